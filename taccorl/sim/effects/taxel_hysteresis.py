"""Hysteresis: a taxel reads more while it is unloaded than while it is loaded, however slowly."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter
from taccorl.sim.robot import PAD_TAXELS


@effects.register("taxel_hysteresis")
@dataclass(kw_only=True)
class TaxelHysteresis(TouchEffect):
    """r stays while (1 − h) f ≤ r ≤ (1 + h) f, and is carried along at these ends: Prandtl's play, its width in proportion to f.

    Loading reads (1 − h) f, unloading (1 + h) f, and nothing is left without contact.
    """

    name: ClassVar = "taxel_hysteresis"
    layer: ClassVar = "material"
    half_width: float = parameter(
        unit="1",
        symbol="h",
        absent=0.0,
        low=0.0,
        high=0.5,
        typical=0.1,
        source="a choice",
    )

    def memory(self, num_sims: int) -> Memory:
        return {"held": np.zeros((num_sims, len(self.pads), *PAD_TAXELS), np.float32)}

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own, held = reading[:, self.slots], memory["held"]
        np.clip(held, (1.0 - self.half_width) * own, (1.0 + self.half_width) * own, out=held)
        reading = reading.copy()
        reading[:, self.slots] = held
        return reading
