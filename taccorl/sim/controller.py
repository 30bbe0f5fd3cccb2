"""MIT impedance control τ = K_p (q* − q) − K_d q̇ + T_ref as MuJoCo's affine actuator, the same in C and on a GPU.

Paper App. B.1. The gains are effective values of the whole drive, found by the paper's identification, not what is sent to
a motor. They damp every joint far beyond critically: a joint follows its target with the time constant K_d / K_p ≈ 0.1 s and
rests T_ref / K_p away from it.
"""

from dataclasses import dataclass, field

import mujoco

from taccorl.errors import TaccorlError
from taccorl.sim.robot import JOINTS, RobotConfig
from taccorl.sim.settings import check_numbers

# J0 … J5 of the paper are joint1 … joint6 here. Table in Fig. "Per-joint controller SysID", App. B.1.
KP_NM_PER_RAD = (1813.0, 1392.4, 974.8, 587.1, 151.1, 151.8)
KD_NMS_PER_RAD = (159.4, 123.7, 87.9, 69.8, 17.1, 16.5)
TORQUE_FF_NM = (0.12, -0.44, 0.04, -0.12, 1.73, 0.07)


@dataclass(kw_only=True)
class ControllerConfig:
    """Per joint, joint1 … joint6, the same for both arms."""

    kp_nm_per_rad: list[float] = field(default_factory=lambda: list(KP_NM_PER_RAD))
    kd_nms_per_rad: list[float] = field(default_factory=lambda: list(KD_NMS_PER_RAD))
    torque_ff_nm: list[float] = field(default_factory=lambda: list(TORQUE_FF_NM))

    def __post_init__(self) -> None:
        for name in ("kp_nm_per_rad", "kd_nms_per_rad", "torque_ff_nm"):
            values = getattr(self, name)
            if len(values) != len(JOINTS):
                raise TaccorlError(
                    f"controller.{name}: {len(values)} values, the arm has {len(JOINTS)} joints: {values}"
                )
        # Without stiffness no joint has a place where it rests.
        check_numbers(
            "controller", self, finite=("torque_ff_nm",), not_negative=("kd_nms_per_rad",), positive=("kp_nm_per_rad",)
        )


def add_actuators(spec: mujoco.MjSpec, arm: str, robot: RobotConfig, controller: ControllerConfig) -> None:
    """Six joint actuators ``left_joint1`` … and ``left_gripper``, whose control is the opening between the pads [m]."""
    gains = zip(JOINTS, controller.kp_nm_per_rad, controller.kd_nms_per_rad, controller.torque_ff_nm, strict=True)
    for joint, kp, kd, torque_ff in gains:
        _affine(spec, f"{arm}_{joint}", mujoco.mjtTrn.mjTRN_JOINT, f"{arm}_{joint}", kp, kd, torque_ff)
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
    spec: mujoco.MjSpec, name: str, transmission: mujoco.mjtTrn, target: str, kp: float, kd: float, bias: float
) -> mujoco.MjsActuator:
    actuator = spec.add_actuator(name=name, trntype=transmission, target=target)
    actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    actuator.gainprm[0] = kp
    actuator.biasprm[:3] = [bias, -kp, -kd]
    return actuator
