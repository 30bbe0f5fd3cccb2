"""Closed forms of effects on joint 5 of the right arm: a steady sweep, a rest, two limits of one drive, lost commands.

Laws that ``tests/surrogate`` computes apart from the one-joint model, which tests/alignment/controller/test_joint_model.py
compares with MuJoCo, are not repeated here. At rest at home targets stand T_ref / K_p below the angles, and weight is carried.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
from joint_bench import COLUMN, KP, TORQUE_FF, asked_nm, drive, on_joint5
from press_bench import RIGHT_HOME, PressBench, start

from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.command import uniform
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

HOME = RIGHT_HOME[4]
STRIBECK = {"torque_nm": 0.5, "stiction_share": 1.0, "stribeck_rad_per_s": 0.1, "presliding_rad": 5e-4}
POWER = {"torque_nm": 0.5, "exponent": 0.5, "asymmetry": 0.3}
LEANING = {"torque_nm": 0.5, "asymmetry": 0.3}


# K_p (u − q) − K_d v + T_ref balances what acts besides it.
@pytest.mark.parametrize(
    ("name", "values", "speed", "seconds", "torque_nm", "rel"),
    [
        ("power_law_friction", POWER, 0.1, 0.8, 0.5 * 1.3, 0.01),  # four times the speed, twice the friction
        ("power_law_friction", POWER, 0.4, 0.8, 0.5 * 1.3 * 2, 0.01),
        ("power_law_friction", POWER, -0.4, 0.8, -0.5 * 0.7 * 2, 0.01),
        ("asymmetric_friction", LEANING, 0.05, 1.0, 0.5 * 1.3, 0.01),
        ("asymmetric_friction", LEANING, -0.05, 1.0, -0.5 * 0.7, 0.01),
        ("stribeck_friction", STRIBECK, 0.02, 1.0, 0.5 + 0.5 * np.exp(-0.04), 0.02),
        ("stribeck_friction", STRIBECK, 0.1, 1.0, 0.5 + 0.5 * np.exp(-1.0), 0.02),
        ("stribeck_friction", STRIBECK, 0.4, 0.7, 0.5 + 0.5 * np.exp(-16.0), 0.02),
    ],
)
def test_a_steady_sweep_takes_the_torque_of_the_law(name, values, speed, seconds, torque_nm, rel):
    motion = drive(start(on_joint5(name, **values)), seconds, lambda t: speed * t)
    assert motion["v"][-1] == pytest.approx(speed, rel=0.02)
    assert asked_nm(motion)[-1] == pytest.approx(torque_nm, rel=rel)


def balance(torque_nm: Callable[[float], float], goal: float) -> float:
    """q where K_p (goal − q) is the torque of the effect, found by Newton's steps."""
    q = goal
    for _ in range(50):
        slope = (torque_nm(q + 1e-6) - torque_nm(q - 1e-6)) / 2e-6
        q += (KP * (goal - q) - torque_nm(q)) / (KP + slope)
    return q


@pytest.mark.parametrize(
    ("effects", "offset", "torque_nm", "tolerance"),
    [
        ({"cable_spring": {"stiffness_nm_per_rad": 5.0, "rest_rad": -0.4}}, 0.0, lambda q: 5.0 * (q + 0.4), 1e-6),
        ({"unbalance": {"torque_nm": 3.0, "hangs_at_rad": -0.8}}, 0.0, lambda q: 3.0 * np.sin(q + 0.8), 1e-6),
        (
            {"end_stop": {"angle_rad": HOME - 0.03, "stiffness_nm_per_rad": 1000.0}},
            -0.1,
            lambda q: 1000.0 * (q - HOME + 0.03),
            1e-6,
        ),
        (
            {
                "end_stop": {"angle_rad": HOME + 0.03, "stiffness_nm_per_rad": 1000.0},
                "cable_spring": {"stiffness_nm_per_rad": 20.0, "rest_rad": 0.5},
            },
            0.1,
            lambda q: 1000.0 * (q - HOME - 0.03) + 20.0 * (q - 0.5),
            1e-6,
        ),
        ({"coulomb_friction": {"torque_nm": 0.5}}, 0.02, lambda q: 0.5, 3e-5),  # it stops short by F / K_p, 3.31 mrad
        ({"coulomb_friction": {"torque_nm": 0.5}}, -0.02, lambda q: -0.5, 3e-5),
    ],
)
def test_a_joint_rests_where_the_drive_balances_the_law(effects, offset, torque_nm, tolerance):
    motion = drive(start(*(on_joint5(name, **values) for name, values in effects.items())), 2.0, lambda t: offset)
    goal = motion["u"][-1] + TORQUE_FF / KP
    assert motion["q"][-1] == pytest.approx(balance(torque_nm, goal), abs=tolerance)
    assert abs(motion["q"][-1] - goal) > 3e-3, "it shows"


@pytest.mark.parametrize(
    ("name", "values", "torque_nm", "least", "most"),
    [
        # Of what breaks it away: 0.5 N·m; 0.5 (1 + a) and 0.5 (1 − a); 1 N·m of bristles that bend by 0.1 mrad, which hold 0.7.
        ("coulomb_friction", {"torque_nm": 0.5}, -0.45, -2e-5, 2e-5),
        ("coulomb_friction", {"torque_nm": 0.5}, 0.25, -2e-5, 2e-5),
        ("coulomb_friction", {"torque_nm": 0.5}, 0.495, -2e-5, 2e-5),
        ("asymmetric_friction", LEANING, 0.6, -2e-5, 2e-5),
        ("asymmetric_friction", LEANING, -0.3, -2e-5, 2e-5),
        ("stribeck_friction", STRIBECK | {"presliding_rad": 1e-4, "stribeck_rad_per_s": 0.05}, 0.7, 0.0, 3e-4),
        # By what is beyond 0.65 or −0.35 N·m, as far as it gets in this time.
        ("asymmetric_friction", LEANING, 0.7, 0.9 * 0.05 / KP, 1.1 * 0.05 / KP),
        ("asymmetric_friction", LEANING, -0.4, -1.1 * 0.05 / KP, -0.9 * 0.05 / KP),
    ],
)
def test_friction_at_rest_holds_up_to_its_break_away(name, values, torque_nm, least, most):
    motion = drive(start(on_joint5(name, **values)), 1.0, lambda t: torque_nm / KP)
    assert least < motion["q"][-1] - HOME < most
    if least < 0 < most:
        assert abs(motion["v"][-1]) < 1e-5


