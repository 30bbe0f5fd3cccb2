"""Sources cut into subtasks: which edges count, and what does not fit is named."""

import dataclasses

import numpy as np
import pytest
from ideal_hands import LIFTED_ROW, NUM_ROWS, demonstration, mimic_spec, scene

from taccorl.episodes.sources.collect import CollectPlan
from taccorl.episodes.sources.mimicgen.grips import FEWEST, grips_report, tcp_from_part
from taccorl.episodes.sources.mimicgen.schedule import ConstraintSpec
from taccorl.episodes.sources.mimicgen.source import (
    Segment,
    Source,
    SourcePool,
    contact_row,
    first_rise,
    subtask_ends,
)
from taccorl.episodes.sources.mimicgen.touching import Touching
from taccorl.errors import DatasetError
from taccorl.robots import ROBOT

JOIN = "join plug"


def with_signal(source, name, rises, falls=None):
    signal = np.arange(NUM_ROWS) >= rises
    if falls is not None:
        signal &= np.arange(NUM_ROWS) < falls
    return dataclasses.replace(
        source,
        signals=source.signals | {"right": source.signals["right"] | {name: signal}},
    )


def with_offsets(spec, arm, *ranges):
    subtasks = [
        dataclasses.replace(s, subtask_term_offset_range=r)
        for s, r in zip(spec.subtask_configs[arm], ranges, strict=True)
    ]
    return dataclasses.replace(
        spec, subtask_configs=spec.subtask_configs | {arm: tuple(subtasks)}
    )


def test_an_edge_back_is_no_end_and_neither_is_one_before_its_turn():
    signal = np.array([1, 1, 0, 0, 1, 0, 1, 1], bool)
    assert first_rise(signal, 0) == 4  # not 2, where it falls
    assert first_rise(signal, 4) == 6
    assert first_rise(signal, 6) is None
    assert first_rise(np.ones(5, bool), 0) is None  # it never was false


def test_subtasks_end_at_rises_in_order_and_the_last_one_with_the_source():
    source = demonstration(scene())
    assert subtask_ends(source, "right", ("grasp plug", JOIN)) == (
        LIFTED_ROW["right"],
        NUM_ROWS,
    )
    # The signal was up once before its turn, fell, and rose: only the last edge counts.
    early = with_signal(source, "grasp plug", 10, 14)
    again = early.signals["right"]["grasp plug"] | (np.arange(NUM_ROWS) >= 30)
    source = dataclasses.replace(
        early,
        signals=early.signals | {"right": dict(early.signals["right"], late=again)},
    )
    assert subtask_ends(source, "right", ("grasp plug", "late", JOIN)) == (
        10,
        30,
        NUM_ROWS,
    )


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
    assert pool.segment(0, "left", 1, {}) == Segment(
        LIFTED_ROW["left"], NUM_ROWS, NUM_ROWS - LIFTED_ROW["right"]
    )
    assert pool.segment(0, "right", 1, {}) == Segment(
        LIFTED_ROW["right"], NUM_ROWS, NUM_ROWS - LIFTED_ROW["right"]
    )
    together = SourcePool(mimic_spec(synchronize_start=True), [source])
    for arm in ("left", "right"):  # the right one lifts later
        assert together.segment(0, arm, 1, {}) == Segment(
            LIFTED_ROW["right"], NUM_ROWS, NUM_ROWS - LIFTED_ROW["right"]
        )


def test_what_waited_for_the_other_arm_begins_where_that_one_ended():
    spec = dataclasses.replace(
        mimic_spec(),
        task_constraint_configs=(
            ConstraintSpec(
                eef_subtask_constraint_tuple=(("right", 0), ("left", 1)),
                constraint_type="sequential",
            ),
        ),
    )
    pool = SourcePool(spec, [demonstration(scene())])
    assert (
        pool.segment(0, "left", 1, {}).start == LIFTED_ROW["right"] > LIFTED_ROW["left"]
    )


def test_contact_begins_before_what_is_held_touches_its_mate():
    source, whole = demonstration(scene()), Segment(30, NUM_ROWS)
    assert contact_row(source, ["plug"], whole, 4) == 40  # they touch from row 44 on
    assert contact_row(source, ["plug"], whole, 30) == 30  # not before the segment
    assert contact_row(source, [], whole, 4) == NUM_ROWS
    assert contact_row(source, ["plug"], Segment(0, 40), 4) == 40  # not in this one


