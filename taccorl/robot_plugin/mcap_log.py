"""What a robot sees, feels and is told, written as MCAP by the drivers' own names, rates and types while LeRobot runs.

``taccorl ingest FILE --spec=piper_flexitac_mcap`` reads it as any recording: so a rollout is compared and diagnosed, too.
"""

import contextlib
import functools
import logging
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from taccorl.data.origin import RATE_OF, Origin, labelled
from taccorl.errors import TaccorlError
from taccorl.robot_plugin.faults import described
from taccorl.robots import ROBOT
from taccorl.surrogate import driver_messages as messages
from taccorl.surrogate import drivers
from taccorl.surrogate.driver_messages import MessageWriter

_JPEG_QUALITY = 90
_log = logging.getLogger(__name__)


def _never_raises(method: Callable[..., None]) -> Callable[..., None]:
    """``method`` of a log; an exception in it ends the recording, not the robot."""

    @functools.wraps(method)
    def call(self: "McapLog", *values: Any) -> None:
        try:
            method(self, *values)
        except Exception as error:
            self._end(error)

    return call


class McapLog:
    """One file of one connection, safe to be called from several threads. Raises TaccorlError: the file exists, or cannot be
    made. If it cannot be written any more (a full disk, a value that no message can hold), the recording ends with an error in
    the log, and the robot goes on: no method but the constructor raises."""

    def __init__(
        self,
        path: Path,
        origin: Origin,
        instruction: str,
        clock: Callable[[], float],
        rates_hz: Mapping[str, float],
    ) -> None:
        """``rates_hz``: topic → rate [Hz], where it is not that of the drivers."""
        if path.exists():
            raise TaccorlError(
                f"--robot.record={path}: exists; give another file, or remove it"
            )
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file, self._lock = path.open("wb"), threading.Lock()
        except OSError as error:
            raise TaccorlError(f"--robot.record={path}: {error.strerror}") from error
        self._writer = Writer(self._file, compression=CompressionType.LZ4)
        self._messages = MessageWriter(self._writer)
        self._writer.start(profile=self._messages.profile, library="taccorl")
        rates = {RATE_OF + topic: f"{rate_hz:g}" for topic, rate_hz in rates_hz.items()}
        self._writer.add_metadata("taccorl", {**labelled(origin), **rates})
        self._clock, self._zero_ns = (
            clock,
            time.time_ns() - round(clock() * 1e9),
        )  # Unix time of the clock's 0
        self.instruction, self._open, self._in_episode = instruction, True, False
        self._last: dict[str, float] = {}

    @_never_raises
    def state(self, stamp_s: float, values: np.ndarray) -> None:
        """(3, 14) position [rad, m], velocity and effort; NaN where they are not measured."""
        self._joints(drivers.STATE_TOPICS, stamp_s, *values)

    @_never_raises
    def command(self, target: np.ndarray) -> None:
        """(14,) command [rad, m] that is sent now. The first one begins an episode."""
        if not self._in_episode:
            self._in_episode = True
            self._write(
                drivers.EPISODE_TOPIC,
                messages.STRING,
                {"data": f"start:{self.instruction}"},
            )
        self._last["command"] = self._clock()
        none = np.zeros(ROBOT.num_actions)
        self._joints(drivers.COMMAND_TOPICS, self._last["command"], target, none, none)

    @_never_raises
    def picture(self, stamp_s: float, camera: str, picture: np.ndarray | bytes) -> None:
        """A JPEG file's bytes, or (rows, columns, 3) uint8 RGB."""
        if self._last.get(camera) == stamp_s:
            return
        self._last[camera] = stamp_s
        if not isinstance(picture, bytes):
            picture = drivers.jpeg(
                cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), _JPEG_QUALITY
            )
        header = self._header(stamp_s, f"{camera}_color_optical_frame")
        message = {"header": header, "format": "jpeg", "data": picture}
        self._write(drivers.CAMERA_TOPICS[camera], messages.COMPRESSED_IMAGE, message)

    @_never_raises
    def pad(self, stamp_s: float, pad: str, frame: np.ndarray) -> None:
        """Frame (12, 32) uint8 of a pad as on the wire, whose log time is its only one."""
        topic = drivers.PAD_TOPICS[drivers.PADS[ROBOT.pads.index(pad)]]
        self._write(topic, messages.UINT8_ARRAY, drivers.pad_message(frame), stamp_s)

    @_never_raises
    def pause(self) -> None:
        """End the episode at its last command; the next one begins another."""
        if self._in_episode:
            self._write(
                drivers.EPISODE_TOPIC,
                messages.STRING,
                {"data": "end"},
                self._last["command"],
            )
            self._in_episode = False

    def close(self) -> None:
        """Finish the file; later samples are dropped."""
        self.pause()
        self._finish()

    def discard(self) -> None:
        """Remove the file: the connection that it was made for has failed."""
        with self._lock:
            self._open = False
            with contextlib.suppress(OSError):
                self._file.close()
            Path(self._file.name).unlink(missing_ok=True)

    @_never_raises
    def _finish(self) -> None:
        with self._lock:
            if self._open:
                self._writer.finish()
                self._file.close()
                self._open = False

    def _joints(
        self, topics: dict[str, str], stamp_s: float, *values: np.ndarray
    ) -> None:
        position = drivers.as_piper_publishes(values[0][None])[0]
        for arm, topic in topics.items():
            own, joints = ROBOT.arm_slice(arm), ROBOT.joint_slice(arm)
            message = {
                "header": self._header(stamp_s, ""),
                "name": list(drivers.JOINT_NAMES),
            }
            message |= {
                "position": position[own].tolist(),
                "velocity": _known(values[1][joints]),
            }
            self._write(
                topic,
                messages.JOINT_STATE,
                message | {"effort": _known(values[2][own])},
            )

    def _header(self, stamp_s: float, frame_id: str) -> dict[str, Any]:
        ns = self._zero_ns + round(stamp_s * 1e9)
        return {
            "stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9},
            "frame_id": frame_id,
        }

    def _write(
        self, topic: str, kind: str, message: dict[str, Any], log_s: float | None = None
    ) -> None:
        now_s = self._clock() if log_s is None else log_s
        with self._lock:
            if self._open:
                time_ns = self._zero_ns + round(now_s * 1e9)
                self._messages.write(topic, kind, message, time_ns)

    def _end(self, error: Exception) -> None:
        with self._lock:
            if not self._open:
                return
            self._open = False
            name, text = self._file.name, described(error)
            _log.error("%s: the recording ends here, unfinished: %s", name, text)
            with contextlib.suppress(OSError):
                self._file.close()


def _known(values: np.ndarray) -> list[float]:
    """Field of a JointState message: empty, as ROS has it, if the values are not measured (NaN)."""
    return [] if np.isnan(values).any() else values.tolist()
