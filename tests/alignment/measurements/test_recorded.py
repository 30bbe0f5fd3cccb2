"""One motion of the twin as MCAP, dataset, CSV and parquet is one and the same measurement, and replayed it gives itself."""

import dataclasses
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from taccorl.alignment.checks.clock import check_against_twin
from taccorl.alignment.checks.telemetry import check_measurement
from taccorl.alignment.measurements.dataset_rows import from_episode, read_dataset
from taccorl.alignment.measurements.folder import read_measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.recorded import read_recording, signal_names
from taccorl.alignment.measurements.tables import read_table
from taccorl.data.dataset import PROVENANCE, dataset_spec_to_json, episode_record
from taccorl.data.episode import ChannelTiming, Episode
from taccorl.data.origin import Origin
from taccorl.data.recording import find_sources
from taccorl.data.spec import find_spec, load_dataset_spec, load_recording_spec
from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.errors import RecordingError, TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.replay import replay
from taccorl.sim.simulation import Simulation
from taccorl.sim.trajectory import SAMPLE_HZ, DenseRecorder, Trajectory
from taccorl.surrogate.drivers import START_UNIX_NS, publish
from taccorl.surrogate.twin_recording import LEAD_S, TwinStory
from tests.recordings.pictures import Dark
from tests.recordings.stand_in import (
    StandInConfig,
    StandInStreams,
    write_cobot_magic_hdf5,
)

STEP = (
    1.0005327 * 0.017444 * 1e-3
)  # rad: 0.001° times piper_ros's factor and its correction
SECONDS = 3.6
NO_LOSS = StandInConfig(
    duration_s=SECONDS + 2 * LEAD_S, joint_repeat_probability=0.0, camera_size=(96, 128)
)


@dataclass
class Moved:
    """A bench motion, and the twin it was made in."""

    sim: Simulation
    recorder: EpisodeRecorder
    trajectory: Trajectory
    folder: Path


def write(moved: Moved, path: Path, config: StandInConfig, **label: str) -> Path:
    """``moved`` as the drivers would have recorded it."""
    streams = StandInStreams(
        config, TwinStory(moved.sim, moved.trajectory, "success"), Dark()
    )
    publish(
        path, streams, {"origin": "surrogate recording", "instruction": "move"} | label
    )
    return path


@pytest.fixture(scope="module")
def moved(tmp_path_factory) -> Moved:
    sim = Simulation(Bench())
    sim.reset([0])
    recorder = EpisodeRecorder(
        sim, row_spec(sim, pictures=False), np.random.default_rng(0), dense=True
    )
    home = sim.targets[0].copy()
    for k in range(round(SECONDS * 30)):
        fade = min(
            1.0, max(0.0, min(k - 8, 76 - k) / 20)
        )  # at rest at the end: a recording goes on as it ended
        wave = 0.15 * fade * np.sin(2 * np.pi * 0.6 * k / 30 + np.arange(14))
        recorder.step(home + np.where(np.arange(14) % 7 == 6, -0.02 * fade, wave))
    return Moved(sim, recorder, recorder.trajectory(), tmp_path_factory.mktemp("moved"))


@pytest.fixture(scope="module")
def driven(moved) -> Moved:
    """Commanded at 200 Hz, so that the recording has every command when it was sent."""
    sim = moved.sim
    sim.reset([1])
    dense, home = DenseRecorder(sim), sim.targets[0].copy()
    for k in range(600):
        fade = min(1.0, max(0.0, min(k - 20, 400 - k) / 100))
        wave = (
            0.15
            * fade
            * np.sin(2 * np.pi * 1.1 * k / 200 + np.arange(14))
            * (np.arange(14) % 7 != 6)
        )
        sim.advance((home + wave)[None, None], 6, watch=dense.watch(6))
    return Moved(sim, moved.recorder, dense.trajectory(), moved.folder)


@pytest.fixture(scope="module")
def recorded(moved) -> Measurement:
    label = {
        "repeat_of": "earlier.mcap",
        "kp": '{"left_joint5": 40}',
        "payload_kg": '{"left": 0.5}',
    }
    return read_measurements(
        write(moved, moved.folder / "bench.mcap", NO_LOSS, **label)
    ).fit[0]


