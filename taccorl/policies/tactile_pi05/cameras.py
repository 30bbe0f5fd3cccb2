"""Tokens of pictures for a policy that is trained from scratch: a small residual network for each camera.

    features = residual blocks(convolution of 7 × 7, stride 4 (picture))      a quarter, then an eighth of the picture's side
    (x, y)   = Σ softmax(sharpness · map) · position                          of each of K maps, −1 … 1 over the picture
    tokens   = MLP(x, y, sines and cosines of π · {1, 2, 4} of each; mean of the features)

The mean of positions, weighted by a softmax, is the spatial softmax of Levine et al. 2016, End-to-End Training of Deep Visuomotor
Policies, §4.1: it locates objects to a fraction of a cell. Norms are of groups of channels (GroupNorm), which do not depend on
the
batch: an average of weights (``averaged``) stays valid.
"""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# B batch, R rows, C columns, K maps, M tokens, D width
_CHANNELS_PER_GROUP = 16
_OCTAVES = 3
_SHARPNESS = 3.0  # to begin with


def _norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(max(1, channels // _CHANNELS_PER_GROUP), channels)


class Residual(nn.Module):
    """Residual block: two 3 × 3 convolutions whose output is added to the input, as in ResNet-18."""

    def __init__(self, channels: int, more: int, stride: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, more, 3, stride, padding=1, bias=False),
            _norm(more),
            nn.ReLU(),
            nn.Conv2d(more, more, 3, padding=1, bias=False),
            _norm(more),
        )
        same = channels == more and stride == 1
        self.beside = nn.Identity() if same else nn.Conv2d(channels, more, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``x`` (B, K, R, C) → maps with the block's number of channels; rows and columns are divided by its stride."""
        return F.relu(self.body(x) + self.beside(x))


class CameraEncoder(nn.Module):
    """Encodes pictures (B, 3, R, C) of one camera into tokens (B, M, D). Letters: B batch, M tokens of a picture, D width of a
    token.
    """

    def __init__(self, channels: tuple[int, ...], num_points: int, num_tokens: int, width: int) -> None:
        """
        Args:
            channels: number of channels after the first convolution, and of each block; the second block halves the picture's
                side.
            num_points: K, number of maps.
            num_tokens: M, number of tokens per picture.
            width: D, width of a token.
        """
        super().__init__()
        self.num_tokens = num_tokens
        first, *others = channels
        layers: list[nn.Module] = [nn.Conv2d(3, first, 7, 4, padding=3, bias=False), _norm(first), nn.ReLU()]
        for block, more in enumerate(others):
            layers.append(Residual(first, more, 2 if block == 1 else 1))
            first = more
        self.features = nn.Sequential(*layers)
        self.maps = nn.Conv2d(first, num_points, 1)
        self.sharpness = nn.Parameter(torch.ones(num_points))  # times _SHARPNESS
        self.hidden = nn.Linear(2 * num_points * (1 + 2 * _OCTAVES) + first, width)
        self.out = nn.Linear(width, num_tokens * width)

    def points(self, maps_BKRC: Tensor) -> Tensor:
        """Positions (B, 2K) of the maxima of the K maps by spatial softmax: all x, to the right, then all y, downwards; −1 …
        1.
        """
        maps_BKRC = maps_BKRC.to(torch.float32)
        weights_BKN = (maps_BKRC.flatten(2) * (_SHARPNESS * self.sharpness)[:, None]).softmax(-1)
        weights_BKRC = weights_BKN.view_as(maps_BKRC)
        y_R, x_C = (torch.linspace(-1, 1, n, device=maps_BKRC.device) for n in maps_BKRC.shape[2:])
        return torch.cat([(weights_BKRC.sum(2) * x_C).sum(-1), (weights_BKRC.sum(3) * y_R).sum(-1)], dim=1)

    def forward(self, images_B3RC: Tensor) -> Tensor:
        """Encode ``images_B3RC`` (B, 3, R, C), −1 … 1, into tokens (B, M, D)."""
        features_BKRC = self.features(images_B3RC)
        points_BP = self.points(self.maps(features_BKRC))
        half_turns = math.pi * 2.0 ** torch.arange(_OCTAVES, device=points_BP.device)
        waves_BPO = points_BP[:, :, None] * half_turns
        told = [points_BP, waves_BPO.sin().flatten(1), waves_BPO.cos().flatten(1), features_BKRC.mean((2, 3))]
        return self.out(F.gelu(self.hidden(torch.cat(told, dim=1)))).unflatten(1, (self.num_tokens, -1))


def encode_pictures(camera: nn.Module, images_B3RC: Tensor) -> Tensor:
    """Encode pictures of one camera as tokens for the language model.

    Args:
        images_B3RC: (B, 3, R, C) RGB pictures.

    Returns:
        (B, M, D): M tokens of D numbers for each of the B pictures.
    """
    return camera(images_B3RC)


class CameraTower(nn.Module):
    """One ``CameraEncoder`` per camera, without shared weights: wrist cameras and the fixed camera show different views."""

    def __init__(
        self, num_cameras: int, channels: tuple[int, ...], num_points: int, num_tokens: int, width: int
    ) -> None:
        super().__init__()
        self.cameras = nn.ModuleList(CameraEncoder(channels, num_points, num_tokens, width) for _ in range(num_cameras))

    def forward(
        self, images: list[Tensor], encode: Callable[[nn.Module, Tensor], Tensor] = encode_pictures
    ) -> list[Tensor]:
        """Return the tokens (B, M, D) of each camera's pictures; ``images`` holds (B, 3, R, C), −1 … 1, for each camera in the
        order of the policy's features.

        Args:
            encode: ``encode_pictures``, or its compiled form.
        """
        return [encode(camera, image) for camera, image in zip(self.cameras, images, strict=True)]
