"""Checks of single pads: dead, stuck, saturated, noisy or frozen taxels, and the share of an episode with contact.

Each pad is judged alone; ``grip_checks`` compares touch with the grippers. One episode cannot show: a taxel that
nothing touched (it is not called dead), the pads a and b of one gripper exchanged (both touch the same part at the
same time), and a gain that is wrong for a whole pad.

Letters in shapes: T time, R rows of taxels, C columns. Counts are above baseline.
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
CONTACT_MIN_TAXELS = 1
"""Least number of 3 × 3 means above the sensor's noise that make a contact. Means are used so that one stuck taxel is no
contact."""
DEAD_SHARE = 0.1  # A taxel is dead if it shows less than this share of what its neighbours on both sides show
DEAD_GAP = 2  # Most dead taxels side by side that are found; wider gaps may be a hollow in the part
DEAD_MIN_S = 0.3  # Least time that a taxel must lie inside a contact before it can be called dead [s]
NOISE_VISIBLE_SHARE = 0.9
"""Least share of a pad's taxels that change at some time for noise to be visible; a constant taxel is then dead or stuck."""
RESTING_COUNT = 3
"""Resting count below which a taxel clips at zero, so that constant values are no fault, unless all other taxels rest higher."""
STUCK_S = 2.0  # Shortest time of a constant value at which a taxel with visible noise is stuck [s]: 60 rows
STUCK_ALWAYS = 0.95  # Share of rows in which a stuck taxel reads touch that none of its neighbours reads
STUCK_BASELINE_FENCE = 1.5
"""Tukey's fence: a constant taxel is stuck, not dead, if it rests more than this many interquartile ranges above the pad's upper
quartile."""
SATURATED_S = 0.5  # Least time with saturated taxels for a warning [s]
SATURATED_SHARE = 0.05
"""Share of the rows in contact with saturated taxels from which on the finding is a warning, since force magnitude is lost;
below, it is a note."""
NOISE_SIGMAS = 3.0
"""The sensor's ``noise_count`` divided by this is the largest accepted standard deviation of an untouched taxel."""
LIVELY_SHARE = 0.1
"""Least share of taxels that change from row to row at rest for noise to be visible; below it a repeated frame is no sign of a
fault."""
STRUCTURE = 0.25
"""Least correlation of neighbouring taxels in a contact: 0 for white noise, above 0.5 for any contact wider than one taxel."""


@dataclass(frozen=True)
class Pad:
    """One pad's readings in the T rows of one episode; R rows and C columns of taxels."""

    name: str
    counts: np.ndarray
    """(T, R, C) float32 counts above baseline, newest reading of each row."""
    baseline: np.ndarray | None
    """(R, C) resting counts; None where the dataset does not hold them."""
    noise_count: float
    """Largest value of an untouched taxel [counts above baseline]."""
    max_count: int
    """Largest count that the sensor sends."""
    fps: int

    @property
    def arm(self) -> str:
        """Arm of the pad, from the prefix of its name: ``left_a`` is on the arm ``left``."""
        return self.name.rpartition("_")[0]

    @functools.cached_property
    def repeated(self) -> np.ndarray:
        """(T,) bool: the pad's frame is bit-identical to the frame of the row before."""
        return repeated(self.counts)

    @functools.cached_property
    def stuck(self) -> np.ndarray:
        """(R, C) bool: stuck taxels. Repeated frames are not counted: a driver that stopped is another fault."""
        fresh = self.counts[~self.repeated]
        return find_stuck(fresh, self.baseline, self.noise_count, self.max_count, self.fps)

    @property
    def shorted(self) -> np.ndarray:
        """(R, C) bool: stuck at the wire's maximum."""
        if self.baseline is None:
            return np.zeros_like(self.stuck)
        return self.stuck & (np.median(self.counts, axis=0) + self.baseline >= self.max_count)

    @functools.cached_property
    def smooth(self) -> np.ndarray:
        """(T, R, C) means over 3 × 3 taxels; stuck taxels count as 0."""
        living = np.where(self.stuck, np.float32(0), self.counts)
        return uniform_filter1d(uniform_filter1d(living, 3, axis=1, mode="nearest"), 3, axis=2, mode="nearest")

    @functools.cached_property
    def structured(self) -> bool:
        """True if neighbouring taxels are correlated in the strongest frames, as in contact and unlike noise."""
        return spatial_structure(np.where(self.stuck, np.float32(0), self.counts)) >= STRUCTURE

    @functools.cached_property
    def contact(self) -> np.ndarray:
        """(T,) bool: the pad reads contact."""
        if not self.structured:
            return np.zeros(len(self.counts), dtype=bool)
        return (self.smooth >= self.noise_count).sum(axis=(1, 2)) >= CONTACT_MIN_TAXELS

    @functools.cached_property
    def noise_std(self) -> float:
        """Standard deviation between rows of a typical taxel [counts]: most taxels are untouched most of the time."""
        return float(np.median(np.sqrt(np.mean(np.diff(self.counts, axis=0) ** 2, axis=0) / 2)))


