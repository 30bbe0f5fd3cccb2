"""``lerobot-train --policy.type=tactile_pi05``: every setting of the policy; the defaults are the paper's co-training table."""

import dataclasses
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.optim.optimizers import AdamWConfig, OptimizerConfig, OptimizerParams
from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig, LRSchedulerConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from taccorl.errors import TaccorlError, nearest
from taccorl.policies.tactile_pi05.gate import CONTACT_THRESHOLD, MIN_ACTIVE
from taccorl.policies.tactile_pi05.hand_poses import NUM_HAND_POSES, arm_names
from taccorl.policies.tactile_pi05.image_randomization import COTRAINING_NOISE_STD, ImageRandomizationConfig
from taccorl.policies.tactile_pi05.part_poses import bodies_of, num_part_numbers
from taccorl.sim.part_poses import PARTS_KEY

TACTILE = "observation.tactile"
RAW_STATE = "observation.state_raw"  # (B, 14), only at inference with relative actions
STATE_SINCE_PLAN = "state_since_plan"  # of an action tensor: how far that has moved since its chunk was predicted
_PALIGEMMA = "google/paligemma-3b-pt-224"
_BACKBONES = ("full", "small", "tiny")
_STATED = {"sensor", "layout", "pads", "scheme", "gain_per_count"}  # keys of the format that taccorl ingest writes
_log = logging.getLogger(__name__)


@LRSchedulerConfig.register_subclass("warmup_then_cosine")
@dataclass
class WarmupThenCosine(CosineDecayWithWarmupSchedulerConfig):
    """LeRobot's cosine schedule over the whole training, with a warm-up of fixed length.

    LeRobot's own schedule shortens the warm-up with the training (100 of 3000 steps become 33 of 1000); the paper uses 100 in
    both cases.
    """

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=min(self.num_warmup_steps, num_training_steps),
            num_decay_steps=num_training_steps,
            peak_lr=self.peak_lr,
            decay_lr=self.decay_lr,
        ).build(optimizer, num_training_steps)


@OptimizerConfig.register_subclass("fused_adamw")
@dataclass
class FusedAdamW(AdamWConfig):
    """LeRobot's AdamW, on a GPU with PyTorch's fused kernel, which takes half the time and rounds bfloat16 weights once per
    step."""

    def build(self, params: OptimizerParams) -> AdamW:
        groups: Any = super().build(params).param_groups
        fused = all(p.is_cuda for group in groups for p in group["params"])
        return AdamW([{**group, "fused": fused} for group in groups], fused=fused)


class TouchInput(NamedTuple):
    """One feature of touch as the policy reads it."""

    layout: tuple[int, ...]
    """Pads, rows and columns; pads and values where a pad is a vector."""
    gain_per_count: float | None
    """Normalised reading of one count. None: its unit is not stated, it is normalised by the dataset's statistics."""

    @property
    def num_values(self) -> int:
        """K: number of values of one reading of all pads."""
        return math.prod(self.layout)


@dataclass(frozen=True)
class TactileFormat:
    """Format of touch in a dataset: ``tactile`` of the feature in its ``meta/info.json``."""

    sensor: str
    """Name of the sensor."""
    pads: tuple[str, ...]
    """Names of the pads, in their order."""
    rows: int
    columns: int
    scheme: str
    """Rule from counts to readings; only ``fixed_scale``."""
    gain_per_count: float
    """Normalised reading = counts above baseline × gain."""

    @property
    def layout(self) -> tuple[int, int, int]:
        """Number of pads, rows and columns, in this order."""
        return len(self.pads), self.rows, self.columns

    @classmethod
    def of_feature(cls, feature: dict[str, Any], where: str) -> "TactileFormat":
        """Read the format from a dataset's feature.

        Args:
            feature: entry of the feature in LeRobot's features dict.
            where: name of the dataset for error messages.

        Raises:
            TaccorlError: the feature does not state its format, or states one that contradicts its shape.
        """
        told = feature.get("tactile")
        if not isinstance(told, dict):
            raise TaccorlError(
                f"{where}: {TACTILE} does not state what its {feature.get('shape')} numbers are (no 'tactile' with layout, "
                "scheme and gain in meta/info.json): write the dataset with taccorl ingest, which also converts other LeRobot "
                "datasets"
            )
        history, pads, rows, columns = told["layout"]
        if history != 1 or math.prod(told["layout"]) != math.prod(feature["shape"]):
            raise TaccorlError(
                f"{where}: {TACTILE} has shape {feature['shape']}, but its layout states {told['layout']}"
            )
        names = tuple(told["pads"])
        if len(names) != pads:
            raise TaccorlError(f"{where}: {TACTILE} names the pads {', '.join(names)}, but its layout states {pads}")
        return cls(told["sensor"], names, rows, columns, told["scheme"], float(told["gain_per_count"]))


