"""Two limits of one drive, and lost commands, in the twin on joint 5."""

import math

import numpy as np
import pytest
from joint_bench import COLUMN, drive, on_joint5
from press_bench import RIGHT_HOME, PressBench, start

from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.command import uniform
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

HOME = RIGHT_HOME[4]


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
