"""Sources cut into subtasks: which edges count, and what does not fit is named."""

import dataclasses

import numpy as np
import pytest
from ideal_hands import LIFTED_ROW, NUM_ROWS, demonstration, mimic_spec, scene

from taccorl.episodes.sources.mimicgen.schedule import ConstraintSpec
from taccorl.episodes.sources.mimicgen.source import Segment, SourcePool, contact_row, first_rise, subtask_ends
from taccorl.errors import DatasetError

JOIN = "join plug"


def with_signal(source, name, rises, falls=None):
    signal = np.arange(NUM_ROWS) >= rises
    if falls is not None:
        signal &= np.arange(NUM_ROWS) < falls
    return dataclasses.replace(source, signals=source.signals | {"right": source.signals["right"] | {name: signal}})


def with_offsets(spec, arm, *ranges):
    subtasks = [
        dataclasses.replace(s, subtask_term_offset_range=r)
        for s, r in zip(spec.subtask_configs[arm], ranges, strict=True)
    ]
    return dataclasses.replace(spec, subtask_configs=spec.subtask_configs | {arm: tuple(subtasks)})


def test_an_edge_back_is_no_end_and_neither_is_one_before_its_turn():
    signal = np.array([1, 1, 0, 0, 1, 0, 1, 1], bool)
    assert first_rise(signal, 0) == 4  # not 2, where it falls
    assert first_rise(signal, 4) == 6
    assert first_rise(signal, 6) is None
    assert first_rise(np.ones(5, bool), 0) is None  # it never was false


def test_subtasks_end_at_rises_in_order_and_the_last_one_with_the_source():
    source = demonstration(scene())
    assert subtask_ends(source, "right", ("grasp plug", JOIN)) == (LIFTED_ROW["right"], NUM_ROWS)
    # The signal was up once before its turn, fell, and rose: only the last edge counts.
    early = with_signal(source, "grasp plug", 10, 14)
    again = early.signals["right"]["grasp plug"] | (np.arange(NUM_ROWS) >= 30)
    source = dataclasses.replace(early, signals=early.signals | {"right": dict(early.signals["right"], late=again)})
    assert subtask_ends(source, "right", ("grasp plug", "late", JOIN)) == (10, 30, NUM_ROWS)


def test_a_source_that_does_not_fit_is_named_with_what_is_wrong():
    source, spec = demonstration(scene(), name="cups episode 3"), mimic_spec()
    said = r"cups episode 3: right arm, subtask 'join plug': ends at row 9, before 'grasp plug'"
    with pytest.raises(DatasetError, match=said):
        SourcePool(spec, [with_signal(source, JOIN, 9)])
    with pytest.raises(DatasetError, match=r"subtask 'join plug':.*never ends"):
        SourcePool(spec, [with_signal(source, JOIN, NUM_ROWS)])
    with pytest.raises(DatasetError, match="no sources; taccorl collect --task=boxes"):
        SourcePool(spec, [])


def test_offsets_move_ends_and_those_that_could_leave_no_rows_are_refused():
    source, spec = demonstration(scene()), mimic_spec()
    pool = SourcePool(with_offsets(spec, "right", (2, 5), (0, 0)), [source])
    end = LIFTED_ROW["right"]
    assert pool.segment(0, "right", 0, {("right", 0): 4}) == Segment(0, end + 4)
    assert pool.segment(0, "right", 1, {("right", 0): 4}).start == end + 4
    said = r"right subtask 'join plug'.*ends at row 60, but may begin at row 60: after its own"
    with pytest.raises(DatasetError, match=said):
        SourcePool(with_offsets(spec, "right", (0, 40), (0, 0)), [source])


def test_coordinated_segments_share_their_ends_or_begin_together():
    source = demonstration(scene())
    pool = SourcePool(mimic_spec(), [source])
    assert pool.segment(0, "left", 1, {}) == Segment(LIFTED_ROW["left"], NUM_ROWS, NUM_ROWS - LIFTED_ROW["right"])
    assert pool.segment(0, "right", 1, {}) == Segment(LIFTED_ROW["right"], NUM_ROWS, NUM_ROWS - LIFTED_ROW["right"])
    together = SourcePool(mimic_spec(synchronize_start=True), [source])
    for arm in ("left", "right"):  # the right one lifts later
        assert together.segment(0, arm, 1, {}) == Segment(LIFTED_ROW["right"], NUM_ROWS, NUM_ROWS - LIFTED_ROW["right"])


def test_what_waited_for_the_other_arm_begins_where_that_one_ended():
    spec = dataclasses.replace(
        mimic_spec(),
        task_constraint_configs=(
            ConstraintSpec(eef_subtask_constraint_tuple=(("right", 0), ("left", 1)), constraint_type="sequential"),
        ),
    )
    pool = SourcePool(spec, [demonstration(scene())])
    assert pool.segment(0, "left", 1, {}).start == LIFTED_ROW["right"] > LIFTED_ROW["left"]


def test_contact_begins_before_what_is_held_touches_its_mate():
    source, whole = demonstration(scene()), Segment(30, NUM_ROWS)
    assert contact_row(source, ["plug"], whole, 4) == 40  # they touch from row 44 on
    assert contact_row(source, ["plug"], whole, 30) == 30  # not before the segment
    assert contact_row(source, [], whole, 4) == NUM_ROWS
    assert contact_row(source, ["plug"], Segment(0, 40), 4) == 40  # not in this one
