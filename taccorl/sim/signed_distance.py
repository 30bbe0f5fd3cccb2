"""Exact depth of points inside single shapes, and its rate: capsules, cylinders and convex solids.

A taxel at (x, y) of its pad lies at p = a_x x + a_y y + t in a shape's frame and moves there with ṗ = v + w × (p − t).
Both are linear in (x, y, 1), so one (3, 3) matrix each says where all taxels of a pad are: its columns belong to x, y, 1.
Depth is the distance from p to the shape's surface, positive inside; what it is outside does not matter to a taxel.
Depth is computed in single precision, which is good to 1e-8 m within 0.2 m of a shape's origin.

Letters in shapes: n pairs of pad and shape, G shapes of a kind, F faces, N corners of a face, V vertices, K taxels, S points,
R rectangles.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.spatial import ConvexHull

FLAT_M = 1e-7
"""Vertices this close to a plane lie in it. MuJoCo stores mesh vertices in single precision: 4e-9 m at 0.1 m."""
FAR_M = 1e3
"""Used in place of infinity, because infinity times 0 is NaN."""
TINY_M = 1e-12
"""Least divisor for distances, which are 0 on a shape's axis and on an edge."""
_PAIRS_AT_ONCE = 64  # of six faces and 384 taxels they are 0.6 MB: a core's cache holds what is being worked on


class Felt(NamedTuple):
    """Depth [m] and depth rate [m/s], each (n, K). Where depth ≤ 0 the point is outside, and both values are undefined."""

    depth_m: np.ndarray
    depth_rate_mps: np.ndarray


class Shapes(Protocol):
    """All G shapes of one kind in a model. Letters in shapes: n pairs of a pad and a shape, K taxels of a pad."""

    @property
    def geoms(self) -> np.ndarray:
        """(G,) ids of the geoms."""
        ...

    def feel(self, shape: np.ndarray, position: np.ndarray, velocity: np.ndarray, grid: np.ndarray) -> Felt:
        """Depth [m] and depth rate [m/s], (n, K) each, of the taxels of n pads, each relative to one shape.

        Args:
            shape: (n,) indices of the shapes.
            position: (n, 3, 3): ``position @ grid`` are the taxels' coordinates in the shape's frame [m].
            velocity: (n, 3, 3): ``velocity @ grid`` are their velocities [m/s].
            grid: (3, K) rows x, y, 1 of the taxels.
        """
        ...


def _in_blocks(feel: Callable[..., Felt], *pairs: np.ndarray, num_taxels: int) -> Felt:
    """``feel`` of a few pairs at a time, so that what it works on stays in a core's cache."""
    felt = Felt(*np.empty((2, len(pairs[0]), num_taxels), np.float32))
    for start in range(0, len(pairs[0]), _PAIRS_AT_ONCE):
        some = slice(start, start + _PAIRS_AT_ONCE)
        felt.depth_m[some], felt.depth_rate_mps[some] = feel(*(array[some] for array in pairs))
    return felt


