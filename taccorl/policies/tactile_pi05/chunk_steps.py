"""Normalisation of each step of an action chunk with its own mean and deviation.

LeRobot normalises all steps of a chunk by one range for each number of an action. Of relative actions the first step is
several times smaller than the last, so errors of the first steps hardly count. Here step h, number a becomes

    z = (x − μ_ha) / σ_ha        with mean μ and deviation σ of the normalised x over the rows that are trained on
"""

from typing import Any

import torch
from lerobot.configs import NormalizationMode
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from taccorl.errors import TaccorlError

STEP_STATISTICS = ("step_mean", "step_std")
"""Keys of a dataset's statistics of ``ACTION``, each (H, A), in the units of actions; ``taccorl.training.reading`` computes
them."""
LEAST_STD = 0.01
"""Lower bound of σ in LeRobot-normalised actions, whose range is 2: errors of an action that hardly moves are not amplified."""


class ChunkSteps(nn.Module):
    """Normalisation of each step of a chunk with its own mean μ and deviation σ, (H, A), stored in a policy's checkpoint. Before
    they are set from a dataset they are 0 and 1."""

    mean_HA: Tensor
    std_HA: Tensor

    def __init__(self, horizon: int, num_actions: int) -> None:
        super().__init__()
        self.register_buffer("mean_HA", torch.zeros(horizon, num_actions))
        self.register_buffer("std_HA", torch.ones(horizon, num_actions))

    @classmethod
    def of_statistics(
        cls, statistics: Any, config: Any, num_actions: int
    ) -> "ChunkSteps":
        """Make the normalisation of chunks of A = ``num_actions`` values from LeRobot's ``statistics`` of a dataset; if they are
        None, or without ``STEP_STATISTICS``, μ and σ stay 0 and 1 until a checkpoint is loaded. ``config``: the policy's.
        Raises TaccorlError: actions are normalised by an unknown method."""
        steps = cls(config.chunk_size, num_actions)
        told = (statistics or {}).get(ACTION, {})
        if any(name not in told for name in STEP_STATISTICS):
            return steps
        mean, std = (
            torch.as_tensor(told[name], dtype=torch.float32) for name in STEP_STATISTICS
        )
        mode = config.normalization_mapping.get("ACTION", NormalizationMode.IDENTITY)
        limits = {
            NormalizationMode.QUANTILES: ("q01", "q99"),
            NormalizationMode.MIN_MAX: ("min", "max"),
        }
        if mode not in limits:
            raise TaccorlError(
                f"--policy.normalize_steps=true: with --policy.normalization_mapping of ACTION {mode.value}; give QUANTILES or "
                "MIN_MAX, or turn it off (--policy.normalize_steps=false)"
            )
        low, high = (
            torch.as_tensor(told[name], dtype=torch.float32) for name in limits[mode]
        )
        half = ((high - low) / 2).clamp(min=1e-8)
        steps.mean_HA.copy_((mean - low) / half - 1)
        steps.std_HA.copy_((std / half).clamp(min=LEAST_STD))
        return steps

    def normalized(self, actions_BHA: Tensor) -> Tensor:
        """Normalise the first n ≤ H steps of a chunk: x (B, n, A) → z (B, n, A)."""
        steps = actions_BHA.shape[-2]
        return (actions_BHA - self.mean_HA[:steps]) / self.std_HA[:steps]

    def restored(self, actions_BHA: Tensor) -> Tensor:
        """Undo the normalisation: z (B, n, A) → x (B, n, A)."""
        steps = actions_BHA.shape[-2]
        return actions_BHA * self.std_HA[:steps] + self.mean_HA[:steps]
