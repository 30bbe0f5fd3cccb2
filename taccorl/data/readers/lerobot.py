"""A LeRobot v3 dataset as recordings, one per episode: for datasets that others recorded, or to convert one to another spec.

Topics are feature keys and ``task``. A taccorl dataset's touch also comes pad by pad, as ``<feature>/<pad>``: counts as the pad
sent them (baseline added back, wire order), since a recording spec reads pads from the wire. Pictures are decoded from videos, so
that writing them again compresses them twice.
"""

import contextlib
import functools
import re
import shlex
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.dataset import BOOKKEEPING, Dataset
from taccorl.data.origin import labelled
from taccorl.data.readers.hdf5 import RowClock
from taccorl.data.recording import (
    Damage,
    Message,
    Query,
    Reader,
    Source,
    TopicType,
    readers,
)
from taccorl.data.spec import ACTION
from taccorl.data.timing import NS_PER_S, check_stamps
from taccorl.errors import DatasetError, RecordingError
from taccorl.lineage.digest import digest_file, stamp
from taccorl.lineage.manifest import MANIFEST_PLACES, read_manifest

TASK = "task"  # Topic of the instructions
_SPEC_FILE = "meta/taccorl/dataset_spec.json"
_STATISTICS = "meta/stats.json"  # Not read here; LeRobot's own command writes it anew (recompute_stats)
REGULAR_S = 1e-3  # Largest difference of a stamp from k / fps at which the row is still row k [s]; they are float32


@functools.lru_cache(maxsize=4096)
def _digest(path: Path, unchanged: tuple[int, ...]) -> str:
    """SHA-256 of a file, once for all episodes that share it as long as its stamp is ``unchanged``."""
    del unchanged
    return digest_file(path)


