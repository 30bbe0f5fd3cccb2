"""Any LeRobot v3 dataset read back as episodes, without LeRobot: parquet through pyarrow, videos through PyAV.

Row k of an episode shows the video frame at from_timestamp + k / fps, found by its own time stamp, never by counting. What
LeRobot's files cannot say (units, ranges, pads, baselines, success) is in ``meta/taccorl/``, where ingest wrote it; of other
people's datasets it stays unknown.
"""

import contextlib
import dataclasses
import json
import math
import os
import re
import shlex
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from taccorl.data.episode import ChannelTiming, Episode, Pictures, Video
from taccorl.data.file_kinds import plainly
from taccorl.data.origin import NOT_STATED, Origin
from taccorl.data.spec import DatasetSpec, FeatureSpec
from taccorl.data.strict_yaml import SPEC_VERSION, Document, check_version
from taccorl.data.timing import MOST_S
from taccorl.data.video_files import frame_problems, video_frames
from taccorl.errors import DatasetError, TaccorlError, no_such_path

PROVENANCE = Path(
    "meta/taccorl"
)  # Folder in a dataset with the files that taccorl adds to LeRobot's
DATASET_STAGES = {
    "collection": "collect",
    "corrections": "correct",
    "augmented": "augment",
}
"""Stage that publishes a dataset of the twin → its command. Its inputs are one attempt for each episode, in their order."""
ROWS_PER_PICTURE = "rows_per_picture"
"""Key of a camera's feature in ``info.json``, k: the rows 0, k, 2k … of each episode have pictures. Absent: all rows."""
BOOKKEEPING = (
    "timestamp",
    "frame_index",
    "episode_index",
    "index",
    "task_index",
)  # LeRobot's own columns, no features
NUMBERS = (
    "float32",
    "float64",
    "int16",
    "int64",
)  # Kinds of numbers that are read from flat features
MOST_FPS = 100_000  # Highest accepted rate of rows [Hz]
MOST_NUMBERS = 10_000_000  # Most numbers of a feature in a row: ten times a picture of 640 × 480 in three colours
_TEMPLATE = re.compile(r"(?:[^{}]|\{\w+(?::0?\d{1,2}d)?\})*")
"""Accepted paths of files in info.json: fields are plain names, with a width of two digits at most. Python's own format language
would also accept widths that exhaust the memory, and attributes of objects."""
READ_AS: dict[str, Any] = {
    **{dtype: dtype for dtype in NUMBERS},
    **dict.fromkeys(("int8", "uint8"), "int16"),
    **dict.fromkeys(("int32", "uint16", "uint32"), "int64"),
    "float16": "float32",
}
"""Type of a feature of numbers → type that holds the same numbers in an episode."""
DOMAINS = "domains"
"""Key in the metadata of features: the domains of the episodes. LeRobot's own tools copy it, but not ``meta/taccorl/``."""
PARQUET = "a whole parquet file"
EDITED = "edited by another tool? Remove this file to read the dataset without it; its domain is then what meta/info.json states"


