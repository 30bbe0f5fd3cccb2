"""Convex solids as planes and corners.

Letters in shapes: F faces, N corners of a face, V vertices.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

FLAT_M = 1e-7
"""Vertices this close to a plane lie in it. MuJoCo stores mesh vertices in single precision: 4e-9 m at 0.1 m."""


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
    area = np.linalg.norm(
        np.cross(facets[:, 1] - facets[:, 0], facets[:, 2] - facets[:, 0]), axis=1
    )
    normals, offsets, corners = [], [], []
    outer = vertices_m[hull.vertices]
    for facet in np.argsort(
        -area, kind="stable"
    ):  # a sliver's own normal may be anything, so the largest first
        if any(
            np.abs(facets[facet] @ n - o).max() < FLAT_M
            for n, o in zip(normals, offsets, strict=True)
        ):
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
