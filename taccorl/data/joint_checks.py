"""Checks of joints and commands: limits and units, jumps, idle stretches, repeated values.

Letters in shapes: T rows, J elements of the vector.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from taccorl.data.episode import Arm, Episode
from taccorl.data.finding import LEAVE_OUT, Finding, finding, listed, not_judged, place
from taccorl.data.spec import ACTION, STATE
from taccorl.data.timing import longest, repeated, runs, stretches

LIMIT_TOLERANCE = 0.02
"""Share of the valid span by which a value may lie outside: calibration offsets and the leader's own stops."""
JOINT_SPEED_RAD_PER_S = 3.93
"""Highest plausible joint speed: 225 °/s, of PiPER's fastest joints (J4 to J6; J1 to J3: 180 to 195 °/s)."""
GRIPPER_SPEED_M_PER_S = 1.5
"""Highest plausible gripper speed: the whole stroke of 70 mm in 47 ms, faster than a hand can press the leader's trigger."""
SPEEDS = {"rad": JOINT_SPEED_RAD_PER_S, "m": GRIPPER_SPEED_M_PER_S}
"""Unit of a position → highest speed that is plausible for it [that unit per second]."""
JUMP_MARGIN = 2.0
"""Factor on the largest plausible step between rows: two neighbouring rows may show samples that are two rows apart."""
STILL_RAD = 0.02
"""A joint whose angle stays within this range for a second is at rest [rad]: a trembling hand on the leader moves it about half
as much."""
STILL_M = 0.002  # A gripper whose opening stays within this range for a second is at rest [m]
STILL_WINDOW_S = 1.0  # Time in which a joint must stay within its range to be at rest [s]
IDLE_END_S = 3.0
"""Longest accepted rest at the start or end of an episode [s]; a policy would learn to wait, so longer ones should be trimmed."""
IDLE_MIDDLE_S = 5.0  # Longest accepted rest in the middle of an episode [s]
FROZEN_S = 0.5
"""Time of bit-identical states, while the command moves, that is reported [s]: 15 rows at 30 fps are no coincidence."""
MOVING_RAD = 0.05  # Least range of a moving joint [rad]: 2.9°, well above tremor


def check_values(episode: Episode) -> Iterator[Finding]:
    """Check every feature that is not a video for NaN, infinity, limits and units."""
    for key, values in episode.arrays.items():
        finite = np.isfinite(values)
        if episode.spec.features[key].optional and np.isnan(values).all():
            yield finding("unknown", key, f"{key} is NaN in every row: this episode does not have it")
        elif not finite.all():
            rows, elements = np.flatnonzero(~finite.all(axis=1)), np.flatnonzero(~finite.all(axis=0))
            names = listed([episode.element_names(key)[i] for i in elements])
            where = (int(rows[0]), int(rows[-1]) + 1)
            text = (
                f"{names}: {int((~finite).sum())} values are NaN or infinite in {len(rows)} rows, "
                f"{place(where, episode.spec.fps)}: the driver or a division wrote them; {LEAVE_OUT}"
            )
            yield finding("not_finite", key, text, where)
        yield from _check_limits(episode, key, np.where(finite, values, 0.0), finite)


def outside(values: np.ndarray, limits: np.ndarray, tolerance: float = LIMIT_TOLERANCE) -> np.ndarray:
    """(T, J) bool: ``values`` (T, J) outside ``limits`` (J, 2), low and high, by more than ``tolerance`` of the span."""
    span = limits[:, 1] - limits[:, 0]
    slack = np.where(np.isfinite(span), tolerance * span, 0.0)
    return (values < limits[:, 0] - slack) | (values > limits[:, 1] + slack)


def unit_hint(values: np.ndarray, limit: np.ndarray, unit: str) -> str | None:
    """Name of the unit in which all values (T,) of an element would lie within its limits; None if there is none."""
    if unit == "m" and values.min() >= -0.05 and values.max() <= 1.05:
        return "a normalised opening 0 to 1"
    candidates = {
        "rad": (("degrees", math.pi / 180), ("0.001 degrees, PiPER's SDK unit", math.pi / 180_000)),
        "m": (("millimetres", 1e-3), ("0.001 mm, PiPER's SDK unit", 1e-6)),
    }
    for name, factor in candidates.get(unit, ()):
        if not outside(factor * values[:, None], limit[None]).any():
            return name
    return None