def truth_rows(m: Measurement, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """(rows of ``m``, samples of the trajectory) that are the same instants."""
    at = (m.time_s + (m.start_ns - START_UNIX_NS) * 1e-9 - LEAD_S) * SAMPLE_HZ
    rows = np.flatnonzero((at > -1e-6) & (at < len(trajectory.time_s) - 1 + 1e-6))
    samples = np.round(at[rows]).astype(int)
    np.testing.assert_allclose(at[rows], samples, atol=1e-4)
    return rows, samples


def test_mcap_is_read_at_the_command_s_own_200_hz(recorded, moved):
    assert recorded.rate_hz == 200.0 and recorded.signals == ROBOT.action_names
    assert recorded.instruction == NO_LOSS.instruction  # of the first start marker
    assert recorded.origin == Origin(None, "surrogate recording")
    assert recorded.time_s[-1] > SECONDS + LEAD_S  # rests included
    rows, samples = truth_rows(recorded, moved.trajectory)
    assert len(rows) == len(moved.trajectory.time_s)
    limit = np.where(np.arange(14) % 7 == 6, 0.5e-6, STEP / 2) + 1e-6
    assert (
        np.abs(recorded.measured[rows] - moved.trajectory.reported[samples]) <= limit
    ).all()
    assert (
        np.abs(recorded.target[rows] - moved.trajectory.targets[samples]) <= limit
    ).all()


def test_effort_and_velocity_come_beside_the_positions(recorded, moved):
    rows, samples = truth_rows(recorded, moved.trajectory)
    np.testing.assert_allclose(
        recorded.effort[rows], moved.trajectory.effort[samples], atol=1e-6
    )
    slope = np.gradient(moved.trajectory.reported, 1 / SAMPLE_HZ, axis=0)
    arms = np.arange(14) % 7 != 6
    np.testing.assert_allclose(
        recorded.velocity[rows][:, arms], slope[samples][:, arms], atol=1e-6
    )
    assert np.isnan(
        recorded.velocity[:, ~arms]
    ).all()  # PiPER reports none for its grippers
    assert recorded.has_effort().sum() == 14


def test_a_frame_of_a_pad_has_the_time_at_which_its_scan_had_been_read(recorded, moved):
    """The boards' own 4 ms on the way stay in it: they are for ``touch_delay`` to find."""
    with (moved.folder / "bench.mcap").open("rb") as file:
        log_ns = [
            m.log_time
            for _, _, m in make_reader(file).iter_messages(
                topics=["/left_robot_left_finger"]
            )
        ]
    read_s = (np.array(log_ns) - recorded.start_ns) * 1e-9
    nearest = np.abs(recorded.touch.time_s[:, 0][:, None] - read_s).min(axis=1)
    assert len(nearest) > 300 and nearest.max() < 1e-6


def test_what_the_recording_says_of_itself_is_kept(recorded):
    assert recorded.repeat_of == "earlier.mcap"
    assert recorded.kp == {"left_joint5": 40.0}
    assert recorded.payload_kg == {"left": 0.5}


def test_resolution_of_the_encoders_is_found(recorded):
    np.testing.assert_allclose(recorded.quantum[[0, 4, 9]], STEP, rtol=1e-5)
    np.testing.assert_allclose(recorded.quantum[6], 1e-6, rtol=1e-3)


def test_touch_keeps_every_pad_s_own_time(recorded, moved):
    touch = recorded.touch
    assert touch.counts.shape[1] == 1536
    assert touch.time_s.shape == (len(touch.counts), 4)
    np.testing.assert_allclose(np.diff(touch.time_s[:, 0]), 0.01, atol=0.004)
    assert len(set(np.round(touch.time_s[10] % 0.01, 5))) == 4  # four phases
    assert np.abs(np.median(touch.counts[:20], axis=0)).max() <= 2  # above baseline


def test_replay_of_the_recording_gives_the_recording_and_one_row_off_does_not(driven):
    m = read_measurements(write(driven, driven.folder / "driven.mcap", NO_LOSS)).fit[0]
    driven.sim.reset([1])
    first = truth_rows(m, driven.trajectory)[0][0]
    twin = replay(driven.sim, m.target[first : first + 560], 200.0, m.measured[first])
    arms = np.arange(14) % 7 != 6

    def error(late: int) -> float:
        a, b = (
            twin.reported[10:-10, arms],
            m.measured[first + 10 + late : first + 550 + late, arms],
        )
        return float(np.sqrt(np.mean((a - b) ** 2)))

    # Commands and positions were rounded to 0.001°, 17 µrad. Half of 0.15 rad · 2π · 1.1 Hz · 5 ms is 2.6 mrad.
    assert error(0) < 2e-5
    assert min(error(1), error(-1)) > 1e-3
    assert check_against_twin(m_rows(m, first), twin.reported, FLOOR) == []
    early = check_against_twin(m_rows(m, first, late=1), twin.reported, FLOOR)
    assert {f.check for f in early} == {"shifted_from_twin"}
    assert len(early) == 12


FLOOR = dict.fromkeys(ROBOT.action_names, 1e-5)


def m_rows(m: Measurement, first: int, late: int = 0) -> Measurement:
    """560 rows; positions of ``late`` rows later."""
    rows, seen = slice(first, first + 560), slice(first + late, first + 560 + late)
    columns = {k: getattr(m, k)[seen] for k in ("measured", "velocity", "effort")}
    return dataclasses.replace(
        m, time_s=m.time_s[rows], target=m.target[rows], **columns
    )


def test_checks_find_nothing_wrong_with_it(recorded):
    found = {f.check for f in check_measurement(recorded)}
    assert found <= {
        "short",
        "not_judged",
    }  # 2 s of motion, and rounding is all the noise it has


@pytest.mark.slow
def test_lost_and_repeated_samples_are_bridged_and_counted(moved, recorded):
    config = dataclasses.replace(NO_LOSS, joint_repeat_probability=0.02)
    m = read_measurements(write(moved, moved.folder / "lossy.mcap", config)).fit[0]
    assert any(t.duplicates > 5 for t in m.timing)
    assert m.rate_hz == 200.0
    shift = round((m.start_ns - recorded.start_ns) * 1e-9 * 200)
    same = slice(max(shift, 0), max(shift, 0) + 900)
    apart = m.measured[max(-shift, 0) :][:900] - recorded.measured[same]
    # A line across 15 ms misses at most q̈ h² / 8 = 0.15 · (2π · 0.6)² rad/s² · 2.25 · 10⁻⁴ s² / 8, plus a step of the encoder.
    assert np.abs(apart[:, np.arange(14) % 7 != 6]).max() < 6e-5 + STEP


def test_a_long_silence_is_a_hole_of_positions_and_holds_commands(moved):
    gaps = [("/joint_states_left", 2.0, 2.1), ("/joint_states_ctrl_right", 2.5, 2.6)]
    config = dataclasses.replace(NO_LOSS, gap=gaps)
    m = read_measurements(write(moved, moved.folder / "gap.mcap", config)).fit[0]
    begins = m.start_ns - START_UNIX_NS
    hole = np.flatnonzero(np.isnan(m.measured[:, 0])) * 0.005 + begins * 1e-9
    assert (hole[0], hole[-1]) == (
        pytest.approx(2.0, abs=1e-6),
        pytest.approx(2.095, abs=1e-6),
    )
    assert np.isfinite(m.measured[:, 7:]).all()
    held = m.target[
        (m.time_s + begins * 1e-9 > 2.4951) & (m.time_s + begins * 1e-9 < 2.5949), 7
    ]
    assert np.ptp(held) == 0.0
    hole = next(f for f in check_measurement(m) if f.check == "lost_samples")
    assert hole.feature == "left_joint1"


@pytest.mark.slow
def test_commands_of_another_phase_keep_their_mean_time(moved, recorded):
    # Command stamps 2 ms later than positions: rows lie on the commands, positions are brought to them.
    late = {"/joint_states_ctrl_left": 0.002, "/joint_states_ctrl_right": 0.002}
    config = dataclasses.replace(NO_LOSS, clock_offset_s=late)
    m = read_measurements(write(moved, moved.folder / "phase.mcap", config)).fit[0]
    assert (m.start_ns - START_UNIX_NS) % 5_000_000 == 2_000_000
    time_s = m.time_s + (m.start_ns - START_UNIX_NS) * 1e-9 - LEAD_S
    inside = (time_s > 0) & (time_s < SECONDS - 0.02)
    expected = np.interp(
        time_s[inside], moved.trajectory.time_s, moved.trajectory.reported[:, 2]
    )
    np.testing.assert_allclose(m.measured[inside, 2], expected, atol=2 * STEP)
    assert [t.align for t in m.timing] == ["line"] * 4
    assert {f.check for f in check_measurement(m)} >= {"jitter"}


def test_pads_touched_at_the_start_leave_touch_out_and_say_so(moved):
    story = moved.trajectory
    reading = story.reading.copy()
    reading[::2] += 0.3
    shaken = Moved(
        moved.sim,
        moved.recorder,
        dataclasses.replace(story, reading=reading[:]),
        moved.folder,
    )
    config = dataclasses.replace(NO_LOSS, pad_noise_counts=40.0)
    m = read_measurements(write(shaken, moved.folder / "touched.mcap", config)).fit[0]
    assert m.touch is None
    assert [f.check for f in m.findings] == ["no_baseline"]
    assert "touched while the baseline was recorded?" in m.findings[0].text


def test_a_recording_without_commands_is_refused_by_name(moved):
    config = dataclasses.replace(NO_LOSS, gap=[("/joint_states_ctrl_left", 0.0, 99.0)])
    path = write(moved, moved.folder / "mute.mcap", config)
    with pytest.raises(
        RecordingError,
        match=r"mute.mcap: topics in the spec but without .*/joint_states_ctrl_left",
    ):
        read_measurements(path)


def test_markers_do_not_matter(moved):
    config = dataclasses.replace(NO_LOSS, gap=[("/episode", 0.0, 99.0)])
    m = read_measurements(write(moved, moved.folder / "unmarked.mcap", config)).fit[0]
    assert m.instruction == "move"  # the metadata's, then


@pytest.mark.parametrize(
    ("gap_s", "kept", "named"), [(2.0, 1.0, "cut_short"), (99.0, 0.7, "damaged")]
)
def test_a_channel_that_ends_early_and_a_file_cut_by_a_crash_are_named(
    moved, gap_s: float, kept: float, named: str
):
    config = dataclasses.replace(NO_LOSS, gap=[("/joint_states_left", gap_s, 99.0)])
    path = write(moved, moved.folder / "cut.mcap", config)
    path.write_bytes((data := path.read_bytes())[: int(kept * len(data))])
    assert named in {f.check for f in read_measurements(path).fit[0].findings}


RATE = "rate_hz /joint_states_ctrl_left"


@pytest.mark.parametrize(
    ("label", "named"),
    [
        ({"kp": "40"}, r'metadata kp.*40.*\{"left_joint5": 40.0\}'),
        *(
            ({RATE: text}, rf"odd\.mcap: metadata '{RATE}' is '{text}'.* Hz")
            for text in ("200 Hz", "0", "nan")
        ),
    ],
)
def test_odd_metadata_is_an_error(moved, label: dict[str, str], named: str):
    path = write(moved, moved.folder / "odd.mcap", NO_LOSS, **label)
    spec = load_recording_spec("piper_flexitac_mcap")
    ((_, source),) = find_sources(path, reader="mcap")
    with pytest.raises(RecordingError, match=named):
        read_recording(source, spec)


def write_tables(m: Measurement, folder: Path) -> list[Path]:
    columns = {"t": m.time_s}
    for j, name in enumerate(m.signals):
        columns |= {
            f"{name}.q": m.measured[:, j],
            f"{name}.q_target": m.target[:, j],
            f"{name}.tau": m.effort[:, j],
        }
    paths = [folder / "bench.csv", folder / "bench.parquet"]
    lines = [
        ",".join(columns),
        *(
            ",".join(repr(float(x)) for x in row)
            for row in zip(*columns.values(), strict=True)
        ),
    ]
    paths[0].write_text("\n".join(lines) + "\n")
    pq.write_table(pa.table(columns), paths[1])
    return paths


def test_csv_and_parquet_give_the_same_measurement_as_the_recording(recorded, tmp_path):
    for path in write_tables(recorded, tmp_path):
        m = read_table(path)
        assert m.signals == recorded.signals
        assert m.units == recorded.units
        for field in ("time_s", "target", "measured", "effort"):
            np.testing.assert_array_equal(
                getattr(m, field),
                getattr(recorded, field),
                err_msg=f"{path.name} {field}",
            )
        np.testing.assert_allclose(m.quantum, recorded.quantum)


@pytest.fixture(scope="module")
def dataset(moved) -> Path:
    from taccorl.data.lerobot_format import write_episodes

    folder = moved.folder / "dataset"
    episode = moved.recorder.episode("bench seed 0", {"task": "bench"})
    write_episodes([episode], folder)
    meta = folder / PROVENANCE
    meta.mkdir(parents=True)
    (meta / "episodes.json").write_text(json.dumps([episode_record(episode, "")]))
    (meta / "dataset_spec.json").write_text(
        json.dumps(dataset_spec_to_json(episode.spec))
    )
    return folder


def test_dataset_of_the_twin_gives_the_same_measurement_at_30_hz(
    dataset, moved, recorded
):
    (m,) = read_dataset(dataset)
    assert (m.name, m.rate_hz, m.signals) == (
        "dataset/episode_0",
        30.0,
        recorded.signals,
    )
    assert m.touch is not None
    # Row 0 has no command before it; row k lies at (k + 1) / 30 s, every third of them on a sample of the 200 Hz.
    at = np.arange(2, m.num_rows, 3)
    samples = (at + 1) * 20 // 3
    np.testing.assert_allclose(
        m.measured[at], moved.trajectory.reported[samples], atol=1e-6
    )
    rows, of = truth_rows(recorded, moved.trajectory)
    np.testing.assert_allclose(
        recorded.measured[rows[np.searchsorted(of, samples)]], m.measured[at], atol=STEP
    )


def test_units_are_stated_once(dataset, tmp_path):
    """A columns file beside the units of a dataset would not be used: refused for that dataset alone, as for other files of a
    folder it may be needed."""
    columns = tmp_path / "columns.yaml"
    columns.write_text(
        "time: {column: t, unit: s}\nsignals: {left_joint1: {q: {column: q1, unit: deg}, q_target: {column: c1, unit: deg}}}\n"
    )
    with pytest.raises(
        TaccorlError, match=r"dataset: .*states its units itself.*--columns"
    ):
        read_measurements(dataset, columns=columns)
    shutil.copytree(dataset, tmp_path / "all/episodes")
    assert [
        m.name for m in read_measurements(tmp_path / "all", columns=columns).all
    ] == ["episodes/episode_0"]


def test_a_folder_of_everything_is_read_by_its_index(
    recorded, dataset, moved, tmp_path
):
    shutil.copy(moved.folder / "bench.mcap", tmp_path / "sweep_1.mcap")
    shutil.copytree(dataset, tmp_path / "episodes")
    write_tables(recorded, tmp_path)[1].unlink()
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff")
    index = "spec: piper_flexitac_mcap\nrecordings: {sweep_1.mcap: {use: validation, kp: {left_joint5: 20}}}\n"
    (tmp_path / "measurements.yaml").write_text(index)
    found = read_measurements(tmp_path)
    assert [m.name for m in found.fit] == ["bench.csv", "episodes/episode_0"]
    (held,) = found.validation
    assert held.kp == {
        "left_joint5": 20.0
    }  # what the index says goes before what the recording says
    assert found.skipped == ("photo.jpg (a JPEG picture, no recording)",)
    (tmp_path / "measurements.yaml").unlink()
    assert len(read_measurements(tmp_path).fit) == 3  # one shipped spec reads MCAP


def test_rows_of_an_ingested_dataset_are_the_twins_and_tell_their_age():
    spec = load_dataset_spec(find_spec("taccorl_bimanual"))
    rows = np.linspace(0, 1, 40)[:, None] * np.ones(14)
    timing = ChannelTiming(
        "left_state", "observation.state", "asof", 200.0, 0, 0.005, 0.0025, 0.005
    )
    episode = Episode(
        "e",
        spec,
        0,
        {"observation.state": rows, "action": rows + 1},
        lambda: iter(()),
        (),
        "",
        timing=(timing,),
    )
    m = from_episode(episode, signal_names(spec), ("rad",) * 14, Path("d"), 0)
    np.testing.assert_array_equal(
        m.target, rows[:-1] + 1
    )  # in force at row k: the action of row k - 1
    np.testing.assert_array_equal(m.measured, rows[1:])
    assert m.time_error_s == 0.005
    assert "row_times" in {f.check for f in check_measurement(m)}


def test_hdf5_of_cobot_magic_has_effort_and_owns_that_it_has_no_clock(tmp_path):
    truth = write_cobot_magic_hdf5(
        tmp_path / "episode_0.hdf5",
        StandInConfig(duration_s=3.0, camera_size=(96, 128)),
    )
    m = read_measurements(tmp_path).fit[0]
    assert (m.rate_hz, m.signals) == (30.0, ROBOT.action_names)
    assert m.time_error_s == pytest.approx(1 / 30, rel=1e-6)
    # Row k of the file's action is the command of frame k + 1: in force at row k is the one before.
    time_s = 1 / 30 + m.time_s
    # piper_ros's factor makes angles 0.053 % short
    np.testing.assert_allclose(
        m.target, truth.story.at("command", time_s), rtol=6e-4, atol=1e-4
    )
    np.testing.assert_allclose(
        m.measured, truth.story.at("state", time_s), rtol=6e-4, atol=1e-4
    )
    np.testing.assert_allclose(m.effort, truth.story.at("effort", time_s), atol=1e-4)
    assert np.isfinite(m.velocity).all()