@pytest.mark.parametrize(
    ("name", "values", "reads"),
    [
        ("encoder_bias", {"bias_rad": 0.01}, lambda q: q + 0.01),
        ("encoder_scale", {"factor": 1.05}, lambda q: 1.05 * q),
        ("encoder_eccentricity", {"amplitude_rad": 0.05, "phase_rad": 0.6}, lambda q: q + 0.05 * np.sin(q + 0.6)),
    ],
)
def test_an_encoder_settles_the_arm_where_it_reads_the_target_and_reports_that_it_is_there(name, values, reads):
    sim = start(on_joint5(name, **values))
    assert sim.proprioception()[0, COLUMN] == pytest.approx(HOME, abs=1e-12)
    motion = drive(sim, 1.5, lambda t: 0.05)
    at_target = motion["u"][-1] + TORQUE_FF / KP
    assert motion["reported"][-1] == pytest.approx(at_target, abs=1e-6)
    assert reads(motion["q"][-1]) == pytest.approx(at_target, abs=1e-6)
    assert abs(motion["q"][-1] - at_target) > 0.009


def test_both_limits_of_one_drive_hold() -> None:
    sim = start(
        on_joint5("torque_speed_limit", stall_nm=4.0, no_load_rad_per_s=50.0),
        on_joint5("torque_saturation", torque_max_nm=2.0),
    )
    alone = start(on_joint5("torque_saturation", torque_max_nm=2.0))
    np.testing.assert_allclose(drive(sim, 0.01, lambda t: 0.5)["v"], drive(alone, 0.01, lambda t: 0.5)["v"], rtol=1e-9)


def dropping(probability: float = 0.3, seed: int = 5, num_sims: int = 1) -> Simulation:
    config = TwinConfig(effects=[make_effect("dropped_commands", probability=probability, seed=seed, arm="right")])
    return Simulation(PressBench(), config, num_sims=num_sims)


def arrived(sim: Simulation, num: int = 60) -> np.ndarray:
    """(num, N) what is in force of a ramp of 1 mrad a command, in mrad."""
    rest = sim.targets.copy()
    rows = []
    for k in range(1, num + 1):
        sim.advance(rest[None] + 1e-3 * k, 1)
        rows.append(sim.arrays["ctrl"][:, sim.action_actuators[COLUMN]] - rest[:, COLUMN])
    return np.round(1e3 * np.array(rows)).astype(int)


def test_a_lost_command_leaves_the_one_before_in_force_and_each_episode_loses_its_own() -> None:
    sim = dropping(num_sims=3)
    sim.reset([0, 2**40 + 3, 0])
    got = arrived(sim)
    for i, episode in ((0, 0), (1, 3 ^ 2**8)):  # 2⁴⁰ + 3 folded into 32 bits
        arrives = uniform(5, np.full(60, episode), np.arange(60)) >= 0.3
        newest = np.maximum.accumulate(np.where(arrives, np.arange(1, 61), 0))
        np.testing.assert_array_equal(got[:, i], newest)
    np.testing.assert_array_equal(got[:, 2], got[:, 0])
    assert (got[:, 1] != got[:, 0]).any()
    sim.reset([0, 0, 0])
    np.testing.assert_array_equal(arrived(sim)[:, 1], got[:, 0])


def test_a_greater_probability_loses_more_commands_besides_the_same_ones() -> None:
    draws = uniform(1, np.zeros(20000), np.arange(20000))
    assert draws.mean() == pytest.approx(0.5, abs=3 / math.sqrt(12 * 20000))
    for p in (0.02, 0.3):
        assert (draws < p).mean() == pytest.approx(p, abs=3 * math.sqrt(p * (1 - p) / 20000))
    assert abs(np.corrcoef(draws[1:], draws[:-1])[0, 1]) < 3 / math.sqrt(20000)
    assert abs(np.corrcoef(draws, uniform(2, np.zeros(20000), np.arange(20000)))[0, 1]) < 3 / math.sqrt(20000)


def test_other_joints_hear_every_command() -> None:
    sim = Simulation(PressBench(), TwinConfig(effects=[on_joint5("dropped_commands", probability=0.95)]))
    sim.reset([0])
    rest = sim.targets.copy()
    sim.advance(rest[None] + 1e-3 * np.arange(1, 4)[:, None, None], 1)
    others = np.delete(np.arange(14), COLUMN)
    np.testing.assert_allclose((sim.arrays["ctrl"][:, sim.action_actuators] - rest)[0, others], 3e-3, atol=1e-12)


@pytest.mark.parametrize("seed", [-1, 1.5, True, 2**32])
def test_a_seed_that_is_no_whole_number_of_32_bits_is_refused(seed: float) -> None:
    with pytest.raises(TaccorlError, match=r"dropped_commands: seed is .*give a whole number in 0 … 4294967295"):
        make_effect("dropped_commands", seed=seed)
