"""Test Tube Insertion: where things begin, what counts as inserted, what is a near miss and what a failure."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from task_scenes import failures, pose_at, put, stay

from taccorl.sim.robot import RobotConfig
from taccorl.sim.simulation import Simulation
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.test_tube.parts import tube_stand
from taccorl.tasks.test_tube.scene import RACK_AT_M, TUBE_AT_M, TestTube

DEG = np.pi / 180
HOLD_STEPS = 15  # 0.5 s at 30 Hz
MOUTH_M, FLOOR_M = (
    0.050,
    0.004,
)  # heights of the rack's top and of its floor: 46 mm deep
AWAY_M = (0.60, -0.30)  # on the table, far from everything


@pytest.fixture(scope="module")
def built() -> Simulation:
    return Simulation(
        TestTube(), scale=0.0
    )  # nothing drawn: everything at its nominal place


@pytest.fixture
def sim(built) -> Simulation:
    built.reset([0])
    rack = built.poses("rack")[0].copy()
    rack[2, 3] = 0.0  # exactly on the table, from which a reset leaves 0.2 mm
    put(built, "rack", rack)
    return built


def over_hole(
    depth_m: float, *, lean_deg: float = 0.0, aside_m: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """World pose (4, 4) of a tube, cap up, its bottom ``depth_m`` below the mouth of the nominal rack's middle hole."""
    x_m, y_m = np.add(RACK_AT_M, aside_m)
    return pose_at(x_m, y_m, MOUTH_M - depth_m, euler_deg=(0, 0, lean_deg))


def goal(sim: Simulation) -> bool:
    return bool(sim.task.look(sim).goal[0])


# where it begins ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw_deg", [-20, 0, 20])
def test_tube_and_stand_are_drawn_together(yaw_deg):
    shift = np.array((0.02, -0.013))
    drawn = {
        "tube_position": shift,
        "tube_yaw": np.array([yaw_deg * DEG]),
        "holder_position": np.zeros(2),
    }
    poses = TestTube().reset({**drawn, "friction": np.array([0.4])}).poses
    turned = {
        name: Rotation.from_quat(pose[3:], scalar_first=True)
        for name, pose in poses.items()
    }
    along = np.array(
        [-np.sin(yaw_deg * DEG), np.cos(yaw_deg * DEG), 0]
    )  # at 0 the cap points along +y
    assert turned["tube"].apply((0, 0, 1)) == pytest.approx(along, abs=1e-12)
    assert turned["stand"].apply((1, 0, 0)) == pytest.approx(along, abs=1e-12)
    middle = poses["tube"][:3] + 0.050 * along
    assert middle == pytest.approx(
        [TUBE_AT_M[0] + 0.02, TUBE_AT_M[1] - 0.013, 0.0402 + 0.0002], abs=3e-4
    )
    seat = tube_stand().seats["tube"]
    in_stand = turned["stand"].inv().apply(poses["tube"][:3] - poses["stand"][:3])
    assert in_stand == pytest.approx(seat[:3, 3], abs=5e-4)


def test_the_rack_is_drawn_in_the_plane_its_handle_to_the_left_arm():
    drawn = {
        "tube_position": np.zeros(2),
        "tube_yaw": np.zeros(1),
        "friction": np.array([0.62]),
    }
    scene = TestTube().reset(drawn | {"holder_position": np.array((0.005, -0.004))})
    rack = scene.poses["rack"]
    assert rack[:2] == pytest.approx((RACK_AT_M[0] + 0.005, RACK_AT_M[1] - 0.004))
    assert rack[2] == pytest.approx(0.0, abs=5e-4)
    handle = Rotation.from_quat(rack[3:], scalar_first=True).apply((-0.061, 0, 0))
    assert handle == pytest.approx((0, 0.061, 0), abs=1e-12)
    assert scene.friction == 0.62


# what counts ----------------------------------------------------------------------------------------------------------


def test_a_tube_in_flight_is_no_success_until_it_has_come_to_rest(sim):
    put(sim, "tube", over_hole(-0.010))
    assert not goal(sim)
    landed = None
    for step in range(40):
        stay(sim, 1)
        speed = sim.judge.verdict.measures["speed_mps"][0]
        assert not (goal(sim) and speed >= 0.02)
        assert not (goal(sim) and sim.judge.verdict.measures["depth_m"][0] < 0.040)
        landed = step if goal(sim) and landed is None else landed
        if landed is None or step < landed + HOLD_STEPS - 1:
            assert not sim.judge.success[0]
    assert landed is not None
    assert sim.judge.success[0] and sim.judge.outcome.failure[0] == ""


@pytest.mark.parametrize(
    ("speed_mps", "at_rest"),
    [(0.0, True), (0.019, True), (0.021, False), (-0.3, False)],
)
def test_a_tube_that_moves_in_the_hole_is_not_there_yet(sim, speed_mps, at_rest):
    put(sim, "tube", over_hole(0.043), velocity_mps=(0, 0, speed_mps))
    assert goal(sim) == at_rest


