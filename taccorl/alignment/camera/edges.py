"""Edges that camera calibration compares: outlines of the twin's arms, and edges of a picture.

An edge of the twin is where neighbouring pixels show different bodies or a jump of depth; its position in space is that of the
nearer body. Edges of a picture are Canny's, refined to a fraction of a pixel along the gradient. Each point of the twin is
matched with the nearest picture edge of similar direction, and compared by its distance from the line of that edge:
displacements along an edge are not measured. The sign of the contrast is ignored, so that light and colour may differ.

Letters in shapes: P points, D directions.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from taccorl.sim.cameras import Intrinsics

NUM_DIRECTIONS = 8
"""Number of directions into which edges are sorted; a match is searched among edges within 180° / 8 = 22.5° of the nearest of
them."""
_STRONG, _LEAST = (
    6.0,
    30.0,
)  # an edge's gradient over the noise's, and at least [counts, sum of Sobel's weights]


@dataclass(frozen=True)
class TwinEdges:
    """Points on the outlines of the twin's arms in one view."""

    points: np.ndarray  # (P, 3) positions [m] in the camera's frame
    normals: (
        np.ndarray
    )  # (P, 2) unit vectors across the edge in the picture; the sign is arbitrary
    bodies: np.ndarray  # (P,) index of the body to which the outline belongs


def twin_edges(
    bodies: np.ndarray, depth_m: np.ndarray, intrinsics: Intrinsics
) -> TwinEdges:
    """Outlines in a view. ``bodies``: (rows, columns) int, index of the body that each pixel shows; 0 if it shows no arm.
    ``depth_m``: (rows, columns), distance along the optical axis [m], infinite where nothing is shown."""
    near_depth = np.where(bodies > 0, depth_m, np.inf)
    # A value of its own for each body: whatever meets, its gradient points across the edge.
    value = ((bodies * 0.618034) % 1.0).astype(np.float32) + (bodies > 0)
    value = cv2.GaussianBlur(value, (0, 0), 1.5)
    across, down = (cv2.Sobel(value, cv2.CV_32F, dx, 1 - dx, ksize=3) for dx in (1, 0))
    depth_smooth = cv2.GaussianBlur(
        np.where(bodies > 0, depth_m, 0).astype(np.float32), (0, 0), 1.5
    )
    inner = [cv2.Sobel(depth_smooth, cv2.CV_32F, dx, 1 - dx, ksize=3) for dx in (1, 0)]
    parts = []
    for axis in (0, 1):
        first, second = (_side(bodies, axis, k) for k in (0, 1))
        first_m, second_m = (_side(near_depth, axis, k) for k in (0, 1))
        with np.errstate(invalid="ignore"):
            step = np.nan_to_num(np.abs(first_m - second_m), posinf=np.inf)
        # A jump of 10 mm within one body: one of its shapes stands before another. Where
        # it is less than three times the steps beside it, it is a face at a slant.
        jump = (
            (first == second)
            & (first > 0)
            & (step > 0.01)
            & (step > 3.0 * _beside(step, axis))
        )
        v, u = np.nonzero((first != second) | jump)
        one, other = first_m[v, u], second_m[v, u]
        nearer = other < one
        normal = np.stack([across[v, u], down[v, u]], axis=1)
        within = np.stack([inner[0][v, u], inner[1][v, u]], axis=1)
        normal = np.where(jump[v, u][:, None], within, normal)
        half = np.array([0.5, 0.0]) if axis == 1 else np.array([0.0, 0.5])
        owner = np.where(nearer, second[v, u], first[v, u])
        parts.append(
            (np.stack([u, v], axis=1) + half, np.minimum(one, other), normal, owner)
        )
    pixels, depth, normals, owners = (
        np.concatenate(part) for part in zip(*parts, strict=True)
    )
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-6
    pixels, depth = pixels[good], depth[good]
    across_m = (pixels[:, 0] - intrinsics.cx_px) / intrinsics.fx_px * depth
    down_m = (pixels[:, 1] - intrinsics.cy_px) / intrinsics.fy_px * depth
    return TwinEdges(
        points=np.stack([across_m, -down_m, -depth], axis=1),
        normals=normals[good] / length[good, None],
        bodies=owners[good],
    )


def _side(image: np.ndarray, axis: int, k: int) -> np.ndarray:
    """All pixels but the last (k = 0) or the first (k = 1) along an axis."""
    return np.take(image, range(k, image.shape[axis] - 1 + k), axis=axis)


