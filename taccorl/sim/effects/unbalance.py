"""Unbalance: weight about a joint that the model lacks."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.dry_friction import add_passive_torque
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("unbalance")
@dataclass(kw_only=True)
class Unbalance(JointEffect):
    """Gravity torque that the model lacks: τ = −A sin(q − q₀), of a part whose centre of mass lies beside its axis, or of a base
    that is mounted tilted. A = m g l cos β with the mass m that the joint moves, the distance l of its centre of mass from the
    axis and the inclination β of the axis from the horizontal; a vertical axis has β = 90° and A = 0, and A = m g l sin α if its
    base is tilted by α. At q = q₀ the centre of mass is lowest. Its inertia belongs to the inertia of the axis.

    A candidate for turning axes and for the hinges of robot files; l, and so A and q₀, change with the pose of the joints behind
    it. Implemented by the cogging term of a passive MuJoCo DC motor, with one period a turn. Efforts do not include the torque.
    """

    name: ClassVar = "unbalance"
    needs: ClassVar = ("position",)
    equation: ClassVar = "τ = −A sin(q − q₀)"
    in_words: ClassVar = (
        "The part that turns is heavier on one side than the model has it, or the base is mounted tilted: without friction it "
        "swings to the angle q₀ with the motor off, and hangs there."
    )
    at_a_policy: ClassVar = "The joint rests a little off its target, by an amount that goes around with its angle."
    to_record: ClassVar = "A slow triangle over half a turn or more; with the motor off the part shows q₀ by itself."
    near_twins: ClassVar = {
        "cable_spring": "Over a small range both are a slope in the angle; sweep half a turn, over which a weight bends back.",
        "gravity_mismatch": (
            "Of a joint that weight loads, a share of the known weight is an unbalance with the phase of that weight; in another "
            "pose of the other joints the share remains, an unbalance changes."
        ),
        "torque_ff": "Near its greatest torque a weight is a constant one; sweep over half a turn.",
    }
    torque_nm: float = parameter(
        unit="N·m",
        symbol="A",
        absent=0.0,
        low=0.0,
        high=10.0,
        typical=0.5,
        over="kp",
        source="a choice: 0.5 kg at 0.1 m",
    )
    hangs_at_rad: float = parameter(
        unit="rad",
        symbol="q₀",
        absent=None,
        low=-math.tau,
        high=math.tau,
        typical=0.0,
        source="a choice",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: sine and cosine of both signs, with a tenth of the largest commanded
        torque."""
        torque_nm = min(max(0.1 * seen.get("peak_torque_nm", 0.0), 1e-3), 10.0)
        angles = (0.0, math.pi / 2, math.pi, -math.pi / 2)
        return [{"torque_nm": torque_nm, "hangs_at_rad": angle} for angle in angles]

    def drive(self) -> dict[str, float]:
        return {
            "unbalance_sin": self.torque_nm * math.cos(self.hangs_at_rad),
            "unbalance_cos": -self.torque_nm * math.sin(self.hangs_at_rad),
        }

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            add_passive_torque(spec, name, "unbalance", cogging=[self.torque_nm, 1.0, math.pi - self.hangs_at_rad])