def test_it_is_the_speed_against_the_rack_that_counts(sim):
    put(sim, "rack", sim.poses("rack")[0], velocity_mps=(0, 0.1, 0))
    put(sim, "tube", over_hole(0.043), velocity_mps=(0, 0.1, 0))
    assert goal(sim)


@pytest.mark.parametrize(("depth_mm", "lean_deg", "aside_mm", "inside"), [
    (39.9, 0, 0, False), (40.1, 0, 0, True),
    (43, 4.9, 0, True), (43, 5.1, 0, False), (43, -5.1, 0, False), (43, 180, 0, False),
    (43, 0, 2.9, True), (43, 0, 3.1, False),
])  # fmt: skip
def test_depth_lean_and_place_are_judged_to_a_hair(
    sim, depth_mm, lean_deg, aside_mm, inside
):
    put(
        sim,
        "tube",
        over_hole(depth_mm * 1e-3, lean_deg=lean_deg, aside_m=(aside_mm * 1e-3, 0)),
    )
    assert goal(sim) == inside and sim.task.look(sim).partial[0] == inside


def test_a_tube_that_is_still_held_is_no_success(sim):
    ahead = np.array((1, 1, 0)) / np.sqrt(
        2
    )  # a hand that comes level from behind on the right, then leans by 35°
    pose = np.eye(4)
    pose[:3, :3] = np.stack([(0, 0, -1), np.cross(ahead, (0, 0, -1)), ahead], axis=1)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("y", 35, degrees=True).as_matrix()
    pose[:3, 3] = (*RACK_AT_M, MOUTH_M + 0.030)
    joints = sim.proprioception()[0].copy()
    joints[7:13] = ArmKinematics("right", RobotConfig()).search(
        pose, np.random.default_rng(0)
    )
    for opening_m, held in [(0.0155, True), (0.030, False)]:
        joints[13] = opening_m
        sim.place_arms(joints, joints)
        put(sim, "tube", over_hole(0.0455))
        assert (
            sim.pads_touching("tube")[0].tolist() == [False, False, held, held]
            and goal(sim) != held
        )


# failures -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("depth_mm", "lean_deg", "aside_mm", "seen"), [
    (0.2, 0, (0, 7), "rim"),  # its round bottom, R 8, is 8 − √(64 − 1.5²) = 0.14 mm up where it meets the edge at 8.5
    (0.05, 0, (0, 13), "rim"),  # on the web between two holes
    (30, 8, (0, 0), "jam"),  # leans by more than 1.8°: it presses into the plates
    (45.9, 6, (0, 0), "jam"),
    (20, 0, (0.55, 0), "jam"),  # stuck on its way
    (46.05, 0, (0, 26), "missed"),  # stands in a hole next to it
    (49.9, -20, (0, -71), "missed"),  # leans on the rack from outside
    (-7.9, 90, (0, 50), "rim"),  # lies across it
])  # fmt: skip
def test_each_failure_has_its_name_and_is_none_while_the_tube_only_passes(
    sim, depth_mm, lean_deg, aside_mm, seen
):
    aside_m = (aside_mm[0] * 1e-3, aside_mm[1] * 1e-3)
    put(sim, "tube", over_hole(depth_mm * 1e-3, lean_deg=lean_deg, aside_m=aside_m))
    assert (
        TestTube.failures[seen] == 0.5
    )  # it may still slide in, or the hand take it again
    assert sim.contact("tube", "rack").touching[0]
    assert failures(sim) == {seen} and not goal(sim)


def test_a_tube_on_the_table_is_dropped_after_half_a_second(sim):
    put(sim, "tube", pose_at(*AWAY_M, 0.0101, euler_deg=(0, 90, 0)))
    stay(sim, HOLD_STEPS - 2)
    assert not sim.judge.outcome.over[0]
    stay(sim, 3)
    assert sim.judge.outcome.failure[0] == "dropped"


@pytest.mark.parametrize(
    "shift_mm",
    [(24, 0, 0), (0, -24, 0), (26, 0, 0), (0, -26, 0), (0, 0, 26), (18.5, 18.5, 0)],
)
def test_the_rack_may_not_be_moved_away(sim, shift_mm):
    """By 20 mm from where it stood, at most 5 mm off its nominal place."""
    rack = sim.poses("rack")[0].copy()
    rack[:3, 3] += np.array(shift_mm) * 1e-3
    put(sim, "rack", rack)
    assert ("rack moved" in failures(sim)) == (np.linalg.norm(shift_mm) > 25)


# subtasks -------------------------------------------------------------------------------------------------------------


def test_a_tube_over_the_rack_is_not_lifted_and_one_in_its_hole_ends_the_last_subtask_of_both(
    sim,
):
    put(sim, "tube", over_hole(-0.05))
    assert not any(subtask.done(sim)[0] for subtask in sim.task.subtasks()["right"])
    put(sim, "tube", over_hole(0.0459))
    assert all(sim.task.subtasks()[arm][-1].done(sim)[0] for arm in ("left", "right"))
