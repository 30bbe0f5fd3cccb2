"""Merge LeRobot datasets by concatenating their Parquet tables. Video files stay as they are, under other numbers.

LeRobot 0.6.1's ``aggregate_datasets`` took 90 CPU-s for 24 demonstrations (one run, under a profiler): it reads the statistics
of each episode as 138 typed columns, several times. The result here is that of its ``concatenate_videos=False``, except for how
rows are divided into files; a test compares both. Videos that are not joined share their bytes with the store, and reading a
row at random takes less time than from a joined one (docs/decisions.md).
"""

import functools
import os
import shutil
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


def has_videos(root: Path) -> bool:
    """Whether a feature of the dataset is a video or a picture."""
    return any(f["dtype"] in ("video", "image") for f in read_info(root)["features"].values())


def join(roots: Sequence[Path], destination: Path, features: dict[str, Any]) -> None:
    """Write the dataset that holds the episodes of ``roots``, in their order, without ``meta/stats.json``. ``destination``:
    does not exist, or is empty. ``features``: of all ``roots``, as in ``info.json``."""
    infos = [read_info(root) for root in roots]
    tasks = _Tasks(roots)
    rows = np.cumsum([0, *(info["total_frames"] for info in infos)])
    episodes = np.cumsum([0, *(info["total_episodes"] for info in infos)])
    parts = [_Part(root, int(rows[k]), int(episodes[k])) for k, root in enumerate(roots)]
    videos = [f"videos/{key}" for key, f in features.items() if f["dtype"] == "video"]
    for kind in (_DATA, _EPISODES, *videos):
        files = _Files(infos[0], one_each=kind in videos)
        for part in parts:
            part.places[kind] = {path: files.place_of(path.stat().st_size) for path in _files(part.root, kind)}
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # pyarrow works outside of Python's lock
        _write_rows(destination, parts, tasks, pool)
        _write_episodes(destination, parts, features, tasks, pool)
        for kind in videos:
            sources = [(place, path) for part in parts for path, place in part.places[kind].items()]
            list(
                pool.map(
                    lambda source, kind=kind: shutil.copyfile(source[1], _path(destination, kind, source[0])), sources
                )
            )
    tasks.write(destination)
    totals = {"total_episodes": int(episodes[-1]), "total_frames": int(rows[-1]), "total_tasks": len(tasks.names)}
    splits = {"train": f"0:{episodes[-1]}"}
    write_info(destination, infos[0] | totals | {"splits": splits, "features": features})


@dataclass(eq=False)
class _Part:
    """One input dataset of the merge: its first row and episode in the result, and the chunk and file for each of its files of
    a kind (folder)."""

    root: Path
    first_row: int
    first_episode: int
    places: dict[str, dict[Path, _Place]] = field(default_factory=dict)

    def rows_tables(self, path: Path, tasks: "_Tasks") -> Iterator[pa.Table]:
        """Renumbered rows of a file, one table for each of its row groups: an episode is read without those beside it."""
        with pq.ParquetFile(path) as file:
            for k in range(file.num_row_groups):
                table = _plus(file.read_row_group(k), "index", self.first_row)
                table = _plus(table, "episode_index", self.first_episode)
                yield set_column(table, "task_index", tasks.renumbered(self.root, table["task_index"]))


class _Files:
    """Numbers of the files of one kind, each of about the size that ``info`` allows; ``one_each``: one for each table."""

    def __init__(self, info: dict[str, Any], one_each: bool) -> None:
        self._limit, self._per_chunk = 0 if one_each else info["data_files_size_in_mb"] * _MB, info["chunks_size"]
        self._number, self._size = 0, 0

    def place_of(self, size: int) -> _Place:
        """Which chunk and file the next table, of ``size`` bytes, is to be written into."""
        if self._size > 0 and self._size + size > self._limit:
            self._number, self._size = self._number + 1, 0
        self._size += size
        return divmod(self._number, self._per_chunk)


def _write_rows(destination: Path, parts: Sequence[_Part], tasks: "_Tasks", pool: ThreadPoolExecutor) -> None:
    """Write ``data``, each file by a thread of its own."""
    by_file: dict[_Place, list[tuple[Path, _Part]]] = {}
    for part in parts:
        for path, place in part.places[_DATA].items():
            by_file.setdefault(place, []).append((path, part))

    def one(place: _Place) -> None:
        writer: pq.ParquetWriter | None = None
        for source, part in by_file[place]:
            for table in part.rows_tables(source, tasks):
                writer = writer or pq.ParquetWriter(_path(destination, _DATA, place), table.schema, **_FORMAT)
                writer.write_table(table.select(writer.schema.names))
        if writer is not None:
            writer.close()

    list(pool.map(one, by_file))


def _write_episodes(
    destination: Path, parts: Sequence[_Part], features: dict[str, Any], tasks: "_Tasks", pool: ThreadPoolExecutor
) -> None:
    """Write ``meta/episodes``. Tables are joined first and changed together: one by one they took most of the time of a merge."""
    sources = [(place, path, part) for part in parts for path, place in part.places[_EPISODES].items()]
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
        for kind in parts[0].places.keys() - {_EPISODES}:
            was = zip(*(table[f"{kind}/{level}_index"].to_pylist() for level in ("chunk", "file")), strict=True)
            into = {
                part: {_numbers(path): to for path, to in part.places[kind].items()} for part in dict.fromkeys(part_of)
            }
            table = _placed(table, kind, [into[part][numbers] for part, numbers in zip(part_of, was, strict=True)])
        table = _placed(table, _EPISODES, [place] * len(table))
        with pq.ParquetWriter(_path(destination, _EPISODES, place), table.schema, **_FORMAT) as writer:
            writer.write_table(table)


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
    yield from sorted((root / kind).glob("chunk-*/file-*.*"))


def _numbers(path: Path) -> tuple[int, int]:
    """Chunk index and file index."""
    return int(path.parent.name.removeprefix("chunk-")), int(path.stem.removeprefix("file-"))


def _plus(table: pa.Table, key: str, more: int | np.ndarray) -> pa.Table:
    """Table with a column increased by ``more``, one number or one for each row."""
    plus = pa.array(more) if isinstance(more, np.ndarray) else more
    return set_column(table, key, pc.add(table[key], plus))  # pyright: ignore[reportAttributeAccessIssue]


def _placed(table: pa.Table, prefix: str, places: Sequence[_Place]) -> pa.Table:
    for k, kind in enumerate(("chunk", "file")):
        table = set_column(table, f"{prefix}/{kind}_index", pa.array([place[k] for place in places], pa.int64()))
    return table


def set_column(table: pa.Table, key: str, column: Any) -> pa.Table:
    """Table with another column in the place of ``key``."""
    at = table.column_names.index(key)
    return table.set_column(at, table.schema.field(at), column)
