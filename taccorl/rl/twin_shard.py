"""Environments of the twin for rollouts, as numbers: a policy's window of touch, streams of scenes, exact resuming.

Scenes come from a stream of seeds: the k-th episode of environment i has ``episode_seed(seed, i, k)``. A world may be made of
several shards; i counts through all of them, so that scenes do not depend on how environments are divided.

Letters in shapes: N environments, n executed actions of a chunk, A action, L history, W control steps of the window, K taxels,
P privileged numbers.
"""

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode

from taccorl.errors import TaccorlError
from taccorl.evaluation.episodes import SUCCESS
from taccorl.rl.start_states import StartStates
from taccorl.sim.episode_seeds import episode_seed
from taccorl.sim.part_poses import part_pose_names
from taccorl.sim.simulation import Snapshot
from taccorl.sim.spaces import IMAGE_KEYS, TACTILE_KEY, Observation
from taccorl.sim.vector_env import TaccorlVectorEnv
from taccorl.training.frame_cache import resized

_COMPARED = 8  # environments whose pictures are drawn in two ways
PRIVILEGED = "privileged"
"""Key of an observation, (N, P) float64: joints' positions and velocities, subtasks, goals, elapsed share of the time, the task's
measures. P = 0 unless asked for."""


SCENE = "scene"
"""Key of an observation, (N, 2) int64: scene seed, and number of control steps since the scene's start."""


