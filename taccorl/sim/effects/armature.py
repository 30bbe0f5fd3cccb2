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
    """(M + ΔJ) q̈: what a rotor adds behind its gear, J_rotor · ratio². Grows with the square of the frequency."""

    name: ClassVar = "armature"
    added_kgm2: float = parameter(
        unit="kg·m²",
        symbol="ΔJ",
        absent=0.0,
        low=0.0,
        high=1.0,
        typical=0.05,
        source="a choice; 0.007–0.020 on a Unitree Go2, research/discrepancy.md §4.6",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.armature += self.added_kgm2
