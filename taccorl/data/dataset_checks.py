"""Faults of a LeRobot dataset's bookkeeping, which LeRobot trips over or trains on without a word, and a copy without them.

LeRobot finds a row's pictures by its ``timestamp``, its neighbours by ``index`` and the episode's ``dataset_from_index``, and
normalises by ``meta/stats.json``. Each is compared with what it must be:

    timestamp = frame_index / fps       index = 0, 1, 2 … over all files       from, to = the episode's first row, last row + 1
    statistics = those of the rows (LeRobot's quantiles are averages over episodes: only their order is checked)
"""

import itertools
import json
import math
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from taccorl.data import lerobot_format
from taccorl.data.cutting import MOST_INSTRUCTION
from taccorl.data.dataset import (
    BOOKKEEPING,
    PARQUET,
    Dataset,
    data_files,
    feature_rows,
    numbers_of,
    write_info,
)
from taccorl.data.exact_statistics import known_rows, statistics_of_rows
from taccorl.data.file_kinds import plainly
from taccorl.data.finding import (
    Finding,
    Severity,
    finding,
    listed,
    recompute_statistics,
)
from taccorl.data.joining import like, set_column
from taccorl.data.lerobot_format import STATED
from taccorl.data.video_files import TOLERANCE_S
from taccorl.errors import DatasetError

CHECKED = (
    "min",
    "max",
    "mean",
    "std",
)  # Statistics that do not depend on how LeRobot adds them up
STATISTICS_TOLERANCE = 1e-3  # Largest difference from the rows', as a share of the element's range: float32 sums


class Rows(NamedTuple):
    """LeRobot's own columns of all rows, in the order of the files."""

    timestamp: np.ndarray
    frame_index: np.ndarray
    episode_index: np.ndarray
    index: np.ndarray
    task_index: np.ndarray


def read_rows(dataset: Dataset) -> Rows:
    """Raises DatasetError: a file is not readable, or lacks a column, or the files have more or fewer rows than the episodes."""
    files, expected = (
        data_files(dataset.root),
        sum(dataset.num_rows(i) for i in range(dataset.num_episodes)),
    )
    present, tables = 0, []
    for path in files:
        with plainly(path, PARQUET):
            present += pq.read_metadata(path).num_rows
    if (
        present != expected
    ):  # before they are read: a small file may hold any number of equal rows
        text = f"{dataset.root}: {present} rows in data/, but the episodes have {expected}: copy the dataset again"
        raise DatasetError(text)
    for path in files:
        with plainly(path, PARQUET):
            if absent := [
                key for key in BOOKKEEPING if key not in pq.read_schema(path).names
            ]:
                raise DatasetError(
                    f"{path}: lacks the column {absent[0]}, which every LeRobot dataset has"
                )
            table = pq.read_table(path, columns=list(BOOKKEEPING))
        tables.append(
            {key: numbers_of(table[key], f"{path}, {key}") for key in BOOKKEEPING}
        )
    return Rows(
        **{
            k: np.concatenate([t[k] for t in tables]) if tables else np.empty(0)
            for k in BOOKKEEPING
        }
    )


def _repair(dataset: Dataset) -> str:
    return f"`taccorl check {shlex.quote(str(dataset.root))} --repair=COPY` writes a copy with the right ones"


def check_bookkeeping(dataset: Dataset) -> Iterator[Finding]:
    """Yield findings on stamps, indices, totals and tasks of a dataset."""
    rows, info, repair = read_rows(dataset), dataset.info, _repair(dataset)
    lengths = np.array(
        [dataset.num_rows(i) for i in range(dataset.num_episodes)], dtype=np.int64
    )
    for key, expected in (
        ("total_frames", int(lengths.sum())),
        ("total_episodes", len(lengths)),
    ):
        if info.get(key) != expected:
            text = f"meta/info.json: {key} is {info.get(key)}, meta/episodes has {expected}; {repair}"
            yield finding("totals", "rows", text)
    first = np.concatenate([[0], np.cumsum(lengths)])
    of_episode = np.repeat(np.arange(len(lengths)), lengths)
    number = np.arange(len(of_episode)) - first[of_episode]
    due_s = rows.frame_index / dataset.spec.fps
    off_s = np.abs(rows.timestamp - due_s)
    late = ~(off_s <= TOLERANCE_S + np.spacing(due_s.astype(np.float32)))
    for name, wrong in (
        (
            "episode_rows",
            (rows.episode_index != of_episode) | (rows.frame_index != number),
        ),
        ("row_index", rows.index != np.arange(len(rows.index))),
        ("row_time", late),
    ):
        if not wrong.any():
            continue
        at, such = int(np.argmax(wrong)), f"{int(wrong.sum())} such rows"
        if name == "episode_rows":
            text = f"row {at} is frame {rows.frame_index[at]} of episode {rows.episode_index[at]}, in the order of "
            text += f"episodes it is frame {number[at]} of episode {of_episode[at]} ({such}): rows are missing, twice "
            text += "or exchanged; copy the dataset again, or make it again from its recordings"
        elif name == "row_index":
            text = f"`index` of row {at} is {rows.index[at]} ({such}): LeRobot counts over all episodes; {repair}"
        else:
            odd = [str(e) for e in sorted(set(rows.episode_index[wrong].tolist()))]
            text = f"`timestamp` of row {at} (frame {rows.frame_index[at]} of episode {rows.episode_index[at]}) is "
            text += f"{rows.timestamp[at]:.4f} s, but frame_index / fps is {due_s[at]:.4f} s; {such} in episodes "
            text += f"{listed(odd)}: LeRobot shows pictures of other rows, or raises FrameTimestampError; {repair}"
        yield finding(name, "rows", text)
    for i in range(len(lengths)):
        stated = tuple(
            dataset.entry(i).get(key)
            for key in ("dataset_from_index", "dataset_to_index")
        )
        if stated != (first[i], first[i + 1]):
            text = f"episode {i}: {stated[0]} to {stated[1]} in meta/episodes, in data/ {first[i]} to {first[i + 1]}; "
            yield finding("dataset_index", "rows", f"{text}{repair}")
            break
    yield from _check_tasks(dataset, rows, of_episode)


