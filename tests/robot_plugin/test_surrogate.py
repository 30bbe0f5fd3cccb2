"""The surrogate: rates, commands, faults, what a client is told; its server: one client, silence, death; the robot through it."""

import json
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zmq
from simulated_robot import SimulatedRobot

from taccorl.errors import TaccorlError
from taccorl.robot_plugin import surrogate_server
from taccorl.robot_plugin.bodies import ARM_NAMES, SurrogateArms
from taccorl.robot_plugin.config_robots import TaccorlSurrogateConfig
from taccorl.robot_plugin.robots import TaccorlSurrogate
from taccorl.robot_plugin.safety import SafetyConfig, Stopped
from taccorl.robot_plugin.surrogate_body import (
    FAULTS,
    SurrogateBody,
    SurrogateConfig,
    hidden_twin,
)
from taccorl.robot_plugin.surrogate_link import LEADER_ROLE, SurrogateLink
from taccorl.robot_plugin.surrogate_messages import MOST_REQUEST_BYTES
from taccorl.robot_plugin.surrogate_server import SurrogateServer, pace, slow_words
from taccorl.robots import ROBOT
from taccorl.sim.seen_scene import SeenScene


@pytest.fixture(scope="module")
def body() -> SurrogateBody:
    return SurrogateBody(SurrogateConfig(task="bench", camera_px=16))


def test_a_second_has_200_states_100_frames_of_each_pad_and_30_pictures_of_each_camera(
    body: SurrogateBody,
) -> None:
    body.reset(0)
    messages = [message for _ in range(100) for message in body.tick()]
    states = [s for m in messages if m.kind == "state" for s in m.header["stamps_s"]]
    assert len(states) == 200
    np.testing.assert_allclose(np.diff(states), 0.005, atol=1e-9)
    assert sum(m.kind == "pads" for m in messages) == 100
    pictures = Counter(m.header["camera"] for m in messages if m.kind == "camera")
    assert pictures == dict.fromkeys(ROBOT.cameras, 30)


def test_the_time_of_a_scene_begins_at_its_reset(body: SurrogateBody) -> None:
    for _ in range(100):
        body.tick()
    body.reset(1)
    led: list[None] = []
    for _ in range(100):
        body.tick(lead=lambda: led.append(None) is not None)
    assert body.outcome()["seconds"] == 1.0 and len(led) == 30


def test_a_command_is_reached_in_a_straight_line_in_a_thirtieth_of_a_second(
    body: SurrogateBody, monkeypatch
) -> None:
    body.reset(0)
    begin, motors, seen = body._target.copy(), body.sim.action_actuators, []
    goal = begin + ROBOT.per_action(0.03, -0.003)
    body.command(goal)
    monkeypatch.setattr(
        body,
        "_state",
        lambda: seen.append(body.sim.arrays["ctrl"][0, motors]) or np.zeros((3, 14)),
    )
    [body.tick() for _ in range(4)]
    share = np.minimum(0.15 * np.arange(1, 9), 1)[
        :, None
    ]  # each 5 ms: in larger steps, the arms press harder
    np.testing.assert_allclose(seen, begin + share * (goal - begin), atol=1e-12)
    np.testing.assert_array_equal(body._target, body._goal)
    with pytest.raises(TaccorlError, match="left_joint2"):
        body.command(np.where(np.arange(14) == 1, np.nan, goal))


@pytest.mark.parametrize("fault", sorted(set(FAULTS) - {"lost_socket"}))
def test_every_fault_changes_the_messages_it_names(
    fault: str, body: SurrogateBody
) -> None:
    body.reset(0)
    body.faults = set()
    [body.tick() for _ in range(8)]
    body.faults = {fault}
    found = [m for _ in range(40) for m in body.tick()]
    body.faults = set()
    front = [m for m in found if m.header.get("camera") == "front"]
    pads = [m for m in found if m.kind == "pads"]
    wire = np.frombuffer(pads[-1].payload, np.uint8).reshape(-1, 384).astype(float)
    states = [m for m in found if m.kind == "state"]
    late = max(m.due_s - m.header["stamps_s"][-1] for m in states)
    alike = [float(np.corrcoef(wire[0], b.reshape(-1))[0, 1]) for b in body.baselines]
    seen = {
        "dead_camera": not front,
        "frozen_camera": len(front) > 10 and len({m.payload for m in front}) == 1,
        "slow_camera": len(front) in (2, 3),
        "silent_pad": 0 not in pads[-1].header["pads"],
        "exchanged_pads": int(np.argmax(alike)) == 2,
        "pressed_pad": wire[0].mean() > 180,
        "late_state": 0.29 < late < 0.31,
        "jammed": np.frombuffer(states[-1].payload).reshape(-1, 3, 14)[-1, 2, 1] > 50,
        "jitter": 0.02 < late < 0.031,
    }
    assert seen.pop(fault) and not any(seen.values()), seen