class Dataset:
    """A LeRobot v3 dataset on disk. Opening it reads ``meta/`` only. Episodes are given by their index from 0."""

    def __init__(self, root: Path, *, partial: bool = False) -> None:
        """``partial``: also one whose last episodes are lost, as a writer leaves it that died. Raises DatasetError: no
        LeRobot v3 dataset, or not a whole one: says what is missing."""
        self.root = Path(root)
        self.info = _checked_info(self.root)
        self._table = _read_episode_table(self.root, self.info, partial)
        self.task_names = _read_tasks(self.root)
        """Number of a task → its text, from ``meta/tasks.parquet``; ``instructions``: the texts."""
        self.instructions = tuple(self.task_names.values())
        self.spec, self.skipped = _read_spec(self.root, self.info)
        """``skipped``: feature key → why episodes do not have it."""
        cameras = [
            key for key, f in self.info["features"].items() if f["dtype"] == "video"
        ]
        known = (
            {name.rpartition("/")[0] for name in self._table[0]}
            if self._table
            else set()
        )
        self.unstored = tuple(
            key for key in cameras if self._table and f"videos/{key}" not in known
        )
        """Cameras without videos: ``taccorl collect --pictures=cache`` stored their frames only in training's frame cache."""
        self.cameras = [key for key in cameras if key not in self.unstored]
        if self.unstored:
            kept = {
                key: f
                for key, f in self.spec.features.items()
                if key not in self.unstored
            }
            self.spec = dataclasses.replace(self.spec, features=kept)
            why = "not stored as video; frames are in training's cache (lerobot-train --dataset.cache=gpu|host|disk)"
            self.skipped |= dict.fromkeys(self.unstored, why)
        self._records = _read_records(self.root, self._table, self.info["features"])
        self._rows: _Rows | None = None
        """File of the episode that was read last."""
        manifest = self.root / PROVENANCE / "manifest.json"
        self.provenance: dict[str, Any] | None = (
            _read_json(manifest) if manifest.is_file() else None
        )
        absent = sorted(
            {
                str(p)
                for i in range(self.num_episodes)
                if not (p := self.data_file(i)).is_file()
            }
        )
        if absent:
            raise DatasetError(
                f"{self.root}: {len(absent)} data files are missing, first {absent[0]}: copy it whole"
            )

    @property
    def rows_per_picture(self) -> int:
        """k: of each episode the rows 0, k, 2k … have pictures; 1 for a dataset with videos. Raises DatasetError:
        ``info.json`` states several values, or none that is possible."""
        cameras = {
            key: f for key, f in self.info["features"].items() if f["dtype"] == "video"
        }
        stated = {key: f.get(ROWS_PER_PICTURE, 1) for key, f in cameras.items()}
        if len(set(stated.values())) > 1 or not all(
            isinstance(k, int) and k >= 1 for k in stated.values()
        ):
            text = f"{self.root / 'meta/info.json'}: {ROWS_PER_PICTURE} is {stated}; the same whole number of at least "
            raise DatasetError(
                f"{text}1 is needed for all cameras. Make the dataset again"
            )
        return next(iter(stated.values()), 1)

    @property
    def num_episodes(self) -> int:
        """Number of episodes, from ``meta/episodes``."""
        return len(self._table)

    def entry(self, index: int) -> dict[str, Any]:
        """One episode's entry in ``meta/episodes``, without its statistics."""
        if not 0 <= index < len(self._table):
            raise DatasetError(
                f"{self.root}: no episode {index}; it has {len(self._table)}, counted from 0"
            )
        return self._table[index]

    def num_rows(self, index: int) -> int:
        """Number of rows of one episode, from ``meta/episodes``."""
        return int(self.entry(index)["length"])

    def first_row(self, index: int) -> int:
        """Index (from 0) in the whole dataset of the episode's first row."""
        return int(self.entry(index)["dataset_from_index"])

    def data_file(self, index: int) -> Path:
        """The parquet file that holds the episode, perhaps among others."""
        return self._file("data_path", "data/", index)

    def video(self, index: int, key: str) -> Video:
        """The episode's part of the videos of the camera ``key``. Raises DatasetError: its frames are only in the cache."""
        if key in self.unstored:
            raise DatasetError(f"{self.root}: {key}: {self.skipped[key]}")
        path = self._file("video_path", f"videos/{key}/", index, video_key=key)
        from_s = float(self.entry(index)[f"videos/{key}/from_timestamp"])
        if not 0 <= from_s <= MOST_S:
            text = f"{self.root}/meta/episodes: videos/{key}/from_timestamp of episode {index} is {from_s:g} s, which "
            raise DatasetError(f"{text}is no time in a video: copy the dataset again")
        return Video(path, from_s, self.num_rows(index))

    def values(self, index: int, keys: Collection[str]) -> dict[str, np.ndarray]:
        """Feature → (T, *shape) values of the features ``keys``, none of them pictures, as stored; (T,) of texts. T rows of
        one episode. Reads only these rows and columns. Raises DatasetError: rows are missing, or a value does not fit its
        feature's shape."""
        path, num_rows, features = (
            self.data_file(index),
            self.num_rows(index),
            self.info["features"],
        )
        where, columns = (
            f"{path}, episode {index}",
            list(dict.fromkeys(["frame_index", *keys])),
        )
        if absent := [key for key in columns if key not in features]:
            raise DatasetError(
                f"{self.root}/meta/info.json: has no feature {absent[0]}: copy the dataset again"
            )
        with plainly(path, PARQUET):
            if self._rows is None or self._rows.path != path:
                self._rows = _Rows(path)
            table = self._rows.of_episode(index, columns)
        if table.num_rows != num_rows or table["frame_index"].to_pylist() != list(
            range(num_rows)
        ):
            raise DatasetError(
                f"{where}: has {table.num_rows} rows, which are not rows 0 to {num_rows - 1} in order"
            )
        return {
            key: _column(table[key], features[key], f"{where}, {key}") for key in keys
        }

    def frames(
        self, index: int, key: str, first: int = 0, end: int | None = None
    ) -> Generator[np.ndarray, None, None]:
        """(rows, columns, 3) uint8 RGB pictures of rows ``first`` to ``end`` (excluded), one at a time. Raises DatasetError:
        a row has no frame at its time."""
        video = self.video(index, key)
        end = video.num_frames if end is None else end
        yield from video_frames(
            video, self.spec.fps, first, end, f"{video.path}, episode {index}"
        )

    def tasks(self, index: int) -> list[tuple[int, str]]:
        """The instructions of an episode as (first row, text) for each run of rows with one instruction; usually one."""
        numbers = self.values(index, ["task_index"])["task_index"].ravel()
        starts = [0, *(np.flatnonzero(np.diff(numbers)) + 1)] if len(numbers) else []
        if unknown := sorted(
            {int(numbers[row]) for row in starts} - set(self.task_names)
        ):
            raise DatasetError(
                f"{self.root}/meta/tasks.parquet has no task {unknown[0]} of episode {index}"
            )
        return [(int(row), self.task_names[int(numbers[row])]) for row in starts]

    def episode_facts(self, index: int) -> dict[str, Any]:
        """Facts about one episode from ``meta/taccorl/``: name of a field of ``Episode`` (success, origin, baselines, …) →
        value; only the origin, as the features' metadata state it, if the dataset was not written by taccorl."""
        origin = {"origin": _origin_of_features(self.info["features"])}
        return origin if self._records is None else dict(self._records[index])

    def episode(self, index: int) -> Episode:
        """Read one episode: its numbers at once, its pictures on demand."""
        present = {
            key: f
            for key, f in self.spec.features.items()
            if key in self.info["features"]
        }
        cameras = tuple(key for key, f in present.items() if f.dtype == "video")
        stored = self.values(index, [key for key in present if key not in cameras])
        arrays = {
            key: rows.reshape(len(rows), -1).astype(present[key].dtype)
            for key, rows in stored.items()
        }
        tasks, told = self.tasks(index), self.episode_facts(index)
        if "stages" not in told and len(tasks) > 1:
            told["stages"] = tuple(tasks)
        name, start_ns, shown = (
            f"{self.root.name} episode {index}",
            told.pop("start_ns", 0),
            self._pictures,
        )
        instruction, videos = (
            tasks[0][1] if tasks else "",
            {key: self.video(index, key) for key in cameras},
        )
        pictures = (lambda: shown(index, cameras), cameras)
        return Episode(
            name,
            self.spec,
            start_ns,
            arrays,
            *pictures,
            instruction,
            videos=videos,
            stored_rows=self.num_rows(index),
            **told,
        )

    def _pictures(self, index: int, cameras: tuple[str, ...]) -> Iterator[Pictures]:
        with contextlib.ExitStack() as stack:
            streams = [
                stack.enter_context(contextlib.closing(self.frames(index, key)))
                for key in cameras
            ]
            for shown in zip(*streams, strict=True):
                for key, picture in zip(cameras, shown, strict=True):
                    if picture.shape != (shape := self.spec.features[key].shape):
                        path = self.video(index, key).path
                        raise DatasetError(
                            f"{path}: pictures have shape {picture.shape}, but the spec states {shape}"
                        )
                yield dict(zip(cameras, shown, strict=True))

    def video_problems(self) -> list[str]:
        """Compare, without decoding, the packets of each video file with the episodes' rows: every row must have its own
        frame. One text for each problem."""
        problems = []
        for key in self.cameras:
            files: dict[Path, dict[int, np.ndarray]] = {}
            for index in range(self.num_episodes):
                video = self.video(index, key)
                due_s = video.from_s + np.arange(video.num_frames) / self.spec.fps
                files.setdefault(video.path, {})[index] = due_s
            for path, due in files.items():
                problems += [
                    f"{path.relative_to(self.root)}: {p}"
                    for p in frame_problems(path, due)
                ]
        return problems

    def _file(self, template: str, prefix: str, index: int, **names: str) -> Path:
        entry = self.entry(index)
        try:
            chunk, file = (
                int(entry[f"{prefix}chunk_index"]),
                int(entry[f"{prefix}file_index"]),
            )
            text = str(self.info[template])
            if not _TEMPLATE.fullmatch(text):
                raise ValueError(
                    f"{template} {text[:200]!r} is not a path with fields such as {{chunk_index:03d}}"
                )
            name = text.format(chunk_index=chunk, file_index=file, **names)
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            text = f"{self.root}/meta: no entry states which file holds {prefix} of episode {index} ({error})"
            raise DatasetError(text) from error
        # By its text: in the cache of Hugging Face's Hub files are links to a folder beside.
        if (
            Path(os.path.normpath(name)).parts[:1] == ("..",)
            or Path(name).is_absolute()
        ):
            text = f"{self.root}/meta/info.json: {template} {self.info[template]!r} points outside of the dataset"
            text = f"{text}, to {self.root / name}, which is not opened: "
            raise DatasetError(f"{text}a dataset's files must lie in its folder")
        return self.root / name


