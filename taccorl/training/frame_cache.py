"""Cache of decoded pictures of a dataset: uint8 at the policy's resolution, in the store, on the GPU or in memory.

Decoding a video for every row that is drawn limits training to some hundred rows a second and core. Here each frame is decoded
once, by the stage ``frames``, into one file a camera that is memory-mapped. Its key is made of the dataset's content, the
resolution and the stage's version, so that another dataset or resolution is another artefact, and runs share it.

A dataset without videos may have a picture only for every k-th row of an episode, from its first row on: consecutive pictures
differ little, and memory limits the number of episodes (``Dataset.rows_per_picture``).

Letters in shapes: N rows of the dataset, F frames of a camera, B rows of a batch, E episodes.
"""

import errno
import logging
import math
import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, get_args

import av
import cv2
import numpy as np
import torch
from av.error import FFmpegError
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from torch import Tensor

from taccorl.data.dataset import DATASET_STAGES, Dataset
from taccorl.errors import DatasetError, TaccorlError, nearest
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.stage import Stage
from taccorl.lineage.store import Store
from taccorl.policies.tactile_pi05.black_bars import without_bars

Place = Literal["none", "disk", "host", "gpu"]
"""Where cached frames are held: nowhere, in a file, in main memory or on the GPU."""
PLACES: tuple[Place, ...] = get_args(Place)
SHARE_OF_FREE = 0.8
"""Largest share of the free memory that the cache takes; training needs the rest."""
AT_ONCE = 64
"""Number of frames that are resized together."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CacheRequest:
    """Options for cached frames: their place (gpu, host, disk), resolution and store."""

    place: Place
    """``none``, ``disk``, ``host`` (main memory) or ``gpu``."""
    resolution: tuple[int, int] | None
    """Rows and columns of cached frames; None: as in the dataset."""
    store: Path
    """Folder of the store."""
    device: str
    """Torch device of the policy: ``cpu``, ``cuda`` or ``cuda:0``."""

    def __post_init__(self) -> None:
        """Raises TaccorlError: the place is not one of gpu, host, disk."""
        if self.place not in PLACES:
            raise TaccorlError(
                f"--dataset.cache={self.place}: {nearest(self.place, PLACES)}"
            )


def cache_request(cfg: Any) -> CacheRequest | None:
    """Cache request from the options of a training. Raises TaccorlError: --dataset.cache names none of its places, or another
    option cannot be combined with a cache."""
    if getattr(cfg.dataset, "cache", "none") == "none":
        return None
    policy = cfg.trainable_config
    if cfg.dataset.streaming:
        raise TaccorlError(
            f"--dataset.cache={cfg.dataset.cache} cannot be combined with --dataset.streaming=true; remove one of them"
        )
    if cfg.dataset.image_transforms.enable:
        raise TaccorlError(
            f"--dataset.cache={cfg.dataset.cache}: --dataset.image_transforms.enable=true changes pictures one by one on the "
            "CPU; remove it, because tactile_pi05 changes whole batches (--policy.image_randomization)"
        )
    resolution = getattr(policy, "image_resolution", None)
    return CacheRequest(
        place=cfg.dataset.cache,
        resolution=tuple(resolution) if resolution else None,
        store=Path(cfg.dataset.cache_store),
        device=str(policy.device),
    )


@dataclass(frozen=True)
class FramesConfig:
    """Configuration of the stage ``frames``."""

    resolution: tuple[int, int] | None
    """Rows and columns of the frames; None: as in the dataset."""


@dataclass(frozen=True)
class FrameIndex:
    """Frames of a dataset's rows: the rows 0, k, 2k … of each episode have one."""

    lengths_E: np.ndarray
    """(E,) number of rows of each episode."""
    rows_per_picture: int
    """k."""

    @classmethod
    def of_dataset(cls, dataset: Dataset) -> "FrameIndex":
        """Make the index of a dataset's frames."""
        lengths = [dataset.num_rows(i) for i in range(dataset.num_episodes)]
        return cls(np.array(lengths, dtype=np.int64), dataset.rows_per_picture)

    @property
    def frames_E(self) -> np.ndarray:
        """(E,) number of frames of each episode: ⌈T / k⌉."""
        return -(-self.lengths_E // self.rows_per_picture)

    @property
    def first_frames_E(self) -> np.ndarray:
        """(E,) index of each episode's first frame."""
        return np.cumsum(self.frames_E) - self.frames_E

    @property
    def num_frames(self) -> int:
        """F."""
        return int(self.frames_E.sum())

    def of_rows(self) -> np.ndarray:
        """(N,) int64 frame of each row: that of the last row with a picture that is not after it."""
        lengths_E = self.lengths_E
        step_N = np.arange(lengths_E.sum()) - np.repeat(
            np.cumsum(lengths_E) - lengths_E, lengths_E
        )
        return (
            np.repeat(self.first_frames_E, lengths_E) + step_N // self.rows_per_picture
        )


def _write_frames(config: FramesConfig, inputs: list[Path], out_dir: Path) -> None:
    meta, k = (
        LeRobotDatasetMetadata("local/dataset", root=inputs[0]),
        Dataset(inputs[0]).rows_per_picture,
    )
    if k > 1:
        raise DatasetError(
            f"{inputs[0]}: states {k} rows for each picture and has videos, which have a frame for every row: remove "
            "rows_per_picture from its meta/info.json"
        )
    files: dict[tuple[str, Path], list[int]] = {}
    for key in meta.video_keys:
        for episode in range(meta.total_episodes):
            files.setdefault(
                (key, inputs[0] / meta.get_video_file_path(episode, key)), []
            ).append(episode)
    out_dir.mkdir(parents=True, exist_ok=True)
    arrays = {
        key: empty_frames(
            out_dir,
            key,
            meta.total_frames,
            config.resolution or tuple(meta.features[key]["shape"][:2]),
        )
        for key in meta.video_keys
    }
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = [
            pool.submit(
                _decode, arrays[key], path, meta, key, episodes, config.resolution
            )
            for (key, path), episodes in files.items()
        ]
        for job in jobs:
            job.result()
    for array in arrays.values():
        array.flush()


FRAMES = Stage(name="frames", fn=_write_frames, version=1)
"""Stage that decodes the frames of a dataset; its artefact holds one ``frames_file`` per camera."""


def frames_file(folder: Path, key: str) -> Path:
    """Path of a camera's frames in the artefact ``folder``: a .npy file, (F, 3, rows, columns) uint8. ``key`` is the camera's."""
    return folder / f"{key}.npy"


def empty_frames(
    folder: Path, key: str, num_frames: int, resolution: tuple[int, int]
) -> np.memmap:
    """Create a camera's file of frames, filled with zeros, as a writable memory map (num_frames, 3, rows, columns) uint8.
    Raises OSError: the disk is too full for it. Space is reserved first: writing to a map without space kills the process
    (SIGBUS)."""
    path, shape = frames_file(folder, key), (num_frames, 3, *resolution)
    size = math.prod(shape)
    full = f"{os.strerror(errno.ENOSPC)} ({size / 1e9:.2f} GB of frames)"
    if size > shutil.disk_usage(folder).free:
        raise OSError(errno.ENOSPC, full, str(path))
    array = np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=shape)
    try:
        with path.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    except OSError as error:
        path.unlink()  # what was reserved fills the disk
        raise OSError(error.errno, full, str(path)) from error
    return array


