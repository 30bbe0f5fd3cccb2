"""The parts as MuJoCo compiles and moves them: clearances, masses, and the failures each task is about, from closed forms."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation
from shapely.affinity import rotate
from shapely.geometry import MultiPoint, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.part import Part, add_part, measure_fit
from taccorl.sim.shapes import Box, Prism, heart_outline
from taccorl.tasks.assembly_1.parts import tenon_plug, tenon_socket
from taccorl.tasks.assembly_2.parts import cradle_plug, open_cradle
from taccorl.tasks.puzzle.parts import PIECES, puzzle_piece, puzzle_tray
from taccorl.tasks.test_tube.parts import glass_tube, tube_rack, tube_stand

ALL = [
    glass_tube(),
    tube_stand(),
    tube_rack(),
    puzzle_tray(),
    *map(puzzle_piece, PIECES),
]
ALL += [tenon_plug("tenon"), tenon_socket(), cradle_plug("plug"), open_cradle()]


def by_name(parts: list[Part]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("part", parts, ids=[part.name for part in parts])


def pose_at(
    *at_m: float, turn_deg: tuple[float, float, float] = (0, 0, 0)
) -> np.ndarray:
    """(4, 4); ``turn_deg`` is a rotation vector."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    pose[:3, 3] = at_m
    return pose


class Bench:
    """A table with parts, and a way to put them somewhere and to ask where they are."""

    def __init__(
        self,
        *parts: Part,
        friction: float = 0.5,
        slides: dict[str, float] | None = None,
        table: bool = True,
    ) -> None:
        """``slides``: the first part cannot turn; it moves along these axes of its own with this damping [N·s/m]."""
        spec = mujoco.MjSpec()
        spec.option.timestep = 1 / 1200
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 50
        if table:
            spec.worldbody.add_geom(
                name="table",
                type=mujoco.mjtGeom.mjGEOM_PLANE,
                size=[1, 1, 0.1],
                friction=[1, 0, 0],
            )
        for part in parts:
            body = add_part(spec, part, friction=friction)
            if slides and part is parts[0]:
                spec.delete(spec.joint(part.name))
                body.pos, body.quat = [0, 0, 0], [1, 0, 0, 0]
                for axis, damping in slides.items():
                    kind = mujoco.mjtJoint.mjJNT_SLIDE
                    body.add_joint(
                        name=axis,
                        type=kind,
                        axis=np.eye(3)["xyz".index(axis)],
                        damping=damping,
                    )
        self.parts = {part.name: part for part in parts}
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def put(self, name: str, world_from_part: np.ndarray) -> None:
        at, quat = (
            world_from_part[:3, 3],
            Rotation.from_matrix(world_from_part[:3, :3]).as_quat(scalar_first=True),
        )
        if self.parts[name].clamped:
            mocap = self.model.body(name).mocapid[0]
            self.data.mocap_pos[mocap], self.data.mocap_quat[mocap] = at, quat
        else:
            self.data.joint(name).qpos[:] = [*at, *quat]
        mujoco.mj_forward(self.model, self.data)

    def pose(self, name: str) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = (
            self.data.body(name).xmat.reshape(3, 3),
            self.data.body(name).xpos,
        )
        return pose

    def run(self, duration_s: float) -> None:
        mujoco.mj_step(self.model, self.data, nstep=round(duration_s * 1200))
        mujoco.mj_forward(self.model, self.data)
        assert not any(warning.number for warning in self.data.warning)

    def fit(self, plug: str, socket: str, hole: str):
        mate = self.parts[plug].mate
        assert mate is not None
        world_from_hole = (
            self.pose(socket) @ self.parts[socket].holes[hole].part_from_hole
        )
        return measure_fit(
            world_from_hole, self.pose(plug) @ mate.part_from_mate, mate.num_turns
        )

    def geoms(self, name: str) -> list[int]:
        body = self.model.body(name)
        return [
            g
            for g in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
            if self.model.geom_contype[g]
        ]

    def distance_m(self, one: list[int], other: list[int]) -> float:
        return min(
            mujoco.mj_geomDistance(self.model, self.data, a, b, 0.1, None)
            for a in one
            for b in other
        )


