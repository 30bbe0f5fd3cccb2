"""Tenon plug and mortise socket. Dimensions are choices."""

from dataclasses import replace

import numpy as np

from taccorl.sim.part import (
    CLEARANCE_M,
    LEADING_END,
    Hole,
    Mate,
    Part,
    check_clearance,
    frame_pose,
)
from taccorl.sim.shapes import box_between, with_mass
from taccorl.tasks.air_assembly.parts import TAIL_LENGTH_M, side_grasp


def tenon_plug(name: str = "plug") -> Part:
    """Tenon 18 × 12 × 45 mm on a head 24 × 20 × 30 mm, 80 g; the head is the heavier, so it lies flat. Origin at the tip."""
    tenon = box_between((-0.009, -0.006, 0), (0.009, 0.006, 0.045), "orange")
    head = box_between((-0.012, -0.010, 0.045), (0.012, 0.010, 0.075), "orange")
    return Part(
        name=name,
        solids=[replace(tenon, mass_kg=0.015), replace(head, mass_kg=0.065)],
        table_from_part=frame_pose(
            x_axis=(0, 0, 1), z_axis=(1, 0, 0), at=(0, 0, 0.012)
        ),
        mate=Mate(part_from_mate=LEADING_END, num_turns=2),
        grasps={
            "head": side_grasp((-1, 0, 0), height_m=0.012, z_m=0.060, width_m=0.020)
        },
    )


def tenon_socket(name: str = "socket", clearance_m: float = CLEARANCE_M) -> Part:
    """Block 36 × 30 mm with a mortise 38 mm deep, then 30 mm of solid tail, 150 g. Origin in the mouth, z into it.
    ``clearance_m`` is the clearance on each side of the tenon.
    """
    check_clearance(name, clearance_m)
    x, y, end = 0.009 + clearance_m, 0.006 + clearance_m, 0.038
    solids = [
        box_between((x, -0.015, 0), (0.018, 0.015, end), "slate"),
        box_between((-0.018, -0.015, 0), (-x, 0.015, end), "slate"),
        box_between((-x, y, 0), (x, 0.015, end), "slate"),
        box_between((-x, -0.015, 0), (x, -y, end), "slate"),
        box_between(
            (-0.018, -0.015, end), (0.018, 0.015, end + TAIL_LENGTH_M), "slate"
        ),
    ]
    return Part(
        name=name,
        solids=with_mass(solids, 0.150),
        table_from_part=frame_pose(
            x_axis=(0, 0, 1), z_axis=(1, 0, 0), at=(0, 0, 0.018)
        ),
        holes={"mortise": Hole(part_from_hole=np.eye(4), depth_m=end)},
        grasps={
            "tail": side_grasp(
                (-1, 0, 0), height_m=0.018, z_m=end + TAIL_LENGTH_M / 2, width_m=0.030
            )
        },
    )
