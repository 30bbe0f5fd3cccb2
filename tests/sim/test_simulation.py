"""N simulations in lock-step: the same bits alone, in a batch and on any threads; state in, state out; bad actions."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.sim.bench import Bench
from taccorl.sim.effects import make_effect
from taccorl.sim.outcome import Judge
from taccorl.sim.randomize import Row, draw
from taccorl.sim.scene_digest import scene_digest
from taccorl.sim.simulation import SUB_COMMANDS, Simulation, Watch
from taccorl.sim.task import Subtask, Verdict, tasks
from taccorl.sim.twin import TwinConfig
from taccorl.tasks.assembly_1.scene import Assembly1


def waving(steps: int) -> np.ndarray:
    """(steps, 14) joint targets that move both arms and grippers, as float32."""
    sim = Simulation(Assembly1())
    sim.reset([0])
    t = np.arange(1, steps + 1)[:, None] / 30
    phase = np.arange(14)
    wave = 0.1 * np.sin(2 * np.pi * 0.7 * t + phase) - 0.1 * np.sin(phase)
    wave[:, [6, 13]] = -0.03 * (1 - np.cos(2 * np.pi * 0.5 * t))
    return (sim.targets[0] + wave).astype(np.float32)


ACTIONS = waving(25)


def scene(
    task: str = "assembly_1",
    difficulty: str = "train",
    effect: tuple = (),
    scale: float = 1.0,
) -> Simulation:
    effects = [make_effect(effect[0], **effect[1])] if effect else []
    sim = Simulation(
        tasks.get(task)(difficulty), TwinConfig(effects=effects), scale=scale
    )
    sim.reset([5])
    return sim


CREEP, HYSTERESIS = (
    ("taxel_creep", {"share": 0.3}),
    ("taxel_hysteresis", {"half_width": 0.1}),
)


@pytest.mark.parametrize(
    ("mine", "other"),
    [
        ({}, {"task": "assembly_2"}),
        ({}, {"task": "bench"}),
        ({}, {"difficulty": "hard"}),
        ({}, {"effect": ("coulomb_friction", {"torque_nm": 0.4})}),
        (
            {"effect": ("coulomb_friction", {"torque_nm": 0.5})},
            {"effect": ("coulomb_friction", {"torque_nm": 0.4})},
        ),
        ({"effect": CREEP}, {"effect": HYSTERESIS}),
        ({}, {"scale": 0.0}),
    ],
)
def test_a_state_of_another_scene_is_refused_before_anything_is_written(
    mine: dict, other: dict
):
    sim, origin = scene(**mine), scene(**other)
    sim.step(sim.targets + 0.01)
    state, rows = sim.batch.state.copy(), sim.state_rows()
    foreign, foreign_rows = origin.snapshot(), origin.state_rows()
    if rows.shape == foreign_rows.shape:  # else sizes tell them apart
        said = "another task, difficulty, twin or randomisation.*assembly_1, train"
    else:
        said = "another t"
    with pytest.raises(TaccorlError, match=r"another t(ask|win)"):
        sim.restore(foreign)
    with pytest.raises(TaccorlError, match=said):
        sim.restore_rows(foreign_rows, [5])
    np.testing.assert_array_equal(sim.batch.state, state)
    np.testing.assert_array_equal(sim.state_rows(), rows)
    assert sim.judge.steps[0] == 1


def test_a_state_of_the_same_scene_made_anew_is_taken():
    for settings in ({}, {"effect": CREEP}, {"difficulty": "hard", "scale": 0.5}):
        origin, sim = scene(**settings), scene(**settings)
        origin.step(origin.targets + 0.01)
        sim.restore(origin.snapshot())
        np.testing.assert_array_equal(sim.state_rows(), origin.state_rows())
        sim.reset([1])
        sim.restore_rows(origin.state_rows(), origin.seeds)
        np.testing.assert_array_equal(sim.state_rows(), origin.state_rows())


def test_a_row_begins_with_its_scene_and_then_has_the_physics():
    sim = scene()
    row = sim.state_rows()[0]
    assert (
        row.shape == (sim.row_size,)
        and 0 < row[0] < 1
        and row[0] * 2**52 == int(row[0] * 2**52)
    )
    np.testing.assert_array_equal(row[1 : 1 + sim.batch.nstate], sim.batch.state[0])
    spoilt = row.copy()
    spoilt[0] += 2**-52  # the last bit
    with pytest.raises(TaccorlError, match="randomisation"):
        sim.restore_rows(spoilt[None], [5])
    with pytest.raises(TaccorlError, match="2 seeds"):
        sim.restore_rows(row[None], [5, 6])
    with pytest.raises(TaccorlError, match="states to draw: rows"):
        next(sim.render_states(sim.snapshot().physics, ["front"]))


@pytest.mark.parametrize(
    "effects", [[], ["command_delay", "command_lag", "taxel_creep"]]
)
def test_a_simulation_that_is_not_stepped_keeps_everything(effects: list[str]):
    typical = [
        make_effect(n, **{p.name: p.typical for p in type(make_effect(n)).parameters()})
        for n in effects
    ]
    sim = Simulation(Assembly1(), TwinConfig(effects=typical), num_sims=3)
    alone = Simulation(Assembly1(), TwinConfig(effects=typical))
    sim.reset([3, 7, 11])
    alone.reset([7])
    for k, action in enumerate(ACTIONS[:6]):
        before = sim.snapshot()
        sim.judge.held[[0, 2]] = 4 + k  # would be broken off if they were judged
        executed, targets = sim.executed.copy(), sim.targets.copy()
        # clipped, if it counted
        beyond = action + np.where(np.arange(3) == 1, 0.0, 4.0)[:, None] * (
            np.arange(14) == 0
        )
        sim.step(beyond, np.array([1]))
        alone.step(action[None])
        now = sim.snapshot()
        for i in (0, 2):
            np.testing.assert_array_equal(now.physics[i], before.physics[i])
            np.testing.assert_array_equal(sim.targets[i], targets[i])
            np.testing.assert_array_equal(sim.executed[i], executed[i])
            for name, values in before.memory.items():
                np.testing.assert_array_equal(
                    now.memory[name][i], values[i], err_msg=name
                )
        assert (
            sim.judge.steps.tolist() == [0, k + 1, 0]
            and sim.judge.held[[0, 2]].tolist() == [4 + k] * 2
        )
        assert not sim.clipped.any()
    np.testing.assert_array_equal(sim.batch.state[1], alone.batch.state[0])
    np.testing.assert_array_equal(sim.targets[1], alone.targets[0])


def test_watching_changes_nothing():
    plain, watched = Simulation(Assembly1()), Simulation(Assembly1())
    seen = []
    for sim in (plain, watched):
        sim.reset([4])
    for action in ACTIONS[:8]:
        plain.step(action[None])
        watched.step(
            action[None],
            watch=Watch(
                range(6, 41, 6), lambda k: seen.append((k, watched.touch().sum()))
            ),
        )
    np.testing.assert_array_equal(plain.batch.state, watched.batch.state)
    assert [step for step, _ in seen[:6]] == [6, 12, 18, 24, 30, 36]


def test_targets_move_in_a_straight_line_over_the_control_step():
    sim = Simulation(tasks.get("bench")())
    sim.reset([0])
    start, goal = sim.targets[0].copy(), sim.targets[0] + 0.05
    goal[[6, 13]] = 0.03
    asked = []
    every = sim.config.physics.steps_per_control_step // SUB_COMMANDS
    watch = Watch(
        range(every, SUB_COMMANDS * every + 1, every),
        lambda _: asked.append(sim.arrays["ctrl"][0].copy()),
    )
    sim.step(goal[None], watch=watch)
    line = [
        start + (goal - start) * k / SUB_COMMANDS for k in range(1, SUB_COMMANDS + 1)
    ]
    np.testing.assert_allclose(
        np.array(asked)[:, sim.action_actuators], line, atol=1e-12
    )


def test_reset_draws_mass_and_friction_into_each_simulation_s_own_model():
    sim = Simulation(Assembly1(), num_sims=2)
    sim.reset([1, 2])
    for i in range(2):
        model = sim.batch.get_model(i)
        draw = sim.draws[i]
        assert model.body("plug").mass[0] == pytest.approx(0.080 + draw["plug_mass"][0])
        assert model.body("socket").mass[0] == pytest.approx(
            0.150 + draw["socket_mass"][0]
        )
        assert model.geom("plug_0").friction[0] == pytest.approx(draw["friction"][0])
        assert model.geom("table").friction[0] == 0.6
        nominal = sim.model.body("plug").inertia / sim.model.body("plug").mass
        np.testing.assert_allclose(
            model.body("plug").inertia / model.body("plug").mass, nominal
        )
    assert sim.draws[0]["friction"][0] != sim.draws[1]["friction"][0]


def test_contact_of_an_undeclared_pair_is_an_error():
    sim = Simulation(Assembly1())
    sim.reset([0])
    with pytest.raises(TaccorlError, match="has only the pairs"):
        sim.contact("socket", "plug")


# ---- the paper's table of domain randomisation, row by row ----


DEG = math.pi / 180
TABLE = {  # half ranges, as printed in the paper's appendix E
    "assembly_1": {
        "plug_position": 0.03,
        "socket_position": 0.03,
        "plug_mass": 0.03,
        "socket_mass": 0.03,
    },
    "assembly_2": {
        "plug_position": 0.03,
        "socket_position": 0.03,
        "plug_mass": 0.03,
        "socket_mass": 0.03,
    },
    "puzzle": {
        "tray_position": 0.005,
        "tray_yaw": 5 * DEG,
        **{f"{piece}_position": 0.01 for piece in ("circle", "heart", "triangle")},
        **{f"{piece}_yaw": 10 * DEG for piece in ("circle", "heart", "triangle")},
        "circle_support": (0.03, 0.03),
        "heart_support": (0.03, 0.027),
        "triangle_support": (0.03, 0.027),
    },
    "test_tube": {
        "tube_position": 0.02,
        "tube_yaw": 20 * DEG,
        "holder_position": 0.005,
    },
}


@pytest.mark.parametrize("task", TABLE)
def test_rows_are_the_paper_s(task):
    rows = {row.name: row for row in tasks.get(task).rows}
    assert (rows.pop("friction").low, tasks.get(task).rows[0].high) == ((0.3,), (0.7,))
    assert set(rows) == set(TABLE[task])
    for name, half in TABLE[task].items():
        np.testing.assert_allclose(
            rows[name].high, np.broadcast_to(half, len(rows[name].high))
        )
        np.testing.assert_allclose(rows[name].low, -np.array(rows[name].high))
        assert rows[name].probability == 1.0


def test_draws_fill_their_range_and_never_leave_it():
    rng = np.random.default_rng(0)
    frictions = np.array(
        [draw(tasks.get("test_tube").rows, rng)["friction"][0] for _ in range(2000)]
    )
    assert 0.3 <= frictions.min() < 0.301 and 0.699 < frictions.max() <= 0.7
    assert frictions.mean() == pytest.approx(
        0.5, abs=3 * 0.4 / math.sqrt(12 * 2000)
    )  # three standard errors


def test_scale_zero_is_the_nominal_scene_and_one_half_halves_the_spread():
    rows = tasks.get("puzzle").rows
    whole, half, none = (
        draw(rows, np.random.default_rng(5), scale) for scale in (1.0, 0.5, 0.0)
    )
    for row in rows:
        np.testing.assert_allclose(none[row.name], row.absent)
        np.testing.assert_allclose(
            half[row.name] - row.absent,
            0.5 * (whole[row.name] - row.absent),
            atol=1e-15,
        )


def test_a_row_that_is_not_drawn_does_not_move_the_rows_after_it():
    def rows(probability: float) -> tuple[Row, ...]:
        first = Row(
            name="first", low=(0.0,), high=(1.0,), unit="1", probability=probability
        )
        return (first, Row(name="second", low=(0.0,), high=(1.0,), unit="1"))

    never, always = (draw(rows(p), np.random.default_rng(1)) for p in (0.0, 1.0))
    assert never["first"] == 0.5  # the middle
    assert always["first"] != 0.5
    assert never["second"] == always["second"]


@pytest.mark.parametrize(
    ("other", "is_same"), [({"torque_nm": 0.4}, True), ({"torque_nm": 0.41}, False)]
)
def test_evidence_and_interval_of_an_effect_make_no_other_scene_but_its_value_does(
    other: dict, is_same: bool
):
    told = {
        "torque_nm": 0.4,
        "interval": {"torque_nm": (0.3, 0.5)},
        "evidence": "validation error halves",
    }
    one, two = (
        scene_digest(
            Assembly1(),
            TwinConfig(effects=[make_effect("coulomb_friction", **values)]),
            1.0,
        )
        for values in (told, other)
    )
    assert (one == two) == is_same


# ---- the judge: a goal has to hold, failures may have to last, what is over stays over ----


class Scripted(Bench):
    """A task whose verdicts are told beforehand."""

    failures = {"dropped": 0.0, "wedged": 0.1}  # noqa: RUF012
    time_limit_s = 2.0

    def __init__(self):
        super().__init__()
        self.now = {
            "goal": [False],
            "dropped": [False],
            "wedged": [False],
            "first": [False],
            "second": [False],
        }

    def look(self, scene):
        told = {name: np.array(values) for name, values in self.now.items()}
        failures = {"dropped": told["dropped"], "wedged": told["wedged"]}
        return Verdict(
            goal=told["goal"], failures=failures, partial=told["goal"].astype(int)
        )

    def subtasks(self):
        def done(name):
            return lambda scene: np.array(self.now[name])

        steps = tuple(
            Subtask(name=name, done=done(name)) for name in ("first", "second")
        )
        return {"left": steps, "right": ()}


@pytest.fixture
def judged():
    task = Scripted()
    scene = SimpleNamespace(diverged=np.array([False]))
    judge = Judge(task, 1, 30)
    judge.reset(np.array([0]), scene)

    def step(num: int = 1, **now):
        task.now = {name: [False] for name in task.now} | {
            name: [value] for name, value in now.items()
        }
        for _ in range(num):
            judge.update(scene)
        return judge.outcome

    return step, judge, scene


def test_goal_counts_only_after_half_a_second_without_a_break(judged):
    step, _, _ = judged
    assert not step(14, goal=True).success[0]
    step(1)  # it jumps out for one control step
    assert not step(14, goal=True).success[0]
    assert step(1, goal=True).success[0]


def test_a_failure_with_a_duration_has_to_last(judged):
    step, _, _ = judged
    assert step(2, wedged=True).failure[0] == ""  # 0.1 s are three steps
    step(1)
    assert step(2, wedged=True).failure[0] == ""
    assert step(1, wedged=True).failure[0] == "wedged"


def test_what_is_over_stays_over(judged):
    step, judge, _ = judged
    assert step(1, dropped=True).failure[0] == "dropped"
    late = step(40, goal=True)
    assert (late.failure[0], late.success[0]) == ("dropped", False)
    assert judge.steps[0] == 1


def test_success_is_not_taken_back_by_a_later_failure(judged):
    step, _, _ = judged
    step(15, goal=True)
    late = step(5, dropped=True)
    assert (late.success[0], late.failure[0]) == (True, "")


def test_time_limit_ends_as_timeout(judged):
    step, _, _ = judged
    assert step(59).failure[0] == ""
    assert step(1).failure[0] == "timeout"


def test_divergence_is_a_failure_and_breaks_the_hold(judged):
    step, _, scene = judged
    step(10, goal=True)
    scene.diverged[:] = True
    outcome = step(10, goal=True)
    assert (outcome.failure[0], outcome.success[0]) == ("diverged", False)


def test_subtasks_end_in_order_and_one_a_step(judged):
    step, judge, _ = judged
    step(1, second=True)  # before its turn
    assert judge.subtask[0, 0] == 0
    step(1, first=True, second=True)
    assert judge.subtask[0, 0] == 1
    step(1, first=True)
    assert judge.subtask[0, 0] == 1
    step(1, second=True)
    assert judge.subtask[0, 0] == 2
    step(1)  # 1 → 0 edges mean nothing
    assert judge.subtask[0, 0] == 2


def test_who_is_not_stepped_is_not_judged():
    task, scene = Scripted(), SimpleNamespace(diverged=np.array([False, False, True]))
    task.now = {name: [False] * 3 for name in task.now} | {
        "goal": [True] * 3,
        "first": [True] * 3,
        "wedged": [True] * 3,
    }
    judge = Judge(task, 3, 30)
    judge.reset(np.arange(3), scene)
    judge.update(scene, np.array([0]))
    judge.update(scene, np.array([0, 1]))
    assert judge.steps.tolist() == [2, 1, 0]
    assert judge.held.tolist() == [2, 1, 0]
    assert judge.lasted[:, 1].tolist() == [2, 1, 0]
    assert judge.subtask[:, 0].tolist() == [1, 1, 0]
    assert judge.failure.tolist() == [
        "",
        "",
        "",
    ]  # the third diverged, but nobody has stepped it
    task.now = {name: [False] * 3 for name in task.now}
    judge.update(scene, np.array([0]))
    assert judge.held.tolist() == [0, 1, 0]
    assert judge.lasted[:, 1].tolist() == [0, 1, 0]


def test_snapshot_and_restore_keep_counters(judged):
    step, judge, scene = judged
    step(14, goal=True, first=True)
    rows = judge.snapshot(np.array([0]))
    step(5)
    judge.restore(rows, np.array([0]), scene)
    assert step(1, goal=True).success[0]
    assert judge.subtask[0, 0] == 1
