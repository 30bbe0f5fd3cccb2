"""A container that counts more messages than it holds is never "whole": metadata.yaml
of a bag, the statistics and indexes of MCAP, the chunk infos of ROS 1, a log of SQLite
that was not copied. Each fixture removes known messages from a written file."""

import contextlib
import shutil
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore
from small_arm import COMMAND, STATE, ingest, messages, write_bag, write_spec

from taccorl.cli.main import main
from taccorl.data.recording import Damage, find_sources, readers
from taccorl.errors import RecordingError

START_NS, STEP_NS = 1_700_000_000_000_000_000, 10_000_000
NUM = 50  # Messages of each topic, one in 10 ms
TOPICS = ("/a", "/b")
KIND = "std_msgs/msg/Float64"
STORE = get_typestore(Stores.ROS2_HUMBLE)


def payload(value: float) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[KIND](data=value), KIND))


def write_ros2(path: Path, plugin: str, **options: Any) -> Path:
    """A bag folder: a message of each topic every 10 ms, with metadata.yaml."""
    storage = rosbag2.StoragePlugin[plugin]
    with rosbag2.Writer(path, version=9, storage_plugin=storage, **options) as writer:
        known = {t: writer.add_connection(t, KIND, typestore=STORE) for t in TOPICS}
        for k in range(NUM):
            for topic in TOPICS:
                writer.write(known[topic], START_NS + k * STEP_NS, payload(k))
    return path


def without(path: Path, drop: Any, **options: Any) -> None:
    """Write an MCAP file again without the messages for which ``drop(topic, k)``."""
    old = path.with_name("old")
    path.rename(old)
    with old.open("rb") as source, path.open("wb") as target:
        writer = Writer(target, **options)
        writer.start()
        channels: dict[str, int] = {}
        for schema, channel, m in make_reader(source).iter_messages():
            k = (m.log_time - START_NS) // STEP_NS
            if channel.topic not in channels:
                text = schema.name, schema.encoding, schema.data
                number = writer.register_schema(*text)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            if not drop(channel.topic, k):
                at = m.log_time
                writer.add_message(channels[channel.topic], at, m.data, at)
        writer.finish()
    old.unlink()


def delete(path: Path, where: str) -> None:
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute(f"DELETE FROM messages WHERE {where}")
        file.commit()


def damage_of(path: Path, topics: Any = None) -> list[Damage]:
    ((name, source),) = find_sources(path)
    reader = readers.get(name)(source)
    list(reader.messages(topics))
    return reader.damage


def missing(damage: list[Damage]) -> dict[str, int]:
    return {t: n for d in damage if d.lost for t, n in d.missing}


DROPS = {
    "the last 20 of both": (lambda topic, k: k >= 30, {"/a": 20, "/b": 20}),
    "one in the middle of /b": (lambda topic, k: topic == "/b" and k == 25, {"/b": 1}),
    "all of /a": (lambda topic, k: topic == "/a", {"/a": NUM}),
    "none": (lambda topic, k: False, {}),
}


@pytest.mark.parametrize("case", DROPS)
def test_what_metadata_counts_is_compared_with_an_mcap_bag(case, tmp_path):
    drop, expected = DROPS[case]
    bag = write_ros2(tmp_path / "bag", "MCAP")
    without(next(bag.glob("*.mcap")), drop)
    damage = damage_of(bag)
    assert missing(damage) == expected
    if "last" in case:  # from message 29 to message 49
        ends = [(d.start_ns - START_NS, d.end_ns - START_NS) for d in damage]
        assert ends == [(29 * STEP_NS, 49 * STEP_NS)]
    assert missing(damage_of(bag, {"/b"})) == expected  # other topics count, too


@pytest.mark.parametrize("given", ["folder", "file"])
@pytest.mark.parametrize("case", DROPS)
def test_what_metadata_counts_is_compared_with_a_db3_bag(case, given, tmp_path):
    drop, expected = DROPS[case]
    bag = write_ros2(tmp_path / "bag", "SQLITE3")
    path = next(bag.glob("*.db3"))
    gone = [2 * k + 1 + j for k in range(NUM) for j in range(2) if drop(TOPICS[j], k)]
    delete(path, f"id IN ({', '.join(map(str, gone)) or 'NULL'})")
    assert missing(damage_of(bag if given == "folder" else path)) == expected


