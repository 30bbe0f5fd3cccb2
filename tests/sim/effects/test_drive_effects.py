"""Effects of dry friction, drives and encoders against their closed forms, on joint 5 of the right arm unless said otherwise.

In a sweep at a steady speed v the controller's torque K_p (u − q) − K_d v + T_ref balances whatever acts besides it.
"""

import numpy as np
import pytest
from joint_bench import (
    COLUMN,
    KD,
    KP,
    STEP_S,
    TORQUE_FF,
    asked_nm,
    drive,
    on_joint5,
    static_torque_nm,
    without_feedforward,
)
from press_bench import RIGHT_HOME, start

from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

SHOULDER = ROBOT.action_names.index("right_joint2")
HOME = RIGHT_HOME[4]


def on_shoulder(name: str, **values: float) -> Effect:
    return make_effect(name, arm="right", joints=["joint2"], **values)


# friction and springs --------------------------------------------------------------------------------------------------


def test_the_constant_part_of_asymmetric_friction_is_not_the_motors() -> None:
    sim = start(on_joint5("asymmetric_friction", torque_nm=0.5, asymmetry=0.3))
    motion = drive(sim, 1.0, lambda t: 0.05 * t)
    assert sim.effort()[0, COLUMN] == pytest.approx(asked_nm(motion)[-1], abs=1e-9)


@pytest.mark.parametrize("sign", [-1, 1])
def test_load_friction_follows_the_weight_that_the_gear_carries(sign: int) -> None:
    """With τ_motor = g + f: f = μ |2 g + f|, so f = 2 μ g / (1 − μ) with the weight's torque and 2 μ g / (1 + μ) against it."""
    share = 0.1
    sim = start(on_shoulder("load_friction", share=share))
    motion = drive(sim, 1.0, lambda t: sign * 0.05 * t, SHOULDER)
    load = static_torque_nm(sim, SHOULDER)
    assert abs(load) > 1.0
    raising = np.sign(load) == sign
    friction = sign * 2 * share * abs(load) / (1 - share if raising else 1 + share)
    assert motion["v"][-1] == pytest.approx(sign * 0.05, rel=0.02)
    assert sim.effort()[0, SHOULDER] == pytest.approx(friction, rel=0.02)


def test_cogging_is_a_sine_of_the_angle() -> None:
    effect = on_joint5("cogging", torque_nm=0.4, periods=30.0, phase_rad=0.7)
    motion = drive(start(effect), 2.0, lambda t: -0.2 * t)
    seen = motion["t"] > 1.0
    np.testing.assert_allclose(asked_nm(motion)[seen], -0.4 * np.sin(30 * motion["q"][seen] + 0.7), atol=0.02)
    assert np.ptp(motion["q"][seen]) > 0.8 * 2 * np.pi / 30


# commands and controllers ----------------------------------------------------------------------------------------------


def test_integral_action_works_an_error_off_at_its_rate() -> None:
    """K_d / K_p s² + s + r = 0: the slow pole is a little beyond −r. T_ref does not shift the joint any more."""
    rate = 0.5
    motion = drive(start(on_joint5("integral_action", rate_per_s=rate)), 4.0)
    error = motion["u"] - motion["q"]
    assert error[0] == pytest.approx(-TORQUE_FF / KP, rel=0.01)
    seen = motion["t"] > 1.0
    pole = np.polyfit(motion["t"][seen], np.log(-error[seen]), 1)[0]
    lag = KD / KP
    assert pole == pytest.approx((-1 + np.sqrt(1 - 4 * lag * rate)) / (2 * lag), rel=0.01)


def test_integral_action_has_balanced_what_acts_on_a_joint_at_its_target() -> None:
    effects = on_joint5("integral_action", rate_per_s=2.0), make_effect("gravity_mismatch", share=0.5, arm="right")
    sim = start(*effects)
    joints = sim.proprioception()[0].copy()
    sim.place_arms(joints, joints)
    moved = drive(sim, 0.5)["q"] - HOME
    assert abs(static_torque_nm(sim)) > 0.1
    assert np.abs(moved).max() < 1e-4  # the other joints sag a little, and change its load


def test_a_lagging_torque_is_a_low_pass_of_what_is_asked_for() -> None:
    sim = start(on_joint5("torque_lag", time_constant_s=0.01))
    share = STEP_S / (STEP_S + 0.01)
    torque, joint = sim.effort()[0, COLUMN], sim.model.joint("right_joint5")
    rest = sim.targets.copy()
    for k in range(60):
        targets = rest.copy()
        targets[0, COLUMN] += 0.05 * np.sin(0.2 * k)
        sim.advance(targets[None], 1)
        q, v = sim.arrays["qpos"][0, joint.qposadr[0]], sim.arrays["qvel"][0, joint.dofadr[0]]
        asked = KP * (targets[0, COLUMN] - q) - KD * v + TORQUE_FF
        torque += share * (asked - torque)
        assert sim.effort()[0, COLUMN] == pytest.approx(torque, abs=1e-9)
    assert abs(torque) > 0.3


