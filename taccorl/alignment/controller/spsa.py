"""Simultaneous perturbation stochastic approximation (Spall 1992), as the paper uses it
to identify a controller (App. B.1): its loss (eq. 9) and its constants.

x_{k+1} = x_k − a_k g_k, with a_k = a / (k + 1 + A)^α and the gradient g_k from two
evaluations at x_k ± c_k Δ, c_k = c / (k + 1)^γ, Δ of random signs.

The paper does not state which points count as progress. Here they are the iterates x_k,
at the cost of a third evaluation: the perturbed points are c_k away from the iterate, and
of a narrow valley they see the walls.

Letters in shapes: T rows of a recording, P parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

DIFFERENCE_WEIGHT = 0.1
"""Weight of the differences between rows in the loss (eq. 9)."""
A_SPSA, C_SPSA, STABILITY, ALPHA, GAMMA = 0.15, 0.08, 20, 0.602, 0.101
"""a, c, A, α, γ. The step a_k suits a loss that is summed over rows, as eq. 9 is."""
GRADIENT_CLIP = 5.0
"""Largest |g_k| of each coordinate."""
PATIENCE = 20
"""Number of iterations without a better iterate after which the search ends."""
MAX_ITERATIONS = 1000  # not in the paper; of a 10 s sweep 5 s of CPU time


@dataclass(frozen=True)
class Spsa:
    """Result of a search by SPSA."""

    x: np.ndarray
    """(P,) the iterate of the lowest loss, the start included."""
    loss: float
    start_loss: float
    iterations: int
    """Number of iterations, three evaluations of the loss each."""
    out_of_patience: bool
    """True: the search ended by the paper's rule (``PATIENCE``). False: it was cut off
    after ``MAX_ITERATIONS``."""


def paper_loss(simulated: np.ndarray, measured: np.ndarray) -> float:
    """Loss of eq. 9: Σ |e_sim − e_real| + 0.1 Σ |Δe_sim − Δe_real|, e = q − q_target [rad].

    The targets cancel: e_sim − e_real = q_sim − q_real. Rows that were not measured add
    nothing, nor do the differences to them.

    Args:
        simulated: (T,) positions [rad] of the simulation.
        measured: (T,) measured positions [rad]; NaN where not measured.
    """
    error = simulated - measured
    return float(
        np.nansum(np.abs(error)) + DIFFERENCE_WEIGHT * np.nansum(np.abs(np.diff(error)))
    )


def minimise(
    loss: Callable[[np.ndarray], float],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    rng: np.random.Generator,
) -> Spsa:
    """Minimise ``loss`` by SPSA within bounds.

    g_k = clip((L₊ − L₋) / (x₊ − x₋), ± 5) of each coordinate. Within the bounds
    x₊ − x₋ = 2 c_k Δ; an end beyond a bound is moved onto it.

    Args:
        loss: function of x (P,).
        start: (P,) first iterate.
        low: (P,) lower bounds.
        high: (P,) upper bounds.
        rng: generator of the random signs Δ.
    """
    x = np.clip(np.asarray(start, dtype=float), low, high)
    best, start_loss = x, loss(x)
    best_loss, iterations, idle = start_loss, 0, 0
    while iterations < MAX_ITERATIONS and idle < PATIENCE:
        step = A_SPSA / (iterations + 1 + STABILITY) ** ALPHA
        reach = C_SPSA / (iterations + 1) ** GAMMA
        signs = rng.choice([-1.0, 1.0], len(x))
        upper = np.clip(x + reach * signs, low, high)
        lower = np.clip(x - reach * signs, low, high)
        rise = loss(upper) - loss(lower)
        distance = upper - lower
        slope = np.divide(rise, distance, out=np.zeros_like(x), where=distance != 0)
        x = x - step * np.clip(slope, -GRADIENT_CLIP, GRADIENT_CLIP)
        x = np.clip(x, low, high)
        iterations, idle, now = iterations + 1, idle + 1, loss(x)
        if now < best_loss:
            best, best_loss, idle = x, now, 0
    return Spsa(best, best_loss, start_loss, iterations, idle >= PATIENCE)