def seated(
    plug: Part,
    socket: Part,
    hole: str,
    depth_m: float,
    lateral_m: tuple[float, float] = (0, 0),
) -> np.ndarray:
    """Socket-from-plug with the mate ``depth_m`` inside and moved sideways, in the hole's frame."""
    assert plug.mate is not None
    return (
        socket.holes[hole].part_from_hole
        @ pose_at(*lateral_m, depth_m)
        @ np.linalg.inv(plug.mate.part_from_mate)
    )


def depth_mm(fit) -> float:
    return float(fit.depth_m) * 1e3


# --- numbers


# Mass [kg] and centre of mass along z [mm]: the tube 50 g at 50 and 10 g at 94; the tenon 15 g at 22.5 and the head 65 g at
# 60; the cradle's plug is asked for 18–20 mm.
@pytest.mark.parametrize(
    ("part", "mass_kg", "com_z_mm"),
    [
        (glass_tube(), 0.060, (50 * 50 + 10 * 94) / 60),
        (tenon_plug(), 0.080, (15 * 22.5 + 65 * 60) / 80),
        (cradle_plug(), 0.070, (28.8 * (18 + 51) / 2 + 41.2 * 8.2) / 70),
        (puzzle_piece("circle"), 0.045, None),
        (puzzle_piece("heart"), 0.045, None),
        (puzzle_piece("triangle"), 0.035, None),
        (tube_rack(), 0.250, None),
        (tenon_socket(), 0.150, None),
        (open_cradle(), 0.160, None),
    ],
    ids=lambda value: value.name if isinstance(value, Part) else "",
)
def test_compiled_mass_and_centre_are_as_stated(part, mass_kg, com_z_mm):
    model = Bench(part).model
    assert model.body(part.name).mass[0] == pytest.approx(mass_kg, rel=1e-12)
    assert part.mass_kg == pytest.approx(mass_kg, rel=1e-12)
    assert model.body(part.name).ipos == pytest.approx(part.com_part_m, abs=1e-9)
    if com_z_mm is not None:
        assert part.com_part_m == pytest.approx([0, 0, com_z_mm * 1e-3], abs=1e-9)


def test_cradle_plug_centre_of_mass_is_where_the_task_needs_it():
    """18–20 mm from the tip, with a core no denser than brass (8.5 g/cm³)."""
    plug = cradle_plug()
    assert 0.018 <= plug.com_part_m[2] <= 0.020
    core = plug.solids[-1]
    assert not core.touches and core.mass_kg / core.volume_m3 == pytest.approx(
        8500, rel=0.01
    )


@by_name(
    [part for part in ALL if part.name != "tube"]
)  # whose cap hides the capsule's upper end
def test_geoms_of_a_part_do_not_overlap(part):
    """Solids touch face to face: 0 within MuJoCo's single-precision vertices."""
    bench = Bench(part, table=False)
    bench.put(part.name, part.table_from_part)
    geoms = bench.geoms(part.name)
    for i, geom in enumerate(geoms[:-1]):
        assert bench.distance_m([geom], geoms[i + 1 :]) > -1e-6


def test_rack_and_tray_have_the_volume_of_their_drawing():
    """Plates minus holes. A regular 2n-gon about a circle of radius r has the area 2 n r² tan(π / 2n)."""
    hole = 24 * 0.0085**2 * math.tan(math.pi / 24)
    plates = 2 * 0.004 * (0.090 * 0.038 - 3 * hole)
    frame = 0.090 * 0.044 * 0.004 + 2 * 0.090 * 0.003 * 0.046 + 0.032 * 0.020 * 0.044
    assert sum(solid.volume_m3 for solid in tube_rack().solids) == pytest.approx(
        plates + frame, rel=1e-9
    )

    circle = 16 * 0.0205**2 * math.tan(math.pi / 16)
    side = 0.046 + 2 * math.sqrt(3) * 0.0005  # all three sides move out by c
    # The heart's hole by shapely's own mitred buffer, an independent way.
    heart = (
        Polygon(heart_outline(0.044, 8))
        .buffer(0.0005, join_style="mitre", mitre_limit=10)
        .area
    )
    top = 0.010 * (0.200 * 0.080 - circle - math.sqrt(3) / 4 * side**2 - heart)
    base = 0.200 * 0.080 * 0.004
    assert sum(solid.volume_m3 for solid in puzzle_tray().solids) == pytest.approx(
        top + base, rel=1e-9
    )


