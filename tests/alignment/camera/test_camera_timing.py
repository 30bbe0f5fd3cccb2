"""Camera latency from surrogate pictures of moving arms."""

import dataclasses

import numpy as np
import pytest

from pipelines.benchmarks.cameras import (
    moving_joints,
    random_offset,
    random_poses,
    surrogate_pictures,
)
from taccorl.alignment.camera.timing import camera_latency
from taccorl.errors import TaccorlError
from taccorl.sim.twin import TwinConfig


@pytest.mark.slow
@pytest.mark.parametrize(
    "camera", ["front", pytest.param("left_wrist", marks=pytest.mark.slow)]
)
def test_latency_is_found_within_its_interval_and_10_ms(camera: str):
    rng = np.random.default_rng(4)
    time_s, late_s, motion = np.arange(180) / 30, 0.07, 11
    joints, shown = (
        moving_joints(np.random.default_rng(motion), time_s - late)
        for late in (0.0, late_s)
    )
    pictures = surrogate_pictures(
        camera, random_offset(rng, 0.005, 0.004), shown, rng, (120, 160)
    )
    config = TwinConfig()
    config.cameras = [
        dataclasses.replace(c, recording_size=(120, 160)) for c in config.cameras
    ]
    fit = camera_latency(iter(pictures), time_s, joints, config, camera)
    assert not fit.problems and fit.latency_s == pytest.approx(late_s, abs=0.010)
    assert fit.interval_s[0] - 0.003 <= late_s <= fit.interval_s[1] + 0.003
    other = moving_joints(np.random.default_rng(motion + 1), time_s)
    assert (
        "otherwise than the arms move"
        in camera_latency(iter(pictures), time_s, other, config, camera).problems[0]
    )
    still = np.repeat(joints[:1], len(joints), axis=0)
    assert (
        "hardly move"
        in camera_latency(iter(pictures), time_s, still, config, camera).problems[0]
    )


def test_latency_wants_even_times_and_three_seconds():
    joints, time_s = random_poses(np.random.default_rng(0), 120), np.arange(120) / 30
    with pytest.raises(TaccorlError, match=r"60 pictures.*less than 3 s"):
        camera_latency(iter(()), time_s[:60], joints[:60], TwinConfig(), "front")
    time_s[50:] += 0.1
    with pytest.raises(TaccorlError, match=r"not evenly spaced by 33\.3 ms"):
        camera_latency(iter(()), time_s, joints, TwinConfig(), "front")
