"""Pieces and tray of the puzzle. Dimensions are choices."""

import numpy as np
from shapely.geometry import Polygon, box

from taccorl.errors import TaccorlError, nearest
from taccorl.sim.part import (
    CLEARANCE_M,
    LEADING_END,
    TCP_ABOVE_M,
    Grasp,
    Hole,
    Mate,
    Part,
    check_clearance,
    frame_pose,
)
from taccorl.sim.shapes import (
    Cylinder,
    Solid,
    box_between,
    circle_outline,
    extrude,
    heart_outline,
    offset_outline,
    triangle_outline,
    with_mass,
)

_PIECE_HEIGHT_M, _KNOB_HEIGHT_M, _KNOB_HALF_M = 0.020, 0.025, 0.009
_TRAY_BASE_M, _TRAY_DEPTH_M, _TRAY_HALF_M = 0.004, 0.010, (0.100, 0.040)
_PIECE_OUTLINES = {
    "circle": circle_outline(0.020, 32),
    "heart": heart_outline(0.044, 8),
    "triangle": triangle_outline(0.046),
}
_PIECE_LOOKS = {
    "circle": ("yellow", 0.045),
    "heart": ("pink", 0.045),
    "triangle": ("green", 0.035),
}  # colour, kg
_PIECE_TURNS = {"circle": None, "heart": 1, "triangle": 3}
_PIECE_X_M = {"circle": -0.060, "heart": 0.0, "triangle": 0.060}
PIECES = tuple(_PIECE_X_M)
"""Names of the pieces."""


def puzzle_piece(shape: str, name: str = "") -> Part:
    """A piece 20 mm thick: circle Ø40, heart 44 wide or triangle of side 46 mm, 35–45 g, with a knob 18 × 18 × 25 mm.

    Origin in the middle of its underside, z up. The knob is what is gripped: the fingers' tips end 4 mm above the piece.
    """
    if shape not in PIECES:
        raise TaccorlError(
            f"puzzle_piece: no shape {shape!r}; {nearest(shape, PIECES)}"
        )
    color, mass_kg = _PIECE_LOOKS[shape]
    half, top, knob_top = (
        _PIECE_HEIGHT_M / 2,
        _PIECE_HEIGHT_M,
        _PIECE_HEIGHT_M + _KNOB_HEIGHT_M,
    )
    if (
        shape == "circle"
    ):  # a true disc; its outline stands in for it only where the tray is cut
        solids: list[Solid] = [
            Cylinder(
                radius_m=0.020,
                half_height_m=half,
                part_from_solid=frame_pose(at=(0, 0, half)),
                color=color,
            )
        ]
    else:
        solids = extrude(Polygon(_PIECE_OUTLINES[shape]), 0, top, color)
    knob = box_between(
        (-_KNOB_HALF_M, -_KNOB_HALF_M, top),
        (_KNOB_HALF_M, _KNOB_HALF_M, knob_top),
        color,
    )
    tcp = frame_pose((1, 0, 0), (0, 0, -1), (0, 0, top + TCP_ABOVE_M))
    return Part(
        name=name or shape,
        solids=with_mass([*solids, knob], mass_kg),
        mate=Mate(part_from_mate=LEADING_END, num_turns=_PIECE_TURNS[shape]),
        grasps={
            "knob": Grasp(part_from_tcp=tcp, width_m=2 * _KNOB_HALF_M, num_turns=4)
        },
    )


def puzzle_tray(name: str = "tray", clearance_m: float = CLEARANCE_M) -> Part:
    """Tray 200 × 80 mm, base 4 mm, holes 10 mm deep in a row along x: circle, heart, triangle; clamped. Origin below it."""
    check_clearance(name, clearance_m)
    x_half, y_half = _TRAY_HALF_M
    mouth = _TRAY_BASE_M + _TRAY_DEPTH_M
    plate: list[Solid] = []
    holes: dict[str, Hole] = {}
    for shape, x in _PIECE_X_M.items():
        outline = _PIECE_OUTLINES[shape]
        y = (
            -(outline[:, 1].min() + outline[:, 1].max()) / 2
        )  # in the middle of the tray as the eye sees it
        if shape == "circle":
            cut = circle_outline(0.020 + clearance_m, 16, circumscribed=True)
        else:
            cut = offset_outline(outline, clearance_m)
        x0, x1 = (x - 0.030 if x >= 0 else -x_half), (x + 0.030 if x <= 0 else x_half)
        cell = Polygon(box(x0, -y_half, x1, y_half).exterior, [cut + np.array((x, y))])
        plate += extrude(cell, _TRAY_BASE_M, mouth, "slate")
        # The hole's x is the piece's x when it lies in it: a mate is turned about x, so is the hole.
        holes[shape] = Hole(
            part_from_hole=frame_pose(z_axis=(0, 0, -1), at=(x, y, mouth)),
            depth_m=_TRAY_DEPTH_M,
        )
    base = box_between((-x_half, -y_half, 0), (x_half, y_half, _TRAY_BASE_M), "sand")
    return Part(
        name=name, solids=with_mass([base, *plate], 0.200), clamped=True, holes=holes
    )
