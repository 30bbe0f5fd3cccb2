"""Merge LeRobot datasets that have no videos, by concatenating their Parquet tables.

LeRobot 0.6.1's ``aggregate_datasets`` took 90 CPU-s for 24 demonstrations (one run, under a profiler): it reads the statistics
of each episode as 138 typed columns, several times. The result here is the same except for how rows are divided into files; a
test compares both.
"""

import functools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

_MB = 1024 * 1024
_DATA, _EPISODES = "data", "meta/episodes"


def has_videos(root: Path) -> bool:
    """Whether a feature of the dataset is a video or a picture."""
    return any(f["dtype"] in ("video", "image") for f in _info(root)["features"].values())


def join_numbers(roots: Sequence[Path], destination: Path) -> None:
    """Write the dataset that holds the episodes of ``roots``, in their order, without ``meta/stats.json``.

    Args:
        roots: datasets without videos.
        destination: does not exist, or is empty.

    Raises:
        ValueError: they differ in features, rate or robot.
    """
    infos = [_info(root) for root in roots]
    for info, root in zip(infos, roots, strict=True):
        for key in ("fps", "robot_type", "features"):
            if info[key] != infos[0][key]:
                raise ValueError(f"{key} of {root.name} is {info[key]}, that of {roots[0].name} {infos[0][key]}")
    tasks = _Tasks(roots)
    data = _Files(destination, _DATA, infos[0])
    episodes = _Files(destination, _EPISODES, infos[0])
    first_row = first_episode = 0
    for root, info in zip(roots, infos, strict=True):
        place: dict[tuple[int, int], tuple[int, int]] = {}
        for path in _files(root, _DATA):
            table = pq.read_table(path)
            table = _plus(table, "index", first_row)
            table = _plus(table, "episode_index", first_episode)
            table = _set(table, "task_index", tasks.renumbered(root, table["task_index"]))
            place[_numbers(path)] = data.append(table, path.stat().st_size)
        for path in _files(root, _EPISODES):
            table = _without_lost_features(pq.read_table(path), infos[0]["features"])
            table = _plus(table, "episode_index", first_episode)
            for key in ("dataset_from_index", "dataset_to_index"):
                table = _plus(table, key, first_row)
            table = _with_own_statistics(table, first_row, first_episode, tasks)
            was = zip(*(table[f"data/{kind}_index"].to_pylist() for kind in ("chunk", "file")), strict=True)
            table = _placed(table, "data", [place[numbers] for numbers in was])
            here = episodes.place_of(path.stat().st_size)
            episodes.append(_placed(table, "meta/episodes", [here] * len(table)), path.stat().st_size)
        first_row += info["total_frames"]
        first_episode += info["total_episodes"]
    data.close()
    episodes.close()
    tasks.write(destination)
    totals = {"total_episodes": first_episode, "total_frames": first_row, "total_tasks": len(tasks.names)}
    splits = {"train": f"0:{first_episode}"}
    (destination / "meta/info.json").write_text(
        json.dumps(infos[0] | totals | {"splits": splits}, indent=4, ensure_ascii=False), encoding="utf-8"
    )


def _without_lost_features(table: pa.Table, features: dict[str, Any]) -> pa.Table:
    """Without statistics of features that LeRobot's ``modify_features`` has removed: it leaves them in the table of episodes."""

    def is_there(column: str) -> bool:
        return not column.startswith("stats/") or column.removeprefix("stats/").rpartition("/")[0] in features

    return table.select([column for column in table.column_names if is_there(column)])


class _Files:
    """Parquet files of one kind, each of about the size that ``info`` allows."""

    def __init__(self, root: Path, kind: str, info: dict[str, Any]) -> None:
        self._root, self._kind = root, kind
        self._limit, self._per_chunk = info["data_files_size_in_mb"] * _MB, info["chunks_size"]
        self._writer: pq.ParquetWriter | None = None
        self._number, self._size = -1, 0

    def place_of(self, size: int) -> tuple[int, int]:
        """Chunk and file that a table of ``size`` bytes will be appended to."""
        full = self._writer is None or (self._size > 0 and self._size + size > self._limit)
        return divmod(self._number + full, self._per_chunk)

    def append(self, table: pa.Table, size: int) -> tuple[int, int]:
        """Chunk and file that it came into."""
        chunk, number = place = self.place_of(size)
        if self._writer is None or chunk * self._per_chunk + number != self._number:
            self.close()
            path = self._root / self._kind / f"chunk-{chunk:03d}" / f"file-{number:03d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, table.schema, compression="snappy", use_dictionary=True)
            self._number, self._size = chunk * self._per_chunk + number, 0
        self._writer.write_table(table)
        self._size += size
        return place

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


