"""Before any effect is fitted: what trace would each leave in these recordings that the fitted numbers cannot take up?

One probe simulation for each start of each effect. Its difference from the fitted model, less what a change of the fitted numbers
would do as well (projection), is the effect's *signature* on these recordings. A score test (Rao) then says how much of the
residual the signature explains; the angle between two signatures says whether these recordings can tell the two effects apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.diagnosis.fit import Fit, stacked
from taccorl.diagnosis.problem import Candidate, Problem, Recording, Values

INVISIBLE = 1e-6
"""RMS of a signature, in floors, that is no more than rounding."""
WRONG_SIGN = 0.1
"""An effect whose start would have to be subtracted is ranked as if it explained this share of what it does."""


@dataclass(frozen=True)
class Probe:
    """What one start of one effect would leave in the recordings."""

    name: str
    start: Values
    signature: np.ndarray
    """(n,) in floors, without what the fitted numbers take up."""
    explained: float
    """Share of the squared residual that goes away with the best multiple of it, 0 … 1."""
    multiple: float
    """That multiple: 1 is an effect as strong as the start."""

    @property
    def visible(self) -> float:
        """RMS in floors: what of the effect these recordings show at all."""
        return float(np.sqrt(np.mean(np.square(self.signature))))


def probe(
    problem: Problem, recordings: Sequence[Recording], parent: Fit, candidates: Sequence[Candidate]
) -> list[Probe]:
    """Every start of every candidate, beside the effects that ``parent`` has.

    Args:
        recordings: those that ``parent`` was fitted to.
    """
    taken_up = _basis(parent.jacobian)
    left = parent.residuals - taken_up @ (taken_up.T @ parent.residuals)
    power = float(left @ left)
    probes = []
    for c in candidates:
        for start in c.starts:
            values = parent.values | {f.name: f.start for f in c.frees} | start
            effects = problem.prepare(values, [*parent.effects, c.make(values)], recordings)
            change = stacked(problem, values, effects, recordings) - parent.residuals
            signature = change - taken_up @ (taken_up.T @ change)
            own = float(signature @ signature)
            if own <= len(signature) * INVISIBLE**2 or power == 0.0:
                probes.append(Probe(c.name, start, np.zeros_like(signature), 0.0, 0.0))
                continue
            along = -float(signature @ left)
            share = along * along / (own * power)
            probes.append(Probe(c.name, start, signature, share if along > 0 else WRONG_SIGN * share, along / own))
    return probes


def alike(one: Probe, other: Probe) -> float:
    """|cos| of the angle between two signatures: 1 where these recordings cannot tell the effects apart."""
    norms = float(np.linalg.norm(one.signature) * np.linalg.norm(other.signature))
    return abs(float(one.signature @ other.signature)) / norms if norms > 0 else 0.0


def _basis(jacobian: np.ndarray) -> np.ndarray:
    """Orthonormal columns (n, r) of what the fitted numbers can do."""
    size = np.linalg.norm(jacobian, axis=0)
    columns = jacobian[:, size > 0] / size[size > 0]
    if columns.shape[1] == 0:
        return columns
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > 1e-6 * singular[0]]
