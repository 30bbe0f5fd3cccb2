"""The faster reader gives what LeRobot's gives; it is installed once, for one version, and can be left out."""

import json
import logging
import pickle
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from by_lerobot import write_with_lerobot
from lerobot.datasets import dataset_reader, factory, lerobot_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
from lerobot.scripts import lerobot_edit_dataset
from tiny_dataset import IS_SIM, TOUCH, WINDOWS, assert_same, write_tiny

from taccorl.data.dataset import Dataset
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.training import reading
from taccorl.training.reading import FastReader, with_windows


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("tiny") / "dataset", rows=(14, 11, 12), sim_episodes=1, cameras=2)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Into LeRobot as it came, and out of it again."""
    monkeypatch.delenv("TACCORL_NO_PATCH", raising=False)
    monkeypatch.setattr(lerobot_dataset, "DatasetReader", dataset_reader.DatasetReader)
    monkeypatch.setattr(factory, "resolve_delta_timestamps", stock_resolve())
    monkeypatch.setattr(factory, "StreamingLeRobotDataset", StreamingLeRobotDataset)


def stock_resolve():
    """LeRobot's, also when a plugin of an earlier test has wrapped it."""
    resolve = factory.resolve_delta_timestamps
    return resolve.__closure__[0].cell_contents if resolve.__closure__ else resolve


def load(root: Path, reader: type, monkeypatch: pytest.MonkeyPatch, **settings) -> LeRobotDataset:
    monkeypatch.setattr(lerobot_dataset, "DatasetReader", reader)
    return LeRobotDataset("local/tiny", root=root, video_backend="pyav", **settings)


@pytest.mark.parametrize(
    ("episodes", "windows", "uint8"), [(None, None, False), (None, WINDOWS, True), ([0, 2], WINDOWS, False)]
)
def test_every_row_is_lerobots_to_the_bit_and_the_type(root, monkeypatch, episodes, windows, uint8):
    settings = {"episodes": episodes, "delta_timestamps": windows, "return_uint8": uint8}
    stock = load(root, dataset_reader.DatasetReader, monkeypatch, **settings)
    fast = load(root, FastReader, monkeypatch, **settings)
    assert fast.reader.columns(), "it would go LeRobot's way"
    assert len(fast) == len(stock) == (37 if episodes is None else 26)
    for row in (0, 5, 13, 14, 20, len(stock) - 1, -1):
        assert_same(fast[row], stock[row])


@pytest.mark.parametrize("dtype", ["float32", "int16"])
def test_features_of_several_dimensions_are_read_alike(tmp_path, monkeypatch, dtype):
    """As LeRobot's writer stores the touch of other robots: lists in lists."""
    shapes = {"observation.tactile.grid": (4, 3), "observation.tactile.pads": (2, 4, 3)}
    rng = np.random.default_rng(0)
    rows = [{key: (50 * rng.normal(size=shape)).astype(dtype) for key, shape in shapes.items()} for _ in range(11)]
    rows = [row | {"action": np.zeros(2, np.float32), "task": "x"} for row in rows]
    write_with_lerobot(tmp_path / "grids", [rows[:6], rows[6:]])
    for episodes in (None, [1]):
        windows = {key: [-2 / 30, 0.0] for key in shapes}
        settings: dict = {"episodes": episodes, "delta_timestamps": windows}
        stock, fast = (
            load(tmp_path / "grids", r, monkeypatch, **settings) for r in (dataset_reader.DatasetReader, FastReader)
        )
        assert fast.reader.columns(), "it would go LeRobot's way"
        for row in range(len(stock)):
            assert_same(fast[row], stock[row])
        stored = fast.reader.columns()["observation.tactile.pads"].stored()
        assert torch.equal(
            stored[0].to(fast[0]["observation.tactile.pads"].dtype), fast[0]["observation.tactile.pads"][1]
        )


