"""How late a machine moves: the shift of time by which it follows its simulation best.

A delay τ of the targets shifts the motion of a linear loop by τ, whatever its gains. So the
maximum of the cross-correlation of simulated and measured speed is a start value for it
where a fit of K_p and K_d has long made up for a part.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from taccorl.diagnosis.search.problem import Problem, Recording, chosen

LATEST_S = 0.2
"""Longest shift that is sought [s]. A choice."""


def lateness_s(
    problem: Problem,
    values: Mapping[str, float],
    names: Sequence[str],
    recordings: Sequence[Recording],
) -> float:
    """Median over ``recordings`` of the time [s] by which the first measured channel
    follows its simulation; negative if it leads.

    Args:
        values: numbers of the machine, with those of its effects ``names``.
    """
    made = [c.make(values) for c in chosen(problem, names)]
    case = dict(values), problem.prepare(dict(values), made, recordings)
    simulated = problem.simulate_all([case], recordings)
    found = [
        _shift_s(own[0][:, 0], r.measured[:, 0], r.time_s)
        for r, own in zip(recordings, simulated, strict=True)
    ]
    return float(np.median(found))


def _shift_s(simulated: np.ndarray, measured: np.ndarray, time_s: np.ndarray) -> float:
    """Time [s] by which ``measured`` (T,) follows ``simulated`` (T,) at ``time_s`` (T,);
    0 if either stands still."""
    step_s = float(np.median(np.diff(time_s)))
    ahead, behind = (np.nan_to_num(np.diff(x)) for x in (simulated, measured))
    most = min(round(LATEST_S / step_s), len(ahead) // 4)
    if most < 1:
        return 0.0
    inner = behind[most : len(behind) - most]
    shifted = sliding_window_view(ahead, len(inner))[::-1]  # by -most … most rows
    size = np.sqrt(np.square(shifted).sum(axis=1))
    alike = shifted @ inner / np.maximum(size, 1e-300)
    k = int(alike.argmax())
    if alike[k] <= 0.0 or k in (0, len(alike) - 1):
        return 0.0
    before, here, after = alike[k - 1 : k + 2]
    part = 0.5 * (before - after) / (before - 2.0 * here + after)  # of a parabola
    return step_s * (k - most + part)
