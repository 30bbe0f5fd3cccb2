"""A hand on a line and a goal: the smallest flow policy and world for the code of PPO.

The hand sees its distance to the goal, moves by chunks of four actions of at most 0.1, and succeeds if it is within 0.05 of the
goal after a chunk. Demonstrations end 0.12 beyond the goal, so a policy that imitates them mostly fails.
"""

import numpy as np
import torch
from torch import Tensor, nn

from taccorl.rl.flow_policy import Batch, Compute, FlowPolicy
from taccorl.rl.rollout import SUCCESS, Acted, Clock, Observations

H, STEP, NEAR, BEYOND, LIMIT = 4, 0.1, 0.05, 0.12, 8


class LinePolicy(FlowPolicy):
    """A perceptron of the distance, the noisy chunk and the time."""

    def __init__(self, seed: int = 0, width: int = 64) -> None:
        torch.manual_seed(seed)
        self.encoder = nn.Sequential(nn.Linear(1, width), nn.SiLU())
        self.expert = nn.Sequential(
            nn.Linear(width + H + 1, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, H),
        )
        self.scored_HD = torch.ones(H, 1, dtype=torch.bool)

    def trained_parameters(self) -> list[nn.Parameter]:
        return [*self.encoder.parameters(), *self.expert.parameters()]

    def actions(self, chunk_BHD: Tensor) -> Tensor:
        return chunk_BHD

    def velocity(self, seen_BF: Tensor, x_BHD: Tensor, t_B: Tensor) -> Tensor:
        return self.expert(torch.cat([seen_BF, x_BHD.flatten(1), t_B[:, None]], dim=1))[
            :, :, None
        ]

    def each(self, batch: Batch, compute: Compute) -> tuple[Tensor, ...]:
        seen_BF = self.encoder(batch["distance"])
        return compute(
            slice(None), lambda x, t: self.velocity(seen_BF, x, t), seen_BF.detach()
        )

    def flow_loss(
        self, distance_B1: Tensor, chunk_BHD: Tensor, generator: torch.Generator
    ) -> Tensor:
        noise = torch.randn(chunk_BHD.shape, generator=generator)
        t = torch.rand(len(chunk_BHD), generator=generator)
        x = t[:, None, None] * noise + (1 - t[:, None, None]) * chunk_BHD
        return (
            (self.velocity(self.encoder(distance_B1), x, t) - (noise - chunk_BHD)) ** 2
        ).mean()


def demonstrations(num: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """(num, 1) distances and (num, H, 1) chunks, in units of the largest step."""
    distance = 2 * torch.rand(num, 1, generator=generator) - 1
    share = ((distance + BEYOND) / (STEP * H)).clamp(-1, 1)
    return distance, (
        share[:, None, :] + 0.1 * torch.randn(num, H, 1, generator=generator)
    ).clamp(-1, 1)


def imitated(seed: int = 0, steps: int = 400) -> LinePolicy:
    policy, generator = LinePolicy(seed), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(policy.trained_parameters(), 3e-3)
    for _ in range(steps):
        loss = policy.flow_loss(*demonstrations(256, generator), generator)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return policy


class DemoAnchor:
    """The demonstrations as "real" data."""

    def __init__(self, policy: LinePolicy, weight: float, batch_size: int = 32) -> None:
        self.policy, self.weight, self.batch_size = policy, weight, batch_size
        self.rows_seen: list[int] = []

    def backward(self, generator: torch.Generator, micro_batch: int) -> float:
        loss = self.policy.flow_loss(
            *demonstrations(self.batch_size, generator), generator
        )
        (self.weight * loss).backward()
        self.rows_seen.append(self.batch_size)
        return float(loss.detach())

    @torch.no_grad()
    def drift(self, num_rows: int) -> float:
        generator = torch.Generator().manual_seed(3)
        return float(
            self.policy.flow_loss(*demonstrations(num_rows, generator), generator)
        )


class LineWorld:
    """N hands, each with its own generator: company does not matter."""

    def __init__(self, num_envs: int, seed: int = 0) -> None:
        self.num_envs, self.clock = num_envs, Clock()
        self.generator = torch.Generator().manual_seed(seed)
        self.distance, self.age = (
            torch.zeros(num_envs),
            torch.zeros(num_envs, dtype=torch.long),
        )
        self.reset(torch.ones(num_envs, dtype=torch.bool))

    def reset(self, mask: Tensor) -> None:
        self.distance[mask] = (
            2 * torch.rand(int(mask.sum()), generator=self.generator) - 1
        )
        self.age[mask] = 0

    def _seen(self, rows: Tensor) -> Observations:
        return Observations(
            {"distance": self.distance[rows][:, None].clone()},
            torch.zeros(int(rows.sum()), 0),
        )

    def observe(self) -> Observations:
        return self._seen(torch.ones(self.num_envs, dtype=torch.bool))

    def act(self, actions_NHA: Tensor) -> Acted:
        self.distance = self.distance - STEP * actions_NHA[:, :, 0].clamp(-1, 1).sum(1)
        self.age += 1
        won = self.distance.abs() < NEAR
        late = ~won & (self.age >= LIMIT)
        last = self._seen(late) if late.any() else None
        outcome = np.where(won, SUCCESS, np.where(late, "timeout", None))
        self.reset(won | late)
        none, whole = np.zeros(self.num_envs, dtype=np.int64), np.full(self.num_envs, H)
        actions, rewards = actions_NHA.numpy(), won.numpy().astype(np.float64)
        return Acted(
            rewards,
            won.numpy(),
            late.numpy(),
            last,
            outcome,
            none > 0,
            whole,
            none,
            none,
            actions,
        )
