"""The parts of the four tasks: geometry, mass, and where to hold and mate them (research/mimicgen.md §3).

A part is plain numbers (``Part``); ``add_part`` puts it into a MuJoCo spec. Lengths in metres, poses are (4, 4) matrices
``a_from_b``. Conventions that experts and predicates rely on:

- *mate*: the pose of the part's leading end; *hole*: of a hole's mouth. Both have z along the insertion. A part is aligned
  when the two agree (up to its symmetry); its depth is then the z of the mate in the hole. ``measure_fit`` does it.
- *grasp*: pose of the TCP (taccorl.sim.robot: middle between the pads, z = approach, fingers close along y).
- A movable part hangs on a free joint named like its body. A clamped one is a mocap body: its pose is simulation state
  (``Batch.mocap_pos``, ``mocap_quat``), so it differs from sim to sim, is saved with the state, and costs no solver rows.
- Clearance is per side: the hole's outline is the part's, moved out by it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation
from shapely.geometry import Polygon, box

from taccorl.errors import TaccorlError, nearest
from taccorl.sim.robot import PAD_LENGTH_M
from taccorl.sim.shapes import (
    Capsule,
    Cylinder,
    Solid,
    add_geom,
    box_between,
    circle_outline,
    extrude,
    heart_outline,
    moved,
    offset_outline,
    triangle_outline,
    with_mass,
)

PART_CONTACT: Mapping[str, Any] = {
    "solref": (0.002, 1.0),
    "solimp": (0.99, 0.999, 0.0005, 0.5, 2.0),
    "condim": 4,
    "priority": 1,
}
"""Contact of a part with anything: as stiff as the time step allows, because MuJoCo's defaults let parts of 0.5 mm clearance
overlap by 1–2 mm (research/mimicgen.md §4.2). Priority 1: the part's friction and stiffness count, not the table's or the
pad's, because the paper randomises the part's friction. Friction itself is ``geom_friction``, which ``Batch.expand`` gives
each sim."""
PART_FRICTION = 0.5  # middle of the paper's U(0.3, 0.7), App. E
_TORSION_M, _ROLLING_M = 0.002, 0.0001  # torsional and rolling friction; a contact patch of some mm

CLEARANCE_M = 0.0005  # per side; 0.001 is easy, 0.0003 hard (research/mimicgen.md §3.1)
_FINGER_ROOM_M = 0.004  # between the fingers' tips and what lies below them
_TCP_ABOVE_M = PAD_LENGTH_M / 2 + _FINGER_ROOM_M  # lowest TCP over a surface: the pads reach 32 mm beyond it

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Mate:
    """The leading end of a part that goes into a hole."""

    part_from_mate: np.ndarray
    """(4, 4) z along the insertion."""
    num_turns: int | None
    """How many turns about z look the same: 1, 2, 3 …; None for any angle."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hole:
    """A hole in a part, up to which depth it takes a mate."""

    part_from_hole: np.ndarray
    """(4, 4) in the middle of the mouth, z into the hole."""
    depth_m: float
    """From the mouth to the floor."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Grasp:
    """One way to grip a part with flat jaws."""

    part_from_tcp: np.ndarray
    """(4, 4) pose of the TCP: z = approach, fingers close along y."""
    width_m: float
    """Between the pads when closed."""
    num_turns: int = 2
    """How many turns about the approach are as good."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """One body: its solids, and what experts and predicates need to know, all in the part's own frame."""

    name: str
    solids: list[Solid]
    clamped: bool = False
    """Clamped to the bench (a mocap body) instead of free."""
    table_from_part: np.ndarray = field(default_factory=lambda: np.eye(4))
    """How it rests on a table whose top is z = 0."""
    mate: Mate | None = None
    holes: Mapping[str, Hole] = field(default_factory=dict)
    grasps: Mapping[str, Grasp] = field(default_factory=dict)
    seats: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Poses (4, 4), in this part, at which other parts lie ready, by the other part's kind."""

    @property
    def mass_kg(self) -> float:
        return sum(solid.mass_kg for solid in self.solids)

    @property
    def com_part_m(self) -> np.ndarray:
        """(3,) Centre of mass."""
        return sum((s.mass_kg * s.com_part_m for s in self.solids), np.zeros(3)) / self.mass_kg


class Fit(NamedTuple):
    """How a mate stands in a hole; each an array of the poses' leading shape."""

    depth_m: np.ndarray
    """Positive inside."""
    lateral_m: np.ndarray
    """Between the two axes, at the leading end."""
    tilt_rad: np.ndarray
    """Between the two axes."""
    turn_rad: np.ndarray
    """About the axis, to the nearest look-alike; 0 for a round part."""


