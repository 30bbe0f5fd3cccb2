"""Cutting an episode out of a dataset's mp4: the same pictures, frame by frame, without encoding again."""

import io
from pathlib import Path

import av
import numpy as np
import pytest
import rerun as rr

from taccorl.data.episode import Video
from taccorl.errors import DatasetError
from taccorl.views.video import codec_of, cut

from .made_episode import draw, write_mp4

FPS, NUM_FRAMES = 30, 40
CODECS = {
    "LeRobot's AV1": ("libsvtav1", {}),
    "LeRobot's H.264": ("h264", {}),
    "few keyframes": ("h264", {"g": "12", "sc_threshold": "0"}),
    "frames shown in another order": ("h264", {"g": "12", "bf": "3", "sc_threshold": "0"}),
    "groups that lean on the one before": ("h264", {"x264-params": "keyint=12:open-gop=1:bframes=3:scenecut=0"}),
}


def decoded(source: Path | io.BytesIO) -> list[np.ndarray]:
    with av.open(source if isinstance(source, io.BytesIO) else str(source)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize("kind", CODECS)
@pytest.mark.parametrize(("first", "num"), [(0, 40), (7, 20), (13, 1), (24, 16)])
def test_a_clip_shows_exactly_the_episodes_frames(tmp_path: Path, kind: str, first: int, num: int):
    codec, options = CODECS[kind]
    path = tmp_path / "file.mp4"
    images = (draw("x.front", row, NUM_FRAMES, 64) for row in range(NUM_FRAMES))
    write_mp4(path, images, fps=FPS, codec=codec, options=options)
    clip = cut(Video(path, first / FPS, num), FPS)
    shown = decoded(io.BytesIO(clip.mp4))[clip.first_frame :][:num]
    assert len(shown) == num
    for mine, whole in zip(shown, decoded(path)[first : first + num], strict=True):
        assert np.array_equal(mine, whole)
    times_ns = rr.AssetVideo(contents=clip.mp4, media_type="video/mp4").read_frame_timestamps_nanos()
    steps_s = np.diff(times_ns[clip.first_frame :][:num]) / 1e9
    assert np.allclose(steps_s, 1 / FPS, atol=1e-4), "Rerun sees the frames in their order"


def test_a_clip_leaves_the_rest_of_the_file_behind(tmp_path: Path):
    path = tmp_path / "file.mp4"
    images = (draw("x.front", row, 300, 64) for row in range(300))
    write_mp4(path, images, fps=FPS, codec="libsvtav1")
    clip = cut(Video(path, 200 / FPS, 20), FPS)
    assert len(decoded(io.BytesIO(clip.mp4))) <= 22  # a keyframe every 2 frames: at most one before, one behind
    assert clip.codec == codec_of(Video(path, 0.0, 1)) == "av1"


def test_a_file_with_too_few_frames_is_refused_with_both_numbers(tmp_path: Path):
    path = tmp_path / "file.mp4"
    write_mp4(path, (draw("x.front", row, 10, 64) for row in range(10)), fps=FPS, codec="h264")
    with pytest.raises(DatasetError, match=r"file\.mp4: 10 frames from 0\.000 s on, but the dataset states 12"):
        cut(Video(path, 0.0, 12), FPS)


@pytest.mark.parametrize("content", [None, b"", b"no video at all" * 100])
def test_a_file_that_is_no_video_is_named(tmp_path: Path, content: bytes | None):
    path = tmp_path / "file.mp4"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"file\.mp4: is no video"):
        cut(Video(path, 0.0, 5), FPS)
