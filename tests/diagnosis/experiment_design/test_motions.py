"""Which motion to record next: pairs that nothing, something or one thing tells apart, and motions that must not be made."""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from imagined_motions import SIGNAL, recorded

from taccorl.alignment.controller import arm_joint
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.motions import (
    CHIRP,
    LIBRARY,
    MARGIN_RAD,
    POSES,
    REST_S,
    STIFFER_CHIRP,
)
from taccorl.cli.plan_words import words
from taccorl.diagnosis.experiment_design import motions
from taccorl.diagnosis.experiment_design.motions import JointPart, arm_ground, rest_pose
from taccorl.diagnosis.experiment_design.plan import (
    SAME,
    TELLS,
    Plan,
    Planned,
    best_first,
    plan,
    scored,
)
from taccorl.errors import TaccorlError
from taccorl.report.planned import planned as shown
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig

FLOOR_RAD = 2e-4
NOMINAL = TwinConfig()
COLUMN = ROBOT.action_names.index(SIGNAL)


def planned(
    *rivals: str, config: TwinConfig = NOMINAL, signal: str = SIGNAL, **options
) -> Plan:
    ground = arm_ground(config, signal, options.pop("pose", rest_pose(signal, None)))
    return scored(
        JointPart(ground, FLOOR_RAD, options.pop("measurements", None), **options),
        rivals,
        {},
    )


def targets(p: Planned) -> np.ndarray:
    """(T,) targets [rad]."""
    (column,) = p.columns.values()
    return column


@pytest.fixture(scope="module")
def frictions() -> Plan:
    return planned("viscous_friction", "coulomb_friction", gains="commanded")


@pytest.mark.slow
def test_two_frictions_are_told_apart_and_the_best_motion_comes_first(frictions):
    assert frictions.hopeless == ()
    assert frictions.planned[0].worst > TELLS
    worst = [p.worst for p in frictions.planned]
    assert worst == sorted(worst, reverse=True)
    assert worst[-1] < TELLS, "not any motion will do"


@pytest.mark.slow
def test_recordings_that_are_there_count(frictions):
    """One motion alone with K_p and K_d free: K_d takes up the viscous one, and Coulomb's may be 0. With a chirp at hand, the
    chirp at twice the gain tells what it could not alone."""
    known = Measurements((recorded(NOMINAL, CHIRP, 0, stated=False),))
    found = planned(
        "viscous_friction", "coulomb_friction", gains="fitted", measurements=known
    )
    alone = planned("viscous_friction", "coulomb_friction", gains="fitted")
    stiffer = [
        next(p for p in of.planned if p.name == STIFFER_CHIRP.name)
        for of in (found, alone)
    ]
    assert stiffer[0].worst > 10 * stiffer[1].worst
    assert alone.planned[0].worst < SAME and frictions.planned[0].worst > TELLS


@pytest.mark.slow
def test_three_rivals_are_three_pairs_and_the_worst_counts():
    found = planned(
        "viscous_friction", "coulomb_friction", "asymmetric_friction", gains="commanded"
    )
    assert all(len(p.discrimination) == 3 for p in found.planned)
    assert all(p.worst == min(p.discrimination.values()) for p in found.planned)
    pair = "coulomb_friction | asymmetric_friction"  # one by algebra: hopeless on every motion
    assert found.hopeless == (pair,) and len(found.planned) == len(LIBRARY)
    assert all(p.discrimination[pair] < SAME for p in found.planned)


@pytest.mark.parametrize("rivals", [(), ("backlash",), ("backlash", "backlash")])
def test_less_than_two_rivals_are_refused(rivals):
    with pytest.raises(TaccorlError, match="two or more effects"):
        planned(*rivals)


def test_an_unknown_rival_is_refused_with_the_nearest_name():
    with pytest.raises(TaccorlError, match=r"no effect 'backlsh'.*backlash"):
        planned("backlsh", "coulomb_friction")


@pytest.mark.slow
def test_every_target_keeps_the_joint_s_limits_and_rests_at_both_ends(frictions):
    rest = round(REST_S * 200)
    for p in frictions.planned:
        assert (
            ROBOT.action_low[COLUMN] <= targets(p).min()
            and targets(p).max() <= ROBOT.action_high[COLUMN]
        )
        assert np.ptp(targets(p)[:rest]) == np.ptp(targets(p)[-rest:]) == 0.0


