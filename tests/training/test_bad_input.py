"""Datasets that do not fit a policy, on disk and by the way that lerobot-train goes: both sides are named, and the way out."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import lerobot_dataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy
from tiny_dataset import IS_SIM, TOUCH, tiny_episode, tiny_spec, write_tiny

from taccorl.data.lerobot_format import write_episodes
from taccorl.data.spec import DatasetSpec
from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.training.cotrain import merge_domains
from taccorl.training.reading import FastReader

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
    told = dataclasses.replace(spec, features=blind, sensors={})
    write_episodes([dataclasses.replace(episode, spec=told, arrays=arrays)], folder / "blind")
    write_tiny(folder / "short", rows=(14, 7))
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
def test_what_a_training_cannot_be_begun_with(place: Path, dataset: str, settings: dict, said: str) -> None:
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
def test_what_a_checkpoint_cannot_be_trained_on_with(place: Path, dataset: str, said: str) -> None:
    config = PreTrainedConfig.from_pretrained(place / "checkpoint")
    config.pretrained_path = place / "checkpoint"
    with pytest.raises(TaccorlError, match=said):
        make_policy(config, ds_meta=of(place / dataset))


def test_the_ways_out_lead_out(place: Path) -> None:
    assert not policy_for(place / "blind", tactile=False).config.tactile
    assert policy_for(place / "short", tactile_history=5).config.tactile_history == 5
    assert policy_for(place / "short", tactile_history=3, tactile_stride=3).config.window_rows == 7
    with pytest.raises(TaccorlError, match="window of touch has 9"):
        policy_for(place / "short", tactile_history=3, tactile_stride=4)
    assert policy_for(place / "only_sim", sim_weight=1).mixture.sim_share == 1
    assert policy_for(place / "only_real", sim_weight=0).mixture.sim_share == 0
    assert policy_for(place / "plain").mixture is None
    config = PreTrainedConfig.from_pretrained(place / "checkpoint")
    config.pretrained_path = place / "checkpoint"
    assert make_policy(config, ds_meta=of(place / "sim")).config.fps == 30


@pytest.mark.slow
def test_the_share_of_simulated_rows_is_counted_where_statistics_have_lost_it(place: Path, tmp_path: Path) -> None:
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
def test_a_co_trained_checkpoint_is_not_trained_on_one_domain_unless_that_is_said(place: Path, tmp_path: Path) -> None:
    merge_domains([place / "plain"], [place / "sim"], tmp_path / "both")
    policy_for(tmp_path / "both").save_pretrained(tmp_path / "co_trained")

    def goes_on(**settings: Any) -> Any:
        config = PreTrainedConfig.from_pretrained(tmp_path / "co_trained")
        config.pretrained_path = tmp_path / "co_trained"
        for name, value in settings.items():
            setattr(config, name, value)
        return make_policy(config, ds_meta=of(place / "plain"))

    with pytest.raises(
        TaccorlError, match=r"local/plain .*no observation\.is_sim.*33 % of rows simulated.*sim_weight=0"
    ):
        goes_on()
    assert goes_on(sim_weight=0.0).config.sim_share is None


@pytest.mark.slow
def test_one_domain_left_by_a_choice_of_episodes_is_noticed(place: Path, tmp_path: Path) -> None:
    """As ``--dataset.episodes=[0]`` of a merged dataset: the share p is that of the rows that are read."""
    merge_domains([place / "plain"], [place / "sim"], tmp_path / "both")
    dataset = read_fast(tmp_path / "both", episodes=[2])
    assert np.ravel(dataset.meta.stats[IS_SIM]["mean"])[0] == 1
    with pytest.raises(TaccorlError, match=r"gives real rows the weight 0\.5"):
        make_policy(TactilePI05Config(**TINY), ds_meta=dataset.meta)


def test_a_base_checkpoint_of_another_size_is_refused_with_both_sides(place: Path) -> None:
    from taccorl.policies.tactile_pi05.weights import load_base_weights

    policy = policy_for(place / "plain", prefix_tokens=4)
    with pytest.raises(
        TaccorlError, match=r"base_checkpoint=.*of another shape, first model\.tactile.*Nothing was loaded"
    ):
        load_base_weights(policy, str(place / "checkpoint"))