# ---- what taccorl adds to a dataset ----


def dataset_spec_to_json(spec: DatasetSpec) -> dict[str, Any]:
    """A dataset spec with its sensors as plain JSON values. Raises DatasetError: a feature without a range, as other people's
    datasets have: such a spec is derived, never written."""
    endless = [
        key for key, f in spec.features.items() if not np.isfinite(f.limits).all()
    ]
    if endless:
        raise DatasetError(
            f"{spec.name}: {endless[0]} has no valid range; state one in a spec in data_specs/"
        )
    return dataclasses.asdict(spec)


def dataset_spec_from_json(path: Path) -> DatasetSpec:
    """Inverse of ``dataset_spec_to_json``, read as strictly as the YAML files of ``data_specs/``. Raises SpecError."""
    document = Document(DatasetSpec, path)  # JSON is YAML
    check_version(document, document.value.spec_version)
    return document.value


def episode_record(episode: Episode, source_digest: str) -> dict[str, Any]:
    """The entry of ``meta/taccorl/episodes.json`` for an episode, as JSON values: what LeRobot's files cannot state
    (recording, start, success, origin, baselines, timing …). ``source_digest`` is that of the recording's files."""
    recording, part, simulation = (
        episode.provenance.get(key) for key in ("recording", "part", "simulation")
    )
    where = {
        "recording": str(recording or episode.name),
        "part": part,
        "source_digest": source_digest,
    }
    what = {
        "start_ns": int(episode.start_ns),
        "rows": episode.num_rows,
        "instruction": episode.instruction,
    }
    baselines = {
        key: np.asarray(counts).tolist() for key, counts in episode.baselines.items()
    }
    timing = [dataclasses.asdict(t) for t in episode.timing]
    stages = [[int(row), name] for row, name in episode.stages]
    found = {
        "baselines": baselines,
        "timing": timing,
        "stages": stages,
        "simulation": simulation,
    }
    return where | what | {"success": episode.success} | episode.origin.record() | found


