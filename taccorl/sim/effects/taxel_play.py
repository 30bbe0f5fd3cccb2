"""Play: a taxel’s reading follows the load only once that has gone back by a fixed width."""

from dataclasses import dataclass
from typing import ClassVar

import numba
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Kind, Memory, parameter
from taccorl.sim.effects.touch_memory import RememberingEffect


@effects.register("taxel_play")
@dataclass(kw_only=True)
class TaxelPlay(RememberingEffect):
    """Hysteresis of fixed width: r stays constant while |f − r| ≤ w, and is carried along at the ends of this band (Prandtl's
    play operator).

    The reading is f − w during loading and f + w during unloading, at any speed, and w remains after release. A band in
    proportion to the load is ``taxel_hysteresis``. A search looks for it in sensors of cells only: pads were studied without it.
    Noise of a measured load widens the fitted band by about half of its standard deviation.
    """

    name: ClassVar = "taxel_play"
    layer: ClassVar = "material"
    windows: ClassVar = True
    holds_scan: ClassVar = False
    equation: ClassVar = "f − w ≤ r ≤ f + w, carried along at its ends"
    in_words: ClassVar = (
        "Readings on the way out lie above those on the way in by the same amount at every load, however slowly: a "
        "cover that sticks, or a spring with friction."
    )
    at_a_policy: ClassVar = "Small changes of a grasp do not show, and some of the touch stays after the release."
    to_record: ClassVar = "Slow presses to three loads at two speeds, with small to-and-fro in between."
    near_twins: ClassVar = {
        "taxel_hysteresis": (
            "Presses to one load have loops of the same height; the band of one is fixed, that of the other grows with "
            "the load. Press to three loads."
        ),
        "taxel_creep": (
            "Both read more on the way out; play does so at any speed and stands still in a hold. Record a hold of 4 s."
        ),
        "taxel_threshold": ("While only pressing in, both take the same off every load; record the release as well."),
        "touch_lag": (
            "Ramps of one speed have loops of the same height; a lag's grows with the speed. Press at two speeds."
        ),
        "touch_delay": (
            "Ramps of one speed have loops of the same height; a delay's grows with the speed. Press at two speeds."
        ),
    }
    half_width: float = parameter(
        unit="reading",
        symbol="w",
        absent=0.0,
        low=0.0,
        high=3.0,
        typical=0.2,
        source="a choice: 2 % of the rated load of a sensor of cells",
    )

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        return ("cells",)

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"held": np.zeros((num_sims, len(self.pads), *pad_shape), np.float32)}

    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        seen = np.empty(own.shape, own.dtype)  # in order, so that its flat form is a view
        flat = (*own.shape[:2], -1)
        _carry_along(
            own.reshape(flat), np.float32(self.half_width), memory["held"].reshape(own.shape[1], -1), seen.reshape(flat)
        )
        return seen


@numba.njit(cache=True)
def _carry_along(own: np.ndarray, half_width: float | np.float32, held: np.ndarray, seen: np.ndarray) -> None:
    """``held`` (N, K) is kept within ``half_width`` of ``own`` (S, N, K) in every scan."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                held[n, k] = min(max(held[n, k], own[s, n, k] - half_width), own[s, n, k] + half_width)
                seen[s, n, k] = held[n, k]
