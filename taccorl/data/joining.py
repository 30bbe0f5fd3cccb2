"""Merge LeRobot datasets that have no videos, by concatenating their Parquet tables.

LeRobot 0.6.1's ``aggregate_datasets`` took 90 CPU-s for 24 demonstrations (one run, under a profiler): it reads the statistics
of each episode as 138 typed columns, several times. The result here is the same except for how rows are divided into files; a
test compares both.
"""

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from taccorl.data.dataset import read_info, write_info

_MB = 1024 * 1024
_FORMAT: dict[str, Any] = {"compression": "snappy", "use_dictionary": True}
_DATA, _EPISODES = "data", "meta/episodes"
_Place = tuple[int, int]  # chunk and file
_Source = tuple[_Place, Path, "_Part"]  # where to, from where


def has_videos(root: Path) -> bool:
    """Whether a feature of the dataset is a video or a picture."""
    return any(f["dtype"] in ("video", "image") for f in read_info(root)["features"].values())


def join_numbers(roots: Sequence[Path], destination: Path) -> None:
    """Write the dataset that holds the episodes of ``roots``, in their order, without ``meta/stats.json``. ``roots``:
    datasets without videos. ``destination``: does not exist, or is empty. Raises ValueError: the datasets differ in features,
    rate or robot."""
    infos = [read_info(root) for root in roots]
    for info, root in zip(infos, roots, strict=True):
        for key in ("fps", "robot_type", "features"):
            if info[key] != infos[0][key]:
                raise ValueError(f"{key} is {info[key]} in {root.name}, but {infos[0][key]} in {roots[0].name}")
    tasks = _Tasks(roots)
    rows = np.cumsum([0, *(info["total_frames"] for info in infos)])
    episodes = np.cumsum([0, *(info["total_episodes"] for info in infos)])
    parts = [_Part(root, int(rows[k]), int(episodes[k])) for k, root in enumerate(roots)]
    data, meta = _Files(destination, _DATA, infos[0]), _Files(destination, _EPISODES, infos[0])
    for part in parts:
        part.data = {path: data.place_of(path.stat().st_size) for path in _files(part.root, _DATA)}
        part.episodes = {path: meta.place_of(path.stat().st_size) for path in _files(part.root, _EPISODES)}
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # pyarrow works outside of Python's lock
        data.write(pool, [(place, path, part) for part in parts for path, place in part.data.items()], tasks)
        _write_episodes(destination, parts, infos[0]["features"], tasks, pool)
    tasks.write(destination)
    totals = {"total_episodes": int(episodes[-1]), "total_frames": int(rows[-1]), "total_tasks": len(tasks.names)}
    splits = {"train": f"0:{episodes[-1]}"}
    write_info(destination, infos[0] | totals | {"splits": splits})


@dataclass(eq=False)
class _Part:
    """One input dataset of the merge: its first row and episode in the result, and the chunk and file for each of its files."""

    root: Path
    first_row: int
    first_episode: int
    data: dict[Path, _Place] = field(default_factory=dict)
    episodes: dict[Path, _Place] = field(default_factory=dict)

    def rows_tables(self, path: Path, tasks: "_Tasks") -> Iterator[pa.Table]:
        """Renumbered rows of a file, one table for each of its row groups: an episode is read without those beside it."""
        with pq.ParquetFile(path) as file:
            for k in range(file.num_row_groups):
                table = _plus(file.read_row_group(k), "index", self.first_row)
                table = _plus(table, "episode_index", self.first_episode)
                yield set_column(table, "task_index", tasks.renumbered(self.root, table["task_index"]))


class _Files:
    """Parquet files of one kind, each of about the size that ``info`` allows."""

    def __init__(self, root: Path, kind: str, info: dict[str, Any]) -> None:
        self._root, self._kind = root, kind
        self._limit, self._per_chunk = info["data_files_size_in_mb"] * _MB, info["chunks_size"]
        self._number, self._size = 0, 0

    def place_of(self, size: int) -> _Place:
        """Which chunk and file the next table, of ``size`` bytes, is to be written into."""
        if self._size > 0 and self._size + size > self._limit:
            self._number, self._size = self._number + 1, 0
        self._size += size
        return divmod(self._number, self._per_chunk)

    def write(self, pool: ThreadPoolExecutor, sources: Sequence[_Source], tasks: "_Tasks") -> None:
        """Each file by a thread of its own. ``sources``: in the order of their rows."""
        by_file: dict[_Place, list[_Source]] = {}
        for source in sources:
            by_file.setdefault(source[0], []).append(source)

        def one(place: _Place) -> None:
            path = _path(self._root, self._kind, place)
            writer: pq.ParquetWriter | None = None
            for _, source, part in by_file[place]:
                for table in part.rows_tables(source, tasks):
                    writer = writer or pq.ParquetWriter(path, table.schema, **_FORMAT)
                    writer.write_table(table.select(writer.schema.names))
            if writer is not None:
                writer.close()

        list(pool.map(one, by_file))


