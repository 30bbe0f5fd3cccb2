"""Which of a model's geoms make up one part, and which pads cannot feel."""

import mujoco
import numpy as np
import pytest
from one_part import model_of

from taccorl.errors import TaccorlError
from taccorl.sim.felt_shapes import shapes_of


def test_parts_of_different_bodies_keep_their_faces() -> None:
    bodies = "".join(f'<body pos="{x} 0 0"><freejoint/><geom type="box" size=".01 .01 .01"/></body>' for x in (0, 0.02))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    assert not shapes_of(model, [0, 1]).covered.any()
    # The same two on one body are one bar without a seam.
    bar = model_of('<geom type="box" size=".01 .01 .01"/><geom type="box" size=".01 .01 .01" pos=".02 0 0"/>')
    found = shapes_of(bar, [0, 1])
    assert found.covered.sum() == 2
    assert len(found.seam_face) == 0


def test_shapes_without_an_exact_depth_are_refused() -> None:
    model = model_of('<geom name="egg" type="ellipsoid" size=".01 .02 .03"/>')
    with pytest.raises(TaccorlError, match=r"geom 'egg': pads cannot detect a ellipsoid; give a convex mesh"):
        shapes_of(model, [0])


def test_mesh_that_is_not_convex_is_refused() -> None:
    """A tetrahedron with a dent: MuJoCo collides it as if the dent were filled."""
    spec = mujoco.MjSpec()
    vertices = np.array([(0, 0, 0), (0.03, 0, 0), (0, 0.03, 0), (0, 0, 0.03), (0.005, 0.005, 0.005)])
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 4), (2, 3, 4), (3, 1, 4)]
    spec.add_mesh(name="dented", uservert=vertices.ravel(), userface=np.ravel(faces))
    spec.worldbody.add_geom(name="tetra", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="dented")
    said = r"geom 'tetra': mesh 'dented' is not convex: a facet lies .* mm inside its convex"
    with pytest.raises(TaccorlError, match=said):
        shapes_of(spec.compile(), [0])
