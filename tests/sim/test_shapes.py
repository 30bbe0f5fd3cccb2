"""Outlines, convex partitions and solids against closed forms: nothing is lost, nothing overlaps, inertia is exact."""

import itertools
import math

import mujoco
import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Point, Polygon, box
from shapely.ops import unary_union

from taccorl.errors import TaccorlError
from taccorl.sim.shapes import (
    Box,
    Capsule,
    Cylinder,
    Prism,
    add_geom,
    box_between,
    circle_outline,
    convex_partition,
    extrude,
    heart_outline,
    moved,
    offset_outline,
    triangle_outline,
    with_mass,
)

# --- outlines


@pytest.mark.parametrize("num_sides", [8, 24, 32])
def test_circumscribed_circle_keeps_the_whole_circle_inside_and_touches_it(num_sides):
    outline = circle_outline(0.0085, num_sides, circumscribed=True)
    ring = LineString([*outline, outline[0]])
    assert ring.distance(Point(0, 0)) == pytest.approx(0.0085, abs=1e-15)
    assert np.allclose(
        np.hypot(*outline.T), 0.0085 / math.cos(math.pi / num_sides), atol=1e-15
    )
    assert np.allclose(
        np.hypot(*circle_outline(0.0085, num_sides).T), 0.0085, atol=1e-15
    )  # inscribed: corners on it


def test_triangle_has_its_side_and_its_centroid_at_the_origin():
    outline = triangle_outline(0.046)
    assert [
        math.dist(a, b)
        for a, b in zip(outline, np.roll(outline, 1, axis=0), strict=True)
    ] == pytest.approx([0.046] * 3)
    assert Polygon(outline).area == pytest.approx(
        math.sqrt(3) / 4 * 0.046**2, rel=1e-12
    )
    assert np.abs(outline.mean(axis=0)).max() < 1e-15


def test_heart_is_a_square_and_two_half_discs():
    """Half-disc radius r = 44 / (2 + √2) = 12.887 mm; each half disc of 12 chords has the area 12 · r²/2 · sin 15°."""
    outline = heart_outline(0.044)
    r = 0.044 / (2 + math.sqrt(2))
    assert r == pytest.approx(0.012887, abs=1e-6)
    assert np.ptp(outline[:, 0]) == pytest.approx(0.044, abs=1e-15)
    assert np.ptp(outline[:, 1]) == pytest.approx(
        r * (math.sqrt(2) + 1 / math.sqrt(2) + 1), abs=1e-15
    )
    assert Polygon(outline).area == pytest.approx(
        4 * r**2 + 12 * r**2 * math.sin(math.pi / 12), rel=1e-12
    )
    assert Polygon(outline).exterior.is_ccw
    assert np.abs(np.array(Polygon(outline).centroid.coords[0])).max() < 1e-12
    mirrored = outline * (-1, 1)
    assert all(
        np.abs(outline - corner).sum(axis=1).min() < 1e-12 for corner in mirrored
    )


@pytest.mark.parametrize("clearance_m", [0.0003, 0.0005, 0.001])
@pytest.mark.parametrize(
    "outline", [triangle_outline(0.046), heart_outline(0.044), circle_outline(0.02, 32)]
)
def test_offset_outline_is_the_clearance_away_along_every_side_and_nowhere_nearer(
    outline, clearance_m
):
    hole = offset_outline(outline, clearance_m)
    assert len(hole) == len(outline)
    part, ring = Polygon(outline), LineString([*hole, hole[0]])
    assert part.exterior.distance(ring) == pytest.approx(clearance_m, abs=1e-15)
    samples = [ring.interpolate(s, normalized=True) for s in np.linspace(0, 1, 2001)]
    assert min(point.distance(part) for point in samples) >= clearance_m - 1e-15
    for a, b in zip(
        outline, np.roll(outline, -1, axis=0), strict=True
    ):  # each side has its parallel at that distance
        assert Point((a + b) / 2).distance(ring) == pytest.approx(
            clearance_m, abs=1e-15
        )


