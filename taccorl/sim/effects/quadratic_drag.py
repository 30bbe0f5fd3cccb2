"""Quadratic drag: a torque against the motion that grows with the square of its speed."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("quadratic_drag")
@dataclass(kw_only=True)
class QuadraticDrag(JointEffect):
    """Drag in proportion to the squared speed: τ = −c q̇ |q̇|. At half the speed a quarter of it remains, so that a change of
    K_d can reproduce it at one speed only.

    Implemented as the second coefficient of MuJoCo's polynomial joint damping.
    """

    name: ClassVar = "quadratic_drag"
    needs: ClassVar = ("velocity",)
    equation: ClassVar = "τ = −c q̇ |q̇|"
    in_words: ClassVar = (
        "Oil that the gear churns, or a cable that is whirled around: it brakes fast motion and no other."
    )
    at_a_policy: ClassVar = "Fast moves fall behind the command, slow ones are as trained."
    to_record: ClassVar = (
        "The same chirp at full and at half amplitude: steady speeds from slow to the fastest allowed."
    )
    near_twins: ClassVar = {
        "kd": "At one speed drag is damping; two speeds that differ by 3 or more separate them.",
        "viscous_friction": "At one speed both are a damping; two speeds that differ by 3 or more separate them.",
    }
    drag_nms2_per_rad2: float = parameter(
        unit="N·m·s²/rad²",
        symbol="c",
        absent=0.0,
        low=0.0,
        high=50.0,
        typical=2.0,
        over="kp",
        source="a choice: 0.3 N·m at 0.4 rad/s",
    )

    def drive(self) -> dict[str, float]:
        return {"quadratic_drag": self.drag_nms2_per_rad2}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.damping[1] += self.drag_nms2_per_rad2