@pytest.mark.slow  # drawing a strength simulates the joint again and again
def test_hidden_effects_come_from_the_secret() -> None:
    twin = hidden_twin(SurrogateConfig(secret=3, effects=["coulomb_friction"]))
    assert [effect.name for effect in twin.effects] == ["coulomb_friction"]
    assert not hidden_twin(SurrogateConfig()).effects


def test_names_that_are_unknown_are_refused_with_the_nearest() -> None:
    with pytest.raises(
        TaccorlError, match="no hidden effect 'coulomb_fricton'; did you mean"
    ):
        hidden_twin(SurrogateConfig(secret=3, effects=["coulomb_fricton"]))
    with pytest.raises(TaccorlError, match="did you mean 'silent_pad'"):
        SurrogateBody(SurrogateConfig(faults=["silent_pads"]))
    with pytest.raises(TaccorlError, match="assembly_1"):
        SurrogateBody(SurrogateConfig(task="asembly_1"))


@pytest.mark.parametrize(
    "options",
    [
        {"camera_px": -5},
        {"camera_px": 3},
        {"camera_px": 100_000},
        {"secret": -1},
        {"seed": -1},
    ],
)
def test_numbers_out_of_range_are_refused_with_the_option(options: dict) -> None:
    (option, value), *_ = options.items()
    with pytest.raises(TaccorlError, match=f"--{option}={value}: give "):
        SurrogateBody(SurrogateConfig(task="bench", **options))


@pytest.mark.parametrize(
    "options",
    [
        {"camera_px": -5},
        {"picture_px": -1},
        {"picture_px": 10**6},
        {"fps": 0.0},
        {"fps": float("nan")},
        {"fps": -30.0},
        {"lost_after_s": float("inf")},
        {"lost_after_s": -1.0},
    ],
)
def test_numbers_of_the_robot_out_of_range_are_refused(options: dict) -> None:
    with pytest.raises(TaccorlError, match=f"--robot.{next(iter(options))}=.*: give "):
        TaccorlSurrogateConfig(**options)