def _check_tasks(
    dataset: Dataset, rows: Rows, of_episode: np.ndarray
) -> Iterator[Finding]:
    known, total = dataset.task_names, dataset.info.get("total_tasks")
    unknown, text = sorted(set(rows.task_index.tolist()) - set(known)), ""
    if long := next(
        (text for text in known.values() if len(text) > MOST_INSTRUCTION), None
    ):
        text = f"a task of {len(long):,} characters, {long[:40]!r} …; at most {MOST_INSTRUCTION:,} are read"
    elif unknown:
        text = f"meta/tasks.parquet has no task {unknown[0]}, to which rows refer"
    elif total is not None and total != len(known):
        told = f"meta/info.json: total_tasks is {total}, meta/tasks.parquet has {len(known)}"
        yield finding("totals", "task", told, severity="warning")
    for i in range(dataset.num_episodes) if not text else ():
        stated = dataset.entry(i).get("tasks")
        found = {known[t] for t in set(rows.task_index[of_episode == i].tolist())}
        if stated is not None and set(stated) != found:
            text = f"episode {i}: meta/episodes states {sorted(stated)}, its rows have {sorted(found)}"
            break
    if text:
        yield finding("tasks", "task", text)


def check_statistics(dataset: Dataset) -> list[Finding]:
    """Compare ``meta/stats.json`` with the rows."""
    repaired, path = _repair(dataset), dataset.root / "meta" / "stats.json"
    if not path.is_file():
        return [
            finding(
                "statistics",
                "stats",
                f"meta/stats.json is absent: nothing can be normalised; {repaired}",
            )
        ]
    with plainly(path, "JSON"):
        stats = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(stats, dict):
        return [
            finding(
                "statistics", "stats", f"meta/stats.json holds no object; {repaired}"
            )
        ]
    findings = []
    for key, feature in dataset.info["features"].items():
        numbers, own = feature["dtype"] in STATED, key in BOOKKEEPING
        due = key not in (BOOKKEEPING if numbers else dataset.unstored) and (
            numbers or feature["dtype"] == "video"
        )
        text = (
            _wrong_statistics(dataset, key, feature, stats[key])
            if key in stats
            else "not in meta/stats.json" * due
        )
        if text:
            severity: Severity = (
                "note" if own else "error"
            )  # LeRobot's own merge leaves its columns' stale
            computed = f"`{recompute_statistics(dataset.root.resolve())}` computes them, or {repaired}"
            way_out = (
                computed if numbers and not own else repaired
            )  # of the rest LeRobot keeps what is there
            findings.append(
                finding(
                    "statistics", key, f"{key}: {text}; {way_out}", severity=severity
                )
            )
    return findings


