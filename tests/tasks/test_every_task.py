"""Every registered task: reset, predicates, rows of randomisation, scripted expert and MimicGen spec fit together."""

import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from taccorl.episodes.sources.collect import CollectPlan
from taccorl.episodes.sources.mimicgen.schedule import rehearse
from taccorl.episodes.sources.mimicgen.spec import check_task, load_mimic_spec
from taccorl.plugins import ENTRY_POINT_GROUP
from taccorl.robots import ROBOT
from taccorl.sim.env import env_id, register_envs
from taccorl.sim.randomize import draw
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import CLEARANCES_M, tasks
from taccorl.tasks.experts import tasks_with_expert
from tests.fresh_python import fresh_python

ROOT = Path(__file__).resolve().parents[2]
WITH_SPEC = tuple(name for name in tasks if tasks.get(name).mimicgen)


@pytest.fixture(scope="module", params=list(tasks))
def sim(request: pytest.FixtureRequest) -> Simulation:
    return Simulation(tasks.get(request.param)())


def test_it_states_what_it_is(sim):
    task = sim.task
    assert tasks.get(task.name) is type(task) and task.instruction.strip()
    assert task.__doc__ and task.time_limit_s > 0
    assert set(task.home_rad) == set(ROBOT.arms)
    for arm, home in task.home_rad.items():
        low, high = (
            ROBOT.action_low[ROBOT.joint_slice(arm)],
            ROBOT.action_high[ROBOT.joint_slice(arm)],
        )
        assert (low <= home).all(), arm
        assert (home <= high).all(), arm
    assert {
        tasks.get(task.name)(difficulty).clearance_m for difficulty in CLEARANCES_M
    } == set(CLEARANCES_M.values())


def test_the_same_seed_gives_the_same_scene_and_another_seed_another(sim):
    def state(seed: int) -> bytes:
        sim.reset([seed])
        return sim.state_rows()[0].tobytes()

    first, second = state(1), state(2)
    assert state(1) == first
    assert (second != first) == bool(sim.task.rows)


def test_nothing_is_reached_or_failed_at_reset_and_for_a_second_of_rest(sim):
    sim.reset([3])
    names = {arm: [s.name for s in own] for arm, own in sim.task.subtasks().items()}
    assert set(names) == set(ROBOT.arms)
    assert len({name for own in names.values() for name in own}) == sum(
        map(len, names.values())
    )
    command = sim.arrays["ctrl"][:, sim.action_actuators].copy()
    for _ in range(30):
        now = sim.task.look(sim)
        assert not now.goal.any()
        assert set(now.failures) == set(sim.task.failures)
        assert not any(seen.any() for seen in now.failures.values()), now.failures
        assert (now.partial >= 0).all()
        assert (now.partial <= sim.task.max_partial).all()
        assert not any(
            own[0].done(sim).any() for own in sim.task.subtasks().values() if own
        )
        sim.step(command)
    assert not sim.judge.outcome.over.any()


def test_rows_are_drawn_within_their_bounds_and_every_one_moves_the_reset(sim):
    task, rng = sim.task, np.random.default_rng(0)
    nominal = draw(task.rows, rng, 0.0)
    assert len(nominal) == len(task.rows), "two rows of one name"
    for row in task.rows:
        assert row.unit
        assert len(row.low) == len(row.high)
        assert all(a < b for a, b in zip(row.low, row.high, strict=True)), row.name
        values = np.array([draw(task.rows, rng)[row.name] for _ in range(50)])
        assert (row.low <= values).all()
        assert (values <= row.high).all()
        assert repr(task.reset(nominal | {row.name: np.array(row.high)})) != repr(
            task.reset(nominal)
        ), row.name


def test_all_but_the_empty_bench_can_be_demonstrated_and_multiplied():
    assert set(tasks_with_expert()) == set(WITH_SPEC) == set(tasks) - {"bench"}


@pytest.mark.parametrize("name", WITH_SPEC)
def test_its_mimicgen_spec_fits_it(name):
    spec, task = load_mimic_spec(name), tasks.get(name)()
    check_task(spec, task)
    rehearse(spec.signals, spec.task_constraint_configs)  # no arm waits for ever
    held = {s.held_object for own in spec.subtask_configs.values() for s in own}
    assert all(held & set(pair) for pair in task.mating), (
        "parts that mate, and neither is held"
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", tasks_with_expert())
def test_its_expert_succeeds_and_ends_every_subtask(name):
    plan = CollectPlan(task=name, images=False)
    sim = plan.make()
    for k in range(3):  # it may fail in one of ten scenes
        sim.reset([plan.attempt_seed(k)])
        for targets in plan.source.actions(sim, np.random.default_rng(k)):
            sim.step(targets.sent[None].astype(float))
            if sim.judge.outcome.over[0]:
                break
        if sim.judge.outcome.success[0]:
            assert sim.judge.subtask[0].tolist() == [
                len(sim.task.subtasks()[arm]) for arm in ROBOT.arms
            ]
            return
    raise AssertionError(f"{name}: no success in 3 attempts")


# ---- a task that ``taccorl task new`` writes goes, as an outside package, through every command ----

NAME = "lift_cube"


def install(site: Path) -> Path:
    """What ``taccorl task new`` writes, as pip leaves it: the package, and a ``dist-info`` with its entry point."""
    taccorl("task", "new", NAME, f"--out={site}")
    project = tomllib.loads((site / "pyproject.toml").read_text())["project"]
    info = site / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    points = project["entry-points"][ENTRY_POINT_GROUP]
    lines = [f"{name} = {value}" for name, value in points.items()]
    (info / "entry_points.txt").write_text(
        "\n".join([f"[{ENTRY_POINT_GROUP}]", *lines, ""])
    )
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


def test_it_is_collected_augmented_and_evaluated(
    installed, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    task, rest = f"--task={NAME}", ("--store=store",)
    taccorl("collect", task, "--episodes=1", "--images=false", "--out=sources", *rest)
    taccorl(
        "augment",
        task,
        "--source=sources",
        "--episodes=1",
        "--images=false",
        "--out=many",
        *rest,
    )
    made = Dataset(tmp_path / "many")
    assert [e.instruction for e in (made.episode(0),)] == ["lift the yellow block"]
    taccorl(
        "evaluate",
        task,
        "--policy.type=expert",
        "--images=false",
        "--episodes=2",
        "--failures=0",
        "--out=scored",
    )
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
    words = [
        "tests/tasks/test_every_task.py",
        "-q",
        "-k",
        NAME,
        "-p",
        "no:cacheprovider",
    ]
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
def test_a_new_task_takes_no_name_or_folder_of_another(
    tmp_path, monkeypatch, capsys, words, told
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there" / "mine").mkdir(parents=True)
    assert main(["task", "new", *words]) == 2
    assert told in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["there"]
