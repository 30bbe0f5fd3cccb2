"""Cutting a stretch out of an episode: the same rows and pictures."""

from pathlib import Path

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.views.part import part_of

from .made_episode import ORIGIN, TOUCH, in_dataset, made_episode

EPISODE = made_episode(90, picture_size=32)  # 3 s


def test_rows_pictures_and_stages_begin_at_the_same_row():
    part = part_of(EPISODE, 1.0, 2.5)
    assert part.num_rows == 45
    for key in ("observation.state", "action", TOUCH):
        assert np.array_equal(part.arrays[key], EPISODE.arrays[key][30:75])
    whole, shown = list(EPISODE.pictures()), list(part.pictures())
    assert len(shown) == 45
    assert np.array_equal(
        shown[0]["observation.images.front"], whole[30]["observation.images.front"]
    )
    # Whole: reach from 0, hold from 36, release from 72. Row 30 lies in "reach".
    assert part.stages == ((0, "reach"), (6, "hold"), (42, "release"))
    assert part.start_ns == EPISODE.start_ns + 1_000_000_000 and part.origin == ORIGIN
    assert part.name.endswith("1.00 to 2.50 s")


def test_video_of_a_part_begins_at_its_first_row(tmp_path: Path):
    part = part_of(in_dataset(EPISODE, tmp_path, rows_before=7), 1.0, None)
    video = part.videos["observation.images.front"]
    assert video.from_s == pytest.approx((7 + 30) / 30)
    assert video.num_frames == 60


@pytest.mark.parametrize(
    ("start_s", "end_s"), [(3.0, None), (2.0, 1.0), (1.0, 1.0), (None, 0.0)]
)
def test_a_stretch_without_rows_says_how_long_the_episode_is(
    start_s: float | None, end_s: float | None
):
    with pytest.raises(
        TaccorlError, match=r"no rows from .*: made\.mcap, episode 0 lasts 3\.00 s"
    ):
        part_of(EPISODE, start_s, end_s)
