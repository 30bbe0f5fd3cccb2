"""Creep: under a constant load, a taxel’s reading continues to change."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from taccorl.sim.effects import effects
from taccorl.sim.effects.creep import CreepingEffect
from taccorl.sim.effects.effect import parameter


@effects.register("taxel_creep")
@dataclass(kw_only=True)
class TaxelCreep(CreepingEffect):
    """Creep of the readings: r = f + a m with ṁ = (f − m) / τ. The reading is f at once and (1 + a) f after a long time; after
    release a m remains and decays.

    Standard linear solid. a < 0 is relaxation: the reading decreases under a constant load. Readings do not fall below 0,
    unless ``below_rest``.
    """

    name: ClassVar = "taxel_creep"
    layer: ClassVar = "material"
    windows: ClassVar = True
    equation: ClassVar = "r = f + a m, ṁ = (f − m) / τ"
    in_words: ClassVar = (
        "Under a load that stays, the reading goes on rising or sinking for seconds: rubber and foils flow."
    )
    at_a_policy: ClassVar = "A grasp that is held feels as if it tightened or slipped, and the policy answers to that."
    to_record: ClassVar = "A press that is held for 4 s or longer, and 5 s of nothing after its release."
    near_twins: ClassVar = {
        "taxel_log_creep": (
            "Over a few seconds both bend alike; logarithmic creep goes on for minutes. Record a hold of 30 s or longer."
        ),
        "taxel_hysteresis": (
            "Both read more on the way out; creep goes on in a hold and fades after. Record a hold of 4 s."
        ),
        "taxel_play": ("Both read more on the way out; creep goes on in a hold and fades after. Record a hold of 4 s."),
        "touch_lag": (
            "Creep with a short time constant rises late, too, but only by a share; record holds of some seconds."
        ),
        "baseline_drift": (
            "In one long hold both rise slowly; drift goes on without contact. Record 5 s of nothing before and after."
        ),
    }
    share: float = parameter(
        unit="1",
        symbol="a",
        absent=0.0,
        low=-0.8,
        high=2.0,
        typical=0.2,
        source="fitted to a Velostat taxel: 0.29 in 0.77 s (Lupasic/tactile-sensor-velostat)",
    )
    time_constant_s: float = parameter(
        unit="s",
        symbol="τ",
        absent=None,
        low=0.05,
        high=30.0,
        typical=0.8,
        source="the same Velostat taxel",
    )

    @property
    def times_s(self) -> tuple[float, ...]:
        return (self.time_constant_s,)

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: a fast increase, a slow increase, a decrease."""
        return [
            {"share": 0.3, "time_constant_s": 0.3},
            {"share": 0.3, "time_constant_s": 3.0},
            {"share": -0.3, "time_constant_s": 1.0},
        ]
