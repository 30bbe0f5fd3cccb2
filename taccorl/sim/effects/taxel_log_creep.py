"""Logarithmic creep: under a load that stays, a reading goes on changing by as much from 1 to 10 s as from 10 to 100 s."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from taccorl.sim.effects import effects
from taccorl.sim.effects.creep import CreepingEffect
from taccorl.sim.effects.effect import Kind, parameter

TIMES_S = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""Time constants of the parts whose sum is logarithmic creep (a Prony series, one part for each decade of time)."""


@effects.register("taxel_log_creep")
@dataclass(kw_only=True)
class TaxelLogCreep(CreepingEffect):
    """Creep over many time scales: r = f + a Σ mᵢ with ṁᵢ = (f − mᵢ) / τᵢ, τᵢ = 0.1 s … 1000 s. After t seconds of load r is
    about (1 + a log₁₀(t / 0.06 s)) f.

    a < 0 is relaxation. Readings do not fall below 0, unless ``below_rest``.
    """

    name: ClassVar = "taxel_log_creep"
    layer: ClassVar = "material"
    windows: ClassVar = True
    equation: ClassVar = "r = f + a Σ mᵢ, ṁᵢ = (f − mᵢ) / τᵢ, τᵢ = 0.1, 1, 10, 100, 1000 s"
    in_words: ClassVar = (
        "Under a load that stays, the reading changes by as much in each tenfold of time: rubber, carbon-filled foils."
    )
    at_a_policy: ClassVar = (
        "A long hold seems to tighten for minutes, and what is felt after it depends on how long it was."
    )
    to_record: ClassVar = "A press that is held for 30 s or longer, and 20 s of nothing after its release."
    near_twins: ClassVar = {
        "taxel_creep": (
            "Over a few seconds both bend alike; creep with one time constant ends. Record a hold of 30 s or longer."
        ),
    }
    share: float = parameter(
        unit="1",
        symbol="a",
        absent=0.0,
        low=-0.15,
        high=0.3,
        typical=0.05,
        source="a choice: 5 % a decade",
    )

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        """Kinds of parts on which it can act; not pads, whose presses are too short to tell it from ``taxel_creep``."""
        return ("cells",)

    @property
    def times_s(self) -> tuple[float, ...]:
        return TIMES_S

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: an increase and a decrease."""
        return [{"share": 0.05}, {"share": -0.05}]