PAIRS = [
    (glass_tube, tube_rack, "middle"),
    (tenon_plug, tenon_socket, "mortise"),
    (cradle_plug, open_cradle, "cradle"),
]
PAIRS += [
    (lambda shape=shape: puzzle_piece(shape), puzzle_tray, shape) for shape in PIECES
]
by_pair = pytest.mark.parametrize(
    ("plug", "socket", "hole"), PAIRS, ids=[hole for _, _, hole in PAIRS]
)


def measured_clearance_m(
    plug: Part, socket: Part, hole: str, lateral_m: tuple[float, float] = (0, 0)
) -> float:
    """Least distance of the compiled geoms, the plug centred, its end 3 mm above the hole's floor."""
    bench = Bench(plug, replace(socket, clamped=True), table=False)
    bench.put(socket.name, np.eye(4))
    bench.put(
        plug.name,
        seated(plug, socket, hole, socket.holes[hole].depth_m - 0.003, lateral_m),
    )
    return bench.distance_m(bench.geoms(plug.name), bench.geoms(socket.name))


@pytest.mark.parametrize("clearance_m", [0.0003, 0.0005, 0.001])
@by_pair
def test_measured_clearance_is_the_one_asked_for(plug, socket, hole, clearance_m):
    assert measured_clearance_m(
        plug(), socket(clearance_m=clearance_m), hole
    ) == pytest.approx(clearance_m, abs=1e-6)


@by_pair
def test_every_hole_says_its_depth(plug, socket, hole):
    """With its end at the stated depth the plug touches the floor, and 1 mm deeper it is in it."""
    one, other = plug(), socket()
    bench = Bench(one, replace(other, clamped=True), table=False)
    bench.put(other.name, np.eye(4))
    for deeper_m in (0.0, 0.001):
        bench.put(
            one.name, seated(one, other, hole, other.holes[hole].depth_m + deeper_m)
        )
        assert bench.distance_m(
            bench.geoms(one.name), bench.geoms(other.name)
        ) == pytest.approx(-deeper_m, abs=2e-6)
        assert depth_mm(bench.fit(one.name, other.name, hole)) == pytest.approx(
            (other.holes[hole].depth_m + deeper_m) * 1e3
        )


# --- fit


def test_fit_reads_depth_offset_tilt_and_turn():
    hole = pose_at(0.1, 0.2, 0.3, turn_deg=(10, 20, 30))
    mate = hole @ pose_at(0.003, -0.004, 0.012, turn_deg=(0, 0, 25))
    fit = measure_fit(hole, mate, 1)
    assert (float(fit.depth_m), float(fit.lateral_m)) == pytest.approx((0.012, 0.005))
    assert (float(fit.tilt_rad), math.degrees(fit.turn_rad)) == pytest.approx(
        (0, 25), abs=1e-7
    )
    assert math.degrees(
        measure_fit(hole, hole @ pose_at(0, 0, 0, turn_deg=(0, 2, 0)), 1).tilt_rad
    ) == pytest.approx(2)
    assert math.degrees(
        measure_fit(hole, hole @ pose_at(0, 0, 0, turn_deg=(180, 0, 0)), 1).tilt_rad
    ) == pytest.approx(180)


