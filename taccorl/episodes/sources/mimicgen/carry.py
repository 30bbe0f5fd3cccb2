"""Retargeting of a motion to a new scene: transforms of objects and held objects, bridges, and choice of a near source.

Pure functions of (4, 4) poses ``a_from_b``.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from taccorl.tasks.experts.se3 import (
    PEAK_OF_MEAN,
    between,
    inverse,
    minimum_jerk,
    rotvec,
    turn,
)

NEAREST = 3
"""Number of source demonstrations, those whose object lies nearest to that of the new scene, from which one is drawn."""
_M_PER_RAD = (
    0.2  # in the distance of poses; a hand is about 0.2 m long. MimicGen's value is 1
)
_BRIDGE_MPS, _BRIDGE_RADPS = 0.25, 1.5  # peak speeds
_ROUNDING = 1e-6


class Distance(NamedTuple):
    """Distance of two poses: position [m] and rotation [rad]."""

    position_m: float
    rotation_rad: float


def distance(one: np.ndarray, other: np.ndarray) -> Distance:
    """Distance of one pose (4, 4) from another (4, 4): that of the positions, and the angle between the rotations."""
    return Distance(
        float(np.linalg.norm(one[:3, 3] - other[:3, 3])),
        float(np.linalg.norm(rotvec(one, other))),
    )


def look_alike(pose: np.ndarray, reference: np.ndarray, num_turns: int) -> np.ndarray:
    """Rotate ``pose`` (4, 4) about its own z axis by one of its symmetries, so that it is nearest to the rotation of
    ``reference`` (4, 4); returns (4, 4).

    ``num_turns`` rotations, in equal steps of a whole turn, look the same; 0: any angle.
    """
    if num_turns == 1:
        return pose
    off = pose[:3, :3].T @ reference[:3, :3]
    angle = math.atan2(off[1, 0] - off[0, 1], off[0, 0] + off[1, 1])
    period = 2 * math.pi / num_turns if num_turns else 0.0
    return pose @ turn((0, 0, period * round(angle / period) if period else angle))


def object_delta(new: np.ndarray, source: np.ndarray, num_turns: int = 1) -> np.ndarray:
    """Δ = O_new · O_src⁻¹ (4, 4), world to world: the transform that moves an object from its pose ``source`` (4, 4) to ``new``
    (4, 4), where ``num_turns`` rotations of it look the same (``look_alike``).
    """
    return look_alike(new, source, num_turns) @ inverse(source)


def in_hand_correction(
    tcp_src: np.ndarray,
    held_src: np.ndarray,
    tcp_new: np.ndarray,
    held_new: np.ndarray,
    num_turns: int = 1,
) -> np.ndarray:
    """C = G_src · G_new⁻¹ (4, 4) with G = TCP-from-held: a hand that follows T · C takes what it holds along the source's path.

    T_new · G_new = T_src · C · G_new = T_src · G_src, for every T_src. ``tcp_src``, ``held_src``: world poses (4, 4) of TCP and
    held object in the source. ``tcp_new``, ``held_new``: their present world poses (4, 4). ``num_turns``: as in ``look_alike``.
    """
    in_hand_src, in_hand_new = inverse(tcp_src) @ held_src, inverse(tcp_new) @ held_new
    return in_hand_src @ inverse(look_alike(in_hand_new, in_hand_src, num_turns))


def bridge(start: np.ndarray, end: np.ndarray, hz: float) -> list[np.ndarray]:
    """Poses (4, 4), one per control step, after ``start`` (4, 4) up to ``end`` (4, 4), straight, minimum jerk, at most 0.25 m/s
    and 1.5 rad/s; none if the two are the same. ``hz`` is the rate of control steps.
    """
    off = distance(start, end)
    duration_s = PEAK_OF_MEAN * max(
        off.position_m / _BRIDGE_MPS, off.rotation_rad / _BRIDGE_RADPS
    )
    num = math.ceil(duration_s * hz - _ROUNDING)
    return [between(start, end, minimum_jerk(k / num)) for k in range(1, num + 1)]


def one_of_nearest(distances: Sequence[Distance], rng: np.random.Generator) -> int:
    """Index of one of the ``NEAREST`` nearest sources, drawn uniformly; ``distances`` has one entry for each source."""
    size = [d.position_m + _M_PER_RAD * d.rotation_rad for d in distances]
    nearest = np.argsort(size, kind="stable")[:NEAREST]
    return int(nearest[rng.integers(len(nearest))])
