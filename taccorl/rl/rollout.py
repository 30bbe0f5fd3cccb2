"""Rollouts of a flow policy with Flow-SDE noise: N environments in one process, T decisions of each.

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

from taccorl.rl.advantages import estimate_advantages, explained_variance
from taccorl.rl.critic import Critic
from taccorl.rl.flow_policy import Batch, FlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.ppo import Decisions
from taccorl.rl.settings import PPOSettings

SUCCESS = "success"


class Clock:
    """Wall time of the parts of an iteration [s]."""

    def __init__(self, device: Any = "cpu") -> None:
        self._is_cuda = torch.device(device).type == "cuda"
        self.seconds: dict[str, float] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Context manager that adds the time spent inside to the part ``name``."""
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
        """Time of each part since the last call [s]; the times restart at 0."""
        seconds, self.seconds = self.seconds, {}
        return seconds


@dataclass(frozen=True)
class Seen:
    """Inputs of policy and critic for some environments."""

    batch: Batch
    privileged_NP: Tensor


@dataclass(frozen=True, kw_only=True)
class Acted:
    """Result of N executed chunks."""

    reward_N: Tensor
    terminated_N: Tensor
    """(N,) bool: the episode succeeded or failed."""
    truncated_N: Tensor
    """(N,) bool: the episode ran out of time."""
    last: Seen | None
    """Last observations, before the reset, of the environments that ran out of time, in their order; None if there are none."""
    outcomes: list[str | None]
    """(N,) ``success``, ``timeout`` or the failure, for episodes that ended and had begun with a reset; else None."""
    later_outcomes: list[str | None] = field(default_factory=list)
    """(N,) the same for episodes that had begun in a state of an earlier episode (``start_states``)."""


class World(Protocol):
    """Interface of the N environments in which a rollout acts."""

    @property
    def num_envs(self) -> int:
        """N: number of environments."""
        ...

    def observe(self) -> Seen:
        """Present inputs of all environments."""
        ...

    def act(self, actions_NHA: Tensor) -> Acted:
        """Execute chunks (N, n, A) in the policy's units; reset environments whose episode ended."""
        ...

    def reset(self, rows_N: Tensor) -> None:
        """Begin the next episode in the environments where ``rows_N`` (bool) is true."""
        ...


@dataclass(frozen=True)
class Rollout:
    """T · N decisions, and outcomes of the episodes that ended in them."""

    decisions: Decisions
    outcomes: Counter[str]
    facts: dict[str, float] = field(default_factory=dict)


def collect(
    world: World,
    actor: FlowPolicy,
    critic: Critic,
    sde: FlowSDE,
    num_decisions: int,
    settings: PPOSettings,
    generator: torch.Generator,
    clock: Clock,
    on_values: Callable[[Tensor], None] | None = None,
) -> Rollout:
    """Make T decisions in every environment, and compute their advantages.

    Args:
        generator: random generator on the CPU for the noise.
        on_values: function that is called with the values (N,) of each decision before it is executed.
    """
    kept: list[dict[str, Tensor]] = []
    batches: list[Batch] = []
    outcomes: Counter[str] = Counter()
    later: Counter[str] = Counter()
    won_by_step = torch.zeros(2, sde.num_steps)  # successes, ends
    shape: tuple[int, int] = tuple(actor.scored_HD.shape)  # pyright: ignore[reportAssignmentType]
    for _ in range(num_decisions):
        seen = world.observe()
        if seen.privileged_NP.shape[-1]:
            critic.observe(seen.privileged_NP)
        with clock.part("policy"):
            draws = sde.draw(world.num_envs, shape, generator, actor.scored_HD.device)
            sampled, features_NF = actor.sample(seen.batch, sde, draws)
            value_N = _values(critic, features_NF, seen.privileged_NP)
            actions_NHA = actor.actions(sampled.chunk_BHD)
        if on_values is not None:
            on_values(value_N)
        acted = world.act(actions_NHA)
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
                "last_value": _last_values(actor, critic, acted, value_N, clock),
            }
        )
        batches.append(seen.batch)
        ended = [name for name in acted.outcomes if name is not None]
        outcomes.update(ended)
        later.update(name for name in acted.later_outcomes if name is not None)
        for name, k in zip(acted.outcomes, draws.step_BS[:, 0].tolist(), strict=True):
            if name is not None and k >= 0:
                won_by_step[:, k] += torch.tensor([float(name == SUCCESS), 1.0])
    seen = world.observe()
    with clock.part("policy"):
        next_N = _values(critic, actor.features(seen.batch), seen.privileged_NP)
    columns = {name: torch.stack([row[name] for row in kept]) for name in kept[0]}
    value_TN, end_TN = columns.pop("value"), columns.pop("end")
    following_TN = torch.cat([value_TN[1:], next_N[None]])
    advantage_TN, return_TN = estimate_advantages(
        columns.pop("reward"),
        value_TN,
        torch.where(end_TN, columns.pop("last_value"), following_TN),
        end_TN,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
    )
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
    for k in range(sde.num_steps):
        if sde.num_stochastic == 1 and won_by_step[1, k]:
            facts[f"success_step_{k}"] = float(won_by_step[0, k] / won_by_step[1, k])
    return Rollout(decisions, outcomes, facts)


@torch.no_grad()
def _values(critic: Critic, features_NF: Tensor, privileged_NP: Tensor) -> Tensor:
    return critic(features_NF, privileged_NP)


def _last_values(actor: FlowPolicy, critic: Critic, acted: Acted, like_N: Tensor, clock: Clock) -> Tensor:
    """(N,) value of the last observation where time ran out, 0 elsewhere."""
    last_N = torch.zeros_like(like_N)
    if acted.last is not None:
        with clock.part("policy"):
            features_NF = actor.features(acted.last.batch)
            last_N[acted.truncated_N.to(last_N.device)] = _values(critic, features_NF, acted.last.privileged_NP)
    return last_N


def first_episodes(
    world: World, actor: FlowPolicy, sde: FlowSDE, generator: torch.Generator, max_decisions: int
) -> list[str | None]:
    """Outcome of the first episode of each environment in a world that was just restarted; None: it has not ended."""
    found: list[str | None] = [None] * world.num_envs
    for _ in range(max_decisions):
        acted = _decide(world, actor, sde, generator)
        found = [one or new for one, new in zip(found, acted.outcomes, strict=True)]
        if all(found):
            break
    return found


def stagger(world: World, actor: FlowPolicy, sde: FlowSDE, generator: torch.Generator, num_decisions: int) -> None:
    """Act for the number of decisions of an episode, and reset each environment once, at a random decision. Otherwise all
    environments would be in the same phase of the task in every iteration.
    """
    begin_N = torch.randint(num_decisions, (world.num_envs,), generator=generator)
    for k in range(num_decisions):
        if (begin_N == k).any():
            world.reset(begin_N == k)
        _decide(world, actor, sde, generator)


def _decide(world: World, actor: FlowPolicy, sde: FlowSDE, generator: torch.Generator) -> Acted:
    shape: tuple[int, int] = tuple(actor.scored_HD.shape)  # pyright: ignore[reportAssignmentType]
    draws = sde.draw(world.num_envs, shape, generator, actor.scored_HD.device)
    sampled, _ = actor.sample(world.observe().batch, sde, draws)
    return world.act(actor.actions(sampled.chunk_BHD))
