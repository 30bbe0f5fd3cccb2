"""How much better one model is than another on recordings that neither was fitted to: block by block, with its uncertainty."""

from collections.abc import Sequence

import numpy as np

from taccorl.diagnosis.fit import Fit, residuals
from taccorl.diagnosis.problem import Problem, Recording

BLOCK_S = 0.5
"""Residuals within half a second are alike; blocks of that length are taken as independent."""


def block_squares(problem: Problem, model: Fit, recordings: Sequence[Recording]) -> np.ndarray:
    """(B,) mean squared residual, in floors, of every block of every recording."""
    blocks = []
    for recording in recordings:
        squares = np.square(residuals(problem, model.values, model.effects, recording))
        seen = np.isfinite(squares)
        rate_hz = (len(recording.time_s) - 1) / (recording.time_s[-1] - recording.time_s[0])
        edges = np.arange(0, len(squares), max(1, round(BLOCK_S * rate_hz)))
        total = np.add.reduceat(np.where(seen, squares, 0.0).sum(1), edges)
        count = np.add.reduceat(seen.sum(1), edges)
        blocks.append(total[count > 0] / count[count > 0])
    return np.concatenate(blocks)


def standard_score(differences: np.ndarray) -> float:
    """Mean over its standard error: 2 is hardly chance. Differences of one block only prove nothing."""
    if len(differences) < 2:
        return 0.0
    spread = float(differences.std(ddof=1)) / np.sqrt(len(differences))
    return float(differences.mean()) / spread if spread > 0 else 0.0


def bic_gain(parent: Fit, child: Fit, more_parameters: int) -> float:
    """How far the Bayesian information criterion falls from ``parent`` to ``child``: 10 is strong evidence (Kass and
    Raftery 1995).

    The noise is known: residuals are in floors, and what ``child`` leaves above one floor counts as noise, too. Rows count as
    often as those of ``child`` are independent.
    """
    rows = child.effective_rows
    noise = max(1.0, float(child.residuals @ child.residuals) / len(child.residuals))
    fallen = float(parent.residuals @ parent.residuals - child.residuals @ child.residuals) / noise
    return fallen * rows / len(child.residuals) - more_parameters * float(np.log(rows))