def _from_record(record: dict[str, Any], features: Iterable[str]) -> dict[str, Any]:
    """Fields of ``Episode`` from its record; ``stages`` only where there are any."""
    stages = tuple((int(row), str(name)) for row, name in record["stages"])
    fields: dict[str, Any] = {
        "start_ns": int(record["start_ns"]),
        "success": record["success"],
    }
    fields["origin"] = Origin.read(record, features)
    fields["baselines"] = {
        key: np.array(counts) for key, counts in record["baselines"].items()
    }
    fields["timing"] = tuple(ChannelTiming(**t) for t in record["timing"])
    fields["provenance"] = {
        k: record.get(k) for k in ("recording", "part", "source_digest", "simulation")
    }
    return fields | ({"stages": stages} if stages else {})


def write_records(root: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Write the episodes' records into ``meta/taccorl/``, one a line, and their domains into the features' metadata."""
    path = root / PROVENANCE / "episodes.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(json.dumps(record, ensure_ascii=False) for record in records)
    path.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    found = {record.get("domain") or NOT_STATED for record in records}
    state_domains(root, sorted(found) if found != {NOT_STATED} else [])


def state_domains(root: Path, domains: Sequence[str]) -> None:
    """Write the domains (``real`` …) into the metadata of the dataset's features of numbers; none: remove the statement."""
    info = read_info(root)
    for key, feature in info["features"].items():
        feature.pop(DOMAINS, None)
        if domains and key not in BOOKKEEPING and feature["dtype"] in NUMBERS:
            feature[DOMAINS] = list(domains)
    write_info(root, info)


def read_info(root: Path) -> dict[str, Any]:
    """Contents of ``meta/info.json``, unchecked."""
    return json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))


