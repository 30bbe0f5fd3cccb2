"""Rigid transforms agree with scipy. Inverse kinematics returns joint angles whose forward kinematics is the asked pose, or an
error that names the pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig, link_poses
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.experts.se3 import between, inverse, rotvec, transform, turn

LOW, HIGH = np.array([link.range_rad for link in ROBOT.links]).T
HOME_RAD = np.array((0.003, 1.732, -0.883, -0.528, 0.884, -1.213))


@pytest.fixture(scope="module")
def left() -> ArmKinematics:
    return ArmKinematics("left", RobotConfig())


def off(pose: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    return float(np.linalg.norm(pose[:3, 3] - goal[:3, 3])), float(
        np.linalg.norm(rotvec(pose, goal))
    )


@pytest.mark.parametrize(("arm", "y_m"), [("left", 0.3), ("right", -0.3)])
def test_the_tcp_is_where_plain_matrix_products_put_it(arm, y_m):
    kinematics, rng = (
        ArmKinematics(arm, RobotConfig(mount_height_m=0.15)),
        np.random.default_rng(0),
    )
    for _ in range(10):
        joints = rng.uniform(LOW + 0.1, HIGH - 0.1)
        by_hand = (
            transform((0, y_m, 0.15))
            @ link_poses(joints)[-1]
            @ transform((0, 0, ROBOT.tcp_from_hand_m))
        )
        np.testing.assert_allclose(kinematics.pose(joints), by_hand, atol=1e-9)


def test_solving_from_nearby_returns_the_joints_that_made_the_pose(left):
    rng, found = np.random.default_rng(1), 0
    for _ in range(40):
        joints = rng.uniform(LOW + 0.4, HIGH - 0.4)
        solved, error_m = left.solve(
            left.pose(joints), joints + rng.uniform(-0.05, 0.05, 6)
        )
        distance_m, angle_rad = off(left.pose(solved), left.pose(joints))
        assert error_m < 1e-5
        assert distance_m < 1e-5
        assert angle_rad < 1e-4
        found += np.abs(solved - joints).max() < 0.02
    assert (
        found >= 38
    )  # joint 5 near 0 leaves joints 4 and 6 free to turn against each other


def test_the_error_that_is_left_is_the_position_plus_a_hand_length_times_the_rotation(
    left,
):
    goal = left.pose(HOME_RAD) @ turn((0, 0, 0.2))
    goal[:3, 3] += (0.03, 0, 0)
    _, error_m = left.solve(
        goal, HOME_RAD, tolerance_m=1.0
    )  # good enough before the first step: 30 mm + 0.15 m · 0.2
    assert error_m == pytest.approx(0.03 + 0.15 * 0.2, abs=1e-9)


def test_a_pose_beyond_the_limits_is_met_as_well_as_the_limits_allow(left):
    joints = HOME_RAD.copy()
    joints[4] = HIGH[4] + 0.2  # 0.22 rad beyond what the margin leaves
    goal = left.pose(joints)
    solved, error_m = left.solve(goal, HOME_RAD)
    assert (solved >= LOW + 0.02 - 1e-9).all()
    assert (solved <= HIGH - 0.02 + 1e-9).all()
    distance_m, angle_rad = off(left.pose(solved), goal)
    assert error_m == pytest.approx(distance_m + 0.15 * angle_rad, abs=1e-9)
    clipped = left.pose(np.clip(joints, LOW + 0.02, HIGH - 0.02))
    naive_m, naive_rad = off(clipped, goal)
    assert (
        0.002 < error_m < naive_m + 0.15 * naive_rad
    )  # better than just stopping at the limit


def test_a_hand_without_reach_is_reported_and_not_guessed(left):
    goal = left.pose(HOME_RAD)
    goal[0, 3] = 1.2
    _, error_m = left.solve(goal, HOME_RAD)
    assert error_m > 0.3  # the arm spans 0.285 + 0.252 + 0.259 m from its shoulder


def test_search_keeps_the_solution_with_the_widest_margin(left):
    goal = left.pose(HOME_RAD)
    margins = []
    for tries in (1, 40):
        joints = left.search(goal, np.random.default_rng(2), tries=tries)
        margins.append(np.minimum(joints - LOW, HIGH - joints).min())
    assert margins[1] >= margins[0]
    assert margins[1] > 0.3  # HOME_RAD itself has 0.336 rad at joint 5


def test_out_of_reach_names_the_arm_the_place_and_the_way_out(left):
    with pytest.raises(
        TaccorlError,
        match=r"left arm: TCP at \[0\.9, 0\.0, 0\.2\] m .* out of reach: \d+\.\d mm short",
    ) as error:
        left.search(transform((0.9, 0, 0.2)), np.random.default_rng(0), tries=3)
    assert "tilt the approach" in str(error.value)


# ---- rigid transforms ----


def drawn(rng: np.random.Generator) -> np.ndarray:
    return transform(rng.normal(size=3), Rotation.random(rng=rng).as_matrix())


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_a_pose_times_its_inverse_is_the_identity(rng):
    for _ in range(20):
        pose = drawn(rng)
        np.testing.assert_allclose(pose @ inverse(pose), np.eye(4), atol=1e-14)
        np.testing.assert_allclose(inverse(pose) @ pose, np.eye(4), atol=1e-14)


def test_turn_is_scipys_rotation(rng):
    for vector in [
        *rng.normal(size=(30, 3)),
        np.zeros(3),
        np.full(3, 1e-12),
        (np.pi, 0, 0),
        (0, 0, 4.0),
    ]:
        np.testing.assert_allclose(
            turn(vector)[:3, :3], Rotation.from_rotvec(vector).as_matrix(), atol=1e-15
        )
        np.testing.assert_array_equal(turn(vector)[:3, 3], 0)


@pytest.mark.parametrize(
    "angle",
    [
        0,
        1e-12,
        1e-9,
        1e-5,
        0.3,
        1.0,
        2.0,
        3.0,
        np.pi - 1e-3,
        np.pi - 2e-5,
        np.pi - 1e-9,
    ],
)
def test_a_turn_is_found_again_from_its_two_ends(rng, angle):
    for _ in range(5):
        start, axis = drawn(rng), rng.normal(size=3)
        vector = angle * axis / np.linalg.norm(axis)
        # The rotation vector is in the first frame: it multiplies from the right. A matrix holds the axis of a turn close to
        # a half only as the small difference of its entries, 1e-16 of 1e-4.
        np.testing.assert_allclose(
            rotvec(start, start @ turn(vector)),
            vector,
            atol=1e-11 if angle < 3.1 else 1e-7,
        )


def test_a_half_turn_is_found_up_to_its_sign_and_only_from_the_rotations(rng):
    axis = np.array([0.6, 0.0, -0.8])
    found = rotvec(np.eye(4), turn(np.pi * axis))
    np.testing.assert_allclose(abs(found @ axis), np.pi, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found), np.pi, atol=1e-12)
    start, end = drawn(rng), drawn(rng)
    np.testing.assert_array_equal(
        rotvec(start, end), rotvec(start[:3, :3], end[:3, :3])
    )


def test_between_is_straight_and_turns_at_one_rate_about_one_axis():
    start, end = transform((0.0, 0, 0)), transform((0.1, 0.2, 0)) @ turn((0, 0, 1.2))
    quarter = between(start, end, 0.25)
    np.testing.assert_allclose(quarter[:3, 3], (0.025, 0.05, 0))
    np.testing.assert_allclose(quarter[:3, :3], turn((0, 0, 0.3))[:3, :3], atol=1e-15)