def read_pads(episode: Episode, key: str) -> list[Pad]:
    """Read the pads of one tactile feature, in the spec's order."""
    sensor, fps = episode.spec.sensors[key], episode.spec.fps
    counts = episode.pads(key)
    shape = (len(counts), sensor.rows, sensor.columns)
    stored = episode.baselines.get(key)
    baselines = stored.reshape(shape) if stored is not None and stored.size == np.prod(shape) else [None] * len(counts)
    return [
        Pad(name, counts[name].astype(np.float32), baseline, sensor.noise_count, sensor.max_count, fps)
        for name, baseline in zip(counts, baselines, strict=True)
    ]


def tactile_keys(episode: Episode) -> list[str]:
    """Return the keys of the tactile features to check. The newest reading of a window repeats the plain feature of the same
    pads, so that a window is not checked if there is a plain feature."""
    keys = [k for k in episode.spec.sensors if k in episode.arrays]
    plain = [k for k in keys if episode.spec.features[k].history == 1]
    return plain or keys


def other_touch_keys(episode: Episode) -> list[str]:
    """Return the keys of touch whose layout and units no sensor spec states, as other people's datasets have."""
    return [k for k in episode.arrays if k.startswith("observation.tactile") and k not in episode.spec.sensors]


def check_other_touch(episode: Episode, key: str) -> Iterator[Finding]:
    """Find what is wrong with touch of any kind: it never changes, a part of it never does, or it stands still for a time."""
    values, fps = episode.arrays[key], episode.spec.fps
    layout = " × ".join(map(str, episode.spec.features[key].layout)) or str(values.shape[1])
    known = values[np.isfinite(values).all(axis=1)] if values.dtype.kind == "f" else values
    if len(known) < JUDGE_S * fps:
        yield not_judged(key, "touch", f"{len(known) / fps:.1f} s of values, it takes {JUDGE_S:g} s")
        return
    span = f"{known.min():.4g} … {known.max():.4g}"
    yield finding("touch_range", key, f"{key}: {layout} values of {span}, in a unit that nobody stated")
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
    if held and same.mean() < 0.5:  # else a binary or very slow sensor, which holds its values
        rows = longest(held)
        text = f"{key}: bit-identical for {(rows[1] - rows[0]) / fps:.2f} s, {place(rows, fps)}: its driver repeats old values"
        yield finding("frozen_touch", key, text, rows)


# ---- measures: arrays in, arrays out ----


