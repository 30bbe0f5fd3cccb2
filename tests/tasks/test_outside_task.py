"""A task that ``taccorl task new`` writes goes, as an outside package, through every command that a shipped task goes through."""

import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from taccorl.plugins import ENTRY_POINT_GROUP
from taccorl.sim.env import env_id, register_envs
from taccorl.sim.task import tasks
from taccorl.tasks.experts import tasks_with_expert
from tests.fresh_python import fresh_python

NAME = "lift_cube"


def install(site: Path) -> Path:
    """What ``taccorl task new`` writes, as pip leaves it: the package, and a ``dist-info`` with its entry point."""
    taccorl("task", "new", NAME, f"--out={site}")
    project = tomllib.loads((site / "pyproject.toml").read_text())["project"]
    info = site / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    points = project["entry-points"][ENTRY_POINT_GROUP]
    lines = [f"{name} = {value}" for name, value in points.items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{ENTRY_POINT_GROUP}]", *lines, ""]))
    return site


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The package installed in this process; its task is forgotten afterwards."""
    site = install(tmp_path_factory.mktemp("site"))
    assert NAME not in tasks
    before = dict(tasks._entries)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        patch.setattr(tasks, "_loaded", False)
        yield
        tasks._entries = before
    for name in [name for name in sys.modules if name.partition(".")[0] == NAME]:
        del sys.modules[name]
    gymnasium.registry.pop(env_id(NAME), None)


def taccorl(*words: Any) -> None:
    assert main([str(word) for word in words]) == 0


def test_it_is_collected_augmented_and_evaluated(installed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    task, rest = f"--task={NAME}", ("--store=store",)
    taccorl("collect", task, "--episodes=1", "--images=false", "--out=sources", *rest)
    taccorl("augment", task, "--source=sources", "--episodes=1", "--images=false", "--out=many", *rest)
    made = Dataset(tmp_path / "many")
    assert [e.instruction for e in (made.episode(0),)] == ["lift the yellow block"]
    taccorl("evaluate", task, "--policy.type=expert", "--images=false", "--episodes=2", "--failures=0", "--out=scored")
    assert f"expert, {NAME}: 2 of 2 episodes succeeded" in capsys.readouterr().out


def test_it_is_in_the_lists_that_are_made_by_registration(installed, capsys):
    assert NAME in tasks_with_expert()
    register_envs()
    assert gymnasium.spec(env_id(NAME)).max_episode_steps == 300
    with pytest.raises(SystemExit):
        main(["collect", "--help"])
    assert NAME in capsys.readouterr().out


@pytest.mark.slow
def test_the_tests_of_every_task_find_it_and_pass(tmp_path):
    words = ["tests/tasks/test_every_task.py", "-q", "-k", NAME, "-p", "no:cacheprovider"]
    run = fresh_python("-m", "pytest", *words, path=install(tmp_path / "site"))
    assert run.returncode == 0, run.stdout  # 5: no test selected


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("New-Task",), "is not a valid name of a task"),
        (("puzzle",), "the task puzzle exists already (taccorl.tasks.puzzle.scene)"),
        (("mine", "--out=there"), "there/mine: is there already"),
    ],
)
def test_a_new_task_takes_no_name_or_folder_of_another(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there" / "mine").mkdir(parents=True)
    assert main(["task", "new", *words]) == 2
    assert told in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["there"]