def measure_fit(world_from_hole: np.ndarray, world_from_mate: np.ndarray, num_turns: int | None) -> Fit:
    """Depth, lateral error, tilt and turn of mates (..., 4, 4) in holes (..., 4, 4)."""
    turned = np.swapaxes(world_from_hole[..., :3, :3], -1, -2)
    hole_from_mate = turned @ world_from_mate[..., :3, :3]
    shift = world_from_mate[..., :3, 3] - world_from_hole[..., :3, 3]
    x, y, depth = np.moveaxis((turned @ shift[..., None])[..., 0], -1, 0)
    tilt = np.arctan2(np.hypot(hole_from_mate[..., 0, 2], hole_from_mate[..., 1, 2]), hole_from_mate[..., 2, 2])
    turn = np.arctan2(
        hole_from_mate[..., 1, 0] - hole_from_mate[..., 0, 1], np.einsum("...ii", hole_from_mate[..., :2, :2])
    )
    period = 2 * math.pi / num_turns if num_turns else math.inf
    turn = np.zeros_like(turn) if num_turns is None else turn - period * np.round(turn / period)
    return Fit(depth, np.hypot(x, y), tilt, turn)


def add_part(spec: mujoco.MjSpec, part: Part, *, friction: float = PART_FRICTION) -> mujoco.MjsBody:
    """Put a part into the world as it rests on the table at the origin; poses are set in the state at reset.

    Body, free joint (if not clamped) and geoms are named after the part: ``rack``, ``rack_0``, ``rack_1`` …
    """
    rest = part.table_from_part
    quat = Rotation.from_matrix(rest[:3, :3]).as_quat(scalar_first=True)
    body = spec.worldbody.add_body(name=part.name, pos=rest[:3, 3], quat=quat, mocap=part.clamped)
    if not part.clamped:
        body.add_freejoint(name=part.name)
    for color in sorted({solid.color for solid in part.solids if solid.touches}):
        spec.add_material(name=f"{part.name}_{color}", rgba=(*COLORS[color], 1), specular=0, shininess=0)
    for i, solid in enumerate(part.solids):
        settings = dict(
            PART_CONTACT, friction=(friction, _TORSION_M, _ROLLING_M), material=f"{part.name}_{solid.color}"
        )
        if not solid.touches:
            settings = {"contype": 0, "conaffinity": 0, "group": 5, "rgba": (0, 0, 0, 0)}
        add_geom(spec, body, solid, f"{part.name}_{i}", **settings)
    return body


def _pose(x_axis: tuple = (1, 0, 0), z_axis: tuple = (0, 0, 1), at: tuple = (0, 0, 0)) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = x_axis, np.cross(z_axis, x_axis), z_axis, at
    return pose


_LEADING_END = _pose(z_axis=(0, 0, -1))  # of a part whose origin is at its tip and whose z runs to its tail


def _check_clearance(name: str, clearance_m: float) -> None:
    if not 0 < clearance_m <= 0.002:
        raise TaccorlError(
            f"{name}: clearance_m={clearance_m} is not within 0 and 0.002 m per side; "
            "0.0005 is the default, 0.001 easy, 0.0003 hard"
        )


# --- Test Tube Insertion

TUBE_RADIUS_M, _TUBE_LENGTH_M = 0.008, 0.100
_RACK_HOLES_M = {"left": -0.026, "middle": 0.0, "right": 0.026}
_STAND_HEIGHT_M = 0.040  # of the lying tube's axis: fingers fit round it


def glass_tube(name: str = "tube") -> Part:
    """Ø16 × 100 mm tube with a round bottom and a Ø20 × 12 mm cap, 60 g. Origin at the bottom, z towards the cap."""
    r, length, cap = TUBE_RADIUS_M, _TUBE_LENGTH_M, 0.012
    # The capsule's upper end is hidden in the cap.
    glass = Capsule(
        radius_m=r, half_height_m=length / 2 - r, part_from_solid=_pose(at=(0, 0, length / 2)), color="glass"
    )
    lid = Cylinder(
        radius_m=0.010, half_height_m=cap / 2, part_from_solid=_pose(at=(0, 0, length - cap / 2)), color="red"
    )
    return Part(
        name=name,
        solids=[replace(glass, mass_kg=0.050), replace(lid, mass_kg=0.010)],
        table_from_part=_pose(x_axis=(0, 0, 1), z_axis=(1, 0, 0), at=(0, 0, 0.010)),  # on its cap; it settles by 1.3°
        mate=Mate(part_from_mate=_LEADING_END, num_turns=None),
        # 60 mm up: clear of the stand's prisms, and of the rack when the tube is in. TCP x points to the bottom, so that
        # the wrist camera is above the hand when the tube stands. Any turn about the tube's axis is as good.
        grasps={"middle": Grasp(part_from_tcp=_pose((0, 0, -1), (-1, 0, 0), (0, 0, 0.060)), width_m=2 * r)},
    )


