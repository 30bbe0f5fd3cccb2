"""Effects of cameras: mount, latency, exposure."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np
from scipy.special import ndtr

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.cameras import CameraOffset, offset_pose
from taccorl.sim.effects.effect import Effect, Kind, effect, number

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

_TURN = {
    "bounds": (-0.35, 0.35),
    "source": "a choice: a bracket screwed on by hand; the paper aligns small pose offsets (App. B.3)",
}
_SHIFT = {
    "bounds": (-0.15, 0.15),
    "source": "a choice: hand-eye measurement with a ruler",
}


@dataclass(kw_only=True)
class CameraEffect(Effect):
    """Base of effects on pictures, with the same parameters for all chosen cameras. Cameras with different parameters need one
    entry each."""

    needs: ClassVar = ("picture",)
    cameras: list[str] = field(default_factory=lambda: list(ROBOT.cameras))
    """Names of cameras, as in the twin's ``cameras``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise TaccorlError(
                f"effect {self.name}: cameras are {self.cameras}; name at least one, each once"
            )

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        return ("camera",)

    def acts_on(self) -> list[str]:
        return list(self.cameras)

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        known = [camera.name for camera in config.cameras]
        for name in self.cameras:
            if name not in known:
                raise TaccorlError(
                    f"effect {self.name}: the twin has no camera {name!r}; {nearest(name, known)}"
                )


@effect("camera_exposure", slot="camera")
class CameraExposure(CameraEffect):
    """Exposure, gamma and blur of a camera: y = (g·x)^γ for values x in 0 … 1, clipped at 1, then blurred by a Gaussian of σ
    pixels of the recorded stream."""

    gain: float = number(
        "g", "1", 1, 1.3, (0.3, 3), "brightness of the paper's App. E: 0.7 … 1.3"
    )
    gamma: float = number("γ", "1", 1, 1.2, (0.4, 2.5))
    blur_px: float = number("σ", "px", 0, 1, (0, 8), "a choice: one pixel out of focus")

    def picture(self, picture: np.ndarray, scale: float) -> np.ndarray:
        if self.gain != 1.0 or self.gamma != 1.0:
            picture = toned(picture, self.gain, self.gamma)
        return blurred(picture, self.blur_px * scale)


def toned(picture: np.ndarray, gain: float, gamma: float) -> np.ndarray:
    """``picture`` (rows, columns, 3), values x in 0 … 255, as y = 255·min(1, (g·x/255)^γ) with ``gain`` g and ``gamma`` γ;
    same shape."""
    return 255.0 * np.minimum((gain / 255.0) * picture, 1.0) ** gamma


def blurred(picture: np.ndarray, sigma_px: float) -> np.ndarray:
    """``picture`` (rows, columns, 3) blurred by a Gaussian of the standard deviation ``sigma_px`` [pixels], same shape. Beyond
    the border its border pixels are repeated. Widths near 0 change the picture continuously."""
    if sigma_px <= 0:
        return picture
    import cv2

    reach = max(1, int(np.ceil(4 * sigma_px)))
    # The share of the Gaussian that falls on each pixel: a sampled one would be nothing below a third of a pixel.
    ends = np.arange(-reach - 0.5, reach + 1)
    weights = np.diff(ndtr(ends / sigma_px))
    weights /= weights.sum()
    return cv2.sepFilter2D(
        picture, -1, weights, weights, borderType=cv2.BORDER_REPLICATE
    )


@effect("camera_latency", slot="camera")
class CameraLatency(CameraEffect):
    """Latency of a camera: the picture at time t shows the scene at t − d. Before the reset the scene counts as at rest."""

    delay_s: float = number(
        "d",
        "s",
        0,
        0.05,
        (0, 0.3),
        "a choice: one to two frames at 30 Hz, as USB cameras have",
    )

    def picture_age_s(self) -> float:
        return self.delay_s


@effect("camera_pose", slot="camera")
class CameraPose(CameraEffect):
    """Error of a camera's mount: R = R₀·exp(ω), p = p₀ + R₀·t in the camera's own frame (x right, y up, z back), as in
    ``CameraOffset``."""

    turn_x_rad: float = number("ω_x", "rad", 0, 0.02, **_TURN)
    turn_y_rad: float = number("ω_y", "rad", 0, 0.02, **_TURN)
    turn_z_rad: float = number("ω_z", "rad", 0, 0.02, **_TURN)
    shift_x_m: float = number("t_x", "m", 0, 0.01, **_SHIFT)
    shift_y_m: float = number("t_y", "m", 0, 0.01, **_SHIFT)
    shift_z_m: float = number("t_z", "m", 0, 0.01, **_SHIFT)

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        super().edit(spec, config)
        offset = CameraOffset(
            rotation_rad=(self.turn_x_rad, self.turn_y_rad, self.turn_z_rad),
            translation_m=(self.shift_x_m, self.shift_y_m, self.shift_z_m),
        )
        for name in self.cameras:
            camera = spec.camera(name)
            camera.pos, camera.quat = offset_pose(camera.pos, camera.quat, offset)
