"""A LeRobot checkpoint as an actor: the policy with its own pre- and post-processors, as ``lerobot-eval`` runs them.

Rollouts of any kind (evaluation, reinforcement learning) make a policy's batch with ``policy_batch`` and its actions with
``policy_actions``, so that a policy never sees two kinds of input. Letters in shapes: N environments.
"""

import contextlib
import dataclasses
import importlib
import json
import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.envs import preprocess_observation
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.processor import (
    DeviceProcessorStep,
    NormalizerProcessorStep,
    ProcessorStep,
    UnnormalizerProcessorStep,
)
from lerobot.utils.random_utils import get_rng_state, set_rng_state, set_seed

from taccorl.data.dataset import Dataset
from taccorl.errors import TaccorlError
from taccorl.evaluation.preflight import PolicyFacts
from taccorl.evaluation.rollouts import Acted
from taccorl.lineage.digest import digest_file, digest_files
from taccorl.lineage.manifest import read_manifest, require_checkpoint
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.policies.tactile_pi05.image_randomization import PICTURES_CHANGED
from taccorl.policies.tactile_pi05.scene_pictures import ScenePictures
from taccorl.policies.tactile_pi05.weights import base_of, load_merged
from taccorl.sim.lerobot_env import raw_names
from taccorl.sim.part_poses import PARTS_KEY, part_pose_names
from taccorl.sim.spaces import IMAGE_KEYS, STATE_KEY, TACTILE_KEY, Observation
from taccorl.sim.vector_env import TaccorlVectorEnv

PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
"""Files of a checkpoint's processors."""

_log = logging.getLogger(__name__)

Processor = Callable[[Any], Any]
"""A policy's pre- or postprocessor, as LeRobot makes them."""


def require_same_parts(config: Any, task: str, there: tuple[str, ...]) -> None:
    """Check that the environment's part poses are those with which the policy was trained. ``there``: names of the
    environment's poses of parts. Raises TaccorlError: the policy uses poses of parts, and was trained with those of another
    task."""
    own = tuple(config.part_names or ())
    if own != there:
        raise TaccorlError(
            f"task {task}: its part poses are {', '.join(there[::9])} …, but the policy was trained with {', '.join(own[::9])} "
            "… of another task"
        )


def needs_images(config: Any) -> bool:
    """Whether a picture is among a policy's inputs; True if its configuration does not state them."""
    features = getattr(config, "input_features", None)
    return features is None or any(
        feature.type is FeatureType.VISUAL for feature in features.values()
    )


def policy_batch(
    preprocessor: Processor,
    observation: Observation,
    instructions: Sequence[str],
    *,
    on_device: bool = False,
) -> dict[str, torch.Tensor | Any]:
    """Input of a policy, LeRobot key → tensor with N rows: LeRobot's conversion of an environment's ``observation`` of N
    environments, then the policy's own preprocessor. Pictures may be absent; ``PICTURES_CHANGED``, if it is there, is passed
    on. ``instructions``: (N,). ``on_device``: the preprocessor computes on the policy's device, not before it: for thousands of
    environments."""
    steps = getattr(preprocessor, "steps", ())
    device = next(
        (step.tensor_device for step in steps if isinstance(step, DeviceProcessorStep)),
        torch.device("cpu"),
    )
    pictures = {
        key: observation[key] for key in IMAGE_KEYS.values() if key in observation
    }
    numbers = {
        key: values for key, values in observation.items() if key not in pictures
    }
    batch: dict[str, Any] = preprocess_observation(raw_names(numbers))
    batch |= {key: pictures_on(device, values) for key, values in pictures.items()}
    if on_device:
        batch = {key: values.to(device) for key, values in batch.items()}
    batch["task"] = list(instructions)
    batch = preprocessor(batch)
    if PICTURES_CHANGED in observation:
        batch[PICTURES_CHANGED] = torch.from_numpy(observation[PICTURES_CHANGED])
    return batch


def pictures_on(device: torch.device, pictures: np.ndarray) -> torch.Tensor:
    """(N, 3, rows, columns) float32 from 0 to 1 on ``device``, of (N, rows, columns, 3) uint8: the numbers of LeRobot's
    ``preprocess_observation``, which for three cameras of 224² takes 7 ms of a thread."""
    channels_first = (
        torch.from_numpy(pictures)
        .to(device)
        .permute(0, 3, 1, 2)
        .contiguous()
        .to(torch.float32)
    )
    # by a plain number, CUDA multiplies with its inverse
    return channels_first.div_(torch.tensor(255.0, device=device))


