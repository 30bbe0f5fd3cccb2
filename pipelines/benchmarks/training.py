"""Figures of training; ``make bench ONLY=loading``."""

import dataclasses
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np

from pipelines.benchmarks.rows import Row, benchmark
from taccorl.robots import ROBOT

EPISODES, EPISODE_ROWS = 2, 128
BATCH, WORKERS, EPOCHS = 8, 2, 3
HORIZON, HISTORY = 10, 10
CACHED_PX, CACHED_BATCH = 112, 128


@benchmark("loading")
def loading_speed() -> Iterator[Row]:
    """Benchmark of rows per second from two worker processes: taccorl's reader relative to LeRobot's on the same dataset."""
    from lerobot.datasets.dataset_reader import DatasetReader

    from taccorl.training.reading import FastReader

    with tempfile.TemporaryDirectory(prefix="taccorl_bench_") as folder:
        for label, cameras, goal in (
            ("3 × 224² video", 3, "≥ 2"),
            ("no video", 0, "≥ 5"),
        ):
            root = _write(Path(folder) / f"cameras_{cameras}", cameras)
            loaders = {
                reader: _loader(root, reader) for reader in (FastReader, DatasetReader)
            }
            backend = loaders[FastReader].dataset.reader._video_backend  # pyright: ignore[reportAttributeAccessIssue]
            # One epoch of each in turn: other work on the machine meets both. The first, in which workers start, is not counted.
            figures = {reader: [] for reader in loaders}
            for _ in range(1 + EPOCHS):
                for reader, loader in loaders.items():
                    figures[reader].append(_rows_per_s(loader))
            ours, stock = figures[FastReader][1:], figures[DatasetReader][1:]
            ratios = [a / b for a, b in zip(ours, stock, strict=True)]
            shown = f"{label} ({backend})" if cameras else label
            name = f"rows per second over LeRobot's reader, {shown}, H = {HORIZON}, L = {HISTORY}, {WORKERS} workers"
            rival = {"rival": "LeRobot, rows/s", "rival_value": mean(stock)}
            yield Row.of(ratios, by=mean, name=name, unit="×", goal=goal, **rival)
            yield Row.of(ours, by=mean, name=f"rows per second, {shown}", unit="rows/s")
            if cameras:
                yield from _cached(root, Path(folder) / "store", mean(stock))


def _cached(root: Path, store: Path, stock: float) -> Iterator[Row]:
    """Whole batches from decoded frames, on the GPU where there is one."""
    import torch

    from taccorl.training import reading
    from taccorl.training.frame_cache import CacheRequest

    device = "cuda" if torch.cuda.is_available() else "cpu"
    place = "gpu" if device == "cuda" else "host"
    reading._requested = CacheRequest(
        place=place, resolution=(CACHED_PX, CACHED_PX), store=store, device=device
    )
    try:
        reading.install()
        loader = _loader(root, reading.FastReader, batch=CACHED_BATCH, workers=0)
        figures = [_rows_per_s(loader) for _ in range(1 + 10 * EPOCHS)][1:]
    finally:
        reading._requested = None
    ratios = [figure / stock for figure in figures]
    frames = f"3 × {CACHED_PX}² frames cached ({place})"
    name = (
        f"rows per second over LeRobot's reader, {frames}, H = {HORIZON}, L = {HISTORY}"
    )
    yield Row.of(
        ratios,
        by=mean,
        name=name,
        unit="×",
        goal="≥ 15",
        rival="LeRobot, rows/s",
        rival_value=stock,
    )


def _write(root: Path, cameras: int) -> Path:
    """Noisy touch and smooth, moving pictures: simulated, not a robot's."""
    from taccorl.data.episode import Episode, Pictures
    from taccorl.data.lerobot_format import write_episodes
    from taccorl.data.origin import Origin
    from taccorl.data.spec import find_spec, load_dataset_spec

    spec = load_dataset_spec(find_spec("taccorl_bimanual"))
    features = {key: f for key, f in spec.features.items() if not f.optional}
    for key in spec.keys("video")[cameras:]:
        del features[key]
    touch = "observation.tactile"
    spec = dataclasses.replace(
        spec, features=features, sensors={touch: spec.sensors[touch]}
    )
    rng = np.random.default_rng(0)
    row, column = np.mgrid[0:224, 0:224]

    def pictures() -> Iterator[Pictures]:
        for k in range(EPISODE_ROWS):
            wave = 128 + 80 * np.sin((row + 3 * k) / 17) * np.cos((column - 2 * k) / 23)
            picture = np.clip(
                wave[:, :, None] + rng.normal(0, 4, (224, 224, 3)), 0, 255
            ).astype(np.uint8)
            yield {key: picture.copy() for key in spec.keys("video")}

    def episode(seed: int) -> Episode:
        numbers = np.random.default_rng(seed)
        arrays: dict[str, np.ndarray] = {
            key: numbers.normal(size=(EPISODE_ROWS, ROBOT.num_actions)).astype(
                np.float32
            )
            for key in ("observation.state", "action")
        }
        arrays[touch] = numbers.integers(
            -15, 15, (EPISODE_ROWS, ROBOT.num_taxels)
        ).astype(np.int16)
        return Episode(
            name=f"benchmark {seed}", spec=spec, start_ns=0, arrays=arrays, picture_keys=tuple(spec.keys("video")),
            pictures=pictures if cameras else lambda: iter([{}] * EPISODE_ROWS), instruction="insert the plug",
            origin=Origin("twin", "made for a benchmark"),
        )  # fmt: skip

    write_episodes([episode(seed) for seed in range(EPISODES)], root)
    return root


def _loader(root: Path, reader: Any, batch: int = BATCH, workers: int = WORKERS) -> Any:
    """As lerobot-train makes it, with ``reader`` inside."""
    import torch
    from lerobot.datasets import lerobot_dataset

    before = lerobot_dataset.DatasetReader
    lerobot_dataset.DatasetReader = reader
    try:
        windows = {
            "observation.tactile": [k / 30 for k in range(1 - HISTORY, 1)],
            "action": [k / 30 for k in range(HORIZON)],
        }
        dataset = lerobot_dataset.LeRobotDataset(
            "local/bench", root=root, delta_timestamps=windows, return_uint8=True
        )
    finally:
        lerobot_dataset.DatasetReader = before
    if not workers:
        return torch.utils.data.DataLoader(dataset, batch, shuffle=True)
    return torch.utils.data.DataLoader(
        dataset,
        batch,
        shuffle=True,
        num_workers=workers,
        persistent_workers=True,
        multiprocessing_context="spawn",
    )


def _rows_per_s(loader: Any) -> float:
    """Of one epoch."""
    start_s, rows = time.perf_counter(), 0
    for batch in loader:
        rows += len(batch["index"])
    return rows / (time.perf_counter() - start_s)
