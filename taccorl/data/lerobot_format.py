"""Write episodes as a LeRobot v3 dataset with LeRobot's own writer, and verify that every row has its own picture.

LeRobot 0.6.1's streaming encoder drops frames without an error when it lags behind (video_utils.py, feed_frame), and rows
then show later pictures. So frames are fed under back-pressure, and afterwards every video file is verified to hold exactly
one frame per row at its time; a dataset that fails is written again the slow way, through PNG files.
"""

import contextlib
import functools
import itertools
import json
import logging
import math
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from taccorl.data.dataset import (
    BOOKKEEPING,
    PROVENANCE,
    ROWS_PER_PICTURE,
    Dataset,
    data_files,
    feature_rows,
    read_columns,
    read_info,
    write_info,
)
from taccorl.data.episode import Episode
from taccorl.data.exact_statistics import (
    exact_stats,
    known_rows,
    statistics_of_rows,
    stats_of_counts,
)
from taccorl.data.joining import JOINED_TOGETHER, Run, in_threads, join, require_videos
from taccorl.data.spec import DatasetSpec
from taccorl.errors import DatasetError, TaccorlError
from taccorl.extras import OnUse, quick_columns

av, cv2 = OnUse("av"), OnUse("cv2")
QUEUE_FRAMES = 4  # Frames that may wait per camera; 3 cameras × 4 × 0.9 MB at 480×640
LARGE_FEATURE = 256  # Fewest elements with exact quantiles in blocks; LeRobot's histograms take 80 kB an element
PRIORITY_ROWS = 16
UNSAFE_IN_PATHS = "'*?[]"  # What LeRobot 0.6.1 reads as patterns (of parquet files) or quotes (in the list of videos)
STATED = (
    *(f"{sign}int{bits}" for sign in ("u", "") for bits in (8, 16, 32, 64)),
    "float16",
    "float32",
    "float64",
)
"""Types of features that have statistics: numbers, LeRobot's own columns among them."""
ENCODERS: dict[str, dict[str, Any]] = {
    # g = 2: a frame is at most one frame away from a keyframe, which random access in training needs (LeRobot's default).
    "libsvtav1": {"vcodec": "libsvtav1", "g": 2, "crf": 30, "preset": 12},
    # no frame refers to a later one, so looking ahead and B-frames would cost memory for nothing
    "h264": {
        "vcodec": "h264",
        "g": 2,
        "crf": 23,
        "preset": "veryfast",
        "extra_options": {"x264-params": "rc-lookahead=0:sync-lookahead=0:bframes=0"},
    },
}
"""Codec of a data spec → options of LeRobot's video encoder."""