def test_a_worker_reads_the_same_after_it_was_sent_the_dataset(root, monkeypatch):
    fast = load(root, FastReader, monkeypatch, delta_timestamps=WINDOWS)
    before = fast[20]
    sent = pickle.dumps(fast)
    assert len(sent) < 2e6  # not the columns themselves
    assert_same(pickle.loads(sent)[20], before)


def test_what_it_does_not_know_goes_lerobots_way(root, monkeypatch):
    windows_of_pictures = {"observation.images.front": [-1 / 30, 0.0]}
    fast = load(root, FastReader, monkeypatch, delta_timestamps=windows_of_pictures)
    stock = load(root, dataset_reader.DatasetReader, monkeypatch, delta_timestamps=windows_of_pictures)
    assert_same(fast[16], stock[16])
    for dataset in (fast, stock):
        dataset.reader.delta_indices = None
        dataset.reader.set_image_transforms(lambda picture: picture * 0.5)
    assert_same(fast[3], stock[3])
    fast.reader.hf_dataset = fast.reader.hf_dataset.shuffle(seed=0)
    fast.reader._columns = None
    assert fast.reader.columns() == {}
    assert fast[0]["index"] == fast.reader.hf_dataset[0]["index"] != 0


def test_the_share_of_simulated_rows_is_that_of_the_episodes_trained_on(root, monkeypatch):
    for episodes, share in ((None, 14 / 37), ([0, 2], 14 / 26), ([1, 2], 0.0)):
        dataset = load(root, FastReader, monkeypatch, episodes=episodes)
        assert float(dataset.meta.stats[IS_SIM]["mean"][0]) == pytest.approx(share, abs=1e-12)


def test_relative_actions_are_normalised_by_their_own_range_over_the_episodes_trained_on(root, monkeypatch):
    settings = {"chunk_size": 3, "n_action_steps": 3, "use_relative_actions": True, "tactile": False}
    config = TactilePI05Config(device="cpu", backbone="tiny", **settings)
    resolve = with_windows(stock_resolve())
    stock = load(root, dataset_reader.DatasetReader, monkeypatch)
    deltas = resolve(config, stock.meta)
    for episodes in (None, [0, 2]):
        meta = load(root, FastReader, monkeypatch, episodes=episodes, delta_timestamps=deltas).meta
        expected = []
        for k in episodes or range(3):
            rows = [row for row in stock.hf_dataset if row["episode_index"] == k]
            for t, row in enumerate(rows):
                for later in rows[t : t + 3]:
                    change = (later["action"] - row["observation.state"]).double().numpy()
                    change[[6, 13]] = later["action"][[6, 13]].double()  # openings stay absolute: LeRobot's default
                    expected.append(change)
        found, wanted = meta.stats["action"], np.array(expected)
        assert found["count"].tolist() == [len(expected)]
        for name, value in (
            ("min", wanted.min(0)), ("max", wanted.max(0)), ("mean", wanted.mean(0)), ("std", wanted.std(0)),
            ("q01", np.quantile(wanted, 0.01, axis=0)), ("q99", np.quantile(wanted, 0.99, axis=0)),
        ):  # fmt: skip
            np.testing.assert_allclose(found[name], value, atol=1e-6)
        assert set(found) == {*stock.meta.stats["action"], "step_mean", "step_std"}
        assert found["step_mean"].shape == found["step_std"].shape == (3, 14)
        now = np.array([
            np.where(np.isin(np.arange(14), (6, 13)), row["action"], row["action"] - row["observation.state"])
            for row in stock.hf_dataset
            if episodes is None or row["episode_index"] in episodes
        ])  # fmt: skip
        np.testing.assert_allclose(found["step_mean"][0], now.mean(0), atol=1e-6)
        np.testing.assert_allclose(found["step_std"][0], now.std(0), atol=1e-6)
    config.use_relative_actions = False
    meta = load(root, FastReader, monkeypatch, delta_timestamps=resolve(config, stock.meta)).meta
    np.testing.assert_array_equal(meta.stats["action"]["q01"], stock.meta.stats["action"]["q01"])


