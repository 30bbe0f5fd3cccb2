"""Unbalance: a turning part whose centre of mass is beside its axis."""

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
    """Gravity torque of a turning part whose centre of mass lies beside its axis, and that the model lacks: τ = −A sin(q − q₀).
    A = m g l, with the part's mass m and the distance l of its centre of mass from a horizontal axis (of an inclined axis A is
    smaller by the cosine of its inclination); at q = q₀ the centre of mass is below the axis. Its inertia belongs to the
    inertia of the axis.

    A candidate for axis files only: a robot file has the weight of its links, and ``payload``. Implemented by the cogging term of
    a passive MuJoCo DC motor, with one period a turn. Efforts do not include the torque.
    """

    name: ClassVar = "unbalance"
    needs: ClassVar = ("position",)
    equation: ClassVar = "τ = −A sin(q − q₀)"
    in_words: ClassVar = (
        "The part that turns is heavier on one side: with the motor off it swings to the angle q₀ and hangs there."
    )
    at_a_policy: ClassVar = "The joint rests a little off its target, by an amount that goes around with its angle."
    to_record: ClassVar = "A slow triangle over half a turn or more; with the motor off the part shows q₀ by itself."
    near_twins: ClassVar = {
        "cable_spring": "Over a small range both are a slope in the angle; sweep half a turn, over which a weight bends back.",
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
