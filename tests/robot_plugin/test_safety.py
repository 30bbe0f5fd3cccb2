"""Reactions to faults in simulated time: the right one, within one period, and no command after a stop."""

import logging
import math
from collections.abc import Mapping

import numpy as np
import pytest
import torch
from lerobot.utils.errors import DeviceNotConnectedError
from simulated_robot import SimulatedRobot

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.hand_poses import arm_chains, tcp_poses
from taccorl.robot_plugin.safety import Guard, Observed, SafetyConfig, Stopped, _hands
from taccorl.robots import ROBOT

PERIOD_S = 1 / 30
HOLD_AFTER_S = {
    "dead_camera": 0.2,
    "frozen_camera": 0.2,
    "silent_pad": 0.1,
    "late_state": 0.1,
    "hung_policy": 0.2,
}
STOPS = ("pressed_pad", "jammed", "lost_socket", "nan_action", "workspace")
FAULTS = (*HOLD_AFTER_S, *STOPS)
NOTHING: Mapping[str, float] = {}
CHANGES = {
    "nan_action": {"right_joint_3.pos": math.nan},
    "workspace": {"left_joint_2.pos": 3.0, "left_joint_3.pos": -0.01},
}
"""Fault of the policy → what it asks for."""
AT_REST_RAD = 0.01
"""Largest motion of a joint in the period after the first one; at full speed, from which it comes, it would be 0.1 rad."""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> SimulatedRobot:
    robot = SimulatedRobot(tmp_path_factory.mktemp("calibration"), camera_px=16)
    robot.connect()
    return robot


def loop(
    robot: SimulatedRobot,
    periods: int,
    changed: Mapping[str, float] = NOTHING,
    acts: bool = True,
) -> str:
    """Reason of the stop after that many periods of a loop that asks for a slow motion; empty while there was none."""
    for _ in range(periods):
        robot.pass_period()
        try:
            seen = robot.get_observation()
            if acts:
                target = {
                    n: seen[n] + (0.01 if n == "left_joint_1.pos" else 0.0)
                    for n in robot.body.names
                }
                robot.send_action(target | dict(changed))
        except Stopped:
            return robot.guard.stopped
    return ""


def fresh(robot: SimulatedRobot) -> None:
    """The robot after a new connection, without waiting for a new baseline."""
    robot.simulated.faults.clear()
    robot.simulated.reset(0)
    for _ in range(40):  # what was late has come
        robot.tick()
    robot.guard, robot._new_picture = robot._new_guard(), {}
    robot._seen_s = robot._sent_s = -math.inf


@pytest.mark.parametrize(
    "of_each", [1, pytest.param(20, marks=pytest.mark.slow)]
)  # 20 of 10 kinds: 200 faults
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_has_its_reaction_and_no_command_follows_a_stop(
    fault, of_each, robot, caplog
):
    rng, right, moved = np.random.default_rng(FAULTS.index(fault)), 0, []
    for _ in range(of_each):
        fresh(robot)
        assert loop(robot, int(rng.integers(3, 8))) == "" and not robot.guard.holding
        caplog.clear()
        if fault not in CHANGES and fault != "hung_policy":
            robot.simulated.faults.add(fault)
        changed = CHANGES.get(fault, {})
        least = math.ceil(HOLD_AFTER_S.get(fault, 0.0) / PERIOD_S) + 2
        within = least + 60 * (fault == "workspace") + 10 * (fault == "lost_socket")
        reason = loop(robot, within, changed, acts=fault != "hung_policy")
        reacted = (
            bool(reason) if fault in STOPS else bool(robot.guard.holding) and not reason
        )
        sent = robot.commands
        for _ in range(4):  # one period and a tick
            robot.tick()
        where = robot.simulated.sim.proprioception()[0]
        for _ in range(3):
            robot.tick()
        moved.append(
            float(np.abs(robot.simulated.sim.proprioception()[0] - where).max())
        )
        if fault in STOPS:
            for _ in range(3):
                with pytest.raises(Stopped):
                    robot.send_action(dict.fromkeys(robot.body.names, 0.1))
        else:
            loop(robot, 2, acts=fault != "hung_policy")
        logged = any(
            r.levelno >= logging.WARNING
            and (robot.guard.stopped or robot.guard.holding)
            for r in caplog.records
        )
        right += (
            reacted and robot.commands == sent and moved[-1] < AT_REST_RAD and logged
        )
    assert right == of_each, (
        f"{fault}: {right} of {of_each}; {moved}; {robot.guard.stopped or robot.guard.holding}"
    )


