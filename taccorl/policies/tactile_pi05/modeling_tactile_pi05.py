"""π0.5 with touch as a LeRobot policy: training's loss and the chunk of actions, around the ``network``.

With flow matching, the result for a row without contact equals that of plain pi05 on the same pictures (``image_crop`` 1) bit
by bit: if no row of the batch is in contact, and on a CPU also beside rows in contact (``_by_contact``). On a GPU with other
kernels than LeRobot's (``compiled`` in training, ``graphed`` for a chunk) it is equal up to rounding.
"""

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import RTCAttentionSchedule as Schedule
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import (
    ACTION,
    OBS_IMAGES,
    OBS_LANGUAGE_ATTENTION_MASK,
    OBS_LANGUAGE_TOKENS,
    OBS_STATE,
)
from torch import Tensor

from taccorl.errors import TaccorlError
from taccorl.lineage.manifest import MANIFEST_PLACES, read_manifest, seal_checkpoint
from taccorl.policies.tactile_pi05.averaged import Averaged
from taccorl.policies.tactile_pi05.black_bars import without_bars
from taccorl.policies.tactile_pi05.chunk_steps import ChunkSteps
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import (
    RAW_STATE,
    STATE_SINCE_PLAN,
    TactilePI05Config,
)
from taccorl.policies.tactile_pi05.gate import contact
from taccorl.policies.tactile_pi05.graphed import GraphedCall
from taccorl.policies.tactile_pi05.hand_poses import HAND_POSES
from taccorl.policies.tactile_pi05.image_randomization import (
    PICTURES_CHANGED,
    at_resolution,
)
from taccorl.policies.tactile_pi05.mixture import IS_SIM, Mixture
from taccorl.policies.tactile_pi05.network import TactilePI05Pytorch
from taccorl.policies.tactile_pi05.part_poses import PART_POSES, PoseHead
from taccorl.policies.tactile_pi05.statistics import use_exact_statistics
from taccorl.policies.tactile_pi05.weights import (
    base_of,
    find_weights,
    load_base_weights,
    load_checkpoint,
    load_merged,
)

# B batch, S state, L history, K values of touch, H horizon, A action
ACTION_IS_PAD = "action_is_pad"
_EMPTY_CAMERA = f"{OBS_IMAGES}.empty_camera_"  # of LeRobot's --policy.empty_cameras
_log = logging.getLogger(__name__)