@pytest.mark.slow
def test_near_a_limit_the_room_is_smaller_and_the_limit_is_kept():
    pose = rest_pose(SIGNAL, None)
    pose[4] = ROBOT.action_high[COLUMN] - 0.2
    found = planned(
        "coulomb_friction", "viscous_friction", gains="commanded", pose=pose
    )
    assert len(found.planned) == len(LIBRARY)
    assert all(
        targets(p).max() <= ROBOT.action_high[COLUMN] - MARGIN_RAD + 1e-6
        for p in found.planned
    )


@pytest.mark.slow
def test_a_motion_that_needs_more_torque_than_the_motor_may_give_is_refused():
    """A drive four times as stiff jerks joint 2: steps at 3 rad/s need more than 25 N·m, a slow triangle does not."""
    config = TwinConfig()
    config.controller.kp_nm_per_rad[1] *= 4.0
    found = planned(
        "coulomb_friction",
        "viscous_friction",
        config=config,
        signal="left_joint2",
        gains="commanded",
    )
    assert set(found.refused) | {p.name for p in found.planned} == {
        m.name for m in LIBRARY
    }
    assert "steps" in found.refused and "of 25" in found.refused["steps"]
    assert "slow_triangle" not in found.refused
    assert all(p.peak <= 25.0 for p in found.planned)


@pytest.mark.slow
def test_a_constant_torque_moves_where_the_joint_rests_and_is_no_jerk_at_the_start():
    """Resting, K_p (q* − q) + T_ref = 0 whatever T_ref is: what a motion needs of the motor does not depend on it."""
    without, with_it = TwinConfig(), TwinConfig()
    without.controller.torque_ff_nm[4], with_it.controller.torque_ff_nm[4] = 0.0, 1.73
    peaks = [
        {
            p.name: p.peak
            for p in planned("coulomb_friction", "viscous_friction", config=c).planned
        }
        for c in (without, with_it)
    ]
    assert peaks[0] == pytest.approx(peaks[1], rel=0.05)


def test_an_imagined_recording_says_so_and_has_the_noise_that_was_asked_for():
    part = JointPart(arm_ground(NOMINAL, SIGNAL, rest_pose(SIGNAL, None)), FLOOR_RAD)
    clean = part.offer(CHIRP, {})
    m = clean.made[0]
    assert "imagined" in m.origin.text
    noisy = part.scene(clean).recordings[-1]
    assert np.std(noisy.measured[:, 0] - m.measured[:, COLUMN]) == pytest.approx(
        FLOOR_RAD, rel=0.05
    )
    assert noisy.floor == pytest.approx([FLOOR_RAD])
    assert m.kp == {SIGNAL: 151.1}
    np.testing.assert_array_equal(m.target[:, COLUMN], CHIRP.target(part.ground.room))


def test_the_arm_stands_as_in_the_recordings_that_sweep_the_joint():
    assert rest_pose(SIGNAL, None)[:6] == pytest.approx(POSES[4])
    m = recorded(NOMINAL, CHIRP, 0)
    m.target[:, ROBOT.action_names.index("left_joint2")] += 0.1
    expected = np.array(POSES[4])
    expected[1] += 0.1
    assert rest_pose(SIGNAL, Measurements((m,)))[:6] == pytest.approx(expected)


def test_peak_torque_includes_the_carried_weight_and_the_pose_is_stated():
    """Joint 3 at POSES[2], 0.3 kg at the TCP: at rest the motor carries the weight of what is beyond it."""
    signal = "left_joint3"
    pose = rest_pose(signal, None)
    still = dataclasses.replace(
        CHIRP, target=lambda room: np.full(200, room.middle_rad)
    )
    part = JointPart(arm_ground(NOMINAL, signal, pose), FLOOR_RAD)
    body = arm_joint.rigid(NOMINAL, signal, pose, 0.0, [])
    weight_nm = abs(
        body.compensation_sin * np.sin(pose[2])
        + body.compensation_cos * np.cos(pose[2])
    )
    assert weight_nm > 0.5
    assert part.offer(still, {}).peak == pytest.approx(weight_nm, rel=0.02)
    found = part.pose
    assert list(found) == [
        "left_joint1",
        "left_joint2",
        "left_joint4",
        "left_joint5",
        "left_joint6",
        "left_gripper",
    ]
    assert found["left_joint2"] == POSES[2][1]


