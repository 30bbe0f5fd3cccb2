"""Recordings are found, and read once: numbers as arrays, pictures as stamps; an error names what does not meet the spec."""

import base64
import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from test_spec import RECORDING
from test_spec import write as write_spec

from taccorl.cli.main import main
from taccorl.data.recording import (
    Recording,
    RecordingSpec,
    Source,
    find_sources,
    load_recording,
)
from taccorl.data.spec import load_recording_spec
from taccorl.data.spool import Spool
from taccorl.errors import RecordingError
from tests.fresh_python import fresh_python
from tests.recordings.stand_in import StandInConfig, write_cobot_magic_hdf5, write_mcap

T0_NS = 1_700_000_000_000_000_000
MS = 1_000_000


def recording_spec(folder: Path, **channels: dict[str, Any]) -> RecordingSpec:
    """The little spec with the given keys of channels changed."""
    changed = {
        name: {**channel, **channels.get(name, {})}
        for name, channel in RECORDING["channels"].items()
    }
    return load_recording_spec(
        write_spec(folder, recording=RECORDING | {"channels": changed})
    )


TYPES = {
    "/joints": "sensor_msgs/msg/JointState",
    "/command": "sensor_msgs/msg/JointState",
    "/camera": "sensor_msgs/msg/CompressedImage",
    "/pad_a": "std_msgs/msg/UInt8MultiArray",
    "/pad_b": "std_msgs/msg/UInt8MultiArray",
    "/episode": "std_msgs/msg/String",
}


def header(stamp_ns: int) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}}


def joint_state(stamp_ns: int, *position: float) -> dict[str, Any]:
    return {"header": header(stamp_ns), "name": ["g", "j1"], "position": list(position)}


def picture(stamp_ns: int, text: bytes) -> dict[str, Any]:
    return {
        "header": header(stamp_ns),
        "format": "jpeg",
        "data": base64.b64encode(text).decode(),
    }


Sent = tuple[str, int, Any]


def usual_messages() -> list[Sent]:
    """Three ticks 10 ms apart; stamps 1 ms before the log time."""
    sent: list[Sent] = [("/episode", T0_NS, {"data": "start:insert"})]
    for k in range(3):
        log = T0_NS + k * 10 * MS
        stamp = log - MS
        sent.append(("/joints", log, joint_state(stamp, 0.07, k)))
        sent.append(("/command", log, joint_state(stamp, 0.08, k + 0.5)))
        sent.append(("/camera", log, picture(stamp, b"picture %d" % k)))
        sent += [
            (f"/pad_{x}", log, {"data": [10 * k + i for i in range(6)]}) for x in "ab"
        ]
        sent.append(("/unwanted", log, {"x": 1}))
    sent.append(("/episode", T0_NS + 30 * MS, {"data": "success"}))
    return sent


def write(
    path: Path, sent: Iterable[Sent], types: dict[str, str] = TYPES, **options: Any
) -> Source:
    """The messages as JSON in an MCAP file."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        ids: dict[str, int] = {}
        for topic, log_ns, message in sent:
            if topic not in ids:
                schema = writer.register_schema(
                    types.get(topic, "T"), "jsonschema", b"{}"
                )
                ids[topic] = writer.register_channel(topic, "json", schema)
            writer.add_message(ids[topic], log_ns, json.dumps(message).encode(), log_ns)
        writer.finish()
    return Source(path, (path,))


def load(
    folder: Path, sent: Iterable[Sent], types: dict[str, str] = TYPES, **channels: Any
) -> Recording:
    spec = recording_spec(folder, **channels)
    scratch = folder / "scratch"
    scratch.mkdir(exist_ok=True)
    return load_recording(write(folder / "a.mcap", sent, types), spec, scratch)


def refusal(
    folder: Path, sent: Iterable[Sent], types: dict[str, str] = TYPES, **channels: Any
) -> str:
    with pytest.raises(RecordingError) as caught:
        load(folder, sent, types, **channels)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# --- what is loaded


def test_a_recording_becomes_channels_with_their_own_times(tmp_path):
    recording = load(tmp_path, usual_messages())
    state = recording.channels["state"]
    assert state.values is not None
    assert state.values.tolist() == [
        [0.0, 0.07],
        [1.5, 0.07],
        [3.0, 0.07],
    ]  # j1 × 1.5, then g, by name
    assert (state.log_ns - T0_NS).tolist() == [
        0,
        10 * MS,
        20 * MS,
    ] and state.stamp_ns is not None
    assert (state.log_ns - state.stamp_ns).tolist() == [MS] * 3
    pad = recording.channels["pad_a"]
    assert pad.stamp_ns is None and pad.values is not None
    assert pad.values.dtype == np.uint8
    assert pad.values[1].tolist() == [
        10,
        12,
        14,
        11,
        13,
        15,
    ]  # 3 × 2 on the wire, 2 × 3 on the pad
    assert recording.channels["front"].values is None
    assert recording.texts == {
        "/episode": [(T0_NS, "start:insert"), (T0_NS + 30 * MS, "success")]
    }
    assert recording.counts == {
        "/joints": 3,
        "/command": 3,
        "/camera": 3,
        "/pad_a": 3,
        "/pad_b": 3,
        "/episode": 2,
    }
    assert recording.damage == []


def test_a_channel_may_have_any_name(tmp_path):
    """A channel's name is no file name."""
    recording_spec(tmp_path)
    path, name = tmp_path / "recording.yaml", "../left/state"
    path.write_text(
        path.read_text()
        .replace("- state\n", f"- {name}\n")
        .replace(" state:", f" {name}:")
    )
    (tmp_path / "scratch").mkdir()
    source = write(tmp_path / "a.mcap", usual_messages())
    recording = load_recording(source, load_recording_spec(path), tmp_path / "scratch")
    assert recording.channels[name].values is not None
    assert (
        len(list(tmp_path.rglob("*.spool")))
        == len(list((tmp_path / "scratch").iterdir()))
        == 4
    )


