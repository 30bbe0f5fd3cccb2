"""Pad shift: the film of taxels sits off its place on the finger."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import parameter
from taccorl.sim.effects.pad_frame import PadFrameEffect


@effects.register("pad_shift")
@dataclass(kw_only=True)
class PadShift(PadFrameEffect):
    """Displacement of the taxels on the pad: each taxel reads what is s further along x of the TCP (across the hand) and t
    further towards the finger tips. The rubber is not displaced.

    On both pads of a hand, an object that is displaced by (−s, −t) from its assumed position has the same effect.
    """

    name: ClassVar = "pad_shift"
    equation: ClassVar = "δ(x, z) = δ_model(x + s, z + t), x and z of the TCP"
    in_words: ClassVar = (
        "The whole picture of touch is moved across the pad: the film was glued on a millimetre off its place."
    )
    at_a_policy: ClassVar = (
        "It sees the part somewhere else in the hand than it is and corrects an error that is not there."
    )
    to_record: ClassVar = "Presses with a ball at known places of the pad, near its edges too."
    near_twins: ClassVar = {
        "taxel_gain_map": "At one place of contact a slope of gains looks like a shift; press at several places.",
    }
    across_m: float = parameter(
        unit="m",
        symbol="s",
        absent=0.0,
        low=-6e-3,
        high=6e-3,
        typical=2e-3,
        source="a choice: a taxel",
    )
    along_m: float = parameter(
        unit="m",
        symbol="t",
        absent=0.0,
        low=-6e-3,
        high=6e-3,
        typical=2e-3,
        source="a choice: a taxel",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: half a taxel in each direction. At larger shifts contact areas
        that do not overlap give no gradient.
        """
        half = 1e-3
        return [
            {"across_m": half, "along_m": 0.0},
            {"across_m": -half, "along_m": 0.0},
            {"across_m": 0.0, "along_m": half},
            {"across_m": 0.0, "along_m": -half},
        ]

    def offset_pad_m(self, pad: str) -> np.ndarray:
        side = 1.0 if pad.endswith("_a") else -1.0
        return np.array([side * self.across_m, self.along_m, 0.0])
