"""Made-up episodes through LeRobot's own writer: every row keeps its own picture, or somebody hears of it."""

import dataclasses
import json
import logging
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited import SIZE

from taccorl.data import lerobot_format
from taccorl.data.dataset import Dataset
from taccorl.data.episode import Episode, Pictures
from taccorl.data.exact_statistics import QUANTILES, exact_stats
from taccorl.data.lerobot_format import (
    lerobot_features,
    merge,
    quiet_lerobot,
    write_episodes,
)
from taccorl.data.spec import DatasetSpec, data_specs_folder, load_dataset_spec
from taccorl.errors import DatasetError, RecordingError
from tests.recordings.pictures import draw_frame_id, read_frame_id

CAMERA, TOUCH = "observation.images.front", "observation.tactile"
SPEC = f"""
spec_version: 1
name: small
robot_type: one_finger
fps: 30
action_time: next_row
video_codec: h264
features:
  observation.state: {{dtype: float32, shape: [2], names: [a, b], unit: [rad, m], frame: joint, rate_hz: 30, range: [-9, 9]}}
  action: {{dtype: float32, shape: [2], names: [a, b], unit: [rad, m], frame: joint, rate_hz: 30, range: [-9, 9]}}
  observation.images.front:
    {{dtype: video, shape: [{SIZE[0]}, {SIZE[1]}, 3], unit: rgb8, frame: cam, rate_hz: 30, range: [0, 255]}}
  observation.tactile: {{dtype: int16, shape: [384], unit: adc_count, frame: pad, rate_hz: 100, range: [-255, 255],
    sensor: {data_specs_folder()}/sensors/flexitac_v2.yaml, pads: [tip]}}
"""


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> DatasetSpec:
    path = tmp_path_factory.mktemp("spec") / "small.yaml"
    path.write_text(SPEC)
    return load_dataset_spec(path)


def made_up(
    spec: DatasetSpec,
    num_rows: int = 40,
    first_id: int = 0,
    fail_at: int = -1,
    seed: int = 0,
) -> Episode:
    """Row k shows picture first_id + k, state (first_id + k, k / 7) and random touch."""
    rng = np.random.default_rng(seed)
    k = np.arange(num_rows)

    def pictures() -> Iterator[Pictures]:
        for row in range(num_rows):
            if row == fail_at:
                raise RecordingError("picture 7 is broken")
            picture = np.full((*SIZE, 3), 60 + row % 100, np.uint8)
            draw_frame_id(picture, first_id + row)
            yield {CAMERA: picture}

    numbers = np.stack([first_id + k, k / 7], axis=1).astype(np.float32)
    touch = rng.integers(-20, 235, (num_rows, 384)).astype(np.int16)
    touch[:, 5], touch[0, 6] = 3, -255  # a constant taxel and an outlier
    arrays = {"observation.state": numbers, "action": -numbers, TOUCH: touch}
    return Episode("made up", spec, 0, arrays, pictures, (CAMERA,), "touch it")


def row_ids(root: Path, index: int = 0) -> list[int]:
    """Frame ids that the rows of an episode show, found by time as a reader does."""
    return [read_frame_id(frame) for frame in Dataset(root).frames(index, CAMERA)]


def encoder_threads() -> list[threading.Thread]:
    return [t for t in threading.enumerate() if "EncoderThread" in type(t).__name__]


@pytest.fixture
def slow_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's encoder takes 0.15 s a frame; LeRobot waits 0.1 s for room in its queue, then drops the frame."""
    import queue

    from lerobot.datasets import video_utils

    class SlowQueue(queue.Queue):
        def get(self, *args: Any, **kwargs: Any) -> Any:
            time.sleep(0.15)
            return super().get(*args, **kwargs)

    class Queues:  # video_utils.queue, but for its Queue
        Queue, Full, Empty = SlowQueue, queue.Full, queue.Empty

    monkeypatch.setattr(video_utils, "queue", Queues)


# ---- every row its own picture ----


def test_rows_keep_their_pictures_and_numbers(spec, tmp_path):
    episodes = [made_up(spec, 33), made_up(spec, 35, first_id=500, seed=1)]
    told: list[int] = []
    write_episodes(episodes, tmp_path / "ds", progress=told.append)
    dataset = Dataset(tmp_path / "ds")
    assert dataset.num_episodes == 2
    for index, episode in enumerate(episodes):
        assert row_ids(dataset.root, index) == [
            round(x) for x in episode.arrays["observation.state"][:, 0]
        ]
        for key, values in episode.arrays.items():
            np.testing.assert_array_equal(dataset.episode(index).arrays[key], values)
        assert dataset.episode(index).instruction == "touch it"
    assert told == list(range(1, 69)) and encoder_threads() == []