@readers.register("lerobot")
class LerobotReader(Reader):
    """One episode of a LeRobot v3 dataset."""

    @classmethod
    def sources(cls, path: Path, *, split_bag: bool) -> list[Source] | None:
        del split_bag
        if not (path / "meta" / "info.json").is_file():
            return None
        with _as_recording_errors():
            dataset, found = Dataset(path), []
            for i in range(dataset.num_episodes):
                videos = [dataset.video(i, camera).path for camera in dataset.cameras]
                # a video that was not copied is missed by those who read it
                files = (
                    dataset.data_file(i),
                    *(file for file in videos if file.is_file()),
                )
                found.append(Source(path, files, f"episode_{i:06d}"))
            return found

    @functools.cached_property
    def dataset(self) -> Dataset:
        """The dataset of which the recording is an episode."""
        with _as_recording_errors():
            return Dataset(self.source.path)

    @functools.cached_property
    def index(self) -> int:
        """Index of the episode in its dataset."""
        found = re.fullmatch(r"episode_(\d+)", self.source.part or "")
        if found is None:
            raise RecordingError(
                f"{self.source.name}: does not name an episode; give the folder of a LeRobot dataset"
            )
        return int(found[1])

    @functools.cached_property
    def _pads(self) -> dict[str, tuple[str, str]]:
        """Topic → (feature, pad) of every feature that is pads' newest readings."""
        spec, present = self.dataset.spec, self.dataset.info["features"]
        single = [
            k for k in spec.sensors if k in present and spec.features[k].history == 1
        ]
        return {
            f"{key}/{pad}": (key, pad)
            for key in single
            for pad in spec.features[key].pads
        }

    def topics(self) -> dict[str, TopicType]:
        found, spec = {TASK: TopicType("String", "lerobot")}, self.dataset.spec
        for key, f in self.dataset.info["features"].items():
            shape, kind = tuple(f["shape"]), f["dtype"]
            if kind == "string":
                found[key] = TopicType("String", "lerobot")
            elif key not in BOOKKEEPING:
                why = (
                    self.dataset.skipped.get(key)
                    if kind in ("video", "image")
                    else None
                )
                names = (
                    spec.features[key].names
                    if key in spec.features and kind not in ("video", "image")
                    else ()
                )
                found[key] = TopicType(kind, "lerobot", why, shape, names)
        for topic, (key, _) in self._pads.items():
            sensor = spec.sensors[key]
            found[topic] = TopicType(
                sensor.wire.dtype, "lerobot", None, (sensor.rows * sensor.columns,)
            )
        return found

    def read(self, query: Query, damage: list[Damage]) -> Generator[Message, None, str]:
        known = self.topics()
        asked = [topic for topic in known if query.asks(topic)]
        self.check_decodable(known, query, self.source.name)
        with _as_recording_errors(), contextlib.ExitStack() as stack:
            self._check_action_time()
            unprotected = self._compare_digests()
            times, tasks, num_rows = (
                self._times_ns(asked),
                dict(self.dataset.tasks(self.index)),
                self.dataset.num_rows(self.index),
            )
            self._describe(tasks)
            inside = {
                t: np.array([query.covers(x) for x in times[t]], dtype=bool)
                for t in asked
            }
            if TASK in inside:
                inside[TASK] &= np.isin(np.arange(num_rows), list(tasks))
            read = [t for t in asked if query.reads(t)]
            values: dict[str, Any] = self._numbers(
                [t for t in read if known[t].name != "video" and t != TASK]
            )
            films = {
                t: self._film(t, inside[t]) for t in read if known[t].name == "video"
            }
            for film in films.values():
                stack.enter_context(contextlib.closing(film))
            for k in range(num_rows):
                for topic in asked:
                    if inside[topic][k]:
                        value = (
                            next(films[topic])
                            if topic in films
                            else values[topic][k]
                            if topic in values
                            else None
                        )
                        value = tasks[k] if topic == TASK and topic in read else value
                        yield Message(topic, int(times[topic][k]), None, value)
        return unprotected

    def _compare_digests(self) -> str:
        """Compare the episode's files, and those in ``meta/``, with the dataset's manifest. Returns why nothing protects
        them; empty if the manifest does. Raises RecordingError: a file is not what was written."""
        root = self.source.path
        digests = read_manifest(root).get("files")
        if not isinstance(digests, dict) or not digests:
            return "the dataset holds no digests of its files (a manifest of taccorl): changed bytes that still decode are read"
        meta = [
            name for name in digests if name.startswith("meta/") and name != _STATISTICS
        ]
        for name in (
            *(file.relative_to(root).as_posix() for file in self.source.files),
            *meta,
        ):
            path = root / name
            if (
                name in digests
                and path.is_file()
                and _digest(path, tuple(stamp(path))) != digests[name]
            ):
                text = f"{self.source.name}: {name} is not what was written (SHA-256 in {MANIFEST_PLACES[1]}): copy "
                raise RecordingError(
                    f"{text}the dataset again, or, if you changed it yourself, remove that manifest"
                )
        return ""

    def _check_action_time(self) -> None:
        """Check that ``lead_frames`` of the command is 1 if the dataset is one of ours, which states its ``action_time``."""
        action_time = self.dataset.spec.action_time
        commands = (
            self.spec.features[ACTION].channels
            if self.spec and ACTION in self.spec.features
            else ()
        )
        for name in commands if action_time else ():
            assert self.spec is not None
            channel = self.spec.channels[name]
            if channel.topic == ACTION and channel.lead_frames not in (1, None):
                meaning = (
                    "sent after row k"
                    if action_time == "this_row"
                    else "reached at row k + 1"
                )
                text = f"{self.source.name}: row k of its {ACTION} is the command {meaning} ({_SPEC_FILE}: action_time "
                text += f"{action_time}): channel {name!r} has `lead_frames: {channel.lead_frames}`, it needs 1"
                raise RecordingError(text)

    def _times_ns(self, topics: list[str]) -> dict[str, list[int]]:
        """Times of the rows per topic [ns]: by number where they are k / fps, else as stamped."""
        stamped_s = (
            self.dataset.values(self.index, ["timestamp"])["timestamp"]
            .ravel()
            .astype(float)
        )
        way_out = f"`taccorl check {shlex.quote(str(self.source.path))} --repair=COPY` writes a copy with the right "
        way_out += "ones"
        check_stamps(stamped_s, f"{self.source.name}: `timestamp`", way_out)
        fps = self.dataset.spec.fps
        clock, rows = (
            RowClock.of(float(fps), self.spec),
            np.rint(stamped_s * fps).astype(np.int64),
        )
        if np.abs(stamped_s - rows / fps).max(initial=0.0) < REGULAR_S:
            rows -= rows[:1]  # stamps that run on over the episodes
            return {t: [clock.time_ns(t, int(row)) for row in rows] for t in topics}
        stamped_ns = np.rint(stamped_s * NS_PER_S).astype(np.int64)
        return {t: (stamped_ns + clock.time_ns(t, 0)).tolist() for t in topics}

    def _describe(self, tasks: dict[int, str]) -> None:
        told = self.dataset.episode_facts(self.index)
        record = {"instruction": next(iter(tasks.values()), "")}
        record |= (
            {"success": str(told["success"]).lower()}
            if told.get("success") is not None
            else {}
        )
        self.metadata["episode"] = record | (
            labelled(told["origin"]) if told.get("origin") else {}
        )

    def _numbers(self, topics: list[str]) -> dict[str, np.ndarray]:
        """(T, …) values of features, and counts of single pads as their wire spec orders them."""
        stored = self.dataset.values(
            self.index,
            sorted({self._pads[t][0] if t in self._pads else t for t in topics}),
        )
        found = {t: stored[t] for t in topics if t not in self._pads}
        for topic, (key, pad) in self._pads.items():
            if topic in topics:
                feature, sensor = (
                    self.dataset.spec.features[key],
                    self.dataset.spec.sensors[key],
                )
                baseline = (
                    self.dataset.episode_facts(self.index)
                    .get("baselines", {})
                    .get(key, 0)
                )
                shape = (-1, len(feature.pads), sensor.rows, sensor.columns)
                counts = (stored[key].astype(np.int64) + baseline).reshape(shape)
                frames = counts[:, feature.pads.index(pad)]
                found[topic] = (
                    frames.swapaxes(1, 2) if sensor.wire.transpose else frames
                ).reshape(len(frames), -1)
        return found

    def _film(self, key: str, inside: np.ndarray) -> Generator[np.ndarray, None, None]:
        rows = np.flatnonzero(inside)
        first, end = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        return self.dataset.frames(self.index, key, first, end)


@contextlib.contextmanager
def _as_recording_errors() -> Iterator[None]:
    try:
        yield
    except DatasetError as error:
        raise RecordingError(str(error)) from error
