"""Recordings of one sensor of cells, and what several checks compute from all of them together.

Letters in shapes: T rows of all recordings, K cells, P places.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taccorl.alignment.machines.cell_model import Calibration, calibrated, loads
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import listed

DEAD = 0.05  # Share of the usual gain, that of the median cell which responds, below which a cell hardly responds
RESPONDS = 0.5  # Correlation of load and reading from which on a cell responds
AS_LOADED = 0.5
"""A cell is judged only if its load reaches this share of the largest load of any cell: a cell with less may have a threshold."""
CLEAR = 3.0
"""A cell is judged only if the usual gain would have changed its reading by so many standard deviations of the rest of it."""


def below_end(config: CellsConfig, m: CellMeasurement) -> np.ndarray:
    """(T, K) bool: the reading is not at that end of the converter to which a load drives it. Readings without load may lie at
    the other end."""
    end = config.high if config.sign > 0 else config.low
    return config.sign * (end - m.measured) > 0.5 * m.quantum + 1e-9 * np.abs(
        m.measured
    )


def slopes(
    x: np.ndarray, y: np.ndarray, use: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares slope of each column of ``y`` over that of ``x``, and their correlation, both (S,), in the rows that ``use``
    marks, all (T, S); NaN where nothing changes."""
    count = np.maximum(use.sum(axis=0), 1)
    dx, dy = (
        np.where(use, v - np.where(use, v, 0.0).sum(axis=0) / count, 0.0)
        for v in (x, y)
    )
    xx, yy, xy = (dx * dx).sum(axis=0), (dy * dy).sum(axis=0), (dx * dy).sum(axis=0)
    known = (
        (xx > 1e-18 * np.square(x).sum(axis=0))
        & (yy > 1e-18 * np.square(y).sum(axis=0))
        & (count > 2)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(known, xy / xx, np.nan), np.where(
            known, xy / np.sqrt(xx * yy), np.nan
        )


@dataclass(frozen=True)
class CellSet:
    """Recordings of one sensor of cells, checked together; derived values are computed once."""

    config: CellsConfig
    recordings: Sequence[CellMeasurement]

    @cached_property
    def load(self) -> np.ndarray:
        """(T, K) load of each cell; (T, P) with places."""
        return np.concatenate([loads(m) for m in self.recordings])

    @cached_property
    def reading(self) -> np.ndarray:
        """(T, K) readings."""
        return np.concatenate([m.measured for m in self.recordings])

    @cached_property
    def free(self) -> np.ndarray:
        """(T, K) bool, as ``below_end``."""
        return np.concatenate([below_end(self.config, m) for m in self.recordings])

    @cached_property
    def step_noise(self) -> np.ndarray:
        """(K,) standard deviation of the rounding of readings; above 0."""
        return np.maximum(
            np.max([m.quantum for m in self.recordings], axis=0) / np.sqrt(12), 1e-12
        )

    @cached_property
    def calibration(self) -> Calibration:
        """Least-squares gain and offset of each cell over all recordings, in rows below the end of the converter."""
        pairs = [
            (loads(m), np.where(below_end(self.config, m), m.measured, np.nan))
            for m in self.recordings
        ]
        return calibrated(self.config, pairs)

    @cached_property
    def shares(self) -> np.ndarray:
        """(K,) gain of each cell over all recordings together, as a multiple of the usual gain, that of the median responding
        cell (with places: at the place where it responds most). A negative one is of the wrong sign. NaN for cells that cannot be
        judged: those whose load is small, or whose readings vary more than the usual gain would change them; all are NaN if fewer
        than two cells are loaded or none responds."""
        sign = self.config.sign
        if self.config.same_place_mm is not None:
            known = [
                np.where((m.place >= 0)[:, None], below_end(self.config, m), False)
                for m in self.recordings
            ]
            pairs = [
                (loads(m), np.where(k, m.measured, np.nan))
                for m, k in zip(self.recordings, known, strict=True)
            ]
            gain = np.max(sign * calibrated(self.config, pairs).gain, axis=1)
            return gain / (
                float(np.median(gain[gain > 0])) if (gain > 0).any() else np.nan
            )
        stuck = np.ptp(self.reading, axis=0) == 0
        use = self.free | stuck  # a reading that never changes is no clipped one
        gain, correlation = slopes(self.load, self.reading, use)
        gain, correlation = sign * np.where(stuck, 0.0, gain), sign * correlation
        peak = self.load.max(axis=0)
        loaded = (peak > 0) & (peak >= AS_LOADED * peak.max()) & np.isfinite(gain)
        responds = loaded & (correlation > RESPONDS)
        if loaded.sum() < 2 or not responds.any():
            return np.full(len(gain), np.nan)
        usual = float(np.median(gain[responds]))
        change, spread = (
            np.nanstd(np.where(use, v, np.nan), axis=0)
            for v in (self.load, self.reading)
        )
        rest = spread * np.sqrt(1 - np.square(np.nan_to_num(correlation)))
        return np.where(
            loaded & (responds | (usual * change > CLEAR * rest)), gain / usual, np.nan
        )

    @cached_property
    def dead(self) -> np.ndarray:
        """(K,) bool: cells that are loaded as the others but whose gain is below ``DEAD`` times the usual one, or of the wrong
        sign."""
        return self.shares < DEAD  # NaN is not

    def some(self, cells: Sequence[int] | np.ndarray) -> str:
        """Text: number of ``cells`` (N,) of all, and names of the first ones."""
        return f"{len(cells)} of {self.config.num_cells} cells ({listed([self.config.names[k] for k in cells], 4)})"
