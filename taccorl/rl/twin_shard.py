"""Environments of the twin for rollouts, as numbers: a policy's window of touch, streams of scenes, exact resuming.

Scenes come from a stream of seeds: the k-th episode of environment i has ``episode_seed(seed, i, k)``. A world may be made of
several shards; i counts through all of them, so that scenes do not depend on how environments are divided.

Letters in shapes: N environments, n executed actions of a chunk, A action, L history, W control steps of the window, K taxels,
P privileged numbers.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode

from taccorl.evaluation.episodes import SUCCESS
from taccorl.rl.start_states import StartStates
from taccorl.sim.episode_seeds import episode_seed
from taccorl.sim.part_poses import part_pose_names
from taccorl.sim.simulation import Snapshot
from taccorl.sim.spaces import TACTILE_KEY, Observation
from taccorl.sim.vector_env import TaccorlVectorEnv

PRIVILEGED = "privileged"
"""Key of an observation, (N, P) float64: joints' positions and velocities, subtasks, goals, elapsed share of the time, the task's
measures. P = 0 unless asked for."""


SCENE = "scene"
"""Key of an observation, (N, 2) int64: scene seed, and number of control steps since the scene's start."""


class ShardFacts(NamedTuple):
    """Facts about a shard's environments that do not change: number, task, instruction, parts, time limit."""

    num_envs: int
    task: str
    """Name of the task."""
    instruction: str
    """Sentence that the policy reads."""
    part_names: tuple[str, ...]
    """Names of the numbers of the parts' poses."""
    limit_steps: int
    """Control steps after which an episode ends."""


class Acted(NamedTuple):
    """Result of executing one chunk in each of N environments: rewards, ends, last observations, outcomes, seeds."""

    reward_N: np.ndarray
    """(N,) sum of the rewards within the chunk."""
    terminated_N: np.ndarray
    """(N,) bool: the episode succeeded or failed."""
    truncated_N: np.ndarray
    """(N,) bool: the episode ran out of time."""
    last: Any
    """Last observations, before the reset, of the environments that ran out of time, in their order; None if there are none. Of a
    shard they are an ``Observation``, of a ``World`` an ``Observations``."""
    outcome_N: np.ndarray
    """(N,) object: ``success``, ``timeout`` or the failure of episodes that ended; else None."""
    began_later_N: np.ndarray
    """(N,) bool: the episode had begun in a state of an earlier one (``start_states``)."""
    num_steps_N: np.ndarray
    """(N,) number of executed control steps: fewer than n if the episode ended."""
    seed_N: np.ndarray
    """(N,) scene seeds of these episodes."""
    partial_N: np.ndarray
    """(N,) number of the task's goals that are reached after the chunk."""
    actions_NnA: np.ndarray
    """(N, n, A) joint targets [rad, m], of which the first ``num_steps_N`` were executed."""


