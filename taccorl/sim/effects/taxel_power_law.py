"""Power law: a taxel’s reading is not in proportion to what presses on it."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter


@effects.register("taxel_power_law")
@dataclass(kw_only=True)
class TaxelPowerLaw(TouchEffect):
    """r = f₀ (f / f₀)^p. Readings of f₀ stay as they are.

    p > 1 is steeper where pressed hard, as a ball on a soft half-space (Hertz); p < 1 is flatter, as resistive foils.
    """

    name: ClassVar = "taxel_power_law"
    layer: ClassVar = "material"
    exponent: float = parameter(
        unit="1",
        symbol="p",
        absent=1.0,
        low=0.3,
        high=3.0,
        typical=1.5,
        source="Hertz: 3/2 for a ball on a half-space",
    )
    reference: float = parameter(
        unit="1",
        symbol="f₀",
        absent=None,
        low=0.1,
        high=10.0,
        typical=1.0,
        source="a choice: where the linear law was calibrated; a reading of 1 is 75 counts",
    )

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own = reading[:, self.slots]
        with np.errstate(divide="ignore"):  # 0 to a negative power, where nothing touches
            factor = np.where(own > 0, (own / self.reference) ** (self.exponent - 1.0), 1.0)
        reading = reading.copy()
        reading[:, self.slots] = own * factor
        return reading
