"""Faults of a LeRobot dataset's bookkeeping, which LeRobot trips over or trains on without a word, and a copy without them.

LeRobot finds a row's pictures by its ``timestamp``, its neighbours by ``index`` and the episode's ``dataset_from_index``, and
normalises by ``meta/stats.json``. Each is compared with what it must be:

    timestamp = frame_index / fps       index = 0, 1, 2 … over all files       from, to = the episode's first row, last row + 1
    statistics = those of the rows; quantiles may also be LeRobot's, which are averages over episodes (a note says so)
"""

import itertools
import json
import math
import re
import shlex
import shutil
from collections.abc import Iterator, Mapping, Sequence
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
    read_columns,
    write_info,
)
from taccorl.data.exact_statistics import (
    QUANTILE_NAMES,
    exact_stats,
    known_rows,
    quantile_bounds,
    statistics_of_rows,
)
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
from taccorl.data.video_files import TOLERANCE_S, frame_shift
from taccorl.errors import DatasetError

CHECKED = (
    "min",
    "max",
    "mean",
    "std",
)  # Statistics that do not depend on how LeRobot adds them up
STATISTICS_TOLERANCE = 1e-3  # Largest difference from the rows', as a share of the element's range: float32 sums
NORMALISED = ("observation.state", "action")
"""Features that policies normalise element by element."""
QUANTILE = re.compile(r"q\d\d")  # Names of LeRobot's quantiles, q01 … q99


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
            table = read_columns(path, BOOKKEEPING)
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
    ends = np.searchsorted(of_episode, np.arange(dataset.num_episodes + 1))
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
        own = rows.task_index[ends[i] : ends[i + 1]]
        found = {known[t] for t in np.unique(own).tolist()}
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
    findings: list[Finding] = []
    averaged: list[str] = []
    without: dict[tuple[str, ...], list[str]] = {}
    for key, feature in dataset.info["features"].items():
        numbers, own = feature["dtype"] in STATED, key in BOOKKEEPING
        due = key not in (BOOKKEEPING if numbers else dataset.unstored) and (
            numbers or feature["dtype"] == "video"
        )
        if key not in stats:
            text = f"{key}: not in meta/stats.json; {_ways_out(dataset, key, numbers)}"
            findings += [finding("statistics", key, text)] if due else []
            continue
        known = _known_values(dataset, key, feature) if numbers else None
        wrong = _wrong_statistics(dataset, feature, stats[key], known)
        if wrong is not None:
            way_out = _ways_out(dataset, key, numbers and not wrong.rounded)
            # LeRobot's own merge leaves its columns' stale
            severity: Severity = "note" if own else "error"
            text = f"{key}: {wrong.text}; {way_out}"
            findings.append(finding("statistics", key, text, severity=severity))
        elif known is not None and not own:
            of_quantiles = _wrong_quantiles(dataset, stats[key], known)
            if of_quantiles is not None and of_quantiles.rounded:
                averaged.append(f"{key}: {of_quantiles.text}")
            elif of_quantiles is not None:
                text = f"{key}: {of_quantiles.text}; {_ways_out(dataset, key, True)}"
                findings.append(finding("statistics", key, text))
            absent = [name for name in QUANTILE_NAMES if name not in stats[key]]
            if absent:
                without.setdefault(tuple(absent), []).append(key)
        if key in NORMALISED and known is not None:
            findings += _without_spread(key, known)
    if averaged:
        text = (
            f"{averaged[0]}: LeRobot averages the quantiles of {dataset.num_episodes} episodes, also of "
            f"{len(averaged) - 1} other features; tactile_pi05 computes exact ones, and {repaired}"
        )
        findings.append(finding("averaged_quantiles", "stats", text))
    for names, keys in without.items():
        text = (
            f"{listed(keys)}: meta/stats.json has no {listed(names, 5)} (datasets converted from v2.1 have none), by which "
            f"LeRobot's π0.5 normalises: its training ends in a ValueError; {repaired}"
        )
        findings.append(finding("statistics", keys[0], text, severity="warning"))
    return findings


def _ways_out(dataset: Dataset, key: str, recomputed: bool) -> str:
    """The commands that mend statistics of ``key``; ``recomputed``: LeRobot's own command computes them, too."""
    repaired = _repair(dataset)
    if not recomputed or key in BOOKKEEPING:  # of the rest LeRobot keeps what is there
        return repaired
    computed = recompute_statistics(dataset.root.resolve())
    return f"{repaired}; `{computed}` computes LeRobot's, in float32 and with quantiles averaged over episodes"


class Wrong(NamedTuple):
    """What is wrong with the statistics of one feature."""

    text: str
    rounded: bool = False
    """True if LeRobot's own way of computing it explains it, so that LeRobot would write the same number again."""


def _last_axis(shape: Sequence[int]) -> int:
    """Number of elements of which LeRobot keeps statistics: of more axes the last."""
    return shape[-1] if len(shape) > 1 else math.prod(shape)


