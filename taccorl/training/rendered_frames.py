"""Render frames for training from a dataset's simulator states into the frame cache, without any video.

The artefact is that of ``frame_cache``: the same stage, key and files, so that ``lerobot-train --dataset.cache=…`` finds it. Each
worker renders the cameras of whole episodes at the size of the dataset's pictures, resizes them as the policy does, and writes
the rows of these episodes into the memory-mapped arrays. Frames that the store already has for another dataset are copied:
demonstrations are rendered once, even if corrections are added later.
"""

import functools
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from taccorl.data.dataset import DATASET_STAGES, Dataset
from taccorl.data.spec import DatasetSpec
from taccorl.episodes.produce import mean_seconds
from taccorl.episodes.recorder import PICTURE
from taccorl.episodes.sources.mimicgen.from_dataset import make_simulation
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
    drawn: "DrawnFrames | None" = None,
) -> tuple[Artefact, dict[str, float]]:
    """Render the frames of the dataset at ``root``, unless they are in the store. Returns the artefact, and the mean time per
    episode [s].

    Args:
        resolution: rows and columns; None: as in the dataset.
        drawn: frames that were drawn while the dataset was collected; used if they are of its episodes.

    Raises:
        DatasetError: the dataset has no simulator states, or no cameras.
    """
    seconds: list[dict[str, float]] = []

    def render(config: FramesConfig, inputs: list[Path], out_dir: Path) -> None:
        dataset = Dataset(inputs[0])
        cameras, index = _cameras(dataset), FrameIndex.of_dataset(dataset)
        if drawn is not None and drawn.are_of(inputs[0], index):
            drawn.move(out_dir, progress)
            return
        for key in cameras:
            shape = tuple(dataset.info["features"][key]["shape"][:2])
            empty_frames(
                out_dir, key, index.num_frames, config.resolution or shape
            ).flush()
        first_frames, num_frames = (
            index.first_frames_E.tolist(),
            index.frames_E.tolist(),
        )
        rendered = _rendered_before(store, config)
        made_of = _attempts(inputs[0]) or [""] * dataset.num_episodes
        found = engine.map(
            functools.partial(_fill_episode, inputs[0], out_dir, config.resolution),
            [
                _Item(
                    i,
                    first_frames[i],
                    num_frames[i],
                    rendered.get((key, index.rows_per_picture)),
                )
                for i, key in enumerate(made_of)
            ],
            on_done=lambda item, _: progress(
                f"{item} of {dataset.num_episodes}: {item.done}"
            ),
            name=str,
        )
        seconds.extend(found)

    artefact = store.run(
        FRAMES.bound(render), FramesConfig(resolution), [store.dataset(root)]
    )
    return artefact, mean_seconds(seconds)


class DrawnFrames:
    """Frames of a dataset that is being collected, drawn as its episodes become known: ``collect.Pictures``."""

    def __init__(
        self,
        spec: DatasetSpec,
        rows_per_picture: int,
        resolution: tuple[int, int] | None,
        store: Store,
        folder: Path,
    ) -> None:
        """
        Args:
            rows_per_picture: k: the rows 0, k, 2k … of each episode have pictures.
            resolution: rows and columns; None: as in the dataset.
            folder: empty, on the store's file system; frames are moved from there into the store.
        """
        self._every, self._folder = rows_per_picture, folder
        shapes = {key: spec.features[key].shape for key in spec.keys("video")}
        self._frames = {
            key: resolution or (shape[0], shape[1]) for key, shape in shapes.items()
        }
        self._size, self._resolution = (
            next((shape[0], shape[1]) for shape in shapes.values()),
            resolution,
        )
        self._known = _rendered_before(store, FramesConfig(resolution))
        self._items: list[_Item] = []
        self._made_of: list[str] = []

    def add(self, demonstration: Artefact, rows: int) -> "_Piece":
        """Reserve the frames of the next episode, whose attempt is ``demonstration``. Returns the function that renders them."""
        first = (
            self._items[-1].first_frame + self._items[-1].num_frames
            if self._items
            else 0
        )
        known = self._known.get((demonstration.digest, self._every))
        item = _Item(len(self._items), first, -(-rows // self._every), known)
        self._items.append(item)
        self._made_of.append(demonstration.digest)
        return _Piece(
            item, self._folder, self._frames, self._size, self._resolution, self._every
        )

    def are_of(self, root: Path, index: FrameIndex) -> bool:
        """Whether these are the frames of the dataset at ``root``, all of them, in its order."""
        frames = [item.num_frames for item in self._items]
        return (
            self._made_of == _attempts(root)
            and frames == index.frames_E.tolist()
            and bool(frames)
        )

    def move(self, out_dir: Path, progress: Callable[[str], None]) -> None:
        """Move the files into ``out_dir``, where they are as those of ``empty_frames``."""
        num_frames = self._items[-1].first_frame + self._items[-1].num_frames
        for key, size in self._frames.items():
            path = frames_file(self._folder, key)
            with path.open("r+b") as file:
                shape = {
                    "descr": "|u1",
                    "fortran_order": False,
                    "shape": (num_frames, 3, *size),
                }
                np.lib.format.write_array_header_1_0(file, shape)
                assert file.tell() == _HEADER_BYTES
            path.rename(frames_file(out_dir, key))
        for item in self._items:
            progress(f"{item} of {len(self._items)}: {item.done}")


_HEADER_BYTES = 128
"""Size of the header of a .npy file of frames: it is padded to a multiple of 64."""


@dataclass(frozen=True)
class _Piece:
    """Draws one episode into the files of ``DrawnFrames``, whose length need not be known yet."""

    item: "_Item"
    folder: Path
    frames: dict[str, tuple[int, int]]
    """Camera → rows and columns of its frames."""
    size: tuple[int, int]
    """Rows and columns of the dataset's pictures."""
    resolution: tuple[int, int] | None
    rows_per_picture: int

    def __call__(self, sim: Simulation, states: np.ndarray) -> None:
        arrays = {key: self._opened(key) for key in self.frames}
        if self.item.known is None:
            _draw(
                sim,
                states[:: self.rows_per_picture],
                self.size,
                self.resolution,
                arrays,
            )
        else:
            _copy(self.item.known, arrays)

    def _opened(self, key: str) -> np.memmap:
        """The episode's part of a camera's file. Space is reserved first, as by ``empty_frames``."""
        path, shape = (
            frames_file(self.folder, key),
            (self.item.num_frames, 3, *self.frames[key]),
        )
        size = math.prod(shape)
        begin = _HEADER_BYTES + size // self.item.num_frames * self.item.first_frame
        with os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o644), "r+b") as file:
            os.posix_fallocate(file.fileno(), begin, size)
        return np.memmap(path, np.uint8, mode="r+", offset=begin, shape=shape)


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
    inputs = (
        manifest["inputs"] if manifest and manifest["stage"] in DATASET_STAGES else []
    )
    return [entry["digest"] for entry in inputs]