def write_info(root: Path, info: Mapping[str, Any]) -> None:
    """Write ``meta/info.json`` as LeRobot formats it."""
    (root / "meta" / "info.json").write_text(
        json.dumps(info, indent=4, ensure_ascii=False), encoding="utf-8"
    )


def _origin_of_features(features: Mapping[str, Mapping[str, Any]]) -> Origin:
    """Origin of every episode of a dataset without records."""
    stated = next(
        (feature[DOMAINS] for feature in features.values() if DOMAINS in feature), None
    )
    if stated is not None and len(stated) > 1:
        return Origin(
            None,
            f"episodes of several domains ({', '.join(map(str, stated))}), edited by another tool",
        )
    return Origin.read(
        {}
        if stated is None
        else {"domain": stated[0], "origin": "edited by another tool"},
        features,
    )


# ---- meta/ ----


def _checked_info(root: Path) -> dict[str, Any]:
    if not root.is_dir():
        if root.exists():
            raise DatasetError(
                f"{root}: is a file; a dataset is the folder that holds meta/info.json"
            )
        raise DatasetError(no_such_path(root, "folder"))
    path = root / "meta" / "info.json"
    if not path.is_file():
        raise DatasetError(f"{root}: not a LeRobot dataset: there is no meta/info.json")
    info = _read_json(path)
    version = str(info.get("codebase_version", "without a version"))
    if version.startswith("v2.1"):
        text = f"{root}: is a LeRobot {version} dataset, but only v3 is supported. Convert it (in place): python -m "
        text += "lerobot.scripts.convert_dataset_v21_to_v30 --push-to-hub=false "
        raise DatasetError(f"{text}--repo-id=local/{root.name} --root={root}")
    if not version.startswith("v3."):
        raise DatasetError(
            f"{root}: is a LeRobot dataset {version}, only v3 is supported; LeRobot converts v2.1 to it"
        )
    needed = {
        "fps": int | float,
        "features": dict,
        "total_episodes": int,
        "data_path": str,
    }
    if wrong := [
        key for key, kind in needed.items() if not isinstance(info.get(key), kind)
    ]:
        raise DatasetError(
            f"{path}: {wrong[0]} is missing or of another type: {info.get(wrong[0])!r}"
        )
    for key, feature in info["features"].items():
        if why := _no_feature(feature):
            raise DatasetError(f"{path}: feature {key}: {why}; copy the dataset again")
    if (
        not math.isfinite(info["fps"])
        or int(info["fps"]) != info["fps"]
        or not 0 < info["fps"] <= MOST_FPS
    ):
        raise DatasetError(
            f"{path}: fps {info['fps']}; only whole numbers up to {MOST_FPS} are supported"
        )
    return info


def _no_feature(feature: Any) -> str:
    """Error text for an entry of ``features`` in info.json that does not describe a feature; empty if the entry is valid."""
    if not isinstance(feature, dict):
        return f"expected dtype, shape and names, found {str(feature)[:80]!r}"
    dtype, shape = feature.get("dtype"), feature.get("shape")
    if not isinstance(dtype, str):
        return f"has no dtype, or one that is no text: {str(dtype)[:80]!r}"
    if not isinstance(shape, list) or not all(
        type(size) is int and size > 0 for size in shape
    ):
        return f"shape is {str(shape)[:80]!r}, expected a list of whole numbers above 0"
    if not isinstance(feature.get("info") or {}, dict):
        return f"info is {str(feature['info'])[:80]!r}, expected names and values"
    return ""


