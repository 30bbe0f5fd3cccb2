"""Gain spread: no two taxels read the same under the same load."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import BoardEffect, Memory, parameter


@effects.register("taxel_gain_spread")
@dataclass(kw_only=True)
class TaxelGainSpread(BoardEffect):
    """Random gain of each taxel: r_i = g_i f_i, where ln g_i is normally distributed with mean 0 and standard deviation s, drawn
    once from ``seed``."""

    name: ClassVar = "taxel_gain_spread"
    layer: ClassVar = "taxel"
    equation: ClassVar = "r_i = g_i f_i, ln g_i ~ N(0, s²)"
    in_words: ClassVar = "No two taxels read the same under the same pressure: foils and solder joints differ."
    at_a_policy: ClassVar = "Textures appear on plain contacts and differ from board to board."
    to_record: ClassVar = (
        "Presses that cover every taxel at several depths: a flat plate, or a rod rolled over the pad."
    )
    near_twins: ClassVar = {
        "taxel_gain_map": "The same thing, as it was measured on one board; this one draws other boards like it.",
    }
    log_std: float = parameter(
        unit="1",
        symbol="s",
        absent=0.0,
        low=0.0,
        high=0.7,
        typical=0.15,
        source="a choice",
    )

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        log_gain = np.random.default_rng(self.seed).standard_normal(reading.shape[1:])[self.slots]
        reading = reading.copy()
        reading[:, self.slots] *= np.exp(self.log_std * log_gain).astype(reading.dtype)
        return reading