# --- pictures


def test_pictures_come_back_by_their_times_once_each(tmp_path):
    recording = load(
        tmp_path,
        [
            *usual_messages(),
            ("/camera", T0_NS + 20 * MS, picture(T0_NS + 19 * MS, b"twin")),
        ],
    )
    ids = [(T0_NS + k * 10 * MS, T0_NS + k * 10 * MS - MS, 0) for k in range(3)]
    assert recording.channels["front"].stamp_ns is not None
    found = list(recording.pictures({"front": [ids[2], ids[0], ids[2]]}))
    assert [(name, identity) for name, identity, _ in found] == [
        ("front", ids[0]),
        ("front", ids[2]),
    ]
    assert [base64.b64decode(value["data"]) for _, _, value in found] == [
        b"picture 0",
        b"picture 2",
    ]
    assert list(recording.pictures({"front": []})) == []
    assert (
        list(recording.pictures({"front": [(ids[0][0], None, 0)]})) == []
    )  # another identity is another picture
    assert recording.damage == []


def test_pictures_with_the_same_times_are_told_apart_by_their_order(tmp_path):
    """A clock that was set back by whole periods gives two pictures one log time and one stamp."""
    again = ("/camera", T0_NS, picture(T0_NS - MS, b"again"))
    recording = load(tmp_path, [*usual_messages(), again])
    ids = [(T0_NS, T0_NS - MS, k) for k in range(2)]
    found = {
        ident: base64.b64decode(value["data"])
        for _, ident, value in recording.pictures({"front": ids})
    }
    assert found == {ids[0]: b"picture 0", ids[1]: b"again"}


def test_two_features_may_show_one_camera(tmp_path):
    recording = load(tmp_path, usual_messages())
    recording.spec.channels["other"] = recording.spec.channels["front"]
    identity = (T0_NS, T0_NS - MS, 0)
    found = list(recording.pictures({"front": [identity], "other": [identity]}))
    assert sorted(name for name, _, _ in found) == ["front", "other"]


# --- what is refused


def without(topic: str) -> list[Sent]:
    return [m for m in usual_messages() if m[0] != topic]


def instead(topic: str, message: Any) -> list[Sent]:
    """The second message of ``topic`` replaced."""
    sent = usual_messages()
    index = [i for i, m in enumerate(sent) if m[0] == topic][1]
    sent[index] = (topic, sent[index][1], message)
    return sent


def test_all_missing_topics_are_named_at_once_and_markers_too(tmp_path):
    message = refusal(
        tmp_path, [m for m in usual_messages() if m[0] in ("/joints", "/camera")]
    )
    assert (
        "without messages in the recording: /command, /pad_a, /pad_b, /episode ("
        in message
    )
    assert message.count("known: /camera, /joints") == 1, (
        "the list of topics once, for all that resemble none"
    )
    assert "the file names no topics" in refusal(tmp_path, [])


