"""Cogging: a torque that comes back many times a turn."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.dry_friction import add_passive_torque
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

_MOST_PERIODS, _MOST_STARTS = 60.0, 32  # where a search for it ends; enough for a span of π


@effects.register("cogging")
@dataclass(kw_only=True)
class Cogging(JointEffect):
    """Cogging torque of the motor's magnets or of gear teeth: τ = +A sin(N q + φ), with N periods per turn of the joint.

    Implemented by the cogging term of a passive MuJoCo DC motor. Efforts do not include the torque.
    """

    name: ClassVar = "cogging"
    needs: ClassVar = ("position",)
    equation: ClassVar = "τ = A sin(N q + φ)"
    in_words: ClassVar = (
        "Magnets against slots, tooth after tooth: turned slowly by hand the joint clicks through the same places."
    )
    at_a_policy: ClassVar = (
        "The hand trembles in slow motion, and rests a little off in a pattern over the joint's angle."
    )
    to_record: ClassVar = "One slow sweep over the whole range, there and back: the pattern stays where it is."
    near_twins: ClassVar = {}
    torque_nm: float = parameter(
        unit="N·m",
        symbol="A",
        absent=0.0,
        low=0.0,
        high=5.0,
        typical=0.3,
        over="kp",
        source="a choice: as much as friction",
    )
    periods: float = parameter(
        unit="1",
        symbol="N",
        absent=None,
        low=6.0,
        high=200.0,
        typical=24.0,
        source="a choice: fewer are weight or a cable; of the joint's turn, so a gear's ratio times the motor's periods",
    )
    phase_rad: float = parameter(
        unit="rad",
        symbol="φ",
        absent=None,
        low=-math.tau,
        high=math.tau,
        typical=0.0,
        source="a choice",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: sine and cosine of both signs; numbers of periods in steps of half
        the resolution of a recording over ``span_rad``, from half a period in this range on; amplitude a twentieth of the torque
        that the controller commands. Where the recordings span many turns, the numbers of periods are ``wave_periods_1`` …
        instead, the phases ``wave_phase_1`` … and π/4 to both sides.
        """
        apart = max(0.5 * math.pi / max(seen["span_rad"], 0.05), _MOST_PERIODS / _MOST_STARTS)
        periods = np.arange(min(max(2 * apart, 6.0), _MOST_PERIODS), _MOST_PERIODS + 1e-9, apart)
        torque_nm = float(np.clip(0.05 * seen["peak_torque_nm"], 1e-3, 5.0))
        phases = (0.0, math.pi / 2, math.pi, -math.pi / 2)
        waves = [(seen[f"wave_periods_{k}"], seen[f"wave_phase_{k}"]) for k in (1, 2, 3) if f"wave_periods_{k}" in seen]
        if waves:
            return [
                {"torque_nm": torque_nm, "periods": n, "phase_rad": math.remainder(phase + turn, math.tau)}
                for n, phase in waves
                for turn in (0.0, *(0.25 * math.pi * side for side in (-1, 1)))
            ]
        return [{"torque_nm": torque_nm, "periods": float(n), "phase_rad": phase} for n in periods for phase in phases]

    def drive(self) -> dict[str, float]:
        return {
            "cogging_torque": self.torque_nm,
            "cogging_periods": self.periods,
            "cogging_phase": self.phase_rad,
        }

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            add_passive_torque(spec, name, "cogging", cogging=[self.torque_nm, self.periods, self.phase_rad])