def test_arms_follow_again_after_a_late_state_and_stop_if_it_lasts(
    robot: SimulatedRobot,
) -> None:
    fresh(robot)
    loop(robot, 4)
    robot.simulated.faults.add("silent_pad")
    assert loop(robot, 8) == "" and robot.guard.holding
    robot.simulated.faults.clear()
    sent = robot.commands
    assert loop(robot, 4) == "" and not robot.guard.holding and robot.commands > sent
    robot.simulated.faults.add("silent_pad")
    reason = loop(robot, 40)
    assert "left_a" in reason and "at most 1 s" in reason


def test_a_robot_that_does_not_answer_is_stopped_and_said(
    robot: SimulatedRobot, monkeypatch
) -> None:
    def lost(*_: object) -> None:
        raise DeviceNotConnectedError("the arm is gone")

    for method, said in (
        ("read", "does not answer: the arm is gone"),
        ("send", "takes no command: the arm is gone"),
    ):
        fresh(robot)
        loop(robot, 3)
        monkeypatch.setattr(robot.body, method, lost)
        loop(robot, 10, acts=method == "read")  # if nobody commands, the watchdog does
        monkeypatch.undo()
        assert said in robot.guard.stopped
        with pytest.raises(Stopped):
            robot.send_action(dict.fromkeys(robot.body.names, 0.1))


@pytest.mark.parametrize(
    ("fault", "oldest_s"), [("jitter", 0.09), ("slow_camera", 0.18)]
)
def test_jitter_of_30_ms_and_a_camera_at_6_hz_are_no_fault(
    fault: str, oldest_s: float, robot: SimulatedRobot
) -> None:
    fresh(robot)
    robot.simulated.faults.add(fault)
    assert loop(robot, 40) == "" and robot.guard.counts["hold"] == 0
    assert max(list(robot.timing["age of camera:front"])[-40:]) == pytest.approx(
        oldest_s, abs=0.02
    )


def guard(now: list[float], **config: object) -> Guard:
    names = [*(f"joint_{k}.pos" for k in range(2)), "gripper.pos"]
    made = SafetyConfig(max_speed={"gripper.pos": 0.3, ".pos": 3.0}, **config)
    found = Guard(made, names, PERIOD_S, lambda: now[0], piper=False)
    found.observed(Observed(position=np.zeros(3), ages_s={"state": 0.0}))
    return found


def test_speed_is_limited_to_speed_times_time_and_ranges_to_their_ends() -> None:
    now = [0.0]
    one = guard(now, ranges={"joint_1.pos": [-0.05, 0.05]})
    now[0] = PERIOD_S
    found = one.command({"joint_0.pos": 5.0, "joint_1.pos": -9.0, "gripper.pos": 0.002})
    assert found.kind == "limit" and found.target is not None
    np.testing.assert_allclose(found.target, [3.0 / 30, -0.05, 0.002], atol=1e-12)
    now[0] += 10.0  # a pause does not add up
    found = one.command({"joint_0.pos": 5.0, "joint_1.pos": 0.0, "gripper.pos": 0.0})
    assert found.target is not None and found.target[0] == pytest.approx(
        0.1 + 2 * 3.0 / 30
    )


def test_a_stop_after_a_late_action_says_so() -> None:
    one = guard(now := [0.0])
    for passed_s in (PERIOD_S, 0.5, PERIOD_S):
        now[0] += passed_s
        one.command(dict.fromkeys(one.names, 0.0))
    assert (
        one.stop("effort").reason == "effort; the loop was late: no action for 0.45 s"
    )  # 0.9 of it, a period later


def test_an_action_without_a_joint_stops() -> None:
    one = guard([0.0])
    assert one.command({"joint_0.pos": 0.0, "gripper.pos": 0.0}).kind == "stop"
    assert (
        "joint_1.pos" in one.stopped
        and one.command(dict.fromkeys(one.names, 0.0)).target is None
    )


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ({}, "max_speed"),
        ({"max_speed": {"pos": 90.0, "elbow": 1.0}}, "elbow"),
        ({"max_speed": {"pos": 0.0}}, "above 0"),
        ({"max_speed": {"pos": 1.0}, "ranges": {"joint_9.pos": [0, 1]}}, "joint_9"),
        ({"max_speed": {"pos": 1.0}, "workspace_m": [1, 0]}, "workspace_m"),
    ],
)
def test_limits_that_cannot_hold_are_refused(config: dict, said: str) -> None:
    with pytest.raises(TaccorlError, match=said):
        Guard(
            SafetyConfig(**config), ["joint_1.pos"], PERIOD_S, lambda: 0.0, piper=False
        )


def test_hands_are_where_the_policys_kinematics_has_them() -> None:
    chains, state = (
        torch.tensor(arm_chains(), dtype=torch.float64),
        (ROBOT.action_low + 2 * ROBOT.action_high) / 3,
    )
    poses = tcp_poses(torch.from_numpy(state)[None], chains)
    np.testing.assert_allclose(
        _hands()(state), [pose[0, :3, 3].numpy() for pose in poses], atol=1e-12
    )
