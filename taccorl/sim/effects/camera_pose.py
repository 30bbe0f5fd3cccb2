"""Camera pose: a camera does not sit where the twin has it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.cameras import CameraOffset, offset_pose
from taccorl.sim.effects import effects
from taccorl.sim.effects.camera_effect import CameraEffect
from taccorl.sim.effects.effect import parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

_TURN = "a choice: a bracket screwed on by hand; the paper aligns small pose offsets (App. B.3)"
_SHIFT = "a choice: hand-eye measurement with a ruler"


def _turn(symbol: str) -> float:
    return parameter(unit="rad", symbol=symbol, absent=0.0, low=-0.35, high=0.35, typical=0.02, source=_TURN)


def _shift(symbol: str) -> float:
    return parameter(unit="m", symbol=symbol, absent=0.0, low=-0.15, high=0.15, typical=0.01, source=_SHIFT)


@effects.register("camera_pose")
@dataclass(kw_only=True)
class CameraPose(CameraEffect):
    """Error of a camera's mount: R = R₀·exp(ω), p = p₀ + R₀·t in the camera's own frame (x right, y up, z back), as in
    ``CameraOffset``."""

    name: ClassVar = "camera_pose"
    equation: ClassVar = "R = R₀·exp(ω), p = p₀ + R₀·t"
    in_words: ClassVar = (
        "The camera sits a little beside where the model has it, or looks a little past: a bracket was bent, screwed on "
        "again or measured by hand."
    )
    at_a_policy: ClassVar = "It reaches beside the part by as much as the picture has moved."
    to_record: ClassVar = (
        "A dozen pictures of arms at rest in poses that differ; taccorl.alignment.camera.calibration fits it to them."
    )
    near_twins: ClassVar = {
        "camera_latency": (
            "Late pictures of a moving arm look shifted along its motion: take pictures at rest, where they are not."
        ),
    }
    turn_x_rad: float = _turn("ω_x")
    turn_y_rad: float = _turn("ω_y")
    turn_z_rad: float = _turn("ω_z")
    shift_x_m: float = _shift("t_x")
    shift_y_m: float = _shift("t_y")
    shift_z_m: float = _shift("t_z")

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        super().edit(spec, config)
        offset = CameraOffset(
            rotation_rad=(self.turn_x_rad, self.turn_y_rad, self.turn_z_rad),
            translation_m=(self.shift_x_m, self.shift_y_m, self.shift_z_m),
        )
        for name in self.cameras:
            camera = spec.camera(name)
            camera.pos, camera.quat = offset_pose(camera.pos, camera.quat, offset)