def test_offset_that_swallows_a_side_says_which_and_what_to_do():
    """The chords at the heart's notch are 2 r sin 7.5° = 3.36 mm long. Moved out by d each loses d tan 37.5° at the notch,
    where the outline turns by 75°, and gains d tan 7.5° at its other end: nothing is left from d = 5.29 mm on."""
    limit_m = (
        2
        * 0.012887
        * math.sin(math.radians(7.5))
        / (math.tan(math.radians(37.5)) - math.tan(math.radians(7.5)))
    )
    assert limit_m == pytest.approx(0.00529, abs=1e-5)
    assert len(offset_outline(heart_outline(0.044), 0.0052)) == 26
    said = r"side \d+ vanishes when moved out by 5.4 mm.*clearance"
    with pytest.raises(TaccorlError, match=said):
        offset_outline(heart_outline(0.044), 0.0054)


# --- partitions


def assert_exact_partition(region: Polygon, pieces: list[np.ndarray]) -> None:
    """Convex, inside, disjoint, nothing missing."""
    polygons = [Polygon(piece) for piece in pieces]
    for polygon in polygons:
        assert polygon.is_valid and polygon.exterior.is_ccw
        assert polygon.convex_hull.area - polygon.area <= 1e-12 * region.area
    assert sum(p.area for p in polygons) == pytest.approx(
        region.area, rel=1e-9, abs=1e-12
    )
    assert (
        unary_union(polygons).symmetric_difference(region).area <= 1e-12 * region.area
    )
    overlap = max(
        (a.intersection(b).area for a, b in itertools.combinations(polygons, 2)),
        default=0.0,
    )
    assert overlap <= 1e-12 * region.area
    corners = {tuple(c) for c in shapely.get_coordinates(region).tolist()}
    assert {
        tuple(c) for piece in pieces for c in piece.tolist()
    } == corners  # bit for bit: no gap, however thin


@pytest.mark.parametrize(
    ("region", "num_pieces"),
    [
        (box(0, 0, 3, 2), 1),
        (Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]), 2),  # L
        (
            Polygon(
                [
                    (1, 0),
                    (2, 0),
                    (2, 1),
                    (3, 1),
                    (3, 2),
                    (2, 2),
                    (2, 3),
                    (1, 3),
                    (1, 2),
                    (0, 2),
                    (0, 1),
                    (1, 1),
                ]
            ),
            3,
        ),
        (Polygon(box(0, 0, 3, 3).exterior, [box(1, 1, 2, 2).exterior]), 4),
        (Polygon(heart_outline(0.044)), 2),
        (Polygon(triangle_outline(0.046)), 1),
    ],
    ids=["rectangle", "L", "cross", "frame", "heart", "triangle"],
)
def test_partition_of_known_shapes_is_exact_and_as_small_as_it_can_be(
    region, num_pieces
):
    pieces = convex_partition(region)
    assert_exact_partition(region, pieces)
    assert len(pieces) == num_pieces


@pytest.mark.parametrize("seed", range(6))
def test_partition_of_random_stars_with_holes_is_exact(seed):
    """Pieces number at most 2 R + H + 1, R reflex corners, H holes (Hertel and Mehlhorn: no inner side is needless)."""
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * math.pi, 23))
    star = rng.uniform(0.05, 0.09, 23)[:, None] * np.stack(
        [np.cos(angle), np.sin(angle)], axis=1
    )
    hole = circle_outline(0.01, 9) + rng.uniform(-0.005, 0.005, 2)
    region = Polygon(star, [hole])
    assert region.is_valid
    pieces = convex_partition(region)
    assert_exact_partition(region, pieces)
    before, after = star - np.roll(star, 1, axis=0), np.roll(star, -1, axis=0) - star
    reflex = int(
        (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] < 0).sum()
    ) + len(hole)
    assert len(pieces) <= 2 * reflex + 2


# --- solids


def compiled(*solids) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="part")
    body.add_freejoint()
    for i, solid in enumerate(solids):
        add_geom(spec, body, solid, f"g{i}")
    return spec.compile()


