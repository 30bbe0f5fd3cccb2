"""Numbers that recordings do not determine return to where they began.

A least-squares fit leaves such numbers wherever the errors of a slightly wrong model drive them, often at their bounds: the place
of a tool's mass along an axis that hardly moves, viscous friction beside a feedforward of the speed. Other motions suffer by it.

So the numbers are fitted once more with a broad Gaussian prior around the values θ₀ at the start:

    min |r(θ)|² + Σ w_i (θ_i − θ₀_i)² / D_i²

with w_i the ratio of a number's variance (``Fit.covariance``) to its variance for white unit noise: the weight that the residuals
really have. Where the standard error σ of a number is far below D, it moves by σ²/D² of its distance from θ₀; one that is not
determined goes to θ₀, and others, which the fit had set to make up for it, follow. The strengths of effects that the search added
have no prior: their start values are no knowledge.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from taccorl.diagnosis.search.fit import FINE, Fit, fit, inverse_of, rms, stacked
from taccorl.diagnosis.search.problem import Free, Problem, Recording

PRIOR_SHARE = 0.25
"""Standard deviation D of the prior in shares of a number's range, on the scale on which it is searched."""
OPEN_FROM = 0.3
"""Standard error in multiples of D from which a number counts as hardly determined. Else nothing is fitted again."""
MOST_MORE = 0.02
"""Largest relative increase of the squared error, on the recordings of the fit and on those of validation, for which numbers
return."""
NO_PRIOR = 1e9
"""Standard deviation of a prior that says nothing."""


def settled(
    problem: Problem,
    model: Fit,
    began: Mapping[str, float],
    present: Sequence[str],
    fitted_to: Sequence[Recording],
    validation: Sequence[Recording],
) -> Fit:
    """``model`` with numbers that the recordings do not determine back near where they began, or ``model`` itself if it has none,
    or the errors would rise.

    Args:
        began: values at the start; numbers that are left out begin at their defaults.
        present: effects that the twin has already: their strengths are known at the start.
        validation: recordings whose error must not rise either.
    """
    deviations = np.array([_deviation(problem, f, present) for f in model.frees])
    variances = np.diag(model.covariance())
    if not (variances > (OPEN_FROM * deviations) ** 2).any():
        return model
    weights = variances / np.diag(inverse_of(model.jacobian.T @ model.jacobian))
    means = [f.coordinate(began.get(f.name, f.start)) for f in model.frees]
    prior = list(zip(means, deviations / np.sqrt(weights), strict=True))
    found = fit(problem, fitted_to, model.names, model.values, step=FINE, prior=prior)
    before, after = (
        rms(stacked(problem, m.values, m.effects, validation)) if validation else 0.0
        for m in (model, found)
    )
    if not (is_as_good(found.error, model.error) and is_as_good(after, before)):
        return model
    return dataclasses.replace(found, trouble=model.trouble, moved=model.moved)


def is_as_good(error: float, before: float) -> bool:
    """Whether an RMS error [floors] has hardly risen."""
    return error**2 - before**2 <= MOST_MORE * max(before, 1.0) ** 2


def _deviation(problem: Problem, f: Free, present: Sequence[str]) -> float:
    """D of a coordinate."""
    effect = f.name.rpartition(".")[0]
    if (
        effect
        and effect not in present
        and f.name in problem.candidates[effect].strengths
    ):
        return NO_PRIOR
    return PRIOR_SHARE * (f.coordinate(f.high) - f.coordinate(f.low))
