"""From a row of a dataset or an environment to what the policy takes, and back: LeRobot's steps, touch and the tokenizer."""

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
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

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.backbone import SIZES
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TACTILE, TactilePI05Config
from taccorl.policies.tactile_pi05.tokenizer import PromptTokenizerStep

SCHEME = "fixed_scale"


@dataclass
class TactileReadingStep(ObservationProcessorStep):
    """Counts above baseline → readings, by the dataset's named scheme. ``fixed_scale``: reading = counts · gain.

    Touch never passes through LeRobot's normaliser: most taxels rest at 0, their 1 % and 99 % quantiles are equal, and what is
    divided by their difference comes out as 2e8. Saved under its class's path, which LeRobot imports when it loads a checkpoint.
    """

    scheme: str = SCHEME
    gain_per_count: float = 1.0

    def __post_init__(self) -> None:
        """
        Raises:
            TaccorlError: unknown scheme.
        """
        if self.scheme != SCHEME:
            raise TaccorlError(f"touch normalised by {self.scheme!r}: only {SCHEME!r} is known")

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """``observation.tactile`` of any shape and number type → float32 of the same shape."""
        if TACTILE in observation:
            observation[TACTILE] = torch.as_tensor(observation[TACTILE]).to(torch.float32) * self.gain_per_count
        return observation

    def get_config(self) -> dict[str, Any]:
        return {"scheme": self.scheme, "gain_per_count": self.gain_per_count}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def make_tactile_pi05_pre_post_processors(
    config: TactilePI05Config, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """What LeRobot makes of ``--policy.type=tactile_pi05``: the order is pi05's, touch comes before the prompt.

    Raises:
        TaccorlError: touch of an unknown format, a tokenizer that cannot be loaded or that the backbone has no room for.
    """
    tokenizer = PromptTokenizerStep(tokenizer_name=config.tokenizer_name, max_length=config.tokenizer_max_length)
    if config.backbone in SIZES and len(tokenizer.input_tokenizer) > SIZES[config.backbone].vocabulary:
        raise TaccorlError(
            f"--policy.tokenizer={config.tokenizer_name}: {len(tokenizer.input_tokenizer)} tokens, --policy.backbone="
            f"{config.backbone} knows {SIZES[config.backbone].vocabulary}: leave the tokenizer out"
        )
    relative = RelativeActionsProcessorStep(
        enabled=config.use_relative_actions,
        exclude_joints=config.relative_exclude_joints,
        action_names=config.action_feature_names,
    )
    common = make_default_policy_processor_steps(config, dataset_stats)
    before: list[ProcessorStep] = [common.rename_observations, common.add_batch_dim, relative, common.normalize]
    if config.tactile:
        told = config.require_tactile_format()
        before.append(TactileReadingStep(scheme=told.scheme, gain_per_count=told.gain_per_count))
    before += [Pi05PrepareStateTokenizerProcessorStep(max_state_dim=config.max_state_dim), tokenizer, common.to_device]
    after: list[ProcessorStep] = [
        common.unnormalize,
        AbsoluteActionsProcessorStep(enabled=config.use_relative_actions, relative_step=relative),
        common.to_cpu,
    ]
    return make_policy_processor_pipelines(input_steps=before, output_steps=after)
