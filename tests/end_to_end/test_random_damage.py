"""600 recordings with random damage, 120 of each format: each ends in an outcome in plain words. If a row differs from that of
the intact recording, the report names damage, or it says that the format cannot show it. The samples and rows of the intact
recording are kept, or the report lists them as lost.

Damage is a flipped bit, a changed byte, zeros or noise, a cut, bytes lost or put in; places are drawn from a seed.
"""

import dataclasses
import json
import random
import shutil
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import StoragePlugin, Writer
from small_arm import messages, write_bag, write_spec

from taccorl.data.cutting import BrokenPicture, Cutter
from taccorl.data.episode import Episode
from taccorl.data.ingest import find_jobs, ingest_one
from taccorl.data.recording import find_sources, opened
from taccorl.data.spec import RecordingSpec, load_recording_spec
from taccorl.errors import TaccorlError
from tests.recordings.stand_in import StandInConfig, write_cobot_magic_hdf5, write_mcap

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]
NUM_EACH = 120
STAND_IN = StandInConfig(
    duration_s=2.5, seed=5, camera_size=(48, 64), chunk_size_bytes=64 * 1024
)
OUTCOMES = {"written", "split", "quarantined", "refused"}


def bag_of(mcap: Path, folder: Path) -> Path:
    """The same messages in an SQLite bag."""
    with (
        Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3) as bag,
        mcap.open("rb") as file,
    ):
        connections: dict[int, Any] = {}
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.id not in connections:
                connections[channel.id] = bag.add_connection(
                    channel.topic,
                    schema.name,
                    msgdef=schema.data.decode(),
                    rihs01="RIHS01_" + "0" * 64,
                )
            bag.write(connections[channel.id], message.log_time, message.data)
    return next(folder.glob("*.db3"))


