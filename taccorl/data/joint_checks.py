"""Checks of values, joints and commands: limits, jumps, rests, and whether commands explain the motion.

    dead      the command never changes while the arm moves         frozen   a joint leaves its command, which stands still
    copied    each command is the state of its own row               scaled   state = a · command + b, a negative or above 1
    lag       argmax over k of Σ_t v_action[t] · v_state[t + k], the velocities of all moving joints of one arm, less the one
              row after which an action is reached (``DatasetSpec.action_time``)
    swapped   an arm's state lies near the other arm's command, and far from its own

Shapes: T rows, J elements of a vector, n joints. Velocities are differences of rows: what a policy will see.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from taccorl.data.episode import EXECUTED, Arm, Episode
from taccorl.data.finding import LEAVE_OUT, Finding, finding, listed, not_judged, place
from taccorl.data.spec import ACTION, STATE
from taccorl.data.timing import longest, repeated, runs, stretches


class Motion:
    """State and command of an episode, and what several checks need of them; ``wrong``: features with wrong values."""

    def __init__(self, episode: Episode, wrong: set[str] | None = None) -> None:
        arrays, self.episode, self.fps, self.wrong = (
            episode.arrays,
            episode,
            episode.spec.fps,
            wrong or set(),
        )
        self.keys = [key for key in (STATE, ACTION) if key in arrays]
        self.seconds, self.arms = episode.num_rows / self.fps, episode.arms()
        self.finite = all(np.isfinite(arrays[key]).all() for key in self.keys)
        sent = (
            EXECUTED if EXECUTED in arrays else ACTION
        )  # demonstrations of the twin: ACTION is what was intended
        self.state, self.action = (
            arrays.get(key, np.empty((0, 0))).astype(float) for key in (STATE, sent)
        )
        self.names: tuple[str, ...] = (
            episode.element_names(STATE) if STATE in arrays else ()
        )

    @functools.cached_property
    def moving(self) -> np.ndarray:
        """(J,) bool: elements of the state that move."""
        least, other = (
            {"rad": MOVING_RAD, "m": 2 * STILL_M},
            OTHER_MOVES * np.abs(self.state).max(axis=0) + 1e-9,
        )
        units = self.episode.spec.features[STATE].units
        return np.ptp(self.state, axis=0) > [
            least.get(unit, other[i]) for i, unit in enumerate(units)
        ]


# ---- values ----

LIMIT_TOLERANCE = 0.02  # Share of the span by which a value may lie outside: calibration offsets, the leader's stops


def check_values(episode: Episode) -> Iterator[Finding]:
    """Check every feature that is not a video for NaN, infinity, limits and units."""
    for key, values in episode.arrays.items():
        finite = np.isfinite(values)
        if episode.spec.features[key].optional and np.isnan(values).all():
            yield Finding(
                "unknown",
                "note",
                key,
                f"{key} is NaN in every row: this episode does not have it",
            )
        elif not finite.all():
            rows, elements = (
                np.flatnonzero(~finite.all(axis=1)),
                np.flatnonzero(~finite.all(axis=0)),
            )
            names, where = (
                [episode.element_names(key)[i] for i in elements],
                (int(rows[0]), int(rows[-1]) + 1),
            )
            text = f"{listed(names)}: {(~finite).sum()} values are NaN or infinite in {len(rows)} rows, "
            text += f"{place(where, episode.spec.fps)}: the driver or a division; {LEAVE_OUT}"
            yield finding("not_finite", key, text, where)
        yield from check_limits(episode, key, np.where(finite, values, 0.0), finite)


def outside(
    values: np.ndarray, limits: np.ndarray, tolerance: float = LIMIT_TOLERANCE
) -> np.ndarray:
    """(T, J) bool: ``values`` (T, J) outside ``limits`` (J, 2), low and high, by more than ``tolerance`` of the span."""
    span = limits[:, 1] - limits[:, 0]
    slack = np.where(np.isfinite(span), tolerance * span, 0.0)
    return (values < limits[:, 0] - slack) | (values > limits[:, 1] + slack)


def unit_hint(values: np.ndarray, limit: np.ndarray, unit: str) -> str | None:
    """Name of the unit in which all values (T,) of an element would lie within its limits; None if there is none."""
    if unit == "m" and values.min() >= -0.05 and values.max() <= 1.05:
        return "a normalised opening 0 to 1"
    factors = {
        "rad": (
            ("degrees", math.pi / 180),
            ("0.001 degrees, PiPER's SDK unit", math.pi / 180_000),
        ),
        "m": (("millimetres", 1e-3), ("0.001 mm, PiPER's SDK unit", 1e-6)),
    }
    fits = (
        name
        for name, x in factors.get(unit, ())
        if not outside(x * values[:, None], limit[None]).any()
    )
    return next(fits, None)


def check_limits(
    episode: Episode, key: str, values: np.ndarray, finite: np.ndarray
) -> Iterator[Finding]:
    """One finding for all elements in the same wrong unit, else one for each; ``values``, ``finite``: (T, J)."""
    feature, is_touch = episode.spec.features[key], key in episode.spec.sensors
    known, names = (
        np.array([u != "unknown" for u in feature.units]),
        episode.element_names(key),
    )
    bad = (
        outside(values, feature.limits, 0.0 if is_touch else LIMIT_TOLERANCE)
        & finite
        & known
    )
    groups: dict[tuple[str | None, int], list[int]] = {}
    for i in map(int, np.flatnonzero(bad.any(axis=0))):
        hint = unit_hint(values[:, i], feature.limits[i], feature.units[i])
        groups.setdefault((hint, -1 if hint is not None or is_touch else i), []).append(
            i
        )
    for (hint, _), elements in groups.items():
        low, high = feature.limits[elements].T
        excess = np.maximum(values[:, elements] - high, low - values[:, elements])
        excess = np.where(bad[:, elements], excess, -np.inf)
        row, worst = np.unravel_index(np.argmax(excess / (high - low)), excess.shape)
        i, rows = elements[worst], np.flatnonzero(bad[:, elements].any(axis=1))
        also = (
            f" (also {listed([names[j] for j in elements if j != i])})"
            if len(elements) > 1
            else ""
        )
        share = "" if is_touch else f" by more than {LIMIT_TOLERANCE:.0%} of the span"
        way_out = "a wrong joint order, zero point or scale? If the robot does reach it, widen `range` in the data spec"
        way_out = way_out if hint is None else f"{hint}? Set `scale` on its channel"
        text = f"{names[i]} = {values[row, i]:.4g} outside [{low[worst]:g}, {high[worst]:g}] {feature.units[i]}{share} "
        text += f"at row {row}, {len(rows)} rows in all{also}: {way_out}"
        name = "joint_limit" if feature.units[i] in SPEEDS else "out_of_range"
        yield finding(name, key, text, (int(rows[0]), int(rows[-1]) + 1))


# ---- jumps and rests ----

SPEEDS = {"rad": 3.93, "m": 1.5}
"""Unit → highest plausible speed [unit/s]: PiPER's fastest joints, 225 °/s; a gripper's stroke of 70 mm in 47 ms."""
JUMP_MARGIN = 2.0  # Two neighbouring rows may show samples that are two rows apart


def check_jumps(m: Motion) -> Iterator[Finding]:
    """Steps between rows that are larger than a joint can move in that time."""
    for key in m.keys:
        units, names = m.episode.spec.features[key].units, m.episode.element_names(key)
        furthest = (
            np.array([SPEEDS.get(u, np.inf) for u in units]) * JUMP_MARGIN / m.fps
        )
        steps = np.abs(np.diff(m.episode.arrays[key].astype(float), axis=0))
        for i in (
            np.flatnonzero((steps > furthest).any(axis=0)) if key not in m.wrong else ()
        ):
            rows, unit = np.flatnonzero(steps[:, i] > furthest[i]), units[i]
            row = int(rows[np.argmax(steps[rows, i])])
            text = f"{names[i]} steps by {steps[row, i]:.3g} {unit} from row {row} to {row + 1} "
            text += f"({(row + 1) / m.fps:.2f} s), "
            text += f"{len(rows)} such steps; at {SPEEDS[unit]:g} {unit}/s it can go {furthest[i]:.3g} {unit} in "
            text += f"{JUMP_MARGIN:g} rows: a glitch of the encoder, or time is missing"
            yield finding("jump", key, text, (row, row + 2))


def check_sample_jumps(
    channel: str,
    values: np.ndarray,
    time_s: np.ndarray,
    names: Sequence[str],
    units: Sequence[str],
    row_s: float,
) -> Iterator[Finding]:
    """Steps between a channel's samples ``values`` (N, J), at ``time_s`` (N,), that are larger than a joint can move in that
    time. A driver may repeat a reading: the time of a step counts from the last change, but at most one row, ``row_s``."""
    speed_per_s = np.array([SPEEDS.get(u, np.inf) for u in units])
    if len(values) < 3 or np.isinf(speed_per_s).all():
        return
    with np.errstate(
        invalid="ignore", over="ignore"
    ):  # values that are not finite are an error of their own
        steps, between_s = np.abs(np.diff(values, axis=0)), np.diff(time_s)
    changed = np.concatenate([[True], (steps[:-1] > 0).any(axis=1)])
    last_change = np.maximum.accumulate(np.where(changed, np.arange(len(steps)), 0))
    since_s = np.minimum(time_s[1:] - time_s[last_change], row_s)
    since_s = np.maximum(since_s, np.maximum(between_s, np.median(between_s)))
    furthest = (
        JUMP_MARGIN
        * since_s[:, None]
        * np.where(np.isinf(speed_per_s), 0.0, speed_per_s)
    )
    too_far = (steps > furthest) & np.isfinite(speed_per_s)
    for i in np.flatnonzero(too_far.any(axis=0)):
        samples = np.flatnonzero(too_far[:, i])
        k = int(samples[np.argmax(steps[samples, i])])
        text = f"{channel}: {names[i]} goes from {values[k, i]:.4g} to {values[k + 1, i]:.4g} {units[i]} in "
        text += f"{1000 * between_s[k]:.1f} ms, at {time_s[k + 1]:.3f} s, {len(samples)} such steps; at "
        text += f"{speed_per_s[i]:g} "
        text += f"{units[i]}/s it can go {furthest[k, i]:.3g} {units[i]}: changed bytes, a glitch, or a wrong stamp"
        yield finding("sample_jump", channel, text)


STILL_RAD = 0.02  # Range of a joint at rest [rad], twice the tremor of a hand on the leader; STILL_M: of a gripper [m]
STILL_M = 0.002
STILL_WINDOW_S = (
    1.0  # Time in which a joint must stay within its range to be at rest [s]
)
IDLE_S = {
    "start": 3.0,
    "end": 3.0,
    "middle": 5.0,
}  # Longest accepted rests [s]: a policy learns to wait


def still_rows(values: np.ndarray, threshold: np.ndarray, window: int) -> np.ndarray:
    """(T,) bool: rows of every stretch of ``window`` rows in which each column of ``values`` (T, J) stays within its
    ``threshold`` (J,)."""
    if len(values) < window:
        return np.zeros(len(values), dtype=bool)
    spread = maximum_filter1d(values, window, axis=0) - minimum_filter1d(
        values, window, axis=0
    )
    half = window // 2
    inside = np.zeros(len(values), dtype=bool)
    centers = slice(half, len(values) - (window - 1 - half))
    inside[centers] = np.all(spread <= threshold, axis=1)[centers]
    return maximum_filter1d(inside, window, origin=-1 if window % 2 == 0 else 0)


def check_idle(m: Motion, touch: np.ndarray) -> Iterator[Finding]:
    """Stretches in which nothing moves and touch, ``touch`` (T, P) mean counts of each pad, does not change: pressing with arms
    at rest is work."""
    columns, thresholds, limit = [], [], {"rad": STILL_RAD, "m": STILL_M}
    for key in m.keys:
        known = [
            (i, limit[u])
            for i, u in enumerate(m.episode.spec.features[key].units)
            if u in limit
        ]
        columns.append(m.episode.arrays[key][:, [i for i, _ in known]])
        thresholds += [threshold for _, threshold in known]
    if not thresholds:
        yield not_judged(STATE, "idle times", "no element in rad or m")
        return
    if touch.size:
        columns.append(touch)
        thresholds += [
            *np.maximum(0.1 * np.abs(touch).max(axis=0), 1.0)
        ]  # counts; a pad's mean hardly has noise
    still = still_rows(
        np.concatenate(columns, axis=1),
        np.array(thresholds),
        round(STILL_WINDOW_S * m.fps),
    )
    for first, end in runs(still):
        where, time_s = (
            "start" if first == 0 else "end" if end == len(still) else "middle",
            (end - first) / m.fps,
        )
        if time_s >= IDLE_S[where]:
            text = f"nothing moves for {time_s:.1f} s at the {where} ({place((first, end), m.fps)}; no joint by more than "
            text += f"{STILL_RAD:g} rad in {STILL_WINDOW_S:g} s): a policy learns to wait; record again without the rest, or "
            yield finding("idle", STATE, f"{text}{LEAVE_OUT}", (first, end))


FROZEN_S = 0.5  # Shortest time of bit-identical values that is reported [s]: 15 rows at 30 fps are no coincidence
MOVING_RAD = 0.05  # Least range of a moving joint [rad]: 2.9°, well above tremor


def check_frozen_state(m: Motion) -> Iterator[Finding]:
    """Arms whose state repeats bit by bit while their command moves."""
    for arm in m.arms:
        action = m.episode.arrays[ACTION][:, arm.joints]
        same = stretches(
            repeated(m.episode.arrays[STATE][:, arm.joints]), m.fps, FROZEN_S
        )
        moved = {
            (a, b): float(np.ptp(action[a:b], axis=0).max(initial=0.0)) for a, b in same
        }
        if found := [
            rows for rows, range_rad in moved.items() if range_rad > MOVING_RAD
        ]:
            rows = longest(found)
            text = f"{arm.name or 'arm'}: joints stay bit-identical for {(rows[1] - rows[0]) / m.fps:.2f} s while the "
            text += f"command moves by {moved[rows]:.2f} rad, {place(rows, m.fps)} ({len(found)} such times): arm "
            yield finding(
                "frozen_state",
                STATE,
                f"{text}disabled, or its driver repeats old values",
                rows,
            )


# ---- commands that do not explain the motion ----

FROZEN_COMMAND_S = 1.0
"""Least time of a command that stands still while its joint leaves it [s]; slow ones are approached."""
SETTLED_S = 0.3
"""Time after a command's last change in which its joint may move in any way [s]: the highest plausible lag."""
# Plausible motion per commanded motion: soft servos lag behind fast commands, none exceeds slow ones
SCALES = (0.7, 1.07)
SCALE_SURE = (
    0.98  # Least correlation of state and command at which their scale is judged
)
SCALE_GAIN = 3.0  # A scale is reported if the deviation from the command is this many times that from the scaled one
OTHER_MOVES = 0.02  # Least change of an element of unknown unit that counts as motion, as a share of its largest value