def policy_actions(
    policy: Any,
    preprocessor: Processor,
    postprocessor: Processor,
    observation: Observation,
    instructions: Sequence[str],
) -> np.ndarray:
    """(N, 14) float32 targets [rad, m] of the next control step.

    Args:
        policy: LeRobot's ``PreTrainedPolicy``, or anything with ``select_action``.
        observation, instructions: as in ``policy_batch``.
    """
    batch = policy_batch(preprocessor, observation, instructions)
    with torch.inference_mode():
        action = policy.select_action(batch)
    return postprocessor(action).to("cpu").numpy().astype(np.float32)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint's configuration and processors; weights are not read yet."""

    path: Path
    config: PreTrainedConfig
    preprocessor: Any
    postprocessor: Any

    @property
    def digest(self) -> str:
        """One SHA-256 of all files in the checkpoint's folder; of an adapter, of those of its base policy, too."""
        manifest = read_manifest(
            self.path
        )  # its digests were compared when the checkpoint was opened
        names = sorted(
            p.name
            for p in self.path.iterdir()
            if p.is_file() and not p.name.startswith(".")
        )
        known = manifest.get("files", {})
        files = {
            n: known.get(n) or digest_file(self.path / n)
            for n in names
            if n != manifest.get("place")
        }
        if (base := base_of(self.path)) and Path(base).is_dir():
            files["base"] = dataclasses.replace(self, path=Path(base)).digest
        return digest_files(files)

    @property
    def training_dataset(self) -> dict[str, Any] | None:
        """Content of ``meta/info.json`` of the training dataset that ``train_config.json`` names; None if it cannot be found."""
        try:
            return dict(
                json.loads(
                    (self._training_root() / "meta" / "info.json").read_text(
                        encoding="utf-8"
                    )
                )
            )
        except (OSError, KeyError, TypeError, ValueError, RecursionError):
            return None

    @property
    def training_instructions(self) -> tuple[str, ...] | None:
        """Instructions of that dataset; None if it cannot be found."""
        try:
            return Dataset(self._training_root()).instructions
        except (OSError, KeyError, TypeError, ValueError, RecursionError, TaccorlError):
            return None

    def _training_root(self) -> Path:
        return Path(
            json.loads((self.path / "train_config.json").read_text(encoding="utf-8"))[
                "dataset"
            ]["root"]
        )

    def facts(self) -> PolicyFacts:
        """Facts for the preflight, from the configuration, the processors' statistics and, if it is found, the training
        dataset."""
        config: Any = self.config
        dataset = self.training_dataset or {}
        names = getattr(config, "action_feature_names", None) or dataset.get(
            "features", {}
        ).get("action", {}).get("names")
        touch = getattr(config, "tactile_format", None)
        statistics, missing = _statistics(
            [*self.preprocessor.steps, *self.postprocessor.steps]
        )
        action = (config.output_features or {}).get("action")
        return PolicyFacts(
            inputs={
                key: tuple(feature.shape)
                for key, feature in (config.input_features or {}).items()
            },
            action_shape=tuple(action.shape) if action else None,
            fps=getattr(config, "fps", None) or dataset.get("fps"),
            robot_type=dataset.get("robot_type"),
            action_names=tuple(names) if isinstance(names, list) else None,
            touch_gain_per_count=touch.gain_per_count if touch else None,
            touch_has_unit=TACTILE_KEY
            not in (getattr(config, "tactile_layouts", None) or {}),
            touch_layout=touch.layout if touch else None,
            ranges={
                key: statistics[key]
                for key in ("action", STATE_KEY)
                if key in statistics
            },
            unnormalised=missing,
            instructions=self.training_instructions,
            pictures_in_training=_pictures_in_training(config),
            pictures_in_use=_pictures_in_use(config),
        )

    def load(self, seed: int) -> "PolicyActor":
        """Load the policy with its weights, an adapter merged into its base. Random generators are seeded with ``seed`` before
        the policy is created, as in ``lerobot-eval --seed``. Raises TaccorlError: weights are missing or of another policy."""
        torch.backends.cudnn.benchmark = (
            True  # this and the next line: as lerobot-eval, for the same numbers
        )
        torch.backends.cuda.matmul.allow_tf32 = True
        if torch.device(self.config.device or "cpu").type != "cpu":
            # Between chunks, small arrays are left for the CPU, whose threads spin beside those of the physics.
            torch.set_num_threads(1)
        set_seed(seed)
        try:
            policy_class = get_policy_class(self.config.type)
            read = (
                policy_class.from_pretrained
                if base_of(self.path) is None
                else partial(load_merged, policy_class)
            )
            policy = read(self.path, config=self.config)
        except (TaccorlError, torch.OutOfMemoryError):
            raise
        except (
            Exception
        ) as error:  # each policy reads its settings and weights in its own way
            raise TaccorlError(
                f"{self.path}: weights cannot be read: {_one_line(error)}"
            ) from error
        return PolicyActor(
            str(self.path), policy.eval(), self.preprocessor, self.postprocessor
        )