def test_another_type_is_named_even_where_its_content_does_not_fit_either(tmp_path):
    types = {**TYPES, "/joints": "sensor_msgs/msg/Joy"}
    expected = "/joints is sensor_msgs/msg/Joy, but the spec's channel 'state' requires sensor_msgs/msg/JointState"
    assert refusal(tmp_path, usual_messages(), types) == expected
    assert refusal(tmp_path, instead("/joints", {"axes": [1.0]}), types) == expected


def test_a_header_clock_without_headers_is_refused(tmp_path):
    expected = "/pad_a has no header stamp: write `clock: log` on channel 'pad_a'"
    assert refusal(tmp_path, usual_messages(), pad_a={"clock": "header"}) == expected
    headless = {
        "name": ["g", "j1"],
        "position": [0.0, 0.0],
    }  # one message among many is enough
    assert "/joints has no header stamp" in refusal(
        tmp_path, instead("/joints", headless)
    )


def test_a_topic_is_either_pictures_or_numbers(tmp_path):
    message = refusal(tmp_path, usual_messages(), pad_a={"topic": "/camera"})
    assert message == "/camera: the spec reads it both as pictures and as numbers"


@pytest.mark.parametrize(
    ("topic", "message", "expected"),
    [
        ("/pad_a", {"data": [1] * 5}, "message 1: 5 taxels, but sensor little_pad has 3×2; other layouts: a file in"),
        ("/pad_a", {"date": [1]}, "message 1: no field 'data'; did you mean 'date'?"),
        ("/joints", joint_state(T0_NS, 1.0), "message 1: 1 values for 2 names in 'position'"),
        ("/episode", {"data": 3}, "expected a text (std_msgs/String), found int"),
        ("/episode", {"text": "x"}, "expected a text (std_msgs/String), found dict"),
    ],
)  # fmt: skip
def test_a_message_that_does_not_fit_names_its_topic_and_number(
    tmp_path, topic, message, expected
):
    told = refusal(tmp_path, instead(topic, message))
    assert told.startswith(
        f"{topic}, {expected}"
        if expected.startswith("message")
        else f"{topic}: {expected}"
    )


# --- the spool


def test_spool_keeps_the_dtype_of_the_first_row_and_refuses_another_size(tmp_path):
    spool = Spool(tmp_path, "x")
    spool.append(np.array([1, 255], dtype=np.uint8))
    spool.append(np.array([2, 3]))
    with pytest.raises(RecordingError, match="3 values after messages with 2"):
        spool.append(np.array([1, 2, 3]))
    found = spool.finish()
    assert found.dtype == np.uint8
    assert found.tolist() == [[1, 255], [2, 3]]


# --- finding recordings


def test_a_missing_path_names_its_neighbour(tmp_path):
    (tmp_path / "demo_07.mcap").touch()
    with pytest.raises(
        RecordingError,
        match=r"demo_7\.mcap: no such file or folder; did you mean 'demo_07\.mcap'",
    ):
        find_sources(tmp_path / "demo_7.mcap")
    with pytest.raises(
        RecordingError, match=r"no such file or folder: there is no folder .*nowhere"
    ):
        find_sources(tmp_path / "nowhere" / "demo_7.mcap")


# --- memory

MEASURE = """
import resource, sys, tempfile
from pathlib import Path
from taccorl.data.recording import Source, load_recording, readers
from taccorl.data.spec import load_recording_spec
import rosbags.typesys

list(readers)  # imports them all

def peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

folder = Path(sys.argv[1])
spec, path = load_recording_spec(folder / "recording.yaml"), folder / "big.mcap"
with tempfile.TemporaryDirectory(dir=folder) as scratch:
    before = peak_mb()
    recording = load_recording(Source(path, (path,)), spec, Path(scratch))
    loaded = peak_mb() - before
    front = recording.channels["front"]
    ids = [(int(log), None, 0) for log in front.log_ns]
    number = sum(1 for _ in recording.pictures({"front": ids}))
    print(loaded, peak_mb() - before, number, len(recording.channels["state"].values))
"""


