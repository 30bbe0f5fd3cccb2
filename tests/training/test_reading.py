"""``FastReader`` returns the rows of LeRobot's reader, and can be switched off; datasets that do not fit a policy are refused."""

import dataclasses
import json
import logging
import pickle
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from by_lerobot import write_with_lerobot
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import dataset_reader, factory, lerobot_dataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.processor import RelativeActionsProcessorStep
from lerobot.scripts import lerobot_edit_dataset
from tiny_dataset import (
    CHANGED,
    IS_SIM,
    TOUCH,
    WINDOWS,
    assert_same,
    tiny_episode,
    tiny_spec,
    write_tiny,
)

from taccorl.data.dataset import Dataset
from taccorl.data.lerobot_format import write_episodes
from taccorl.data.spec import DatasetSpec
from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.training import reading
from taccorl.training.cotrain import merge_domains
from taccorl.training.reading import FastReader, install, with_windows
from taccorl.training.video_backend import default_video_backend


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(
        tmp_path_factory.mktemp("tiny") / "dataset",
        rows=(14, 11, 12),
        sim_episodes=1,
        cameras=2,
    )


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


def load(
    root: Path, reader: type, monkeypatch: pytest.MonkeyPatch, **settings
) -> LeRobotDataset:
    monkeypatch.setattr(lerobot_dataset, "DatasetReader", reader)
    return LeRobotDataset("local/tiny", root=root, video_backend="pyav", **settings)


