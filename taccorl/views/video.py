"""An episode's part of a dataset's mp4 as a small mp4 of its own: packets are copied, never decoded or encoded again."""

import contextlib
import io
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import av
from av.container import InputContainer
from av.error import FFmpegError

from taccorl.data.episode import Video
from taccorl.errors import DatasetError

MOST_REORDERED_FRAMES = 16
"""Largest number of frames by which decoding order and display order may differ: the limit of H.264 and AV1."""


@dataclass(frozen=True)
class Clip:
    """A small mp4 with an episode. It begins at a keyframe, so that frames from before the episode may come first."""

    mp4: bytes
    first_frame: int
    """Index, in order of time, of the frame that is the episode's row 0."""
    codec: str


def cut(video: Video, fps: int) -> Clip:
    """Copy the episode's packets into a small mp4, from the last keyframe at or before its first frame to the keyframe behind
    its last one. Raises DatasetError: the file does not exist, cannot be read, or holds fewer frames than the dataset
    states."""
    with _opened(video) as source:
        return _cut(source, video, fps)


def codec_of(video: Video) -> str:
    """Name of a video's codec: ``av1``, ``h264`` …; raises as ``cut`` if the file cannot be read."""
    with _opened(video) as source:
        return _codec(source)


@contextlib.contextmanager
def _opened(video: Video) -> Iterator[InputContainer]:
    try:
        with contextlib.closing(av.open(str(video.path))) as source:
            yield source
    except (FFmpegError, OSError, IndexError) as error:
        raise DatasetError(f"{video.path}: is no video ({error}): copy or write the dataset again") from error


def _codec(source: InputContainer) -> str:
    return source.streams.video[0].codec_context.codec.canonical_name


def _cut(source: InputContainer, video: Video, fps: int) -> Clip:
    stream = source.streams.video[0]
    tick_s = stream.time_base or Fraction(1, 90_000)
    begin_pts = (video.from_s - 0.5 / fps) / tick_s
    end_pts = begin_pts + video.num_frames / fps / tick_s
    # An mp4's index knows when frames are decoded, not when they are shown: begin early enough, then drop what is not needed.
    early_s = max(video.from_s - MOST_REORDERED_FRAMES / fps, 0.0)
    source.seek(round(early_s / tick_s), stream=stream)
    packets, times, num_found = [], [], 0
    for packet in source.demux(stream):
        if packet.pts is None or packet.dts is None:  # the demuxer's empty last packet
            continue
        # Enough only at a keyframe: in front of it, in the file, may stand frames that are shown later.
        if num_found >= video.num_frames and packet.is_keyframe and packet.pts >= end_pts:
            break
        if packet.is_keyframe and packet.pts < begin_pts + 1 / fps / tick_s:
            packets.clear()
            times.clear()
        if times and packet.pts < times[0]:  # leans on a group that was dropped, and is shown before what we want
            continue
        num_found += begin_pts <= packet.pts < end_pts
        packets.append(packet)
        times.append(packet.pts)
    if num_found != video.num_frames:
        raise DatasetError(
            f"{video.path}: {num_found} frames from {video.from_s:.3f} s on, but the dataset states {video.num_frames}: its "
            "video and its rows do not match; write the dataset again"
        )
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as target:
        copy = target.add_stream_from_template(stream, opaque=True)  # opaque: PyAV need not know an encoder for it
        start = packets[0].dts
        for packet in packets:
            packet.pts, packet.dts, packet.stream = packet.pts - start, packet.dts - start, copy
            target.mux(packet)
    return Clip(buffer.getvalue(), sum(pts < begin_pts for pts in times), _codec(source))