def _rendered_before(
    store: Store, config: FramesConfig
) -> dict[tuple[str, int], _Place]:
    """(digest of an attempt, rows per picture) → its frames at this resolution. Only of datasets that are still there, as they
    were."""
    found: dict[tuple[str, int], _Place] = {}
    now = {
        name: version
        for name, version in software().items()
        if name in ("mujoco", "taccorl")
    }
    for folder in store.artefacts():
        manifest = read_manifest(folder) if folder.parent.name == FRAMES.name else {}
        if not manifest or (manifest["config"], manifest["stage_version"]) != (
            canonical(config),
            FRAMES.version,
        ):
            continue
        if any(
            manifest["software"].get(name) != version for name, version in now.items()
        ):
            continue  # it may have drawn other pictures
        root = Path(manifest["inputs"][0]["path"])
        made_of = _attempts(root) if root.is_dir() else []
        if (
            made_of
            and store.source(root).digest == manifest["inputs"][0]["digest"]
            and not store.damaged(folder)
        ):
            dataset = Dataset(root)
            first, every = (
                FrameIndex.of_dataset(dataset).first_frames_E.tolist(),
                dataset.rows_per_picture,
            )
            found |= {
                (key, every): _Place(folder, first[i]) for i, key in enumerate(made_of)
            }
    return found


def _fill_episode(
    root: Path, out_dir: Path, resolution: tuple[int, int] | None, item: _Item
) -> dict[str, float]:
    """Write every frame of an episode; returns the seconds of rendering and of resizing and writing, none if copied."""
    arrays = {}
    for path in out_dir.glob("*.npy"):
        frames = np.load(path, mmap_mode="r+")
        arrays[path.stem] = frames[item.first_frame :][: item.num_frames]
    if item.known is not None:
        _copy(item.known, arrays)
        return {}
    dataset, sim = _opened(root)
    states = dataset.values(item.index, ["sim.state"])["sim.state"][
        :: dataset.rows_per_picture
    ]
    shape = dataset.info["features"][_cameras(dataset)[0]]["shape"]
    return _draw(sim, states, (shape[0], shape[1]), resolution, arrays)


def _copy(known: _Place, arrays: Mapping[str, np.ndarray]) -> None:
    for key, here in arrays.items():
        there = np.load(frames_file(known.folder, key), mmap_mode="r")
        here[:] = there[known.first_frame :][: len(here)]


def _draw(
    sim: Simulation,
    states: np.ndarray,
    size: tuple[int, int],
    resolution: tuple[int, int] | None,
    arrays: Mapping[str, np.ndarray],
) -> dict[str, float]:
    """Draw ``states`` (F, row_size) into camera → (F, 3, rows, columns); returns the seconds of the parts of the work."""
    if multiprocessing.parent_process() is not None:
        torch.set_num_threads(1)  # as many workers as cores
    spent = {"rendering": 0.0, "resizing and writing": 0.0}
    for first in range(0, len(states), DRAWN_TOGETHER):
        began_s = time.perf_counter()
        part = states[first : first + DRAWN_TOGETHER]
        shown = sim.draw_states(
            part, [key.removeprefix(PICTURE) for key in arrays], size
        )
        rendered_s = time.perf_counter()
        for key, frames in arrays.items():
            frames[first : first + len(part)] = resized(
                shown[key.removeprefix(PICTURE)], resolution
            )
        spent["rendering"] += rendered_s - began_s
        spent["resizing and writing"] += time.perf_counter() - rendered_s
    return spent


def _cameras(dataset: Dataset) -> list[str]:
    """Raises DatasetError: nothing to render, or nothing to render it from."""
    features = dataset.info["features"]
    cameras = [key for key, f in features.items() if f["dtype"] == "video"]
    if not cameras or "sim.state" not in features:
        raise DatasetError(
            f"{dataset.root}: has {len(cameras)} cameras and {'' if 'sim.state' in features else 'no '}sim.state: frames can "
            "be rendered only for datasets of the twin with both: taccorl collect --pictures=cache"
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
            raise DatasetError(
                f"{root}: does not state in which twin it was made; make it with taccorl collect"
            )
        _open[root] = dataset, make_simulation(told)
    return _open[root]