def pose_at(*at_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = at_m
    return pose


def test_volumes_are_the_textbook_ones():
    assert box_between((0, 0, 0), (0.1, 0.2, 0.3)).volume_m3 == pytest.approx(0.006)
    assert Cylinder(radius_m=0.1, half_height_m=0.5).volume_m3 == pytest.approx(
        math.pi * 0.01
    )
    assert Capsule(radius_m=0.1, half_height_m=0.5).volume_m3 == pytest.approx(
        math.pi * 0.01 * (1 + 0.4 / 3)
    )
    assert Prism(
        outline_m=triangle_outline(0.1), half_height_m=0.5
    ).volume_m3 == pytest.approx(math.sqrt(3) / 4 * 0.01)


def test_compiled_triangular_prism_has_the_closed_form_inertia():
    """Equilateral, side a, height h: I_z = m a²/12, I_x = I_y = m (a²/24 + h²/12)."""
    a, h, mass = 0.046, 0.020, 0.030
    prism = Prism(
        outline_m=triangle_outline(a),
        half_height_m=h / 2,
        mass_kg=mass,
        part_from_solid=pose_at(0.01, -0.02, 0.03),
    )
    model = compiled(prism)
    across, along = mass * (a**2 / 24 + h**2 / 12), mass * a**2 / 12
    assert model.body_mass[1] == pytest.approx(mass, rel=1e-12)
    assert np.sort(model.body_inertia[1]) == pytest.approx(
        sorted([across, across, along]), rel=1e-6
    )
    assert model.body_ipos[1] == pytest.approx([0.01, -0.02, 0.03], abs=1e-9)
    assert prism.com_part_m == pytest.approx([0.01, -0.02, 0.03], abs=1e-15)


def test_compiled_prism_stands_where_its_outline_says_to_a_few_nanometres():
    outline = heart_outline(0.044)
    right = convex_partition(Polygon(outline))[0]
    turn = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    pose = pose_at(0.05, 0.06, 0.07)
    pose[:3, :3] = turn
    model = compiled(
        Prism(outline_m=right, half_height_m=0.01, part_from_solid=pose, mass_kg=0.01)
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    got = model.mesh_vert @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    for x, y in right:
        for z in (-0.01, 0.01):
            wanted = turn @ (x, y, z) + pose[:3, 3]
            assert np.linalg.norm(got - wanted, axis=1).min() < 1e-8
    assert len(got) == 2 * len(right)


def test_extruded_rectangles_are_boxes_and_other_outlines_prisms():
    (solid,) = extrude(box(1, 2, 4, 4), 0.5, 1.0)
    assert isinstance(solid, Box)
    assert solid.half_m == (1.5, 1.0, 0.25)
    assert solid.part_from_solid[:3, 3].tolist() == [2.5, 3.0, 0.75]
    frame = extrude(
        Polygon(box(0, 0, 3, 3).exterior, [box(1, 1, 2, 2).exterior]), 0.5, 1.0
    )
    assert sum(solid.volume_m3 for solid in frame) == pytest.approx(8 * 0.5)
    (solid,) = extrude(Polygon([(0, 0), (3, 0), (2, 1), (1, 1)]), 0, 1)
    assert isinstance(solid, Prism)
    (turned,) = extrude(
        Polygon([(0, 0), (1, 1), (0, 2), (-1, 1)]), 0, 1
    )  # a square on its corner is not axis-parallel
    assert isinstance(turned, Prism)


def test_mass_is_shared_out_by_volume_and_frames_compose():
    small, large = with_mass(
        [box_between((0, 0, 0), (1, 1, 1)), box_between((1, 0, 0), (4, 1, 1))], 8.0
    )
    assert (small.mass_kg, large.mass_kg) == (2.0, 6.0)
    assert moved(large, pose_at(0, 10, 0)).com_part_m.tolist() == [2.5, 10.5, 0.5]
    model = compiled(small, large)
    assert model.body_mass[1] == pytest.approx(8.0)
    assert model.body_ipos[1] == pytest.approx([(2 * 0.5 + 6 * 2.5) / 8, 0.5, 0.5])
