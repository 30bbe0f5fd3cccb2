"""Shapes that pads can detect, read from a compiled MuJoCo model: capsules, cylinders, and convex solids that may tile a part.

Solids of one body that touch or overlap are one part, whose inner faces are no surface (``part_surface``).
"""

import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from taccorl.errors import TaccorlError
from taccorl.sim.part_surface import TOUCH_M, Covered, Surface, surface_of
from taccorl.sim.signed_distance import (
    FAR_M,
    FLAT_M,
    Capsules,
    Cylinders,
    Polyhedra,
    Polyhedron,
    Seams,
    Shapes,
    polyhedron,
)

_ROUNDING_M = 3e-8  # of mesh vertices 0.2 m from their origin


def shapes_of(model: mujoco.MjModel, geoms: Sequence[int]) -> list[Shapes]:
    """Return the shapes of these geoms (ids) as one ``Shapes`` per kind that occurs, with the compiled model's sizes; sizes that
    differ between simulations are not supported.

    Raises:
        TaccorlError: a geom is of a kind whose depth is not implemented, or a mesh is not convex.
    """
    kind = mujoco.mjtGeom
    by_kind: dict[int, list[int]] = {}
    for geom in geoms:
        by_kind.setdefault(int(model.geom_type[geom]), []).append(geom)
    capsules = [g for t in (kind.mjGEOM_SPHERE, kind.mjGEOM_CAPSULE) for g in by_kind.pop(t, [])]
    cylinders = by_kind.pop(kind.mjGEOM_CYLINDER, [])
    solids = [g for t in (kind.mjGEOM_BOX, kind.mjGEOM_MESH) for g in by_kind.pop(t, [])]
    planes = by_kind.pop(kind.mjGEOM_PLANE, [])
    for geom_type, (geom, *_) in by_kind.items():
        raise TaccorlError(
            f"geom {_name(model, geom)}: pads cannot detect a {kind(geom_type).name.removeprefix('mjGEOM_').lower()}; make it of "
            "spheres, capsules, cylinders, boxes and convex meshes, or non-colliding (contype = conaffinity = 0)"
        )
    found: list[Shapes] = []
    for cls, ids in ((Capsules, capsules), (Cylinders, cylinders)):
        if ids:
            size = model.geom_size[ids].astype(np.float32)
            half = size[:, 1:2] * (model.geom_type[ids] != kind.mjGEOM_SPHERE)[:, None]
            found.append(cls(np.array(ids), size[:, :1], half))
    return found + _polyhedra(model, solids, planes)


def _polyhedra(model: mujoco.MjModel, solids: list[int], planes: list[int]) -> list[Shapes]:
    """Grouped by number of faces, rounded up, so that a wedge costs no more calls than the boxes beside it."""
    vertices = {g: _vertices_of(model, g) for g in solids}
    shape = {g: _polyhedron_of(model, g, vertices[g]) for g in solids}
    upward = Polyhedron(np.array([[0.0, 0.0, 1.0]]), np.zeros(1), [])
    shape |= dict.fromkeys(planes, upward)
    body_from_geom = {g: np.column_stack([_matrix(model.geom_quat[g]), model.geom_pos[g]]) for g in shape}
    covered: dict[int, Covered] = {}
    surfaces: dict[int, Surface] = {}
    for body in np.unique(model.geom_bodyid[solids]) if solids else []:
        members = [g for g in solids if model.geom_bodyid[g] == body]
        surface, covered_by_others = _part_of(tuple((vertices[g], body_from_geom[g].tobytes()) for g in members))
        for geom, of_geom in zip(members, covered_by_others, strict=True):
            if of_geom.faces.any():
                covered[geom], surfaces[geom] = of_geom, surface
    groups: dict[int, list[int]] = {}
    for geom, solid in shape.items():
        groups.setdefault(_rounded_up(len(solid.normals)), []).append(geom)
    found: list[Shapes] = []
    for num_faces, geoms in groups.items():
        normals = np.zeros((len(geoms), num_faces, 3), np.float32)
        offsets = np.full((len(geoms), num_faces), FAR_M)
        wholly = np.zeros(offsets.shape, bool)
        for i, geom in enumerate(geoms):
            faces = slice(len(shape[geom].normals))
            normals[i, faces], offsets[i, faces] = shape[geom].normals, shape[geom].offsets_m
            if geom in covered:
                wholly[i, faces] = covered[geom].wholly
                offsets[i, faces] += np.where(wholly[i, faces], TOUCH_M, _ROUNDING_M * covered[geom].faces)
        found.append(
            Polyhedra(
                geoms=np.array(geoms),
                normals=normals,
                offsets_m=offsets.astype(np.float32),
                covered=wholly,
                seams=[_seams(covered[g].places, body_from_geom[g]) if g in covered else None for g in geoms],
                surfaces=[surfaces.get(g) for g in geoms],
                body_from_geom=np.array([body_from_geom[g] for g in geoms]),
            )
        )
    return found


def _seams(
    places: Sequence[tuple[int, np.ndarray, np.ndarray, np.ndarray]], body_from_geom: np.ndarray
) -> Seams | None:
    """The places, given in the body's frame, in the solid's own."""
    if not places:
        return None
    axes = np.concatenate([axes for _, axes, _, _ in places])
    low, high = (np.concatenate([place[end] for place in places]) for end in (2, 3))
    return Seams(
        faces=np.array([face for face, *_ in places]),
        axes=(axes @ body_from_geom[:, :3]).astype(np.float32),
        centres_m=((low + high) / 2 - axes @ body_from_geom[:, 3]).astype(np.float32),
        halves_m=((high - low) / 2).astype(np.float32),
    )


def _rounded_up(num_faces: int) -> int:
    return next((n for n in (1, 6, 8) if num_faces <= n), -(-num_faces // 8) * 8)


def _vertices_of(model: mujoco.MjModel, geom: int) -> bytes:
    """(V, 3) float64 of a box or mesh geom in its own frame; MuJoCo has moved a mesh's into the frame of its inertia."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
        return (signs * model.geom_size[geom]).tobytes()
    mesh = model.mesh(model.geom_dataid[geom])
    return model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]].astype(float).tobytes()


def _polyhedron_of(model: mujoco.MjModel, geom: int, vertices: bytes) -> Polyhedron:
    """A box or mesh geom in its own frame."""
    solid = _hull_of(vertices)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return solid
    mesh = model.mesh(model.geom_dataid[geom])
    facets = _points(vertices)[model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]]
    inside_m = (solid.offsets_m - facets.mean(axis=1) @ solid.normals.T).min(axis=1).max()
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
    return surface_of([_moved(_hull_of(vertices), np.frombuffer(pose).reshape(3, 4)) for vertices, pose in solids])


def _points(vertices: bytes) -> np.ndarray:
    return np.frombuffer(vertices).reshape(-1, 3)


def _moved(solid: Polyhedron, pose: np.ndarray) -> Polyhedron:
    turn, shift = pose[:, :3], pose[:, 3]
    normals = solid.normals @ turn.T
    return Polyhedron(normals, solid.offsets_m + normals @ shift, [c @ turn.T + shift for c in solid.corners_m])


def _matrix(quat_wxyz: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat_wxyz)
    return matrix.reshape(3, 3)


def _name(model: mujoco.MjModel, geom: int) -> str:
    return repr(model.geom(geom).name or geom)
