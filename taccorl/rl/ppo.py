"""Clipped PPO over chunks (Schulman et al., arXiv 1707.06347), where each optimiser step of the actor also
minimises the flow loss on real data (``anchor``).

    ratio = exp(log π(chunk) − log π_old(chunk))
    L_PPO = −E[min(ratio · A, clip(ratio, 1 − ε, 1 + ε) · A)]        L = L_PPO + β · ℓ_flow(real)

Log-probabilities are summed over the executed numbers of a chunk: one ratio for each decision. The critic has an optimiser and a
gradient norm of its own, and learns from stored features: it needs no pass through the policy.

Clipping does not bound a step: the gradient is computed before it. So KL(π_old ‖ π) is measured after each step of the actor; a
step after which it is above ``kl_stop`` is undone, weights and moments, and ends the updates of the iteration.

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
"""Largest accepted |ratio − 1| at the first minibatch of an iteration; above it sampling and scoring differ, which is an
error."""
FIRST_STEP_UNDONE, LATER_STEP_UNDONE, SMALL_STEPS = 0.5, 0.7, 1.2
"""Factors on the actor's learning rate (``adapt_lr``): after a first step that was undone, after a later one, and after small
steps only."""
SMALL_KL = 0.2
"""Share of ``kl_stop`` below which the steps of an iteration are small."""
MOST_LR = 10.0
"""Largest learning rate of ``adapt_lr``, in multiples of the initial one."""


@dataclass(frozen=True)
class Decisions:
    """M decisions of a rollout, the data of an update.

    ``before``, ``after`` and ``step`` are the stochastic steps as in ``Sampled`` and ``Draws``; ``log_prob`` is that of the
    policy which sampled them. ``advantage`` is not normalised.
    """

    batch: Batch
    """Preprocessed inputs of the policy: key → tensor with M rows."""
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
        """Decisions of the indices ``rows``, (m,) int64, in this order."""
        others = {k: x[rows] for k, x in vars(self).items() if k != "batch"}
        return Decisions(batch={k: x[rows] for k, x in self.batch.items()}, **others)


class StepUndo:
    """Copies of an optimiser's weights and Adam's moments, to undo its last step.

    Memory: 12 bytes for each trained float32 weight, on the policy's device: 3.6 GB for action expert and touch of the full size
    (0.3 billion weights), 40 GB for all of it (3.3 billion), 0.14 GB for ``small``.
    """

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        self._optimizer = optimizer
        self._kept: list[tuple[Tensor, Tensor, dict[str, Tensor]]] = []

    @torch.no_grad()
    def keep(self) -> None:
        """Store the present weights and moments."""
        self._kept = []  # first, so that memory is that of one copy
        for p in (p for group in self._optimizer.param_groups for p in group["params"]):
            self._kept.append((p, p.clone(), {k: x.clone() for k, x in self._optimizer.state.get(p, {}).items()}))

    @torch.no_grad()
    def restore(self) -> None:
        """Restore weights and moments of the last ``keep``. Learning rates are not changed."""
        for p, weight, moments in self._kept:
            p.copy_(weight)
            self._optimizer.state.pop(p, None)
            if moments:  # Adam makes them in its first step
                self._optimizer.state[p] = moments


class PPO:
    """Actor, critic, their optimisers, and one update with the decisions of a rollout."""

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
            ratio_guard: limit on |ratio − 1| at the first minibatch; inf if kernels round too coarsely for it (TF32).
        """
        self.actor, self.critic, self.sde, self.settings, self.anchor = actor, critic, sde, settings, anchor
        self.ratio_guard = ratio_guard
        self.actor_optimizer = self._adam(actor.trained_parameters(), settings.actor_lr)
        self.critic_optimizer = self._adam(list(critic.parameters()), settings.critic_lr)
        self._undo = StepUndo(self.actor_optimizer)
        self.num_updates = 0
        """Number of calls of ``update``."""

    @property
    def actor_lr(self) -> float:
        """Learning rate of the actor for the next steps."""
        return self.actor_optimizer.param_groups[0]["lr"]

    @actor_lr.setter
    def actor_lr(self, value: float) -> None:
        self.actor_optimizer.param_groups[0]["lr"] = value

    def _adam(self, parameters: Sequence[nn.Parameter], lr: float) -> torch.optim.AdamW:
        return torch.optim.AdamW(parameters, lr, betas=(0.9, 0.95), weight_decay=self.settings.weight_decay)

    def update(self, decisions: Decisions, generator: torch.Generator) -> dict[str, float]:
        """Train on a rollout; each decision is used once in each epoch.

        Args:
            generator: random generator on the CPU for the order, and for the anchor's rows.

        Returns:
            Means over the optimiser steps; counts (``actor_steps`` includes ``undone_steps``); ``last_kl`` of the final policy;
            ``actor_lr`` of these steps.

        Raises:
            TaccorlError: a first ratio differs from 1 by more than ``ratio_guard``.
        """
        settings, steps, actor_lr = self.settings, list[dict[str, float]](), self.actor_lr
        for _ in range(settings.critic_epochs):
            for rows in self._minibatches(len(decisions), generator):
                steps.append(self._critic_step(decisions, rows))
        counts = {"actor_steps": 0, "skipped_steps": 0, "kl_stopped": 0, "undone_steps": 0}
        counts["skipped_steps"] += sum(not math.isfinite(step["critic_grad_norm"]) for step in steps)
        if self.num_updates >= settings.critic_warmup:
            last_kl = self._train_actor(decisions, normalise(decisions.advantage_M), generator, steps, counts)
            steps.append({"last_kl": last_kl})
            if settings.adapt_lr:
                self._adapt_lr(last_kl, counts)
        self.num_updates += 1
        facts: dict[str, list[float]] = {}
        for name, value in (item for step in steps for item in step.items()):
            facts.setdefault(name, []).append(value)
        return {name: sum(values) / len(values) for name, values in facts.items()} | counts | {"actor_lr": actor_lr}

    def _train_actor(
        self,
        decisions: Decisions,
        advantage_M: Tensor,
        generator: torch.Generator,
        steps: list[dict[str, float]],
        counts: dict[str, int],
    ) -> float:
        """All epochs, or up to the first step that goes too far; KL of the policy that remains, as last measured."""
        kept_kl, is_measured, probe = 0.0, True, torch.arange(0)
        for epoch in range(self.settings.epochs):
            for k, rows in enumerate(self._minibatches(len(decisions), generator)):
                probe = rows if k == 0 else probe
                found = self._actor_gradient(decisions.rows(rows), advantage_M[rows], generator, epoch == k == 0)
                steps.append(found)
                if self._goes_too_far(found["kl"], counts, is_measured):
                    return kept_kl
                kept_kl = found["kl"]
                self._undo.keep()
                is_measured = not self._step(self.actor_optimizer, found["actor_grad_norm"])
                counts["skipped_steps" if is_measured else "actor_steps"] += 1
        if not is_measured:  # no minibatch came after the last step
            kl = self._measure_kl(decisions.rows(probe))
            kept_kl = kept_kl if self._goes_too_far(kl, counts, is_measured) else kl
        return kept_kl

    def _goes_too_far(self, kl: float, counts: dict[str, int], is_measured: bool) -> bool:
        """Whether updates end here; the last step is undone unless a smaller KL was measured after it."""
        if kl <= self.settings.kl_stop:  # false for NaN
            return False
        counts["kl_stopped"] = 1
        if not is_measured:
            self._undo.restore()
            counts["undone_steps"] += 1
        return True

    @torch.no_grad()
    def _measure_kl(self, rows: Decisions) -> float:
        return kl_divergence(torch.cat([self._log_ratios(rows.rows(part)) for part in self._micro_batches(rows)]))

    def _adapt_lr(self, last_kl: float, counts: dict[str, int]) -> None:
        """Smaller after a step that was undone, larger after an iteration of small ones."""
        if counts["undone_steps"]:
            self.actor_lr *= FIRST_STEP_UNDONE if counts["actor_steps"] == 1 else LATER_STEP_UNDONE
        elif counts["actor_steps"] and not counts["kl_stopped"] and last_kl < SMALL_KL * self.settings.kl_stop:
            self.actor_lr = max(self.actor_lr, min(SMALL_STEPS * self.actor_lr, MOST_LR * self.settings.actor_lr))

    def _minibatches(self, num: int, generator: torch.Generator) -> Sequence[Tensor]:
        order = torch.randperm(num, generator=generator).to(self.actor.scored_HD.device)
        return order.split(self.settings.batch_size)

    def _micro_batches(self, rows: Decisions) -> Sequence[Tensor]:
        return torch.arange(len(rows), device=rows.log_prob_M.device).split(self.settings.micro_batch)

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
        for part in self._micro_batches(rows):
            log_ratio_M = self._log_ratios(rows.rows(part))
            loss = policy_loss(log_ratio_M, advantage_M[part], self.settings.clip) * (len(part) / len(rows))
            loss.backward()
            log_ratios.append(log_ratio_M.detach())
            losses.append(loss.detach())
        log_ratio_M = torch.cat(log_ratios)
        error_M = (log_ratio_M.exp() - 1).abs()
        found = {
            "actor_loss": float(torch.stack(losses).sum()),
            "kl": kl_divergence(log_ratio_M),
            "clip_fraction": float((error_M > self.settings.clip).float().mean()),
        }
        if is_first:
            found["first_ratio_error"] = float(error_M.max())
            self._guard(found["first_ratio_error"])
        if self.anchor is not None:
            found["anchor_loss"] = self.anchor.backward(generator, self.settings.micro_batch)
        parameters = self.actor.trained_parameters()
        return found | {"actor_grad_norm": float(nn.utils.clip_grad_norm_(parameters, self.settings.max_grad_norm))}

    def _log_ratios(self, rows: Decisions) -> Tensor:
        """(M,) log π − log π_old."""
        now_M = self.actor.log_prob(rows.batch, self.sde, rows.before_MSHD, rows.after_MSHD, rows.step_MS)
        return now_M - rows.log_prob_M

    def _guard(self, error: float) -> None:
        if not error <= self.ratio_guard:  # nor NaN
            raise TaccorlError(
                "post-training: before the first update of an iteration the ratio of probabilities differs from 1 by "
                f"{error:.2g}, more than the allowed {self.ratio_guard:g}: sampling and scoring do not compute the same "
                "policy. Check that its weights are float32, and that --policy.tf32=false"
            )

    def _step(self, optimizer: torch.optim.Optimizer, grad_norm: float) -> bool:
        """Step, unless a gradient is not finite; whether it was done."""
        if math.isfinite(grad_norm):
            optimizer.step()
            return True
        optimizer.zero_grad()
        return False

    def state_dict(self) -> dict[str, Any]:
        """State of critic, optimisers and counters, without the policy's weights, as ``load_state_dict`` takes it."""
        parts = (self.critic, self.actor_optimizer, self.critic_optimizer)
        names = ("critic", "actor_optimizer", "critic_optimizer")
        states = {name: part.state_dict() for name, part in zip(names, parts, strict=True)}
        return states | {"num_updates": self.num_updates}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from ``state_dict``."""
        self.critic.load_state_dict(state["critic"])
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])
        self.num_updates = state["num_updates"]


def policy_loss(log_ratio_M: Tensor, advantage_M: Tensor, clip: float) -> Tensor:
    """Clipped loss of PPO, L_PPO (a scalar). ``advantage_M`` is normalised; ``clip`` is ε."""
    ratio_M = log_ratio_M.exp()
    return -torch.minimum(ratio_M * advantage_M, ratio_M.clamp(1 - clip, 1 + clip) * advantage_M).mean()


def kl_divergence(log_ratio_M: Tensor) -> float:
    """Estimate of KL(π_old ‖ π) [nat]: mean of ratio − 1 − log ratio, which is never negative (k3 of Schulman's note)."""
    return float((log_ratio_M.exp() - 1 - log_ratio_M).mean())
