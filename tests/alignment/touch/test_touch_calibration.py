"""Tactile calibration on presses whose k_n, k_d and noise are known."""

import dataclasses
import math

import numpy as np
import pytest
from made_press import K_D, K_N, ball_at, plain, press

from taccorl.alignment.touch.calibration import (
    TouchCalibration,
    calibrate_touch,
    noise_level,
)
from taccorl.alignment.touch.match import touch_match
from taccorl.alignment.touch.motion import TouchMotion, touch_motion
from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.twin import TwinConfig

CONFIG = TwinConfig()
BALL = ball_at(0.001, 0.003)


def motions(*seeds: int, **settings) -> list[TouchMotion]:
    return [touch_motion(press(seed, **settings), CONFIG, BALL) for seed in seeds]


@pytest.fixture(scope="module")
def presses() -> list[TouchMotion]:
    return motions(0, 1, 2)


@pytest.fixture(scope="module")
def found(presses: list[TouchMotion]) -> TouchCalibration:
    return calibrate_touch(presses[:2], presses[2:], CONFIG)


def test_the_noise_is_found_where_nothing_touches(presses: list[TouchMotion]) -> None:
    noise = noise_level(presses)
    # 1.3 counts and the converter's 1/√12 together
    assert noise.pooled_std_count == pytest.approx(
        math.hypot(1.3, 1 / math.sqrt(12)), rel=0.01
    )
    # 0.999 of a normal distribution: 3.09 σ = 4.1, in whole counts
    assert noise.threshold_count in (4.0, 5.0)


def test_stiffness_and_damping_are_recovered_within_their_intervals(
    found: TouchCalibration,
) -> None:
    assert found.trouble == "" and found.stiffness.value == pytest.approx(
        K_N, rel=0.003
    )
    assert found.damping.value == pytest.approx(K_D, rel=0.03)
    # A smoothed opening cuts a press's corners by some µm, which noise alone knows nothing of: 4 standard errors
    for number, truth in ((found.stiffness, K_N), (found.damping, K_D)):
        half = (number.high - number.low) / 2
        assert 0 < half < 0.03 * truth
        assert abs(number.value - truth) < 2 * half


def test_the_validation_recording_is_matched_in_all_that_the_paper_aligns(
    found: TouchCalibration,
) -> None:
    before, after = found.before, found.after
    assert found.fitted_to == ("press_0", "press_1")
    assert found.validation == ("press_2",)
    assert after.rms_count < 0.6 * before.rms_count
    assert after.rms_count == pytest.approx(1.33, rel=0.05), "what is left is noise"
    assert after.mask_iou >= before.mask_iou
    assert after.mask_iou > 0.97
    assert after.active_taxels <= before.active_taxels
    assert after.centroid_m < 1e-3
    assert after.histogram_count < 0.2 * before.histogram_count
    # Of noise alone: √2 · 1.33
    assert after.temporal_count == pytest.approx(1.88, rel=0.05)
    assert after.temporal_count <= before.temporal_count


def test_the_twins_own_effects_act_in_the_fit(presses: list[TouchMotion]) -> None:
    """With pads that the twin takes for 0.2 mm too thick the same readings need a smaller k_n."""
    thick = TwinConfig(effects=[make_effect("depth_offset", offset_m=2e-4)])
    assert (
        calibrate_touch(presses[:1], presses[1:2], thick).stiffness.value < 0.85 * K_N
    )


def test_a_perfect_twin_matches_perfectly_and_one_off_by_a_taxel_does_not(
    presses: list[TouchMotion],
) -> None:
    """A patch of counts moved by one column."""
    motion = presses[0]
    clean = np.zeros(motion.measured.shape, np.int16)
    clean[motion.near(0.0).any(axis=(2, 3)), 10:14, 3:6] = 50
    made = dataclasses.replace(motion, measured=clean)
    pitch_m = motion.layout.pitch_m
    perfect = touch_match([made.measured], [clean], 4.0, pitch_m)
    assert (perfect.rms_count, perfect.mask_iou) == (0.0, 1.0)
    moved = touch_match([made.measured], [np.roll(clean, 1, axis=3)], 4.0, pitch_m)
    assert moved.mask_iou == pytest.approx(8 / 16)  # of 3 + 1 columns two are shared
    assert moved.centroid_m == pytest.approx(2e-3)  # one column
    assert (moved.active_taxels, moved.histogram_count) == (0.0, 0.0)


def test_what_cannot_be_calibrated_is_said(presses: list[TouchMotion]) -> None:
    with pytest.raises(TaccorlError, match=r"1 recordings.*fit.*0.*validation"):
        calibrate_touch(presses[:1], [], CONFIG)
    late = motions(
        0,
        law=lambda depth, rate, time_s: np.roll(plain(depth, rate, time_s), 3, axis=0),
    )
    found = calibrate_touch(late, late, CONFIG)
    assert "k_d is no more than its error" in found.trouble
    assert found.damping.low == 0.0
    assert found.damping.high > 0.1
    in_time = ("measured", "time_s", "object_from_pad", "velocity", "clearance_m")
    touched = dataclasses.replace(
        presses[0], **{name: getattr(presses[0], name)[210:240] for name in in_time}
    )
    before = {name: getattr(presses[1], name)[:150] for name in in_time}
    before["measured"] = np.zeros_like(before["measured"])
    silent = dataclasses.replace(presses[1], **before)
    with pytest.raises(TaccorlError, match=r"no taxel ever.*λ_noise.*press_1"):
        calibrate_touch(presses[:1], [silent], CONFIG)
    with pytest.raises(
        TaccorlError, match=r"pad left_a has 0 frames without contact in press_0"
    ):
        noise_level([touched])