def test_no_client_gets_privileged_state(
    body: SurrogateBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The simulator's privileged accessors are blinded; messages and facts are made without them."""

    def blind(*_: object) -> None:
        raise AssertionError("privileged state was read")

    body.reset(0)
    monkeypatch.setattr(
        body.sim.judge, "update", lambda *_: None
    )  # the judge beside the robot may see
    for name in ("poses", "velocities", "tcp", "pads_touching", "contact"):
        monkeypatch.setattr(SeenScene, name, blind)
    found = [m for _ in range(10) for m in body.tick()]
    assert {key for m in found for key in m.header} == {
        "stamps_s",
        "lead",
        "pads",
        "camera",
    }
    assert set(body.facts()) == {"task", "instruction", "seed", "cameras", "origin"}
    assert body.facts()["origin"]["domain"] == "surrogate"


@contextmanager
def running(port: int = 0) -> Iterator[SurrogateServer]:
    server = SurrogateServer(
        SurrogateBody(SurrogateConfig(task="bench", camera_px=16)), port
    )
    ended = threading.Event()
    thread = threading.Thread(target=server.run, kwargs={"stop": ended.is_set})
    thread.start()
    yield server
    ended.set()
    thread.join()
    server.close()


@pytest.fixture
def server() -> Iterator[SurrogateServer]:
    with running() as server:
        yield server


@pytest.fixture
def patient_server(
    server: SurrogateServer, monkeypatch: pytest.MonkeyPatch
) -> SurrogateServer:
    """A busy machine may stop a process for a second, after which a client is let go."""
    monkeypatch.setattr(surrogate_server, "GONE_S", 60.0)
    return server


def connected(port: int, folder: Path) -> TaccorlSurrogate:
    """A robot whose time limits are long, because a busy machine may stop a process for half a second."""
    patient = SafetyConfig(
        max_age_s={"state": 3, "pad": 3, "camera": 3}, stop_after_s=9
    )
    options = {
        "camera_px": 16,
        "lost_after_s": 2.0,
        "safety": patient,
        "calibration_dir": folder,
    }
    robot = TaccorlSurrogate(TaccorlSurrogateConfig(port=port, **options))
    robot.connect()
    return robot


def until(condition: object, timeout_s: float = 10.0) -> bool:
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:  # pyright: ignore[reportCallIssue]
        time.sleep(0.01)
    return bool(condition())  # pyright: ignore[reportCallIssue]


def test_one_client_drives_and_a_dead_one_is_let_go_with_the_arms_at_rest(
    server: SurrogateServer,
) -> None:
    first, second = SurrogateLink(server.port), SurrogateLink(server.port)
    first.connect(10.0)
    with pytest.raises(TaccorlError, match="another robot is connected: process"):
        second.connect(10.0)
    with pytest.raises(TaccorlError, match="no scripted expert"):
        SurrogateLink(server.port, LEADER_ROLE).connect(10.0)
    assert until(lambda: len(first.states) > 3 and all(first.pads.values()))
    tick, server.body.tick = (
        server.body.tick,
        lambda *lead: time.sleep(1.2) or tick(*lead),
    )
    assert until(lambda: server.slipped_s > 1.0)  # the machine was busy: nobody is dead
    server.body.tick = tick
    first.send("command", target=[0.0] * 14)
    assert until(lambda: server.commands == 1)
    first._thread, thread = None, first._thread  # it dies: no goodbye
    first._wake.send(b"")
    assert thread is not None
    thread.join()
    assert until(lambda: not server._clients)
    np.testing.assert_array_equal(server.body._goal, server.body._target)
    assert server.body._goal.any(), (
        "it holds where it has come to, and not the zeros of the command"
    )
    facts = second.connect(10.0)
    assert (
        facts["origin"]["domain"] == "surrogate" and facts["seed"] == 1
    )  # a new scene for a new client
    assert second.request("reset", 10.0, seed=5)["seed"] == 5
    assert second.request("outcome", 10.0)["outcome"]["success"] is False
    second.close()


STRANGER = """
import sys, time, zmq
socket = zmq.Context().socket(zmq.DEALER)
socket.setsockopt(zmq.LINGER, 0)
socket.connect(f"tcp://127.0.0.1:{sys.argv[1]}")
end = time.monotonic() + 20
while time.monotonic() < end:
    socket.send(b'{"do": "ping"}')
"""


@contextmanager
def stranger(port: int) -> Iterator[zmq.Socket]:
    """A peer that sends what it likes."""
    socket = zmq.Context.instance().socket(zmq.DEALER)
    socket.setsockopt(zmq.LINGER, 2000)
    socket.connect(f"tcp://127.0.0.1:{port}")
    yield socket
    socket.close()


def drives_on(server: SurrogateServer, link: SurrogateLink) -> bool:
    """True if states still arrive, and the next command is carried out."""
    assert until(lambda: bool(link.states))
    before, commands = link.states[-1][0], server.commands
    link.send("command", target=[0.1] * 14)
    return until(
        lambda: server.commands == commands + 1 and link.states[-1][0] > before
    )


MALFORMED = {
    "no JSON": b"{",
    "not UTF-8": b"\xff\xfe{",
    "a list": b"[]",
    "a number": b"1e999",
    "nested": b"[" * 3000,
    "number of another type": b'{"do": "reset", "id": [1]}',
}
REFUSED = {
    "no request": b"{}",
    "unknown request": b'{"do": ["hello"]}',
    "no target": b'{"do": "command"}',
    "short target": b'{"do": "command", "target": [0.1]}',
    "long target": b'{"do": "command", "target": [%s]}' % b",".join([b"0"] * 15),
    "nested target": b'{"do": "command", "target": [[%s]]}' % b",".join([b"0"] * 14),
    "NaN": b'{"do": "command", "target": [%s]}' % b",".join([b"NaN"] * 14),
    "infinite": b'{"do": "command", "target": [%s]}' % b",".join([b"-1e999"] * 14),
    "huge": b'{"do": "command", "target": [1%s%s]}' % (b"0" * 400, b",0" * 13),
    "texts": b'{"do": "command", "target": [%s]}' % b",".join([b'"0.1"'] * 14),
    "true": b'{"do": "command", "target": [%s]}' % b",".join([b"true"] * 14),
    "seed below 0": b'{"do": "reset", "seed": -1}',
    "seed of a text": b'{"do": "reset", "seed": "5"}',
    "seed with a point": b'{"do": "reset", "seed": 5.0}',
    "seed above 64 bits": b'{"do": "reset", "seed": 99999999999999999999}',
    "list of seeds": b'{"do": "reset", "seed": [5]}',
    "other role": b'{"do": "hello", "role": "leader", "name": "x"}',
    "unknown role": b'{"do": "hello", "role": [], "name": "x"}',
    "no name": b'{"do": "hello", "role": "robot"}',
    "control characters": b'{"do": "hello", "role": "robot", "name": "\\u001b[2J"}',
}


def test_malformed_messages_of_any_peer_are_counted_and_the_robot_runs_on(
    patient_server: SurrogateServer,
) -> None:
    server = patient_server
    link = SurrogateLink(server.port)
    link.connect(10.0)
    seed = server.body.scene_seed
    texts = [*MALFORMED.values(), *REFUSED.values()]
    with stranger(server.port) as peer:
        for text in texts:
            link._wake.send(text)
            peer.send(text)
        peer.send_multipart([b"", b'{"do": "ping"}'])  # as zmq.REQ does
        peer.send_multipart([b"x"] * 100)
    expected = {"malformed": 2 * len(MALFORMED) + 2, "refused": 2 * len(REFUSED)}
    assert until(lambda: server.dropped == expected), server.dropped
    assert server.commands == 0 and server.body.scene_seed == seed
    assert drives_on(server, link)
    with pytest.raises(TaccorlError, match=r"target\[13\]: expected a finite number"):
        link.request("command", target=[0.0] * 13 + [float("nan")])
    assert link.request("reset", 10.0, seed=2**63 - 1)["seed"] == 2**63 - 1
    assert drives_on(server, link)
    assert link.request("reset", 10.0)["seed"] == 0
    link.close()


def test_a_peer_that_did_not_say_hello_drives_nothing(server: SurrogateServer) -> None:
    with stranger(server.port) as peer:
        for do in ("command", "reset", "bye", "outcome", "ping"):
            peer.send_json({"do": do, "id": 7, "target": [0.1] * 14, "seed": 3})
            assert peer.poll(5000)
            reply = json.loads(peer.recv_multipart()[0])
            assert reply == {"kind": "reply", "id": 7, "refused": "say hello first"}
    assert server.commands == 0 and server.body.scene_seed == 0


def test_a_frame_above_the_limit_is_not_received(
    patient_server: SurrogateServer,
) -> None:
    server = patient_server
    link = SurrogateLink(server.port)
    link.connect(10.0)
    with stranger(server.port) as peer:
        monitor = peer.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        padding = " " * MOST_REQUEST_BYTES
        peer.send_json({"do": "outcome", "id": 1, "padding": padding})
        assert monitor.poll(5000), "ZeroMQ closed the connection"
        peer.disable_monitor()
    assert not server.dropped and drives_on(server, link)
    link.close()


def test_pings_of_a_stranger_cost_no_tick(patient_server: SurrogateServer) -> None:
    server = patient_server
    link = SurrogateLink(server.port)
    link.connect(10.0)
    words = [sys.executable, "-c", STRANGER, str(server.port)]
    with subprocess.Popen(words) as flood:
        assert until(lambda: server.dropped["refused"] > 2000)
        begin = server.body.ticks
        assert until(lambda: server.body.ticks > begin + 50)
        assert drives_on(server, link) and flood.poll() is None
        flood.kill()
    link.close()


def test_messages_that_are_none_of_a_surrogate_are_counted_by_the_link() -> None:
    """A server on a free port that answers every request with the same message."""
    stamp, lead, state = '"stamps_s": [1.0]', [0.0] * 14, np.zeros((1, 3, 14)).tobytes()
    header = f'{{"kind": "state", {stamp}, "lead": {lead}}}'
    messages = {
        "one frame": [header],
        "three frames": [header, state, b""],
        "no JSON": ["{", state],
        "a list": ["[]", state],
        "no kind": ["{}", state],
        "unknown kind": [header.replace("state", "lidar"), state],
        "no stamp": ['{"kind": "state"}', state],
        "stamp NaN": [header.replace("1.0", "NaN"), state],
        "two stamps": [header.replace("1.0", "1.0, 2.0"), state],
        "cut off": [header, state[:-1]],
        "no lead": [f'{{"kind": "state", {stamp}}}', state],
        "no JPEG": [f'{{"kind": "camera", "camera": "front", {stamp}}}', b"x" * 99],
        "empty": [f'{{"kind": "camera", "camera": "front", {stamp}}}', b""],
        "unknown camera": [f'{{"kind": "camera", "camera": [], {stamp}}}', b""],
        "unknown pad": [f'{{"kind": "pads", "pads": [9], {stamp}}}', bytes(384)],
        "small pad": [f'{{"kind": "pads", "pads": [0], {stamp}}}', bytes(383)],
    }
    link = SurrogateLink(1)
    for text, *payload in messages.values():
        link._take(text.encode(), *payload)
    assert link.malformed == len(messages)
    assert not link.states and not link.pictures and link.is_lost
    link._take(header.encode(), state)
    assert link.malformed == len(messages) and not link.is_lost
    answers = ([b"[]", b""], [b'{"kind": "reply", "id": 0}', b""])
    for answer, text in zip(answers, ("1 messages are none", "task"), strict=True):
        with (
            zmq.Context.instance().socket(zmq.ROUTER) as other,
            ThreadPoolExecutor(1) as pool,
        ):
            link = SurrogateLink(other.bind_to_random_port("tcp://127.0.0.1"))
            connecting = pool.submit(link.connect, 0.5)
            assert other.poll(5000)
            other.send_multipart([other.recv_multipart()[0], *answer])
            with pytest.raises(TaccorlError, match=text):
                connecting.result()
            assert not link.is_connected


@pytest.mark.timeout(30)  # a missing one is said at once
def test_a_taken_port_and_a_missing_surrogate_are_said(server: SurrogateServer) -> None:
    for port in (server.port, 99999):
        with pytest.raises(TaccorlError, match=f"--port={port}"):
            SurrogateServer(server.body, port)
    with pytest.raises(TaccorlError, match="taccorl serve-surrogate --port=9"):
        SurrogateLink(9).connect(60.0)
    arms = SurrogateArms(SurrogateLink(server.port), ["front"], 224)
    with pytest.raises(
        TaccorlError, match=r"its cameras are .*'front': \[16, 16\].*, not .*224"
    ):
        arms.connect()


def test_an_episode_begins_with_samples_of_its_own_scene(
    server: SurrogateServer, tmp_path: Path
) -> None:
    robot = connected(server.port, tmp_path)
    for given, expected in ((7, 7), (None, 8)):
        for _ in range(5):  # from home as fast as safety allows
            robot.send_action(
                {name: 0.0 for name in robot.body.names if robot.get_observation()}
            )
        newest = robot.body.read().stamps_s | {
            name: f[-1][0] for name, f in robot.pads._frames.items()
        }
        robot.begin_episode(given)
        oldest = robot.body.read().stamps_s | {
            name: f[0][0] for name, f in robot.pads._frames.items()
        }
        assert server.body.scene_seed == expected and all(
            oldest[channel] > newest[channel] for channel in newest
        )
        asked = {
            name: value
            for name, value in robot.get_observation().items()
            if name in robot.body.names
        }
        assert robot.send_action(asked) == pytest.approx(asked, abs=2e-3), (
            "not limited by where the last episode ended"
        )
    robot.disconnect()


@pytest.mark.slow
def test_a_robot_whose_server_dies_stops_and_may_be_connected_to_the_next(
    tmp_path: Path,
) -> None:
    with running() as server:
        robot = connected(server.port, tmp_path)
        assert robot.get_observation() and not robot.guard.stopped
    with pytest.raises(Stopped, match=r"the connection is lost|does not answer"):
        while robot.get_observation():
            time.sleep(1 / 30)
    assert robot.guard.is_lost
    robot.disconnect()
    with pytest.raises(TaccorlError, match="no surrogate answers"):
        robot.connect()
    with running(server.port):
        robot.connect()
        assert robot.get_observation() and not robot.guard.stopped
        robot.disconnect()


def test_names_units_zero_and_order_are_those_of_the_data_spec(tmp_path: Path) -> None:
    from taccorl.data.spec import find_spec, load_dataset_spec

    spec = load_dataset_spec(find_spec("taccorl_bimanual"))
    assert list(spec.features["action"].names) == list(ARM_NAMES)
    robot = SimulatedRobot(tmp_path, camera_px=16)
    robot.connect()
    robot.pass_period()
    seen = robot.get_observation()
    here = robot.simulated.sim.proprioception()[0]
    np.testing.assert_allclose([seen[name] for name in ARM_NAMES], here, atol=2e-3)
    assert (
        seen["tactile"].newest.shape == (1536,)
        and np.abs(seen["tactile"].newest).max() <= 8
    )  # untouched: noise
    robot.simulated.faults.add("pressed_pad")
    for _ in range(2):
        robot.pass_period()
    seen = robot.get_observation()
    pads = seen["tactile"].newest.reshape(4, 384)
    assert pads[0].min() > 150 and np.abs(pads[1:]).max() <= 8
    shown = np.split(
        seen["tactile"].picture().astype(int).sum(axis=2), 4, axis=1
    )  # a pad each, in Rerun's live view
    assert (
        shown[0][25:200, 8:70].min() > 1.5 * shown[1][25:200, 8:70].max()
    )  # which is noise
    assert robot.robot_type == spec.robot_type


def test_a_dry_run_sends_nothing_and_says_whether_the_loop_can_be_held(
    tmp_path: Path,
) -> None:
    robot = SimulatedRobot(tmp_path, dry_run=True)
    robot.connect()
    for _ in range(20):
        robot.pass_period()
        seen = robot.get_observation()
        robot.send_action({name: seen[name] for name in ARM_NAMES})
    said = "\n".join(robot.summary())
    assert robot.commands == 0 and "dry run, nothing was sent" in said
    assert (
        "a loop of 30 Hz can be held: p99 of the period 30.0 ms" in said
        and "age of pad:left_a: p50" in said
    )


def test_the_window_of_touch_is_at_the_policys_rate_whatever_the_loop_does(
    tmp_path: Path,
) -> None:
    robot = SimulatedRobot(tmp_path)
    robot.connect()
    assert robot.pads is not None
    for _ in range(40):
        robot.tick()
    robot.simulated.faults.add("pressed_pad")
    for _ in range(10):  # pressed since 0.1 s
        robot.tick()
    window, _ = robot.pads.at(robot.now_s, rows=10, period_s=1 / 30)
    felt = window.reshape(10, 4, 384)[:, 0].mean(axis=1) > 100
    assert felt.tolist() == [False] * 7 + [True] * 3


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("silent_pad", "left_a: 0 frames"),
        ("exchanged_pads", "on its port is right_a"),
        ("gripping", "is it touched"),
    ],
)
def test_pads_are_checked_when_they_are_connected(
    fault: str, said: str, tmp_path: Path
) -> None:
    first = SimulatedRobot(tmp_path)
    first.connect()
    first.pads and first.pads.close()
    second = SimulatedRobot(tmp_path, () if fault == "gripping" else (fault,))
    if fault == "gripping":  # steadily, so that no frame differs from the others
        held = np.random.default_rng(0).uniform(
            0, 120, second.simulated.baselines[0].shape
        )
        second.simulated.baselines[0] += held
    with pytest.raises(TaccorlError, match=said):
        second.connect()
    assert not second.pads or not second.pads._threads


def test_a_surrogate_that_is_too_slow_names_the_option_that_helps():
    assert slow_words(0.99, 0.3, 224) == ""
    # 2.5 s of the machine for each second, of which pictures take 1.7 s: halve them.
    assert "--camera_px=112" in slow_words(2.5, 0.8, 224)
    assert "2.5" in slow_words(2.5, 0.8, 224)
    for without, camera_px in ((1.4, 224), (2.5, 0)):
        assert "--camera_px" not in slow_words(2.5, without, camera_px) != ""


def test_the_pace_is_time_over_simulated_time():
    body = SurrogateBody(SurrogateConfig(task="bench", camera_px=0))
    begun = body.ticks
    times_s = iter((10.0, 11.5))
    # 50 ticks of 10 ms are 0.5 s; the clock moves by 1.5 s.
    assert pace(body, 1, lambda: next(times_s)) == pytest.approx(3.0)
    assert body.ticks == begun + 50
    body.close()
