"""What is left of a training or a scoring, told from the files that LeRobot writes."""

import json
from pathlib import Path
from typing import Any

import pytest

from pipelines.lerobot_commands import Scoring, Training
from taccorl.data.dataset import PROVENANCE
from taccorl.errors import DatasetError
from taccorl.lineage.stage import Stage
from taccorl.lineage.store import Store


def published(out: Path, content: str = "1") -> Path:
    """Something that a verb made, as far as its manifest goes."""

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        (folder / "data").write_text(content)

    stage = Stage("cotraining", build, manifest=f"{PROVENANCE}/manifest.json")
    Store(out.parent / "store").run(stage, {"content": content}, [], destination=out)
    return out


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return published(tmp_path / "both")


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "recipe.yaml"
    path.write_text("steps: 10\n")
    return path


def checkpoint(training: Training, step: int, steps: int = 10) -> None:
    """As LeRobot leaves it after so many steps."""
    training.policy.mkdir(parents=True, exist_ok=True)
    (training.policy / "train_config.json").write_text(json.dumps({"steps": steps}))
    state = training.policy.parent / "training_state"
    state.mkdir(exist_ok=True)
    (state / "training_step.json").write_text(json.dumps({"step": step}))


def test_a_training_begins_goes_on_and_ends(
    dataset: Path, recipe: Path, tmp_path: Path
) -> None:
    training = Training(recipe, dataset, ["--batch_size=4"], tmp_path)
    begin = training.command()
    assert (
        begin[0] == "lerobot-train" and begin[-1] == f"--output_dir={training.folder}"
    )
    assert {
        f"--config_path={recipe}",
        f"--dataset.root={dataset}",
        "--batch_size=4",
    } <= set(begin)
    # Killed before its first checkpoint: LeRobot would refuse the folder, so it is cleared away.
    (training.folder / "checkpoints").mkdir(parents=True)
    assert (
        training.command() == begin
        and not training.folder.exists()
        and training.steps == 0
    )
    checkpoint(training, step=4)
    begun = training.policy / "train_config.json"
    assert training.command()[:3] == [
        "lerobot-train",
        f"--config_path={begun}",
        "--resume=true",
    ]
    assert training.steps == 4
    checkpoint(training, step=10)
    assert training.command() == []


def test_other_data_another_recipe_or_other_options_are_another_training(
    dataset, recipe, tmp_path
):
    first = Training(recipe, dataset, [], tmp_path).folder
    assert Training(recipe, dataset, [], tmp_path).folder == first
    found = {first, Training(recipe, dataset, ["--steps=5"], tmp_path).folder}
    recipe.write_text("steps: 11\n")
    found.add(Training(recipe, dataset, [], tmp_path).folder)
    found.add(Training(recipe, published(tmp_path / "other", "2"), [], tmp_path).folder)
    assert len(found) == 4
    (dataset / "meta/taccorl/manifest.json").unlink()
    with pytest.raises(DatasetError, match="merge it with taccorl merge"):
        Training(recipe, dataset, [], tmp_path)


def test_a_policy_that_was_trained_on_is_scored_again(
    dataset: Path, recipe: Path, tmp_path: Path
) -> None:
    training = Training(recipe, dataset, [], tmp_path)
    checkpoint(training, step=4)
    scoring = Scoring(training, ["--env.task=puzzle"], episodes=12)
    command = scoring.command()
    assert {
        "--env.type=taccorl",
        "--env.task=puzzle",
        "--eval.n_episodes=12",
        "--eval.batch_size=10",
    } <= set(command)
    scoring.folder.mkdir()
    told = {"per_task": [{"metrics": {"successes": [True, False]}}]}
    (scoring.folder / "eval_info.json").write_text(json.dumps(told))
    assert scoring.command() == [] and scoring.successes() == [True, False]
    checkpoint(training, step=10)
    assert Scoring(training, ["--env.task=puzzle"], episodes=12).command()
