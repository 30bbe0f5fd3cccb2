"""The judge: a goal has to hold, failures may have to last, what is over stays over."""

from types import SimpleNamespace

import numpy as np
import pytest

from taccorl.sim.bench import Bench
from taccorl.sim.outcome import Judge
from taccorl.sim.task import Subtask, Verdict


class Scripted(Bench):
    """A task whose verdicts are told beforehand."""

    failures = {"dropped": 0.0, "wedged": 0.1}  # noqa: RUF012
    time_limit_s = 2.0

    def __init__(self):
        super().__init__()
        self.now = {"goal": [False], "dropped": [False], "wedged": [False], "first": [False], "second": [False]}

    def look(self, scene):
        told = {name: np.array(values) for name, values in self.now.items()}
        failures = {"dropped": told["dropped"], "wedged": told["wedged"]}
        return Verdict(goal=told["goal"], failures=failures, partial=told["goal"].astype(int))

    def subtasks(self):
        def done(name):
            return lambda scene: np.array(self.now[name])

        steps = tuple(Subtask(name=name, done=done(name)) for name in ("first", "second"))
        return {"left": steps, "right": ()}


@pytest.fixture
def judged():
    task = Scripted()
    scene = SimpleNamespace(diverged=np.array([False]))
    judge = Judge(task, 1, 30)
    judge.reset(np.array([0]), scene)

    def step(num: int = 1, **now):
        task.now = {name: [False] for name in task.now} | {name: [value] for name, value in now.items()}
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
    assert judge.failure.tolist() == ["", "", ""]  # the third diverged, but nobody has stepped it
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
