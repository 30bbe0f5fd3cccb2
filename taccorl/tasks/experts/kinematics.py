"""Inverse kinematics of one arm: TCP pose in the world → six joint angles within their limits.

Six joints for six numbers: along a motion one Newton step q += J⁻¹ e does it, in a fifth of the time of a quadratic program.
Where that does not converge or would leave a joint's range, mink's program finds the best within the limits.
"""

import math
from collections.abc import Mapping

import mink
import mujoco
import numpy as np

from taccorl.errors import UnreachableError
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig, add_arm
from taccorl.tasks.experts.se3 import rotvec, transform

_METRES_PER_RAD = 0.15  # how an orientation error weighs against a position error: the hand's own length
_ITERATIONS = 20
_NEWTON_ITERATIONS = 4
_STEP_RAD = 0.3  # at most, in one iteration
_MARGIN_RAD = 0.02  # kept from the joint limits, so that a trembling hand stays inside


class ArmKinematics:
    """Forward and inverse kinematics of one arm, without collisions."""

    def __init__(self, arm: str, robot: RobotConfig) -> None:
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        add_arm(spec, arm, robot)
        self.arm, self.model = arm, spec.compile()
        self._joints = np.array(
            [self.model.joint(f"{arm}_{j}").qposadr[0] for j in ROBOT.joints]
        )
        self.model.jnt_range[self._joints] += [_MARGIN_RAD, -_MARGIN_RAD]
        self._low, self._high = self.model.jnt_range[self._joints].T
        self._data, self._site = (
            mujoco.MjData(self.model),
            self.model.site(f"{arm}_tcp").id,
        )
        # Views of the data: MuJoCo makes a new one whenever it is asked.
        self._qpos = self._data.qpos
        self._position, self._rotation = (
            self._data.site_xpos[self._site],
            self._data.site_xmat[self._site].reshape(3, 3),
        )
        self._jacobian = np.zeros((6, self.model.nv))
        self._configuration = mink.Configuration(self.model)
        self._frame = mink.FrameTask(
            f"{arm}_tcp",
            "site",
            position_cost=1.0,
            orientation_cost=_METRES_PER_RAD,
            lm_damping=1e-6,
        )
        self._limits = [mink.ConfigurationLimit(self.model)]

    def pose(self, joints_rad: np.ndarray) -> np.ndarray:
        """Forward kinematics: pose world-from-TCP (4, 4) of the angles ``joints_rad`` (6,)."""
        self._qpos[self._joints] = joints_rad
        mujoco.mj_kinematics(self.model, self._data)
        return transform(self._position, self._rotation)

    def solve(
        self, tcp_world: np.ndarray, start_rad: np.ndarray, tolerance_m: float = 1e-5
    ) -> tuple[np.ndarray, float]:
        """Return the joint angles (6,) [rad] that bring the TCP closest to ``tcp_world`` (4, 4), and the remaining error [m].

        The error is that of the position plus 0.15 m/rad times that of the rotation. The search starts at ``start_rad`` (6,), so
        that it finds the nearest solution; it ends below ``tolerance_m``.
        """
        joints = np.array(start_rad, dtype=np.float64)
        for _ in range(_NEWTON_ITERATIONS):
            twist, error_m = self._error(tcp_world, joints)
            if error_m < tolerance_m:
                return joints, error_m
            mujoco.mj_comPos(self.model, self._data)
            mujoco.mj_jacSite(
                self.model,
                self._data,
                self._jacobian[:3],
                self._jacobian[3:],
                self._site,
            )
            try:
                joints = joints + np.linalg.solve(
                    self._jacobian[:, self._joints], twist
                )
            except (
                np.linalg.LinAlgError
            ):  # stretched out: two joints turn about the same line
                break
            if ((joints < self._low) | (joints > self._high)).any():
                break
        return self._solve_within_limits(tcp_world, start_rad, tolerance_m)

    def _error(
        self, tcp_world: np.ndarray, joints_rad: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """(6,) what is missing, in the world [m, rad], and its size [m]."""
        self._qpos[self._joints] = joints_rad
        mujoco.mj_kinematics(self.model, self._data)
        twist = np.empty(6)
        twist[:3] = tcp_world[:3, 3] - self._position
        twist[3:] = self._rotation @ rotvec(self._rotation, tcp_world)
        return twist, math.sqrt(twist[:3] @ twist[:3]) + _METRES_PER_RAD * math.sqrt(
            twist[3:] @ twist[3:]
        )

    def _solve_within_limits(
        self, tcp_world: np.ndarray, start_rad: np.ndarray, tolerance_m: float
    ) -> tuple[np.ndarray, float]:
        q = self._configuration.q.copy()
        q[self._joints] = np.clip(start_rad, self._low, self._high)
        self._configuration.update(q)
        self._frame.set_target(mink.SE3.from_matrix(tcp_world))
        for _ in range(_ITERATIONS):
            if (
                self._error(tcp_world, self._configuration.q[self._joints])[1]
                < tolerance_m
            ):
                break
            step = mink.solve_ik(
                self._configuration,
                [self._frame],
                1.0,
                "daqp",
                damping=1e-6,
                limits=self._limits,
            )
            self._configuration.integrate_inplace(
                np.clip(step, -_STEP_RAD, _STEP_RAD), 1.0
            )
        joints = np.clip(self._configuration.q[self._joints], self._low, self._high)
        return joints, self._error(tcp_world, joints)[1]

    def search(
        self,
        tcp_world: np.ndarray,
        rng: np.random.Generator,
        tries: int = 20,
        tolerance_m: float = 5e-4,
    ) -> np.ndarray:
        """Joint angles (6,) [rad] that bring the TCP to ``tcp_world`` (4, 4) within ``tolerance_m``: of the solutions from
        ``tries`` random starts, the one farthest from the joint limits.

        Raises:
            UnreachableError: the pose is out of reach.
        """
        low, high = self._low, self._high
        best, best_margin, best_error = None, -np.inf, np.inf
        for _ in range(tries):
            joints, error_m = self.solve(
                tcp_world,
                rng.uniform(low + 0.15 * (high - low), high - 0.15 * (high - low)),
            )
            best_error = min(best_error, error_m)
            margin = np.minimum(joints - low, high - joints).min()
            if error_m < tolerance_m and margin > best_margin:
                best, best_margin = joints, margin
        if best is None:
            place = np.round(tcp_world[:3, 3], 3).tolist()
            raise UnreachableError(
                f"{self.arm} arm: TCP at {place} m with approach {np.round(tcp_world[:3, 2], 2).tolist()} is out of reach: "
                f"{best_error * 1e3:.1f} mm short after {tries} starts. Move the pose, or tilt the approach."
            )
        return best


def retargeted(
    action: np.ndarray,
    kinematics: Mapping[str, ArmKinematics],
    joints_rad: Mapping[str, np.ndarray],
    goals: Mapping[str, np.ndarray],
) -> np.ndarray:
    """``action`` (14,) with other goals of some arms: (14,) float32 joint targets [rad] and openings [m], within their limits.

    Args:
        joints_rad: arm → joint angles (6,) [rad] for which ``action`` was computed. What the action has beside them, such as an
            offset against gravity, is kept.
        goals: arm → world-from-TCP target (4, 4) [m] instead.
    """
    other = action.astype(float)
    for arm, goal in goals.items():
        joints, _ = kinematics[arm].solve(goal, joints_rad[arm])
        other[ROBOT.joint_slice(arm)] += joints - joints_rad[arm]
    return np.clip(other, ROBOT.action_low, ROBOT.action_high).astype(np.float32)