def check_commands(m: Motion) -> Iterator[Finding]:
    """Commands that are dead, copied from the state, frozen, or of another scale."""
    if (
        len(m.keys) < 2
        or not m.finite
        or m.seconds < FROZEN_COMMAND_S
        or not m.moving.any()
    ):
        return
    if (np.ptp(m.action, axis=0) == 0).all():
        what = "is 0 in every row" if not m.action.any() else "never changes"
        moved = listed([m.names[i] for i in np.flatnonzero(m.moving)])
        text = f"the command {what} while {moved} move: a dead channel, or another topic; correct `channels`, or "
        yield finding("dead_command", ACTION, f"{text}{LEAVE_OUT}")
    elif m.state.shape == m.action.shape and np.array_equal(
        m.episode.arrays[STATE], m.episode.arrays[ACTION]
    ):
        text = "each command equals the state of its own row: a policy learns to stand still; record what was commanded"
        yield finding("copied_command", ACTION, text)
    elif m.names == m.episode.spec.features[ACTION].names:
        yield from _frozen(m)
        yield from _scaled(m)


def _frozen(m: Motion) -> Iterator[Finding]:
    found: dict[str, tuple[int, int]] = {}
    away: dict[tuple[int, int], float] = {}
    for i in np.flatnonzero(
        m.moving & m.episode.joints(STATE, "rad")
    ):  # a gripper is stopped by its part
        for first, end in stretches(repeated(m.action[:, i]), m.fps, FROZEN_COMMAND_S):
            off = np.abs(
                m.state[first + round(SETTLED_S * m.fps) : end, i] - m.action[first, i]
            )
            left = float((off - np.minimum.accumulate(off)).max(initial=0.0))
            if left > MOVING_RAD and m.names[i] not in found:
                found[m.names[i]] = (first, end)
                away.setdefault((first, end), left)
    if found:
        rows = longest([*found.values()])
        text = f"the command of {listed([*found])} stands still for {(rows[1] - rows[0]) / m.fps:.1f} s, "
        text += f"{place(rows, m.fps)}, "
        text += f"while the joint moves {away[rows]:.2f} rad away from it: the command channel hung; {LEAVE_OUT}"
        yield finding("frozen_command", ACTION, text, rows)


