"""Which motion to record next: pairs that nothing, something or one thing tells apart, and motions that must not be made."""

import dataclasses

import numpy as np
import pytest
from imagined_motions import SIGNAL, recorded

from taccorl.alignment.controller import arm_bench
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.motions import CHIRP, LIBRARY, MARGIN_RAD, POSES, REST_S, STIFFER_CHIRP
from taccorl.diagnosis.experiment_design.excitation import (
    SAME,
    TELLS,
    Plan,
    imagined,
    other_joints,
    peak_torque_nm,
    plan,
    rest_pose,
    room_of,
)
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig

FLOOR_RAD = 2e-4
NOMINAL = TwinConfig()
COLUMN = ROBOT.action_names.index(SIGNAL)


def planned(*rivals: str, config: TwinConfig = NOMINAL, signal: str = SIGNAL, **options) -> Plan:
    pose = options.pop("pose", rest_pose(signal, None))
    return plan(config, signal, rivals, pose=pose, floor_rad=FLOOR_RAD, **options)


@pytest.fixture(scope="module")
def twins() -> Plan:
    return planned("coulomb_friction", "asymmetric_friction", gains="fitted")


@pytest.fixture(scope="module")
def frictions() -> Plan:
    return planned("viscous_friction", "coulomb_friction", gains="commanded")


@pytest.mark.slow
def test_effects_that_are_one_by_algebra_are_hopeless_on_every_motion(twins):
    pair = "coulomb_friction | asymmetric_friction"
    assert twins.hopeless == (pair,)
    assert len(twins.planned) == len(LIBRARY)
    assert all(p.discrimination[pair] < SAME for p in twins.planned)


@pytest.mark.slow
def test_two_frictions_are_told_apart_and_the_best_motion_comes_first(frictions):
    assert frictions.hopeless == ()
    assert frictions.planned[0].worst > TELLS
    worst = [p.worst for p in frictions.planned]
    assert worst == sorted(worst, reverse=True)
    assert worst[-1] < TELLS, "not any motion will do"


@pytest.mark.slow
def test_free_gains_hide_what_commanded_ones_show(frictions):
    """One motion alone with K_p and K_d free: K_d takes up the viscous one, and Coulomb's may be 0."""
    assert planned("viscous_friction", "coulomb_friction", gains="fitted").planned[0].worst < SAME
    assert frictions.planned[0].worst > TELLS


@pytest.mark.slow
def test_recordings_that_are_there_count(frictions):
    """Viscous friction and K_d: with a chirp at hand, the chirp at twice the gain tells what it could not alone."""
    known = Measurements((recorded(NOMINAL, CHIRP, 0, stated=False),))
    found = planned("viscous_friction", "coulomb_friction", gains="fitted", measurements=known)
    alone = planned("viscous_friction", "coulomb_friction", gains="fitted")
    stiffer = [next(p for p in of.planned if p.motion.name == STIFFER_CHIRP.name) for of in (found, alone)]
    assert stiffer[0].worst > 10 * stiffer[1].worst


@pytest.mark.slow
def test_three_rivals_are_three_pairs_and_the_worst_counts():
    found = planned("viscous_friction", "coulomb_friction", "asymmetric_friction", gains="commanded")
    assert all(len(p.discrimination) == 3 for p in found.planned)
    assert all(p.worst == min(p.discrimination.values()) for p in found.planned)
    assert found.hopeless == ("coulomb_friction | asymmetric_friction",)


@pytest.mark.parametrize("rivals", [(), ("backlash",), ("backlash", "backlash")])
def test_less_than_two_rivals_are_refused(rivals):
    with pytest.raises(TaccorlError, match="two or more effects"):
        planned(*rivals)


def test_an_unknown_rival_is_refused_with_the_nearest_name():
    with pytest.raises(TaccorlError, match=r"no effect 'backlsh'.*backlash"):
        planned("backlsh", "coulomb_friction")