def test_only_touch_gets_a_window(root, monkeypatch):
    metadata = load(root, FastReader, monkeypatch).meta
    config = TactilePI05Config(device="cpu", backbone="tiny", tactile_history=3, chunk_size=2, n_action_steps=2)
    resolve = with_windows(stock_resolve())
    assert resolve(config, metadata) == {TOUCH: [-2 / 30, -1 / 30, 0.0], "action": [0.0, 1 / 30]}
    config.tactile_stride = 4
    assert resolve(config, metadata)[TOUCH] == [-8 / 30, -4 / 30, 0.0]
    config.tactile = False
    assert resolve(config, metadata) == {"action": [0.0, 1 / 30]}


def test_it_is_installed_once_and_for_the_version_it_was_compared_with(installed, monkeypatch, caplog):
    stock = factory.resolve_delta_timestamps
    assert reading.install() and reading.install()
    assert lerobot_dataset.DatasetReader is FastReader
    assert factory.resolve_delta_timestamps.__closure__[0].cell_contents is stock
    monkeypatch.setattr(lerobot_dataset, "DatasetReader", dataset_reader.DatasetReader)
    with caplog.at_level(logging.WARNING):
        monkeypatch.setattr(reading, "lerobot_version", "0.6.2")
        assert not reading.install()
    assert "LeRobot 0.6.2 reads datasets by itself" in caplog.text
    assert lerobot_dataset.DatasetReader is dataset_reader.DatasetReader


def test_it_can_be_left_out(installed, monkeypatch, caplog):
    monkeypatch.setenv("TACCORL_NO_PATCH", "1")
    with caplog.at_level(logging.WARNING):
        assert not reading.install()
    assert "TACCORL_NO_PATCH=1" in caplog.text and "--policy.tactile_history=1" in caplog.text
    assert lerobot_dataset.DatasetReader is dataset_reader.DatasetReader


@pytest.mark.parametrize("relative", [True, False])
def test_streaming_says_that_relative_actions_have_the_range_of_absolute_ones(
    root, installed, caplog, relative, tmp_path, monkeypatch
):
    reading.install()
    root = shutil.copytree(root, tmp_path / "a set")
    settings = {"chunk_size": 3, "n_action_steps": 3, "use_relative_actions": relative, "tactile": False}
    config = TactilePI05Config(device="cpu", backbone="tiny", **settings)
    stock = LeRobotDataset("local/tiny", root=root).meta
    with caplog.at_level(logging.WARNING):
        deltas = factory.resolve_delta_timestamps(config, stock)
        made = factory.StreamingLeRobotDataset("local/tiny", root=root, delta_timestamps=deltas)
    assert isinstance(made, StreamingLeRobotDataset)
    np.testing.assert_array_equal(made.meta.stats["action"]["q99"], stock.stats["action"]["q99"])  # of absolute actions
    commands = re.findall("`(lerobot-edit-dataset [^`]*)`", caplog.text)
    assert len(commands) == relative
    for command in commands:
        monkeypatch.setattr("sys.argv", shlex.split(command))
        lerobot_edit_dataset.main()
        episodes = [Dataset(root).values(k, ["observation.state", "action"]) for k in range(3)]
        windows = [
            e["action"][k : len(e["action"]) - 2 + k] - e["observation.state"][:-2] for e in episodes for k in range(3)
        ]
        stats = json.loads((root / "meta/stats.json").read_text())["action"]
        assert "gripper" not in stock.features["action"]["names"][0]
        assert stats["max"][0] == pytest.approx(max(w[:, 0].max() for w in windows), rel=1e-5)
        assert stats["min"][0] == pytest.approx(min(w[:, 0].min() for w in windows), rel=1e-5)