def _known_values(dataset: Dataset, key: str, feature: dict[str, Any]) -> np.ndarray:
    """(N, size) values of the rows in which the feature is known."""
    known = known_rows(feature_rows(dataset.root, key))
    return known.reshape(-1, _last_axis(feature["shape"]))


def _element(number: int, size: int) -> str:
    return f" of element {number}" if size > 1 else ""


def _wrong_statistics(
    dataset: Dataset, feature: dict[str, Any], stats: Any, known: np.ndarray | None
) -> Wrong | None:
    """What is wrong with the statistics of one feature besides its quantiles' values; None if nothing is. ``known``: (N, size)
    values of all rows; None of pictures."""
    try:
        found = {name: np.asarray(stats[name], dtype=float).ravel() for name in CHECKED}
        names = [name for name in sorted(stats) if QUANTILE.fullmatch(name)]
        quantiles = [np.asarray(stats[name], dtype=float).ravel() for name in names]
    except (KeyError, TypeError, ValueError) as error:
        return Wrong(f"its statistics are not whole ({type(error).__name__}: {error})")
    pictures = feature["dtype"] in ("video", "image")
    size = 3 if pictures else _last_axis(feature["shape"])
    if known is not None and not len(known):
        return None  # NaN in every row: nobody knows it
    for name, values in (*found.items(), *zip(names, quantiles, strict=True)):
        if len(values) != size and not (
            pictures and len(values) == 1
        ):  # depth has one channel
            return Wrong(f"{name} has {len(values)} values for {size} elements")
        if not np.isfinite(values).all():
            if known is not None and not np.isfinite(known).all():
                return None  # as its rows, which have a finding of their own
            return Wrong(f"{name} holds {values[~np.isfinite(values)][0]}")
    if (found["std"] < 0).any():
        return Wrong(f"std is negative ({found['std'].min():g})")
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
            return Wrong("minimum, quantiles, mean and maximum are not in this order")
    if known is None:
        return None
    count = np.asarray(stats.get("count", len(known))).ravel()
    if len(count) and int(count[0]) not in (
        len(known),
        sum(map(dataset.num_rows, range(dataset.num_episodes))),
    ):
        return Wrong(f"count is {int(count[0])}, but there are {len(known)} rows")
    lengths = [*map(dataset.num_rows, range(dataset.num_episodes))]
    per_row = len(known) // max(sum(lengths), 1)  # more than one: of more axes
    return _wrong_moment(found, known, max(lengths) * max(per_row, 1))


def _wrong_moment(
    found: Mapping[str, np.ndarray], known: np.ndarray, summed: int
) -> Wrong | None:
    """The first of ``found`` (min, max, mean, std; (size,) each) that is not that of the rows ``known`` (N, size). Mean and
    deviation of an element that never changes may be off by LeRobot's rounding, which is no fault.

    LeRobot 0.6.1 adds up the rows of an episode in float32, ``summed`` numbers of magnitude x at most, and takes √(E[x²] − E[x]²)
    for the deviation s. With ε = 2⁻²³: |mean error| ≤ summed ε x, |s² − σ²| ≤ 2 · summed ε x²."""
    exact = {"min": known.min(0), "max": known.max(0)}
    exact |= {"mean": known.mean(0, dtype=float), "std": known.std(0, dtype=float)}
    span = np.asarray(exact["max"], dtype=float) - exact["min"]
    largest = np.maximum(np.abs(known.max(0)), np.abs(known.min(0))).astype(float)
    rounding = summed * float(np.finfo(np.float32).eps)
    for name, values in exact.items():
        off = np.abs(found[name] - values)
        tolerance = _tolerance(span, exact["mean"])
        rounded = np.zeros(len(off), dtype=bool)
        if name == "mean":
            rounded = off <= rounding * largest
        if name == "std":
            rounded = np.abs(found[name] ** 2 - values**2) <= 2 * rounding * largest**2
        tolerance = np.where(rounded & (span == 0.0), np.inf, tolerance)
        if (off > tolerance).any():
            i = int(np.argmax(off - tolerance))
            text = f"{name}{_element(i, len(off))} is {found[name][i]:.6g}, of the rows {float(values[i]):.6g}"
            if not rounded[off > tolerance].all():
                return Wrong(text)
            why = "LeRobot adds up in float32 and takes √(E[x²] − E[x]²), and its recompute_stats writes the same number again"
            return Wrong(f"{text}: {why}", rounded=True)
    return None


