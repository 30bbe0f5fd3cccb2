"""A sampled loop: its limit of stability and its bias are known beforehand."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from taccorl.alignment.measurements.motions import CHIRP, POSES, RATE_HZ, Motion, Room
from taccorl.errors import TaccorlError
from taccorl.surrogate.cases import LOOP_FLOORS, draw_case
from taccorl.surrogate.plant import STEP_S
from taccorl.surrogate.robot import TWIN_LATE_S, Robot, free_inertia, inertia_and_weight
from taccorl.surrogate.sampled_loop import FILTER_S, PERIODS_STEPS, SampledLoop, draw_loop, is_stable, spectral_radius

JOINT = 1  # no weight
POSE = POSES[JOINT - 1]
INERTIA, _ = inertia_and_weight(np.array(POSE), JOINT)
OMEGA, ZETA = 12.0, 1.2
KP, KD = INERTIA * OMEGA**2, 2 * ZETA * OMEGA * INERTIA
ROOM = Room.of(JOINT, POSE[JOINT - 1], INERTIA, 0.0)
LOOP = SampledLoop(steps=8, filter_s=2e-3)


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def test_rates_are_from_half_to_four_kilohertz():
    assert [round(1 / (steps * STEP_S)) for steps in PERIODS_STEPS] == [4000, 2000, 1600, 1000, 800, 500]


@pytest.mark.parametrize(("share", "stable"), [(0.99, True), (1.01, False)])
def test_without_low_pass_a_velocity_loop_is_stable_up_to_two_inertias_a_period(share, stable):
    # w_k = (v_k + v_{k-1}) / 2 and v_{k+1} = v_k − g w_k with g = K_d T / J: z² − z + g (z + 1) / 2 = 0, |z|² = g / 2 < 1.
    loop = SampledLoop(steps=8, filter_s=0.0)
    kd = share * 2 * INERTIA / loop.period_s
    assert (spectral_radius(loop, 1e-9, kd, INERTIA) < 1 + 1e-6) == stable


@pytest.mark.parametrize(("share", "grows"), [(0.8, False), (1.3, True)])
def test_the_plant_rings_where_the_eigenvalues_say_so(share, grows):
    damping = np.arange(100.0, 3000.0, 5.0) * INERTIA
    light = free_inertia(np.array(POSE), JOINT)  # at some 50 Hz the other joints give way
    assert 0.3 * INERTIA < light < INERTIA
    most = next(kd for kd in damping if spectral_radius(LOOP, KP, kd, light) >= 1.0)
    step = Motion(name="made", target=lambda room: np.repeat([0.0, 0.05], [20, 180]))
    run = Robot(f"left_joint{JOINT}", (KP, share * most, 0.0), [], POSE, loop=LOOP).run(step, ROOM)
    assert (np.ptp(run.angle[-100:, 0]) > 0.02) == grows  # the other joints damp what grows


def test_the_margin_counts_doubled_gains_and_every_inertia():
    most = 2 * INERTIA / (1e-3 * 1.0)
    loop = SampledLoop(steps=8, filter_s=1e-6)
    assert is_stable(loop, 1e-6, most / 3.3, [INERTIA])
    assert not is_stable(loop, 1e-6, most / 3.1, [INERTIA])
    assert not is_stable(loop, 1e-6, most / 3.3, [INERTIA, 0.4 * INERTIA])


def linear(inertia: float) -> np.ndarray:
    discrete: Any = cont2discrete(([KP / inertia], [1.0, KD / inertia, KP / inertia]), 1 / RATE_HZ)
    return np.asarray(lfilter(np.ravel(discrete[0]), discrete[1], CHIRP.target(ROOM) - POSE[JOINT - 1]))


def test_a_sampled_loop_moves_as_a_lighter_joint_does():
    run = Robot(f"left_joint{JOINT}", (KP, KD, 0.0), [], POSE, loop=LOOP).run(CHIRP, ROOM)
    angle = run.angle[::5, 0] - POSE[JOINT - 1]
    # K_d of the drive is larger by K_p (T / 2 + half of the twin's step), see ``TWIN_LATE_S``.
    late = (KD + KP * (0.5 * LOOP.period_s + TWIN_LATE_S)) * LOOP.late_s
    assert late / INERTIA == pytest.approx(0.088, abs=0.002)  # K_p from angles and J is 9.6 % too large
    as_light, as_heavy = (rms(angle - linear(inertia)) for inertia in (INERTIA - late, INERTIA))
    assert as_light < 0.4 * as_heavy  # the twin's half step is left


def test_a_drawn_loop_is_no_later_than_asked():
    rng = np.random.default_rng(0)
    drawn = [draw_loop(rng, 1.5e-3) for _ in range(200)]
    assert {loop.steps for loop in drawn} == {2, 4, 5, 8}
    assert all(loop.late_s <= 1.5e-3 + 1e-12 and loop.filter_s >= FILTER_S[0] for loop in drawn)
    assert draw_loop(rng, 1e-4).late_s == pytest.approx(2 * STEP_S + FILTER_S[0])  # nothing is faster


def test_a_drawn_case_has_a_stable_loop_that_alone_leaves_next_to_nothing():
    case = draw_case(["coulomb_friction"], 301, signal="left_joint1", strength=8.0, design="chirp", sampled=True)
    assert case.loop is not None and case.loop_floors <= LOOP_FLOORS
    assert is_stable(case.loop, *case.gains[:2], [inertia_and_weight(np.array(case.pose), 1)[0]])
    truth = case.truth()
    torque = case.hidden[0].values["torque_nm"]
    assert truth["loop_hz"] == pytest.approx(1 / case.loop.period_s)
    ratios = truth["ratios"]
    assert isinstance(ratios, dict)
    assert ratios["coulomb_friction.torque_nm/kp"] == pytest.approx(torque / case.gains[0])
    late_s = 0.5 * case.loop.period_s + TWIN_LATE_S  # of K_p, which the timing takes from the drive's K_d
    assert ratios["kd/kp"] == pytest.approx(case.gains[1] / case.gains[0] + late_s)
    assert math.isclose(case.left_floors, 8.0, rel_tol=0.25)


@pytest.mark.slow
def test_where_no_loop_is_stable_a_gear_keeps_the_continuous_one_and_any_other_robot_is_refused(monkeypatch):
    monkeypatch.setattr("taccorl.surrogate.cases.is_stable", lambda *_: False)
    case = draw_case(["backlash"], 302, signal="left_joint2", strength=8.0, design="chirp", sampled=True)
    assert case.loop is None
    assert case.gains == draw_case(["backlash"], 302, signal="left_joint2", strength=8.0, design="chirp").gains
    with pytest.raises(TaccorlError, match="no sampled loop of left_joint2, seed 302, is stable"):
        draw_case([], 302, signal="left_joint2", design="chirp", sampled=True)
