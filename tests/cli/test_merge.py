"""``taccorl merge`` as a user types it, on small datasets of random numbers (no robot)."""

import dataclasses
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from taccorl.data.origin import TWIN_ORIGIN, Origin

IS_SIM = "observation.is_sim"
WORDS = ("--real=surrogate", "--sim=twin", "--out=both", "--store=store")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a surrogate's dataset and the twin's, in which they were merged once."""
    from by_lerobot import write_described
    from tiny_dataset import tiny_episode, tiny_spec, write_tiny

    folder = tmp_path_factory.mktemp("merge_cli")
    write_tiny(
        folder / "foreign", rows=(16,), with_spec=False
    )  # without what taccorl writes down of a dataset
    for name, seeds, origin in (
        ("surrogate", (0, 1), Origin("surrogate", "made up")),
        ("twin", (2,), TWIN_ORIGIN),
    ):
        episodes = [
            dataclasses.replace(
                tiny_episode(tiny_spec(), 20 + seed, seed), origin=origin, success=True
            )
            for seed in seeds
        ]
        write_described(folder / name, episodes)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["merge", *WORDS]) == 0
    return folder


def test_who_stands_for_the_robot_is_not_the_twin_and_the_reverse(
    place: Path, said: Any
) -> None:
    code, shown = said(
        "merge", "--real=surrogate", "--sim=surrogate", "--out=nothing", "--store=store"
    )
    assert code != 0 and "twice" in shown
    code, shown = said("merge", "--sim=surrogate", "--out=nothing", "--store=store")
    assert (
        code != 0
        and "--sim=surrogate" in shown
        and "surrogate: made up" in shown
        and "--real=surrogate" in shown
    )
    assert not (place / "nothing").exists()


def test_every_episode_keeps_its_origin_and_every_row_its_domain(place: Path) -> None:
    both = Dataset(place / "both")
    episodes = [both.episode(k) for k in range(both.num_episodes)]
    assert [e.origin for e in episodes] == [Origin("surrogate", "made up")] * 2 + [
        Origin("twin", "MuJoCo twin, not a robot")
    ]
    assert [e.num_rows for e in episodes] == [20, 21, 22] and all(
        e.success for e in episodes
    )
    assert [set(e.arrays[IS_SIM].ravel().tolist()) for e in episodes] == [
        {0.0},
        {0.0},
        {1.0},
    ]
    assert (
        both.spec.features[IS_SIM].range == (0, 1)
        and "observation.tactile" in both.spec.sensors
    )
    card = (place / "both/README.md").read_text()
    for line in (
        "- surrogate\n- simulated\n",
        "| surrogate: made up | 2 |",
        "| twin: MuJoCo twin, not a robot | 1 |",
        "| given as real: surrogate | 2 |",
        "| simulated: twin | 1 |",
    ):
        assert line in card, line


def test_the_same_command_again_does_nothing_and_lineage_tells_what_it_was_made_of(
    place: Path, said: Any
) -> None:
    made_ns = (place / "both/meta/info.json").stat().st_mtime_ns
    code, text = said("merge", *WORDS)
    assert code == 0 and (place / "both/meta/info.json").stat().st_mtime_ns == made_ns
    assert "real:      2 episodes, 41 rows (surrogate: made up)" in text
    assert "simulated: 1 episodes, 22 rows (twin: MuJoCo twin, not a robot)" in text
    assert (
        "--dataset.repo_id=local/both --dataset.root=both" in text
        and "sim_weight" not in text
    )
    code, text = said("lineage", "explain", "both", "--store=store")
    assert code == 0 and "cotraining" in text and "surrogate" in text and "twin" in text


def test_the_command_it_names_next_is_one_that_lerobot_takes(
    said: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.configs import parser
    from lerobot.configs.train import TrainPipelineConfig

    import taccorl.lerobot_plugin  # noqa: F401

    code, text = said("merge", "--sim=twin", "--out=simulated", "--store=store")
    assert code == 0 and "real:      0 episodes, 0 rows" in text
    command = shlex.split(text.rpartition("next:")[2].splitlines()[0])
    assert command[0] == "lerobot-train"
    monkeypatch.setattr(sys, "argv", command)

    @parser.wrap()
    def train(cfg: TrainPipelineConfig) -> TrainPipelineConfig:
        return cfg

    config: Any = train()  # pyright: ignore[reportCallIssue]
    assert (
        config.policy.sim_weight == 1.0 and config.dataset.root == "simulated"
    )  # α that one domain can have


def test_a_dataset_that_says_nothing_of_itself_is_merged_once_its_spec_is_written(
    place: Path, said: Any
) -> None:
    code, text = said(
        "merge", "--real=foreign", "--sim=twin", "--out=mixed", "--store=store"
    )
    assert (
        code == 2
        and "foreign: nothing states when its actions are reached (action_time" in text
    )
    from tiny_dataset import tiny_spec, write_spec

    shutil.copytree(place / "foreign", place / "described")
    write_spec(place / "described", tiny_spec())
    code, text = said(
        "merge", "--real=described", "--sim=twin", "--out=mixed", "--store=store"
    )
    assert code == 0, text
    mixed = Dataset(place / "mixed")
    assert [mixed.episode(k).origin for k in range(2)] == [
        Origin(),
        Origin("twin", "MuJoCo twin, not a robot"),
    ]
    assert said("check", "mixed")[0] in (0, 1)  # random numbers, but it can be read


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--real=surrogate",), "missing --out="),
        (("--out=x",), "no dataset given: --real=FOLDER, --sim=FOLDER"),
        (
            ("--real=surogate", "--sim=twin", "--out=x"),
            "surogate: no such folder; did you mean 'surrogate'?",
        ),
        (
            ("--real=twin", "--sim=surrogate", "--out=x"),
            "--real=twin: its episodes are twin: MuJoCo twin, not a robot: give --sim=twin",
        ),
        (
            ("--real=surrogate", "--sim=both", "--out=x"),
            "both has observation.is_sim, so that it is a merged dataset",
        ),
        (("--sim=twin", "--sim=twin", "--out=x"), "twin is given twice"),
        (("--sim=twin", "--sim=copy", "--out=x"), "twin: give each dataset once"),
        (("--real=surrogate", "--sim=twin", "--out=twin/x"), "contain one another"),
        (
            ("--real=surrogate", "--sim=twin", "--out=mine"),
            "mine is occupied: it is a folder of 1 entries without",
        ),
        (("--sim=twin", "--out=both"), "both is occupied: it holds cotraining v3"),
        (
            ("--real=blind", "--sim=twin", "--out=x"),
            "twin has observation.images.front, but blind does not: ingest",
        ),
    ],
)
def test_what_cannot_work_is_named_and_nothing_is_left(words, expected, place, said):
    from tiny_dataset import write_tiny

    (place / "mine").mkdir(exist_ok=True)
    (place / "mine/work.txt").write_text("x")
    if not (place / "copy").exists():
        shutil.copytree(place / "twin", place / "copy")
    if not (place / "blind").exists():
        write_tiny(place / "blind", rows=(12,), cameras=0)
    before = sorted(path.name for path in place.iterdir())
    code, text = said(
        "merge",
        *words,
        *(["--store=store"] if "--out=x" in words or "--out=both" in words else []),
    )
    shutil.rmtree(place / "outputs", ignore_errors=True)
    assert code == 2 and expected in text
    assert sorted(path.name for path in place.iterdir()) == before


def test_what_lies_at_out_is_moved_aside_if_asked_for_and_comes_back_if_the_merge_fails(
    place: Path, said: Any
) -> None:
    words = ("--real=surrogate", "--sim=twin", "--out=again", "--store=store")
    assert said("merge", *words[1:])[0] == 0  # of the twin alone
    first = (place / "again/meta/info.json").read_bytes()
    code, text = said("merge", *words)
    assert (
        code == 2
        and "--replace=true" in text
        and (place / "again/meta/info.json").read_bytes() == first
    )
    code, text = said("merge", *words, "--replace=true")
    assert code == 0 and "is now at again.old-1" in text, text
    assert (place / "again.old-1/meta/info.json").read_bytes() == first
    assert Dataset(place / "again").num_episodes == 3
    assert said("merge", *words, "--replace=true")[0] == 0, (
        "the same merge is there already"
    )
    assert not (place / "again.old-2").exists()
    shutil.rmtree(place / "again.old-1")
    shutil.rmtree(place / "again")