def _tolerance(span: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Largest difference of a statistic from that of the rows, per element, (size,)."""
    return STATISTICS_TOLERANCE * span + 1e-5 * np.abs(mean) + 1e-7


def _wrong_quantiles(dataset: Dataset, stats: Any, known: np.ndarray) -> Wrong | None:
    """A quantile that is not that of the rows ``known`` (N, size): first one that is not LeRobot's either, the mean of the
    episodes' quantiles weighted by their rows."""
    names = [name for name in sorted(stats) if QUANTILE.fullmatch(name)]
    if not len(known) or not np.isfinite(known).all():
        return None
    span = known.max(0).astype(float) - known.min(0)
    tolerance = _tolerance(span, known.mean(0, dtype=float))
    averaged = None
    for name in names:
        values, share = (
            np.asarray(stats[name], dtype=float).ravel(),
            int(name[1:]) / 100,
        )
        low, high = quantile_bounds(known, share)
        off = np.maximum(low - values, values - high) - tolerance
        if (off <= 0.0).all():
            continue
        i = int(np.argmax(off))
        exact = np.sort(known[:, i])[max(math.ceil(len(known) * share) - 1, 0)]
        text = f"{name}{_element(i, len(off))} is {values[i]:.6g}, of the rows {float(exact):.6g}"
        low, high = _averaged_bounds(dataset, known, share)
        if not ((low - tolerance <= values) & (values <= high + tolerance)).all():
            return Wrong(text)
        averaged = averaged or Wrong(text, rounded=True)
    return averaged


def _averaged_bounds(
    dataset: Dataset, known: np.ndarray, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds, (size,) each, of the mean of the episodes' quantiles, weighted by their rows; ``known`` (N, size): values of all
    rows. Without an episode's own rows, some of which are unknown, all rows are one episode."""
    lengths = [dataset.num_rows(k) for k in range(dataset.num_episodes)]
    each = len(known) // max(sum(lengths), 1)  # more than one: of features of more axes
    if each * sum(lengths) != len(known):
        return quantile_bounds(known, share)
    parts = np.split(known, np.cumsum(lengths)[:-1] * each)
    bounds = [quantile_bounds(part, share) for part in parts if len(part)]
    weights = [len(part) for part in parts if len(part)]
    low, high = (
        np.average(side, axis=0, weights=weights) for side in zip(*bounds, strict=True)
    )
    return low, high


def _without_spread(key: str, known: np.ndarray) -> Iterator[Finding]:
    """Elements of ``known`` (N, size) whose 1 % and 99 % quantiles are one number: a note where that is all they ever have, which
    is no fault of the data; a warning where other numbers are rare."""
    if len(known) < 2 or not np.isfinite(known).all():
        return
    stats = exact_stats(known)
    still = stats["q01"] == stats["q99"]
    moves = stats["max"] > stats["min"]
    why = (
        "and LeRobot's π0.5 divides what deviates from it by their difference, or 1e-8: the least deviation in use becomes huge. "
        "tactile_pi05 gives such elements a finite range"
    )
    for name, elements in (
        ("constant_element", still & ~moves),
        ("rare_motion", still & moves),
    ):
        at = np.flatnonzero(elements)
        if len(at):
            share = (
                "every row"
                if name == "constant_element"
                else "98 % of the rows or more"
            )
            each = listed([f"{i} ({stats['q01'][i]:g})" for i in at])
            text = f"{key}: one number in {share} of element {each}: its quantiles q01 and q99 are equal, {why}"
            yield finding(name, key, text)


def repair(dataset: Dataset, copy: Path) -> None:
    """Write a copy of a dataset with the stamps, indices, totals and statistics that its rows must have, and with starts of
    videos that lie on their frames. Raises DatasetError: ``copy`` exists, or rows are missing or exchanged: then which are
    right is unknown."""
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
    shifts = _video_shifts(dataset)
    first = np.cumsum([0, *(dataset.num_rows(i) for i in range(dataset.num_episodes))])
    at = 0
    for path in data_files(copy):
        table = read_columns(path)
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
        table = read_columns(path)
        numbers = table["episode_index"].to_numpy()
        for key, to in (
            ("dataset_from_index", first[numbers]),
            ("dataset_to_index", first[numbers + 1]),
        ):
            table = _with(table, key, to)
        for key in dataset.cameras:
            shift_s = np.array([shifts.get((int(i), key), 0.0) for i in numbers])
            for end in ("from", "to") if shift_s.any() else ():
                column = f"videos/{key}/{end}_timestamp"
                table = _with(table, column, table[column].to_numpy() + shift_s)
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
        if k not in stats
        or _wrong_statistics(dataset, features[k], stats[k], None) is not None
    ]
    lerobot_format.restore_picture_statistics(copy, bad)
    lerobot_format.write_exact_statistics(copy)


def _video_shifts(dataset: Dataset) -> dict[tuple[int, str], float]:
    """(episode, camera) → seconds by which its ``from_timestamp`` is before the frame of its first row, where that is less
    than half a frame and explains why its rows have no frames."""
    found = {}
    for key in dataset.cameras:
        for index in range(dataset.num_episodes):
            video = dataset.video(index, key)
            due_s = video.from_s + np.arange(video.num_frames) / dataset.spec.fps
            if (shift_s := frame_shift(video.path, due_s)) is not None:
                found[index, key] = shift_s
    return found


def _with(table: pa.Table, key: str, values: np.ndarray) -> pa.Table:
    """Table with other values of a column of single numbers, in its own type."""
    return set_column(
        table, key, pa.array(values).cast(table.schema.field(key).type, safe=False)
    )
