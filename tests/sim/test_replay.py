"""Replay and the dense record: aligned in time to the sample."""

import numpy as np
import pytest

from taccorl.data.episode import Episode
from taccorl.data.origin import Origin
from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.effects import make_effect
from taccorl.sim.replay import replay, replay_episode
from taccorl.sim.simulation import Simulation
from taccorl.sim.trajectory import SAMPLE_HZ, DenseRecorder
from taccorl.sim.twin import TwinConfig


@pytest.fixture
def bench():
    sim = Simulation(Bench())
    sim.reset([0])
    return sim


def test_sample_k_is_the_twin_before_command_k_acts(bench):
    # A step at row 10: rows 0 … 10 rest, and row 11 is 1 − exp(−dt / τ) of the way, τ = K_d / K_p. One row off would be 0.
    targets = np.tile(bench.targets[0], (30, 1))
    targets[10:, 3] += 0.02
    start = bench.proprioception()[0].copy()
    done = replay(bench, targets, 200.0, start)
    np.testing.assert_allclose(done.reported[:11, 3], start[3], atol=1e-7)
    tau_s = ROBOT.kd_nms_per_rad[3] / ROBOT.kp_nm_per_rad[3]
    for row in (11, 15, 25):
        expected = 0.02 * (1 - np.exp(-(row - 10) / 200 / tau_s))
        assert done.reported[row, 3] - start[3] == pytest.approx(
            expected, abs=0.02 * 0.012
        )
    np.testing.assert_allclose(done.time_s, np.arange(30) / 200)


def test_a_measured_episode_is_replayed_row_by_row(bench):
    # "Measured" in a twin with friction: its rows hold the state at each 1/30 s and the target reached 1/30 s later. The twin
    # without friction replays it: same rows, same commands, and the residual is what friction does; with friction it is nothing.
    def sticky() -> Simulation:
        sim = Simulation(
            Bench(),
            TwinConfig(effects=[make_effect("coulomb_friction", torque_nm=1.0)]),
        )
        sim.reset([0])
        return sim

    measured = sticky()
    state, action = [], []
    for k in range(45):
        state.append(measured.proprioception()[0].astype(np.float32))
        measured.step(
            measured.targets + 0.01 * np.sin(0.25 * k) * (np.arange(14) % 7 != 6)
        )
        action.append(measured.targets[0].astype(np.float32))
    spec = load_dataset_spec(find_spec("taccorl_bimanual"))
    arrays = {"observation.state": np.array(state), "action": np.array(action)}
    episode = Episode(
        "run 1",
        spec,
        0,
        arrays,
        lambda: iter(()),
        (),
        "sweep",
        origin=Origin("surrogate", "stand-in"),
    )
    twin = replay_episode(bench, episode)
    np.testing.assert_array_equal(twin.arrays["action"], episode.arrays["action"])
    assert twin.arrays["observation.state"].shape == (45, 14)
    assert twin.arrays["observation.tactile"].shape == (45, 1536)
    assert twin.origin == Origin("twin", "replay of: stand-in")
    residual = np.abs(
        twin.arrays["observation.state"] - episode.arrays["observation.state"]
    ).max()
    same = replay_episode(sticky(), episode)
    assert residual > 3e-4
    np.testing.assert_allclose(
        same.arrays["observation.state"], episode.arrays["observation.state"], atol=2e-5
    )


def test_rates_that_fall_between_physics_steps_are_refused(bench):
    with pytest.raises(TaccorlError, match="resample"):
        replay(bench, np.tile(bench.targets[0], (5, 1)), 70.0)
    with pytest.raises(TaccorlError, match=r"\(5, 7\)"):
        replay(bench, np.zeros((5, 7)), 100.0)


def test_dense_record_samples_every_five_milliseconds_across_control_steps(bench):
    # 40 physics steps a control step, a sample every 6: the samples of the second step begin at step 42.
    recorder = DenseRecorder(bench)
    times = []
    for _ in range(4):
        watch = recorder.watch()
        bench.step(bench.targets + np.where(np.arange(14) == 0, 0.01, 0.0), watch=watch)
        times.append(len(watch.at))
    record = recorder.trajectory()
    assert times == [6, 7, 7, 6]
    assert len(record.time_s) == 1 + 160 // 6
    np.testing.assert_allclose(np.diff(record.time_s), 1 / SAMPLE_HZ)
    # joint 1 follows a ramp of 0.3 rad/s with lag τ: reported is monotonic and below the target
    assert (np.diff(record.reported[:, 0]) >= 0).all()
    assert (record.reported[5:, 0] < record.targets[5:, 0]).all()
    assert record.reading.shape == (len(record.time_s), 4, 32, 12)


def test_dense_record_of_effort_is_the_controllers_law(bench):
    # K_p (q* − q) − K_d q̇ + T_ref while the target stands still and the joint is on its way.
    recorder = DenseRecorder(bench)
    goal = bench.targets + np.where(np.arange(14) == 4, 0.05, 0.0)
    for _ in range(8):
        bench.step(goal, watch=recorder.watch())
    record = recorder.trajectory()
    velocity = np.gradient(record.reported[:, 4], 1 / SAMPLE_HZ)
    expected = (
        ROBOT.kp_nm_per_rad[4] * (goal[0, 4] - record.reported[:, 4])
        - ROBOT.kd_nms_per_rad[4] * velocity
        + ROBOT.torque_ff_nm[4]
    )
    np.testing.assert_allclose(record.effort[10:-2, 4], expected[10:-2], atol=0.03)
    assert np.abs(velocity[10:20]).min() > 0.05