@pytest.mark.slow
def test_a_slow_encoder_loses_no_frame(spec, tmp_path, slow_encoder):
    write_episodes([made_up(spec, 20)], tmp_path / "ds")
    assert row_ids(tmp_path / "ds") == list(range(20))


def test_dropped_frames_are_found_and_the_dataset_is_written_again(
    spec, tmp_path, slow_encoder, monkeypatch, caplog
):
    monkeypatch.setattr(
        lerobot_format, "_wait_for_room", lambda dataset: None
    )  # no back-pressure
    attempts: list[tuple[bool, list[str]]] = []
    original = lerobot_format._write

    def watched(episodes: Any, root: Path, progress: Any, streaming: bool) -> None:
        original(episodes, root, progress, streaming)
        attempts.append((streaming, Dataset(root).video_problems()))

    monkeypatch.setattr(lerobot_format, "_write", watched)
    with caplog.at_level(logging.WARNING):
        write_episodes([made_up(spec, 40)], tmp_path / "ds")
    (first_streams, first_problems), (second_streams, second_problems) = attempts
    assert (first_streams, second_streams) == (True, False)
    assert "frames for 40 rows" in first_problems[0], "the planted fault was felt"
    assert second_problems == [] and "writing again without streaming" in caplog.text
    assert row_ids(tmp_path / "ds") == list(range(40))
    assert not list((tmp_path / "ds").rglob("*.png"))


def test_a_dataset_that_stays_wrong_is_an_error(spec, tmp_path, monkeypatch):
    monkeypatch.setattr(
        Dataset, "video_problems", lambda self: ["front: 3 frames for 9 rows"]
    )
    with pytest.raises(DatasetError, match="3 frames for 9 rows"):
        write_episodes([made_up(spec, 9)], tmp_path / "ds", streaming=False)


def test_an_episode_without_pictures_is_written(spec, tmp_path):
    blind = dataclasses.replace(made_up(spec, 9), picture_keys=())
    write_episodes([blind], tmp_path / "ds")
    np.testing.assert_array_equal(
        Dataset(tmp_path / "ds").episode(0).arrays[TOUCH], blind.arrays[TOUCH]
    )


# ---- what goes wrong ----


@pytest.mark.parametrize(("fail_at", "streaming"), [(0, True), (25, True), (25, False)])
def test_an_error_in_the_middle_leaves_nothing_behind(
    spec, tmp_path, fail_at, streaming
):
    episodes = [made_up(spec, 10), made_up(spec, 40, fail_at=fail_at)]
    with pytest.raises(RecordingError, match="picture 7 is broken"):
        write_episodes(episodes, tmp_path / "ds", streaming=streaming)
    assert list(tmp_path.iterdir()) == []
    assert encoder_threads() == []


def test_what_exists_is_never_touched(spec, tmp_path):
    (tmp_path / "ds").mkdir()
    (tmp_path / "ds/mine.txt").write_text("keep")
    with pytest.raises(DatasetError, match="exists already"):
        write_episodes([made_up(spec)], tmp_path / "ds")
    assert (tmp_path / "ds/mine.txt").read_text() == "keep"


def test_statistics_are_lerobots_own_again_afterwards(spec, tmp_path):
    from lerobot.datasets import dataset_writer

    before, level = dataset_writer.compute_episode_stats, logging.getLogger().level
    write_episodes([made_up(spec, 5)], tmp_path / "ds")
    assert dataset_writer.compute_episode_stats is before
    assert logging.getLogger().level == level


# ---- statistics ----


def test_exact_statistics_are_lerobots_within_one_histogram_bin():
    from lerobot.datasets.compute_stats import compute_episode_stats

    rng = np.random.default_rng(3)
    values = rng.integers(-255, 256, (200, 300)).astype(np.int16)
    values[:, 7] = 4
    values[:, 8] = np.arange(200)
    ours = exact_stats(values)
    with quiet_lerobot():
        theirs = compute_episode_stats(
            {"x": values}, {"x": {"dtype": "int16", "shape": (300,)}}
        )["x"]
    assert set(ours) == set(theirs)
    for name in ours:
        assert ours[name].shape == theirs[name].shape, name
    for name in ("min", "max", "mean", "std", "count"):
        np.testing.assert_allclose(
            ours[name], theirs[name], rtol=1e-6, atol=1e-6, err_msg=name
        )
    bins = (values.max(axis=0) - values.min(axis=0)) / 5000  # LeRobot's histogram
    for q in QUANTILES:
        name = f"q{round(100 * q):02d}"
        assert (np.abs(ours[name] - theirs[name]) <= bins + 1e-4).all(), (
            name
        )  # its edges are float32
    # by hand: of 0 … 199, half do not exceed 99 (the 100th), and 1 % (two of them) do not exceed 1
    assert (ours["q50"][8], ours["q01"][8], ours["q99"][8]) == (99, 1, 197)
    assert (ours["std"][7], ours["q99"][7]) == (0.0, 4.0)


