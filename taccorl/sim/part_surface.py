"""Outer surface of a part that consists of several convex solids: faces, or pieces of them, that no other solid covers.

Each face is cut along the other solids that touch or overlap it. What lies open stays in convex pieces; what is covered, the
whole face or places in it, is a *seam*: there a point's depth is its distance to the surface of the whole part.

Letters in shapes: F faces of a solid, N corners of a polygon, Q pieces of surface, E sides of a piece, M edges, C cells, B boxes.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taccorl.sim.polyhedron import Polyhedron

TOUCH_M = 1e-6
"""Largest distance of two solids of one part that are taken to touch [m]: nothing can be between them."""
_SLIVER_M = 1e-5  # narrower pieces of surface are what cutting left over
_FLAT_RAD = 1e-4
NEAR_M = 0.004  # pads rarely go deeper
_CELL_M, _MAX_CELLS = 0.006, 4096
_MAX_RECTANGLES = 8


@dataclass(frozen=True, eq=False)
class Surface:
    """Outer surface of a part that consists of several convex solids: convex pieces, and the edges at which the part may be
    concave.

    The surface point nearest to an inner point is its projection on a piece, or on an edge at which the part is concave."""

    corners_m: (
        np.ndarray
    )  # (Q, E, 3) corners of each piece; the last corner is repeated up to E
    normals: np.ndarray  # (Q, 3) outward unit normal of each piece
    side_normals: (
        np.ndarray
    )  # (Q, E, 3) unit normal of each side of a piece, outward, in the piece's plane
    side_offsets_m: np.ndarray  # (Q, E) offset of each side: n · p of its points
    edges_m: np.ndarray  # (M, 2, 3) start and end of each edge

    @functools.cached_property
    def cells(self) -> "Cells":
        """Grid of boxes with the pieces and edges near each."""
        low, high = self.corners_m.min(axis=(0, 1)), self.corners_m.max(axis=(0, 1))
        size = _CELL_M
        while np.prod(np.ceil((high - low) / size)) > _MAX_CELLS:
            size *= 1.25
        counts = np.ceil((high - low) / size).astype(int)
        centres = low + (np.indices(counts).reshape(3, -1).T + 0.5) * size

        def near(corners_m: np.ndarray) -> np.ndarray:
            """(C, B) bool: the bounding boxes of corners (B, N, 3) reach to within ``NEAR_M`` of the cells."""
            low, high = corners_m.min(axis=1), corners_m.max(axis=1)
            gap = np.maximum(
                0,
                np.maximum(low - centres[:, None], centres[:, None] - high) - size / 2,
            )
            return _dot(gap, gap) < NEAR_M**2

        above = np.abs(
            centres @ self.normals.T - _dot(self.normals, self.corners_m[:, 0])
        )
        reaches = above < NEAR_M + size / 2 * np.abs(self.normals).sum(axis=1)
        return Cells(
            low, size, counts, near(self.corners_m) & reaches, near(self.edges_m)
        )

    @property
    def piece_table(self) -> np.ndarray:
        """(Q, 8) normal, offset, and centre and radius² of a sphere around each piece."""
        centres = self.corners_m.mean(axis=1)
        radius = (
            np.linalg.norm(self.corners_m - centres[:, None], axis=2).max(axis=1)
            + TOUCH_M
        )
        offsets = _dot(self.normals, self.corners_m[:, 0])
        return np.column_stack([self.normals, offsets, centres, radius**2])

    @property
    def edge_table(self) -> np.ndarray:
        """(M, 6) start and vector of each edge."""
        return np.concatenate(
            [self.edges_m[:, 0], self.edges_m[:, 1] - self.edges_m[:, 0]], axis=1
        )


class Cells(NamedTuple):
    """Grid of C equal boxes over a part, and the part of its surface within ``NEAR_M`` of each box."""

    origin_m: np.ndarray
    size_m: float
    shape: np.ndarray
    """(3,) number of boxes along x, y, z."""
    near_pieces: np.ndarray
    """(C, Q) bool."""
    near_edges: np.ndarray
    """(C, M) bool."""


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products (...) of ``a`` and ``b`` (..., 3), summed in a fixed order."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


class Covered(NamedTuple):
    """Areas of one solid's faces that other solids cover."""

    wholly: np.ndarray
    """(F,) bool: the whole face is covered, or so many places of it that the whole face is treated as covered."""
    places: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]
    """Rectangles in the other faces: index of the face, axes (2, 3), lower and upper ends along them (2,)."""

    @property
    def faces(self) -> np.ndarray:
        """(F,) bool: the solid's faces that are covered wholly or in part."""
        faces = self.wholly.copy()
        faces[[face for face, *_ in self.places]] = True
        return faces