def _read_episode_table(
    root: Path, info: dict[str, Any], partial: bool = False
) -> list[dict[str, Any]]:
    """One dict per episode, in order, without the statistics. ``partial``: the last ones may be missing."""
    rows: list[dict[str, Any]] = []
    for path in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
        with plainly(path, PARQUET):
            every = pq.read_schema(path).names
        names = [name for name in every if not name.startswith("stats/")]
        rows += read_columns(path, names).to_pylist()
    rows.sort(key=lambda r: r["episode_index"])
    listed, told = [r["episode_index"] for r in rows], info["total_episodes"]
    are_first = 0 < len(listed) < told and listed == list(range(len(listed)))
    if (len(listed) != told or listed != list(range(told))) and not (
        partial and are_first
    ):
        missing = next(
            (i for i in range(told) if i not in listed), None
        )  # `told` may be any number
        described = (
            "one stands twice or is too many"
            if missing is None
            else f"episode {missing} is missing"
        )
        text = f"{root}: info.json states {told} episodes, but meta/episodes lists {len(listed)}, {described}: the "
        text += "writer died before finalize(), or the copy is incomplete"
        if are_first:
            text += f"; `taccorl check {shlex.quote(str(root))} --repair=COPY` writes a copy of the {len(listed)} that are whole"
        raise DatasetError(text)
    return rows


def _read_tasks(root: Path) -> dict[int, str]:
    path = root / "meta" / "tasks.parquet"
    if not path.is_file():
        raise DatasetError(
            f"{root}: there is no meta/tasks.parquet: copy it whole, or remove a failed recording"
        )
    table = read_columns(path)
    # LeRobot up to 0.4 kept the text as pandas' index.
    text = next(
        (n for n in ("task", "__index_level_0__") if n in table.column_names), None
    )
    if text is None or "task_index" not in table.column_names:
        raise DatasetError(
            f"{path}: has the columns {', '.join(table.column_names)} instead of task_index and task"
        )
    return dict(
        zip(table["task_index"].to_pylist(), table[text].to_pylist(), strict=True)
    )


def _read_spec(root: Path, info: dict[str, Any]) -> tuple[DatasetSpec, dict[str, str]]:
    """The spec that ingest wrote, checked against info.json; else what info.json says."""
    derived, skipped = _derive_spec(root, info)
    path = root / PROVENANCE / "dataset_spec.json"
    if not path.is_file():
        return derived, skipped
    spec = dataset_spec_from_json(path)
    if spec.fps != info["fps"]:
        raise DatasetError(
            f"{path} states {spec.fps} fps, but info.json {info['fps']}: a spec of another dataset"
        )
    for key, feature in spec.features.items():
        found = derived.features.get(key)
        if found is None and not feature.optional:
            raise DatasetError(
                f"{path} has {key}, but info.json does not: {skipped.get(key, 'was it removed?')}"
            )
        if found is not None and (found.dtype, found.shape) != (
            feature.dtype,
            feature.shape,
        ):
            text = f"{path}: {key} is {feature.dtype} {list(feature.shape)}, but info.json states {found.dtype} "
            raise DatasetError(
                f"{text}{list(found.shape)}: one of the two was changed; write the dataset again"
            )
    others = [key for key in derived.features if key not in spec.features]
    return spec, skipped | dict.fromkeys(others, "not in the dataset's own spec")


