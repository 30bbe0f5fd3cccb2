"""Checks of single pads: dead, stuck, saturated, noisy or frozen taxels, and the share of an episode with contact.

``grip_checks`` compares pads with grippers. One episode cannot show a taxel that nothing touched (it is not called dead), the
pads a and b of one gripper exchanged, and a gain that is wrong for a whole pad.

Shapes: T time, R rows of taxels, C columns. Counts are above baseline.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from taccorl.data.episode import Episode
from taccorl.data.finding import LEAVE_OUT, Finding, finding, listed, not_judged, place
from taccorl.data.joint_checks import FROZEN_S
from taccorl.data.timing import longest, repeated, stretches

JUDGE_S = 2.0  # Shortest episode in which taxels are judged [s]
CONTACT_MIN_TAXELS = 1  # Fewest 3 × 3 means above noise_count that make a contact: one stuck taxel is none
STRUCTURE = 0.25  # Least correlation of neighbours in a contact: 0 for white noise, above 0.5 for wide contacts


@dataclass(frozen=True)
class Pad:
    """One pad's readings in the T rows of one episode; R rows and C columns of taxels."""

    name: str
    counts: np.ndarray
    """(T, R, C) float32 counts above baseline, newest reading of each row."""
    baseline: np.ndarray | None
    """(R, C) resting counts; None where the dataset does not hold them."""
    noise_count: float
    """Largest value of an untouched taxel [counts above baseline]; ``max_count``: largest count that the sensor sends."""
    max_count: int
    fps: int

    @property
    def arm(self) -> str:
        """Arm of the pad, from the prefix of its name: ``left_a`` is on the arm ``left``."""
        return self.name.rpartition("_")[0]

    @functools.cached_property
    def repeated(self) -> np.ndarray:
        """(T,) bool: the frame is bit-identical to that of the row before."""
        return repeated(self.counts)

    @functools.cached_property
    def stuck(self) -> np.ndarray:
        """(R, C) bool: stuck taxels. Repeated frames are not counted: a driver that stopped is another fault."""
        return find_stuck(self, self.counts[~self.repeated])

    @property
    def shorted(self) -> np.ndarray:
        """(R, C) bool: stuck at the wire's maximum."""
        full = np.inf if self.baseline is None else self.max_count - self.baseline
        return self.stuck & (np.median(self.counts, axis=0) >= full)

    @functools.cached_property
    def living(self) -> np.ndarray:
        """(T, R, C) counts; stuck taxels count as 0."""
        return np.where(self.stuck, np.float32(0), self.counts)

    @functools.cached_property
    def smooth(self) -> np.ndarray:
        """(T, R, C) means of ``living`` over 3 × 3 taxels."""
        return uniform_filter1d(
            uniform_filter1d(self.living, 3, axis=1, mode="nearest"),
            3,
            axis=2,
            mode="nearest",
        )

    @functools.cached_property
    def structured(self) -> bool:
        """True if neighbouring taxels are correlated in the strongest frames, as in contact and unlike noise."""
        return spatial_structure(self.living) >= STRUCTURE

    @functools.cached_property
    def contact(self) -> np.ndarray:
        """(T,) bool: the pad reads contact."""
        return (
            (self.smooth >= self.noise_count).sum(axis=(1, 2)) >= CONTACT_MIN_TAXELS
        ) & self.structured


def read_pads(episode: Episode, key: str) -> list[Pad]:
    """The pads of one tactile feature, in the spec's order."""
    sensor, counts, stored = (
        episode.spec.sensors[key],
        episode.pads(key),
        episode.baselines.get(key),
    )
    shape = (len(counts), sensor.rows, sensor.columns)
    baselines = (
        stored.reshape(shape)
        if stored is not None and stored.size == np.prod(shape)
        else [None] * len(counts)
    )
    rest = (sensor.noise_count, sensor.max_count, episode.spec.fps)
    return [
        Pad(n, counts[n].astype(np.float32), b, *rest)
        for n, b in zip(counts, baselines, strict=True)
    ]


def tactile_keys(episode: Episode) -> list[str]:
    """Keys of the tactile features to check: no windows beside a plain feature, which their newest readings repeat."""
    keys = [k for k in episode.spec.sensors if k in episode.arrays]
    return [k for k in keys if episode.spec.features[k].history == 1] or keys


def other_touch_keys(episode: Episode) -> list[str]:
    """Keys of touch whose layout and units no sensor spec states, as other people's datasets have."""
    return [
        k
        for k in episode.arrays
        if k.startswith("observation.tactile") and k not in episode.spec.sensors
    ]