def _decode(
    out: np.ndarray,
    path: Path,
    meta: LeRobotDatasetMetadata,
    key: str,
    episodes: Sequence[int],
    resolution: tuple[int, int] | None,
) -> None:
    """Every frame of ``episodes`` in one file, each into its row of ``out`` (N, 3, rows, columns). Raises DatasetError: fewer
    or more frames in the file than rows."""
    rows, times_s = [], []
    for k in episodes:
        episode: Any = meta.episodes[k]  # pyright: ignore[reportOptionalSubscript]
        first, last = (
            int(episode["dataset_from_index"]),
            int(episode["dataset_to_index"]),
        )
        begin_s = float(episode[f"videos/{key}/from_timestamp"])
        rows += range(first, last)
        times_s += [begin_s + t / meta.fps for t in range(last - first)]
    order = np.argsort(times_s, kind="stable")
    rows, times_s = np.asarray(rows)[order], np.asarray(times_s)[order]
    done, waiting = 0, []
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"
            step_s = float(stream.time_base or Fraction(0))
            for frame in container.decode(stream):
                if done + len(waiting) == len(rows) or frame.pts is None:
                    continue
                if (
                    abs(frame.pts * step_s - times_s[done + len(waiting)])
                    > 0.5 / meta.fps
                ):
                    continue  # of an episode that the dataset no longer has
                waiting.append(frame.to_ndarray(format="rgb24"))
                if len(waiting) == AT_ONCE:
                    out[rows[done : done + len(waiting)]] = resized(
                        np.stack(waiting), resolution
                    )
                    done, waiting = done + len(waiting), []
    except (FFmpegError, OSError, IndexError) as error:
        raise DatasetError(
            f"{path}: cannot be decoded ({error}): copy the dataset again, or make it again (taccorl check gives details)"
        ) from error
    if waiting:
        out[rows[done : done + len(waiting)]] = resized(np.stack(waiting), resolution)
    if done + len(waiting) != len(rows):
        at = done + len(waiting)
        raise DatasetError(
            f"{path}: {at} of its {len(rows)} frames exist, and none at {times_s[at]:.3f} s; make the dataset again (taccorl "
            "check gives details)"
        )