class _Tasks:
    """Instructions of all datasets, each once, numbered as they first come."""

    def __init__(self, roots: Sequence[Path]) -> None:
        import pandas as pd

        self._of = {root: pd.read_parquet(root / "meta/tasks.parquet") for root in roots}
        self.names: list[str] = list(dict.fromkeys(name for frame in self._of.values() for name in frame.index))

    def renumbered(self, root: Path, column: pa.ChunkedArray) -> pa.Array:
        frame, number = self._of[root], {name: k for k, name in enumerate(self.names)}
        new = np.zeros(int(frame["task_index"].max()) + 1, dtype=np.int64)
        new[frame["task_index"].to_numpy()] = [number[name] for name in frame.index]
        return pa.array(new[column.to_numpy()])

    def write(self, root: Path) -> None:
        import pandas as pd

        frame = pd.DataFrame({"task_index": range(len(self.names))}, index=pd.Index(self.names, name="task"))
        frame.to_parquet(root / "meta/tasks.parquet")


def _with_own_statistics(table: pa.Table, first_row: int, first_episode: int, tasks: _Tasks) -> pa.Table:
    """Of rows' and episodes' numbers, which are others here, and of tasks, as LeRobot tells them of an episode's instructions."""
    for key, more in (("index", first_row), ("episode_index", first_episode)):
        for name in set(_STATISTICS) - {"std"}:
            column = f"stats/{key}/{name}"
            if column in table.column_names:
                moved = [[x + more for x in cell] for cell in table[column].to_pylist()]
                table = _set(table, column, _like(moved, table, column))
    number = {name: k for k, name in enumerate(tasks.names)}
    ids = [np.array([number[name] for name in names], dtype=float) for names in table["tasks"].to_pylist()]
    for name, statistic in _STATISTICS.items():
        column = f"stats/task_index/{name}"
        if column in table.column_names:
            cells = zip(table[column].to_pylist(), ids, strict=True)
            table = _set(
                table, column, _like([[float(statistic(own))] * len(cell) for cell, own in cells], table, column)
            )
    return table


_STATISTICS: dict[str, Callable[[np.ndarray], Any]] = {
    "min": np.min,
    "max": np.max,
    "mean": np.mean,
    "std": np.std,
    **{f"q{q:02d}": functools.partial(np.quantile, q=q / 100) for q in (1, 10, 50, 90, 99)},
}


def _like(values: list[Any], table: pa.Table, column: str) -> pa.Array:
    kind = table.schema.field(column).type
    number = kind.value_type
    if pa.types.is_integer(number):
        values = [[round(x) for x in cell] for cell in values]
    return pa.array(values, kind)


def _info(root: Path) -> dict[str, Any]:
    return json.loads((root / "meta/info.json").read_text(encoding="utf-8"))


def _files(root: Path, kind: str) -> Iterator[Path]:
    yield from sorted((root / kind).glob("chunk-*/file-*.parquet"))


def _numbers(path: Path) -> tuple[int, int]:
    """Chunk and file."""
    return int(path.parent.name.removeprefix("chunk-")), int(path.stem.removeprefix("file-"))


def _plus(table: pa.Table, key: str, more: int) -> pa.Table:
    return _set(table, key, pc.add(table[key], more))  # pyright: ignore[reportAttributeAccessIssue]


def _placed(table: pa.Table, prefix: str, places: Sequence[tuple[int, int]]) -> pa.Table:
    for k, kind in enumerate(("chunk", "file")):
        table = _set(table, f"{prefix}/{kind}_index", pa.array([place[k] for place in places], pa.int64()))
    return table


def _set(table: pa.Table, key: str, column: Any) -> pa.Table:
    at = table.column_names.index(key)
    return table.set_column(at, table.schema.field(at), column)
