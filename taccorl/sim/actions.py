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


def beyond_reason(actions: np.ndarray) -> np.ndarray:
    """(…, 14) bool: NaN, or so far beyond the limits that it is another unit; a little beyond is clipped."""
    return ~((actions >= ACTION_LOW - _ABSURD) & (actions <= ACTION_HIGH + _ABSURD))


def check_actions(actions: np.ndarray) -> None:
    """Targets (N, …, 14) are numbers in rad and m; a little beyond the limits is not wrong, it is clipped.

    Raises:
        TaccorlError: names the joint, the simulation, the value and the limits.
    """
    if (beyond := beyond_reason(actions)).any():
        at = np.argwhere(beyond)[0]
        raise TaccorlError(why_bad(actions[tuple(at[:-1])], f" of simulation {at[0]}"))


def why_bad(action: np.ndarray, whose: str = "") -> str:
    """Names the first joint of a bad action (14,), its value and limits."""
    k = int(beyond_reason(action).argmax())
    return (
        f"action: {ACTION_NAMES[k]}{whose} is {action[k]:g}, limits are {ACTION_LOW[k]:g} … {ACTION_HIGH[k]:g}. "
        "Joints are in rad, the gripper's opening is in m."
    )
