"""Rigid transforms: against scipy, against their own inverses, at the ends and at half turns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from taccorl.tasks.experts.se3 import between, inverse, rotvec, transform, turn


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
    for vector in [*rng.normal(size=(30, 3)), np.zeros(3), np.full(3, 1e-12), (np.pi, 0, 0), (0, 0, 4.0)]:
        np.testing.assert_allclose(turn(vector)[:3, :3], Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
        np.testing.assert_array_equal(turn(vector)[:3, 3], 0)


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-9, 1e-5, 0.3, 1.0, 2.0, 3.0, np.pi - 1e-3, np.pi - 2e-5, np.pi - 1e-9]
)
def test_a_turn_is_found_again_from_its_two_ends(rng, angle):
    for _ in range(5):
        start, axis = drawn(rng), rng.normal(size=3)
        vector = angle * axis / np.linalg.norm(axis)
        # The rotation vector is in the first frame: it multiplies from the right. A matrix holds the axis of a turn close to
        # a half only as the small difference of its entries, 1e-16 of 1e-4.
        np.testing.assert_allclose(rotvec(start, start @ turn(vector)), vector, atol=1e-11 if angle < 3.1 else 1e-7)


def test_a_half_turn_is_found_up_to_its_sign(rng):
    axis = np.array([0.6, 0.0, -0.8])
    found = rotvec(np.eye(4), turn(np.pi * axis))
    np.testing.assert_allclose(abs(found @ axis), np.pi, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found), np.pi, atol=1e-12)


def test_rotvec_reads_only_the_rotations(rng):
    start, end = drawn(rng), drawn(rng)
    np.testing.assert_array_equal(rotvec(start, end), rotvec(start[:3, :3], end[:3, :3]))


def test_between_is_straight_and_turns_at_one_rate_about_one_axis():
    start, end = transform((0.0, 0, 0)), transform((0.1, 0.2, 0)) @ turn((0, 0, 1.2))
    quarter = between(start, end, 0.25)
    np.testing.assert_allclose(quarter[:3, 3], (0.025, 0.05, 0))
    np.testing.assert_allclose(quarter[:3, :3], turn((0, 0, 0.3))[:3, :3], atol=1e-15)
