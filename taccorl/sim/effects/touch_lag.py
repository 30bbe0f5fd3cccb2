"""Touch lag: the electronics low-pass the taxels' readings."""

from dataclasses import dataclass
from typing import ClassVar

import numba
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, parameter
from taccorl.sim.effects.touch_memory import RememberingEffect


@effects.register("touch_lag")
@dataclass(kw_only=True)
class TouchLag(RememberingEffect):
    """Low-pass of the readings: ṙ = (f − r) / T. Solved exactly for a reading that was constant since the last scan."""

    name: ClassVar = "touch_lag"
    layer: ClassVar = "taxel"
    windows: ClassVar = True
    equation: ClassVar = "ṙ = (f − r) / T"
    in_words: ClassVar = (
        "Readings rise and fall gradually after a touch that came at once: the board averages over scans."
    )
    at_a_policy: ClassVar = "It feels contact late and softened, so it presses on for some steps."
    to_record: ClassVar = "Quick presses and quick releases between holds."
    near_twins: ClassVar = {
        "touch_delay": (
            "In slow presses both are late by the same time; quick ones keep their edges with a delay and lose them "
            "with a lag."
        ),
        "taxel_play": (
            "Ramps of one speed have loops of the same height; a lag's grows with the speed. Press at two speeds."
        ),
        "k_d": (
            "A lag takes off what damping adds while a press deepens; quick presses, and their release, where damping "
            "cannot read below 0."
        ),
        "taxel_creep": (
            "Creep with a short time constant rises late, too, but only by a share; record holds of some seconds."
        ),
    }
    time_constant_s: float = parameter(
        unit="s",
        symbol="T",
        absent=0.0,
        low=0.0,
        high=0.5,
        typical=0.03,
        source="a choice: three scans",
    )

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"smooth": np.zeros((num_sims, len(self.pads), *pad_shape), np.float32)}

    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        seen = np.empty(own.shape, own.dtype)  # in order, so that its flat form is a view
        reached = -np.expm1(-dt_s / self.time_constant_s)
        flat = (*own.shape[:2], -1)
        _follow(
            own.reshape(flat), reached.astype(own.dtype), memory["smooth"].reshape(own.shape[1], -1), seen.reshape(flat)
        )
        return seen


@numba.njit(cache=True)
def _follow(own: np.ndarray, reached: np.ndarray, smooth: np.ndarray, seen: np.ndarray) -> None:
    """``smooth`` (N, K) goes the share ``reached`` (S, N) of its way to ``own`` (S, N, K) in every scan."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                smooth[n, k] += (own[s, n, k] - smooth[n, k]) * reached[s, n]
                seen[s, n, k] = smooth[n, k]
