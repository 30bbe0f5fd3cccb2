"""Solids of an object for the pads' depth queries, in the object's frame. Letter in shapes: G solids."""

from collections.abc import Sequence

import mujoco
import numpy as np

from taccorl.sim.felt_shapes import ShapeTables, shapes_of
from taccorl.sim.shapes import Capsule, Solid, add_geom


def shapes_in_object(solids: Sequence[Solid]) -> tuple[ShapeTables, np.ndarray]:
    """The G solids that touch (no ballast).

    Returns:
        The solids in double precision, for ``depth_in_body``; and the corners (8 G, 3) [m] of their bounding boxes.
    """
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="pressed")
    for k, solid in enumerate(s for s in solids if s.touches):
        if isinstance(solid, Capsule) and solid.half_height_m == 0:
            pos, size = solid.part_from_solid[:3, 3], [solid.radius_m, 0, 0]
            body.add_geom(name=f"{k}", type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=pos, size=size)
        else:
            add_geom(spec, body, solid, f"pressed_{k}")
    model = spec.compile()
    shapes = shapes_of(model, list(range(model.ngeom)), np.float64)
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    boxes = [model.geom_aabb[g, :3] + signs * model.geom_aabb[g, 3:] for g in shapes.geom]
    corners = [box @ pose[:, :3].T + pose[:, 3] for box, pose in zip(boxes, shapes.body_from_geom, strict=True)]
    return shapes, np.concatenate(corners)