class TwinShard:
    """A group of N environments that are simulated together in one process."""

    def __init__(
        self,
        envs: TaccorlVectorEnv,
        *,
        history: int,
        stride: int = 1,
        starts: StartStates,
        privileged: bool = False,
        first: int = 0,
    ) -> None:
        """
        Args:
            envs: environments with ``AutoresetMode.DISABLED``; observations contain pictures unless they render them ``never``.
            history: L; observations have L readings of touch, (N, L, K), the last one at present.
            stride: control steps between two of these readings.
            starts: states of earlier episodes in which episodes begin.
            privileged: observations contain the simulator's state.
            first: number of the first environment among those of all shards.
        """
        assert envs.autoreset is AutoresetMode.DISABLED
        self.envs, self.starts = envs, starts
        self._stride, self._privileged, self._first = stride, privileged, first
        self._window_steps = (history - 1) * stride + 1
        self._root, self._episode_N = 0, np.zeros(envs.num_envs, dtype=np.int64)
        self._began_later_N = np.zeros(envs.num_envs, dtype=bool)
        self._window_NWK = np.zeros(
            (0,)
        )  # W control steps, of which the policy gets every ``stride``-th

    def facts(self) -> ShardFacts:
        """Facts about the environments that do not change."""
        envs = self.envs
        names = part_pose_names(envs.sim.task)
        return ShardFacts(
            envs.num_envs,
            envs.task,
            envs.task_description,
            names,
            envs.sim.judge.limit_steps,
        )

    def restart(self, seed: int) -> None:
        """Start new episodes with the seed sequence of ``seed``."""
        self._root, self._episode_N[:], self._began_later_N[:] = seed, 0, False
        self.starts.restart((seed, self._first))
        observation, _ = self.envs.reset(seed=self._seeds())
        self._window_NWK = self._repeated(observation[TACTILE_KEY])

    def observe(self) -> Observation:
        """Present observations of all environments, with the window of touch (N, L, K), ``PRIVILEGED`` and ``SCENE``."""
        observation = self.envs.observe(images=self.envs.images != "never")
        sim = self.envs.sim
        return observation | {
            TACTILE_KEY: self._window_NWK[:, :: self._stride].copy(),
            PRIVILEGED: self._privileged_numbers(),
            SCENE: np.stack([sim.seeds, sim.judge.steps], axis=1).astype(np.int64),
        }

    def act(self, actions_NnA: np.ndarray) -> Acted:
        """Execute chunks (N, n, A) of joint targets [rad, m]; reset environments whose episode ended."""
        chunk = self.envs.step_chunk(actions_NnA)
        facts = self.envs.facts()
        truncated, over = chunk.truncated, chunk.truncated | chunk.terminated
        outcome = np.where(
            facts["is_success"],
            SUCCESS,
            np.where(over, facts["failure"], np.array(None)),
        )
        windows = np.concatenate([self._window_NWK, chunk.tactile], axis=1)
        ends = (
            self._window_steps + chunk.num_steps
        )  # readings after the end of an episode do not count
        self._window_NWK = np.stack(
            [
                w[end - self._window_steps : end]
                for w, end in zip(windows, ends, strict=True)
            ]
        )
        self.starts.see(self.envs.sim, self._window_NWK, over)
        acted = Acted(
            reward_N=chunk.reward,
            terminated_N=chunk.terminated,
            truncated_N=truncated,
            last={key: x[truncated] for key, x in self.observe().items()}
            if truncated.any()
            else None,
            outcome_N=outcome,
            began_later_N=self._began_later_N.copy(),
            num_steps_N=chunk.num_steps,
            seed_N=np.array(self._seeds()),
            partial_N=facts["partial"],
            actions_NnA=actions_NnA,
        )
        if over.any():
            self.reset(over)
        return acted

    def reset(self, rows_N: np.ndarray) -> None:
        """Begin the next episode in the environments where ``rows_N`` (bool) is true."""
        self._episode_N[rows_N] += 1
        observation, _ = self.envs.reset(
            seed=self._seeds(), options={"reset_mask": rows_N}
        )
        self._window_NWK[rows_N] = self._repeated(observation[TACTILE_KEY][rows_N])
        self._began_later_N[rows_N] = False
        if drawn := self.starts.draw(rows_N):
            states, windows = zip(*drawn.values(), strict=True)
            chosen_N = np.isin(np.arange(len(rows_N)), list(drawn))
            state = Snapshot.joined(states)
            self.envs.reset(
                seed=self._seeds(), options={"reset_mask": chosen_N, "state": state}
            )
            self._window_NWK[chosen_N], self._began_later_N[chosen_N] = windows, True

    def _seeds(self) -> list[int]:
        return [
            episode_seed(self._root, self._first + i, int(k))
            for i, k in enumerate(self._episode_N)
        ]

    def _repeated(self, reading_NK: np.ndarray) -> np.ndarray:
        """(N, W, K): before an episode's first reading there were none; it is repeated, as in datasets."""
        return np.repeat(reading_NK[:, None], self._window_steps, axis=1)

    def _privileged_numbers(self) -> np.ndarray:
        sim, facts, num = self.envs.sim, self.envs.facts(), self.envs.num_envs
        if not self._privileged:
            return np.zeros((num, 0))
        elapsed = facts["steps"] / sim.judge.limit_steps
        columns = [
            sim.arrays["qpos"],
            sim.arrays["qvel"],
            facts["subtask"],
            facts["partial"],
            elapsed,
        ]
        columns += list(facts["measures"].values())
        numbers = np.concatenate(
            [np.asarray(x, dtype=np.float64).reshape(num, -1) for x in columns], axis=1
        )
        return np.nan_to_num(
            numbers, nan=0.0, posinf=0.0, neginf=0.0
        )  # of a diverged simulation

    def state_dict(self) -> dict[str, Any]:
        """State from which a run continues bit for bit, as ``load_state_dict`` takes it. No episode may end between two calls
        of ``act``."""
        return {
            "root": self._root,
            "episode": self._episode_N.copy(),
            "window": self._window_NWK,
            "snapshot": dataclasses.asdict(self.envs.sim.snapshot()),
            "starts": self.starts.state_dict(),
            "began_later": self._began_later_N.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from ``state_dict``, of as many environments. Raises TaccorlError: the state is of another task,
        difficulty, twin or randomisation."""
        self._root, self._episode_N = state["root"], state["episode"].copy()
        self._window_NWK, self._began_later_N = (
            state["window"].copy(),
            state["began_later"].copy(),
        )
        self.starts.load_state_dict(state["starts"])
        self.envs.reset(
            seed=self._seeds(), options={"state": Snapshot(**state["snapshot"])}
        )

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()


def make_shard(envs: dict[str, Any], **options: Any) -> TwinShard:
    """Make environments and the shard that holds them.

    Args:
        envs: arguments of ``TaccorlVectorEnv`` but ``autoreset``.
        options: further arguments of ``TwinShard``.
    """
    return TwinShard(
        TaccorlVectorEnv(**envs, autoreset=AutoresetMode.DISABLED), **options
    )
