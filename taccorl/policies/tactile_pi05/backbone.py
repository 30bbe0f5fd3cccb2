"""Sizes of the vision-language model and its action expert: π0.5's own, and small ones of the same code to train from scratch.

LeRobot 0.6.1 writes three things into pi05 that a smaller one cannot change: 8 query heads with one key-value head, as many
layers in the expert as in the language model, and its sizes (modeling_pi05.py, ``compute_layer_complete`` and
``PaliGemmaWithExpertModel.__init__``). So the small ones keep the first two and have an ``__init__`` of their own.
"""

from dataclasses import dataclass
from typing import Any

from lerobot.policies.pi05.modeling_pi05 import (
    CONFIG_MAPPING,
    PaliGemmaForConditionalGenerationWithPiGemma,
    PaliGemmaWithExpertModel,
    PiGemmaForCausalLM,
    get_gemma_config,
)
from torch import Tensor, nn

from taccorl.policies.tactile_pi05.compiled import CompiledBackbone
from taccorl.policies.tactile_pi05.tokenizer import write_number_embeddings

_HEADS, _KV_HEADS = 8, 1
_FEWEST_CHANNELS, _GROUPS = 16, 4  # of early convolutions


@dataclass(frozen=True, kw_only=True)
class Size:
    """Widths are of hidden states; an ``mlp`` is the inner width of a layer's feed-forward half."""

    depth: int
    head_width: int
    text_width: int
    text_mlp: int
    expert_width: int
    expert_mlp: int
    vision_width: int
    vision_depth: int
    vision_heads: int
    vision_mlp: int
    patch_px: int
    vocabulary: int
    early_convolutions: bool = False
    """A few small convolutions cut an image into patches, not one large one (see ``EarlyConvolutions``)."""


SIZES = {
    # 30 M, for one GPU from scratch: 196 tokens a camera
    "small": Size(
        depth=7, head_width=48, text_width=384, text_mlp=1536, expert_width=256, expert_mlp=1024,
        vision_width=256, vision_depth=6, vision_heads=4, vision_mlp=1024, patch_px=16, vocabulary=520,
    ),
    # 1 M, for a CPU: 64 tokens a camera
    "tiny": Size(
        depth=3, head_width=16, text_width=96, text_mlp=192, expert_width=64, expert_mlp=128,
        vision_width=64, vision_depth=2, vision_heads=4, vision_mlp=128, patch_px=28, vocabulary=520,
        early_convolutions=True,
    ),
}  # fmt: skip


class EarlyConvolutions(nn.Module):
    """Patches of an image as SigLIP's one convolution gives them, by several: 3 × 3 with stride 2 as long as that divides.

    A vision transformer learns faster that way, and with fewer rows (Xiao et al. 2021, Early Convolutions Help Transformers See
    Better). Only where nothing is pretrained.
    """

    def __init__(self, patch_px: int, width: int) -> None:
        """
        Args:
            patch_px: side of a patch, the product of the strides.
            width: channels that come out.
        """
        super().__init__()
        layers: list[nn.Module] = []
        channels, rest_px = 3, patch_px
        while rest_px % 2 == 0 and rest_px > 2:
            more = min(max(_FEWEST_CHANNELS, 2 * channels if layers else 0), width)
            layers += [nn.Conv2d(channels, more, 3, 2, padding=1), nn.GroupNorm(_GROUPS, more), nn.GELU()]
            channels, rest_px = more, rest_px // 2
        self.layers = nn.Sequential(*layers, nn.Conv2d(channels, width, rest_px, rest_px))

    @property
    def weight(self) -> Tensor:
        """SigLIP asks for its type."""
        return next(self.layers[-1].parameters())

    def forward(self, images_BCRC: Tensor) -> Tensor:
        """(B, 3, rows, columns) → (B, width, rows of patches, columns of patches)."""
        return self.layers(images_BCRC)


class FullBackbone(CompiledBackbone):
    """LeRobot's PaliGemma with its action expert, without language heads."""

    def __init__(self, config: Any) -> None:
        """
        Args:
            config: LeRobot's ``PI05Config``.
        """
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
    """LeRobot's PaliGemma with its action expert, in another size and without language heads."""

    def __init__(
        self, size: Size, *, precision: Any, image_px: int, freeze_vision_encoder: bool, train_expert_only: bool
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
        text = {"model_type": "gemma", "hidden_size": size.text_width, "intermediate_size": size.text_mlp, **shared}
        vision = {
            "model_type": "siglip_vision_model",
            "hidden_size": size.vision_width,
            "intermediate_size": size.vision_mlp,
            "num_hidden_layers": size.vision_depth,
            "num_attention_heads": size.vision_heads,
            "image_size": image_px,
            "patch_size": size.patch_px,
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
        if size.early_convolutions:
            model.vision_tower.vision_model.embeddings.patch_embedding = EarlyConvolutions(
                size.patch_px, size.vision_width
            )
        without_language_heads(self)
        self.to_bfloat16_for_selected_params(precision)
        self._set_requires_grad()


def without_language_heads(backbone: PaliGemmaWithExpertModel) -> None:
    """Actions never use them: 0.79 of the full size's 4.14 billion parameters."""
    models: list[Any] = [backbone.paligemma, backbone.gemma_expert]
    for model in models:
        model.lm_head = None
