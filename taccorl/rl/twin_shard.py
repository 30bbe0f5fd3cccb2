"""Environments of the twin for rollouts, as numbers: a policy's window of touch, streams of scenes, exact resuming.

Scenes come from a stream of seeds: the k-th episode of environment i has ``episode_seed(seed, i, k)``. A world may be made of
several shards; i counts through all of them, so that scenes do not depend on how environments are divided.

Letters in shapes: N environments, n executed actions of a chunk, A action, L history, K taxels, P privileged numbers.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from gymnasium.vector import AutoresetMode

from taccorl.errors import TaccorlError
from taccorl.rl.rollout import SUCCESS
from taccorl.rl.start_states import StartStates
from taccorl.sim.episode_seeds import episode_seed
from taccorl.sim.part_poses import part_pose_names
from taccorl.sim.simulation import Snapshot
from taccorl.sim.spaces import TACTILE_KEY, Observation
from taccorl.sim.vector_env import TaccorlVectorEnv


@dataclass(frozen=True)
class ShardSeen:
    """Observations of some environments."""

    observation: Observation
    window_NLK: np.ndarray
    privileged_NP: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ShardActed:
    """Result of N executed chunks; fields as of ``rollout.Acted``."""

    reward_N: np.ndarray
    terminated_N: np.ndarray
    truncated_N: np.ndarray
    last: ShardSeen | None
    outcomes: list[str | None]
    later_outcomes: list[str | None]
    num_steps_N: np.ndarray
    """(N,) number of executed control steps: fewer than n if the episode ended."""
    seed_N: np.ndarray
    """(N,) scene seeds of these episodes."""
    partial_N: np.ndarray
    """(N,) number of the task's goals that are reached after the chunk."""


class Shard(Protocol):
    """Interface of a group of N environments that run in this process (``TwinShard``) or in another one (``RemoteShard``)."""

    @property
    def num_envs(self) -> int: ...
    @property
    def task(self) -> str: ...
    @property
    def instruction(self) -> str: ...
    @property
    def part_names(self) -> tuple[str, ...]: ...
    @property
    def limit_steps(self) -> int: ...
    def restart(self, seed: int) -> None: ...
    def observe(self) -> ShardSeen: ...
    def act(self, actions_NHA: np.ndarray) -> ShardActed: ...
    def reset(self, rows_N: np.ndarray) -> None: ...
    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: dict[str, Any]) -> None: ...
    def close(self) -> None: ...


