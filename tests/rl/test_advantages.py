"""Generalised advantage estimation by hand."""

import pytest
import torch

from taccorl.rl.advantages import estimate_advantages, explained_variance, normalise


def test_three_decisions_by_hand() -> None:
    """γ = 0.5, λ = 0.5; the second ends the episode by its time limit, with V = 8 for the last observation.
    δ = 0 + 0.5·4 − 2 = 0; 1 + 0.5·8 − 4 = 1; 0 + 0.5·6 − 1 = 2. A = 0 + 0.25·1 = 0.25; 1; 2. R = A + V = 2.25; 5; 3."""
    column = {
        "reward_TN": [0.0, 1.0, 0.0],
        "value_TN": [2.0, 4.0, 1.0],
        "next_value_TN": [4.0, 8.0, 6.0],
        "end_TN": [False, True, False],
    }
    given = {name: torch.tensor(x)[:, None] for name, x in column.items()}
    advantage, returns = estimate_advantages(**given, gamma=0.5, gae_lambda=0.5)
    assert advantage[:, 0].tolist() == [0.25, 1.0, 2.0] and returns[:, 0].tolist() == [2.25, 5.0, 3.0]


def test_normalised_advantages_and_explained_variance() -> None:
    found = normalise(torch.tensor([1.0, 2.0, 3.0, 6.0]))  # mean 3, deviation √3.5
    assert found.tolist() == pytest.approx([(x - 3) / (3.5**0.5 + 1e-5) for x in (1, 2, 3, 6)])
    returns = torch.tensor([0.0, 1.0, 0.0, 1.0])
    assert explained_variance(returns + 5, returns) == pytest.approx(1.0)  # an offset is not variance
    assert explained_variance(torch.zeros(4), returns) == pytest.approx(0.0)
