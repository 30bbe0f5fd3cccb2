"""Dead taxels: some never read anything."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import BoardEffect, Memory, parameter


@effects.register("dead_taxels")
@dataclass(kw_only=True)
class DeadTaxels(BoardEffect):
    """Taxels that always read 0: a share of each pad's taxels, drawn once from ``seed``. The dead taxels of a smaller share are
    also dead at a greater one."""

    name: ClassVar = "dead_taxels"
    layer: ClassVar = "taxel"
    equation: ClassVar = "r_i = 0 for a share s of the taxels"
    in_words: ClassVar = "Some taxels never read anything: a broken trace or a cold solder joint."
    at_a_policy: ClassVar = "A hole in the contact looks like an edge or a smaller part."
    to_record: ClassVar = "Presses that cover every taxel: a flat plate, or a rod rolled over the pad."
    near_twins: ClassVar = {
        "taxel_gain_map": "The same thing, as it was measured on one board; this one draws other boards like it.",
    }
    share: float = parameter(
        unit="1",
        symbol="s",
        absent=0.0,
        low=0.0,
        high=1.0,
        typical=0.05,
        source="a choice",
    )

    def dead(self, shape: tuple[int, int, int]) -> np.ndarray:
        """(pads, rows, columns) bool, of the given ``shape``: round(s · taxels) dead taxels of each pad, also of pads that are
        not selected."""
        num_pads, num_taxels = shape[0], math.prod(shape[1:])
        rank = np.random.default_rng(self.seed).permuted(np.tile(np.arange(num_taxels), (num_pads, 1)), axis=1)
        return (rank < round(self.share * num_taxels)).reshape(shape)

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        reading = reading.copy()
        reading[:, self.slots] *= ~self.dead(reading.shape[1:])[self.slots]
        return reading