def _scaled(m: Motion) -> Iterator[Finding]:
    """Joints that move against their command, or farther than it."""
    for arm in m.arms if m.seconds >= LAG_MIN_S else ():
        joints = [
            i for i in arm.joints if m.moving[i] and np.ptp(m.action[:, i]) > MOVING_RAD
        ]
        lag = (
            max(
                find_lag(m.action[:, joints], m.state[:, joints], m.fps).lag_s * m.fps,
                0.0,
            )
            if joints
            else 0.0
        )
        rows = np.arange(len(m.action))
        kept = len(rows) - math.ceil(lag)
        for i in joints:
            told, done = (
                m.action[:kept, i],
                np.interp(rows[:kept] + lag, rows, m.state[:, i]),
            )
            told, done = told - told.mean(), done - done.mean()
            r = float(told @ done) / max(
                float(np.sqrt((told @ told) * (done @ done))), 1e-12
            )
            scale = float(told @ done) / max(float(told @ told), 1e-12)
            residual, usual = (
                np.sqrt(np.mean((done - scale * told) ** 2)),
                np.sqrt(np.mean((done - told) ** 2)),
            )
            if (
                abs(r) < SCALE_SURE
                or SCALES[0] <= scale <= SCALES[1]
                or usual < SCALE_GAIN * residual
            ):
                continue
            what = (
                "moves against its command"
                if scale < 0
                else "moves by another amount than its command"
            )
            text = f"{m.names[i]} {what}: state = {scale:.2f} × command, correlation {abs(r):.3f}: a wrong sign or "
            yield finding(
                "command_scale", ACTION, f"{text}`scale` on one of the two channels"
            )


