"""Datasets that do not fit a policy, on disk and by the way that lerobot-train goes: both sides are named, and the way out."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import lerobot_dataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from tiny_dataset import CHANGED, IS_SIM, TOUCH, tiny_episode, tiny_spec, write_tiny

from taccorl.data.lerobot_format import write_episodes
from taccorl.data.spec import DatasetSpec
from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.training import reading
from taccorl.training.cotrain import merge_domains
from taccorl.training.reading import FastReader

NAMES = tiny_spec().features["action"].names
SWAPPED = (NAMES[1], NAMES[0], *NAMES[2:])
TINY: dict[str, Any] = {"device": "cpu", "backbone": "tiny", "image_resolution": (56, 56)}


def of(root: Path) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata(f"local/{root.name}", root=root)


def policy_for(root: Path, **settings: Any) -> Any:
    """As ``lerobot-train --policy.type=tactile_pi05 --dataset.root=ROOT`` makes it."""
    return make_policy(TactilePI05Config(**TINY, **settings), ds_meta=of(root))


def read_fast(root: Path, **words: Any) -> LeRobotDataset:
    """As LeRobot reads it where taccorl.lerobot_plugin is at work."""
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
        dataclasses.replace(spec, sensors={TOUCH: dataclasses.replace(sensor, gain_per_count=0.01)}),
    )
    write(folder / "slow", dataclasses.replace(spec, fps=15))
    blind = {key: f for key, f in spec.features.items() if key != TOUCH}
    episode = tiny_episode(spec, 14, 0)
    arrays = {key: values for key, values in episode.arrays.items() if key != TOUCH}
    seen = dataclasses.replace(spec, features=blind, sensors={})
    write_episodes([dataclasses.replace(episode, spec=seen, arrays=arrays)], folder / "blind")
    write_tiny(folder / "short", rows=(14, 7))
    for name, keys in {"moved": ("action", "observation.state"), "moved_state": ("observation.state",)}.items():
        swapped = {key: dataclasses.replace(spec.features[key], names=SWAPPED) for key in keys}
        write(folder / name, dataclasses.replace(spec, features={**spec.features, **swapped}))
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
    assert config.pop("joint_names") == {"action": list(NAMES), "observation.state": list(NAMES)}
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
    assert ", ".join(NAMES) in said and ", ".join(SWAPPED) in said and "action" in said and "local/moved" in said
    assert goes_on(place / checkpoint, place / "plain").config.joint_names["observation.state"] == list(NAMES)


def test_a_state_in_another_order_is_refused_too(place, earlier_checkpoint):
    with pytest.raises(TaccorlError, match=r"elements of observation\.state are in another order"):
        goes_on(place / "checkpoint", place / "moved_state")
    assert goes_on(earlier_checkpoint, place / "moved_state").config.joint_names["observation.state"] == list(SWAPPED)


def test_a_dataset_without_names_is_warned_about_and_the_checkpoint_keeps_its_own(place, caplog):
    policy = goes_on(place / "checkpoint", place / "unnamed")
    assert caplog.text.count("is not known") == 2
    assert policy.config.joint_names == {"action": list(NAMES), "observation.state": list(NAMES)}
    for key in ("joint_names", "action_feature_names"):
        assert getattr(policy_for(place / "unnamed").config, key) is None


def test_grouped_names_are_compared_one_by_one():
    config, meta = TactilePI05Config(**TINY, tactile=False), of_names({"motors": list(NAMES)})
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
    return SimpleNamespace(repo_id="local/x", root="x", fps=30, features={"action": {"names": names}})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dataset", "words", "said"),
    [
        ("moved", (), "the elements of action are in another order"),
        ("no_camera", (), "has no {camera}, with which the checkpoint was trained"),
        ("plain", ("--rename_map={{{camera}: observation.images.other}}",), "has no {camera}"),
        ("plain", (), ""),
    ],
)
def test_lerobot_train_refuses_other_joints_and_missing_cameras(place, tmp_path, monkeypatch, dataset, words, said):
    """The command itself, up to the first step of the training."""
    from lerobot.scripts import lerobot_train

    def stop(*_: Any, **__: Any) -> None:
        raise InterruptedError

    for module, names in CHANGED.items():
        for name in names:
            monkeypatch.setattr(module, name, getattr(module, name))  # so that it is put back
    reading.install()
    camera = next(key for key in tiny_spec().features if key.startswith("observation.images."))
    checkpoint = Path(shutil.copytree(place / "checkpoint", tmp_path / "checkpoint"))
    config = PreTrainedConfig.from_pretrained(checkpoint)
    for processor in make_pre_post_processors(config, dataset_stats=of(place / "plain").stats):
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
        sys, "argv", [*argv, "--dataset.video_backend=pyav", *(word.format(camera=camera) for word in words)]
    )
    with pytest.raises(TaccorlError if said else InterruptedError, match=said.format(camera=camera) or "^$"):
        lerobot_train.main()


def test_the_ways_out_lead_out(place):
    assert not policy_for(place / "blind", tactile=False).config.tactile
    assert policy_for(place / "short", tactile_history=5).config.tactile_history == 5
    assert policy_for(place / "short", tactile_history=3, tactile_stride=3).config.window_rows == 7
    with pytest.raises(TaccorlError, match="window of touch has 9"):
        policy_for(place / "short", tactile_history=3, tactile_stride=4)
    assert policy_for(place / "only_sim", sim_weight=1).mixture.sim_share == 1
    assert policy_for(place / "only_real", sim_weight=0).mixture.sim_share == 0
    assert policy_for(place / "plain").mixture is None
    assert goes_on(place / "checkpoint", place / "sim").config.fps == 30


@pytest.mark.slow
def test_the_share_of_simulated_rows_is_counted_where_statistics_have_lost_it(place, tmp_path):
    merge_domains([place / "plain"], [place / "sim"], tmp_path / "both")
    path = tmp_path / "both/meta/stats.json"
    stats = json.loads(path.read_text())
    assert stats.pop(IS_SIM)["mean"] == [pytest.approx(13 / 39)]
    path.write_text(json.dumps(stats))  # as lerobot-edit-dataset leaves it
    with pytest.raises(TaccorlError, match=r"statistics do not state how many rows are simulated.*taccorl merge"):
        policy_for(tmp_path / "both")
    dataset = read_fast(tmp_path / "both")
    policy = make_policy(TactilePI05Config(**TINY), ds_meta=dataset.meta)
    assert policy.mixture.sim_share == pytest.approx(13 / 39) and policy.config.sim_share == policy.mixture.sim_share


@pytest.mark.slow
def test_a_co_trained_checkpoint_is_not_trained_on_one_domain_unless_that_is_said(place, tmp_path):
    merge_domains([place / "plain"], [place / "sim"], tmp_path / "both")
    policy_for(tmp_path / "both").save_pretrained(tmp_path / "co_trained")

    with pytest.raises(
        TaccorlError, match=r"local/plain .*no observation\.is_sim.*33 % of rows simulated.*sim_weight=0"
    ):
        goes_on(tmp_path / "co_trained", place / "plain")
    assert goes_on(tmp_path / "co_trained", place / "plain", sim_weight=0.0).config.sim_share is None


@pytest.mark.slow
def test_one_domain_left_by_a_choice_of_episodes_is_noticed(place, tmp_path):
    """As ``--dataset.episodes=[0]`` of a merged dataset: the share p is that of the rows that are read."""
    merge_domains([place / "plain"], [place / "sim"], tmp_path / "both")
    dataset = read_fast(tmp_path / "both", episodes=[2])
    assert np.ravel(dataset.meta.stats[IS_SIM]["mean"])[0] == 1
    with pytest.raises(TaccorlError, match=r"gives real rows the weight 0\.5"):
        make_policy(TactilePI05Config(**TINY), ds_meta=dataset.meta)
