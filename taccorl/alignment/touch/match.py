"""Agreement of measured and simulated touch in the five quantities that the paper aligns
(App. B.2): masks of active taxels, their number, centroids, histograms, temporal differences.

The same threshold makes a taxel active in the measurement and in the simulation. A number
that the readings do not determine is None, never 0 or NaN: ``TouchMatch.undefined`` says why.

Letters in shapes: T frames, P pads, R × C taxels of a pad.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import wasserstein_distance

from taccorl.errors import TaccorlError


class MatchNumber(NamedTuple):
    """One of the paper's five numbers."""

    name: str  # Field of ``TouchMatch``
    label: str  # Text for tables
    unit: str  # Unit of the field; empty: it has none
    needs: str  # What the readings lack if it is undefined


NO_ACTIVE = "no taxel is active in the measurement or in the simulation"
MATCH_NUMBERS = (
    MatchNumber("mask_iou", "masks, intersection over union", "", NO_ACTIVE),
    MatchNumber("active_taxels", "number of active taxels", "taxels", NO_ACTIVE),
    MatchNumber(
        "centroid_m",
        "centroids",
        "m",
        "in no frame of a pad are taxels active in both measurement and simulation",
    ),
    MatchNumber(
        "histogram_count",
        "histograms",
        "counts",
        "measurement or simulation has no active taxel in any frame",
    ),
    MatchNumber(
        "temporal_count",
        "changes between frames",
        "counts/frame",
        "no recording has an active taxel and two frames",
    ),
)


@dataclass(frozen=True, kw_only=True)
class TouchMatch:
    """Agreement over all frames of some recordings; "both" are measurement and simulation.
    Perfect is 0, for ``mask_iou`` 1. None: not determined by these readings."""

    rms_count: float | None
    """RMS difference of counts [counts], over taxels that are ever active in either."""
    mask_iou: float | None
    """Masks of active taxels: intersection over union, all frames together."""
    active_taxels: float | None
    """Mean |difference| of the number of active taxels of a pad [taxels], over frames in
    which either has one."""
    centroid_m: float | None
    """Mean distance [m] of the centroids of a pad's active taxels, weighted by counts, over
    frames in which both have one."""
    histogram_count: float | None
    """Wasserstein distance [counts] of the distributions of the active taxels' counts."""
    temporal_count: float | None
    """RMS difference of the change from frame to frame [counts/frame], over taxels that
    are ever active in either."""
    frames: int
    """Number of frames of single pads in which either has an active taxel."""
    centroid_frames: int
    """Number of frames of single pads in which both have one."""

    def record(self) -> dict[str, Any]:
        """All numbers by name as JSON values, and under ``undefined`` why one is null."""
        return asdict(self) | {"undefined": self.undefined}

    @property
    def undefined(self) -> dict[str, str]:
        """Name of each number that is None → why these readings do not determine it."""
        return {n.name: n.needs for n in MATCH_NUMBERS if getattr(self, n.name) is None}


def touch_match(
    measured: Sequence[np.ndarray],
    simulated: Sequence[np.ndarray],
    threshold_count: float | np.ndarray,
    pitch_m: float,
) -> TouchMatch:
    """Compare the counts of some recordings of the same pads with their simulation.

    Args:
        measured: (T, P, R, C) counts above baseline, of each recording.
        simulated: (T, P, R, C) counts, of each recording.
        threshold_count: λ_noise [counts], broadcast to (P, R, C): a taxel that reads more
            is active. Below 0 it counts as 0.
        pitch_m: distance between neighbouring taxels [m].

    Raises TaccorlError: measurement and simulation of a recording differ in shape."""
    level = np.maximum(threshold_count, 0.0)
    unions = shared = 0
    differences, changes, numbers, distances = [], [], [], []
    readings: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    for counts, model in zip(measured, simulated, strict=True):
        if counts.shape != model.shape:
            raise TaccorlError(
                f"touch: measured counts have the shape {counts.shape}, simulated ones "
                f"{model.shape}; both are (frames, pads, rows, columns)"
            )
        real, twin = counts.astype(np.float32), model.astype(np.float32)
        is_real, is_twin = real > level, twin > level
        unions += int((is_real | is_twin).sum())
        shared += int((is_real & is_twin).sum())
        difference = (real - twin)[:, (is_real | is_twin).any(axis=0)]
        differences.append(difference.ravel())
        changes.append(np.diff(difference, axis=0).ravel())
        num_real, num_twin = is_real.sum(axis=(2, 3)), is_twin.sum(axis=(2, 3))
        numbers.append(np.abs(num_real - num_twin)[(num_real > 0) | (num_twin > 0)])
        both = (num_real > 0) & (num_twin > 0)
        real_at_m = _centroids_m(np.where(is_real, real, 0.0)[both], pitch_m)
        twin_at_m = _centroids_m(np.where(is_twin, twin, 0.0)[both], pitch_m)
        distances.append(np.linalg.norm(real_at_m - twin_at_m, axis=1))
        readings[0].append(real[is_real])
        readings[1].append(twin[is_twin])
    real, twin = map(np.concatenate, readings)
    active, distance_m = np.concatenate(numbers), np.concatenate(distances)
    return TouchMatch(
        rms_count=_rms(np.concatenate(differences)),
        mask_iou=shared / unions if unions else None,
        active_taxels=_mean(active),
        centroid_m=_mean(distance_m),
        histogram_count=(
            float(wasserstein_distance(real, twin)) if len(real) and len(twin) else None
        ),
        temporal_count=_rms(np.concatenate(changes)),
        frames=len(active),
        centroid_frames=len(distance_m),
    )


def _centroids_m(counts: np.ndarray, pitch_m: float) -> np.ndarray:
    """(F, 2) centroids (column, row) [m] of counts (F, R, C), each of a positive sum."""
    rows, columns = (np.arange(n) * pitch_m for n in counts.shape[1:])
    moments = counts.sum(axis=1) @ columns, counts.sum(axis=2) @ rows
    return np.stack(moments, axis=1) / counts.sum(axis=(1, 2))[:, None]


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _rms(values: np.ndarray) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None