def _derive_spec(
    root: Path, info: dict[str, Any]
) -> tuple[DatasetSpec, dict[str, str]]:
    features, skipped, codec, rate_hz = {}, {}, "libsvtav1", float(info["fps"])
    for key, f in info["features"].items():
        if key in BOOKKEEPING:
            continue
        shape, names, dtype, size = (
            tuple(f["shape"]),
            f.get("names"),
            f["dtype"],
            math.prod(f["shape"]),
        )
        what, info_of = f"{dtype} {list(f['shape'])}", f.get("info") or {}
        if dtype == "video":
            if isinstance(names, list) and names[:1] in (["channel"], ["channels"]):
                shape = (*shape[1:], shape[0])
            if len(shape) != 3 or shape[2] != 3 or info_of.get("is_depth_map"):
                skipped[key] = (
                    f"a video of shape {list(f['shape'])}: colour pictures are read"
                )
                continue
            codec = "h264" if info_of.get("video.codec") == "h264" else codec
            told = {
                "dtype": "video",
                "shape": shape,
                "unit": "rgb8",
                "range": (0.0, 255.0),
            }
        elif dtype == "image":
            skipped[key] = (
                "pictures inside the parquet files; lerobot-edit-dataset's convert_image_to_video helps"
            )
            continue
        elif size > MOST_NUMBERS or dtype not in READ_AS or not shape:
            limit = f"at most {MOST_NUMBERS:,} numbers a row are read"
            skipped[key] = (
                f"{what}: {limit if size > MOST_NUMBERS else f'numbers are read ({", ".join(READ_AS)})'}"
            )
            continue
        else:
            told = {
                "dtype": READ_AS[dtype],
                "shape": (size,),
                "unit": "unknown",
                "range": (-math.inf, math.inf),
            }
            told |= {
                "layout": shape if len(shape) > 1 else (),
                "names": _names(names, shape),
            }
        features[key] = FeatureSpec(**told, frame="unknown", rate_hz=rate_hz)
    robot = str(info.get("robot_type") or "unknown")
    what = {
        "name": root.name,
        "robot_type": robot,
        "fps": int(info["fps"]),
        "features": features,
    }
    return DatasetSpec(spec_version=SPEC_VERSION, video_codec=codec, **what), skipped


def _names(names: Any, shape: tuple[int, ...]) -> tuple[str, ...]:
    """One name per element, or none: datasets write lists, and dicts of one list ({"motors": […]})."""
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if (
        not isinstance(names, list)
        or len(names) != math.prod(shape)
        or len(set(map(str, names))) != len(names)
    ):
        return ()
    return tuple(map(str, names))


def _read_records(
    root: Path, table: list[dict[str, Any]], features: Iterable[str]
) -> list[dict[str, Any]] | None:
    path = root / PROVENANCE / "episodes.json"
    if not path.is_file():
        return None
    records = _read_json(path, list)
    rows = [r.get("rows") if isinstance(r, dict) else None for r in records]
    if rows != [r["length"] for r in table]:
        text = f"{path}: lists {len(rows)} episodes, {sum(r or 0 for r in rows)} rows, but the dataset has "
        raise DatasetError(
            f"{text}{len(table)} episodes, {sum(r['length'] for r in table)} rows: {EDITED}"
        )
    try:
        return [_from_record(r, features) for r in records]
    except (KeyError, TypeError, ValueError) as error:
        text = f"{path}: not in the form in which taccorl writes it ({type(error).__name__}: {error}): {EDITED}"
        raise DatasetError(text) from error
    except TaccorlError as error:  # of an origin
        raise DatasetError(f"{path}: {error}") from error


def _read_json(path: Path, kind: type = dict) -> Any:
    with plainly(path, "JSON"):
        value = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(value, kind):
        raise DatasetError(
            f"{path}: contains a {type(value).__name__} instead of a {kind.__name__}"
        )
    return value


# ---- columns and videos ----


