"""Sizes of the vision-language model and its action expert: π0.5's own, and small ones of the same code to train from scratch.

LeRobot 0.6.1 writes three things into pi05 that a smaller one cannot change: 8 query heads with one key-value head, as many
layers in the expert as in the language model, and its sizes (modeling_pi05.py, ``compute_layer_complete`` and
``PaliGemmaWithExpertModel.__init__``). So the small ones keep the first two and have an ``__init__`` of their own.
"""

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.policies.pi05.modeling_pi05 import (
    CONFIG_MAPPING,
    PaliGemmaForConditionalGenerationWithPiGemma,
    PaliGemmaWithExpertModel,
    PiGemmaForCausalLM,
    get_gemma_config,
)
from torch import Tensor, nn

from taccorl.policies.tactile_pi05.cameras import CameraSize, CameraTower
from taccorl.policies.tactile_pi05.compiled import CompiledBackbone
from taccorl.policies.tactile_pi05.tokenizer import write_number_embeddings

_HEADS, _KV_HEADS = 8, 1


@dataclass(frozen=True, kw_only=True)
class Patches:
    """Settings of SigLIP, which makes one token per patch of a picture."""

    px: int
    """Side of a square patch [pixels]."""
    width: int
    depth: int
    """Number of layers."""
    heads: int
    mlp: int
    """Inner width of a layer's feed-forward part."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """Sizes of a backbone. Widths are those of hidden states; ``mlp`` is the inner width of a layer's feed-forward part."""

    depth: int
    """Number of layers."""
    head_width: int
    text_width: int
    text_mlp: int
    expert_width: int
    expert_mlp: int
    vision: Patches | CameraSize
    """How pictures become tokens: by SigLIP, or by a network for each camera."""
    vocabulary: int
    """Number of tokens of the tokenizer."""


SIZES = {
    # 18.4 M with three cameras and touch, for one GPU
    "small": Size(
        depth=4, head_width=32, text_width=256, text_mlp=512, expert_width=256, expert_mlp=512,
        vision=CameraSize(
            stem_channels=32, blocks=((64, 2), (128, 1), (128, 2)), points=48, pooled_width=128, tokens=6
        ),
        vocabulary=520,
    ),
    # for a CPU: tests and demonstrations
    "tiny": Size(
        depth=3, head_width=16, text_width=96, text_mlp=192, expert_width=64, expert_mlp=128,
        vision=CameraSize(stem_channels=8, blocks=((16, 2), (32, 2)), points=32, pooled_width=32, tokens=4),
        vocabulary=520,
    ),
}  # fmt: skip
"""Name in ``--policy.backbone`` → sizes of the networks that are trained from scratch."""


class FullBackbone(CompiledBackbone):
    """LeRobot's PaliGemma with its action expert, without the output layers for text."""

    def __init__(self, config: Any) -> None:
        """``config``: LeRobot's ``PI05Config``."""
        super().__init__(
            get_gemma_config(config.paligemma_variant),
            get_gemma_config(config.action_expert_variant),
            use_adarms=[False, True],
            precision=config.dtype,
            image_size=config.image_resolution[0],
            freeze_vision_encoder=config.freeze_vision_encoder,
            train_expert_only=config.train_expert_only,
        )
        without_language_heads(self)


class SmallBackbone(CompiledBackbone):
    """LeRobot's PaliGemma and action expert with widths and depth from a ``Size``, without the output layers for text.

    Its weights are float32 whatever ``--policy.dtype`` says: with bfloat16, LeRobot's trainer computes in it (autocast), and
    small changes of weights are not lost."""

    def __init__(
        self,
        size: Size,
        *,
        image_px: int,
        num_cameras: int,
        freeze_vision_encoder: bool,
        train_expert_only: bool,
    ) -> None:
        nn.Module.__init__(self)
        self.freeze_vision_encoder = freeze_vision_encoder
        self.train_expert_only = train_expert_only
        shared: dict[str, Any] = {
            "num_hidden_layers": size.depth,
            "num_attention_heads": _HEADS,
            "num_key_value_heads": _KV_HEADS,
            "head_dim": size.head_width,
            "vocab_size": size.vocabulary,
            "pad_token_id": 0,
            "hidden_activation": "gelu_pytorch_tanh",
            "dtype": "float32",
        }
        text = {
            "model_type": "gemma",
            "hidden_size": size.text_width,
            "intermediate_size": size.text_mlp,
            **shared,
        }
        no_patches = Patches(
            px=image_px, width=8, depth=0, heads=1, mlp=8
        )  # its tower is replaced below
        patches = size.vision if isinstance(size.vision, Patches) else no_patches
        vision = {
            "model_type": "siglip_vision_model",
            "hidden_size": patches.width,
            "intermediate_size": patches.mlp,
            "num_hidden_layers": patches.depth,
            "num_attention_heads": patches.heads,
            "image_size": image_px,
            "patch_size": patches.px,
            "projection_dim": size.text_width,
            "vision_use_head": False,
            "dtype": "float32",
        }
        # transformers' configs take any key; their declared type is that of their common base
        make_paligemma: Any = CONFIG_MAPPING["paligemma"]
        make_gemma: Any = CONFIG_MAPPING["gemma"]
        self.paligemma = PaliGemmaForConditionalGenerationWithPiGemma(
            config=make_paligemma(
                text_config={**text, "use_adarms": False, "adarms_cond_dim": None},
                vision_config=vision,
                projection_dim=size.text_width,
                hidden_size=size.text_width,
                image_token_index=size.vocabulary - 1,
            )
        )
        self.gemma_expert = PiGemmaForCausalLM(
            config=make_gemma(
                hidden_size=size.expert_width,
                intermediate_size=size.expert_mlp,
                use_adarms=True,
                adarms_cond_dim=size.expert_width,
                **shared,
            )
        )
        expert: Any = self.gemma_expert.model
        expert.embed_tokens = None
        model: Any = self.paligemma.model
        write_number_embeddings(model.language_model.embed_tokens.weight)
        if isinstance(size.vision, CameraSize):
            self.tells_cameras_apart = True
            model.vision_tower = CameraTower(num_cameras, size.vision, size.text_width)
            model.multi_modal_projector = None
        without_language_heads(self)
        self._set_requires_grad()

    def embed_images(self, images: list[Tensor]) -> list[Tensor]:
        if not self.tells_cameras_apart:
            return super().embed_images(images)
        tower: Any = self.paligemma.model.vision_tower
        return [
            tokens.to(images[0].dtype)
            for tokens in tower([image.to(torch.float32) for image in images])
        ]


def without_language_heads(backbone: PaliGemmaWithExpertModel) -> None:
    """Remove the output layers for text from ``backbone``, in place. Computing actions never uses them; at full size they hold
    0.79 billion of its 4.14 billion parameters."""
    models: list[Any] = [backbone.paligemma, backbone.gemma_expert]
    for model in models:
        model.lm_head = None