# ---- time from command to state ----

LAG_SEARCH_S = (-0.5, 1.0)  # Range of lags that is searched [s]
LAG_PLAUSIBLE_S = (
    0.0,
    0.3,
)  # Plausible lags [s]: PiPER's is about 0.1 s (CAN, controller, gear); 0.3 s would be slow
LAG_TOLERANCE_ROWS = 1.0  # A sample is up to one row old, so that lags near 0 are measured slightly negative [rows]
LAG_SURE = 0.6  # Least correlation at which a lag is used
LAG_MIN_S = 3.0  # Shortest episode whose lag is measured [s]; shorter ones hold too little motion
ARM_LAG_SPREAD_S = 0.1  # Largest accepted difference between the lags of two arms [s]; arms of one make differ less
PLAIN_RAD = 0.2  # Least motion of a joint and of its command, without a correlation of the two, that is reported [rad]
SWAP_RATIO = 3.0  # Swapped: so many times farther from the own command than from the other's; symmetric motion never is


class Lag(NamedTuple):
    """Time by which an arm's state follows its command, and the correlation of their velocities when shifted by it."""

    lag_s: float
    correlation: float


def find_lag(
    action: np.ndarray,
    state: np.ndarray,
    fps: int,
    search_s: tuple[float, float] = LAG_SEARCH_S,
) -> Lag:
    """Lag of ``state`` (T, n) behind ``action`` (T, n) by cross-correlation of velocities, from ``search_s[0]`` to
    ``search_s[1]`` [s]; parabola through the peak. Moving columns have equal weight; lag and correlation are 0 if none moves."""
    moving = (np.ptp(action, axis=0) > MOVING_RAD) & (
        np.ptp(state, axis=0) > MOVING_RAD
    )
    if not moving.any():
        return Lag(0.0, 0.0)
    a, s = (
        uniform_filter1d(np.diff(x[:, moving].astype(float), axis=0), 3, axis=0)
        for x in (action, state)
    )
    a, s = a / a.std(axis=0), s / s.std(axis=0)
    lags = np.arange(math.floor(search_s[0] * fps), math.ceil(search_s[1] * fps) + 1)
    lags = lags[np.abs(lags) < len(a) - 2]

    def correlation_at(k: int) -> float:
        x, y = (a[: len(a) - k], s[k:]) if k >= 0 else (a[-k:], s[:k])
        norm = math.sqrt(float((x * x).sum()) * float((y * y).sum()))
        return float((x * y).sum()) / norm if norm > 0 else 0.0

    correlation = np.array([correlation_at(int(k)) for k in lags])
    peak, shift = int(np.argmax(correlation)), 0.0
    if 0 < peak < len(lags) - 1:
        before, at, after = correlation[peak - 1 : peak + 2]
        bend = before - 2 * at + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return Lag(float((lags[peak] + shift) / fps), float(correlation[peak]))