def check_other_touch(episode: Episode, key: str) -> Iterator[Finding]:
    """Touch of any kind: it never changes, a part of it never does, or it stands still for a time."""
    values, fps = episode.arrays[key], episode.spec.fps
    layout = " × ".join(map(str, episode.spec.features[key].layout)) or str(
        values.shape[1]
    )
    known = (
        values[np.isfinite(values).all(axis=1)] if values.dtype.kind == "f" else values
    )
    if len(known) < JUDGE_S * fps:
        yield not_judged(
            key, "touch", f"{len(known) / fps:.1f} s of values, it takes {JUDGE_S:g} s"
        )
        return
    span = f"{known.min():.4g} … {known.max():.4g}"
    stated = [
        u
        for u in dict.fromkeys(episode.spec.features[key].units)
        if u not in ("", "unknown")
    ]
    unit = f"the unit {listed(stated)}" if stated else "a unit that nobody stated"
    yield finding("touch_range", key, f"{key}: {layout} values of {span}, in {unit}")
    constant = np.ptp(known, axis=0) == 0
    if constant.all():
        text = f"{key}: none of its {layout} values ever changes: a sensor that is not connected, or its driver hung"
        yield finding("silent_pad", key, text)
        return
    if constant.any():
        dead = [str(i) for i in np.flatnonzero(constant)]
        text = f"{key}: {len(dead)} of {layout} values never change (elements {listed(dead)}): dead taxels"
        yield finding("dead_taxel", key, text)
    same = repeated(known.astype(float))
    held = stretches(same, fps, SATURATED_S)
    if (
        held and same.mean() < 0.5
    ):  # else a binary or very slow sensor, which holds its values
        rows = longest(held)
        text = f"{key}: bit-identical for {(rows[1] - rows[0]) / fps:.2f} s, {place(rows, fps)}: its driver repeats "
        yield finding("frozen_touch", key, f"{text}old values", rows)


# ---- measures: arrays in, arrays out ----

NOISE_VISIBLE_SHARE = 0.9
"""Least share of taxels that ever change for noise to be visible: constant ones are dead or stuck."""
STUCK_S = 2.0  # Shortest time of a constant value at which a taxel with visible noise is stuck [s]: 60 rows
STUCK_ALWAYS = 0.95  # Share of rows in which a stuck taxel reads touch that none of its neighbours reads
STUCK_BASELINE_FENCE = 1.5  # Tukey's fence: constant and so many interquartile ranges above the upper quartile is stuck
RESTING_COUNT = 3
"""Resting count below which a taxel clips at zero: constant is no fault, unless all others rest higher."""
DEAD_SHARE = 0.1  # A taxel is dead if it shows less than this share of what its neighbours on both sides show
DEAD_GAP = 2  # Most dead taxels side by side that are found; wider gaps may be a hollow in the part
DEAD_MIN_S = 0.3  # Least time that a taxel must lie inside a contact before it can be called dead [s]


