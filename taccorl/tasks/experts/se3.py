"""Rigid transforms as (4, 4) matrices. Frames are named ``a_from_b``.

Rotation vectors are written out instead of taken from scipy: an expert needs some ten of them a control step, and scipy's
own take 55 µs each, a sixth of it here.
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation

PEAK_OF_MEAN = 1.875
"""Peak speed of a minimum-jerk profile in multiples of its mean."""
_TINY_RAD = 1e-9
_IDENTITY = np.eye(4)
_NEARLY_HALF_TURN = 1e-4  # sine below which a half turn's axis is not to be had from the antisymmetric part


def minimum_jerk(x: float) -> float:
    """Minimum-jerk profile: share of the path at share ``x`` of the time, 10x³ − 15x⁴ + 6x⁵."""
    return 10 * x**3 - 15 * x**4 + 6 * x**5


def transform(
    pos_m: np.ndarray | tuple, rotation: np.ndarray | None = None
) -> np.ndarray:
    """Transform (4, 4) from a position ``pos_m`` (3,) and a rotation matrix (3, 3) (identity by default)."""
    pose = _IDENTITY.copy()  # in a third of the time of np.eye
    pose[:3, 3] = pos_m
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose


def inverse(pose: np.ndarray) -> np.ndarray:
    """Inverse (4, 4) of a rigid transform ``pose`` (4, 4)."""
    turned = pose[:3, :3].T
    return transform(-turned @ pose[:3, 3], turned)


def turn(rotvec_rad: np.ndarray | tuple) -> np.ndarray:
    """Rotation (4, 4) by the rotation vector ``rotvec_rad`` (3,), about the origin: I + sin θ/θ [v]× + (1 − cos θ)/θ² [v]×²
    (Rodrigues).
    """
    x, y, z = map(float, rotvec_rad)
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < _TINY_RAD:
        s, c = 1.0, 0.5
    else:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    return np.array(
        [
            [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y, 0.0],
            [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x, 0.0],
            [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y), 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def rotvec(rotation_from: np.ndarray, rotation_to: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) [rad], in the first frame, that turns ``rotation_from`` into ``rotation_to``: poses (4, 4) or
    rotations (3, 3).
    """
    matrix = rotation_from[:3, :3].T @ rotation_to[:3, :3]
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix.tolist()
    axis = (zy - yz) / 2, (xz - zx) / 2, (yx - xy) / 2  # times the sine of the angle
    sine, cosine = math.hypot(*axis), (xx + yy + zz - 1.0) / 2
    if sine < _NEARLY_HALF_TURN and cosine < 0:
        return Rotation.from_matrix(matrix).as_rotvec()
    scale = 1.0 if sine < _TINY_RAD else math.atan2(sine, cosine) / sine
    return np.array([scale * axis[0], scale * axis[1], scale * axis[2]])


def between(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """Interpolate two poses (4, 4) → (4, 4): linear in position, constant axis in rotation; ``share`` 0 is the start, 1 the
    end.
    """
    pose = start @ turn(share * rotvec(start, end))
    pose[:3, 3] = (1 - share) * start[:3, 3] + share * end[:3, 3]
    return pose


def is_on_way(
    here: np.ndarray, start: np.ndarray, end: np.ndarray, near_m: float, near_rad: float
) -> bool:
    """Whether the pose ``here`` is no farther than ``near_m`` from the straight way between two poses (4, 4), and turned by no
    more than ``near_rad`` from its end."""
    way, gone = end[:3, 3] - start[:3, 3], here[:3, 3] - start[:3, 3]
    left = gone - float(np.clip(gone @ way / (way @ way), 0.0, 1.0)) * way
    return bool(
        np.linalg.norm(left) < near_m and np.linalg.norm(rotvec(here, end)) < near_rad
    )
