"""The twin's environments for rollouts: a policy's own processors, its history of touch, pictures only where it looks.

Scenes come from a stream of seeds: the k-th episode of environment i has ``episode_seed(seed, i, k)``.

Letters in shapes: N environments, n executed actions of a chunk, A action, L history, K taxels, P privileged numbers.
"""

import copy
import dataclasses
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from lerobot.configs import FeatureType, NormalizationMode
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import Tensor

from taccorl.errors import TaccorlError
from taccorl.evaluation.policy_actor import Processor, policy_batch, require_same_parts
from taccorl.policies.tactile_pi05.hand_poses import HAND_POSES
from taccorl.policies.tactile_pi05.part_poses import PART_POSES
from taccorl.rl.flow_policy import Batch
from taccorl.rl.rollout import SUCCESS, Acted, Clock, Seen
from taccorl.rl.watched_episode import EpisodeWatch
from taccorl.sim.episode_seeds import episode_seed
from taccorl.sim.simulation import Snapshot
from taccorl.sim.spaces import CAMERAS, IMAGE_KEYS, PARTS_KEY, STATE_KEY, TACTILE_KEY, Observation
from taccorl.sim.vector_env import TaccorlVectorEnv


class TwinWorld:
    """A ``World`` of one task."""

    def __init__(
        self,
        envs: TaccorlVectorEnv,
        config: Any,
        preprocessor: Processor,
        postprocessor: Processor,
        *,
        privileged: bool,
        clock: Clock,
    ) -> None:
        """
        Args:
            envs: with ``AutoresetMode.DISABLED``, pictures on request if the policy has cameras, and poses of the parts if it is
                told them.
            config: ``TactilePI05Config`` of the policy.
            privileged: give the critic the simulator's state.

        Raises:
            TaccorlError: pictures are normalised: they are stored as uint8 and bypass the preprocessor; or the policy was trained
                on the poses of other parts.
        """
        assert envs.autoreset is AutoresetMode.DISABLED
        if config.normalization_mapping.get("VISUAL", NormalizationMode.IDENTITY) is not NormalizationMode.IDENTITY:
            raise TaccorlError(
                "post-training: --policy.normalization_mapping normalises pictures (VISUAL); only IDENTITY is known"
            )
        self.envs, self._config, self._clock, self._privileged = envs, config, clock, privileged
        self._preprocessor, self._postprocessor = preprocessor, postprocessor
        if config.part_poses:
            require_same_parts(config, envs)
        self._device = torch.device(config.device)
        self._history = config.tactile_history
        inputs = config.input_features
        self._cameras = [IMAGE_KEYS[name] for name in CAMERAS if IMAGE_KEYS[name] in inputs]
        self.needs_images = any(feature.type is FeatureType.VISUAL for feature in inputs.values())
        self._kept = {*inputs, OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK}
        self._kept |= {HAND_POSES} if config.knows_hands else set()
        self._kept |= {PART_POSES} if config.part_poses else set()
        self._root = 0
        self._episode_N = np.zeros(envs.num_envs, dtype=np.int64)
        self._observation: Observation = {}
        self._window_NLK = np.zeros((0,))
        self.watch = EpisodeWatch()

    @property
    def num_envs(self) -> int:
        return self.envs.num_envs

    def restart(self, seed: int) -> None:
        """Begin the stream of scenes ``seed``."""
        self._root, self._episode_N[:] = seed, 0
        self._observation, _ = self.envs.reset(seed=self._seeds())
        self._window_NLK = self._repeated(self._observation[TACTILE_KEY])
        self.watch.reset()

    def observe(self) -> Seen:
        with self._clock.part("pictures"):
            observation = self.envs.observe(images=self.needs_images)
        return self._seen(observation, self._window_NLK, np.arange(self.num_envs))

    def act(self, actions_NHA: Tensor) -> Acted:
        with self._clock.part("policy"):
            actions = self._postprocessor(actions_NHA).to("cpu").numpy().astype(np.float32)
        with self._clock.part("physics"):
            chunk = self.envs.step_chunk(actions)
            facts = self.envs.facts()
        truncated, terminated = chunk.truncated, chunk.terminated
        outcome = np.where(facts["is_success"], SUCCESS, facts["failure"])
        outcomes = [str(o) or None for o in outcome]
        windows = np.concatenate([self._window_NLK, chunk.tactile], axis=1)
        ends = self._history + chunk.num_steps  # readings after the end of an episode do not count
        self._window_NLK = np.stack([w[end - self._history : end] for w, end in zip(windows, ends, strict=True)])
        self._observation = chunk.observation
        self.watch.stepped(actions[0, : chunk.num_steps[0]])
        if outcomes[0]:
            self.watch.end(self._seeds()[0], outcomes[0], int(facts["partial"][0]))
        last = self._before_reset(truncated) if truncated.any() else None
        if (over := truncated | terminated).any():
            with self._clock.part("physics"):
                self.reset(torch.from_numpy(over))
        return Acted(
            reward_N=torch.from_numpy(chunk.reward).float(),
            terminated_N=torch.from_numpy(terminated),
            truncated_N=torch.from_numpy(truncated),
            last=last,
            outcomes=outcomes,
        )

    def _before_reset(self, rows: np.ndarray) -> Seen:
        with self._clock.part("pictures"):
            observation = self.envs.observe(images=self.needs_images)
        ids = np.flatnonzero(rows)
        return self._seen({key: x[ids] for key, x in observation.items()}, self._window_NLK[ids], ids)

    def reset(self, rows_N: Tensor) -> None:
        over = rows_N.numpy()
        self._episode_N[over] += 1
        self._observation, _ = self.envs.reset(seed=self._seeds(), options={"reset_mask": over})
        self._window_NLK[over] = self._repeated(self._observation[TACTILE_KEY][over])
        if over[0]:
            self.watch.reset()

    def _seeds(self) -> list[int]:
        return [episode_seed(self._root, i, int(k)) for i, k in enumerate(self._episode_N)]

    def _repeated(self, reading_NK: np.ndarray) -> np.ndarray:
        """(N, L, K): before an episode's first reading there were none; it is repeated, as in datasets."""
        return np.repeat(reading_NK[:, None], self._history, axis=1)

    def _seen(self, observation: Observation, window_NLK: np.ndarray, ids: np.ndarray) -> Seen:
        with self._clock.part("policy"):
            numbers = {STATE_KEY: observation[STATE_KEY], TACTILE_KEY: window_NLK}
            if PARTS_KEY in observation:
                numbers[PARTS_KEY] = observation[PARTS_KEY]
            instructions = [self.envs.task_description] * len(ids)
            found = policy_batch(self._preprocessor, numbers, instructions)
            batch: Batch = {k: x.to(self._device) for k, x in found.items() if k in self._kept}
            for key in self._cameras:  # (N, 3, rows, columns) uint8, a quarter of float32
                batch[key] = torch.from_numpy(observation[key]).to(self._device).permute(0, 3, 1, 2).contiguous()
        return Seen(batch, torch.from_numpy(self._privileged_numbers(ids)).float().to(self._device))

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
        """All that is needed to go on bit for bit; no episode is over between two calls of ``act``."""
        snapshot = self.envs.sim.snapshot()
        fields = {f.name: getattr(snapshot, f.name) for f in dataclasses.fields(snapshot)}
        state = {"root": self._root, "episode": self._episode_N.copy(), "window": self._window_NLK, "snapshot": fields}
        return state | {"watch": copy.deepcopy(vars(self.watch))}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """What ``state_dict`` gave.

        Raises:
            TaccorlError: of another number of environments, task, difficulty, twin or randomisation.
        """
        if len(state["episode"]) != self.num_envs:
            raise TaccorlError(
                f"--env.num_envs={self.num_envs}: the run was stopped with {len(state['episode'])}; resume with the same"
            )
        self._root, self._episode_N = state["root"], state["episode"].copy()
        self._window_NLK = state["window"].copy()
        self.watch = EpisodeWatch(**copy.deepcopy(state["watch"]))
        options = {"state": Snapshot(**state["snapshot"])}
        self._observation, _ = self.envs.reset(seed=self._seeds(), options=options)
