"""Checks of actions: targets of all joints [rad] and gripper openings [m], in the order of ``ROBOT.action_names``.

Targets beyond the limits are clipped, as the driver does; targets far beyond them are of another unit and are rejected.
Letters in shapes: N simulations, A numbers of an action.
"""

import numpy as np

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT

_ABSURD = ROBOT.per_action(2 * np.pi, 0.5)  # rad, m beyond a limit: another unit


def beyond_reason(actions: np.ndarray) -> np.ndarray:
    """For ``actions`` (…, A) [rad, m]: (…, A) bool, true for NaN, or so far beyond the limits that the action must be in another
    unit. Values slightly beyond are clipped."""
    return ~(
        (actions >= ROBOT.action_low - _ABSURD)
        & (actions <= ROBOT.action_high + _ABSURD)
    )


def check_actions(actions: np.ndarray) -> None:
    """Check that ``actions`` (N, …, A) of N simulations are finite numbers that can be rad and m. Targets slightly beyond the
    limits are accepted; the simulation clips them. Raises TaccorlError: a target is not; the message names the joint, the
    simulation, the value and the limits."""
    if (beyond := beyond_reason(actions)).any():
        at = np.argwhere(beyond)[0]
        raise TaccorlError(why_bad(actions[tuple(at[:-1])], f" of simulation {at[0]}"))


def why_bad(action: np.ndarray, whose: str = "") -> str:
    """Return a text that names the first joint of an invalid action (A,), its value and its limits. ``whose`` follows the joint's
    name, such as " of simulation 3"."""
    k = int(beyond_reason(action).argmax())
    return (
        f"action: {ROBOT.action_names[k]}{whose} is {action[k]:g}, limits are {ROBOT.action_low[k]:g} … "
        f"{ROBOT.action_high[k]:g}. "
        "Joints are in rad, the gripper's opening is in m."
    )
