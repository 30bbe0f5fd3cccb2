"""Camera effects in pictures: the pose against a mount that is off, latency against earlier pictures, exposure by hand."""

import dataclasses
import functools

import numpy as np
import pytest
from press_bench import PressBench, start, typical_effect

from taccorl.errors import TaccorlError
from taccorl.sim.cameras import CameraOffset
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.cameras import blurred, toned
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

SIZE = (120, 160)
NAMES = [name for name in effects if effects.get(name).slot == "camera"]


def swing(sim: Simulation, first: int = 0, last: int = 6) -> np.ndarray:
    """Control steps of the right arm turning to one side, 1.5 rad/s: pictures (T, N, cameras, rows, columns, 3)."""
    seen = []
    for _ in range(first, last):
        targets = sim.targets.copy()
        targets[:, 7:9] += 0.05
        sim.step(targets)
        seen.append(np.stack(list(sim.render(size=SIZE).values()), axis=1))
    return np.stack(seen)


@functools.cache
def nominal() -> np.ndarray:
    return swing(start())


def apart(seen: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(seen.astype(int) - other.astype(int)).mean())


@pytest.mark.parametrize("name", NAMES)
def test_pictures_of_an_absent_effect_are_bit_identical(name: str):
    np.testing.assert_array_equal(swing(start(make_effect(name))), nominal())


@pytest.mark.parametrize("name", NAMES)
def test_pictures_fade_out_towards_the_absent_value(name: str):
    cls = effects.get(name)
    nearly = {
        p.name: p.absent + 0.01 * (p.typical - p.absent)
        for p in cls.parameters()
        if p.absent is not None
    }
    there = apart(swing(start(typical_effect(name))), nominal())
    assert (
        there > 0.2
        and apart(swing(start(make_effect(name, **nearly))), nominal()) <= 0.05 * there
    )


@pytest.mark.parametrize("name", NAMES)
def test_pictures_are_the_same_alone_in_a_batch_from_a_snapshot_and_from_stored_states(
    name: str,
):
    effect = typical_effect(name)
    alone = swing(start(effect))
    batch = start(effect, num_sims=2, num_threads=2)
    first = swing(batch, last=3)
    snapshot, rows = batch.snapshot(), batch.state_rows()
    np.testing.assert_array_equal(first[:, 0], alone[:3, 0])
    cameras = [camera.name for camera in batch.config.cameras]
    for k, stored in enumerate(batch.render_states(rows, cameras, SIZE)):
        for c, camera in enumerate(cameras):
            np.testing.assert_array_equal(stored[camera], first[-1, k, c])
    rest = swing(batch, 3)
    np.testing.assert_array_equal(rest[:, 0], alone[3:, 0])
    other = start(effect, num_sims=2)
    swing(other, last=2)
    other.restore(snapshot)
    np.testing.assert_array_equal(swing(other, 3), rest)
    again = start(effect, num_sims=2)
    again.restore_rows(rows, snapshot.seeds)
    np.testing.assert_array_equal(swing(again, 3), rest)


@pytest.mark.parametrize("name", NAMES)
def test_physics_and_the_other_cameras_do_not_change(name: str):
    effect = dataclasses.replace(typical_effect(name), cameras=["right_wrist"])
    sim, plain = start(effect), start()
    seen = swing(sim)
    swing(plain)
    np.testing.assert_array_equal(sim.batch.state, plain.batch.state)
    np.testing.assert_array_equal(seen[:, :, :2], nominal()[:, :, :2])
    assert apart(seen[:, :, 2], nominal()[:, :, 2]) > 0.1


def test_an_offset_mount_and_a_camera_pose_are_the_same_camera():
    turn, shift = (0.02, -0.03, 0.01), (0.01, -0.004, 0.006)
    keys = [
        f"{kind}_{axis}_{unit}"
        for kind, unit in (("turn", "rad"), ("shift", "m"))
        for axis in "xyz"
    ]
    by_effect = start(
        make_effect(
            "camera_pose",
            **dict(zip(keys, (*turn, *shift), strict=True)),
            cameras=["front"],
        )
    )
    config = TwinConfig()
    offset = CameraOffset(rotation_rad=turn, translation_m=shift)
    config.cameras = [
        dataclasses.replace(c, offset=offset) if c.name == "front" else c
        for c in config.cameras
    ]
    by_mount = Simulation(PressBench(), config)
    camera, other = by_effect.model.camera("front"), by_mount.model.camera("front")
    np.testing.assert_allclose(camera.pos, other.pos, atol=1e-12)
    np.testing.assert_allclose(camera.quat, other.quat, atol=1e-12)


