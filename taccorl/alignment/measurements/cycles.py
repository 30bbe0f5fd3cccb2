"""Equal cycles within one recording: rows whose targets are those of one period later. What the measured values differ by there
is noise and the machine's own variation, as between two recordings of one motion.

Letters in shapes: T rows, C columns.
"""

from dataclasses import dataclass

import numpy as np

from taccorl.alignment.measurements.measurement import Measurement

SAME = 1e-6
"""Largest difference of equal targets, as a share of their range: rounding of logged numbers. A choice."""
EVEN = 0.01
"""Largest difference of the rows' periods, as a share of the period: targets of rows that jitter act at other times in each
cycle."""
MOVES = 0.5
"""Least range of each target within the equal cycles, as a share of its range in the recording: a hold is equal at any period."""
MOST_PERIODS = 20
"""Number of periods that are tried, the shortest first. A choice."""


@dataclass(frozen=True)
class Cycles:
    """The rows ``first`` to ``end`` (exclusive) of a recording have the same targets as those ``period_rows`` later."""

    period_rows: int
    first: int
    """First row of the second cycle: the first one begins from rest."""
    end: int

    def difference(self, values: np.ndarray) -> np.ndarray:
        """(end − first, …) ``values`` (T, …) of one period later minus those of these rows."""
        later = slice(self.first + self.period_rows, self.end + self.period_rows)
        return values[later] - values[self.first : self.end]


def cycles(m: Measurement) -> Cycles | None:
    """Find the shortest period at which the recording's targets repeat for three cycles or more; None if there is none.

    The targets of all signals must repeat, with known loads, added torques, supply and stretches with the motor off. Targets
    that state a velocity or a torque have no cycles: from them positions drift.
    """
    period_s = np.diff(m.time_s)
    if m.num_rows < 4 or m.command_s.size or any(kind != "position" for kind in m.target_kinds):
        return None
    if np.ptp(period_s) > EVEN * float(np.median(period_s)):
        return None
    columns = np.nan_to_num(np.column_stack([m.target, *(getattr(m, name) for name in m.extra_columns)]))
    span = np.ptp(columns, axis=0)
    columns = columns[:, span > 0.0] / span[span > 0.0]
    if columns.shape[1] == 0:
        return None
    third = m.num_rows // 3
    at = third + int(np.argmax(np.abs(np.diff(columns[third : 2 * third + 1], axis=0)).max(axis=1)))
    alike = (np.abs(columns - columns[at]) <= SAME).all(axis=1)
    alike = np.flatnonzero(alike[:-1] & (np.abs(columns[1:] - columns[at + 1]) <= SAME).all(axis=1))
    periods = np.unique(np.abs(alike - at))
    for period in periods[(periods > 0) & (periods <= third)][:MOST_PERIODS].tolist():
        first, end = _longest((np.abs(columns[period:] - columns[:-period]) <= SAME).all(axis=1))
        if end - first >= 2 * period and (np.ptp(columns[first:end], axis=0) >= MOVES).all():
            return Cycles(period, first + period, end)
    return None


def _longest(same: np.ndarray) -> tuple[int, int]:
    """[first, end) rows of the longest stretch of True in ``same`` (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]])))
    if len(edges) == 0:
        return 0, 0
    k = 2 * int(np.argmax(edges[1::2] - edges[::2]))
    return int(edges[k]), int(edges[k + 1])