def flattened(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """All numbers or texts of a column, one after the other, whatever lists they stand in."""
    if isinstance(
        column.type, pa.BaseExtensionType
    ):  # Hugging Face's Array2D, where `datasets` is imported
        column = pa.chunked_array(
            [c.storage for c in column.chunks], column.type.storage_type
        )
    while pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
        column = pa.chunked_array(
            [c.flatten() for c in column.chunks], column.type.value_type
        )
    return column


def numbers_of(column: pa.ChunkedArray, where: str) -> np.ndarray:
    """All numbers of a column, one after the other. Raises DatasetError: it has values of another type, or empty ones."""
    values = flattened(column)
    kind = values.type
    # True and false are the numbers of `next.done`.
    if not (
        pa.types.is_integer(kind)
        or pa.types.is_floating(kind)
        or pa.types.is_boolean(kind)
    ):
        raise DatasetError(
            f"{where}: a column of {column.type}, not of numbers: was it written by another tool? Copy the dataset again"
        )
    if values.null_count:
        raise DatasetError(
            f"{where}: {values.null_count} of {len(values)} values are empty: copy the dataset again"
        )
    return values.to_numpy()


def read_columns(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """A parquet file, or these columns of it. (``pq.read_table`` does the same and imports pandas, which takes 0.6 CPU-s.)
    Raises DatasetError: not a whole parquet file, or it lacks a column."""
    with plainly(path, PARQUET), pq.ParquetFile(path) as file:
        _require_columns(path, file, columns or ())
        return file.read(columns)


def _require_columns(path: Path, file: pq.ParquetFile, columns: Sequence[str]) -> None:
    """Raise a DatasetError if a file lacks a column, which pyarrow would leave out of the table without a word."""
    present = set(file.schema_arrow.names)
    if absent := [key for key in columns if key not in present]:
        raise DatasetError(f"{path}: lacks the column {absent[0]}: copy it again")


def data_files(root: Path) -> list[Path]:
    """Parquet files of rows in the order in which LeRobot joins them."""
    return sorted((root / "data").glob("*/*.parquet"))


class _Rows:
    """A file of rows, of which single episodes are read. Its footer is read once: LeRobot writes a row group for each episode, so
    that reading the footer takes longer than reading an episode."""

    def __init__(self, path: Path) -> None:
        """Raises ValueError, OSError: not a whole parquet file, or it has no ``episode_index``."""
        self.path = path
        self._footer = pq.read_metadata(path)
        schema = self._footer.schema
        columns = [schema.column(k).path for k in range(self._footer.num_columns)]
        column, bounds = columns.index("episode_index"), []
        for k in range(self._footer.num_row_groups):
            known = self._footer.row_group(k).column(column).statistics
            if known is not None and known.has_min_max:
                bounds.append((known.min, known.max))
            else:
                bounds.append((-math.inf, math.inf))
        self._first, self._last = np.array(bounds, dtype=float).reshape(-1, 2).T
        """(G,) first and last episode that each row group may hold."""

    def of_episode(self, index: int, columns: Sequence[str]) -> pa.Table:
        """The ``columns`` of the rows of one episode. Raises DatasetError: the file lacks a column."""
        groups = np.flatnonzero((self._first <= index) & (index <= self._last))
        with pq.ParquetFile(self.path, metadata=self._footer) as file:
            _require_columns(self.path, file, columns)
            named = [*columns, "episode_index"]
            table = file.read_row_groups(groups.tolist(), named)
        own = pc.equal(table["episode_index"], index)  # pyright: ignore[reportAttributeAccessIssue]
        return table.filter(own).select(list(columns))


def feature_rows(root: Path, key: str) -> np.ndarray:
    """(N, size) values of a feature of numbers in all rows of the dataset."""
    parts = []
    for path in data_files(root):
        column = read_columns(path, [key])[key]
        parts += (
            [numbers_of(column, f"{path}, {key}").reshape(len(column), -1)]
            if len(column)
            else []
        )
    return np.concatenate(parts)


def _column(
    rows: pa.ChunkedArray, feature: Mapping[str, Any], where: str
) -> np.ndarray:
    """(T, *shape) of numbers; (T,) of texts. Raises DatasetError: the column has values of
    another type or number than ``feature`` states."""
    num_rows, column, shape = len(rows), flattened(rows), tuple(feature["shape"])
    text = pa.types.is_string(column.type) or pa.types.is_large_string(column.type)
    number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
    stated = feature["dtype"]
    if (stated in READ_AS and not number) or (stated == "string" and not text):
        raise DatasetError(
            f"{where}: a column of {column.type}, but meta/info.json states {stated}: "
            "was it written by another tool? Copy the dataset again"
        )
    if column.null_count or len(column) != num_rows * (1 if text else math.prod(shape)):
        found = f"{where}: {len(column)} values, {column.null_count} of them empty, for {num_rows} rows of shape "
        raise DatasetError(f"{found}{list(shape)}")
    values = column.to_numpy()
    if text:
        return values
    if (
        np.dtype(READ_AS.get(stated, "float64")).kind == "i"
        and values.dtype.kind == "f"
    ):
        odd = values != np.floor(values)
        if odd.any():
            raise DatasetError(
                f"{where}: {values[odd][0]:g} is no whole number, but meta/info.json states {stated}: copy the dataset again"
            )
    return values.reshape(num_rows, *shape)
