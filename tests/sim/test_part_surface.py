"""Depth and rate, in single shapes and in parts of several solids, against shapely, MuJoCo, strewn points and closed forms."""

import mujoco
import numpy as np
import pytest
import shapely
from one_part import model_of, prism_vertices
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from shapely.geometry import Polygon

from taccorl.errors import TaccorlError
from taccorl.sim.felt_shapes import ShapeTables, shapes_of
from taccorl.sim.part_surface import surface_of
from taccorl.sim.polyhedron import polyhedron
from taccorl.sim.shapes import circle_outline, convex_partition, heart_outline
from taccorl.sim.touch_kernel import depth_in_body


def part_of(outlines: list[np.ndarray], low_m: float, high_m: float) -> ShapeTables:
    meshes = {
        f"m{i}": prism_vertices(outline, low_m, high_m)
        for i, outline in enumerate(outlines)
    }
    return part(
        "".join(f'<geom type="mesh" mesh="{name}" contype="0"/>' for name in meshes),
        meshes,
    )


def part(geoms: str, meshes: dict[str, np.ndarray] | None = None) -> ShapeTables:
    model = model_of(geoms, meshes)
    return shapes_of(model, list(range(model.ngeom)), np.float64)


def depth_and_rate(
    shapes: ShapeTables, p: np.ndarray, speed: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """(S,) depth in a part, 0 outside, and its rate, at points (S, 3) of its body's frame that move there."""
    position, velocity = np.zeros((2, len(p), 3, 3))
    position[:, :, 2], velocity[:, :, 2] = p, speed
    depth, rate = depth_in_body(shapes, position, velocity, np.ones((3, 1)))
    return depth[:, 0], rate[:, 0]


def part_depth(shapes: ShapeTables, p: np.ndarray) -> np.ndarray:
    return depth_and_rate(shapes, p)[0]


L_OUTLINE = [(0, 0), (0.03, 0), (0.03, 0.01), (0.01, 0.01), (0.01, 0.03), (0, 0.03)]
OUTLINES = {
    "box of two prisms": [(0, 0), (0.03, 0), (0.03, 0.02), (0, 0.02)],
    "L": L_OUTLINE,
    "heart": heart_outline(0.044),
    "U": [
        (0, 0),
        (0.05, 0),
        (0.05, 0.03),
        (0.04, 0.03),
        (0.035, 0.012),
        (0.012, 0.012),
        (0.01, 0.03),
        (0, 0.03),
    ],
}


def random_points(
    outline: Polygon, low_m: float, high_m: float, num: int
) -> np.ndarray:
    x0, y0, x1, y1 = outline.bounds
    return np.random.default_rng(4).uniform((x0, y0, low_m), (x1, y1, high_m), (num, 3))


def extruded_depth(
    outline: Polygon, low_m: float, high_m: float, p: np.ndarray
) -> np.ndarray:
    """By shapely: distance to the outline, to the lower and to the upper face; negative outside."""
    at = shapely.points(p[:, :2])
    side = shapely.distance(outline.boundary, at) * np.where(
        shapely.contains(outline, at), 1, -1
    )
    return np.min([side, p[:, 2] - low_m, high_m - p[:, 2]], axis=0)


def outlines_of(name: str, partition: str) -> tuple[Polygon, list[np.ndarray]]:
    """A part's outline, and convex outlines that tile it."""
    if name == "plate with a round hole":
        hole = circle_outline(0.0086, 24, circumscribed=True)
        outline = Polygon(
            [(-0.03, -0.025), (0.03, -0.025), (0.03, 0.025), (-0.03, 0.025)], [hole]
        )
    else:
        outline = Polygon(OUTLINES[name])
    if partition == "merged":
        return outline, convex_partition(outline)
    if partition == "triangles":
        triangles = shapely.constrained_delaunay_triangles(outline).geoms
        return outline, [
            shapely.get_coordinates(triangle)[:-1] for triangle in triangles
        ]
    corners = np.array(outline.exterior.coords[:-1])
    return outline, [corners[[0, 1, 2]], corners[[0, 2, 3]]]


@pytest.mark.parametrize(
    ("name", "partition"),
    [
        ("box of two prisms", "cut along the diagonal"),
        *(
            (name, how)
            for name in (*OUTLINES, "plate with a round hole")
            for how in ("merged", "triangles")
        ),
    ],
)
def test_inner_faces_of_a_part_are_no_surface(name: str, partition: str) -> None:
    outline, outlines = outlines_of(name, partition)
    found = part_of(outlines, -0.005, 0.01)
    assert len(found.geom) == len(outlines)
    p = random_points(outline, -0.006, 0.011, 6000)
    truth = extruded_depth(outline, -0.005, 0.01, p)
    depth = part_depth(found, p)
    inside = truth > 0
    assert inside.sum() > 1000 and np.abs(depth - truth)[inside].max() < 1e-7
    assert (depth[~inside] < 1e-7).all()
    if (
        len(outlines) > 1
    ):  # the test can fail: with inner faces as surfaces the depth is wrong
        naive = part_depth(found._replace(surface=np.full_like(found.surface, -1)), p)
        assert np.abs(naive - truth)[inside].max() > 1e-3


def test_middle_of_a_large_part_is_deep() -> None:
    """A head of 80 × 80 × 80 mm on a tenon of 60 × 60 × 60, in the corner where all coordinates are negative.

    Asked together: the middle of the seam between them, 30 mm from the hollow edges about it and nothing near, and a point
    1 mm beside and 0.5 mm above such an edge."""
    found = part(
        '<geom type="box" size=".04 .04 .04" pos="-.2 -.2 -.16"/><geom type="box" size=".03 .03 .03" pos="-.2 -.2 -.23"/>'
    )
    p = np.array([(-0.2, -0.2, -0.2), (-0.171, -0.2, -0.1995)])
    assert part_depth(found, p) == pytest.approx(
        [0.03, np.hypot(0.001, 0.0005)], abs=1e-7
    )


@pytest.mark.parametrize("seed", range(4))
def test_depth_in_a_heap_of_boxes_is_the_distance_to_its_surface(seed: int) -> None:
    """Five boxes through one another, against the nearest of points strewn 0.25 mm apart over what sticks out of the others."""
    rng = np.random.default_rng(seed)
    placed = (
        rng.uniform(-0.012, 0.012, (5, 3)),
        rng.uniform(0.004, 0.015, (5, 3)),
        Rotation.random(5, rng=rng),
    )
    numbers = [
        " ".join(map(str, values))
        for a in (*placed[:2], placed[2].as_quat(scalar_first=True))
        for values in a
    ]
    boxes = zip(*(numbers[i : i + 5] for i in (0, 5, 10)), strict=True)
    model = model_of(
        "".join(
            f'<geom type="box" pos="{p}" size="{h}" quat="{q}"/>' for p, h, q in boxes
        )
    )
    turns = [Rotation.from_quat(quat, scalar_first=True) for quat in model.geom_quat]

    def within(points_m: np.ndarray) -> np.ndarray:
        """(5, S) depth in each of the boxes."""
        local = [
            turn.inv().apply(points_m - pos)
            for turn, pos in zip(turns, model.geom_pos, strict=True)
        ]
        return np.array(
            [
                (half - np.abs(p)).min(axis=1)
                for half, p in zip(model.geom_size, local, strict=True)
            ]
        )

    strewn = []
    for geom, half in enumerate(model.geom_size):
        for axis in range(3):
            lines = [np.linspace(-h, h, int(2 * h / 0.00025) + 2) for h in half]
            lines[axis] = np.array([-half[axis], half[axis]])
            face = np.stack([g.ravel() for g in np.meshgrid(*lines)], axis=1)
            points_m = turns[geom].apply(face) + model.geom_pos[geom]
            strewn.append(
                points_m[np.delete(within(points_m), geom, axis=0).max(axis=0) <= 1e-9]
            )
    p = rng.uniform(-0.02, 0.02, (3000, 3))
    p = p[within(p).max(axis=0) > 1e-5]
    nearest = KDTree(np.concatenate(strewn)).query(p)[0]
    depth = part_depth(shapes_of(model, list(range(5)), np.float64), p)
    assert len(p) > 500 and (depth - nearest).max() < 1e-6
    assert (nearest - depth).max() < 0.00025
    assert (
        nearest - within(p).max(axis=0)
    ).max() > 0.001  # what the deepest box alone would say


def test_rate_at_a_seam_is_the_central_difference_of_the_depth() -> None:
    outline = Polygon(L_OUTLINE)
    found = part_of(
        [
            np.array([(0, 0), (0.03, 0), (0.03, 0.01), (0, 0.01)]),
            np.array([(0, 0.01), (0.01, 0.01), (0.01, 0.03), (0, 0.03)]),
        ],
        -0.01,
        0.01,
    )
    rng = np.random.default_rng(6)
    p = np.column_stack(
        [rng.uniform((0.001, 0.0075), (0.0095, 0.0125), (400, 2)), np.zeros(400)]
    )
    speed = rng.normal(0, 0.05, (400, 3))
    truth = [
        extruded_depth(outline, -0.01, 0.01, p + t * speed) for t in (-1e-7, 0, 1e-7)
    ]
    smooth = np.abs(truth[2] - 2 * truth[1] + truth[0]) < 1e-13
    hollow = np.hypot(p[:, 0] - 0.01, p[:, 1] - 0.01) < truth[1] + 1e-9
    assert (hollow & smooth).sum() > 20
    _, rate = depth_and_rate(found, p, speed)
    assert np.abs(rate - (truth[2] - truth[0]) / 2e-7)[smooth].max() < 1e-6


def test_surface_of_a_tiled_box_has_its_area() -> None:
    cells = [
        np.array(np.meshgrid([x, x + 0.01], [y, y + 0.01], [0, 0.02])).reshape(3, -1).T
        for x in (0, 0.01)
        for y in (0, 0.01)
    ]
    surface, covered = surface_of([polyhedron(v) for v in cells])
    assert [faces.wholly.sum() for faces in covered] == [2] * 4
    # Of 24 faces 8 are inside; the others are four quarters of top and bottom and eight halves of the sides.
    assert len(surface.normals) == 16


NUM_POSES = 300
WEDGE_M = np.array(
    [(-0.02, -0.01), (0.02, -0.01), (-0.02, 0.02)]
)  # a right-angled triangle, extruded to ± 15 mm
GRID = np.stack(
    [
        *(
            g.ravel()
            for g in np.meshgrid(
                np.linspace(-0.011, 0.011, 12), np.linspace(-0.031, 0.031, 32)
            )
        )
    ]
)
GRID = np.concatenate([GRID, np.ones((1, 384))]).astype(np.float32)


def poses(
    seed: int, reach_m: float, num: int = NUM_POSES
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3, 3) places of pads whose middle lies within ``reach_m`` of the shape, and their velocities."""
    rng = np.random.default_rng(seed)
    axes = Rotation.random(num, rng=rng).as_matrix()
    origin = rng.uniform(-reach_m, reach_m, (num, 3))
    position = np.stack([axes[:, :, 0], axes[:, :, 1], origin], axis=2)
    turn, shift = rng.normal(0, 2.0, (num, 3)), rng.normal(0, 0.05, (num, 3))
    velocity = np.stack(
        [np.cross(turn, axes[:, :, 0]), np.cross(turn, axes[:, :, 1]), shift], axis=2
    )
    return position, velocity


def points(position: np.ndarray) -> np.ndarray:
    """(n, K, 3) taxels in the shape's frame, double precision."""
    return (position @ GRID.astype(float)).swapaxes(1, 2)


# ---- closed forms, written anew: depth of points (..., 3), any sign outside ----


def capsule_depth(p: np.ndarray) -> np.ndarray:
    nearest = np.clip(p[..., 2], -0.02, 0.02)
    return 0.008 - np.linalg.norm(
        p - np.stack([0 * nearest, 0 * nearest, nearest], axis=-1), axis=-1
    )


def cylinder_depth(p: np.ndarray) -> np.ndarray:
    return np.minimum(0.01 - np.hypot(p[..., 0], p[..., 1]), 0.025 - np.abs(p[..., 2]))


def box_depth(p: np.ndarray) -> np.ndarray:
    return (np.array([0.01, 0.02, 0.03]) - np.abs(p)).min(axis=-1)


def wedge_depth(p: np.ndarray) -> np.ndarray:
    """Legs x = −20 mm, y = −10 mm; hypotenuse from (20, −10) to (−20, 20): 3 x + 4 y = 20 mm, normal (3, 4) / 5."""
    x, y, z = np.moveaxis(p, -1, 0)
    return np.min(
        [x + 0.02, y + 0.01, (0.02 - 3 * x - 4 * y) / 5, 0.015 - np.abs(z)], axis=0
    )


SHAPES = {
    "sphere": (
        '<geom type="sphere" size=".012"/>',
        lambda p: 0.012 - np.linalg.norm(p, axis=-1),
    ),
    "capsule": ('<geom type="capsule" size=".008 .02"/>', capsule_depth),
    "cylinder": ('<geom type="cylinder" size=".01 .025"/>', cylinder_depth),
    "box": ('<geom type="box" size=".01 .02 .03"/>', box_depth),
    "prism": ('<geom type="mesh" mesh="wedge"/>', wedge_depth),
}


def shape(name: str) -> ShapeTables:
    return shapes_of(
        model_of(SHAPES[name][0], {"wedge": prism_vertices(WEDGE_M, -0.015, 0.015)}),
        [0],
        np.float64,
    )


@pytest.mark.parametrize("name", SHAPES)
def test_depth_is_the_closed_form_to_a_micrometre_in_any_pose(name: str) -> None:
    position, velocity = poses(seed=1, reach_m=0.025)
    depth, _ = depth_in_body(shape(name), position, velocity, GRID)
    truth = SHAPES[name][1](points(position))
    inside = truth > 0
    assert 0.01 < inside.mean() < 0.6 and np.abs(depth - truth)[inside].max() < 2e-8
    assert (depth[~inside] < 2e-8).all()


def test_plane_is_felt_as_a_half_space() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>'
    )
    position, velocity = poses(seed=7, reach_m=0.02, num=10)
    depth, _ = depth_in_body(
        shapes_of(model, [0], np.float64), position, velocity, GRID
    )
    assert depth.any() and depth == pytest.approx(
        np.maximum(-points(position)[:, :, 2], 0), abs=1e-8
    )