# ---- different grips of sources ----


def moved(source: Source, *, mm: float = 0.0, deg: float = 0.0) -> Source:
    """A copy of the demonstration, its plug moved by ``mm`` [mm] along its x axis and turned by ``deg`` [°] about it."""
    pose, angle = np.eye(4), np.radians(deg)
    pose[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[0, 3] = mm / 1e3
    return dataclasses.replace(
        source, objects={**source.objects, "plug": source.objects["plug"] @ pose}
    )


def test_grips_differ_by_half_a_millimetre_or_a_degree() -> None:
    """Of plugs 0, 0.4, 0.6 and 0.9 mm along and 0.9 and 1.1 degrees about x: 0.4 mm and 0.9 degrees are as 0, 0.9 mm as 0.6; the
    cradle is gripped alike in all, and no hand holds the other's part."""
    source = demonstration(scene())
    plugs = [{}, {"mm": 0.4}, {"mm": 0.6}, {"mm": 0.9}, {"deg": 0.9}, {"deg": 1.1}]
    found = [
        tuple(hand.values())
        for hand in grips_report([moved(source, **how) for how in plugs])["hands"]
    ]
    assert found == [("left", "cradle", 6, 1), ("right", "plug", 6, 3)]
    assert grips_report([source])["few"]


@pytest.mark.parametrize("num", [FEWEST - 1, FEWEST])
def test_fewer_than_fifty_of_one_part_are_few(num: int) -> None:
    source = demonstration(scene())
    only_plug = {
        arm: {name: rows & (name == "plug") for name, rows in own.items()}
        for arm, own in source.held.items()
    }
    sources = [
        dataclasses.replace(moved(source, mm=0.6 * k), held=only_plug)
        for k in range(num)
    ]
    assert grips_report(sources) == {
        "hands": [{"arm": "right", "part": "plug", "sources": num, "different": num}],
        "few": num < FEWEST,
    }


def test_the_pose_is_of_a_row_in_which_only_the_hand_touches_the_part() -> None:
    """Rows 0 … 9 with the hand at the origin and the plug t mm along x; held in rows 2 … 8, free in 4 … 6: row 5."""
    source, t = demonstration(scene()), np.arange(10)
    poses = np.repeat(np.eye(4)[None], 10, axis=0)
    poses[:, 0, 3] = t / 1e3
    arms = {
        **source.arms,
        "right": dataclasses.replace(
            source.arms["right"], tcp=np.repeat(np.eye(4)[None], 10, axis=0)
        ),
    }
    held = {"left": {"plug": t < 0}, "right": {"plug": (t >= 2) & (t <= 8)}}
    given = dataclasses.replace(
        source,
        arms=arms,
        objects={"plug": poses},
        held=held,
        free={"plug": (t >= 4) & (t <= 6)},
    )
    pose = tcp_from_part(given, "right", "plug")
    assert pose is not None and pose[0, 3] == pytest.approx(5e-3)
    never_free = dataclasses.replace(
        given, free={"plug": t < 0}, held={**held, "right": {"plug": t >= 7}}
    )
    pose = tcp_from_part(never_free, "right", "plug")
    assert pose is not None and pose[0, 3] == pytest.approx(8e-3)
    assert tcp_from_part(given, "left", "plug") is None


@pytest.mark.slow
def test_a_hand_holds_where_the_sensors_of_both_its_pads_touch() -> None:
    plan = CollectPlan(task="assembly_1", images=False)
    sim = plan.make()
    touching, seen = Touching(sim), {True: 0, False: 0}
    sim.reset([plan.attempt_seed(0)])
    for t, targets in enumerate(plan.source.actions(sim, np.random.default_rng(0))):
        if t % 10 == 0:
            touching.look(sim.state_rows()[0])
            for part in sim.task.parts:
                pads = sim.pads_touching(part)[0].reshape(
                    len(ROBOT.arms), len(ROBOT.fingers)
                )
                for arm, both in zip(ROBOT.arms, pads.all(axis=1), strict=True):
                    assert touching.holds(arm, part) == both, (t, arm, part)
                    seen[bool(both)] += 1
        sim.step(targets.sent[None].astype(np.float64))
        if sim.judge.outcome.over[0]:
            break
    sim.close()
    assert seen[True] > 10 and seen[False] > 10
