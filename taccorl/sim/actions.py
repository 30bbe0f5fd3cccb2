"""What an action is: 14 targets, their names, limits, and what is no action at all."""

import numpy as np

from taccorl.errors import TaccorlError
from taccorl.sim.robot import ARMS, FINGER_STROKE_M, JOINTS, LINKS

OPEN_M = 2 * FINGER_STROKE_M
ACTION_NAMES = tuple(f"{arm}_{j}" for arm in ARMS for j in (*JOINTS, "gripper"))
_LIMITS = np.array([*(link.range_rad for link in LINKS), (0.0, OPEN_M)] * 2, np.float32)
ACTION_LOW = np.nextafter(_LIMITS[:, 0], np.float32(1), dtype=np.float32).astype(float)
ACTION_HIGH = np.nextafter(_LIMITS[:, 1], np.float32(0), dtype=np.float32).astype(float)
ACTION_LOW[[6, 13]] = 0.0
"""Joint limits and gripper opening, in the order of ``action`` (rad, m), as float32 that lie inside: a clipped action is stored
exactly. Targets beyond are clipped, as the driver does."""
_ABSURD = np.array([*([2 * np.pi] * 6), 0.5] * 2)  # beyond any limit by this much: another unit


def check_actions(actions: np.ndarray) -> None:
    """Targets (N, …, 14) are numbers in rad and m; a little beyond the limits is not wrong, it is clipped.

    Raises:
        TaccorlError: names the joint, the simulation, the value and the limits.
    """
    beyond = ~((actions >= ACTION_LOW - _ABSURD) & (actions <= ACTION_HIGH + _ABSURD))  # NaN is beyond, too
    if beyond.any():
        at = np.argwhere(beyond)[0]
        raise TaccorlError(
            f"action: {ACTION_NAMES[at[-1]]} of simulation {at[0]} is {actions[tuple(at)]:g}, limits are "
            f"{ACTION_LOW[at[-1]]:g} … {ACTION_HIGH[at[-1]]:g}. Joints are in rad, the gripper's opening is in m."
        )
