"""A part of an episode as an episode of its own."""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from taccorl.data.episode import Episode, Pictures
from taccorl.data.timing import NS_PER_S
from taccorl.data.video_files import video_frames
from taccorl.errors import TaccorlError


def part_of(episode: Episode, start_s: float | None, end_s: float | None) -> Episode:
    """The rows from ``start_s`` up to, but not at, ``end_s`` (seconds since row 0; None: the episode's own), as an episode.
    Raises TaccorlError: no row is in the range."""
    if start_s is None and end_s is None:
        return episode
    fps, num_rows = episode.spec.fps, episode.num_rows
    whole_s = num_rows / fps
    begin_s, until_s = (
        0.0 if start_s is None else start_s,
        whole_s if end_s is None else end_s,
    )
    first = max(int(np.ceil(begin_s * fps - 1e-6)), 0)
    end = min(int(np.ceil(until_s * fps - 1e-6)), num_rows)
    if first >= end:
        raise TaccorlError(
            f"no rows from {begin_s:g} to {until_s:g} s: {episode.name} lasts {whole_s:.2f} s"
        )
    kept = slice(first, end)
    before = [s for s in episode.stages if s[0] <= first][
        -1:
    ]  # the stage that is on when the part begins
    later = [s for s in episode.stages if first < s[0] < end]
    videos = {
        key: dataclasses.replace(
            v, from_s=v.from_s + first / fps, num_frames=end - first
        )
        for key, v in episode.videos.items()
    }

    def pictures() -> Iterator[Pictures]:
        if episode.picture_keys and set(episode.picture_keys) <= set(
            videos
        ):  # nothing before them is decoded
            streams = [
                video_frames(videos[key], fps, 0, end - first, f"{episode.name}, {key}")
                for key in episode.picture_keys
            ]
            return (
                dict(zip(episode.picture_keys, shown, strict=True))
                for shown in zip(*streams, strict=True)
            )
        return itertools.islice(episode.pictures(), first, end)

    note = f"{first / fps:.2f} to {end / fps:.2f} s of {whole_s:.2f} s; timing is that of the whole"
    return dataclasses.replace(
        episode,
        name=f"{episode.name}, {first / fps:.2f} to {end / fps:.2f} s",
        start_ns=episode.start_ns + round(first * NS_PER_S / fps),
        arrays={key: array[kept] for key, array in episode.arrays.items()},
        pictures=pictures,
        picture_rows={key: rows[kept] for key, rows in episode.picture_rows.items()},
        videos=videos,
        stages=tuple((max(row - first, 0), name) for row, name in (*before, *later)),
        provenance={**episode.provenance, "shown": note},
    )