class TactilePI05Policy(PI05Policy):
    """π0.5 with touch as a LeRobot policy. Made from a dataset's metadata or from a checkpoint."""

    config_class = TactilePI05Config
    name = "tactile_pi05"

    def __init__(
        self,
        config: TactilePI05Config,
        *,
        dataset_meta: Any = None,
        dataset_stats: Any = None,
        from_base: bool = True,
        **kwargs: Any,
    ) -> None:
        """``dataset_meta``: LeRobot's metadata of the training dataset; None if the policy is only used. ``dataset_stats``:
        statistics of the dataset, for the share of simulated rows. ``from_base``: start from ``config.base_checkpoint``, if
        there is one; False for loading a checkpoint of this policy. Raises TaccorlError: the dataset does not fit (see
        ``TactilePI05Config.match_dataset``), has no rows of a domain with a weight above 0, or the base does not fit."""
        PreTrainedPolicy.__init__(self, config)
        if dataset_meta is not None:
            config.match_dataset(dataset_meta)
            use_exact_statistics(config, dataset_meta)
        self.mixture = Mixture.of_statistics(dataset_stats, config.sim_weight)
        if dataset_meta is not None and self.mixture is None:
            if IS_SIM in dataset_meta.features:
                raise TaccorlError(
                    f"dataset {dataset_meta.repo_id} ({dataset_meta.root}) has {IS_SIM}, but its statistics do not state how "
                    "many rows are simulated, and the reader that counts them is turned off (TACCORL_NO_PATCH=1, or "
                    "--dataset.streaming=true): remove this setting, or merge the datasets again with taccorl merge"
                )
            if config.sim_share is not None and config.sim_weight not in (0, 1):
                raise TaccorlError(
                    f"dataset {dataset_meta.repo_id} ({dataset_meta.root}) has no {IS_SIM}, but the checkpoint was trained on "
                    f"both domains ({100 * config.sim_share:.0f} % of rows simulated): give the merged dataset; to continue "
                    "with one domain: --policy.sim_weight=0 for real rows, 1 for simulated ones"
                )
            if config.sim_weight not in (0, 1, TactilePI05Config.sim_weight):
                raise TaccorlError(
                    f"--policy.sim_weight={config.sim_weight:g}: dataset {dataset_meta.repo_id} ({dataset_meta.root}) has no "
                    f"{IS_SIM}: it has one domain only. Merge both domains with taccorl merge --real=… --sim=…, or remove the "
                    "weight"
                )
            _log.info(
                "dataset %s has no %s: one domain, sim_weight is not used",
                dataset_meta.repo_id,
                IS_SIM,
            )
        if dataset_meta is not None:
            config.sim_share = self.mixture.sim_share if self.mixture else None
        config.validate_features()
        self.config: TactilePI05Config = config
        self.init_rtc_processor()
        if config.base_checkpoint and from_base:
            find_weights(
                config.base_checkpoint,
                f"--policy.base_checkpoint={config.base_checkpoint}",
            )
        self.model = TactilePI05Pytorch(config, rtc_processor=self.rtc_processor)
        if config.base_checkpoint and from_base:
            load_base_weights(self, config.base_checkpoint)
        if config.gradient_checkpointing:
            self.model.gradient_checkpointing_enable()
        fusion = self.model.fusion
        self.pose_head = (
            PoseHead(fusion.width, config.num_bodies)
            if config.pose_loss and fusion is not None
            else None
        )
        self.steps = (
            ChunkSteps.of_statistics(dataset_stats, config, self._num_actions)
            if config.normalizes_steps
            else None
        )
        self.averaged = (
            Averaged(self.model, config.decay_of_average)
            if config.decay_of_average
            else None
        )
        self.to(config.device)
        changes = config.image_changes()
        self._change_images = changes.build() if changes else None
        self._saw_bars = False
        self.reset()

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: Any,
        *,
        config: Any = None,
        revision: str | None = None,
        **kwargs: Any,
    ) -> "TactilePI05Policy":
        """Load a checkpoint of this policy, or an adapter (PEFT) merged into its base, in evaluation mode. (LeRobot's own loader
        for pi05 continues with random weights if it cannot read them.) Raises TaccorlError: it cannot be read, or its weights
        are not exactly this policy's."""
        hub = {
            k: kwargs.pop(k)
            for k in ("cache_dir", "token", "local_files_only", "force_download")
            if k in kwargs
        }
        for ignored in ("strict", "proxies", "resume_download"):
            kwargs.pop(ignored, None)
        if config is None:
            config = TactilePI05Config.from_pretrained(
                pretrained_name_or_path, revision=revision, **hub
            )
        source = str(pretrained_name_or_path)
        if base_of(Path(source)):
            return load_merged(cls, Path(source), config, **kwargs).eval()
        if source == config.base_checkpoint:  # of an adapter that was trained from it
            return cls(config, **kwargs).eval()
        find_weights(source, f"checkpoint {source}", revision=revision, **hub)
        policy = cls(config, from_base=False, **kwargs)
        load_checkpoint(policy, source, revision=revision, **hub)
        return policy.eval()

    def reset(self) -> None:
        """Clear the queue of actions and the window of touch at the start of an episode."""
        super().reset()
        self._graph: GraphedCall | None = getattr(self, "_graph", None)
        self._felt: dict[str, deque[Tensor]] = {}
        self._plans_state: Tensor | None = None

    def init_rtc_processor(self) -> None:
        """As LeRobot's, with two changes. The guidance weight is at most the number of denoising steps: with more, one step moves
        an action beyond the value that it is guided to. And instead of LeRobot's default, LINEAR, guidance ends with the actions
        that are executed before the chunk arrives (ZEROS): new observations hardly change what is guided by the last chunk."""
        super().init_rtc_processor()
        if self.rtc_processor is not None:
            theirs = self.rtc_processor.rtc_config
            most = min(
                theirs.max_guidance_weight, float(self.config.num_inference_steps)
            )
            how = theirs.prefix_attention_schedule
            how = Schedule.ZEROS if how == Schedule.LINEAR else how
            self.rtc_processor.rtc_config = replace(
                theirs, max_guidance_weight=most, prefix_attention_schedule=how
            )

    def forward(
        self, batch: dict[str, Tensor], reduction: str = "mean"
    ) -> tuple[Tensor, dict]:
        """Return the co-training loss (see ``mixture``) over ``_losses_and_fused``, and values for the log (name → float).

        A row's loss is the mean over its action steps except those beyond the episode's end (LeRobot's pi05 includes them).
        Without such steps, and with one domain, the loss equals LeRobot's flow-matching loss bit by bit. ``batch``: output of the
        preprocessor, with B rows. ``reduction``: "mean" for a scalar, or "none" for the losses of the rows, (B,)."""
        losses_BHA, contact_B, fused_BF = self._losses_and_fused(batch)
        rows, horizon = losses_BHA.shape[:2]
        counts_BH = losses_BHA.new_ones(rows, horizon)
        if ACTION_IS_PAD in batch:
            valid_BH = ~batch[ACTION_IS_PAD].to(losses_BHA.device)
            counts_BH = valid_BH * (
                horizon / valid_BH.sum(dim=1, keepdim=True).clamp(min=1)
            )
        losses_BHA = losses_BHA * counts_BH[:, :, None]
        num_actions = self._num_actions
        told: dict[str, Tensor] = {}
        if self.mixture is not None:
            is_sim_B = self._is_sim(batch)
            told |= self.mixture.means(
                losses_BHA[:, :, :num_actions].mean(dim=(1, 2)).detach(), is_sim_B
            )
            losses_BHA = losses_BHA * self.mixture.weights(is_sim_B)[:, None, None]
        losses_BHA = losses_BHA[:, :, :num_actions]
        loss = losses_BHA.mean(dim=(1, 2)) if reduction == "none" else losses_BHA.mean()
        if (
            self.training
            and PART_POSES in batch
            and self.pose_head is not None
            and fused_BF is not None
        ):
            told["flow_loss"] = loss.detach().mean()
            pose_B, told["pose_error_mm"] = self.pose_head.errors(
                fused_BF, batch[PART_POSES]
            )
            loss = loss + self.config.pose_loss * (
                pose_B if reduction == "none" else pose_B.mean()
            )
            told["pose_loss"] = pose_B.detach().mean()
        told["loss"] = loss.detach().mean()
        if contact_B is not None:
            told["contact_rate"] = contact_B.float().mean()
        said: dict[str, Any] = dict(
            zip(told, torch.stack(list(told.values())).tolist(), strict=True)
        )
        return loss, said

    def _losses_and_fused(
        self, batch: dict[str, Tensor]
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """(B, H, 32) squared errors of the velocity at a random time; (B,) bool contact, None: vision only; and the fusion's
        output (B, F), None for backbones without. Draws noise and time from torch's generator as LeRobot's pi05 does."""
        images, image_masks = self._preprocess_images(batch)
        images = self._tokens(images)
        actions = self.prepare_action(batch)
        noise = self.model.sample_noise(actions.shape, actions.device)
        time = self.model.sample_time(len(actions), actions.device)
        prompt = batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK]

        def compute(rows: Any) -> tuple[Tensor, ...]:
            seen = (
                [image[rows] for image in images],
                [mask[rows] for mask in image_masks],
            )
            losses_BHA = self.model(
                *seen, *(x[rows] for x in (*prompt, actions, noise, time))
            )
            return (
                (losses_BHA,)
                if self.model.fused is None
                else (losses_BHA, self.model.fused)
            )

        (losses_BHA, *fused), contact_B = self._by_contact(batch, compute)
        return losses_BHA, contact_B, fused[0] if fused else None

    @property
    def _num_actions(self) -> int:
        """A; the rest fills up to π0.5's 32."""
        assert self.config.output_features is not None, (
            "validate_features, which __init__ calls, has set them"
        )
        return self.config.output_features[ACTION].shape[0]

    def _by_contact(
        self,
        batch: dict[str, Tensor],
        compute: Callable[[Any], tuple[Tensor, ...]],
        *,
        together: bool = False,
    ) -> tuple[tuple[Tensor, ...], Tensor | None]:
        """The tensors that ``compute(rows)`` gives for all rows, which feel what they touch; and (B,) contact. In training,
        ``touch_dropout`` hides touch from some rows; contact includes these.

        Masked tokens weigh exactly nothing, but they make sums longer, and a longer sum is rounded elsewhere: 5e-7 in a
        chunk. So on a CPU rows with and without contact are computed apart, for the same work, and the latter are plain
        pi05's to the bit. A GPU's kernels round by the size of the batch in any case, and half a batch costs it as much time
        as a whole one: there they stay together. ``together``: on a CPU, too."""
        state, (readings, contact_B) = self._state(batch), self._readings(batch)
        if readings is None or contact_B is None:
            with self.model.sensing(state, None, None):
                return compute(slice(None)), contact_B
        felt_B = self._felt_in_training(contact_B) if self.training else contact_B
        # Compiled layers are compiled for a number of tokens, with those of touch.
        masked = self.model.paligemma_with_expert.fuses(contact_B.device)
        if masked or together or contact_B.device.type != "cpu" or felt_B.all():
            with self.model.sensing(state, readings, felt_B, masked=masked):
                return compute(slice(None)), contact_B
        kinds = [
            rows
            for rows in (felt_B.nonzero()[:, 0], (~felt_B).nonzero()[:, 0])
            if len(rows)
        ]
        parts = []
        for rows in kinds:
            with self.model.sensing(
                None if state is None else state[rows], readings[rows], felt_B[rows]
            ):
                parts.append(compute(rows))
        order = torch.cat(kinds).argsort()
        return tuple(torch.cat(x)[order] for x in zip(*parts, strict=True)), contact_B

    def _felt_in_training(self, contact_B: Tensor) -> Tensor:
        """(B,) contact without the rows that ``touch_dropout`` hides."""
        if not self.config.touch_dropout:
            return contact_B
        return contact_B & (
            torch.rand(len(contact_B), device=contact_B.device)
            >= self.config.touch_dropout
        )

    def _is_sim(self, batch: dict[str, Tensor]) -> Tensor:
        if IS_SIM not in batch:
            raise TaccorlError(
                f"the batch has no {IS_SIM}, but the dataset's statistics do: they belong to another dataset"
            )
        return batch[IS_SIM].reshape(len(batch[IS_SIM])) > 0.5

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor]) -> Tensor:
        """The next action (B, A), normalised, of each environment, from its preprocessed observation, a row of ``batch``. Must be
        called at every control step, because it stores the touch readings."""
        for key, touch in (
            self.config.require_touch().items() if self.config.tactile else ()
        ):
            if key in batch and batch[key][0].numel() == touch.num_values:
                batch = {
                    **batch,
                    key: self._remember(key, batch[key].reshape(-1, touch.num_values)),
                }
        state = batch.get(RAW_STATE)
        if not self._action_queue:
            self._plans_state = state
        action = super().select_action(batch)
        if state is not None and self._plans_state is not None:  # see RawStateStep
            action = action.clone()
            setattr(action, STATE_SINCE_PLAN, state - self._plans_state)
        return action

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Predict a chunk of normalised actions, (B, H, A), for the B rows of ``batch``. Its touch is the whole window, (B, L,
        …), which the caller must provide. ``kwargs``: LeRobot's arguments for real-time chunking; ``num_steps``; and
        ``noise`` (B, H, 32), which is used as it is, without the factor ``inference_noise``."""
        self.eval()
        images, image_masks = self._preprocess_images(batch)
        prompt = batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK]
        noise = kwargs.pop("noise", None)
        if noise is None:
            shape = len(prompt[0]), self.config.chunk_size, self.config.max_action_dim
            noise = self.config.inference_noise * self.model.sample_noise(
                shape, prompt[0].device
            )

        if self._may_graph(prompt[0].device) and not kwargs:
            sensed = self._state(batch), *self._readings(batch)
            return self._finished(
                self._graphed_chunk(images, image_masks, *prompt, noise, *sensed)
            )
        images = self._tokens(images)

        def compute(rows: Any) -> tuple[Tensor]:
            seen = (
                [image[rows] for image in images],
                [mask[rows] for mask in image_masks],
            )
            return (
                self.model.sample_actions(
                    *seen, *(x[rows] for x in prompt), noise=noise[rows], **kwargs
                ),
            )

        if self.steps is not None and kwargs.get("prev_chunk_left_over") is not None:
            kwargs["prev_chunk_left_over"] = self.steps.normalized(
                kwargs["prev_chunk_left_over"]
            )
        (actions,), _ = self._by_contact(batch, compute, together=self._rtc_enabled())
        return self._finished(actions)

    def _may_graph(self, device: torch.device) -> bool:
        # Autocast keeps copies of weights, which a graph would go on using.
        return (
            self.config.cuda_graph
            and device.type == "cuda"
            and not self._rtc_enabled()
            and not torch.is_autocast_enabled(device.type)
        )

    def _graphed_chunk(
        self,
        images: list[Tensor],
        image_masks: list[Tensor],
        tokens: Tensor,
        token_mask: Tensor,
        noise: Tensor,
        *sensed: Tensor | None,
    ) -> Tensor:
        """(B, H, 32) by a recorded graph; contact is a mask, also where there is none. ``sensed``: as ``sensing`` takes it."""
        num, given = len(images), [x for x in sensed if x is not None]

        def compute(*x: Tensor) -> Tensor:
            rest = iter(x[2 * num + 3 :])
            with self.model.sensing(
                *(None if y is None else next(rest) for y in sensed), masked=True
            ):
                return self.model.sample_actions(
                    list(x[:num]),
                    list(x[num : 2 * num]),
                    *x[2 * num : 2 * num + 2],
                    noise=x[2 * num + 2],
                )

        if self._graph is None:
            self._graph = GraphedCall(compute)
        return self._graph(*images, *image_masks, tokens, token_mask, noise, *given)

    def train(self, mode: bool = True) -> "TactilePI05Policy":
        if mode:
            self._graph = None  # its memory is training's
        if mode == self.training:
            return self  # LeRobot says so at every step; going through all modules takes longer than touch does
        if self.averaged is not None:
            self.averaged.exchange(self.model)
        return super().train(mode)

    def update(self) -> None:
        """Called by LeRobot after each step of the optimiser; updates the mean of the weights, if the policy has one."""
        if self.averaged is not None:
            self.averaged.update(self.model)

    def _save_pretrained(self, save_directory: Path, **kwargs: Any) -> None:
        """With the weights that are trained in their place, whatever the policy is doing: training goes on from them. The digests
        of all files are in the manifest, to which the processors add theirs (``with_digests``)."""
        if read_manifest(save_directory):
            (save_directory / MANIFEST_PLACES[0]).unlink()
        was_training = self.training
        self.train()
        super()._save_pretrained(save_directory, **kwargs)
        self.train(was_training)
        seal_checkpoint(save_directory)

    def prepare_action(self, batch: dict[str, Tensor]) -> Tensor:
        """(B, H, 32) training target: the normalised actions (B, H, A) of ``batch``, with ``normalizes_steps`` each step by
        itself, padded to π0.5's 32."""
        if self.steps is None:
            return super().prepare_action(batch)
        return super().prepare_action(
            {**batch, ACTION: self.steps.normalized(batch[ACTION])}
        )

    def _finished(self, actions_BHA: Tensor) -> Tensor:
        """The chunk without what fills it up, as LeRobot's normaliser takes it back."""
        actions_BHA = actions_BHA[:, :, : self._num_actions]
        return actions_BHA if self.steps is None else self.steps.restored(actions_BHA)

    def _remember(self, key: str, reading_BK: Tensor) -> Tensor:
        """(B, L, K): the window's readings; before the first there were none, it is repeated, as in datasets."""
        felt = self._felt.setdefault(key, deque(maxlen=self.config.window_rows))
        if felt and felt[-1].shape != reading_BK.shape:
            raise TaccorlError(
                f"{key}: {tuple(reading_BK.shape)} after {tuple(felt[-1].shape)}: the number of environments changed within a "
                "rollout; call reset() first"
            )
        felt.append(reading_BK)
        readings = [felt[0]] * (self.config.window_rows - len(felt)) + list(felt)
        return torch.stack(readings[:: self.config.tactile_stride], dim=1)

    def _tokens(self, images: list[Tensor]) -> list[Tensor]:
        """Key points' tokens of all rows at once: few rows are rounded elsewhere. Pictures for patches remain pictures."""
        backbone = self.model.paligemma_with_expert
        return (
            backbone.embed_images(images)
            if images and backbone.tells_cameras_apart
            else images
        )

    def _state(self, batch: dict[str, Tensor]) -> Tensor | None:
        """(B, 1, D) the state's token, of all rows at once: few rows are rounded elsewhere. None where the prompt has it."""
        if self.config.has_discrete_state:
            return None
        state_BS = self._robot_state(batch)
        if self.config.part_poses:
            state_BS = torch.cat([state_BS, batch[PART_POSES].to(torch.float32)], dim=1)
        return self.model.state_token(state_BS)

    def _robot_state(self, batch: dict[str, Tensor]) -> Tensor:
        """(B, S) normalised state and, where they are told, hand poses."""
        state_BS = batch[OBS_STATE].to(torch.float32)
        if self.config.knows_hands:
            state_BS = torch.cat([state_BS, batch[HAND_POSES].to(torch.float32)], dim=1)
        return state_BS

    def _readings(
        self, batch: dict[str, Tensor]
    ) -> tuple[Tensor | None, Tensor | None]:
        """(B, L, K) readings and (B,) contact, True if the unit of a feature is not stated; None and None for vision only.
        Raises TaccorlError: no touch, or another number of readings or values than the policy takes."""
        if not self.config.tactile:
            return None, None
        parts, inputs, history = (
            [],
            self.config.require_touch(),
            self.config.tactile_history,
        )
        for key, touch in inputs.items():
            if key not in batch:
                raise TaccorlError(
                    f"--policy.tactile=true, but the batch has no {key}; it has: {', '.join(batch)}"
                )
            values, num = batch[key], touch.num_values
            if values[0].numel() != history * num or (
                history > 1 and values.shape[1] != history
            ):
                raise TaccorlError(
                    f"{key}: {tuple(values.shape)}, but the policy needs (batch, {history}, {num}): a window of {history} "
                    "readings. In training it comes from LeRobot's reader as taccorl.lerobot_plugin extends it, which "
                    "TACCORL_NO_PATCH=1 turns off (then: --policy.tactile_history=1); predict_action_chunk needs it in the "
                    "observation; select_action collects it by itself"
                )
            readings = values.to(torch.float32).reshape(len(values), history, num)
            if self.config.noise_threshold and touch.gain_per_count is not None:
                readings = readings * (readings.abs() > self.config.noise_threshold)
            parts.append(readings)
        readings_BLK = torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]
        if any(touch.gain_per_count is None for touch in inputs.values()):
            return readings_BLK, torch.ones(
                len(readings_BLK), dtype=torch.bool, device=readings_BLK.device
            )
        return readings_BLK, contact(
            readings_BLK, self.config.contact_threshold, self.config.contact_min_active
        )

    def _preprocess_images(
        self, batch: dict[str, Tensor]
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Prepare pictures for the network: changed at random in training; in use cropped to the middle (``image_crop``).
        Raises TaccorlError: a camera is missing, and each has weights of its own: LeRobot puts black pictures behind the
        others."""
        if not self.config.image_features:
            return [], []
        missing = [
            k
            for k in self.config.image_features
            if k not in batch and not k.startswith(_EMPTY_CAMERA)
        ]
        if missing and self.model.paligemma_with_expert.tells_cameras_apart:
            raise TaccorlError(
                f"--policy.backbone={self.config.backbone} has weights for each camera, but the batch has no "
                f"{', '.join(missing)}; it has: {', '.join(batch)}"
            )
        return super()._preprocess_images(self._seen(batch))

    def _seen(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """``batch`` with its pictures cut to the aspect of ``image_resolution`` (``without_bars``), changed or cropped, at the
        policy's resolution, which is that of cached frames. Raises TaccorlError: the policy's first pictures have no black
        bars to cut."""
        size, check = self.config.image_resolution, not self._saw_bars
        self._saw_bars = True  # once is enough: the comparison waits for the GPU
        cameras = [key for key in self.config.image_features if key in batch]
        images = [without_bars(batch[key], size, key, check=check) for key in cameras]
        changes = self._change_images
        if (
            changes is not None
            and PICTURES_CHANGED not in batch
            and (self.training or changes.config.crop < 1)
        ):
            images = [at_resolution(image, size) for image in images]
            images = (
                changes.of_cameras(images)
                if self.training
                else [changes.middle(image) for image in images]
            )
        return {**batch, **dict(zip(cameras, images, strict=True))}

    def _get_default_peft_targets(self) -> dict[str, Any]:
        targets = super()._get_default_peft_targets()
        return (
            {**targets, "modules_to_save": ["model.tactile"]}
            if self.config.tactile
            else targets
        )

    def _validate_peft_config(self, peft_config: Any) -> None:
        """Note the start, by its own path, as the adapter's base. Raises TaccorlError: there is no start, or the policy acts with
        a mean of its weights, which an adapter has not."""
        config = self.config
        if self.averaged is not None:
            raise TaccorlError(
                f"--peft: with --policy.average_decay={config.decay_of_average:g} the policy acts with a mean of its weights, "
                "which an adapter has not: start from a checkpoint that was trained with --policy.average_decay=0"
            )
        if not (given := config.pretrained_path or config.base_checkpoint):
            raise TaccorlError(
                "--peft: nothing to adapt: give --policy.path=… or --policy.base_checkpoint=…"
            )
        # Not by a link such as checkpoints/last, which moves on.
        start = Path(given).resolve() if Path(given).exists() else Path(given)
        if config.pretrained_path:
            config.pretrained_path = start
        else:
            config.base_checkpoint = self.name_or_path = str(start)
            if config.tactile and "model.tactile" not in (
                peft_config.modules_to_save or ()
            ):
                raise TaccorlError(
                    "--peft.full_training_modules: needs model.tactile: its weights are not in the base"
                )