@pytest.mark.slow
def test_300_mb_of_pictures_do_not_enter_memory(tmp_path):
    """Loading keeps stamps and numbers only; asking for the pictures streams them. Bound: 15 MB above the imports."""
    recording_spec(tmp_path, front={"clock": "log"})
    noise = np.random.default_rng(0).integers(0, 256, 100_000, dtype=np.uint8).tobytes()
    with (tmp_path / "big.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        ids = {
            t: writer.register_channel(
                t, "json", writer.register_schema(n, "jsonschema", b"{}")
            )
            for t, n in TYPES.items()
        }
        # a picture's bytes as ROS 2 sends them: CDR of a string and uint8[]
        schema = writer.register_schema(
            "sensor_msgs/msg/CompressedImage", "ros2msg", b"string format\nuint8[] data"
        )
        ids["/camera"] = writer.register_channel("/camera", "cdr", schema)
        cdr = (
            b"\0\1\0\0"
            + (5).to_bytes(4, "little")
            + b"jpeg\0\0\0\0"
            + len(noise).to_bytes(4, "little")
            + noise
        )
        for topic, log_ns, message in without("/camera"):
            if topic in ids:
                writer.add_message(
                    ids[topic], log_ns, json.dumps(message).encode(), log_ns
                )
        for k in range(3000):
            log_ns = T0_NS + k * 33 * MS
            writer.add_message(ids["/camera"], log_ns, cdr, log_ns)
            state = json.dumps(joint_state(log_ns, 0.0, 1.0)).encode()
            writer.add_message(ids["/joints"], log_ns, state, log_ns)
        writer.finish()
    assert (tmp_path / "big.mcap").stat().st_size > 300_000_000
    run = fresh_python("-c", MEASURE, tmp_path)
    (tmp_path / "big.mcap").unlink()
    loaded_mb, streamed_mb, pictures, states = map(float, run.stdout.split())
    assert (pictures, states) == (3000, 3003)
    assert loaded_mb < 15
    assert streamed_mb < 15


def test_a_recording_that_was_cut_off_is_said_to_be_so_where_topics_are_missing(
    tmp_path,
):
    source = write(tmp_path / "a.mcap", usual_messages(), chunk_size=300)
    source.path.write_bytes(
        source.path.read_bytes()[:900]
    )  # the last topics come later
    with pytest.raises(
        RecordingError,
        match=r"without messages.*damaged or cut off: a\.mcap bytes [\d,]+ to 900",
    ):
        load_recording(source, recording_spec(tmp_path), tmp_path)


