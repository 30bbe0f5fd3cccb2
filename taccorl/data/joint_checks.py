"""Do joints and commands make sense? Limits and units, jumps, rests, who follows whom and how late.

    lag      argmax over k of Σ_t v_action[t] · v_state[t + k], the velocities of all moving joints of one arm
    swapped  an arm's state lies near the other arm's command, and far from its own

Letters in shapes: T rows, J elements of the vector. Velocities are differences of rows: what a policy will see.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from taccorl.data.episode import Episode
from taccorl.data.finding import Finding, listed, not_judged, place
from taccorl.data.timing import runs

STATE, ACTION = "observation.state", "action"

LIMIT_TOLERANCE = 0.02
"""Share of the valid span by which a value may lie outside: calibration offsets and the leader's own stops."""
JOINT_SPEED_RAD_PER_S = 3.93
"""225 °/s, PiPER's fastest joints (J4 to J6; J1 to J3: 180 to 195 °/s)."""
GRIPPER_SPEED_M_PER_S = 1.5
"""The whole 70 mm stroke in 47 ms: faster than a hand can press the leader's trigger."""
JUMP_MARGIN = 2.0
"""A row may show a sample one row older than its neighbour's, so that a step can hold the way of two rows."""
STILL_RAD = 0.02
"""A joint that stays within this for a second is at rest: a trembling hand on the leader moves about half of it."""
STILL_M = 0.002
STILL_WINDOW_S = 1.0
IDLE_END_S = 3.0
"""Longer rests at the start or end should be trimmed: a policy would learn to wait."""
IDLE_MIDDLE_S = 5.0
FROZEN_S = 0.5
"""15 rows at 30 fps: bit-identical for so long while it should change is not chance."""
MOVING_RAD = 0.05
"""A joint has moved: 2.9°, well above tremor."""
LAG_SEARCH_S = (-0.5, 1.0)
LAG_PLAUSIBLE_S = (0.0, 0.3)
"""PiPER follows its command in about 0.1 s (CAN, controller, gear); 0.3 s would be slow."""
LAG_TOLERANCE_ROWS = 1.0
"""A sample is up to one row old, so that true lags near 0 measure as slightly negative."""
LAG_SURE = 0.6
"""Correlation below this says nothing about time."""
ARM_LAG_SPREAD_S = 0.1
"""Two arms of one make differ less."""
LAG_MIN_S = 3.0
"""Shorter episodes hold too little motion to correlate."""
SWAP_RATIO = 3.0
"""Own command must be this many times farther than the other arm's: symmetric motion never is."""


@dataclass(frozen=True)
class Arm:
    """Which elements of ``observation.state`` and ``action`` are one arm's."""

    name: str
    """Prefix of its names without the underscore; empty for a robot with one arm."""
    joints: np.ndarray
    """(n,) element numbers in rad, base to wrist."""
    gripper: int | None
    """Element number of the opening in m."""


def find_arms(names: tuple[str, ...], units: tuple[str, ...]) -> list[Arm]:
    """Arms by the names' prefixes ``left_`` and ``right_``; elements with neither belong to the arm without a name."""
    arms = []
    prefixes = [next((p for p in ("left", "right") if n.startswith(f"{p}_")), "") for n in names]
    for prefix in sorted(set(prefixes)):
        own = [i for i, p in enumerate(prefixes) if p == prefix]
        grippers = [i for i in own if units[i] == "m" and names[i].endswith("gripper.pos")]
        joints = np.array([i for i in own if units[i] == "rad"], dtype=int)
        arms.append(Arm(prefix, joints, grippers[0] if grippers else None))
    return arms


def element_units(episode: Episode, key: str) -> tuple[str, ...]:
    """Unit of every element of a feature."""
    feature = episode.spec.features[key]
    return (feature.unit,) * feature.size if isinstance(feature.unit, str) else feature.unit


def element_names(episode: Episode, key: str) -> tuple[str, ...]:
    """Name of every element; its number where the spec names none."""
    feature = episode.spec.features[key]
    return feature.names or tuple(f"{key}[{i}]" for i in range(feature.size))


def episode_arms(episode: Episode) -> list[Arm]:
    """The arms of an episode that holds both state and command under the same names; else none."""
    if STATE not in episode.arrays or ACTION not in episode.arrays:
        return []
    if element_names(episode, STATE) != episode.spec.features[ACTION].names:
        return []
    return find_arms(element_names(episode, STATE), element_units(episode, STATE))


# ---- values ----


