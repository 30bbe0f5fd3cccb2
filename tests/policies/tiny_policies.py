"""Tiny policies with fixed weights, batches for them, and LeRobot's own pi05 in the same size."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import lerobot.policies.pi05.modeling_pi05 as pi05
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.pi05.configuration_pi05 import PI05Config

from taccorl.policies.tactile_pi05.backbone import (
    SIZES,
    Patches,
    SmallBackbone,
    without_language_heads,
)
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import (
    TactileFormat,
    TactilePI05Config,
)
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy

FORMAT = TactileFormat(
    "flexitac_v2",
    ("left_a", "left_b", "right_a", "right_b"),
    32,
    12,
    "fixed_scale",
    1 / 75,
)
TACTILE = "observation.tactile"
PROMPT_TOKENS = 40
CAMERAS = ("front", "left_wrist", "right_wrist")
COMMON: dict[str, Any] = {
    "device": "cpu",
    "chunk_size": 10,
    "n_action_steps": 5,
    "num_inference_steps": 4,
    "image_resolution": (56, 56),
}


@contextmanager
def sees_with(vision: str) -> Iterator[None]:
    """tiny with "cameras", as it is, or with "patches", as the larger ones are."""
    with pytest.MonkeyPatch.context() as patch:
        if vision == "patches":
            patches = Patches(px=28, width=64, depth=2, heads=4, mlp=128)
            patch.setitem(
                SIZES, "tiny", dataclasses.replace(SIZES["tiny"], vision=patches)
            )
        yield


def features() -> dict[str, dict[str, PolicyFeature]]:
    images = {
        f"observation.images.{c}": PolicyFeature(FeatureType.VISUAL, (3, 56, 56))
        for c in CAMERAS
    }
    state = {"observation.state": PolicyFeature(FeatureType.STATE, (14,))}
    touch = {TACTILE: PolicyFeature(FeatureType.STATE, (1536,))}
    return {
        "input_features": {**state, **images, **touch},
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (14,))},
    }


def tiny_config(**changes: Any) -> TactilePI05Config:
    """With the state in the prompt, as LeRobot's pi05 has it."""
    own = {"backbone": "tiny", "discrete_state_input": True, "tactile_format": FORMAT}
    return TactilePI05Config(**{**COMMON, **own, **features(), **changes})


def tiny_policy(**changes: Any) -> TactilePI05Policy:
    """With weights of seed 0; touch matters, as after some training: the cross-attention's output is not zero."""
    torch.manual_seed(0)
    policy = TactilePI05Policy(tiny_config(**changes)).eval()
    if policy.config.tactile:
        torch.nn.init.normal_(policy.model.tactile.into_context.out.weight, std=0.1)
    return policy


def plain_pi05(
    weights_of: TactilePI05Policy, monkeypatch: pytest.MonkeyPatch
) -> pi05.PI05Policy:
    """LeRobot's class itself, whose two places with sizes written into them give tiny ones."""
    size = SIZES["tiny"]
    widths = {"gemma_2b": size.text_width, "gemma_300m": size.expert_width}

    def backbone(
        *_: Any, precision: Any, image_size: int, use_adarms: Any, **frozen: bool
    ) -> SmallBackbone:
        return SmallBackbone(
            size, image_px=image_size, num_cameras=len(CAMERAS), **frozen
        )

    monkeypatch.setattr(
        pi05, "get_gemma_config", lambda variant: SimpleNamespace(width=widths[variant])
    )
    monkeypatch.setattr(pi05, "PaliGemmaWithExpertModel", backbone)
    known = features()
    del known["input_features"][TACTILE]
    policy = pi05.PI05Policy(PI05Config(**COMMON, **known)).eval()
    shared = {
        k: v
        for k, v in weights_of.state_dict().items()
        if not k.startswith("model.tactile.")
    }
    without_language_heads(policy.model.paligemma_with_expert)
    policy.load_state_dict(shared, strict=True)
    embed_prefix, seeing = policy.model.embed_prefix, policy.model.paligemma_with_expert
    if (
        seeing.tells_cameras_apart
    ):  # LeRobot's does not say of which camera a picture is
        monkeypatch.setattr(
            policy.model,
            "embed_prefix",
            lambda images, *rest: embed_prefix(seeing.embed_images(images), *rest),
        )
    return policy


def readings(*touched: bool, seed: int = 1) -> torch.Tensor:
    """(B, 10, 1536): noise below the gate everywhere, and in touched rows a press that grows."""
    generator = torch.Generator().manual_seed(seed)
    out = 0.39 * (2 * torch.rand(len(touched), 10, 1536, generator=generator) - 1)
    for row, is_touched in enumerate(touched):
        if is_touched:
            out[row, 4:, 100 : 100 + 8 * (row + 1)] += torch.linspace(0.5, 2.5, 6)[
                :, None
            ]
    return out


def batch_of(
    *touched: bool, seed: int = 1, prompt_tokens: int = PROMPT_TOKENS
) -> dict[str, torch.Tensor]:
    """Rows with different pictures, prompts of different lengths and actions."""
    generator = torch.Generator().manual_seed(seed)
    rows = len(touched)
    lengths = torch.linspace(prompt_tokens // 2, prompt_tokens, rows).long()
    batch = {
        f"observation.images.{c}": torch.rand(rows, 3, 56, 56, generator=generator)
        for c in CAMERAS
    }
    return {
        **batch,
        "observation.state": torch.rand(rows, 14, generator=generator),
        "observation.language.tokens": torch.randint(
            2, 258, (rows, prompt_tokens), generator=generator
        ),
        "observation.language.attention_mask": torch.arange(prompt_tokens)
        < lengths[:, None],
        "action": torch.randn(rows, 10, 14, generator=generator),
        TACTILE: readings(*touched, seed=seed),
    }


def chunk(policy: Any, batch: dict[str, torch.Tensor], seed: int = 7) -> torch.Tensor:
    torch.manual_seed(seed)
    return policy.predict_action_chunk(batch)


def losses(
    policy: Any, batch: dict[str, torch.Tensor], reduction: str = "none", seed: int = 7
) -> torch.Tensor:
    torch.manual_seed(seed)
    return policy.forward(batch, reduction)[0].detach()
