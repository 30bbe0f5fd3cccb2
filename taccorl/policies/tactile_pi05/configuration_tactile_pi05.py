"""``lerobot-train --policy.type=tactile_pi05``: every setting of the policy; the defaults are the paper's co-training table."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.utils.constants import OBS_STATE

from taccorl.errors import TaccorlError, nearest
from taccorl.policies.tactile_pi05.gate import CONTACT_THRESHOLD, MIN_ACTIVE
from taccorl.policies.tactile_pi05.hand_poses import NUM_HAND_POSES, arm_names
from taccorl.policies.tactile_pi05.image_randomization import (
    COTRAINING_NOISE_STD,
    ImageRandomizationConfig,
)
from taccorl.policies.tactile_pi05.match_dataset import match_cameras, match_dataset
from taccorl.policies.tactile_pi05.optim import FusedAdamW, WarmupThenCosine
from taccorl.policies.tactile_pi05.part_poses import bodies_of, num_part_numbers
from taccorl.policies.tactile_pi05.touch_format import (
    TACTILE,
    TactileFormat,
    TouchInput,
    touch_of,
)
from taccorl.sim.part_poses import PARTS_KEY

RAW_STATE = "observation.state_raw"  # (B, 14), only at inference with relative actions
STATE_SINCE_PLAN = "state_since_plan"  # of an action tensor: how far that has moved since its chunk was predicted
_PALIGEMMA = "google/paligemma-3b-pt-224"
_BACKBONES = ("full", "small", "tiny")


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
    be made with taccorl collect --part_poses=true."""
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

    # True while a training is resumed, whose processors keep the checkpoint's statistics; no setting, and not stored.
    resumed = False

    def __post_init__(self) -> None:
        """Raises TaccorlError: a setting is out of its range, or the backbone is unknown."""
        super().__post_init__()
        # LeRobot's make_policy writes the dataset's names over those of the checkpoint before the policy sees either.
        self.action_names_given = list(self.action_feature_names or ())
        if self.backbone not in _BACKBONES:
            raise TaccorlError(
                f"--policy.backbone={self.backbone}: {nearest(self.backbone, _BACKBONES)}"
            )
        if self.base_checkpoint and self.backbone != "full":
            raise TaccorlError(
                f"--policy.base_checkpoint={self.base_checkpoint}: π0.5's weights can only be used with "
                f"--policy.backbone=full, not with {self.backbone}, which is trained from scratch"
            )
        poses = "the poses are part of the state's token; --policy.discrete_state_input=true puts the state into the prompt"
        no_touch = "; for a policy without touch: --policy.tactile=false"
        counts = (
            "tactile_history",
            "tactile_stride",
            "prefix_tokens",
            "suffix_tokens",
            "contact_min_active",
        )
        for name, is_right, why in (
            *(
                (name, getattr(self, name) >= 1, f"at least 1{no_touch}")
                for name in counts
            ),
            (
                "normalize_steps",
                not self.normalize_steps or self.use_relative_actions,
                "it requires --policy.use_relative_actions=true, because all steps of absolute actions have the same statistics",
            ),
            *(
                (name, not getattr(self, name) or not self.has_discrete_state, poses)
                for name in ("hand_poses", "part_poses")
            ),
            *(
                (name, 0 <= getattr(self, name) < math.inf, "0 or more")
                for name in ("pose_loss", "inference_noise")
            ),
            (
                "pose_loss",
                not self.pose_loss or not self.has_discrete_state,
                "poses are predicted from the fusion of all inputs, which a policy has only where its state is a token: "
                "--policy.backbone=small or tiny, with --policy.discrete_state_input=false",
            ),
            (
                "pose_loss",
                not self.pose_loss or self.pictures or self.tactile,
                "poses are predicted from pictures and touch, but the policy has neither: --policy.pictures=false and "
                "--policy.tactile=false",
            ),
            (
                "average_decay",
                self.average_decay is None or 0 <= self.average_decay < 1,
                "0 or more, and below 1",
            ),
            (
                "touch_dropout",
                0 <= self.touch_dropout < 1,
                f"0 or more, and below 1{no_touch}",
            ),
            (
                "contact_threshold",
                0 <= self.contact_threshold < math.inf,
                "0 or more, in normalised readings",
            ),
            (
                "noise_threshold",
                0 <= self.noise_threshold <= self.contact_threshold,
                f"0 to --policy.contact_threshold={self.contact_threshold}, in normalised readings: readings below it are set "
                "to 0, readings above the latter are contact",
            ),
        ):
            if not is_right:
                value = getattr(self, name)
                raise TaccorlError(
                    f"--policy.{name}={str(value).lower() if value is True else value}: {why}"
                )
        self.image_changes()

    def image_changes(self) -> ImageRandomizationConfig | None:
        """Image randomisation in training; None: no randomisation and no noise. Raises TaccorlError: crop, noise or rotation is
        out of its range, or set without the randomisation."""
        if self.image_randomization:
            return ImageRandomizationConfig(
                crop=self.image_crop,
                rotation_deg=self.image_rotation_deg,
                noise_std=self.image_noise_std,
            )
        for name, none in (("image_crop", 1.0), ("image_rotation_deg", 0.0)):
            if getattr(self, name) not in (none, getattr(type(self), name)):
                raise TaccorlError(
                    f"--policy.{name}={getattr(self, name):g} has no effect with --policy.image_randomization=false"
                )
        return (
            ImageRandomizationConfig.absent(noise_std=self.image_noise_std)
            if self.image_noise_std
            else None
        )

    @property
    def crop_in_use(self) -> float:
        """Side of the crop that the policy sees, in training and in use, relative to the image's side."""
        return self.image_crop if self.image_randomization else 1.0

    @property
    def normalizes_steps(self) -> bool:
        """Whether each step of a chunk is normalised by itself: ``normalize_steps`` or the backbone's default; only with
        relative actions."""
        wanted = (
            self.backbone != "full"
            if self.normalize_steps is None
            else self.normalize_steps
        )
        return wanted and self.use_relative_actions

    @property
    def decay_of_average(self) -> float:
        """Value of ``average_decay``, with the backbone's default resolved."""
        return (
            (0.999 if self.backbone == "small" else 0.0)
            if self.average_decay is None
            else self.average_decay
        )

    @property
    def tokenizer_name(self) -> str:
        """Name of the tokenizer, with the backbone's default resolved."""
        return self.tokenizer or (_PALIGEMMA if self.backbone == "full" else "words")

    @property
    def has_discrete_state(self) -> bool:
        """Value of ``discrete_state_input``, with the backbone's default resolved."""
        return (
            self.backbone == "full"
            if self.discrete_state_input is None
            else self.discrete_state_input
        )

    @property
    def knows_hands(self) -> bool:
        """Value of ``hand_poses``, with the backbone's default resolved."""
        if self.hand_poses is None:
            return (
                not self.has_discrete_state
                and tuple(self.action_feature_names or ()) == arm_names()
            )
        return self.hand_poses

    @property
    def state_dim(self) -> int:
        """S: size of the state token's input: the robot's state and, by option, poses of hands and parts."""
        return self.robot_state_dim + (
            num_part_numbers(self.num_bodies) if self.part_poses else 0
        )

    @property
    def robot_state_dim(self) -> int:
        """Size of the robot's state and, with ``hand_poses``, of the hands' poses."""
        assert self.input_features is not None, (
            "the policy's __init__ has made sure of features"
        )
        return (
            self.input_features[OBS_STATE].shape[0] + NUM_HAND_POSES * self.knows_hands
        )

    @property
    def num_bodies(self) -> int:
        """P: number of parts whose poses are known."""
        return len(bodies_of(self.require_part_names()))

    def require_part_names(self) -> list[str]:
        """Return the names (9 P) of the numbers in the pose input, part after part: position [m] and rotation. Raises
        TaccorlError: neither a dataset nor a checkpoint has stated them."""
        if self.part_names is None:
            raise TaccorlError(
                "tactile_pi05 does not know the task's parts: make the policy from a dataset (taccorl collect "
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
        known = self.known_touch or touch_of(features)
        return (
            {key: offsets for key in known if key in features}
            if self.tactile and self.tactile_history > 1
            else {}
        )

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
        clocks) would be normalised without use."""
        super().validate_features()
        given = self.input_features or {}
        kept = {
            k: f
            for k, f in given.items()
            if (f.type is FeatureType.VISUAL and self.pictures) or k == OBS_STATE
        }
        if self.part_poses and self.part_names is not None:
            kept[PARTS_KEY] = PolicyFeature(FeatureType.ENV, (len(self.part_names),))
        for key in (self.known_touch or (TACTILE,)) if self.tactile else ():
            if key in given:
                kept[key] = PolicyFeature(FeatureType.ENV, given[key].shape)
        self.input_features = kept

    @property
    def known_touch(self) -> tuple[str, ...]:
        """Features of touch that a dataset, a checkpoint or options have stated."""
        return (
            *((TACTILE,) if self.tactile_format else ()),
            *(self.tactile_layouts or ()),
        )

    def require_touch(self) -> dict[str, TouchInput]:
        """Features of touch that the policy uses, in the order of their values in a reading. Raises TaccorlError: neither a
        dataset nor a checkpoint has stated them."""
        told = self.tactile_format
        found = (
            {}
            if told is None
            else {TACTILE: TouchInput(told.layout, told.gain_per_count)}
        )
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
        """Complete this configuration from a dataset, or compare both (see ``match_dataset.match_dataset``)."""
        match_dataset(self, meta)

    def match_cameras(self, meta: Any, renamed: Mapping[str, str]) -> None:
        """Check that the dataset has the checkpoint's cameras (see ``match_dataset.match_cameras``)."""
        match_cameras(self, meta, renamed)
