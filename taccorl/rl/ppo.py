"""Clipped PPO over chunks (Schulman et al., arXiv 1707.06347), where each optimiser step of the actor also
minimises the flow loss on real data (``anchor``).

    ratio = exp(log π(chunk) − log π_old(chunk))
    L_PPO = −E[min(ratio · A, clip(ratio, 1 − ε, 1 + ε) · A)]        L = L_PPO + β · ℓ_flow(real)

Log-probabilities are summed over the executed numbers of a chunk: one ratio for each decision. The critic has an optimiser and a
gradient norm of its own, and learns from stored features: it needs no pass through the policy.

Clipping does not bound a step: the gradient is computed before it. So KL(π_old ‖ π) is measured after each step of the actor; a
step after which it is above ``kl_stop`` is undone, weights and moments, and ends the updates of the iteration. For this a copy
of both is kept, 12 bytes for each trained float32 weight on the policy's device: 3.6 GB for action expert and touch of the full
size (0.3 billion weights), 40 GB for all of it (3.3 billion), 0.14 GB for ``small``.

Letters in shapes: M decisions of a rollout, S stochastic steps, H horizon, D padded action, F features, P privileged numbers.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
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

FIRST_STEP_UNDONE, LATER_STEP_UNDONE, SMALL_STEPS = 0.5, 0.7, 1.2
"""Factors on the actor's learning rate (``adapt_lr``): after a first step that was undone, after a later one, and after small
steps only."""
SMALL_KL = 0.2
"""Share of ``kl_stop`` below which the steps of an iteration are small."""
MOST_LR = 10.0
"""Largest learning rate of ``adapt_lr``, in multiples of the initial one."""
_PARTS = ("critic", "actor_optimizer", "critic_optimizer")  # of PPO's state


@dataclass(frozen=True)
class Decisions:
    """M decisions of a rollout, the data of an update.

    ``before``, ``after`` and ``step`` are the stochastic steps as in ``Sampled`` and ``Draws``; ``log_prob`` is that of the
    policy which sampled them. ``advantage`` is not normalised."""

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


class PPO:
    """Actor, critic, their optimisers, and one update with the decisions of a rollout."""

    ratio_guard = 1e-3
    """Largest accepted |ratio − 1| at the first minibatch of an iteration; above it sampling and scoring differ. inf if kernels
    round too coarsely for it (TF32)."""

    def __init__(
        self,
        actor: FlowPolicy,
        critic: Critic,
        sde: FlowSDE,
        settings: PPOSettings,
        anchor: Anchor | None = None,
    ) -> None:
        self.actor, self.critic, self.sde, self.settings, self.anchor = (
            actor,
            critic,
            sde,
            settings,
            anchor,
        )
        self.actor_optimizer = self._adam(actor.trained_parameters(), settings.actor_lr)
        self.critic_optimizer = self._adam(
            list(critic.parameters()), settings.critic_lr
        )
        self._before: Any = None
        """Copies of the actor's weights and of its optimiser's state from before the last step."""
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
        return torch.optim.AdamW(
            parameters, lr, betas=(0.9, 0.95), weight_decay=self.settings.weight_decay
        )

    def update(
        self, decisions: Decisions, generator: torch.Generator
    ) -> dict[str, float]:
        """Train on a rollout; each decision is used once in each epoch.

        Args:
            generator: random generator on the CPU for the order, and for the anchor's rows.

        Returns:
            Means over the optimiser steps; counts (``actor_steps`` includes ``undone_steps``); ``last_kl`` of the final policy;
            ``actor_lr`` of these steps.

        Raises:
            TaccorlError: a first ratio differs from 1 by more than ``ratio_guard``.
        """
        settings, steps, actor_lr = (
            self.settings,
            list[dict[str, float]](),
            self.actor_lr,
        )
        for _ in range(settings.critic_epochs):
            steps += [
                self._critic_step(decisions, rows)
                for rows in self._minibatches(len(decisions), generator)
            ]
        counts = {
            "actor_steps": 0,
            "skipped_steps": 0,
            "kl_stopped": 0,
            "undone_steps": 0,
        }
        counts["skipped_steps"] += sum(
            not math.isfinite(step["critic_grad_norm"]) for step in steps
        )
        if self.num_updates >= settings.critic_warmup:
            decisions = replace(decisions, advantage_M=normalise(decisions.advantage_M))
            actor_steps, last_kl = self._train_actor(decisions, generator, counts)
            steps += [*actor_steps, {"last_kl": last_kl}]
            if settings.adapt_lr:
                self._adapt_lr(last_kl, counts)
        self.num_updates += 1
        facts: dict[str, list[float]] = {}
        for name, value in (item for step in steps for item in step.items()):
            facts.setdefault(name, []).append(value)
        return (
            {name: sum(values) / len(values) for name, values in facts.items()}
            | counts
            | {"actor_lr": actor_lr}
        )

    def _train_actor(
        self, decisions: Decisions, generator: torch.Generator, counts: dict[str, int]
    ) -> tuple[list[dict[str, float]], float]:
        """All epochs, or up to the first step that goes too far. Facts of each minibatch; KL of the policy that remains, as last
        measured."""
        steps, minibatches, kl, is_new = (
            list[dict[str, float]](),
            list[Tensor](),
            0.0,
            False,
        )
        for _ in range(self.settings.epochs):
            minibatches = self._minibatches(len(decisions), generator)
            for rows in minibatches:
                steps.append(
                    self._actor_gradient(
                        decisions.rows(rows), generator, is_first=not steps
                    )
                )
                if self._goes_too_far(steps[-1]["kl"], is_new, counts):
                    return steps, kl
                kl = steps[-1]["kl"]
                self._keep()
                is_new = self._step(self.actor_optimizer, steps[-1]["actor_grad_norm"])
                counts["actor_steps" if is_new else "skipped_steps"] += 1
        if is_new:  # no minibatch came after the last step
            new_kl = self._measure_kl(decisions.rows(minibatches[0]))
            kl = kl if self._goes_too_far(new_kl, is_new, counts) else new_kl
        return steps, kl

    def _goes_too_far(self, kl: float, is_new: bool, counts: dict[str, int]) -> bool:
        """Whether updates end here. The last step is then undone if ``is_new``: no smaller KL was measured after it."""
        if kl <= self.settings.kl_stop:  # false for NaN
            return False
        counts["kl_stopped"] = 1
        if is_new:
            self._undo()
            counts["undone_steps"] += 1
        return True

    def _keep(self) -> None:
        """Copy the actor's weights and Adam's moments."""
        self._before = None  # first, so that memory is that of one copy
        weights = [p.detach().clone() for p in self.actor.trained_parameters()]
        self._before = weights, copy.deepcopy(self.actor_optimizer.state_dict())

    @torch.no_grad()
    def _undo(self) -> None:
        """Restore the weights and moments of the last ``_keep``."""
        weights, optimizer = self._before
        for p, weight in zip(self.actor.trained_parameters(), weights, strict=True):
            p.copy_(weight)
        self.actor_optimizer.load_state_dict(optimizer)

    @torch.no_grad()
    def _measure_kl(self, rows: Decisions) -> float:
        return kl_divergence(
            torch.cat(
                [
                    self._log_ratios(rows.rows(part))
                    for part in self._micro_batches(rows)
                ]
            )
        )

    def _adapt_lr(self, last_kl: float, counts: dict[str, int]) -> None:
        """Smaller after a step that was undone, larger after an iteration of small ones."""
        if counts["undone_steps"]:
            self.actor_lr *= (
                FIRST_STEP_UNDONE if counts["actor_steps"] == 1 else LATER_STEP_UNDONE
            )
        elif (
            counts["actor_steps"]
            and not counts["kl_stopped"]
            and last_kl < SMALL_KL * self.settings.kl_stop
        ):
            self.actor_lr = max(
                self.actor_lr,
                min(SMALL_STEPS * self.actor_lr, MOST_LR * self.settings.actor_lr),
            )

    def _minibatches(self, num: int, generator: torch.Generator) -> list[Tensor]:
        order = torch.randperm(num, generator=generator).to(self.actor.scored_HD.device)
        return list(order.split(self.settings.batch_size))

    def _micro_batches(self, rows: Decisions) -> Sequence[Tensor]:
        return torch.arange(len(rows), device=rows.log_prob_M.device).split(
            self.settings.micro_batch
        )

    def _critic_step(self, decisions: Decisions, rows: Tensor) -> dict[str, float]:
        self.critic_optimizer.zero_grad()
        values = self.critic(decisions.features_MF[rows], decisions.privileged_MP[rows])
        loss = 0.5 * ((values - decisions.return_M[rows]) ** 2).mean()
        loss.backward()
        norm = float(
            nn.utils.clip_grad_norm_(
                self.critic.parameters(), self.settings.max_grad_norm
            )
        )
        self._step(self.critic_optimizer, norm)
        return {"critic_loss": float(loss.detach()), "critic_grad_norm": norm}

    def _actor_gradient(
        self, rows: Decisions, generator: torch.Generator, is_first: bool
    ) -> dict[str, float]:
        """Accumulate the gradient of L over micro-batches, then clip it. The advantages are normalised."""
        self.actor_optimizer.zero_grad()
        log_ratios, losses = [], []
        for part in self._micro_batches(rows):
            log_ratio_M = self._log_ratios(rows.rows(part))
            loss = policy_loss(
                log_ratio_M, rows.advantage_M[part], self.settings.clip
            ) * (len(part) / len(rows))
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
            if not found["first_ratio_error"] <= self.ratio_guard:  # nor NaN
                raise TaccorlError(
                    "post-training: before the first update of an iteration the ratio of probabilities differs from 1 by "
                    f"{found['first_ratio_error']:.2g}, more than {self.ratio_guard:g}: sampling and scoring differ. Check that "
                    "the policy's weights are float32, and that --policy.tf32=false"
                )
        if self.anchor is not None:
            found["anchor_loss"] = self.anchor.backward(
                generator, self.settings.micro_batch
            )
        parameters = self.actor.trained_parameters()
        return found | {
            "actor_grad_norm": float(
                nn.utils.clip_grad_norm_(parameters, self.settings.max_grad_norm)
            )
        }

    def _log_ratios(self, rows: Decisions) -> Tensor:
        """(M,) log π − log π_old."""
        now_M = self.actor.log_prob(
            rows.batch, self.sde, rows.before_MSHD, rows.after_MSHD, rows.step_MS
        )
        return now_M - rows.log_prob_M

    def _step(self, optimizer: torch.optim.Optimizer, grad_norm: float) -> bool:
        """Step, unless a gradient is not finite; whether it was done."""
        is_finite = math.isfinite(grad_norm)
        if is_finite:
            optimizer.step()
        return is_finite

    def state_dict(self) -> dict[str, Any]:
        """State of critic, optimisers and counters, without the policy's weights, as ``load_state_dict`` takes it."""
        return {name: getattr(self, name).state_dict() for name in _PARTS} | {
            "num_updates": self.num_updates
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from ``state_dict``."""
        for name in _PARTS:
            getattr(self, name).load_state_dict(state[name])
        self.num_updates = state["num_updates"]


def policy_loss(log_ratio_M: Tensor, advantage_M: Tensor, clip: float) -> Tensor:
    """Clipped loss of PPO, L_PPO (a scalar). ``advantage_M`` is normalised; ``clip`` is ε."""
    ratio_M = log_ratio_M.exp()
    return -torch.minimum(
        ratio_M * advantage_M, ratio_M.clamp(1 - clip, 1 + clip) * advantage_M
    ).mean()


def kl_divergence(log_ratio_M: Tensor) -> float:
    """Estimate of KL(π_old ‖ π) [nat]: mean of ratio − 1 − log ratio, which is never negative (k3 of Schulman's note)."""
    return float((log_ratio_M.exp() - 1 - log_ratio_M).mean())