def test_written_statistics_of_pictures_are_lerobots_but_for_its_bins(spec, tmp_path):
    from lerobot.datasets import compute_stats
    from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata

    theirs = compute_stats.RunningQuantileStats
    episode = made_up(spec, 5)
    write_episodes([episode], tmp_path / "ds")
    assert compute_stats.RunningQuantileStats is theirs
    written = LeRobotDatasetMetadata("local/ds", root=tmp_path / "ds").stats
    assert written is not None
    assert episode.picture_keys
    for key in episode.picture_keys:
        lerobots = theirs()
        for shown in episode.pictures():
            lerobots.update(shown[key].reshape(-1, 3))
        for name, expected in lerobots.get_statistics().items():
            ours, scale = written[key][name].ravel(), 1 if name == "count" else 255
            np.testing.assert_allclose(
                ours * scale, expected, atol=0.06, rtol=2e-4, err_msg=f"{key} {name}"
            )


# ---- the features' own words ----


def test_features_say_what_their_numbers_mean(spec, tmp_path):
    write_episodes([made_up(spec, 5)], tmp_path / "ds")
    features = Dataset(tmp_path / "ds").info["features"]
    assert features["observation.state"]["unit"] == ["rad", "m"]
    assert features["observation.state"]["range"] == [-9, 9]
    assert features["observation.state"]["frame"] == "joint"
    assert features[TOUCH]["tactile"] == {
        "sensor": "flexitac_v2",
        "layout": [1, 1, 32, 12],
        "layout_names": ["history", "pad", "row", "column"],
        "pads": ["tip"],
        "signal": "counts above baseline",
        "scheme": "fixed_scale",
        "gain_per_count": 0.0133333333,
    }
    assert list(lerobot_features(spec, [CAMERA])) == [CAMERA]


# ---- merging ----


