"""Gravity mismatch: the controller carries a share of the arm’s weight that is not the configured one."""

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
    """τ_comp = s c g(q), with c the configured share (``robot.gravity_compensation``): the controller's masses are wrong.

    A joint rests (s − 1) c g(q) / K_p off, more where the arm reaches out.
    """

    name: ClassVar = "gravity_mismatch"
    share: float = parameter(
        unit="1",
        symbol="s",
        absent=1.0,
        low=0.0,
        high=2.0,
        typical=0.9,
        source="the two published mass sets of this arm: 3.6 and 2.2 kg moving (taccorl/sim/robot.py)",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for arm in self.arms():
            for body in spec.bodies:
                if body.name.startswith(f"{arm}_"):
                    body.gravcomp *= self.share