def arm_lags(episode: Episode) -> dict[str, Lag]:
    """Arm name → ``Lag`` of the arm's state behind its command; one row is subtracted where the action of row t is reached at
    row t + 1. Arms with a correlation below ``LAG_SURE`` are left out, and all of an episode shorter than ``LAG_MIN_S``."""
    m = Motion(episode)
    ahead_s = 1 / m.fps if episode.spec.action_time == "next_row" else 0.0
    arms = m.arms if m.seconds >= LAG_MIN_S and m.finite else ()
    found = {
        arm.name: find_lag(m.action[:, arm.joints], m.state[:, arm.joints], m.fps)
        for arm in arms
    }
    return {
        arm: Lag(lag.lag_s - ahead_s, lag.correlation)
        for arm, lag in found.items()
        if lag.correlation >= LAG_SURE
    }


def check_lag(m: Motion, explained: bool) -> Iterator[Finding]:
    """Arms that follow their commands too early or late, or unlike each other. ``explained``: another finding says already that
    the command does not explain the motion."""
    if m.seconds < LAG_MIN_S:
        yield not_judged(
            ACTION,
            "action lag",
            f"{m.seconds:.1f} s, it takes {LAG_MIN_S:g} s of motion",
        )
        return
    lags = arm_lags(m.episode)
    if not lags:
        spans = np.minimum(np.ptp(m.state, axis=0), np.ptp(m.action, axis=0))
        why = f"no shift of a command follows the arm's motion with a correlation of {LAG_SURE} or more"
        if not explained and any(
            (spans[arm.joints] > PLAIN_RAD).any() for arm in m.arms
        ):
            text = f"{why}: the command of another arm or time, or another quantity; correct `channels`"
            yield finding("unexplained_motion", ACTION, text)
        else:
            yield not_judged(
                ACTION, "action lag", f"{why} (too little motion, or another quantity)"
            )
        return
    low, high = (
        LAG_PLAUSIBLE_S[0] - LAG_TOLERANCE_ROWS / m.fps,
        LAG_PLAUSIBLE_S[1] + LAG_TOLERANCE_ROWS / m.fps,
    )
    plausible = f"plausible {low:.2f} to {high:.2f} s"
    for name, lag in lags.items():
        arm = f"the {name} arm" if name else "the arm"
        if lag.lag_s < low:
            text = f"{arm}'s command trails its state by {-lag.lag_s:.3f} s ({plausible}): action and state exchanged, "
            text += "or on different clocks; correct `channels`, `clock` or `latency_s`"
            yield finding("action_lag", ACTION, text, severity="error")
        elif lag.lag_s > high:
            text = f"{arm}'s state follows its command after {lag.lag_s:.3f} s ({plausible}): channels on different "
            text += "clocks, or a slow controller; set `latency_s` if a clock is off by a constant"
            yield finding("action_lag", ACTION, text)
    lags_s = [lag.lag_s for lag in lags.values()]
    spread_s = max(lags_s) - min(lags_s)
    if spread_s > ARM_LAG_SPREAD_S and low <= min(lags_s) and max(lags_s) <= high:
        each = ", ".join(f"{name} {lag.lag_s:.3f} s" for name, lag in lags.items())
        text = f"lag from command to state differs between the arms by {spread_s:.3f} s ({each}; expected below "
        text += f"{ARM_LAG_SPREAD_S:g} s): one arm's channels are on another clock; set `latency_s` there"
        yield finding("action_lag", ACTION, text)


