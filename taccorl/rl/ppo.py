"""Clipped PPO over chunks (Schulman et al., arXiv 1707.06347), where each optimiser step of the actor also
minimises the flow loss on real data (``anchor``).

    ratio = exp(log π(chunk) − log π_old(chunk))
    L_PPO = −E[min(ratio · A, clip(ratio, 1 − ε, 1 + ε) · A)]        L = L_PPO + β · ℓ_flow(real)

Log-probabilities are summed over the executed numbers of a chunk: one ratio for each decision. The critic has an optimiser and a
gradient norm of its own, and learns from stored features: it costs no pass through the policy.

Letters in shapes: M decisions of a rollout, S stochastic steps, H horizon, D padded action, F features, P privileged numbers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from taccorl.errors import TaccorlError
from taccorl.rl.advantages import normalise
from taccorl.rl.anchor import Anchor
from taccorl.rl.critic import Critic
from taccorl.rl.flow_policy import Batch, FlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.settings import PPOSettings

RATIO_GUARD = 1e-3
"""|ratio − 1| at the first minibatch of an iteration, above which sampling and scoring are not the same policy."""


@dataclass(frozen=True)
class Decisions:
    """M decisions of a rollout, for an update."""

    batch: Batch
    before_MSHD: Tensor
    after_MSHD: Tensor
    step_MS: Tensor
    log_prob_M: Tensor
    features_MF: Tensor
    privileged_MP: Tensor
    advantage_M: Tensor
    return_M: Tensor

    def __len__(self) -> int:
        return len(self.log_prob_M)

    def rows(self, rows: Tensor) -> "Decisions":
        """Some of them."""
        others = {k: x[rows] for k, x in vars(self).items() if k != "batch"}
        return Decisions(batch={k: x[rows] for k, x in self.batch.items()}, **others)


class PPO:
    """Actor, critic, their optimisers, and one update."""

    def __init__(
        self,
        actor: FlowPolicy,
        critic: Critic,
        sde: FlowSDE,
        settings: PPOSettings,
        anchor: Anchor | None = None,
        *,
        ratio_guard: float = RATIO_GUARD,
    ) -> None:
        """
        Args:
            ratio_guard: inf where kernels round too coarsely for a guard (TF32).
        """
        self.actor, self.critic, self.sde, self.settings, self.anchor = actor, critic, sde, settings, anchor
        self.ratio_guard = ratio_guard
        self.actor_optimizer = self._adam(actor.trained_parameters(), settings.actor_lr)
        self.critic_optimizer = self._adam(list(critic.parameters()), settings.critic_lr)
        self.num_updates = 0
        """Calls of ``update``."""

    def _adam(self, parameters: Sequence[nn.Parameter], lr: float) -> torch.optim.AdamW:
        return torch.optim.AdamW(parameters, lr, betas=(0.9, 0.95), weight_decay=self.settings.weight_decay)

    def update(self, decisions: Decisions, generator: torch.Generator) -> dict[str, float]:
        """Train on a rollout; each decision is used once in each epoch.

        Args:
            generator: on the CPU; draws the order, and the anchor's rows.

        Returns:
            Means over the optimiser steps, and counts.

        Raises:
            TaccorlError: the first ratios are not 1.
        """
        settings = self.settings
        advantage_M = normalise(decisions.advantage_M)
        facts: dict[str, list[float]] = {}
        for _ in range(settings.critic_epochs):
            for rows in self._minibatches(len(decisions), generator):
                _append(facts, self._critic_step(decisions, rows))
        counts = {"actor_steps": 0, "skipped_steps": 0, "kl_stopped": 0}
        if self.num_updates >= settings.critic_warmup:
            for epoch in range(settings.epochs):
                for k, rows in enumerate(self._minibatches(len(decisions), generator)):
                    is_first = epoch == k == 0
                    found = self._actor_gradient(decisions.rows(rows), advantage_M[rows], generator, is_first)
                    _append(facts, found)
                    if found["kl"] > settings.kl_stop:
                        counts["kl_stopped"] = 1
                        break
                    stepped = self._step(self.actor_optimizer, facts["actor_grad_norm"][-1])
                    counts["actor_steps" if stepped else "skipped_steps"] += 1
                if counts["kl_stopped"]:
                    break
        counts["skipped_steps"] += sum(not math.isfinite(x) for x in facts["critic_grad_norm"])
        self.num_updates += 1
        return {name: sum(values) / len(values) for name, values in facts.items()} | counts

    def _minibatches(self, num: int, generator: torch.Generator) -> Sequence[Tensor]:
        order = torch.randperm(num, generator=generator).to(self.actor.scored_HD.device)
        return order.split(self.settings.batch_size)

    def _critic_step(self, decisions: Decisions, rows: Tensor) -> dict[str, float]:
        self.critic_optimizer.zero_grad()
        values = self.critic(decisions.features_MF[rows], decisions.privileged_MP[rows])
        loss = 0.5 * ((values - decisions.return_M[rows]) ** 2).mean()
        loss.backward()
        norm = float(nn.utils.clip_grad_norm_(self.critic.parameters(), self.settings.max_grad_norm))
        self._step(self.critic_optimizer, norm)
        return {"critic_loss": float(loss.detach()), "critic_grad_norm": norm}

    def _actor_gradient(
        self, rows: Decisions, advantage_M: Tensor, generator: torch.Generator, is_first: bool
    ) -> dict[str, float]:
        """Accumulate the gradient of L over micro-batches, then clip it."""
        self.actor_optimizer.zero_grad()
        log_ratios, losses = [], []
        parts = torch.arange(len(rows), device=advantage_M.device).split(self.settings.micro_batch)
        for part in parts:
            own = rows.rows(part)
            log_ratio_M = (
                self.actor.log_prob(own.batch, self.sde, own.before_MSHD, own.after_MSHD, own.step_MS) - own.log_prob_M
            )
            loss = policy_loss(log_ratio_M, advantage_M[part], self.settings.clip) * (len(part) / len(rows))
            loss.backward()
            log_ratios.append(log_ratio_M.detach())
            losses.append(loss.detach())
        log_ratio_M = torch.cat(log_ratios)
        ratio_M = log_ratio_M.exp()
        found = {
            "actor_loss": float(torch.stack(losses).sum()),
            "kl": float((ratio_M - 1 - log_ratio_M).mean()),
            "clip_fraction": float(((ratio_M - 1).abs() > self.settings.clip).float().mean()),
        }
        if is_first:
            found["first_ratio_error"] = float((ratio_M - 1).abs().max())
            self._guard(found["first_ratio_error"])
        if self.anchor is not None:
            found["anchor_loss"] = self.anchor.backward(generator, self.settings.micro_batch)
        parameters = self.actor.trained_parameters()
        found["actor_grad_norm"] = float(nn.utils.clip_grad_norm_(parameters, self.settings.max_grad_norm))
        return found

    def _guard(self, error: float) -> None:
        if not error <= self.ratio_guard:  # nor NaN
            raise TaccorlError(
                f"post-training: before the first update of an iteration the ratio of probabilities is off 1 by {error:.2g}, "
                f"allowed is {self.ratio_guard:g}: sampling and scoring do not compute the same policy. Check that its weights "
                "are float32, and that --policy.tf32=false"
            )

    def _step(self, optimizer: torch.optim.Optimizer, grad_norm: float) -> bool:
        """Step, unless a gradient is not finite; whether it was done."""
        if math.isfinite(grad_norm):
            optimizer.step()
            return True
        optimizer.zero_grad()
        return False

    def state_dict(self) -> dict[str, Any]:
        """All but the policy's weights."""
        return {
            "critic": self.critic.state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
            "critic_optimizer": self.critic_optimizer.state_dict(),
            "num_updates": self.num_updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """What ``state_dict`` gave."""
        self.critic.load_state_dict(state["critic"])
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])
        self.num_updates = state["num_updates"]


def policy_loss(log_ratio_M: Tensor, advantage_M: Tensor, clip: float) -> Tensor:
    """L_PPO, a scalar."""
    ratio_M = log_ratio_M.exp()
    return -torch.minimum(ratio_M * advantage_M, ratio_M.clamp(1 - clip, 1 + clip) * advantage_M).mean()


def _append(facts: dict[str, list[float]], found: dict[str, float]) -> None:
    for name, value in found.items():
        facts.setdefault(name, []).append(value)