def test_coplanar_facets_of_a_mesh_are_one_face() -> None:
    solid = polyhedron(
        prism_vertices(circle_outline(0.02, 24), 0, 0.02)
        .astype(np.float32)
        .astype(float)
    )
    assert len(solid.normals) == 26
    assert sorted(len(c) for c in solid.corners_m) == [4] * 24 + [24] * 2
    assert np.linalg.norm(solid.normals, axis=1) == pytest.approx(1)
    for normal, offset, corners in zip(
        solid.normals, solid.offsets_m, solid.corners_m, strict=True
    ):
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
    depth, _ = depth_in_body(
        shapes_of(model, [0], np.float64), position, velocity, GRID
    )
    compared = 0
    for pose, taxel in np.argwhere(depth > 2e-4)[::40]:
        data.mocap_pos[0] = points(position)[pose, taxel]
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 0.1, None)
        assert depth[pose, taxel] == pytest.approx(-(distance + probe_m), abs=1e-6)
        compared += 1
    assert compared > 10


# ---- which of a model's geoms make up one part, and which pads cannot feel ----


def test_parts_of_different_bodies_keep_their_faces() -> None:
    bodies = "".join(
        f'<body pos="{x} 0 0"><freejoint/><geom type="box" size=".01 .01 .01"/></body>'
        for x in (0, 0.02)
    )
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"
    )
    assert not shapes_of(model, [0, 1]).covered.any()
    # The same two on one body are one bar without a seam.
    bar = model_of(
        '<geom type="box" size=".01 .01 .01"/><geom type="box" size=".01 .01 .01" pos=".02 0 0"/>'
    )
    found = shapes_of(bar, [0, 1])
    assert found.covered.sum() == 2
    assert len(found.seam_face) == 0


def test_shapes_without_an_exact_depth_are_refused() -> None:
    model = model_of('<geom name="egg" type="ellipsoid" size=".01 .02 .03"/>')
    with pytest.raises(
        TaccorlError,
        match=r"geom 'egg': pads cannot detect a ellipsoid; give a convex mesh",
    ):
        shapes_of(model, [0])


def test_mesh_that_is_not_convex_is_refused() -> None:
    """The mesh is a tetrahedron with a dent. MuJoCo collides the convex hull of a mesh, which fills the dent."""
    spec = mujoco.MjSpec()
    vertices = np.array(
        [(0, 0, 0), (0.03, 0, 0), (0, 0.03, 0), (0, 0, 0.03), (0.005, 0.005, 0.005)]
    )
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 4), (2, 3, 4), (3, 1, 4)]
    spec.add_mesh(name="dented", uservert=vertices.ravel(), userface=np.ravel(faces))
    spec.worldbody.add_geom(
        name="tetra", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="dented"
    )
    said = r"geom 'tetra': mesh 'dented' is not convex: a facet lies .* mm inside its convex"
    with pytest.raises(TaccorlError, match=said):
        shapes_of(spec.compile(), [0])
