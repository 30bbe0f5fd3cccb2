"""Gain map: each taxel's own gain, as it was measured; dead taxels are those of gain 0."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Kind, Memory, TouchEffect, parameter


@effects.register("taxel_gain_map")
@dataclass(kw_only=True)
class TaxelGainMap(TouchEffect):
    """Gain of each taxel: r_i = (1 + s (g_i − 1)) f_i, with the known gains g_i of these boards. ``taxel_gain_spread`` draws
    gains of similar boards instead."""

    name: ClassVar = "taxel_gain_map"
    layer: ClassVar = "taxel"
    equation: ClassVar = "r_i = g_i f_i"
    in_words: ClassVar = (
        "Under the same pressure some taxels always read more than others, and some nothing: foils and solder "
        "joints differ."
    )
    at_a_policy: ClassVar = "Textures appear on plain contacts; a dead taxel looks like an edge."
    to_record: ClassVar = (
        "Presses that cover every taxel at several depths: a flat plate, or a rod rolled over the pad."
    )
    near_twins: ClassVar = {
        "taxel_gain_spread": (
            "The same thing, drawn for boards that were not measured; the map is for the board that was."
        ),
        "dead_taxels": "The same thing, drawn for boards that were not measured; in the map they have gain 0.",
        "pad_shift": "At one place of contact a slope of gains looks like a shift; press at several places.",
    }
    share: float = parameter(
        unit="1",
        symbol="s",
        absent=0.0,
        low=0.0,
        high=1.0,
        typical=1.0,
        source="1 is the map as it was measured; less fades it out",
    )
    gains: list[float] = field(default_factory=lambda: [0.0])
    """g_i: one gain per taxel, row after row from palm to tip, pad after pad; or one gain for all. The default 0 is a pad that
    is not connected."""

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        """Kinds of parts on which it can act; not a sensor of cells, whose gains are always fitted."""
        return ("pads",)

    def __post_init__(self) -> None:
        super().__post_init__()
        expected = len(self.pads) * ROBOT.pad.num_taxels
        if len(self.gains) not in (1, expected):
            raise TaccorlError(
                f"effect {self.name}: there are {len(self.gains)} gains, but the pads {', '.join(self.pads)} have {expected} "
                "taxels: give one gain per taxel, or one for all"
            )
        bad = [g for g in self.gains if isinstance(g, bool) or not isinstance(g, int | float | np.number)]
        bad += [g for g in self.gains if not bad and not 0 <= g < math.inf]
        if bad:
            raise TaccorlError(f"effect {self.name}: gains contain {bad[0]!r}; give numbers of 0 or more")
        self.gains = [float(g) for g in self.gains]
        self._window = (slice(None), slice(None))

    @classmethod
    def of(cls, gains: np.ndarray, pads: Sequence[str]) -> "TaxelGainMap":
        """The effect with the gains (P, R, C), rounded to six digits."""
        return cls(share=1.0, pads=list(pads), gains=np.round(np.asarray(gains, float), 6).reshape(-1).tolist())

    def within(self, window: tuple[slice, slice]) -> "TaxelGainMap":
        found = copy.copy(self)
        found._window = window
        return found

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        gains = np.broadcast_to(self.gains, len(self.pads) * ROBOT.pad.num_taxels).reshape(-1, *ROBOT.pad.shape)
        gains = gains[:, *self._window]
        reading = reading.copy()
        reading[:, self.slots] *= (1.0 + self.share * (gains - 1.0)).astype(reading.dtype)
        return reading
