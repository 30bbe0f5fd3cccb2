"""Tokens of pictures for a policy that is trained from scratch: a small residual network for each camera.

    features = residual blocks(convolution of 5 × 5, stride 2 (picture))      an eighth of the picture's side
    (x, y)   = Σ softmax(sharpness · map) · position                          of each of K maps, −1 … 1 over the picture
    pooled   = linear layer(mean of the features in each of 4 × 5 cells of the picture)
    tokens   = MLP(x, y, sines and cosines of π · {1, 2, 4} of each; pooled)

The mean of positions, weighted by a softmax, is the spatial softmax of Levine et al. 2016, End-to-End Training of Deep Visuomotor
Policies, §4.1: it locates objects to a fraction of a cell. Norms are of groups of channels (GroupNorm), which do not depend on
the batch: an average of weights (``averaged``) stays valid.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from taccorl.policies.tactile_pi05.compiled import Compiled

# B batch, R rows, C columns, K maps, M tokens, D width
_CHANNELS_PER_GROUP = 16
_STEM_STRIDE = 2
_OCTAVES = 3
_SHARPNESS = 3.0  # to begin with


@dataclass(frozen=True, kw_only=True)
class CameraSize:
    """Sizes of a ``CameraEncoder``."""

    stem_channels: int
    """Number of channels after the first convolution."""
    blocks: tuple[tuple[int, int], ...]
    """Number of channels and stride of each residual block."""
    points: int
    """K: number of maps, each of which gives one point."""
    pooled_cells: tuple[int, int] = (4, 5)
    """Rows and columns of cells in which the last features are averaged."""
    pooled_width: int
    """Number of values that a linear layer makes of these averages."""
    tokens: int
    """M: number of tokens per picture."""


class NormReLU(nn.GroupNorm):
    """GroupNorm of 16 channels a group, sum with other maps, ReLU; the output has the maps' precision, also with autocast. In
    training on a GPU it is compiled: kernels for each of them took longer than the convolutions, which are not compiled (torch
    2.11 once tuned their gradient into an illegal memory access)."""

    compiles: bool = True
    compiles_updates: bool = False
    """Also outside training mode where gradients are computed, as in updates of PPO; each size of a batch is compiled anew."""

    def __init__(self, channels: int) -> None:
        super().__init__(max(1, channels // _CHANNELS_PER_GROUP), channels)

    def forward(self, x: Tensor, beside: Tensor | None = None) -> Tensor:
        """Maps (B, K, R, C), and ``beside`` of the same shape to be added before the ReLU, → maps."""
        is_compiled = (
            self.compiles
            if self.training
            else self.compiles_updates and torch.is_grad_enabled()
        )
        compute = _compiled_norm_relu if is_compiled else _norm_relu
        return compute(x, beside, self.num_groups, self.weight, self.bias)


def _norm_relu(
    x: Tensor, beside: Tensor | None, groups: int, weight: Tensor, bias: Tensor
) -> Tensor:
    normed = F.group_norm(x, groups, weight, bias)
    return F.relu(normed if beside is None else normed + beside).to(x.dtype)


_compiled_norm_relu = Compiled(_norm_relu)


class Residual(nn.Module):
    """Residual block: two 3 × 3 convolutions whose output is added to the input, as in ResNet-18."""

    def __init__(self, channels: int, more: int, stride: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, more, 3, stride, padding=1, bias=False),
            NormReLU(more),
            nn.Conv2d(more, more, 3, padding=1, bias=False),
        )
        self.out = NormReLU(more)
        same = channels == more and stride == 1
        self.beside = (
            nn.Identity() if same else nn.Conv2d(channels, more, 1, stride, bias=False)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``x`` (B, K, R, C) → maps with the block's number of channels; rows and columns are divided by its stride."""
        return self.out(self.body(x), self.beside(x))


class CameraEncoder(nn.Module):
    """Encodes pictures (B, 3, R, C) of one camera into tokens (B, M, D). Letters: B batch, M tokens of a picture, D width of a
    token."""

    def __init__(self, size: CameraSize, width: int) -> None:
        super().__init__()
        self.token_shape, self._cells = (size.tokens, width), size.pooled_cells
        first = size.stem_channels
        layers: list[nn.Module] = [
            nn.Conv2d(3, first, 5, _STEM_STRIDE, padding=2, bias=False), NormReLU(first),
        ]  # fmt: skip
        for more, stride in size.blocks:
            layers.append(Residual(first, more, stride))
            first = more
        self.features = nn.Sequential(*layers)
        self.maps = nn.Conv2d(first, size.points, 1)
        self.sharpness = nn.Parameter(torch.ones(size.points))  # times _SHARPNESS
        self.pooled = nn.Linear(first * math.prod(size.pooled_cells), size.pooled_width)
        self.hidden = nn.Linear(
            2 * size.points * (1 + 2 * _OCTAVES) + size.pooled_width, width
        )
        self.out = nn.Linear(width, size.tokens * width)

    def points(self, maps_BKRC: Tensor) -> Tensor:
        """Positions (B, 2K) of the maxima of the K maps by spatial softmax: all x, to the right, then all y, downwards; −1 …
        1."""
        maps_BKRC = maps_BKRC.to(torch.float32)
        weights_BKN = (
            maps_BKRC.flatten(2) * (_SHARPNESS * self.sharpness)[:, None]
        ).softmax(-1)
        weights_BKRC = weights_BKN.view_as(maps_BKRC)
        y_R, x_C = (
            torch.linspace(-1, 1, n, device=maps_BKRC.device)
            for n in maps_BKRC.shape[2:]
        )
        return torch.cat(
            [(weights_BKRC.sum(2) * x_C).sum(-1), (weights_BKRC.sum(3) * y_R).sum(-1)],
            dim=1,
        )

    def forward(self, images_B3RC: Tensor) -> Tensor:
        """Encode ``images_B3RC`` (B, 3, R, C), −1 … 1, into tokens (B, M, D)."""
        if (
            images_B3RC.is_cuda
        ):  # the convolutions' own layout: converted once, not in each of them
            images_B3RC = images_B3RC.contiguous(memory_format=torch.channels_last)
        features_BKRC = self.features(images_B3RC)
        points_BP = self.points(self.maps(features_BKRC))
        half_turns = math.pi * 2.0 ** torch.arange(_OCTAVES, device=points_BP.device)
        waves_BPO = points_BP[:, :, None] * half_turns
        pooled_BD = self.pooled(
            F.adaptive_avg_pool2d(features_BKRC, self._cells).flatten(1)
        )
        told = [
            points_BP,
            waves_BPO.sin().flatten(1),
            waves_BPO.cos().flatten(1),
            pooled_BD,
        ]
        return self.out(F.gelu(self.hidden(torch.cat(told, dim=1)))).unflatten(
            1, self.token_shape
        )


class CameraTower(nn.Module):
    """One ``CameraEncoder`` per camera, without shared weights: wrist cameras and the fixed camera show different views."""

    def __init__(self, num_cameras: int, size: CameraSize, width: int) -> None:
        super().__init__()
        self.cameras = nn.ModuleList(
            CameraEncoder(size, width) for _ in range(num_cameras)
        )

    def forward(self, images: list[Tensor]) -> list[Tensor]:
        """Return the tokens (B, M, D) of each camera's pictures; ``images`` holds (B, 3, R, C), −1 … 1, for each camera in the
        order of the policy's features."""
        return [
            camera(image) for camera, image in zip(self.cameras, images, strict=True)
        ]
