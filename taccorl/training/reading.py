"""LeRobot's dataset reader, faster and with windows of touch; installed by ``taccorl.lerobot_plugin``.

LeRobot 0.6.1 makes Python lists of every column of every row that a window or an action chunk names (dataset_reader.py,
``_query_hf_dataset``), opens a video anew for every picture where torchcodec finds no FFmpeg (video_utils.py), and gives a
window to all observations or to none (factory.py, ``resolve_delta_timestamps``). Here rows are read from the requested Arrow
columns, videos stay open, and a policy's ``window_delta_indices`` names the features that get a window. The result has the same
bits and types; tests compare them. With ``--dataset.cache=gpu|host|disk`` whole batches are gathered from numbers and decoded
frames (``frame_cache``) instead of row by row.

With ``TACCORL_NO_PATCH=1``, or with a version of LeRobot other than the tested one, LeRobot is not changed.
"""

import bisect
import contextlib
import dataclasses
import logging
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from lerobot import __version__ as lerobot_version
from lerobot.configs.default import DatasetConfig
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.processor import DataProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map

from taccorl.data.dataset import Dataset
from taccorl.data.finding import recompute_statistics
from taccorl.errors import DatasetError
from taccorl.lineage.manifest import (
    CHECKPOINT,
    MANIFEST_PLACES,
    is_verified,
    read_manifest,
    seal_checkpoint,
)
from taccorl.policies.tactile_pi05.chunk_steps import STEP_STATISTICS
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.policies.tactile_pi05.mixture import IS_SIM
from taccorl.policies.tactile_pi05.weights import ADAPTER, WEIGHTS
from taccorl.training.frame_cache import (
    CacheRequest,
    FrameIndex,
    Frames,
    cache_request,
    open_frames,
)
from taccorl.training.video_backend import OPEN_VIDEOS, default_video_backend

COMPARED_VERSION = "0.6.1"
"""Version of LeRobot with which the results of this reader were compared."""
RELATIVE = "--operation.relative_action=true"
"""Option of LeRobot's ``recompute_stats``."""
SIMULATOR = "sim."
"""Beginning of the keys that only a simulator has. No policy reads them, so that the cache leaves them out."""
_log = logging.getLogger(__name__)


def install() -> bool:
    """Make LeRobot create its datasets with ``FastReader``. Further calls change nothing. Returns False if LeRobot was not
    changed."""
    from lerobot.datasets import factory, lerobot_dataset, video_utils

    if os.environ.get("TACCORL_NO_PATCH") == "1":
        _log.warning(
            "TACCORL_NO_PATCH=1: LeRobot reads datasets by itself: 5 to 20 times slower, touch without its history "
            "(--policy.tactile_history=1), relative actions only after `%s`, and α takes the share of simulated rows of the "
            "whole dataset even where --dataset.episodes takes a part of it",
            recompute_statistics(Path("DATASET"), RELATIVE),
        )
        return False
    if lerobot_version != COMPARED_VERSION:
        _log.warning(
            "LeRobot %s reads datasets by itself: taccorl's faster reader was compared with %s only. Touch comes without its "
            "history (--policy.tactile_history=1), relative actions with statistics of absolute ones; pip install lerobot==%s "
            "has all",
            lerobot_version,
            COMPARED_VERSION,
            COMPARED_VERSION,
        )
        return False
    for module in (lerobot_dataset, video_utils):
        module.get_safe_default_video_backend = default_video_backend  # pyright: ignore[reportAttributeAccessIssue]
    if lerobot_dataset.DatasetReader is not FastReader:
        lerobot_dataset.DatasetReader = FastReader
        factory.resolve_delta_timestamps = with_windows(
            factory.resolve_delta_timestamps
        )
        factory.StreamingLeRobotDataset = streamed(factory.StreamingLeRobotDataset)
        factory.make_dataset = with_cache(factory.make_dataset)
        lerobot_dataset.LeRobotDataset.__getitems__ = whole_batch  # pyright: ignore[reportAttributeAccessIssue]
        default_collate_fn_map[WholeBatch] = lambda batch, **_: batch[0]
        DataProcessorPipeline._save_pretrained = with_digests(
            DataProcessorPipeline._save_pretrained
        )
    add_cache_options()
    return True


