"""Pictures as key points: what tiny sees with, as its patches learn too slowly for a CPU.

    maps = convolutions(picture)                        one for each key point
    (x, y) = Σ softmax(sharpness · map) · position      where it is, −1 … 1 over the picture
    tokens = MLP(x, y, and sines and cosines of π · {1, 2, 4} of each)

The mean of positions, weighed by a softmax, is the spatial softmax of Levine et al. 2016, End-to-End Training of Deep Visuomotor
Policies, §4.1. What passes is mostly places: hardly colours, or how many there are of a thing.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# B batch, R rows, C columns, K key points, M tokens, D width
_CHANNELS = (16, 32, 32)
_STRIDES = (2, 2, 1)
_GROUPS = 4
_HIDDEN = 256
_OCTAVES = 3
_SHARPNESS = 3.0  # to begin with


class KeypointCamera(nn.Module):
    """Tokens of one camera's pictures."""

    def __init__(self, num_points: int, num_tokens: int, width: int) -> None:
        """
        Args:
            num_points: K, key points.
            num_tokens: M.
            width: D.
        """
        super().__init__()
        self.num_tokens = num_tokens
        layers: list[nn.Module] = []
        channels = 3
        for more, stride in zip(_CHANNELS, _STRIDES, strict=True):
            layers += [nn.Conv2d(channels, more, 3, stride, padding=1), nn.GroupNorm(_GROUPS, more), nn.GELU()]
            channels = more
        self.maps = nn.Sequential(*layers, nn.Conv2d(channels, num_points, 1))
        self.sharpness = nn.Parameter(torch.ones(num_points))  # times _SHARPNESS
        self.hidden = nn.Linear(2 * num_points * (1 + 2 * _OCTAVES), _HIDDEN)
        self.out = nn.Linear(_HIDDEN, num_tokens * width)

    def points(self, images_B3RC: Tensor) -> Tensor:
        """(B, 2K) where the key points are: all x, to the right, then all y, downwards; −1 … 1 from edge cell to edge cell."""
        maps_BKRC = self.maps(images_B3RC)
        weights_BKN = (maps_BKRC.flatten(2) * (_SHARPNESS * self.sharpness)[:, None]).softmax(-1)
        weights_BKRC = weights_BKN.view_as(maps_BKRC)
        y_R, x_C = (torch.linspace(-1, 1, n, device=maps_BKRC.device) for n in maps_BKRC.shape[2:])
        return torch.cat([(weights_BKRC.sum(2) * x_C).sum(-1), (weights_BKRC.sum(3) * y_R).sum(-1)], dim=1)

    def forward(self, images_B3RC: Tensor) -> Tensor:
        """(B, 3, R, C), −1 … 1 → (B, M, D)."""
        points_BP = self.points(images_B3RC)
        half_turns = math.pi * 2.0 ** torch.arange(_OCTAVES, device=points_BP.device)
        waves_BPO = points_BP[:, :, None] * half_turns
        told = torch.cat([points_BP, waves_BPO.sin().flatten(1), waves_BPO.cos().flatten(1)], dim=1)
        return self.out(F.gelu(self.hidden(told))).unflatten(1, (self.num_tokens, -1))


class KeypointTower(nn.Module):
    """A ``KeypointCamera`` for each camera, as a wrist looks for other things than a camera above the table."""

    def __init__(self, num_cameras: int, num_points: int, num_tokens: int, width: int) -> None:
        super().__init__()
        self.cameras = nn.ModuleList(KeypointCamera(num_points, num_tokens, width) for _ in range(num_cameras))

    def forward(self, images: list[Tensor]) -> list[Tensor]:
        """(B, M, D) of each camera's (B, 3, R, C), in the order of the policy's features."""
        return [camera(image) for camera, image in zip(self.cameras, images, strict=True)]