def tube_stand(name: str = "stand") -> Part:
    """Two V prisms, 40 mm high, on a base plate, clamped; the tube lies in them along x. Origin below the tube's bottom."""
    apex, half_notch = _STAND_HEIGHT_M - math.sqrt(2) * TUBE_RADIUS_M, 0.009
    outline = [
        (-0.016, 0.004), (0.016, 0.004), (0.016, apex + half_notch), (half_notch, apex + half_notch), (0, apex),
        (-half_notch, apex + half_notch), (-0.016, apex + half_notch),
    ]  # fmt: skip
    profile = Polygon(outline)
    along_x = _pose(x_axis=(0, 1, 0), z_axis=(1, 0, 0))
    blocks = [extrude(profile, *span, "walnut") for span in ((0.010, 0.022), (0.079, 0.086))]
    base = box_between((0, -0.022, 0), (0.096, 0.022, 0.004), "walnut")
    return Part(
        name=name,
        solids=with_mass([base, *(moved(solid, along_x) for block in blocks for solid in block)], 0.120),
        clamped=True,
        seats={"tube": _pose(x_axis=(0, 0, 1), z_axis=(1, 0, 0), at=(0, 0, _STAND_HEIGHT_M))},
    )


def tube_rack(name: str = "rack", clearance_m: float = CLEARANCE_M) -> Part:
    """Rack 90 × 44 × 50 mm with three holes in a top and a guide plate, and a 20 mm wide handle block at −x; 250 g, free.

    Origin in the middle of its underside. Tubes end on its floor, 4 mm up. The guide plate's lower face is 32 mm below the
    mouth: a tube within both plates can tilt by 2c / 32 mm = 1.8° at 0.5 mm.
    """
    _check_clearance(name, clearance_m)
    hole = circle_outline(TUBE_RADIUS_M + clearance_m, 24, circumscribed=True)
    cells = [(-0.045, -0.013), (-0.013, 0.013), (0.013, 0.045)]
    plates = [
        solid
        for low, high in ((0.018, 0.022), (0.046, 0.050))
        for (x0, x1), x in zip(cells, _RACK_HOLES_M.values(), strict=True)
        for solid in extrude(Polygon(box(x0, -0.019, x1, 0.019).exterior, [hole + np.array((x, 0))]), low, high, "blue")
    ]
    frame = [
        box_between((-0.045, -0.022, 0), (0.045, 0.022, 0.004), "blue"),
        box_between((-0.045, 0.019, 0.004), (0.045, 0.022, 0.050), "blue"),
        box_between((-0.045, -0.022, 0.004), (0.045, -0.019, 0.050), "blue"),
        box_between((-0.077, -0.010, 0), (-0.045, 0.010, 0.044), "sand"),
    ]
    return Part(
        name=name,
        solids=with_mass([*plates, *frame], 0.250),
        holes={
            which: Hole(part_from_hole=_pose(z_axis=(0, 0, -1), at=(x, 0, 0.050)), depth_m=0.046)
            for which, x in _RACK_HOLES_M.items()
        },
        grasps={"handle": Grasp(part_from_tcp=_pose((1, 0, 0), (0, 0, -1), (-0.061, 0, _TCP_ABOVE_M)), width_m=0.020)},
    )


# --- Do Puzzle

_PIECE_HEIGHT_M, _KNOB_HEIGHT_M, _KNOB_HALF_M = 0.020, 0.025, 0.009
_TRAY_BASE_M, _TRAY_DEPTH_M, _TRAY_HALF_M = 0.004, 0.010, (0.100, 0.040)
_PIECE_OUTLINES = {
    "circle": circle_outline(0.020, 32),
    "heart": heart_outline(0.044, 8),
    "triangle": triangle_outline(0.046),
}
_PIECE_LOOKS = {"circle": ("yellow", 0.045), "heart": ("pink", 0.045), "triangle": ("green", 0.035)}  # colour, kg
_PIECE_TURNS = {"circle": None, "heart": 1, "triangle": 3}
_PIECE_X_M = {"circle": -0.060, "heart": 0.0, "triangle": 0.060}
PIECES = tuple(_PIECE_X_M)


