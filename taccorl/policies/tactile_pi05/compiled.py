"""LeRobot's joint forward of pi05 for training on a GPU: the same weights and arithmetic in fewer, larger kernels.

LeRobot starts fifteen thousand kernels a step, one by one, and a GPU waits for Python. Here torch.compile fuses each layer
(one compilation serves all layers, in half a minute), and four things are done otherwise: all cameras go through SigLIP
together; positions become angles once, not in each layer; the query heads share one key head, so their scores are one
matrix product; of the last layer only what the actions need is computed. Results differ from LeRobot's by rounding.
"""

import logging
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from lerobot.policies.pi05.modeling_pi05 import (
    PaliGemmaWithExpertModel,
    _gated_residual,
    layernorm_forward,
    modeling_gemma,
)
from lerobot.utils.constants import OPENPI_ATTENTION_MASK_VALUE
from torch import Tensor

# B batch, T tokens of prefix and suffix, K the same as keys, filled up, N heads, D width of a head
_KEYS_MULTIPLE = (
    8  # rows of 16 bytes in bfloat16, which tensor cores take without a copy
)
_MAX_COMPILATIONS = 32

_log = logging.getLogger(__name__)


class Compiled:
    """Callable that runs ``compute`` compiled by torch.compile on a GPU, and uncompiled elsewhere or where compiling fails."""

    def __init__(self, compute: Callable[..., Any]) -> None:
        self._plain = compute
        self._compiled: Callable[..., Any] | None = None

    def __call__(self, *args: Any) -> Any:
        if not _is_on_gpu(args):
            return self._plain(*args)
        from torch._dynamo import (
            config,
        )  # slow to import, and nothing but training needs it
        from torch._dynamo.exc import TorchDynamoException

        if self._compiled is None:
            # Each size of a batch has its own: one compilation for several of them was 10 % slower for each. All policies
            # of a process count as one here, and at PyTorch's limit of 8 compiling would stop.
            config.recompile_limit = max(config.recompile_limit, _MAX_COMPILATIONS)
            self._compiled = torch.compile(self._plain, dynamic=False)
        try:
            return self._compiled(*args)
        except TorchDynamoException as error:
            said = " ".join(str(error).split("\n\n")[0].split()) or type(error).__name__
            _log.warning(
                "torch.compile failed: training continues with uncompiled layers, more slowly. --policy.compile_model=false "
                "uses LeRobot's own forward and does not compile. %s",
                said,
            )
            self._compiled = self._plain
            return self._plain(*args)


def _is_on_gpu(args: tuple[Any, ...]) -> bool:
    return any(isinstance(x, Tensor) and x.is_cuda for x in args)


class CompiledBackbone(PaliGemmaWithExpertModel):
    """LeRobot's PaliGemma with its action expert; in training on a GPU its layers are compiled."""

    compiles_layers: bool = True
    tells_cameras_apart: bool = False
    """Whether the model distinguishes cameras: each has weights of its own, so that pictures go through ``embed_images`` only."""

    def fuses(self, device: torch.device) -> bool:
        """Whether this module's joint forward pass of language model and action expert is used instead of LeRobot's. With
        activation recomputation (gradient checkpointing) LeRobot's is used."""
        models: Any = self.paligemma.model.language_model, self.gemma_expert.model
        checkpoints = any(model.gradient_checkpointing for model in models)
        return (
            self.compiles_layers
            and self.training
            and device.type == "cuda"
            and not checkpoints
        )

    def embed_images(self, images: list[Tensor]) -> list[Tensor]:
        """Return the tokens (B, T, D) of each camera's pictures; ``images`` holds (B, 3, rows, columns), −1 … 1, for each
        camera."""
        paligemma: Any = self.paligemma.model
        tower = paligemma.vision_tower.vision_model
        hidden = tower.embeddings(torch.cat(images))
        for layer in tower.encoder.layers:
            hidden = _compiled_vision_layer(layer, hidden)
        tokens = paligemma.multi_modal_projector(tower.post_layernorm(hidden))
        return list(tokens.to(images[0].dtype).chunk(len(images)))

    def embed_image(self, image: Tensor) -> Any:
        """Tokens (B, T, D) of pictures (B, 3, rows, columns); tokens that ``embed_images`` made are returned unchanged."""
        return image if image.ndim == 3 else super().embed_image(image)

    def forward(
        self,
        attention_mask: Any = None,
        position_ids: Any = None,
        past_key_values: Any = None,
        inputs_embeds: Any = None,
        use_cache: Any = None,
        adarms_cond: Any = None,
    ) -> Any:
        if any(x is None for x in inputs_embeds) or not self.fuses(
            inputs_embeds[1].device
        ):
            return super().forward(
                attention_mask,
                position_ids,
                past_key_values,
                inputs_embeds,
                use_cache,
                adarms_cond,
            )
        text: Any = self.paligemma.model.language_model
        expert: Any = self.gemma_expert.model
        (prefix, suffix), condition = inputs_embeds, adarms_cond[1]
        angles = text.rotary_emb(prefix, position_ids)
        missing = -attention_mask.shape[-1] % _KEYS_MULTIPLE
        mask_BT1K = F.pad(
            attention_mask, (0, missing), value=OPENPI_ATTENTION_MASK_VALUE
        ).transpose(1, 2)
        for text_layer, expert_layer in zip(text.layers, expert.layers, strict=True):
            is_last = expert_layer is expert.layers[-1]
            prefix, suffix = _compiled_joint_layer(
                text_layer,
                expert_layer,
                prefix,
                suffix,
                condition,
                *angles,
                mask_BT1K,
                is_last,
            )
        suffix, _ = layernorm_forward(expert.norm, suffix, condition)
        return [None, suffix], None


