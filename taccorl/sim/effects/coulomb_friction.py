"""Coulomb friction: a torque against the motion that does not depend on its speed, and that holds a joint at rest."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.dry_friction import add_dry_friction
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("coulomb_friction")
@dataclass(kw_only=True)
class CoulombFriction(JointEffect):
    """Dry friction of a joint: τ = −F sign(q̇); at rest any τ with |τ| ≤ F. The joint stops up to F / K_p before its target."""

    name: ClassVar = "coulomb_friction"
    needs: ClassVar = ("velocity",)
    equation: ClassVar = "τ = −F sign(q̇); at rest |τ| ≤ F"
    in_words: ClassVar = (
        "Dry friction of gear and bearings: the same torque against the motion at any speed, and the joint sticks at"
        " rest."
    )
    at_a_policy: ClassVar = (
        "The arm stops short of each target by up to F / K_p, on the side that it comes from, and small corrections "
        "do nothing."
    )
    to_record: ClassVar = "A slow triangle over the range at two speeds."
    near_twins: ClassVar = {
        "asymmetric_friction": (
            "From angles alone Coulomb's friction and a constant torque are identical to it: pick either; efforts can tell."
        ),
        "load_friction": "Alike while the load is the same; move slowly where the arm reaches out and where it hangs.",
        "position_dependent_friction": (
            "Over a range that is small against the spot both are alike; sweep slowly over the whole range."
        ),
        "power_law_friction": "Alike at one speed; steady speeds that differ by 3 or more separate them.",
        "stribeck_friction": "Alike but at the slowest; hold, then creep at 0.01 rad/s.",
        "error_deadband": (
            "Both stop short of the target; a dead band gives way to a push, friction holds: efforts, or twice the "
            "gain."
        ),
    }
    same_with_torque_ff: ClassVar = ("asymmetric_friction",)
    torque_nm: float = parameter(
        unit="N·m",
        symbol="F",
        absent=0.0,
        low=0.0,
        high=20.0,
        typical=0.4,
        over="kp",
        source="0.2–0.8 N·m fitted to a Unitree Go2 (iit-DLSLab/sim2real-robot-identification); 0.3 in Menagerie’s PiPER",
    )

    def drive(self) -> dict[str, float]:
        return {"coulomb": self.torque_nm}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            add_dry_friction(joint, self.torque_nm)
