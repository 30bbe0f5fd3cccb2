"""Creep: under a load that stays, a taxel’s reading goes on changing."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter
from taccorl.sim.robot import PAD_TAXELS


@effects.register("taxel_creep")
@dataclass(kw_only=True)
class TaxelCreep(TouchEffect):
    """r = f + a m with ṁ = (f − m) / τ: at once f, at length (1 + a) f; after release a m remains for a while.

    Standard linear solid. a < 0 is relaxation: the reading sinks under a load that stays; what falls below 0 is cut off.

    ṁ is solved exactly for a reading that has stood since the last scan.
    """

    name: ClassVar = "taxel_creep"
    layer: ClassVar = "material"
    share: float = parameter(
        unit="1",
        symbol="a",
        absent=0.0,
        low=-0.8,
        high=2.0,
        typical=0.2,
        source="a Velostat taxel: 0.29 in 0.77 s, research/discrepancy.md §4.6",
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

    def memory(self, num_sims: int) -> Memory:
        return {"crept": np.zeros((num_sims, len(self.pads), *PAD_TAXELS), np.float32)}

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own, crept = reading[:, self.slots], memory["crept"]
        reached = -np.expm1(-dt_s / self.time_constant_s)
        crept += (own - crept) * reached[:, None, None, None].astype(np.float32)
        reading = reading.copy()
        reading[:, self.slots] = np.maximum(own + self.share * crept, 0)
        return reading
