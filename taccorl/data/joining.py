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
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from taccorl.data.dataset import Dataset, read_info, write_info
from taccorl.errors import DatasetError

_MB = 1024 * 1024
_FORMAT: dict[str, Any] = {"compression": "snappy", "use_dictionary": True}
_DATA, _EPISODES = "data", "meta/episodes"
JOINED_TOGETHER = 64  # Largest number of datasets whose rows are written into one file; files are written in parallel
_Place = tuple[int, int]  # chunk and file
Run = Callable[[Callable[[Any], Any], Sequence[Any]], list[Any]]
"""Function that returns ``[fn(item) for item in items]``, such as ``Engine.map``; function and items can be pickled."""


def in_threads(fn: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """``[fn(item) for item in items]`` by the threads of this process: pyarrow works outside of Python's lock."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(fn, items))


def require_videos(root: Path) -> None:
    """Raise a DatasetError if pictures of the dataset are only in the frame cache of training."""
    pictures = any(
        f["dtype"] in ("video", "image") for f in read_info(root)["features"].values()
    )
    if pictures and (unstored := Dataset(root).unstored):
        text = f"{root}: has no videos of {', '.join(unstored)}, only frames in the cache of training: merge it with "
        raise DatasetError(
            f"{text}--pictures=cache, or make it with taccorl collect --pictures=video"
        )


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


def join(
    roots: Sequence[Path],
    destination: Path,
    features: dict[str, Any],
    run: Run = in_threads,
) -> None:
    """Write the dataset that holds the episodes of ``roots``, in their order, without ``meta/stats.json``. ``destination``:
    does not exist, or is empty. ``features``: of all ``roots``, as in ``info.json``. ``run`` writes the files."""
    infos = [read_info(root) for root in roots]
    names, numbers_of = _tasks(roots)
    rows = np.cumsum([0, *(info["total_frames"] for info in infos)])
    episodes = np.cumsum([0, *(info["total_episodes"] for info in infos)])
    parts = [
        _Part(int(rows[k]), int(episodes[k]), numbers_of[k]) for k in range(len(roots))
    ]
    videos = [f"videos/{key}" for key, f in features.items() if f["dtype"] == "video"]
    most = {_DATA: JOINED_TOGETHER, _EPISODES: JOINED_TOGETHER} | dict.fromkeys(
        videos, 1
    )
    placed = {
        kind: _placed_files(kind, most[kind], roots, parts, infos[0]) for kind in most
    }
    numbers = {name: k for k, name in enumerate(names)}
    write = functools.partial(
        _write_episodes, destination, frozenset(features), numbers
    )
    meta = [functools.partial(write, *file) for file in placed[_EPISODES].items()]
    jobs = [
        *meta,
        *(
            functools.partial(_write_rows, _path(destination, _DATA, p), own)
            for p, own in placed[_DATA].items()
        ),
    ]
    for kind in videos:
        for place, [(source, _)] in placed[kind].items():
            jobs.append(
                functools.partial(
                    shutil.copyfile, source, _path(destination, kind, place)
                )
            )
    written = run(_called, jobs)[: len(meta)]
    common = frozenset.intersection(
        *map(frozenset, written)
    )  # some lack statistics of an added feature
    run(
        _called,
        [
            functools.partial(job, only=common)
            for job, own in zip(meta, written, strict=True)
            if common != set(own)
        ],
    )
    import pandas as pd

    frame = pd.DataFrame(
        {"task_index": range(len(names))}, index=pd.Index(names, name="task")
    )
    frame.to_parquet(destination / "meta/tasks.parquet")
    totals = {
        "total_episodes": int(episodes[-1]),
        "total_frames": int(rows[-1]),
        "total_tasks": len(names),
    }
    splits = {"train": f"0:{episodes[-1]}"}
    write_info(
        destination, infos[0] | totals | {"splits": splits, "features": features}
    )


def _called(job: Callable[[], Any]) -> Any:
    return job()


def _tasks(roots: Sequence[Path]) -> tuple[list[str], list[np.ndarray]]:
    """Instructions of all datasets, each once, numbered as they first come; and for each dataset: number of its task → number
    in the result."""
    import pandas as pd

    contents = [
        (root / "meta/tasks.parquet").read_bytes() for root in roots
    ]  # of demonstrations, all the same
    frames = {
        content: pd.read_parquet(io.BytesIO(content))
        for content in dict.fromkeys(contents)
    }
    names: list[str] = list(
        dict.fromkeys(name for frame in frames.values() for name in frame.index)
    )
    number = {name: k for k, name in enumerate(names)}
    new: dict[bytes, np.ndarray] = {}
    for content, frame in frames.items():
        new[content] = np.zeros(int(frame["task_index"].max()) + 1, dtype=np.int64)
        new[content][frame["task_index"].to_numpy()] = [
            number[name] for name in frame.index
        ]
    return names, [new[content] for content in contents]


def _placed_files(
    kind: str,
    most: int,
    roots: Sequence[Path],
    parts: Sequence[_Part],
    info: dict[str, Any],
) -> dict[_Place, list[_Source]]:
    """Files of one kind in the result and their sources: at most ``most`` for each, about the size that ``info`` allows."""
    files: dict[_Place, list[_Source]] = {}
    place, size = (0, 0), 0
    for part, root in zip(parts, roots, strict=True):
        part.places[kind] = {}
        for path in sorted((root / kind).glob("chunk-*/file-*.*")):
            own = (
                int(path.parent.name.removeprefix("chunk-")),
                int(path.stem.removeprefix("file-")),
            )
            more = path.stat().st_size
            if (
                not files
                or size + more > info["data_files_size_in_mb"] * _MB
                or len(files[place]) == most
            ):
                place, size = divmod(len(files), info["chunks_size"]), 0
                files[place] = []
            size += more
            files[place].append((path, part))
            part.places[kind][own] = place
    return files


def _path(root: Path, kind: str, place: _Place) -> Path:
    """Path of a file of ``kind`` in the dataset at ``root``; makes its folder."""
    suffix = "mp4" if kind.startswith("videos/") else "parquet"
    path = root / kind / f"chunk-{place[0]:03d}" / f"file-{place[1]:03d}.{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write_rows(path: Path, sources: list[_Source]) -> None:
    """Write one row group for each of the sources': an episode is read without those beside it."""
    writer: pq.ParquetWriter | None = None
    for source, part in sources:
        with pq.ParquetFile(source) as file:
            for k in range(file.num_row_groups):
                table = _plus(file.read_row_group(k), "index", part.first_row)
                table = _plus(table, "episode_index", part.first_episode)
                table = set_column(
                    table,
                    "task_index",
                    pa.array(part.task_numbers[table["task_index"].to_numpy()]),
                )
                writer = writer or pq.ParquetWriter(path, table.schema, **_FORMAT)
                writer.write_table(table.select(writer.schema.names))
    if writer is not None:
        writer.close()


def _write_episodes(
    destination: Path,
    features: frozenset[str],
    tasks: dict[str, int],
    place: _Place,
    sources: list[_Source],
    only: frozenset[str] | None = None,
) -> list[str]:
    """Write a file of ``meta/episodes`` for a result with these features and numbers of tasks; returns the names of its columns:
    those that all sources have, and of them ``only``. Tables are joined first and changed together: one by one they took most of
    the time of a merge."""
    read = []
    for path, _ in sources:
        with (
            pq.ParquetFile(path) as file
        ):  # for small files of many columns in half the time of ``pq.read_table``
            read.append(file.read())
    known = set.intersection(*(set(table.column_names) for table in read))
    known &= known if only is None else only
    # LeRobot's ``modify_features`` leaves the statistics of removed features in the table.
    stated = {name for name in known if name.startswith("stats/")}
    gone = {
        name
        for name in stated
        if name.removeprefix("stats/").rpartition("/")[0] not in features
    }
    names = [name for name in read[0].column_names if name in known - gone]
    table = pa.concat_tables(table.select(names) for table in read)
    part_of = [
        part
        for table, (_, part) in zip(read, sources, strict=True)
        for _ in range(len(table))
    ]
    first_rows = np.array([part.first_row for part in part_of])
    first_episodes = np.array([part.first_episode for part in part_of])
    table = _plus(table, "episode_index", first_episodes)
    for key in ("dataset_from_index", "dataset_to_index"):
        table = _plus(table, key, first_rows)
    table = _with_own_statistics(table, first_rows, first_episodes, tasks)
    for kind in part_of[0].places.keys() - {_EPISODES}:
        was = zip(
            *(
                table[f"{kind}/{level}_index"].to_pylist()
                for level in ("chunk", "file")
            ),
            strict=True,
        )
        table = _placed(
            table,
            kind,
            [part.places[kind][own] for part, own in zip(part_of, was, strict=True)],
        )
    table = _placed(table, _EPISODES, [place] * len(table))
    with pq.ParquetWriter(
        _path(destination, _EPISODES, place), table.schema, **_FORMAT
    ) as writer:
        writer.write_table(table)
    return names


_STATISTICS: dict[str, Callable[[np.ndarray], Any]] = {
    **dict(
        zip(
            ("min", "max", "mean", "std"),
            (np.min, np.max, np.mean, np.std),
            strict=True,
        )
    ),
    **{
        f"q{q:02d}": functools.partial(np.quantile, q=q / 100)
        for q in (1, 10, 50, 90, 99)
    },
}


def _with_own_statistics(
    table: pa.Table,
    first_rows: np.ndarray,
    first_episodes: np.ndarray,
    tasks: dict[str, int],
) -> pa.Table:
    """Table of episodes with new statistics of the row, episode and task indices, which differ after the merge."""
    ids = [
        np.array([tasks[name] for name in names], dtype=float)
        for names in table["tasks"].to_pylist()
    ]
    for name, statistic in _STATISTICS.items():
        new: dict[str, list[Any]] = {
            "task_index": [float(statistic(own)) for own in ids]
        }
        more = (
            {"index": first_rows, "episode_index": first_episodes}
            if name != "std"
            else {}
        )
        for key, values in (more | new).items():
            if (column := f"stats/{key}/{name}") in table.column_names:
                cells = zip(
                    table[column].to_pylist(), np.asarray(values).tolist(), strict=True
                )
                moved = [
                    [x + y if key in more else y for x in cell] for cell, y in cells
                ]
                table = set_column(table, column, like(moved, table, column))
    return table


def like(values: list[Any], table: pa.Table, column: str) -> pa.Array:
    """Lists of numbers as an array of the type of a column; rounded where that holds integers."""
    kind = table.schema.field(column).type
    if pa.types.is_integer(kind.value_type):
        values = [[round(x) for x in cell] for cell in values]
    return pa.array(values, kind)


def _plus(table: pa.Table, key: str, more: int | np.ndarray) -> pa.Table:
    """Table with a column increased by ``more``, one number or one for each row."""
    plus = pa.array(more) if isinstance(more, np.ndarray) else more
    return set_column(table, key, pc.add(table[key], plus))  # pyright: ignore[reportAttributeAccessIssue]


def _placed(table: pa.Table, prefix: str, places: Sequence[_Place]) -> pa.Table:
    for k, kind in enumerate(("chunk", "file")):
        table = set_column(
            table,
            f"{prefix}/{kind}_index",
            pa.array([place[k] for place in places], pa.int64()),
        )
    return table


def set_column(table: pa.Table, key: str, column: Any) -> pa.Table:
    """Table with another column in the place of ``key``."""
    at = table.column_names.index(key)
    return table.set_column(at, table.schema.field(at), column)