def check_swapped_arms(m: Motion) -> Iterator[Finding]:
    """Exchanged arms: each arm's state belongs to the other arm's command."""
    arms = [arm for arm in m.arms if arm.name]
    if len(arms) != 2 or m.seconds < LAG_MIN_S:
        return
    a, b = (arm.joints for arm in arms)
    if (
        len(a) != len(b)
        or not len(a)
        or max(np.ptp(m.state[:, [*a, *b]], axis=0)) < MOVING_RAD
    ):
        yield not_judged(ACTION, "swapped arms", "the arms hardly move")
        return
    pairs = {
        (x, y): (m.state[:, i], m.action[:, j])
        for x, i in enumerate((a, b))
        for y, j in enumerate((a, b))
    }
    off = {
        at: float(np.sqrt(np.mean((state - action) ** 2)))
        for at, (state, action) in pairs.items()
    }
    r = {
        at: find_lag(action, state, m.fps).correlation
        for at, (state, action) in pairs.items()
    }
    near_other = (
        off[0, 0] > SWAP_RATIO * off[0, 1] and off[1, 1] > SWAP_RATIO * off[1, 0]
    )
    if near_other and r[0, 1] + r[1, 0] > r[0, 0] + r[1, 1]:
        one, other = (arm.name for arm in arms)
        text = f"the {one} arm's state follows the {other} arm's command, and the {other} arm's the {one} one's: "
        text += "topics are "
        text += f"exchanged in {STATE} or {ACTION}; correct `channels` in the recording spec"
        yield finding("swapped_arms", ACTION, text)


