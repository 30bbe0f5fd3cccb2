"""A LeRobot v3 dataset as recordings, one per episode: for datasets that others recorded, or to convert a dataset to another
spec.

Topics are feature keys and ``task``. A taccorl dataset's touch also comes pad by pad, as ``<feature>/<pad>``: counts as the
pad sent them (baseline added back, wire order), since a recording spec reads pads from the wire. Pictures are decoded from
videos, so that writing them again compresses them twice.
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
from taccorl.data.recording import Message, Reader, Source, Topics, TopicType, readers
from taccorl.data.spec import ACTION
from taccorl.data.timing import NS_PER_S, check_stamps
from taccorl.errors import DatasetError, RecordingError
from taccorl.lineage.digest import digest_file, stamp
from taccorl.lineage.manifest import MANIFEST_PLACES, read_manifest

TASK = "task"  # Topic of the instructions
_SPEC_FILE = "meta/taccorl/dataset_spec.json"
_STATISTICS = "meta/stats.json"  # Not read here; LeRobot's own command writes it anew (recompute_stats)
REGULAR_S = 1e-3
"""Largest difference of a time stamp from k / fps at which the row is still row k [s]; stamps are float32."""


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
        """Return one recording per episode of a dataset's folder; None for another path."""
        del split_bag
        if not (path / "meta" / "info.json").is_file():
            return None
        with _as_recording_errors():
            dataset = Dataset(path)
            videos = [k for k, f in dataset.info["features"].items() if f["dtype"] == "video"]
            cameras = [k for k in videos if k not in dataset.unstored]
            found = []
            for i in range(dataset.num_episodes):
                files = [dataset.video(i, camera).path for camera in cameras]
                # a video that was not copied is missed by those who read it
                files = [dataset.data_file(i), *(file for file in files if file.is_file())]
                found.append(Source(path, tuple(files), f"episode_{i:06d}"))
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
            raise RecordingError(f"{self.source.name}: does not name an episode; give the folder of a LeRobot dataset")
        return int(found[1])

    def topics(self) -> dict[str, TopicType]:
        found = {TASK: TopicType("String", "lerobot")}
        for key, f in self.dataset.info["features"].items():
            shape = tuple(f["shape"])
            if key in BOOKKEEPING:
                continue
            if f["dtype"] == "string":
                found[key] = TopicType("String", "lerobot")
            elif f["dtype"] in ("video", "image"):
                found[key] = TopicType(f["dtype"], "lerobot", self.dataset.skipped.get(key), shape)
            else:
                feature = self.dataset.spec.features.get(key)
                found[key] = TopicType(f["dtype"], "lerobot", None, shape, feature.names if feature else ())
        for key, pad in self._pads():
            sensor = self.dataset.spec.sensors[key]
            found[f"{key}/{pad}"] = TopicType(sensor.wire.dtype, "lerobot", None, (sensor.rows * sensor.columns,))
        return found

    def messages(
        self, topics: Topics | None, *, stamps_only: Topics = (), start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        known = self.topics()
        asked = [topic for topic in known if topics is None or topic in topics]
        read = [t for t in asked if topics is not None and t not in stamps_only]
        for topic in read:
            if known[topic].undecodable:
                raise RecordingError(f"{self.source.name}: {topic}: {known[topic].undecodable}")
        with _as_recording_errors(), contextlib.ExitStack() as stack:
            self._check_action_time()
            self.unprotected = self._compare_digests()
            log_ns = self._times_ns(asked)
            tasks = dict(self.dataset.tasks(self.index))
            self._describe(tasks)
            inside = {t: _inside(times, start_ns, end_ns) for t, times in log_ns.items()}
            if TASK in inside:
                inside[TASK] &= np.isin(np.arange(self.dataset.num_rows(self.index)), list(tasks))
            numbers = self._numbers([t for t in read if known[t].name != "video" and t != TASK])
            films = {t: stack.enter_context(self._film(t, inside[t])) for t in read if known[t].name == "video"}
            for k in range(self.dataset.num_rows(self.index)):
                for topic in asked:
                    if not inside[topic][k]:
                        continue
                    value: Any = None
                    if topic in films:
                        value = next(films[topic])
                    elif topic in numbers:
                        value = numbers[topic][k]
                    elif topic in read:
                        value = tasks[k]
                    yield Message(topic, int(log_ns[topic][k]), None, value)

    def _compare_digests(self) -> str:
        """Compare the episode's files, and those in ``meta/``, with the dataset's manifest. Returns why nothing protects
        them; empty if the manifest does. Raises RecordingError: a file is not what was written."""
        root = self.source.path
        digests = read_manifest(root).get("files")
        if not isinstance(digests, dict) or not digests:
            return "the dataset holds no digests of its files (a manifest of taccorl): changed bytes that still decode are read"
        meta = [name for name in digests if name.startswith("meta/") and name != _STATISTICS]
        for name in (*(file.relative_to(root).as_posix() for file in self.source.files), *meta):
            path = root / name
            if name in digests and path.is_file() and _digest(path, tuple(stamp(path))) != digests[name]:
                raise RecordingError(
                    f"{self.source.name}: {name} is not what was written (SHA-256 in {MANIFEST_PLACES[1]}): copy the dataset "
                    "again, or, if you changed it yourself, remove that manifest"
                )
        return ""

    def _check_action_time(self) -> None:
        """Check that ``lead_frames`` of the command agrees with the ``action_time`` that one of our datasets states."""
        if self.spec is None or ACTION not in self.spec.features:
            return
        lead = 1 if self.dataset.spec.action_time else self._lead_without_action_time()
        for name in self.spec.features[ACTION].channels:
            channel = self.spec.channels[name]
            if lead is not None and channel.topic == ACTION and channel.lead_frames not in (lead, None):
                meaning = "reached at row k + 1" if lead else "in force at row k"
                meaning = "sent after row k" if self.dataset.spec.action_time == "this_row" else meaning
                stated = self.dataset.spec.action_time or "is not stated, an older taccorl ingested it"
                raise RecordingError(
                    f"{self.source.name}: row k of its {ACTION} is the command {meaning} ({_SPEC_FILE}: action_time {stated}): "
                    f"channel {name!r} has `lead_frames: {channel.lead_frames}`, it needs {lead}"
                )

    def _lead_without_action_time(self) -> int | None:
        """Rows by which actions lead states where ``action_time`` is missing: 1 if the twin made the dataset, 0 if ingest did,
        else None."""
        if not (self.source.path / _SPEC_FILE).is_file():
            return None
        provenance = self.dataset.episode_facts(self.index).get("provenance") or {}
        return 1 if provenance.get("simulation") else 0

    def _pads(self) -> list[tuple[str, str]]:
        """(feature, pad) of every feature that is pads' newest readings."""
        spec, present = self.dataset.spec, self.dataset.info["features"]
        single = [k for k in spec.sensors if k in present and spec.features[k].history == 1]
        return [(key, pad) for key in single for pad in spec.features[key].pads]

    def _times_ns(self, topics: list[str]) -> dict[str, np.ndarray]:
        """(T,) int64 per topic: row times by number where they are k / fps, else as stamped."""
        stamped_s = self.dataset.values(self.index, ["timestamp"])["timestamp"].ravel().astype(float)
        way_out = (
            f"`taccorl check {shlex.quote(str(self.source.path))} --repair=COPY` writes a copy with the right ones"
        )
        check_stamps(stamped_s, f"{self.source.name}: `timestamp`", way_out)
        fps = self.dataset.spec.fps
        clock, rows = RowClock.of(float(fps), self.spec), np.rint(stamped_s * fps).astype(np.int64)
        if np.abs(stamped_s - rows / fps).max(initial=0.0) < REGULAR_S:
            rows -= rows[:1]  # stamps that run on over the episodes
            return {t: np.array([clock.time_ns(t, int(row)) for row in rows], dtype=np.int64) for t in topics}
        stamped_ns = np.rint(stamped_s * NS_PER_S).astype(np.int64)
        return {t: stamped_ns + clock.time_ns(t, 0) for t in topics}

    def _describe(self, tasks: dict[int, str]) -> None:
        told = self.dataset.episode_facts(self.index)
        record = {"instruction": next(iter(tasks.values()), "")}
        if told.get("success") is not None:
            record["success"] = str(told["success"]).lower()
        if told.get("origin"):
            record |= labelled(told["origin"])
        self.metadata["episode"] = record

    def _numbers(self, topics: list[str]) -> dict[str, np.ndarray]:
        """(T, …) values of features and single pads."""
        pads = {f"{key}/{pad}": (key, pad) for key, pad in self._pads()}
        features = {pads[t][0] if t in pads else t for t in topics}
        stored = self.dataset.values(self.index, sorted(features))
        return {t: self._wire_counts(*pads[t], stored[pads[t][0]]) if t in pads else stored[t] for t in topics}

    def _wire_counts(self, key: str, pad: str, stored: np.ndarray) -> np.ndarray:
        """(T, rows · columns) counts of one pad as its wire spec orders them."""
        feature, sensor = self.dataset.spec.features[key], self.dataset.spec.sensors[key]
        baseline = self.dataset.episode_facts(self.index).get("baselines", {}).get(key, 0)
        counts = stored.astype(np.int64) + baseline
        frames = counts.reshape(len(stored), len(feature.pads), sensor.rows, sensor.columns)[:, feature.pads.index(pad)]
        return (frames.swapaxes(1, 2) if sensor.wire.transpose else frames).reshape(len(stored), -1)

    def _film(self, key: str, inside: np.ndarray) -> contextlib.closing[Generator[np.ndarray, None, None]]:
        rows = np.flatnonzero(inside)
        first, end = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        return contextlib.closing(self.dataset.frames(self.index, key, first, end))


def _inside(times_ns: np.ndarray, start_ns: int | None, end_ns: int | None) -> np.ndarray:
    after = times_ns >= start_ns if start_ns is not None else np.ones(len(times_ns), dtype=bool)
    return after & (times_ns <= end_ns) if end_ns is not None else after


@contextlib.contextmanager
def _as_recording_errors() -> Iterator[None]:
    try:
        yield
    except DatasetError as error:
        raise RecordingError(str(error)) from error
