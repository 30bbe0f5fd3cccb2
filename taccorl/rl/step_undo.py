"""Undo the last step of an optimiser: restore weights and Adam's moments to the values before it.

Memory: one copy of the trained weights and of both moments, 12 bytes for each float32 weight, on the policy's device: 3.6 GB for
action expert and touch of the full size (0.3 billion weights), 40 GB for all of it (3.3 billion), 0.14 GB for ``small``.
"""

import torch
from torch import Tensor


class StepUndo:
    """Copies of an optimiser's weights and moments, to restore them."""

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        self._optimizer = optimizer
        self._weights: list[Tensor] = []
        self._states: list[dict[str, Tensor]] = []

    def _parameters(self) -> list[Tensor]:
        return [p for group in self._optimizer.param_groups for p in group["params"]]

    @torch.no_grad()
    def keep(self) -> None:
        """Store the present weights and moments. Memory is allocated once."""
        parameters = self._parameters()
        states = [self._optimizer.state.get(p, {}) for p in parameters]
        if [s.keys() for s in states] != [s.keys() for s in self._states]:  # Adam makes its moments in the first step
            self._weights = [torch.empty_like(p) for p in parameters]
            self._states = [{name: torch.empty_like(x) for name, x in state.items()} for state in states]
        for kept, p in zip(self._weights, parameters, strict=True):
            kept.copy_(p)
        for kept, state in zip(self._states, states, strict=True):
            for name, x in state.items():
                kept[name].copy_(x)

    @torch.no_grad()
    def restore(self) -> None:
        """Restore weights and moments of the last ``keep``. Learning rates are not changed."""
        for p, kept, state in zip(self._parameters(), self._weights, self._states, strict=True):
            p.copy_(kept)
            if not state:  # there were no moments yet
                self._optimizer.state.pop(p, None)
            for name, x in state.items():
                self._optimizer.state[p][name].copy_(x)
