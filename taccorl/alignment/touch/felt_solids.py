"""Solids of an object for the pads' depth queries, all in the object's frame instead of one frame each.

Letters in shapes: n pairs of pad and shape, G shapes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.sim.felt_shapes import shapes_of
from taccorl.sim.shapes import Capsule, Solid, add_geom
from taccorl.sim.signed_distance import Felt, Shapes


def shapes_in_object(solids: Sequence[Solid]) -> tuple[list[Shapes], np.ndarray]:
    """The G solids that touch (no ballast) for depth queries in the object's frame.

    Returns:
        ``Shapes``, one item per kind of shape; and the corners (8 G, 3) [m] of the solids' bounding boxes in the object's frame.
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
    pose = [_pose(model.geom_pos[g], model.geom_quat[g]) for g in range(model.ngeom)]
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    boxes = [model.geom_aabb[g, :3] + signs * model.geom_aabb[g, 3:] for g in range(model.ngeom)]
    corners = [box @ p[:, :3].T + p[:, 3] for box, p in zip(boxes, pose, strict=True)]
    kinds = shapes_of(model, list(range(model.ngeom)))
    return [_InBody(kind, np.array([pose[g] for g in kind.geoms])) for kind in kinds], np.concatenate(corners)


def _pose(position: np.ndarray, quat_wxyz: np.ndarray) -> np.ndarray:
    return np.column_stack([Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix(), position])


@dataclass(frozen=True, eq=False)
class _InBody:
    """Shapes that are asked in the frame of their body instead of each in its own."""

    own: Shapes
    body_from_geom: np.ndarray
    """(G, 3, 4)"""

    @property
    def geoms(self) -> np.ndarray:
        return self.own.geoms

    def feel(self, shape: np.ndarray, position: np.ndarray, velocity: np.ndarray, grid: np.ndarray) -> Felt:
        """As ``Shapes.feel``."""
        turn, shift = self.body_from_geom[shape, :, :3].swapaxes(1, 2), self.body_from_geom[shape, :, 3]
        position = position.copy()
        position[:, :, 2] -= shift
        return self.own.feel(shape, turn @ position, turn @ velocity, grid)