def with_digests(save: Callable[..., None]) -> Callable[..., None]:
    """LeRobot's ``_save_pretrained`` of processors, which it writes last: their digests are added to a policy's or adapter's."""

    def save_with_digests(self: Any, save_directory: Path, **kwargs: Any) -> None:
        save(self, save_directory, **kwargs)
        if (
            read_manifest(save_directory).get("stage") == CHECKPOINT
            or (save_directory / ADAPTER).is_file()
        ):
            seal_checkpoint(save_directory, keep=[WEIGHTS])

    return save_with_digests


def add_cache_options() -> None:
    """Add ``--dataset.cache`` and ``--dataset.cache_store`` to LeRobot's options of a dataset; the default of
    ``--dataset.video_backend`` becomes ``default_video_backend``."""
    if "cache" in {f.name for f in dataclasses.fields(DatasetConfig)}:
        return
    # none, disk, host or gpu: decode every frame once, at the policy's resolution, and gather whole batches.
    for f in dataclasses.fields(
        DatasetConfig
    ):  # once made, a dataclass has lost its default factories
        if f.default_factory is not dataclasses.MISSING:
            default = (
                default_video_backend
                if f.name == "video_backend"
                else f.default_factory
            )
            setattr(DatasetConfig, f.name, dataclasses.field(default_factory=default))
    for name in (
        "__init__",
        "__repr__",
        "__eq__",
        "__match_args__",
    ):  # nor does it make again what it has made
        delattr(DatasetConfig, name)
    DatasetConfig.__annotations__ |= {"cache": str, "cache_store": str}
    DatasetConfig.cache, DatasetConfig.cache_store = "none", "outputs/store"  # pyright: ignore[reportAttributeAccessIssue]
    dataclasses.dataclass(DatasetConfig)


_requested: CacheRequest | None = None
"""Request of the training that is being created, stored here because LeRobot passes no options of a dataset to its readers."""


_reads_pictures = True
"""Also of the training that is being created. False: the policy has no cameras (``--policy.pictures=false``), so that no frame
is decoded or cached."""


