"""Shapes that pads can detect, read from a compiled MuJoCo model: capsules, cylinders, and convex solids that may tile a part.

Solids of one body that touch or overlap are one part, whose inner faces are no surface (``part_surface``).

Letters in shapes: G shapes, F faces of all shapes, R seams, U surfaces of parts, Q their pieces, E sides of a piece, M edges,
C cells, V vertices.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from taccorl.errors import TaccorlError
from taccorl.sim.part_surface import TOUCH_M, Covered, Surface, surface_of
from taccorl.sim.polyhedron import FLAT_M, Polyhedron, polyhedron

CAPSULE, CYLINDER, SOLID = 0, 1, 2
"""Codes of the kinds of shapes."""
_ROUNDING_M = 3e-8  # of mesh vertices 0.2 m from their origin
_BOX, _MESH, _PLANE = (
    int(kind)
    for kind in (
        mujoco.mjtGeom.mjGEOM_BOX,
        mujoco.mjtGeom.mjGEOM_MESH,
        mujoco.mjtGeom.mjGEOM_PLANE,
    )
)
_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): (CAPSULE, 0),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): (CAPSULE, 0),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): (CYLINDER, 0),
    _BOX: (SOLID, 0),
    _MESH: (SOLID, 1),
    _PLANE: (SOLID, 2),
}
_NO_FACES = Polyhedron(np.zeros((0, 3)), np.zeros(0), [])
_UPWARD = Polyhedron(np.array([[0.0, 0.0, 1.0]]), np.zeros(1), [])


class ShapeTables(NamedTuple):
    """Shapes as tables for compiled code (``touch_kernel``). If several have the same depth, the first counts. Arrays of numbers
    are float32 for pads in a simulation, float64 on request; those of surfaces are always float64.

    A *seam* is a rectangle in a face of a solid: it encloses a place where another solid of the same part touches or cuts the
    face. Where the nearest point lies in one, the depth is that within the whole part."""

    geom: np.ndarray  # (G,) ids of the geoms
    kind: np.ndarray  # (G,) code of the kind
    radius_m: np.ndarray
    """(G,) radius of capsules and cylinders along z; ``half_m`` is half their length, 0 of a sphere."""
    half_m: np.ndarray
    faces: np.ndarray  # (G, 2) index of the shape's first face, and of its last + 1
    normals: np.ndarray  # (F, 3) outward unit normals of the faces
    offsets_m: np.ndarray
    """(F,) offset of each face: n · p of its points. Faces at a seam lie a little further out, so that no point falls between two
    solids."""
    covered: np.ndarray  # (F,) bool: other solids of the part cover the whole face
    seams: np.ndarray  # (G, 2) index of the shape's first seam, and of its last + 1
    seam_face: (
        np.ndarray
    )  # (R,) index of the face that contains the seam, among those of its solid
    seam_axes: np.ndarray
    """(R, 2, 3) axes of the seam's rectangle; ``seam_centres_m`` and ``seam_halves_m`` (R, 2) lie along them."""
    seam_centres_m: np.ndarray
    seam_halves_m: np.ndarray
    surface: np.ndarray  # (G,) index of the surface of the shape's part; −1 if no other solid covers any of its faces
    body_from_geom: np.ndarray  # (G, 3, 4) pose of the shape in its body's frame
    own_pieces: np.ndarray  # (U, 2) index of the surface's first piece, and of its last + 1; ``own_edges`` likewise
    own_edges: np.ndarray
    pieces: np.ndarray
    """(Q, 8): normal, offset, and centre and radius² of a sphere around each piece. The first belongs to no surface."""
    side_normals: np.ndarray  # (Q, E, 3) outward unit normal of each side of a piece
    side_offsets_m: np.ndarray  # (Q, E) offset of each side: n · p of its points
    edges: np.ndarray  # (M, 6): start and vector of each edge
    cell_origin_m: np.ndarray  # (U, 3) corner of the surface's grid of cells [m]
    cell_size_m: np.ndarray  # (U,) side of a cell [m]
    cell_counts: np.ndarray  # (U, 3) number of cells along x, y, z
    first_cell: np.ndarray  # (U,) index of the surface's first cell
    cell_pieces: np.ndarray
    """(C, 2) index of the cell's first entry in ``piece_list``, and of its last + 1; ``cell_edges`` likewise for edges."""
    cell_edges: np.ndarray
    piece_list: np.ndarray
    edge_list: np.ndarray


