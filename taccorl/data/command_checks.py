"""Check that commands explain the motion: an arm does not move by itself, nor farther than it is told.

    dead      the command never changes while the arm moves
    frozen    a joint leaves its command, which stands still
    copied    each command is the state of its own row: a policy would learn to stand still
    scaled    state = a · command + b with a negative, or above 1: no servo does that

Letters in shapes: T rows, J elements.
"""

import numpy as np

from taccorl.data.arms import ACTION, STATE, element_names, element_units, episode_arms
from taccorl.data.episode import Episode
from taccorl.data.finding import LEAVE_OUT, Finding, listed, place
from taccorl.data.joint_checks import MOVING_RAD, STILL_M
from taccorl.data.lag_checks import LAG_MIN_S, find_lag
from taccorl.data.timing import runs

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


def _moves(values: np.ndarray, units: tuple[str, ...]) -> np.ndarray:
    """(J,) bool: elements of ``values`` (T, J) that move."""
    least = {"rad": MOVING_RAD, "m": 2 * STILL_M}
    span = np.ptp(values, axis=0)
    other = OTHER_MOVES * np.abs(values).max(axis=0) + 1e-9
    return np.array([span[i] > least.get(unit, other[i]) for i, unit in enumerate(units)], dtype=bool)


def check_commands(episode: Episode) -> list[Finding]:
    """Return findings on commands that do not explain the motion of the state."""
    if STATE not in episode.arrays or ACTION not in episode.arrays:
        return []
    state, action = (episode.arrays[key].astype(float) for key in (STATE, ACTION))
    seconds = episode.num_rows / episode.spec.fps
    if not np.isfinite(state).all() or not np.isfinite(action).all() or seconds < FROZEN_COMMAND_S:
        return []
    moving = _moves(state, element_units(episode, STATE))
    if not moving.any():
        return []
    if (np.ptp(action, axis=0) == 0).all():
        what = "is 0 in every row" if not action.any() else "never changes"
        text = (
            f"the command {what} while {listed(_names(episode, moving))} move: a dead command channel, or another topic"
        )
        return [Finding("dead_command", "warning", ACTION, f"{text}; correct `channels`, or leave the episode out")]
    if state.shape == action.shape and np.array_equal(episode.arrays[STATE], episode.arrays[ACTION]):
        text = "each command equals the state of its own row: a policy learns to stand still; record what was commanded"
        return [Finding("copied_command", "warning", ACTION, text)]
    if element_names(episode, STATE) != episode.spec.features[ACTION].names:
        return []
    return [*_frozen(episode, state, action, moving), *_scaled(episode, state, action, moving)]


def _names(episode: Episode, chosen: np.ndarray) -> list[str]:
    return [name for name, is_chosen in zip(element_names(episode, STATE), chosen, strict=True) if is_chosen]


def _frozen(episode: Episode, state: np.ndarray, action: np.ndarray, moving: np.ndarray) -> list[Finding]:
    """Joints that leave a command which stands still."""
    fps, units = episode.spec.fps, element_units(episode, STATE)
    found: dict[str, tuple[tuple[int, int], float]] = {}
    for i in np.flatnonzero(moving):
        if units[i] != "rad":  # a gripper is stopped by its part
            continue
        same = np.concatenate([[False], np.diff(action[:, i]) == 0])
        for first, end in runs(same):
            begin = first - 1 + round(SETTLED_S * fps)
            if (end - first + 1) / fps < FROZEN_COMMAND_S or end - begin < 2:
                continue
            off = np.abs(state[begin:end, i] - action[begin, i])
            away = float(off.max() - off[0])
            if away > MOVING_RAD:
                found.setdefault(element_names(episode, STATE)[i], ((first - 1, end), away))
    if not found:
        return []
    rows, away = max(found.values(), key=lambda f: f[0][1] - f[0][0])
    text = (
        f"the command of {listed([*found])} stands still for {(rows[1] - rows[0]) / fps:.1f} s, {place(rows, fps)}, while the "
        f"joint moves {away:.2f} rad away from it: the command channel hung; {LEAVE_OUT}"
    )
    return [Finding("frozen_command", "warning", ACTION, text, rows)]


def _scaled(episode: Episode, state: np.ndarray, action: np.ndarray, moving: np.ndarray) -> list[Finding]:
    """Joints that move against their command, or farther than it."""
    fps = episode.spec.fps
    if episode.num_rows < LAG_MIN_S * fps:
        return []
    findings = []
    for arm in episode_arms(episode):
        joints = [i for i in arm.joints if moving[i] and np.ptp(action[:, i]) > MOVING_RAD]
        lag = max(round(find_lag(action[:, joints], state[:, joints], fps).lag_s * fps), 0) if joints else 0
        for i in joints:
            told, done = action[: len(action) - lag, i], state[lag:, i]
            told, done = told - told.mean(), done - done.mean()
            correlation = float(told @ done) / max(float(np.sqrt((told @ told) * (done @ done))), 1e-12)
            scale = float(told @ done) / max(float(told @ told), 1e-12)
            left, usual = np.sqrt(np.mean((done - scale * told) ** 2)), np.sqrt(np.mean((done - told) ** 2))
            if abs(correlation) < SCALE_SURE or SCALES[0] <= scale <= SCALES[1] or usual < SCALE_GAIN * left:
                continue
            name = element_names(episode, STATE)[i]
            what = "moves against its command" if scale < 0 else "moves by another amount than its command"
            text = f"{name} {what}: state = {scale:.2f} × command, correlation {abs(correlation):.3f}: a wrong sign or `scale`"
            findings.append(Finding("command_scale", "warning", ACTION, f"{text} on one of the two channels"))
    return findings