def constant_runs(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each taxel (…) the number of rows of its longest stretch without any change, and its value there, from
    ``counts`` (T, …)."""
    row = np.arange(len(counts)).reshape(-1, *[1] * (counts.ndim - 1))
    changed = np.diff(counts, axis=0, prepend=counts[:1] + 1) != 0
    since = row - np.maximum.accumulate(np.where(changed, row, 0), axis=0)
    last = since.argmax(axis=0)
    return since.max(axis=0) + 1, np.take_along_axis(counts, last[None], axis=0)[0]


def noise_visible(counts: np.ndarray) -> bool:
    """True if nearly all taxels of ``counts`` (T, R, C) change at some time, so that a constant one is a fault."""
    return bool((np.ptp(counts, axis=0) > 0).mean() >= NOISE_VISIBLE_SHARE)


def find_stuck(
    counts: np.ndarray, baseline: np.ndarray | None, noise_count: float, max_count: int, fps: int
) -> np.ndarray:
    """(R, C) bool: constant far from its baseline, shorted from the start, or the only taxel with contact at all times.

    ``counts`` (T, R, C) are above ``baseline`` (R, C); the other arguments are those of ``Pad``.
    """
    length, value = constant_runs(counts)
    long = length >= min(STUCK_S * fps, len(counts))
    stuck = np.zeros(counts.shape[1:], dtype=bool)
    if noise_visible(counts):
        stuck = long & (np.abs(value) > noise_count)
        if baseline is not None:
            # At the wire's maximum while others vary: saturated by a touch, unless it never comes down.
            stuck &= (baseline + value < max_count) | (length == len(counts))
            low, high = np.quantile(baseline, (0.25, 0.75))
            stuck |= (length == len(counts)) & (baseline > high + STUCK_BASELINE_FENCE * (high - low))
    always = ((np.abs(counts) > noise_count).mean(axis=0) >= STUCK_ALWAYS) & ~stuck
    for r, c in np.argwhere(always):
        around = np.abs(counts[:, max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]).reshape(len(counts), -1)
        own = np.abs(counts[:, r, c])
        alone = (around >= own[:, None] / 2).sum(axis=1) == 1
        stuck[r, c] = alone.mean() >= STUCK_ALWAYS / 2
    return stuck


def inside_contact(counts: np.ndarray) -> np.ndarray:
    """(T, R, C) lower bound of the ``counts`` (T, R, C) of a taxel: the smaller count of two neighbours that enclose it.

    It is enclosed along a row or a column (not a diagonal: the inner corner of an L-shaped contact is free), with at most
    ``DEAD_GAP`` taxels between the two.
    """
    expected = np.zeros_like(counts)
    for axis in (1, 2):
        padded = np.pad(counts, [(DEAD_GAP, DEAD_GAP) if a == axis else (0, 0) for a in range(3)])

        def shifted(by: int, axis: int = axis, padded: np.ndarray = padded) -> np.ndarray:
            start = DEAD_GAP + by
            return np.take(padded, range(start, start + counts.shape[axis]), axis=axis)

        for before in range(1, DEAD_GAP + 1):
            for after in range(1, DEAD_GAP + 2 - before):
                np.maximum(expected, np.minimum(shifted(-before), shifted(after)), out=expected)
    return expected


def find_dead(
    counts: np.ndarray, baseline: np.ndarray | None, stuck: np.ndarray, noise_count: float, fps: int
) -> np.ndarray:
    """(R, C) bool: no answer inside a contact, or no noise where all others have some.

    ``counts`` (T, R, C) are above ``baseline`` (R, C); ``stuck`` (R, C) bool is the result of ``find_stuck``.
    """
    living = np.where(stuck, np.float32(0), counts)
    touched = np.flatnonzero(living.max(axis=(1, 2)) > 2 * noise_count)
    living = living[touched]
    expected = inside_contact(living)
    inside = expected > 2 * noise_count
    num_inside = inside.sum(axis=0)
    shown, due = (living * inside).sum(axis=0), (expected * inside).sum(axis=0)
    highest = living.max(axis=0, initial=0.0)
    dead = (num_inside >= DEAD_MIN_S * fps) & (shown < DEAD_SHARE * due) & (highest <= noise_count)
    if noise_visible(counts):
        constant = np.ptp(counts, axis=0) == 0
        if baseline is not None and np.quantile(baseline, 0.05) < 2 * RESTING_COUNT:
            constant &= baseline >= RESTING_COUNT
        dead |= constant
    return dead & ~stuck


def spatial_structure(counts: np.ndarray) -> float:
    """Correlation (−1 … 1) of next neighbours in the strongest tenth of the frames of ``counts`` (T, R, C), pad means removed."""
    power = np.mean(np.square(counts), axis=(1, 2))
    strongest = counts[np.argsort(power)[-max(len(counts) // 10, 1) :]]
    x = strongest - strongest.mean(axis=(1, 2), keepdims=True)
    energy = float(np.mean(x * x))
    if energy == 0:
        return 0.0
    return float((np.mean(x[:, 1:] * x[:, :-1]) + np.mean(x[:, :, 1:] * x[:, :, :-1])) / (2 * energy))


# ---- findings ----


def taxel_list(mask: np.ndarray) -> str:
    """Text that names the taxels that are true in ``mask`` (R, C) bool, such as ``3 taxels: (4, 7), (4, 8), row 11``; whole rows
    and columns by one name."""
    rows, columns = np.flatnonzero(mask.all(axis=1)), np.flatnonzero(mask.all(axis=0))
    rest = mask.copy()
    rest[rows], rest[:, columns] = False, False
    names = [f"row {r}" for r in rows] + [f"column {c}" for c in columns]
    names += [f"({r}, {c})" for r, c in np.argwhere(rest)]
    count = int(mask.sum())
    return f"{count} taxel{'s' if count > 1 else ''} (row, column): {listed(names, 6)}"


def check_pads(episode: Episode, key: str, pads: list[Pad]) -> Iterator[Finding]:
    """Check the pads of the feature ``key`` by all checks."""
    if episode.num_rows < JUDGE_S * episode.spec.fps:
        yield not_judged(key, "taxels", f"{episode.num_rows / episode.spec.fps:.1f} s, it takes {JUDGE_S:g} s")
        return
    for pad in pads:
        for check in (_check_stuck, _check_dead, _check_saturated, _check_noise, _check_frozen):
            yield from check(key, pad)
    if any(pad.baseline is None for pad in pads):
        yield not_judged(key, "saturation", "no baselines, so that counts on the wire are unknown")
    active = {
        p.name: ((p.counts >= p.noise_count).any(axis=0) & ~p.stuck).mean() if p.structured else 0.0 for p in pads
    }
    parts = (
        f"{p.name} in {p.contact.mean():.0%} of the rows, {active[p.name]:.0%} of its taxels ever active" for p in pads
    )
    yield finding("contact_coverage", key, f"contact (≥ {pads[0].noise_count:g} counts): {'; '.join(parts)}")


def _check_stuck(key: str, pad: Pad) -> Iterator[Finding]:
    stuck = pad.stuck & ~pad.shorted
    if stuck.any():
        baseline = pad.baseline if pad.baseline is not None else np.zeros_like(pad.counts[0])
        level = np.median(pad.counts[:, stuck] + baseline[stuck], axis=0)
        where = "on the wire" if pad.baseline is not None else "above baseline"
        text = (
            f"{pad.name}: stuck at {listed([f'{v:.0f}' for v in level], 3)} counts {where}, {taxel_list(stuck)}: a taxel pinched "
            "by the mounting, or a trace shorted to its neighbour; mask them for training"
        )
        yield finding("stuck_taxel", key, text)


def _check_dead(key: str, pad: Pad) -> Iterator[Finding]:
    dead = find_dead(pad.counts, pad.baseline, pad.stuck, pad.noise_count, pad.fps)
    if dead.any():
        text = (
            f"{pad.name}: no answer while the taxels on both sides are pressed, or no noise, {taxel_list(dead)}: a broken trace "
            "(whole rows or columns: the connector), or a slot in the part just there"
        )
        yield finding("dead_taxel", key, text)


def _check_saturated(key: str, pad: Pad) -> Iterator[Finding]:
    most = f"the wire's maximum ({pad.max_count} counts)"
    if pad.shorted.any():
        text = f"{pad.name}: always at {most}, {taxel_list(pad.shorted)}: a short to the supply; mask them for training"
        yield finding("saturated", key, text)
    if pad.baseline is None:
        return
    full = (pad.counts + pad.baseline >= pad.max_count) & ~pad.stuck
    rows = np.flatnonzero(full.any(axis=(1, 2)))
    if len(rows):
        share = len(rows) / max(int(pad.contact.sum()), len(rows))
        bad = len(rows) / pad.fps >= SATURATED_S and share >= SATURATED_SHARE
        where = (int(rows[0]), int(rows[-1]) + 1)
        text = (
            f"{pad.name}: up to {int(full.sum(axis=(1, 2)).max())} taxels at {most} in {len(rows)} rows, {share:.0%} of those in "
            f"contact, {place(where, pad.fps)}: force is cut off there; grip less hard, or lower the board's gain"
        )
        yield finding("saturated", key, text, where, severity=None if bad else "note")


def _check_noise(key: str, pad: Pad) -> Iterator[Finding]:
    limit = pad.noise_count / NOISE_SIGMAS
    if pad.noise_std > limit:
        text = (
            f"{pad.name}: a typical taxel jitters by {pad.noise_std:.1f} counts (standard deviation from row to row), the "
            f"sensor's noise_count {pad.noise_count:g} allows {limit:.1f}: loose connector, missing ground, or a byte shift on "
            "the wire"
        )
        yield finding("noisy_pad", key, text)


def _check_frozen(key: str, pad: Pad) -> Iterator[Finding]:
    found = stretches(pad.repeated, pad.fps, FROZEN_S)
    at_rest = np.flatnonzero(~pad.repeated[1:] & ~pad.contact[1:])
    if not found or len(at_rest) < FROZEN_S * pad.fps:
        return
    if np.mean(pad.counts[at_rest + 1] != pad.counts[at_rest]) >= LIVELY_SHARE:
        rows, num_rows = longest(found), sum(end - first for first, end in found)
        text = (
            f"{pad.name}: frames repeat bit by bit for {(rows[1] - rows[0]) / pad.fps:.2f} s, {place(rows, pad.fps)}, {num_rows} "
            f"rows in all: its driver hung and published an old frame; {LEAVE_OUT}"
        )
        yield finding("frozen_touch", key, text, rows)