def _pictures_in_training(config: Any) -> str | None:
    if not isinstance(config, TactilePI05Config):
        return None
    changes = config.image_changes()
    return "clear" if changes is None else str(changes)


def _pictures_in_use(config: Any) -> dict[str, str]:
    """Return, for ``clear`` and for ``randomised`` pictures, a text that says what the policy gets to see in an evaluation."""
    crop = config.crop_in_use if isinstance(config, TactilePI05Config) else 1.0
    return {
        "clear": "clear" if crop == 1 else f"clear, their middle {100 * crop:g} %",
        "randomised": str(ScenePictures.of_policy(config).config),
    }


def _statistics(
    steps: Sequence[Any],
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], tuple[str, ...]]:
    """Feature → (low, high) of its data, and features that lack the statistics by which they are to be normalised."""
    ranges: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    missing: list[str] = []
    for step in steps:
        if not isinstance(step, NormalizerProcessorStep | UnnormalizerProcessorStep):
            continue
        statistics = {
            key: {k: np.asarray(v) for k, v in own.items()}
            for key, own in (step.stats or {}).items()
        }
        for low, high in (
            ("q01", "q99"),
            ("min", "max"),
        ):  # the second counts: limits, where they are known
            ranges |= {
                key: (own[low], own[high])
                for key, own in statistics.items()
                if low in own and high in own
            }
        for key, feature in step.features.items():
            mode = step.norm_map.get(feature.type, NormalizationMode.IDENTITY)
            if mode is not NormalizationMode.IDENTITY and key not in statistics:
                missing.append(key)
    return ranges, tuple(dict.fromkeys(missing))


def open_checkpoint(
    path: Path,
    device: str | None = None,
    option: str = "--policy.path",
    *,
    n_action_steps: int | None = None,
) -> Checkpoint:
    """Open a checkpoint, a folder that LeRobot's ``save_pretrained`` or ``lerobot-train`` wrote.

    Args:
        device: cpu, cuda, …; None: as in the checkpoint if this machine has it, else another one.
        option: option of the command line that gave ``path``, for messages.
        n_action_steps: number of actions of a chunk that are executed; None: as in the checkpoint.

    Raises:
        TaccorlError: the folder does not exist, holds no policy, one of a type that is not installed, or an adapter (PEFT) whose
            base is missing; or a file differs from its digest.
    """
    if not (path / "config.json").is_file():
        near = (
            next(iter(sorted(path.glob("**/pretrained_model/config.json"))), None)
            if path.is_dir()
            else None
        )
        hint = (
            f"; did you mean {near.parent}?"
            if near
            else "; give the folder pretrained_model of a checkpoint"
        )
        raise TaccorlError(f"{option}={path}: no config.json there{hint}")
    if without := require_checkpoint(path, f"{option}={path}"):
        _log.warning(
            "note: %s=%s: %s without digests: damage would not be noticed",
            option,
            path,
            ", ".join(without),
        )
    try:
        overrides = [] if device is None else [f"--device={device}"]
        config = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
        config.pretrained_path = path
    except Exception as error:  # draccus and LeRobot raise many kinds; all mean that the file cannot be used
        raise TaccorlError(
            f"{option}={path}: config.json cannot be used: {_one_line(error)}"
        ) from error
    if n_action_steps is not None:
        chunk = getattr(config, "chunk_size", None)
        if chunk is None or not 1 <= n_action_steps <= chunk:
            range_ = (
                "the policy predicts no chunks of actions"
                if chunk is None
                else f"1 to {chunk}, its chunk_size"
            )
            raise TaccorlError(
                f"--policy.n_action_steps={n_action_steps}: {path}: {range_}"
            )
        config.n_action_steps = n_action_steps  # pyright: ignore[reportAttributeAccessIssue]
    base_of(path)  # for its errors
    for name in PROCESSORS:
        if not (path / name).is_file():
            raise TaccorlError(
                f"{option}={path}: has no {name}; save the policy together with its processors"
            )
        try:
            _require_steps(path / name)
        except (
            OSError,
            ValueError,
            LookupError,
            TypeError,
            AttributeError,
            ImportError,
            RecursionError,
        ) as error:
            raise TaccorlError(
                f"{option}={path}: {name} cannot be used: {_one_line(error)}"
            ) from error
    overridden = {"device_processor": {"device": str(config.device)}}
    try:
        before, after = make_pre_post_processors(
            config, pretrained_path=str(path), preprocessor_overrides=overridden
        )
    except (
        Exception
    ) as error:  # each step reads its settings and numbers in its own way
        raise TaccorlError(
            f"{option}={path}: its processors cannot be used: {_one_line(error)}"
        ) from error
    return Checkpoint(path, config, before, after)


