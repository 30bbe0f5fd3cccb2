"""Baseline drift: what a taxel reads without contact wanders off with time."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter


@effects.register("baseline_drift")
@dataclass(kw_only=True)
class BaselineDrift(TouchEffect):
    """Linear drift of the readings: r = f + b t, with the time t since the reset, at which the baseline was taken.

    A reading of 1 is 75 counts. Counts cannot fall below the converter's 0.
    """

    name: ClassVar = "baseline_drift"
    layer: ClassVar = "baseline"
    windows: ClassVar = True
    equation: ClassVar = "r = f + b t"
    in_words: ClassVar = (
        "What the pads read without contact wanders away from the zero taken at the start: warmth, and rubber "
        "that settles."
    )
    at_a_policy: ClassVar = "After minutes it feels contact that is not there, or misses the one that is."
    to_record: ClassVar = "5 s without contact at the beginning and at the end of a long recording."
    near_twins: ClassVar = {
        "taxel_temperature": (
            "A sensor that warms up steadily drifts in time, too; record the temperature, and let it go up and down."
        ),
        "taxel_creep": (
            "In one long hold both rise slowly; drift goes on without contact. Record 5 s of nothing before and after."
        ),
    }
    rate_per_min: float = parameter(
        unit="reading/min",
        symbol="b",
        absent=0.0,
        low=-2.0,
        high=2.0,
        typical=0.1,
        source="a choice: 7.5 counts a minute, half of the no-contact threshold in two",
    )

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        reading = reading.copy()
        drift = self.rate_per_min / 60.0 * time_s
        reading[:, self.slots] += drift[:, None, None, None].astype(reading.dtype)
        return reading
