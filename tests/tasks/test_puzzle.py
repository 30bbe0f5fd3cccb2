"""Do Puzzle: where things begin, what counts as placed, and what as lost."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapely import affinity
from shapely.geometry import Point, Polygon, box
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union
from task_scenes import pose_at, put, stay

from taccorl.robots import ROBOT
from taccorl.sim.part import Part
from taccorl.sim.randomize import draw
from taccorl.sim.robot import RobotConfig
from taccorl.sim.shapes import Box, Cylinder, Prism
from taccorl.sim.simulation import Simulation
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.puzzle.parts import PIECES
from taccorl.tasks.puzzle.scene import PIECES_AT_M, TRAY_AT_M, YAW_RAD, Puzzle

IN_HOLE_M = 0.004  # height of a piece's underside when it lies in: the tray's base is 4 mm thick
ON_TRAY_M = 0.014  # and when it stands on the tray's top: base and 10 mm of depth


@pytest.fixture(scope="module")
def built() -> Simulation:
    return Simulation(
        Puzzle(), scale=0.0
    )  # nothing drawn: everything at its nominal place


@pytest.fixture
def sim(built) -> Simulation:
    built.reset([0])
    return built


def over_hole(
    sim: Simulation,
    hole: str,
    height_m: float,
    *,
    turned_deg: float = 0.0,
    aside_m: float = 0.0,
) -> np.ndarray:
    """World pose (4, 4) of a piece that stands level over a hole of the tray."""
    pose = (
        sim.poses("tray")[0]
        @ Puzzle().tray.holes[hole].part_from_hole
        @ np.diag([1.0, -1, -1, 1])
    )
    pose[:3, :3] = (
        pose[:3, :3] @ Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    )
    pose[:3, 3] = (pose[0, 3] + aside_m, pose[1, 3], height_m)
    return pose


def put_all_in(sim: Simulation, **instead: np.ndarray) -> None:
    for piece in PIECES:
        put(sim, piece, instead.get(piece, over_hole(sim, piece, IN_HOLE_M + 1e-4)))


def move_hand(sim: Simulation, arm: str, tcp: np.ndarray, opening_m: float) -> None:
    """Put an arm at rest with its TCP at a world pose (4, 4)."""
    joints = sim.proprioception()[0].copy()
    a = 7 * ROBOT.arms.index(arm)
    joints[a : a + 6] = ArmKinematics(arm, RobotConfig()).search(
        tcp, np.random.default_rng(0)
    )
    joints[a + 6] = opening_m
    sim.place_arms(joints, joints)


def hand_over(piece: np.ndarray, above_m: float) -> np.ndarray:
    """TCP pose (4, 4), straight down, ``above_m`` above a piece's underside; the fingers close along the world's y."""
    tcp = np.diag([-1.0, 1, -1, 1])
    tcp[:3, 3] = piece[:3, 3] + (0, 0, above_m)
    return tcp


def now(sim: Simulation):
    return sim.task.look(sim)


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
                outline = box(
                    -solid.half_m[0], -solid.half_m[1], solid.half_m[0], solid.half_m[1]
                )
            case _:
                raise TypeError(solid)
        outlines.append(affinity.translate(outline, *solid.part_from_solid[:2, 3]))
    return unary_union(outlines)


def placed_at(outline: BaseGeometry, pose7: np.ndarray) -> BaseGeometry:
    yaw = Rotation.from_quat(pose7[3:], scalar_first=True).as_euler("zyx")[0]
    return affinity.translate(
        affinity.rotate(outline, yaw, origin=(0, 0), use_radians=True), *pose7[:2]
    )


@pytest.mark.parametrize("side", [-1, 1])
def test_support_and_position_add_up(side):
    task = Puzzle()
    values = {
        row.name: np.array(row.high if side > 0 else row.low) for row in task.rows
    }
    poses = task.reset(values).poses
    reach_m = {
        "circle": (0.040, 0.040),
        "heart": (0.040, 0.037),
        "triangle": (0.040, 0.037),
    }  # 30 + 10, 27 + 10 mm
    for piece in PIECES:
        np.testing.assert_allclose(
            poses[piece][:2] - PIECES_AT_M[piece],
            side * np.array(reach_m[piece]),
            atol=1e-12,
        )
        yaw = Rotation.from_quat(poses[piece][3:], scalar_first=True).as_euler("zyx")[0]
        assert yaw - YAW_RAD == pytest.approx(side * np.deg2rad(10))
    np.testing.assert_allclose(poses["tray"][:2] - TRAY_AT_M, side * 0.005, atol=1e-12)
    tray_yaw = Rotation.from_quat(poses["tray"][3:], scalar_first=True).as_euler("zyx")[
        0
    ]
    assert tray_yaw - YAW_RAD == pytest.approx(side * np.deg2rad(5))


def test_nothing_overlaps_in_500_draws_and_500_corners_of_the_ranges():
    task, rng = Puzzle(), np.random.default_rng(0)
    outlines = {
        name: footprint(part)
        for name, part in {"tray": task.tray, **task.pieces}.items()
    }
    assert outlines["tray"].area == pytest.approx(0.200 * 0.080)  # base and plate
    assert outlines["circle"].area == pytest.approx(np.pi * 0.020**2, rel=0.01)

    def smallest_gap_m(values: dict[str, np.ndarray]) -> float:
        poses = task.reset(values).poses
        covered = [
            placed_at(outline, poses[name]) for name, outline in outlines.items()
        ]
        return min(
            one.distance(other) for one, other in itertools.combinations(covered, 2)
        )

    corners = [
        {
            row.name: np.where(rng.random(len(row.low)) < 0.5, row.low, row.high)
            for row in task.rows
        }
        for _ in range(500)
    ]
    drawn = [draw(task.rows, np.random.default_rng(seed)) for seed in range(500)]
    assert min(map(smallest_gap_m, drawn + corners)) > 0.004


# what counts as placed -------------------------------------------------------------------------------------------------


def test_all_three_in_their_holes_succeed_after_half_a_second(sim):
    assert now(sim).partial[0] == 0
    for num, piece in enumerate(PIECES, start=1):
        put(sim, piece, over_hole(sim, piece, IN_HOLE_M + 1e-4))
        assert now(sim).partial[0] == num and now(sim).goal[0] == (num == 3)
    stay(sim, 14)
    assert not sim.judge.outcome.success[0]
    stay(sim, 1)
    assert sim.judge.outcome.success[0]


@pytest.mark.parametrize(
    ("piece", "above_mm", "tilt_deg", "turned_deg", "counts"),
    [
        ("heart", 2.4, 0, 0, True),
        ("heart", 2.6, 0, 0, False),
        ("circle", 0, 2.9, 0, True),
        ("circle", 0, 3.1, 0, False),
        ("triangle", 0, 0, 120, True),
        ("triangle", 0, 0, -120, True),
        ("triangle", 0, 0, 60, False),
        ("circle", 0, 0, 77, True),
        ("heart", 0, 0, 120, False),
        ("heart", 0, 0, 180, False),
    ],
)
def test_a_piece_is_in_near_the_floor_level_and_turned_as_it_fits(
    sim, piece, above_mm, tilt_deg, turned_deg, counts
):
    pose = over_hole(sim, piece, IN_HOLE_M + above_mm / 1e3, turned_deg=turned_deg)
    pose[:3, :3] = (
        Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix() @ pose[:3, :3]
    )
    put_all_in(sim, **{piece: pose})
    assert now(sim).goal[0] == counts
    assert now(sim).partial[0] == (3 if counts else 2)


def test_the_wrong_piece_in_a_hole_counts_for_nothing(sim):
    put_all_in(
        sim,
        circle=over_hole(sim, "triangle", IN_HOLE_M),
        triangle=over_hole(sim, "circle", IN_HOLE_M),
    )
    assert now(sim).partial[0] == 1  # the heart


def test_a_piece_in_flight_through_its_place_does_not_count(sim):
    put_all_in(sim)
    for speed_mps, counts in ((-0.05, False), (-0.01, True)):  # falling
        put(
            sim,
            "triangle",
            over_hole(sim, "triangle", IN_HOLE_M + 1e-4),
            (0, 0, speed_mps),
        )
        assert now(sim).goal[0] == counts and now(sim).partial[0] == 2 + counts


@pytest.mark.parametrize(
    "height_m", [0.0005, 0.0020]
)  # lying in, and hovering low enough to count
def test_a_piece_that_a_hand_still_holds_in_its_hole_does_not_count(sim, height_m):
    held = over_hole(sim, "heart", IN_HOLE_M + height_m)
    put_all_in(sim, heart=held)
    assert now(sim).goal[0]
    move_hand(
        sim, "right", hand_over(held, 0.060), opening_m=0.0178
    )  # the knob is 18 mm wide
    assert (
        sim.pads_touching("heart")[0].tolist() == [False, False, True, True]
        and not now(sim).goal[0]
    )
    assert now(sim).partial[0] == 2
    move_hand(sim, "right", hand_over(held, 0.060), opening_m=0.030)
    assert now(sim).goal[0]


# what counts as lost ---------------------------------------------------------------------------------------------------


def test_a_piece_left_on_the_rim_fails_after_three_seconds(sim):
    put(sim, "triangle", over_hole(sim, "triangle", ON_TRAY_M + 1e-4, aside_m=0.003))
    stay(sim, 87)
    assert sim.poses("triangle")[0, 2, 3] > IN_HOLE_M + 0.005  # it has not dropped in
    assert now(sim).failures["rim"][0]
    assert sim.judge.outcome.failure[0] == ""
    stay(sim, 6)
    assert sim.judge.outcome.failure[0] == "rim"


def test_a_piece_on_the_rim_is_not_lost_while_a_hand_is_near(sim):
    on_rim = over_hole(sim, "triangle", ON_TRAY_M - 5e-5, aside_m=0.003)  # it touches
    put(sim, "triangle", on_rim)
    assert now(sim).failures["rim"][0]
    move_hand(
        sim, "right", hand_over(on_rim, 0.0325 + 0.095), opening_m=0.06
    )  # the knob's middle is 32.5 mm up
    assert not now(sim).failures["rim"][0]
    move_hand(sim, "right", hand_over(on_rim, 0.0325 + 0.105), opening_m=0.06)
    assert now(sim).failures["rim"][0]


def hold_on_the_tray(sim: Simulation, height_m: float = ON_TRAY_M - 5e-5) -> np.ndarray:
    """The right hand holds the triangle 3 mm beside its hole; its pose (4, 4)."""
    held = over_hole(sim, "triangle", height_m, aside_m=0.003)
    put(sim, "triangle", held)
    move_hand(
        sim, "right", hand_over(held, 0.060), opening_m=0.0178
    )  # the knob is 18 mm wide
    assert sim.pads_touching("triangle")[0].tolist() == [False, False, True, True]
    return held


def test_a_piece_that_is_pressed_beside_its_hole_for_three_seconds_is_at_the_wrong_place(
    sim,
):
    held = hold_on_the_tray(sim)
    seen = now(sim)
    assert seen.failures["wrong place"][0] and not seen.failures["rim"][0]
    move_hand(sim, "right", hand_over(held, 0.060), opening_m=0.03)  # let go
    assert not now(sim).failures["wrong place"][0]
    hold_on_the_tray(sim)
    targets = sim.targets.copy()
    targets[0, 13] = 0.012  # grip; the arm presses down by 2 mm
    below = hand_over(held, 0.058)
    targets[0, 7:13] = ArmKinematics("right", RobotConfig()).search(
        below, np.random.default_rng(0)
    )
    stay(sim, 87, targets)
    assert sim.contact("triangle", "tray").force_n[0] > 1.0
    assert sim.judge.outcome.failure[0] == ""
    stay(sim, 15, targets)  # the first steps settle
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
    put(sim, "triangle", held)
    move_hand(sim, "right", hand_over(held, 0.060), opening_m=0.0178)
    assert sim.contact("triangle", "tray").touching[0]
    assert not now(sim).failures["wrong place"][0]


def test_a_piece_in_its_hole_or_beside_the_tray_is_not_on_the_rim(sim):
    assert not now(sim).failures["rim"][0]  # pieces on the table
    put_all_in(sim)
    stay(sim, 3)
    assert sim.contact("heart", "tray").touching[0]
    assert not now(sim).failures["rim"][0]


def test_a_piece_that_lies_on_its_side_is_tipped_after_a_second(sim):
    put(sim, "heart", pose_at(0.40, 0.10, 0.024, euler_deg=(0, 0, 100)))
    assert now(sim).failures["tipped"][0]
    stay(sim, 15)
    assert sim.judge.outcome.failure[0] == ""
    stay(sim, 18)
    assert sim.judge.outcome.failure[0] == "tipped"


def test_a_piece_off_the_table_is_dropped_at_once(sim):
    put(sim, "circle", pose_at(1.2, 0.0, 0.0))
    stay(sim, 1)
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
    put(sim, "circle", over_hole(sim, "circle", 0.05))
    assert grasp.done(sim)[0]
    assert not place.done(sim)[0]
    put(sim, "circle", over_hole(sim, "circle", ON_TRAY_M))
    assert not place.done(sim)[0]
    put(sim, "circle", over_hole(sim, "circle", IN_HOLE_M))
    assert place.done(sim)[0]
