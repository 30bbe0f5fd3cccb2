"""Saturation: pressed ever harder, a taxel’s reading approaches a limit."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter


@effects.register("taxel_saturation")
@dataclass(kw_only=True)
class TaxelSaturation(TouchEffect):
    """Saturation of the taxels: r = f / (1 + f / f_s), which is the output of a voltage divider whose other resistor equals the
    taxel's at f = f_s. r remains below f_s."""

    name: ClassVar = "taxel_saturation"
    layer: ClassVar = "material"
    windows: ClassVar = True
    equation: ClassVar = "r = f / (1 + f / f_s)"
    in_words: ClassVar = (
        "The harder a taxel is pressed, the less its reading grows: its voltage divider runs out of range."
    )
    at_a_policy: ClassVar = "Firm and crushing grasps look alike, so it does not ease off."
    to_record: ClassVar = "Presses and holds at three depths, one of them as hard as the task ever gets."
    near_twins: ClassVar = {
        "taxel_power_law": (
            "Both bend the same way over a narrow range of depth; press to three depths, a light one included."
        ),
        "k_n": "At one depth it is a smaller k_n; press to three depths.",
    }
    limit: float = parameter(
        unit="reading",
        symbol="f_s",
        absent=math.inf,
        low=0.05,
        high=2000.0,
        typical=4.0,
        source="a choice: 300 counts, above what the converter sends; resistive taxels saturate by their voltage divider",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: strong and weak saturation relative to the largest reading in the
        recordings (``peak_reading``).
        """
        peak = seen.get("peak_reading", 1.0)
        return [{"limit": float(np.clip(share * peak, 0.05, 2000.0))} for share in (1.0, 4.0)]

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own = reading[:, self.slots]
        reading = reading.copy()
        reading[:, self.slots] = own / (1.0 + np.abs(own) / reading.dtype.type(self.limit))
        return reading
