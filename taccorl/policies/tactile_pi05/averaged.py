"""Exponential mean of a network's weights over training; the policy acts with the mean.

    m ← d_n m + (1 − d_n) w,    d_n = min(d, (1 + n) / (10 + n))    after optimiser step n

d_n increases with n, so that the random initial weights are forgotten (as in TensorFlow's ExponentialMovingAverage). The mean
averages the noise of the last steps.
"""

import torch
from torch import Tensor, nn


class Averaged(nn.Module):
    """Exponential mean of the floating-point parameters of ``network``, in buffers that checkpoints hold. In training,
    ``network`` holds the trained weights; in use, they are exchanged with the mean."""

    num_updates: Tensor
    """Number of calls of ``update``, an int64 scalar."""

    def __init__(self, network: nn.Module, decay: float) -> None:
        super().__init__()
        self.decay = decay
        self.register_buffer("num_updates", torch.zeros((), dtype=torch.int64))
        for name, weight in network.named_parameters():
            self.register_buffer(_key(name), weight.detach().clone())

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Update the mean from the weights of ``network`` after a step of the optimiser."""
        self.num_updates += 1
        # A tensor, so that nothing is read back from a GPU.
        decay = ((1 + self.num_updates) / (10 + self.num_updates)).clamp(max=self.decay)
        means = [self.get_buffer(_key(name)) for name, _ in network.named_parameters()]
        weights = [weight.detach() for weight in network.parameters()]
        torch._foreach_mul_(means, decay)  # pyright: ignore[reportPrivateImportUsage]
        shares = torch._foreach_mul(weights, 1 - decay)  # pyright: ignore[reportPrivateImportUsage]
        torch._foreach_add_(means, shares)  # pyright: ignore[reportPrivateImportUsage]

    @torch.no_grad()
    def exchange(self, network: nn.Module) -> None:
        """Swap the weights of ``network`` with their mean. Only references are swapped, no numbers are copied."""
        for name, weight in network.named_parameters():
            mean = self.get_buffer(_key(name))
            weight.data, mean.data = mean.data, weight.data


def _key(name: str) -> str:
    return name.replace(".", "/")  # buffers have no dots in their names
