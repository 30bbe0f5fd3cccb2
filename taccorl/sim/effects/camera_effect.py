"""Base of effects of cameras."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import Effect, Kind

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@dataclass(kw_only=True)
class CameraEffect(Effect):
    """Base of effects on pictures, with the same parameters for all chosen cameras. Cameras with different parameters need one
    entry each."""

    layer: ClassVar = "camera"
    needs: ClassVar = ("picture",)
    cameras: list[str] = field(default_factory=lambda: list(ROBOT.cameras))
    """Names of cameras, as in the twin's ``cameras``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise TaccorlError(f"effect {self.name}: cameras are {self.cameras}; name at least one, each once")

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        return ("camera",)

    def acts_on(self) -> list[str]:
        return list(self.cameras)

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        known = [camera.name for camera in config.cameras]
        for name in self.cameras:
            if name not in known:
                raise TaccorlError(f"effect {self.name}: the twin has no camera {name!r}; {nearest(name, known)}")