@pytest.mark.parametrize(
    ("num_turns", "turn_deg", "left_deg"),
    [(1, 170, 170), (2, 170, -10), (3, 130, 10), (4, -95, -5), (None, 77, 0)],
)
def test_fit_counts_turns_from_the_nearest_look_alike(num_turns, turn_deg, left_deg):
    fit = measure_fit(np.eye(4), pose_at(0, 0, 0, turn_deg=(0, 0, turn_deg)), num_turns)
    assert math.degrees(fit.turn_rad) == pytest.approx(left_deg, abs=1e-9)


def silhouette(piece: Part) -> BaseGeometry:
    return unary_union(
        [Polygon(solid.outline_m) for solid in piece.solids if isinstance(solid, Prism)]
    )


@pytest.mark.parametrize("shape", ["heart", "triangle"])
def test_a_piece_looks_the_same_after_the_turns_it_claims_and_after_no_others(shape):
    piece = puzzle_piece(shape)
    outline = silhouette(piece)
    for turns in (2, 3, 4):
        changed = (
            outline.symmetric_difference(
                rotate(outline, 360 / turns, origin=(0, 0))
            ).area
            / outline.area
        )
        assert (changed < 1e-9) == (turns in {"heart": (), "triangle": (3,)}[shape])
    assert piece.mate and piece.mate.num_turns == {"heart": 1, "triangle": 3}[shape]


# --- grasps


def jaw(side: int) -> Part:
    half = (ROBOT.pad.width_m / 2, ROBOT.pad_thickness_m / 2, ROBOT.pad.length_m / 2)
    return Part(
        name=f"jaw{side}", solids=[Box(half_m=half, color="orange")], clamped=True
    )


def place_jaws(bench: Bench, world_from_tcp: np.ndarray, opening_m: float) -> None:
    for side in (-1, 1):
        bench.put(
            f"jaw{side}",
            world_from_tcp
            @ pose_at(0, side * (opening_m + ROBOT.pad_thickness_m) / 2, 0),
        )


def jaws_to_m(bench: Bench, *names: str) -> list[float]:
    """Distance of either pad to the nearest of the named parts."""
    geoms = [geom for name in names for geom in bench.geoms(name)]
    return [bench.distance_m(bench.geoms(f"jaw{side}"), geoms) for side in (-1, 1)]


def jaws_above_table_m(bench: Bench) -> float:
    """Height of the pads' lowest corner."""
    half = (ROBOT.pad.width_m / 2, ROBOT.pad_thickness_m / 2, ROBOT.pad.length_m / 2)
    poses = [bench.pose(f"jaw{side}") for side in (-1, 1)]
    return min(pose[2, 3] - np.abs(pose[2, :3]) @ half for pose in poses)


def at_rest(part: Part, *others: Part) -> tuple[Bench, np.ndarray, list[str]]:
    """A bench with the part as it rests on the table (the tube: in its stand), its pose, and what else it rests on."""
    holders = [tube_stand()] if part.name == "tube" else []
    bench = Bench(part, *holders, *others)
    for holder in holders:
        bench.put(holder.name, np.eye(4))
    rest = holders[0].seats["tube"] if holders else part.table_from_part
    bench.put(part.name, rest)
    return bench, rest, [holder.name for holder in holders]


GRIPPED = [(part, grasp) for part in ALL for grasp in part.grasps]


@pytest.mark.parametrize(
    ("part", "grasp"), GRIPPED, ids=[f"{part.name}-{grasp}" for part, grasp in GRIPPED]
)
def test_the_closed_pads_lie_on_the_part_and_clear_of_the_rest_and_the_open_ones_pass(
    part, grasp
):
    """Width at most 50 mm: the gripper opens 70. Nothing but the part comes nearer than 3.5 mm."""
    grip = part.grasps[grasp]
    assert grip.width_m <= 0.050
    bench, rest, others = at_rest(part, jaw(-1), jaw(1))
    for opening_m in (grip.width_m, 2 * ROBOT.finger_stroke_m):
        place_jaws(bench, rest @ grip.part_from_tcp, opening_m)
        to_part_m = jaws_to_m(bench, part.name)
        assert (
            to_part_m == pytest.approx([0, 0], abs=2e-6)
            if opening_m == grip.width_m
            else min(to_part_m) >= 0.0035
        )
        assert jaws_above_table_m(bench) >= 0.0035
        assert not others or min(jaws_to_m(bench, *others)) >= 0.0035
    for turn in range(1, grip.num_turns):  # the turns it calls as good are
        turned = pose_at(0, 0, 0, turn_deg=(0, 0, 360 * turn / grip.num_turns))
        place_jaws(bench, rest @ grip.part_from_tcp @ turned, grip.width_m)
        assert jaws_to_m(bench, part.name) == pytest.approx([0, 0], abs=2e-6)


