"""Rollouts of a flow policy with Flow-SDE noise: N environments at once, T decisions of each.

A decision is one chunk of actions. Episodes that end are reset at the end of the chunk; running episodes continue in the next
iteration.

Letters in shapes: T decisions, N environments, H horizon, D padded action, A action, P privileged numbers.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from taccorl.evaluation.episodes import SUCCESS
from taccorl.rl.advantages import estimate_advantages, explained_variance
from taccorl.rl.flow_policy import Batch, FlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.ppo import PPO, Decisions
from taccorl.rl.twin_shard import Acted


class Clock:
    """Wall time of the parts of an iteration [s]."""

    def __init__(self, device: Any = "cpu") -> None:
        self._wait = (
            torch.cuda.synchronize
            if torch.device(device).type == "cuda"
            else lambda: None
        )
        self.seconds = defaultdict[str, float](float)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Context manager that adds the wall time spent inside to the part ``name``."""
        self._wait()
        begin_s = time.perf_counter()
        yield
        self._wait()
        self.seconds[name] += time.perf_counter() - begin_s

    def restart(self) -> dict[str, float]:
        """Part → its time since the last call [s]; the times restart at 0."""
        seconds, self.seconds = dict(self.seconds), defaultdict[str, float](float)
        return seconds


@dataclass(frozen=True)
class Observations:
    """Inputs of policy and critic for N environments."""

    batch: Batch
    """Preprocessed inputs of the policy: key → tensor with N rows."""
    privileged_NP: Tensor
    """Numbers of the simulator's state for the critic; P = 0 without ``privileged_critic``."""


OnActed = Callable[[Acted, Tensor], None]
"""Function of a decision's result and the critic's values (N,) before it."""


class World(Protocol):
    """Interface of the N environments in which a rollout acts."""

    num_envs: int
    """N: number of environments."""
    clock: Clock
    """``collect`` adds the time of the policy to its part ``policy``."""

    def observe(self) -> Observations:
        """Present inputs of all N environments."""
        ...

    def act(self, actions_NnA: Tensor) -> Acted:
        """Execute the chunks ``actions_NnA`` (N, n, A), as from ``FlowPolicy.actions``; reset environments whose episode
        ended."""
        ...


@dataclass(frozen=True)
class Rollout:
    """T · N decisions, and outcomes of the episodes that ended in them."""

    decisions: Decisions
    facts: dict[str, Any]
    """For progress.jsonl: number of ``episodes`` from a reset that ended, their ``success`` rate (None without any) and
    ``outcomes``: ``success``, ``timeout`` or the failure → number. ``explained_variance``, mean ``return``, ``advantage_std``;
    with ``start_share`` also ``later_episodes`` and ``later_success``. ``success_step_k``: success rate of the episodes in whose
    last decision step k was the stochastic one."""