def _wrong_statistics(
    dataset: Dataset, key: str, feature: dict[str, Any], stats: Any
) -> str:
    """What is wrong with the statistics of one feature; empty if nothing is."""
    try:
        found = {name: np.asarray(stats[name], dtype=float).ravel() for name in CHECKED}
        names = [
            name for name in sorted(stats) if name[:1] == "q" and name[1:].isdecimal()
        ]
        quantiles = [np.asarray(stats[name], dtype=float).ravel() for name in names]
    except (KeyError, TypeError, ValueError) as error:
        return f"its statistics are not whole ({type(error).__name__}: {error})"
    pictures, shape = feature["dtype"] in ("video", "image"), tuple(feature["shape"])
    size = (
        3 if pictures else shape[-1] if len(shape) > 1 else math.prod(shape)
    )  # of more axes LeRobot keeps the last
    numbers = not pictures and feature["dtype"] in STATED
    known = (
        known_rows(feature_rows(dataset.root, key)).reshape(-1, size)
        if numbers
        else None
    )
    if known is not None and not len(known):
        return ""  # NaN in every row: nobody knows it
    for name, values in found.items():
        if len(values) != size and not (
            pictures and len(values) == 1
        ):  # depth has one channel
            return f"{name} has {len(values)} values for {size} elements"
        if not np.isfinite(values).all():
            if known is not None and not np.isfinite(known).all():
                return ""  # as its rows, which have a finding of their own
            return f"{name} holds {values[~np.isfinite(values)][0]}"
    if (found["std"] < 0).any():
        return f"std is negative ({found['std'].min():g})"
    low, high, mean = found["min"], found["max"], found["mean"]
    tolerance = (
        STATISTICS_TOLERANCE * np.maximum(high - low, 0) + 1e-6 * np.abs(mean) + 1e-8
    )
    for a, b in (
        *itertools.pairwise([low, *quantiles, high]),
        *itertools.pairwise([low, mean, high]),
    ):
        if (
            len(a) != len(b)
            or not (a <= b + tolerance + STATISTICS_TOLERANCE * np.abs(b)).all()
        ):
            return "minimum, quantiles, mean and maximum are not in this order"
    if known is None:
        return ""
    count = np.asarray(stats.get("count", len(known))).ravel()
    if len(count) and int(count[0]) not in (
        len(known),
        sum(map(dataset.num_rows, range(dataset.num_episodes))),
    ):
        return f"count is {int(count[0])}, but there are {len(known)} rows"
    exact = {"min": known.min(0), "max": known.max(0)}
    exact |= {"mean": known.mean(0, dtype=float), "std": known.std(0, dtype=float)}
    span = np.asarray(exact["max"], dtype=float) - exact["min"]
    tolerance = STATISTICS_TOLERANCE * span + 1e-5 * np.abs(exact["mean"]) + 1e-7
    for name, values in exact.items():
        off = np.abs(found[name] - values)
        if (off > tolerance).any():
            i = int(np.argmax(off - tolerance))
            element = f" of element {i}" if size > 1 else ""
            return f"{name}{element} is {found[name][i]:.6g}, of the rows {float(values[i]):.6g}"
    return ""


def repair(dataset: Dataset, copy: Path) -> None:
    """Write a copy of a dataset with the stamps, indices, totals and statistics that its rows must have. Raises DatasetError:
    ``copy`` exists, or rows are missing or exchanged: then which are right is unknown."""
    root, features = dataset.root, dataset.info["features"]
    if copy.exists():
        raise DatasetError(f"--repair={copy} exists: give a new folder")
    if unsafe := [
        f for f in check_bookkeeping(dataset) if f.check in ("episode_rows", "tasks")
    ]:
        raise DatasetError(f"{root}: cannot be repaired: {unsafe[0].text}")
    shutil.copytree(
        root,
        copy,
        ignore=lambda folder, names: {"manifest.json", ".verified.json"} & set(names),
    )
    first = np.cumsum([0, *(dataset.num_rows(i) for i in range(dataset.num_episodes))])
    at = 0
    for path in data_files(copy):
        table = pq.read_table(path)
        table = _with(
            table, "timestamp", table["frame_index"].to_numpy() / dataset.spec.fps
        )
        table = _with(table, "index", np.arange(at, at + len(table)))
        at += len(table)
        pq.write_table(table, path)
    values = {
        k: feature_rows(copy, k) for k, f in features.items() if f["dtype"] in STATED
    }
    for path in sorted((copy / "meta" / "episodes").glob("*/*.parquet")):
        table = pq.read_table(path)
        numbers = table["episode_index"].to_numpy()
        for key, to in (
            ("dataset_from_index", first[numbers]),
            ("dataset_to_index", first[numbers + 1]),
        ):
            table = _with(table, key, to)
        for key, of_rows in values.items():
            parts = (of_rows[first[i] : first[i + 1]] for i in numbers)
            stats = [statistics_of_rows(part, features[key]["shape"]) for part in parts]
            for name in stats[0] if stats else ():
                if (column := f"stats/{key}/{name}") in table.column_names:
                    table = set_column(
                        table,
                        column,
                        like([s[name].tolist() for s in stats], table, column),
                    )
        pq.write_table(table, path)
    totals = {"total_frames": int(first[-1]), "total_episodes": dataset.num_episodes}
    write_info(copy, dataset.info | totals | {"total_tasks": len(dataset.task_names)})
    path = copy / "meta" / "stats.json"
    stats = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    pictures = [
        k
        for k, f in features.items()
        if f["dtype"] in ("video", "image") and k not in dataset.unstored
    ]
    bad = [
        k
        for k in pictures
        if k not in stats or _wrong_statistics(dataset, k, features[k], stats[k])
    ]
    lerobot_format.restore_picture_statistics(copy, bad)
    lerobot_format.write_exact_statistics(copy)


def _with(table: pa.Table, key: str, values: np.ndarray) -> pa.Table:
    """Table with other values of a column of single numbers, in its own type."""
    return set_column(
        table, key, pa.array(values).cast(table.schema.field(key).type, safe=False)
    )
