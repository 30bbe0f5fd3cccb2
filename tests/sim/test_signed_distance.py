"""Depth and rate in single shapes against closed forms, finite differences and MuJoCo's own distance."""

import mujoco
import numpy as np
import pytest
from one_part import model_of, prism_vertices
from scipy.spatial.transform import Rotation

from taccorl.sim.felt_shapes import ShapeTables, shapes_of
from taccorl.sim.polyhedron import polyhedron
from taccorl.sim.shapes import circle_outline
from taccorl.sim.touch_kernel import depth_in_body

NUM_POSES = 300
WEDGE_M = np.array([(-0.02, -0.01), (0.02, -0.01), (-0.02, 0.02)])  # a right-angled triangle, extruded to ± 15 mm
GRID = np.stack([*(g.ravel() for g in np.meshgrid(np.linspace(-0.011, 0.011, 12), np.linspace(-0.031, 0.031, 32)))])
GRID = np.concatenate([GRID, np.ones((1, 384))]).astype(np.float32)


def poses(seed: int, reach_m: float, num: int = NUM_POSES) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3, 3) places of pads whose middle lies within ``reach_m`` of the shape, and their velocities."""
    rng = np.random.default_rng(seed)
    axes = Rotation.random(num, rng=rng).as_matrix()
    origin = rng.uniform(-reach_m, reach_m, (num, 3))
    position = np.stack([axes[:, :, 0], axes[:, :, 1], origin], axis=2)
    turn, shift = rng.normal(0, 2.0, (num, 3)), rng.normal(0, 0.05, (num, 3))
    velocity = np.stack([np.cross(turn, axes[:, :, 0]), np.cross(turn, axes[:, :, 1]), shift], axis=2)
    return position, velocity


def points(position: np.ndarray) -> np.ndarray:
    """(n, K, 3) taxels in the shape's frame, double precision."""
    return (position @ GRID.astype(float)).swapaxes(1, 2)


# ---- closed forms, written anew: depth of points (..., 3), any sign outside ----


def sphere_depth(p: np.ndarray) -> np.ndarray:
    return 0.012 - np.linalg.norm(p, axis=-1)


def capsule_depth(p: np.ndarray) -> np.ndarray:
    nearest = np.clip(p[..., 2], -0.02, 0.02)
    return 0.008 - np.linalg.norm(p - np.stack([0 * nearest, 0 * nearest, nearest], axis=-1), axis=-1)


def cylinder_depth(p: np.ndarray) -> np.ndarray:
    return np.minimum(0.01 - np.hypot(p[..., 0], p[..., 1]), 0.025 - np.abs(p[..., 2]))


def box_depth(p: np.ndarray) -> np.ndarray:
    return (np.array([0.01, 0.02, 0.03]) - np.abs(p)).min(axis=-1)


def wedge_depth(p: np.ndarray) -> np.ndarray:
    """Legs x = −20 mm, y = −10 mm; hypotenuse from (20, −10) to (−20, 20): 3 x + 4 y = 20 mm, normal (3, 4) / 5."""
    x, y, z = np.moveaxis(p, -1, 0)
    sides = [x + 0.02, y + 0.01, (0.02 - 3 * x - 4 * y) / 5, 0.015 - np.abs(z)]
    return np.min(sides, axis=0)


SHAPES = {
    "sphere": ('<geom type="sphere" size=".012"/>', sphere_depth),
    "capsule": ('<geom type="capsule" size=".008 .02"/>', capsule_depth),
    "cylinder": ('<geom type="cylinder" size=".01 .025"/>', cylinder_depth),
    "box": ('<geom type="box" size=".01 .02 .03"/>', box_depth),
    "prism": ('<geom type="mesh" mesh="wedge"/>', wedge_depth),
}


def shape(name: str) -> ShapeTables:
    model = model_of(SHAPES[name][0], {"wedge": prism_vertices(WEDGE_M, -0.015, 0.015)})
    return shapes_of(model, [0], np.float64)


@pytest.mark.parametrize("name", SHAPES)
def test_depth_is_the_closed_form_to_a_micrometre_in_any_pose(name: str) -> None:
    position, velocity = poses(seed=1, reach_m=0.025)
    depth, _ = depth_in_body(shape(name), position, velocity, GRID)
    truth = SHAPES[name][1](points(position))
    inside = truth > 0
    assert 0.01 < inside.mean() < 0.6
    assert np.abs(depth - truth)[inside].max() < 2e-8
    assert (depth[~inside] < 2e-8).all()


def test_plane_is_felt_as_a_half_space() -> None:
    model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>')
    position, velocity = poses(seed=7, reach_m=0.02, num=10)
    depth, _ = depth_in_body(shapes_of(model, [0], np.float64), position, velocity, GRID)
    assert depth.any() and depth == pytest.approx(np.maximum(-points(position)[:, :, 2], 0), abs=1e-8)


def test_coplanar_facets_of_a_mesh_are_one_face() -> None:
    solid = polyhedron(prism_vertices(circle_outline(0.02, 24), 0, 0.02).astype(np.float32).astype(float))
    assert len(solid.normals) == 26
    assert sorted(len(c) for c in solid.corners_m) == [4] * 24 + [24] * 2
    assert np.linalg.norm(solid.normals, axis=1) == pytest.approx(1)
    for normal, offset, corners in zip(solid.normals, solid.offsets_m, solid.corners_m, strict=True):
        assert corners @ normal == pytest.approx(offset, abs=1e-8)
        centre = corners.mean(axis=0)
        assert np.cross(corners[0] - centre, corners[1] - centre) @ normal > 0
        assert centre @ normal - solid.corners_m[0].mean() > -1


@pytest.mark.parametrize("name", ["sphere", "capsule", "cylinder"])
def test_depth_agrees_with_mujocos_own_distance(name: str) -> None:
    """MuJoCo's ``mj_geomDistance`` from a tiny sphere; its boxes are not exact inside."""
    probe_m = 1e-5
    xml = f'<mujoco><worldbody>{SHAPES[name][0]}<body name="p" mocap="true"><geom size="{probe_m}"/></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    position, velocity = poses(seed=3, reach_m=0.01, num=20)
    depth, _ = depth_in_body(shapes_of(model, [0], np.float64), position, velocity, GRID)
    compared = 0
    for pose, taxel in np.argwhere(depth > 2e-4)[::40]:
        data.mocap_pos[0] = points(position)[pose, taxel]
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 0.1, None)
        assert depth[pose, taxel] == pytest.approx(-(distance + probe_m), abs=1e-6)
        compared += 1
    assert compared > 10
