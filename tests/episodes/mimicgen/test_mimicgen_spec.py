"""Specs of generation: the shipped ones fit their tasks, and a slip is named with file, line and what is near."""

import re

import pytest
import yaml

from taccorl.episodes.sources.mimicgen.schedule import (
    ConstraintSpec,
    Cue,
    Schedule,
    rehearse,
)
from taccorl.episodes.sources.mimicgen.spec import (
    check_task,
    load_mimic_spec,
    mimic_spec_path,
    with_options,
)
from taccorl.errors import DeadlockError, SpecError, TaccorlError
from taccorl.sim.task import tasks


def test_digest_changes_with_what_decides_and_not_with_layout(tmp_path):
    path = tmp_path / "a.yaml"
    document = yaml.safe_load(mimic_spec_path("assembly_2").read_text())
    path.write_text(yaml.safe_dump(document, default_flow_style=True))
    spec = load_mimic_spec("assembly_2")
    assert load_mimic_spec(path).digest == spec.digest
    assert with_options(spec, retarget="eef").digest != spec.digest
    with pytest.raises(TaccorlError, match="no 'retarge'; did you mean 'retarget'"):
        with_options(spec, retarge="eef")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("object_ref: plug", "object_rev: plug", r"unknown key 'object_rev'; did you mean 'object_ref'"),
        ("coordination_scheme: replay", "coordination_scheme: replai", r"'replai' is not one of .*did you mean 'replay'"),
        ("nearest_neighbor_object", "nearest_neighbour_object", r"did you mean 'nearest_neighbor_object'"),
        ("[[left, 1], [right, 1]]", "[[left, 1], [right, 2]]", r"no subtask 2 of 'right'; left has 0 … 1, right has 0 … 1"),
        ("[[left, 1], [right, 1]]", "[[left, 0], [left, 1]]", r"both are of the left arm"),
        ("[2, 6]", "[6, 2]", r"\[6, 2\]: the lower bound comes first"),
        ("held_object: cradle", "held_object: cradle, subtask_term_offset_range: [0, 4]", r"an arm's last subtask ends where"),
        ("subtask_term_signal: grasp cradle", "subtask_term_signal: null", r"null: only an arm's last subtask"),
        ("spec_version: 1", "spec_version: 2", r"this taccorl reads version 1"),
        (
            "task: assembly_2",
            "task: assembly_2\ndatagen_config: {disturbance: {joint_rad: -0.02}}",
            r"disturbance → joint_rad: -0\.02 is out of range; give a number ≥ 0",
        ),
        ("task: assembly_2", "task: assembly_2\ndatagen_config: {disturbance: {time_s: 0}}", r"give a number > 0"),
        ("task: assembly_2", "task: assembly_2\ndatagen_config: {disturbance: {time_s: 1}}", r"without joint_rad"),
        ("task: assembly_2", "task: assembly_2\ndatagen_config: {disturbance: {joint_rad: .nan}}", r"found '\.nan'"),
        ("task: assembly_2", "task: assembly_2\ndatagen_config: {disturbance: {joint_rad: .inf}}", r"found '\.inf'"),
        ("task: assembly_2", "task: assembly_2\ndatagen_config: {contact_mode: closed_loop_exprt}", r"mean 'closed_loop_expert'"),
        (
            "task: assembly_2",
            "task: assembly_2\ndatagen_config: {contact_mode: closed_loop_expert, retarget: eef_command}",
            r"retarget: eef_command sends poses as commanded",
        ),
        ("task: assembly_2", "task: assembly_2\ngates: {max_force_n: -5}", r"-5: nothing would pass; give a number > 0"),
        (
            "[[left, 1], [right, 1]], constraint_type: coordination, coordination_scheme: replay}",
            "[[left, 1], [right, 0]], constraint_type: sequential}\n"
            "  - {eef_subtask_constraint_tuple: [[right, 1], [left, 0]], constraint_type: sequential}",
            r"deadlock: left waits to begin 'grasp cradle' until right has ended 'insert plug'; right waits",
        ),
    ],
)  # fmt: skip
def test_a_slip_in_a_spec_is_named_with_its_place(old, new, said, tmp_path):
    text = mimic_spec_path("assembly_2").read_text()
    assert old in text
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(SpecError, match=rf"mine\.yaml:\d+: .*{said}") as error:
        load_mimic_spec(path)
    assert (
        re.search(r"mine\.yaml:(?!1:)\d+", str(error.value))
        or "spec_version" in old
        or "deadlock" in said
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "grasp plug",
            "grasp plog",
            r"right → 0: no subtask 'grasp plog'; did you mean 'grasp plug'",
        ),
        (
            "held_object: cradle",
            "held_object: cradel",
            r"left → 1 → held_object: no 'cradel'; did you mean 'cradle'",
        ),
        (
            "task: assembly_2",
            "task: assembly_1",
            r"mimicgen spec of assembly_1: the task is assembly_2",
        ),
        (
            "task_constraint_configs",
            "symmetry: {plugg: 2}\ntask_constraint_configs",
            r"symmetry: no 'plugg'; did you mean 'plug'",
        ),
    ],
)
def test_a_spec_that_is_not_the_tasks_is_named(old, new, said, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(mimic_spec_path("assembly_2").read_text().replace(old, new, 1))
    with pytest.raises(SpecError, match=said):
        check_task(load_mimic_spec(path), tasks.get("assembly_2")())


# ---- two arms step by step: tables written by hand, and deadlocks that are named ----


SIGNALS = {"left": ("grasp", "hold"), "right": ("lift", "insert")}
HOLD, INSERT = ("left", 1), ("right", 1)


def after(former, latter, kind="sequential", **more):
    return ConstraintSpec(
        eef_subtask_constraint_tuple=(former, latter), constraint_type=kind, **more
    )


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
        told = [
            f"{cues[a].subtask}.{cues[a].step}" if a in cues else "-"
            for a in ("left", "right")
        ]
        rows.append(" ".join(told))
    return rows


LENGTHS = {("left", 0): 2, ("left", 1): 3, ("right", 0): 3, ("right", 1): 2}


def test_without_constraints_each_arm_goes_its_own_way_and_then_stands():
    assert table(Schedule(SIGNALS), LENGTHS) == [
        "0.0 0.0",
        "0.1 0.1",
        "1.0 0.2",
        "1.1 1.0",
        "1.2 1.1",
    ]
    shorter = LENGTHS | {("left", 1): 1}
    assert table(Schedule(SIGNALS), shorter) == [
        "0.0 0.0",
        "0.1 0.1",
        "1.0 0.2",
        "- 1.0",
        "- 1.1",
    ]


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
    expected = [
        "0.0 0.0",
        "1.0 0.1",
        "1.1 0.2",
        "1.2 0.3",
        "- 0.4",
        "- 1.0",
        "1.3 1.1",
        "1.4 1.2",
    ]
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
    with pytest.raises(
        DeadlockError,
        match=r"left waits in 'grasp' for right to come to its part of 'insert'",
    ):
        rehearse(SIGNALS, crossed)
    both = [
        together(HOLD, INSERT, coordination_synchronize_start=True),
        after(INSERT, ("left", 0)),
    ]
    said = (
        r"left waits to begin 'grasp'.*right waits to begin 'insert' until left begins"
    )
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
