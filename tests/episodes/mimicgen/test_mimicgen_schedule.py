"""Two arms step by step: tables written by hand, and deadlocks that are named."""

import pytest

from taccorl.episodes.sources.mimicgen.schedule import ConstraintSpec, Cue, Schedule, rehearse
from taccorl.errors import DeadlockError, TaccorlError

SIGNALS = {"left": ("grasp", "hold"), "right": ("lift", "insert")}
HOLD, INSERT = ("left", 1), ("right", 1)


def after(former, latter, kind="sequential", **more):
    return ConstraintSpec(eef_subtask_constraint_tuple=(former, latter), constraint_type=kind, **more)


def together(one, other, **more):
    return after(one, other, "coordination", **more)


def table(schedule, lengths, together=None, held=None):
    """Step by step: "left right" as "0.1" (subtask 0, step 1) or "-" for an arm that stands.

    ``held``: tick → arms that must not move then.
    """
    rows = []
    while not schedule.done:
        for arm in schedule.to_plan():
            place = arm, schedule.subtask(arm)
            schedule.plan(arm, lengths[place], (together or {}).get(place, 0))
        cues = schedule.tick((held or {}).get(len(rows), ()))
        told = [f"{cues[a].subtask}.{cues[a].step}" if a in cues else "-" for a in ("left", "right")]
        rows.append(" ".join(told))
    return rows


LENGTHS = {("left", 0): 2, ("left", 1): 3, ("right", 0): 3, ("right", 1): 2}


def test_without_constraints_each_arm_goes_its_own_way_and_then_stands():
    assert table(Schedule(SIGNALS), LENGTHS) == ["0.0 0.0", "0.1 0.1", "1.0 0.2", "1.1 1.0", "1.2 1.1"]
    shorter = LENGTHS | {("left", 1): 1}
    assert table(Schedule(SIGNALS), shorter) == ["0.0 0.0", "0.1 0.1", "1.0 0.2", "- 1.0", "- 1.1"]


def test_a_latter_subtask_begins_when_the_former_has_ended():
    sequence = after(("right", 0), HOLD)
    expected = ["0.0 0.0", "0.1 0.1", "- 0.2", "1.0 1.0", "1.1 1.1", "1.2 -"]
    assert table(Schedule(SIGNALS, [sequence]), LENGTHS) == expected


def test_a_trajectory_is_asked_for_when_its_subtask_begins_and_not_before():
    schedule = Schedule(SIGNALS, [after(("right", 0), HOLD)])
    assert schedule.to_plan() == ["left", "right"]
    schedule.plan("left", 1)
    schedule.plan("right", 2)
    schedule.tick()
    assert schedule.to_plan() == []  # the left arm's next one waits
    schedule.tick()
    assert schedule.to_plan() == ["left", "right"]


def test_ends_of_coordinated_subtasks_run_side_by_side():
    # 5 and 3 steps, the last 2 together: the left arm waits with 2 left, the right one comes 1 step of its own later.
    lengths = {("left", 0): 1, ("left", 1): 5, ("right", 0): 5, ("right", 1): 3}
    coordination = together(HOLD, INSERT)
    rows = table(Schedule(SIGNALS, [coordination]), lengths, {HOLD: 2, INSERT: 2})
    expected = ["0.0 0.0", "1.0 0.1", "1.1 0.2", "1.2 0.3", "- 0.4", "- 1.0", "1.3 1.1", "1.4 1.2"]
    assert rows == expected


def test_a_partner_that_is_held_holds_the_other_only_where_they_are_side_by_side():
    lengths = {("left", 0): 1, ("left", 1): 3, ("right", 0): 1, ("right", 1): 3}
    coordination = together(HOLD, INSERT)
    held = {1: ["right"], 4: ["right"]}  # before, and in the part that they do together
    rows = table(Schedule(SIGNALS, [coordination]), lengths, {HOLD: 2, INSERT: 2}, held)
    assert rows == ["0.0 0.0", "1.0 -", "- 1.0", "1.1 1.1", "- -", "1.2 1.2"]


def test_subtasks_that_begin_together_are_planned_together():
    coordination = together(HOLD, INSERT, coordination_synchronize_start=True)
    schedule = Schedule(SIGNALS, [coordination])
    for arm, num in (("left", 1), ("right", 2)):
        schedule.plan(arm, num)
    schedule.tick()
    assert schedule.to_plan() == []
    assert schedule.upcoming("left") is None
    assert schedule.upcoming("right") == Cue(0, 1)
    schedule.tick()
    assert schedule.to_plan() == ["left", "right"]


def test_a_deadlock_is_named():
    crossed = [after(HOLD, ("right", 0)), after(INSERT, ("left", 0))]
    text = (
        r"deadlock: left waits to begin 'grasp' until right has ended 'insert'; "
        r"right waits to begin 'lift' until left has ended 'hold'\. Change task_constraint_configs"
    )
    with pytest.raises(DeadlockError, match=text):
        Schedule(SIGNALS, crossed).tick()
    with pytest.raises(DeadlockError, match="waits"):
        rehearse(SIGNALS, crossed)


def test_crossed_coordinations_and_one_that_nobody_comes_to_are_deadlocks():
    crossed = [together(("left", 0), INSERT), together(HOLD, ("right", 0))]
    with pytest.raises(DeadlockError, match=r"left waits in 'grasp' for right to come to its part of 'insert'"):
        rehearse(SIGNALS, crossed)
    both = [together(HOLD, INSERT, coordination_synchronize_start=True), after(INSERT, ("left", 0))]
    said = r"left waits to begin 'grasp'.*right waits to begin 'insert' until left begins"
    with pytest.raises(DeadlockError, match=said):
        rehearse(SIGNALS, both)


def test_who_is_held_from_outside_is_no_deadlock():
    schedule = Schedule(SIGNALS)
    schedule.plan("left", 1)
    schedule.plan("right", 1)
    assert schedule.tick(["left", "right"]) == {}


def test_a_trajectory_of_no_steps_is_refused():
    with pytest.raises(TaccorlError, match="right: 4 of 3 steps together"):
        Schedule(SIGNALS).plan("right", 3, 4)
