"""Intrinsics against published units, the letterbox against ingest's own, poses against arithmetic."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from taccorl.data.pictures import letterbox
from taccorl.errors import TaccorlError
from taccorl.sim.cameras import (
    CameraConfig,
    CameraOffset,
    Intrinsics,
    add_cameras,
    bench_cameras,
    letterbox_window,
    look_at_quat,
    project,
    sensor_intrinsics,
)


def bench_bodies() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    for arm, side in (("left", 0.3), ("right", -0.3)):
        body = spec.worldbody.add_body(
            name=f"{arm}_link6", pos=[0.3, side, 0.25], quat=[0.6, 0.0, 0.8, 0.0]
        )
        body.add_joint(name=f"{arm}_joint", axis=[0, 0, 1])
        body.add_geom(size=[0.01, 0, 0])
    return spec


def pose_of(model: mujoco.MjModel, name: str) -> tuple[np.ndarray, np.ndarray]:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.camera(name).xpos.copy(), data.camera(name).xmat.reshape(3, 3).copy()


def test_a_d415_has_the_datasheets_angles_and_the_sdks_at_4_to_3():
    full = sensor_intrinsics("d415", 1080, 1920)
    assert full.fy_px == pytest.approx(540 / math.tan(math.radians(42.5 / 2)))  # 1388.6
    assert math.degrees(full.vertical_fov_rad) == pytest.approx(42.5)
    assert math.degrees(2 * math.atan(960 / full.fx_px)) == pytest.approx(69.4, abs=0.1)
    vga = sensor_intrinsics(
        "d415", 480, 640
    )  # 1440 × 1080 of the sensor, divided by 2.25
    assert vga.fx_px == pytest.approx(full.fx_px / 2.25)
    assert vga.fx_px == pytest.approx(
        616.8, rel=0.005
    )  # camera_info of one unit of this imager
    assert math.degrees(2 * math.atan(320 / vga.fx_px)) == pytest.approx(
        54.73, abs=0.2
    )  # librealsense issue 2141
    assert math.degrees(vga.vertical_fov_rad) == pytest.approx(42.41, abs=0.2)


@pytest.mark.parametrize(
    ("rows", "columns", "published"),
    [(480, 640, (393.03, 390.67, 388.46)), (480, 848, (425.01, 425.19, 426.56))],
)
def test_a_d405_has_the_focal_length_of_published_units(
    rows: int, columns: int, published: tuple[float, ...]
):
    nominal = sensor_intrinsics("d405", rows, columns)
    assert (
        nominal.fx_px == nominal.fy_px == pytest.approx(np.mean(published), rel=0.015)
    )


@pytest.mark.parametrize(
    "recorded", [(480, 640), (720, 1280), (480, 848), (101, 57), (224, 224), (30, 20)]
)
@pytest.mark.parametrize(
    "frame", [(224, 224), (96, 96), (84, 129), (50, 50), (224, 100)]
)
def test_the_window_is_where_ingest_puts_the_picture(
    recorded: tuple[int, int], frame: tuple[int, int]
):
    stored = letterbox(np.full((*recorded, 3), 255, np.uint8), *frame)
    rows, columns = (
        np.flatnonzero(stored.any((1, 2))),
        np.flatnonzero(stored.any((0, 2))),
    )
    window = letterbox_window(recorded, frame)
    assert (window.top, window.rows) == (rows[0], len(rows))
    assert (window.left, window.columns) == (columns[0], len(columns))


def test_projection_is_the_pinhole_formula_and_knows_no_points_behind():
    camera = Intrinsics(
        rows=100, columns=200, fx_px=50.0, fy_px=60.0, cx_px=99.5, cy_px=49.5
    )
    # A camera at (0, 0, 1) looking along −z: x right, y up. 0.2 right, 0.1 up, 2 ahead.
    points = np.array([[0.2, 0.1, -1.0], [0.0, 0.0, 5.0]])
    pixels = project(points, np.array([0.0, 0.0, 1.0]), np.eye(3), camera)
    assert pixels[0] == pytest.approx((99.5 + 50 * 0.2 / 2, 49.5 - 60 * 0.1 / 2))
    assert np.isnan(pixels[1]).all()


def test_the_target_is_in_the_middle_and_up_is_up():
    for config in bench_cameras():
        spec = bench_bodies()
        add_cameras(spec, [config])
        model = spec.compile()
        position, world_from_camera = pose_of(model, config.name)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        body = data.body(config.body)
        camera = config.recorded_intrinsics()
        ahead = body.xpos + body.xmat.reshape(3, 3) @ np.array(config.look_at_m)
        higher = ahead + 0.02 * body.xmat.reshape(3, 3) @ np.array(config.up)
        middle, above = project(
            np.stack([ahead, higher]), position, world_from_camera, camera
        )
        assert middle == pytest.approx((319.5, 239.5), abs=1e-9)
        assert above[0] == pytest.approx(319.5, abs=1e-6) and above[1] < 239.5 - 5


def test_an_offset_moves_the_picture_as_the_pinhole_says():
    spec = bench_bodies()
    front = bench_cameras()[0]
    angle, shift_m = math.radians(1.5), 0.01
    offsets = {
        "left": CameraOffset(
            rotation_rad=(0, angle, 0)
        ),  # about up: the camera turns left, things move right
        "down": CameraOffset(
            rotation_rad=(-angle, 0, 0)
        ),  # about right, backwards: looks down, things move up
        "roll": CameraOffset(rotation_rad=(0, 0, angle)),
        "right": CameraOffset(translation_m=(shift_m, 0, 0)),
        "high": CameraOffset(translation_m=(0, shift_m, 0)),
        "back": CameraOffset(translation_m=(0, 0, shift_m)),
    }
    add_cameras(
        spec,
        [
            dataclasses.replace(front, name=name, offset=offset)
            for name, offset in offsets.items()
        ],
    )
    model = spec.compile()
    camera, target = front.recorded_intrinsics(), np.array(front.look_at_m)
    middle = {
        name: project(target, *pose_of(model, name), camera) - 239.5 - [80, 0]
        for name in offsets
    }
    depth = 0.75
    turned, moved = camera.fx_px * math.tan(angle), camera.fx_px * shift_m / depth
    assert middle["left"] == pytest.approx((turned, 0), abs=1e-6)
    assert middle["down"] == pytest.approx((0, -turned), abs=1e-6)
    assert middle["roll"] == pytest.approx((0, 0), abs=1e-6)
    assert middle["right"] == pytest.approx((-moved, 0), abs=1e-6)
    assert middle["high"] == pytest.approx((0, moved), abs=1e-6)
    assert middle["back"] == pytest.approx((0, 0), abs=1e-6)
    assert np.linalg.norm(pose_of(model, "back")[0] - target) == pytest.approx(
        depth + shift_m
    )


def test_a_quaternion_may_stand_in_for_a_target():
    quat = look_at_quat(np.array([0.0, 0, 1]), np.zeros(3), np.array([0.0, 1, 0]))
    assert quat == pytest.approx(
        (1, 0, 0, 0)
    )  # straight down with y up is MuJoCo's own default
    spec = bench_bodies()
    add_cameras(
        spec, [CameraConfig(name="top", position_m=(0, 0, 1), quat_wxyz=(1, 0, 0, 0))]
    )
    position, matrix = pose_of(spec.compile(), "top")
    assert position == pytest.approx((0, 0, 1)) and matrix == pytest.approx(np.eye(3))


def test_the_compiled_model_has_the_recordings_size_and_angle():
    spec = bench_bodies()
    add_cameras(spec, bench_cameras())
    model = spec.compile()
    assert [model.camera(i).name for i in range(model.ncam)] == [
        "front",
        "left_wrist",
        "right_wrist",
    ]
    assert model.cam_resolution.tolist() == [[640, 480]] * 3
    assert model.cam_fovy == pytest.approx((42.5, 63.26, 63.26), abs=0.01)


def test_mistakes_are_answered_with_a_way_out():
    with pytest.raises(TaccorlError, match=r"'d435'.*did you mean 'd415'"):
        sensor_intrinsics("d435", 480, 640)
    spec = bench_bodies()
    with pytest.raises(
        TaccorlError,
        match=r"left_wrist: no body 'left_link7'.*did you mean 'left_link6'",
    ):
        add_cameras(spec, [dataclasses.replace(bench_cameras()[1], body="left_link7")])
    add_cameras(spec, bench_cameras())
    with pytest.raises(TaccorlError, match=r"front:.*model.*name"):
        add_cameras(spec, bench_cameras())
    with pytest.raises(TaccorlError, match="either look_at_m or quat_wxyz"):
        CameraConfig(name="x")
    with pytest.raises(TaccorlError, match="another `up`"):
        CameraConfig(name="x", position_m=(0, 0, 1), look_at_m=(0, 0, 0)).pose()
    with pytest.raises(TaccorlError, match=r"480×640 pictures, not .*720, 1280"):
        CameraConfig(
            name="x",
            look_at_m=(1, 0, 0),
            recording_size=(720, 1280),
            intrinsics=sensor_intrinsics("d415", 480, 640),
        )
