"""The critic: a value head on the mean token of the policy's prefix (paper), by option with the simulator's state beside it.

The prefix is computed by the policy and detached: no gradient of the critic reaches the policy.

Letters in shapes: B decisions, F features, P privileged numbers.
"""

import torch
from torch import Tensor, nn

_HIDDEN = (1024, 512, 256)  # as RLinf's ValueHead
_LAST_STD = 0.02  # values start near 0
_MAX_NORMALISED = 10.0


class Critic(nn.Module):
    """Value head: (B, F) features and (B, P) privileged numbers of the simulator's state → (B,) values. B decisions."""

    mean_P: Tensor
    """Mean of each privileged number so far; ``square_P`` is the sum of squared deviations from it, ``count`` the number of
    rows."""
    square_P: Tensor
    count: Tensor

    def __init__(
        self,
        num_features: int,
        num_privileged: int = 0,
        hidden: tuple[int, ...] = _HIDDEN,
    ) -> None:
        super().__init__()
        layers, width = list[nn.Module](), num_features + num_privileged
        for next_width in hidden:
            layers += [nn.Linear(width, next_width), nn.ReLU()]
            width = next_width
        last = nn.Linear(width, 1)
        nn.init.normal_(last.weight, std=_LAST_STD)
        nn.init.zeros_(last.bias)
        self.head = nn.Sequential(*layers, last)
        self.register_buffer("mean_P", torch.zeros(num_privileged))
        self.register_buffer(
            "square_P", torch.zeros(num_privileged)
        )  # sum of squared distances from the mean
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def observe(self, privileged_BP: Tensor) -> None:
        """Update mean and deviation of the privileged numbers, with which they are normalised (Chan's parallel variance)."""
        added = len(privileged_BP)
        total = self.count + added
        mean_P, distance_P = privileged_BP.mean(0), privileged_BP.mean(0) - self.mean_P
        spread_P = ((privileged_BP - mean_P) ** 2).sum(0)
        self.square_P += spread_P + distance_P**2 * (self.count * added / total).float()
        self.mean_P += distance_P * (added / total).float()
        self.count.copy_(total)

    def forward(self, features_BF: Tensor, privileged_BP: Tensor) -> Tensor:
        """Value (B,) of each row. Gradients do not flow into the features; P may be 0."""
        std_P = (self.square_P / self.count.clamp(min=1).float()).sqrt()
        normalised_BP = (privileged_BP - self.mean_P) / (std_P + 1e-6)
        normalised_BP = normalised_BP.clamp(-_MAX_NORMALISED, _MAX_NORMALISED)
        return self.head(torch.cat([features_BF.detach(), normalised_BP], dim=1))[:, 0]
