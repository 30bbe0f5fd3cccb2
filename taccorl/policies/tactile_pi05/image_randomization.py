"""The image rows of the paper's domain randomisation (App. E): crop-resize, rotation, brightness, contrast, saturation.

They are those of π0.5's own training (its App. E). openpi's code rotates and crops only the fixed camera and changes only the
colours of wrist cameras; the paper says "camera" without exception, so that here every row applies to every image.

The result is that of torchvision's RandomCrop, Resize, RandomRotation and ColorJitter, computed for a whole batch on its device,
with two differences: crop and rotation are one sampling instead of two, which blurs less (0.001 off on a picture without edges),
and the seam of the black corners is as bright as its share of the picture, not the square of it.

Three users: training draws for each image (``forward``); rollouts draw for each scene and camera (``scene_pictures``); a policy
in use takes the middle crop of the size of training (``middle``). All change pictures at the policy's resolution.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, repeat
from typing import Any

import torch
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample
from torchvision.transforms.v2.functional import rgb_to_grayscale

from taccorl.errors import TaccorlError

# N images, R rows, C columns
COTRAINING_NOISE_STD = 0.03  # σ_v, paper's co-training table; images in [0, 1]
PICTURES_CHANGED = "observation.pictures_changed"
"""Key of a batch, (B,) bool: its pictures have been changed and cropped already (``scene_pictures``). A policy takes no middle
crop of them."""
NUM_DRAWS = 7
"""Random numbers of an image, 0 … 1: place of the crop (down, right), angle, brightness, contrast, saturation, their order."""
_ORDERS = tuple(permutations(range(3)))  # of brightness, contrast and saturation


@dataclass(kw_only=True)
class ImageRandomizationConfig:
    """Ranges from which crop, rotation, brightness, contrast and saturation of training images are drawn. Every image gets all
    of these changes (the paper's probability is 1.0)."""

    crop: float = 0.95
    """f_crop: side of the random crop relative to the image's side; the crop is scaled back to full size. 1: no crop."""
    rotation_deg: float = 5.0
    """Δθ ~ U(±this) [degrees]: rotation about the middle; corners become black. 0: no rotation."""
    brightness: tuple[float, float] = (0.7, 1.3)
    """j_b ~ U(range): factor on the image. (1, 1): no change."""
    contrast: tuple[float, float] = (0.6, 1.4)
    """j_c ~ U(range): factor on the difference from the image's mean grey. (1, 1): no change."""
    saturation: tuple[float, float] = (0.5, 1.5)
    """j_s ~ U(range): factor on the difference of each pixel from its own grey. (1, 1): no change."""
    noise_std: float = 0.0
    """Standard deviation of normal noise on every value in [0, 1], added last: 0.03 (σ_v) in the paper's co-training, 0 in its
    randomisation."""

    def __post_init__(self) -> None:
        for row, is_right, right in (
            ("crop", 0 < self.crop <= 1, "a share of the side, above 0 and at most 1"),
            ("rotation_deg", 0 <= self.rotation_deg <= 180, "0 … 180"),
            ("noise_std", 0 <= self.noise_std < math.inf, "0 or more"),
        ):
            if not is_right:
                raise TaccorlError(
                    f"image randomisation: {row} is {getattr(self, row)}; give {right}"
                )
        for row in ("brightness", "contrast", "saturation"):
            low, high = getattr(self, row)
            if not 0 <= low <= high < math.inf:
                raise TaccorlError(
                    f"image randomisation: {row} is ({low}, {high}); give two factors ≥ 0, the lower first"
                )

    @classmethod
    def absent(cls, **rows: Any) -> "ImageRandomizationConfig":
        """Configuration without any change except those of the given fields."""
        one = (1.0, 1.0)
        return cls(
            **{
                "crop": 1.0,
                "rotation_deg": 0.0,
                "brightness": one,
                "contrast": one,
                "saturation": one,
                **rows,
            }
        )

    def __str__(self) -> str:
        rows = [f"crop {100 * self.crop:g} %", f"rotation ± {self.rotation_deg:g}°"]
        for row in ("brightness", "contrast", "saturation"):
            low, high = getattr(self, row)
            rows.append(f"{row} {low:g} … {high:g}")
        return ", ".join([*rows, f"noise {self.noise_std:g}"])

    def build(self) -> "ImageRandomization":
        """Build the transform; LeRobot also accepts it as a dataset's ``image_transforms``."""
        return ImageRandomization(self)


class ImageRandomization(nn.Module):
    """Random changes of images, drawn for each image from torch's global generator (``torch.manual_seed``)."""

    def __init__(self, config: ImageRandomizationConfig) -> None:
        super().__init__()
        self.config = config

    @torch.no_grad()
    def forward(self, images: Tensor) -> Tensor:
        """Images (…, 3, rows, columns) of float in [0, 1] → the same shape; random numbers are drawn for each image separately.
        Raises TaccorlError: images are of another type or number of channels."""
        flat = _flat(images)
        if not len(flat):
            return images
        changed = torch.cat(
            [self._changed(part, *self._draw(part)) for part in _parts(flat)]
        )
        return changed.reshape(images.shape).to(images.dtype)

    @torch.no_grad()
    def with_draws(
        self, images_N3RC: Tensor, draws_7N: Tensor, noise_N3RC: Tensor | None = None
    ) -> Tensor:
        """As ``forward``, with given random numbers; returns (N, 3, R, C) float32. ``draws_7N``: ``NUM_DRAWS`` uniform numbers
        0 … 1 of each image; 0.5: middle crop, no rotation. ``noise_N3RC``: standard normal numbers, overwritten; None: no
        noise."""
        flat = _flat(images_N3RC)
        if not len(flat):
            return flat
        noise = repeat(None) if noise_N3RC is None else _parts(noise_N3RC)
        parts = zip(
            _parts(flat),
            draws_7N.split(1 if _one_by_one(flat) else len(flat), dim=1),
            noise,
            strict=False,
        )
        return torch.cat([self._changed(*part) for part in parts])

    @torch.no_grad()
    def middle(self, images: Tensor) -> Tensor:
        """The middle crop of images (…, 3, rows, columns), back at full size: ``forward`` without rotation, with the crop in
        the middle and with the colours as they are. The same tensor if ``crop`` is 1. Raises TaccorlError: as ``forward``."""
        if self.config.crop == 1:
            return images
        flat = _flat(images)
        return (
            self._cut_and_turned(flat, *flat.new_full((3, len(flat)), 0.5))
            .reshape(images.shape)
            .to(images.dtype)
        )

    @torch.no_grad()
    def of_cameras(self, cameras: Sequence[Tensor]) -> list[Tensor]:
        """Images (B, 3, rows, columns) of several cameras, each as ``forward`` changes them one camera after the other; returns
        one tensor of the same shape for each. On a GPU, images of one size are computed together: in a third of the kernels
        for three cameras, with the same random numbers. Raises TaccorlError: as ``forward``."""
        sizes = {images.shape[-2:] for images in cameras}
        if len(sizes) != 1 or any(
            images.device.type == "cpu" or not len(images) for images in cameras
        ):
            return [self(images) for images in cameras]
        return self._together(cameras)

    def _together(self, cameras: Sequence[Tensor]) -> list[Tensor]:
        flat = [_flat(images) for images in cameras]
        draws, noise = zip(*(self._draw(images) for images in flat), strict=True)
        joined_noise = None if noise[0] is None else torch.cat(noise)
        changed = self._changed(
            torch.cat(flat), torch.cat(draws, dim=1), joined_noise
        ).split([len(x) for x in flat])
        return [
            new.reshape(old.shape).to(old.dtype)
            for new, old in zip(changed, cameras, strict=True)
        ]

    def _draw(self, images_N3RC: Tensor) -> tuple[Tensor, Tensor | None]:
        """(7, N) numbers 0 … 1, and normal noise of the images' shape if there is any."""
        draws_7N = torch.rand(NUM_DRAWS, len(images_N3RC), device=images_N3RC.device)
        return draws_7N, torch.randn_like(
            images_N3RC
        ) if self.config.noise_std else None

    def _changed(
        self, images_N3RC: Tensor, draws_7N: Tensor, noise_N3RC: Tensor | None
    ) -> Tensor:
        config = self.config
        if config.crop < 1 or config.rotation_deg:
            images_N3RC = self._cut_and_turned(images_N3RC, *draws_7N[:3])
        colours = (config.brightness, config.contrast, config.saturation)
        if any(row != (1, 1) for row in colours):
            factors = [
                low + (high - low) * draw
                for (low, high), draw in zip(colours, draws_7N[3:6], strict=True)
            ]
            images_N3RC = _jittered(
                images_N3RC, torch.stack(factors), (draws_7N[6] * len(_ORDERS)).long()
            )
        if noise_N3RC is not None:
            images_N3RC = (
                noise_N3RC.mul_(config.noise_std).add_(images_N3RC).clamp_(0, 1)
            )
        return images_N3RC

    def _cut_and_turned(
        self, images_N3RC: Tensor, down_N: Tensor, right_N: Tensor, turn_N: Tensor
    ) -> Tensor:
        """Crops of whole pixels, rounded down as openpi does (212 of 224), back at full size, turned about the middle. The draws
        are from 0 to 1."""
        rows, columns = images_N3RC.shape[-2:]
        height, width = (
            max(1, int(self.config.crop * rows)),
            max(1, int(self.config.crop * columns)),
        )
        angle_N11 = torch.deg2rad(self.config.rotation_deg * (2 * turn_N - 1))[
            :, None, None
        ]
        u_1C = (
            torch.arange(columns, device=images_N3RC.device)[None] - (columns - 1) / 2
        )
        v_R1 = torch.arange(rows, device=images_N3RC.device)[:, None] - (rows - 1) / 2
        # Where each pixel comes from, counted from the middle: that of the crop is that of the picture.
        u_NRC = angle_N11.cos() * u_1C - angle_N11.sin() * v_R1
        v_NRC = angle_N11.cos() * v_R1 + angle_N11.sin() * u_1C
        seen_NRC = _inside(u_NRC, columns).mul_(_inside(v_NRC, rows))
        left_N11 = (right_N * (columns - width + 1)).floor()[:, None, None]
        top_N11 = (down_N * (rows - height + 1)).floor()[:, None, None]
        grid_NRC2 = torch.stack(
            [
                _sampled_at(u_NRC, width, columns, left_N11),
                _sampled_at(v_NRC, height, rows, top_N11),
            ],
            dim=-1,
        )
        sampled_N3RC = grid_sample(
            images_N3RC, grid_NRC2, padding_mode="border", align_corners=False
        )
        return sampled_N3RC.mul_(seen_NRC[:, None])


def at_resolution(images: Tensor, resolution: tuple[int, int]) -> Tensor:
    """Images (N, 3, R, C) of float at ``resolution`` (rows, columns), resized as LeRobot's pi05 does, with black bars if the
    shape differs."""
    if (
        tuple(images.shape[-2:]) == tuple(resolution)
        or images.ndim != 4
        or images.shape[1] != 3
    ):  # see ``_flat``
        return images
    return resize_with_pad_torch(images.to(torch.float32), *resolution)


def _one_by_one(images_N3RC: Tensor) -> bool:
    """A CPU's cache holds one image, a GPU wants them all at once."""
    return images_N3RC.device.type == "cpu"


def _parts(images_N3RC: Tensor) -> Sequence[Tensor]:
    return images_N3RC.split(1) if _one_by_one(images_N3RC) else [images_N3RC]


def _flat(images: Tensor) -> Tensor:
    """(N, 3, R, C) float32 of images (…, 3, R, C). Raises TaccorlError: images are of another type or number of channels."""
    if not images.is_floating_point() or images.ndim < 3 or images.shape[-3] != 3:
        raise TaccorlError(
            f"image randomisation: images are {images.dtype} {tuple(images.shape)}; (…, 3, rows, columns) of float in [0, 1] "
            "are required: divide the values by 255, and move the colour axis to the front"
        )
    return images.reshape(-1, *images.shape[-3:]).to(torch.float32)


def _inside(from_middle: Tensor, size: int) -> Tensor:
    """Share of a pixel that lies on a picture of ``size`` pixels; beyond there is black."""
    return ((size + 1) / 2 - from_middle.abs()).clamp_(0, 1)


def _sampled_at(from_middle: Tensor, cut: int, size: int, start: Tensor) -> Tensor:
    """In a picture of ``size`` pixels, −1 to 1 from edge to edge, for a crop of ``cut`` pixels from ``start`` on.

    Within half a pixel of the crop's edge it is the edge's own colour, as in torchvision's resize."""
    pixel = (from_middle * (cut / size)).clamp_((1 - cut) / 2, (cut - 1) / 2)
    return pixel.mul_(2 / size).add_((2 * start + cut) / size - 1)


def _jittered(images_N3RC: Tensor, factors_3N: Tensor, orders_N: Tensor) -> Tensor:
    """Brightness, contrast and saturation in an order of each image's own: image · f + (1 − f) · (0, mean grey, grey)."""
    orders_3N = torch.tensor(_ORDERS, device=orders_N.device)[orders_N].T
    images_N3RC = images_N3RC.clone()
    for which_N in orders_3N:
        factor_N111 = factors_3N.gather(0, which_N[None])[0][:, None, None, None]
        grey_N1RC = rgb_to_grayscale(images_N3RC)
        is_contrast, is_saturation = (
            (which_N == 1)[:, None, None, None],
            (which_N == 2)[:, None, None, None],
        )
        base_N1RC = is_saturation * grey_N1RC + is_contrast * grey_N1RC.mean(
            dim=(-2, -1), keepdim=True
        )
        images_N3RC.mul_(factor_N111).add_(base_N1RC.mul_(1 - factor_N111)).clamp_(0, 1)
    return images_N3RC
