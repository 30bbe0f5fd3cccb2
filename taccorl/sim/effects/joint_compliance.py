"""Joint compliance: the gear between motor and link gives way like a spring."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter
from taccorl.sim.effects.transmission import add_transmission_joint

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("joint_compliance")
@dataclass(kw_only=True)
class JointCompliance(JointEffect):
    """Compliance of the gear: the link rotates by c τ relative to the motor under the torque τ in the gear, which includes the
    arm's weight.

    Controller and encoder are on the motor's side. The effect is a second hinge with a spring between the motor's joint and the
    link, so that the model has one more joint: ``left_joint5_compliance``. Its damping is κ / c.
    """

    name: ClassVar = "joint_compliance"
    needs: ClassVar = ("position", "effort")
    equation: ClassVar = "q_link − q_motor = c τ; damping κ / c"
    in_words: ClassVar = (
        "The gear between motor and link gives way like a spring. The encoder on the motor does not see it."
    )
    at_a_policy: ClassVar = (
        "The hand sags and swings after fast motion while the reported angles are where they should be."
    )
    to_record: ClassVar = "A small chirp up to 10 Hz shows the resonance; a known payload shows the sag in a camera."
    near_twins: ClassVar = {
        "torque_lag": (
            "A small phase within the loop in both; only a spring resonates: small chirp beyond 5 Hz at twice the gain."
        ),
        "command_delay": "A small phase in either; a delay leaves no resonance: small, fast chirp.",
        "command_lag": "A small phase in either; a small, fast chirp shows the resonance of a spring.",
        "backlash": (
            "The link moves against the motor in both; play does so all at once and without resonance: record small "
            "motions about two poses."
        ),
    }
    compliance_rad_per_nm: float = parameter(
        unit="rad/(N·m)",
        symbol="c",
        absent=0.0,
        low=0.0,
        high=0.05,
        typical=0.001,
        source="a choice: 1e3 N·m/rad",
    )
    damping_s: float = parameter(
        unit="s",
        symbol="κ",
        absent=None,
        low=0.0,
        high=0.05,
        typical=0.002,
        source="a choice: lightly damped",
    )

    def drive(self) -> dict[str, float]:
        return {"compliance": self.compliance_rad_per_nm, "compliance_damping": self.damping_s}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for motor in self.chosen(spec):
            spring = add_transmission_joint(motor, "compliance")
            spring.stiffness[0] = 1.0 / self.compliance_rad_per_nm
            spring.damping[0] = self.damping_s / self.compliance_rad_per_nm
