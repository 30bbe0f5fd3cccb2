"""Shared code of effects of dry friction and of passive torques."""

import mujoco

_NO_INPUT = 16  # mjINPUT_NONE of mjtype.h, for which Python has no name


def add_dry_friction(joint: mujoco.MjsJoint, torque_nm: float) -> None:
    """Add dry friction that holds a joint at rest. With MuJoCo's default settings the friction is soft: it acts as a damping of
    11 N·m·s/rad on joint 5, and a joint that rests within F / K_p of its target drifts to it within a second. With the settings
    used here it drifts at 4e-6 rad/s."""
    joint.frictionloss += torque_nm
    joint.solref_friction = [0.002, 1.0]
    joint.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2.0]


def add_passive_torque(spec: mujoco.MjSpec, joint: str, what: str, **terms: list[float]) -> None:
    """Add the actuator ``{joint}_{what}``: MuJoCo's DC motor without input and current, of which only the ``cogging`` or
    ``lugre`` terms act. ``torque_saturation`` of the same joint limits the sum of this actuator and the motor."""
    actuator = spec.add_actuator(name=f"{joint}_{what}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint)
    actuator.set_to_dcmotor(motorconst=[0.0, 0.0], resistance=1.0, ctrlspec=_NO_INPUT, **terms)
