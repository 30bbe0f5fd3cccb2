"""Rollouts of a flow policy with Flow-SDE noise: N environments at once, T decisions of each.

A decision is one chunk of actions. Episodes that end are reset at the end of the chunk; running episodes continue in the next
iteration.

Letters in shapes: T decisions, N environments, H horizon, D padded action, A action, P privileged numbers.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from taccorl.evaluation.episodes import SUCCESS
from taccorl.rl.advantages import estimate_advantages, explained_variance
from taccorl.rl.flow_policy import Batch, FlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.ppo import PPO, Decisions


class Clock:
    """Wall time of the parts of an iteration [s]."""

    def __init__(self, device: Any = "cpu") -> None:
        self._is_cuda = torch.device(device).type == "cuda"
        self.seconds: dict[str, float] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Context manager that adds the wall time spent inside to the part ``name``."""
        begin_s = self._now_s()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self._now_s() - begin_s

    def _now_s(self) -> float:
        if self._is_cuda:
            torch.cuda.synchronize()
        return time.perf_counter()

    def restart(self) -> dict[str, float]:
        """Part → its time since the last call [s]; the times restart at 0."""
        seconds, self.seconds = self.seconds, {}
        return seconds


@dataclass(frozen=True)
class Observations:
    """Inputs of policy and critic for N environments."""

    batch: Batch
    """Preprocessed inputs of the policy: key → tensor with N rows."""
    privileged_NP: Tensor
    """Numbers of the simulator's state for the critic; P = 0 without ``privileged_critic``."""


@dataclass(frozen=True, kw_only=True)
class Acted:
    """Result of executing one chunk in each of N environments: rewards, ends, last observations, outcomes."""

    reward_N: Tensor
    """(N,) float32 sum of the rewards within the chunk."""
    terminated_N: Tensor
    """(N,) bool: the episode succeeded or failed."""
    truncated_N: Tensor
    """(N,) bool: the episode ran out of time."""
    last: Observations | None
    """Last observations, before the reset, of the environments that ran out of time, in their order; None if there are none."""
    outcomes: list[str | None]
    """(N,) ``success``, ``timeout`` or the failure, for episodes that ended and had begun with a reset; else None."""
    later_outcomes: list[str | None] = field(default_factory=list)
    """(N,) outcome, like ``outcomes``, of episodes that had begun in a state of an earlier episode (``start_states``)."""


class World(Protocol):
    """Interface of the N environments in which a rollout acts."""

    num_envs: int
    """N: number of environments."""

    def observe(self) -> Observations:
        """Present inputs of all N environments."""
        ...

    def act(self, actions_NnA: Tensor) -> Acted:
        """Execute the chunks ``actions_NnA`` (N, n, A), as from ``FlowPolicy.actions``; reset environments whose episode
        ended.
        """
        ...


@dataclass(frozen=True)
class Rollout:
    """T · N decisions, and outcomes of the episodes that ended in them."""

    decisions: Decisions
    outcomes: Counter[str]
    """Outcome (``success``, ``timeout`` or the failure) → number of episodes that ended with it."""
    facts: dict[str, float]
    """Numbers for progress.jsonl: ``explained_variance``, mean ``return``, ``advantage_std``; with ``start_share`` also
    ``later_episodes`` and ``later_success``; ``success_step_k``: success rate of the episodes in whose last decision step k was
    the stochastic one.
    """


