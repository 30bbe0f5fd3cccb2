"""Specs of generation: the shipped ones fit their tasks, and a slip is named with file, line and what is near."""

import re

import pytest
import yaml

from taccorl.episodes.sources.mimicgen.spec import check_task, load_mimic_spec, mimic_spec_path, with_options
from taccorl.errors import SpecError, TaccorlError
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
    assert re.search(r"mine\.yaml:(?!1:)\d+", str(error.value)) or "spec_version" in old or "deadlock" in said


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("grasp plug", "grasp plog", r"right → 0: no subtask 'grasp plog'; did you mean 'grasp plug'"),
        ("held_object: cradle", "held_object: cradel", r"left → 1 → held_object: no 'cradel'; did you mean 'cradle'"),
        ("task: assembly_2", "task: assembly_1", r"mimicgen spec of assembly_1: the task is assembly_2"),
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
