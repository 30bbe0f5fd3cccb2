"""Simultaneous perturbation stochastic approximation (Spall 1992) with the constants of the paper's App. B.1.

The two perturbed points of an iteration are used for the gradient only: at the first step they are c = 0.08 away from the
iterate, so that their loss differs from the iterate's. Loss, best point and stop rule therefore use the iterate x_k, which costs
a third evaluation.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Paper App. B.1. The step a_k is relative to a loss that is summed over rows: with a mean instead, nothing moves.
A_SPSA, C_SPSA, STABILITY, ALPHA, GAMMA = 0.15, 0.08, 20, 0.602, 0.101
"""a, c, A, α and γ of the equations in ``minimise``."""
GRADIENT_CLIP = 5.0
"""Largest |g_k| of each coordinate."""
PATIENCE = 20
"""Number of iterations without a better iterate after which the search ends."""
MAX_ITERATIONS = 400  # not in the paper


@dataclass(frozen=True)
class Spsa:
    """Result of a search by SPSA: the best iterate."""

    x: np.ndarray
    """(P,) best iterate."""
    loss: float
    iterations: int
    """Number of iterations, three evaluations of the loss each."""
    out_of_patience: bool
    """True: the search stopped because no iterate was better for ``PATIENCE`` iterations, which does not prove a minimum. False:
    it reached the largest number of iterations."""


def minimise(
    loss: Callable[[np.ndarray], float], start: np.ndarray, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> Spsa:
    """Minimise by SPSA: x_{k+1} = x_k − a_k g_k with a_k = a / (k + 1 + A)^α, from evaluations at x_k ± c_k Δ, Δ of random signs.

    g_k = clip((L₊ − L₋) / (x₊ − x₋), ± 5) per coordinate, c_k = c / (k + 1)^γ. Without bounds x₊ − x₋ = 2 c_k Δ; where a bound
    clips an end it is shorter, and 0 in a coordinate means no gradient along it.

    Args:
        loss: function of x (P,).
        start: (P,) first iterate.
        low, high: (P,) bounds of x.
    """
    x = np.clip(np.asarray(start, dtype=float), low, high)
    best, best_loss, since = x.copy(), loss(x), 0
    k = 0
    while k < MAX_ITERATIONS and since < PATIENCE:
        step, reach = A_SPSA / (k + 1 + STABILITY) ** ALPHA, C_SPSA / (k + 1) ** GAMMA
        signs = rng.choice([-1.0, 1.0], len(x))
        ends = [np.clip(x + reach * signs, low, high), np.clip(x - reach * signs, low, high)]
        apart = ends[0] - ends[1]
        rise = loss(ends[0]) - loss(ends[1])
        gradient = np.divide(rise, apart, out=np.zeros_like(x), where=apart != 0)
        x = np.clip(x - step * np.clip(gradient, -GRADIENT_CLIP, GRADIENT_CLIP), low, high)
        k, since, now = k + 1, since + 1, loss(x)
        if now < best_loss:
            best, best_loss, since = x.copy(), now, 0
    return Spsa(best, best_loss, k, since >= PATIENCE)