def check_values(episode: Episode) -> list[Finding]:
    """NaN, infinity, limits and units of every feature that is not a video."""
    findings = []
    for key, values in episode.arrays.items():
        finite = np.isfinite(values)
        if not finite.all():
            rows, elements = ~finite.all(axis=1), np.flatnonzero(~finite.all(axis=0))
            names = [element_names(episode, key)[i] for i in elements]
            where = (int(np.flatnonzero(rows)[0]), int(np.flatnonzero(rows)[-1]) + 1)
            findings.append(
                Finding(
                    "not_finite",
                    "error",
                    key,
                    f"{listed(names)}: {int((~finite).sum())} values are NaN or infinite in {int(rows.sum())} rows, "
                    f"{place(where, episode.spec.fps)}: the driver or a division wrote them; cut these rows out",
                    where,
                )
            )
        findings += _check_limits(episode, key, np.where(finite, values, 0.0), finite)
    return findings


def outside(values: np.ndarray, limits: np.ndarray, tolerance: float = LIMIT_TOLERANCE) -> np.ndarray:
    """(T, J) bool: values outside ``limits`` (J, 2) by more than ``tolerance`` of the span."""
    span = limits[:, 1] - limits[:, 0]
    slack = np.where(np.isfinite(span), tolerance * span, 0.0)
    return (values < limits[:, 0] - slack) | (values > limits[:, 1] + slack)


def unit_hint(values: np.ndarray, limit: np.ndarray, unit: str) -> str | None:
    """Which other unit would bring all of an element's values (T,) into its limits; None where none would."""
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
    """One-row steps longer than the robot can go in that time."""
    fps = episode.spec.fps
    speed = {"rad": JOINT_SPEED_RAD_PER_S, "m": GRIPPER_SPEED_M_PER_S}
    units, names = element_units(episode, key), element_names(episode, key)
    longest = np.array([speed.get(u, np.inf) for u in units]) * JUMP_MARGIN / fps
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
                f"({(row + 1) / fps:.2f} s), {len(rows)} such steps; at {speed[units[i]]:g} {units[i]}/s it can go "
                f"{longest[i]:.3g} {units[i]} in {JUMP_MARGIN:g} rows: a glitch of the encoder, or time is missing here",
                (row, row + 2),
            )
        )
    return findings


def still_rows(values: np.ndarray, threshold: np.ndarray, window: int) -> np.ndarray:
    """(T,) bool: rows of every stretch of ``window`` rows in which each column of (T, J) stays within its threshold."""
    if len(values) < window:
        return np.zeros(len(values), dtype=bool)
    spread = maximum_filter1d(values, window, axis=0) - minimum_filter1d(values, window, axis=0)
    half = window // 2
    inside = np.zeros(len(values), dtype=bool)
    centers = slice(half, len(values) - (window - 1 - half))
    inside[centers] = np.all(spread <= threshold, axis=1)[centers]
    return maximum_filter1d(inside, window, origin=-1 if window % 2 == 0 else 0)


def check_idle(episode: Episode, touch: np.ndarray) -> list[Finding]:
    """Nothing moves, nothing is commanded and touch does not change.

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
    """An arm's state repeats bit by bit while its command moves: the driver republishes old values."""
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


# ---- command and state ----


@dataclass(frozen=True)
class Lag:
    """How long after the command an arm's state moves."""

    lag_s: float
    correlation: float
    """Of the velocities at that lag; below LAG_SURE the lag means nothing."""


def find_lag(action: np.ndarray, state: np.ndarray, fps: int, search_s: tuple[float, float] = LAG_SEARCH_S) -> Lag:
    """Lag of ``state`` (T, n) behind ``action`` (T, n) by cross-correlation of velocities; parabola through the peak.

    Each column counts alike; those at rest (range below MOVING_RAD, which fits counts as well) not at all.
    """
    moving = (np.ptp(action, axis=0) > MOVING_RAD) & (np.ptp(state, axis=0) > MOVING_RAD)
    if not moving.any():
        return Lag(0.0, 0.0)
    v_action, v_state = (
        uniform_filter1d(np.diff(x[:, moving].astype(float), axis=0), 3, axis=0) for x in (action, state)
    )
    v_action, v_state = v_action / v_action.std(axis=0), v_state / v_state.std(axis=0)
    lags = np.arange(math.floor(search_s[0] * fps), math.ceil(search_s[1] * fps) + 1)
    lags = lags[np.abs(lags) < len(v_action) - 2]
    correlation = np.array([_correlation_at(v_action, v_state, int(k)) for k in lags])
    peak = int(np.argmax(correlation))
    shift = 0.0
    if 0 < peak < len(lags) - 1:
        before, at, after = correlation[peak - 1 : peak + 2]
        bend = before - 2 * at + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return Lag(float((lags[peak] + shift) / fps), float(correlation[peak]))


def _correlation_at(v_action: np.ndarray, v_state: np.ndarray, lag: int) -> float:
    a, s = (v_action[: len(v_action) - lag], v_state[lag:]) if lag >= 0 else (v_action[-lag:], v_state[:lag])
    norm = math.sqrt(float((a * a).sum()) * float((s * s).sum()))
    return float((a * s).sum()) / norm if norm > 0 else 0.0