def _beside(step: np.ndarray, axis: int) -> np.ndarray:
    """The larger of the steps before and after each along an axis; none beyond the ends."""
    wide = np.pad(step, [(1, 1) if k == axis else (0, 0) for k in (0, 1)])
    return np.maximum(
        *(np.take(wide, range(k, k + step.shape[axis]), axis=axis) for k in (0, 2))
    )


class PictureEdges:
    """Edges of a picture (rows, columns, 3) uint8, with a lookup of the nearest edge of a given direction."""

    def __init__(self, picture: np.ndarray) -> None:
        gray = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        dx, dy = (cv2.Sobel(gray, cv2.CV_16S, k, 1 - k, ksize=3) for k in (1, 0))
        size = np.hypot(dx, dy, dtype=np.float32)
        noise = (
            float(np.median(size)) / 1.1774
        )  # of a Rayleigh distribution, which the median has least of edges
        strong = max(_STRONG * noise, _LEAST)
        edge = cv2.Canny(dx, dy, strong / 2, strong, L2gradient=True) > 0
        edge[[0, -1]] = edge[:, [0, -1]] = False
        v, u = np.nonzero(edge)
        self.normals = np.stack([dx[v, u], dy[v, u]], axis=1) / size[v, u][:, None]
        """(P, 2) unit vectors across the edges."""
        self.pixels = (
            np.stack([u, v], axis=1)
            + self.normals * _peak(size, u, v, self.normals)[:, None]
        )
        """(P, 2) positions as (u, v) [px]."""
        self._shape = edge.shape
        self._nearest = self._maps(u, v)

    def match(
        self, pixels: np.ndarray, normals: np.ndarray, reach_px: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For points at ``pixels`` (P, 2) = (u, v) [px] with ``normals`` (P, 2), the nearest edges of similar direction in the
        picture. Returns pixels (P, 2) and normals (P, 2) of those edges, and (P,) bool: there is one within ``reach_px``. The
        first two are meaningless where the third is false."""
        rows, columns = self._shape
        inside = np.isfinite(pixels).all(1)
        u, v = (
            np.where(inside, np.round(pixels[:, k]), -1).astype(int) for k in (0, 1)
        )
        inside &= (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        number = np.full(len(pixels), -1)
        number[inside] = self._nearest[
            _direction(normals[inside]), v[inside], u[inside]
        ]
        found = number >= 0
        if not found.any():
            return np.zeros((len(pixels), 2)), np.zeros((len(pixels), 2)), found
        edges, across = self.pixels[number], self.normals[number]
        with np.errstate(invalid="ignore"):
            found &= np.linalg.norm(edges - pixels, axis=1) <= reach_px
        return edges, across, found

    def _maps(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(D, rows, columns) int32 number of the nearest edge of a direction, −1 where there is none at all."""
        maps = np.full((NUM_DIRECTIONS, *self._shape), -1, np.int32)
        middle = np.pi * np.arange(NUM_DIRECTIONS) / NUM_DIRECTIONS
        for k, angle in enumerate(middle):
            like = np.abs(self.normals @ [np.cos(angle), np.sin(angle)]) > np.cos(
                np.pi / NUM_DIRECTIONS
            )
            if not like.any():
                continue
            free = np.ones(self._shape, np.uint8)
            free[v[like], u[like]] = 0
            kind = cv2.DIST_LABEL_PIXEL
            _, labels = cv2.distanceTransformWithLabels(
                free, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=kind
            )
            number = np.empty(labels.max() + 1, np.int32)
            number[labels[v[like], u[like]]] = np.flatnonzero(like)
            maps[k] = number[labels]
        return maps


def _direction(normals: np.ndarray) -> np.ndarray:
    angle = np.arctan2(normals[:, 1], normals[:, 0])
    return np.round(angle / np.pi * NUM_DIRECTIONS).astype(int) % NUM_DIRECTIONS


def _peak(
    size: np.ndarray, u: np.ndarray, v: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """(P,) how far [px] along its normal the gradient peaks: a parabola through three of its values."""
    at = np.stack([v, u])
    before, here, after = (
        map_coordinates(size, at + k * normals.T[::-1], order=1, mode="nearest")
        for k in (-1, 0, 1)
    )
    bend = before - 2 * here + after
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = 0.5 * (before - after) / bend
    return np.where(bend < 0, np.clip(shift, -1.0, 1.0), 0.0)