def surface_of(solids: Sequence[Polyhedron]) -> tuple[Surface, list[Covered]]:
    """Return the surface of the union of convex solids in one frame, and for each solid, in their order, the areas of its faces
    that others cover."""
    low = (
        np.array(
            [
                np.min([c.min(axis=0) for c in solid.corners_m], axis=0)
                for solid in solids
            ]
        )
        - TOUCH_M
    )
    high = (
        np.array(
            [
                np.max([c.max(axis=0) for c in solid.corners_m], axis=0)
                for solid in solids
            ]
        )
        + TOUCH_M
    )
    pieces: list[tuple[np.ndarray, np.ndarray]] = []  # corners, normal
    covered = [Covered(np.zeros(len(solid.normals), bool), []) for solid in solids]
    for s, solid in enumerate(solids):
        near = [
            i
            for i in range(len(solids))
            if i != s and (low[i] <= high[s]).all() and (low[s] <= high[i]).all()
        ]
        for face, normal in enumerate(solid.normals):
            uncovered, patches = _split(
                solid.corners_m[face], normal, [solids[i] for i in near]
            )
            pieces += [(corners, normal) for corners in uncovered]
            rectangles = _rectangles(solid.corners_m[face], normal, patches)
            if not uncovered or len(rectangles) > _MAX_RECTANGLES:
                covered[s].wholly[face] = True
            else:
                covered[s].places.extend((face, *rectangle) for rectangle in rectangles)
    num_sides = max(len(corners) for corners, _ in pieces)
    side_normals, side_offsets = (
        np.zeros((len(pieces), num_sides, 3)),
        np.ones((len(pieces), num_sides)),
    )
    for q, (corners, normal) in enumerate(pieces):
        sides = np.cross(np.roll(corners, -1, axis=0) - corners, normal)
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        side_normals[q, : len(corners)], side_offsets[q, : len(corners)] = (
            sides,
            _dot(sides, corners),
        )
    surface = Surface(
        corners_m=np.array(
            [
                np.pad(c, ((0, num_sides - len(c)), (0, 0)), mode="edge")
                for c, _ in pieces
            ]
        ),
        normals=np.array([normal for _, normal in pieces]),
        side_normals=side_normals,
        side_offsets_m=side_offsets,
        edges_m=_hollow_edges(
            [(*piece, sides) for piece, sides in zip(pieces, side_normals, strict=True)]
        ),
    )
    return surface, covered


def _hollow_edges(
    pieces: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> np.ndarray:
    """(M, 2, 3) starts and ends of the edges between pieces (corners, normal, sides' normals) but where two of them meet
    in a convex edge or in one plane, which is never the nearest."""
    meeting: dict[tuple, list[tuple]] = {}
    for corners, normal, sides in pieces:
        for start, end, side in zip(
            corners, np.roll(corners, -1, axis=0), sides, strict=False
        ):
            ends = sorted(
                tuple(np.round(corner / TOUCH_M).astype(int).tolist())
                for corner in (start, end)
            )
            meeting.setdefault(tuple(ends), []).append((start, end, normal, side))
    hollow = []
    for same in meeting.values():
        start, end, normal, _ = same[0]
        other_side = same[-1][3]  # the other piece lies the other way
        if len(same) != 2 or -other_side @ normal > _FLAT_RAD:
            hollow.append((start, end))
    return np.array(hollow).reshape(-1, 2, 3)


def _split(
    corners: np.ndarray, normal: np.ndarray, others: Sequence[Polyhedron]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Convex pieces of a face in front of which none of the others lies, and those that one of them covers."""
    pieces, patches = [corners], []
    for other in others:
        # Of the other solid, what a point just in front of the face would be in.
        offsets = other.offsets_m - TOUCH_M * (other.normals @ normal)
        left = []
        for piece in pieces:
            outside, inside = _cut_out(piece, other.normals, offsets)
            left += outside
            patches += inside
        pieces = left
    return pieces, patches


def _cut_out(
    corners: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Convex pieces of a convex polygon (N, 3) outside of a convex solid, and the one inside, if there is one."""
    if ((corners @ normals.T - offsets).min(axis=0) > -0.5 * TOUCH_M).any():
        return [corners], []
    rest, outside = corners, []
    for normal, offset in zip(normals, offsets, strict=True):
        height = rest @ normal - offset
        beyond = _cut(rest, -height)
        if _is_wide(beyond):
            outside.append(beyond)
        rest = _cut(rest, height)
        if not _is_wide(rest):
            return [corners], []
    return outside, [rest]


def _rectangles(
    corners: np.ndarray, normal: np.ndarray, patches: Sequence[np.ndarray]
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Rectangles along a face's longest side that hold all patches: axes (2, 3), lower and upper ends (2,)."""
    sides = np.roll(corners, -1, axis=0) - corners
    along = sides[np.linalg.norm(sides, axis=1).argmax()]
    axes = np.stack([along, np.cross(normal, along)]) / np.linalg.norm(along)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for patch in patches:
        low, high = (patch @ axes.T).min(axis=0), (patch @ axes.T).max(axis=0)
        i = 0
        while i < len(
            found
        ):  # as one with any that it fits on to, and then again with the others
            both_low, both_high = (
                np.minimum(low, found[i][0]),
                np.maximum(high, found[i][1]),
            )
            if np.prod(both_high - both_low) <= 1.1 * (
                np.prod(high - low) + np.prod(found[i][1] - found[i][0])
            ):
                found.pop(i)
                low, high, i = both_low, both_high, 0
            else:
                i += 1
        found.append((low, high))
    return [(axes, low - TOUCH_M, high + TOUCH_M) for low, high in found]


def _cut(corners: np.ndarray, height: np.ndarray) -> np.ndarray:
    """The part of a convex polygon (N, 3) whose height (N,) is not above 0."""
    kept = []
    for p, q, hp, hq in zip(
        corners, np.roll(corners, -1, axis=0), height, np.roll(height, -1), strict=True
    ):
        if hp <= 0:
            kept.append(p)
        if hp * hq < 0:
            kept.append(p + (q - p) * (hp / (hp - hq)))
    return np.array(kept).reshape(-1, 3)


def _is_wide(corners: np.ndarray) -> bool:
    """A polygon (N, 3) is more than a sliver: twice its area over half its girth."""
    if len(corners) < 3:
        return False
    following = np.roll(corners, -1, axis=0)
    area = 0.5 * np.linalg.norm(np.cross(corners, following).sum(axis=0))
    return 2 * area / np.linalg.norm(following - corners, axis=1).sum() > _SLIVER_M
