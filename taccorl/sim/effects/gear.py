"""Effects in the gear, between motor and link: play, and a spring. Controller and encoder are on the motor's side."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import mujoco

from taccorl.sim.effects.effect import JointEffect, effect, number

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

GEAR_KGM2 = 1e-5
"""A gear's own inertia: with none, play and spring on one joint would be a singular chain."""
LIMIT_TIME_S, LIMIT_SHARE = 0.002, 0.99
"""Time constant [s] and impedance of MuJoCo's constraint at the ends of the play."""


def _add_joint(motor: mujoco.MjsJoint, what: str) -> mujoco.MjsJoint:
    """Add a hinge after ``motor`` about the same axis, named ``{motor}_{what}``: the link's angle is the sum of both.

    The motor supplies the gravity compensation. MuJoCo's gravity compensation acts on every joint; at this hinge it counts as an
    actuator force, which is limited to zero, so that the weight loads the gear."""
    joint = motor.parent.add_joint(
        name=f"{motor.name}_{what}", axis=motor.axis, pos=motor.pos, armature=GEAR_KGM2
    )
    joint.actgravcomp, joint.actfrclimited = True, True
    joint.actfrcrange = [-1e-12, 1e-12]
    return joint


@effect("backlash", slot="gear", needs="position")
class Backlash(JointEffect):
    """Play of the gear: the link moves freely within ± p / 2 of the motor, and the motor moves it at both ends. ``play_rad`` p is
    the whole play, from one end to the other. The weight of the link decides at which end it rests.

    The effect is a second hinge with limits between the motor's joint and the link, so that the model has one more joint:
    ``left_joint5_backlash``. The limits are stiff, but not rigid: 10–20 µrad of motion remain if the play approaches 0."""

    play_rad: float = number("p", "rad", 0, 0.005, (0, 0.1))

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for motor in self.chosen(spec):
            play = _add_joint(motor, "backlash")
            play.limited, play.range = True, [-self.play_rad / 2, self.play_rad / 2]
            play.solref_limit = [LIMIT_TIME_S, 1.0]
            play.solimp_limit = [LIMIT_SHARE, LIMIT_SHARE, 0.001, 0.5, 2.0]


@effect("joint_compliance", slot="gear", needs=("position", "effort"))
class JointCompliance(JointEffect):
    """Compliance of the gear: the link rotates by c τ relative to the motor under the torque τ in the gear, which includes the
    arm's weight.

    The effect is a second hinge with a spring between the motor's joint and the link, so that the model has one more joint:
    ``left_joint5_compliance``. Its damping is κ / c."""

    compliance_rad_per_nm: float = number(
        "c", "rad/(N·m)", 0, 0.001, (0, 0.05), "a choice: 1e3 N·m/rad"
    )
    damping_s: float = number(
        "κ", "s", None, 0.002, (0, 0.05), "a choice: lightly damped"
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: also gears as soft as the drive, and three times as soft."""
        soft = [
            times * seen["drive_rad_per_nm"]
            for times in (1.0, 3.0)
            if "drive_rad_per_nm" in seen
        ]
        return [*super().starts(seen), *({"compliance_rad_per_nm": c} for c in soft)]

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for motor in self.chosen(spec):
            spring = _add_joint(motor, "compliance")
            spring.stiffness[0] = 1.0 / self.compliance_rad_per_nm
            spring.damping[0] = self.damping_s / self.compliance_rad_per_nm