def check_motion(m: Motion, touch: np.ndarray) -> Iterator[Finding]:
    """Findings on state and command, without those that another one explains; ``touch``: (T, P) mean counts of each pad."""
    yield from check_jumps(m)
    if m.keys and not m.wrong & set(m.keys):
        yield from check_idle(m, touch)
    if not m.finite:
        yield not_judged(
            ACTION, "action lag, swapped arms", "values that are not finite"
        )
        return
    commands = list(check_commands(m))
    yield from commands
    if not any(len(arm.joints) for arm in m.arms):
        yield not_judged(
            ACTION, "action lag, swapped arms", "no joints in rad named alike in both"
        )
        return
    swapped = list(check_swapped_arms(m))
    yield from swapped
    if not any(f.severity == "error" for f in swapped):
        yield from check_lag(m, explained=bool(commands))
        yield from check_frozen_state(m)


def joints_in_sight(episode: Episode, camera: str) -> np.ndarray | None:
    """(T, n) joints that a camera ought to see move: a wrist camera's own arm, else all arms; None if there are none."""
    if STATE not in episode.arrays or not np.isfinite(episode.arrays[STATE]).all():
        return None
    arms: list[Arm] = episode.state_arms()
    own = [
        arm for arm in arms if arm.name and camera.startswith(f"{arm.name}_")
    ] or arms
    elements = [i for arm in own for i in arm.joints]
    return episode.arrays[STATE][:, elements] if elements else None
