"""Simulated and real rows in one loss, paper eq. 7: L = α · E_sim[ℓ] + (1 − α) · E_real[ℓ], for any share of simulated rows.

A row is drawn from the merged dataset with probability p of being simulated, so with the weights

    w = α / p  where simulated,  (1 − α) / (1 − p)  where real

the mean of w · ℓ over a batch is L in expectation, and over the whole dataset it is L exactly.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from taccorl.errors import TaccorlError

IS_SIM = "observation.is_sim"
"""Feature that is 1 for a simulated row and 0 for a real one (or one of a surrogate that stands for the real robot); shape
(1,)."""
_ROUNDING = (
    1e-9  # LeRobot's mean of the means of episodes, all of them 1, may be off by this
)


@dataclass(frozen=True)
class Mixture:
    """Weights of simulated and real rows in the loss: the weight α of the simulated loss, and the share of simulated rows."""

    sim_weight: float
    """α: weight of the simulated loss."""
    sim_share: float
    """p: number of simulated rows / number of all rows."""

    def __post_init__(self) -> None:
        """Raises TaccorlError: a domain with a weight above 0 has no rows."""
        if not 0 <= self.sim_weight <= 1:
            raise TaccorlError(
                f"--policy.sim_weight={self.sim_weight}: α is a share, 0 … 1"
            )
        for name, weight, share, other in (
            ("simulated", self.sim_weight, self.sim_share, 0),
            ("real", 1 - self.sim_weight, 1 - self.sim_share, 1),
        ):
            if weight > 0 and share == 0:
                raise TaccorlError(
                    f"--policy.sim_weight={self.sim_weight:g} gives {name} rows the weight {weight:g}, but according to "
                    f"{IS_SIM} the dataset has no such rows: merge {name} data into it, or --policy.sim_weight={other}"
                )

    @classmethod
    def of_statistics(
        cls, stats: Mapping[str, Mapping[str, Any]] | None, sim_weight: float
    ) -> "Mixture | None":
        """Make the weights from a dataset's statistics. ``stats``: the dataset's statistics in LeRobot's form; None or without
        ``observation.is_sim``: one domain. Raises TaccorlError: a domain with a weight above 0 has no rows, or α is not in 0
        … 1."""
        if not stats or IS_SIM not in stats:
            return None
        share = float(torch.as_tensor(stats[IS_SIM]["mean"]).reshape(()))
        return cls(
            sim_weight,
            float(round(share)) if abs(share - round(share)) < _ROUNDING else share,
        )

    def weights(self, is_sim_B: Tensor) -> Tensor:
        """(B,) weight w of each row; 0 for a domain whose loss has weight 0."""
        sim = self.sim_weight / self.sim_share if self.sim_weight > 0 else 0.0
        real = (
            (1 - self.sim_weight) / (1 - self.sim_share) if self.sim_weight < 1 else 0.0
        )
        return torch.where(is_sim_B, sim, real)

    def means(self, losses_B: Tensor, is_sim_B: Tensor) -> dict[str, Tensor]:
        """Return ``loss_sim`` and ``loss_real`` (scalars): each domain's expected loss as this batch estimates it from the rows'
        losses.

        The sum of ℓ over a domain's rows is divided by the expected, not the actual, number of its rows in a batch, so that loss
        = α · loss_sim + (1 − α) · loss_real in every batch, also in a batch without rows of one domain."""
        of_sim = torch.where(is_sim_B, losses_B, 0).mean()
        means = {}
        if self.sim_share > 0:
            means["loss_sim"] = of_sim / self.sim_share
        if self.sim_share < 1:
            means["loss_real"] = (losses_B.mean() - of_sim) / (1 - self.sim_share)
        return means
