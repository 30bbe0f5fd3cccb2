"""A torque-speed limit, a tight spot, an end stop and lost commands in the twin, against their closed forms on joint 5."""

import math

import numpy as np
import pytest
from joint_bench import COLUMN, asked_nm, drive, on_joint5
from press_bench import RIGHT_HOME, PressBench, start

from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.command import uniform
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

HOME = RIGHT_HOME[4]


def test_a_tight_spot_rubs_at_its_place_and_nowhere_else() -> None:
    spot = HOME + 0.06
    sim = start(on_joint5("position_dependent_friction", torque_nm=0.5, angle_rad=spot, width_rad=0.01))
    motion = drive(sim, 2.4, lambda t: 0.05 * t)
    friction = asked_nm(motion)
    settled = motion["t"] > 0.5  # K_d / K_p is 0.11 s
    expected = 0.5 * np.exp(-(((motion["q"] - spot) / 0.01) ** 2))
    np.testing.assert_allclose(friction[settled], expected[settled], atol=0.02)
    assert friction[settled].max() > 0.48


def test_a_drive_gives_what_the_torque_speed_line_leaves_of_its_stall_torque() -> None:
    # J dv/dt = τ_s (1 − v / v₀): v = v₀ (1 − exp(−t / T)) with T = J v₀ / τ_s, and J from the first milliseconds.
    def moved(no_load: float) -> dict[str, np.ndarray]:
        effect = on_joint5("torque_speed_limit", stall_nm=4.0, no_load_rad_per_s=no_load)
        return drive(start(effect), 0.06, lambda t: 1.0)

    fast, slow = moved(50.0), moved(1.0)
    inertia = 4.0 * 5 * fast["t"][0] / fast["v"][4]
    constant_s = inertia * 1.0 / 4.0
    np.testing.assert_allclose(slow["v"], 1.0 - np.exp(-slow["t"] / constant_s), atol=0.15)
    assert slow["v"][-1] == pytest.approx(1.0, abs=0.05)
    assert fast["v"][-1] > 2.0


def test_a_moving_joint_is_braked_with_the_whole_stall_torque() -> None:
    # Half a second at 1 rad/s, as fast as the motor turns, then back at once: it brakes with 2 N·m, at rest it drives with 2 N·m.
    effect = on_joint5("torque_speed_limit", stall_nm=2.0, no_load_rad_per_s=2.0)
    motion = drive(start(effect), 0.3, lambda t: 1.0 * t if t < 0.25 else -1.0)
    at = np.searchsorted(motion["t"], 0.25)
    braking = np.diff(motion["v"])[at + 1 : at + 8]
    driving = np.diff(drive(start(effect), 0.02, lambda t: -1.0)["v"])[0]
    assert motion["v"][at + 8] > 0.1
    np.testing.assert_allclose(braking, driving, rtol=0.1)


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
