"""Generalised advantage estimation over decisions (Schulman et al., arXiv 1506.02438).

    δ_t = r_t + γ V'_t − V_t        A_t = δ_t + γ λ (1 − end_t) A_{t+1}        R_t = A_t + V_t

r_t is the sum of rewards within a chunk. V'_t is the value after decision t: of the next observation while the episode
continues, of the last observation before the reset if time ran out (0 with ``bootstrap_time_limit=False``), and 0 after success
or failure.

Letters in shapes: T decisions of an environment, N environments.
"""

import torch
from torch import Tensor


def estimate_advantages(
    reward_TN: Tensor,
    value_TN: Tensor,
    next_value_TN: Tensor,
    end_TN: Tensor,
    *,
    gamma: float,
    gae_lambda: float,
) -> tuple[Tensor, Tensor]:
    """Return the advantages (T, N) and the returns (T, N) of a rollout of T decisions in N environments.

    Args:
        reward_TN: sum of the rewards within each chunk.
        value_TN: V, the critic's value before each decision.
        next_value_TN: V'; 0 where the episode succeeded or failed.
        end_TN: bool, the episode ended in this decision, for any reason: no advantage is passed back over a reset.
        gamma: γ, discount factor per decision.
        gae_lambda: λ, decay of the estimate.
    """
    advantage_TN, later_N = torch.zeros_like(reward_TN), torch.zeros_like(reward_TN[0])
    for t in reversed(range(len(reward_TN))):
        error_N = reward_TN[t] + gamma * next_value_TN[t] - value_TN[t]
        advantage_TN[t] = later_N = error_N + gamma * gae_lambda * torch.where(
            end_TN[t], 0.0, later_N
        )
    return advantage_TN, advantage_TN + value_TN


def normalise(advantage: Tensor) -> Tensor:
    """Scale advantages (T, N) to mean 0 and standard deviation 1 over the whole rollout; same shape, 1e-5 is added to the
    deviation."""
    return (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-5)


def explained_variance(value: Tensor, returns: Tensor) -> float:
    """1 − Var[R − V] / Var[R] over all decisions; 1: the critic predicts returns exactly, 0: no better than their mean.

    ``value`` V and ``returns`` R have the same shape (T, N). NaN if all returns are equal."""
    spread = returns.var(correction=0)
    return (
        float("nan")
        if spread == 0
        else float(1 - (returns - value).var(correction=0) / spread)
    )
