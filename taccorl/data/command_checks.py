"""Check that commands explain the motion: an arm follows its own command, soon, and does not move by itself or farther.

    dead      the command never changes while the arm moves
    frozen    a joint leaves its command, which stands still
    copied    each command is the state of its own row: a policy would learn to stand still
    scaled    state = a · command + b with a negative, or above 1: no servo does that
    lag       argmax over k of Σ_t v_action[t] · v_state[t + k], the velocities of all moving joints of one arm,
              less the one row after which an action is reached (``DatasetSpec.action_time``)
    swapped   an arm's state lies near the other arm's command, and far from its own

Letters in shapes: T rows, J elements, n joints. Velocities are differences of rows: what a policy will see.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from taccorl.data.episode import Arm, Episode
from taccorl.data.finding import LEAVE_OUT, Finding, finding, listed, not_judged, place
from taccorl.data.joint_checks import MOVING_RAD, STILL_M
from taccorl.data.spec import ACTION, STATE
from taccorl.data.timing import longest, repeated, stretches

FROZEN_COMMAND_S = 1.0
"""Time for which a command stands still while its joint moves away from it that is reported [s]: slower commands are held longer,
but the joint then comes nearer."""
SETTLED_S = 0.3
"""Time after the last change of a command in which its joint may still move in any way [s]: the highest plausible lag."""
SCALES = (0.7, 1.07)
"""Plausible motion of a joint per motion of its command: soft servos lag behind fast commands, none exceeds slow ones."""
SCALE_SURE = 0.98  # Least correlation of state and command at which their scale is judged
SCALE_GAIN = 3.0  # A scale is reported if the deviation from the command is this many times that from the scaled one
OTHER_MOVES = 0.02  # Least change of an element of unknown unit that counts as motion, as a share of its largest value
LAG_SEARCH_S = (-0.5, 1.0)  # Range of lags that is searched [s]
LAG_PLAUSIBLE_S = (0.0, 0.3)
"""Plausible lag of the state behind the command [s]: PiPER's is about 0.1 s (CAN, controller, gear); 0.3 s would be slow."""
LAG_TOLERANCE_ROWS = 1.0
"""Tolerance on the lag [rows]: a sample is up to one row old, so that lags near 0 are measured slightly negative."""
LAG_SURE = 0.6  # Least correlation at which a lag is used
ARM_LAG_SPREAD_S = 0.1  # Largest accepted difference between the lags of two arms [s]; arms of one make differ less
PLAIN_RAD = 0.2  # Least motion of a joint and of its command, without a correlation of the two, that is reported [rad]
LAG_MIN_S = 3.0  # Shortest episode whose lag is measured [s]; shorter ones hold too little motion
SWAP_RATIO = 3.0
"""Arms count as swapped if the distance to the own command is this many times the distance to the other arm's; symmetric motion
never reaches it."""


# ---- commands that do not explain the motion ----


def check_commands(episode: Episode) -> Iterator[Finding]:
    """Find commands that are dead, frozen, copied from the state, or of another scale."""
    if STATE not in episode.arrays or ACTION not in episode.arrays:
        return
    state, action = (episode.arrays[key].astype(float) for key in (STATE, ACTION))
    if not (np.isfinite(state).all() and np.isfinite(action).all()):
        return
    if episode.num_rows < FROZEN_COMMAND_S * episode.spec.fps:
        return
    moving, names = _moves(state, episode.spec.features[STATE].units), episode.element_names(STATE)
    if not moving.any():
        return
    if (np.ptp(action, axis=0) == 0).all():
        what = "is 0 in every row" if not action.any() else "never changes"
        moved = listed([names[i] for i in np.flatnonzero(moving)])
        text = f"the command {what} while {moved} move: a dead command channel, or another topic; correct `channels`"
        yield finding("dead_command", ACTION, f"{text}, or {LEAVE_OUT}")
    elif state.shape == action.shape and np.array_equal(episode.arrays[STATE], episode.arrays[ACTION]):
        text = "each command equals the state of its own row: a policy learns to stand still; record what was commanded"
        yield finding("copied_command", ACTION, text)
    elif names == episode.spec.features[ACTION].names:
        yield from _frozen(episode, state, action, moving)
        yield from _scaled(episode, state, action, moving)


def _moves(values: np.ndarray, units: tuple[str, ...]) -> np.ndarray:
    """(J,) bool: elements of ``values`` (T, J) that move."""
    least = {"rad": MOVING_RAD, "m": 2 * STILL_M}
    other = OTHER_MOVES * np.abs(values).max(axis=0) + 1e-9
    return np.ptp(values, axis=0) > [least.get(unit, other[i]) for i, unit in enumerate(units)]


