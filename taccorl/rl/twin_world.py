"""The twin's environments for rollouts: the policy's own processors, its window of touch, pictures only when they are used.

Letters in shapes: N environments, n executed actions of a chunk, A action, L history, K taxels, P privileged numbers.
"""

import copy
from collections.abc import Sequence
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
from taccorl.rl.rollout import Acted, Clock, Observations
from taccorl.rl.shards import Shard
from taccorl.rl.twin_shard import PRIVILEGED, ShardActed
from taccorl.rl.watched_episode import EpisodeWatch
from taccorl.robots import ROBOT
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.sim.spaces import IMAGE_KEYS, STATE_KEY, TACTILE_KEY, Observation


def needs_images(config: Any) -> bool:
    """Whether the policy has camera inputs, so that environments must render them."""
    return any(feature.type is FeatureType.VISUAL for feature in config.input_features.values())


class TwinWorld:
    """``World`` of one task in the twin, of shards that compute at the same time."""

    def __init__(
        self, shards: Sequence[Shard], config: Any, preprocessor: Processor, postprocessor: Processor, *, clock: Clock
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
                "post-training: --policy.normalization_mapping normalises pictures (VISUAL); only IDENTITY is supported"
            )
        self.shards, self._clock = list(shards), clock
        self._preprocessor, self._postprocessor = preprocessor, postprocessor
        facts = self.shards[0].facts
        if config.part_poses:
            require_same_parts(config, facts.task, facts.part_names)
        self.limit_steps, self._instruction, self._device = facts.limit_steps, facts.instruction, config.device
        inputs = config.input_features
        self._cameras = [IMAGE_KEYS[name] for name in ROBOT.cameras if IMAGE_KEYS[name] in inputs]
        self.needs_images = needs_images(config)
        self._kept = {*inputs, OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK}
        self._kept |= {HAND_POSES} if config.knows_hands else set()
        self._kept |= {PART_POSES} if config.part_poses else set()
        ends = np.cumsum([shard.facts.num_envs for shard in self.shards])
        self.num_envs, self._ends = int(ends[-1]), ends[:-1]
        self.watch = EpisodeWatch()

    def _each(self, method: str, *arguments: Sequence[Any]) -> list[Any]:
        """``method`` of all shards at the same time; ``arguments`` have an entry for each."""
        for k, shard in enumerate(self.shards):
            shard.start(method, *(argument[k] for argument in arguments))
        return [shard.result() for shard in self.shards]

    def restart(self, seed: int) -> None:
        """Start new episodes with the seed sequence of ``seed``."""
        self._each("restart", [seed] * len(self.shards))
        self.watch.reset()

    def observe(self) -> Observations:
        with self._clock.part("pictures"):
            observations = self._each("observe")
        return self._seen(observations)

    def act(self, actions_NnA: Tensor) -> Acted:
        with self._clock.part("policy"):
            actions = self._postprocessor(actions_NnA).to("cpu").numpy().astype(np.float32)
        with self._clock.part("physics"):
            acted: list[ShardActed] = self._each("act", np.split(actions, self._ends))
        joined = {
            name: np.concatenate([getattr(a, name) for a in acted]) for name in ShardActed._fields if name != "last"
        }
        last = [a.last for a in acted if a.last is not None]
        outcomes, later = joined["outcome_N"].tolist(), joined["began_later_N"].tolist()
        self.watch.stepped(actions[0, : joined["num_steps_N"][0]])
        if outcomes[0]:
            # Episodes that began in a state of an earlier one cannot be executed again from their seed.
            self.watch.end(int(joined["seed_N"][0]), None if later[0] else outcomes[0], int(joined["partial_N"][0]))
        return Acted(
            reward_N=torch.from_numpy(joined["reward_N"]).float(),
            terminated_N=torch.from_numpy(joined["terminated_N"]),
            truncated_N=torch.from_numpy(joined["truncated_N"]),
            last=self._seen(last) if last else None,
            outcomes=[None if is_later else outcome for outcome, is_later in zip(outcomes, later, strict=True)],
            later_outcomes=[outcome if is_later else None for outcome, is_later in zip(outcomes, later, strict=True)],
        )

    def _seen(self, parts: Sequence[Observation]) -> Observations:
        observation = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        privileged_NP = torch.from_numpy(observation[PRIVILEGED]).float().to(self._device)
        with self._clock.part("policy"):
            numbers = {key: observation[key] for key in (STATE_KEY, TACTILE_KEY, PARTS_KEY) if key in observation}
            found = policy_batch(self._preprocessor, numbers, [self._instruction] * len(privileged_NP))
            batch: Batch = {k: x.to(self._device) for k, x in found.items() if k in self._kept}
            for key in self._cameras:  # (N, 3, rows, columns) uint8, a quarter of float32
                batch[key] = torch.from_numpy(observation[key]).to(self._device).permute(0, 3, 1, 2).contiguous()
        return Observations(batch, privileged_NP)

    def state_dict(self) -> dict[str, Any]:
        """State from which a run continues bit for bit, as ``load_state_dict`` takes it. No episode may end between two calls
        of ``act``.
        """
        return {"shards": self._each("state_dict"), "watch": copy.deepcopy(vars(self.watch))}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from ``state_dict``.

        Raises:
            TaccorlError: the state is of another number of environments or shards, task, difficulty, twin or randomisation.
        """
        if "shards" not in state:
            raise TaccorlError(
                "--resume=true: the checkpoint was written by a taccorl from before 22 November 2026, which stored "
                "environments in another form: start a new run from its policy, "
                "--policy.path=…/checkpoints/last/pretrained_model"
            )
        there, here = len(state["shards"]), len(self.shards)
        if there != here:
            raise TaccorlError(f"--env.shards={here}: the run was stopped with {there}; resume with the same number")
        self._each("load_state_dict", state["shards"])
        self.watch = EpisodeWatch(**copy.deepcopy(state["watch"]))

    def close(self) -> None:
        """Close all environments, also while one of them computes."""
        for shard in self.shards:
            shard.close()
