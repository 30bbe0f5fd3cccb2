"""Pre- and postprocessor of the policy: LeRobot's steps, conversion of touch, and the tokenizer."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    ObservationProcessorStep,
    PolicyProcessorPipeline,
    ProcessorStep,
    RelativeActionsProcessorStep,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from lerobot.processor.relative_action_processor import to_relative_actions
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.backbone import SIZES
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import (
    RAW_STATE,
    STATE_SINCE_PLAN,
    TACTILE,
    TactilePI05Config,
)
from taccorl.policies.tactile_pi05.hand_poses import HandPosesStep, KeepsFeatures
from taccorl.policies.tactile_pi05.part_poses import PartPosesStep
from taccorl.policies.tactile_pi05.tokenizer import PromptTokenizerStep

SCHEME = "fixed_scale"
"""The only rule from counts to readings with a stated unit: reading = counts × gain."""
_LEAST_SCALE = 0.1
"""Least scale of an element of a vector, relative to the root mean square of those of all: the noise of one that hardly moves
stays small."""


@dataclass
class TactileReadingStep(KeepsFeatures, ObservationProcessorStep):
    """Preprocessor step that converts touch to normalised readings. With a stated unit, by the dataset's scheme ``fixed_scale``:
    reading = counts above baseline · gain. Without: reading = (value − center) / scale, by the statistics of the dataset
    (``center_and_scale``).

    Touch never passes through LeRobot's normaliser: most taxels rest at 0, so that their 1 % and 99 % quantiles are equal, and a
    division by their difference gives 2e8. A checkpoint names the step by its class's path, which LeRobot imports when it loads
    a checkpoint."""

    scheme: str = SCHEME
    gain_per_count: float = 1.0
    """Reading of one count."""
    without_unit: list[str] = field(default_factory=list)
    """Features without a stated unit."""
    statistics: dict[str, Tensor] = field(default_factory=dict)
    """``<feature>.center`` and ``<feature>.scale`` of each of them; a checkpoint keeps them as the step's state."""

    def __post_init__(self) -> None:
        """Raises TaccorlError: unknown scheme."""
        if self.scheme != SCHEME:
            raise TaccorlError(
                f"touch is normalised by {self.scheme!r}: only {SCHEME!r} is supported"
            )

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Touch of any shape and numeric type → float32 readings of the same shape. Raises TaccorlError: the statistics of a
        feature are not known."""
        for key in (TACTILE, *self.without_unit):
            if key not in observation:
                continue
            values = torch.as_tensor(observation[key]).to(torch.float32)
            if key not in self.without_unit:
                observation[key] = values * self.gain_per_count
            elif f"{key}.scale" not in self.statistics:
                raise TaccorlError(
                    f"the statistics of {key} are not known: make the processors from a dataset's statistics or a checkpoint"
                )
            else:
                center, scale = (
                    self.statistics[f"{key}.{name}"].to(values.device)
                    for name in ("center", "scale")
                )
                observation[key] = (values - center) / scale
        return observation

    def get_config(self) -> dict[str, Any]:
        own = {"without_unit": self.without_unit} if self.without_unit else {}
        return {"scheme": self.scheme, "gain_per_count": self.gain_per_count, **own}

    def state_dict(self) -> dict[str, Tensor]:
        """``center`` and ``scale`` of each feature, (n,) of a vector or () of a grid."""
        return self.statistics

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take what ``state_dict`` returned, (n,) and () tensors."""
        self.statistics = dict(state)


def center_and_scale(
    statistics: Mapping[str, Mapping[str, Any]], key: str, *, is_grid: bool
) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the feature ``key``, float32: of each element of a vector, (n,); of all elements of a grid
    together, (), which keeps its pattern. ``statistics``: of a dataset: feature → min, max, mean, std. LeRobot has one of
    each column for grids. Raises TaccorlError: there are none, they are not finite, or the feature never changes."""
    try:
        mean, std, low, high = (
            torch.as_tensor(np.asarray(statistics[key][name], np.float64))
            for name in ("mean", "std", "min", "max")
        )
    except KeyError as error:
        raise TaccorlError(
            f"the dataset's meta/stats.json has no {error} of {key}: taccorl check --repair=COPY"
        ) from error
    center, scale = (
        mean,
        std.clamp(min=_LEAST_SCALE * float(std.square().mean().sqrt())),
    )
    if is_grid:
        center = mean.mean()
        scale = (std.square() + (mean - center).square()).mean().sqrt()
    if (
        not (center.isfinite().all() and scale.isfinite().all())
        or torch.equal(low, high)
        or not std.any()
    ):
        raise TaccorlError(
            f"{key} cannot be normalised by the dataset's meta/stats.json: its mean is {float(center.mean()):g}, its standard "
            f"deviation {float(scale.mean()):g}. taccorl check names values that never change or are not finite. Leave it out: "
            "lerobot-edit-dataset --operation.type=remove_feature, or list the others in --policy.tactile_layouts"
        )
    return center.to(torch.float32), scale.to(torch.float32)


@dataclass
class OneNumberStep(KeepsFeatures):
    """Step that gives state and actions of one number their last axis.

    LeRobot 0.6.1 reads a feature of shape [1] as a scalar, so that the batch has states
    (B,) and actions (B, H); its own next step takes (B,) for one state of B numbers."""

    state: bool = False
    """Whether the state is one number."""
    action: bool = False
    """Whether an action is one number."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        state = observation.get(OBS_STATE)
        if self.state and isinstance(state, Tensor) and state.dim() == 1:
            observation = {**observation, OBS_STATE: state[:, None]}
            transition = _with(transition, TransitionKey.OBSERVATION, observation)
        action = transition.get(TransitionKey.ACTION)
        if self.action and isinstance(action, Tensor) and action.dim() == 2:
            transition = _with(transition, TransitionKey.ACTION, action[..., None])
        return transition

    def get_config(self) -> dict[str, Any]:
        return {"state": self.state, "action": self.action}