@PreTrainedConfig.register_subclass("tactile_pi05")
@dataclass
class TactilePI05Config(PI05Config):
    """π0.5 with touch. Fields that are not listed here are those of LeRobot's pi05."""

    backbone: str = "full"
    """Size of the network. full: π0.5's own (3.4 billion parameters). Trained from scratch with the same code: small (18
    million), for one GPU; tiny, for tests and demonstrations on a CPU."""
    base_checkpoint: str | None = None
    """Folder, model.safetensors or hub id of plain π0.5 weights to start from, such as lerobot/pi05_base. None: random
    weights."""
    tokenizer: str | None = None
    """Tokenizer of the prompt: hub id, folder, ``words`` or ``bytes``. None: PaliGemma's for full, words for small and tiny."""
    discrete_state_input: bool | None = None
    """Input of the robot's state. True: as part of the prompt, in 256 steps over each joint's range, as in π0.5. False: as a
    token beside the actions, as in π0, without rounding. None: True for full, False for small and tiny."""
    hand_poses: bool | None = None
    """Add the poses of both hands to the state's token (see ``hand_poses``). None: True where the state is a token and the
    names of the actions are those of the two arms whose geometry is known."""
    part_poses: bool = False
    """Add the poses of the task's parts to the state's token (see ``part_poses``). Only a simulator knows them: the dataset must
    be made with taccorl execute --part_poses=true."""
    part_names: list[str] | None = None
    """Names of the entries of ``observation.environment_state``, the poses of the parts: ``plug.x`` … ``plug.z`` (position) and
    ``plug.r00`` … ``plug.r21`` (first two columns of the rotation matrix), part after part. None: read from the dataset when
    training starts, then kept in the checkpoint."""
    pictures: bool = True
    """False: the policy uses no cameras, even if the dataset has some; their frames are not read."""
    pose_loss: float = 0.0
    """Weight of an auxiliary loss, in training only: from the fusion of pictures, touch and state, predict the poses of the parts
    relative to each other and to both hands (see ``PoseHead``). Needs a dataset as for ``part_poses``. 0: no such loss."""
    tactile: bool = True
    """True: the policy uses touch. False: vision only; with flow matching the policy is then LeRobot's pi05."""
    tactile_history: int = 10
    """L: number of readings in the tactile window."""
    tactile_stride: int = 1
    """Rows of the dataset between two readings of the tactile window: it holds the readings −(L − 1) · stride … −stride, 0 rows
    from the present one."""
    prefix_tokens: int = 8
    """M_pre: number of touch tokens in the context of the vision-language model."""
    suffix_tokens: int = 8
    """M_suf: number of touch tokens beside the actions, in the action expert."""
    contact_threshold: float = CONTACT_THRESHOLD
    """λ_f: a normalised reading above this is contact. Touch without a stated unit has no threshold: with it every row is in
    contact."""
    noise_threshold: float = 0.0
    """λ_noise: normalised readings up to this are set to 0, in training and in use (paper, App. B.2: one threshold suppresses
    the background noise of both domains). taccorl align --pads=… measures it and prints this option. 0: readings are unchanged,
    which suffices for data of the twin alone."""
    touch_dropout: float = 0.0
    """Share of the training rows whose touch is hidden from the policy, as if no pad were in contact: 0 or more, below 1; drawn
    anew at each step. The policy then also learns to act without touch. 0: touch is never hidden. No effect in use."""
    contact_min_active: int = MIN_ACTIVE
    """m: number of taxels of one reading that must be above λ_f for contact."""
    tactile_format: TactileFormat | None = None
    """Format of ``observation.tactile`` with a stated unit. None: read from the dataset when training starts, then kept in the
    checkpoint."""
    tactile_layouts: dict[str, list[int]] | None = None
    """Features of touch without a stated unit (``observation.tactile*``) → shape of a reading: [n] for a vector, [rows, columns]
    for a grid, [pads, rows, columns]. None, without ``tactile_format``: all touch of the dataset in the shapes that it states,
    then kept in the checkpoint. Given: these features only; a vector may be given the shape of its grid."""
    joint_names: dict[str, list[str]] | None = None
    """``action`` and ``observation.state`` → names of their elements, in order. None: read from the dataset when training starts,
    then kept in the checkpoint."""
    fps: int | None = None
    """Rows per second of the dataset, the unit of the tactile window and of the actions. None: read from the dataset likewise."""
    sim_weight: float = 0.5
    """α: weight of the simulated loss; the real loss has 1 − α. Used if the dataset marks simulated rows
    (``observation.is_sim``)."""
    sim_share: float | None = None
    """Share of simulated rows in the training data, 0 … 1. Written by training."""

    image_randomization: bool = True
    """True: in training, randomly crop, rotate and recolour every image: the image rows of the paper's domain randomisation."""
    image_crop: float = ImageRandomizationConfig.crop
    """Image randomisation: side length of the random crop, as a fraction of the image's side length. The crop is enlarged to the
    full image size, as in openpi. In use (whatever acts or is scored in evaluation mode) the middle crop of the same size is
    enlarged likewise, so that objects have the size of training. 1: no crop; the policy sees whole images in training and in
    use, and without touch it is LeRobot's pi05.

    Rollouts with randomised pictures (``--pictures=randomised``) crop at a place of the scene's instead of in the middle, once
    and at this size: the images are then distributed as in training."""
    image_rotation_deg: float = ImageRandomizationConfig.rotation_deg
    """Image randomisation: largest rotation of an image about its middle [degrees]. 0: no rotation."""
    image_noise_std: float = COTRAINING_NOISE_STD
    """σ_v: standard deviation of normal noise on training images in [0, 1], added after the randomisation. 0: no noise."""

    cuda_graph: bool = True
    """True: on a GPU, record the computation of a chunk once and replay it (see ``graphed``). False: LeRobot's eager
    computation."""

    compile_model: bool = True
    """On a GPU, train with compiled layers (see ``compiled``; ``compile_mode`` is not used). False: LeRobot's own forward."""

    chunk_size: int = 10
    """H: number of actions that are predicted at once."""
    n_action_steps: int = 10
    """Number of actions of a chunk that are executed before the next chunk is predicted."""
    num_inference_steps: int = 4
    """K_denoise: number of denoising steps."""
    inference_noise: float = 1.0
    """Factor of the noise from which a chunk is denoised when the policy acts. 1: flow matching's own normal noise. 0: always
    from zero, so that a chunk depends on the observation only. Post-training (``taccorl.rl``) samples with its own noise."""
    normalize_steps: bool | None = None
    """True: normalise each of the H × A numbers of a chunk of relative actions by its own mean and deviation, after LeRobot's
    normalisation of all steps together (see ``chunk_steps``). None: False for full, whose pretrained weights use LeRobot's
    normalisation, and True for small and tiny."""
    average_decay: float | None = None
    """d: decay of the exponential mean of the weights with which the policy acts (see ``averaged``). 0: it acts with the last
    weights. None: 0.999 for small, 0 for full and tiny."""
    optimizer_lr: float = 2.5e-5
    """η_max: largest learning rate."""
    scheduler_warmup_steps: int = 100
    """T_warm: steps of the warm-up."""
    scheduler_decay_lr: float = 5e-6
    """η_min, reached at the last step of the training, whatever ``scheduler_decay_steps`` says."""

    def __post_init__(self) -> None:
        """
        Raises:
            TaccorlError: a setting is out of its range, or the backbone is unknown.
        """
        super().__post_init__()
        # LeRobot's make_policy writes the dataset's names over those of the checkpoint before the policy sees either.
        self._action_names_given = list(self.action_feature_names or ())
        if self.backbone not in _BACKBONES:
            raise TaccorlError(f"--policy.backbone={self.backbone}: {nearest(self.backbone, _BACKBONES)}")
        if self.base_checkpoint and self.backbone != "full":
            raise TaccorlError(
                f"--policy.base_checkpoint={self.base_checkpoint}: π0.5's weights can only be used with "
                f"--policy.backbone=full, not with {self.backbone}, which is trained from scratch"
            )
        for name in ("tactile_history", "tactile_stride", "prefix_tokens", "suffix_tokens", "contact_min_active"):
            if getattr(self, name) < 1:
                raise TaccorlError(
                    f"--policy.{name}={getattr(self, name)}: at least 1; for a policy without touch: --policy.tactile=false"
                )
        if self.normalize_steps and not self.use_relative_actions:
            raise TaccorlError(
                "--policy.normalize_steps=true: it requires --policy.use_relative_actions=true, because all steps of absolute "
                "actions have the same statistics"
            )
        if self.hand_poses and self.has_discrete_state:
            raise TaccorlError(
                "--policy.hand_poses=true: the poses are part of the state's token; --policy.discrete_state_input=true puts the "
                "state into the prompt"
            )
        if self.part_poses and self.has_discrete_state:
            raise TaccorlError(
                "--policy.part_poses=true: the poses are part of the state's token; --policy.discrete_state_input=true puts the "
                "state into the prompt"
            )
        for name in ("pose_loss", "inference_noise"):
            if not 0 <= getattr(self, name) < math.inf:
                raise TaccorlError(f"--policy.{name}={getattr(self, name)}: 0 or more")
        if self.pose_loss and self.has_discrete_state:
            raise TaccorlError(
                f"--policy.pose_loss={self.pose_loss:g}: poses are predicted from the fusion of all inputs, which a policy has "
                "only where its state is a token: --policy.backbone=small or tiny, with --policy.discrete_state_input=false"
            )
        if self.pose_loss and not (self.pictures or self.tactile):
            raise TaccorlError(
                f"--policy.pose_loss={self.pose_loss:g}: poses are predicted from pictures and touch, but the policy has "
                "neither: --policy.pictures=false and --policy.tactile=false"
            )
        if self.average_decay is not None and not 0 <= self.average_decay < 1:
            raise TaccorlError(f"--policy.average_decay={self.average_decay}: 0 or more, and below 1")
        if not 0 <= self.touch_dropout < 1:
            raise TaccorlError(
                f"--policy.touch_dropout={self.touch_dropout}: 0 or more, and below 1; for a policy without touch: "
                "--policy.tactile=false"
            )
        if not 0 <= self.contact_threshold < math.inf:
            raise TaccorlError(
                f"--policy.contact_threshold={self.contact_threshold}: 0 or more, in normalised readings"
            )
        if not 0 <= self.noise_threshold <= self.contact_threshold:
            raise TaccorlError(
                f"--policy.noise_threshold={self.noise_threshold}: 0 to --policy.contact_threshold={self.contact_threshold}, "
                "in normalised readings: readings below it are set to 0, readings above the latter are contact"
            )

        self.image_changes()

    def image_changes(self) -> ImageRandomizationConfig | None:
        """Image randomisation in training; None: no randomisation and no noise.

        Raises:
            TaccorlError: crop, noise or rotation is out of its range, or set without the randomisation.
        """
        if not self.image_randomization:
            for name, value, none in (
                ("image_crop", self.image_crop, 1.0),
                ("image_rotation_deg", self.image_rotation_deg, 0.0),
            ):
                if value not in (none, getattr(ImageRandomizationConfig, name.removeprefix("image_"))):
                    raise TaccorlError(
                        f"--policy.{name}={value:g} has no effect with --policy.image_randomization=false"
                    )
        if not self.image_randomization and not self.image_noise_std:
            return None
        if self.image_randomization:
            return ImageRandomizationConfig(
                crop=self.image_crop, rotation_deg=self.image_rotation_deg, noise_std=self.image_noise_std
            )
        return ImageRandomizationConfig.absent(noise_std=self.image_noise_std)

    @property
    def crop_in_use(self) -> float:
        """Side of the crop that the policy sees, in training and in use, relative to the image's side."""
        return self.image_crop if self.image_randomization else 1.0

    @property
    def normalizes_steps(self) -> bool:
        """Whether each step of a chunk is normalised by itself: ``normalize_steps`` or the backbone's default; only with
        relative actions."""
        wanted = self.backbone != "full" if self.normalize_steps is None else self.normalize_steps
        return wanted and self.use_relative_actions

    @property
    def decay_of_average(self) -> float:
        """Value of ``average_decay``, with the backbone's default resolved."""
        return (0.999 if self.backbone == "small" else 0.0) if self.average_decay is None else self.average_decay

    @property
    def tokenizer_name(self) -> str:
        """Name of the tokenizer, with the backbone's default resolved."""
        return self.tokenizer or (_PALIGEMMA if self.backbone == "full" else "words")

    @property
    def has_discrete_state(self) -> bool:
        """Value of ``discrete_state_input``, with the backbone's default resolved."""
        return self.backbone == "full" if self.discrete_state_input is None else self.discrete_state_input

    @property
    def knows_hands(self) -> bool:
        """Value of ``hand_poses``, with the backbone's default resolved."""
        if self.hand_poses is None:
            return not self.has_discrete_state and tuple(self.action_feature_names or ()) == arm_names()
        return self.hand_poses

    @property
    def state_dim(self) -> int:
        """S: size of the state token's input: the robot's state and, by option, poses of hands and parts."""
        return self.robot_state_dim + (num_part_numbers(self.num_bodies) if self.part_poses else 0)

    @property
    def robot_state_dim(self) -> int:
        """Size of the robot's state and, with ``hand_poses``, of the hands' poses."""
        assert self.input_features is not None, "the policy's __init__ has made sure of features"
        return self.input_features[OBS_STATE].shape[0] + NUM_HAND_POSES * self.knows_hands

    @property
    def num_bodies(self) -> int:
        """P: number of parts whose poses are known."""
        return len(bodies_of(self.require_part_names()))

    def require_part_names(self) -> list[str]:
        """Return the names (9 P) of the numbers in the pose input, part after part: position [m] and rotation.

        Raises:
            TaccorlError: neither a dataset nor a checkpoint has stated them.
        """
        if self.part_names is None:
            raise TaccorlError(
                "tactile_pi05 does not know the task's parts: make the policy from a dataset (taccorl execute "
                "--part_poses=true) or a checkpoint, or set --policy.part_names"
            )
        return self.part_names

    @property
    def window_rows(self) -> int:
        """Number of rows that the tactile window spans, (L − 1) · stride + 1."""
        return (self.tactile_history - 1) * self.tactile_stride + 1

    def window_delta_indices(self, features: Mapping[str, Any]) -> dict[str, list[int]]:
        """Those of a dataset's ``features`` of which the policy gets L rows → their offsets −(L − 1) · stride … 0; for
        ``taccorl.training.reading``."""
        offsets = list(range(1 - self.window_rows, 1, self.tactile_stride))
        known = self._known_touch or _touch_of(features)
        return {key: offsets for key in known if key in features} if self.tactile and self.tactile_history > 1 else {}

    def get_optimizer_preset(self) -> FusedAdamW:
        return FusedAdamW(**dataclasses.asdict(super().get_optimizer_preset()))

    def get_scheduler_preset(self) -> WarmupThenCosine:
        return WarmupThenCosine(
            num_warmup_steps=self.scheduler_warmup_steps,
            num_decay_steps=self.scheduler_decay_steps,
            peak_lr=self.optimizer_lr,
            decay_lr=self.scheduler_decay_lr,
        )

    def validate_features(self) -> None:
        """Keep only the policy's inputs: state, pictures, the parts' poses and, unless it is vision only, touch.

        Touch gets the type ``ENV``, which LeRobot's normaliser does not change. Other features (a flag, the touch of faster
        clocks) would be normalised without use.
        """
        super().validate_features()
        given = self.input_features or {}
        kept = {k: f for k, f in given.items() if (f.type is FeatureType.VISUAL and self.pictures) or k == OBS_STATE}
        if self.part_poses and self.part_names is not None:
            kept[PARTS_KEY] = PolicyFeature(FeatureType.ENV, (len(self.part_names),))
        for key in (self._known_touch or (TACTILE,)) if self.tactile else ():
            if key in given:
                kept[key] = PolicyFeature(FeatureType.ENV, given[key].shape)
        self.input_features = kept

    @property
    def _known_touch(self) -> tuple[str, ...]:
        """Features of touch that a dataset, a checkpoint or options have stated."""
        return (*((TACTILE,) if self.tactile_format else ()), *(self.tactile_layouts or ()))

    def require_touch(self) -> dict[str, TouchInput]:
        """Features of touch that the policy uses, in the order of their values in a reading.

        Raises:
            TaccorlError: neither a dataset nor a checkpoint has stated them.
        """
        told = self.tactile_format
        found = {} if told is None else {TACTILE: TouchInput(told.layout, told.gain_per_count)}
        for key, shape in sorted((self.tactile_layouts or {}).items()):
            found[key] = TouchInput((math.prod(shape[:-2]), *shape[-2:]), None)
        if not found:
            raise TaccorlError(
                "tactile_pi05 does not know the format of touch (tactile_format, tactile_layouts): make the policy from a "
                "dataset or a checkpoint, or set --policy.tactile_format or --policy.tactile_layouts; without touch: "
                "--policy.tactile=false"
            )
        return found

    def match_dataset(self, meta: Any) -> None:
        """Take the format of touch, the rate and the names of state and actions from the dataset's metadata, or compare them with
        those already known.

        Args:
            meta: LeRobot's ``LeRobotDatasetMetadata``.

        Raises:
            TaccorlError: the dataset has no touch, another format, rate or order of joints than the checkpoint, or episodes
                shorter than the window.
        """
        where = f"dataset {meta.repo_id} ({meta.root})"
        if self.fps is not None and self.fps != meta.fps:
            raise TaccorlError(
                f"{where} has {meta.fps} rows per second, but the checkpoint was trained with {self.fps}: its action chunks "
                f"would last for another time. Ingest the recordings at {self.fps}, or train a new policy"
            )
        self.fps = int(meta.fps)
        self._match_joints(meta, where)
        self._match_parts(meta, where)
        if not self.tactile:
            return
        self._match_touch(meta, where)
        lengths = list(meta.episodes["length"])
        if min(lengths) < self.window_rows:
            shortest = lengths.index(min(lengths))
            raise TaccorlError(
                f"{where}: episode {shortest} has {min(lengths)} rows, but the window of touch has {self.window_rows}: "
                "remove the episode (lerobot-edit-dataset, --operation.type=delete_episodes), or give a smaller "
                "--policy.tactile_history or --policy.tactile_stride"
            )

    def match_cameras(self, meta: Any, renamed: Mapping[str, str]) -> None:
        """Check that the dataset has every camera that a checkpoint was trained with.

        Args:
            meta: as for ``match_dataset``.
            renamed: feature of the dataset → its name for the policy (``--rename_map``).

        Raises:
            TaccorlError: one is missing; without this, the full backbone would see a black picture in its place.
        """
        known = [k for k, f in (self.input_features or {}).items() if f.type is FeatureType.VISUAL and self.pictures]
        known = [k for k in known if not k.startswith(f"{OBS_IMAGES}.empty_camera_")]
        found = {renamed.get(key, key) for key in meta.camera_keys}
        if missing := [key for key in known if key not in found]:
            raise TaccorlError(
                f"dataset {meta.repo_id} ({meta.root}) has no {', '.join(missing)}, with which the checkpoint was trained. It "
                f"has: {', '.join(meta.camera_keys) or 'no camera'}. Where a camera has another name there: "
                f'--rename_map=\'{{"name in the dataset": "{missing[0]}"}}\'; without it: train a new policy'
            )
        if known and (unused := sorted(found - set(known))):
            _log.warning(
                "dataset %s: %s is not used, because the checkpoint was trained without it",
                meta.repo_id,
                ", ".join(unused),
            )

    def _match_touch(self, meta: Any, where: str) -> None:
        """Take the features of touch and their formats from the dataset, or compare them with those already known.

        Raises:
            TaccorlError: no touch, one that cannot be used, or others than those known.
        """
        touch, known = _touch_of(meta.features), self._known_touch
        if missing := [key for key in known or (() if touch else (TACTILE,)) if key not in touch]:
            raise TaccorlError(
                f"{where} has no {', '.join(missing)}, which --policy.tactile=true needs: --policy.tactile=false trains on "
                f"vision only; taccorl ingest makes datasets with touch. "
                f"It has: {', '.join(k for k in meta.features if k.startswith('observation.'))}"
            )
        layouts: Mapping[str, list[int] | None] = self.tactile_layouts or {}
        if self.tactile_format or (not known and _metadata_of(touch.get(TACTILE, {}))):
            self._match_format(touch[TACTILE], where)
        if not known:
            layouts = {key: None for key in touch if key not in self._known_touch}
        layouts = {key: _layout_of(touch[key], shape, f"{where}: {key}") for key, shape in layouts.items()}
        self.tactile_layouts = layouts or None
        for key, shape in layouts.items():
            _log.info("%s: %s (%s) has no stated unit: normalised by its statistics", where, key, _by(shape))
        unused = [k for k, f in meta.features.items() if _is_touch(k, f) and k not in self._known_touch]
        if unused:
            _log.warning("%s: the policy does not use %s", where, ", ".join(unused))
        own = [] if self.tactile_format and not layouts else ["contact_threshold", "contact_min_active"]
        own += [] if self.tactile_format else ["noise_threshold"]
        for name in own:
            if getattr(self, name) != getattr(TactilePI05Config, name):
                raise TaccorlError(
                    f"--policy.{name}={getattr(self, name)} has no effect: {where} does not state the unit of "
                    f"{', '.join(layouts)}, with which every row is in contact: remove the option"
                )

    def _match_format(self, feature: dict[str, Any], where: str) -> None:
        found = TactileFormat.of_feature(feature, where)
        if self.tactile_format is not None and self.tactile_format != found:
            ours, theirs = dataclasses.asdict(self.tactile_format), dataclasses.asdict(found)
            said = "; ".join(
                f"{k}: {theirs[k]} there, {ours[k]} in the checkpoint" for k in ours if ours[k] != theirs[k]
            )
            raise TaccorlError(
                f"{where}: its format of touch differs from that of the checkpoint: {said}. Ingest the recordings in the "
                "same format, or train a new policy"
            )
        self.tactile_format = found

    def _match_joints(self, meta: Any, where: str) -> None:
        """Take the names of the elements of state and action from the dataset, or compare with those known already.

        Raises:
            TaccorlError: they differ, or are in another order.
        """
        known, found = dict(self.joint_names or {}), {}
        if self._action_names_given and self._action_names_given != list(
            meta.features.get(ACTION, {}).get("names") or ()
        ):
            known.setdefault(ACTION, self._action_names_given)  # all that a checkpoint of an earlier taccorl states
        for key in (ACTION, OBS_STATE):
            names = _names_of(meta.features.get(key, {}))
            if not names:
                if key in known:
                    _log.warning(
                        "%s does not name the elements of %s: whether they are in the checkpoint's order, %s, is not known",
                        *(where, key, ", ".join(known[key])),
                    )
                    found[key] = known[key]
                continue
            found[key] = names
            if key in known and known[key] != names:
                what = "in another order" if sorted(known[key]) == sorted(names) else "others"
                raise TaccorlError(
                    f"{where}: the elements of {key} are {what} than those of the checkpoint, which would learn and send each "
                    f"value for another joint. Dataset: {', '.join(names)}. Checkpoint: {', '.join(known[key])}. Ingest the "
                    "recordings in the checkpoint's order (the features' names in the data spec), or train a new policy; the "
                    "same joints under other names: rename them in meta/info.json of a copy of the dataset"
                )
        self.joint_names = found or None

    def _match_parts(self, meta: Any, where: str) -> None:
        """Take the names of the parts' poses from the dataset, or compare with those known already.

        Raises:
            TaccorlError: no poses, or those of other parts.
        """
        if not self.part_poses and not self.pose_loss:
            return
        if PARTS_KEY not in meta.features:
            if not self.part_poses and self.part_names is not None:
                return  # a checkpoint goes on without its pose loss
            option = "--policy.part_poses=true" if self.part_poses else f"--policy.pose_loss={self.pose_loss:g}"
            raise TaccorlError(
                f"{option}: {where} has no {PARTS_KEY}: make it with taccorl execute --part_poses=true. It has: "
                f"{', '.join(k for k in meta.features if k.startswith('observation.'))}"
            )
        names = list(meta.features[PARTS_KEY]["names"])
        if self.part_names is not None and self.part_names != names:
            raise TaccorlError(
                f"{where}: its {PARTS_KEY} is of {', '.join(bodies_of(names))}, but that of the checkpoint is of "
                f"{', '.join(bodies_of(self.part_names))}: it is another task"
            )
        rows = (
            int(np.ravel(meta.stats[PARTS_KEY]["count"])[0]) if PARTS_KEY in (meta.stats or {}) else meta.total_frames
        )
        if self.part_poses and rows < meta.total_frames:
            raise TaccorlError(
                f"--policy.part_poses=true: {where} has no {PARTS_KEY} in {meta.total_frames - rows} of {meta.total_frames} "
                "rows, those of the robot: only --policy.pose_loss can use it"
            )
        self.part_names = names