def puzzle_piece(shape: str, name: str = "") -> Part:
    """A piece 20 mm thick: circle Ø40, heart 44 wide or triangle of side 46 mm, 35–45 g, with a knob 18 × 18 × 25 mm.

    Origin in the middle of its underside, z up. The knob is what is gripped: the fingers' tips end 4 mm above the piece.
    """
    if shape not in PIECES:
        raise TaccorlError(f"puzzle_piece: no shape {shape!r}; {nearest(shape, PIECES)}")
    color, mass_kg = _PIECE_LOOKS[shape]
    half, top, knob_top = _PIECE_HEIGHT_M / 2, _PIECE_HEIGHT_M, _PIECE_HEIGHT_M + _KNOB_HEIGHT_M
    if shape == "circle":  # a true disc; its outline stands in for it only where the tray is cut
        solids: list[Solid] = [
            Cylinder(radius_m=0.020, half_height_m=half, part_from_solid=_pose(at=(0, 0, half)), color=color)
        ]
    else:
        solids = extrude(Polygon(_PIECE_OUTLINES[shape]), 0, top, color)
    knob = box_between((-_KNOB_HALF_M, -_KNOB_HALF_M, top), (_KNOB_HALF_M, _KNOB_HALF_M, knob_top), color)
    tcp = _pose((1, 0, 0), (0, 0, -1), (0, 0, top + _TCP_ABOVE_M))
    return Part(
        name=name or shape,
        solids=with_mass([*solids, knob], mass_kg),
        mate=Mate(part_from_mate=_LEADING_END, num_turns=_PIECE_TURNS[shape]),
        grasps={"knob": Grasp(part_from_tcp=tcp, width_m=2 * _KNOB_HALF_M, num_turns=4)},
    )


def puzzle_tray(name: str = "tray", clearance_m: float = CLEARANCE_M) -> Part:
    """Tray 200 × 80 mm, base 4 mm, holes 10 mm deep in a row along x: circle, heart, triangle; clamped. Origin below it."""
    _check_clearance(name, clearance_m)
    x_half, y_half = _TRAY_HALF_M
    mouth = _TRAY_BASE_M + _TRAY_DEPTH_M
    plate: list[Solid] = []
    holes: dict[str, Hole] = {}
    for shape, x in _PIECE_X_M.items():
        outline = _PIECE_OUTLINES[shape]
        y = -(outline[:, 1].min() + outline[:, 1].max()) / 2  # in the middle of the tray as the eye sees it
        if shape == "circle":
            cut = circle_outline(0.020 + clearance_m, 16, circumscribed=True)
        else:
            cut = offset_outline(outline, clearance_m)
        x0, x1 = (x - 0.030 if x >= 0 else -x_half), (x + 0.030 if x <= 0 else x_half)
        cell = Polygon(box(x0, -y_half, x1, y_half).exterior, [cut + np.array((x, y))])
        plate += extrude(cell, _TRAY_BASE_M, mouth, "slate")
        # The hole's x is the piece's x when it lies in it: a mate is turned about x, so is the hole.
        holes[shape] = Hole(part_from_hole=_pose(z_axis=(0, 0, -1), at=(x, y, mouth)), depth_m=_TRAY_DEPTH_M)
    base = box_between((-x_half, -y_half, 0), (x_half, y_half, _TRAY_BASE_M), "sand")
    return Part(name=name, solids=with_mass([base, *plate], 0.200), clamped=True, holes=holes)


# --- Assembly #1: align the axes in the air

_TAIL_LENGTH_M = 0.030  # solid block behind each hole: there the hand is clear of the other hand


def tenon_plug(name: str = "plug") -> Part:
    """Tenon 18 × 12 × 45 mm on a head 24 × 20 × 30 mm, 80 g; the head is the heavier, so it lies flat. Origin at the tip."""
    tenon = box_between((-0.009, -0.006, 0), (0.009, 0.006, 0.045), "orange")
    head = box_between((-0.012, -0.010, 0.045), (0.012, 0.010, 0.075), "orange")
    return Part(
        name=name,
        solids=[replace(tenon, mass_kg=0.015), replace(head, mass_kg=0.065)],
        table_from_part=_pose(x_axis=(0, 0, 1), z_axis=(1, 0, 0), at=(0, 0, 0.012)),
        mate=Mate(part_from_mate=_LEADING_END, num_turns=2),
        grasps={"head": _side_grasp((-1, 0, 0), height_m=0.012, z_m=0.060, width_m=0.020)},
    )