def test_two_frames_of_latency_show_the_picture_of_two_frames_ago():
    late = swing(start(make_effect("camera_latency", delay_s=2 / 30)))
    moved = np.abs(late[4].astype(int) - nominal()[4]) > 20
    assert moved.mean() > 0.005  # the arm is seen elsewhere
    wrong = np.abs(late[2:].astype(int) - nominal()[:-2]) > 20
    assert (
        wrong.mean() < 2e-4
    )  # but for pixels on an outline: kept positions go in straight lines
    resting = np.stack(list(start().render(size=SIZE).values()), axis=1)
    assert apart(late[1], resting) < 0.01  # the second frame shows the start


def test_latency_between_two_frames_lies_between_them():
    halfway = swing(start(make_effect("camera_latency", delay_s=0.5 / 30)))[3, 0, 0]
    before, after = nominal()[2, 0, 0], nominal()[3, 0, 0]
    to_before, to_after = apart(halfway, before), apart(halfway, after)
    assert 0.3 < to_before / (to_before + to_after) < 0.7


def test_a_reset_forgets_the_past():
    sim = start(make_effect("camera_latency", delay_s=0.1))
    swing(sim)
    late = sim.render(size=SIZE)["front"]
    sim.place_arms(sim.proprioception()[0], sim.targets[0])
    assert apart(sim.render(size=SIZE)["front"], late) > 0.1
    plain = start()
    swing(plain)
    plain.place_arms(plain.proprioception()[0], plain.targets[0])
    np.testing.assert_array_equal(
        sim.render(size=SIZE)["front"], plain.render(size=SIZE)["front"]
    )


def test_tone_is_the_equation():
    picture = np.array([[[0.0, 51.0, 102.0], [204.0, 255.0, 127.5]]], np.float32)
    # (2 · 0.2)² = 0.16, (2 · 0.4)² = 0.64, and above 0.5 all is white
    expected = [[[0.0, 0.16 * 255, 0.64 * 255], [255.0, 255.0, 255.0]]]
    np.testing.assert_allclose(toned(picture, 2.0, 2.0), expected, rtol=1e-5)


@pytest.mark.parametrize("sigma_px", [0.05, 0.4, 1.0, 3.0])
def test_a_blurred_step_has_the_width_asked_for_and_keeps_its_light(sigma_px: float):
    picture = np.zeros((9, 81, 3), np.float32)
    picture[:, 40:] = 200.0
    step = np.diff(blurred(picture, sigma_px)[4, :, 0])
    at = np.arange(len(step)) - 39
    assert step.sum() == pytest.approx(200.0, rel=1e-5)
    variance = (step * at**2).sum() / step.sum()
    if sigma_px >= 1:  # a pixel's own width adds 1/12
        assert variance == pytest.approx(sigma_px**2 + 1 / 12, rel=0.02)
    if sigma_px == 0.05:
        assert variance < 1e-6


def test_blur_is_in_pixels_of_the_stream_and_stops_at_the_bars():
    effect = make_effect("camera_exposure", gain=1.0, gamma=1.0, blur_px=4.0)
    sim = start(effect)
    square = sim.render(["front"], size=(224, 224))["front"][
        0
    ]  # 168 rows of picture, 28 of bars above and below
    assert not square[:28].any() and not square[-28:].any()
    assert square[28].mean() > 60  # not darkened by the bar
    plain = start().render(["front"], size=(224, 224))["front"][0]
    same = blurred(plain[28:-28].astype(np.float32), 4.0 * 224 / 640)
    np.testing.assert_allclose(square[28:-28], same, atol=0.51)


def test_a_camera_that_is_not_there_is_named():
    with pytest.raises(
        TaccorlError, match=r"camera_pose: the twin has no camera 'frnt'.*front"
    ):
        start(make_effect("camera_pose", turn_x_rad=0.01, cameras=["frnt"]))
    with pytest.raises(TaccorlError, match=r"cameras are .*each once"):
        make_effect("camera_pose", cameras=[])
