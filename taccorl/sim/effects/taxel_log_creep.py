"""Logarithmic creep: under a load that stays, a reading goes on changing by as much from 1 to 10 s as from 10 to 100 s."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numba
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Kind, Memory, parameter
from taccorl.sim.effects.touch_memory import RememberingEffect

TIMES_S = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""Time constants of the parts whose sum is logarithmic creep (a Prony series, one part for each decade of time)."""


@effects.register("taxel_log_creep")
@dataclass(kw_only=True)
class TaxelLogCreep(RememberingEffect):
    """Creep over many time scales: r = f + a Σ mᵢ with ṁᵢ = (f − mᵢ) / τᵢ, τᵢ = 0.1 s … 1000 s. After t seconds of load r is
    about (1 + a log₁₀(t / 0.06 s)) f.

    a < 0 is relaxation. Readings do not fall below 0, unless ``below_rest``.
    """

    name: ClassVar = "taxel_log_creep"
    layer: ClassVar = "material"
    windows: ClassVar = True
    equation: ClassVar = "r = f + a Σ mᵢ, ṁᵢ = (f − mᵢ) / τᵢ, τᵢ = 0.1, 1, 10, 100, 1000 s"
    in_words: ClassVar = (
        "Under a load that stays, the reading changes by as much in each tenfold of time: rubber, carbon-filled foils."
    )
    at_a_policy: ClassVar = (
        "A long hold seems to tighten for minutes, and what is felt after it depends on how long it was."
    )
    to_record: ClassVar = "A press that is held for 30 s or longer, and 20 s of nothing after its release."
    near_twins: ClassVar = {
        "taxel_creep": (
            "Over a few seconds both bend alike; creep with one time constant ends. Record a hold of 30 s or longer."
        ),
    }
    below_rest: bool = False
    """True: after a release readings may be below 0 where a < 0; for sensors whose reading at rest is no lower end."""
    share: float = parameter(
        unit="1",
        symbol="a",
        absent=0.0,
        low=-0.15,
        high=0.3,
        typical=0.05,
        source="a choice: 5 % a decade",
    )

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        """Kinds of parts on which it can act; not pads, whose presses are too short to tell it from ``taxel_creep``."""
        return ("cells",)

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"crept": np.zeros((num_sims, len(TIMES_S), len(self.pads), *pad_shape), np.float32)}

    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        seen = np.empty(own.shape, own.dtype)  # in order, so that its flat form is a view
        reached = -np.expm1(-dt_s[..., None] / np.array(TIMES_S)).astype(own.dtype)
        crept = memory["crept"].reshape(own.shape[1], len(TIMES_S), -1)
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
        """Start values of a search, parameter → value each: an increase and a decrease."""
        return [{"share": 0.05}, {"share": -0.05}]


@numba.njit(cache=True)
def _creep(
    own: np.ndarray, reached: np.ndarray, share: np.float32, lowest: np.float32, crept: np.ndarray, seen: np.ndarray
) -> None:
    """Each part of ``crept`` (N, M, K) goes its share ``reached`` (S, N, M) of the way to ``own`` (S, N, K) in every scan;
    ``seen`` is at least ``lowest``."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                total = np.float32(0)
                for m in range(crept.shape[1]):
                    crept[n, m, k] += (own[s, n, k] - crept[n, m, k]) * reached[s, n, m]
                    total += crept[n, m, k]
                seen[s, n, k] = max(own[s, n, k] + share * total, lowest)
