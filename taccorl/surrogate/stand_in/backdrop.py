"""Static background of the stand-in's pictures: table, cutting mat, wall, columns, and sensor noise. Colours are BGR."""

import functools
from collections.abc import Callable

import cv2
import numpy as np

from taccorl.surrogate.stand_in.kinematics import ARMS, MOUNT_POS_WORLD

_TABLE_MIN_M, _TABLE_SIZE_M = (-0.25, -0.75), (1.10, 1.50)  # x, y in world
_MAT_M = ((0.08, 0.72), (-0.46, 0.46))  # from, to in x and y
_TABLE_BGR, _MAT_BGR = (108, 152, 190), (98, 92, 46)
SHADE = 0.62  # brightness left in a shadow
"""Factor on the brightness in a shadow."""

Project = Callable[[np.ndarray], np.ndarray]  # world points (..., 3) -> pixels (..., 2)
"""Function from world points (..., 3) [m] to pixels (..., 2)."""


def _texel_m(rows: int) -> float:
    return 0.001 * 480 / max(rows, 120)


def table_from_texel(rows: int) -> np.ndarray:
    """Homography (3, 3): world (x, y, 1) [m] of a texture position (column, row, 1); columns run along y, rows along x.

    Args:
        rows: height of the camera's picture [pixels], as in ``table_texture``.
    """
    m = _texel_m(rows)
    return np.array([[0, m, _TABLE_MIN_M[0]], [m, 0, _TABLE_MIN_M[1]], [0, 0, 1.0]])


@functools.lru_cache(maxsize=2)
def table_texture(rows: int) -> np.ndarray:
    """Texture (X, Y, 3) uint8 BGR of a wooden table with a cutting mat ruled every 10 and 50 mm, seen from above.

    Its first axis runs along the world's x, the second along y (``table_from_texel``).

    Args:
        rows: height of the camera's picture [pixels], for which the resolution is chosen: 1 mm a texel at 480.
    """
    m = _texel_m(rows)
    nx, ny = (round(size / m) for size in _TABLE_SIZE_M)
    rng = np.random.default_rng(7)
    grain = cv2.GaussianBlur(rng.normal(0, 21, (nx, 1 + ny // 40)).astype(np.float32), (0, 0), 1.2)
    grain = cv2.resize(grain, (ny, nx), interpolation=cv2.INTER_CUBIC) + rng.normal(0, 5, (nx, ny)).astype(np.float32)
    table = np.array(_TABLE_BGR, np.float32) + grain[..., None]
    (x0, x1), (y0, y1) = (
        [round((edge - origin) / m) for edge in edges] for edges, origin in zip(_MAT_M, _TABLE_MIN_M, strict=True)
    )
    mat = np.full((x1 - x0, y1 - y0), 0, np.float32)
    for step_m, thickness_m, lighter in ((0.01, 0.0007, 14), (0.05, 0.0014, 42)):
        for at in np.arange(0, max(mat.shape) * m, step_m):
            line = slice(round(at / m), round(at / m) + max(1, round(thickness_m / m)))
            mat[line] += lighter
            mat[:, line] += lighter
    mat += cv2.GaussianBlur(rng.normal(0, 9, mat.shape).astype(np.float32), (0, 0), 0.7)
    table[x0:x1, y0:y1] = np.array(_MAT_BGR, np.float32) + mat[..., None]
    cv2.rectangle(table, (y0, x0), (y1, x1), (150, 160, 120), max(1, round(0.003 / m)))
    return np.clip(table, 0, 255).astype(np.uint8)


def front_backdrop(rows: int, columns: int, pixel_from_table: np.ndarray, project: Project) -> np.ndarray:
    """Picture of the front camera without arms and parts, (rows, columns, 3) uint8 BGR.

    Args:
        pixel_from_table: (3, 3) homography from world (x, y, 1) [m] on the table to pixels.
        project: projection of world points to pixels.
    """
    rng = np.random.default_rng(8)
    wall = np.linspace(150, 196, rows, dtype=np.float32)[:, None, None] * np.array([1.0, 0.99, 0.96], np.float32)
    picture = np.clip(wall + rng.normal(0, 2.5, (rows, columns, 1)), 0, 255).astype(np.uint8)
    for left, top, right, bottom, colour in (  # posters and a window, as parts of the picture
        (0.05, 0.04, 0.28, 0.23, (120, 96, 70)),
        (0.37, 0.00, 0.63, 0.15, (205, 206, 200)),
        (0.73, 0.06, 0.94, 0.24, (92, 118, 150)),
    ):
        corners = (int(left * columns), int(top * rows)), (int(right * columns), int(bottom * rows))
        cv2.rectangle(picture, *corners, colour, -1)
    picture = cv2.GaussianBlur(picture, (0, 0), rows / 120)  # out of focus
    warp = pixel_from_table @ table_from_texel(rows)
    size = (columns, rows)
    cv2.warpPerspective(table_texture(rows), warp, size, picture, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    for arm in ARMS:
        x, y, z = MOUNT_POS_WORLD[arm]
        near, far, side, other = x + 0.06, x - 0.06, y - 0.06, y + 0.06
        front_face = [(near, side, 0.0), (near, other, 0.0), (near, other, z), (near, side, z)]
        top_face = [(far, side, z), (far, other, z), (near, other, z), (near, side, z)]
        for face, grey in ((front_face, 78), (top_face, 104)):
            outline = np.round(project(np.array(face)) * 16).astype(np.int32)
            cv2.fillConvexPoly(picture, outline, (grey, grey, grey - 4), cv2.LINE_AA, shift=4)
    return picture


@functools.lru_cache(maxsize=2)
def sensor_noise(rows: int, columns: int) -> np.ndarray:
    """(rows + 32, columns + 32, 3) uint8, 0 … 30 with mean 9: noise, larger than a picture so that every picture can cut its
    own piece."""
    noise = np.random.default_rng(9).normal(9.0, 5.2, (rows + 32, columns + 32, 3))
    return np.clip(np.round(noise), 0, 30).astype(np.uint8)
