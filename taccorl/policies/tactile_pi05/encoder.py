"""Tactile encoder: tokens from a window of touch (E_τ of the paper), and cross-attention into the base context.

The pads of one feature pass through the same network: a taxel pattern means the same on every pad. A grid passes through
convolutions, a vector through two linear layers. Readings span three orders of magnitude, so each is given in two scales, of c
counts above baseline:

    log(1 + max(c, 0) / 10)        resolves light contact
    c / 200 within −1 … 3          resolves the pressure of a grip

Readings z without a stated unit, normalised by a dataset's statistics, may have both signs. For them c = 100 z, one standard
deviation:

    sign(c) log(1 + |c| / 10),     c / 200 within −3 … 3
"""

import math
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from taccorl.policies.tactile_pi05.cameras import NormReLU
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TouchInput

# B batch, L history, K values of all features, P pads, R rows, C columns, M tokens, D width, T tokens of the context
_CHANNELS = (32, 64, 64)
_STRIDE = 2
_PAD_WIDTH = 128  # numbers that describe one pad
_LOG_COUNTS, _LINEAR_COUNTS = 10, 200  # units of the two scales [counts]
_LINEAR_LIMITS = (-1.0, 3.0)
_COUNTS_PER_DEVIATION = (
    100  # c of one standard deviation of readings without a stated unit
)


class TactileEncoder(nn.Module):
    """A network for the pads of each feature, whose channels are the L readings in two scales; then M tokens from all pads.

    The network of the feature with a stated unit is ``pad``; the others have their feature's name, with / for each dot."""

    def __init__(
        self,
        inputs: Mapping[str, TouchInput],
        history: int,
        num_tokens: int,
        width: int,
    ) -> None:
        """``inputs``: feature → its layout and unit, in the order of their values in a reading. ``history``: L, readings in a
        window. ``num_tokens``: M. ``width``: D."""
        super().__init__()
        self.token_shape = (num_tokens, width)
        self.inputs = {
            "pad" if touch.gain_per_count else key.replace(".", "/"): touch
            for key, touch in inputs.items()
        }
        for name, touch in self.inputs.items():
            self.add_module(name, _network(touch.layout[1:], 2 * history))
        self.hidden = nn.Linear(
            sum(touch.layout[0] for touch in inputs.values()) * _PAD_WIDTH, width
        )
        self.out = nn.Linear(width, num_tokens * width)

    def forward(self, readings_BLK: Tensor) -> Tensor:
        """(B, L, K) normalised readings, oldest first → (B, M, D)."""
        parts = readings_BLK.split(
            [touch.num_values for touch in self.inputs.values()], dim=-1
        )
        pads = []
        for (name, touch), part_BLK in zip(self.inputs.items(), parts, strict=True):
            readings_BPLRC = part_BLK.unflatten(-1, touch.layout).transpose(1, 2)
            channels = torch.cat(scales(readings_BPLRC, touch.gain_per_count), dim=2)
            maps = channels.flatten(0, 1)
            if maps.is_cuda and maps.ndim == 4:
                maps = maps.contiguous(memory_format=torch.channels_last)
            pads.append(
                self.get_submodule(name)(maps)
                .unflatten(0, channels.shape[:2])
                .flatten(1)
            )
        pads_BD = torch.cat(pads, dim=1)
        return self.out(F.gelu(self.hidden(pads_BD))).unflatten(1, self.token_shape)


def scales(readings: Tensor, gain_per_count: float | None) -> tuple[Tensor, Tensor]:
    """Normalised readings of any shape in the two scales of the module's table, logarithmic and linear, of the same shape.
    ``gain_per_count``: as in ``TouchInput``."""
    if gain_per_count is None:
        counts, limit = readings * _COUNTS_PER_DEVIATION, _LINEAR_LIMITS[1]
        return counts.sign() * (counts.abs() / _LOG_COUNTS).log1p(), (
            counts / _LINEAR_COUNTS
        ).clamp(-limit, limit)
    counts = readings / gain_per_count
    return (counts.clamp(min=0) / _LOG_COUNTS).log1p(), (counts / _LINEAR_COUNTS).clamp(
        *_LINEAR_LIMITS
    )