def resized(pictures: np.ndarray, resolution: tuple[int, int] | None) -> np.ndarray:
    """Resize ``pictures`` (B, rows, columns, 3) uint8 → (B, 3, *resolution) uint8, as the policy does, rounded to whole values.

    ``resolution`` is (rows, columns); None: only the axes change. Raises TaccorlError: they are square, ``resolution`` is
    not, and their bars are not black (``without_bars``)."""
    pictures = without_bars(pictures, resolution, "frames", channels_last=True)
    if resolution is None or pictures.shape[1:3] == tuple(resolution):
        return pictures.transpose(0, 3, 1, 2)
    if pictures.shape[1:3] == (2 * resolution[0], 2 * resolution[1]):
        # Means of four values: twenty times faster in whole numbers.
        size = resolution[1], resolution[0]
        halved = [
            cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            for picture in pictures
        ]
        return np.stack(halved).transpose(0, 3, 1, 2)
    small = resize_with_pad_torch(
        torch.from_numpy(pictures).to(torch.float32) / 255, *resolution
    )
    return (
        (small * 255).round().clamp(0, 255).to(torch.uint8).permute(0, 3, 1, 2).numpy()
    )


class Frames:
    """Frames of a dataset in the requested place.

    Args:
        arrays: camera → (F, 3, rows, columns) uint8.
        numbers_bytes: memory that the dataset's numbers take beside the frames.

    Frames that do not fit on the GPU are held in main memory, and on disk if they do not fit there; the log states it.
    """

    def __init__(
        self,
        arrays: dict[str, np.ndarray],
        place: Place,
        device: str,
        numbers_bytes: int = 0,
    ) -> None:
        needed = sum(array.nbytes for array in arrays.values()) + numbers_bytes
        self.place = _fitting(place, needed, device)
        self.device = torch.device(device if self.place == "gpu" else "cpu")
        self.tensors: dict[str, Tensor] = {}
        for key, array in arrays.items():
            if self.place == "disk":
                self.tensors[key] = torch.from_numpy(array)
                continue
            held = torch.empty(array.shape, dtype=torch.uint8, device=self.device)
            for first in range(0, len(array), 4096):  # never twice as much in memory
                held[first : first + 4096] = torch.from_numpy(
                    np.array(array[first : first + 4096])
                )
            self.tensors[key] = held

    def at(self, frames_B: Tensor) -> dict[str, Tensor]:
        """Camera → (B, 3, rows, columns) uint8 frames with the indices ``frames_B`` (int64, from 0)."""
        return {key: frames[frames_B] for key, frames in self.tensors.items()}


def require_frames(
    root: Path, resolution: tuple[int, int] | None, store: Store
) -> None:
    """Check, without decoding, that the frames of the dataset at ``root`` are in the store or can be decoded. Raises
    DatasetError: the dataset has no videos, and the store has no frames of it at this resolution."""
    found = Dataset(root)
    if (
        found.unstored
        and store.find(FRAMES, FramesConfig(resolution), [store.dataset(root)]) is None
    ):
        raise DatasetError(
            f"{root}: has no videos of {', '.join(found.unstored)}, and {store.root} has no frames of it at "
            f"{_size(resolution)}: {_command(root, found)}{_option(resolution)} --store={store.root} makes them; "
            "--dataset.cache_store= of lerobot-train names another store"
        )


def stored_frames(root: Path, resolution: tuple[int, int] | None, store: Store) -> Path:
    """Return the folder with the frames of the dataset at ``root``, one ``frames_file`` for each camera; they are decoded if
    they are not in the store. ``resolution``: rows and columns; None: as in the dataset. Raises DatasetError: a video is
    damaged or missing; or as ``require_frames``."""
    dataset, config = store.dataset(root), FramesConfig(resolution)
    if store.find(FRAMES, config, [dataset]) is None:
        require_frames(root, resolution, store)
        info = Dataset(root).info
        cameras = [key for key, f in info["features"].items() if f["dtype"] == "video"]
        _log.info(
            "decoding %d frames of %s into %s, once",
            int(info["total_frames"]) * len(cameras),
            root,
            store.root,
        )
    return store.run(FRAMES, config, [dataset]).path


def require_joinable(
    parts: Sequence[Path], resolution: tuple[int, int] | None, store: Store
) -> None:
    """Check, before anything is written, that ``join_frames`` can join the frames of the datasets ``parts``. Raises
    DatasetError: as ``require_frames``, or the datasets have pictures of different shares of their rows."""
    every = {part: Dataset(part).rows_per_picture for part in parts}
    if len(set(every.values())) > 1:
        listed = ", ".join(f"{part}: {k}" for part, k in every.items())
        raise DatasetError(
            f"the datasets differ in the number of rows for each picture ({listed}): make them with the same "
            "--rows_per_picture; datasets with videos have 1"
        )
    for part in parts:
        require_frames(part, resolution, store)