def test_more_messages_than_metadata_counts_are_no_loss(tmp_path):
    """As of a metadata.yaml that was written before the last messages came."""
    bag = write_ros2(tmp_path / "bag", "SQLITE3")
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace(f": {NUM}\n", f": {NUM - 3}\n"))
    assert damage_of(bag) == []


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
@pytest.mark.parametrize("stated", ["many", -5, 2.5, True])
def test_a_count_that_is_none_is_refused_and_not_ignored(stated, plugin, tmp_path):
    bag = write_ros2(tmp_path / "bag", plugin)
    path = bag / "metadata.yaml"
    metadata = yaml.safe_load(path.read_text())
    of_topic = metadata["rosbag2_bagfile_information"]["topics_with_message_count"][0]
    of_topic["message_count"] = stated
    path.write_text(yaml.safe_dump(metadata))
    with pytest.raises(
        RecordingError, match=rf"metadata.yaml states {stated!r} for /a"
    ):
        damage_of(bag)


def split_bag(folder: Path) -> Path:
    """Three .db3 files of one bag, of 20, 20 and 10 messages of each topic."""
    bag = write_ros2(folder / "bag", "SQLITE3")
    whole = next(bag.glob("*.db3"))
    spans = ((0, 20), (20, 40), (40, 50))
    files = []
    for k, (first, end) in enumerate(spans):
        path = bag / f"rec_{k}.db3"
        shutil.copy(whole, path)
        delete(path, f"id <= {2 * first} OR id > {2 * end}")
        files.append({"path": path.name, "message_count": 2 * (end - first)})
    whole.unlink()
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    own = metadata["rosbag2_bagfile_information"]
    own["relative_file_paths"] = [file["path"] for file in files]
    own["files"] = files
    (bag / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    return bag


def test_the_files_of_a_split_bag_are_compared_together_and_one_by_one(tmp_path):
    bag = split_bag(tmp_path)
    assert damage_of(bag) == []
    delete(bag / "rec_1.db3", "id > 70")  # messages 71 to 80 of the bag
    assert missing(damage_of(bag)[:1]) == {"/a": 5, "/b": 5}
    (own,) = damage_of(bag / "rec_1.db3")  # metadata.yaml counts it in sum only
    assert dict(own.missing) == {"": 10} and "rec_1.db3" in str(own)
    assert damage_of(bag / "rec_2.db3") == []


@pytest.mark.parametrize("end", ["db3", "bag"])
def test_a_lacking_number_of_a_split_bag_without_metadata_is_damage(end, tmp_path):
    (tmp_path / "bag").mkdir()
    for k in (0, 1, 4):
        path = tmp_path / "bag" / f"rec_{k}.{end}"
        if end == "db3":
            made = write_ros2(tmp_path / f"b{k}", "SQLITE3")
            shutil.move(next(made.glob("*.db3")), path)
        else:
            write_ros1(path)
    ((name, source),) = find_sources(tmp_path / "bag", split_bag=True)
    reader = readers.get(name)(source)
    list(reader.messages(None))
    (damage,) = reader.damage
    assert damage.lost and f"rec_2.{end} … rec_3.{end}" in str(damage)


# ---- MCAP's own statistics and indexes ----


def write_mcap(path: Path, **options: Any) -> Path:
    """Chunks of a few messages each."""
    bag = write_ros2(path.with_suffix(""), "MCAP")
    shutil.move(next(bag.glob("*.mcap")), path)
    without(path, lambda topic, k: False, chunk_size=400, **options)
    return path


def records(data: bytes) -> list[tuple[int, int, int]]:
    """(opcode, begin, end) of every record."""
    at, found = 8, []
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        found.append((opcode, at, at + 9 + length))
        at += 9 + length
    return found


CHUNK, MESSAGE_INDEX, STATISTICS, METADATA = 0x06, 0x07, 0x0B, 0x0C


def test_an_intact_mcap_has_no_damage(tmp_path):
    assert damage_of(write_mcap(tmp_path / "a.mcap")) == []


@pytest.mark.parametrize("more", [1, 300])
def test_statistics_that_count_more_than_there_is_are_a_loss_by_topic(more, tmp_path):
    path = write_mcap(tmp_path / "a.mcap", enable_crcs=False)
    data = bytearray(path.read_bytes())
    ((_, begin, _),) = [r for r in records(data) if r[0] == STATISTICS]
    total, channel = begin + 9, begin + 9 + 46  # of the first channel: id, count
    (number,) = struct.unpack_from("<Q", data, total)
    struct.pack_into("<Q", data, total, number + more)
    struct.pack_into("<Q", data, channel + 2, NUM + more)
    path.write_bytes(data)
    assert sum(missing(damage_of(path)).values()) == more
    assert set(missing(damage_of(path))) < set(TOPICS)


def test_a_chunk_that_the_index_lists_and_that_is_not_there_is_a_loss(tmp_path):
    """The chunk and its message indexes are replaced by a metadata record of the same
    length, so that all offsets stay right; no statistics."""
    path = write_mcap(tmp_path / "a.mcap", use_statistics=False)
    data = bytearray(path.read_bytes())
    found = records(data)
    chunks = [k for k, r in enumerate(found) if r[0] == CHUNK]
    first, following = chunks[3], chunks[4]
    begin, end = found[first][1], found[following][1]
    size = end - begin - 9
    name = struct.pack("<I", size - 8) + b"x" * (size - 8)
    data[begin:end] = struct.pack("<BQ", METADATA, size) + name + bytes(4)
    path.write_bytes(data)
    lost = [d for d in damage_of(path) if d.lost]
    assert lost and lost[0].byte_start == begin
    assert lost[0].start_ns is not None


@pytest.mark.parametrize("copies", [0, 1])
def test_a_chunk_whose_bytes_are_missing_is_a_loss(copies, tmp_path):
    """The index behind it begins earlier than the footer says; with the copy of another
    chunk in its place, the counts of the topics are right."""
    path = write_mcap(tmp_path / "a.mcap")
    data = path.read_bytes()
    found = records(data)
    begins = [r[1] for r in found if r[0] == CHUNK]
    other = data[begins[2] : begins[3]]
    path.write_bytes(data[: begins[3]] + other * copies + data[begins[4] :])
    lost = [d for d in damage_of(path) if d.lost]
    assert lost and lost[0].start_ns is not None
    assert damage_of(write_mcap(tmp_path / "b.mcap")) == []


def test_indexes_of_chunks_that_list_more_messages_are_a_loss(tmp_path):
    """One entry more in a message index, without statistics and without a summary."""
    path = write_mcap(tmp_path / "a.mcap", use_statistics=False)
    data = path.read_bytes()
    begin, end = next(r[1:] for r in records(data) if r[0] == MESSAGE_INDEX)
    channel, size = struct.unpack_from("<HI", data, begin + 9)
    entry = data[end - 16 : end]
    more = struct.pack("<BQHI", 7, end - begin - 9 + 16, channel, size + 16)
    summary = next(r[1] for r in records(data) if r[0] == 0x0F)  # end of the data
    footer = struct.pack("<BQQQI", 2, 20, 0, 0, 0) + data[:8]
    body = data[:begin] + more + data[begin + 15 : end] + entry + data[end:summary]
    path.write_bytes(body + struct.pack("<BQI", 0x0F, 4, 0) + footer)
    assert sum(missing(damage_of(path)).values()) == 1


# ---- ROS 1 ----


def write_ros1(path: Path) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(path) as writer:
        known = {t: writer.add_connection(t, KIND, typestore=store) for t in TOPICS}
        for k in range(NUM):
            for topic in TOPICS:
                data = bytes(store.serialize_ros1(store.types[KIND](data=k), KIND))
                writer.write(known[topic], START_NS + k * STEP_NS, data)
    return path


def test_chunk_infos_of_a_ros_1_bag_that_count_more_are_a_loss_by_topic(tmp_path):
    """The last record of a bag: counts of its only chunk, (connection, number) each."""
    path = write_ros1(tmp_path / "a.bag")
    assert damage_of(path) == []
    data = bytearray(path.read_bytes())
    numbers = struct.unpack("<IIII", data[-16:])
    assert numbers == (0, NUM, 1, NUM)
    struct.pack_into("<I", data, len(data) - 4, NUM + 7)
    path.write_bytes(data)
    assert missing(damage_of(path)) == {"/b": 7}


# ---- HDF5 ----


@pytest.mark.parametrize(("stated", "lost"), [(60, 0), (50, 0), (75, 15)])
def test_rows_that_a_demonstration_counts_are_compared(stated, lost, tmp_path):
    import h5py

    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        group = file.create_group("data/demo_0")
        group.attrs["num_samples"] = stated
        group["actions"] = np.zeros((60, 7))
    assert sum(missing(damage_of(tmp_path / "a.hdf5")).values()) == lost


# ---- a write-ahead log of SQLite, by the commands ----


@pytest.fixture
def bag_with_log(tmp_path: Path) -> Path:
    """A bag of the small arm, whose messages after 1.5 s are in its write-ahead log;
    metadata.yaml counts all: 400, 400 and 120 in 4 s."""
    bag = write_bag(tmp_path / "bag", messages(), 2)
    path = next(bag.glob("*.db3"))
    live = tmp_path / "live.db3"
    with contextlib.closing(sqlite3.connect(path)) as file:
        rows = file.execute("SELECT * FROM messages ORDER BY id").fetchall()
    shutil.copy(path, live)
    delete(live, "TRUE")
    file = sqlite3.connect(live)
    with contextlib.closing(file):
        file.execute("PRAGMA journal_mode = WAL")
        file.execute("PRAGMA wal_autocheckpoint = 0")
        marks = ", ".join("?" * len(rows[0]))
        insert = f"INSERT INTO messages VALUES ({marks})"
        file.executemany(insert, rows[:345])
        file.commit()
        file.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        file.executemany(insert, rows[345:])
        file.commit()
        for end in ("", "-wal", "-shm"):
            shutil.copy(f"{live}{end}", f"{path}{end}")
    return bag


def test_a_log_that_was_not_copied_is_a_loss_with_its_rows(bag_with_log, capsys):
    """345 of 920 messages: 150 states and commands, 45 pictures, up to 1.49 s of 3.99."""
    next(bag_with_log.glob("*-wal")).unlink()
    spec = write_spec(bag_with_log.parent, reader="db3")
    code, entry = ingest(bag_with_log, spec)
    assert (code, entry["outcome"]) == (0, "split")
    assert "whole" not in capsys.readouterr().out
    (damage,) = entry["damage"]
    counted = dict(damage["missing"])
    assert counted[STATE] == counted[COMMAND] == 250 and counted["/top/image"] == 75
    assert "-wal" in damage["reason"]
    rows = sum(episode["rows"] for episode in entry["episodes"])
    assert rows + entry["rows_lost"] == pytest.approx(119.5, abs=2)
    assert 70 < entry["rows_lost"] < 78
    assert main(["ingest", "inspect", str(bag_with_log)]) == 1
    assert f"250 of {STATE}" in capsys.readouterr().out


def test_the_log_beside_a_bag_is_read_and_is_no_stranger(bag_with_log, capsys):
    (bag_with_log / "metadata.yaml").unlink()  # a recorder that died writes none
    spec = write_spec(bag_with_log.parent, reader="db3")
    code, entry = ingest(bag_with_log, spec)
    assert (code, entry["outcome"], entry["rows_lost"]) == (0, "written", 0)
    assert entry["samples"]["state"]["kept"] == 400
    assert len(entry["source_digests"]) == 3  # what is read is in the digests
    assert main(["ingest", "inspect", str(bag_with_log)]) == 0
    printed = capsys.readouterr().out
    assert "not read" not in printed
    assert "-wal" in printed and "-shm" in printed


def test_a_log_that_is_copied_later_is_read_then(bag_with_log):
    """The store must not give what it read of the .db3 file without it."""
    log = next(bag_with_log.glob("*-wal"))
    content = log.read_bytes()
    log.unlink()
    spec = write_spec(bag_with_log.parent, reader="db3")
    assert ingest(bag_with_log, spec)[1]["outcome"] == "split"
    log.write_bytes(content)
    again = ingest(bag_with_log, spec, "--replace=true")[1]
    assert again["outcome"] == "written"


def test_a_file_of_a_log_that_nothing_counts_is_called_unprotected(bag_with_log):
    log = next(bag_with_log.glob("*-wal"))
    log.unlink()
    (bag_with_log / "metadata.yaml").unlink()
    path = next(bag_with_log.glob("*.db3"))
    ((name, source),) = find_sources(path)
    reader = readers.get(name)(source)
    list(reader.messages(None))
    assert log.name in reader.unprotected


# ---- many files ----


def damaged_at_random(path: Path, rng: np.random.Generator) -> None:
    """Cut the file off, or take a part of it out, and perhaps copy another part."""
    data = path.read_bytes()
    if rng.random() < 0.4:
        path.write_bytes(data[: rng.integers(60, len(data))])
    elif path.suffix == ".db3":
        first = int(rng.integers(1, 90))
        delete(path, f"id BETWEEN {first} AND {first + int(rng.integers(0, 10))}")
    else:
        begins = [r[1] for r in records(data) if r[0] == CHUNK]
        k, other = rng.choice(len(begins) - 1, 2, replace=False)
        copied = data[begins[other] : begins[other + 1]] * int(rng.integers(0, 2))
        begin, end = begins[k], begins[k + 1]
        path.write_bytes(data[:begin] + copied + data[end:])


@pytest.mark.slow
def test_none_of_a_hundred_recordings_that_lack_messages_is_whole(tmp_path):
    rng = np.random.default_rng(90)
    whole = write_mcap(tmp_path / "whole.mcap")
    bag = write_ros2(tmp_path / "bag", "SQLITE3")
    num_lacking = 0
    for number in range(100):
        path = tmp_path / str(number)
        if number % 2:
            shutil.copytree(bag, path)
            file = next(path.glob("*.db3"))
        else:
            path = file = path.with_suffix(".mcap")
            shutil.copy(whole, path)
        damaged_at_random(file, rng)
        try:
            ((name, source),) = find_sources(path)
            reader = readers.get(name)(source)
            found = {(m.topic, m.log_ns) for m in reader.messages(None)}
        except RecordingError:
            continue
        lacks = len(found) < len(TOPICS) * NUM
        num_lacking += lacks
        assert lacks <= any(damage.lost for damage in reader.damage), number
    assert num_lacking > 50
