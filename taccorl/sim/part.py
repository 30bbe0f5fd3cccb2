"""A part (geometry, mass, grasp and mating poses), and the function that adds it to a MuJoCo spec.

A part is plain numbers (``Part``); ``add_part`` puts it into a spec. Lengths in metres, poses are (4, 4) matrices ``a_from_b``.
Conventions that experts and predicates rely on:

- *mate*: the pose of the part's leading end; *hole*: of a hole's mouth. Both have z along the insertion. A part is aligned
  when the two agree (up to its symmetry); its depth is then the z of the mate in the hole. ``measure_fit`` does it.
- *grasp*: pose of the TCP (taccorl.sim.robot: middle between the pads, z = approach, fingers close along y).
- A movable part hangs on a free joint named like its body. A clamped one is a mocap body: its pose is simulation state
  (``Batch.mocap_pos``, ``mocap_quat``), so it differs from sim to sim, is saved with the state, and costs no solver rows.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.shapes import Solid, add_geom

PART_CONTACT: Mapping[str, Any] = {
    "solref": (-8e5, -1790.0),
    "solimp": (0.95, 0.98, 0.0005, 0.5, 2.0),
    "condim": 4,
    "priority": 1,
}
"""Contact of a part with anything: stiffness 8e5 /s² and damping 1790 /s, critical, a time constant of 1.1 ms, because
MuJoCo's defaults let parts of 0.5 mm clearance overlap by 1–2 mm (measured). Given as negative numbers, since
MuJoCo holds a positive time constant at two physics steps or more: at those 1.7 ms plugs sink 0.25 mm when they hit. An
impedance of (0.99, 0.999) is too hard: a part that slides in the hand then pops out of contact and back (0.4 mm).
Priority 1: the part's friction and stiffness count, not the table's or the pad's, because the paper randomises the part's
friction. Friction itself is ``geom_friction``, which ``Batch.expand`` gives each sim."""
PART_FRICTION = 0.5  # middle of the paper's U(0.3, 0.7), App. E
_TORSION_M, _ROLLING_M = (
    0.002,
    0.0001,
)  # torsional and rolling friction; a contact patch of some mm

COLORS: Mapping[str, tuple[float, float, float]] = {
    "glass": (0.62, 0.86, 0.90),
    "red": (0.80, 0.12, 0.12),
    "blue": (0.12, 0.30, 0.68),
    "sand": (0.80, 0.66, 0.40),
    "walnut": (0.36, 0.22, 0.13),
    "yellow": (0.93, 0.75, 0.10),
    "pink": (0.88, 0.22, 0.45),
    "green": (0.12, 0.58, 0.30),
    "orange": (0.92, 0.43, 0.08),
    "slate": (0.25, 0.32, 0.40),
    "violet": (0.48, 0.26, 0.66),
    "teal": (0.05, 0.46, 0.48),
}
"""Matte colours by name, RGB 0–1."""

# Per side; 0.001 is easy, 0.0003 hard. A choice between 0.06 mm (Isaac Lab's Factory) and 3 mm (ManiSkill's PegInsertionSide).
CLEARANCE_M = 0.0005
_FINGER_ROOM_M = 0.004  # between the fingers' tips and what lies below them
TCP_ABOVE_M = (
    ROBOT.pad.length_m / 2 + _FINGER_ROOM_M
)  # lowest TCP over a surface: the pads reach 32 mm beyond it


def frame_pose(
    x_axis: tuple = (1, 0, 0), z_axis: tuple = (0, 0, 1), at: tuple = (0, 0, 0)
) -> np.ndarray:
    """Pose (4, 4) of a frame with the axes ``x_axis`` and ``z_axis``, perpendicular unit vectors of 3 numbers, and its origin at
    ``at`` [m]."""
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = (
        x_axis,
        np.cross(z_axis, x_axis),
        z_axis,
        at,
    )
    return pose


LEADING_END = frame_pose(
    z_axis=(0, 0, -1)
)  # of a part whose origin is at its tip and whose z runs to its tail


def check_clearance(name: str, clearance_m: float) -> None:
    """Check the clearance ``clearance_m`` on each side between a part and the hole of the part ``name``. Raises TaccorlError:
    it is not within 0 and 2 mm."""
    if not 0 < clearance_m <= 0.002:
        raise TaccorlError(
            f"{name}: clearance_m={clearance_m} is not within 0 and 0.002 m; the default is 0.0005"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Mate:
    """The leading end of a part, which goes into a hole: its pose in the part, and its symmetry."""

    part_from_mate: np.ndarray
    """(4, 4) pose of the mate in the part's frame, z along the insertion."""
    num_turns: int | None
    """Number of rotations about z, in equal steps of a whole turn, that look the same: 1, 2, 3 …; None for any angle."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hole:
    """A hole in a part, and the depth to which it accepts a mate."""

    part_from_hole: np.ndarray
    """(4, 4) pose of the hole in the part's frame: origin in the middle of the mouth, z into the hole."""
    depth_m: float
    """Distance from the mouth to the floor [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Grasp:
    """One way to grip a part with flat jaws: the hand's pose, the opening, and the symmetry."""

    part_from_tcp: np.ndarray
    """(4, 4) pose of the TCP in the part's frame: z = approach, fingers close along y."""
    width_m: float
    """Distance between the pads when closed on the part [m]."""
    num_turns: int = 2
    """Number of gripper rotations about the approach direction, 2π / ``num_turns`` apart, that grip the part equally well;
    2 if only the two jaws can be exchanged."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """One rigid part: its solids, and the grasp and mating poses for experts and predicates, all in the part's own frame."""

    name: str
    solids: list[Solid]  # Solids of which it consists; those of one part may touch
    clamped: bool = False  # True: fixed to the bench (a mocap body); False: free
    table_from_part: np.ndarray = field(default_factory=lambda: np.eye(4))
    """(4, 4) pose of the part when it rests on a table whose top is z = 0."""
    mate: Mate | None = (
        None  # Leading end that goes into another part's hole; None: it has none
    )
    holes: Mapping[str, Hole] = field(
        default_factory=dict
    )  # Name → hole for another part's mate
    grasps: Mapping[str, Grasp] = field(
        default_factory=dict
    )  # Name → way to grip the part
    seats: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Kind of another part → pose (4, 4) in this part's frame at which it is placed at reset."""

    @property
    def mass_kg(self) -> float:
        """Mass of all solids [kg]."""
        return sum(solid.mass_kg for solid in self.solids)

    @property
    def com_part_m(self) -> np.ndarray:
        """(3,) centre of mass in the part's frame [m]."""
        return (
            sum((s.mass_kg * s.com_part_m for s in self.solids), np.zeros(3))
            / self.mass_kg
        )


