"""Power-law friction: friction that rises steeply from rest and less and less with the speed, as that of grease."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.dry_friction import add_dry_friction
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

AT_RAD_PER_S = 0.1
"""v₁, the speed at which F is stated [rad/s; m/s of a slide]. A choice."""


@effects.register("power_law_friction")
@dataclass(kw_only=True)
class PowerLawFriction(JointEffect):
    """Friction of a lubricant that thins with the shear rate: τ = −F (1 + a sign q̇) (|q̇| / v₁)ⁿ sign q̇ with v₁ = 0.1 rad/s (0.1
    m/s of a slide) and 0 < n < 1, between Coulomb friction (n = 0) and viscous friction (n = 1).

    This is the law of Herschel and Bulkley (1926) for grease, without its yield stress, which ``coulomb_friction`` adds. With a >
    0 friction is greater in the positive direction. Implemented as dry friction whose limit follows from the speed of the physics
    step before.
    """

    name: ClassVar = "power_law_friction"
    needs: ClassVar = ("velocity",)
    equation: ClassVar = "τ = −F (1 + a sign q̇) (|q̇| / v₁)ⁿ sign q̇, v₁ = 0.1 rad/s"
    in_words: ClassVar = (
        "Grease that thins as it is sheared: friction rises steeply at slow speeds and grows little beyond."
    )
    at_a_policy: ClassVar = (
        "Slow motion lags nearly as much as fast motion, but the arm does not stick short of its targets."
    )
    to_record: ClassVar = "Slow triangles at three speeds or more that differ by 3, there and back, with efforts."
    near_twins: ClassVar = {
        "coulomb_friction": "Alike at one speed; steady speeds that differ by 3 or more separate them.",
        "asymmetric_friction": "Alike at one speed, with a difference between directions; three steady speeds separate them.",
        "presliding": "Both soften a reversal; only bristles do so at the slowest speed: a triangle at 0.005 rad/s.",
        "viscous_friction": "Alike at one speed; steady speeds that differ by 3 or more separate them.",
    }
    reduces_to: ClassVar = {"coulomb_friction": "exponent"}
    equals_when_wide: ClassVar = {"viscous_friction": "exponent"}
    rewrites: ClassVar = ("dof_frictionloss",)
    torque_nm: float = parameter(
        unit="N·m",
        symbol="F",
        absent=0.0,
        low=0.0,
        high=20.0,
        typical=0.4,
        over="kp",
        source="as coulomb_friction",
    )
    exponent: float = parameter(
        unit="1",
        symbol="n",
        absent=None,
        low=0.0,
        high=1.0,
        typical=0.4,
        source="a choice; 0.35 is fitted to a real drive (EMPS, docs/your_robot.md)",
    )
    asymmetry: float = parameter(
        unit="1",
        symbol="a",
        absent=None,
        low=-0.9,
        high=0.9,
        typical=0.0,
        source="a choice",
    )

    def drive(self) -> dict[str, float]:
        return {
            "power_torque": self.torque_nm,
            "power_exponent": self.exponent,
            "power_asymmetry": self.asymmetry,
        }

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            add_dry_friction(joint, 0.0)

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"friction_nm": np.zeros((num_sims, len(self.acts_on())))}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        speed = live.seen("qvel")[:, live.dofs(self.acts_on())][ids]
        grown = self.torque_nm * (np.abs(speed) / AT_RAD_PER_S) ** self.exponent * (speed != 0.0)
        memory["friction_nm"][ids] = grown * (1.0 + self.asymmetry * np.sign(speed))

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        live.own("dof_frictionloss")[:, live.dofs(self.acts_on())] += memory["friction_nm"]