def _check_limits(episode: Episode, key: str, values: np.ndarray, finite: np.ndarray) -> Iterator[Finding]:
    """One finding for all elements in the same wrong unit, else one for each element."""
    feature, is_touch = episode.spec.features[key], key in episode.spec.sensors
    known = np.array([u != "unknown" for u in feature.units])
    bad = outside(values, feature.limits, 0.0 if is_touch else LIMIT_TOLERANCE) & finite & known
    by_hint: dict[tuple[str | None, int], list[int]] = {}
    for i in np.flatnonzero(bad.any(axis=0)):
        hint = unit_hint(values[:, i], feature.limits[i], feature.units[i])
        group = -1 if hint is not None or is_touch else int(i)
        by_hint.setdefault((hint, group), []).append(int(i))
    for (hint, _), elements in by_hint.items():
        yield _limit_finding(episode, key, values, bad, elements, hint)


def _limit_finding(
    episode: Episode, key: str, values: np.ndarray, bad: np.ndarray, elements: list[int], hint: str | None
) -> Finding:
    feature, names = episode.spec.features[key], episode.element_names(key)
    low, high = feature.limits[elements].T
    excess = np.where(bad[:, elements], np.maximum(values[:, elements] - high, low - values[:, elements]), -np.inf)
    row, worst = np.unravel_index(np.argmax(excess / (high - low)), excess.shape)
    i = elements[worst]
    rows = np.flatnonzero(bad[:, elements].any(axis=1))
    others = [names[j] for j in elements if j != i]
    also = f" (also {listed(others)})" if others else ""
    way_out = "a wrong joint order, zero point or scale? If the robot does reach it, widen `range` in the data spec"
    way_out = way_out if hint is None else f"{hint}? Set `scale` on its channel"
    share = "" if key in episode.spec.sensors else f" by more than {LIMIT_TOLERANCE:.0%} of the span"
    text = (
        f"{names[i]} = {values[row, i]:.4g} outside [{low[worst]:g}, {high[worst]:g}] {feature.units[i]}{share} at row "
        f"{row}, {len(rows)} rows in all{also}: {way_out}"
    )
    check = "joint_limit" if feature.units[i] in SPEEDS else "out_of_range"
    return finding(check, key, text, (int(rows[0]), int(rows[-1]) + 1))


def check_jumps(episode: Episode, key: str) -> Iterator[Finding]:
    """Find steps between rows of the feature ``key`` that are larger than a joint can move in that time."""
    fps, units, names = episode.spec.fps, episode.spec.features[key].units, episode.element_names(key)
    furthest = np.array([SPEEDS.get(u, np.inf) for u in units]) * JUMP_MARGIN / fps
    steps = np.abs(np.diff(episode.arrays[key].astype(float), axis=0))
    for i in np.flatnonzero((steps > furthest).any(axis=0)):
        rows = np.flatnonzero(steps[:, i] > furthest[i])
        row = int(rows[np.argmax(steps[rows, i])])
        text = (
            f"{names[i]} steps by {steps[row, i]:.3g} {units[i]} from row {row} to {row + 1} ({(row + 1) / fps:.2f} s), "
            f"{len(rows)} such steps; at {SPEEDS[units[i]]:g} {units[i]}/s it can go {furthest[i]:.3g} {units[i]} in "
            f"{JUMP_MARGIN:g} rows: a glitch of the encoder, or time is missing here"
        )
        yield finding("jump", key, text, (row, row + 2))


def check_sample_jumps(
    channel: str, values: np.ndarray, time_s: np.ndarray, names: Sequence[str], units: Sequence[str], row_s: float
) -> Iterator[Finding]:
    """Find steps between samples of a channel that are larger than a joint can move in that time.

    Rows hold a part of a fast channel's samples, and a possible step between two samples is smaller than one between two rows. A
    driver may repeat a reading: so the time of a step is taken from the last change, but at most one row.

    Args:
        values: (N, J) samples of an episode, in rad and m where ``units`` say so; others are not judged.
        time_s: (N,) since row 0 [s], increasing.
        names: of the J elements.
        row_s: time between rows [s].
    """
    speed_per_s = np.array([SPEEDS.get(u, np.inf) for u in units])
    if len(values) < 3 or np.isinf(speed_per_s).all():
        return
    with np.errstate(invalid="ignore", over="ignore"):  # values that are not finite are an error of their own
        steps, between_s = np.abs(np.diff(values, axis=0)), np.diff(time_s)
    changed = np.concatenate([[True], (steps[:-1] > 0).any(axis=1)])
    last_change = np.maximum.accumulate(np.where(changed, np.arange(len(steps)), 0))
    since_s = np.maximum(
        np.minimum(time_s[1:] - time_s[last_change], row_s), np.maximum(between_s, np.median(between_s))
    )
    furthest = JUMP_MARGIN * since_s[:, None] * np.where(np.isinf(speed_per_s), 0.0, speed_per_s)
    too_far = (steps > furthest) & np.isfinite(speed_per_s)
    for i in np.flatnonzero(too_far.any(axis=0)):
        samples = np.flatnonzero(too_far[:, i])
        k = int(samples[np.argmax(steps[samples, i])])
        text = (
            f"{channel}: {names[i]} goes from {values[k, i]:.4g} to {values[k + 1, i]:.4g} {units[i]} in "
            f"{1000 * between_s[k]:.1f} ms, at {time_s[k + 1]:.3f} s, {len(samples)} such steps; at {speed_per_s[i]:g} "
            f"{units[i]}/s it can go {furthest[k, i]:.3g} {units[i]}: changed bytes, a glitch of the encoder, or a wrong stamp"
        )
        yield finding("sample_jump", channel, text)


