"""Power law: a taxel’s reading is not in proportion to what presses on it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter


@effects.register("taxel_power_law")
@dataclass(kw_only=True)
class TaxelPowerLaw(TouchEffect):
    """Nonlinear characteristic of the taxels: r = f₀ (f / f₀)^p. Readings equal to f₀ do not change.

    p > 1 is steeper at high pressure, as for a ball on a soft half-space (Hertz); p < 1 is flatter, as for resistive foils.
    """

    name: ClassVar = "taxel_power_law"
    layer: ClassVar = "material"
    windows: ClassVar = True
    equation: ClassVar = "r = f₀ (f / f₀)^p"
    in_words: ClassVar = (
        "A taxel's reading is not in proportion to the pressure: foils flatten out, soft covers stiffen."
    )
    at_a_policy: ClassVar = (
        "Light touches read too much and firm ones too little, or the reverse, so grip forces come out wrong."
    )
    to_record: ClassVar = "Presses and holds at three depths, a light one included."
    near_twins: ClassVar = {
        "taxel_saturation": (
            "Both bend the same way over a narrow range of depth; press to three depths, a light one included."
        ),
        "taxel_threshold": "p > 1 also hides light touches; press to three depths.",
        "k_n": "At one depth it is another k_n; press to three depths.",
    }
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
        unit="reading",
        symbol="f₀",
        absent=None,
        low=0.1,
        high=10.0,
        typical=1.0,
        source="a choice: where the linear law was calibrated; a reading of 1 is 75 counts",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: steeper and flatter. The reference f₀ has one start only, because
        changing it is equivalent to changing k_n.
        """
        return [{"exponent": 1.4}, {"exponent": 0.75}]

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own = reading[:, self.slots]
        with np.errstate(divide="ignore", invalid="ignore"):  # 0 and less to a power, where nothing touches
            factor = np.where(own > 0, (own / self.reference) ** (self.exponent - 1.0), 1.0)
        reading = reading.copy()
        reading[:, self.slots] = own * factor
        return reading
