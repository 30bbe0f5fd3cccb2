"""Tube, stand and rack. Dimensions are choices."""

import math
from dataclasses import replace

import numpy as np
from shapely.geometry import Polygon, box

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
    Capsule,
    Cylinder,
    box_between,
    circle_outline,
    extrude,
    moved,
    with_mass,
)

TUBE_RADIUS_M, _TUBE_LENGTH_M = 0.008, 0.100
_RACK_HOLES_M = {"left": -0.026, "middle": 0.0, "right": 0.026}
_STAND_HEIGHT_M = 0.040  # of the lying tube's axis: fingers fit round it


def glass_tube(name: str = "tube") -> Part:
    """Ø16 × 100 mm tube with a round bottom and a Ø20 × 12 mm cap, 60 g. Origin at the bottom, z towards the cap."""
    r, length, cap = TUBE_RADIUS_M, _TUBE_LENGTH_M, 0.012
    # The capsule's upper end is hidden in the cap.
    glass = Capsule(
        radius_m=r,
        half_height_m=length / 2 - r,
        part_from_solid=frame_pose(at=(0, 0, length / 2)),
        color="glass",
    )
    lid = Cylinder(
        radius_m=0.010,
        half_height_m=cap / 2,
        part_from_solid=frame_pose(at=(0, 0, length - cap / 2)),
        color="red",
    )
    return Part(
        name=name,
        solids=[replace(glass, mass_kg=0.050), replace(lid, mass_kg=0.010)],
        table_from_part=frame_pose(
            x_axis=(0, 0, 1), z_axis=(1, 0, 0), at=(0, 0, 0.010)
        ),  # on its cap; it settles by 1.3°
        mate=Mate(part_from_mate=LEADING_END, num_turns=None),
        # 60 mm up: clear of the stand's prisms, and of the rack when the tube is in. TCP x points to the bottom, so that
        # the wrist camera is above the hand when the tube stands. Any turn about the tube's axis is as good.
        grasps={
            "middle": Grasp(
                part_from_tcp=frame_pose((0, 0, -1), (-1, 0, 0), (0, 0, 0.060)),
                width_m=2 * r,
            )
        },
    )


def tube_stand(name: str = "stand") -> Part:
    """Two V prisms, 40 mm high, on a base plate, clamped; the tube lies in them along x. Origin below the tube's bottom."""
    apex, half_notch = _STAND_HEIGHT_M - math.sqrt(2) * TUBE_RADIUS_M, 0.009
    outline = [
        (-0.016, 0.004), (0.016, 0.004), (0.016, apex + half_notch), (half_notch, apex + half_notch), (0, apex),
        (-half_notch, apex + half_notch), (-0.016, apex + half_notch),
    ]  # fmt: skip
    profile = Polygon(outline)
    along_x = frame_pose(x_axis=(0, 1, 0), z_axis=(1, 0, 0))
    blocks = [
        extrude(profile, *span, "walnut") for span in ((0.010, 0.022), (0.079, 0.086))
    ]
    base = box_between((0, -0.022, 0), (0.096, 0.022, 0.004), "walnut")
    return Part(
        name=name,
        solids=with_mass(
            [base, *(moved(solid, along_x) for block in blocks for solid in block)],
            0.120,
        ),
        clamped=True,
        seats={
            "tube": frame_pose(
                x_axis=(0, 0, 1), z_axis=(1, 0, 0), at=(0, 0, _STAND_HEIGHT_M)
            )
        },
    )


def tube_rack(name: str = "rack", clearance_m: float = CLEARANCE_M) -> Part:
    """Rack 90 × 44 × 50 mm with three holes in a top and a guide plate, and a 20 mm wide handle block at −x; 250 g, free.

    Origin in the middle of its underside. Tubes end on its floor, 4 mm up. The guide plate's lower face is 32 mm below the
    mouth: a tube within both plates can tilt by 2c / 32 mm = 1.8° at 0.5 mm.
    """
    check_clearance(name, clearance_m)
    hole = circle_outline(TUBE_RADIUS_M + clearance_m, 24, circumscribed=True)
    cells = [(-0.045, -0.013), (-0.013, 0.013), (0.013, 0.045)]
    plates = [
        solid
        for low, high in ((0.018, 0.022), (0.046, 0.050))
        for (x0, x1), x in zip(cells, _RACK_HOLES_M.values(), strict=True)
        for solid in extrude(
            Polygon(box(x0, -0.019, x1, 0.019).exterior, [hole + np.array((x, 0))]),
            low,
            high,
            "blue",
        )
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
            which: Hole(
                part_from_hole=frame_pose(z_axis=(0, 0, -1), at=(x, 0, 0.050)),
                depth_m=0.046,
            )
            for which, x in _RACK_HOLES_M.items()
        },
        grasps={
            "handle": Grasp(
                part_from_tcp=frame_pose(
                    (1, 0, 0), (0, 0, -1), (-0.061, 0, TCP_ABOVE_M)
                ),
                width_m=0.020,
            )
        },
    )