def damaged(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    """What was done, and the result."""
    kind = rng.choice(["bit", "byte", "zeros", "noise", "cut", "lost", "put in"])
    at, size = rng.randrange(len(data)), rng.choice([16, 512, 4096])
    if kind == "bit":
        changed = data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    elif kind == "byte":
        changed = data[:at] + bytes([data[at] ^ rng.randrange(1, 256)]) + data[at + 1 :]
    elif kind in ("zeros", "noise"):
        size = min(size, len(data) - at)
        changed = (
            data[:at]
            + (bytes(size) if kind == "zeros" else rng.randbytes(size))
            + data[at + size :]
        )
    else:
        changed = {
            "cut": data[:at],
            "lost": data[:at] + data[at + size :],
            "put in": data[:at] + rng.randbytes(size) + data[at:],
        }[kind]
    return f"{kind} at {at} of {len(data)}, size {size}", changed


def rows_of(episodes: list[Episode]) -> dict[int, tuple[bytes, ...]]:
    """Time of a row [ns] → its numbers and pictures."""
    found = {}
    for episode in episodes:
        pictures = (
            list(episode.pictures())
            if episode.picture_keys
            else [{}] * episode.num_rows
        )
        for row, shown in enumerate(pictures):
            numbers = (array[row].tobytes() for array in episode.arrays.values())
            time_ns = episode.start_ns + round(row * 1e9 / episode.spec.fps)
            found[time_ns] = (
                *numbers,
                *(picture.tobytes() for picture in shown.values()),
            )
    return found


def rows_read(base: "Base", part: int = 0) -> dict[int, tuple[bytes, ...]]:
    """As ``taccorl ingest`` reads a recording (of a dataset: an episode): a broken picture is left out."""
    _, source = find_sources(base.path, reader=base.spec.reader)[part]
    with opened(source, base.spec) as recording:
        cutter = Cutter(recording)
        try:
            return rows_of(cutter.cut().episodes)
        except BrokenPicture:
            cutter.drop_broken_pictures()
            return rows_of(cutter.cut().episodes)


@dataclasses.dataclass(frozen=True)
class Base:
    """An intact recording, and the files of it that are damaged."""

    path: Path
    spec: RecordingSpec
    files: tuple[Path, ...]

    def entries(self, store: Path) -> list[dict[str, Any]]:
        """Entry of each recording in ingest's report."""
        return [
            ingest_one(job)
            for job in find_jobs([self.path], self.spec, "spec", store, dry_run=True)
        ]


def made(kind: str, folder: Path, dataset: Path) -> Base:
    if kind == "hdf5":
        write_cobot_magic_hdf5(folder / "base.hdf5", STAND_IN)
        return Base(
            folder / "base.hdf5",
            load_recording_spec("cobot_magic_hdf5"),
            (folder / "base.hdf5",),
        )
    if kind == "lerobot":
        root = Path(
            shutil.copytree(
                dataset,
                folder / "base",
                ignore=shutil.ignore_patterns(".*", "README.md"),
            )
        )
        files = tuple(
            p
            for p in sorted(root.rglob("*"))
            if p.is_file() and "taccorl" not in p.parts
        )
        return Base(root, load_recording_spec("taccorl_lerobot"), files)
    if kind == "rosbag1":
        bag = write_bag(folder / "base.bag", messages(STAND_IN.duration_s), 1)
        return Base(
            bag, load_recording_spec(write_spec(folder, reader="rosbag1")), (bag,)
        )
    write_mcap(folder / "base.mcap", STAND_IN)
    spec = load_recording_spec("piper_flexitac_mcap")
    if kind == "mcap":
        return Base(folder / "base.mcap", spec, (folder / "base.mcap",))
    file = bag_of(folder / "base.mcap", folder / "bag")
    return Base(file, dataclasses.replace(spec, reader="db3"), (file,))


Rows = dict[int, tuple[bytes, ...]]


def wrong(entries: list[dict[str, Any]]) -> str:
    """What is not right about the outcomes of a damaged file by themselves; empty if all is."""
    for one in entries:
        if one["outcome"] not in OUTCOMES or not (
            one["reason"] or one["outcome"] == "written"
        ):
            return f"outcome {one['outcome']!r}, reason {one['reason']!r}"
        if "traceback" in one:
            return one["traceback"][-600:]
        for channel, counts in one["samples"].items():
            if counts["messages"] != sum(
                count for reason, count in counts.items() if reason != "messages"
            ):
                return f"samples of {channel} do not add up: {counts}"
        lost = sum(loss["rows"] for loss in one["losses"] if loss["wanted"])
        lost += sum(e["rows"] for e in one["episodes"] if e["outcome"] == "quarantined")
        if one["episodes"] and one["rows_lost"] != lost:
            return f"{one['rows_lost']} rows lost, but the losses have {lost}"
    return ""


def rows_of_entry(entry: dict[str, Any]) -> int:
    return (
        sum(e["rows"] for e in entry["episodes"] if e["outcome"] == "written")
        + entry["rows_lost"]
    )


def span_ns(base: "Base", part: int = 0) -> tuple[int, int]:
    """Times of the first and the last sample of any channel that can be read [ns]."""
    _, source = find_sources(base.path, reader=base.spec.reader)[part]
    with opened(source, base.spec) as recording:
        clocks = Cutter(recording).clocks.values()
        return min(int(c.time_ns[0]) for c in clocks), max(
            int(c.time_ns[-1]) for c in clocks
        )


Span = tuple[int, int]


def gone_in_silence(
    entries: list[dict[str, Any]],
    clean: list[dict[str, Any]],
    spans_ns: list[Span],
    span_of: Callable[[int], Span],
    fps: int,
) -> str:
    """What the intact recording has and the damaged one neither has nor lists; empty if there is nothing. A recording that is not
    written states why.
    """
    for part, (entry, whole) in enumerate(zip(entries, clean, strict=False)):
        if entry["outcome"] not in ("written", "split"):
            continue
        first_ns, last_ns = span_of(part)
        ends_ns = max(0, first_ns - spans_ns[part][0]) + max(
            0, spans_ns[part][1] - last_ns
        )
        gone = rows_of_entry(whole) - rows_of_entry(entry)
        is_told = any(d["lost"] for d in entry["damage"])
        # 1 more: where the rows begin; and the last command is no row of its own
        if gone > (ends_ns * fps / 1e9 if is_told else 0) + 2:
            return f"{gone} rows are neither written nor lost; {ends_ns / 1e9:.3f} s of the ends are not read"
        for channel, counts in whole["samples"].items():
            found = entry["samples"][channel]["messages"]
            if found < counts["messages"] and not is_told:
                return f"{channel} has {found} of {counts['messages']} messages"
    if len(entries) < len(clean):
        return f"{len(entries)} of {len(clean)} recordings"
    return ""


def shortened(entry: dict[str, Any]) -> dict[str, Any]:
    """By five rows that no loss lists."""
    first, *others = entry["episodes"]
    return entry | {"episodes": [first | {"rows": first["rows"] - 5}, *others]}


def with_fewer_messages(entry: dict[str, Any]) -> dict[str, Any]:
    """By one of the first channel, of which nothing is said."""
    (name, counts), *_ = entry["samples"].items()
    return entry | {
        "samples": entry["samples"]
        | {name: counts | {"messages": counts["messages"] - 1}}
    }


def changed_in_silence(
    base: Base, entries: list[dict[str, Any]], intact: list[Rows]
) -> list[bool]:
    """For each recording that was written with other rows than the intact one and without a warning, whether its entry states
    that the format cannot show it."""
    found = []
    for part, (entry, expected) in enumerate(zip(entries, intact, strict=False)):
        warned = any(
            f["severity"] != "note" for e in entry["episodes"] for f in e["findings"]
        )
        if entry["outcome"] == "written" and not warned:
            shown = rows_read(base, part)
            if any(expected[t] != row for t, row in shown.items() if t in expected):
                found.append(bool(entry["unprotected"]))
    return found


@pytest.mark.parametrize("kind", ["mcap", "db3", "rosbag1", "hdf5", "lerobot"])
def test_random_damage_ends_in_the_right_outcome(
    kind, dataset, tmp_path, record_property
):
    base = made(kind, tmp_path, dataset)
    clean = base.entries(tmp_path / "store")
    assert {one["outcome"] for one in clean} == {"written"}
    spans_ns = [span_ns(base, part) for part in range(len(clean))]
    gone = partial(
        gone_in_silence, clean=clean, spans_ns=spans_ns, fps=base.spec.target.fps
    )
    assert wrong(clean) == gone(clean, span_of=spans_ns.__getitem__) == ""
    for change in (shortened, with_fewer_messages):
        assert gone([change(clean[0]), *clean[1:]], span_of=spans_ns.__getitem__), (
            "the comparison finds nothing"
        )
    intact = [rows_read(base, part) for part in range(len(clean))]
    assert all(len(rows) > 45 for rows in intact)
    contents = {path: path.read_bytes() for path in base.files}
    rng, failed, outcomes = random.Random(f"{kind} 1"), [], Counter[str]()
    for _ in range(NUM_EACH):
        path = rng.choice(base.files)
        what, changed = damaged(contents[path], rng)
        path.write_bytes(changed)
        try:
            entries = base.entries(tmp_path / "store")
            fault = wrong(entries)
            silent = changed_in_silence(base, entries, intact) if not fault else []
            if not all(silent):
                fault = "rows differ, and nothing states that"
            fault = fault or gone(entries, span_of=partial(span_ns, base))
            outcomes["changed, and the format cannot show it"] += bool(silent)
            outcomes.update({one["outcome"] for one in entries})
        except TaccorlError as error:  # no recording was found: said in one line
            fault = "" if str(error) else "no words"
            outcomes["not found"] += 1
        if path.read_bytes() != changed:
            fault = "the file was written to"
        if fault:
            failed.append(f"{path.name}: {what}: {fault}")
        path.write_bytes(contents[path])
    print(kind, json.dumps(outcomes))
    for name, value in {"files": NUM_EACH, "wrong": len(failed), **outcomes}.items():
        record_property(f"{kind}: {name}", value)
    assert not failed, "\n".join(failed)
