"""Armature: rotor inertia on top of the configured one."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("armature")
@dataclass(kw_only=True)
class Armature(JointEffect):
    """Additional inertia of the motor's rotor: (M + ΔJ) q̈ with ΔJ = J_rotor · (gear ratio)². Its torque grows with the square
    of the motion's frequency."""

    name: ClassVar = "armature"
    needs: ClassVar = ("acceleration",)
    equation: ClassVar = "(M + ΔJ) q̈"
    in_words: ClassVar = (
        "The motor's rotor turns with the joint, as fast as the gear makes it. The controller has to accelerate it "
        "as well."
    )
    at_a_policy: ClassVar = "Quick corrections come late and overshoot; slow motion is as before."
    to_record: ClassVar = "A chirp up to 3 Hz or more; with efforts, or again with a known payload on the hand."
    near_twins: ClassVar = {
        "torque_scale": (
            "Without efforts, more inertia is less torque for all of it; weight tells: move slowly between poses, or "
            "load the hand."
        ),
        "kp": "All gains together scale like 1 / J; efforts or a known payload fix their size.",
        "speed_delay": "An inertia with the other sign: only their difference shows, and only less inertia is a delay.",
    }
    added_kgm2: float = parameter(
        unit="kg·m²",
        symbol="ΔJ",
        absent=0.0,
        low=0.0,
        high=1.0,
        typical=0.05,
        over="kp",
        source="a choice; 0.007–0.020 fitted to a Unitree Go2 (iit-DLSLab/sim2real-robot-identification)",
    )

    def drive(self) -> dict[str, float]:
        return {"added_inertia": self.added_kgm2}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.armature += self.added_kgm2
