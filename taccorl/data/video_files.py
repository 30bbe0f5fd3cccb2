"""Videos of datasets through PyAV: the frame of every row, found by its own time stamp, never by counting."""

from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.episode import Video
from taccorl.data.file_kinds import plainly
from taccorl.errors import DatasetError
from taccorl.extras import OnUse

av = OnUse("av")
TOLERANCE_S = (
    1e-4  # A frame may lie this far from its row's time: LeRobot's own ``tolerance_s``
)


def _nearest(times_s: np.ndarray, due_s: np.ndarray) -> np.ndarray:
    """Index of the closest of the sorted ``times_s`` for each of ``due_s``."""
    if len(times_s) < 2:
        return np.zeros(len(due_s), dtype=int)
    after = np.clip(np.searchsorted(times_s, due_s), 1, len(times_s) - 1)
    return np.where(
        due_s - times_s[after - 1] <= times_s[after] - due_s, after - 1, after
    )


def _packet_times(path: Path) -> tuple[np.ndarray, int]:
    """Sorted times (s) of a video's frames, and how many of them are corrupt, without decoding."""
    times, corrupt = [], 0
    with plainly(path, "a video"), av.open(str(path)) as container:
        for packet in container.demux(container.streams.video[0]):
            if packet.pts is not None and packet.size:
                times.append(packet.pts * packet.time_base)
                corrupt += packet.is_corrupt
    return np.sort(np.array(times, dtype=float)), corrupt


def video_frames(
    video: Video, fps: int, first: int, end: int, name: str
) -> Generator[np.ndarray, None, None]:
    """(rows, columns, 3) uint8 RGB pictures of rows ``first`` to ``end`` (excluded) of an episode, one at a time. ``name``:
    of the video, for the message. Raises DatasetError: a row has no frame at its time."""
    row = first
    for time_s, frame in (
        _decode_from(video.path, video.from_s + first / fps) if row < end else ()
    ):
        due_s = video.from_s + row / fps
        if time_s > due_s + TOLERANCE_S:
            break
        if time_s > due_s - TOLERANCE_S:
            yield frame.to_ndarray(format="rgb24")
            row += 1
            if row == end:
                return
    if row < end:
        raise DatasetError(
            f"{name}: no frame at {video.from_s + row / fps:.4f} s for row {row} of {end}"
        )


def _decode_from(path: Path, time_s: float) -> Iterator[tuple[float, Any]]:
    """(time, frame) of a video from the keyframe before ``time_s`` on."""
    with plainly(path, "a video"), av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        assert stream.time_base is not None
        base = float(stream.time_base)
        container.seek(max(0, round(time_s / base) - 1), stream=stream)
        frames = container.decode(stream)
        first = next(frames, None)
        if (
            first is None
            or first.pts is None
            or first.pts * base > time_s + TOLERANCE_S
        ):
            container.seek(
                0, stream=stream
            )  # an index that points behind the wanted frame: from the start, then
            frames = container.decode(stream)
        else:
            yield first.pts * base, first
        yield from (
            (frame.pts * base, frame) for frame in frames if frame.pts is not None
        )


def _shift(times_s: np.ndarray, due_s: np.ndarray) -> float | None:
    """Seconds from the times ``due_s`` of an episode's rows to those of its frames, where all of them are off by one time
    below half a frame; None if they are not, or not off."""
    if not len(times_s) or len(due_s) < 2:
        return None
    off_s = times_s[_nearest(times_s, due_s)] - due_s
    shift_s = float(np.median(off_s))
    is_one = np.abs(off_s - shift_s).max() < TOLERANCE_S
    half_s = (due_s[1] - due_s[0]) / 2
    return shift_s if is_one and TOLERANCE_S <= abs(shift_s) < half_s else None


def frame_shift(path: Path, due_s: np.ndarray) -> float | None:
    """Seconds by which a video's frames come after the times ``due_s`` (T,) of an episode's rows, if that is one time below
    half a frame for all rows; else None. Raises DatasetError: the video cannot be read."""
    return _shift(_packet_times(path)[0], due_s)


def frame_problems(path: Path, due: Mapping[int, np.ndarray]) -> list[str]:
    """Compare, without decoding, the packets of a video file with the rows that it shows: every row must have a frame of its own.
    ``due``: episode → (T,) times of its rows [s]. One text for each problem."""
    try:
        times_s, corrupt = _packet_times(path)
    except DatasetError as error:
        return [str(error).removeprefix(f"{path}: ")]
    problems = (
        [f"{corrupt} of {len(times_s)} frames are cut off or corrupt"]
        if corrupt
        else []
    )
    owner: dict[int, int] = {}
    for index, due_s in due.items():
        if (shift_s := _shift(times_s, due_s)) is not None:
            side = "before" if shift_s > 0 else "after"
            text = f"episode {index}: from_timestamp lies {abs(shift_s) * 1000:.1f} ms {side} the frame at "
            text += f"{due_s[0] + shift_s:.4f} s, so that no row has one; `taccorl check DATASET --repair=COPY` writes a copy "
            problems.append(f"{text}with the right one")
            due_s = due_s + shift_s
        nearby = _nearest(times_s, due_s)
        found = (
            np.abs(times_s[nearby] - due_s) < TOLERANCE_S
            if len(times_s)
            else np.zeros(len(due_s), dtype=bool)
        )
        if not found.all():
            row = int(np.argmin(found))
            text = f"episode {index}: {int(found.sum())} frames for {len(due_s)} rows; row {row} has none at "
            problems.append(f"{text}{due_s[row]:.4f} s")
        claimed = [int(f) for f in nearby[found]]
        if shared := [owner[f] for f in claimed if f in owner]:
            problems.append(
                f"episode {index}: {len(shared)} of its frames are also those of episode {min(shared)}"
            )
        owner.update(dict.fromkeys(claimed, index))
    if spare := [f for f in range(len(times_s)) if f not in owner]:
        rows, episodes = sum(map(len, due.values())), list(due)
        text = f"{len(times_s)} frames for {rows} rows of episodes {episodes[0]} to {episodes[-1]}: {len(spare)} "
        problems.append(
            f"{text}frames belong to no row, first at {times_s[spare[0]]:.4f} s"
        )
    return problems
