"""How far an arm's joints rest from their targets: what a hand's goal and the command that brings it there differ by.

The controller's feed-forward torque lets joint 5 rest 11 mrad off, 3 mm at the fingertips, and other joints by less; a twin
with other gains lets them rest elsewhere. So goals, not commands, are carried over, and the rest is learnt where they are used.
"""

import math

import mujoco
import numpy as np

from taccorl.demos.experts.scripted import follow
from taccorl.robots import ROBOT
from taccorl.sim.twin import CONTROL_HZ

_LEARNED = 1 - math.exp(
    -3.0 / CONTROL_HZ
)  # in a control step: what is seen to rest off is down to a third after 1 / 3 s

_STILL_RAD = 0.001  # of a joint in a control step: what a tremor makes; 12 mm/s of a hand


def joint_addresses(model: mujoco.MjModel, arm: str) -> np.ndarray:
    """(6,) where an arm's joints are in ``qpos``."""
    return np.array([model.joint(f"{arm}_{joint}").qposadr[0] for joint in ROBOT.joints])


class RestOffset:
    """Of one arm's joints (6,): command = goal − offset. A first-order lag behind the goals is told apart from it."""

    def __init__(self, joints_rad: np.ndarray, command_rad: np.ndarray, lag_s: np.ndarray) -> None:
        """At rest: where the joints are, what is commanded, and the controller's time constants K_d / K_p."""
        self.offset_rad = joints_rad - command_rad
        self._goal, self._predicted, self._lag_s = joints_rad, joints_rad, lag_s
        self._step_rad = 0.0

    @property
    def is_still(self) -> bool:
        """Whether the last goal hardly moved: whether there is anything to ``see``."""
        return self._step_rad < _STILL_RAD

    def see(self, joints_rad: np.ndarray) -> None:
        """Before a command, where nothing is touched: what is not where a lag would have it rests off. An arm that moves teaches
        nothing: its lag is not exactly of first order."""
        if self.is_still:
            self.offset_rad = self.offset_rad + _LEARNED * (joints_rad - self._predicted)

    def command(self, goal_rad: np.ndarray) -> np.ndarray:
        """(6,) what to send so that the joints come to ``goal_rad``."""
        self._predicted = follow(self._predicted, self._goal, goal_rad, self._lag_s)
        self._step_rad = float(np.abs(goal_rad - self._goal).max())
        self._goal = goal_rad
        return goal_rad - self.offset_rad

    def goal(self, command_rad: np.ndarray) -> np.ndarray:
        """(6,) what ``command`` was asked for, from what it sent."""
        goal_rad = command_rad + self.offset_rad
        self.command(goal_rad)
        return goal_rad