def constant_runs(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each taxel (…) of ``counts`` (T, …): rows of its longest stretch without any change, and its value there."""
    row = np.arange(len(counts)).reshape(-1, *[1] * (counts.ndim - 1))
    changed = np.diff(counts, axis=0, prepend=counts[:1] + 1) != 0
    since = row - np.maximum.accumulate(np.where(changed, row, 0), axis=0)
    last = since.argmax(axis=0)
    return since.max(axis=0) + 1, np.take_along_axis(counts, last[None], axis=0)[0]


def _noise_visible(counts: np.ndarray) -> bool:
    return bool((np.ptp(counts, axis=0) > 0).mean() >= NOISE_VISIBLE_SHARE)


def find_stuck(pad: Pad, counts: np.ndarray) -> np.ndarray:
    """(R, C) bool: constant far from its baseline, shorted from the start, or the only taxel with contact at all times; by the
    frames ``counts`` (T, R, C) of a pad."""
    length, value = constant_runs(counts)
    long = length >= min(STUCK_S * pad.fps, len(counts))
    stuck = np.zeros(counts.shape[1:], dtype=bool)
    if _noise_visible(counts):
        stuck = long & (np.abs(value) > pad.noise_count)
        if pad.baseline is not None:
            # At the wire's maximum while others vary: saturated by a touch, unless it never comes down.
            stuck &= (pad.baseline + value < pad.max_count) | (length == len(counts))
            low, high = np.quantile(pad.baseline, (0.25, 0.75))
            stuck |= (length == len(counts)) & (
                pad.baseline > high + STUCK_BASELINE_FENCE * (high - low)
            )
    always = ((np.abs(counts) > pad.noise_count).mean(axis=0) >= STUCK_ALWAYS) & ~stuck
    for r, c in np.argwhere(always):
        around = np.abs(
            counts[:, max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]
        ).reshape(len(counts), -1)
        alone = (around >= np.abs(counts[:, r, c])[:, None] / 2).sum(axis=1) == 1
        stuck[r, c] = alone.mean() >= STUCK_ALWAYS / 2
    return stuck


def inside_contact(counts: np.ndarray) -> np.ndarray:
    """(T, R, C) lower bound of the ``counts`` (T, R, C) of a taxel: the smaller count of two neighbours that enclose it along a
    row or a column (not a diagonal: the inner corner of an L is free), with at most ``DEAD_GAP`` taxels between the two."""
    expected = np.zeros_like(counts)
    for axis in (1, 2):
        padded = np.pad(
            counts, [(DEAD_GAP, DEAD_GAP) if a == axis else (0, 0) for a in range(3)]
        )
        at = {
            by: np.take(padded, np.arange(counts.shape[axis]) + DEAD_GAP + by, axis)
            for by in range(-DEAD_GAP, DEAD_GAP + 1)
        }
        for before in range(1, DEAD_GAP + 1):
            for after in range(1, DEAD_GAP + 2 - before):
                np.maximum(expected, np.minimum(at[-before], at[after]), out=expected)
    return expected


def find_dead(pad: Pad) -> np.ndarray:
    """(R, C) bool: no answer inside a contact, or no noise where all others have some."""
    living = pad.living[pad.living.max(axis=(1, 2)) > 2 * pad.noise_count]
    expected = inside_contact(living)
    inside = expected > 2 * pad.noise_count
    shown, due = (living * inside).sum(axis=0), (expected * inside).sum(axis=0)
    highest = living.max(axis=0, initial=0.0)
    dead = (
        (inside.sum(axis=0) >= DEAD_MIN_S * pad.fps)
        & (shown < DEAD_SHARE * due)
        & (highest <= pad.noise_count)
    )
    if _noise_visible(pad.counts):
        constant = np.ptp(pad.counts, axis=0) == 0
        if (
            pad.baseline is not None
            and np.quantile(pad.baseline, 0.05) < 2 * RESTING_COUNT
        ):
            constant &= pad.baseline >= RESTING_COUNT
        dead |= constant
    return dead & ~pad.stuck


def spatial_structure(counts: np.ndarray) -> float:
    """Correlation (−1 … 1) of next neighbours in the strongest tenth of the frames of ``counts`` (T, R, C), pad means removed."""
    power = np.mean(np.square(counts), axis=(1, 2))
    strongest = counts[np.argsort(power)[-max(len(counts) // 10, 1) :]]
    x = strongest - strongest.mean(axis=(1, 2), keepdims=True)
    neighbours = np.mean(x[:, 1:] * x[:, :-1]) + np.mean(x[:, :, 1:] * x[:, :, :-1])
    return (
        float(neighbours) / (2 * energy) if (energy := float(np.mean(x * x))) else 0.0
    )


# ---- findings ----

SATURATED_S = 0.5  # Least time with saturated taxels for a warning [s]
SATURATED_SHARE = 0.05  # Least share of the rows in contact with saturated taxels for a warning: force is cut off
NOISE_SIGMAS = 3.0  # noise_count divided by this is the largest accepted standard deviation of an untouched taxel
LIVELY_SHARE = 0.1  # Least share of taxels that change between rows at rest: below, a repeated frame is no fault


def taxel_list(mask: np.ndarray) -> str:
    """Text of the taxels in ``mask`` (R, C) bool, such as ``3 taxels: (4, 7), (4, 8), row 11``; whole rows and columns by one
    name."""
    rows, columns = np.flatnonzero(mask.all(axis=1)), np.flatnonzero(mask.all(axis=0))
    rest = mask.copy()
    rest[rows], rest[:, columns] = False, False
    names = [
        *(f"row {r}" for r in rows),
        *(f"column {c}" for c in columns),
        *(f"({r}, {c})" for r, c in np.argwhere(rest)),
    ]
    return f"{mask.sum()} taxel{'s' if mask.sum() > 1 else ''} (row, column): {listed(names, 6)}"


def check_pads(episode: Episode, key: str, pads: list[Pad]) -> Iterator[Finding]:
    """The pads of the feature ``key``, by all checks."""
    if episode.num_rows < JUDGE_S * episode.spec.fps:
        yield not_judged(
            key,
            "taxels",
            f"{episode.num_rows / episode.spec.fps:.1f} s, it takes {JUDGE_S:g} s",
        )
        return
    for pad in pads:
        for single in (_stuck, _dead, _saturated, _noisy, _frozen):
            yield from single(key, pad)
    if any(pad.baseline is None for pad in pads):
        yield not_judged(
            key, "saturation", "no baselines, so that counts on the wire are unknown"
        )
    parts = []
    for p in pads:
        active = (
            (p.counts >= p.noise_count).any(axis=0) & ~p.stuck
        ).mean() * p.structured
        parts.append(
            f"{p.name} in {p.contact.mean():.0%} of the rows, {active:.0%} of its taxels ever active"
        )
    yield finding(
        "contact_coverage",
        key,
        f"contact (≥ {pads[0].noise_count:g} counts): {'; '.join(parts)}",
    )


def _stuck(key: str, pad: Pad) -> Iterator[Finding]:
    stuck = pad.stuck & ~pad.shorted
    if stuck.any():
        baseline = 0 * pad.counts[0] if pad.baseline is None else pad.baseline
        level = [
            f"{v:.0f}"
            for v in np.median(pad.counts[:, stuck] + baseline[stuck], axis=0)
        ]
        where = "above baseline" if pad.baseline is None else "on the wire"
        text = f"{pad.name}: stuck at {listed(level, 3)} counts {where}, {taxel_list(stuck)}: pinched by the mounting, "
        yield finding(
            "stuck_taxel",
            key,
            f"{text}or a trace shorted to its neighbour; mask them for training",
        )


def _dead(key: str, pad: Pad) -> Iterator[Finding]:
    if (dead := find_dead(pad)).any():
        text = f"{pad.name}: no answer while the taxels on both sides are pressed, or no noise, {taxel_list(dead)}: a "
        text += "broken trace (whole rows or columns: the connector), or a slot in the part just there"
        yield finding("dead_taxel", key, text)


def _saturated(key: str, pad: Pad) -> Iterator[Finding]:
    most = f"the wire's maximum ({pad.max_count} counts)"
    if pad.shorted.any():
        text = f"{pad.name}: always at {most}, {taxel_list(pad.shorted)}: a short to the supply; mask them for training"
        yield finding("saturated", key, text)
    full = (
        pad.counts + (np.nan if pad.baseline is None else pad.baseline) >= pad.max_count
    ) & ~pad.stuck
    rows = np.flatnonzero(full.any(axis=(1, 2)))
    if len(rows):
        share, where = (
            len(rows) / max(int(pad.contact.sum()), len(rows)),
            (int(rows[0]), int(rows[-1]) + 1),
        )
        bad = len(rows) / pad.fps >= SATURATED_S and share >= SATURATED_SHARE
        text = f"{pad.name}: up to {full.sum(axis=(1, 2)).max()} taxels at {most} in {len(rows)} rows, {share:.0%} of "
        text += f"those in contact, {place(where, pad.fps)}: force is cut off there; grip less hard, or lower the board's gain"
        yield finding("saturated", key, text, where, None if bad else "note")


def _noisy(key: str, pad: Pad) -> Iterator[Finding]:
    """By the standard deviation between rows of a typical taxel: most are untouched most of the time."""
    std, limit = (
        np.median(np.sqrt(np.mean(np.diff(pad.counts, axis=0) ** 2, axis=0) / 2)),
        pad.noise_count / NOISE_SIGMAS,
    )
    if std > limit:
        text = f"{pad.name}: a typical taxel jitters by {std:.1f} counts (standard deviation from row to row), noise_count "
        text += f"{pad.noise_count:g} allows {limit:.1f}: loose connector, missing ground, or a byte shift on the wire"
        yield finding("noisy_pad", key, text)


def _frozen(key: str, pad: Pad) -> Iterator[Finding]:
    found, at_rest = (
        stretches(pad.repeated, pad.fps, FROZEN_S),
        np.flatnonzero(~pad.repeated[1:] & ~pad.contact[1:]),
    )
    if not found or len(at_rest) < FROZEN_S * pad.fps:
        return
    if np.mean(pad.counts[at_rest + 1] != pad.counts[at_rest]) >= LIVELY_SHARE:
        rows = longest(found)
        text = f"{pad.name}: frames repeat bit by bit for {(rows[1] - rows[0]) / pad.fps:.2f} s, "
        text += f"{place(rows, pad.fps)}, "
        text += f"{sum(b - a for a, b in found)} rows in all: its driver hung and published an old frame; {LEAVE_OUT}"
        yield finding("frozen_touch", key, text, rows)
