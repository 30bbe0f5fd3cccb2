"""Camera calibration on surrogate pictures (other light, colours, parts, blur, noise, JPEG) whose camera's place is known."""

import dataclasses
import functools
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.benchmarks import cameras as drawn
from taccorl.alignment.camera.calibration import (
    CameraFit,
    CameraFrames,
    calibrate_camera,
)
from taccorl.alignment.camera.fit import Matches, distances, moved, seen_from, slopes
from taccorl.alignment.camera.view import TwinView, as_offset
from taccorl.errors import TaccorlError
from taccorl.sim.cameras import Intrinsics
from taccorl.sim.effects import make_effect
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, save_twin

SIZE = (240, 320)
SMALL = Intrinsics(rows=60, columns=80, fx_px=70.0, fy_px=70.0, cx_px=39.5, cy_px=29.5)


def twin() -> TwinConfig:
    """The nominal twin with cameras that record 320 × 240."""
    config = TwinConfig()
    config.cameras = [
        dataclasses.replace(camera, recording_size=SIZE) for camera in config.cameras
    ]
    return config


@functools.cache
def made(camera: str) -> tuple[np.ndarray, CameraFrames]:
    """Where the surrogate's camera is, and what it took."""
    rng = np.random.default_rng(7)
    truth, joints = drawn.random_offset(rng), drawn.random_poses(rng, 9)
    pictures = drawn.surrogate_pictures(camera, truth, joints, rng, SIZE)
    stages = {"initial": 0, "grasp": 4}
    return truth, CameraFrames(
        pictures=pictures,
        joints=joints,
        stages=stages,
        name="nine frames",
        origin=drawn.ORIGIN,
    )


@functools.cache
def fitted(camera: str) -> CameraFit:
    return calibrate_camera(made(camera)[1], twin(), camera)


@pytest.mark.parametrize(
    "camera", ["front", pytest.param("left_wrist", marks=pytest.mark.slow)]
)
def test_the_camera_is_found_from_2_7_degrees_and_25_mm_off_and_held_out_frames_are_closer(
    camera: str,
):
    truth, fit = made(camera)[0], fitted(camera)
    angle_deg, distance_mm = drawn.pose_error(fit.offset, truth)
    assert fit.converged, fit.problems
    assert (
        drawn.pose_error(fit.start, truth) == pytest.approx((2.7, 25.0))
        and angle_deg < 0.3
    )
    assert distance_mm < 4.0
    assert (np.abs(fit.offset - truth) < fit.half_width).all()
    assert fit.num_held_out == 4  # the fourth and the eighth frame, and the two stages
    assert fit.num_frames + fit.num_held_out == 9
    assert fit.after_px < 0.4 * fit.before_px


@pytest.mark.slow
def test_the_new_camera_is_saved_and_loaded_with_the_twin(tmp_path: Path):
    fit = fitted("front")
    mended = fit.twin(twin())
    save_twin(mended, tmp_path / "twin.yaml")
    loaded = load_twin(tmp_path / "twin.yaml")
    front = next(camera for camera in loaded.cameras if camera.name == "front")
    assert front.offset == as_offset(fit.offset)
    again = calibrate_camera(
        made("front")[1], loaded, "front"
    )  # from where it is now, it has no reason to move
    turned_deg, moved_mm = drawn.pose_error(again.offset, again.start)
    assert turned_deg < 0.1 and moved_mm < 1.5
    assert again.before_px == pytest.approx(fit.after_px, abs=0.05)


@pytest.mark.slow
def test_a_camera_pose_effect_is_where_it_starts_and_goes_into_the_offset():
    truth, frames = made("front")
    keys = (
        "turn_x_rad",
        "turn_y_rad",
        "turn_z_rad",
        "shift_x_m",
        "shift_y_m",
        "shift_z_m",
    )
    config = twin()
    config.effects = [
        make_effect(
            "camera_pose",
            **dict(zip(keys, truth.tolist(), strict=True)),
            cameras=["front"],
        )
    ]
    fit = calibrate_camera(frames, config, "front")
    np.testing.assert_allclose(fit.start, truth, atol=1e-9)
    assert drawn.pose_error(fit.offset, truth)[1] < 4.0
    assert fit.twin(config).effects == []
    config.effects = [
        make_effect("camera_pose", turn_x_rad=0.01, cameras=["front", "left_wrist"])
    ]
    [other] = fit.twin(config).effects
    assert other.acts_on() == ["left_wrist"] and other.turn_x_rad == 0.01  # pyright: ignore[reportAttributeAccessIssue]


def test_an_effect_on_several_cameras_moves_each_as_an_own_entry_would():
    config, views = twin(), []
    for cameras in (["front"], ["left_wrist", "front"]):
        config.effects = [
            make_effect(
                "camera_pose", turn_x_rad=0.01, shift_z_m=0.004, cameras=cameras
            )
        ]
        with TwinView(config, "front", SIZE) as view:
            views.append(view.start)
    np.testing.assert_allclose(views[1], [0.01, 0, 0, 0, 0, 0.004], atol=1e-9)
    np.testing.assert_array_equal(*views)


def test_overlays_show_the_stages_and_the_outlines_where_the_arms_are():
    shown = fitted("front").overlays
    assert list(shown) == ["initial", "grasp"]
    for picture in shown.values():
        assert picture.shape == (22 + 240, 4 * 320, 3)
        red, green, _ = picture[22:].astype(int).transpose(2, 0, 1)
        before, after = (
            (red > green + 80) & (red > 200),
            (green > red + 80) & (green > 180),
        )
        assert before[:, 640:960].sum() > 200
        assert not before[:, 960:].any()
        assert after[:, 960:].sum() > 200


