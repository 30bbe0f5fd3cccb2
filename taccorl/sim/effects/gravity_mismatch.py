"""Gravity mismatch: the controller compensates a share of the arm’s weight that is not the configured one."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import ArmEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("gravity_mismatch")
@dataclass(kw_only=True)
class GravityMismatch(ArmEffect):
    """Error of the gravity compensation: τ_comp = s c g(q), with the configured share c (``robot.gravity_compensation``). The
    controller's masses differ from the arm's by the factor s.

    At rest a joint deviates from its target by (s − 1) c g(q) / K_p, which is greatest when the arm is stretched out.
    """

    name: ClassVar = "gravity_mismatch"
    needs: ClassVar = ("weight",)
    equation: ClassVar = "τ_comp = s c g(q)"
    in_words: ClassVar = (
        "The controller carries the arm's weight with masses that are not the arm's: it hangs, or rises, where it "
        "reaches out."
    )
    at_a_policy: ClassVar = "The hand is too low or too high by millimetres, by more the further it reaches."
    to_record: ClassVar = "A wide, slow triangle, or holds in several poses; efforts settle it."
    near_twins: ClassVar = {
        "payload": (
            "Weight that is not carried in both; a payload weighs most on the wrist and has inertia: holds in several "
            "poses."
        ),
        "torque_scale": "A weak drive carries less as well; it also follows fast motion worse: chirp and efforts.",
        "cable_spring": "Over a small range both are a slope in the angle; turn the base, which weight does not load.",
        "torque_ff": "The constant part of a weight hides in T_ref; poses far from each other separate them.",
        "unbalance": "In one pose both are a sine of the angle; another pose of the other joints keeps s.",
    }
    share: float = parameter(
        unit="1",
        symbol="s",
        absent=1.0,
        low=0.0,
        high=2.0,
        typical=0.9,
        over="kp",
        source="the two published mass sets of this arm: 3.6 and 2.2 kg moving (taccorl/robots/bimanual_piper.py)",
    )

    def drive(self) -> dict[str, float]:
        return {"gravity_carried": self.share}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for arm in self.arms():
            for body in spec.bodies:
                if body.name.startswith(f"{arm}_"):
                    body.gravcomp *= self.share
