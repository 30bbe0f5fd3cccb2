"""Decoding of LeRobot's videos: PyAV if torchcodec cannot be loaded, and files that stay open.

LeRobot 0.6.1 makes the same choice (import_utils.py, ``get_safe_default_video_backend``), but prints about 180 lines each time:
two tracebacks for each version of FFmpeg that torchcodec did not find.
"""

import functools
import importlib
import importlib.util
import os
import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import av
import torch
from av.container import InputContainer
from torch import Tensor

MOST_OPEN = 16
"""Most video files that a process keeps open, at 3 MB each. Opening one again costs no more than seeking in it (18 and 19 ms)."""


@functools.cache
def default_video_backend() -> str:
    """Name of the video decoder: ``torchcodec``, or ``pyav`` if torchcodec is not installed or finds no FFmpeg."""
    if importlib.util.find_spec("torchcodec") is None:
        return "pyav"
    try:
        importlib.import_module("torchcodec")
    except (ImportError, OSError, RuntimeError):
        return "pyav"
    return "torchcodec"


class OpenVideos(threading.local):
    """Video files that stay open between pictures, per thread and process."""

    def __init__(self) -> None:
        self._process = os.getpid()
        self._open: OrderedDict[Path, InputContainer] = OrderedDict()

    def picture(self, path: Path, time_s: float, tolerance_s: float) -> Tensor | None:
        """Frame nearest to ``time_s`` [s], (3, rows, columns) uint8; None if there is none within ``tolerance_s``."""
        nearest, distance_s = None, tolerance_s
        for frame, frame_s in self._frames(path, time_s):
            if abs(frame_s - time_s) < distance_s:
                nearest, distance_s = frame, abs(frame_s - time_s)
            if frame_s >= time_s:
                break
        if nearest is None:
            return None
        return (
            torch.from_numpy(nearest.to_ndarray(format="rgb24"))
            .permute(2, 0, 1)
            .contiguous()
        )

    def _frames(
        self, path: Path, time_s: float
    ) -> Iterator[tuple[av.VideoFrame, float]]:
        """From the last keyframe that is not after ``time_s`` on."""
        container = self._container(path)
        stream = container.streams.video[0]
        assert stream.time_base is not None, "LeRobot's videos have a time base"
        container.seek(
            round(time_s / stream.time_base) - 1,
            backward=True,
            any_frame=False,
            stream=stream,
        )
        for frame in container.decode(stream):
            if frame.pts is not None:
                yield frame, float(frame.pts * stream.time_base)

    def _container(self, path: Path) -> InputContainer:
        if (
            self._process != os.getpid()
        ):  # a fork shares its parent's place in each file
            self.__init__()
        if path in self._open:
            self._open.move_to_end(path)
            return self._open[path]
        container = self._open[path] = av.open(str(path))
        container.streams.video[
            0
        ].thread_type = (
            "NONE"  # frame threads read ahead, for one frame that is in vain
        )
        if len(self._open) > MOST_OPEN:
            self._open.popitem(last=False)[1].close()
        return container


OPEN_VIDEOS = OpenVideos()