def test_every_target_keeps_the_joint_s_limits_and_rests_at_both_ends(frictions, twins):
    rest = round(REST_S * 200)
    for p in (*frictions.planned, *twins.planned):
        assert ROBOT.action_low[COLUMN] <= p.target.min() and p.target.max() <= ROBOT.action_high[COLUMN]
        assert np.ptp(p.target[:rest]) == np.ptp(p.target[-rest:]) == 0.0


@pytest.mark.slow
def test_near_a_limit_the_room_is_smaller_and_the_limit_is_kept():
    pose = rest_pose(SIGNAL, None)
    pose[4] = ROBOT.action_high[COLUMN] - 0.2
    found = planned("coulomb_friction", "viscous_friction", gains="commanded", pose=pose)
    assert len(found.planned) == len(LIBRARY)
    assert all(p.target.max() <= ROBOT.action_high[COLUMN] - MARGIN_RAD + 1e-6 for p in found.planned)


@pytest.mark.slow
def test_a_motion_that_needs_more_torque_than_the_motor_may_give_is_refused():
    """A drive four times as stiff jerks joint 2: steps at 3 rad/s need more than 25 N·m, a slow triangle does not."""
    config = TwinConfig()
    config.controller.kp_nm_per_rad[1] *= 4.0
    found = planned("coulomb_friction", "viscous_friction", config=config, signal="left_joint2", gains="commanded")
    assert set(found.refused) | {p.motion.name for p in found.planned} == {m.name for m in LIBRARY}
    assert "steps" in found.refused and "of 25" in found.refused["steps"]
    assert "slow_triangle" not in found.refused
    assert all(p.peak_torque_nm <= 25.0 for p in found.planned)


@pytest.mark.slow
def test_a_constant_torque_moves_where_the_joint_rests_and_is_no_jerk_at_the_start():
    """Resting, K_p (q* − q) + T_ref = 0 whatever T_ref is: what a motion needs of the motor does not depend on it."""
    without, with_it = TwinConfig(), TwinConfig()
    without.controller.torque_ff_nm[4], with_it.controller.torque_ff_nm[4] = 0.0, 1.73
    peaks = [
        {p.motion.name: p.peak_torque_nm for p in planned("coulomb_friction", "viscous_friction", config=c).planned}
        for c in (without, with_it)
    ]
    assert peaks[0] == pytest.approx(peaks[1], rel=0.05)


@pytest.mark.slow
def test_a_pair_is_hopeless_where_no_motion_may_be_made():
    found = dataclasses.replace(planned("coulomb_friction", "viscous_friction"), planned=())
    assert found.best("coulomb_friction | viscous_friction") == 0.0
    assert found.hopeless == ("coulomb_friction | viscous_friction",)


def test_an_imagined_recording_says_so_and_has_the_noise_that_was_asked_for():
    pose = rest_pose(SIGNAL, None)
    target = CHIRP.target(room_of(NOMINAL, SIGNAL, pose))
    clean, noisy = (imagined(NOMINAL, SIGNAL, pose, CHIRP, target, floor) for floor in (0.0, FLOOR_RAD))
    assert "imagined" in noisy.origin.text
    assert np.std(noisy.measured[:, COLUMN] - clean.measured[:, COLUMN]) == pytest.approx(FLOOR_RAD, rel=0.05)
    assert noisy.kp == {SIGNAL: 151.1}
    np.testing.assert_array_equal(noisy.target[:, COLUMN], target)


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
    still = dataclasses.replace(CHIRP, target=lambda room: np.full(200, room.middle_rad))
    target = still.target(room_of(NOMINAL, signal, pose))
    body = arm_bench.rigid(NOMINAL, signal, pose, 0.0, [])
    weight_nm = abs(body.compensation_sin * np.sin(pose[2]) + body.compensation_cos * np.cos(pose[2]))
    assert weight_nm > 0.5
    assert peak_torque_nm(NOMINAL, signal, pose, still, target) == pytest.approx(weight_nm, rel=0.02)
    found = other_joints(signal, pose)
    assert list(found) == ["left_joint1", "left_joint2", "left_joint4", "left_joint5", "left_joint6", "left_gripper"]
    assert found["left_joint2"] == POSES[2][1]
