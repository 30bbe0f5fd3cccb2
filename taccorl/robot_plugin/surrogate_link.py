"""Client of a surrogate: one thread that owns the socket, the newest samples of every channel, and commands.

Times are of CLOCK_MONOTONIC, the same in all processes of this machine.
"""

import contextlib
import itertools
import json
import os
import queue
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from socket import create_connection
from typing import Any

import cv2
import numpy as np
import zmq

from taccorl.errors import TaccorlError
from taccorl.robot_plugin import LOST_S
from taccorl.robot_plugin.surrogate_messages import (
    MOST_REPLY_BYTES,
    finite_numbers,
    read_object,
)
from taccorl.robots import ROBOT
from taccorl.surrogate.drivers import PAD_WIRE_SHAPE

ROBOT_ROLE, LEADER_ROLE = "robot", "leader"
PING_S = 0.05
FACTS = {"task": str, "instruction": str, "cameras": dict, "origin": dict}
"""Facts on a surrogate that its reply to hello states: key → type."""


class SurrogateLink:
    """Connection to a surrogate on this machine. ``role``: robot, or leader for the teleoperator. ``lost_s``: time without any
    message after which the connection counts as lost [s of ``clock``]."""

    def __init__(
        self,
        port: int,
        role: str = ROBOT_ROLE,
        lost_s: float = LOST_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.port, self.role, self.lost_s, self._clock = port, role, lost_s, clock
        self.states: deque[tuple[float, np.ndarray]] = deque(
            maxlen=64
        )  # stamp [s], (3, 14) position, velocity, effort
        self.pads: dict[str, queue.SimpleQueue[tuple[float, np.ndarray]]] = {
            n: queue.SimpleQueue() for n in ROBOT.pads
        }
        self.pictures: dict[
            str, tuple[float, np.ndarray]
        ] = {}  # stamp [s], RGB: decoded beside the loop
        self.lead: list[float] | None = None
        self.listeners: list[Any] = []
        """Called with (kind, stamp [s], name, value) of every sample, in the link's thread."""
        self.heard_s = -np.inf
        self.malformed = 0
        """Number of messages that were dropped because they are none of a surrogate."""
        self._replies: queue.Queue[dict[str, Any]] = queue.Queue()
        self._numbers = itertools.count()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    @property
    def is_connected(self) -> bool:
        """True from ``connect`` to ``close``, also if the surrogate does not answer any more."""
        return self._thread is not None

    @property
    def is_lost(self) -> bool:
        """True if nothing was heard of the surrogate for ``lost_s``."""
        return self._clock() - self.heard_s > self.lost_s

    def connect(self, timeout_s: float = 3.0) -> Mapping[str, Any]:
        """Connect; returns the surrogate's facts. Raises TaccorlError: nobody answers, or somebody else drives it."""
        if (
            self.heard_s == -np.inf
        ):  # a surrogate that was there once may be on its way back
            try:
                create_connection(("127.0.0.1", self.port), timeout_s).close()
            except (OSError, OverflowError) as error:  # no such port
                raise self._absent() from error
        context, inside = zmq.Context.instance(), f"inproc://{uuid.uuid4()}"
        receiver, self._wake = context.socket(zmq.PAIR), context.socket(zmq.PAIR)
        receiver.bind(inside)
        self._wake.connect(inside)
        self._thread = threading.Thread(
            target=self._run, args=(receiver,), daemon=True, name="surrogate link"
        )
        self._thread.start()
        try:
            facts = self.request(
                "hello", timeout_s, role=self.role, name=f"process {os.getpid()}"
            )
            for key, kind in FACTS.items():
                if not isinstance(facts.get(key), kind):
                    raise TaccorlError(
                        f"port {self.port} of this machine: no surrogate of this version answers: {key} is missing; give "
                        "the port that taccorl serve-surrogate prints"
                    )
            return facts
        except TaccorlError:
            self.close()
            raise

    def close(self) -> None:
        """Say goodbye and end the thread; no error if the surrogate is gone."""
        if self._thread is not None:
            with contextlib.suppress(TaccorlError):
                self.request(
                    "bye", 0.5
                )  # before the next connection's hello, which goes another way
            self._wake.send(b"")
            self._thread.join()
            self._wake.close()
            self._thread = None

    def send(self, do: str, **values: Any) -> None:
        """Send without waiting for a reply."""
        with self._lock:
            self._wake.send(json.dumps({"do": do, **values}).encode())

    def request(self, do: str, timeout_s: float = 3.0, **values: Any) -> dict[str, Any]:
        """Send, and wait for the reply. Raises TaccorlError: none came, or the surrogate refuses."""
        number = next(self._numbers)
        self.send(do, id=number, **values)
        until = time.monotonic() + timeout_s
        with contextlib.suppress(queue.Empty):
            while (left := until - time.monotonic()) > 0:
                reply = self._replies.get(timeout=left)
                if reply.get("id") == number:
                    if "refused" in reply:
                        raise TaccorlError(
                            f"surrogate on port {self.port}: {reply['refused']}"
                        )
                    return reply
        raise self._absent()

    def _absent(self) -> TaccorlError:
        if self.malformed:
            return TaccorlError(
                f"port {self.port} of this machine: {self.malformed} messages are none of a surrogate; give the port that "
                "taccorl serve-surrogate prints"
            )
        text = f"no surrogate answers on port {self.port} of this machine: start one with taccorl serve-surrogate "
        return TaccorlError(
            f"{text}--port={self.port}, and wait until it says listening"
        )

    def _run(self, receiver: zmq.Socket) -> None:
        socket = zmq.Context.instance().socket(zmq.DEALER)
        socket.setsockopt(
            zmq.LINGER, 0
        )  # nothing of this connection may reach the next server on the port
        socket.setsockopt(zmq.MAXMSGSIZE, MOST_REPLY_BYTES)
        socket.connect(f"tcp://127.0.0.1:{self.port}")
        poller = zmq.Poller()
        for one in (receiver, socket):
            poller.register(one, zmq.POLLIN)
        pinged_s = time.monotonic()
        while True:
            ready = dict(poller.poll(round(PING_S * 1e3)))
            if receiver in ready:
                text = receiver.recv()
                if not text:
                    break
                socket.send(text)
            if socket in ready:
                self._take(*socket.recv_multipart())
            if time.monotonic() - pinged_s > PING_S:
                socket.send(b'{"do": "ping"}')
                pinged_s = time.monotonic()
        socket.close()
        receiver.close()

    def _take(self, *frames: bytes) -> None:
        try:
            samples = self._read(frames)
        except (TaccorlError, ValueError, cv2.error):
            self.malformed += 1
            return
        for listener in self.listeners:
            for sample in samples:
                listener(*sample)

    def _read(self, frames: Sequence[bytes]) -> list[tuple[str, float, str, Any]]:
        """Keep the content of a message; returns its samples: kind, stamp [s], name and
        value. Raises TaccorlError, ValueError or cv2.error: it is no message of a
        surrogate; nothing was kept."""
        text, payload = frames
        samples: list[tuple[str, float, str, Any]]
        header = read_object(text)
        kind = header.get("kind")
        if kind == "reply":
            self._keep_reply(header)
            return []
        stamps_s = finite_numbers(header, "stamps_s").tolist()
        if kind == "state":
            found = np.frombuffer(payload).reshape(-1, 3, ROBOT.num_actions)
            new = list(zip(stamps_s, found, strict=True))
            self.lead = finite_numbers(header, "lead", ROBOT.num_actions).tolist()
            self.states.extend(new)
            samples = [("state", stamp_s, "", value) for stamp_s, value in new]
        elif kind == "camera" and header.get("camera") in ROBOT.cameras:
            decoded = cv2.imdecode(np.frombuffer(payload, np.uint8), cv2.IMREAD_COLOR)
            if decoded is None:
                raise TaccorlError("the picture is no JPEG")
            picture = cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)
            self.pictures[header["camera"]] = (stamps_s[0], picture)
            samples = [("camera", stamps_s[0], header["camera"], payload)]
        elif kind == "pads":
            numbers = header.get("pads")
            if not isinstance(numbers, list) or any(
                type(k) is not int or not 0 <= k < len(ROBOT.pads) for k in numbers
            ):
                raise TaccorlError(f"pads: expected numbers in 0 … {len(ROBOT.pads)}")
            scans = np.frombuffer(payload, np.uint8).reshape(-1, *PAD_WIRE_SHAPE)
            samples = [
                ("pad", stamps_s[0], ROBOT.pads[k], scan)
                for k, scan in zip(numbers, scans, strict=True)
            ]
            for _, stamp_s, name, scan in samples:
                self.pads[name].put((stamp_s, scan))
                if self.pads[name].qsize() > 4096:  # 40 s: nobody reads them
                    self.pads[name].get_nowait()
        else:
            raise TaccorlError("kind: expected reply, state, camera or pads")
        self.heard_s = self._clock()
        return samples

    def _keep_reply(self, header: dict[str, Any]) -> None:
        if "seed" in header:
            # Of hello or reset: the samples so far are of another scene.
            self.states.clear()
            self.pictures.clear()
        self._replies.put(header)