def _is_touch(key: str, feature: Mapping[str, Any]) -> bool:
    """Pictures of a tactile sensor are cameras of the policy."""
    return key.startswith(TACTILE) and feature["dtype"] not in ("image", "video")


def _touch_of(features: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """A dataset's features of touch; those that hold a window of several readings a row are left out."""
    touch = {k: f for k, f in features.items() if _is_touch(k, f)}
    return {k: f for k, f in touch.items() if k == TACTILE or _metadata_of(f).get("layout", [1])[0] == 1}


def _metadata_of(feature: Mapping[str, Any]) -> dict[str, Any]:
    """Format as taccorl ingest writes it; empty: not stated, or another program's."""
    told = feature.get("tactile")
    return told if isinstance(told, dict) and told.keys() >= _STATED else {}


def _layout_of(feature: Mapping[str, Any], known: Sequence[int] | None, where: str) -> list[int]:
    """Shape of a reading that the dataset states, or ``known`` if it fits.

    Raises:
        TaccorlError: no numbers, or another shape than that known.
    """
    if not re.fullmatch(r"bool|u?int\d+|float\d+", str(feature["dtype"])):
        raise TaccorlError(
            f"{where} holds {feature['dtype']}, not numbers, so that it is no touch. Leave it out: lerobot-edit-dataset "
            "--operation.type=remove_feature, or list the others in --policy.tactile_layouts"
        )
    shape, told = list(feature["shape"]), _metadata_of(feature)
    stated = told["layout"][1:] if told else feature.get("layout")
    found = shape
    if isinstance(stated, list | tuple) and all(isinstance(n, int) for n in stated):
        found = list(stated) if math.prod(stated) == math.prod(shape) else shape
    if known is None:
        return found
    if not known or math.prod(known) != math.prod(shape) or (list(known) != found and len(found) > 1):
        raise TaccorlError(f"{where} has readings of {_by(found)}, but the policy (tactile_layouts) takes {_by(known)}")
    return list(known)


def _by(shape: Sequence[int]) -> str:
    return " × ".join(map(str, shape))


def _names_of(feature: Mapping[str, Any]) -> list[str]:
    """Names of a feature's elements; LeRobot also has them grouped, as in ``{"motors": […]}``. Empty: the dataset states none."""
    names = feature.get("names") or []
    if isinstance(names, Mapping):
        names = [name for group in names.values() for name in (group if isinstance(group, list) else [group])]
    return [str(name) for name in names]
