"""Merge LeRobot datasets by concatenating their Parquet tables. Video files stay as they are, under other numbers.

LeRobot 0.6.1's ``aggregate_datasets`` took 90 CPU-s for 24 demonstrations (one run, under a profiler): it reads the statistics
of each episode as 138 typed columns, several times. The result here is that of its ``concatenate_videos=False``, except for how
rows are divided into files; a test compares both. Videos that are not joined share their bytes with the store, and reading a
row at random takes less time than from a joined one (docs/decisions.md).
"""

import functools
import io
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
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
JOINED_TOGETHER = 64
"""Largest number of datasets whose rows are written into one file. Files are written in parallel, one task for each."""
_Place = tuple[int, int]  # chunk and file
Run = Callable[[Callable[[Any], Any], Sequence[Any]], list[Any]]
"""Function that returns ``[fn(item) for item in items]``, such as ``Engine.map``; function and items can be pickled."""


def in_threads(fn: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """``[fn(item) for item in items]`` by the threads of this process: pyarrow works outside of Python's lock."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(fn, items))


def has_videos(root: Path) -> bool:
    """Whether a feature of the dataset is a video or a picture."""
    return any(f["dtype"] in ("video", "image") for f in read_info(root)["features"].values())


def join(roots: Sequence[Path], destination: Path, features: dict[str, Any], run: Run = in_threads) -> None:
    """Write the dataset that holds the episodes of ``roots``, in their order, without ``meta/stats.json``. ``destination``:
    does not exist, or is empty. ``features``: of all ``roots``, as in ``info.json``. ``run`` writes the files."""
    infos = [read_info(root) for root in roots]
    tasks = _Tasks(roots)
    rows = np.cumsum([0, *(info["total_frames"] for info in infos)])
    episodes = np.cumsum([0, *(info["total_episodes"] for info in infos)])
    parts = [_Part(int(rows[k]), int(episodes[k]), tasks.numbers_of[k]) for k in range(len(roots))]
    videos = [f"videos/{key}" for key, f in features.items() if f["dtype"] == "video"]
    placed = {
        kind: _Places(infos[0], most=1 if kind in videos else JOINED_TOGETHER) for kind in (_DATA, _EPISODES, *videos)
    }
    for part, root in zip(parts, roots, strict=True):
        for kind, places in placed.items():
            part.places[kind] = {_numbers(path): places.put(path, part) for path in _files(root, kind)}
    numbers = {name: k for k, name in enumerate(tasks.names)}
    meta = [_EpisodesFile(destination, *file, frozenset(features), numbers) for file in placed[_EPISODES].files.items()]
    jobs: list[_EpisodesFile | _RowsFile | _Video] = [*meta]
    jobs += [_RowsFile(_path(destination, _DATA, place), own) for place, own in placed[_DATA].files.items()]
    for kind in videos:
        jobs += [_Video(_path(destination, kind, place), path) for place, [(path, _)] in placed[kind].files.items()]
    written = run(_written, jobs)[: len(meta)]
    common = frozenset.intersection(*map(frozenset, written))  # some lack statistics of an added feature
    run(_written, [replace(meta[k], only=common) for k, names in enumerate(written) if common != frozenset(names)])
    tasks.write(destination)
    totals = {"total_episodes": int(episodes[-1]), "total_frames": int(rows[-1]), "total_tasks": len(tasks.names)}
    splits = {"train": f"0:{episodes[-1]}"}
    write_info(destination, infos[0] | totals | {"splits": splits, "features": features})


@dataclass(eq=False)
class _Part:
    """One input dataset of the merge: its first row and episode in the result, and its tasks' numbers there."""

    first_row: int
    first_episode: int
    task_numbers: np.ndarray
    """Number of a task in the input → its number in the result."""
    places: dict[str, dict[_Place, _Place]] = field(default_factory=dict)
    """Kind of files (folder) → chunk and file of each → those in the result."""


_Source = tuple[Path, _Part]


class _Places:
    """Files of one kind in the result and their sources: at most ``most`` for each, and about the size that ``info`` allows."""

    def __init__(self, info: dict[str, Any], most: int) -> None:
        self._most = most
        self._limit, self._per_chunk = info["data_files_size_in_mb"] * _MB, info["chunks_size"]
        self._size = 0
        self.files: dict[_Place, list[_Source]] = {}

    def put(self, path: Path, part: _Part) -> _Place:
        """Append the file ``path`` of ``part`` to the last file, or to a new one; returns the chunk and file of it."""
        size, last = path.stat().st_size, list(self.files.values())[-1:]
        if not last or self._size + size > self._limit or len(last[0]) == self._most:
            self.files[divmod(len(self.files), self._per_chunk)] = []
            self._size = 0
        self._size += size
        place = next(reversed(self.files))
        self.files[place].append((path, part))
        return place


@dataclass(frozen=True)
class _RowsFile:
    """A file of rows to be written."""

    path: Path
    sources: list[_Source]

    def write(self) -> None:
        """Write one row group for each of the sources': an episode is read without those beside it."""
        writer: pq.ParquetWriter | None = None
        for source, part in self.sources:
            with pq.ParquetFile(source) as file:
                for k in range(file.num_row_groups):
                    table = _plus(file.read_row_group(k), "index", part.first_row)
                    table = _plus(table, "episode_index", part.first_episode)
                    tasks = pa.array(part.task_numbers[table["task_index"].to_numpy()])
                    table = set_column(table, "task_index", tasks)
                    writer = writer or pq.ParquetWriter(self.path, table.schema, **_FORMAT)
                    writer.write_table(table.select(writer.schema.names))
        if writer is not None:
            writer.close()


@dataclass(frozen=True)
class _EpisodesFile:
    """A file of ``meta/episodes`` to be written."""

    destination: Path
    place: _Place
    sources: list[_Source]
    features: frozenset[str]
    """Features of the result."""
    tasks: dict[str, int]
    """Instruction → its number in the result."""
    only: frozenset[str] | None = None
    """Columns to be written, of those that all sources have; None: all."""

    def write(self) -> list[str]:
        """Returns the names of its columns. Tables are joined first and changed together: one by one they took most of the time
        of a merge."""
        read = [_read(path) for path, _ in self.sources]
        known = set.intersection(*(set(table.column_names) for table in read))
        known &= known if self.only is None else self.only
        # LeRobot's ``modify_features`` leaves the statistics of removed features in the table.
        gone = {
            name
            for name in known
            if name.startswith("stats/") and name.removeprefix("stats/").rpartition("/")[0] not in self.features
        }
        names = [name for name in read[0].column_names if name in known - gone]
        table = pa.concat_tables(table.select(names) for table in read)
        part_of = [part for table, (_, part) in zip(read, self.sources, strict=True) for _ in range(len(table))]
        first_rows = np.array([part.first_row for part in part_of])
        first_episodes = np.array([part.first_episode for part in part_of])
        table = _plus(table, "episode_index", first_episodes)
        for key in ("dataset_from_index", "dataset_to_index"):
            table = _plus(table, key, first_rows)
        table = _with_own_statistics(table, first_rows, first_episodes, self.tasks)
        for kind in part_of[0].places.keys() - {_EPISODES}:
            was = zip(*(table[f"{kind}/{level}_index"].to_pylist() for level in ("chunk", "file")), strict=True)
            table = _placed(table, kind, [part.places[kind][own] for part, own in zip(part_of, was, strict=True)])
        table = _placed(table, _EPISODES, [self.place] * len(table))
        with pq.ParquetWriter(_path(self.destination, _EPISODES, self.place), table.schema, **_FORMAT) as writer:
            writer.write_table(table)
        return names


@dataclass(frozen=True)
class _Video:
    """A file of pictures to be copied."""

    path: Path
    source: Path

    def write(self) -> None:
        shutil.copyfile(self.source, self.path)


def _written(file: _RowsFile | _EpisodesFile | _Video) -> list[str] | None:
    return file.write()


def _read(path: Path) -> pa.Table:
    """Table of a Parquet file. For small files of many columns this takes half the time of ``pq.read_table``."""
    with pq.ParquetFile(path) as file:
        return file.read()


def _path(root: Path, kind: str, place: _Place) -> Path:
    """Path of a file of ``kind`` in the dataset at ``root``; makes its folder."""
    suffix = "mp4" if kind.startswith("videos/") else "parquet"
    path = root / kind / f"chunk-{place[0]:03d}" / f"file-{place[1]:03d}.{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


class _Tasks:
    """Instructions of all datasets, each once, numbered as they first come."""

    def __init__(self, roots: Sequence[Path]) -> None:
        import pandas as pd

        contents = [(root / "meta/tasks.parquet").read_bytes() for root in roots]  # of demonstrations, all the same
        frames = {content: pd.read_parquet(io.BytesIO(content)) for content in dict.fromkeys(contents)}
        self.names: list[str] = list(dict.fromkeys(name for frame in frames.values() for name in frame.index))
        number = {name: k for k, name in enumerate(self.names)}
        new: dict[bytes, np.ndarray] = {}
        for content, frame in frames.items():
            new[content] = np.zeros(int(frame["task_index"].max()) + 1, dtype=np.int64)
            new[content][frame["task_index"].to_numpy()] = [number[name] for name in frame.index]
        self.numbers_of = [new[content] for content in contents]
        """For each dataset: number of its task → number in the result."""

    def write(self, root: Path) -> None:
        import pandas as pd

        frame = pd.DataFrame({"task_index": range(len(self.names))}, index=pd.Index(self.names, name="task"))
        frame.to_parquet(root / "meta/tasks.parquet")


def _with_own_statistics(
    table: pa.Table, first_rows: np.ndarray, first_episodes: np.ndarray, tasks: dict[str, int]
) -> pa.Table:
    """Table of episodes with new statistics of the row, episode and task indices, which differ after the merge."""
    for key, more in (("index", first_rows), ("episode_index", first_episodes)):
        for name in set(_STATISTICS) - {"std"}:
            column = f"stats/{key}/{name}"
            if column in table.column_names:
                cells = zip(table[column].to_pylist(), more.tolist(), strict=True)
                moved = [[x + plus for x in cell] for cell, plus in cells]
                table = set_column(table, column, like(moved, table, column))
    ids = [np.array([tasks[name] for name in names], dtype=float) for names in table["tasks"].to_pylist()]
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
    yield from sorted((root / kind).glob("chunk-*/file-*.*"))


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
