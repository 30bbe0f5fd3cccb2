"""Steady-state offset of an arm's joints from their targets: command = goal − offset.

The controller's feed-forward torque causes an offset of 11 mrad in joint 5, 3 mm at the fingertips, and less in other joints; in
a twin with other gains it differs. So goals, not commands, are retargeted, and the offset is estimated where they are used.
"""

import mujoco
import numpy as np

from taccorl.robots import ROBOT
from taccorl.tasks.experts.hands import LEARNED, follow

_STILL_RAD = (
    0.001  # of a joint in a control step: what a tremor makes; 12 mm/s of a hand
)


def joint_addresses(model: mujoco.MjModel, arm: str) -> np.ndarray:
    """Indices (6,) of an arm's joints in ``qpos``."""
    return np.array(
        [model.joint(f"{arm}_{joint}").qposadr[0] for joint in ROBOT.joints]
    )


class RestOffset:
    """Estimate of the offset of one arm's joints (6,): command = goal − offset. The first-order lag behind moving goals is
    not part of it."""

    def __init__(
        self, joints_rad: np.ndarray, command_rad: np.ndarray, lag_s: np.ndarray
    ) -> None:
        """Start at rest, with joint angles, commands, and the controller's time constants K_d / K_p [s], each (6,)."""
        self.offset_rad = joints_rad - command_rad
        self._goal, self._predicted, self._lag_s = joints_rad, joints_rad, lag_s
        self._step_rad = 0.0

    @property
    def is_still(self) -> bool:
        """True if the last goal hardly moved, so that ``see`` can update the estimate."""
        return self._step_rad < _STILL_RAD

    def see(self, joints_rad: np.ndarray) -> None:
        """Update the estimate before a command, without contact: the deviation of ``joints_rad`` (6,) from a first-order lag. A
        moving arm gives no estimate, because its lag is not exactly of first order.
        """
        if self.is_still:
            self.offset_rad = self.offset_rad + LEARNED * (joints_rad - self._predicted)

    def command(self, goal_rad: np.ndarray) -> np.ndarray:
        """(6,) command [rad] that brings the joints to ``goal_rad`` (6,)."""
        self._predicted = follow(self._predicted, self._goal, goal_rad, self._lag_s)
        self._step_rad = float(np.abs(goal_rad - self._goal).max())
        self._goal = goal_rad
        return goal_rad - self.offset_rad

    def goal(self, command_rad: np.ndarray) -> np.ndarray:
        """(6,) goal [rad] for which ``command`` returned ``command_rad`` (6,)."""
        goal_rad = command_rad + self.offset_rad
        self.command(goal_rad)
        return goal_rad
