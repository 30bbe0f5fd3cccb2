"""Ghosting: taxels share the wires of their row and column, and currents find ways around."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter


@effects.register("taxel_ghosting")
@dataclass(kw_only=True)
class TaxelGhosting(TouchEffect):
    """Ghosting along the wires of rows and columns: r_ij = f_ij + g (Σ_k f_ik + Σ_k f_kj − 2 f_ij). Every other taxel on a
    taxel's two wires adds the share g of its reading."""

    name: ClassVar = "taxel_ghosting"
    needs: ClassVar = ("reading", "neighbours")
    layer: ClassVar = "spread"
    windows: ClassVar = True
    equation: ClassVar = "r_ij = f_ij + g (Σ_{k≠j} f_ik + Σ_{k≠i} f_kj)"
    in_words: ClassVar = (
        "A faint cross through the place of contact: a pressed taxel shows on all others of its row and of its column, "
        "because a matrix is read through shared wires."
    )
    at_a_policy: ClassVar = "It sees contact where there is none and takes a point for a cross or a bar."
    to_record: ClassVar = "A ball pressed in, with the whole pad recorded, not only the patch."
    near_twins: ClassVar = {
        "taxel_crosstalk": (
            "Within a patch both fill up its rim; the taxels far away in its rows and columns tell: record whole pads."
        ),
    }
    share: float = parameter(
        unit="1",
        symbol="g",
        absent=0.0,
        low=0.0,
        high=0.2,
        typical=0.01,
        source="a choice; some 5 to 20 taxels of a row are pressed at once",
    )

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own = reading[:, self.slots]
        others = own.sum(axis=3, keepdims=True) + own.sum(axis=2, keepdims=True) - 2 * own
        reading = reading.copy()
        reading[:, self.slots] = own + reading.dtype.type(self.share) * others
        return reading
