"""Asymmetric friction: dry friction that is greater in one direction than in the other."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.dry_friction import add_dry_friction, add_passive_torque
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("asymmetric_friction")
@dataclass(kw_only=True)
class AsymmetricFriction(JointEffect):
    """Dry friction that depends on the direction: τ = −F (1 + a sign q̇) sign q̇; at rest any τ with −F (1 + a) ≤ τ ≤ F (1 − a).
    With a > 0 friction is greater in the positive direction.

    The torque equals −F sign q̇ − a F, so that it is implemented as Coulomb friction and a constant torque. It does not come
    from the motor: efforts do not include it.
    """

    name: ClassVar = "asymmetric_friction"
    needs: ClassVar = ("velocity",)
    equation: ClassVar = "τ = −F (1 + a sign q̇) sign q̇"
    in_words: ClassVar = (
        "Dry friction that is greater one way than the other, as of worm gears, seals, or a gear worn on one flank."
    )
    at_a_policy: ClassVar = "The arm stops short of its targets by different amounts from either side."
    to_record: ClassVar = (
        "A slow triangle over the range, with efforts: they alone tell the constant part from a constant torque of the drive "
        "(T_ref)."
    )
    near_twins: ClassVar = {
        "coulomb_friction": "From angles alone, T_ref fitted, it is identical by algebra: pick either; efforts can tell.",
        "power_law_friction": "Alike at one speed; three steady speeds, there and back, separate them.",
        "direction_gain": (
            "At one amplitude both differ by direction alike; twice the speed, or twice the load, doubles that one only."
        ),
        "torque_ff": "Its part a F is a constant torque; only efforts tell it from the controller's own.",
    }
    same_with_torque_ff: ClassVar = ("coulomb_friction",)
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
    asymmetry: float = parameter(
        unit="1",
        symbol="a",
        absent=None,
        low=-0.9,
        high=0.9,
        typical=0.3,
        source="a choice",
    )

    def drive(self) -> dict[str, float]:
        return {"coulomb": self.torque_nm, "asymmetry": self.asymmetry}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name, joint in zip(self.acts_on(), self.chosen(spec), strict=True):
            add_dry_friction(joint, self.torque_nm)
            # A cogging torque of no periods: its sine is 1 everywhere.
            constant = [-self.asymmetry * self.torque_nm, 0.0, math.pi / 2]
            add_passive_torque(spec, name, "asymmetry", cogging=constant)