def test_a_scaled_torque_carries_its_share_of_the_weight_and_keeps_the_time_constant() -> None:
    """g (K_p (u − q) + T_ref + w) = w at rest: it sags by (1 − g) w / (g K_p). K_d / K_p is as before."""
    sim = start(on_shoulder("torque_scale", factor=0.8))
    kp = ROBOT.kp_nm_per_rad[1]
    load = static_torque_nm(sim, SHOULDER)
    sag = drive(sim, 1.5, column=SHOULDER)["q"][-1] - RIGHT_HOME[1]
    assert sag == pytest.approx(-0.2 * load / (0.8 * kp), rel=0.01)
    # of the motor's 0.8 (w + asked): beyond 0.8 w
    assert sim.effort()[0, SHOULDER] == pytest.approx(0.2 * load, rel=0.01)
    motion = drive(start(on_joint5("torque_scale", factor=0.5)), 0.8, lambda t: 0.4 * t)
    plain = drive(start(), 0.8, lambda t: 0.4 * t)
    lags = [m["u"][-1] - m["q"][-1] for m in (motion, plain)]
    assert lags[0] == pytest.approx(lags[1] + 0.5 * static_torque_nm(start()) / (0.5 * KP), abs=2e-3)


def test_a_fading_torque_lets_the_arm_sag_more_and_more() -> None:
    """After t the share is f = 1 − R t, and the arm sags by (1 − f) w / (f K_p), K_d / K_p later."""
    sim = start(on_shoulder("torque_fade", rate_per_min=3.0))
    load, kp = static_torque_nm(sim, SHOULDER), ROBOT.kp_nm_per_rad[1]
    motion = drive(sim, 3.0, column=SHOULDER)
    for seconds in (1.0, 2.0, 3.0):
        left = 1 - 3.0 / 60 * (seconds - 0.089)  # K_d / K_p of joint 2
        sag = motion["q"][round(seconds / STEP_S) - 1] - RIGHT_HOME[1]
        assert sag == pytest.approx(-(1 - left) * load / (left * kp), rel=0.03)


def test_within_a_dead_band_nothing_happens_and_a_delayed_command_enters_it_late() -> None:
    sim = without_feedforward(on_joint5("error_deadband", width_rad=0.01))
    assert np.ptp(drive(sim, 0.5, lambda t: 0.009)["q"]) < 1e-6
    late = without_feedforward(on_joint5("error_deadband", width_rad=0.01), on_joint5("command_delay", delay_s=0.1))
    motion = drive(late, 0.3, lambda t: 0.05)
    assert np.ptp(motion["q"][motion["t"] < 0.1]) < 1e-6
    assert motion["q"][-1] - motion["q"][0] > 0.03  # of 0.04, with 0.11 s for two thirds


# where a search starts -------------------------------------------------------------------------------------------------

SEEN = {"peak_torque_nm": 4.0, "peak_speed_rad_per_s": 0.8, "span_rad": 1.5, "duration_s": 10.0}


@pytest.mark.parametrize(
    ("name", "parameter", "expected"),
    [
        ("torque_saturation", "torque_max_nm", [2.2, 3.0, 3.52, 3.88]),
        ("slew_limit", "speed_rad_per_s", [0.28, 0.48, 0.64, 0.736, 0.784]),
        ("coulomb_friction", "torque_nm", [0.12, 0.4, 1.2]),
        ("viscous_friction", "damping_nms_per_rad", [1 / 3, 1.0, 3.0]),
        ("torque_scale", "factor", [1.2, 0.8]),
    ],
)
def test_a_search_starts_where_the_recordings_say(name: str, parameter: str, expected: list[float]) -> None:
    assert [values[parameter] for values in effects.get(name).starts(SEEN)] == pytest.approx(expected)


@pytest.mark.parametrize("periods", [6.1, 7.3, 24.0, 57.4])
def test_a_search_for_cogging_starts_near_enough_to_see_any_number_of_periods(periods: float) -> None:
    """Over the span one of the starts explains most of the wave: it does not run out of step."""
    q = np.linspace(0.0, SEEN["span_rad"], 400)
    wave = np.sin(periods * q + 0.9)
    starts = effects.get("cogging").starts(SEEN)
    explained = []
    for n in {values["periods"] for values in starts}:
        basis = np.column_stack([np.sin(n * q), np.cos(n * q)])
        left = wave - basis @ np.linalg.lstsq(basis, wave, rcond=None)[0]
        explained.append(1 - np.sum(left**2) / np.sum(wave**2))
    assert max(explained) > 0.7
    assert {values["phase_rad"] for values in starts} == {0.0, np.pi / 2, np.pi, -np.pi / 2}


# together --------------------------------------------------------------------------------------------------------------


def test_commands_may_be_sent_one_by_one_or_together() -> None:
    names = {
        "load_friction": {"share": 0.1},
        "torque_lag": {"time_constant_s": 0.005},
        "command_delay": {"delay_s": 0.01},
    }
    together, apart = (start(*(make_effect(name, **values) for name, values in names.items())) for _ in range(2))
    commands = together.targets + 0.05 * np.sin(np.arange(1, 9))[:, None, None]
    together.advance(commands, 6)
    for command in commands:
        apart.advance(command[None], 6)
    np.testing.assert_array_equal(together.arrays["qpos"], apart.arrays["qpos"])


@pytest.mark.parametrize("name", ["torque_scale", "torque_lag", "load_friction"])
def test_the_first_reset_of_a_simulation_is_like_every_other(name: str) -> None:
    """What an effect feels at a reset must not depend on whether the simulation has been reset before."""
    effect = make_effect(name, joints=["joint2"])
    strength = next(p for p in effect.parameters() if p.absent is not None)
    setattr(effect, strength.name, strength.typical)
    config = TwinConfig(effects=[effect])
    sim = Simulation(Bench(), config)
    seen = []
    for _ in range(2):
        sim.reset([0])
        sim.step(sim.targets + 0.05)
        seen.append(sim.proprioception()[0].copy())
    np.testing.assert_array_equal(*seen)
