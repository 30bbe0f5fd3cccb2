"""Coulomb friction: a torque against the motion that does not depend on its speed, and that holds a joint at rest."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("coulomb_friction")
@dataclass(kw_only=True)
class CoulombFriction(JointEffect):
    """τ = −F sign(q̇); at rest any τ with |τ| ≤ F. The joint stops up to F / K_p before its target, on the side it comes from.

    MuJoCo's friction loss is soft. With its defaults it damps instead of holding: by 11 N·m·s/rad on joint 5, and a joint within
    F / K_p of its target creeps there in a second. With the settings below it creeps at 4e-6 rad/s.
    """

    name: ClassVar = "coulomb_friction"
    torque_nm: float = parameter(
        unit="N·m",
        symbol="F",
        absent=0.0,
        low=0.0,
        high=20.0,
        typical=0.4,
        source="0.2–0.8 N·m on a Unitree Go2, research/discrepancy.md §4.6; 0.3 in Menagerie’s PiPER",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.frictionloss += self.torque_nm
            joint.solref_friction = [0.002, 1.0]
            joint.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2.0]