class Fit(NamedTuple):
    """Pose error of a mate (the leading end of a part) relative to a hole, each array with the leading shape (…) of the poses."""

    depth_m: np.ndarray  # Depth of the mate in the hole [m], positive inside
    lateral_m: np.ndarray  # Distance of the two axes at the mate's leading end [m]
    tilt_rad: np.ndarray  # Angle between the two axes [rad]
    turn_rad: np.ndarray  # Angle about the axis to the nearest rotation that looks the same [rad]; 0 for a round part


def measure_fit(
    world_from_hole: np.ndarray, world_from_mate: np.ndarray, num_turns: int | None
) -> Fit:
    """Depth, lateral error, tilt and turn of mates in holes, each (…).

    ``world_from_hole`` and ``world_from_mate`` (…, 4, 4) are the poses of ``Hole`` and ``Mate``; ``num_turns`` is that of the
    mate."""
    turned = np.swapaxes(world_from_hole[..., :3, :3], -1, -2)
    hole_from_mate = turned @ world_from_mate[..., :3, :3]
    shift = world_from_mate[..., :3, 3] - world_from_hole[..., :3, 3]
    seen = (turned @ shift[..., None])[..., 0]
    x, y, depth = seen[..., 0], seen[..., 1], seen[..., 2]
    tilt = np.arctan2(
        np.hypot(hole_from_mate[..., 0, 2], hole_from_mate[..., 1, 2]),
        hole_from_mate[..., 2, 2],
    )
    turn = np.arctan2(
        hole_from_mate[..., 1, 0] - hole_from_mate[..., 0, 1],
        np.einsum("...ii", hole_from_mate[..., :2, :2]),
    )
    period = 2 * math.pi / num_turns if num_turns else math.inf
    turn = (
        np.zeros_like(turn)
        if num_turns is None
        else turn - period * np.round(turn / period)
    )
    return Fit(depth, np.hypot(x, y), tilt, turn)


def add_part(
    spec: mujoco.MjSpec, part: Part, *, friction: float = PART_FRICTION
) -> mujoco.MjsBody:
    """Add a part to the world of ``spec``, at rest on the table at the origin; returns its body.

    A reset then moves the part: a loose one by the ``qpos`` of its free joint, a clamped one, which is a mocap body without
    a joint, by ``mocap_pos`` and ``mocap_quat``. Body and free joint have the part's name (``rack``), the geoms are
    ``rack_0``, ``rack_1`` … ``friction``: coefficient of sliding friction of its geoms."""
    rest = part.table_from_part
    quat = Rotation.from_matrix(rest[:3, :3]).as_quat(scalar_first=True)
    body = spec.worldbody.add_body(
        name=part.name, pos=rest[:3, 3], quat=quat, mocap=part.clamped
    )
    if not part.clamped:
        body.add_freejoint(name=part.name)
    for color in sorted({solid.color for solid in part.solids if solid.touches}):
        spec.add_material(
            name=f"{part.name}_{color}",
            rgba=(*COLORS[color], 1),
            specular=0,
            shininess=0,
        )
    for i, solid in enumerate(part.solids):
        settings = dict(
            PART_CONTACT,
            friction=(friction, _TORSION_M, _ROLLING_M),
            material=f"{part.name}_{solid.color}",
        )
        if not solid.touches:
            settings = {
                "contype": 0,
                "conaffinity": 0,
                "group": 5,
                "rgba": (0, 0, 0, 0),
            }
        add_geom(spec, body, solid, f"{part.name}_{i}", **settings)
    return body


def on_table(part: Part, xy_m: np.ndarray, yaw_rad: float) -> np.ndarray:
    """World pose (7,), position [m] and quaternion wxyz, of a part that rests on the table, turned by ``yaw_rad`` about the
    vertical, with its origin above ``xy_m`` (2,)."""
    rest = part.table_from_part
    turned = Rotation.from_euler("z", yaw_rad)
    pos = np.array(
        [*xy_m, rest[2, 3] + 0.0002]
    )  # a hair above: no contact to begin with
    return np.r_[
        pos, (turned * Rotation.from_matrix(rest[:3, :3])).as_quat(scalar_first=True)
    ]
