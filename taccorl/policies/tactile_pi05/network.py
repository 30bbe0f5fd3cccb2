"""The network: LeRobot's pi05 with two more kinds of tokens, gated by contact (paper §3.2).

    Z̄ = Z_base + CrossAttn(Z_base, Z_touch)        the cross-attention's output is zero when training starts
    prefix = [Z̄, Z_touch]                          images, language and state; then M_pre tokens of touch
    suffix = [Z_touch, actions]                     M_suf tokens of touch, then the noisy actions


Without pretrained weights the state is not in the prompt, in 256 steps a joint, but a token before the actions, as in π0; and a
``Fusion`` of all inputs is added to the condition of the action expert's layers.
Without contact tokens of touch do not exist for the row: attention masks them, positions do not count them and the sum is left
out.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from lerobot.policies.pi05.modeling_pi05 import PI05Pytorch
from torch import Tensor, nn

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.backbone import (
    SIZES,
    FullBackbone,
    Patches,
    SmallBackbone,
)
from taccorl.policies.tactile_pi05.cameras import NormReLU
from taccorl.policies.tactile_pi05.compiled import CompiledBackbone
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.policies.tactile_pi05.encoder import (
    Fusion,
    StateToken,
    TactileEncoder,
    TouchIntoContext,
)

# B batch, L history, K values of touch, M tokens, T of the context, D width, H horizon
_TOUCH_WIDTH = 256  # hidden width of the encoder, at most that of the context
_FUSED_OF_EXPERT = 2  # width of the fusion, relative to that of the action expert


class Touch(NamedTuple):
    """Tactile tokens of a batch for prefix and suffix, and the rows that are in contact."""

    prefix_BMD: Tensor
    suffix_BMD: Tensor
    tokens_BMD: Tensor
    """Tokens of the encoder, from which both are computed."""
    contact_B: Tensor
    """c_t, (B,) bool. Rows without contact do not use the tokens."""


class TactileConditioning(nn.Module):
    """All weights that touch adds to the network: the entries ``model.tactile.*`` of a checkpoint."""

    def __init__(
        self,
        config: TactilePI05Config,
        prefix_width: int,
        suffix_width: int,
        fused_width: int,
    ) -> None:
        """``fused_width``: F of the fusion; 0: the network has none."""
        super().__init__()
        width = min(_TOUCH_WIDTH, prefix_width)
        self.num_prefix = config.prefix_tokens
        num_tokens = config.prefix_tokens + config.suffix_tokens
        self.encoder = TactileEncoder(
            config.require_touch(), config.tactile_history, num_tokens, width
        )
        self.to_prefix = nn.Linear(width, prefix_width)  # W_τ
        self.to_suffix = nn.Linear(width, suffix_width)
        self.into_context = TouchIntoContext(prefix_width)
        self.to_fusion = (
            nn.Linear(math.prod(self.encoder.token_shape), fused_width, bias=False)
            if fused_width
            else None
        )

    def forward(self, readings_BLK: Tensor, contact_B: Tensor) -> Touch:
        """Compute the tactile tokens of normalised readings (B, L, K); ``contact_B`` (bool) is passed on."""
        tokens_BMD = self.encoder(readings_BLK)
        prefix_BMD, suffix_BMD = (
            tokens_BMD[:, : self.num_prefix],
            tokens_BMD[:, self.num_prefix :],
        )
        return Touch(
            self.to_prefix(prefix_BMD),
            self.to_suffix(suffix_BMD),
            tokens_BMD,
            contact_B,
        )


class TactilePI05Pytorch(PI05Pytorch):
    """LeRobot's pi05 model with tactile tokens, added in ``embed_prefix`` and ``embed_suffix``."""

    config: TactilePI05Config
    paligemma_with_expert: CompiledBackbone

    def __init__(self, config: TactilePI05Config, rtc_processor: Any = None) -> None:
        """As ``PI05Pytorch.__init__``, with a backbone of ``taccorl``."""
        nn.Module.__init__(self)
        self.config, self.rtc_processor = config, rtc_processor
        self.paligemma_with_expert = _backbone(config)
        self.paligemma_with_expert.compiles_layers = config.compile_model
        expert_config: Any = self.paligemma_with_expert.gemma_expert.config
        width = expert_config.hidden_size
        self.action_in_proj = nn.Linear(config.max_action_dim, width)
        self.action_out_proj = nn.Linear(width, config.max_action_dim)
        self.time_mlp_in, self.time_mlp_out = (
            nn.Linear(width, width),
            nn.Linear(width, width),
        )
        self.gradient_checkpointing_enabled = False
        self.fusion: Fusion | None = None
        if not config.has_discrete_state:
            self.state_token = StateToken(config.state_dim, width)
            if self.paligemma_with_expert.tells_cameras_apart:
                tower: Any = self.paligemma_with_expert.paligemma.model.vision_tower
                num = width + sum(
                    math.prod(camera.token_shape) for camera in tower.cameras
                )
                self.fusion = Fusion(num, _FUSED_OF_EXPERT * width, width)
        if config.tactile:
            text_config: Any = self.paligemma_with_expert.paligemma.config.text_config
            prefix_width = text_config.hidden_size
            fused_width = 0 if self.fusion is None else self.fusion.width
            self.tactile = TactileConditioning(config, prefix_width, width, fused_width)
        for module in self.modules():
            if isinstance(module, NormReLU):
                module.compiles = config.compile_model
        self._fused_BF: Tensor | None = None
        self._touch: Touch | None = None
        self._state_B1D: Tensor | None = None

    @property
    def touch(self) -> Touch | None:
        """Touch of the batch within ``sensing``; None: outside of it, or no row is in contact."""
        return self._touch

    @property
    def fused(self) -> Tensor | None:
        """Output (B, F) of the fusion for the latest prefix within ``sensing``; None: outside of it, or there is no fusion."""
        return self._fused_BF

    def _fuse(self, fusion: Fusion, images: list[Tensor], state_B1D: Tensor) -> None:
        """Of camera tokens (B, M, D), state and, in rows with contact, touch."""
        with torch.autocast(state_B1D.device.type, enabled=False):
            touch_BF = None
            if self._touch is not None and self.tactile.to_fusion is not None:
                touch_BF = self.tactile.to_fusion(self._touch.tokens_BMD.flatten(1))
                touch_BF = torch.where(self._touch.contact_B[:, None], touch_BF, 0.0)
            self._fused_BF = fusion([*images, state_B1D], touch_BF)

    @contextmanager
    def sensing(
        self,
        state_B1D: Tensor | None,
        readings_BLK: Tensor | None,
        contact_B: Tensor | None,
        *,
        masked: bool = False,
    ) -> Iterator[None]:
        """Context manager: the model uses this state and these tactile readings in all computations inside it. ``state_B1D``:
        token (B, 1, D) of the state; None: it is in the prompt. ``readings_BLK``: normalised tactile readings; None, or no
        contact in the batch: plain pi05. ``contact_B``: (B,) bool, rows in contact; None without readings. ``masked``: also
        compute (masked) tokens if there is no contact in the batch, so that nothing is copied from the GPU."""
        if (
            readings_BLK is not None
            and contact_B is not None
            and (masked or bool(contact_B.any()))
        ):
            # Float32 in training, too, as in a chunk: casting the encoder's many small weights takes longer than using them.
            with torch.autocast(contact_B.device.type, enabled=False):
                self._touch = self.tactile(readings_BLK, contact_B)
        self._state_B1D = state_B1D
        try:
            yield
        finally:
            self._touch = self._state_B1D = self._fused_BF = None

    def embed_prefix(
        self,
        images: list[Tensor],
        image_masks: list[Tensor],
        tokens: Tensor,
        token_mask: Tensor,
        *memory: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """``memory``: what versions of LeRobot after 0.6.1 pass on to their π0.5 besides."""
        backbone = self.paligemma_with_expert
        are_tokens = not images or images[0].ndim == 3  # none: a policy without cameras
        if not are_tokens and (
            backbone.tells_cameras_apart or backbone.fuses(tokens.device)
        ):
            images = backbone.embed_images(images)
        if self.fusion is not None and self._state_B1D is not None:
            self._fuse(self.fusion, images, self._state_B1D)
        context_BTD, valid_BT, starts_block_BT = super().embed_prefix(
            images, image_masks, tokens, token_mask, *memory
        )
        if self._touch is None:
            return context_BTD, valid_BT, starts_block_BT
        tokens_BMD, contact_B = self._touch.prefix_BMD, self._touch.contact_B
        felt_BTD = self.tactile.into_context(
            context_BTD.to(tokens_BMD.dtype), tokens_BMD
        ).to(context_BTD.dtype)
        # where, not a product with the gate: 0 · x is not 0 for every x, and −0 + 0 is not −0
        context_BTD = torch.where(
            contact_B[:, None, None], context_BTD + felt_BTD, context_BTD
        )
        num_tokens = tokens_BMD.shape[1]
        return (
            torch.cat([context_BTD, tokens_BMD.to(context_BTD.dtype)], dim=1),
            torch.cat([valid_BT, contact_B[:, None].expand(-1, num_tokens)], dim=1),
            torch.cat(
                [
                    starts_block_BT,
                    starts_block_BT.new_zeros(len(starts_block_BT), num_tokens),
                ],
                dim=1,
            ),
        )

    def embed_suffix(
        self, *args: Any, **kwargs: Any
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        actions_BHD, valid_BH, starts_block_BH, condition_BD = super().embed_suffix(
            *args, **kwargs
        )
        if self.fusion is not None and self._fused_BF is not None:
            with torch.autocast(condition_BD.device.type, enabled=False):
                condition_BD = condition_BD + self.fusion.condition(self._fused_BF).to(
                    condition_BD.dtype
                )
        before: list[tuple[Tensor, Tensor]] = []  # tokens and whether the row has them
        if self._touch is not None:
            tokens_BMD, contact_B = self._touch.suffix_BMD, self._touch.contact_B
            before.append(
                (tokens_BMD, contact_B[:, None].expand(-1, tokens_BMD.shape[1]))
            )
        if self._state_B1D is not None:
            before.append((self._state_B1D, valid_BH[:, :1]))
        for tokens_BMD, valid_BM in before:
            # A block of its own: the context does not look at it, the actions do, and it does not look at them.
            starts_block_BM = starts_block_BH.new_zeros(valid_BM.shape)
            starts_block_BM[:, 0] = 1
            actions_BHD = torch.cat(
                [tokens_BMD.to(actions_BHD.dtype), actions_BHD], dim=1
            )
            valid_BH = torch.cat([valid_BM, valid_BH], dim=1)
            starts_block_BH = torch.cat([starts_block_BM, starts_block_BH], dim=1)
        return actions_BHD, valid_BH, starts_block_BH, condition_BD


def _backbone(config: TactilePI05Config) -> CompiledBackbone:
    """Raises TaccorlError: pictures of a size that the vision tower does not take."""
    size = SIZES.get(config.backbone)
    rows, columns = config.image_resolution
    patch_px = (
        size.vision.px
        if size is not None and isinstance(size.vision, Patches)
        else None
    )
    takes_squares = size is None or patch_px is not None
    if takes_squares and (rows != columns or (patch_px and rows % patch_px)):
        patches = f" of a multiple of {patch_px} pixels" if patch_px else ""
        raise TaccorlError(
            f"--policy.image_resolution={config.image_resolution}: --policy.backbone={config.backbone} requires square "
            f"pictures{patches}, such as [224, 224]"
        )
    if size is None:
        return FullBackbone(config)
    return SmallBackbone(
        size,
        image_px=rows,
        num_cameras=len(config.image_features),
        freeze_vision_encoder=config.freeze_vision_encoder,
        train_expert_only=config.train_expert_only,
    )