def tenon_socket(name: str = "socket", clearance_m: float = CLEARANCE_M) -> Part:
    """Block 36 × 30 mm with a mortise 38 mm deep, then 30 mm of solid tail, 150 g. Origin in the mouth, z into it."""
    _check_clearance(name, clearance_m)
    x, y, end = 0.009 + clearance_m, 0.006 + clearance_m, 0.038
    solids = [
        box_between((x, -0.015, 0), (0.018, 0.015, end), "slate"),
        box_between((-0.018, -0.015, 0), (-x, 0.015, end), "slate"),
        box_between((-x, y, 0), (x, 0.015, end), "slate"),
        box_between((-x, -0.015, 0), (x, -y, end), "slate"),
        box_between((-0.018, -0.015, end), (0.018, 0.015, end + _TAIL_LENGTH_M), "slate"),
    ]
    return Part(
        name=name,
        solids=with_mass(solids, 0.150),
        table_from_part=_pose(x_axis=(0, 0, 1), z_axis=(1, 0, 0), at=(0, 0, 0.018)),
        holes={"mortise": Hole(part_from_hole=np.eye(4), depth_m=end)},
        grasps={"tail": _side_grasp((-1, 0, 0), height_m=0.018, z_m=end + _TAIL_LENGTH_M / 2, width_m=0.030)},
    )


def _side_grasp(approach: tuple, height_m: float, z_m: float, width_m: float) -> Grasp:
    """Grip from above a part that lies with its axis level and reaches ``height_m`` below it. TCP x points to the partner."""
    at = -np.asarray(approach) * (_TCP_ABOVE_M - height_m) + (0, 0, z_m)
    return Grasp(part_from_tcp=_pose((0, 0, -1), approach, tuple(at)), width_m=width_m)


# --- Assembly #2: the cradle carries the plug only where its centre of mass is inside


def cradle_plug(name: str = "plug") -> Part:
    """Square 20 × 20 × 36 mm on a head 24 × 20 × 30 mm, 70 g, its centre of mass 19 mm from the tip. Origin at the tip.

    41.2 g of it are a brass core of 18 × 18 × 15 mm in the tip. The underside, −y, is flush: it lies flat.
    """
    shaft = box_between((-0.010, -0.010, 0), (0.010, 0.010, 0.036), "violet")
    head = box_between((-0.012, -0.010, 0.036), (0.012, 0.010, 0.066), "violet")
    plastic = with_mass([shaft, head], 0.0288)
    core = replace(box_between((-0.009, -0.009, 0.0007), (0.009, 0.009, 0.0157)), mass_kg=0.0412, touches=False)
    return Part(
        name=name,
        solids=[*plastic, core],
        table_from_part=_pose(x_axis=(0, 1, 0), z_axis=(1, 0, 0), at=(0, 0, 0.010)),
        # Turned about y, not x, so that both have their open, upper side at +y.
        mate=Mate(part_from_mate=_pose(x_axis=(-1, 0, 0), z_axis=(0, 0, -1)), num_turns=4),
        grasps={"head": _side_grasp((0, -1, 0), height_m=0.010, z_m=0.051, width_m=0.024)},
    )


def open_cradle(name: str = "cradle", clearance_m: float = CLEARANCE_M) -> Part:
    """U-shaped cradle 36 mm wide and 34 mm deep, open at +y, then 30 mm of solid tail, 160 g. Origin in the mouth, z into it.

    A closed socket holds a plug by the couple between its floor and its roof from 8 mm on. Without the roof the plug stays
    only if its centre of mass is inside (research/mimicgen.md §3.6).
    """
    _check_clearance(name, clearance_m)
    inner, outer, end = 0.010 + clearance_m, 0.018, 0.034
    solids = [
        box_between((-outer, -0.020, 0), (outer, -inner, end), "teal"),
        box_between((inner, -inner, 0), (outer, 0.010, end), "teal"),
        box_between((-outer, -inner, 0), (-inner, 0.010, end), "teal"),
        box_between((-outer, -0.020, end), (outer, 0.010, end + _TAIL_LENGTH_M), "teal"),
    ]
    return Part(
        name=name,
        solids=with_mass(solids, 0.160),
        table_from_part=_pose(x_axis=(0, 1, 0), z_axis=(1, 0, 0), at=(0, 0, 0.020)),
        holes={"cradle": Hole(part_from_hole=np.eye(4), depth_m=end)},
        grasps={"tail": _side_grasp((0, -1, 0), height_m=0.020, z_m=end + _TAIL_LENGTH_M / 2, width_m=2 * outer)},
    )
