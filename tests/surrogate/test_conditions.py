"""Conditions under which a surrogate robot is recorded: what it holds, what is lost on the way, how its encoder's noise is."""

import dataclasses

import numpy as np
import pytest

from taccorl.alignment.measurements.motions import CHIRP, POSES, Motion, Room
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.robot import link_poses
from taccorl.surrogate.arm import GRAVITY
from taccorl.surrogate.cases import PAYLOAD_KG, draw_case
from taccorl.surrogate.hidden import KINDS, NOT_FITTED, OUTSIDE, REGISTERED, Change
from taccorl.surrogate.recordings import record
from taccorl.surrogate.robot import LOST_RUN, NOISE_RAD, PAYLOAD_LINK6_M, Robot, inertia_and_weight


def test_a_known_mass_sits_between_the_pads():
    assert (0.0, 0.0, ROBOT.tcp_from_hand_m) == PAYLOAD_LINK6_M
    pose = np.array(POSES[4])
    without, held = (inertia_and_weight(pose, 5, kg)[1] for kg in (0.0, 0.3))
    wrist, hand = link_poses(pose)[4], link_poses(pose)[5]
    lever = hand[:3, 3] + ROBOT.tcp_from_hand_m * hand[:3, 2] - wrist[:3, 3]
    # Torque about the joint's axis z: (r × m g) · z, which the motor holds with the opposite sign.
    weight = np.cross(lever, [0.0, 0.0, -0.3 * GRAVITY]) @ wrist[:3, 2]
    assert held - without == pytest.approx(-weight, rel=1e-9)


def test_it_is_gripped_a_few_millimetres_off_its_middle_on_each_robot_elsewhere():
    places = np.array([draw_case([], seed, design="chirp").payload_m for seed in (300, 301, 302)]) - PAYLOAD_LINK6_M
    assert 1e-4 < np.abs(places).max() < 8e-3
    assert len(np.unique(places)) == places.size


def test_a_loaded_robot_holds_a_weighed_mass_in_every_recording():
    case = draw_case([], 303, signal="left_joint5", design="chirp", loaded=True)
    assert PAYLOAD_KG[0] <= case.payload_kg <= PAYLOAD_KG[1]
    assert record(case, CHIRP).payload_kg == {"left": case.payload_kg}
    both = record(case, dataclasses.replace(CHIRP, payload_kg=0.3))
    assert both.payload_kg["left"] == pytest.approx(case.payload_kg + 0.3)
    assert draw_case([], 303, signal="left_joint5", design="chirp").payload_kg == 0.0


def test_of_lost_commands_the_one_before_is_held():
    share = 0.06
    robot = Robot("left_joint1", (1.0, 0.1, 0.0), [Change(dropped=share)], POSES[0])
    arrived = robot._lost(40000, np.random.default_rng(0))
    held = np.arange(40000) - arrived
    assert (held > 0).mean() == pytest.approx(share, rel=0.06)
    lengths = np.bincount(held)[1:]  # how long a command has been held
    alone = (lengths[0] - lengths[1]) / lengths[0]
    assert alone == pytest.approx(LOST_RUN[0], abs=0.05)  # runs that meet each other are longer
    assert (robot._lost(1000, np.random.default_rng(1)) != robot._lost(1000, np.random.default_rng(2))).any()
    whole = Robot("left_joint1", (1.0, 0.1, 0.0), [], POSES[0])._lost(1000, np.random.default_rng(1))
    np.testing.assert_array_equal(whole, np.arange(1000))


def test_a_lost_command_moves_the_joint_a_period_late_and_stays_in_the_log():
    case = draw_case(["dropped_commands"], 304, signal="left_joint1", design="chirp")
    assert 0.01 <= case.hidden[0].values["probability"] <= 0.1
    plain = dataclasses.replace(case, hidden=())
    one, other = record(case, CHIRP), record(plain, CHIRP)
    np.testing.assert_array_equal(one.target, other.target)  # what was sent is logged as sent
    again = record(case, dataclasses.replace(CHIRP, name="chirp_again"))
    assert np.abs(one.measured - again.measured)[:, 0].max() > 3 * NOISE_RAD  # other commands are lost


def test_coloured_noise_is_as_large_as_white_and_lasts():
    white = draw_case([], 305, signal="left_joint1", design="chirp")
    coloured = draw_case([], 305, signal="left_joint1", design="chirp", coloured=True)
    still = Motion(name="still", target=lambda room: np.zeros(4000))
    resting = slice(7, 13)  # the other arm
    for case, memory in ((white, 0.0), (coloured, np.exp(-1 / (200 * coloured.colour_s)))):
        noise = record(case, still).measured[:, resting]
        noise = noise - noise.mean(axis=0)
        assert noise.std() == pytest.approx(NOISE_RAD, rel=0.15)
        assert (noise[1:] * noise[:-1]).mean() / noise.var() == pytest.approx(memory, abs=0.1)
    assert coloured.colour_s > 0.0 and white.colour_s == 0.0


def made(change: Change, target: np.ndarray, kp: float = 5.0) -> np.ndarray:
    """(T, 2) angle from the middle and effort of joint 1, which has no weight."""
    robot = Robot("left_joint1", (kp, 0.5, 0.0), [change], POSES[0])
    run = robot.run(Motion(name="made", target=lambda room: target), Room.of(1, 0.0, 0.02, 0.0))
    return np.column_stack([run.angle[::5, 0], run.effort[::5, 0]])


SLOW = 0.3 * np.interp(np.arange(2400) / 2400, [0, 0.25, 0.75, 1.0], [0, 1, -1, 0])
"""0.1 rad/s."""


def test_gains_that_differ_by_direction_hold_a_spring_differently():
    drive = {"one_way": 0.2, "spring": 1.0, "spring_rest": 0.0}
    for side, gain in ((1.0, 1.2), (-1.0, 0.8)):
        end = made(Change(drive=drive), side * np.repeat([0.0, 0.3], [100, 700]))[-1, 0]
        assert end == pytest.approx(side * 0.3 * 5.0 * gain / (5.0 * gain + 1.0), abs=1e-4)


def test_a_hung_mass_is_inertia_to_slow_motion_and_rings_at_its_own_frequency():
    drive = {"hung_inertia": 0.004, "hung_rad_per_s": 2 * np.pi * 5.0, "hung_damping": 0.02}
    step = np.repeat([0.0, 0.05], [100, 900])
    rest = made(Change(drive=drive), step)[300:, 0] - 0.05
    spectrum = np.abs(np.fft.rfft(rest * np.hanning(len(rest))))
    hz = np.fft.rfftfreq(len(rest), 0.005)
    assert hz[3:][np.argmax(spectrum[3:])] == pytest.approx(5.0, rel=0.25)
    assert np.abs(rest).max() > 5 * np.abs(made(Change(), step)[300:, 0] - 0.05).max()


def test_kinds_are_registered_or_outside_or_not_fitted():
    assert set(REGISTERED) | set(OUTSIDE) | set(NOT_FITTED) == set(KINDS)
    assert set(REGISTERED) <= set(effects) and not set(OUTSIDE) & set(effects)
    assert len(OUTSIDE) >= 10