def still_rows(values: np.ndarray, threshold: np.ndarray, window: int) -> np.ndarray:
    """(T,) bool: rows of every stretch of ``window`` rows in which each column of ``values`` (T, J) stays within its
    ``threshold`` (J,)."""
    if len(values) < window:
        return np.zeros(len(values), dtype=bool)
    spread = maximum_filter1d(values, window, axis=0) - minimum_filter1d(values, window, axis=0)
    half = window // 2
    inside = np.zeros(len(values), dtype=bool)
    centers = slice(half, len(values) - (window - 1 - half))
    inside[centers] = np.all(spread <= threshold, axis=1)[centers]
    return maximum_filter1d(inside, window, origin=-1 if window % 2 == 0 else 0)


def check_idle(episode: Episode, touch: np.ndarray) -> Iterator[Finding]:
    """Find stretches in which nothing moves, commands are constant and touch does not change. ``touch``: (T, P) mean counts
    of each pad, P may be 0: pressing with arms at rest is work, not idling."""
    columns, thresholds, limit = [], [], {"rad": STILL_RAD, "m": STILL_M}
    for key in (STATE, ACTION):
        if key in episode.arrays:
            known = [(i, limit[u]) for i, u in enumerate(episode.spec.features[key].units) if u in limit]
            columns.append(episode.arrays[key][:, [i for i, _ in known]])
            thresholds += [threshold for _, threshold in known]
    if not thresholds:
        yield not_judged(STATE, "idle times", "no element in rad or m")
        return
    if touch.size:
        columns.append(touch)
        thresholds += [*np.maximum(0.1 * np.abs(touch).max(axis=0), 1.0)]  # counts; a pad's mean hardly has noise
    fps, num_rows = episode.spec.fps, episode.num_rows
    still = still_rows(np.concatenate(columns, axis=1), np.array(thresholds), round(STILL_WINDOW_S * fps))
    for first, end in runs(still):
        where = "start" if first == 0 else "end" if end == num_rows else "middle"
        if (end - first) / fps < (IDLE_MIDDLE_S if where == "middle" else IDLE_END_S):
            continue
        text = (
            f"nothing moves for {(end - first) / fps:.1f} s at the {where} ({place((first, end), fps)}; no joint by more than "
            f"{STILL_RAD:g} rad): a policy learns to wait; record again without the rest, or {LEAVE_OUT}"
        )
        yield finding("idle", STATE, text, (first, end))


def check_frozen_state(episode: Episode, arm: Arm) -> Iterator[Finding]:
    """Find an arm whose state repeats bit by bit while its command moves: its driver republishes old values."""
    fps, action = episode.spec.fps, episode.arrays[ACTION][:, arm.joints]
    moved = {
        (first, end): float(np.ptp(action[first:end], axis=0).max(initial=0.0))
        for first, end in stretches(repeated(episode.arrays[STATE][:, arm.joints]), fps, FROZEN_S)
    }
    found = [rows for rows, range_rad in moved.items() if range_rad > MOVING_RAD]
    if found:
        rows = longest(found)
        text = (
            f"{arm.name or 'arm'}: joints stay bit-identical for {(rows[1] - rows[0]) / fps:.2f} s while the command moves by "
            f"{moved[rows]:.2f} rad, {place(rows, fps)} ({len(found)} such times): arm disabled, or its driver repeats old values"
        )
        yield finding("frozen_state", STATE, text, rows)
