"""Frames for training, rendered from a dataset's simulator states into the cache: no video is encoded, decoded or needed.

The artefact is that of ``frame_cache``: the same stage, key and files, so that ``lerobot-train --dataset.cache=…`` finds it. Each
worker renders the cameras of whole episodes at the size of the dataset's pictures, resizes them as the policy does, and writes
the rows of these episodes into the memory-mapped arrays.
"""

import dataclasses
import functools
import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from taccorl.data.dataset import Dataset
from taccorl.demos.mimicgen.execute import mean_seconds
from taccorl.demos.mimicgen.from_dataset import simulation_told
from taccorl.demos.recorder import PICTURE
from taccorl.errors import DatasetError
from taccorl.lineage.engines import Engine
from taccorl.lineage.stage import Artefact
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation
from taccorl.training.frame_cache import AT_ONCE, FRAMES, FramesConfig, empty_frames, frames_file, resized


def render_frames(
    root: Path,
    resolution: tuple[int, int] | None,
    store: Store,
    engine: Engine,
    progress: Callable[[str], None] = print,
) -> tuple[Artefact, dict[str, float]]:
    """The artefact of frames of the dataset at ``root``, and the mean seconds of an episode; from the store if it is there.

    Args:
        resolution: rows and columns; None: as the dataset has them.

    Raises:
        DatasetError: no simulator states, or no cameras.
    """
    seconds: list[dict[str, float]] = []

    def render(config: FramesConfig, inputs: list[Path], out_dir: Path) -> None:
        dataset = Dataset(inputs[0])
        cameras = _cameras(dataset)
        num_rows = int(dataset.info["total_frames"])
        for key in cameras:
            shape = tuple(dataset.info["features"][key]["shape"][:2])
            empty_frames(out_dir, key, num_rows, config.resolution or shape).flush()
        found = engine.map(
            functools.partial(_render_episode, inputs[0], out_dir, config.resolution),
            range(dataset.num_episodes),
            on_done=lambda i, _: progress(f"episode {i} of {dataset.num_episodes}: rendered"),
            name=lambda i: f"episode {i}",
        )
        seconds.extend(found)

    artefact = store.run(dataclasses.replace(FRAMES, fn=render), FramesConfig(resolution), [store.dataset(root)])
    return artefact, mean_seconds(seconds)


def _render_episode(root: Path, out_dir: Path, resolution: tuple[int, int] | None, i: int) -> dict[str, float]:
    """Every frame of an episode into its rows; returns the seconds of rendering and of resizing and writing."""
    if multiprocessing.parent_process() is not None:
        torch.set_num_threads(1)  # as many workers as cores
    dataset, sim = _opened(root)
    keys = _cameras(dataset)
    arrays = {key: np.load(frames_file(out_dir, key), mmap_mode="r+") for key in keys}
    states, row = dataset.values(i, ["sim.state"])["sim.state"], dataset.first_row(i)
    spent = {"rendering": 0.0, "resizing and writing": 0.0}
    shape = dataset.info["features"][keys[0]]["shape"]
    for first in range(0, len(states), AT_ONCE):
        began_s = time.perf_counter()
        part = states[first : first + AT_ONCE]
        shown = list(sim.render_states(part, [key.removeprefix(PICTURE) for key in keys], (shape[0], shape[1])))
        rendered_s = time.perf_counter()
        for key in keys:
            pictures = np.stack([images[key.removeprefix(PICTURE)] for images in shown])
            arrays[key][row + first : row + first + len(part)] = resized(pictures, resolution)
        spent["rendering"] += rendered_s - began_s
        spent["resizing and writing"] += time.perf_counter() - rendered_s
    return spent


def _cameras(dataset: Dataset) -> list[str]:
    """
    Raises:
        DatasetError: nothing to render, or nothing to render it from.
    """
    features = dataset.info["features"]
    cameras = [key for key, f in features.items() if f["dtype"] == "video"]
    if not cameras or "sim.state" not in features:
        raise DatasetError(
            f"{dataset.root}: has {len(cameras)} cameras and {'' if 'sim.state' in features else 'no '}sim.state: frames are "
            "rendered of datasets of the twin with both: taccorl execute --pictures=cache"
        )
    return cameras


_open: dict[Path, tuple[Dataset, Simulation]] = {}


def _opened(root: Path) -> tuple[Dataset, Simulation]:
    """A dataset and its simulation, made once in a process."""
    if root not in _open:
        _open.clear()
        dataset = Dataset(root)
        told: Any = dataset.told(0).get("provenance", {}).get("simulation")
        if not isinstance(told, dict) or "twin" not in told:
            raise DatasetError(f"{root}: does not say in which twin it was made; make it with taccorl execute")
        _open[root] = dataset, simulation_told(told)
    return _open[root]