def shapes_of(
    model: mujoco.MjModel, geoms: Sequence[int], dtype: type[np.floating] = np.float32
) -> ShapeTables:
    """The shapes of these geoms (ids) with the compiled model's sizes, ordered by kind; sizes that differ between simulations
    are not supported. Raises TaccorlError: a geom is of a kind whose depth is not implemented, or a mesh is not convex."""
    types = {geom: int(model.geom_type[geom]) for geom in geoms}
    for geom, geom_type in types.items():
        if geom_type not in _KINDS:
            name = mujoco.mjtGeom(geom_type).name.removeprefix("mjGEOM_").lower()
            raise TaccorlError(
                f"geom {_name(model, geom)}: pads cannot detect a {name}; give a convex mesh"
            )
    order = sorted(geoms, key=lambda geom: (*_KINDS[types[geom]], geom))
    pose = {
        g: np.column_stack([_matrix(model.geom_quat[g]), model.geom_pos[g]])
        for g in order
    }
    vertices = {g: _vertices_of(model, g) for g in order if types[g] in (_BOX, _MESH)}
    solid = {g: _UPWARD if types[g] == _PLANE else _NO_FACES for g in order}
    solid |= {g: _polyhedron_of(model, g, vertices[g]) for g in vertices}
    covered: dict[int, Covered] = {}
    surface: dict[int, Surface] = {}
    for body in np.unique(model.geom_bodyid[list(vertices)]) if vertices else []:
        members = [g for g in vertices if model.geom_bodyid[g] == body]
        of_part, covered_by_others = _part_of(
            tuple((vertices[g], pose[g].tobytes()) for g in members)
        )
        for geom, of_geom in zip(members, covered_by_others, strict=True):
            if of_geom.faces.any():
                covered[geom], surface[geom] = of_geom, of_part
    whole = {
        g: covered[g].wholly if g in covered else np.zeros(len(solid[g].normals), bool)
        for g in order
    }
    offsets = [
        solid[g].offsets_m
        + (
            np.where(whole[g], TOUCH_M, _ROUNDING_M * covered[g].faces)
            if g in covered
            else 0.0
        )
        for g in order
    ]
    places = {g: covered[g].places if g in covered else [] for g in order}
    seams = [(*place, pose[g]) for g in order for place in places[g]]
    low, high = (
        np.array([seam[end] for seam in seams]).reshape(-1, 2) for end in (2, 3)
    )
    off = np.array(
        [axes @ body_from_geom[:, 3] for _, axes, _, _, body_from_geom in seams]
    ).reshape(-1, 2)
    surfaces = list(
        {id(one): one for g in order if (one := surface.get(g)) is not None}.values()
    )
    number = {id(one): u for u, one in enumerate(surfaces)}
    is_round = np.array([_KINDS[types[g]][0] != SOLID for g in order], bool)
    size = model.geom_size[order].reshape(-1, 3)
    has_length = is_round & (model.geom_type[order] != mujoco.mjtGeom.mjGEOM_SPHERE)
    return ShapeTables(
        geom=np.array(order, np.int64),
        kind=np.array([_KINDS[types[g]][0] for g in order], np.int64),
        radius_m=(size[:, 0] * is_round).astype(np.float32).astype(dtype),
        half_m=(size[:, 1] * has_length).astype(np.float32).astype(dtype),
        faces=_spans([len(solid[g].normals) for g in order]),
        normals=_joined([solid[g].normals for g in order], (3,), np.float32).astype(
            dtype
        ),
        offsets_m=_joined(offsets, (), np.float32).astype(dtype),
        covered=_joined(list(whole.values()), (), np.bool_),
        seams=_spans([len(places[g]) for g in order]),
        seam_face=np.array([face for face, *_ in seams], np.int64),
        seam_axes=_joined(
            [(axes @ at[:, :3])[None] for _, axes, _, _, at in seams],
            (2, 3),
            np.float32,
        ).astype(dtype),
        seam_centres_m=((low + high) / 2 - off).astype(np.float32).astype(dtype),
        seam_halves_m=((high - low) / 2).astype(np.float32).astype(dtype),
        surface=np.array(
            [number[id(surface[g])] if g in surface else -1 for g in order], np.int64
        ),
        body_from_geom=np.array([pose[g] for g in order]).reshape(-1, 3, 4),
        **_surface_tables(surfaces),
    )


