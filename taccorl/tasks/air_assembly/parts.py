"""Dimensions of parts, and poses of the hand that grips them, which the tasks assembly_1 and assembly_2 have in common."""

import numpy as np

from taccorl.sim.part import TCP_ABOVE_M, Grasp, frame_pose

TAIL_LENGTH_M = (
    0.030  # solid block behind each hole: there the hand is clear of the other hand
)


def side_grasp(approach: tuple, height_m: float, z_m: float, width_m: float) -> Grasp:
    """Grasp from above, for a part that lies with its axis level, ``height_m`` above the table: the fingers end 4 mm above the
    table. TCP x points to the partner. ``approach`` is the hand's direction in the part's frame, a unit vector of 3 numbers;
    ``z_m`` the place along the part.
    """
    at = -np.asarray(approach) * (TCP_ABOVE_M - height_m) + (0, 0, z_m)
    return Grasp(
        part_from_tcp=frame_pose((0, 0, -1), approach, tuple(at)), width_m=width_m
    )