def vision_layer(layer: Any, hidden: Tensor) -> Tensor:
    """One layer of SigLIP: ``hidden`` (B, T, D) → (B, T, D)."""
    return layer(hidden, None)


def joint_layer(
    text_layer: Any,
    expert_layer: Any,
    prefix: Tensor,
    suffix: Tensor,
    condition: Tensor,
    cos_BTD: Tensor,
    sin_BTD: Tensor,
    mask_BT1K: Tensor,
    suffix_only: bool,
) -> tuple[Tensor | None, Tensor]:
    """One layer of language model and action expert with shared attention: ``compute_layer_complete`` of LeRobot's
    modeling_pi05.py. Returns the new ``prefix`` and ``suffix``.

    Args:
        prefix: hidden states (B, prefix tokens, width of the language model).
        suffix: hidden states (B, suffix tokens, width of the action expert).
        condition: (B, width of the action expert) for its norms, from the time of the flow.
        cos_BTD, sin_BTD: of the tokens' positions; T counts prefix and suffix.
        mask_BT1K: additive attention mask, K a multiple of 8.
        suffix_only: the returned prefix is None, because no later layer uses it.
    """
    text, expert = text_layer.self_attn, expert_layer.self_attn
    normed_prefix, prefix_gate = layernorm_forward(text_layer.input_layernorm, prefix)
    normed_suffix, suffix_gate = layernorm_forward(
        expert_layer.input_layernorm, suffix, condition
    )
    num_prefix = prefix.shape[1]
    start = num_prefix if suffix_only else 0

    queries_BTND = expert.q_proj(normed_suffix)
    if not suffix_only:
        queries_BTND = torch.cat([text.q_proj(normed_prefix), queries_BTND], dim=1)
    queries_BTND = queries_BTND.unflatten(-1, (-1, text.head_dim))
    queries_BTND = _rotated(
        queries_BTND, cos_BTD[:, start:, None], sin_BTD[:, start:, None]
    )
    keys = torch.cat([text.k_proj(normed_prefix), expert.k_proj(normed_suffix)], dim=1)
    values = torch.cat(
        [text.v_proj(normed_prefix), expert.v_proj(normed_suffix)], dim=1
    )
    missing = mask_BT1K.shape[-1] - keys.shape[1]
    keys_BKD = F.pad(_rotated(keys, cos_BTD, sin_BTD), (0, 0, 0, missing))
    values_BKD = F.pad(values, (0, 0, 0, missing))

    scores = (queries_BTND.flatten(1, 2) @ keys_BKD.transpose(1, 2)) * text.scaling
    scores_BTNK = scores.unflatten(1, queries_BTND.shape[1:3]) + mask_BT1K[:, start:]
    weights_BTNK = torch.softmax(scores_BTNK, dim=-1, dtype=torch.float32).to(
        queries_BTND.dtype
    )
    attended = (
        (weights_BTNK.flatten(1, 2) @ values_BKD)
        .unflatten(1, queries_BTND.shape[1:3])
        .flatten(2)
    )

    suffix = _after_attention(
        expert_layer, suffix, attended[:, num_prefix - start :], suffix_gate, condition
    )
    if suffix_only:
        return None, suffix
    return _after_attention(
        text_layer, prefix, attended[:, :num_prefix], prefix_gate, None
    ), suffix


def _rotated(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    return x * cos + modeling_gemma.rotate_half(x) * sin


def _after_attention(
    layer: Any, hidden: Any, attended: Tensor, gate: Any, condition: Any
) -> Any:
    hidden = _gated_residual(hidden, layer.self_attn.o_proj(attended), gate)
    normed, gate = layernorm_forward(layer.post_attention_layernorm, hidden, condition)
    return _gated_residual(
        hidden, layer.mlp(normed.to(layer.mlp.up_proj.weight.dtype)), gate
    )


_compiled_vision_layer, _compiled_joint_layer = (
    Compiled(vision_layer),
    Compiled(joint_layer),
)
