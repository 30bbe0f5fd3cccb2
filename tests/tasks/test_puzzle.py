"""Do Puzzle: where things begin, what counts as placed, and what as lost."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapely import affinity
from shapely.geometry import Point, Polygon, box
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from taccorl.robots import ROBOT
from taccorl.sim.part import Part
from taccorl.sim.randomize import draw
from taccorl.sim.robot import RobotConfig
from taccorl.sim.shapes import Box, Cylinder, Prism
from taccorl.sim.simulation import Simulation
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.puzzle.parts import PIECES
from taccorl.tasks.puzzle.scene import PIECES_AT_M, TRAY_AT_M, YAW_RAD, Puzzle

STEP_S = 1 / 30
IN_HOLE_M = 0.004  # height of a piece's underside when it lies in: the tray's base is 4 mm thick
ON_TRAY_M = 0.014  # and when it stands on the tray's top: base and 10 mm of depth


@pytest.fixture(scope="module")
def built() -> Simulation:
    return Simulation(Puzzle(), scale=0.0)  # nothing drawn: everything at its nominal place


@pytest.fixture
def sim(built) -> Simulation:
    built.reset([0])
    return built


def over_hole(
    sim: Simulation, hole: str, height_m: float, *, turned_deg: float = 0.0, aside_m: float = 0.0
) -> np.ndarray:
    """World pose (4, 4) of a piece that stands level over a hole of the tray."""
    pose = sim.poses("tray")[0] @ Puzzle().tray.holes[hole].part_from_hole @ np.diag([1.0, -1, -1, 1])
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    pose[:3, 3] = (pose[0, 3] + aside_m, pose[1, 3], height_m)
    return pose


def put(sim: Simulation, pieces: dict[str, np.ndarray]) -> None:
    """Write world poses (4, 4) into the state; everything at rest."""
    for piece, pose in pieces.items():
        at = sim.model.joint(piece).qposadr[0]
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        sim.arrays["qpos"][0, at : at + 7] = np.r_[pose[:3, 3], quat]
    sim.batch.forward(np.array([0]))


def put_all_in(sim: Simulation, **instead: np.ndarray) -> None:
    put(sim, {piece: over_hole(sim, piece, IN_HOLE_M + 1e-4) for piece in PIECES} | instead)


def move_hand(sim: Simulation, arm: str, tcp: np.ndarray, opening_m: float) -> None:
    """Put an arm at rest with its TCP at a world pose (4, 4)."""
    joints = sim.proprioception()[0].copy()
    a = 7 * ROBOT.arms.index(arm)
    joints[a : a + 6] = ArmKinematics(arm, RobotConfig()).search(tcp, np.random.default_rng(0))
    joints[a + 6] = opening_m
    sim.place_arms(joints, joints)


def hand_over(piece: np.ndarray, above_m: float) -> np.ndarray:
    """TCP pose (4, 4), straight down, ``above_m`` above a piece's underside; the fingers close along the world's y."""
    tcp = np.diag([-1.0, 1, -1, 1])
    tcp[:3, 3] = piece[:3, 3] + (0, 0, above_m)
    return tcp


def now(sim: Simulation):
    return sim.task.look(sim)


def run(sim: Simulation, seconds: float) -> None:
    """Let time pass; the arms stay where they are."""
    for _ in range(round(seconds / STEP_S)):
        sim.step(sim.targets.copy())


# where things begin ----------------------------------------------------------------------------------------------------


def footprint(part: Part) -> BaseGeometry:
    """What a part that stands at the origin covers of the table."""
    outlines = []
    for solid in part.solids:
        match solid:
            case Prism():
                outline = Polygon(solid.outline_m)
            case Cylinder():
                outline = Point(0, 0).buffer(solid.radius_m)
            case Box():
                outline = box(-solid.half_m[0], -solid.half_m[1], solid.half_m[0], solid.half_m[1])
            case _:
                raise TypeError(solid)
        outlines.append(affinity.translate(outline, *solid.part_from_solid[:2, 3]))
    return unary_union(outlines)


def placed_at(outline: BaseGeometry, pose7: np.ndarray) -> BaseGeometry:
    yaw = Rotation.from_quat(pose7[3:], scalar_first=True).as_euler("zyx")[0]
    return affinity.translate(affinity.rotate(outline, yaw, origin=(0, 0), use_radians=True), *pose7[:2])


def test_rows_are_those_of_the_papers_table():
    half = {row.name: (np.round(row.high, 12).tolist(), np.round(row.low, 12).tolist()) for row in Puzzle().rows}
    assert half.pop("friction") == ([0.7], [0.3])
    deg = np.pi / 180
    expected = {"tray_position": [0.005, 0.005], "tray_yaw": [5 * deg], "circle_support": [0.03, 0.03]}
    expected |= {f"{piece}_support": [0.03, 0.027] for piece in ("heart", "triangle")}
    for piece in PIECES:
        expected |= {f"{piece}_position": [0.01, 0.01], f"{piece}_yaw": [10 * deg]}
    assert half == {k: (np.round(v, 12).tolist(), np.round(-np.array(v), 12).tolist()) for k, v in expected.items()}


@pytest.mark.parametrize("side", [-1, 1])
def test_support_and_position_add_up(side):
    task = Puzzle()
    values = {row.name: np.array(row.high if side > 0 else row.low) for row in task.rows}
    poses = task.reset(values).poses
    reach_m = {"circle": (0.040, 0.040), "heart": (0.040, 0.037), "triangle": (0.040, 0.037)}  # 30 + 10, 27 + 10 mm
    for piece in PIECES:
        np.testing.assert_allclose(poses[piece][:2] - PIECES_AT_M[piece], side * np.array(reach_m[piece]), atol=1e-12)
        yaw = Rotation.from_quat(poses[piece][3:], scalar_first=True).as_euler("zyx")[0]
        assert yaw - YAW_RAD == pytest.approx(side * np.deg2rad(10))
    np.testing.assert_allclose(poses["tray"][:2] - TRAY_AT_M, side * 0.005, atol=1e-12)
    tray_yaw = Rotation.from_quat(poses["tray"][3:], scalar_first=True).as_euler("zyx")[0]
    assert tray_yaw - YAW_RAD == pytest.approx(side * np.deg2rad(5))


def test_nothing_overlaps_in_500_draws_and_500_corners_of_the_ranges():
    task, rng = Puzzle(), np.random.default_rng(0)
    outlines = {name: footprint(part) for name, part in {"tray": task.tray, **task.pieces}.items()}
    assert outlines["tray"].area == pytest.approx(0.200 * 0.080)  # base and plate
    assert outlines["circle"].area == pytest.approx(np.pi * 0.020**2, rel=0.01)

    def smallest_gap_m(values: dict[str, np.ndarray]) -> float:
        poses = task.reset(values).poses
        covered = [placed_at(outline, poses[name]) for name, outline in outlines.items()]
        return min(one.distance(other) for one, other in itertools.combinations(covered, 2))

    corners = [
        {row.name: np.where(rng.random(len(row.low)) < 0.5, row.low, row.high) for row in task.rows} for _ in range(500)
    ]
    drawn = [draw(task.rows, np.random.default_rng(seed)) for seed in range(500)]
    assert min(map(smallest_gap_m, drawn + corners)) > 0.004


def test_pieces_rest_where_they_are_put(sim):
    before = {piece: sim.poses(piece)[0] for piece in PIECES}
    run(sim, 0.5)
    for piece in PIECES:
        assert np.abs(sim.poses(piece)[0] - before[piece]).max() < 5e-4  # they are put 0.2 mm above the table
    assert not any(seen[0] for seen in now(sim).failures.values())


# what counts as placed -------------------------------------------------------------------------------------------------


def test_all_three_in_their_holes_succeed_after_half_a_second(sim):
    put_all_in(sim)
    assert now(sim).goal[0]
    assert now(sim).partial[0] == 3
    run(sim, 14 * STEP_S)
    assert not sim.judge.outcome.success[0]
    run(sim, STEP_S)
    assert sim.judge.outcome.success[0]


def test_partial_counts_the_pieces_that_are_in(sim):
    assert now(sim).partial[0] == 0
    for num, piece in enumerate(PIECES, start=1):
        put(sim, {piece: over_hole(sim, piece, IN_HOLE_M)})
        assert now(sim).partial[0] == num
        assert now(sim).goal[0] == (num == 3)


@pytest.mark.parametrize(("height_m", "counts"), [(0.0024, True), (0.0026, False)])
def test_a_piece_is_in_below_2_5_mm_above_the_floor(sim, height_m, counts):
    put_all_in(sim, heart=over_hole(sim, "heart", IN_HOLE_M + height_m))
    assert now(sim).goal[0] == counts


@pytest.mark.parametrize(("tilt_deg", "counts"), [(2.9, True), (3.1, False)])
def test_a_piece_is_in_when_tilted_by_less_than_3_degrees(sim, tilt_deg, counts):
    tilted = over_hole(sim, "circle", IN_HOLE_M)
    tilted[:3, :3] = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix() @ tilted[:3, :3]
    put_all_in(sim, circle=tilted)
    assert now(sim).goal[0] == counts


@pytest.mark.parametrize(
    ("piece", "turned_deg", "counts"),
    [
        ("triangle", 120, True),
        ("triangle", -120, True),
        ("triangle", 60, False),
        ("circle", 77, True),
        ("heart", 120, False),
        ("heart", 180, False),
    ],
)
def test_turns_that_look_the_same_count(sim, piece, turned_deg, counts):
    put_all_in(sim, **{piece: over_hole(sim, piece, IN_HOLE_M, turned_deg=turned_deg)})
    assert now(sim).partial[0] == (3 if counts else 2)


def test_the_wrong_piece_in_a_hole_counts_for_nothing(sim):
    put_all_in(sim, circle=over_hole(sim, "triangle", IN_HOLE_M), triangle=over_hole(sim, "circle", IN_HOLE_M))
    assert now(sim).partial[0] == 1  # the heart


def test_a_piece_in_flight_through_its_place_does_not_count(sim):
    put_all_in(sim)
    at = sim.model.joint("triangle").dofadr[0]
    sim.arrays["qvel"][0, at + 2] = -0.05  # falling
    sim.batch.forward(np.array([0]))
    assert not now(sim).goal[0]
    assert now(sim).partial[0] == 2
    sim.arrays["qvel"][0, at + 2] = -0.01
    sim.batch.forward(np.array([0]))
    assert now(sim).goal[0]


@pytest.mark.parametrize("height_m", [0.0005, 0.0020])  # lying in, and hovering low enough to count
def test_a_piece_that_a_hand_still_holds_in_its_hole_does_not_count(sim, height_m):
    held = over_hole(sim, "heart", IN_HOLE_M + height_m)
    put_all_in(sim, heart=held)
    assert now(sim).goal[0]
    move_hand(sim, "right", hand_over(held, 0.060), opening_m=0.0178)  # the knob is 18 mm wide
    assert sim.pads_touching("heart")[0].tolist() == [False, False, True, True]
    assert not now(sim).goal[0]
    assert now(sim).partial[0] == 2
    move_hand(sim, "right", hand_over(held, 0.060), opening_m=0.030)
    assert now(sim).goal[0]


# what counts as lost ---------------------------------------------------------------------------------------------------


def test_a_piece_left_on_the_rim_fails_after_three_seconds(sim):
    put(sim, {"triangle": over_hole(sim, "triangle", ON_TRAY_M + 1e-4, aside_m=0.003)})
    run(sim, 2.9)
    assert sim.poses("triangle")[0, 2, 3] > IN_HOLE_M + 0.005  # it has not dropped in
    assert now(sim).failures["rim"][0]
    assert sim.judge.outcome.failure[0] == ""
    run(sim, 0.2)
    assert sim.judge.outcome.failure[0] == "rim"


def test_a_piece_on_the_rim_is_not_lost_while_a_hand_is_near(sim):
    on_rim = over_hole(sim, "triangle", ON_TRAY_M - 5e-5, aside_m=0.003)  # it touches
    put(sim, {"triangle": on_rim})
    assert now(sim).failures["rim"][0]
    move_hand(sim, "right", hand_over(on_rim, 0.0325 + 0.095), opening_m=0.06)  # the knob's middle is 32.5 mm up
    assert not now(sim).failures["rim"][0]
    move_hand(sim, "right", hand_over(on_rim, 0.0325 + 0.105), opening_m=0.06)
    assert now(sim).failures["rim"][0]


def hold_on_the_tray(sim: Simulation, height_m: float = ON_TRAY_M - 5e-5) -> np.ndarray:
    """The right hand holds the triangle 3 mm beside its hole; its pose (4, 4)."""
    held = over_hole(sim, "triangle", height_m, aside_m=0.003)
    put(sim, {"triangle": held})
    move_hand(sim, "right", hand_over(held, 0.060), opening_m=0.0178)  # the knob is 18 mm wide
    assert sim.pads_touching("triangle")[0].tolist() == [False, False, True, True]
    return held


def test_a_piece_that_is_pressed_beside_its_hole_for_three_seconds_is_at_the_wrong_place(sim):
    held = hold_on_the_tray(sim)
    seen = now(sim)
    assert seen.failures["wrong place"][0] and not seen.failures["rim"][0]
    move_hand(sim, "right", hand_over(held, 0.060), opening_m=0.03)  # let go
    assert not now(sim).failures["wrong place"][0]
    hold_on_the_tray(sim)
    targets = sim.targets.copy()
    targets[0, 13] = 0.012  # grip; the arm presses down by 2 mm
    below = hand_over(held, 0.058)
    targets[0, 7:13] = ArmKinematics("right", RobotConfig()).search(below, np.random.default_rng(0))
    for _ in range(round(2.9 / STEP_S)):
        sim.step(targets)
    assert sim.contact("triangle", "tray").force_n[0] > 1.0
    assert sim.judge.outcome.failure[0] == ""
    for _ in range(round(0.5 / STEP_S)):  # the first steps settle
        sim.step(targets)
    assert sim.judge.outcome.failure[0] == "wrong place"


@pytest.mark.parametrize(("speed_mps", "counts"), [(0.004, True), (0.006, False)])
def test_a_pressed_piece_that_moves_is_searching(sim, speed_mps, counts):
    hold_on_the_tray(sim)
    sim.arrays["qvel"][0, sim.model.joint("triangle").dofadr[0]] = speed_mps
    sim.batch.forward(np.array([0]))
    assert now(sim).failures["wrong place"][0] == counts


def test_a_held_piece_over_the_tray_or_in_its_hole_is_at_no_wrong_place(sim):
    hold_on_the_tray(sim, ON_TRAY_M + 1e-3)
    assert not now(sim).failures["wrong place"][0]
    held = over_hole(sim, "triangle", IN_HOLE_M - 5e-5)
    put(sim, {"triangle": held})
    move_hand(sim, "right", hand_over(held, 0.060), opening_m=0.0178)
    assert sim.contact("triangle", "tray").touching[0]
    assert not now(sim).failures["wrong place"][0]


def test_a_piece_in_its_hole_or_beside_the_tray_is_not_on_the_rim(sim):
    assert not now(sim).failures["rim"][0]  # pieces on the table
    put_all_in(sim)
    run(sim, 0.1)
    assert sim.contact("heart", "tray").touching[0]
    assert not now(sim).failures["rim"][0]


def test_a_piece_that_lies_on_its_side_is_tipped_after_a_second(sim):
    lying = np.eye(4)
    lying[:3, :3] = Rotation.from_euler("x", 100, degrees=True).as_matrix()
    lying[:3, 3] = (0.40, 0.10, 0.024)
    put(sim, {"heart": lying})
    assert now(sim).failures["tipped"][0]
    run(sim, 0.5)
    assert sim.judge.outcome.failure[0] == ""
    run(sim, 0.6)
    assert sim.judge.outcome.failure[0] == "tipped"


def test_a_piece_off_the_table_is_dropped_at_once(sim):
    gone = np.eye(4)
    gone[:3, 3] = (1.2, 0.0, 0.0)
    put(sim, {"circle": gone})
    run(sim, STEP_S)
    assert sim.judge.outcome.failure[0] == "dropped"


# subtasks --------------------------------------------------------------------------------------------------------------


def test_each_piece_is_grasped_then_placed(sim):
    subtasks = sim.task.subtasks()
    assert [step.name for step in subtasks["left"]] == ["grasp circle", "place circle"]
    assert [step.name for step in subtasks["right"]] == [
        "grasp triangle",
        "place triangle",
        "grasp heart",
        "place heart",
    ]
    grasp, place = subtasks["left"]
    assert not grasp.done(sim)[0]
    put(sim, {"circle": over_hole(sim, "circle", 0.05)})
    assert grasp.done(sim)[0]
    assert not place.done(sim)[0]
    put(sim, {"circle": over_hole(sim, "circle", ON_TRAY_M)})
    assert not place.done(sim)[0]
    put(sim, {"circle": over_hole(sim, "circle", IN_HOLE_M)})
    assert place.done(sim)[0]