@dataclass(frozen=True, eq=False)
class Capsules:
    """Capsules along z; a sphere is one of length 0. Depth = radius − distance to the axis."""

    geoms: np.ndarray
    """(G,) ids of the geoms."""
    radius_m: np.ndarray
    """(G, 1) radius [m]."""
    half_length_m: np.ndarray
    """(G, 1) half the length of the axis [m]."""

    def feel(self, shape: np.ndarray, position: np.ndarray, velocity: np.ndarray, grid: np.ndarray) -> Felt:
        def feel_some(shape: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> Felt:
            x, y, z = (position @ grid).swapaxes(0, 1)
            vx, vy, vz = (velocity @ grid).swapaxes(0, 1)
            half = self.half_length_m[shape]
            z = z - np.clip(z, -half, half)
            distance = np.sqrt(x * x + y * y + z * z)
            rate = (x * vx + y * vy + z * vz) / -np.maximum(distance, TINY_M)
            return Felt(self.radius_m[shape] - distance, rate)

        return _in_blocks(feel_some, shape, position, velocity, num_taxels=grid.shape[1])


@dataclass(frozen=True, eq=False)
class Cylinders:
    """Cylinders along z. Depth is the smaller distance: to the side, or to the nearer end."""

    geoms: np.ndarray
    """(G,) ids of the geoms."""
    radius_m: np.ndarray
    """(G, 1) radius [m]."""
    half_length_m: np.ndarray
    """(G, 1) half the length of the axis [m]."""

    def feel(self, shape: np.ndarray, position: np.ndarray, velocity: np.ndarray, grid: np.ndarray) -> Felt:
        def feel_some(shape: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> Felt:
            x, y, z = (position @ grid).swapaxes(0, 1)
            vx, vy, vz = (velocity @ grid).swapaxes(0, 1)
            distance = np.sqrt(x * x + y * y)
            under_side, under_end = self.radius_m[shape] - distance, self.half_length_m[shape] - np.abs(z)
            rate = (x * vx + y * vy) / -np.maximum(distance, TINY_M)
            np.copyto(rate, -vz * np.sign(z), where=under_end < under_side)
            return Felt(np.minimum(under_side, under_end), rate)

        return _in_blocks(feel_some, shape, position, velocity, num_taxels=grid.shape[1])


class PartSurface(Protocol):
    """The surface of a part made of several solids: ``part_surface.Surface``."""

    def depth(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth (S,) [m] of ``points_m`` (S, 3) within the part, and the unit direction (S, 3) in which it grows."""
        ...


@dataclass(frozen=True, eq=False)
class Seams:
    """R rectangles in the faces of one convex solid, in its frame: they enclose the places where other solids of the same part
    touch or cut these faces. Where the nearest point lies in one, the depth is that within the whole part."""

    faces: np.ndarray
    """(R,) index of the solid's face in which each rectangle lies, as in ``Polyhedra.normals``."""
    axes: np.ndarray
    """(2 R, 3) float32: the two axes of each rectangle."""
    centres_m: np.ndarray
    """(2 R,) coordinate of each rectangle's centre along its axes."""
    halves_m: np.ndarray
    """(2 R,) half the side along each axis."""


@dataclass(frozen=True, eq=False)
class Polyhedra:
    """Convex solids of at most F faces: boxes, convex meshes, planes. Depth is the distance to the nearest face.

    Where another solid of the same body touches or cuts a face, the face is not part of the outer surface. Where the nearest
    point is such a *seam*, the depth is the distance to the surface of the whole part instead (``PartSurface``), exact as well.
    """

    geoms: np.ndarray
    """(G,) ids of the geoms."""
    normals: np.ndarray
    """(G, F, 3) outward unit normals of the faces, float32; shapes with fewer than F faces are padded with zeros."""
    offsets_m: np.ndarray
    """(G, F) n · p of the face's points; padded with ``FAR_M``. Faces at a seam lie a little further out, so that no point
    falls between two solids."""
    covered: np.ndarray
    """(G, F) bool: the whole face is treated as a seam."""
    seams: list[Seams | None]
    """Per shape: rectangles in its other faces that are seams; None without any."""
    surfaces: list[PartSurface | None]
    """Per shape: the outer surface of its part; None if the shape has no seams."""
    body_from_geom: np.ndarray
    """(G, 3, 4) pose of each geom in its body's frame."""

    def feel(self, shape: np.ndarray, position: np.ndarray, velocity: np.ndarray, grid: np.ndarray) -> Felt:
        at_seam = np.zeros((len(shape), grid.shape[1]), bool)

        def feel_some(shape: np.ndarray, position: np.ndarray, velocity: np.ndarray, at_seam: np.ndarray) -> Felt:
            normals = self.normals[shape]
            under = -(normals @ position)
            under[:, :, 2] += self.offsets_m[shape]
            under_face = under @ grid
            depth = under_face.min(axis=1)
            nearest = under_face == depth[:, None]
            rate_of_face = -(normals @ velocity) @ grid
            rate = np.empty_like(depth)
            for face in range(normals.shape[1]):
                np.copyto(rate, rate_of_face[:, face], where=nearest[:, face])
            self._mark_seams(shape, position, grid, nearest, at_seam)
            at_seam &= depth > 0
            return Felt(depth, rate)

        felt = _in_blocks(feel_some, shape, position, velocity, at_seam, num_taxels=grid.shape[1])
        pair, taxel = np.nonzero(at_seam)
        if len(pair):
            where = grid[:, taxel].T.astype(float)
            point, speed = (_combined(matrix[pair], where) for matrix in (position, velocity))
            felt.depth_m[pair, taxel], felt.depth_rate_mps[pair, taxel] = self._within_part(shape[pair], point, speed)
        return felt

    def _mark_seams(
        self, shape: np.ndarray, position: np.ndarray, grid: np.ndarray, nearest: np.ndarray, at_seam: np.ndarray
    ) -> None:
        """Sets at_seam (n, K) where the ``nearest`` (n, F, K) point of the solid's own faces is in a seam."""
        covered = self.covered[shape]
        if covered.any():
            np.any(nearest & covered[:, :, None], axis=1, out=at_seam)
        for one in np.unique(shape):
            if (seams := self.seams[one]) is not None:
                mine = np.nonzero(shape == one)[0]
                at = seams.axes @ position[mine]
                at[:, :, 2] -= seams.centres_m
                inside = (np.abs(at @ grid) < seams.halves_m[:, None]).reshape(len(mine), len(seams.faces), 2, -1)
                at_seam[mine] |= (inside.all(axis=2) & nearest[mine][:, seams.faces]).any(axis=1)

    def _within_part(self, shape: np.ndarray, point: np.ndarray, speed: np.ndarray) -> Felt:
        """(S,) depth and rate of points (S, 3) in the frames of shapes (S,), moving there."""
        felt = Felt(*np.zeros((2, len(shape))))
        body_from_geom = self.body_from_geom[shape]
        turn, shift = body_from_geom[:, :, :3], body_from_geom[:, :, 3]
        point, speed = _combined(turn, point) + shift, _combined(turn, speed)
        parts = {id(surface): surface for one in np.unique(shape) if (surface := self.surfaces[one]) is not None}
        part_of_shape = np.array([id(surface) for surface in self.surfaces])
        for number, surface in parts.items():
            mine = np.nonzero(part_of_shape[shape] == number)[0]
            felt.depth_m[mine], inward = surface.depth(point[mine])
            felt.depth_rate_mps[mine] = dot(inward, speed[mine])
        return felt


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products (...) of ``a`` and ``b`` (..., 3), written out: in a fixed order one simulation gives the same bits alone and
    in a batch.
    """
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _combined(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Columns of (S, 3, 3) matrices times (S, 3) weights, summed in a fixed order: (S, 3)."""
    first, second, third = (columns[:, :, i] * weights[:, i, None] for i in range(3))
    return first + second + third


@dataclass(frozen=True, eq=False)
class Polyhedron:
    """One convex solid: F faces as planes, and their corners."""

    normals: np.ndarray
    """(F, 3) outward unit normals of the faces."""
    offsets_m: np.ndarray
    """(F,) offset of each face: n · p of its points."""
    corners_m: list[np.ndarray]
    """Corners (N, 3) of each face, counter-clockwise seen from outside."""


def polyhedron(vertices_m: np.ndarray) -> Polyhedron:
    """The convex hull of ``vertices_m`` (V, 3) [m], with coplanar facets merged."""
    hull = ConvexHull(vertices_m)
    facets = vertices_m[hull.simplices]
    area = np.linalg.norm(np.cross(facets[:, 1] - facets[:, 0], facets[:, 2] - facets[:, 0]), axis=1)
    normals, offsets, corners = [], [], []
    outer = vertices_m[hull.vertices]
    for facet in np.argsort(-area, kind="stable"):  # a sliver's own normal may be anything, so the largest first
        if any(np.abs(facets[facet] @ n - o).max() < FLAT_M for n, o in zip(normals, offsets, strict=True)):
            continue
        rough = hull.equations[facet]
        face = outer[np.abs(outer @ rough[:3] + rough[3]) < FLAT_M]
        centre = face.mean(axis=0)
        u, v, normal = np.linalg.svd(face - centre)[2]
        normal = normal * np.sign(normal @ rough[:3])
        u, v = (u, v) if np.cross(u, v) @ normal > 0 else (v, u)
        around = np.argsort(np.arctan2((face - centre) @ v, (face - centre) @ u))
        normals.append(normal)
        offsets.append(normal @ centre)
        corners.append(face[around])
    return Polyhedron(np.array(normals), np.array(offsets), corners)