def _frozen(episode: Episode, state: np.ndarray, action: np.ndarray, moving: np.ndarray) -> Iterator[Finding]:
    """Joints that leave a command which stands still."""
    fps, names = episode.spec.fps, episode.element_names(STATE)
    found: dict[str, tuple[int, int]] = {}
    away: dict[tuple[int, int], float] = {}
    for i in np.flatnonzero(moving & episode.joints(STATE, "rad")):  # a gripper is stopped by its part
        for first, end in stretches(repeated(action[:, i]), fps, FROZEN_COMMAND_S):
            off = np.abs(state[first + round(SETTLED_S * fps) : end, i] - action[first, i])
            left = float((off - np.minimum.accumulate(off)).max(initial=0.0))
            if left > MOVING_RAD and names[i] not in found:
                found[names[i]] = (first, end)
                away.setdefault((first, end), left)
    if found:
        rows = longest([*found.values()])
        text = (
            f"the command of {listed([*found])} stands still for {(rows[1] - rows[0]) / fps:.1f} s, {place(rows, fps)}, while "
            f"the joint moves {away[rows]:.2f} rad away from it: the command channel hung; {LEAVE_OUT}"
        )
        yield finding("frozen_command", ACTION, text, rows)


def _scaled(episode: Episode, state: np.ndarray, action: np.ndarray, moving: np.ndarray) -> Iterator[Finding]:
    """Joints that move against their command, or farther than it."""
    fps = episode.spec.fps
    if episode.num_rows < LAG_MIN_S * fps:
        return
    for arm in episode.arms():
        joints = [i for i in arm.joints if moving[i] and np.ptp(action[:, i]) > MOVING_RAD]
        lag = max(find_lag(action[:, joints], state[:, joints], fps).lag_s * fps, 0.0) if joints else 0.0
        rows = np.arange(len(action))
        kept = len(rows) - math.ceil(lag)
        for i in joints:
            told, done = action[:kept, i], np.interp(rows[:kept] + lag, rows, state[:, i])
            told, done = told - told.mean(), done - done.mean()
            correlation = float(told @ done) / max(float(np.sqrt((told @ told) * (done @ done))), 1e-12)
            scale = float(told @ done) / max(float(told @ told), 1e-12)
            residual, usual = np.sqrt(np.mean((done - scale * told) ** 2)), np.sqrt(np.mean((done - told) ** 2))
            if abs(correlation) < SCALE_SURE or SCALES[0] <= scale <= SCALES[1] or usual < SCALE_GAIN * residual:
                continue
            what = "moves against its command" if scale < 0 else "moves by another amount than its command"
            text = (
                f"{episode.element_names(STATE)[i]} {what}: state = {scale:.2f} × command, correlation {abs(correlation):.3f}: "
                "a wrong sign or `scale` on one of the two channels"
            )
            yield finding("command_scale", ACTION, text)


# ---- time from command to state ----


@dataclass(frozen=True)
class Lag:
    """Time by which an arm's state lags behind its command."""

    lag_s: float
    """The lag [s]; positive: the state follows the command."""
    correlation: float
    """Correlation of the velocities of state and command when shifted by the lag; below LAG_SURE the lag is not used."""


