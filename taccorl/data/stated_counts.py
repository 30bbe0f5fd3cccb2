"""Numbers of messages that a container states about itself, compared with those that
were read: what lacks is damage, topic by topic."""

import contextlib
import itertools
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from taccorl.data.recording import Damage, Source
from taccorl.data.strict_yaml import load_yaml
from taccorl.data.timing import NS_PER_S
from taccorl.errors import RecordingError, SpecError

METADATA = "metadata.yaml"
MOST_METADATA_BYTES = 1 << 20
"""Largest metadata.yaml of a bag that is read; rosbag2 writes 1 to 2 kB for each topic."""
PACKED = ".zstd"  # Ending of the files of a bag that rosbag2 compressed one by one
LATE_S = 0.05
"""Time at the end without a message from which on a stated end is called missing [s]."""


@dataclass(frozen=True)
class StatedCounts:
    """What a container states about its messages."""

    by: str
    """Part of the container that states it, for messages."""
    topics: Mapping[str, int] = field(default_factory=dict)
    """Topic → number of its messages; empty where only the sum is stated."""
    total: int = 0
    """Number of all messages; 0 if it is not stated."""
    end_ns: int | None = None
    """Log time of the last message [ns]; None if it is not stated."""

    def compared(
        self, file: Path, found: Counter[str], last_ns: int | None, way_out: str = ""
    ) -> list[Damage]:
        """Damage for messages that are stated and were not found; empty if there are
        none.

        Args:
            file: what was read, for the damage.
            found: topic → number of messages that were read.
            last_ns: greatest log time that was read [ns]; None without messages.
            way_out: text with the remedy.
        """
        lacking = {
            topic: number - found[topic]
            for topic, number in self.topics.items()
            if number > found[topic]
        }
        stated = max(self.total, sum(self.topics.values()))
        unnamed = stated - found.total() - sum(lacking.values())
        if unnamed > 0 and not lacking:
            lacking[""] = unnamed
        if not lacking:
            return []
        text = f"{self.by} counts {stated:,} messages, {found.total():,} are there"
        start_ns, end_ns = last_ns, self.end_ns
        if start_ns is None or end_ns is None or end_ns - start_ns < LATE_S * NS_PER_S:
            start_ns, end_ns = None, None
        else:
            text += f", the last {(end_ns - start_ns) / NS_PER_S:.2f} s are missing"
        if way_out:
            text += f". {way_out}"
        missing = tuple(lacking.items())
        return [Damage(str(file), 0, 0, text, start_ns, end_ns, missing=missing)]


def added(counted: list[Damage], damage: list[Damage]) -> None:
    """Add damage ``counted`` by ``compared`` to other ``damage``, in place. Where some
    was found already that cost messages, it is said there how many."""
    known = [k for k, other in enumerate(damage) if other.lost]
    if not (counted and known):
        damage += counted
        return
    first, count = damage[known[0]], counted[0]
    times_ns = first.start_ns, first.end_ns
    if times_ns == (None, None):
        times_ns = count.start_ns, count.end_ns
    damage[known[0]] = replace(
        first, missing=count.missing, start_ns=times_ns[0], end_ns=times_ns[1]
    )


def lacking_files(source: Source) -> list[Damage]:
    """Damage for files of a split bag whose numbers lie between those of others, as
    where one was not copied; none where metadata.yaml names the files."""
    found = [re.fullmatch(r"(.*?)(\d+)", path.stem) for path in source.files]
    numbered = [(m[1], int(m[2])) for m in found if m is not None]
    damage = []
    for (prefix, number), (other, following) in itertools.pairwise(numbered):
        if prefix == other and following > number + 1 and not metadata_of(source):
            suffix = source.files[0].suffix
            text = f"{prefix}{number + 1}{suffix}"
            if following > number + 2:
                text += f" … {prefix}{following - 1}{suffix}"
            reason = f"{text} is not there, between the files of the split bag: copy it"
            damage.append(Damage(str(source.path), 0, 0, reason))
    return damage


# ---- metadata.yaml of rosbag2 ----


def bag_metadata(folder: Path) -> dict[str, Any]:
    """What metadata.yaml of a rosbag2 folder states. Raises RecordingError: it is no
    such file."""
    index = folder / METADATA
    try:
        found = load_yaml(index, MOST_METADATA_BYTES)["rosbag2_bagfile_information"]
        found["relative_file_paths"] = [
            Path(name).name.removesuffix(PACKED)
            for name in found["relative_file_paths"]
        ]
    except (SpecError, KeyError, TypeError) as error:
        raise RecordingError(
            f"{index}: no metadata file of rosbag2 ({type(error).__name__}: {error})"
        ) from error
    return found


def metadata_of(source: Source) -> dict[str, Any]:
    """What metadata.yaml states about the bag of a recording; empty if there is none
    that names its files."""
    folder = source.path if source.path.is_dir() else source.path.parent
    with contextlib.suppress(RecordingError):
        found = bag_metadata(folder)
        if {path.name for path in source.files} <= {*found["relative_file_paths"]}:
            return found
    return {}


def bag_counts(source: Source) -> list[tuple[StatedCounts, tuple[Path, ...]]]:
    """What metadata.yaml counts, and in which files of the recording: in all of them
    topic by topic, if they are the whole bag, and in each file, if it counts that.
    Raises RecordingError: a count is no number of messages."""
    found, stated = metadata_of(source), []
    by_name = {path.name: path for path in source.files}
    with contextlib.suppress(KeyError, TypeError):  # not stated
        for file in found.get("files") or ():
            name = Path(file["path"]).name.removesuffix(PACKED)
            if name in by_name and len(found["relative_file_paths"]) > 1:
                number = _count(source, name, file["message_count"])
                stated.append((StatedCounts(METADATA, total=number), (by_name[name],)))
    if {*by_name} != {*found.get("relative_file_paths", ())}:
        return stated
    with contextlib.suppress(KeyError, TypeError):
        topics: Counter[str] = Counter()
        for topic in found["topics_with_message_count"]:
            name = topic["topic_metadata"]["name"]
            topics[name] += _count(source, name, topic["message_count"])
        begin_ns = found["starting_time"]["nanoseconds_since_epoch"]
        length_ns = found["duration"]["nanoseconds"]
        end_ns = sum(_count(source, "its times", ns) for ns in (begin_ns, length_ns))
        total = _count(source, "the bag", found["message_count"])
        stated.insert(0, (StatedCounts(METADATA, topics, total, end_ns), source.files))
    return stated


def _count(source: Source, what: str, stated: object) -> int:
    """Raises RecordingError: ``stated`` is no whole number, or below 0."""
    if not isinstance(stated, int) or isinstance(stated, bool) or stated < 0:
        raise RecordingError(
            f"{source.path}: {METADATA} states {stated!r} for {what}, which is no whole number "
            "of 0 or more: what lacks cannot be told. Correct it, or remove that file"
        )
    return stated
