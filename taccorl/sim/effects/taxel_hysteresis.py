"""Hysteresis: a taxel reads more while it is unloaded than while it is loaded, however slowly."""

from dataclasses import dataclass
from typing import ClassVar

import numba
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, parameter
from taccorl.sim.effects.touch_memory import RememberingEffect


@effects.register("taxel_hysteresis")
@dataclass(kw_only=True)
class TaxelHysteresis(RememberingEffect):
    """Hysteresis of the readings: r stays constant while (1 − h) f ≤ r ≤ (1 + h) f, and follows the limit that it reaches
    (Prandtl's play with a width in proportion to f).

    The reading is (1 − h) f during loading, (1 + h) f during unloading, and 0 without contact.
    """

    name: ClassVar = "taxel_hysteresis"
    layer: ClassVar = "material"
    windows: ClassVar = True
    holds_scan: ClassVar = False
    equation: ClassVar = "(1 − h) f ≤ r ≤ (1 + h) f, carried along at its ends"
    in_words: ClassVar = (
        "At the same depth a taxel reads more on the way out than on the way in, however slowly: rubber and foils "
        "stick."
    )
    at_a_policy: ClassVar = "It feels a firm grasp long after the fingers have begun to open."
    to_record: ClassVar = "Slow presses in and out with small to-and-fro in between."
    near_twins: ClassVar = {
        "taxel_creep": (
            "Both read more on the way out; hysteresis does so at any speed and stands still in a hold. Record a hold "
            "of 4 s."
        ),
        "taxel_play": (
            "Presses to one load have loops of the same height; the band of one grows with the load, that of the other is "
            "fixed. Press to three loads."
        ),
        "k_n": "While only pressing in, (1 − h) f is a smaller k_n; record the release as well.",
    }
    half_width: float = parameter(
        unit="1",
        symbol="h",
        absent=0.0,
        low=0.0,
        high=0.5,
        typical=0.1,
        source="a choice",
    )

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"held": np.zeros((num_sims, len(self.pads), *pad_shape), np.float32)}

    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        seen = np.empty(own.shape, own.dtype)  # in order, so that its flat form is a view
        flat = (*own.shape[:2], -1)
        held = memory["held"].reshape(own.shape[1], -1)
        low, high = np.float32(1.0 - self.half_width), np.float32(1.0 + self.half_width)
        _carry_along(own.reshape(flat), low, high, held, seen.reshape(flat))
        return seen


@numba.njit(cache=True)
def _carry_along(
    own: np.ndarray, low: float | np.float32, high: float | np.float32, held: np.ndarray, seen: np.ndarray
) -> None:
    """``held`` (N, K) is kept between ``low`` and ``high`` times ``own`` (S, N, K) in every scan."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                held[n, k] = min(max(held[n, k], low * own[s, n, k]), high * own[s, n, k])
                seen[s, n, k] = held[n, k]
