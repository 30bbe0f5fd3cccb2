"""Creep of readings with one or more time constants: what the effects of it share."""

from abc import abstractmethod
from dataclasses import dataclass

import numba
import numpy as np

from taccorl.sim.effects.effect import Memory
from taccorl.sim.effects.touch_memory import RememberingEffect


@dataclass(kw_only=True)
class CreepingEffect(RememberingEffect):
    """Base class of the effects of creep. The reading is r = f + a Σ mᵢ with ṁᵢ = (f − mᵢ) / τᵢ: f is the reading without creep,
    a the share of the creep, τᵢ [s] its time constants. r is at least 0, unless ``below_rest`` is true.

    The equation is solved exactly for a reading that was constant since the last scan.
    """

    below_rest: bool = False
    """True: after a release readings may be below 0 where a < 0; for sensors whose reading at rest is no lower end."""
    share: float
    """a; a parameter of each effect, with its own range."""

    @property
    @abstractmethod
    def times_s(self) -> tuple[float, ...]:
        """Time constants τᵢ [s]."""

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"crept": np.zeros((num_sims, len(self.times_s), len(self.pads), *pad_shape), np.float32)}

    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        seen = np.empty(own.shape, own.dtype)  # in order, so that its flat form is a view
        reached = -np.expm1(-dt_s[..., None] / np.array(self.times_s)).astype(own.dtype)
        crept = memory["crept"].reshape(own.shape[1], len(self.times_s), -1)
        lowest = np.float32(-np.inf if self.below_rest else 0.0)
        flat = (*own.shape[:2], -1)
        _creep(own.reshape(flat), reached, np.float32(self.share), lowest, crept, seen.reshape(flat))
        return seen


@numba.njit(cache=True)
def _creep(
    own: np.ndarray, reached: np.ndarray, share: np.float32, lowest: np.float32, crept: np.ndarray, seen: np.ndarray
) -> None:
    """Each part of ``crept`` (N, M, K) goes its share ``reached`` (S, N, M) of the way to ``own`` (S, N, K) in every scan;
    ``seen`` (S, N, K) is at least ``lowest``."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                total = np.float32(0)
                for m in range(crept.shape[1]):
                    crept[n, m, k] += (own[s, n, k] - crept[n, m, k]) * reached[s, n, m]
                    total += crept[n, m, k]
                seen[s, n, k] = max(own[s, n, k] + share * total, lowest)
