"""Simultaneous perturbation stochastic approximation (Spall 1992) with the constants of the paper's App. B.1."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Paper App. B.1. The step a_k is relative to a loss that is summed over rows: with a mean instead, nothing moves.
A_SPSA, C_SPSA, STABILITY, ALPHA, GAMMA = 0.15, 0.08, 20, 0.602, 0.101
GRADIENT_CLIP = 5.0
PATIENCE = 20
MAX_ITERATIONS = 400  # not in the paper


@dataclass(frozen=True)
class Spsa:
    """The best point that was looked at."""

    x: np.ndarray
    loss: float
    iterations: int
    stopped_early: bool
    """Nothing better in ``PATIENCE`` iterations, as opposed to out of iterations."""


def minimise(
    loss: Callable[[np.ndarray], float], start: np.ndarray, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> Spsa:
    """x_{k+1} = x_k − a_k g_k with a_k = a / (k + 1 + A)^α, from two evaluations at x_k ± c_k Δ, Δ of random signs.

    g_k = clip((L₊ − L₋) / (2 c_k) · Δ, ± 5), c_k = c / (k + 1)^γ.
    """
    x = np.clip(np.asarray(start, dtype=float), low, high)
    best, best_loss, since = x.copy(), loss(x), 0
    k = 0
    while k < MAX_ITERATIONS and since < PATIENCE:
        step, reach = A_SPSA / (k + 1 + STABILITY) ** ALPHA, C_SPSA / (k + 1) ** GAMMA
        signs = rng.choice([-1.0, 1.0], len(x))
        ends = [np.clip(x + reach * signs, low, high), np.clip(x - reach * signs, low, high)]
        losses = [loss(end) for end in ends]
        gradient = (losses[0] - losses[1]) / (2 * reach) * signs
        x = np.clip(x - step * np.clip(gradient, -GRADIENT_CLIP, GRADIENT_CLIP), low, high)
        k, since, better = k + 1, since + 1, int(losses[1] < losses[0])
        if losses[better] < best_loss:
            best, best_loss, since = ends[better], losses[better], 0
    return Spsa(best, best_loss, k, since >= PATIENCE)