@dataclass
class RawStateStep(KeepsFeatures):
    """Step that, at inference, also passes the unnormalised state to the policy: its relative actions refer to it.

    LeRobot 0.6.1 adds the present state to every action of a chunk, but all actions are relative to the state for which the
    chunk was predicted: the motion since then would be added twice. So the policy returns with each action the change of the
    state since the prediction (``STATE_SINCE_PLAN``), which is subtracted."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        if OBS_STATE in observation and transition.get(TransitionKey.ACTION) is None:
            return _with(
                transition,
                TransitionKey.OBSERVATION,
                {**observation, RAW_STATE: observation[OBS_STATE]},
            )
        return transition


@dataclass
class TakeStateSincePlanStep(KeepsFeatures):
    """Stores ``STATE_SINCE_PLAN`` of an action before LeRobot's steps change the action."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        moved = getattr(transition.get(TransitionKey.ACTION), STATE_SINCE_PLAN, None)
        if moved is not None:
            told = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
            return _with(
                transition,
                TransitionKey.COMPLEMENTARY_DATA,
                {**told, STATE_SINCE_PLAN: moved},
            )
        return transition


@dataclass
class FromPlansStateStep(RelativeActionsProcessorStep):
    """Step after LeRobot's addition of the present state: subtracts the change of the state since the chunk was predicted."""

    _registry_name = None  # not LeRobot's step of that name

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        moved = (transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get(
            STATE_SINCE_PLAN
        )
        action = transition.get(TransitionKey.ACTION)
        if moved is not None and isinstance(action, torch.Tensor):
            at_plan = to_relative_actions(
                action, moved, self._build_mask(action.shape[-1])
            )
            return _with(transition, TransitionKey.ACTION, at_plan)
        return transition


def _with(transition: EnvTransition, key: TransitionKey, value: Any) -> EnvTransition:
    changed: Any = transition.copy()
    changed[key] = value
    return changed


def make_tactile_pi05_pre_post_processors(
    config: TactilePI05Config,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Make the preprocessor and the postprocessor, in this order, of ``--policy.type=tactile_pi05``: pi05's steps, with touch
    before the prompt. ``dataset_stats``: feature → statistic (min, q01 …) → tensor of the feature's shape; None: none are
    known yet. Raises TaccorlError: the format of touch is unknown, or the tokenizer cannot be loaded or has more tokens than
    the backbone."""
    tokenizer = PromptTokenizerStep(
        tokenizer_name=config.tokenizer_name, max_length=config.tokenizer_max_length
    )
    if (
        config.backbone in SIZES
        and len(tokenizer.input_tokenizer) > SIZES[config.backbone].vocabulary
    ):
        raise TaccorlError(
            f"--policy.tokenizer={config.tokenizer_name}: has {len(tokenizer.input_tokenizer)} tokens, more than the "
            f"{SIZES[config.backbone].vocabulary} of --policy.backbone={config.backbone}: remove --policy.tokenizer"
        )
    names = {
        "exclude_joints": config.relative_exclude_joints,
        "action_names": config.action_feature_names,
    }
    relative = RelativeActionsProcessorStep(
        enabled=config.use_relative_actions, **names
    )
    common = make_default_policy_processor_steps(config, dataset_stats)
    before: list[ProcessorStep] = [common.rename_observations]
    state = (config.input_features or {}).get(OBS_STATE)
    action = (config.output_features or {}).get(ACTION)
    one_number = OneNumberStep(
        state=state is not None and tuple(state.shape) == (1,),
        action=action is not None and tuple(action.shape) == (1,),
    )
    before += [one_number] if one_number.state or one_number.action else []
    before += [common.add_batch_dim, relative]
    before += [RawStateStep()] if config.use_relative_actions else []
    before += [HandPosesStep()] if config.knows_hands else []
    if config.part_poses or config.pose_loss:
        before.append(
            PartPosesStep(names=config.require_part_names(), required=config.part_poses)
        )
    before.append(common.normalize)
    before += [_tactile_step(config, dataset_stats)] if config.tactile else []
    if config.has_discrete_state:
        before.append(
            Pi05PrepareStateTokenizerProcessorStep(max_state_dim=config.max_state_dim)
        )
    before += [tokenizer, common.to_device]
    absolute = AbsoluteActionsProcessorStep(
        enabled=config.use_relative_actions, relative_step=relative
    )
    after: list[ProcessorStep] = [common.unnormalize, absolute, common.to_cpu]
    if config.use_relative_actions:
        after = [
            TakeStateSincePlanStep(),
            common.unnormalize,
            absolute,
            FromPlansStateStep(**names),
            common.to_cpu,
        ]
    return make_policy_processor_pipelines(input_steps=before, output_steps=after)


def _tactile_step(
    config: TactilePI05Config, dataset_stats: Mapping[str, Any] | None
) -> TactileReadingStep:
    found: dict[str, Tensor] = {}
    without_unit = {
        key: touch
        for key, touch in config.require_touch().items()
        if touch.gain_per_count is None
    }
    for key, touch in without_unit.items() if dataset_stats is not None else ():
        told = center_and_scale(dataset_stats or {}, key, is_grid=len(touch.layout) > 2)
        found[f"{key}.center"], found[f"{key}.scale"] = told
    step = TactileReadingStep(without_unit=list(without_unit), statistics=found)
    if config.tactile_format is not None:
        step.scheme, step.gain_per_count = (
            config.tactile_format.scheme,
            config.tactile_format.gain_per_count,
        )
    return step
