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
from collections.abc import Callable, Mapping
from socket import create_connection
from typing import Any

import cv2
import numpy as np
import zmq

from taccorl.errors import TaccorlError
from taccorl.robot_plugin import LOST_S
from taccorl.robots import ROBOT
from taccorl.surrogate.drivers import PAD_WIRE_SHAPE

ROBOT_ROLE, LEADER_ROLE = "robot", "leader"
PING_S = 0.05


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
            return self.request(
                "hello", timeout_s, role=self.role, name=f"process {os.getpid()}"
            )
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
        text = f"no surrogate answers on port {self.port} of this machine: start one with taccorl serve-surrogate "
        return TaccorlError(
            f"{text}--port={self.port}, and wait until it says listening"
        )

    def _run(self, receiver: zmq.Socket) -> None:
        socket = zmq.Context.instance().socket(zmq.DEALER)
        socket.setsockopt(
            zmq.LINGER, 0
        )  # nothing of this connection may reach the next server on the port
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
                self._take(*socket.recv_multipart()[:2])
            if time.monotonic() - pinged_s > PING_S:
                socket.send(b'{"do": "ping"}')
                pinged_s = time.monotonic()
        socket.close()
        receiver.close()

    def _take(self, text: bytes, payload: bytes) -> None:
        header = json.loads(text)
        kind, stamps_s = header["kind"], header.get("stamps_s")
        if kind == "reply":
            if (
                "seed" in header
            ):  # of hello or reset: the samples so far are of another scene
                self.states.clear()
                self.pictures.clear()
            self._replies.put(header)
            return
        self.heard_s = self._clock()
        if kind == "state":
            self.lead = header["lead"]
            found = np.frombuffer(payload).reshape(-1, 3, ROBOT.num_actions)
            self.states.extend(zip(stamps_s, found, strict=True))
            samples = [
                ("state", stamp, "", value)
                for stamp, value in zip(stamps_s, found, strict=True)
            ]
        elif kind == "camera":
            decoded = cv2.imdecode(np.frombuffer(payload, np.uint8), cv2.IMREAD_COLOR)
            assert decoded is not None, "the surrogate sends JPEG"
            self.pictures[header["camera"]] = (
                stamps_s[0],
                cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB),
            )
            samples = [("camera", stamps_s[0], header["camera"], payload)]
        else:
            names = [ROBOT.pads[k] for k in header["pads"]]
            frames = np.frombuffer(payload, np.uint8).reshape(-1, *PAD_WIRE_SHAPE)
            samples = [
                ("pad", stamps_s[0], name, frame)
                for name, frame in zip(names, frames, strict=True)
            ]
            for _, stamp, name, frame in samples:
                self.pads[name].put((stamp, frame))
                if self.pads[name].qsize() > 4096:  # 40 s: nobody reads them
                    self.pads[name].get_nowait()
        for listener in self.listeners:
            for sample in samples:
                listener(*sample)
