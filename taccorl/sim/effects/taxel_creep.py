"""Creep: under a constant load, a taxel’s reading continues to change."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numba
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, parameter
from taccorl.sim.effects.touch_memory import RememberingEffect


@effects.register("taxel_creep")
@dataclass(kw_only=True)
class TaxelCreep(RememberingEffect):
    """Creep of the readings: r = f + a m with ṁ = (f − m) / τ. The reading is f at once and (1 + a) f after a long time; after
    release a m remains and decays.

    Standard linear solid. a < 0 is relaxation: the reading decreases under a constant load. Readings do not fall below 0,
    unless ``below_rest``.

    The equation is solved exactly for a reading that was constant since the last scan.
    """

    name: ClassVar = "taxel_creep"
    layer: ClassVar = "material"
    windows: ClassVar = True
    equation: ClassVar = "r = f + a m, ṁ = (f − m) / τ"
    in_words: ClassVar = (
        "Under a load that stays, the reading goes on rising or sinking for seconds: rubber and foils flow."
    )
    at_a_policy: ClassVar = "A grasp that is held feels as if it tightened or slipped, and the policy answers to that."
    to_record: ClassVar = "A press that is held for 4 s or longer, and 5 s of nothing after its release."
    near_twins: ClassVar = {
        "taxel_log_creep": (
            "Over a few seconds both bend alike; logarithmic creep goes on for minutes. Record a hold of 30 s or longer."
        ),
        "taxel_hysteresis": (
            "Both read more on the way out; creep goes on in a hold and fades after. Record a hold of 4 s."
        ),
        "taxel_play": ("Both read more on the way out; creep goes on in a hold and fades after. Record a hold of 4 s."),
        "touch_lag": (
            "Creep with a short time constant rises late, too, but only by a share; record holds of some seconds."
        ),
        "baseline_drift": (
            "In one long hold both rise slowly; drift goes on without contact. Record 5 s of nothing before and after."
        ),
    }
    below_rest: bool = False
    """True: after a release readings may be below 0 where a < 0; for sensors whose reading at rest is no lower end."""
    share: float = parameter(
        unit="1",
        symbol="a",
        absent=0.0,
        low=-0.8,
        high=2.0,
        typical=0.2,
        source="fitted to a Velostat taxel: 0.29 in 0.77 s (Lupasic/tactile-sensor-velostat)",
    )
    time_constant_s: float = parameter(
        unit="s",
        symbol="τ",
        absent=None,
        low=0.05,
        high=30.0,
        typical=0.8,
        source="the same Velostat taxel",
    )

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"crept": np.zeros((num_sims, len(self.pads), *pad_shape), np.float32)}

    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        seen = np.empty(own.shape, own.dtype)  # in order, so that its flat form is a view
        reached = -np.expm1(-dt_s / self.time_constant_s).astype(own.dtype)
        crept = memory["crept"].reshape(own.shape[1], -1)
        flat = (*own.shape[:2], -1)
        _creep(
            own.reshape(flat),
            reached,
            np.float32(self.share),
            np.float32(-np.inf if self.below_rest else 0.0),
            crept,
            seen.reshape(flat),
        )
        return seen

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: a fast increase, a slow increase, a decrease."""
        return [
            {"share": 0.3, "time_constant_s": 0.3},
            {"share": 0.3, "time_constant_s": 3.0},
            {"share": -0.3, "time_constant_s": 1.0},
        ]


@numba.njit(cache=True)
def _creep(
    own: np.ndarray,
    reached: np.ndarray,
    share: float | np.float32,
    lowest: np.float32,
    crept: np.ndarray,
    seen: np.ndarray,
) -> None:
    """``crept`` (N, K) goes the share ``reached`` (S, N) of its way to ``own`` (S, N, K) in every scan; ``seen`` is
    at least ``lowest``."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                crept[n, k] += (own[s, n, k] - crept[n, k]) * reached[s, n]
                seen[s, n, k] = max(own[s, n, k] + share * crept[n, k], lowest)