def arm_lags(episode: Episode) -> dict[str, Lag]:
    """Arm name → lag, for the arms that move enough to tell."""
    if episode.num_rows < LAG_MIN_S * episode.spec.fps:
        return {}
    state, action = episode.arrays.get(STATE), episode.arrays.get(ACTION)
    lags = {}
    for arm in episode_arms(episode):
        if state is None or action is None or not np.isfinite(state).all() or not np.isfinite(action).all():
            continue
        lag = find_lag(action[:, arm.joints], state[:, arm.joints], episode.spec.fps)
        if lag.correlation >= LAG_SURE:
            lags[arm.name] = lag
    return lags


def check_lag(episode: Episode) -> list[Finding]:
    """Does the state follow the command, and within a plausible time?"""
    fps = episode.spec.fps
    if episode.num_rows < LAG_MIN_S * fps:
        return [not_judged(ACTION, "action lag", f"{episode.num_rows / fps:.1f} s, it takes {LAG_MIN_S:g} s of motion")]
    lags = arm_lags(episode)
    if not lags:
        why = f"no arm's state follows its command with a correlation of {LAG_SURE} or more"
        return [not_judged(ACTION, "action lag", f"{why} (too little motion, or another quantity)")]
    findings = []
    low, high = LAG_PLAUSIBLE_S[0] - LAG_TOLERANCE_ROWS / fps, LAG_PLAUSIBLE_S[1] + LAG_TOLERANCE_ROWS / fps
    for name, lag in lags.items():
        arm = f"the {name} arm" if name else "the arm"
        plausible = f"plausible {low:.2f} to {high:.2f} s"
        if lag.lag_s < low:
            findings.append(
                Finding(
                    "action_lag",
                    "error",
                    ACTION,
                    f"{arm}'s command trails its state by {-lag.lag_s:.3f} s ({plausible}): action and state exchanged, "
                    f"or their channels on different clocks; mend `channels`, `clock` or `latency_s`",
                )
            )
        elif lag.lag_s > high:
            findings.append(
                Finding(
                    "action_lag",
                    "warning",
                    ACTION,
                    f"{arm}'s state follows its command after {lag.lag_s:.3f} s ({plausible}): channels on different "
                    f"clocks, or a slow controller; set `latency_s` if the clock is off by a constant",
                )
            )
    spread = max(x.lag_s for x in lags.values()) - min(x.lag_s for x in lags.values())
    if spread > ARM_LAG_SPREAD_S and not findings:
        each = ", ".join(f"{name} {lag.lag_s:.3f} s" for name, lag in lags.items())
        findings.append(
            Finding(
                "action_lag",
                "warning",
                ACTION,
                f"lag from command to state differs between the arms by {spread:.3f} s ({each}; expected below "
                f"{ARM_LAG_SPREAD_S:g} s): one arm's channels are on another clock; set `latency_s` there",
            )
        )
    return findings


def arms_swapped(state: np.ndarray, action: np.ndarray, left: Arm, right: Arm, fps: int) -> bool | None:
    """Does each arm's state follow the other arm's command? None where the arms move too little to tell."""
    pairs = [(left, right), (right, left)]
    if any(len(a.joints) != len(b.joints) or not len(a.joints) for a, b in pairs):
        return None
    if all(np.ptp(state[:, a.joints], axis=0).max() < MOVING_RAD for a, _ in pairs):
        return None

    def distance(a: Arm, b: Arm) -> float:
        return float(np.sqrt(np.mean((state[:, a.joints] - action[:, b.joints]) ** 2)))

    def follows(a: Arm, b: Arm) -> float:
        return find_lag(action[:, b.joints], state[:, a.joints], fps).correlation

    near_other = all(distance(a, a) > SWAP_RATIO * distance(a, b) for a, b in pairs)
    follows_other = sum(follows(a, b) for a, b in pairs) > sum(follows(a, a) for a, _ in pairs)
    return near_other and follows_other


def check_swapped_arms(episode: Episode) -> list[Finding]:
    """State of the left arm with the command of the right one, and the other way round."""
    arms = {arm.name: arm for arm in episode_arms(episode)}
    if not {"left", "right"} <= set(arms):
        return []
    if episode.num_rows < LAG_MIN_S * episode.spec.fps:
        return []
    state, action = episode.arrays[STATE].astype(float), episode.arrays[ACTION].astype(float)
    swapped = arms_swapped(state, action, arms["left"], arms["right"], episode.spec.fps)
    if swapped is None:
        return [not_judged(ACTION, "swapped arms", "the arms hardly move")]
    if not swapped:
        return []
    return [
        Finding(
            "swapped_arms",
            "error",
            ACTION,
            "the left arm's state follows the right arm's command, and the right arm's the left one's: left and right "
            "topics are exchanged in either observation.state or action; mend `channels` in the recording spec",
        )
    ]