def collect(
    world: World,
    learner: PPO,
    num_decisions: int,
    generator: torch.Generator,
    clock: Clock,
    on_values: Callable[[Tensor], None] = lambda value_N: None,
) -> Rollout:
    """Make T decisions in every environment, and compute their advantages.

    Args:
        num_decisions: T.
        generator: random generator on the CPU for the noise.
        clock: the times of the policy are added to its part ``policy``.
        on_values: function that is called with the values (N,) of each decision before it is executed.
    """
    actor, critic, sde = learner.actor, learner.critic, learner.sde
    kept: list[dict[str, Tensor]] = []
    batches: list[Batch] = []
    outcomes, later, won_by_step = Counter[str](), Counter[str](), dict[int, list[bool]]()

    def values(features_NF: Tensor, seen: Observations) -> Tensor:
        with torch.no_grad():
            return critic(features_NF, seen.privileged_NP)

    for _ in range(num_decisions):
        seen = world.observe()
        if seen.privileged_NP.shape[-1]:
            critic.observe(seen.privileged_NP)
        with clock.part("policy"):
            draws = actor.draw(world.num_envs, sde, generator)
            sampled, features_NF = actor.sample(seen.batch, sde, draws)
            value_N = values(features_NF, seen)
            actions_NnA = actor.actions(sampled.chunk_BHD)
        on_values(value_N)
        acted = world.act(actions_NnA)
        last_N = torch.zeros_like(value_N)  # value of the last observation where time ran out
        if acted.last is not None:
            with clock.part("policy"):
                last_N[acted.truncated_N.to(last_N.device)] = values(actor.features(acted.last.batch), acted.last)
        kept.append(
            {
                "before_MSHD": sampled.before_BSHD,
                "after_MSHD": sampled.after_BSHD,
                "step_MS": draws.step_BS,
                "log_prob_M": sampled.log_prob_B,
                "features_MF": features_NF,
                "privileged_MP": seen.privileged_NP,
                "value": value_N,
                "reward": acted.reward_N.to(value_N),
                "end": (acted.terminated_N | acted.truncated_N).to(value_N.device),
                "last_value": last_N,
            }
        )
        batches.append(seen.batch)
        outcomes.update(name for name in acted.outcomes if name is not None)
        later.update(name for name in acted.later_outcomes if name is not None)
        for name, k in zip(acted.outcomes, draws.step_BS[:, 0].tolist(), strict=True):
            if name is not None and sde.num_stochastic == 1 and k >= 0:
                won_by_step.setdefault(k, []).append(name == SUCCESS)
    seen = world.observe()
    with clock.part("policy"):
        next_N = values(actor.features(seen.batch), seen)
    columns = {name: torch.stack([row[name] for row in kept]) for name in kept[0]}
    value_TN, end_TN = columns.pop("value"), columns.pop("end")
    following_TN = torch.where(end_TN, columns.pop("last_value"), torch.cat([value_TN[1:], next_N[None]]))
    discounts = {"gamma": learner.settings.gamma, "gae_lambda": learner.settings.gae_lambda}
    advantage_TN, return_TN = estimate_advantages(columns.pop("reward"), value_TN, following_TN, end_TN, **discounts)
    decisions = Decisions(
        batch={key: torch.cat([batch[key] for batch in batches]) for key in batches[0]},
        advantage_M=advantage_TN.flatten(),
        return_M=return_TN.flatten(),
        **{name: x.flatten(0, 1) for name, x in columns.items()},
    )
    facts = {
        "explained_variance": explained_variance(value_TN, return_TN),
        "return": float(return_TN.mean()),
        "advantage_std": float(advantage_TN.std(correction=0)),
    }
    if later:
        facts |= {"later_episodes": float(later.total()), "later_success": later[SUCCESS] / later.total()}
    facts |= {f"success_step_{k}": sum(won) / len(won) for k, won in sorted(won_by_step.items())}
    return Rollout(decisions, outcomes, facts)


def first_episodes(
    world: World, actor: FlowPolicy, sde: FlowSDE, generator: torch.Generator, max_decisions: int
) -> list[str | None]:
    """Return the outcome of the first episode of each of the N environments in a world that was just restarted: ``success``,
    ``timeout`` or the failure; None: it has not ended after ``max_decisions`` chunks.
    """
    found: list[str | None] = [None] * world.num_envs
    for _ in range(max_decisions):
        draws = actor.draw(world.num_envs, sde, generator)
        sampled, _ = actor.sample(world.observe().batch, sde, draws)
        acted = world.act(actor.actions(sampled.chunk_BHD))
        found = [one or new for one, new in zip(found, acted.outcomes, strict=True)]
        if all(found):
            break
    return found
