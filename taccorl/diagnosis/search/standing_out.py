"""Recordings and regimes whose positions stand clearly above the noise floor, though the error of all rows together may not.

n rows with residuals r in floors count as n_e = n · (independent rows / rows of the recording). If noise of s floors and
equations that leave up to ``little`` times the noise are all there is, n_e Σ r² / (n little² s²) is distributed as χ² with n_e
degrees of freedom. Efforts are not judged: they jump with the target, so that a tenth of a millisecond shows.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from taccorl.alignment.measurements.correlation import independent_rows
from taccorl.diagnosis.search.fit import Fit, residuals
from taccorl.diagnosis.search.problem import LEAST_ROWS, Problem, Recording

CHANCE = 1e-3
"""Probability that noise alone stands out in any regime of any recording of a part. A choice."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """Rows of a recording in one regime, with the error of a model's positions there."""

    recording: str
    regime: str
    error: float
    """RMS residual [floors]."""
    most: float
    """Error [floors] above which it stands out."""
    n: int

    def words(self) -> str:
        """Text such as ``val_steps.csv, high speed``."""
        return f"{self.recording}, {self.regime}"


def places(
    problem: Problem, model: Fit, recordings: Sequence[Recording], little: float
) -> Iterator[Place]:
    """The error of ``model`` in each regime of each recording with at least ``LEAST_ROWS`` rows, whether it stands out or not.
    ``little``: ``SearchConfig.little``, the error [floors] that equations of a robot may leave."""
    tests = max(1, sum(len(r.regimes) for r in recordings))
    for r in recordings:
        if not r.regimes:
            continue
        left = residuals(problem, model.values, model.effects, r)[:, 0]
        seen = np.isfinite(left)
        share = independent_rows([left[:, None]]) / max(int(seen.sum()), 1)
        for regime, (rows, noise) in r.regimes.items():
            own = left[rows & seen]
            if len(own) >= LEAST_ROWS:
                free = max(1.0, share * len(own))
                most = (
                    little
                    * noise
                    * math.sqrt(float(chi2.isf(CHANCE / tests, free)) / free)
                )
                error = float(np.sqrt(np.mean(own**2)))
                yield Place(
                    recording=r.name, regime=regime, error=error, most=most, n=len(own)
                )
