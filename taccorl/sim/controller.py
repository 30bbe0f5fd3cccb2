"""MIT impedance control τ = K_p (q* − q) − K_d q̇ + T_ref as MuJoCo's affine actuator, the same in C and on a GPU.

Paper App. B.1. The gains are effective values of the whole drive, found by the paper's identification, not those sent to
a motor. Every joint is strongly over-damped: it follows its target with the time constant K_d / K_p ≈ 0.1 s and has the
steady-state offset T_ref / K_p.
"""

from dataclasses import dataclass, field

import mujoco
import numpy as np
from mujoco.batch import Batch

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig
from taccorl.sim.settings import check_numbers


@dataclass(kw_only=True)
class ControllerConfig:
    """Gains K_p, K_d and feed-forward torques of the joints' controllers, τ = K_p (q* − q) − K_d q̇ + T_ref.

    Each list has one number for each joint of an arm, from base to hand, and holds for all arms."""

    kp_nm_per_rad: list[float] = field(
        default_factory=lambda: list(ROBOT.kp_nm_per_rad)
    )
    """K_p [N·m/rad]."""
    kd_nms_per_rad: list[float] = field(
        default_factory=lambda: list(ROBOT.kd_nms_per_rad)
    )
    """K_d [N·m·s/rad]."""
    torque_ff_nm: list[float] = field(default_factory=lambda: list(ROBOT.torque_ff_nm))
    """T_ref [N·m]."""

    def __post_init__(self) -> None:
        for name in ("kp_nm_per_rad", "kd_nms_per_rad", "torque_ff_nm"):
            values = getattr(self, name)
            if len(values) != ROBOT.num_joints:
                raise TaccorlError(
                    f"controller.{name}: {len(values)} values for {ROBOT.num_joints} joints: {values}"
                )
        # Without stiffness no joint has a place where it rests.
        check_numbers(
            "controller",
            self,
            finite=("torque_ff_nm",),
            not_negative=("kd_nms_per_rad",),
            positive=("kp_nm_per_rad",),
        )


class MotorEffort:
    """Torques of motors in a batch of simulations: the actuators' forces, within the limits of their joints (``actfrcrange``),
    which hold for the sum of all actuators of a joint and its gravity compensation. ``motors``: ids of the motors' actuators."""

    def __init__(self, batch: Batch, motors: np.ndarray) -> None:
        model = batch.model
        self._motors, self._force = motors, batch.bind("actuator_force")
        on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        own = np.where(on_joint, model.actuator_trnid[:, 0], -1)
        self._limited = np.array(
            [
                k
                for k, motor in enumerate(motors)
                if on_joint[motor] and model.jnt_actfrclimited[own[motor]]
            ],
            dtype=int,
        )
        if self._limited.size:
            joints = own[motors[self._limited]]
            self._dofs, self._carries = (
                model.jnt_dofadr[joints],
                model.jnt_actgravcomp[joints] != 0,
            )
            self._gear = np.where(
                own[:, None] == joints, model.actuator_gear[:, :1], 0.0
            )
            self._given, self._carried = (
                batch.bind("qfrc_actuator"),
                batch.bind("qfrc_gravcomp"),
            )

    def __call__(self) -> np.ndarray:
        """(N, number of motors) [N·m, N] in the newest physics step, without gravity compensation."""
        effort = self._force[:, self._motors]
        if self._limited.size:
            asked = self._force @ self._gear + np.where(
                self._carries, self._carried[:, self._dofs], 0.0
            )
            effort[:, self._limited] += self._given[:, self._dofs] - asked
        return effort


def add_actuators(
    spec: mujoco.MjSpec, arm: str, robot: RobotConfig, controller: ControllerConfig
) -> None:
    """Add one position actuator per joint, ``left_joint1`` …, and per gripper, ``left_gripper``; a gripper's control is the
    opening between the pads [m]."""
    gains = zip(
        ROBOT.joints,
        controller.kp_nm_per_rad,
        controller.kd_nms_per_rad,
        controller.torque_ff_nm,
        strict=True,
    )
    for joint, kp, kd, torque_ff in gains:
        _affine(
            spec,
            f"{arm}_{joint}",
            mujoco.mjtTrn.mjTRN_JOINT,
            f"{arm}_{joint}",
            kp,
            kd,
            torque_ff,
        )
    opening = spec.add_tendon(name=f"{arm}_opening")
    opening.wrap_joint(f"{arm}_finger_a", 1)
    opening.wrap_joint(f"{arm}_finger_b", 1)
    gripper = _affine(
        spec,
        f"{arm}_gripper",
        mujoco.mjtTrn.mjTRN_TENDON,
        f"{arm}_opening",
        robot.grip_stiffness_n_per_m,
        robot.grip_damping_ns_per_m,
        0.0,
    )
    gripper.forcelimited = True
    gripper.forcerange = [-robot.grip_force_max_n, robot.grip_force_max_n]


def _affine(
    spec: mujoco.MjSpec,
    name: str,
    transmission: mujoco.mjtTrn,
    target: str,
    kp: float,
    kd: float,
    bias: float,
) -> mujoco.MjsActuator:
    actuator = spec.add_actuator(name=name, trntype=transmission, target=target)
    actuator.gaintype, actuator.biastype = (
        mujoco.mjtGain.mjGAIN_FIXED,
        mujoco.mjtBias.mjBIAS_AFFINE,
    )
    actuator.gainprm[0] = kp
    actuator.biasprm[:3] = [bias, -kp, -kd]
    return actuator