def _network(cells: tuple[int, ...], channels: int) -> nn.Sequential:
    """From (N, channels, *cells) of a vector or a grid of rows and columns to (N, _PAD_WIDTH)."""
    if len(cells) == 1:
        layers = [
            nn.Flatten(),
            nn.Linear(channels * cells[0], _PAD_WIDTH),
            nn.ReLU(),
            nn.Linear(_PAD_WIDTH, _PAD_WIDTH),
        ]
        return nn.Sequential(*layers, nn.ReLU())
    first, second, third = _CHANNELS
    return nn.Sequential(
        nn.Conv2d(channels, first, 3, padding=1),
        NormReLU(first),
        nn.Conv2d(first, second, 3, _STRIDE, padding=1),
        NormReLU(second),
        nn.Conv2d(second, third, 3, _STRIDE, padding=1),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(third * math.prod(_shrunk(_shrunk(n)) for n in cells), _PAD_WIDTH),
        nn.ReLU(),
    )


def _shrunk(cells: int) -> int:
    return (cells - 1) // _STRIDE + 1


class TouchIntoContext(nn.Module):
    """Cross-attention that adds touch to the base context, CrossAttn of the paper's eq. 6. Its output is zero until training
    changes it."""

    def __init__(self, width: int, heads: int = 8, inner: int = 512) -> None:
        """``width``: D of context and touch tokens. ``inner``: width of queries, keys and values, at most ``width``."""
        super().__init__()
        inner = min(inner, width)
        self.heads = heads
        self.norm_context, self.norm_touch = nn.LayerNorm(width), nn.LayerNorm(width)
        self.query, self.key, self.value = (nn.Linear(width, inner) for _ in range(3))
        self.out = nn.Linear(inner, width)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(
        self, context_BTD: torch.Tensor, touch_BMD: torch.Tensor
    ) -> torch.Tensor:
        """Contribution (B, T, D) of touch, to be added to the context."""
        context = self.norm_context(context_BTD)
        touch = self.norm_touch(touch_BMD)
        q, k, v = (
            linear(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for linear, x in (
                (self.query, context),
                (self.key, touch),
                (self.value, touch),
            )
        )
        return self.out(
            F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        )


class Fusion(nn.Module):
    """What all inputs determine together: where the parts are follows from pictures, touch and joint angles only in combination.
    Its output is added to the condition of all layers of the action expert, which otherwise is the time of the flow alone, and
    the pose head reads it."""

    def __init__(self, num_inputs: int, width: int, condition_width: int) -> None:
        """``num_inputs``: size of all inputs but touch together. ``width``: F of the output. ``condition_width``: C of the action
        expert's condition."""
        super().__init__()
        self.width = width
        self.inputs = nn.Linear(num_inputs, width)
        self.layers = nn.Sequential(
            nn.LayerNorm(width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, width),
        )
        self.condition = nn.Linear(width, condition_width)

    def forward(self, tokens: list[Tensor], touch_BF: Tensor | None) -> Tensor:
        """Compute the output (B, F) of tokens (B, M, D) of any number and width, in float32; ``touch_BF`` is added to the first
        layer."""
        hidden_BF = self.inputs(
            torch.cat([x.flatten(1).to(torch.float32) for x in tokens], dim=1)
        )
        return self.layers(hidden_BF if touch_BF is None else hidden_BF + touch_BF)


class StateToken(nn.Module):
    """The normalised state as one token: sines and cosines with ½ … 8 periods over each joint's range, and a hidden layer.
    Without the sines and cosines small differences have too little influence: with them the errors of a chunk are a fifth
    smaller after 128 thousand rows (one training each)."""

    _OCTAVES = 5
    _LIMIT = 4.0  # a joint that stands still in all of the data has no range: whatever it does is large

    def __init__(self, state_dim: int, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(state_dim * (1 + 2 * self._OCTAVES), 2 * width)
        self.out = nn.Linear(2 * width, width)

    def forward(self, state_BS: Tensor) -> Tensor:
        """Encode normalised states (B, S), mostly within −1 … 1, into tokens (B, 1, width)."""
        state_BS = state_BS.clamp(-self._LIMIT, self._LIMIT)
        half_turns = math.pi * 2.0 ** torch.arange(
            self._OCTAVES, device=state_BS.device
        )
        waves_BSO = state_BS[:, :, None] * half_turns
        told = torch.cat(
            [state_BS, waves_BSO.sin().flatten(1), waves_BSO.cos().flatten(1)], dim=1
        )
        return self.out(F.gelu(self.hidden(told.to(self.hidden.weight.dtype))))[:, None]