@torch.no_grad()
def collect(
    world: World,
    learner: PPO,
    num_decisions: int,
    generator: torch.Generator,
    on_acted: OnActed | None = None,
) -> Rollout:
    """Make T decisions in every environment, and compute their advantages.

    Args:
        num_decisions: T.
        generator: random generator on the CPU for the noise.
        on_acted: function that is called after each decision.
    """
    actor, critic, sde, clock = learner.actor, learner.critic, learner.sde, world.clock
    batches: list[Batch] = []
    sampled_parts: list[tuple[Tensor, ...]] = []
    earned: list[tuple[Tensor, ...]] = []
    ended: list[tuple[Any, ...]] = []
    """Outcome, whether the episode had begun in a state of an earlier one, and stochastic step of its last decision."""
    for _ in range(num_decisions):
        seen = world.observe()
        critic.observe(seen.privileged_NP)
        with clock.part("policy"):
            draws = actor.draw(world.num_envs, sde, generator)
            sampled, features_NF = actor.sample(seen.batch, sde, draws)
            value_N = critic(features_NF, seen.privileged_NP)
            actions_NnA = actor.actions(sampled.chunk_BHD)
        acted = world.act(actions_NnA)
        if on_acted is not None:
            on_acted(acted, value_N)
        last_N = torch.zeros_like(value_N)  # value after an episode's last decision
        if acted.last is not None and learner.settings.bootstrap_time_limit:
            with clock.part("policy"):
                late_N = torch.from_numpy(acted.truncated_N).to(value_N.device)
                last_N[late_N] = critic(
                    actor.features(acted.last.batch), acted.last.privileged_NP
                )
        end_N, step_N = (
            acted.terminated_N | acted.truncated_N,
            draws.step_BS[:, 0].tolist(),
        )
        ended += [
            (acted.outcome_N[i], acted.began_later_N[i], step_N[i])
            for i in np.flatnonzero(end_N)
        ]
        batches.append(seen.batch)
        before_BSHD, after_BSHD, log_prob_B = (
            sampled.before_BSHD,
            sampled.after_BSHD,
            sampled.log_prob_B,
        )
        sampled_parts.append(
            (
                before_BSHD,
                after_BSHD,
                draws.step_BS,
                log_prob_B,
                features_NF,
                seen.privileged_NP,
            )
        )
        earned.append(
            (
                value_N,
                *(torch.from_numpy(x).to(value_N) for x in (acted.reward_N, end_N)),
                last_N,
            )
        )
    seen = world.observe()
    with clock.part("policy"):
        next_N = critic(actor.features(seen.batch), seen.privileged_NP)
    value_TN, reward_TN, end_TN, last_TN = (
        torch.stack(x) for x in zip(*earned, strict=True)
    )
    following_TN = torch.where(
        end_TN > 0, last_TN, torch.cat([value_TN[1:], next_N[None]])
    )
    discounts = {
        "gamma": learner.settings.gamma,
        "gae_lambda": learner.settings.gae_lambda,
    }
    advantage_TN, return_TN = estimate_advantages(
        reward_TN, value_TN, following_TN, end_TN > 0, **discounts
    )
    decisions = Decisions(
        {key: torch.cat([batch[key] for batch in batches]) for key in batches[0]},
        *(
            torch.cat(x) for x in zip(*sampled_parts, strict=True)
        ),  # in the order of the fields
        advantage_M=advantage_TN.flatten(),
        return_M=return_TN.flatten(),
    )
    from_reset = [
        (outcome, step) for outcome, began_later, step in ended if not began_later
    ]
    outcomes = Counter(outcome for outcome, _ in from_reset)
    facts: dict[str, Any] = {
        "episodes": len(from_reset),
        "success": outcomes[SUCCESS] / len(from_reset) if from_reset else None,
        "outcomes": dict(outcomes),
        "explained_variance": explained_variance(value_TN, return_TN),
        "return": float(return_TN.mean()),
        "advantage_std": float(advantage_TN.std(correction=0)),
    }
    if later := [
        outcome == SUCCESS for outcome, began_later, _ in ended if began_later
    ]:
        facts |= {
            "later_episodes": float(len(later)),
            "later_success": sum(later) / len(later),
        }
    for k in range(sde.num_steps) if sde.num_stochastic == 1 else ():
        if won := [outcome == SUCCESS for outcome, step in from_reset if step == k]:
            facts[f"success_step_{k}"] = sum(won) / len(won)
    return Rollout(decisions, facts)


def first_episodes(
    world: World,
    actor: FlowPolicy,
    sde: FlowSDE,
    generator: torch.Generator,
    max_decisions: int,
) -> list[str | None]:
    """Return the outcome of the first episode of each of the N environments in a world that was just restarted: ``success``,
    ``timeout`` or the failure; None: it has not ended after ``max_decisions`` chunks."""
    found: list[str | None] = [None] * world.num_envs
    for _ in range(max_decisions):
        draws = actor.draw(world.num_envs, sde, generator)
        sampled, _ = actor.sample(world.observe().batch, sde, draws)
        acted = world.act(actor.actions(sampled.chunk_BHD))
        found = [one or new for one, new in zip(found, acted.outcome_N, strict=True)]
        if all(found):
            break
    return found
