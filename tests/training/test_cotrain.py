"""Real and simulated datasets in one: every row is told apart, and statistics are those of all rows."""

import dataclasses
import json

import numpy as np
import pytest
from tiny_dataset import IS_SIM, TOUCH, tiny_episode, tiny_spec, write_spec, write_tiny

from taccorl.data.dataset import Dataset
from taccorl.data.lerobot_format import write_episodes
from taccorl.data.origin import Origin
from taccorl.data.spec import FeatureSpec
from taccorl.errors import DatasetError, InTheWayError
from taccorl.training.cotrain import merge_domains

OWN = {"unit": "1", "frame": "world", "rate_hz": 30, "range": (0, 2**62)}


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """A real dataset of two episodes, and one of the twin with a column of its own."""
    folder = tmp_path_factory.mktemp("domains")
    spec = tiny_spec()
    twin_spec = dataclasses.replace(
        spec,
        features={
            **spec.features,
            "sim.seed": FeatureSpec(dtype="int64", shape=(1,), **OWN),
        },
    )
    episode = tiny_episode(twin_spec, 21, seed=5)
    shifted = {k: v + 3 if k == "action" else v for k, v in episode.arrays.items()}
    episode = dataclasses.replace(
        episode,
        arrays={**shifted, "sim.seed": np.full((21, 1), 5)},
        origin=Origin("twin", "simulated: the twin"),
    )
    write_episodes([episode], folder / "twin")
    write_spec(folder / "twin", twin_spec)
    return write_tiny(folder / "real", rows=(14, 11)), folder / "twin"


@pytest.fixture(scope="module")
def merged(parts, tmp_path_factory):
    real, twin = parts
    out = tmp_path_factory.mktemp("merged") / "both"
    return out, merge_domains([real], [twin], out)


def test_rows_keep_their_values_and_are_told_apart(parts, merged):
    out, told = merged
    both, one, other = Dataset(out), Dataset(parts[0]), Dataset(parts[1])
    assert both.num_episodes == 3 and "sim.seed" not in both.info["features"]
    for k, (source, index, is_sim) in enumerate(
        [(one, 0, 0.0), (one, 1, 0.0), (other, 0, 1.0)]
    ):
        values, wanted = (
            both.values(k, [IS_SIM, TOUCH, "action"]),
            source.values(index, [TOUCH, "action"]),
        )
        assert (values[IS_SIM] == is_sim).all()
        assert np.array_equal(values[TOUCH], wanted[TOUCH]) and np.array_equal(
            values["action"], wanted["action"]
        )
    assert both.video_problems() == []
    assert [(part.is_sim, part.episodes, part.rows) for part in told] == [
        (False, 2, 25),
        (True, 1, 21),
    ]
    assert (
        json.loads((out / "meta/taccorl/cotrain.json").read_text())[1]["is_sim"] is True
    )


def test_statistics_are_those_of_all_rows(parts, merged):
    stats = json.loads((merged[0] / "meta/stats.json").read_text())
    assert stats[IS_SIM]["mean"] == [pytest.approx(21 / 46, abs=1e-12)]
    actions = np.concatenate(
        [
            Dataset(parts[k]).values(i, ["action"])["action"]
            for k, i in ((0, 0), (0, 1), (1, 0))
        ]
    )
    for q, name in ((0.01, "q01"), (0.5, "q50"), (0.99, "q99")):
        # the middle of a mixture is in one of its parts; the mean of their middles, which LeRobot writes, is between them
        np.testing.assert_allclose(
            stats["action"][name],
            np.quantile(actions, q, axis=0, method="inverted_cdf"),
        )
    assert stats["action"]["count"] == [46] and len(stats[TOUCH]["mean"]) == 1536


def test_the_policy_finds_touch_and_both_domains_in_it(merged):
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import (
        TactilePI05Config,
    )
    from taccorl.policies.tactile_pi05.mixture import Mixture

    metadata = LeRobotDatasetMetadata("local/both", root=merged[0])
    config = TactilePI05Config(device="cpu", backbone="tiny")
    config.match_dataset(metadata)
    assert config.require_touch()["observation.tactile"].layout == (4, 32, 12)
    mixture = Mixture.of_statistics(metadata.stats, 0.5)
    assert mixture is not None and mixture.sim_share == pytest.approx(21 / 46)


def test_what_does_not_fit_is_named_with_both_sides(parts, merged, tmp_path):
    real, twin = parts
    with pytest.raises(InTheWayError, match="exists already"):
        merge_domains([real], [twin], merged[0])
    with pytest.raises(DatasetError, match="no dataset given"):
        merge_domains([], [], tmp_path / "out")
    blind = write_tiny(tmp_path / "blind", rows=(12,), cameras=0)
    with pytest.raises(
        DatasetError,
        match=r"real has observation\.images\.front, but blind does not: ingest",
    ):
        merge_domains([real], [blind], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_actions_that_may_be_a_row_apart_are_not_merged(parts, tmp_path):
    real, twin = parts
    assert (
        Dataset(real).spec.action_time == Dataset(twin).spec.action_time == "next_row"
    )
    older = write_tiny(tmp_path / "older", rows=(12,), with_spec=False)
    for spec in (None, dataclasses.replace(tiny_spec(), action_time=None)):
        if spec is not None:
            write_spec(older, spec)
        for real_side, sim_side in (
            ([older], [twin]),
            ([real], [older]),
            ([], [older, older]),
        ):
            with pytest.raises(
                DatasetError, match=r"older: .*action_time.*Ingest its recordings again"
            ):
                merge_domains(real_side, sim_side, tmp_path / "out")
    write_spec(older, tiny_spec())
    merge_domains([real], [older], tmp_path / "out")
    assert Dataset(tmp_path / "out").spec.action_time == "next_row"
