"""Other people's LeRobot datasets: a columns file states their units, and the command of row k is in force from row k on."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from taccorl.alignment.measurements.dataset_rows import from_episode
from taccorl.alignment.measurements.folder import read_measurements
from taccorl.alignment.measurements.recorded import signal_names
from taccorl.alignment.measurements.tables import is_table, load_table_spec
from taccorl.cli import init_robot
from taccorl.data.cutting import open_episodes
from taccorl.data.draft import draft_specs
from taccorl.data.inspection import inspect_source
from taccorl.data.recording import find_sources
from taccorl.errors import RecordingError, SpecError, TaccorlError

FPS, ROWS = 30, 60
NAMES = ["lift.pos", "grip.pos", "lamp"]
ARM = """
<mujoco model="arm"><compiler angle="radian"/><worldbody><body><joint name="lift" range="-1.5 1.5"/>
<inertial pos="0.1 0 0" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/><body pos="0.2 0 0">
<joint name="grip" range="-0.2 1.8" axis="0 0 1"/><inertial pos="0.05 0 0" mass="0.05" diaginertia="1e-5 1e-5 1e-5"/>
</body></body></worldbody></mujoco>
"""


def numbers(episode: int) -> tuple[np.ndarray, np.ndarray]:
    """(state, action), each (T, 3): degrees, a range of 0 … 100, and a lamp that is no joint."""
    k = np.arange(ROWS)
    action = np.stack(
        [30 * np.sin(0.2 * k) + episode, 50 + 40 * np.sin(0.1 * k), k % 2], axis=1
    )
    return 0.9 * action - 1.0, action


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Two episodes of a LeRobot v3 dataset with nothing of taccorl in it."""
    root = tmp_path / "set"
    for folder in ("data/chunk-000", "meta/episodes/chunk-000"):
        (root / folder).mkdir(parents=True)
    vector = {"dtype": "float32", "shape": [3], "names": NAMES}
    single = {
        key: {"dtype": "int64", "shape": [1], "names": None}
        for key in ("episode_index", "frame_index", "index")
    }
    features = {"observation.state": vector, "action": vector, **single}
    features |= {
        "task_index": single["index"],
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    info = {
        "codebase_version": "v3.0",
        "robot_type": "so101_follower",
        "fps": FPS,
        "total_episodes": 2,
    }
    info |= {
        "total_frames": 2 * ROWS,
        "total_tasks": 1,
        "features": features,
        "splits": {"train": "0:2"},
    }
    info |= {
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
    }
    (root / "meta/info.json").write_text(json.dumps(info))
    tasks = pa.table({"task_index": [0], "task": ["lift it"]})
    pq.write_table(tasks, root / "meta/tasks.parquet")
    first = [0, ROWS]
    table = {
        "episode_index": [0, 1],
        "length": [ROWS, ROWS],
        "dataset_from_index": first,
        "dataset_to_index": [ROWS, 2 * ROWS],
    }
    table |= {
        "data/chunk_index": [0, 0],
        "data/file_index": [0, 0],
        "tasks": [["lift it"]] * 2,
    }
    pq.write_table(pa.table(table), root / "meta/episodes/chunk-000/file-000.parquet")
    rows, lists = [numbers(k) for k in range(2)], pa.list_(pa.float32(), 3)
    frame = np.tile(np.arange(ROWS), 2)
    columns = {
        "observation.state": pa.array([list(r) for s, _ in rows for r in s], lists),
        "action": pa.array([list(r) for _, a in rows for r in a], lists),
        "timestamp": pa.array((frame / FPS).astype(np.float32)),
        "frame_index": frame,
        "episode_index": np.repeat([0, 1], ROWS),
        "index": np.arange(2 * ROWS),
        "task_index": np.zeros(2 * ROWS, int),
    }
    pq.write_table(pa.table(columns), root / "data/chunk-000/file-000.parquet")
    return root


def drafted(dataset: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """The drafted columns file: degrees for lift, and the numbers that the draft gives for 0 … 100 for grip."""
    model = dataset.parent / "arm.xml"
    model.write_text(ARM)
    assert (
        init_robot.main(
            [str(model), f"--out={dataset.parent / 'arm.yaml'}", f"--dataset={dataset}"]
        )
        == 0
    )
    assert "lamp" in capsys.readouterr().out  # an element that is no joint is named
    path = dataset.parent / "columns.yaml"
    with pytest.raises(
        SpecError, match=r"columns\.yaml:\d+: signals → lift → q → unit: 'TODO'"
    ):
        load_table_spec(path)
    lines = path.read_text().splitlines()
    given = next(
        line.split("0 … 100: ")[1]
        for line in reversed(lines)
        if "of a range 0 … 100" in line
    )
    units = {"lift": "unit: deg", "grip": given}
    path.write_text(
        "\n".join(
            line.replace("unit: TODO", units["lift" if "lift" in line else "grip"])
            for line in lines
        )
    )
    return path


def test_a_columns_file_states_units_zeros_and_ranges(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = drafted(dataset, capsys)
    one, two = read_measurements(dataset, columns=columns).all
    assert (one.name, two.name, one.signals, one.instruction) == (
        "set/episode_0",
        "set/episode_1",
        ("lift", "grip"),
        "lift it",
    )
    state, action = numbers(1)
    assert two.num_rows == ROWS and two.rate_hz == FPS
    np.testing.assert_allclose(
        two.target[:, 0], np.radians(action[:, 0]), atol=1e-6
    )  # row k: the action of row k
    np.testing.assert_allclose(two.measured[:, 0], np.radians(state[:, 0]), atol=1e-6)
    # 0 is -0.2 rad, 100 is 1.8 rad
    np.testing.assert_allclose(
        two.target[:, 1], -0.2 + 2.0 * action[:, 1] / 100, atol=1e-5
    )
    assert is_table(two)  # what is wrong is corrected in the columns file


def test_units_are_asked_for_and_absent_columns_named(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(TaccorlError, match=r"--columns.*init-robot MODEL --dataset"):
        read_measurements(dataset)
    columns = drafted(dataset, capsys)
    columns.write_text(columns.read_text().replace("action.grip.pos", "action.grip"))
    with pytest.raises(
        RecordingError, match=r"set: no column 'action\.grip'.*action\.grip\.pos"
    ):
        read_measurements(dataset, columns=columns)
    with pytest.raises(RecordingError, match="give the folder"):
        signal = "{q: {column: action, unit: rad}, tau: {column: index, unit: Nm}}"
        columns.write_text(
            f"time: {{column: timestamp, unit: s}}\nsignals: {{lift: {signal}}}\n"
        )
        read_measurements(dataset / "data/chunk-000/file-000.parquet", columns=columns)


def test_a_drafted_ingest_and_a_columns_file_pair_action_and_state_alike(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """LeRobot's record loop sends the action of row k right after the observation of row k."""
    direct = read_measurements(dataset, columns=drafted(dataset, capsys)).all[0]
    name, source = find_sources(dataset)[0]
    folder = dataset.parent
    for path, text in (
        draft_specs(inspect_source(name, source), folder / "draft.yaml")
        .files(folder / "draft.yaml")
        .items()
    ):
        lines = [
            line.split("TODO")[0]
            + ("rad" if "unit: " in line else "[-100, 100]") * ("TODO" in line)
            for line in text.splitlines()
        ]
        path.write_text(
            "\n".join(lines).replace(
                "lead_frames: 1", f"lead_frames: 1, scale: [{np.pi / 180}, 1, 1]"
            )
        )
    draft = folder / "draft.yaml"
    draft.write_text(
        draft.read_text().replace(
            "max_age_s: 0.08}", f"max_age_s: 0.08, scale: [{np.pi / 180}, 1, 1]}}"
        )
    )
    with open_episodes(source.path, draft) as episodes:
        episode = next(iter(episodes))
        assert episode.spec.action_time == "this_row"
        m = from_episode(episode, signal_names(episode.spec), ("rad",) * 3, dataset, 0)
    # not shifted
    np.testing.assert_allclose(
        episode.arrays["action"][:, 1], numbers(0)[1][: episode.num_rows, 1], atol=1e-4
    )
    rows = m.num_rows
    assert rows >= ROWS - 1
    np.testing.assert_allclose(m.target[:, 0], direct.target[:rows, 0], atol=1e-6)
    np.testing.assert_allclose(m.measured[:, 0], direct.measured[:rows, 0], atol=1e-6)


def test_a_draft_of_an_so101_states_units_as_lerobot_records_them(
    dataset: Path,
) -> None:
    info, model = dataset / "meta" / "info.json", dataset.parent / "arm.xml"
    info.write_text(info.read_text().replace("grip.pos", "gripper.pos"))
    model.write_text(ARM.replace('"grip"', '"gripper"'))
    out = dataset.parent / "arm.yaml"
    words = [str(model), f"--out={out}", f"--dataset={dataset}", "--servo=so101"]
    assert init_robot.main(words) == 0
    columns = dataset.parent / "columns.yaml"
    assert columns.read_text().count("# a guess: ") == 4
    two = read_measurements(dataset, columns=columns).all[1]
    state, _ = numbers(1)
    np.testing.assert_allclose(two.measured[:, 0], np.radians(state[:, 0]), atol=1e-6)
    # 0 is -0.2 rad, 100 is 1.8 rad
    np.testing.assert_allclose(
        two.measured[:, 1], -0.2 + 2.0 * state[:, 1] / 100, atol=1e-5
    )
