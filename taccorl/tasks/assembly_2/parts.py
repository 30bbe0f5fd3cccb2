"""Plug and open cradle, which supports the plug only if its centre of mass is inside. Dimensions are choices."""

from dataclasses import replace

import numpy as np

from taccorl.sim.part import CLEARANCE_M, Hole, Mate, Part, check_clearance, frame_pose
from taccorl.sim.shapes import box_between, with_mass
from taccorl.tasks.air_assembly.parts import TAIL_LENGTH_M, side_grasp


def cradle_plug(name: str = "plug") -> Part:
    """Square 20 × 20 × 36 mm on a head 24 × 20 × 30 mm, 70 g, its centre of mass 19 mm from the tip. Origin at the tip.

    41.2 g of it are a brass core of 18 × 18 × 15 mm in the tip. The underside, −y, is flush: it lies flat.
    """
    shaft = box_between((-0.010, -0.010, 0), (0.010, 0.010, 0.036), "violet")
    head = box_between((-0.012, -0.010, 0.036), (0.012, 0.010, 0.066), "violet")
    plastic = with_mass([shaft, head], 0.0288)
    core = replace(
        box_between((-0.009, -0.009, 0.0007), (0.009, 0.009, 0.0157)),
        mass_kg=0.0412,
        touches=False,
    )
    return Part(
        name=name,
        solids=[*plastic, core],
        table_from_part=frame_pose(
            x_axis=(0, 1, 0), z_axis=(1, 0, 0), at=(0, 0, 0.010)
        ),
        # Turned about y, not x, so that both have their open, upper side at +y.
        mate=Mate(
            part_from_mate=frame_pose(x_axis=(-1, 0, 0), z_axis=(0, 0, -1)), num_turns=4
        ),
        grasps={
            "head": side_grasp((0, -1, 0), height_m=0.010, z_m=0.051, width_m=0.024)
        },
    )


def open_cradle(name: str = "cradle", clearance_m: float = CLEARANCE_M) -> Part:
    """U-shaped cradle 36 mm wide and 34 mm deep, open at +y, then 30 mm of solid tail, 160 g. Origin in the mouth, z into it.

    A closed socket holds a plug by the couple between its floor and its roof from 8 mm on. Without the roof the plug stays
    only if its centre of mass is inside (tests/tasks/test_parts.py).
    """
    check_clearance(name, clearance_m)
    inner, outer, end = 0.010 + clearance_m, 0.018, 0.034
    solids = [
        box_between((-outer, -0.020, 0), (outer, -inner, end), "teal"),
        box_between((inner, -inner, 0), (outer, 0.010, end), "teal"),
        box_between((-outer, -inner, 0), (-inner, 0.010, end), "teal"),
        box_between((-outer, -0.020, end), (outer, 0.010, end + TAIL_LENGTH_M), "teal"),
    ]
    return Part(
        name=name,
        solids=with_mass(solids, 0.160),
        table_from_part=frame_pose(
            x_axis=(0, 1, 0), z_axis=(1, 0, 0), at=(0, 0, 0.020)
        ),
        holes={"cradle": Hole(part_from_hole=np.eye(4), depth_m=end)},
        grasps={
            "tail": side_grasp(
                (0, -1, 0),
                height_m=0.020,
                z_m=end + TAIL_LENGTH_M / 2,
                width_m=2 * outer,
            )
        },
    )
