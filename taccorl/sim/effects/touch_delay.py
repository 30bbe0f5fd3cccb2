"""Touch delay: frames of the pads arrive late."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numba
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, parameter
from taccorl.sim.effects.touch_memory import RememberingEffect

_GAP_S = 0.008  # readings closer than this are not kept beside each other; pads are scanned 100 times a second


@effects.register("touch_delay")
@dataclass(kw_only=True)
class TouchDelay(RememberingEffect):
    """Delay of the readings: r(t) = f(t − d), with linear interpolation between scans. Before the reset readings count as 0."""

    name: ClassVar = "touch_delay"
    layer: ClassVar = "taxel"
    holds_scan: ClassVar = False
    windows: ClassVar = True
    equation: ClassVar = "r(t) = f(t − d)"
    in_words: ClassVar = (
        "Touch is reported late: the board buffers, or its driver stamps a frame when it arrives, not when it was read."
    )
    at_a_policy: ClassVar = "What it feels belongs to an earlier picture; it overshoots at every contact."
    to_record: ClassVar = "Quick presses and releases, with the opening recorded on the same clock."
    near_twins: ClassVar = {
        "touch_lag": (
            "In slow presses both are late by the same time; quick ones keep their edges with a delay and lose them "
            "with a lag."
        ),
        "taxel_play": (
            "Ramps of one speed have loops of the same height; a delay's grows with the speed. Press at two speeds."
        ),
        "k_d": (
            "Late by d is f − d ḟ: less damping. Quick presses, and their release, where damping cannot read below 0."
        ),
    }
    delay_s: float = parameter(
        unit="s",
        symbol="d",
        absent=0.0,
        low=0.0,
        high=0.2,
        typical=0.03,
        source="a choice: three scans",
    )

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        kept = math.ceil(self.delay_s / _GAP_S) + 2
        return {
            "past": np.zeros((num_sims, kept, len(self.pads), *pad_shape), np.float32),
            "age_s": np.zeros((num_sims, kept)),
        }

    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        seen = np.empty(own.shape, own.dtype)  # in order, so that its flat form is a view
        flat = (*own.shape[:2], -1)
        past = memory["past"].reshape(*memory["past"].shape[:2], -1)
        _recall(
            own.reshape(flat), np.asarray(dt_s, float), past, memory["age_s"], float(self.delay_s), seen.reshape(flat)
        )
        return seen


@numba.njit(cache=True)
def _recall(
    own: np.ndarray, dt_s: np.ndarray, past: np.ndarray, age_s: np.ndarray, delay_s: float, seen: np.ndarray
) -> None:
    """``past`` (N, H, K), the newest first, takes up ``own`` (S, N, K); ``seen`` is what there was ``delay_s`` ago.

    A simulation that stands still (dt 0), and scans that follow each other quickly, replace the newest.
    """
    last = past.shape[1] - 1
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            is_apart = dt_s[s, n] > 0.0 and age_s[n, 1] - age_s[n, 0] >= _GAP_S
            age_s[n] += dt_s[s, n]
            if is_apart:
                for h in range(last, 0, -1):
                    age_s[n, h] = age_s[n, h - 1]
                    past[n, h] = past[n, h - 1]
            age_s[n, 0] = 0.0
            past[n, 0] = own[s, n]
            h = 0
            while h < last - 1 and age_s[n, h + 1] < delay_s:
                h += 1
            span = age_s[n, h + 1] - age_s[n, h]
            share = min((delay_s - age_s[n, h]) / span, 1.0) if span > 0.0 else 0.0
            for k in range(own.shape[2]):
                seen[s, n, k] = past[n, h, k] + share * (past[n, h + 1, k] - past[n, h, k])
