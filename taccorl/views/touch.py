"""Touch signals of every row: active taxels, their sum, the peak, and the contact gate; and touch of unknown layout and unit.

Letters in shapes: T rows (time).
"""

import functools
from dataclasses import dataclass

import numpy as np

from taccorl.data.episode import Episode
from taccorl.data.sensor_spec import SensorSpec
from taccorl.data.touch_checks import other_touch_keys
from taccorl.views.groups import MOST_NUMBERS

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
    pad."""
    keys = [key for key in episode.spec.keys("tactile") if key in episode.arrays]
    found: dict[str, Pad] = {}
    for key in sorted(keys, key=lambda k: episode.spec.features[k].history):
        for name, counts in episode.pads(key).items():
            found.setdefault(name, Pad(name, episode.spec.sensors[key], counts))
    return list(found.values())


def contact_gate(pads: list[Pad]) -> np.ndarray:
    """(T,) bool, paper's c_t at history L = 1: I[Σ_k I(|f_k| > λ_f) ≥ m] over all pads; f = counts × gain."""
    over = sum(
        (np.abs(p.counts) * p.sensor.gain_per_count > CONTACT_THRESHOLD).sum(
            axis=(1, 2)
        )
        for p in pads
    )
    return np.asarray(over) >= MIN_ACTIVE_TAXELS


def peak_row(pads: list[Pad]) -> int:
    """Index of the row with the highest sum over all pads; 0 without touch."""
    return int(np.argmax(sum(p.sum_count for p in pads))) if pads else 0


@dataclass(frozen=True)
class OtherTouch:
    """A feature of touch that no sensor spec describes, as pictures: R rows and C columns, P pads."""

    key: str
    values: np.ndarray
    """(T, P, R, C) float32, in the feature's own unit."""
    low: float
    """Least value of the episode; ``high``: the largest."""
    high: float
    unit: str
    """Unit of the values; empty if nobody stated it."""

    @property
    def path(self) -> str:
        """Entity below which its pads are."""
        return f"touch_values/{self.key.removeprefix('observation.').replace('.', '_')}"

    @property
    def title(self) -> str:
        """Feature, layout, range and unit in words."""
        num_pads, rows, columns = self.values.shape[1:]
        pads = f"{num_pads} of " if num_pads > 1 else ""
        unit = self.unit if self.unit not in ("", "unknown") else "(unit not stated)"
        return f"{self.key}: {pads}{rows} × {columns}, {self.low:.4g} … {self.high:.4g} {unit}"


def other_touch_of(episode: Episode) -> list[OtherTouch]:
    """Return touch that no sensor spec describes and that has two or more dimensions, the last two of which are rows and columns;
    and vectors of more elements than are shown as curves, as a single row."""
    found = []
    for key in other_touch_keys(episode):
        feature, values = (
            episode.spec.features[key],
            episode.arrays[key].astype(np.float32),
        )
        layout = feature.layout or (1, feature.size)
        if not feature.layout and feature.size <= MOST_NUMBERS:
            continue
        known = values[np.isfinite(values)]
        low, high = (
            (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
        )
        unit = (
            feature.unit
            if isinstance(feature.unit, str)
            else ", ".join(dict.fromkeys(feature.unit))
        )
        pictures = values.reshape(len(values), -1, *layout[-2:])
        found.append(OtherTouch(key, pictures, low, high, unit))
    return found
