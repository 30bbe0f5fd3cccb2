"""Intervals of a camera pose: they hold the truth as often as they say, where the surrogate's arms differ as they suppose."""

import numpy as np
import pytest
from test_camera import SIZE, twin

from pipelines.benchmarks.cameras import random_offset, random_poses, surrogate_pictures
from taccorl.alignment.camera.calibration import CameraFrames, calibrate_camera
from taccorl.alignment.camera.fit import (
    PoseFit,
    levels,
    match,
    outlines,
    seen_from,
    solve,
)
from taccorl.alignment.camera.interval import (
    JOINT_RAD,
    SHAPE_M,
    Covariance,
    _shifts,
    covariance,
)
from taccorl.alignment.camera.view import TwinView


@pytest.mark.slow
def test_the_same_frames_again_shrink_the_noise_but_not_what_the_twin_has_wrong():
    """All at the pose that the frames have once: a fit of more frames ends elsewhere."""
    rng = np.random.default_rng(0)
    joints = random_poses(rng, 3)
    pictures = surrogate_pictures("front", np.zeros(6), joints, rng, SIZE)
    found = []
    with TwinView(twin(), "front", SIZE) as view:
        pyramid = levels(list(view.inside(pictures)), view.intrinsics)
        pose = solve(view, joints, pyramid, view.start).offset
        for times in (1, 4):
            rows, level = np.tile(joints, (times, 1)), pyramid[-1]
            level = level._replace(edges=level.edges * times)
            drawn = outlines(view, rows, pose, level.intrinsics)
            matches = match(drawn, seen_from(view, pose, drawn.points), level, 3.0)
            fitted = PoseFit(pose, np.zeros(6), drawn, matches)
            found.append(covariance(view, rows, level, fitted))
    once, four_times = found
    # Points are drawn anew for each frame and the scatter of 36 groups is rough: a quarter, in the mean of the six.
    shrunk = np.log(np.diag(four_times.noise) / np.diag(once.noise)).mean()
    assert np.exp(shrunk) == pytest.approx(1 / 4, rel=0.35)
    np.testing.assert_allclose(
        np.diag(four_times.twin) / np.diag(once.twin), 1.0, rtol=0.1
    )
    np.testing.assert_allclose(np.diag(once.correlation), 1.0)
    assert (np.linalg.eigvalsh(once.total) > 0).all()


@pytest.mark.parametrize(
    "camera", ["front", pytest.param("left_wrist", marks=pytest.mark.slow)]
)
def test_wrong_joint_zeros_move_points_as_kinematics_says_and_not_the_hand_that_carries_the_camera(
    camera: str,
):
    rng = np.random.default_rng(0)
    joints, points = random_poses(rng, 1), rng.uniform(-0.1, 0.1, (3, 3))
    names = ["left_finger_a", "right_link5", "left_base_link"]
    with TwinView(twin(), camera, SIZE) as view:
        pose = random_offset(rng)

        def seen(row: np.ndarray) -> np.ndarray:
            view.place(row)
            at = [view.data.body(name) for name in (*names, view.camera.body)]
            world = [
                b.xpos + b.xmat.reshape(3, 3) @ point
                for b, point in zip(at, points, strict=False)
            ]
            return seen_from(
                view, pose, (np.array(world) - at[3].xpos) @ at[3].xmat.reshape(3, 3)
            )

        bodies = np.array([view.model.body(name).id for name in names])
        shifts = _shifts(view, joints, pose, seen(joints[0]), np.zeros(3, int), bodies)
        for k, joint in enumerate([0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]):
            further, back = joints[0].copy(), joints[0].copy()
            further[joint] += JOINT_RAD / 2
            back[joint] -= JOINT_RAD / 2
            moved = seen(further) - seen(back)
            np.testing.assert_allclose(
                shifts[9 + k], moved, atol=1e-8
            )  # after three axes of three bodies
            if camera == "left_wrist":
                assert np.abs(moved[0]).max() < 1e-12
        for k in range(9):
            lengths = np.linalg.norm(shifts[k], axis=1)
            mine = bodies == np.sort(bodies)[k // 3]
            np.testing.assert_allclose(
                lengths, np.where(mine, SHAPE_M, 0.0), atol=1e-12
            )


def test_the_worst_direction_is_the_longest_axis_and_is_put_in_words():
    variance = np.r_[np.deg2rad([0.1, 0.1, 0.1]), 0.001, 0.001, 0.001] ** 2
    noise = np.diag(variance)
    noise[1, 1], noise[3, 3] = np.deg2rad(3.0) ** 2, 0.04**2
    noise[1, 3] = noise[3, 1] = (
        0.99 * np.deg2rad(3.0) * 0.04
    )  # a turn and a shift that look alike
    width, words = Covariance(noise=noise, twin=np.zeros((6, 6))).worst()
    # In units of 0.3° and 4 mm both are 10: [[100, 99], [99, 100]] has the eigenvalue 199.
    assert (
        width == pytest.approx(1.96 * np.sqrt(199))
        and "turn about up (±5.88°)" in words
    )
    assert "shift right (±78.4 mm)" in words
    assert "back" not in words


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["front", "left_wrist"])
def test_the_truth_is_where_the_intervals_say(camera: str):
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth, joints = random_offset(rng, 0.02, 0.01), random_poses(rng, 12)
        pictures = surrogate_pictures(
            camera, truth, joints, rng, SIZE, joint_zero_rad=JOINT_RAD, shape_m=SHAPE_M
        )
        fit = calibrate_camera(
            CameraFrames(pictures=pictures, joints=joints), twin(), camera
        )
        deviation = fit.half_width / 1.96
        total = fit.correlation * np.outer(deviation, deviation)
        squares.append(
            (fit.offset - truth) @ np.linalg.solve(total, fit.offset - truth)
        )
    # χ² with 48 degrees of freedom: 95 % of its values lie between 31 and 69, and 99.9 % between 23 and 85.
    assert 23 < sum(squares) < 85
