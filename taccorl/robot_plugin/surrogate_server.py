"""``taccorl serve-surrogate [--task=assembly_2] [--secret=3] [--port=8730]``

Run a surrogate robot, the twin plus hidden effects, in a process of its own at wall-clock speed, for LeRobot's commands:
``lerobot-rollout --robot.type=taccorl_surrogate …``. It is no robot, and whatever is recorded from it is labelled surrogate.

Joints at 200 Hz, pads at 100 Hz, three cameras at 30 Hz as JPEG, on a ZeroMQ socket of this machine only. One client drives it;
a client that falls silent is let go, and the arms come to rest. Each connection begins with a new scene. Stop it by Ctrl-C.
"""

import itertools
import json
import math
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zmq

from taccorl.errors import TaccorlError
from taccorl.robot_plugin import DEFAULT_PORT
from taccorl.robot_plugin.surrogate_body import Message, SurrogateBody, SurrogateConfig
from taccorl.robot_plugin.surrogate_link import LEADER_ROLE, ROBOT_ROLE
from taccorl.robot_plugin.surrogate_messages import (
    MOST_REQUEST_BYTES,
    finite_numbers,
    name_of,
    read_object,
)
from taccorl.robots import ROBOT

GONE_S = 1.0
"""Time without a message, of which it sends one every 50 ms, after which a client counts as dead, and another is accepted [s]."""
_FRAMES_PER_TICK = 64
"""Frames that are received in a tick whose time is used up; more while time remains."""
_PACE_TICKS = 50
"""Ticks by which the pace is measured before the surrogate is served: half a second."""
_SLIPPED_S = 0.25  # further behind than this, the surrogate's time stands still instead of hurrying


@dataclass(kw_only=True)
class ServeConfig(SurrogateConfig):
    """Run a surrogate robot for LeRobot's commands."""

    port: int = DEFAULT_PORT
    """TCP port on this machine (127.0.0.1); 0: any that is free, which is printed."""


@dataclass
class _Client:
    role: str
    name: str
    heard_s: float


