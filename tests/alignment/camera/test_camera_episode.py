"""Calibration from an episode, as a dataset or a recording gives it; here of a surrogate whose camera is off."""

import dataclasses
import functools

import numpy as np
import pytest

from pipelines.benchmarks.cameras import moving_joints, pose_error
from taccorl.alignment.camera.calibration import calibrate_camera
from taccorl.alignment.camera.episode import camera_frames, stage_rows
from taccorl.data.episode import Episode
from taccorl.data.origin import Origin
from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig

OFFSET = {
    "turn_x_rad": 0.03,
    "turn_y_rad": -0.02,
    "turn_z_rad": 0.01,
    "shift_x_m": -0.01,
    "shift_z_m": 0.015,
}
TRUTH = np.array([0.03, -0.02, 0.01, -0.01, 0.0, 0.015])


@functools.cache
def episode() -> Episode:
    """Four seconds of both arms going to and fro, seen by a front camera that is not where the twin has it."""
    config = TwinConfig(
        effects=[make_effect("camera_pose", **OFFSET, cameras=["front"])]
    )
    sim = Simulation(tasks.get("assembly_1")(), config)
    sim.reset([0])
    spec = row_spec(sim, pictures=True)
    recorder = EpisodeRecorder(sim, spec)
    for row in moving_joints(np.random.default_rng(0), np.arange(120) / 30):
        recorder.step(row)
    return dataclasses.replace(
        recorder.episode("four seconds", {}),
        origin=Origin("surrogate", "a twin whose camera is off"),
    )


@pytest.mark.slow
def test_a_camera_is_calibrated_from_an_episode():
    frames = camera_frames(episode(), "front", 10)
    assert frames.pictures.shape[1:] == (224, 224, 3) and frames.joints.shape == (
        len(frames.pictures),
        14,
    )
    fit = calibrate_camera(frames, TwinConfig(), "front")
    angle_deg, distance_mm = pose_error(fit.offset, TRUTH)
    assert fit.converged, fit.problems
    assert angle_deg < 0.3
    assert distance_mm < 4
    assert set(fit.overlays) == set(frames.stages)
    assert frames.origin == Origin("surrogate", "a twin whose camera is off")


def test_frames_are_slow_rows_and_differ():
    frames = camera_frames(episode(), "front", 8)
    state = episode().arrays["observation.state"]
    speed = np.abs(np.diff(state, axis=0)).sum(1)
    chosen = [int(np.argmin(np.abs(state - joints).sum(1))) for joints in frames.joints]
    free = [row for k, row in enumerate(chosen) if k not in frames.stages.values()]
    assert np.mean(speed[np.minimum(free, len(speed) - 1)]) < np.mean(speed)
    apart = [
        np.abs(a - b).max()
        for k, a in enumerate(frames.joints)
        for b in frames.joints[:k]
    ]
    assert min(apart) > 0.005


@pytest.mark.slow
def test_joints_are_taken_as_much_earlier_as_the_pictures_are_late():
    now, then = (
        camera_frames(episode(), "front", 6),
        camera_frames(episode(), "front", 6, latency_s=1 / 30),
    )
    state = episode().arrays["observation.state"]
    for joints, earlier in zip(now.joints[1:], then.joints[1:], strict=True):
        row = int(np.argmin(np.abs(state - joints).sum(1)))
        np.testing.assert_allclose(earlier, state[row - 1], atol=1e-6)
    np.testing.assert_array_equal(now.pictures, then.pictures)


def test_stages_are_the_start_the_closing_of_a_hand_and_the_hands_together():
    joints = np.tile(np.r_[0.0, 1.7, -0.9, 0.0, 0.9, 0.0, 0.07], (50, 2)).reshape(
        50, 14
    )
    joints[20:, 6] = 0.01  # the left hand closes
    turn = np.interp(np.arange(50), [0, 30, 35, 49], [0.0, 1.0, 1.0, 0.2])
    joints[:, 0], joints[:, 7] = -turn, turn  # towards each other, and apart again
    assert stage_rows(joints) == {"initial": 0, "grasp": 20, "insertion": 35}


def test_a_camera_that_the_episode_lacks_is_named():
    with pytest.raises(TaccorlError, match=r"four seconds has no camera 'top'.*front"):
        camera_frames(episode(), "top")