V21 = "is a LeRobot v2.1 dataset, but only v3 is supported. Convert it"


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as people have them: two MCAP files among all sorts of things."""
    folder = tmp_path_factory.mktemp("finding") / "mixed"
    (folder / "v21/meta").mkdir(parents=True)
    (folder / "v21/meta/info.json").write_text(
        json.dumps({"codebase_version": "v2.1", "fps": 30, "features": {}})
    )
    (folder / "days/one").mkdir(parents=True)
    config = StandInConfig(duration_s=2.0, camera_size=(96, 128))
    write_mcap(folder / "days/one/a.mcap", config)
    write_cobot_magic_hdf5(folder / "aloha1.hdf5", config)
    for name in ("good.mcap", "odd.bin"):
        shutil.copy(folder / "days/one/a.mcap", folder / name)
    (folder / "notes.txt").write_text("tried again after lunch")
    (folder / "cover.jpg").write_bytes(b"\xff\xd8\xff\xe0" + bytes(20))
    (folder / ".hidden").touch()
    return folder


def test_everything_that_a_folder_holds_is_read_or_told(mixed: Path) -> None:
    skipped: list[str] = []
    found = find_sources(mixed, reader="mcap", skipped=skipped)
    assert [source.path.name for _, source in found] == ["good.mcap"]
    told = dict(line.rstrip(")").split(" (", 1) for line in skipped)
    assert set(told) == {
        "aloha1.hdf5",
        "cover.jpg",
        "days",
        "notes.txt",
        "odd.bin",
        "v21",
    }
    assert told["aloha1.hdf5"] == "an HDF5 file; this spec reads mcap"
    assert told["cover.jpg"] == "a JPEG picture, no recording"
    assert (
        told["days"]
        == f"there are recordings in {mixed / 'days/one'}: give that folder"
    )
    assert told["notes.txt"] == "no recording"
    assert told["odd.bin"] == "an MCAP file with another ending: give the file itself"
    assert told["v21"].startswith(V21) and told["v21"].endswith(
        "; this spec reads mcap"
    )


def test_a_bad_entry_keeps_the_others_only_from_those_who_do_not_ask(
    mixed: Path,
) -> None:
    skipped: list[str] = []
    assert [name for name, _ in find_sources(mixed, skipped=skipped)] == [
        "hdf5",
        "mcap",
    ]
    assert any(line.startswith(f"v21 ({V21}") for line in skipped)
    with pytest.raises(RecordingError, match=f"v21: {V21}"):
        find_sources(mixed)


@pytest.mark.parametrize(
    ("name", "reader", "said"),
    [
        ("aloha1.hdf5", "mcap", "an HDF5 file; this spec reads mcap (cobot_magic_hdf5 reads hdf5)"),
        ("good.mcap", "hdf5", "an MCAP file; this spec reads hdf5 (piper_flexitac_mcap reads mcap)"),
        ("cover.jpg", "mcap", "a JPEG picture, no recording"),
        ("cover.jpg", None, "a JPEG picture, no recording"),
        ("notes.txt", None, "no recording here; readers db3, hdf5, lerobot, mcap, rosbag1 open .bag, .db3, .h5, .hdf5, .mcap"),
        ("days", "mcap", "no recording here, but there are some in {mixed}/days/one: give that folder"),
        ("v21", "mcap", V21),
        ("v21", None, V21),
        ("days/one", "db3", "no recording here; the reader db3 opens .db3; not read: a.mcap (an MCAP file; this spec reads db3)"),
    ],
)  # fmt: skip
def test_a_path_without_a_recording_says_what_it_is(
    mixed: Path, name: str, reader: str | None, said: str
) -> None:
    with pytest.raises(RecordingError) as error:
        find_sources(mixed / name, reader=reader)
    assert str(error.value).startswith(f"{mixed / name}: {said.format(mixed=mixed)}")
    assert str(error.value).count(str(mixed / name) + ":") == 1


def test_a_known_file_with_an_odd_ending_is_opened_by_what_it_is(mixed: Path) -> None:
    for reader in (None, "mcap"):
        [(name, source)] = find_sources(mixed / "odd.bin", reader=reader)
        assert (name, source.path) == ("mcap", mixed / "odd.bin")


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
TAR = bytes(257) + b"ustar\x0000" + bytes(248)


@pytest.mark.parametrize(
    ("name", "content", "what", "command"),
    [
        ("p.mcap", POINTER, "a Git LFS pointer", "git -C {folder} lfs pull"),
        ("p.hdf5", POINTER, "a Git LFS pointer", "git -C {folder} lfs pull"),
        ("p.db3", POINTER, "a Git LFS pointer", "git -C {folder} lfs pull"),
        ("p.bag", POINTER, "a Git LFS pointer", "git -C {folder} lfs pull"),
        (
            "day 1.zip",
            b"PK\x03\x04" + bytes(30),
            "a ZIP archive",
            "unzip '{folder}/day 1.zip' -d {folder}",
        ),
        (
            "really_zipped.mcap",
            b"PK\x03\x04" + bytes(30),
            "a ZIP archive",
            "unzip {folder}/really_zipped.mcap",
        ),
        (
            "a.bag.gz",
            b"\x1f\x8b\x08" + bytes(30),
            "a gzip archive",
            "gunzip --keep {folder}/a.bag.gz",
        ),
        (
            "a.mcap.zst",
            b"\x28\xb5\x2f\xfd" + bytes(30),
            "a zstd archive",
            "unzstd {folder}/a.mcap.zst",
        ),
        ("days.tar", TAR, "a tar archive", "tar -xf {folder}/days.tar -C {folder}"),
    ],
)
def test_what_only_stands_for_a_recording_is_named_with_the_command_that_gives_it(
    name: str,
    content: bytes,
    what: str,
    command: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    for words in (
        ["ingest", "inspect", path],
        ["ingest", tmp_path, "--spec=piper_flexitac_mcap", "--dry_run=true"],
    ):
        assert main([str(word) for word in words]) != 0
        shown = "".join(capsys.readouterr())
        assert name in shown
        if "inspect" in words or path.suffix not in (
            ".hdf5",
            ".db3",
            ".bag",
        ):  # another reader's: not looked into
            for part in (what, command.format(folder=tmp_path)):
                assert part in shown


@pytest.mark.parametrize(
    "file", ["meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet"]
)
def test_a_dataset_of_git_lfs_pointers_is_named(
    file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    info = {
        "codebase_version": "v3.0",
        "fps": 30,
        "features": {},
        "total_episodes": 0,
        "data_path": "data/x",
    }
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_bytes(POINTER)
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    for words in (["check"], ["view"], ["ingest", "inspect"]):
        assert main([*words, str(tmp_path)]) == 2
        shown = capsys.readouterr().err
        assert f"{tmp_path / file}: a Git LFS pointer" in shown
        assert f"git -C {(tmp_path / file).parent} lfs pull" in shown