def join_frames(
    root: Path, parts: Sequence[Path], resolution: tuple[int, int] | None, store: Store
) -> Path:
    """Store the frames of the merged dataset at ``root``: those of ``parts`` one after the other. Returns the folder.
    ``parts``: the datasets whose rows it holds, in this order; frames of those with videos are decoded. Raises DatasetError:
    as ``stored_frames``."""

    def write(config: FramesConfig, inputs: list[Path], out_dir: Path) -> None:
        dataset = Dataset(inputs[0])
        folders = [stored_frames(part, config.resolution, store) for part in parts]
        for key in dataset.unstored:
            joined, first = None, 0
            for folder in folders:
                frames = np.load(frames_file(folder, key), mmap_mode="r")
                if joined is None:
                    joined = empty_frames(
                        out_dir,
                        key,
                        FrameIndex.of_dataset(dataset).num_frames,
                        frames.shape[2:],
                    )
                for begin in range(0, len(frames), 4096):
                    piece = frames[begin : begin + 4096]
                    joined[first + begin :][: len(piece)] = piece
                first += len(frames)
            assert joined is not None and first == len(joined), "a frame for each row"
            joined.flush()

    return store.run(
        FRAMES.bound(write), FramesConfig(resolution), [store.dataset(root)]
    ).path


def open_frames(
    request: CacheRequest,
    root: Path,
    cameras: Sequence[str],
    index: FrameIndex,
    numbers_bytes: int,
) -> Frames:
    """Open the frames of the dataset at ``root``; they are decoded if they are not in the store.

    Args:
        cameras: keys of the picture features.
        index: frames that the dataset must have.
        numbers_bytes: memory that the dataset's numbers take beside the frames.

    Raises:
        DatasetError: a video is damaged, or the number of frames differs from that of rows.
    """
    arrays: dict[str, np.ndarray] = {}
    if cameras:
        folder = stored_frames(root, request.resolution, Store(request.store))
        for key in cameras:
            arrays[key] = np.load(frames_file(folder, key), mmap_mode="c")
            if len(arrays[key]) != index.num_frames:
                raise DatasetError(
                    f"{frames_file(folder, key)}: {len(arrays[key])} frames, but the dataset {root} has {index.num_frames}: "
                    f"one for every {index.rows_per_picture} of its {index.lengths_E.sum()} rows. Remove {folder}; the next run "
                    "writes them again"
                )
    return Frames(arrays, request.place, request.device, numbers_bytes)


def _command(root: Path, dataset: Dataset) -> str:
    """The command that stores frames of a dataset without videos."""
    if "observation.is_sim" in dataset.info["features"]:
        words = "merge --real=… --sim=…"
    else:
        words = (
            DATASET_STAGES.get(read_manifest(root).get("stage", ""), "collect") + " …"
        )
    return f"taccorl {words} --out={root} --pictures=cache"


def _size(resolution: tuple[int, int] | None) -> str:
    return (
        "the size that the dataset states"
        if resolution is None
        else f"{resolution[0]}×{resolution[1]} pixels"
    )


def _option(resolution: tuple[int, int] | None) -> str:
    return (
        "" if resolution is None else f" --resolution={resolution[0]}x{resolution[1]}"
    )


def _fitting(place: Place, needed: int, device: str) -> Place:
    """``place``, or the next one with room for ``needed`` bytes."""
    if place == "gpu" and not device.startswith("cuda"):
        _log.warning(
            "--dataset.cache=gpu: --policy.device=%s is not a GPU; frames are kept in main memory",
            device,
        )
        place = "host"
    if place == "gpu":
        free = torch.cuda.mem_get_info(device)[0]
        if needed > SHARE_OF_FREE * free:
            _log.warning(_too_large("gpu", needed, free, "held in memory"))
            place = "host"
    if place == "host":
        free = _free_memory_bytes()
        if needed > SHARE_OF_FREE * free:
            _log.warning(_too_large("host", needed, free, "read from disk"))
            place = "disk"
    return place


def _too_large(place: str, needed: int, free: int, instead: str) -> str:
    return (
        f"--dataset.cache={place}: frames and numbers need {needed / 1e9:.2f} GB, {free / 1e9:.2f} GB are free, of which "
        f"{SHARE_OF_FREE:.0%} may be taken; they are {instead}. They would fit with pictures of "
        f"{(SHARE_OF_FREE * free / needed) ** 0.5:.0%} of the side (--policy.image_resolution), or fewer episodes"
    )


def _free_memory_bytes() -> int:
    for line in (
        Path("/proc/meminfo").read_text().splitlines()
        if Path("/proc/meminfo").exists()
        else []
    ):
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
