"""The twin's environments for rollouts: the policy's own processors, its window of touch, pictures only when they are used.

Several groups of environments (shards) compute at the same time. One thread for each of them waits for its results.

Letters in shapes: N environments, n executed actions of a chunk, A action, L history, K taxels, P privileged numbers.
"""

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, NormalizationMode
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import Tensor

from taccorl.errors import TaccorlError
from taccorl.evaluation.policy_actor import Processor, policy_batch, require_same_parts
from taccorl.policies.tactile_pi05.hand_poses import HAND_POSES
from taccorl.policies.tactile_pi05.part_poses import PART_POSES
from taccorl.rl.flow_policy import Batch
from taccorl.rl.remote_shards import RemoteShard
from taccorl.rl.rollout import Acted, Clock, Seen
from taccorl.rl.twin_shard import Shard, ShardActed, ShardSeen
from taccorl.rl.watched_episode import EpisodeWatch
from taccorl.robots import ROBOT
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.sim.spaces import IMAGE_KEYS, STATE_KEY, TACTILE_KEY


def needs_images(config: Any) -> bool:
    """Whether the policy has camera inputs, so that environments must render them."""
    return any(feature.type is FeatureType.VISUAL for feature in config.input_features.values())


class TwinWorld:
    """``World`` of one task in the twin."""

    def __init__(
        self,
        shards: Sequence[Shard],
        config: Any,
        preprocessor: Processor,
        postprocessor: Processor,
        *,
        clock: Clock,
    ) -> None:
        """
        Args:
            shards: shards with equal settings except for their sizes, and consecutive numbers of environments; with pictures if
                the policy has cameras.
            config: ``TactilePI05Config`` of the policy.

        Raises:
            TaccorlError: pictures are normalised: they are stored as uint8 and bypass the preprocessor. Or the policy was trained
                on the poses of other parts.
        """
        if config.normalization_mapping.get("VISUAL", NormalizationMode.IDENTITY) is not NormalizationMode.IDENTITY:
            raise TaccorlError(
                "post-training: --policy.normalization_mapping normalises pictures (VISUAL); only IDENTITY is known"
            )
        self.shards, self._config, self._clock = list(shards), config, clock
        self._preprocessor, self._postprocessor = preprocessor, postprocessor
        if config.part_poses:
            require_same_parts(config, self.shards[0].task, self.shards[0].part_names)
        self._device = torch.device(config.device)
        inputs = config.input_features
        self._cameras = [IMAGE_KEYS[name] for name in ROBOT.cameras if IMAGE_KEYS[name] in inputs]
        self.needs_images = needs_images(config)
        self._kept = {*inputs, OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK}
        self._kept |= {HAND_POSES} if config.knows_hands else set()
        self._kept |= {PART_POSES} if config.part_poses else set()
        firsts = np.cumsum([0, *(shard.num_envs for shard in self.shards)])
        self._bounds = list(zip(firsts[:-1].tolist(), firsts[1:].tolist(), strict=True))
        self._threads = [ThreadPoolExecutor(1) for _ in self.shards] if len(self.shards) > 1 else []
        self.watch = EpisodeWatch()

    @property
    def limit_steps(self) -> int:
        """Control steps after which an episode ends."""
        return self.shards[0].limit_steps

    @property
    def num_envs(self) -> int:
        return self._bounds[-1][1]

    def _each(self, work: Callable[[Shard, int, int], Any]) -> list[Any]:
        """``work(shard, first, end)`` of all shards, side by side."""
        if not self._threads:
            return [work(self.shards[0], *self._bounds[0])]
        calls = zip(self._threads, self.shards, self._bounds, strict=True)
        waiting = [thread.submit(work, shard, *bounds) for thread, shard, bounds in calls]
        return [each.result() for each in waiting]

    def restart(self, seed: int) -> None:
        """Start new episodes with the seed sequence of ``seed``."""
        self._each(lambda shard, *_: shard.restart(seed))
        self.watch.reset()

    def observe(self) -> Seen:
        with self._clock.part("pictures"):
            seen = self._each(lambda shard, *_: shard.observe())
        return self._seen(seen)

    def act(self, actions_NHA: Tensor) -> Acted:
        with self._clock.part("policy"):
            actions = self._postprocessor(actions_NHA).to("cpu").numpy().astype(np.float32)
        with self._clock.part("physics"):
            acted = self._each(lambda shard, first, end: shard.act(actions[first:end]))
        last = [each.last for each in acted if each.last is not None]
        self._watch(actions, acted[0])

        def joined(name: str) -> Tensor:
            return torch.from_numpy(np.concatenate([getattr(each, name) for each in acted]))

        return Acted(
            reward_N=joined("reward_N").float(),
            terminated_N=joined("terminated_N"),
            truncated_N=joined("truncated_N"),
            last=self._seen(last) if last else None,
            outcomes=[o for each in acted for o in each.outcomes],
            later_outcomes=[o for each in acted for o in each.later_outcomes],
        )

    def _watch(self, actions_NHA: np.ndarray, acted: ShardActed) -> None:
        """Environment 0. Episodes that began in a state of an earlier one cannot be executed again from their seed."""
        self.watch.stepped(actions_NHA[0, : acted.num_steps_N[0]])
        if outcome := acted.outcomes[0]:
            self.watch.end(int(acted.seed_N[0]), outcome, int(acted.partial_N[0]))
        if outcome or acted.later_outcomes[0]:
            self.watch.reset()

    def reset(self, rows_N: Tensor) -> None:
        rows = rows_N.numpy()
        if rows[0]:
            self.watch.reset()
        self._each(lambda shard, first, end: shard.reset(rows[first:end]) if rows[first:end].any() else None)

    def _seen(self, parts: Sequence[ShardSeen]) -> Seen:
        observation = {key: np.concatenate([p.observation[key] for p in parts]) for key in parts[0].observation}
        window_NLK = np.concatenate([p.window_NLK for p in parts])
        with self._clock.part("policy"):
            numbers = {STATE_KEY: observation[STATE_KEY], TACTILE_KEY: window_NLK}
            if PARTS_KEY in observation:
                numbers[PARTS_KEY] = observation[PARTS_KEY]
            instructions = [self.shards[0].instruction] * len(window_NLK)
            found = policy_batch(self._preprocessor, numbers, instructions)
            batch: Batch = {k: x.to(self._device) for k, x in found.items() if k in self._kept}
            for key in self._cameras:  # (N, 3, rows, columns) uint8, a quarter of float32
                batch[key] = torch.from_numpy(observation[key]).to(self._device).permute(0, 3, 1, 2).contiguous()
        privileged_NP = np.concatenate([p.privileged_NP for p in parts])
        return Seen(batch, torch.from_numpy(privileged_NP).float().to(self._device))

    def state_dict(self) -> dict[str, Any]:
        """State from which a run continues bit for bit; no episode may end between two calls of ``act``."""
        return {"shards": self._each(lambda shard, *_: shard.state_dict()), "watch": copy.deepcopy(vars(self.watch))}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from ``state_dict``.

        Raises:
            TaccorlError: the state is of another number of environments or shards, task, difficulty, twin or randomisation.
        """
        if "shards" not in state:
            raise TaccorlError(
                "--resume=true: the checkpoint was written by a taccorl of before 22 November 2026, which kept environments in "
                "another form: begin anew from its policy, --policy.path=…/checkpoints/last/pretrained_model"
            )
        states = state["shards"]
        if len(states) != len(self.shards):
            raise TaccorlError(
                f"--env.shards={len(self.shards)}: the run was stopped with {len(states)}; resume with the same"
            )
        own = dict(zip((first for first, _ in self._bounds), states, strict=True))
        self._each(lambda shard, first, _: shard.load_state_dict(own[first]))
        self.watch = EpisodeWatch(**copy.deepcopy(state["watch"]))

    def close(self) -> None:
        """Close all environments.

        Environments of this process are closed in the thread that rendered their pictures, because an OpenGL context works in
        one thread only.
        """
        if all(isinstance(shard, RemoteShard) for shard in self.shards):  # also while a thread waits for one of them
            for shard in self.shards:
                shard.close()
        else:
            self._each(lambda shard, *_: shard.close())
        for thread in self._threads:
            thread.shutdown()
