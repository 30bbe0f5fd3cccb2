"""Outer surface of a part that consists of several convex solids: faces, or pieces of them, that no other solid covers.

Each face is cut along the other solids that touch or overlap it. What lies open stays in convex pieces; what is covered, the
whole face or places in it, is a *seam*: there a point's depth is its distance to the surface of the whole part.

Letters in shapes: F faces of a solid, N corners of a polygon, Q pieces of surface, E sides of a piece, M edges, S points,
L entries of a list, B boxes.
"""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taccorl.sim.signed_distance import FAR_M, FLAT_M, TINY_M, Polyhedron, dot

TOUCH_M = 1e-6
"""Largest distance of two solids of one part that are taken to touch [m]: nothing can be between them."""
_SLIVER_M = 1e-5  # narrower pieces of surface are what cutting left over
_FLAT_RAD = 1e-4
NEAR_M = 0.004  # pads rarely go deeper
_CELL_M, _MAX_CELLS = 0.006, 4096
_MAX_RECTANGLES = 8
_POINTS_AT_ONCE = 1000


@dataclass(frozen=True, eq=False)
class Surface:
    """Outer surface of a part that consists of several convex solids: convex pieces, and the edges at which the part may be
    concave.

    The surface point nearest to an inner point is its projection on a piece, or on an edge at which the part is concave.
    """

    corners_m: np.ndarray
    """(Q, E, 3) corners of each piece; the last corner is repeated up to E."""
    normals: np.ndarray
    """(Q, 3) outward unit normal of each piece."""
    side_normals: np.ndarray
    """(Q, E, 3) unit normal of each side of a piece, outward, in the piece's plane."""
    side_offsets_m: np.ndarray
    """(Q, E) offset of each side: n · p of its points."""
    edges_m: np.ndarray
    """(M, 2, 3) start and end of each edge."""

    def depth(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth (S,) [m] of ``points_m`` (S, 3) within the part, and the unit direction (S, 3) in which it grows."""
        cells = self.cells
        at = np.clip((points_m - cells.origin_m) / cells.size_m, 0, np.array(cells.shape) - 1).astype(int)
        cell = np.ravel_multi_index((at[:, 0], at[:, 1], at[:, 2]), cells.shape)
        depth, inward = np.empty(len(points_m)), np.empty(points_m.shape)
        # Points in crowded cells together, so that the others have short lists.
        for some in _blocks(np.argsort(cells.num_pieces[cell], kind="stable")):
            pieces = cells.pieces[cell[some], : cells.num_pieces[cell[some]].max()]
            edges = cells.edges[cell[some], : cells.num_edges[cell[some]].max()]
            depth[some], inward[some] = self._depth(points_m[some], pieces, edges)
        far = np.nonzero(depth > NEAR_M)[0]
        if len(far):
            everything = [np.arange(count)[None] for count in (len(self.normals), len(self.edges_m))]
            for some in _blocks(far):
                lists = (np.tile(every, (len(some), 1)) for every in everything)
                depth[some], inward[some] = self._depth(points_m[some], *lists)
        return depth, inward

    @functools.cached_property
    def cells(self) -> "_Cells":
        """Grid of boxes with the pieces and edges near each. Computed on first use: most parts are never pressed at a seam."""
        low, high = self.corners_m.min(axis=(0, 1)), self.corners_m.max(axis=(0, 1))
        size = _CELL_M
        while np.prod(np.ceil((high - low) / size)) > _MAX_CELLS:
            size *= 1.25
        counts = np.ceil((high - low) / size).astype(int)
        centres = low + (np.indices(counts).reshape(3, -1).T + 0.5) * size

        def lists(low: np.ndarray, high: np.ndarray, is_near: np.ndarray) -> np.ndarray:
            """(cells, L) which of the boxes low … high (B, 3) are near, filled up with B."""
            gap = np.maximum(0, np.maximum(low - centres[:, None], centres[:, None] - high) - size / 2)
            is_near = is_near & (dot(gap, gap) < NEAR_M**2)
            order = np.argsort(~is_near, axis=1, kind="stable")[:, : is_near.sum(axis=1).max(initial=0)]
            return np.where(np.take_along_axis(is_near, order, axis=1), order, len(low))

        above = np.abs(centres @ self.normals.T - dot(self.normals, self.corners_m[:, 0]))
        reaches = above < NEAR_M + size / 2 * np.abs(self.normals).sum(axis=1)
        pieces = lists(self.corners_m.min(axis=1), self.corners_m.max(axis=1), reaches)
        edges = lists(self.edges_m.min(axis=1), self.edges_m.max(axis=1), np.array(True))
        shape = (int(counts[0]), int(counts[1]), int(counts[2]))
        num_pieces, num_edges = (pieces < len(self.normals)).sum(axis=1), (edges < len(self.edges_m)).sum(axis=1)
        return _Cells(low, size, shape, pieces, num_pieces, edges, num_edges)

    @functools.cached_property
    def piece_table(self) -> np.ndarray:
        """(8, Q + 1) normal, offset, and centre and radius² of a sphere around each piece; the last column is a piece that is
        never near."""
        centres = self.corners_m.mean(axis=1)
        radius = np.linalg.norm(self.corners_m - centres[:, None], axis=2).max(axis=1) + TOUCH_M
        offsets = dot(self.normals, self.corners_m[:, 0])
        table = np.stack([*self.normals.T, offsets, *centres.T, radius**2])
        return np.concatenate([table, np.array([[0, 0, 0, FAR_M, 0, 0, 0, 0]]).T], axis=1)

    @functools.cached_property
    def edge_table(self) -> np.ndarray:
        """(6, M + 1) start and vector of each edge; the last column is an edge that is never near."""
        table = np.concatenate([self.edges_m[:, 0], self.edges_m[:, 1] - self.edges_m[:, 0]], axis=1).T
        return np.concatenate([table, np.array([[FAR_M, 0, 0, 1, 0, 0]]).T], axis=1)

    def _depth(self, points_m: np.ndarray, pieces: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of (S, 3) points, with (S, L) numbers of the pieces and edges to look at."""
        x, y, z = points_m.T[:, :, None]
        depth, inward = np.full(len(points_m), FAR_M), np.zeros(points_m.shape)
        if edges.size:
            sx, sy, sz, ex, ey, ez = np.take(self.edge_table, edges, axis=1)
            dx, dy, dz = x - sx, y - sy, z - sz
            share = np.clip((dx * ex + dy * ey + dz * ez) / (ex * ex + ey * ey + ez * ez), 0.0, 1.0)
            away = dx - share * ex, dy - share * ey, dz - share * ez
            square = away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
            nearest = np.arange(len(points_m)), square.argmin(axis=1)
            depth = np.minimum(np.sqrt(square[nearest]), FAR_M)
            inward = np.stack([a[nearest] for a in away], axis=1) / np.maximum(depth, TINY_M)[:, None]
        nx, ny, nz, offset, cx, cy, cz, radius_squared = np.take(self.piece_table, pieces, axis=1)
        under = offset - (x * nx + y * ny + z * nz)
        apart = (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2
        under[(under < -2 * TOUCH_M) | (apart - under * under > radius_squared)] = FAR_M
        # The nearest plane whose piece lies straight under the point: rarely more than two are tried.
        left = np.arange(len(points_m) if pieces.size else 0)
        while len(left):
            column = under[left].argmin(axis=1)
            is_nearer = under[left, column] < depth[left]
            left, column = left[is_nearer], column[is_nearer]
            piece = pieces[left, column]
            beside = dot(points_m[left, None], self.side_normals[piece]) - self.side_offsets_m[piece]
            is_over = (beside < FLAT_M).all(axis=1)
            over = left[is_over]
            depth[over], inward[over] = under[over, column[is_over]], -self.normals[piece[is_over]]
            left, column = left[~is_over], column[~is_over]
            under[left, column] = FAR_M
        return depth, inward


def _blocks(points: np.ndarray) -> Iterator[np.ndarray]:
    for start in range(0, len(points), _POINTS_AT_ONCE):
        yield points[start : start + _POINTS_AT_ONCE]


class _Cells(NamedTuple):
    """Grid of equal boxes over a part, and the part of its surface within ``NEAR_M`` of each box."""

    origin_m: np.ndarray
    size_m: float
    shape: tuple[int, int, int]
    pieces: np.ndarray
    """(cells, L) indices of pieces, padded with the index of the piece that is never near."""
    num_pieces: np.ndarray
    """(cells,)"""
    edges: np.ndarray
    """(cells, L) the same of edges."""
    num_edges: np.ndarray
    """(cells,)"""


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
    that others cover.
    """
    low = np.array([np.min([c.min(axis=0) for c in solid.corners_m], axis=0) for solid in solids]) - TOUCH_M
    high = np.array([np.max([c.max(axis=0) for c in solid.corners_m], axis=0) for solid in solids]) + TOUCH_M
    pieces: list[tuple[np.ndarray, np.ndarray]] = []  # corners, normal
    covered = [Covered(np.zeros(len(solid.normals), bool), []) for solid in solids]
    for s, solid in enumerate(solids):
        near = [i for i in range(len(solids)) if i != s and (low[i] <= high[s]).all() and (low[s] <= high[i]).all()]
        for face, normal in enumerate(solid.normals):
            uncovered, patches = _split(solid.corners_m[face], normal, [solids[i] for i in near])
            pieces += [(corners, normal) for corners in uncovered]
            rectangles = _rectangles(solid.corners_m[face], normal, patches)
            if not uncovered or len(rectangles) > _MAX_RECTANGLES:
                covered[s].wholly[face] = True
            else:
                covered[s].places.extend((face, *rectangle) for rectangle in rectangles)
    num_sides = max(len(corners) for corners, _ in pieces)
    side_normals, side_offsets = np.zeros((len(pieces), num_sides, 3)), np.ones((len(pieces), num_sides))
    for q, (corners, normal) in enumerate(pieces):
        sides = np.cross(np.roll(corners, -1, axis=0) - corners, normal)
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        side_normals[q, : len(corners)], side_offsets[q, : len(corners)] = sides, dot(sides, corners)
    surface = Surface(
        corners_m=np.array([np.pad(c, ((0, num_sides - len(c)), (0, 0)), mode="edge") for c, _ in pieces]),
        normals=np.array([normal for _, normal in pieces]),
        side_normals=side_normals,
        side_offsets_m=side_offsets,
        edges_m=_hollow_edges([(*piece, sides) for piece, sides in zip(pieces, side_normals, strict=True)]),
    )
    return surface, covered


def _hollow_edges(pieces: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
    """(M, 2, 3) starts and ends of the edges between pieces (corners, normal, sides' normals) but where two of them meet
    in a convex edge or in one plane, which is never the nearest."""
    meeting: dict[tuple, list[tuple]] = {}
    for corners, normal, sides in pieces:
        for start, end, side in zip(corners, np.roll(corners, -1, axis=0), sides, strict=False):
            ends = sorted(tuple(np.round(corner / TOUCH_M).astype(int).tolist()) for corner in (start, end))
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
        while i < len(found):  # as one with any that it fits on to, and then again with the others
            both_low, both_high = np.minimum(low, found[i][0]), np.maximum(high, found[i][1])
            if np.prod(both_high - both_low) <= 1.1 * (np.prod(high - low) + np.prod(found[i][1] - found[i][0])):
                found.pop(i)
                low, high, i = both_low, both_high, 0
            else:
                i += 1
        found.append((low, high))
    return [(axes, low - TOUCH_M, high + TOUCH_M) for low, high in found]


def _cut(corners: np.ndarray, height: np.ndarray) -> np.ndarray:
    """The part of a convex polygon (N, 3) whose height (N,) is not above 0."""
    kept = []
    for p, q, hp, hq in zip(corners, np.roll(corners, -1, axis=0), height, np.roll(height, -1), strict=True):
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
