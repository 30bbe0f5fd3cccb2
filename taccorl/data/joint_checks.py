"""Checks of joints and commands: limits and units, jumps, idle stretches, repeated values.

Letters in shapes: T rows, J elements of the vector.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from taccorl.data.arms import ACTION, STATE, Arm, element_names, element_units
from taccorl.data.episode import Episode
from taccorl.data.finding import LEAVE_OUT, Finding, listed, not_judged, place
from taccorl.data.timing import runs

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


# ---- values ----


def check_values(episode: Episode) -> list[Finding]:
    """Check every feature that is not a video for NaN, infinity, limits and units; returns findings."""
    findings = []
    for key, values in episode.arrays.items():
        finite = np.isfinite(values)
        if episode.spec.features[key].optional and np.isnan(values).all():
            findings.append(
                Finding("unknown", "note", key, f"{key} is NaN in every row: this episode does not have it")
            )
        elif not finite.all():
            rows, elements = ~finite.all(axis=1), np.flatnonzero(~finite.all(axis=0))
            names = [element_names(episode, key)[i] for i in elements]
            where = (int(np.flatnonzero(rows)[0]), int(np.flatnonzero(rows)[-1]) + 1)
            findings.append(
                Finding(
                    "not_finite",
                    "error",
                    key,
                    f"{listed(names)}: {int((~finite).sum())} values are NaN or infinite in {int(rows.sum())} rows, "
                    f"{place(where, episode.spec.fps)}: the driver or a division wrote them; {LEAVE_OUT}",
                    where,
                )
            )
        findings += _check_limits(episode, key, np.where(finite, values, 0.0), finite)
    return findings


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


def _check_limits(episode: Episode, key: str, values: np.ndarray, finite: np.ndarray) -> list[Finding]:
    feature, units = episode.spec.features[key], element_units(episode, key)
    known = np.array([u != "unknown" for u in units])
    tolerance = 0.0 if key in episode.spec.sensors else LIMIT_TOLERANCE
    bad = outside(values, feature.limits, tolerance) & finite & known
    by_hint: dict[tuple[str | None, int], list[int]] = {}
    for i in np.flatnonzero(bad.any(axis=0)):
        hint = unit_hint(values[:, i], feature.limits[i], units[i])
        group = -1 if hint is not None or key in episode.spec.sensors else int(i)
        by_hint.setdefault((hint, group), []).append(int(i))
    return [_limit_finding(episode, key, values, bad, elements, hint) for (hint, _), elements in by_hint.items()]


def _limit_finding(
    episode: Episode, key: str, values: np.ndarray, bad: np.ndarray, elements: list[int], hint: str | None
) -> Finding:
    limits, units, names = episode.spec.features[key].limits, element_units(episode, key), element_names(episode, key)
    low, high = limits[elements].T
    excess = np.where(bad[:, elements], np.maximum(values[:, elements] - high, low - values[:, elements]), -np.inf)
    row, worst = np.unravel_index(np.argmax(excess / (high - low)), excess.shape)
    i = elements[worst]
    rows = np.flatnonzero(bad[:, elements].any(axis=1))
    where = (int(rows[0]), int(rows[-1]) + 1)
    others = [names[j] for j in elements if j != i]
    also = f" (also {listed(others)})" if others else ""
    if hint is not None:
        way_out = f"{hint}? Set `scale` on its channel"
    else:
        way_out = "a wrong joint order, zero point or scale? If the robot does reach it, widen `range` in the data spec"
    share = "" if key in episode.spec.sensors else f" by more than {LIMIT_TOLERANCE:.0%} of the span"
    text = (
        f"{names[i]} = {values[row, i]:.4g} outside [{limits[i, 0]:g}, {limits[i, 1]:g}] {units[i]}{share} at row "
        f"{row}, {len(rows)} rows in all{also}: {way_out}"
    )
    joint = units[i] in ("rad", "m")
    return Finding("joint_limit" if joint else "out_of_range", "error", key, text, where)


# ---- motion ----


def check_jumps(episode: Episode, key: str) -> list[Finding]:
    """Find steps between rows of the feature ``key`` that are larger than a joint can move in that time; returns findings."""
    fps = episode.spec.fps
    units, names = element_units(episode, key), element_names(episode, key)
    longest = np.array([SPEEDS.get(u, np.inf) for u in units]) * JUMP_MARGIN / fps
    steps = np.abs(np.diff(episode.arrays[key].astype(float), axis=0))
    findings = []
    for i in np.flatnonzero((steps > longest).any(axis=0)):
        rows = np.flatnonzero(steps[:, i] > longest[i])
        row = int(rows[np.argmax(steps[rows, i])])
        findings.append(
            Finding(
                "jump",
                "warning",
                key,
                f"{names[i]} steps by {steps[row, i]:.3g} {units[i]} from row {row} to {row + 1} "
                f"({(row + 1) / fps:.2f} s), {len(rows)} such steps; at {SPEEDS[units[i]]:g} {units[i]}/s it can go "
                f"{longest[i]:.3g} {units[i]} in {JUMP_MARGIN:g} rows: a glitch of the encoder, or time is missing here",
                (row, row + 2),
            )
        )
    return findings


def check_sample_jumps(
    channel: str, values: np.ndarray, time_s: np.ndarray, names: Sequence[str], units: Sequence[str], row_s: float
) -> list[Finding]:
    """Find steps between samples of a channel that are larger than a joint can move in that time; returns findings.

    Rows hold a part of a fast channel's samples, and a possible step between two samples is smaller than one between two rows. A
    driver may repeat a reading: so the time of a step is taken from the last change, but at most one row.

    Args:
        channel: name for the message.
        values: (N, J) samples of an episode, in rad and m where ``units`` say so; others are not judged.
        time_s: (N,) since row 0 [s], increasing.
        names: of the J elements.
        row_s: time between rows [s].
    """
    speed_per_s = np.array([SPEEDS.get(u, np.inf) for u in units])
    if len(values) < 3 or np.isinf(speed_per_s).all():
        return []
    with np.errstate(invalid="ignore", over="ignore"):  # values that are not finite are an error of their own
        steps, between_s = np.abs(np.diff(values, axis=0)), np.diff(time_s)
    changed = np.concatenate([[True], (steps[:-1] > 0).any(axis=1)])
    last_change = np.maximum.accumulate(np.where(changed, np.arange(len(steps)), 0))
    since_s = np.maximum(
        np.minimum(time_s[1:] - time_s[last_change], row_s), np.maximum(between_s, np.median(between_s))
    )
    longest = JUMP_MARGIN * since_s[:, None] * np.where(np.isinf(speed_per_s), 0.0, speed_per_s)
    too_far = (steps > longest) & np.isfinite(speed_per_s)
    findings = []
    for i in np.flatnonzero(too_far.any(axis=0)):
        samples = np.flatnonzero(too_far[:, i])
        k = int(samples[np.argmax(steps[samples, i])])
        findings.append(
            Finding(
                "sample_jump",
                "warning",
                channel,
                f"{channel}: {names[i]} goes from {values[k, i]:.4g} to {values[k + 1, i]:.4g} {units[i]} in "
                f"{1000 * between_s[k]:.1f} ms, at {time_s[k + 1]:.3f} s, {len(samples)} such steps; at "
                f"{speed_per_s[i]:g} {units[i]}/s it can go {longest[k, i]:.3g} {units[i]}: changed bytes, a glitch of the "
                "encoder, or a wrong stamp",
            )
        )
    return findings


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


def check_idle(episode: Episode, touch: np.ndarray) -> list[Finding]:
    """Find stretches in which nothing moves, commands are constant and touch does not change; returns findings.

    Args:
        touch: (T, P) mean counts of each pad, P may be 0: pressing with arms at rest is work, not idling.
    """
    columns, thresholds = [], []
    for key in (STATE, ACTION):
        if key in episode.arrays:
            limit = {"rad": STILL_RAD, "m": STILL_M}
            units = element_units(episode, key)
            known = [i for i, u in enumerate(units) if u in limit]
            columns.append(episode.arrays[key][:, known])
            thresholds += [limit[units[i]] for i in known]
    if not thresholds:
        return [not_judged(STATE, "idle times", "no element in rad or m")]
    if touch.size:
        columns.append(touch)
        thresholds += list(
            np.maximum(0.1 * np.abs(touch).max(axis=0), 1.0)
        )  # counts; the mean of a pad hardly has noise
    fps, num_rows = episode.spec.fps, episode.num_rows
    still = still_rows(np.concatenate(columns, axis=1), np.array(thresholds), round(STILL_WINDOW_S * fps))
    findings = []
    for first, end in runs(still):
        where = "start" if first == 0 else "end" if end == num_rows else "middle"
        if (end - first) / fps < (IDLE_MIDDLE_S if where == "middle" else IDLE_END_S):
            continue
        way_out = "split the episode or leave it out" if where == "middle" else "trim it"
        findings.append(
            Finding(
                "idle",
                "warning",
                STATE,
                f"nothing moves for {(end - first) / fps:.1f} s at the {where} ({place((first, end), fps)}; no joint by "
                f"more than {STILL_RAD:g} rad): {way_out}, or a policy learns to wait",
                (first, end),
            )
        )
    return findings


def check_frozen_state(episode: Episode, arm: Arm) -> list[Finding]:
    """Find an arm whose state repeats bit by bit while its command moves: its driver republishes old values. Returns findings."""
    fps = episode.spec.fps
    state, action = episode.arrays[STATE][:, arm.joints], episode.arrays[ACTION][:, arm.joints]
    same = np.concatenate([[False], (np.diff(state, axis=0) == 0).all(axis=1)])
    found = []
    for first, end in runs(same):
        rows = (first - 1, end)
        moved = np.ptp(action[rows[0] : rows[1]], axis=0).max(initial=0.0)
        if (rows[1] - rows[0]) / fps >= FROZEN_S and moved > MOVING_RAD:
            found.append((rows, moved))
    if not found:
        return []
    rows, moved = max(found, key=lambda f: f[0][1] - f[0][0])
    return [
        Finding(
            "frozen_state",
            "warning",
            STATE,
            f"{arm.name or 'arm'}: joints stay bit-identical for {(rows[1] - rows[0]) / fps:.2f} s while the command moves "
            f"by {moved:.2f} rad, {place(rows, fps)} ({len(found)} such times): arm disabled, or its driver repeats old "
            f"values",
            rows,
        )
    ]