def test_slopes_are_finite_differences():
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.3, -0.3, -1.2], [0.3, 0.3, -0.5], (20, 3))
    angle = rng.uniform(0, np.pi, 20)
    matches = Matches(
        np.ones(20, bool),
        rng.uniform(0, 60, (20, 2)),
        np.stack([np.cos(angle), np.sin(angle)], 1),
    )
    with TwinView(twin(), "front", SIZE) as view:
        start = drawn.random_offset(rng)
        world = np.linalg.inv(view.pose(start)[1].T)  # mount from camera
        mount = points @ world.T + view.pose(start)[0]
        analytic = slopes(seen_from(view, start, mount), matches, SMALL)
        for k, step in enumerate(1e-6 * np.eye(6)):
            ends = [
                distances(
                    seen_from(view, moved(start, s * step), mount), matches, SMALL
                )
                for s in (1, -1)
            ]
            np.testing.assert_allclose(
                analytic[:, k], (ends[0] - ends[1]) / 2e-6, rtol=1e-4, atol=1e-3
            )


def test_an_encoder_bias_of_the_twin_is_taken_off_before_its_arms_are_drawn():
    config, joints = twin(), drawn.random_poses(np.random.default_rng(0), 1)[0]
    config.effects = [
        make_effect("encoder_bias", bias_rad=0.05, arm="left", joints=["joint2"])
    ]
    with (
        TwinView(config, "front", SIZE) as biased,
        TwinView(twin(), "front", SIZE) as plain,
    ):
        biased.place(joints)
        shifted = joints.copy()
        shifted[1] -= 0.05
        plain.place(shifted)
        np.testing.assert_allclose(biased.data.xpos, plain.data.xpos, atol=1e-9)


def test_too_few_frames_and_frames_that_do_not_fit_are_named():
    frames = made("front")[1]
    with pytest.raises(TaccorlError, match="3 frames; a calibration needs at least 4"):
        calibrate_camera(
            CameraFrames(pictures=frames.pictures[:3], joints=frames.joints[:3]),
            twin(),
            "front",
        )
    with pytest.raises(TaccorlError, match=r"joints are \(8, 14\) for 9 pictures"):
        CameraFrames(pictures=frames.pictures, joints=frames.joints[:8])
    with pytest.raises(TaccorlError, match="pictures are float64"):
        CameraFrames(pictures=frames.pictures / 255, joints=frames.joints)
    with pytest.raises(TaccorlError, match="name frames"):
        dataclasses.replace(frames, stages={"grasp": 9})
    with pytest.raises(TaccorlError, match=r"camera 'frond' is not in the twin.*front"):
        calibrate_camera(frames, twin(), "frond")


def test_pictures_of_another_stream_are_told_by_light_where_bars_should_be():
    frames = made("front")[1]
    wide = np.stack([cv2.resize(picture, (426, 240)) for picture in frames.pictures])
    with pytest.raises(TaccorlError, match=r"240×426.*stream.*black bars"):
        calibrate_camera(
            CameraFrames(pictures=wide, joints=frames.joints), twin(), "front"
        )


def test_arms_out_of_view_are_an_error():
    config, frames = twin(), made("front")[1]
    away = [
        dataclasses.replace(c, look_at_m=(2.0, 0.0, 0.5)) if c.name == "front" else c
        for c in config.cameras
    ]
    config.cameras = away
    with pytest.raises(TaccorlError, match=r"arms.*nine frames"):
        calibrate_camera(frames, config, "front")


@pytest.mark.slow
def test_pictures_of_other_poses_do_not_converge_and_the_twin_keeps_its_camera():
    frames = made("front")[1]
    mixed = dataclasses.replace(frames, joints=np.roll(frames.joints, 3, axis=0))
    fit = calibrate_camera(mixed, twin(), "front")
    assert not fit.converged
    assert "not converged: in held-out frames" in fit.problems[0]
    assert fit.camera == twin().cameras[0]
    with pytest.raises(TaccorlError, match=r"not converged.*The twin keeps its camera"):
        fit.twin(twin())


@pytest.mark.slow
def test_pictures_without_an_edge_identify_nothing():
    frames = made("front")[1]
    fit = calibrate_camera(
        dataclasses.replace(frames, pictures=np.full_like(frames.pictures, 90)),
        twin(),
        "front",
    )
    assert any("not identifiable" in problem for problem in fit.problems)
    assert np.isinf(fit.half_width).all()
    np.testing.assert_array_equal(fit.offset, fit.start)


@pytest.mark.slow
def test_frames_of_one_pose_are_called_so_with_the_direction_that_is_known_worst():
    frames = made("front")[1]
    same = dataclasses.replace(
        frames,
        pictures=np.repeat(frames.pictures[:1], 6, 0),
        joints=np.repeat(frames.joints[:1], 6, 0),
        stages={},
    )
    fit = calibrate_camera(same, twin(), "front")
    assert fit.problems[-1].startswith("not identifiable: all 6 frames show one pose")
    assert "shift right (±" in fit.problems[-1]
    assert (
        "turn about up (±" in fit.problems[-1]
    )  # a turn and a shift look alike from afar
    assert fit.half_width[3] > fitted("front").half_width[3]
