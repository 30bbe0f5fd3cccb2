"""Known object that the fingers of one arm press during a measurement: shape and pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.shapes import Capsule, Cylinder, Solid


@dataclass(frozen=True, kw_only=True)
class PressedObject:
    """Object that the fingers of one arm press, and its pose. TCP frame: middle between the pads, z = approach, fingers close
    along y; finger a is on the side of +y."""

    solids: Sequence[
        Solid
    ]  # Solids of the object in its own frame; ballast (``touches`` is false) is ignored
    arm: str  # Name of the arm, ``left`` or ``right``
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    """(4, 4) pose of the object in the TCP's frame, or in the world's [m]."""
    frame: Literal["tcp", "world"] = "tcp"
    """tcp: the object is fixed relative to the hand; world: it is fixed to the bench."""

    def __post_init__(self) -> None:
        if self.arm not in ROBOT.arms:
            raise TaccorlError(
                f"pressed object: no arm {self.arm!r}; {nearest(self.arm, ROBOT.arms)}"
            )
        if self.frame not in ("tcp", "world"):
            raise TaccorlError(
                f"pressed object: frame {self.frame!r} is neither 'tcp' nor 'world'"
            )
        pose = np.asarray(self.pose, float)
        if pose.shape != (4, 4) or not np.allclose(
            pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6
        ):
            raise TaccorlError(
                f"pressed object: its pose is not a (4, 4) matrix of a rotation and a translation: {pose.tolist()}"
            )
        if not any(solid.touches for solid in self.solids):
            raise TaccorlError(
                "pressed object: all of its solids are ballast (touches is false)"
            )


def indenter(
    shape: Literal["sphere", "rod"],
    radius_m: float,
    arm: str,
    *,
    length_m: float = 0.03,
    position_m: Sequence[float] = (0.0, 0.0, 0.0),
    rpy_rad: Sequence[float] = (0.0, 0.0, 0.0),
    frame: Literal["tcp", "world"] = "tcp",
) -> PressedObject:
    """Make a sphere, or a rod with flat ends along its own z, of ``radius_m`` [m], between the fingers of ``arm``, centred at
    ``position_m`` [m] in ``frame`` (``PressedObject``) and turned by ``rpy_rad`` [rad], fixed-axis roll, pitch, yaw; (0, π/2, 0)
    lays a rod across the pads. Raises TaccorlError: the shape is unknown, or a size is not above 0."""
    if shape not in ("sphere", "rod"):
        raise TaccorlError(
            f"indenter: no shape {shape!r}; {nearest(shape, ('sphere', 'rod'))}"
        )
    if not (0 < radius_m < math.inf and 0 < length_m < math.inf):
        raise TaccorlError(
            f"indenter: radius_m {radius_m} and length_m {length_m} must be above 0"
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (
        Rotation.from_euler("xyz", rpy_rad).as_matrix(),
        position_m,
    )
    kind, half_height_m = (
        (Capsule, 0.0) if shape == "sphere" else (Cylinder, length_m / 2)
    )
    solid = kind(radius_m=radius_m, half_height_m=half_height_m)
    return PressedObject(solids=[solid], arm=arm, pose=pose, frame=frame)