def _require_steps(path: Path) -> None:
    """Check that a processor's file names nothing but steps: LeRobot imports and calls whatever class it names. Raises
    TaccorlError: a class is no step of LeRobot, of taccorl or of a plug-in for LeRobot."""
    for step in json.loads(path.read_text(encoding="utf-8"))["steps"]:
        if "registry_name" in step:
            continue
        module, _, name = step["class"].rpartition(".")
        root = module.partition(".")[0]
        known = root in ("lerobot", "taccorl") or root.startswith("lerobot_")
        found = getattr(importlib.import_module(module), name) if known else None
        if not (isinstance(found, type) and issubclass(found, ProcessorStep)):
            raise TaccorlError(
                f"{path}: its step {step['class']} is none of LeRobot, taccorl or a package lerobot_…, and is not called"
            )


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


class PolicyActor:
    """A policy and its processors (see ``rollouts.Actor``). Made after seeding; ``restart`` returns to that state."""

    max_batch: int | None = None

    def __init__(
        self, name: str, policy: Any, preprocessor: Processor, postprocessor: Processor
    ) -> None:
        """``policy``: LeRobot's ``PreTrainedPolicy``, in evaluation mode."""
        self.name, self.policy = name, policy
        self._preprocessor, self._postprocessor = preprocessor, postprocessor
        self._config = getattr(policy, "config", None)
        self._random_state = get_rng_state()
        self._instructions: list[str] = []
        self._envs: TaccorlVectorEnv | None = None
        self._pictures: ScenePictures | None = None

    @property
    def needs_images(self) -> bool:
        """Whether a picture is among the policy's inputs; True if the policy does not state its inputs."""
        return needs_images(self._config)

    @property
    def needs_part_poses(self) -> bool:
        """Whether the poses of the task's parts are among the policy's inputs."""
        return PARTS_KEY in (getattr(self._config, "input_features", None) or {})

    def looks_now(self) -> bool:
        """Whether a picture is used in this step (bool). It is not while a policy without a history of observations
        (``n_obs_steps`` = 1) still has actions of a chunk in LeRobot's ``_action_queue``. Rendering is most of the time of a
        rollout."""
        queue = getattr(self.policy, "_action_queue", None)
        return (
            getattr(self._config, "n_obs_steps", None) != 1
            or not isinstance(queue, deque)
            or not queue
        )

    def restart(self, stream: int = 0) -> None:
        """Restore the state of the random numbers at construction; of another ``stream``, the numbers of a seed made of both."""
        set_rng_state(self._random_state)
        if stream:
            set_seed(
                int(
                    np.random.SeedSequence(
                        [torch.initial_seed(), stream]
                    ).generate_state(1)[0]
                )
            )

    def begin(self, envs: TaccorlVectorEnv, pictures: str = "clear") -> None:
        """Reset the policy at the start of an episode. Raises TaccorlError: the policy was trained on poses of other parts."""
        if self.needs_part_poses:
            require_same_parts(self._config, envs.task, part_pose_names(envs.sim.task))
        self.policy.reset()
        self._instructions = [envs.task_description] * envs.num_envs
        self._envs = envs
        changes = pictures == "randomised" and self.needs_images
        self._pictures = ScenePictures.of_policy(self._config) if changes else None

    def act(self, observation: Observation) -> Acted:
        """Next actions, as from ``policy_actions``; in mixed precision if the checkpoint states it."""
        is_ours = isinstance(self._config, TactilePI05Config)
        if is_ours and not self.looks_now():
            # Converting pictures that nobody looks at would take a quarter as long as the physics.
            observation = {
                key: value
                for key, value in observation.items()
                if key not in IMAGE_KEYS.values()
            }
        elif self._pictures is not None and self.looks_now():
            observation = self._changed(self._pictures, observation)
        amp = bool(getattr(self._config, "use_amp", False))
        with (
            torch.autocast(torch.device(self._config.device).type)  # pyright: ignore[reportOptionalMemberAccess]
            if amp
            else contextlib.nullcontext()
        ):
            return Acted(
                policy_actions(
                    self.policy,
                    self._preprocessor,
                    self._postprocessor,
                    observation,
                    self._instructions,
                )
            )

    def _changed(self, changes: ScenePictures, observation: Observation) -> Observation:
        """With the pictures of the policy's cameras as its scenes change them."""
        assert self._envs is not None, "begin was called"
        sim, inputs = self._envs.sim, getattr(self._config, "input_features", None)
        clear = {
            key: observation[key]
            for key in IMAGE_KEYS.values()
            if inputs is None or key in inputs
        }
        changed = changes(clear, sim.seeds, sim.judge.steps)
        views = {key: x.permute(0, 2, 3, 1).cpu().numpy() for key, x in changed.items()}
        return {
            **observation,
            **views,
            PICTURES_CHANGED: np.ones(self._envs.num_envs, dtype=bool),
        }
