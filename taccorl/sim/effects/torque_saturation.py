"""Torque saturation: the drive gives no more than so much."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("torque_saturation")
@dataclass(kw_only=True)
class TorqueSaturation(JointEffect):
    """|τ| ≤ τ_max, where τ is the controller's torque and the one that carries the arm's weight together.

    MuJoCo's ``actuatorfrcrange`` with ``actuatorgravcomp``: a limit at the joint. While it is reached, K_d does not damp either.
    """

    name: ClassVar = "torque_saturation"
    torque_max_nm: float = parameter(
        unit="N·m",
        symbol="τ_max",
        absent=math.inf,
        low=0.05,
        high=200.0,
        typical=8.0,
        source="torque range of the MIT mode, ±8 N·m by default (research/mujoco.md §2)",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.actgravcomp, joint.actfrclimited = True, True
            joint.actfrcrange = [-self.torque_max_nm, self.torque_max_nm]
