"""The twin's environments for rollouts: the policy's own processors, its window of touch, pictures only when they are used.

Letters in shapes: N environments, n executed actions of a chunk, A action, L history, K taxels, P privileged numbers.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from lerobot.configs import NormalizationMode
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import Tensor

from taccorl.errors import TaccorlError
from taccorl.evaluation.policy_actor import Checkpoint, policy_batch, require_same_parts
from taccorl.policies.tactile_pi05.hand_poses import HAND_POSES
from taccorl.policies.tactile_pi05.image_randomization import PICTURES_CHANGED
from taccorl.policies.tactile_pi05.part_poses import PART_POSES
from taccorl.policies.tactile_pi05.scene_pictures import ScenePictures, channels_first
from taccorl.rl.flow_policy import Batch
from taccorl.rl.rollout import Clock, Observations
from taccorl.rl.shards import Shard
from taccorl.rl.twin_shard import PRIVILEGED, SCENE, Acted, ShardFacts
from taccorl.robots import ROBOT
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.sim.spaces import IMAGE_KEYS, STATE_KEY, TACTILE_KEY, Observation


class TwinWorld:
    """``World`` of one task in the twin, of shards that compute at the same time."""

    def __init__(
        self,
        shards: Sequence[Shard],
        opened: Checkpoint,
        clock: Clock,
        pictures: ScenePictures | None = None,
    ) -> None:
        """
        Args:
            shards: shards with equal settings except for their sizes, and consecutive numbers of environments; with pictures if
                the policy has cameras.
            opened: the policy's checkpoint, for its configuration and processors.
            pictures: changes of the pictures that the policy sees; None: it sees them as they are rendered.

        Raises:
            TaccorlError: pictures are normalised: they are stored as uint8 and bypass the preprocessor. Or the policy was trained
                on the poses of other parts.
        """
        config: Any = opened.config
        if (
            config.normalization_mapping.get("VISUAL", NormalizationMode.IDENTITY)
            is not NormalizationMode.IDENTITY
        ):
            raise TaccorlError(
                "post-training: --policy.normalization_mapping of pictures (VISUAL) must be IDENTITY"
            )
        self.shards, self.clock, self._pictures = list(shards), clock, pictures
        self._preprocessor, self._postprocessor = (
            opened.preprocessor,
            opened.postprocessor,
        )
        all_facts: list[ShardFacts] = self._each("facts")
        facts = all_facts[0]
        if config.part_poses:
            require_same_parts(config, facts.task, facts.part_names)
        self.limit_steps, self._instruction, self._device = (
            facts.limit_steps,
            facts.instruction,
            config.device,
        )
        inputs = config.input_features
        self._cameras = [
            IMAGE_KEYS[name] for name in ROBOT.cameras if IMAGE_KEYS[name] in inputs
        ]
        self._kept = {
            *inputs,
            OBS_LANGUAGE_TOKENS,
            OBS_LANGUAGE_ATTENTION_MASK,
            HAND_POSES,
            PART_POSES,
        }
        ends = np.cumsum([own.num_envs for own in all_facts])
        self.num_envs, self._ends = int(ends[-1]), ends[:-1]

    def _each(self, method: str, *arguments: Sequence[Any]) -> list[Any]:
        """``method`` of all shards at the same time; ``arguments`` have an entry for each."""
        for k, shard in enumerate(self.shards):
            shard.start(method, *(argument[k] for argument in arguments))
        return [shard.result() for shard in self.shards]

    def restart(self, seed: int) -> None:
        """Start new episodes with the seed sequence of ``seed``."""
        self._each("restart", [seed] * len(self.shards))

    def observe(self) -> Observations:
        with self.clock.part("pictures"):
            observations = self._each("observe")
        return self._seen(observations)

    def act(self, actions_NnA: Tensor) -> Acted:
        with self.clock.part("policy"):
            actions = (
                self._postprocessor(actions_NnA).to("cpu").numpy().astype(np.float32)
            )
        with self.clock.part("physics"):
            parts: list[Acted] = self._each("act", np.split(actions, self._ends))
        last = [part.last for part in parts if part.last is not None]
        columns = {
            name: [getattr(part, name) for part in parts]
            for name in Acted._fields
            if name != "last"
        }
        joined = {name: np.concatenate(values) for name, values in columns.items()}
        return Acted(**joined, last=self._seen(last) if last else None)

    def _seen(self, parts: Sequence[Observation]) -> Observations:
        observation = parts[0]
        if len(parts) > 1:
            observation = {
                key: self._joined([part[key] for part in parts]) for key in observation
            }
        privileged_NP = (
            torch.from_numpy(observation[PRIVILEGED]).float().to(self._device)
        )
        with self.clock.part("policy"):
            numbers = {
                key: observation[key]
                for key in (STATE_KEY, TACTILE_KEY, PARTS_KEY)
                if key in observation
            }
            found = policy_batch(
                self._preprocessor,
                numbers,
                [self._instruction] * len(privileged_NP),
                on_device=True,
            )
            batch: Batch = {
                k: x.to(self._device) for k, x in found.items() if k in self._kept
            }
            batch |= self._seen_pictures(
                {key: observation[key] for key in self._cameras}, observation[SCENE]
            )
        return Observations(batch, privileged_NP)

    def _joined(self, parts: list[Any]) -> Any:
        """One array of those of all shards, or one tensor on the policy's device."""
        if isinstance(parts[0], Tensor):
            return torch.cat([part.to(self._device) for part in parts])
        return np.concatenate(parts)

    def _seen_pictures(self, clear: Observation, scene_N2: np.ndarray) -> Batch:
        """(N, 3, rows, columns) uint8, a quarter of float32: what is stored for the update is what the policy saw."""
        if self._pictures is None or not clear:
            return {
                key: channels_first(x, self._device).contiguous()
                for key, x in clear.items()
            }
        changed = self._pictures(clear, scene_N2[:, 0], scene_N2[:, 1])
        return {
            **changed,
            PICTURES_CHANGED: torch.ones(
                len(scene_N2), dtype=torch.bool, device=self._device
            ),
        }

    def picture_difference(self) -> float | None:
        """That of the first shard (``TwinShard.picture_difference``)."""
        self.shards[0].start("picture_difference")
        return self.shards[0].result()

    def state_dict(self) -> dict[str, Any]:
        """State from which a run continues bit for bit, as ``load_state_dict`` takes it. No episode may end between two calls
        of ``act``."""
        return {"shards": self._each("state_dict")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from ``state_dict``, of as many shards and environments. Raises TaccorlError: the state is of another
        task, difficulty, twin or randomisation."""
        self._each("load_state_dict", state["shards"])

    def close(self) -> None:
        """Close all environments, also while one of them computes."""
        for shard in self.shards:
            shard.close()