@pytest.fixture(scope="module")
def shards(spec: DatasetSpec, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("shards")
    write_episodes(
        [made_up(spec, 31), made_up(spec, 32, first_id=100, seed=1)], folder / "a"
    )
    write_episodes([made_up(spec, 33, first_id=200, seed=2)], folder / "b")
    write_episodes([made_up(spec, 34, first_id=300, seed=3)], folder / "c")
    return [folder / name for name in "abc"]


def test_datasets_with_other_features_do_not_merge(spec, shards, tmp_path):
    three = dataclasses.replace(
        spec.features["action"], shape=(3,), names=("a", "b", "c"), unit="rad"
    )
    wider = dataclasses.replace(spec, features={**spec.features, "action": three})
    episode = made_up(spec, 9)
    arrays = {**episode.arrays, "action": np.zeros((9, 3), np.float32)}
    write_episodes(
        [dataclasses.replace(episode, spec=wider, arrays=arrays)], tmp_path / "wide"
    )
    with pytest.raises(DatasetError, match="do not merge"):
        merge([shards[1], tmp_path / "wide"], tmp_path / "all")


def test_a_merge_that_loses_frames_is_an_error(shards, tmp_path, monkeypatch):
    monkeypatch.setattr(
        Dataset, "video_problems", lambda self: ["front: one is missing"]
    )
    with pytest.raises(
        DatasetError, match="after merging, first: front: one is missing"
    ):
        merge(shards[1:], tmp_path / "all")


@pytest.mark.parametrize("name", ["ünï 😀 #1", "a%d {y}", "a&b;$c", ".hidden"])
def test_folders_with_odd_names_merge(shards, tmp_path, name):
    folder = tmp_path / name
    for shard in shards[1:]:
        shutil.copytree(shard, folder / shard.name)
    merge([folder / "b", folder / "c"], folder / "all")
    assert row_ids(folder / "all", 1) == list(range(300, 334))


@pytest.mark.parametrize("name", ["Anna's data", "run [3]", "a*", "what?"])
def test_folders_that_lerobot_would_misread_are_refused(spec, shards, tmp_path, name):
    with pytest.raises(DatasetError, match="LeRobot cannot work in a folder with"):
        write_episodes([made_up(spec, 5)], tmp_path / name)
    with pytest.raises(DatasetError, match="LeRobot cannot work in a folder with"):
        merge(shards[1:], tmp_path / name / "all")
    assert list(tmp_path.iterdir()) == []


SAME_DATASET = """
import dataclasses, sys
from pathlib import Path
from test_lerobot_format import SPEC, blind
from taccorl.data.lerobot_format import merge, write_episodes
from taccorl.data.spec import load_dataset_spec

folder = Path(sys.argv[1])
(folder / "small.yaml").write_text(SPEC)
spec = load_dataset_spec(folder / "small.yaml")
write_episodes([blind(spec, 0), blind(spec, 1, "or that")], folder / "a")
write_episodes([blind(spec, 2, "or that")], folder / "b")
merge([folder / "a", folder / "b"], folder / "all")
"""


def blind(spec: DatasetSpec, seed: int, instruction: str = "touch it") -> Episode:
    """Nine rows without pictures, with four features so large that their statistics are ours."""
    wide = {
        f"observation.{name}": dataclasses.replace(
            spec.features["action"], shape=(300,), names=(), unit="rad"
        )
        for name in ("one", "two", "three")
    }
    episode = made_up(spec, 9, seed=seed)
    rows = np.random.default_rng(seed).normal(size=(9, 300)).astype(np.float32)
    return dataclasses.replace(
        episode,
        spec=dataclasses.replace(spec, features={**spec.features, **wide}),
        arrays={**episode.arrays, **dict.fromkeys(wide, rows)},
        picture_keys=(),
        instruction=instruction,
    )


@pytest.mark.slow
def test_every_process_writes_and_merges_the_same_bytes(tmp_path):
    folders = [
        tmp_path / hash_seed for hash_seed in "12"
    ]  # of the order in which Python's sets of strings go
    processes = []
    for folder in folders:
        folder.mkdir()
        own = {
            "PYTHONHASHSEED": folder.name,
            "TACCORL_PROGRAM": "1",
            "PYTHONPATH": f"{Path(__file__).parents[2]}",
        }
        words = [sys.executable, "-c", SAME_DATASET, str(folder)]
        processes.append(
            subprocess.Popen(words, cwd=Path(__file__).parent, env=os.environ | own)
        )
    assert [process.wait(timeout=120) for process in processes] == [0, 0]
    one, two = (
        {p.relative_to(f): p.read_bytes() for p in f.rglob("*") if p.is_file()}
        for f in folders
    )
    assert [str(name) for name in one if one[name] != two.get(name)] == []
    assert set(one) == set(two)
    stats = json.loads((folders[0] / "all/meta/stats.json").read_text())
    features = json.loads((folders[0] / "all/meta/info.json").read_text())["features"]
    assert [
        key
        for key in stats
        if key in ("action", TOUCH, "observation.one", "observation.state")
    ] == [
        key
        for key in features
        if key in ("action", TOUCH, "observation.one", "observation.state")
    ]


def test_an_episode_of_one_row_is_written(spec, tmp_path):
    write_episodes([made_up(spec, 1)], tmp_path / "ds")
    assert row_ids(tmp_path / "ds") == [0]


@pytest.mark.slow
def test_data_files_are_those_of_lerobots_writer_left_alone(
    spec, tmp_path, monkeypatch
):
    import contextlib

    import pyarrow.parquet as pq

    episodes = [made_up(spec, 300), made_up(spec, 41, 300, seed=1)]
    write_episodes(episodes, tmp_path / "ours")
    monkeypatch.setattr(
        lerobot_format,
        "_large_features_in_blocks",
        lambda writer: contextlib.nullcontext(),
    )
    write_episodes(episodes, tmp_path / "theirs")
    ours, theirs = (
        pq.read_table(next((tmp_path / name / "data").rglob("*.parquet")))
        for name in ("ours", "theirs")
    )
    assert ours.schema.equals(theirs.schema)
    assert ours.equals(theirs)
    said = [
        json.loads(table.schema.metadata[b"huggingface"])["info"]
        for table in (ours, theirs)
    ]
    assert said[0] == said[1]
    assert (tmp_path / "ours/meta/info.json").read_text() == (
        tmp_path / "theirs/meta/info.json"
    ).read_text()