def lerobot_features(
    spec: DatasetSpec, keys: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """LeRobot's features of ``keys``, in their order. Unit, frame, range and a sensor's layout are stored in the feature."""
    features: dict[str, dict[str, Any]] = {}
    for key in keys:
        f = spec.features[key]
        entry: dict[str, Any] = {"dtype": f.dtype, "shape": f.shape}
        entry["names"] = (
            ["height", "width", "channels"]
            if f.dtype == "video"
            else list(f.names) or None
        )
        if f.dtype != "video":
            entry |= {
                "unit": list(f.unit) if isinstance(f.unit, tuple) else f.unit,
                "frame": f.frame,
            }
            if not isinstance(f.range, dict) and np.isfinite(f.range).all():
                entry["range"] = list(f.range)
            if f.layout:
                entry["layout"] = list(f.layout)
        if key in spec.sensors:
            sensor = spec.sensors[key]
            layout = {
                "history": f.history,
                "pad": len(f.pads),
                "row": sensor.rows,
                "column": sensor.columns,
            }
            touch = {
                "sensor": sensor.name,
                "layout": list(layout.values()),
                "layout_names": list(layout),
            }
            touch |= {
                "pads": list(f.pads),
                "signal": "counts above baseline",
                "scheme": sensor.scheme,
            }
            entry["tactile"] = touch | {"gain_per_count": sensor.gain_per_count}
        features[key] = entry
    return features


def declare_pictures(root: Path, spec: DatasetSpec, rows_per_picture: int = 1) -> None:
    """Add the picture features of ``spec`` to ``info.json`` of a dataset without videos, whose frames are only in training's
    frame cache. ``rows_per_picture``: k: the rows 0, k, 2k … of each episode have pictures."""
    info, features = read_info(root), lerobot_features(spec, spec.keys("video"))
    for feature in features.values():
        feature |= {ROWS_PER_PICTURE: rows_per_picture} if rows_per_picture > 1 else {}
    info["features"] = {
        key: info["features"].get(key) or features[key]
        for key in [*spec.features, *info["features"]]
        if key in info["features"] or key in features
    }
    write_info(root, info)


def change_features(
    root: Path,
    copy: Path,
    keep: Collection[str],
    added: Mapping[str, tuple[float, Mapping[str, Any]]],
) -> None:
    """Write the dataset at ``root`` with other features to ``copy``, which must not exist, without its provenance. Videos are
    linked. ``keep``: features that remain, besides LeRobot's own columns. ``added``: new feature → its value in all rows, and its
    description as in ``info.json``. (LeRobot's ``modify_features`` makes an object of every cell, 0.8 ms for a row with touch.)
    """
    with quiet_lerobot():
        from lerobot.datasets.feature_utils import get_hf_features_from_features

    shutil.copytree(
        root / "meta", copy / "meta", ignore=shutil.ignore_patterns(PROVENANCE.name)
    )
    info = read_info(copy)
    kept = {
        key: f
        for key, f in info["features"].items()
        if key in keep or key in BOOKKEEPING
    }
    lost = [key for key in info["features"] if key not in kept]
    info["features"] = kept | {
        key: {**told, "shape": list(told["shape"])} for key, (_, told) in added.items()
    }
    is_shown = any(f["dtype"] == "video" for f in kept.values())
    info["video_path"] = info.get("video_path") if is_shown else None
    write_info(copy, info)
    if is_shown:
        (copy / "videos").symlink_to(
            (root / "videos").resolve(), target_is_directory=True
        )

    shaped = {
        key: {**f, "shape": tuple(f["shape"])} for key, f in info["features"].items()
    }
    schema = get_hf_features_from_features(shaped).arrow_schema
    for source in sorted((root / "data").glob("*/*.parquet")):
        table = read_columns(
            source, [name for name in schema.names if name not in added]
        )
        for key, (value, _) in added.items():
            kind = schema.field(key).type
            size = kind.list_size if pa.types.is_fixed_size_list(kind) else 1
            flat = pa.array(np.full(len(table) * size, value, dtype=np.float32))
            column = (
                pa.FixedSizeListArray.from_arrays(flat, size)
                if pa.types.is_fixed_size_list(kind)
                else flat
            )
            table = table.append_column(key, column)
        place = copy / source.relative_to(root)
        place.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(
            table.select(schema.names).cast(schema), place, compression="snappy"
        )

    gone = tuple(f"{kind}/{key}/" for kind in ("videos", "stats") for key in lost)
    for file in (copy / "meta/episodes").rglob("*.parquet"):
        table = read_columns(file)
        pq.write_table(
            table.select(
                [name for name in table.column_names if not name.startswith(gone)]
            ),
            file,
        )
    stats = copy / "meta" / "stats.json"
    if stats.is_file():
        known = json.loads(stats.read_text(encoding="utf-8"))
        stats.write_text(
            json.dumps({key: s for key, s in known.items() if key not in lost}),
            encoding="utf-8",
        )


def copy_pictures(source: Path, root: Path) -> None:
    """Add the picture features of the dataset at ``source`` to ``info.json`` of the one at ``root``, whose frames are only in the
    frame cache of training."""
    features, info = read_info(source)["features"], read_info(root)
    cameras = {
        key: {k: v for k, v in f.items() if k != "info"}
        for key, f in features.items()
        if f["dtype"] == "video"
    }
    write_info(root, info | {"features": cameras | info["features"]})


def check_path(path: Path) -> None:
    """Raise a DatasetError if LeRobot would misread this path, or read another one."""
    odd = sorted(set(str(path.resolve())) & set(UNSAFE_IN_PATHS))
    if odd:
        text = f"{path.resolve()}: LeRobot cannot work in a folder with {' '.join(odd)} in its path; use another folder"
        raise DatasetError(text)


def write_episodes(
    episodes: Sequence[Episode],
    root: Path,
    *,
    progress: Callable[[int], None] | None = None,
    streaming: bool = True,
) -> None:
    """Write these episodes as a new dataset at ``root``, and verify it; if that fails, or without ``streaming``, write it through
    PNG files. ``progress``: called with the number of rows written so far. Raises DatasetError: also the videos made from PNG
    files do not hold exactly one frame per row; RecordingError: a picture is broken; nothing is left at ``root``."""
    check_path(root)
    if root.exists():
        raise DatasetError(
            f"{root} exists already; nothing was changed: give another folder"
        )
    try:
        _write(episodes, root, progress, streaming)
        problems = Dataset(root).video_problems()
        if problems and streaming:
            logging.getLogger(__name__).warning(
                "%s: %s; writing again without streaming", root, problems[0]
            )
            shutil.rmtree(root)
            _write(episodes, root, progress, streaming=False)
            problems = Dataset(root).video_problems()
    except BaseException:
        shutil.rmtree(root, ignore_errors=True)
        raise
    if problems:
        raise DatasetError(f"{root}: {len(problems)} problems, first: {problems[0]}")


def _write(
    episodes: Sequence[Episode],
    root: Path,
    progress: Callable[[int], None] | None,
    streaming: bool,
) -> None:
    with quiet_lerobot():
        from lerobot.configs import RGBEncoderConfig
        from lerobot.datasets import dataset_metadata
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        first = episodes[0]
        keys = [
            k
            for k in first.spec.features
            if k in first.arrays or k in first.picture_keys
        ]
        dataset = LeRobotDataset.create(
            repo_id=f"local/{root.name}",
            fps=first.spec.fps,
            features=lerobot_features(first.spec, keys),
            root=root,
            robot_type=first.spec.robot_type,
            use_videos=True,
            streaming_encoding=streaming and bool(first.picture_keys),
            encoder_queue_maxsize=QUEUE_FRAMES,
            rgb_encoder=RGBEncoderConfig(**ENCODERS[first.spec.video_codec]),
            encoder_threads=1,  # one a camera: cheaper than many, and the same bytes on any machine
        )
        done = 0
        try:
            with _pixels_counted():
                for episode in episodes:
                    for row in _rows(episode):
                        _wait_for_room(dataset)
                        dataset.add_frame(row)
                        done += 1
                        if done % PRIORITY_ROWS == 1:
                            _normal_priority()
                        if progress is not None:
                            progress(done)
                    with (
                        _large_features_in_blocks(dataset.writer),
                        _statistics_in_order(dataset_metadata),
                    ):
                        dataset.save_episode()
            dataset.finalize()
        except BaseException:
            with contextlib.suppress(
                Exception
            ):  # stop encoder threads; the error that brought us here matters
                dataset.clear_episode_buffer()
                dataset.finalize()
            raise


def _rows(episode: Episode) -> Iterator[dict[str, Any]]:
    pictures = (
        episode.pictures() if episode.picture_keys else iter([{}] * episode.num_rows)
    )
    for k, shown in enumerate(pictures):
        numbers = {key: values[k] for key, values in episode.arrays.items()}
        yield {**numbers, **shown, "task": episode.instruction}


def _normal_priority() -> None:
    """Run as root, SVT-AV1 puts its threads and the one that opens it under real-time scheduling (first in, first out, 99),
    which starves the whole machine and is inherited by every child: back to normal."""
    tasks = Path("/proc/self/task")
    if not hasattr(os, "sched_setscheduler") or os.geteuid() != 0 or not tasks.is_dir():
        return
    for task in tasks.iterdir():
        with contextlib.suppress(OSError):  # a thread that ended meanwhile
            if os.sched_getscheduler(int(task.name)) != os.SCHED_OTHER:
                os.sched_setscheduler(int(task.name), os.SCHED_OTHER, os.sched_param(0))


@contextlib.contextmanager
def _replaced(owner: Any, **values: Any) -> Iterator[None]:
    """While open, attributes of ``owner`` have other values."""
    usual = {name: getattr(owner, name) for name in values}
    try:
        for name, value in values.items():
            setattr(owner, name, value)
        yield
    finally:
        for name, value in usual.items():
            setattr(owner, name, value)


@contextlib.contextmanager
def _large_features_in_blocks(writer: Any) -> Iterator[None]:
    """While open, LeRobot's writer spends no memory that grows with an episode's touch, beyond the touch itself. On 22 MB of it
    (4 min) LeRobot 0.6.1 and ``datasets`` spend 800 MB: a histogram for every taxel (here ``exact_stats``), Python lists (here
    Arrow in pieces), picture files to embed (there are none), a pickle of the table. A test compares what is written."""
    from datasets import arrow_dataset
    from lerobot.datasets import dataset_writer

    def is_large(value: Any) -> bool:
        return (
            isinstance(value, np.ndarray)
            and value.ndim == 2
            and value.shape[1] >= LARGE_FEATURE
        )

    compute, save = dataset_writer.compute_episode_stats, writer._save_episode_data

    def compute_in_blocks(
        data: dict[str, Any], features: dict[str, Any], *args: Any
    ) -> dict[str, Any]:
        large = {k: exact_stats(v) for k, v in data.items() if is_large(v)}
        stats = (
            compute({k: v for k, v in data.items() if k not in large}, features, *args)
            | large
        )
        return {
            k: stats[k] for k in data if k in stats
        }  # they become the episodes' columns, in this order

    def save_as_arrow(episode_buffer: dict[str, Any]) -> dict[str, Any]:
        return save(
            {k: as_arrow(v) if is_large(v) else v for k, v in episode_buffer.items()}
        )

    with (
        _replaced(
            dataset_writer,
            compute_episode_stats=compute_in_blocks,
            embed_images=lambda dataset: dataset,
        ),
        _replaced(writer, _save_episode_data=save_as_arrow),
        _replaced(arrow_dataset, generate_fingerprint=lambda dataset: "0" * 16),
    ):
        yield


@contextlib.contextmanager
def _pixels_counted() -> Iterator[None]:
    """While open, LeRobot counts how often each of a pixel's 256 values occurs, exactly, instead of sorting every picture into
    5000 bins, which took 45 % of the CPU time of an augmented episode with three cameras (docs/decisions.md)."""
    from lerobot.datasets import compute_stats

    theirs: type = compute_stats.RunningQuantileStats

    class PixelStatistics(theirs):
        """LeRobot's running statistics for 8-bit values, given as (pixels, channels)."""

        counts: np.ndarray | None = None

        def update(self, batch: np.ndarray) -> None:
            if batch.dtype != np.uint8:
                super().update(batch)
                return
            pixels = np.ascontiguousarray(batch.reshape(-1, 1, batch.shape[-1]))
            new = [
                # (256, 1) of OpenCV 4, (256,) of OpenCV 5
                cv2.calcHist([pixels], [c], None, [256], [0, 256]).reshape(256)
                for c in range(batch.shape[-1])
            ]
            self.counts = np.array(new, np.int64) + (
                0 if self.counts is None else self.counts
            )

        def get_statistics(self) -> dict[str, np.ndarray]:
            return (
                super().get_statistics()
                if self.counts is None
                else stats_of_counts(self.counts)
            )

    with _replaced(compute_stats, RunningQuantileStats=PixelStatistics):
        yield


@contextlib.contextmanager
def _statistics_in_order(module: Any) -> Iterator[None]:
    """While open, LeRobot's ``module`` keeps statistics in the features' order, so that equal data make equal files (0.6.1's
    ``aggregate_stats`` takes its keys from a set of strings, whose order is another one in every process)."""
    aggregate = module.aggregate_stats

    def in_order(stats: list[dict[str, Any]]) -> dict[str, Any]:
        total = aggregate(stats)
        return {
            key: total[key]
            for key in dict.fromkeys(key for each in stats for key in each)
        }

    with _replaced(module, aggregate_stats=in_order):
        yield


def as_arrow(values: np.ndarray, rows: int = 256) -> pa.ChunkedArray:
    """``values`` (T, size) as an Arrow array of T fixed-size lists, in pieces of ``rows``, so that no later step holds all of
    them twice."""
    pieces = [values[k : k + rows] for k in range(0, len(values), rows)]
    return pa.chunked_array(
        [
            pa.FixedSizeListArray.from_arrays(pa.array(p.reshape(-1)), p.shape[1])
            for p in pieces
        ]
    )


def _wait_for_room(dataset: Any) -> None:
    """Back-pressure: LeRobot drops a frame whose queue stays full for 0.1 s. We are the only feeder, so room stays room."""
    encoder = dataset.writer._streaming_encoder
    while encoder is not None and any(q.full() for q in encoder._frame_queues.values()):
        if not all(t.is_alive() for t in encoder._threads.values()):
            return  # feed_frame tells what killed it
        time.sleep(0.002)


def merge(roots: Sequence[Path], destination: Path, run: Run = in_threads) -> None:
    """Merge datasets into one (``joining``, whose files ``run`` writes); a single one is copied. Statistics of joints and actions
    are those of all rows: LeRobot 0.6.1 averages the datasets' quantiles, and computes the deviation of a feature that hardly
    moves as 0 (float32). Raises DatasetError: the datasets differ in features, fps or robot, or the merged videos do not hold
    exactly one frame per row."""
    for path in (*roots, destination):
        check_path(path)
    for root in roots:
        require_videos(root)
    if len(roots) == 1:
        shutil.copytree(roots[0], destination, dirs_exist_ok=True)
    else:
        _join(roots, destination, run)
    write_exact_statistics(destination, smaller_than=LARGE_FEATURE, run=run)
    problems = Dataset(destination).video_problems()
    if problems:
        raise DatasetError(
            f"{destination}: {len(problems)} problems after merging, first: {problems[0]}"
        )


def write_exact_statistics(
    root: Path, *, smaller_than: float = math.inf, run: Run = in_threads
) -> None:
    """Replace the statistics of numeric features in ``meta/stats.json`` by exact ones over all rows, quantiles included. Rows
    that are NaN as a whole, in which the feature is unknown, are not counted. ``smaller_than``: leave features with as many
    elements as they are."""
    with quiet_lerobot():
        from lerobot.datasets.io_utils import load_stats, write_stats

        stated = {
            key: f["shape"]
            for key, f in read_info(root)["features"].items()
            if f["dtype"] in STATED
        }
        stated = {
            key: shape
            for key, shape in stated.items()
            if math.prod(shape) < smaller_than
        }
        found = run(functools.partial(_exact_statistics, root), list(stated.items()))
        write_stats(
            dict(load_stats(root) or {}) | dict(zip(stated, found, strict=True)), root
        )


def _exact_statistics(
    root: Path, feature: tuple[str, Sequence[int]]
) -> dict[str, np.ndarray]:
    key, shape = feature
    values = feature_rows(root, key)
    known = known_rows(values)
    return statistics_of_rows(known if len(known) else values, shape)


def restore_picture_statistics(root: Path, keys: Sequence[str]) -> None:
    """Write the statistics of the pictures ``keys`` in ``meta/stats.json`` anew, from those of the episodes."""
    with quiet_lerobot():
        from lerobot.datasets.io_utils import load_stats, write_stats

        stats = dict(
            (load_stats(root) if (root / "meta/stats.json").is_file() else None) or {}
        )
        write_stats(stats | picture_statistics(root, keys), root)


def picture_statistics(
    root: Path, keys: Sequence[str]
) -> dict[str, dict[str, np.ndarray]]:
    """Key → statistic → (3, 1, 1) of the pictures ``keys``, added up from those of the episodes in ``meta/episodes``."""
    stats: dict[str, dict[str, np.ndarray]] = {}
    with quiet_lerobot():
        from lerobot.datasets.compute_stats import aggregate_stats

        tables = [
            read_columns(path)
            for path in sorted((root / "meta/episodes").glob("*/*.parquet"))
        ]
        for key in keys:
            prefix, episodes = f"stats/{key}/", []
            columns = [
                t.select([n for n in t.column_names if n.startswith(prefix)])
                for t in tables
            ]
            for row in (row for table in columns for row in table.to_pylist()):
                shapes = {n: (-1,) if n.endswith("/count") else (-1, 1, 1) for n in row}
                episodes.append(
                    {
                        n.removeprefix(prefix): np.array(v).reshape(shapes[n])
                        for n, v in row.items()
                    }
                )
            if episodes and episodes[0]:
                stats |= aggregate_stats([{key: episode} for episode in episodes])
    return stats


def loading_problems(dataset: Dataset, probed: Sequence[int]) -> list[str]:
    """What would stop LeRobot, or ``datasets``, from loading a dataset: tables with columns that are not stated, or that not
    all files have. Of the episodes ``probed`` also pictures of the first and last row that do not decode. One text for each."""
    problems, features = [], dataset.info["features"]
    stated = {key for key, f in features.items() if f["dtype"] != "video"}
    for path in data_files(dataset.root):
        if odd := sorted(set(pq.read_schema(path).names) - stated):
            text = f"has the column {odd[0]}, which meta/info.json does not state"
            problems.append(f"LeRobot cannot load it: {path}: {text}")
    first: set[str] | None = None
    for path in sorted((dataset.root / "meta" / "episodes").glob("*/*.parquet")):
        names = set(pq.read_schema(path).names)
        first = names if first is None else first
        if odd := sorted(names - first):
            text = f"has the column {odd[0]}, which the first file there lacks"
            problems.append(f"LeRobot cannot load it: {path}: {text}")
    for index, key in itertools.product(probed, dataset.cameras):
        for row in {0, dataset.num_rows(index) - 1}:
            try:
                next(dataset.frames(index, key, row, row + 1))
            except TaccorlError as error:
                text = f"row {dataset.first_row(index) + row}: {error}"
                problems.append(f"LeRobot cannot read {text}")
    return problems


def read_as_lerobot(root: Path, rows: Sequence[int]) -> list[str]:
    """Load the dataset and these rows of it as LeRobot does in training; returns its errors, one line each."""
    problems: list[str] = []
    with quiet_lerobot(), tempfile.TemporaryDirectory(prefix="taccorl_") as cache:
        from datasets import config as datasets_config
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        with _replaced(
            datasets_config, HF_DATASETS_CACHE=Path(cache)
        ):  # it would keep a copy of the rows there
            try:
                dataset = LeRobotDataset(f"local/{root.name}", root=root)
            except Exception as error:  # whatever it is, training would end in it
                return [f"LeRobot cannot load it: {_in_one_line(error)}"]
            for row in rows:
                try:
                    found = int(dataset[row]["index"])  # pyright: ignore[reportCallIssue, reportArgumentType]
                    problems += (
                        []
                        if found == row
                        else [f"LeRobot gives row {found} for row {row}"]
                    )
                except Exception as error:
                    problems.append(
                        f"LeRobot cannot read row {row}: {_in_one_line(error)}"
                    )
    return problems


def _in_one_line(error: Exception, most: int = 300) -> str:
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return text if len(text) <= most else f"{text[:most]} …"


def _join(roots: Sequence[Path], destination: Path, run: Run = in_threads) -> None:
    with quiet_lerobot():
        join(roots, destination, _common_features(roots), run)
    groups = [
        roots[k : k + JOINED_TOGETHER] for k in range(0, len(roots), JOINED_TOGETHER)
    ]
    found = [stats for stats in run(_mean_statistics, groups) if stats]
    with quiet_lerobot():
        from lerobot.datasets.io_utils import write_stats

        write_stats(found[0] if len(found) == 1 else _mean(found), destination)


def _mean_statistics(roots: Sequence[Path]) -> dict[str, Any]:
    """Statistics of datasets together, as LeRobot computes them from those of each."""
    with quiet_lerobot():
        from lerobot.datasets.io_utils import load_stats

        found = [stats for root in roots if (stats := load_stats(root)) is not None]
        return _mean(found) if found else {}


def _mean(stats: list[dict[str, Any]]) -> dict[str, Any]:
    from lerobot.datasets import compute_stats

    with _statistics_in_order(compute_stats):
        return compute_stats.aggregate_stats(stats)


def _common_features(roots: Sequence[Path]) -> dict[str, Any]:
    """Features of all datasets; what encoders of videos state is kept where all datasets state the same. Raises
    DatasetError: they differ in features, rate or robot."""
    from lerobot.datasets.aggregate import merge_video_feature_info_for_aggregate
    from lerobot.datasets.feature_utils import features_equal_for_merge

    infos = [read_info(root) for root in roots]
    for info, root in zip(infos, roots, strict=True):
        one, other = infos[0]["features"], info["features"]
        compared = [
            (key, infos[0][key], info[key])
            for key in ("fps", "robot_type")
            if infos[0][key] != info[key]
        ]
        for key in {**one, **other}:
            a, b = (
                {key: features[key]} if key in features else {}
                for features in (one, other)
            )
            compared += (
                []
                if features_equal_for_merge(a, b)
                else [(key, a.get(key, "absent"), b.get(key, "absent"))]
            )
        if compared:
            key, a, b = compared[0]
            raise DatasetError(
                f"these datasets do not merge: {key} is {b} in {root.name}, but {a} in {roots[0].name}"
            )
    return merge_video_feature_info_for_aggregate(
        [SimpleNamespace(features=info["features"]) for info in infos]  # pyright: ignore[reportArgumentType]
    )


@contextlib.contextmanager
def quiet_lerobot() -> Iterator[None]:
    """While open, LeRobot works offline and prints no progress bars, encoder messages or download attempts; errors are still
    printed."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    os.environ.setdefault("SVT_LOG", "1")
    os.environ.setdefault("TQDM_DISABLE", "1")
    if (
        os.environ.get("TACCORL_PROGRAM") == "1"
        and "lerobot.processor" not in sys.modules
    ):
        # Writing a dataset needs no tokenizer: without transformers LeRobot imports 2 CPU-s faster and 55 MB smaller.
        from lerobot.utils import import_utils

        import_utils._transformers_available = False
    quick_columns()
    av.logging.set_libav_level(av.logging.ERROR)
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)
    with np.errstate(all="ignore"):
        try:
            yield
        finally:
            root.setLevel(level)
