"""Cutting a stretch out of an episode or a dataset's mp4: the same rows and pictures, frame by frame, not encoded again."""

import io
from pathlib import Path

import av
import numpy as np
import pytest
import rerun as rr

from taccorl.data.episode import Video
from taccorl.errors import DatasetError, TaccorlError
from taccorl.views.part import part_of
from taccorl.views.video import codec_of, cut

from .made_episode import ORIGIN, TOUCH, draw, in_dataset, made_episode, write_mp4

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


EPISODE = made_episode(90, picture_size=32)  # 3 s


def test_rows_pictures_and_stages_begin_at_the_same_row():
    part = part_of(EPISODE, 1.0, 2.5)
    assert part.num_rows == 45
    for key in ("observation.state", "action", TOUCH):
        assert np.array_equal(part.arrays[key], EPISODE.arrays[key][30:75])
    whole, shown = list(EPISODE.pictures()), list(part.pictures())
    assert len(shown) == 45
    assert np.array_equal(shown[0]["observation.images.front"], whole[30]["observation.images.front"])
    # Whole: reach from 0, hold from 36, release from 72. Row 30 lies in "reach".
    assert part.stages == ((0, "reach"), (6, "hold"), (42, "release"))
    assert part.start_ns == EPISODE.start_ns + 1_000_000_000
    assert part.origin == ORIGIN
    assert part.name.endswith("1.00 to 2.50 s")


def test_video_of_a_part_begins_at_its_first_row(tmp_path: Path):
    part = part_of(in_dataset(EPISODE, tmp_path, rows_before=7), 1.0, None)
    video = part.videos["observation.images.front"]
    assert video.from_s == pytest.approx((7 + 30) / 30)
    assert video.num_frames == 60
    assert cut(video, 30).first_frame == 1  # frame 37 follows the keyframe 36


@pytest.mark.parametrize(("start_s", "end_s"), [(3.0, None), (2.0, 1.0), (1.0, 1.0), (None, 0.0)])
def test_a_stretch_without_rows_says_how_long_the_episode_is(start_s: float | None, end_s: float | None):
    with pytest.raises(TaccorlError, match=r"no rows from .*: made\.mcap, episode 0 lasts 3\.00 s"):
        part_of(EPISODE, start_s, end_s)
