"""The part of a recording that has to be simulated: a fit needs nothing after the last measured row. Where the last rows of a
recording are for validation (``search.problem.split_rows``), its fits take less time by as much.

Letters in shapes: T rows, C channels.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from taccorl.alignment.controller.joint_motion import JointMotion, first_rows
from taccorl.diagnosis.search.problem import Recording

MORE_ROWS = 4
"""Rows after the last measured one simulated, too: torques are interpolated to the next row, slopes at the end one-sided."""


@lru_cache(maxsize=64)
def measured_part(recording: Recording) -> JointMotion:
    """Motion of the recording, up to a few rows after the last measured one."""
    seen = np.flatnonzero(np.isfinite(recording.measured).any(axis=1))
    return first_rows(recording.data, int(seen[-1]) + 1 + MORE_ROWS) if len(seen) else recording.data


def whole_rows(columns: Sequence[np.ndarray], recording: Recording) -> np.ndarray:
    """(T, C) ``columns`` of fewer rows side by side, and NaN below."""
    whole = np.full((len(recording.time_s), len(columns)), np.nan)
    for k, column in enumerate(columns):
        whole[: len(column), k] = column
    return whole