class SurrogateServer:
    """Serves one ``SurrogateBody``. Raises TaccorlError: the port is taken."""

    def __init__(
        self,
        body: SurrogateBody,
        port: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.body, self._clock = body, clock
        if not 0 <= port <= 65535:  # of which ZMQ takes the remainder
            raise TaccorlError(f"--port={port}: give 0 … 65535")
        self._socket = zmq.Context.instance().socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, 300)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MOST_REQUEST_BYTES)
        try:
            self._socket.bind(f"tcp://127.0.0.1:{port or '*'}")
        except zmq.ZMQError as error:
            self._socket.close()
            raise TaccorlError(
                f"--port={port}: {error.strerror}; another surrogate? Give another"
            ) from error
        self.port = int(
            self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2]
        )
        self._clients: dict[bytes, _Client] = {}
        self._pending: list[Message] = []  # in the order in which they are due
        self._driven = False  # whether a command has come since the scene began
        self._frames: list[bytes] = []  # of a message that is not yet received whole
        self.commands = 0  # received
        self.dropped: Counter[str] = Counter()
        """Kind of fault → number of messages that were not carried out because of it."""
        self.slipped_s = (
            0.0  # time by which it has fallen behind the clock, and which it lets pass
        )

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve until ``stop``."""
        zero = (
            self._clock() - self.body.ticks * self.body.TICK_S
        )  # the clock's time at the body's time 0
        while not stop():
            late_s = self._clock() - zero - (self.body.ticks + 1) * self.body.TICK_S
            if late_s > _SLIPPED_S:
                zero += late_s
                self.slipped_s += late_s
                late_s = 0.0
            if late_s >= 0:
                new = self.body.tick(
                    int(late_s / self.body.TICK_S),
                    lambda: bool(self._owner(LEADER_ROLE)),
                )
                self._pending = sorted(
                    [*self._pending, *new], key=lambda message: message.due_s
                )
            while self._pending and zero + self._pending[0].due_s <= self._clock():
                self._publish(self._pending.pop(0), zero)
            wait_s = zero + (self.body.ticks + 1) * self.body.TICK_S - self._clock()
            if self._pending:
                wait_s = min(wait_s, zero + self._pending[0].due_s - self._clock())
            self._receive_until(self._clock() + wait_s)
            for name, client in list(
                self._clients.items()
            ):  # after a slow tick, their messages have waited until here
                if self._clock() - client.heard_s > GONE_S:
                    self._answer(
                        name, client, {"do": "bye"}
                    )  # in its place: it is dead

    def close(self) -> None:
        """Close the socket and free the twin."""
        self._socket.close()
        self.body.close()

    def _owner(self, role: str) -> bytes | None:
        return next(
            (name for name, client in self._clients.items() if client.role == role),
            None,
        )

    def _publish(self, message: Message, zero: float) -> None:
        if "lost_socket" in self.body.faults:
            return
        stamps_s = [s + zero for s in message.header["stamps_s"]]
        header = {**message.header, "kind": message.kind, "stamps_s": stamps_s}
        parts = [json.dumps(header).encode(), message.payload]
        for name, client in self._clients.items():
            if client.role == ROBOT_ROLE or message.kind == "state":
                self._socket.send_multipart([name, *parts], zmq.DONTWAIT)

    def _receive_until(self, end_s: float) -> None:
        """Receive frames until ``end_s`` [s of the clock]; if that has passed, those that
        wait, at most _FRAMES_PER_TICK."""
        for count in itertools.count():
            wait_s = end_s - self._clock()
            if wait_s <= 0 and count >= _FRAMES_PER_TICK:
                return
            if not self._socket.poll(max(0, math.ceil(wait_s * 1e3))):
                return
            self._receive()

    def _receive(self) -> None:
        """Receive one frame, and carry out the message that it ends."""
        frame = self._socket.recv()
        # Sender, request, and one more that shows that there are too many.
        self._frames += [frame] if len(self._frames) < 3 else []
        if self._socket.getsockopt(zmq.RCVMORE):
            return
        (name, *parts), self._frames = self._frames, []
        if "lost_socket" in self.body.faults:
            return
        client = self._clients.get(name)
        if client is not None:
            client.heard_s = self._clock()
        number = None
        try:
            if len(parts) != 1:
                raise TaccorlError("is not one frame")
            request = read_object(parts[0])
            number = request.get("id")
            if number is not None and type(number) is not int:
                raise TaccorlError("id: expected a whole number")
        except TaccorlError:
            self.dropped["malformed"] += 1
            return
        try:
            reply = self._answer(name, client, request)
        except TaccorlError as error:
            self.dropped["refused"] += 1
            reply = {"refused": str(error)}
        # Without a number, nobody waits for a reply.
        if reply is not None and number is not None:
            text = json.dumps({"kind": "reply", "id": number, **reply}).encode()
            self._socket.send_multipart([name, text, b""], zmq.DONTWAIT)

    def _answer(
        self, name: bytes, client: _Client | None, request: dict[str, Any]
    ) -> dict[str, Any] | None:
        """Carry out one request of a client; returns the reply, None for requests that get
        none. Raises TaccorlError: the request is refused; nothing was changed."""
        do = request.get("do")
        if do == "hello":
            return self._hello(name, client, request)
        if client is None:
            raise TaccorlError("say hello first")
        if do == "ping":
            return None
        if do == "bye":
            del self._clients[name]
            if client.role == ROBOT_ROLE:
                self.body.hold()
            return {}
        if do == "outcome":
            return {"outcome": self.body.outcome()}
        if do not in ("command", "reset"):
            raise TaccorlError("unknown request")
        if client.role != ROBOT_ROLE:
            raise TaccorlError(f"{do} is for the client that drives")
        if do == "reset":
            seed = request.get("seed")
            if seed is not None and type(seed) is not int:
                raise TaccorlError("seed: expected a whole number in 0 … 2^63 - 1")
            return {"seed": self._reset(seed)}
        target = finite_numbers(request, "target", ROBOT.num_actions)
        self.body.command(target)
        self.commands += 1
        self._driven = True
        return None

    def _hello(
        self, name: bytes, client: _Client | None, request: dict[str, Any]
    ) -> dict[str, Any]:
        """Accept a client; returns the facts on the robot."""
        role, label = request.get("role"), name_of(request)
        if role not in (ROBOT_ROLE, LEADER_ROLE):
            raise TaccorlError(f"role: expected {ROBOT_ROLE} or {LEADER_ROLE}")
        if client is not None and client.role != role:
            raise TaccorlError(f"is connected as {client.role}; say bye first")
        other = self._owner(role)
        if other is not None and other != name:
            raise TaccorlError(
                f"another {role} is connected: {self._clients[other].name}"
            )
        if role == LEADER_ROLE and not self.body.sim.task.expert:
            raise TaccorlError(
                f"task {self.body.config.task} has no scripted expert to lead"
            )
        if role == ROBOT_ROLE:  # somebody has put the bench in order
            self._reset(None)
        self._clients[name] = _Client(role, label, self._clock())
        return dict(self.body.facts())

    def _reset(self, seed: int | None) -> int:
        """Begin the scene of ``seed``; without one, the next, or the present one again if nobody has commanded in it."""
        again = None if self._driven else self.body.scene_seed
        found = self.body.reset(again if seed is None else seed)
        self._pending, self._driven = [], False  # they are of the scene before
        return found


def pace(
    body: SurrogateBody, behind: int, clock: Callable[[], float] = time.monotonic
) -> float:
    """Time that the surrogate needs for a second of its own time [s/s]; above 1 it is too
    slow.

    Args:
        behind: 0 with pictures, 1 without them, as for ``SurrogateBody.tick``.
        clock: the time [s].
    """
    begun_s = clock()
    for _ in range(_PACE_TICKS):
        body.tick(behind)
    return (clock() - begun_s) / (_PACE_TICKS * body.TICK_S)


def slow_words(with_pictures: float, without: float, camera_px: int) -> str:
    """Text on a surrogate that is too slow, with the option that helps; empty if it is
    not. Both paces are those of ``pace``."""
    if with_pictures <= 1.0:
        return ""
    text = f"too slow: it needs {with_pictures:.1f} s of this machine for each of its seconds"
    if without <= 1.0 and camera_px:
        return f"{text}, {without:.1f} s without pictures: --camera_px={camera_px // 2} (0: no cameras)"
    return f"{text}, also without pictures: end what else runs here, or take a faster machine"


def serve(config: ServeConfig) -> int:
    """Run ``taccorl serve-surrogate``; returns the exit status: 143 after SIGTERM, else 0."""
    signals: list[int] = []
    for number in (
        signal.SIGINT,
        signal.SIGTERM,
    ):  # it ends between ticks, not within a call of OpenGL
        signal.signal(number, lambda number, _: signals.append(number))
    print("starting a surrogate robot, not a real one", flush=True)
    body = SurrogateBody(config)
    for _ in range(
        12
    ):  # what is compiled and allocated at first use, such as each camera's renderer, must not be late
        body.tick()
    with_pictures, without = (pace(body, behind) for behind in (0, 1))
    if body.sim.task.expert:
        body.lead_on()
    body.reset(config.seed)
    server = SurrogateServer(body, config.port)
    shown = (
        f"{len(body.cameras)} cameras of {config.camera_px} px"
        if body.cameras
        else "no cameras"
    )
    print(f"{config.task}, scene {body.scene_seed}, {shown}", flush=True)
    if slow := slow_words(with_pictures, without, config.camera_px):
        print(slow, flush=True)
    if config.secret is not None and config.effects is None:
        print("hidden effects: drawn from the secret, not shown", flush=True)
    print(
        f"listening on port {server.port} of this machine; Ctrl-C ends it", flush=True
    )
    try:
        server.run(lambda: bool(signals))
    finally:
        server.close()
    slow = (
        f"; it was {server.slipped_s:.1f} s too slow in all" if server.slipped_s else ""
    )
    print(f"ended after {server.commands} commands{slow}")
    if server.dropped:
        counts = ", ".join(f"{n} {kind}" for kind, n in sorted(server.dropped.items()))
        print(f"messages not carried out: {counts}")
    return 128 + signal.SIGTERM if signal.SIGTERM in signals else 0
