"""Different grips of sources: counted where the answer is known, and seen in the twin as its own sensors see them."""

import dataclasses

import numpy as np
import pytest
from ideal_hands import demonstration, scene

from taccorl.episodes.sources.collect import CollectPlan
from taccorl.episodes.sources.mimicgen.grips import FEWEST, grips_report, tcp_from_part
from taccorl.episodes.sources.mimicgen.source import Source
from taccorl.episodes.sources.mimicgen.touching import Touching
from taccorl.robots import ROBOT


def moved(source: Source, *, mm: float = 0.0, deg: float = 0.0) -> Source:
    """The source with its plug moved along, and turned about, its own x axis."""
    pose, angle = np.eye(4), np.radians(deg)
    pose[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[0, 3] = mm / 1e3
    return dataclasses.replace(source, objects={**source.objects, "plug": source.objects["plug"] @ pose})


def test_grips_differ_by_half_a_millimetre_or_a_degree() -> None:
    """Of plugs 0, 0.4, 0.6 and 0.9 mm along and 0.9 and 1.1 degrees about x: 0.4 mm and 0.9 degrees are as 0, 0.9 mm as 0.6; the
    cradle is gripped alike in all, and no hand holds the other's part."""
    source = demonstration(scene())
    plugs = [{}, {"mm": 0.4}, {"mm": 0.6}, {"mm": 0.9}, {"deg": 0.9}, {"deg": 1.1}]
    found = [tuple(hand.values()) for hand in grips_report([moved(source, **how) for how in plugs])["hands"]]
    assert found == [("left", "cradle", 6, 1), ("right", "plug", 6, 3)]
    assert grips_report([source])["few"]


@pytest.mark.parametrize("num", [FEWEST - 1, FEWEST])
def test_fewer_than_fifty_of_one_part_are_few(num: int) -> None:
    source = demonstration(scene())
    only_plug = {arm: {name: rows & (name == "plug") for name, rows in own.items()} for arm, own in source.held.items()}
    sources = [dataclasses.replace(moved(source, mm=0.6 * k), held=only_plug) for k in range(num)]
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
        "right": dataclasses.replace(source.arms["right"], tcp=np.repeat(np.eye(4)[None], 10, axis=0)),
    }
    held = {"left": {"plug": t < 0}, "right": {"plug": (t >= 2) & (t <= 8)}}
    given = dataclasses.replace(
        source, arms=arms, objects={"plug": poses}, held=held, free={"plug": (t >= 4) & (t <= 6)}
    )
    pose = tcp_from_part(given, "right", "plug")
    assert pose is not None and pose[0, 3] == pytest.approx(5e-3)
    never_free = dataclasses.replace(given, free={"plug": t < 0}, held={**held, "right": {"plug": t >= 7}})
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
                pads = sim.pads_touching(part)[0].reshape(len(ROBOT.arms), len(ROBOT.fingers))
                for arm, both in zip(ROBOT.arms, pads.all(axis=1), strict=True):
                    assert touching.holds(arm, part) == both, (t, arm, part)
                    seen[bool(both)] += 1
        sim.step(targets.sent[None].astype(np.float64))
        if sim.judge.outcome.over[0]:
            break
    sim.close()
    assert seen[True] > 10 and seen[False] > 10