def _surface_tables(surfaces: Sequence[Surface]) -> dict[str, Any]:
    """The fields of ``ShapeTables`` from ``own_pieces`` on."""
    num_sides = max((surface.side_normals.shape[1] for surface in surfaces), default=1)
    more = [num_sides - surface.side_normals.shape[1] for surface in surfaces]
    cells = [surface.cells for surface in surfaces]
    own_pieces = _spans([len(surface.normals) for surface in surfaces]) + 1
    own_edges = _spans([len(surface.edges_m) for surface in surfaces])
    tables: dict[str, Any] = {}
    for name, own, near in (
        ("piece", own_pieces, [one.near_pieces for one in cells]),
        ("edge", own_edges, [one.near_edges for one in cells]),
    ):
        lists = [
            np.nonzero(is_near)[1] + first
            for is_near, (first, _) in zip(near, own, strict=True)
        ]
        tables[f"cell_{name}s"] = _spans(
            _joined([is_near.sum(axis=1) for is_near in near], (), np.int64)
        )
        tables[f"{name}_list"] = _joined(lists, (), np.int64)
    # The first piece is named by no list: it keeps the tables from being empty.
    sides = [np.zeros((1, num_sides, 3))]
    sides += [
        np.pad(s.side_normals, ((0, 0), (0, n), (0, 0)))
        for s, n in zip(surfaces, more, strict=True)
    ]
    offsets = [np.ones((1, num_sides))]
    offsets += [
        np.pad(s.side_offsets_m, ((0, 0), (0, n)), constant_values=1.0)
        for s, n in zip(surfaces, more, strict=True)
    ]
    counts = np.array([one.shape for one in cells], np.int64).reshape(-1, 3)
    return tables | {
        "own_pieces": own_pieces,
        "own_edges": own_edges,
        "pieces": np.concatenate(
            [np.zeros((1, 8)), *(surface.piece_table for surface in surfaces)]
        ),
        "side_normals": np.concatenate(sides),
        "side_offsets_m": np.concatenate(offsets),
        "edges": _joined(
            [surface.edge_table for surface in surfaces], (6,), np.float64
        ),
        "cell_origin_m": np.array([one.origin_m for one in cells], np.float64).reshape(
            -1, 3
        ),
        "cell_size_m": np.array([one.size_m for one in cells], np.float64),
        "cell_counts": counts,
        "first_cell": _spans(counts.prod(axis=1))[:, 0].copy(),
    }


def _spans(counts: Sequence[int] | np.ndarray) -> np.ndarray:
    """(n, 2) int64 first index, and last + 1, of n runs of these lengths behind one another."""
    ends = np.cumsum(np.asarray(counts, np.int64))
    return np.stack([ends - np.asarray(counts, np.int64), ends], axis=1)


def _joined(
    rows: Sequence[np.ndarray], shape: tuple[int, ...], dtype: type[np.generic]
) -> np.ndarray:
    """Arrays (n, *shape) behind one another; also of none."""
    return np.concatenate([np.zeros((0, *shape)), *rows]).astype(dtype)


def _vertices_of(model: mujoco.MjModel, geom: int) -> bytes:
    """(V, 3) float64 of a box or mesh geom in its own frame; MuJoCo has moved a mesh's into the frame of its inertia."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
        return (signs * model.geom_size[geom]).tobytes()
    mesh = model.mesh(model.geom_dataid[geom])
    return (
        model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
        .astype(float)
        .tobytes()
    )


def _polyhedron_of(model: mujoco.MjModel, geom: int, vertices: bytes) -> Polyhedron:
    """A box or mesh geom in its own frame."""
    solid = _hull_of(vertices)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return solid
    mesh = model.mesh(model.geom_dataid[geom])
    facets = _points(vertices)[
        model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
    ]
    inside_m = (
        (solid.offsets_m - facets.mean(axis=1) @ solid.normals.T).min(axis=1).max()
    )
    if inside_m > FLAT_M:
        raise TaccorlError(
            f"geom {_name(model, geom)}: mesh {mesh.name!r} is not convex: a facet lies {inside_m * 1e3:.3g} mm inside its "
            "convex hull, which MuJoCo and the pads use; replace it by convex meshes (for a part of constant "
            "cross-section: taccorl.sim.shapes.extrude)"
        )
    return solid


# The twins that one process compiles share most of their solids, and a part of many solids takes up to 2 CPU-s.
@functools.lru_cache(maxsize=1024)
def _hull_of(vertices: bytes) -> Polyhedron:
    return polyhedron(_points(vertices))


@functools.lru_cache(maxsize=256)
def _part_of(solids: tuple[tuple[bytes, bytes], ...]) -> tuple[Surface, list[Covered]]:
    """``surface_of`` solids given as their vertices and poses (3, 4) in the body's frame."""
    return surface_of(
        [
            _moved(_hull_of(vertices), np.frombuffer(pose).reshape(3, 4))
            for vertices, pose in solids
        ]
    )


def _points(vertices: bytes) -> np.ndarray:
    return np.frombuffer(vertices).reshape(-1, 3)


def _moved(solid: Polyhedron, pose: np.ndarray) -> Polyhedron:
    turn, shift = pose[:, :3], pose[:, 3]
    normals = solid.normals @ turn.T
    return Polyhedron(
        normals,
        solid.offsets_m + normals @ shift,
        [c @ turn.T + shift for c in solid.corners_m],
    )


def _matrix(quat_wxyz: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat_wxyz)
    return matrix.reshape(3, 3)


def _name(model: mujoco.MjModel, geom: int) -> str:
    return repr(model.geom(geom).name or geom)
