"""``taccorl serve-surrogate [--task=assembly_2] [--secret=3] [--port=8730]``

Run a surrogate robot, the twin plus hidden effects, in a process of its own at wall-clock speed, for LeRobot's commands:
``lerobot-rollout --robot.type=taccorl_surrogate …``. It is no robot, and whatever is recorded from it is labelled surrogate.

Joints at 200 Hz, pads at 100 Hz, three cameras at 30 Hz as JPEG, on a ZeroMQ socket of this machine only. One client drives it;
a client that falls silent is let go, and the arms come to rest. Each connection begins with a new scene. Stop it by Ctrl-C.
"""

import json
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import zmq

from taccorl.errors import TaccorlError
from taccorl.robot_plugin import DEFAULT_PORT
from taccorl.robot_plugin.surrogate_body import Message, SurrogateBody, SurrogateConfig
from taccorl.robot_plugin.surrogate_link import LEADER_ROLE, ROBOT_ROLE

GONE_S = 1.0
"""Time without a message, of which it sends one every 50 ms, after which a client counts as dead, and another is accepted [s]."""
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
        self.commands = 0  # received
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
            while self._socket.poll(max(0, round(wait_s * 1e3))):
                self._receive()
                wait_s = 0.0
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

    def _receive(self) -> None:
        name, text = self._socket.recv_multipart()[:2]
        if "lost_socket" in self.body.faults:
            return
        try:
            asked = json.loads(text)
        except ValueError:
            return
        client = self._clients.get(name)
        if client is not None:
            client.heard_s = self._clock()
        reply = self._answer(name, client, asked)
        if reply is not None:
            text = json.dumps(
                {"kind": "reply", "id": asked.get("id"), **reply}
            ).encode()
            self._socket.send_multipart([name, text, b""], zmq.DONTWAIT)

    def _answer(
        self, name: bytes, client: _Client | None, asked: dict[str, Any]
    ) -> dict[str, Any] | None:
        """Carry out one request of a client; returns the reply, None for requests that get none."""
        do = asked.get("do")
        if do == "hello":
            role = str(asked.get("role"))
            other = self._owner(role)
            if other is not None and other != name:
                return {
                    "refused": f"another {role} is connected: {self._clients[other].name}"
                }
            if role == LEADER_ROLE and not self.body.sim.task.expert:
                return {
                    "refused": f"task {self.body.config.task} has no scripted expert to lead"
                }
            if role == ROBOT_ROLE:  # somebody has put the bench in order
                self._reset(None)
            self._clients[name] = _Client(role, str(asked.get("name")), self._clock())
            return dict(self.body.facts())
        if client is None:
            return {"refused": "say hello first"}
        if do == "bye":
            del self._clients[name]
            if client.role == ROBOT_ROLE:
                self.body.hold()
            return {}
        elif do == "outcome":
            return {"outcome": self.body.outcome()}
        elif client.role != ROBOT_ROLE:
            return None
        elif do == "command":
            self.commands += 1
            self._driven = True
            self.body.command(np.array(asked["target"], dtype=float))
        elif do == "reset":
            return {"seed": self._reset(asked.get("seed"))}
        return None

    def _reset(self, seed: int | None) -> int:
        """Begin the scene of ``seed``; without one, the next, or the present one again if nobody has commanded in it."""
        again = None if self._driven else self.body.scene_seed
        self._pending, self._driven = (
            [],
            False,
        )  # what is pending is of the scene before
        return self.body.reset(again if seed is None else seed)


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
    return 128 + signal.SIGTERM if signal.SIGTERM in signals else 0
