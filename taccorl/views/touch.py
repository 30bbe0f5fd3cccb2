"""Touch signals of every row: active taxels, their sum, the peak, and the contact gate.

Letters in shapes: T rows (time).
"""

import functools
from dataclasses import dataclass

import numpy as np

from taccorl.data.episode import Episode
from taccorl.data.spec import SensorSpec

CONTACT_THRESHOLD = 0.4
"""λ_f: a normalised reading above this is contact (paper Table 3)."""
MIN_ACTIVE_TAXELS = 1
"""m: number of taxels that must be above λ_f for contact (paper Table 3)."""


@dataclass(frozen=True)
class Pad:
    """One pad over the T rows of an episode."""

    name: str
    sensor: SensorSpec
    counts: np.ndarray
    """(T, rows, columns) counts above baseline."""

    @functools.cached_property
    def active(self) -> np.ndarray:
        """(T, rows, columns) bool: above the sensor's noise."""
        return self.counts > self.sensor.noise_count

    @property
    def num_active(self) -> np.ndarray:
        """(T,) number of active taxels."""
        return self.active.sum(axis=(1, 2))

    @property
    def sum_count(self) -> np.ndarray:
        """(T,) sum of the counts of the active taxels; 0 without contact."""
        return np.where(self.active, self.counts, 0).sum(axis=(1, 2), dtype=np.int64)

    @property
    def peak_count(self) -> np.ndarray:
        """(T,) largest count of a taxel."""
        return self.counts.max(axis=(1, 2))

    @property
    def gate_count(self) -> float:
        """Contact threshold λ_f in counts."""
        return CONTACT_THRESHOLD / self.sensor.gain_per_count

    @property
    def full_sum_count(self) -> float:
        """Sum of counts at the end of the fixed colour scale: every taxel of the pad at twice λ_f, a firm full-face grip."""
        return 2.0 * self.gate_count * self.sensor.rows * self.sensor.columns


def pads_of(episode: Episode) -> list[Pad]:
    """Return the episode's pads; from a feature with history the newest reading is used, and only if no other feature has the
    pad.
    """
    keys = [key for key in episode.spec.keys("tactile") if key in episode.arrays]
    found: dict[str, Pad] = {}
    for key in sorted(keys, key=lambda k: episode.spec.features[k].history):
        for name, counts in episode.pads(key).items():
            found.setdefault(name, Pad(name, episode.spec.sensors[key], counts))
    return list(found.values())


def contact_gate(pads: list[Pad]) -> np.ndarray:
    """(T,) bool, paper's c_t at history L = 1: I[Σ_k I(|f_k| > λ_f) ≥ m] over all pads; f = counts × gain."""
    over = sum((np.abs(p.counts) * p.sensor.gain_per_count > CONTACT_THRESHOLD).sum(axis=(1, 2)) for p in pads)
    return np.asarray(over) >= MIN_ACTIVE_TAXELS


def peak_row(pads: list[Pad]) -> int:
    """Index of the row with the highest sum over all pads; 0 without touch."""
    return int(np.argmax(sum(p.sum_count for p in pads))) if pads else 0
