"""Render frames for training from a dataset's simulator states into the frame cache, without any video.

The artefact is that of ``frame_cache``: the same stage, key and files, so that ``lerobot-train --dataset.cache=…`` finds it. Each
worker renders the cameras of whole episodes at the size of the dataset's pictures, resizes them as the policy does, and writes
the rows of these episodes into the memory-mapped arrays. Frames that the store already has for another dataset are copied:
demonstrations are rendered once, even if corrections are added later.
"""

import functools
import multiprocessing
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from taccorl.data.dataset import DATASET_STAGES, Dataset
from taccorl.demos.mimicgen.execute import mean_seconds
from taccorl.demos.mimicgen.from_dataset import make_simulation
from taccorl.demos.recorder import PICTURE
from taccorl.errors import DatasetError
from taccorl.lineage.canonical import canonical
from taccorl.lineage.engines import Engine
from taccorl.lineage.manifest import read_manifest, software
from taccorl.lineage.stage import Artefact
from taccorl.lineage.store import Store
from taccorl.sim.seen_scene import DRAWN_TOGETHER
from taccorl.sim.simulation import Simulation
from taccorl.training.frame_cache import (
    FRAMES,
    FrameIndex,
    FramesConfig,
    empty_frames,
    frames_file,
    resized,
)


def render_frames(
    root: Path,
    resolution: tuple[int, int] | None,
    store: Store,
    engine: Engine,
    progress: Callable[[str], None] = print,
) -> tuple[Artefact, dict[str, float]]:
    """Render the frames of the dataset at ``root``, unless they are in the store. Returns the artefact, and the mean time per
    episode [s].

    Args:
        resolution: rows and columns; None: as in the dataset.

    Raises:
        DatasetError: the dataset has no simulator states, or no cameras.
    """
    seconds: list[dict[str, float]] = []

    def render(config: FramesConfig, inputs: list[Path], out_dir: Path) -> None:
        dataset = Dataset(inputs[0])
        cameras, index = _cameras(dataset), FrameIndex.of_dataset(dataset)
        for key in cameras:
            shape = tuple(dataset.info["features"][key]["shape"][:2])
            empty_frames(out_dir, key, index.num_frames, config.resolution or shape).flush()
        first_frames, num_frames = index.first_frames_E.tolist(), index.frames_E.tolist()
        rendered = _rendered_before(store, config)
        made_of = _attempts(inputs[0]) or [""] * dataset.num_episodes
        found = engine.map(
            functools.partial(_fill_episode, inputs[0], out_dir, config.resolution),
            [
                _Item(i, first_frames[i], num_frames[i], rendered.get((key, index.rows_per_picture)))
                for i, key in enumerate(made_of)
            ],
            on_done=lambda item, _: progress(f"{item} of {dataset.num_episodes}: {item.done}"),
            name=str,
        )
        seconds.extend(found)

    artefact = store.run(FRAMES.bound(render), FramesConfig(resolution), [store.dataset(root)])
    return artefact, mean_seconds(seconds)


@dataclass(frozen=True)
class _Place:
    """Where the frames of an episode are in the store."""

    folder: Path
    """Folder of an artefact of the stage ``frames``."""
    first_frame: int


@dataclass(frozen=True)
class _Item:
    """An episode whose frames are wanted."""

    index: int
    first_frame: int
    num_frames: int
    known: _Place | None
    """Where its frames are; None: nowhere yet."""

    def __str__(self) -> str:
        return f"episode {self.index}"

    @property
    def done(self) -> str:
        return "rendered" if self.known is None else "copied"


def _attempts(root: Path) -> list[str]:
    """Digest of the attempt that each episode of the dataset was made of; empty if the dataset does not say so."""
    manifest = read_manifest(root)
    inputs = manifest["inputs"] if manifest and manifest["stage"] in DATASET_STAGES else []
    return [entry["digest"] for entry in inputs]


def _rendered_before(store: Store, config: FramesConfig) -> dict[tuple[str, int], _Place]:
    """(digest of an attempt, rows per picture) → its frames at this resolution. Only of datasets that are still there, as they
    were."""
    found: dict[tuple[str, int], _Place] = {}
    now = {name: version for name, version in software().items() if name in ("mujoco", "taccorl")}
    for folder in store.artefacts():
        manifest = read_manifest(folder) if folder.parent.name == FRAMES.name else {}
        if not manifest or (manifest["config"], manifest["stage_version"]) != (canonical(config), FRAMES.version):
            continue
        if any(manifest["software"].get(name) != version for name, version in now.items()):
            continue  # it may have drawn other pictures
        root = Path(manifest["inputs"][0]["path"])
        made_of = _attempts(root) if root.is_dir() else []
        if made_of and store.source(root).digest == manifest["inputs"][0]["digest"] and not store.damaged(folder):
            dataset = Dataset(root)
            first, every = FrameIndex.of_dataset(dataset).first_frames_E.tolist(), dataset.rows_per_picture
            found |= {(key, every): _Place(folder, first[i]) for i, key in enumerate(made_of)}
    return found


def _fill_episode(root: Path, out_dir: Path, resolution: tuple[int, int] | None, item: _Item) -> dict[str, float]:
    """Write every frame of an episode; returns the seconds of rendering and of resizing and writing, none if copied."""
    if item.known is None:
        return _render_episode(root, out_dir, resolution, item)
    for path in out_dir.glob("*.npy"):
        there = np.load(item.known.folder / path.name, mmap_mode="r")
        here = np.load(path, mmap_mode="r+")
        here[item.first_frame :][: item.num_frames] = there[item.known.first_frame :][: item.num_frames]
    return {}


def _render_episode(root: Path, out_dir: Path, resolution: tuple[int, int] | None, item: _Item) -> dict[str, float]:
    if multiprocessing.parent_process() is not None:
        torch.set_num_threads(1)  # as many workers as cores
    dataset, sim = _opened(root)
    keys = _cameras(dataset)
    arrays = {key: np.load(frames_file(out_dir, key), mmap_mode="r+") for key in keys}
    states = dataset.values(item.index, ["sim.state"])["sim.state"][:: dataset.rows_per_picture]
    spent = {"rendering": 0.0, "resizing and writing": 0.0}
    shape = dataset.info["features"][keys[0]]["shape"]
    for first in range(0, len(states), DRAWN_TOGETHER):
        began_s = time.perf_counter()
        part = states[first : first + DRAWN_TOGETHER]
        shown = sim.draw_states(part, [key.removeprefix(PICTURE) for key in keys], (shape[0], shape[1]))
        rendered_s = time.perf_counter()
        for key in keys:
            pictures = shown[key.removeprefix(PICTURE)]
            arrays[key][item.first_frame + first :][: len(part)] = resized(pictures, resolution)
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
            f"{dataset.root}: has {len(cameras)} cameras and {'' if 'sim.state' in features else 'no '}sim.state: frames can "
            "be rendered only for datasets of the twin with both: taccorl execute --pictures=cache"
        )
    return cameras


_open: dict[Path, tuple[Dataset, Simulation]] = {}


def _opened(root: Path) -> tuple[Dataset, Simulation]:
    """A dataset and its simulation, made once in a process."""
    if root not in _open:
        _open.clear()
        dataset = Dataset(root)
        told: Any = dataset.episode_facts(0).get("provenance", {}).get("simulation")
        if not isinstance(told, dict) or "twin" not in told:
            raise DatasetError(f"{root}: does not state in which twin it was made; make it with taccorl execute")
        _open[root] = dataset, make_simulation(told)
    return _open[root]
