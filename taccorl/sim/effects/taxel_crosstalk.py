"""Crosstalk: a taxel passes a part of its reading to its neighbours."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter


@effects.register("taxel_crosstalk")
@dataclass(kw_only=True)
class TaxelCrosstalk(TouchEffect):
    """Crosstalk between neighbouring taxels of a row or column: r = f + c/4 Σ (f_neighbour − f). A taxel keeps 1 − c of its
    reading and adds c/4 of it to each neighbour.

    At the edge a taxel keeps the shares of missing neighbours, so that the sum over a pad does not change.
    """

    name: ClassVar = "taxel_crosstalk"
    needs: ClassVar = ("reading", "neighbours")
    layer: ClassVar = "spread"
    windows: ClassVar = True
    equation: ClassVar = "r = f + c/4 Σ (f_neighbour − f)"
    in_words: ClassVar = "The picture of touch is blurred: covers carry load sideways, and neighbours share wires."
    at_a_policy: ClassVar = "Edges are soft and small parts look wide, so it aligns them less exactly."
    to_record: ClassVar = "A ball pressed lightly: few taxels, with the rim of the patch in view."
    near_twins: ClassVar = {
        "taxel_ghosting": (
            "Within a patch both fill up its rim; the taxels far away in its rows and columns tell: record whole pads."
        ),
    }
    share: float = parameter(
        unit="1",
        symbol="c",
        absent=0.0,
        low=0.0,
        high=0.8,
        typical=0.1,
        source="a choice; covers carry load sideways, taxels share wires",
    )

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own = reading[:, self.slots]
        spread = own.copy()
        for axis in (2, 3):
            flow = 0.25 * self.share * np.diff(own, axis=axis)  # from each taxel's next one into it
            head, tail = [slice(None)] * 4, [slice(None)] * 4
            head[axis], tail[axis] = slice(None, -1), slice(1, None)
            spread[tuple(head)] += flow
            spread[tuple(tail)] -= flow
        reading = reading.copy()
        reading[:, self.slots] = spread
        return reading