@pytest.mark.parametrize("shape", ["heart", "triangle"])
def test_the_knob_stands_on_its_piece(shape):
    corners = MultiPoint([(x, y) for x in (-0.009, 0.009) for y in (-0.009, 0.009)])
    assert silhouette(puzzle_piece(shape)).buffer(-0.0005).contains(corners)


# --- at rest


@by_name([part for part in ALL if not part.clamped])
def test_a_part_at_rest_stays_where_it_is(part):
    """1 s after it has settled for 0.2 s: less than 0.1 mm of movement and 0.05 mm of penetration."""
    bench, rest, _ = at_rest(part)
    bench.run(0.2)
    before = bench.pose(part.name)
    bench.run(1.0)
    assert np.linalg.norm((bench.pose(part.name) - before)[:3, 3]) < 1e-4
    assert (
        Rotation.from_matrix(
            bench.pose(part.name)[:3, :3] @ before[:3, :3].T
        ).magnitude()
        < 1e-3
    )
    assert (
        np.linalg.norm((before - rest)[:3, 3]) < 1e-4
        and bench.data.contact.dist.min() > -5e-5
    )


# --- Test Tube Insertion


@pytest.mark.parametrize("friction", [0.3, 0.5, 0.7])
def test_an_upright_tube_catches_on_the_rim_beyond_the_friction_angle_and_slides_in_below_it(
    friction,
):
    """Its bottom, a half sphere of r = 8 mm, meets the rim (R = 8.5 mm) at offset e under the angle θ from the axis with
    sin θ = (R − e) / r, and sticks where tan θ < μ: from e = R − r sin(atan μ) = 6.2, 4.9, 3.9 mm on."""
    limit_mm = 8.5 - 8 * math.sin(math.atan(friction))
    bench = Bench(
        glass_tube(),
        replace(tube_rack(), clamped=True),
        friction=friction,
        slides={"x": 0, "z": 100},
    )
    bench.put("rack", np.eye(4))
    for offset_mm, goes_in in ((limit_mm - 0.25, True), (limit_mm + 0.25, False)):
        mujoco.mj_resetData(bench.model, bench.data)
        bench.data.qpos[:] = [offset_mm * 1e-3, 0.051]
        bench.data.qfrc_applied[:] = [0, -2]  # pressed down at some 20 mm/s
        bench.run(1.0)
        assert (depth_mm(bench.fit("tube", "rack", "middle")) > 15) == goes_in


def test_a_released_tube_that_leans_or_misses_does_not_go_in():
    bench = Bench(glass_tube(), replace(tube_rack(), clamped=True))
    for start in (
        seated(glass_tube(), tube_rack(), "middle", -0.001, (0.007, 0)),
        seated(glass_tube(), tube_rack(), "middle", 0.010)
        @ pose_at(0, 0, 0, turn_deg=(30, 0, 0)),
    ):
        mujoco.mj_resetData(bench.model, bench.data)
        bench.put("rack", np.eye(4))
        bench.put("tube", start)
        bench.run(0.8)
        fit = bench.fit("tube", "rack", "middle")
        assert float(fit.lateral_m) > 0.005 or depth_mm(fit) < 40


# --- Do Puzzle


