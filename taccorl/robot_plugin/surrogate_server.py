"""``taccorl serve-surrogate [--task=assembly_2] [--secret=3] [--port=8730]``

Run a surrogate robot, the twin plus hidden effects, in a process of its own at wall-clock speed, for LeRobot's commands:
``lerobot-rollout --robot.type=taccorl_surrogate …``. It is no robot, and whatever is recorded from it is labelled surrogate.

Joints at 200 Hz, pads at 100 Hz, three cameras at 30 Hz as JPEG, on a ZeroMQ socket of this machine only. One client drives it;
a client that falls silent is let go, and the arms come to rest. Each connection begins with a new scene. Stop it by Ctrl-C.
"""

import heapq
import itertools
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
from taccorl.robot_plugin.surrogate_body import Message, SurrogateBody, SurrogateConfig, checked_fault
from taccorl.robot_plugin.surrogate_link import LEADER_ROLE, ROBOT_ROLE

SILENT_S = 0.2
"""Time without a message of its client after which the surrogate comes to rest [s]; the client sends one every 50 ms."""
GONE_S = 1.0
"""Time without a message after which a client counts as dead, and another one is accepted [s]."""
_SLIPPED_S = 0.25  # further behind than this, the surrogate's time stands still instead of hurrying


@dataclass(kw_only=True)
class ServeConfig(SurrogateConfig):
    """Run a surrogate robot for LeRobot's commands."""

    port: int = DEFAULT_PORT
    """TCP port on this machine (127.0.0.1); 0: any that is free, which is printed."""
    duration_s: float = 0.0
    """Time after which it ends [s]; 0: with Ctrl-C."""


@dataclass
class _Client:
    role: str
    name: str
    heard_s: float


class SurrogateServer:
    """Serves one ``SurrogateBody``. Raises TaccorlError: the port is taken."""

    def __init__(self, body: SurrogateBody, port: int = 0, clock: Callable[[], float] = time.monotonic) -> None:
        self.body, self._clock = body, clock
        self._socket = zmq.Context.instance().socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, 300)
        try:
            self._socket.bind(f"tcp://127.0.0.1:{port or '*'}")
        except zmq.ZMQError as error:
            self._socket.close()
            raise TaccorlError(
                f"--port={port}: {error.strerror}; is another surrogate running? Give another"
            ) from error
        self.port = int(self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self._clients: dict[bytes, _Client] = {}
        self._pending: list[tuple[float, int, Message]] = []
        self._order = itertools.count()
        self._resting, self._driven = True, False  # whether commands have come since the newest scene
        self.commands = 0
        """Number of commands received."""
        self.slipped_s = 0.0
        """Time by which the surrogate has fallen behind the clock, which it lets pass [s]."""

    def run(self, duration_s: float = 0.0, stop: Callable[[], bool] = lambda: False) -> None:
        """Serve until ``stop``, or for ``duration_s``; 0: for ever."""
        begin = self._clock()
        zero = begin - self.body.ticks * self.body.TICK_S  # the clock's time at the body's time 0
        while not stop() and not (duration_s and self._clock() - begin > duration_s):
            due_s = zero + (self.body.ticks + 1) * self.body.TICK_S
            late_s = self._clock() - due_s
            if late_s > _SLIPPED_S:
                zero += late_s
                self.slipped_s += late_s
                late_s = 0.0
            if late_s >= 0:
                for message in self.body.tick(int(late_s / self.body.TICK_S), lambda: bool(self._owner(LEADER_ROLE))):
                    heapq.heappush(self._pending, (message.due_s, next(self._order), message))
                self._watch()
            while self._pending and zero + self._pending[0][0] <= self._clock():
                self._publish(heapq.heappop(self._pending)[2], zero)
            wait_s = zero + (self.body.ticks + 1) * self.body.TICK_S - self._clock()
            if self._pending:
                wait_s = min(wait_s, zero + self._pending[0][0] - self._clock())
            while self._socket.poll(max(0, round(wait_s * 1e3))):
                self._receive()
                wait_s = 0.0

    def close(self) -> None:
        """Close the socket and free the twin."""
        self._socket.close()
        self.body.close()

    def _owner(self, role: str) -> bytes | None:
        return next((name for name, client in self._clients.items() if client.role == role), None)

    def _watch(self) -> None:
        now_s = self._clock()
        for name in [n for n, c in self._clients.items() if now_s - c.heard_s > GONE_S]:
            del self._clients[name]
        owner = self._owner(ROBOT_ROLE)
        silent = owner is None or now_s - self._clients[owner].heard_s > SILENT_S
        if silent and not self._resting:
            self.body.hold()
            self._resting = True

    def _publish(self, message: Message, zero: float) -> None:
        if "lost_socket" in self.body.faults:
            return
        header = {**message.header, "kind": message.kind}
        for key in ("camera_s", "pad_s"):
            header |= {key: header[key] + zero} if key in header else {}
        if "state_s" in header:
            header["state_s"] = [s + zero for s in header["state_s"]]
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
            text = json.dumps({"kind": "reply", "id": asked.get("id"), **reply}).encode()
            self._socket.send_multipart([name, text, b""], zmq.DONTWAIT)

    def _answer(self, name: bytes, client: _Client | None, asked: dict[str, Any]) -> dict[str, Any] | None:
        """Carry out one request of a client; returns the reply, None for requests that get none."""
        do = asked.get("do")
        if do == "hello":
            role = str(asked.get("role"))
            other = self._owner(role)
            if other is not None and other != name:
                return {"refused": f"another {role} is connected: {self._clients[other].name}"}
            if role == LEADER_ROLE and not self.body.sim.task.expert:
                return {"refused": f"task {self.body.config.task} has no scripted expert to lead"}
            if role == ROBOT_ROLE and self._driven:  # somebody has put the bench in order
                self.body.reset()
                self._driven = False
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
            self._resting, self._driven = False, True
            self.body.command(np.array(asked["target"], dtype=float))
        elif do == "hold":
            self.body.hold()
        elif do == "reset":
            return {"seed": self.body.reset(asked.get("seed"))}
        elif do == "faults":
            try:
                self.body.faults = {checked_fault(str(fault)) for fault in asked["faults"]}
            except TaccorlError as error:
                return {"refused": str(error)}
            return {"faults": sorted(self.body.faults)}
        return None


def serve(config: ServeConfig) -> int:
    """Run ``taccorl serve-surrogate``; returns the exit status: 143 after SIGTERM, else 0."""
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):  # it ends between ticks, not within a call of OpenGL
        signal.signal(number, lambda number, _: signals.append(number))
    print("starting a surrogate robot, not a real one", flush=True)
    body = SurrogateBody(config)
    for _ in range(12):  # what is compiled and allocated at first use, such as each camera's renderer, must not be late
        body.tick()
    if body.sim.task.expert:
        body.lead_on()
    body.reset(config.seed)
    server = SurrogateServer(body, config.port)
    shown = f"{len(body.cameras)} cameras of {config.camera_px} px" if body.cameras else "no cameras"
    print(f"{config.task}, scene {body.scene_seed}, {shown}", flush=True)
    if config.secret is not None and config.effects is None:
        print("hidden effects: drawn from the secret, not shown", flush=True)
    print(f"listening on port {server.port} of this machine; Ctrl-C ends it", flush=True)
    try:
        server.run(config.duration_s, lambda: bool(signals))
    finally:
        server.close()
    slow = f"; it was {server.slipped_s:.1f} s too slow in all" if server.slipped_s else ""
    print(f"ended after {server.commands} commands{slow}")
    return 128 + signal.SIGTERM if signal.SIGTERM in signals else 0
