"""Viscous friction: a torque against the motion in proportion to its speed."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("viscous_friction")
@dataclass(kw_only=True)
class ViscousFriction(JointEffect):
    """Viscous friction: τ = −b q̇. For a joint that follows given targets, b has the same effect as a larger K_d: positions
    cannot distinguish them.

    To determine b, change the gains between recordings, or record torques.
    """

    name: ClassVar = "viscous_friction"
    needs: ClassVar = ("velocity",)
    equation: ClassVar = "τ = −b q̇"
    in_words: ClassVar = "Grease: a torque against the motion in proportion to its speed."
    at_a_policy: ClassVar = "The arm lags a little more behind fast commands."
    to_record: ClassVar = "The same chirp at twice the commanded gain, or efforts: positions at one gain never show it."
    near_twins: ClassVar = {
        "kd": (
            "This b adds to K_d and does nothing else, on every recording at one gain; twice the gain, or efforts, separate"
            " them."
        ),
        "power_law_friction": "At one speed both are alike; steady speeds that differ by 3 or more separate them.",
        "quadratic_drag": "At one speed both are a damping; two speeds that differ by 3 or more separate them.",
    }
    damping_nms_per_rad: float = parameter(
        unit="N·m·s/rad",
        symbol="b",
        absent=0.0,
        low=0.0,
        high=50.0,
        typical=1.0,
        over="kp",
        source="a choice; 0.15 fitted to a Unitree Go2 (iit-DLSLab/sim2real-robot-identification)",
    )

    def drive(self) -> dict[str, float]:
        return {"viscous": self.damping_nms_per_rad}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.damping[0] += self.damping_nms_per_rad