@pytest.mark.parametrize("shape", PIECES)
def test_a_piece_falls_in_within_the_clearance_and_stays_on_the_rim_beyond(shape):
    """Released 1 mm above, 0.5 mm clearance, six directions: all in at 0.3 mm, none at 2.5 mm."""
    bench = Bench(puzzle_piece(shape), puzzle_tray(), table=False)
    for offset_mm, falls_in in ((0.0, True), (0.3, True), (2.5, False)):
        for angle in np.arange(6) * math.pi / 3 if offset_mm else [0.0]:
            mujoco.mj_resetData(bench.model, bench.data)
            bench.put("tray", np.eye(4))
            lateral = (
                offset_mm * 1e-3 * math.cos(angle),
                offset_mm * 1e-3 * math.sin(angle),
            )
            bench.put(
                shape,
                seated(puzzle_piece(shape), puzzle_tray(), shape, -0.001, lateral),
            )
            bench.run(0.4)
            depth = depth_mm(bench.fit(shape, "tray", shape))
            assert (depth > 9.8) if falls_in else (depth < 7.5), (offset_mm, angle)


def test_a_piece_turned_by_a_third_fits_only_if_it_is_the_triangle():
    for shape, fits in (("triangle", True), ("heart", False)):
        bench = Bench(puzzle_piece(shape), puzzle_tray(), table=False)
        bench.put("tray", np.eye(4))
        start = seated(puzzle_piece(shape), puzzle_tray(), shape, -0.001)
        bench.put(shape, start @ pose_at(0, 0, 0, turn_deg=(0, 0, 120)))
        bench.run(0.4)
        assert (depth_mm(bench.fit(shape, "tray", shape)) > 9.8) == fits


# --- Assembly #1


def pushed_tenon(tilt_deg: float, clearance_m: float, friction: float) -> float:
    """Depth [mm] of a tenon that cannot turn, 2 N along the hole at no more than 40 mm/s, free to move sideways."""
    tenon, socket = (
        tenon_plug(),
        replace(tenon_socket(clearance_m=clearance_m), clamped=True),
    )
    bench = Bench(
        tenon, socket, friction=friction, slides={"x": 1, "y": 1, "z": 50}, table=False
    )
    bench.model.opt.gravity[:] = 0
    start = seated(tenon, socket, "mortise", -0.0002) @ pose_at(
        0, 0, 0, turn_deg=(tilt_deg, 0, 0)
    )
    bench.model.body("plug").quat[:] = Rotation.from_matrix(start[:3, :3]).as_quat(
        scalar_first=True
    )
    bench.model.body("plug").pos[:] = start[:3, 3]
    bench.put("socket", np.eye(4))
    bench.data.xfrc_applied[bench.model.body("plug").id, 2] = 2.0
    bench.run(1.5)
    return depth_mm(bench.fit("plug", "socket", "mortise"))


@pytest.mark.parametrize("friction", [0.3, 0.7])
def test_a_tenon_goes_straight_in_and_wedges_where_geometry_says(friction):
    """Across its 12 mm, tilted by θ: L sin θ + 12 cos θ = 12 + 2c, so it stops at L = 28.9 mm for 2° and 19.4 for 3°."""
    assert pushed_tenon(0.0, 0.0005, friction) == pytest.approx(38, abs=0.1)
    assert pushed_tenon(1.0, 0.0005, friction) > 37.5
    for tilt_deg in (2.0, 3.0):
        tilt = math.radians(tilt_deg)
        expected_mm = (12 + 1 - 12 * math.cos(tilt)) / math.sin(tilt)
        assert expected_mm < 34  # the task's success depth
        assert pushed_tenon(tilt_deg, 0.0005, friction) == pytest.approx(
            expected_mm, abs=0.6
        )
    assert pushed_tenon(2.0, 0.001, friction) > 37


# --- Assembly #2


