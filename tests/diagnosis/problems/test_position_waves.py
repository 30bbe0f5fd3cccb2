"""Position-periodic torques in recordings of many turns."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from made_rows import of_joint

from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.diagnosis.problems.position_waves import position_waves
from taccorl.sim.effects.load import Cogging
from taccorl.sim.effects.scaled import Scale, scaled

INERTIA, WAVE_NM, PERIODS, PHASE_RAD = 0.004, 0.03, 42.0, 0.7
NOISE_RAD = 7.7e-4 / math.sqrt(12)  # of an encoder of 8192 steps a turn


def motion(amplitude_rad: float, hz: float, seed: int) -> JointMotion:
    """14 s of q = A sin(2π f t) at 200 Hz with the effort that holds it: J q̈ − 0.03 N·m sin(42 q + 0.7) + 0.01 N·m sign q̇."""
    t = np.arange(2800) / 200.0
    w = math.tau * hz
    q = amplitude_rad * np.sin(w * t)
    effort = (
        -INERTIA * w * w * q
        - WAVE_NM * np.sin(PERIODS * q + PHASE_RAD)
        + 0.01 * np.sign(np.cos(w * t))
    )
    rng = np.random.default_rng(seed)
    measured = q + NOISE_RAD * rng.standard_normal(len(t))
    return of_joint(
        "wheel",
        200.0,
        np.zeros_like(t),
        measured,
        effort + 0.002 * rng.standard_normal(len(t)),
    )


def test_the_strongest_wave_of_a_wheel_is_the_one_that_its_effort_works_against() -> (
    None
):
    found = position_waves(
        [motion(12.0, 0.1, 1), motion(7.0, 0.25, 2)], [INERTIA, INERTIA]
    )
    # Over 24 rad the numbers of periods that can be told apart are 2π / 24 = 0.26 apart.
    assert found["wave_periods_1"] == pytest.approx(PERIODS, abs=0.05)
    assert math.remainder(found["wave_phase_1"] - PHASE_RAD, math.tau) == pytest.approx(
        0.0, abs=0.3
    )
    starts = Cogging.starts(found | {"span_rad": 24.0, "peak_torque_nm": 0.3})
    assert starts[0]["periods"] == found["wave_periods_1"]
    assert (
        starts[0]["phase_rad"] == pytest.approx(found["wave_phase_1"])
        and len(starts) == 9
    )


def test_a_joint_that_turns_by_less_than_half_a_turn_is_searched_by_the_grid() -> None:
    assert position_waves([motion(1.5, 0.1, 1)], [INERTIA]) == {}


def test_a_slides_magnets_are_found_by_their_pitch_and_their_effect_is_in_newtons() -> (
    None
):
    """A magnet pitch of 24 mm on a stroke of 0.2 m: 2π / 0.024 = 261.8 rad/m, and 13.1 periods per unit of 0.05 m."""
    scale = Scale(unit="m", force=30.0, length=0.2)
    assert scale.wave == pytest.approx(0.05)
    turning = motion(
        0.09 / 0.05, 0.1, 1
    )  # of the wheel above, whose 42 periods a radian are 840 rad/m here
    sliding = dataclasses.replace(turning, measured=0.05 * turning.measured)
    slide = scaled("cogging", scale)
    found = position_waves([sliding], [INERTIA / 0.05], slide, length=scale.wave)
    (start, *_) = slide.starts(found | {"span_rad": 0.18, "peak_torque_nm": 30.0})
    assert start["periods"] == pytest.approx(PERIODS / 0.05, rel=0.03)
    assert start["phase_rad"] == pytest.approx(found["wave_phase_1"])
    assert {p.name: p.unit for p in slide.parameters()} == {
        "torque_nm": "N",
        "periods": "rad/m",
        "phase_rad": "rad",
    }
    numbers: Any = {"torque_nm": 4.0, "periods": 2 * math.pi / 0.024, "phase_rad": 0.6}
    assert (slide(**numbers).drive() or {})["cogging__periods"] == pytest.approx(
        261.8, abs=0.01
    )