@pytest.mark.parametrize(
    ("num", "scores", "expected"),
    [
        (1, {"one": [(0.9, 0.8)], "two": [(4.0, 0.1)], "three": [(0.7, 0.7)]}, {"two"}),
        (
            2,
            {"one": [(0.9, 0.8)], "two": [(4.0, 0.1)], "three": [(0.7, 0.7)]},
            {"one", "two"},
        ),
        (
            1,
            {"one": [(0.9, 0.8)], "two": [(4.0, 0.1)], "three": [(0.2, 3.0)]},
            {"two", "three"},
        ),
        (
            2,
            {"one": [(4.0, 3.0)], "two": [(9.0, 0.1)], "three": [(2.0, 2.5)]},
            {"one", "three"},
        ),
        (
            1,
            {
                "even": [(1, 1)] * 3,
                "one": [(9, 9), (0, 0), (9, 9)],
                "two": [(0, 0), (9, 9), (0, 0)],
            },
            {"one", "two"},
        ),
    ],
)
def test_a_plan_has_the_motions_that_its_message_recommends_and_one_for_each_pair(
    num, scores, expected
):
    part = JointPart(arm_ground(NOMINAL, SIGNAL, rest_pose(SIGNAL, None)), FLOOR_RAD)
    rivals = ("a", "b", "c") if "even" in scores else ("a", "b")
    pairs = [f"{a} | {b}" for a, b in itertools.combinations(rivals, 2)]
    every = [
        Planned(
            part=part,
            item=dataclasses.replace(CHIRP, name=name),
            columns={},
            peak=0.0,
            made=None,
            ways=ways,
        )
        for name, own in scores.items()
        for ways in [dict(zip(pairs, own, strict=True))]
    ]
    found = Plan(SIGNAL, rivals, 1.0, best_first(every), {})
    assert {p.name for p in found.written(num)} == expected
    section = shown(found, part, words)
    told = [
        f"{sum(s >= TELLS for s in p.discrimination.values())} of 3"
        for p in found.planned
    ]
    assert len(section.heads) == 5 and (
        [row[-1] for row in section.rows] == told or len(rivals) == 2
    )
    assert len(rivals) == 2 or {
        pair for pair in pairs if pair in str(section.parts)
    } == {*pairs}
    recommended = {p.name for _, _, p, _ in found.one_way()}
    assert recommended <= expected and bool(recommended) == bool(found.hopeless)


def test_efforts_are_tried_where_positions_separate_nothing(monkeypatch):
    """With K_p and K_d fitted, K_d takes up the viscous friction; the motor's effort shows both."""
    monkeypatch.setattr(motions, "LIBRARY", [m for m in LIBRARY if m.name == "holds"])
    part = JointPart(
        arm_ground(NOMINAL, SIGNAL, rest_pose(SIGNAL, None)), FLOOR_RAD, gains="fitted"
    )
    pair = "viscous_friction | coulomb_friction"
    found = plan(part, pair.split(" | "))
    assert (
        found.at_first(pair) < SAME and found.best(pair) > TELLS and not found.hopeless
    )
    assert [p.name for p in found.written(1)] == ["holds_with_efforts"]
    (where, best), *_ = found.tried.items()
    assert "effort" in where and "0.5%" in where and best == {pair: found.best(pair)}
    (lines,) = shown(found, part, words).parts
    assert any(
        pair in str(line) and f"{found.best(pair):.2f} {where}" in str(line)
        for line in lines.text
    )


@pytest.mark.parametrize(
    ("with_efforts", "names", "hopeless"),
    [
        ((2.0, 0.3), {"chirp", "chirp_with_efforts"}, True),
        ((3.0, 3.5), {"chirp", "chirp_with_efforts"}, False),
        ((0.2, 0.3), {"chirp"}, True),
        (None, {"chirp"}, True),
    ],
)
def test_what_only_efforts_show_is_planned_with_them(
    with_efforts, names, hopeless, monkeypatch
):
    """a | b: 0.1 floors without efforts; with them those of b fitted to a's data, and of a
    to b's."""

    def made(label: str, ways: tuple[float, float] | None) -> Any:
        return SimpleNamespace(
            label=label,
            where=f"{label}, too",
            ways={"a | b": ways},
            with_efforts=lambda: with_efforts and made("with_efforts", with_efforts),
        )

    def of(part, rivals, *_) -> Plan:
        of_item = Planned(
            part=part, item=CHIRP, columns={}, peak=0.0, made=None, ways=part.ways
        )
        return Plan(SIGNAL, rivals, 1.0, (of_item,), {})

    monkeypatch.setattr("taccorl.diagnosis.experiment_design.plan.scored", of)
    found = plan(made("", (0.1, 0.1)), ("a", "b"))
    assert {p.name for p in found.planned} == names
    assert bool(found.hopeless) == hopeless
    recommended = {p.name for _, _, p, _ in found.one_way()}
    if not recommended:
        recommended = {found.planned[0].name}
    assert {p.name for p in found.written(1)} >= recommended
    tried = with_efforts and {"with_efforts, too": {"a | b": min(with_efforts)}}
    assert found.tried == (tried or {})
