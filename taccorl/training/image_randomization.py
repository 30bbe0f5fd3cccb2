"""The image rows of the paper's domain randomisation (App. E): crop-resize, rotation, brightness, contrast, saturation.

They are those of π0.5's own training (its App. E). openpi's code turns and crops only the fixed camera and gives wrist
cameras the colours alone; the paper says "camera" without exception, so every image gets every row here.
"""

import math
from dataclasses import dataclass

import torch
from torch import nn
from torchvision.transforms import v2

from taccorl.errors import TaccorlError

COTRAINING_NOISE_STD = 0.03  # σ_v, paper's co-training table; images in [0, 1]


@dataclass(kw_only=True)
class ImageRandomizationConfig:
    """How far an image may be changed. Every row applies to every image (the paper's probability is 1.0)."""

    crop: float = 0.95
    """f_crop: side of the random crop as a part of the image's side; scaled back to full size. 1: absent."""
    rotation_deg: float = 5.0
    """Δθ ~ U(±this), about the middle; corners that come in are black. 0: absent."""
    brightness: tuple[float, float] = (0.7, 1.3)
    """j_b ~ U(range): image · j_b. (1, 1): absent."""
    contrast: tuple[float, float] = (0.6, 1.4)
    """j_c ~ U(range): distance from the image's mean grey · j_c. (1, 1): absent."""
    saturation: tuple[float, float] = (0.5, 1.5)
    """j_s ~ U(range): distance of each pixel from its own grey · j_s. (1, 1): absent."""
    noise_std: float = 0.0
    """Normal noise on every value, after all else: 0.03 (σ_v) in the paper's co-training, none in its randomisation."""

    def __post_init__(self) -> None:
        if not 0 < self.crop <= 1:
            raise TaccorlError(f"image randomisation: crop is {self.crop}; a part of the side, above 0 and at most 1")
        if not 0 <= self.rotation_deg <= 180:
            raise TaccorlError(f"image randomisation: rotation_deg is {self.rotation_deg}; 0 … 180 in either direction")
        if not 0 <= self.noise_std < math.inf:
            raise TaccorlError(f"image randomisation: noise_std is {self.noise_std}; 0 or more")
        for row in ("brightness", "contrast", "saturation"):
            low, high = getattr(self, row)
            if not 0 <= low <= high < math.inf:
                raise TaccorlError(
                    f"image randomisation: {row} is ({low}, {high}); factors, the lower first, none negative"
                )

    def build(self) -> "ImageRandomization":
        """The transform itself; LeRobot takes it as a dataset's ``image_transforms``."""
        return ImageRandomization(self)


class ImageRandomization(nn.Module):
    """Draws anew for each image, from torch's global generator (``torch.manual_seed``)."""

    def __init__(self, config: ImageRandomizationConfig) -> None:
        super().__init__()
        self.config = config
        rows: list[nn.Module] = []
        if config.rotation_deg:
            rows.append(
                v2.RandomRotation(
                    [-config.rotation_deg, config.rotation_deg], interpolation=v2.InterpolationMode.BILINEAR
                )
            )
        rows.append(v2.ColorJitter(config.brightness, config.contrast, config.saturation))
        if config.noise_std:
            rows.append(v2.GaussianNoise(sigma=config.noise_std))
        self.rows = nn.Sequential(*rows)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Images (…, 3, rows, columns) of float in [0, 1] → the same shape; each of the leading ones is drawn for itself.

        Raises:
            TaccorlError: another type or number of channels.
        """
        if not images.is_floating_point() or images.ndim < 3 or images.shape[-3] != 3:
            raise TaccorlError(
                f"image randomisation: images are {images.dtype} {tuple(images.shape)}; (…, 3, rows, columns) of float in "
                "[0, 1] are changed: divide counts by 255, move colours to the front"
            )
        crop = self._crop(*images.shape[-2:])
        flat = images.reshape(-1, *images.shape[-3:])
        return torch.stack([self.rows(crop(image)) for image in flat]).reshape(images.shape) if len(flat) else images

    def _crop(self, rows: int, columns: int) -> nn.Module:
        """Whole pixels, rounded down as openpi does: 212 of 224."""
        size = max(1, int(self.config.crop * rows)), max(1, int(self.config.crop * columns))
        if size == (rows, columns):
            return nn.Identity()
        return nn.Sequential(v2.RandomCrop(size), v2.Resize((rows, columns), antialias=True))