class DrawnPictures(NamedTuple):
    """Pictures that the device of the physics draws for a policy."""

    cameras: Sequence[str]
    """Names of the policy's cameras."""
    size: tuple[int, int]
    """Rows and columns, as the policy reads them."""
    on_host: bool = False
    """True: the shard runs in another process, to which arrays are sent."""


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
        num_actions: int = 1,
        starts: StartStates,
        privileged: bool = False,
        first: int = 0,
        drawn: DrawnPictures | None = None,
    ) -> None:
        """
        Args:
            envs: environments with ``AutoresetMode.DISABLED``; observations contain pictures unless they render them ``never``.
            history: L; observations have L readings of touch, (N, L, K), the last one at present.
            stride: control steps between two of these readings.
            num_actions: n, control steps of a decision; ``act`` takes multiples of it. The time limit of episodes becomes a
                multiple of it, too.
            starts: states of earlier episodes in which episodes begin.
            privileged: observations contain the simulator's state.
            first: number of the first environment among those of all shards.
            drawn: pictures that the physics' device draws, in place of those of ``envs``, if it can.
        """
        assert envs.autoreset is AutoresetMode.DISABLED
        self.envs, self.starts = envs, starts
        self._privileged, self._first = privileged, first
        # Decisions begin, and time runs out, after multiples of num_actions: other readings are in no window.
        judge = envs.sim.judge
        judge.limit_steps = max(
            num_actions, judge.limit_steps - judge.limit_steps % num_actions
        )
        self._touch_every = math.gcd(stride, num_actions)
        self._stride = stride // self._touch_every
        self._window_size = (history - 1) * self._stride + 1
        self._root, self._episode_N = 0, np.zeros(envs.num_envs, dtype=np.int64)
        self._seed_N = np.zeros(envs.num_envs, dtype=np.int64)
        self._drawn = drawn if envs.sim.draws_on_device else None
        self._pictures: dict[str, Any] = {}
        self._unseen_N = np.ones(envs.num_envs, dtype=bool)
        self._began_later_N = np.zeros(envs.num_envs, dtype=bool)
        self._window_NWK = np.zeros(
            (0,)
        )  # W readings, of which the policy gets every ``self._stride``-th

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
        self._draw_seeds(np.ones(self.envs.num_envs, dtype=bool))
        self.starts.restart((seed, self._first))
        observation, _ = self.envs.reset(seed=self._seed_N.tolist())
        self._unseen_N[:] = True
        self._window_NWK = self._repeated(observation[TACTILE_KEY])

    def observe(self) -> Observation:
        """Present observations of all environments, with the window of touch (N, L, K), ``PRIVILEGED`` and ``SCENE``."""
        has_pictures = self.envs.images != "never" and self._drawn is None
        observation = self._with_state(self.envs.observe(images=has_pictures))
        if self._drawn is not None and self._unseen_N.any():
            rows_N = self._unseen_N & ~self.envs.sim.diverged
            new = self._draw(rows_N)
            for key, pictures in new.items():
                if not rows_N.all() and self._pictures:
                    kept = copy.deepcopy(self._pictures[key])  # it was handed out
                    kept[np.flatnonzero(rows_N)] = pictures
                    new[key] = kept
            self._pictures = new
            self._unseen_N[:] = False
        return observation | self._pictures

    def _last(self, rows_N: np.ndarray) -> Observation:
        """Observations of the environments in ``rows_N`` (bool), whose episodes end here."""
        if self._drawn is None:
            return {key: x[rows_N] for key, x in self.observe().items()}
        observation = self._with_state(self.envs.observe())
        return {key: x[rows_N] for key, x in observation.items()} | self._draw(rows_N)

    def _draw(self, rows_N: np.ndarray) -> dict[str, Any]:
        """Key of each camera → (n, 3, R, C) uint8 tensor of the environments in ``rows_N`` (bool); ``on_host``: array
        (n, R, C, 3)."""
        assert self._drawn is not None
        names, size, on_host = self._drawn
        ids = np.flatnonzero(rows_N)
        drawn = self.envs.sim.draw_on_device(names, ids, size)
        if on_host:  # as OpenGL's
            drawn = drawn.permute(0, 1, 3, 4, 2).cpu().numpy()
        return {IMAGE_KEYS[name]: drawn[:, k] for k, name in enumerate(names)}

    def picture_difference(self) -> float | None:
        """Mean difference [of 255] between what the device draws for the policy and OpenGL's pictures, which datasets have,
        reduced to the same size; of the first environments. None: the device draws none. Raises TaccorlError: no OpenGL."""
        if self._drawn is None:
            return None
        names, size, _ = self._drawn
        sim, ids = self.envs.sim, np.arange(min(_COMPARED, self.envs.num_envs))
        drawn = sim.draw_on_device(names, ids, size).cpu().numpy()
        stored = sim.render_by_opengl(names, ids)
        apart = [
            np.abs(drawn[:, k].astype(int) - resized(stored[name], size))
            for k, name in enumerate(names)
        ]
        return float(np.mean(apart))

    def _with_state(self, observation: Observation) -> Observation:
        sim = self.envs.sim
        return observation | {
            TACTILE_KEY: self._window_NWK[:, :: self._stride].copy(),
            PRIVILEGED: self._privileged_numbers(),
            SCENE: np.stack([sim.seeds, sim.judge.steps], axis=1).astype(np.int64),
        }

    def act(self, actions_NnA: np.ndarray) -> Acted:
        """Execute chunks (N, n, A) of joint targets [rad, m]; reset environments whose episode ended."""
        chunk = self.envs.step_chunk(actions_NnA, touch_every=self._touch_every)
        self._unseen_N[:] = True
        facts = self.envs.facts()
        truncated, over = chunk.truncated, chunk.truncated | chunk.terminated
        outcome = np.where(
            facts["is_success"],
            SUCCESS,
            np.where(over, facts["failure"], np.array(None)),
        )
        windows = np.concatenate([self._window_NWK, chunk.tactile], axis=1)
        # Readings after the end of an episode do not count.
        num_new_N = chunk.num_steps // self._touch_every
        rows_NW = num_new_N[:, None] + np.arange(self._window_size)
        self._window_NWK = windows[np.arange(len(windows))[:, None], rows_NW]
        self.starts.see(self.envs.sim, self._window_NWK, over)
        acted = Acted(
            reward_N=chunk.reward,
            terminated_N=chunk.terminated,
            truncated_N=truncated,
            last=self._last(truncated) if truncated.any() else None,
            outcome_N=outcome,
            began_later_N=self._began_later_N.copy(),
            num_steps_N=chunk.num_steps,
            seed_N=self._seed_N.copy(),
            partial_N=facts["partial"],
            actions_NnA=actions_NnA,
        )
        if over.any():
            self.reset(over)
        return acted

    def reset(self, rows_N: np.ndarray) -> None:
        """Begin the next episode in the environments where ``rows_N`` (bool) is true."""
        self._episode_N[rows_N] += 1
        self._draw_seeds(rows_N)
        observation, _ = self.envs.reset(
            seed=self._seed_N.tolist(), options={"reset_mask": rows_N}
        )
        self._unseen_N |= rows_N
        self._window_NWK[rows_N] = self._repeated(observation[TACTILE_KEY][rows_N])
        self._began_later_N[rows_N] = False
        if drawn := self.starts.draw(rows_N):
            states, windows = zip(*drawn.values(), strict=True)
            chosen_N = np.isin(np.arange(len(rows_N)), list(drawn))
            state = Snapshot.joined(states)
            self.envs.reset(
                seed=self._seed_N.tolist(),
                options={"reset_mask": chosen_N, "state": state},
            )
            self._window_NWK[chosen_N], self._began_later_N[chosen_N] = windows, True

    def _draw_seeds(self, rows_N: np.ndarray) -> None:
        """Scene seeds of the present episodes of the environments in ``rows_N`` (bool)."""
        for i in np.flatnonzero(rows_N).tolist():
            number = int(self._episode_N[i])
            self._seed_N[i] = episode_seed(self._root, self._first + i, number)

    def _repeated(self, reading_NK: np.ndarray) -> np.ndarray:
        """(N, W, K): before an episode's first reading there were none; it is repeated, as in datasets."""
        return np.repeat(reading_NK[:, None], self._window_size, axis=1)

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
        num_readings = state["window"].shape[1]
        if num_readings != self._window_size:
            raise TaccorlError(
                f"state: windows of {num_readings} readings of touch, but this version keeps {self._window_size}: "
                "the run was stored by another version; begin a new one"
            )
        self._window_NWK, self._began_later_N = (
            state["window"].copy(),
            state["began_later"].copy(),
        )
        self._draw_seeds(np.ones(self.envs.num_envs, dtype=bool))
        self.starts.load_state_dict(state["starts"])
        self.envs.reset(
            seed=self._seed_N.tolist(), options={"state": Snapshot(**state["snapshot"])}
        )
        self._unseen_N[:] = True

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