@pytest.mark.parametrize("clearance_m", [0.0003, 0.0005, 0.001])
@pytest.mark.parametrize("friction", [0.3, 0.7])
def test_a_plug_released_in_the_cradle_stays_exactly_if_its_centre_of_mass_is_inside(
    friction, clearance_m
):
    """Axis level, lying on the cradle's floor, released: 2 mm to either side decide."""
    plug, cradle = (
        cradle_plug(),
        replace(open_cradle(clearance_m=clearance_m), clamped=True),
    )
    bench = Bench(plug, cradle, friction=friction)
    held = pose_at(0, 0, 0.3) @ cradle.table_from_part
    for beyond_com_mm in (-10, -5, -2, 2, 5, 10):
        mujoco.mj_resetData(bench.model, bench.data)
        bench.put("cradle", held)
        start_m = plug.com_part_m[2] + beyond_com_mm * 1e-3
        bench.put(
            "plug", held @ seated(plug, cradle, "cradle", start_m, (0, -clearance_m))
        )
        bench.run(1.0)
        fit = bench.fit("plug", "cradle", "cradle")
        if beyond_com_mm > 0:
            assert (
                depth_mm(fit) == pytest.approx(start_m * 1e3, abs=0.1)
                and math.degrees(fit.tilt_rad) < 0.1
            )
        else:
            assert bench.pose("plug")[2, 3] < 0.1  # on the table, 0.2 m below


# --- in a batch


def test_tray_pose_and_friction_differ_from_sim_to_sim():
    """Two sims: tray elsewhere and turned, the triangle falls in at both. Then, on the table, 0.5 of its weight pushes the
    circle: it slides at μ = 0.3 and not at 0.7, whatever the table's friction is (1 here)."""
    tray, pieces = puzzle_tray(), [puzzle_piece("triangle"), puzzle_piece("circle")]
    bench = Bench(tray, *pieces)
    batch = Batch(bench.model, nsim=2)
    trays = [pose_at(0, 0, 0), pose_at(0.005, -0.005, 0, turn_deg=(0, 0, 5))]
    friction = batch.expand("geom_friction")
    friction[0, bench.geoms("circle"), 0], friction[1, bench.geoms("circle"), 0] = (
        0.3,
        0.7,
    )
    for sim, pose in enumerate(trays):
        batch.mocap_pos[sim, 0] = pose[:3, 3]
        batch.mocap_quat[sim, 0] = Rotation.from_matrix(pose[:3, :3]).as_quat(
            scalar_first=True
        )
        start = pose @ seated(pieces[0], tray, "triangle", -0.001)
        batch.qpos[sim, :7] = [
            *start[:3, 3],
            *Rotation.from_matrix(start[:3, :3]).as_quat(scalar_first=True),
        ]
        batch.qpos[sim, 7:10] = [0, 0.3, 0]
    batch.xfrc_applied[:, bench.model.body("circle").id, 0] = 0.5 * 0.045 * 9.81
    batch.step(nstep=480)
    for sim, pose in enumerate(trays):
        at = np.linalg.inv(pose) @ (*batch.qpos[sim, :3], 1)
        assert at[2] == pytest.approx(0.004, abs=1e-4)
        assert (
            np.abs(at[:2] - tray.holes["triangle"].part_from_hole[:2, 3]).max() < 0.001
        )
    slid_m = batch.qpos[:, 7]
    assert slid_m[0] == pytest.approx(0.5 * (0.5 - 0.3) * 9.81 * 0.4**2, rel=0.05)
    assert abs(slid_m[1]) < 1e-4


def test_a_clamped_part_makes_no_contact_with_the_table():
    bench = Bench(puzzle_tray(), tube_stand())
    bench.put("tray", pose_at(0.3, 0, 0))
    bench.put("stand", pose_at(-0.3, 0, 0))
    assert bench.data.ncon == 0
    assert bench.model.nv == 0


# --- looks and bad input


@pytest.mark.parametrize("clearance_m", [0.0, -0.0005, 0.5])
def test_a_clearance_in_millimetres_is_refused(clearance_m):
    with pytest.raises(
        TaccorlError,
        match=f"tray: clearance_m={clearance_m} is not within 0 and 0.002 m; the default is 0.0005",
    ):
        puzzle_tray(clearance_m=clearance_m)
