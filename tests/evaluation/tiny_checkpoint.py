"""A checkpoint of tactile_pi05 at its smallest, as lerobot-train leaves one: random weights, statistics near the home pose."""

from pathlib import Path
from typing import Any

from taccorl.robots import ROBOT
from taccorl.sim.spaces import IMAGE_KEYS


def write_checkpoint(folder: Path, **changes: Any) -> Path:
    """``folder/pretrained_model`` with weights, configuration and both processors; returns it."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.factory import make_pre_post_processors
    from tiny_policies import tiny_policy

    import taccorl.lerobot_plugin  # noqa: F401
    from taccorl.policies.tactile_pi05.hand_poses import arm_names

    inputs = {
        "observation.state": PolicyFeature(FeatureType.STATE, (14,)),
        "observation.tactile": PolicyFeature(FeatureType.STATE, (1536,)),
        **{
            key: PolicyFeature(FeatureType.VISUAL, (3, 224, 224))
            for key in IMAGE_KEYS.values()
        },
    }
    policy = tiny_policy(
        fps=30,
        discrete_state_input=None,
        action_feature_names=list(arm_names()),
        input_features=inputs,
        **changes,
    )
    middle = torch.tensor(
        (ROBOT.action_low + ROBOT.action_high) / 2, dtype=torch.float32
    )
    statistics = {
        name: {
            "q01": middle - 0.05,
            "q99": middle + 0.05,
            "min": middle - 0.05,
            "max": middle + 0.05,
        }
        for name in ("action", "observation.state")
    }
    policy.save_pretrained(folder / "pretrained_model")
    for processor in make_pre_post_processors(policy.config, dataset_stats=statistics):
        processor.save_pretrained(folder / "pretrained_model")
    return folder / "pretrained_model"