def find_lag(action: np.ndarray, state: np.ndarray, fps: int, search_s: tuple[float, float] = LAG_SEARCH_S) -> Lag:
    """Lag of ``state`` (T, n) behind ``action`` (T, n) by cross-correlation of velocities, searched from ``search_s[0]`` to
    ``search_s[1]`` [s]; parabola through the peak.

    Moving columns have equal weight; columns at rest (range below MOVING_RAD) are not used. Lag and correlation are 0 if none
    moves.
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
    """Arm name → ``Lag`` of the arm's state behind its command. In datasets in which the action of row t is reached at row t + 1
    (``action_time``: next_row), that one row is subtracted.

    Empty if the episode is shorter than ``LAG_MIN_S``. An arm is left out if the correlation is below ``LAG_SURE``: it moves too
    little, or the two are different quantities.
    """
    fps, arms = episode.spec.fps, episode.arms()
    if episode.num_rows < LAG_MIN_S * fps or not arms:
        return {}
    state, action = episode.arrays[STATE], episode.arrays[ACTION]
    if not (np.isfinite(state).all() and np.isfinite(action).all()):
        return {}
    ahead_s = 1 / fps if episode.spec.action_time == "next_row" else 0.0
    found = {arm.name: find_lag(action[:, arm.joints], state[:, arm.joints], fps) for arm in arms}
    return {arm: Lag(lag.lag_s - ahead_s, lag.correlation) for arm, lag in found.items() if lag.correlation >= LAG_SURE}


def check_lag(episode: Episode, *, explained: bool = False) -> Iterator[Finding]:
    """Check that each arm's state follows its command within a plausible time (``LAG_PLAUSIBLE_S``), and that the lags of the
    two arms differ by at most ``ARM_LAG_SPREAD_S``. ``explained``: another finding says already that the command does not
    explain the motion."""
    fps = episode.spec.fps
    if episode.num_rows < LAG_MIN_S * fps:
        yield not_judged(ACTION, "action lag", f"{episode.num_rows / fps:.1f} s, it takes {LAG_MIN_S:g} s of motion")
        return
    lags = arm_lags(episode)
    if not lags and not explained and _both_move(episode):
        text = (
            f"the arm moves, but no shift of its command follows that with a correlation of {LAG_SURE} or more: the command of "
            "another arm or time, or another quantity; correct `channels`"
        )
        yield finding("unexplained_motion", ACTION, text)
    elif not lags:
        why = f"no arm's state follows its command with a correlation of {LAG_SURE} or more"
        yield not_judged(ACTION, "action lag", f"{why} (too little motion, or another quantity)")
    if not lags:
        return
    low, high = LAG_PLAUSIBLE_S[0] - LAG_TOLERANCE_ROWS / fps, LAG_PLAUSIBLE_S[1] + LAG_TOLERANCE_ROWS / fps
    plausible = f"plausible {low:.2f} to {high:.2f} s"
    for name, lag in lags.items():
        arm = f"the {name} arm" if name else "the arm"
        if lag.lag_s < low:
            text = (
                f"{arm}'s command trails its state by {-lag.lag_s:.3f} s ({plausible}): action and state exchanged, or their "
                "channels on different clocks; correct `channels`, `clock` or `latency_s`"
            )
            yield finding("action_lag", ACTION, text, severity="error")
        elif lag.lag_s > high:
            text = (
                f"{arm}'s state follows its command after {lag.lag_s:.3f} s ({plausible}): channels on different clocks, or a "
                "slow controller; set `latency_s` if the clock is off by a constant"
            )
            yield finding("action_lag", ACTION, text)
    lags_s = [lag.lag_s for lag in lags.values()]
    if max(lags_s) - min(lags_s) > ARM_LAG_SPREAD_S and low <= min(lags_s) and max(lags_s) <= high:
        each = ", ".join(f"{name} {lag.lag_s:.3f} s" for name, lag in lags.items())
        text = (
            f"lag from command to state differs between the arms by {max(lags_s) - min(lags_s):.3f} s ({each}; expected below "
            f"{ARM_LAG_SPREAD_S:g} s): one arm's channels are on another clock; set `latency_s` there"
        )
        yield finding("action_lag", ACTION, text)


def _both_move(episode: Episode) -> bool:
    """Whether a joint and its command move by ``PLAIN_RAD`` or more."""
    spans = [np.ptp(episode.arrays[key], axis=0) for key in (STATE, ACTION)]
    return any((np.minimum(*spans)[arm.joints] > PLAIN_RAD).any() for arm in episode.arms())


def arms_swapped(state: np.ndarray, action: np.ndarray, left: Arm, right: Arm, fps: int) -> bool | None:
    """True if each arm's state follows the other arm's command; None if the arms move too little to decide.

    ``state`` and ``action`` are (T, J) [rad, m] with the elements of both arms.
    """
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


def check_swapped_arms(episode: Episode) -> Iterator[Finding]:
    """Find exchanged arms: the left arm's state belongs to the right arm's command, and vice versa."""
    arms = {arm.name: arm for arm in episode.arms()}
    if not {"left", "right"} <= set(arms) or episode.num_rows < LAG_MIN_S * episode.spec.fps:
        return
    state, action = episode.arrays[STATE].astype(float), episode.arrays[ACTION].astype(float)
    swapped = arms_swapped(state, action, arms["left"], arms["right"], episode.spec.fps)
    if swapped is None:
        yield not_judged(ACTION, "swapped arms", "the arms hardly move")
    elif swapped:
        text = (
            "the left arm's state follows the right arm's command, and the right arm's the left one's: left and right topics "
            "are exchanged in either observation.state or action; correct `channels` in the recording spec"
        )
        yield finding("swapped_arms", ACTION, text)