def _write_episodes(
    destination: Path, parts: Sequence[_Part], features: dict[str, Any], tasks: "_Tasks", pool: ThreadPoolExecutor
) -> None:
    """Write ``meta/episodes``. Tables are joined first and changed together: one by one they took most of the time of a merge."""
    sources = [(place, path, part) for part in parts for path, place in part.episodes.items()]
    read = list(pool.map(lambda source: _read(source[1]), sources))
    known = set.intersection(*(set(table.column_names) for table in read))  # some lack statistics of an added feature
    # LeRobot's ``modify_features`` leaves the statistics of removed features in the table.
    gone = {
        name
        for name in known
        if name.startswith("stats/") and name.removeprefix("stats/").rpartition("/")[0] not in features
    }
    read = [table.select([name for name in read[0].column_names if name in known - gone]) for table in read]
    for place in dict.fromkeys(source[0] for source in sources):
        own = [(table, part) for table, (to, _, part) in zip(read, sources, strict=True) if to == place]
        table = pa.concat_tables(table for table, _ in own)
        part_of = [part for table, part in own for _ in range(len(table))]
        first_rows = np.array([part.first_row for part in part_of])
        first_episodes = np.array([part.first_episode for part in part_of])
        table = _plus(table, "episode_index", first_episodes)
        for key in ("dataset_from_index", "dataset_to_index"):
            table = _plus(table, key, first_rows)
        table = _with_own_statistics(table, first_rows, first_episodes, tasks)
        was = zip(*(table[f"data/{kind}_index"].to_pylist() for kind in ("chunk", "file")), strict=True)
        into = {part: {_numbers(path): to for path, to in part.data.items()} for part in dict.fromkeys(part_of)}
        table = _placed(table, "data", [into[part][numbers] for part, numbers in zip(part_of, was, strict=True)])
        table = _placed(table, "meta/episodes", [place] * len(table))
        with pq.ParquetWriter(_path(destination, _EPISODES, place), table.schema, **_FORMAT) as writer:
            writer.write_table(table)


def _read(path: Path) -> pa.Table:
    """Table of a Parquet file. For small files of many columns this takes half the time of ``pq.read_table``."""
    with pq.ParquetFile(path) as file:
        return file.read()


def _path(root: Path, kind: str, place: _Place) -> Path:
    """Path of a Parquet file of ``kind`` in the dataset at ``root``; makes its folder."""
    path = root / kind / f"chunk-{place[0]:03d}" / f"file-{place[1]:03d}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


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


def _with_own_statistics(
    table: pa.Table, first_rows: np.ndarray, first_episodes: np.ndarray, tasks: _Tasks
) -> pa.Table:
    """Table of episodes with new statistics of the row, episode and task indices, which differ after the merge."""
    for key, more in (("index", first_rows), ("episode_index", first_episodes)):
        for name in set(_STATISTICS) - {"std"}:
            column = f"stats/{key}/{name}"
            if column in table.column_names:
                cells = zip(table[column].to_pylist(), more.tolist(), strict=True)
                moved = [[x + plus for x in cell] for cell, plus in cells]
                table = set_column(table, column, like(moved, table, column))
    number = {name: k for k, name in enumerate(tasks.names)}
    ids = [np.array([number[name] for name in names], dtype=float) for names in table["tasks"].to_pylist()]
    for name, statistic in _STATISTICS.items():
        column = f"stats/task_index/{name}"
        if column in table.column_names:
            cells = zip(table[column].to_pylist(), ids, strict=True)
            values = [[float(statistic(own))] * len(cell) for cell, own in cells]
            table = set_column(table, column, like(values, table, column))
    return table


_STATISTICS: dict[str, Callable[[np.ndarray], Any]] = {
    "min": np.min,
    "max": np.max,
    "mean": np.mean,
    "std": np.std,
    **{f"q{q:02d}": functools.partial(np.quantile, q=q / 100) for q in (1, 10, 50, 90, 99)},
}


def like(values: list[Any], table: pa.Table, column: str) -> pa.Array:
    """Lists of numbers as an array of the type of a column; rounded where that holds integers."""
    kind = table.schema.field(column).type
    number = kind.value_type
    if pa.types.is_integer(number):
        values = [[round(x) for x in cell] for cell in values]
    return pa.array(values, kind)


def _files(root: Path, kind: str) -> Iterator[Path]:
    yield from sorted((root / kind).glob("chunk-*/file-*.parquet"))


def _numbers(path: Path) -> tuple[int, int]:
    """Chunk index and file index."""
    return int(path.parent.name.removeprefix("chunk-")), int(path.stem.removeprefix("file-"))


def _plus(table: pa.Table, key: str, more: int | np.ndarray) -> pa.Table:
    """Table with a column increased by ``more``, one number or one for each row."""
    plus = pa.array(more) if isinstance(more, np.ndarray) else more
    return set_column(table, key, pc.add(table[key], plus))  # pyright: ignore[reportAttributeAccessIssue]


def _placed(table: pa.Table, prefix: str, places: Sequence[tuple[int, int]]) -> pa.Table:
    for k, kind in enumerate(("chunk", "file")):
        table = set_column(table, f"{prefix}/{kind}_index", pa.array([place[k] for place in places], pa.int64()))
    return table


def set_column(table: pa.Table, key: str, column: Any) -> pa.Table:
    """Table with another column in the place of ``key``."""
    at = table.column_names.index(key)
    return table.set_column(at, table.schema.field(at), column)
