"""The parts of the four tasks; dimensions are choices. Clearance is per side: a hole is its part's outline, moved out."""

import math
from dataclasses import replace

import numpy as np
from shapely.geometry import Polygon, box

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.part import Grasp, Hole, Mate, Part
from taccorl.sim.shapes import (
    Capsule,
    Cylinder,
    Solid,
    box_between,
    circle_outline,
    extrude,
    heart_outline,
    moved,
    offset_outline,
    triangle_outline,
    with_mass,
)

# Per side; 0.001 is easy, 0.0003 hard. A choice between 0.06 mm (Isaac Lab's Factory) and 3 mm (ManiSkill's PegInsertionSide).
CLEARANCE_M = 0.0005
_FINGER_ROOM_M = 0.004  # between the fingers' tips and what lies below them
_TCP_ABOVE_M = ROBOT.pad.length_m / 2 + _FINGER_ROOM_M  # lowest TCP over a surface: the pads reach 32 mm beyond it


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
    only if its centre of mass is inside (tests/sim/test_parts.py).
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