class TwinShard:
    """A group of N environments that are simulated together in this process."""

    def __init__(
        self,
        envs: TaccorlVectorEnv,
        *,
        history: int,
        images: bool,
        privileged: bool,
        starts: StartStates | None = None,
        first: int = 0,
    ) -> None:
        """
        Args:
            envs: environments with ``AutoresetMode.DISABLED``, and pictures on request if ``images``.
            history: L, length of the touch history.
            images: observations contain pictures.
            privileged: observations contain the simulator's state.
            starts: states in which episodes may begin; None: all begin with a reset.
            first: number of the first environment among those of all shards.
        """
        assert envs.autoreset is AutoresetMode.DISABLED
        self.envs, self._history, self._images, self._privileged = envs, history, images, privileged
        self.starts = StartStates(0.0, 1) if starts is None else starts
        self._first = first
        self._began_later_N = np.zeros(envs.num_envs, dtype=bool)
        self._root = 0
        self._episode_N = np.zeros(envs.num_envs, dtype=np.int64)
        self._window_NLK = np.zeros((0,))

    @property
    def num_envs(self) -> int:
        return self.envs.num_envs

    @property
    def task(self) -> str:
        return self.envs.task

    @property
    def instruction(self) -> str:
        return self.envs.task_description

    @property
    def part_names(self) -> tuple[str, ...]:
        """Names of the numbers of the parts' poses."""
        return part_pose_names(self.envs.sim.task)

    @property
    def limit_steps(self) -> int:
        """Control steps after which an episode ends."""
        return self.envs.sim.judge.limit_steps

    def restart(self, seed: int) -> None:
        """Start new episodes with the seed sequence of ``seed``."""
        self._root, self._episode_N[:], self._began_later_N[:] = seed, 0, False
        self.starts.restart((seed, self._first))
        observation, _ = self.envs.reset(seed=self._seeds())
        self._window_NLK = self._repeated(observation[TACTILE_KEY])

    def observe(self) -> ShardSeen:
        """Present observations of all environments."""
        return self._seen(np.arange(self.num_envs))

    def _seen(self, ids: np.ndarray) -> ShardSeen:
        observation = self.envs.observe(images=self._images)
        chosen = {key: x[ids] for key, x in observation.items()}
        return ShardSeen(chosen, self._window_NLK[ids], self._privileged_numbers(ids))

    def act(self, actions_NHA: np.ndarray) -> ShardActed:
        """Execute chunks (N, n, A) [rad, m]; reset environments whose episode ended."""
        chunk = self.envs.step_chunk(actions_NHA)
        facts = self.envs.facts()
        truncated, terminated = chunk.truncated, chunk.terminated
        outcomes = [str(o) or None for o in np.where(facts["is_success"], SUCCESS, facts["failure"])]
        began_later, seeds, partial = self._began_later_N.tolist(), self._seeds(), facts["partial"].copy()
        windows = np.concatenate([self._window_NLK, chunk.tactile], axis=1)
        ends = self._history + chunk.num_steps  # readings after the end of an episode do not count
        self._window_NLK = np.stack([w[end - self._history : end] for w, end in zip(windows, ends, strict=True)])
        over = truncated | terminated
        self.starts.see(self.envs.sim, self._window_NLK, over)
        last = self._seen(np.flatnonzero(truncated)) if truncated.any() else None
        if over.any():
            self.reset(over)
        return ShardActed(
            reward_N=chunk.reward,
            terminated_N=terminated,
            truncated_N=truncated,
            last=last,
            outcomes=[None if later else o for o, later in zip(outcomes, began_later, strict=True)],
            later_outcomes=[o if later else None for o, later in zip(outcomes, began_later, strict=True)],
            num_steps_N=chunk.num_steps,
            seed_N=np.array(seeds),
            partial_N=partial,
        )

    def reset(self, rows_N: np.ndarray) -> None:
        """Begin the next episode in the environments where ``rows_N`` (bool) is true."""
        self._episode_N[rows_N] += 1
        observation, _ = self.envs.reset(seed=self._seeds(), options={"reset_mask": rows_N})
        self._window_NLK[rows_N] = self._repeated(observation[TACTILE_KEY][rows_N])
        later_N, numbers = self.starts.draw(rows_N)
        self._began_later_N[rows_N] = later_N[rows_N]
        if numbers:
            snapshot, windows = self.starts.states(numbers)
            self.envs.reset(seed=self._seeds(), options={"reset_mask": later_N, "state": snapshot})
            self._window_NLK[later_N] = windows

    def _seeds(self) -> list[int]:
        return [episode_seed(self._root, self._first + i, int(k)) for i, k in enumerate(self._episode_N)]

    def _repeated(self, reading_NK: np.ndarray) -> np.ndarray:
        """(N, L, K): before an episode's first reading there were none; it is repeated, as in datasets."""
        return np.repeat(reading_NK[:, None], self._history, axis=1)

    def _privileged_numbers(self, ids: np.ndarray) -> np.ndarray:
        """(n, P) positions and velocities of all joints, subtasks, goals, elapsed share of the time, the task's measures."""
        if not self._privileged:
            return np.zeros((len(ids), 0))
        sim, facts = self.envs.sim, self.envs.facts()
        elapsed = facts["steps"] / sim.judge.limit_steps
        columns = [sim.arrays["qpos"], sim.arrays["qvel"], facts["subtask"], facts["partial"], elapsed]
        columns += list(facts["measures"].values())
        numbers = np.concatenate([np.asarray(x, dtype=np.float64).reshape(self.num_envs, -1) for x in columns], axis=1)
        return np.nan_to_num(numbers[ids], nan=0.0, posinf=0.0, neginf=0.0)  # of a diverged simulation

    def state_dict(self) -> dict[str, Any]:
        """State from which a run continues bit for bit; no episode may end between two calls of ``act``."""
        snapshot = self.envs.sim.snapshot()
        fields = {f.name: getattr(snapshot, f.name) for f in dataclasses.fields(snapshot)}
        return {
            "root": self._root,
            "episode": self._episode_N.copy(),
            "window": self._window_NLK,
            "snapshot": fields,
            "starts": self.starts.state_dict(),
            "began_later": self._began_later_N.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from ``state_dict``.

        Raises:
            TaccorlError: the state is of another number of environments, task, difficulty, twin or randomisation.
        """
        if len(state["episode"]) != self.num_envs:
            raise TaccorlError(
                f"--env.num_envs: the run was stopped with {len(state['episode'])} environments in a shard, here are "
                f"{self.num_envs}; resume with the same"
            )
        self._root, self._episode_N = state["root"], state["episode"].copy()
        self._window_NLK = state["window"].copy()
        self.starts.load_state_dict(state["starts"])
        self._began_later_N = state["began_later"].copy()
        self.envs.reset(seed=self._seeds(), options={"state": Snapshot(**state["snapshot"])})

    def close(self) -> None:
        self.envs.close()
