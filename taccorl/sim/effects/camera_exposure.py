"""Camera exposure: pictures are brighter, darker, greyer or softer than the twin's."""

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from scipy.special import ndtr

from taccorl.sim.effects import effects
from taccorl.sim.effects.camera_effect import CameraEffect
from taccorl.sim.effects.effect import parameter


@effects.register("camera_exposure")
@dataclass(kw_only=True)
class CameraExposure(CameraEffect):
    """Exposure, gamma and blur of a camera: y = (g·x)^γ for values x in 0 … 1, clipped at 1, then blurred by a Gaussian of σ
    pixels of the recorded stream."""

    name: ClassVar = "camera_exposure"
    equation: ClassVar = "y = G_σ * min(1, (g·x)^γ)"
    in_words: ClassVar = (
        "The camera's exposure, gamma and focus are others than the model's, which has none: brightness, contrast and "
        "sharpness of the whole picture differ."
    )
    at_a_policy: ClassVar = (
        "What it knows by brightness or fine edges it no longer recognises; image randomisation covers some of it."
    )
    to_record: ClassVar = (
        "Pictures of arms at rest under the light of the bench, after the camera's pose has been fitted."
    )
    gain: float = parameter(
        unit="1",
        symbol="g",
        absent=1.0,
        low=0.3,
        high=3.0,
        typical=1.3,
        source="brightness of the paper's App. E: 0.7 … 1.3",
    )
    gamma: float = parameter(unit="1", symbol="γ", absent=1.0, low=0.4, high=2.5, typical=1.2, source="a choice")
    blur_px: float = parameter(
        unit="px", symbol="σ", absent=0.0, low=0.0, high=8.0, typical=1.0, source="a choice: one pixel out of focus"
    )

    def picture(self, picture: np.ndarray, scale: float) -> np.ndarray:
        if self.gain != 1.0 or self.gamma != 1.0:
            picture = toned(picture, self.gain, self.gamma)
        return blurred(picture, self.blur_px * scale)


def toned(picture: np.ndarray, gain: float, gamma: float) -> np.ndarray:
    """``picture`` (rows, columns, 3), values x in 0 … 255, as y = 255·min(1, (g·x/255)^γ) with ``gain`` g and ``gamma`` γ;
    same shape.
    """
    return 255.0 * np.minimum((gain / 255.0) * picture, 1.0) ** gamma


def blurred(picture: np.ndarray, sigma_px: float) -> np.ndarray:
    """``picture`` (rows, columns, 3) blurred by a Gaussian of the standard deviation ``sigma_px`` [pixels], same shape. Beyond
    the border its border pixels are repeated. Widths near 0 change the picture continuously.
    """
    if sigma_px <= 0:
        return picture
    reach = max(1, int(np.ceil(4 * sigma_px)))
    # The share of the Gaussian that falls on each pixel: a sampled one would be nothing below a third of a pixel.
    ends = np.arange(-reach - 0.5, reach + 1)
    weights = np.diff(ndtr(ends / sigma_px))
    weights /= weights.sum()
    return cv2.sepFilter2D(picture, -1, weights, weights, borderType=cv2.BORDER_REPLICATE)
