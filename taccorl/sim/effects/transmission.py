"""A second joint between a motor and its link, for effects in the gear: backlash, or a spring."""

import mujoco


def add_transmission_joint(motor: mujoco.MjsJoint, what: str) -> mujoco.MjsJoint:
    """Add a hinge after ``motor`` about the same axis, named ``{motor}_{what}``: the link's angle is the sum of both.

    The motor supplies the gravity compensation. MuJoCo's gravity compensation acts on every joint; at this hinge it counts as an
    actuator force, which is limited to zero, so that the weight loads the gear.
    """
    gear_kgm2 = 1e-5  # a gear's own inertia: with none, play and spring on one joint would be a singular chain
    joint = motor.parent.add_joint(name=f"{motor.name}_{what}", axis=motor.axis, pos=motor.pos, armature=gear_kgm2)
    joint.actgravcomp, joint.actfrclimited = True, True
    joint.actfrcrange = [-1e-12, 1e-12]
    return joint
