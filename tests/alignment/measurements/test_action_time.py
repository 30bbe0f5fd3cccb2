"""One action-time convention: the action of row t is the last command sent before row t + 1, on every way into a dataset.

One simulated motion goes both ways: collected directly, and written to MCAP as the drivers would and ingested. In both datasets
the same number of rows must lie between action and state.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from taccorl.alignment.measurements.dataset_rows import from_episode
from taccorl.alignment.measurements.recorded import signal_names
from taccorl.data.cutting import open_episodes
from taccorl.data.episode import Episode
from taccorl.data.joint_checks import arm_lags
from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.errors import DatasetError
from taccorl.sim.bench import Bench
from taccorl.sim.replay import replay_episode
from taccorl.sim.simulation import Simulation
from taccorl.surrogate.drivers import publish
from taccorl.surrogate.twin_recording import LEAD_S, TwinStory
from tests.recordings.pictures import Dark
from tests.recordings.stand_in import StandInConfig, StandInStreams

FPS, SECONDS = 30, 6.0
JOINTS = np.arange(14) % 7 != 6
STATE, ACTION = "observation.state", "action"
PART_OF_ROW = 0.3
"""What the recording of a command leaves open, in rows: the twin sends five steps a row (0.2), drivers sample them and the
state at 200 Hz (0.15 each, of opposite sign). Measured: 0.20 of 3.62 rows."""


@dataclass
class BothWays:
    """One motion of the bench, as two episodes."""

    sim: Simulation
    collected: Episode
    ingested: Episode


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> BothWays:
    sim = Simulation(Bench())
    sim.reset([0])
    spec = row_spec(sim, pictures=False)
    recorder = EpisodeRecorder(sim, spec, np.random.default_rng(0), dense=True)
    home, rng = sim.targets[0].copy(), np.random.default_rng(3)
    phase, frequency_hz = rng.uniform(0, 6.3, (2, 14)), rng.uniform(0.4, 1.1, (2, 14))
    num_rows = round(SECONDS * FPS)
    for k in range(num_rows):
        fade = min(1.0, max(0.0, min(k - 8, num_rows - 8 - k) / 20))
        wave = (
            0.08 * fade * np.sin(2 * np.pi * frequency_hz * k / FPS + phase).sum(axis=0)
        )
        recorder.step(home + np.where(JOINTS, wave, -0.02 * fade))
    trajectory = recorder.trajectory()
    path = tmp_path_factory.mktemp("both") / "bench.mcap"
    config = StandInConfig(
        duration_s=float(trajectory.time_s[-1]) + 2 * LEAD_S, camera_size=(96, 128)
    )
    story = TwinStory(sim, trajectory, "success")
    publish(
        path,
        StandInStreams(config, story, Dark()),
        {"origin": "surrogate recording", "instruction": "move"},
    )
    with open_episodes(path, "piper_flexitac_mcap") as (ingested,):
        pass
    return BothWays(sim, recorder.episode("bench", {"task": "bench"}), ingested)


def lag_rows(action: np.ndarray, state: np.ndarray) -> float:
    """Rows L by which ``state`` (T, n) follows ``action`` (T, n): least squares of state[t] − action(t − L) over L.

    Both are smooth on the scale of a row, so that action between two rows is the straight line.
    """
    shifts, rows = (
        np.arange(-3.0, 6.0, 0.02),
        np.arange(10, len(state) - 10, dtype=float),
    )
    errors = []
    for shift in shifts:
        at = np.stack(
            [
                np.interp(rows - shift, np.arange(len(action)), column)
                for column in action.T
            ],
            axis=1,
        )
        difference = state[10:-10] - at
        errors.append(float(np.square(difference - difference.mean(axis=0)).sum()))
    return float(shifts[int(np.argmin(errors))])


def episode_lag_rows(episode: Episode) -> float:
    return lag_rows(
        episode.arrays[ACTION][:, JOINTS].astype(float),
        episode.arrays[STATE][:, JOINTS].astype(float),
    )


def test_lag_of_a_known_shift_is_found():
    times = np.arange(200) / FPS
    wave = np.stack([np.sin(5 * times), np.cos(3 * times + 1)], axis=1)
    assert lag_rows(wave, np.roll(wave, 2, axis=0)) == pytest.approx(2, abs=0.03)
    assert lag_rows(wave, np.roll(wave, -1, axis=0)) == pytest.approx(-1, abs=0.03)


def test_the_arms_lag_as_the_checks_report_it_is_behind_the_command_in_force(both):
    # Without the row by which an action is ahead: the lag of the controller alone.
    for one, other in zip(
        arm_lags(both.collected).values(), arm_lags(both.ingested).values(), strict=True
    ):
        assert 0.05 < one.lag_s < 0.12 and other.lag_s == pytest.approx(
            one.lag_s, abs=PART_OF_ROW / FPS
        )


def test_measurements_of_both_have_equal_lag_behind_the_command_in_force(both):
    lags = []
    for episode in (both.collected, both.ingested):
        m = from_episode(
            episode, signal_names(episode.spec), ("rad",) * 14, Path("d"), 0
        )
        assert m.num_rows == episode.num_rows - 1
        np.testing.assert_array_equal(m.target, episode.arrays[ACTION][:-1])
        np.testing.assert_array_equal(m.measured, episode.arrays[STATE][1:])
        lags.append(lag_rows(m.target[:, JOINTS], m.measured[:, JOINTS]))
    collected = episode_lag_rows(both.collected)
    assert (
        collected > 1
    )  # one row until the target is reached, and what the arm lags behind its command
    assert lags[0] == pytest.approx(collected - 1, abs=0.05)
    assert lags[1] == pytest.approx(lags[0], abs=PART_OF_ROW)


def test_a_twins_own_episode_is_replayed_to_its_own_states(both):
    both.sim.reset([0])
    twin = replay_episode(both.sim, both.collected)
    np.testing.assert_allclose(
        twin.arrays[STATE], both.collected.arrays[STATE], atol=5e-5
    )
    arrays = both.collected.arrays
    early = dataclasses.replace(
        both.collected, arrays=arrays | {ACTION: np.roll(arrays[ACTION], -1, axis=0)}
    )
    both.sim.reset([0])
    wrong = replay_episode(both.sim, early)
    assert np.abs(wrong.arrays[STATE] - arrays[STATE]).max() > 5e-3


def test_the_ingested_recording_is_replayed_within_its_clock(both):
    both.sim.reset([0])
    twin = replay_episode(both.sim, both.ingested)
    residual = twin.arrays[STATE] - both.ingested.arrays[STATE]
    # Rows of the grid lie between those of the twin: 0.2 rows leave 2.3 mrad, a whole row leaves 7.6 to 10.6 mrad.
    assert np.sqrt(np.mean(residual[:, JOINTS] ** 2)) < 4e-3


def test_who_does_not_state_the_convention_is_refused(both):
    silent = dataclasses.replace(
        both.ingested, spec=dataclasses.replace(both.ingested.spec, action_time=None)
    )
    with pytest.raises(DatasetError, match=r"action_time.*Ingest its recordings again"):
        from_episode(silent, signal_names(silent.spec), ("rad",) * 14, Path("d"), 0)
    with pytest.raises(DatasetError, match="action_time"):
        replay_episode(both.sim, silent)