def with_cache(make_dataset: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """LeRobot's ``make_dataset``, with the reader set up for ``--dataset.cache``; a dataset without a camera of the checkpoint is
    refused."""

    def make_with_cache(cfg: Any) -> Any:
        global _requested, _reads_pictures
        _requested = cache_request(cfg)
        _reads_pictures = getattr(cfg.trainable_config, "pictures", True)
        if _requested is not None and cfg.num_workers:
            _log.info(
                "--dataset.cache=%s: batches are gathered by the training's own process",
                _requested.place,
            )
            cfg.num_workers = 0
        dataset, policy = make_dataset(cfg), cfg.trainable_config
        if isinstance(policy, TactilePI05Config):
            policy.resumed = bool(getattr(cfg, "resume", False))
        if isinstance(policy, TactilePI05Config) and policy.pretrained_path:
            policy.match_cameras(dataset.meta, cfg.rename_map or {})
        return dataset

    return make_with_cache


class WholeBatch(dict):
    """A collated batch (key → tensor with B rows), as LeRobot's loader returns it."""

    def pin_memory(self) -> "WholeBatch":
        """Pin the tensors that are on the CPU."""
        pinned = {
            k: v.pin_memory()
            for k, v in self.items()
            if isinstance(v, Tensor) and v.device.type == "cpu"
        }
        return WholeBatch({**self, **pinned})


def whole_batch(dataset: Any, rows: list[int]) -> list[Any]:
    """Replacement for ``LeRobotDataset.__getitems__``: a list with one ``WholeBatch`` if frames are cached, else a list with the
    item of each of ``rows`` (indices in the dataset)."""
    dataset.hf_dataset  # loads it  # noqa: B018
    batch = (
        dataset.reader.batch(rows) if isinstance(dataset.reader, FastReader) else None
    )
    return [dataset[row] for row in rows] if batch is None else [batch]


def with_windows(
    resolve: Callable[[Any, Any], dict[str, list] | None],
) -> Callable[[Any, Any], dict[str, list] | None]:
    """Return ``resolve``, LeRobot's ``resolve_delta_timestamps``, extended by a policy's ``window_delta_indices`` (feature →
    offsets of rows)."""

    def resolve_with_windows(cfg: Any, ds_meta: Any) -> dict[str, list] | None:
        deltas = Deltas(resolve(cfg, ds_meta) or {})
        if getattr(cfg, "use_relative_actions", False):
            action = ds_meta.features[ACTION]
            names, size = action["names"] or (), action["shape"][0]
            absolute = [
                str(word).lower() for word in cfg.relative_exclude_joints if word
            ]
            if absolute and isinstance(names, dict):
                _log.warning(
                    "dataset %s: its actions have grouped names, %s, in which LeRobot finds no joint: all %d actions are made "
                    "relative, those of %s too; write the names as a list in meta/info.json",
                    *(ds_meta.repo_id, names, size, ", ".join(absolute)),
                )
            stay = [
                any(word in str(name).lower() for word in absolute) for name in names
            ]
            # Of actions without a name LeRobot makes relative ones; of groups it sees the keys.
            deltas.relative_actions = [
                not (k < len(stay) and stay[k]) for k in range(size)
            ]
        if isinstance(cfg, TactilePI05Config):
            for key, indices in cfg.window_delta_indices(ds_meta.features).items():
                deltas[key] = [index / ds_meta.fps for index in indices]
        return deltas or None

    return resolve_with_windows


def streamed(make: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``make``, which creates LeRobot's ``StreamingLeRobotDataset`` (that does not use our reader), with a warning about
    its statistics of relative actions."""

    def make_streamed(*args: Any, **kwargs: Any) -> Any:
        windows = (
            v
            for v in (*args, *kwargs.values())
            if isinstance(v, Deltas) and v.relative_actions
        )
        if deltas := next(windows, None):
            root, repo_id = kwargs.get("root"), kwargs.get("repo_id") or args[0]
            words = RELATIVE, f"--operation.chunk_size={len(deltas[ACTION])}"
            _log.warning(
                "--dataset.streaming=true: relative actions are normalised by the action statistics that the dataset %s was "
                "written with, as LeRobot does it. Those of taccorl's commands are of absolute actions, several times wider: "
                "leave streaming out%s",
                root or repo_id,
                f", or run `{recompute_statistics(Path(root).resolve(), *words)}` first"
                if root
                else "",
            )
        return make(*args, **kwargs)

    return make_streamed


class Deltas(dict):
    """LeRobot's ``delta_timestamps``, passed to the reader unchanged, with the actions that are relative."""

    relative_actions: list[bool] | None = None
    """For each element of an action: whether the policy learns it relative to the state. None: none is relative."""


class Column:
    """One column of a table as NumPy views of its Arrow chunks; nothing is copied before a row is requested."""

    def __init__(self, column: pa.ChunkedArray) -> None:
        """Raises TypeError: the column does not hold numbers, or some are missing."""
        kind = column.type
        self.shape: tuple[int, ...] = ()
        if pa.types.is_fixed_size_list(kind):
            self.shape, kind = (kind.list_size,), kind.value_type
        elif isinstance(kind, pa.ExtensionType) and hasattr(
            kind, "shape"
        ):  # of the datasets library: lists in lists
            self.shape, kind = tuple(kind.shape), kind.storage_type
            for _ in self.shape:
                kind = kind.value_type
        size = math.prod(self.shape)
        if (
            not (pa.types.is_integer(kind) or pa.types.is_floating(kind))
            or column.null_count
        ):
            raise TypeError(f"a column of {column.type}")
        self._pieces, self._starts, start = [], [], 0
        for chunk in column.chunks:
            if len(chunk):
                numbers = getattr(chunk, "storage", chunk)
                for _ in self.shape:
                    numbers = numbers.flatten()
                if len(numbers) != len(chunk) * size:
                    raise TypeError(
                        f"a column of {column.type} whose rows differ in size"
                    )
                self._pieces.append(
                    numbers.to_numpy(zero_copy_only=True).reshape(len(chunk), size)
                )
                self._starts.append(start)
                start += len(chunk)
        # As LeRobot's own way through Python's numbers makes them.
        self._dtype = np.int64 if pa.types.is_integer(kind) else np.float32
        self.kind = torch.int64 if pa.types.is_integer(kind) else torch.float32

    def stored(self) -> Tensor:
        """Values of all rows, (N, *shape), in the file's data type: int16 touch needs a quarter of the memory of ``rows``."""
        pieces = np.concatenate(self._pieces) if self._pieces else np.empty((0, 1))
        if pieces.dtype.kind == "f" and pieces.itemsize > 4:
            pieces = pieces.astype(np.float32)
        return torch.from_numpy(pieces).reshape(len(pieces), *self.shape)

    def rows(self, rows: list[int]) -> Tensor:
        """Values of these rows (indices from 0), (len(rows), *shape), int64 or float32."""
        found = []
        for row in rows:
            piece = bisect.bisect_right(self._starts, row) - 1
            found.append(self._pieces[piece][row - self._starts[piece]])
        return torch.from_numpy(np.stack(found).astype(self._dtype)).reshape(
            len(rows), *self.shape
        )


_warned: set[Path] = set()


def _warn_unverified(root: Path) -> None:
    """Say once that nobody has compared a dataset of taccorl with its manifest."""
    if (
        root in _warned
        or not any((root / place).is_file() for place in MANIFEST_PLACES[1:])
        or is_verified(root)
    ):
        return
    _warned.add(root)
    _log.warning(
        "%s: its files have not been compared with its manifest here: taccorl check %s",
        root,
        root,
    )


class FastReader(DatasetReader):
    """Replacement for LeRobot's reader, faster for datasets of numbers and colour videos; other datasets are read by LeRobot's
    own code."""

    _columns: dict[str, Column] | None = None
    _gathered: "Gathered | None" = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        _warn_unverified(Path(self.root))
        if self._meta.stats is None:
            raise DatasetError(
                f"{self.root}: meta/stats.json is absent: nothing can be normalised; `taccorl check {self.root} --repair=COPY` "
                "writes a copy with it"
            )
        self._cache = _requested
        self.cameras: list[str] = self._meta.video_keys if _reads_pictures else []
        """Cameras whose pictures are read."""
        cameras = self._meta.video_keys
        if self._meta.episodes is None:
            raise DatasetError(
                f"{self.root}: holds no episode; if its recording failed, remove it and record again"
            )
        self._has_videos = all(
            f"videos/{key}/file_index" in self._meta.episodes.column_names
            for key in cameras
        )  # pyright: ignore
        if not self._has_videos:
            if self._cache is None and self.cameras:
                raise DatasetError(
                    f"{self.root}: has no videos of {', '.join(cameras)}; its frames are only in the frame cache of training: "
                    "give --dataset.cache=gpu (host, disk), or make a dataset with videos by taccorl collect --pictures=video"
                )
            assert self._meta.stats is not None, (
                "LeRobot writes statistics with every dataset"
            )
            for key in cameras:  # LeRobot puts ImageNet's there
                self._meta.stats.setdefault(key, {})
        given = [v for v in (*args, *kwargs.values()) if isinstance(v, Deltas)]
        self._relative_actions = given[0].relative_actions if given else None

    def __getstate__(self) -> dict[str, Any]:
        return {
            k: v for k, v in self.__dict__.items() if k not in ("_columns", "_gathered")
        }  # a worker makes its own, of the same files

    def _check_cached_episodes_sufficient(self) -> bool:
        if self._has_videos:
            return super()._check_cached_episodes_sufficient()
        table: Any = self.hf_dataset
        wanted = (
            range(self._meta.total_episodes) if self.episodes is None else self.episodes
        )
        return set(wanted) <= {
            int(episode) for episode in table.unique("episode_index")
        }

    def _build_index_mapping(self) -> None:
        super()._build_index_mapping()
        self._columns = self._gathered = None
        if self.hf_dataset is not None and IS_SIM in self.hf_dataset.column_names:
            # Which rows the share p of the loss's weights counts: those that are trained on. LeRobot's editing of a dataset
            # loses the statistics of what it does not know.
            share = np.asarray(
                self.hf_dataset.data.column(IS_SIM).to_numpy(), dtype=np.float64
            ).mean()
            assert self._meta.stats is not None, (
                "LeRobot writes statistics with every dataset"
            )
            self._meta.stats.setdefault(IS_SIM, {})["mean"] = np.array([share])
        if self.hf_dataset is not None and self._relative_actions is not None:
            # LeRobot normalises what is relative by the range of what is absolute unless lerobot-edit-dataset has overwritten it.
            assert self._meta.stats is not None and self.delta_indices is not None
            self._meta.stats[ACTION] = self._relative_statistics(
                np.array(self._relative_actions)
            )

    def _relative_statistics(self, relative_A: np.ndarray) -> dict[str, np.ndarray]:
        """Exact statistics of actions as a policy with relative ones meets them: each step of each row's chunk, up to the end of
        the episode, less the row's state where that is wanted. (A,) each, and (H, A) for ``STEP_STATISTICS``."""
        table: Any = self.hf_dataset
        episode, state, action = (
            Column(table.data.column(k)) for k in ("episode_index", OBS_STATE, ACTION)
        )
        episode_T = episode.stored().reshape(-1).numpy()
        state_TA, action_TA = (
            column.stored().numpy().astype(np.float64).reshape(len(episode_T), -1)
            for column in (state, action)
        )
        state_TA = state_TA[:, : len(relative_A)] * relative_A

        def of_action(a: int) -> dict[str, Any]:
            parts = []
            for step in self.delta_indices[ACTION]:  # pyright: ignore[reportOptionalSubscript]
                rows = np.arange(len(episode_T) - step)
                rows = rows[episode_T[rows] == episode_T[rows + step]]
                parts.append(action_TA[rows + step, a] - state_TA[rows, a])
            values = np.concatenate(parts)
            found = {
                "min": values.min(),
                "max": values.max(),
                "mean": values.mean(),
                "std": values.std(),
            }
            percent = (1, 10, 50, 90, 99)
            found |= {
                f"q{q:02d}": x
                for q, x in zip(percent, np.percentile(values, percent), strict=True)
            }
            found |= {
                "step_mean": [part.mean() for part in parts],
                "step_std": [part.std() for part in parts],
            }
            return found | {"count": len(values)}

        with ThreadPoolExecutor(4) as pool:  # NumPy partitions outside of Python's lock
            each = list(pool.map(of_action, range(len(relative_A))))
        told = {name: [of_one[name] for of_one in each] for name in each[0]}
        statistics = {
            name: np.array(v if name != "count" else v[:1]) for name, v in told.items()
        }
        return statistics | {
            name: np.ascontiguousarray(statistics[name].T) for name in STEP_STATISTICS
        }

    def columns(self) -> dict[str, Column]:
        """Feature → its column; empty for a dataset that LeRobot reads."""
        if self._columns is None:
            dataset, features = self.hf_dataset, self._meta.features
            assert dataset is not None, "LeRobot loads the table before it reads rows"
            self._columns = {}
            plain = (
                dataset._indices is None
                and not self._meta.depth_keys
                and not self._meta.image_keys
            )
            if plain and set(dataset.column_names) == set(features) - set(
                self._meta.video_keys
            ):
                with contextlib.suppress(TypeError, pa.ArrowInvalid):
                    self._columns = {
                        key: Column(dataset.data.column(key))
                        for key in dataset.column_names
                    }
        return self._columns

    def batch(self, rows: list[int]) -> "WholeBatch | None":
        """A whole batch of rows, equal to the collated results of ``get_item``; None if frames are not cached. Raises
        DatasetError: as ``open_frames``."""
        if self._cache is None:
            return None
        if self._gathered is None:
            columns = self.columns()
            windows = self.delta_indices or {}
            if not columns or any(key in windows for key in self._meta.video_keys):
                _log.warning(
                    "--dataset.cache=%s: %s has more than numbers and single colour pictures; its rows are read one by one",
                    self._cache.place,
                    self.root,
                )
                self._cache = None
                return None
            self._gathered = Gathered(self, columns, self._cache)
        return self._gathered.batch(rows)

    def get_item(self, idx: int) -> dict:
        """Row ``idx`` of the dataset: feature → tensor, (n, …) where the policy asked for n time steps; ``task`` → instruction
        (str)."""
        columns = self.columns()
        if not columns or not isinstance(idx, int | np.integer):
            return super().get_item(idx)
        row = int(idx) + len(self.hf_dataset) * (idx < 0)  # pyright: ignore[reportArgumentType]
        if not 0 <= row < len(self.hf_dataset):  # pyright: ignore[reportArgumentType]
            return super().get_item(idx)
        episode, index = (
            int(columns["episode_index"].rows([row])),
            int(columns["index"].rows([row])),
        )
        windows: dict[str, list[int]] = {}
        padding: dict[str, Tensor] = {}
        if self.delta_indices is not None:
            windows, padding = self._get_query_indices(index, episode)
        item: dict[str, Any] = {
            k: column.rows([row])[0]
            for k, column in columns.items()
            if k not in windows
        }
        item |= padding | self._query_hf_dataset(windows)
        if self.cameras and not self._has_videos:
            gathered: Any = self.batch([row])
            for key in self.cameras:
                item[key] = (
                    gathered[key][0]
                    if self._return_uint8
                    else gathered[key][0].to(torch.float32) / 255
                )
        elif self.cameras:
            times_s = self._get_query_timestamps(item["timestamp"].item(), windows)
            item = self._query_videos(times_s, episode) | item
        if self._image_transforms is not None:
            for camera in self.cameras:
                item[camera] = self._image_transforms(item[camera])
        assert self._meta.tasks is not None, "LeRobot loads tasks with the metadata"
        item["task"] = self._meta.tasks.iloc[item["task_index"].item()].name
        return item

    def _query_hf_dataset(self, query_indices: dict[str, list[int]]) -> dict:
        columns = self.columns()
        if not columns:
            return super()._query_hf_dataset(query_indices)
        relative = self._absolute_to_relative_idx
        return {
            key: columns[key].rows(
                rows if relative is None else [relative[row] for row in rows]
            )
            for key, rows in query_indices.items()
            if key in columns
        }

    def _query_videos(
        self, query_timestamps: dict[str, list[float]], ep_idx: int
    ) -> dict[str, Tensor]:
        single = all(len(times_s) == 1 for times_s in query_timestamps.values())
        if self._video_backend != "pyav" or not single or self._meta.depth_keys:
            return super()._query_videos(query_timestamps, ep_idx)
        assert self._meta.episodes is not None, (
            "LeRobot loads episodes with the metadata"
        )
        episode, pictures = self._meta.episodes[ep_idx], {}
        for key, (time_s,) in query_timestamps.items():
            path = self.root / self._meta.get_video_file_path(ep_idx, key)
            picture = OPEN_VIDEOS.picture(
                path,
                episode[f"videos/{key}/from_timestamp"] + time_s,
                self._tolerance_s,
            )
            if picture is None:  # LeRobot says what is wrong
                return super()._query_videos(query_timestamps, ep_idx)
            pictures[key] = (
                picture if self._return_uint8 else picture.to(torch.float32) / 255
            )
        return pictures


class Gathered:
    """A dataset's numbers as tensors beside its cached frames: a batch is a few gather operations on one device."""

    def __init__(
        self, reader: FastReader, columns: dict[str, Column], request: CacheRequest
    ) -> None:
        """Raises DatasetError: as ``open_frames``."""
        meta: Any = reader._meta
        assert reader.hf_dataset is not None and meta.tasks is not None, (
            "LeRobot loads table and tasks first"
        )
        numbers = {
            key: column.stored()
            for key, column in columns.items()
            if not key.startswith(SIMULATOR)
        }
        index = FrameIndex(
            np.array(meta.episodes["length"], dtype=np.int64),
            Dataset(reader.root).rows_per_picture,
        )
        needed = sum(x.nbytes for x in numbers.values())
        self.frames: Frames = open_frames(
            request, reader.root, reader.cameras, index, needed
        )
        device = self.frames.device
        self.rows_per_picture = index.rows_per_picture if reader.cameras else 1
        self.frame_N = torch.from_numpy(index.of_rows()).to(device)
        self.numbers = {key: x.to(device) for key, x in numbers.items()}
        self.kinds = {key: column.kind for key, column in columns.items()}
        self.offsets = {
            key: torch.tensor(d, device=device)
            for key, d in (reader.delta_indices or {}).items()
        }
        episode = numbers["episode_index"].reshape(-1)
        begins = torch.ones(len(episode), dtype=torch.bool)
        begins[1:] = episode[1:] != episode[:-1]
        place = begins.cumsum(0) - 1
        firsts = torch.nonzero(begins).reshape(-1)
        self.first = firsts[place].to(device)
        self.last = (torch.cat([firsts[1:], torch.tensor([len(episode)])]) - 1)[
            place
        ].to(device)
        self.tasks = [str(meta.tasks.iloc[k].name) for k in range(len(meta.tasks))]
        self.task_index = numbers["task_index"].reshape(-1).tolist()

    def batch(self, rows: list[int]) -> WholeBatch:
        """Batch of B rows: key → (B, …), ``task`` → list of B instructions. A row without a picture is replaced by the last row
        before it that has one."""
        rows_B = torch.tensor(rows, device=self.frames.device)
        rows_B = rows_B - (rows_B - self.first[rows_B]) % self.rows_per_picture
        found: dict[str, Any] = {}
        for key, numbers in self.numbers.items():
            if key not in self.offsets:
                found[key] = numbers[rows_B].to(self.kinds[key])
        for key, offsets_W in self.offsets.items():
            wanted_BW = rows_B[:, None] + offsets_W
            first_B1, last_B1 = self.first[rows_B][:, None], self.last[rows_B][:, None]
            found[f"{key}_is_pad"] = (wanted_BW < first_B1) | (wanted_BW > last_B1)
            if key in self.numbers:
                within_BW = torch.minimum(torch.maximum(wanted_BW, first_B1), last_B1)
                found[key] = self.numbers[key][within_BW].to(self.kinds[key])
        found |= self.frames.at(self.frame_N[found["index"]])
        found["task"] = [self.tasks[self.task_index[row]] for row in rows]
        return WholeBatch(found)
