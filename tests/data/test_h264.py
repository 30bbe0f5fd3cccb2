"""Frames that are lost from a stream of H.264: named up to the next key frame, in streams of several encoders' settings."""

import functools
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from small_arm import CAMERA, Sent, messages, video, write_mcap

from taccorl.data.h264 import FrameNumbers
from taccorl.data.inspection import inspect_source
from taccorl.data.pictures import VideoStream
from taccorl.data.recording import find_sources

FRAMES, KEY = 120, 30
SETTINGS = {
    "baseline": "keyint=30:min-keyint=30:scenecut=0:bframes=0:cabac=0:ref=1",
    "main": "keyint=30:min-keyint=30:scenecut=0:bframes=0:ref=4",
    "slices": "keyint=30:min-keyint=30:scenecut=0:bframes=0:slices=3",
    "one key frame of all": "keyint=500:scenecut=0:bframes=0",
}


@functools.cache
def encoded(
    settings: str, frames: int = FRAMES, pixels: str = "yuv420p"
) -> list[bytes]:
    """Messages of a square that moves over a grey ground."""
    encoder = av.CodecContext.create("libx264", "w")
    assert isinstance(encoder, av.VideoCodecContext)
    encoder.width, encoder.height, encoder.pix_fmt = 128, 96, pixels
    encoder.time_base = Fraction(1, 30)
    encoder.options = {"tune": "zerolatency", "x264-params": settings}
    out: list[bytes] = []
    for k in range(frames):
        picture = np.full((96, 128, 3), 90, np.uint8)
        picture[30:50, (at := (3 * k) % 100) : at + 20] = 255
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame = frame.reformat(format=pixels)
        frame.pts = k
        out += [bytes(p) for p in encoder.encode(frame)]
    return out + [bytes(p) for p in encoder.encode(None)]


def broken(sent: Sequence[bytes]) -> list[bool]:
    numbers = FrameNumbers()
    return [numbers.take(data) for data in sent]


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=list(SETTINGS))
def test_a_whole_stream_misses_nothing(settings):
    assert len(sent := encoded(settings, 400)) == 400
    assert not any(broken(sent))  # frame_num begins anew within it


@pytest.mark.parametrize("pixels", ["yuv420p", "yuv444p"])
@pytest.mark.parametrize("settings", [*SETTINGS.values()][:3], ids=[*SETTINGS][:3])
@pytest.mark.parametrize("lost", [[65], [65, 66, 67, 68, 69, 70], [61], [88]])
def test_all_frames_from_a_loss_to_the_next_key_frame_are_named(lost, settings, pixels):
    sent = encoded(settings, pixels=pixels)
    kept = [k for k in range(FRAMES) if k not in lost]
    found = broken([sent[k] for k in kept])
    assert [k for k, is_bad in zip(kept, found, strict=True) if is_bad] == [
        k for k in kept if lost[0] < k < 90
    ]


def test_a_lost_key_frame_spoils_what_follows_it():
    """Its P frames carry on from frames that were never there: to the next key frame."""
    sent = encoded(SETTINGS["main"])
    kept = [k for k in range(FRAMES) if k != 60]
    found = broken([sent[k] for k in kept])
    assert [k for k, is_bad in zip(kept, found, strict=True) if is_bad] == [
        *range(61, 90)
    ]


def test_bytes_that_are_no_stream_break_nothing():
    rng = np.random.default_rng(0)
    for length in (0, 1, 3, 4, 5, 40, 500):
        data = b"\0\0\1" + rng.integers(0, 256, length, dtype=np.uint8).tobytes()
        assert broken([data, data[:4], b"", data]) is not None


def test_the_decoder_gives_no_picture_that_may_show_remains():
    sent = encoded(SETTINGS["main"])
    stream, none, shown = VideoStream("h264"), [], []
    for k in (k for k in range(FRAMES) if not 65 <= k <= 70):
        for number, picture in stream.decode(k, sent[k]):
            (none if picture is None else shown).append(number)
    assert none == [*range(71, 90)]
    assert shown == [*range(65), *range(90, FRAMES)]


def test_a_stream_that_begins_between_key_frames_is_drafted(tmp_path: Path):
    """The first 9 of its frames come before a key frame, and give no picture."""
    frame = video(every=15)
    pictures = [frame(k / 30) for k in range(90)][6:]
    others = [m for m in messages() if m.topic != CAMERA and m.time_s >= 0.2]
    path = write_mcap(tmp_path / "a.mcap", [*others, *pictures])
    ((reader, source),) = find_sources(path)
    (topic,) = [t for t in inspect_source(reader, source).topics if t.topic == CAMERA]
    assert (topic.unusable, topic.problem) == (9, "")


def test_a_stream_without_a_key_frame_is_not_drafted(tmp_path: Path):
    frame = video(every=200)
    pictures: list[Sent] = [frame(k / 30) for k in range(90)][6:]
    path = write_mcap(tmp_path / "a.mcap", pictures)
    ((reader, source),) = find_sources(path)
    (topic,) = inspect_source(reader, source).topics
    assert "84 messages" in topic.problem
