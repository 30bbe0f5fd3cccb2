"""The PiPER's file: indices by hand, limits that float32 keeps, and agreement with the data spec that datasets are made by."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from taccorl.data.sensor_spec import load_sensor_spec
from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.robots import ROBOT
from taccorl.robots.bimanual_piper import FINGER_MASS_KG, INERTIAS
from taccorl.robots.robot_spec import PadLayout

SPEC = load_dataset_spec(find_spec("taccorl_bimanual"))


def test_numbers_of_an_action_are_arm_after_arm_joints_then_gripper() -> None:
    assert (ROBOT.num_joints, ROBOT.num_per_arm, ROBOT.num_actions) == (6, 7, 14)
    assert ROBOT.action_names[:7] == (
        *(f"left_joint{j}" for j in range(1, 7)),
        "left_gripper",
    )
    assert ROBOT.joint_slice("right") == slice(7, 13)
    assert ROBOT.arm_slice("right") == slice(7, 14)
    assert (ROBOT.gripper_index("left"), ROBOT.gripper_indices) == (6, [6, 13])
    assert ROBOT.joint_indices == [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]
    assert ROBOT.per_action(2.0, 0.5).tolist() == [2.0] * 6 + [0.5] + [2.0] * 6 + [0.5]
    with pytest.raises(ValueError):
        ROBOT.joint_slice("middle")


def test_a_robot_with_one_arm_of_five_joints_has_indices_of_its_own() -> None:
    one = dataclasses.replace(
        ROBOT,
        arms=("arm",),
        joints=ROBOT.joints[:5],
        links=ROBOT.links[:5],
        pad=PadLayout(rows=16, columns=8, pitch_m=0.003),
    )
    assert one.action_names == (
        "arm_joint1",
        "arm_joint2",
        "arm_joint3",
        "arm_joint4",
        "arm_joint5",
        "arm_gripper",
    )
    assert (one.joint_slice("arm"), one.gripper_indices, one.num_actions) == (
        slice(0, 5),
        [5],
        6,
    )
    assert one.action_low.shape == one.action_high.shape == (6,)
    assert (one.pads, one.num_taxels) == (("arm_a", "arm_b"), 2 * 16 * 8)
    assert (one.pad.length_m, one.pad.width_m) == pytest.approx((0.048, 0.024))


def test_limits_are_float32_that_lie_inside_the_ranges() -> None:
    ranges = np.array([*(link.range_rad for link in ROBOT.links), (0.0, 0.07)] * 2)
    for limits in (ROBOT.action_low, ROBOT.action_high):
        np.testing.assert_array_equal(limits, limits.astype(np.float32))
    assert (ROBOT.action_low >= ranges[:, 0]).all()
    assert (ROBOT.action_high <= ranges[:, 1]).all()
    np.testing.assert_allclose(ROBOT.action_low, ranges[:, 0], atol=1e-6)
    np.testing.assert_allclose(ROBOT.action_high, ranges[:, 1], atol=1e-6)
    assert (ROBOT.action_low[ROBOT.gripper_indices] == 0.0).all()


def test_the_data_spec_is_of_this_robot() -> None:
    """Our ``left_joint1`` is the dataset's ``left_joint_1.pos``. Its grippers open wider, for longer fingers."""
    names = SPEC.features["action"].names
    assert names is not None
    assert [n.removesuffix(".pos").replace("joint_", "joint") for n in names] == list(
        ROBOT.action_names
    )
    assert SPEC.features["observation.state"].names == names
    assert [k for k in SPEC.features if ".images." in k] == [
        f"observation.images.{name}" for name in ROBOT.cameras
    ]
    tactile = SPEC.features["observation.tactile"]
    assert tactile.pads == ROBOT.pads
    assert tactile.shape == (ROBOT.num_taxels,)
    assert tactile.sensor is not None
    sensor = load_sensor_spec(find_spec(Path(tactile.sensor).stem))
    assert (sensor.rows, sensor.columns) == ROBOT.pad.shape


def test_every_table_has_a_number_for_every_joint() -> None:
    assert len(ROBOT.links) == len(ROBOT.joints)
    for gains in (ROBOT.kp_nm_per_rad, ROBOT.kd_nms_per_rad, ROBOT.torque_ff_nm):
        assert len(gains) == len(ROBOT.joints)
    assert {name: len(rows) for name, rows in INERTIAS.items()} == dict.fromkeys(
        FINGER_MASS_KG, len(ROBOT.links)
    )