@pytest.mark.parametrize(
    ("episodes", "windows", "uint8"),
    [(None, None, False), (None, WINDOWS, True), ([0, 2], WINDOWS, False)],
)
def test_every_row_is_lerobots_to_the_bit_and_the_type(
    root, monkeypatch, episodes, windows, uint8
):
    settings = {
        "episodes": episodes,
        "delta_timestamps": windows,
        "return_uint8": uint8,
    }
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
    rows = [
        {
            key: (50 * rng.normal(size=shape)).astype(dtype)
            for key, shape in shapes.items()
        }
        for _ in range(11)
    ]
    rows = [row | {"action": np.zeros(2, np.float32), "task": "x"} for row in rows]
    write_with_lerobot(tmp_path / "grids", [rows[:6], rows[6:]])
    for episodes in (None, [1]):
        windows = {key: [-2 / 30, 0.0] for key in shapes}
        settings: dict = {"episodes": episodes, "delta_timestamps": windows}
        stock, fast = (
            load(tmp_path / "grids", r, monkeypatch, **settings)
            for r in (dataset_reader.DatasetReader, FastReader)
        )
        assert fast.reader.columns(), "it would go LeRobot's way"
        for row in range(len(stock)):
            assert_same(fast[row], stock[row])
        stored = fast.reader.columns()["observation.tactile.pads"].stored()
        assert torch.equal(
            stored[0].to(fast[0]["observation.tactile.pads"].dtype),
            fast[0]["observation.tactile.pads"][1],
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
    stock = load(
        root,
        dataset_reader.DatasetReader,
        monkeypatch,
        delta_timestamps=windows_of_pictures,
    )
    assert_same(fast[16], stock[16])
    for dataset in (fast, stock):
        dataset.reader.delta_indices = None
        dataset.reader.set_image_transforms(lambda picture: picture * 0.5)
    assert_same(fast[3], stock[3])
    fast.reader.hf_dataset = fast.reader.hf_dataset.shuffle(seed=0)
    fast.reader._columns = None
    assert (
        fast.reader.columns() == {}
        and fast[0]["index"] == fast.reader.hf_dataset[0]["index"] != 0
    )


def test_the_share_of_simulated_rows_is_that_of_the_episodes_trained_on(
    root, monkeypatch
):
    for episodes, share in ((None, 14 / 37), ([0, 2], 14 / 26), ([1, 2], 0.0)):
        dataset = load(root, FastReader, monkeypatch, episodes=episodes)
        assert float(dataset.meta.stats[IS_SIM]["mean"][0]) == pytest.approx(
            share, abs=1e-12
        )


def test_relative_actions_are_normalised_by_their_own_range_over_the_episodes_trained_on(
    root, monkeypatch
):
    settings = {
        "chunk_size": 3,
        "n_action_steps": 3,
        "use_relative_actions": True,
        "tactile": False,
    }
    config = TactilePI05Config(device="cpu", backbone="tiny", **settings)
    resolve = with_windows(stock_resolve())
    stock = load(root, dataset_reader.DatasetReader, monkeypatch)
    deltas = resolve(config, stock.meta)
    for episodes in (None, [0, 2]):
        meta = load(
            root, FastReader, monkeypatch, episodes=episodes, delta_timestamps=deltas
        ).meta
        expected = []
        for k in episodes or range(3):
            rows = [row for row in stock.hf_dataset if row["episode_index"] == k]
            for t, row in enumerate(rows):
                for later in rows[t : t + 3]:
                    change = (
                        (later["action"] - row["observation.state"]).double().numpy()
                    )
                    change[[6, 13]] = later["action"][
                        [6, 13]
                    ].double()  # openings stay absolute: LeRobot's default
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
    meta = load(
        root, FastReader, monkeypatch, delta_timestamps=resolve(config, stock.meta)
    ).meta
    np.testing.assert_array_equal(
        meta.stats["action"]["q01"], stock.meta.stats["action"]["q01"]
    )


def test_actions_with_grouped_names_are_all_relative_as_lerobot_has_it(
    root, monkeypatch, caplog
):
    """``{"motors": [...]}``: LeRobot's list of the names is ["motors"]."""
    config = TactilePI05Config(
        device="cpu", backbone="tiny", use_relative_actions=True, tactile=False
    )
    meta = load(root, dataset_reader.DatasetReader, monkeypatch).meta
    names = meta.features["action"]["names"]
    with caplog.at_level(logging.WARNING):
        kept = with_windows(stock_resolve())(config, meta).relative_actions
    assert kept == [k not in (6, 13) for k in range(14)] and not caplog.records
    meta.features["action"]["names"] = {"motors": names}
    with caplog.at_level(logging.WARNING):
        deltas = with_windows(stock_resolve())(config, meta)
    step = RelativeActionsProcessorStep(
        enabled=True,
        exclude_joints=config.relative_exclude_joints,
        action_names=list(meta.features["action"]["names"]),
    )
    assert deltas.relative_actions == step._build_mask(14) == [True] * 14
    assert "motors" in caplog.text and "gripper" in caplog.text
    found = load(root, FastReader, monkeypatch, delta_timestamps=deltas).meta.stats
    assert found["action"]["q01"].shape == (14,)


def test_only_touch_gets_a_window(root, monkeypatch):
    metadata = load(root, FastReader, monkeypatch).meta
    config = TactilePI05Config(
        device="cpu", backbone="tiny", tactile_history=3, chunk_size=2, n_action_steps=2
    )
    resolve = with_windows(stock_resolve())
    assert resolve(config, metadata) == {
        TOUCH: [-2 / 30, -1 / 30, 0.0],
        "action": [0.0, 1 / 30],
    }
    config.tactile_stride = 4
    assert resolve(config, metadata)[TOUCH] == [-8 / 30, -4 / 30, 0.0]
    config.tactile = False
    assert resolve(config, metadata) == {"action": [0.0, 1 / 30]}


def test_it_is_installed_once_and_for_the_version_it_was_compared_with(
    installed, monkeypatch, caplog
):
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
    assert (
        "TACCORL_NO_PATCH=1" in caplog.text
        and "--policy.tactile_history=1" in caplog.text
    )
    assert lerobot_dataset.DatasetReader is dataset_reader.DatasetReader


@pytest.mark.parametrize("relative", [True, False])
def test_streaming_says_that_relative_actions_have_the_range_of_absolute_ones(
    root, installed, caplog, relative, tmp_path, monkeypatch
):
    reading.install()
    root = shutil.copytree(root, tmp_path / "a set")
    settings = {
        "chunk_size": 3,
        "n_action_steps": 3,
        "use_relative_actions": relative,
        "tactile": False,
    }
    config = TactilePI05Config(device="cpu", backbone="tiny", **settings)
    stock = LeRobotDataset("local/tiny", root=root).meta
    with caplog.at_level(logging.WARNING):
        deltas = factory.resolve_delta_timestamps(config, stock)
        made = factory.StreamingLeRobotDataset(
            "local/tiny", root=root, delta_timestamps=deltas
        )
    assert isinstance(made, StreamingLeRobotDataset)
    np.testing.assert_array_equal(
        made.meta.stats["action"]["q99"], stock.stats["action"]["q99"]
    )  # of absolute actions
    commands = re.findall("`(lerobot-edit-dataset [^`]*)`", caplog.text)
    assert len(commands) == relative
    for command in commands:
        monkeypatch.setattr("sys.argv", shlex.split(command))
        lerobot_edit_dataset.main()
        episodes = [
            Dataset(root).values(k, ["observation.state", "action"]) for k in range(3)
        ]
        windows = [
            e["action"][k : len(e["action"]) - 2 + k] - e["observation.state"][:-2]
            for e in episodes
            for k in range(3)
        ]
        stats = json.loads((root / "meta/stats.json").read_text())["action"]
        assert "gripper" not in stock.features["action"]["names"][0]
        assert stats["max"][0] == pytest.approx(
            max(w[:, 0].max() for w in windows), rel=1e-5
        )
        assert stats["min"][0] == pytest.approx(
            min(w[:, 0].min() for w in windows), rel=1e-5
        )


NAMES = tiny_spec().features["action"].names
SWAPPED = (NAMES[1], NAMES[0], *NAMES[2:])
TINY: dict[str, Any] = {
    "device": "cpu",
    "backbone": "tiny",
    "image_resolution": (56, 56),
}


def of(root: Path) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata(f"local/{root.name}", root=root)


def policy_for(root: Path, **settings: Any) -> Any:
    """As ``lerobot-train --policy.type=tactile_pi05 --dataset.root=ROOT`` makes it."""
    return make_policy(TactilePI05Config(**TINY, **settings), ds_meta=of(root))


def read_fast(root: Path, **words: Any) -> LeRobotDataset:
    """The dataset at ``root``, read by LeRobot with the ``FastReader`` that taccorl.lerobot_plugin puts in its reader's place."""
    before, lerobot_dataset.DatasetReader = lerobot_dataset.DatasetReader, FastReader
    try:
        return LeRobotDataset(f"local/{root.name}", root=root, **words)
    finally:
        lerobot_dataset.DatasetReader = before


def write(root: Path, spec: DatasetSpec) -> Path:
    write_episodes([tiny_episode(spec, 14, 0)], root)
    return root


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Datasets that differ in one thing each, and a checkpoint trained on ``plain``."""
    folder, spec = tmp_path_factory.mktemp("bad_input"), tiny_spec()
    write_tiny(folder / "plain", rows=(14, 12))
    sensor = spec.sensors[TOUCH]
    write(
        folder / "other_gain",
        dataclasses.replace(
            spec, sensors={TOUCH: dataclasses.replace(sensor, gain_per_count=0.01)}
        ),
    )
    write(folder / "slow", dataclasses.replace(spec, fps=15))
    blind = {key: f for key, f in spec.features.items() if key != TOUCH}
    episode = tiny_episode(spec, 14, 0)
    arrays = {key: values for key, values in episode.arrays.items() if key != TOUCH}
    seen = dataclasses.replace(spec, features=blind, sensors={})
    write_episodes(
        [dataclasses.replace(episode, spec=seen, arrays=arrays)], folder / "blind"
    )
    write_tiny(folder / "short", rows=(14, 7))
    for name, keys in {
        "moved": ("action", "observation.state"),
        "moved_state": ("observation.state",),
    }.items():
        swapped = {
            key: dataclasses.replace(spec.features[key], names=SWAPPED) for key in keys
        }
        write(
            folder / name,
            dataclasses.replace(spec, features={**spec.features, **swapped}),
        )
    info = write(folder / "unnamed", spec) / "meta/info.json"
    told = json.loads(info.read_text())
    for key in ("action", "observation.state"):
        told["features"][key]["names"] = None
    info.write_text(json.dumps(told))
    blindfold = {key: f for key, f in spec.features.items() if f.dtype != "video"}
    write(folder / "no_camera", dataclasses.replace(spec, features=blindfold))
    write_tiny(folder / "sim", rows=(13,))
    merge_domains([], [folder / "sim"], folder / "only_sim")
    merge_domains([folder / "plain"], [], folder / "only_real")
    policy_for(folder / "plain").save_pretrained(folder / "checkpoint")
    return folder


@pytest.mark.parametrize(
    ("dataset", "settings", "said"),
    [
        ("blind", {}, r"local/blind .*has no observation\.tactile, .*--policy\.tactile=false.*taccorl ingest"),
        ("short", {}, r"local/short.*episode 1 has 7 rows, .*window of touch has 10.*--policy\.tactile_history"),
        ("only_sim", {}, r"gives real rows.*weight 0\.5,.*merge real data into.*--policy\.sim_weight=1"),
        ("only_real", {"sim_weight": 0.95}, r"gives simulated rows the weight 0\.95.*or --policy\.sim_weight=0"),
        ("plain", {"sim_weight": 0.95}, r"sim_weight=0\.95: dataset local/plain.*no observation\.is_sim.*taccorl merge --real=…"),
    ],
)  # fmt: skip
def test_what_a_training_cannot_be_begun_with(place, dataset, settings, said):
    with pytest.raises(TaccorlError, match=said):
        policy_for(place / dataset, **settings)


@pytest.mark.parametrize(
    ("dataset", "said"),
    [
        ("other_gain", r"local/other_gain.*gain_per_count: 0\.01 there, 0\.013\d+.*checkpoint\. Ingest"),
        ("slow", r"local/slow.*has 15 rows per second, but the checkpoint was trained with 30.*Ingest the recordings at 30"),
        ("blind", r"local/blind.*has no observation\.tactile"),
    ],
)  # fmt: skip
def test_what_a_checkpoint_cannot_be_trained_on_with(place, dataset, said):
    with pytest.raises(TaccorlError, match=said):
        goes_on(place / "checkpoint", place / dataset)


def goes_on(checkpoint: Path, dataset: Path, **settings: Any) -> Any:
    """As ``lerobot-train --policy.path=CHECKPOINT --dataset.root=DATASET`` makes the policy."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    for name, value in settings.items():
        setattr(config, name, value)
    return make_policy(config, ds_meta=of(dataset))


@pytest.fixture(scope="module")
def earlier_checkpoint(place: Path) -> Path:
    """As of a taccorl that knew the actions' names only."""
    root = Path(shutil.copytree(place / "checkpoint", place / "earlier_checkpoint"))
    config = json.loads((root / "config.json").read_text())
    assert config.pop("joint_names") == {
        "action": list(NAMES),
        "observation.state": list(NAMES),
    }
    (root / "config.json").write_text(json.dumps(config))
    (root / "manifest.json").unlink()
    return root


@pytest.mark.parametrize("checkpoint", ["checkpoint", "earlier_checkpoint"])
def test_joints_in_another_order_than_the_checkpoints_are_refused_with_both_orders(
    place, earlier_checkpoint, checkpoint
):
    with pytest.raises(TaccorlError) as error:
        goes_on(place / checkpoint, place / "moved")
    said = str(error.value)
    assert (
        ", ".join(NAMES) in said
        and ", ".join(SWAPPED) in said
        and "action" in said
        and "local/moved" in said
    )
    assert goes_on(place / checkpoint, place / "plain").config.joint_names[
        "observation.state"
    ] == list(NAMES)


def test_a_state_in_another_order_is_refused_too(place, earlier_checkpoint):
    with pytest.raises(
        TaccorlError, match=r"elements of observation\.state are in another order"
    ):
        goes_on(place / "checkpoint", place / "moved_state")
    assert goes_on(earlier_checkpoint, place / "moved_state").config.joint_names[
        "observation.state"
    ] == list(SWAPPED)


def test_a_dataset_without_names_is_warned_about_and_the_checkpoint_keeps_its_own(
    place, caplog
):
    policy = goes_on(place / "checkpoint", place / "unnamed")
    assert caplog.text.count("is not known") == 2
    assert policy.config.joint_names == {
        "action": list(NAMES),
        "observation.state": list(NAMES),
    }
    for key in ("joint_names", "action_feature_names"):
        assert getattr(policy_for(place / "unnamed").config, key) is None


def test_grouped_names_are_compared_one_by_one():
    config, meta = (
        TactilePI05Config(**TINY, tactile=False),
        of_names({"motors": list(NAMES)}),
    )
    config.action_feature_names = ["motors"]  # as LeRobot's make_policy sets it
    config.match_dataset(meta)
    assert config.joint_names == {"action": list(NAMES)}
    config.match_dataset(of_names(list(NAMES)))
    with pytest.raises(TaccorlError, match="in another order"):
        config.match_dataset(of_names({"motors": list(SWAPPED)}))
    earlier = TactilePI05Config(**TINY, tactile=False, action_feature_names=["motors"])
    earlier.match_dataset(meta)
    assert earlier.joint_names == {"action": list(NAMES)}


def of_names(names: Any) -> Any:
    return SimpleNamespace(
        repo_id="local/x", root="x", fps=30, features={"action": {"names": names}}
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dataset", "words", "said"),
    [
        ("moved", (), "the elements of action are in another order"),
        ("no_camera", (), "has no {camera}, with which the checkpoint was trained"),
        (
            "plain",
            ("--rename_map={{{camera}: observation.images.other}}",),
            "has no {camera}",
        ),
        ("plain", (), ""),
    ],
)
def test_lerobot_train_refuses_other_joints_and_missing_cameras(
    place, tmp_path, monkeypatch, dataset, words, said
):
    """The command itself, up to the first step of the training."""
    from lerobot.scripts import lerobot_train

    def stop(*_: Any, **__: Any) -> None:
        raise InterruptedError

    for module, names in CHANGED.items():
        for name in names:
            monkeypatch.setattr(
                module, name, getattr(module, name)
            )  # so that it is put back
    reading.install()
    camera = next(
        key for key in tiny_spec().features if key.startswith("observation.images.")
    )
    checkpoint = Path(shutil.copytree(place / "checkpoint", tmp_path / "checkpoint"))
    config = PreTrainedConfig.from_pretrained(checkpoint)
    for processor in make_pre_post_processors(
        config, dataset_stats=of(place / "plain").stats
    ):
        processor.save_pretrained(checkpoint)
    monkeypatch.setattr(lerobot_train, "make_optimizer_and_scheduler", stop)
    argv = [
        "lerobot-train",
        f"--policy.path={checkpoint}",
        "--dataset.repo_id=local/x",
        f"--output_dir={tmp_path / 'out'}",
    ]
    argv += [
        f"--dataset.root={place / dataset}",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--num_workers=0",
    ]
    monkeypatch.setattr(
        sys,
        "argv",
        [
            *argv,
            "--dataset.video_backend=pyav",
            *(word.format(camera=camera) for word in words),
        ],
    )
    with pytest.raises(
        TaccorlError if said else InterruptedError,
        match=said.format(camera=camera) or "^$",
    ):
        lerobot_train.main()


def test_the_ways_out_lead_out(place):
    assert not policy_for(place / "blind", tactile=False).config.tactile
    assert policy_for(place / "short", tactile_history=5).config.tactile_history == 5
    assert (
        policy_for(
            place / "short", tactile_history=3, tactile_stride=3
        ).config.window_rows
        == 7
    )
    with pytest.raises(TaccorlError, match="window of touch has 9"):
        policy_for(place / "short", tactile_history=3, tactile_stride=4)
    assert policy_for(place / "only_sim", sim_weight=1).mixture.sim_share == 1
    assert policy_for(place / "only_real", sim_weight=0).mixture.sim_share == 0
    assert policy_for(place / "plain").mixture is None
    assert goes_on(place / "checkpoint", place / "sim").config.fps == 30


@pytest.mark.slow
def test_the_share_of_simulated_rows_is_counted_where_statistics_have_lost_it(
    place, tmp_path
):
    merge_domains([place / "plain"], [place / "sim"], tmp_path / "both")
    path = tmp_path / "both/meta/stats.json"
    stats = json.loads(path.read_text())
    assert stats.pop(IS_SIM)["mean"] == [pytest.approx(13 / 39)]
    path.write_text(json.dumps(stats))  # as lerobot-edit-dataset leaves it
    with pytest.raises(
        TaccorlError,
        match=r"statistics do not state how many rows are simulated.*taccorl merge",
    ):
        policy_for(tmp_path / "both")
    dataset = read_fast(tmp_path / "both")
    policy = make_policy(TactilePI05Config(**TINY), ds_meta=dataset.meta)
    assert (
        policy.mixture.sim_share == pytest.approx(13 / 39)
        and policy.config.sim_share == policy.mixture.sim_share
    )


@pytest.mark.slow
def test_a_co_trained_checkpoint_is_not_trained_on_one_domain_unless_that_is_said(
    place, tmp_path
):
    merge_domains([place / "plain"], [place / "sim"], tmp_path / "both")
    policy_for(tmp_path / "both").save_pretrained(tmp_path / "co_trained")

    with pytest.raises(
        TaccorlError,
        match=r"local/plain .*no observation\.is_sim.*33 % of rows simulated.*sim_weight=0",
    ):
        goes_on(tmp_path / "co_trained", place / "plain")
    assert (
        goes_on(
            tmp_path / "co_trained", place / "plain", sim_weight=0.0
        ).config.sim_share
        is None
    )


@pytest.mark.slow
def test_one_domain_left_by_a_choice_of_episodes_is_noticed(place, tmp_path):
    """As ``--dataset.episodes=[0]`` of a merged dataset: the share p is that of the rows that are read."""
    merge_domains([place / "plain"], [place / "sim"], tmp_path / "both")
    dataset = read_fast(tmp_path / "both", episodes=[2])
    assert np.ravel(dataset.meta.stats[IS_SIM]["mean"])[0] == 1
    with pytest.raises(TaccorlError, match=r"gives real rows the weight 0\.5"):
        make_policy(TactilePI05Config(**TINY), ds_meta=dataset.meta)


# ---- which decoder LeRobot takes for videos ----

BROKEN = "raise RuntimeError('Could not load libtorchcodec. Likely causes: …')"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder in which this process looks for torchcodec first, and none that was imported."""
    for name in [
        name for name in sys.modules if name.partition(".")[0] == "torchcodec"
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(str(tmp_path))
    default_video_backend.cache_clear()
    yield tmp_path
    default_video_backend.cache_clear()
    sys.modules.pop("torchcodec", None)


@pytest.mark.parametrize(
    ("torchcodec", "expected"), [(BROKEN, "pyav"), ("", "torchcodec")]
)
def test_a_torchcodec_that_cannot_be_loaded_is_left_out_in_silence(
    torchcodec, expected, site, capfd, caplog
):
    from lerobot.configs.default import DatasetConfig
    from lerobot.datasets import lerobot_dataset

    (site / "torchcodec.py").write_text(torchcodec)
    install()
    assert (
        DatasetConfig("local/x").video_backend
        == lerobot_dataset.get_safe_default_video_backend()
        == expected
    )
    assert "".join(capfd.readouterr()) + caplog.text == ""
