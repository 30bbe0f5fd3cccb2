"""LeRobot's optimiser and schedule with the paper's warm-up, and with PyTorch's fused kernel on a GPU."""

from dataclasses import dataclass
from typing import Any

from lerobot.optim.optimizers import AdamWConfig, OptimizerConfig, OptimizerParams
from lerobot.optim.schedulers import (
    CosineDecayWithWarmupSchedulerConfig,
    LRSchedulerConfig,
)
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR


@LRSchedulerConfig.register_subclass("warmup_then_cosine")
@dataclass
class WarmupThenCosine(CosineDecayWithWarmupSchedulerConfig):
    """LeRobot's cosine schedule over the whole training, with a warm-up of fixed length.

    LeRobot's own schedule shortens the warm-up with the training (100 of 3000 steps become 33 of 1000); the paper uses 100 in
    both cases."""

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=min(self.num_warmup_steps, num_training_steps),
            num_decay_steps=num_training_steps,
            peak_lr=self.peak_lr or 1.0,  # LeRobot divides by it
            decay_lr=self.decay_lr,
        ).build(optimizer, num_training_steps)


@OptimizerConfig.register_subclass("fused_adamw")
@dataclass
class FusedAdamW(AdamWConfig):
    """LeRobot's AdamW, on a GPU with PyTorch's fused kernel, which takes half the time and rounds bfloat16 weights once per
    step."""

    def build(self, params: OptimizerParams) -> AdamW:
        groups: Any = super().build(params).param_groups
        fused = all(p.is_cuda for group in groups for p in group["params"])
        return AdamW([{**group, "fused": fused} for group in groups], fused=fused)
