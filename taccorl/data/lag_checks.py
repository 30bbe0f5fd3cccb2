"""Check that each arm follows its own command, and how late.

    lag      argmax over k of Σ_t v_action[t] · v_state[t + k], the velocities of all moving joints of one arm,
             less the one row after which an action is reached (``DatasetSpec.action_time``)
    swapped  an arm's state lies near the other arm's command, and far from its own

Letters in shapes: T rows, n joints. Velocities are differences of rows: what a policy will see.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from taccorl.data.arms import ACTION, STATE, Arm, episode_arms
from taccorl.data.episode import Episode
from taccorl.data.finding import Finding, not_judged
from taccorl.data.joint_checks import MOVING_RAD

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


@dataclass(frozen=True)
class Lag:
    """Time by which an arm's state lags behind its command."""

    lag_s: float
    """The lag [s]; positive: the state follows the command."""
    correlation: float
    """Correlation of the velocities of state and command when shifted by the lag; a lag with a correlation below LAG_SURE is not
    used."""


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
    if episode.num_rows < LAG_MIN_S * episode.spec.fps:
        return {}
    state, action = episode.arrays.get(STATE), episode.arrays.get(ACTION)
    lags = {}
    for arm in episode_arms(episode):
        if state is None or action is None or not np.isfinite(state).all() or not np.isfinite(action).all():
            continue
        lag = find_lag(action[:, arm.joints], state[:, arm.joints], episode.spec.fps)
        if lag.correlation >= LAG_SURE:
            ahead_s = 1 / episode.spec.fps if episode.spec.action_time == "next_row" else 0.0
            lags[arm.name] = Lag(lag.lag_s - ahead_s, lag.correlation)
    return lags


def check_lag(episode: Episode, *, explained: bool = False) -> list[Finding]:
    """Check that each arm's state follows its command within a plausible time (``LAG_PLAUSIBLE_S``), and that the lags of the two
    arms differ by at most ``ARM_LAG_SPREAD_S``. Returns findings.

    Args:
        explained: another finding says already that the command does not explain the motion.
    """
    fps = episode.spec.fps
    if episode.num_rows < LAG_MIN_S * fps:
        return [not_judged(ACTION, "action lag", f"{episode.num_rows / fps:.1f} s, it takes {LAG_MIN_S:g} s of motion")]
    lags = arm_lags(episode)
    if not lags and not explained and _both_move(episode):
        return [
            Finding(
                "unexplained_motion",
                "warning",
                ACTION,
                f"the arm moves, but no shift of its command follows that with a correlation of {LAG_SURE} or more: the command "
                "of another arm or time, or another quantity; correct `channels`",
            )
        ]
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
                    f"or their channels on different clocks; correct `channels`, `clock` or `latency_s`",
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


def _both_move(episode: Episode) -> bool:
    """Whether a joint and its command move by ``PLAIN_RAD`` or more."""
    spans = [np.ptp(episode.arrays[key], axis=0) for key in (STATE, ACTION)]
    return any((np.minimum(*spans)[arm.joints] > PLAIN_RAD).any() for arm in episode_arms(episode))


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


def check_swapped_arms(episode: Episode) -> list[Finding]:
    """Find exchanged arms: the left arm's state belongs to the right arm's command, and vice versa. Returns findings."""
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
            "topics are exchanged in either observation.state or action; correct `channels` in the recording spec",
        )
    ]
