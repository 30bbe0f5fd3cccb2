"""Threshold: a taxel reads nothing until it is pressed by so much."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter


@effects.register("taxel_threshold")
@dataclass(kw_only=True)
class TaxelThreshold(TouchEffect):
    """Threshold of the readings: r = [f − t]₊, because foils touch each other only from t on, or because a driver cuts off small
    values."""

    name: ClassVar = "taxel_threshold"
    layer: ClassVar = "material"
    windows: ClassVar = True
    equation: ClassVar = "r = [f − t]₊"
    in_words: ClassVar = "A light touch does not show: the foils of a taxel must first be pressed together."
    at_a_policy: ClassVar = "It feels contact too late and its patch too small."
    to_record: ClassVar = "Slow light presses with a ball, whose rim shows what a light touch reads."
    near_twins: ClassVar = {
        "depth_offset": (
            "A pad that stands back is touched later, too; its rate is felt in full where a dead zone also takes off "
            "of it. Press at two speeds."
        ),
        "taxel_play": "While only pressing in, both take the same off every load; record the release as well.",
        "taxel_power_law": "p > 1 also hides light touches; press to three depths.",
    }
    threshold: float = parameter(
        unit="reading",
        symbol="t",
        absent=0.0,
        low=0.0,
        high=3.0,
        typical=0.1,
        source="a choice: 7.5 counts, half of the boards' own no-contact threshold",
    )

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own = reading[:, self.slots]
        reading = reading.copy()
        reading[:, self.slots] = np.maximum(own - reading.dtype.type(self.threshold), 0)
        return reading
