"""AdamW that moves the matrices of hidden layers by Muon: fewer rows until the same error, where weights start at random.

Muon (Jordan et al. 2024) replaces a matrix's momentum by the nearest one whose singular values are all about 1, so that rare
directions learn as fast as frequent ones. Steps are as long as AdamW's, 0.2 · √(longer side), and take its learning rate (Liu et
al. 2025, Muon is Scalable for LLM Training, §2.2). ``torch.optim.Muon`` computes that in bfloat16, one matrix after another: on
a CPU tiny's 42 took 0.22 CPU-s a step, here 0.02 (n = 5, one thread).
"""

import math
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.optim import AdamW

BY_MUON = "by_muon"  # of a parameter group: its matrices are moved by Muon
_MOMENTUM = 0.95
_COEFFICIENTS = 3.4445, -4.775, 2.0315  # of Jordan's quintic: steep at 0, what is in 0.7 … 1.2 stays about there
_STEPS = 5
_RMS = 0.2  # of AdamW's steps, per learning rate


class MuonAdamW(AdamW):
    """AdamW; parameter groups with ``by_muon`` hold matrices and are moved by Muon."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # A scaler of gradients leaves it to AdamW's fused kernel to skip a step with an overflow; Muon has no such kernel.
        self._step_supports_amp_scaling = False

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """One step of all groups; what ``closure`` gives, which computes gradients anew."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        # AdamW leaves alone what has no gradient.
        held = [(p, p.grad, group) for group in self.param_groups if group.get(BY_MUON) for p in group["params"]]
        for p, _, _ in held:
            p.grad = None
        super().step()
        alike: defaultdict[Any, list[tuple[Tensor, Tensor, dict[str, Any]]]] = defaultdict(list)
        for p, gradient, group in held:
            p.grad = gradient
            if gradient is not None:
                alike[p.shape, p.device, p.dtype].append((p, self._update(p, gradient), group))
        for same in alike.values():
            directions = orthogonal(torch.stack([update for _, update, _ in same]))
            for (p, _, group), direction in zip(same, directions, strict=True):
                length = group["lr"] * _RMS * math.sqrt(max(p.shape))
                # In float32, rounded once: 1 − lr · decay is 1 in bfloat16.
                p.copy_(p.to(torch.float32) * (1 - group["lr"] * group["weight_decay"]) - length * direction)
        return loss

    def _update(self, p: Tensor, gradient: Tensor) -> Tensor:
        """Nesterov's momentum."""
        state = self.state[p]
        if not state:
            state["step"] = torch.zeros(())  # AdamW looks for it where a state is loaded
            state["momentum_buffer"] = torch.zeros_like(gradient)
        state["step"] += 1
        state["momentum_buffer"].lerp_(gradient, 1 - _MOMENTUM)
        return gradient.lerp(state["momentum_buffer"], _MOMENTUM)


def orthogonal(matrices_NRC: Tensor) -> Tensor:
    """(N, R, C) → each with its singular vectors, singular values 0.7 … 1.2 but for those a hundred times below the largest,
    which are raised less. Newton-Schulz iterations in float32."""
    x = matrices_NRC.to(torch.float32)
    is_tall = x.shape[1] > x.shape[2]
    if is_tall:
        x = x.mT
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=1e-7)
    a, b, c = _COEFFICIENTS
    for _ in range(_STEPS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.mT if is_tall else x
