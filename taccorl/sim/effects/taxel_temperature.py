"""Temperature: gain and zero of a cell change with its temperature."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Kind, Memory, TouchEffect, parameter

NOMINAL_C = 20.0
"""Temperature at which the effect does nothing [°C]; simulations have this temperature."""


@effects.register("taxel_temperature")
@dataclass(kw_only=True)
class TaxelTemperature(TouchEffect):
    """Influence of the temperature ϑ on the readings: r = (1 + α (ϑ − 20 °C)) f + β (ϑ − 20 °C). ϑ is recorded together with the
    readings."""

    name: ClassVar = "taxel_temperature"
    needs: ClassVar = ("reading", "temperature")
    layer: ClassVar = "baseline"
    windows: ClassVar = True
    equation: ClassVar = "r = (1 + α (ϑ − 20 °C)) f + β (ϑ − 20 °C)"
    in_words: ClassVar = "Warmth changes how much a cell reads under the same load, and what it reads without any."
    at_a_policy: ClassVar = "Grip forces come out wrong once the hand has warmed up."
    to_record: ClassVar = "The same presses cold and warm, 5 K apart at least, with a column of the temperature."
    near_twins: ClassVar = {
        "baseline_drift": (
            "A steady rise of temperature and a drift in time are alike; record the temperature, and let it go up and down."
        ),
    }
    gain_per_k: float = parameter(
        unit="1/K",
        symbol="α",
        absent=0.0,
        low=-0.1,
        high=0.1,
        typical=0.005,
        source="a choice: half a per cent a kelvin",
    )
    zero_per_k: float = parameter(
        unit="reading/K",
        symbol="β",
        absent=0.0,
        low=-1.0,
        high=1.0,
        typical=0.02,
        source="a choice",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_nominal_k = np.zeros(1)

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        """Kinds of parts on which it can act; not pads, whose recordings hold no temperature."""
        return ("cells",)

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: gain up and down, zero up and down."""
        return [
            {"gain_per_k": 0.005, "zero_per_k": 0.0},
            {"gain_per_k": -0.005, "zero_per_k": 0.0},
            {"gain_per_k": 0.0, "zero_per_k": 0.02},
            {"gain_per_k": 0.0, "zero_per_k": -0.02},
        ]

    def at(self, temperature_c: np.ndarray) -> "TaxelTemperature":
        """The effect for readings (N, P, R, C) of N simulations at ``temperature_c`` (N,) [°C]."""
        found = copy.copy(self)
        found._above_nominal_k = np.asarray(temperature_c, dtype=float) - NOMINAL_C
        return found

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        warmer = self._above_nominal_k[:, None, None, None].astype(reading.dtype)
        gain, zero = reading.dtype.type(self.gain_per_k), reading.dtype.type(self.zero_per_k)
        own = reading[:, self.slots]
        reading = reading.copy()
        reading[:, self.slots] = own + warmer * (gain * own + zero)
        return reading
