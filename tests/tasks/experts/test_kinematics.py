"""Inverse kinematics: back to where forward kinematics came from, within the joints' limits, or an error that says where."""

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig, link_poses
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.experts.se3 import rotvec, transform, turn

LOW, HIGH = np.array([link.range_rad for link in ROBOT.links]).T
HOME_RAD = np.array((0.003, 1.732, -0.883, -0.528, 0.884, -1.213))


@pytest.fixture(scope="module")
def left() -> ArmKinematics:
    return ArmKinematics("left", RobotConfig())


def drawn_joints(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(LOW + 0.1, HIGH - 0.1)


def off(pose: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    return float(np.linalg.norm(pose[:3, 3] - goal[:3, 3])), float(np.linalg.norm(rotvec(pose, goal)))


@pytest.mark.parametrize(("arm", "y_m"), [("left", 0.3), ("right", -0.3)])
def test_the_tcp_is_where_plain_matrix_products_put_it(arm, y_m):
    kinematics, rng = ArmKinematics(arm, RobotConfig(mount_height_m=0.15)), np.random.default_rng(0)
    for _ in range(10):
        joints = drawn_joints(rng)
        by_hand = transform((0, y_m, 0.15)) @ link_poses(joints)[-1] @ transform((0, 0, ROBOT.tcp_from_hand_m))
        np.testing.assert_allclose(kinematics.pose(joints), by_hand, atol=1e-9)


def test_solving_from_nearby_returns_the_joints_that_made_the_pose(left):
    rng, found = np.random.default_rng(1), 0
    for _ in range(40):
        joints = rng.uniform(LOW + 0.4, HIGH - 0.4)
        solved, error_m = left.solve(left.pose(joints), joints + rng.uniform(-0.05, 0.05, 6))
        distance_m, angle_rad = off(left.pose(solved), left.pose(joints))
        assert error_m < 1e-5
        assert distance_m < 1e-5
        assert angle_rad < 1e-4
        found += np.abs(solved - joints).max() < 0.02
    assert found >= 38  # joint 5 near 0 leaves joints 4 and 6 free to turn against each other


def test_the_error_that_is_left_is_the_position_plus_a_hand_length_times_the_rotation(left):
    goal = left.pose(HOME_RAD) @ turn((0, 0, 0.2))
    goal[:3, 3] += (0.03, 0, 0)
    _, error_m = left.solve(goal, HOME_RAD, tolerance_m=1.0)  # good enough before the first step: 30 mm + 0.15 m · 0.2
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
    assert 0.002 < error_m < naive_m + 0.15 * naive_rad  # better than just stopping at the limit


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
        TaccorlError, match=r"left arm: TCP at \[0\.9, 0\.0, 0\.2\] m .* out of reach: \d+\.\d mm short"
    ) as error:
        left.search(transform((0.9, 0, 0.2)), np.random.default_rng(0), tries=3)
    assert "tilt the approach" in str(error.value)
