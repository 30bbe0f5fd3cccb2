"""Retargeting of a motion to a new scene: transforms of objects and held objects, bridges, and choice of the nearest source.

Pure functions of (4, 4) poses ``a_from_b``.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from taccorl.episodes.sources.mimicgen.spec import BridgeSpec, SelectionSpec
from taccorl.tasks.experts.se3 import PEAK_OF_MEAN, between, inverse, minimum_jerk, rotvec, turn

_ROUNDING = 1e-6


class Distance(NamedTuple):
    """Distance of two poses: position [m] and rotation [rad]."""

    position_m: float
    rotation_rad: float


def distance(one: np.ndarray, other: np.ndarray) -> Distance:
    """Distance of one pose (4, 4) from another (4, 4): that of the positions, and the angle between the rotations."""
    return Distance(float(np.linalg.norm(one[:3, 3] - other[:3, 3])), float(np.linalg.norm(rotvec(one, other))))


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


def translation(delta: np.ndarray, source: np.ndarray) -> np.ndarray:
    """The translation (4, 4) by which ``delta`` (4, 4) moves the object at ``source`` (4, 4), without its rotation."""
    shift = np.eye(4)
    shift[:3, 3] = (delta @ source)[:3, 3] - source[:3, 3]
    return shift


def shaken(delta: np.ndarray, about: np.ndarray, shift_m: np.ndarray, turn_rad: np.ndarray) -> np.ndarray:
    """``delta`` (4, 4) followed by a rotation vector ``turn_rad`` (3,) about the position to which it moves the pose ``about``
    (4, 4), and by a translation ``shift_m`` (3,), in world coordinates; returns (4, 4).
    """
    centre = (delta @ about)[:3, 3]
    extra = turn(turn_rad)
    extra[:3, 3] = centre - extra[:3, :3] @ centre + shift_m
    return extra @ delta


def in_hand_correction(
    tcp_src: np.ndarray, held_src: np.ndarray, tcp_new: np.ndarray, held_new: np.ndarray, num_turns: int = 1
) -> np.ndarray:
    """C = G_src · G_new⁻¹ (4, 4) with G = TCP-from-held: a hand that follows T · C takes what it holds along the source's path.

    T_new · G_new = T_src · C · G_new = T_src · G_src, for every T_src. ``tcp_src``, ``held_src``: world poses (4, 4) of TCP and
    held object in the source. ``tcp_new``, ``held_new``: their present world poses (4, 4). ``num_turns``: as in ``look_alike``.
    """
    in_hand_src, in_hand_new = inverse(tcp_src) @ held_src, inverse(tcp_new) @ held_new
    return in_hand_src @ inverse(look_alike(in_hand_new, in_hand_src, num_turns))


def bridge(start: np.ndarray, end: np.ndarray, limits: BridgeSpec, hz: float) -> list[np.ndarray]:
    """Poses (4, 4), one per control step, after ``start`` (4, 4) up to ``end`` (4, 4), straight, minimum jerk, within the peak
    speeds ``limits``; none if the two are the same. ``hz`` is the rate of control steps.
    """
    off = distance(start, end)
    duration_s = PEAK_OF_MEAN * max(off.position_m / limits.speed_mps, off.rotation_rad / limits.turn_radps)
    num = math.ceil(duration_s * hz - _ROUNDING)
    return [between(start, end, minimum_jerk(k / num)) for k in range(1, num + 1)]


def one_of_nearest(distances: Sequence[Distance], how: SelectionSpec, rng: np.random.Generator) -> int:
    """Index of one of the ``nn_k`` nearest sources, drawn uniformly; ``distances`` has one entry for each source."""
    size = [how.pos_weight * d.position_m + how.rot_weight * d.rotation_rad for d in distances]
    nearest = np.argsort(size, kind="stable")[: how.nn_k]
    return int(nearest[rng.integers(len(nearest))])
