"""Formats without checksums: which changed bytes are detected; files that need too much memory or refer to others are refused."""

import sqlite3
import struct
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import test_bags
from mcap.writer import Writer
from test_bags import START_NS, db3_of, write_bag
from test_hdf5 import ROWS, state, write
from test_hdf5 import write as write_hdf5

from taccorl.cli.main import main
from taccorl.data import ingest as ingest_module
from taccorl.data.cutting import Unfit, open_episodes
from taccorl.data.ingest import find_jobs, ingest, ingest_one
from taccorl.data.inspection import inspect_source
from taccorl.data.recording import Source, readers
from taccorl.data.spec import RecordingSpec, load_recording_spec
from taccorl.errors import RecordingError

JOINTS = [f"joint{j}" for j in range(1, 7)]
NUM = 600  # 3 s of joints at 200 Hz: 0.3 sin(t + 1.001 j), at most 0.3 rad/s


def angle(k: int, j: int) -> float:
    return 0.3 * np.sin(k / 200 + 1.001 * j)


@pytest.fixture
def bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(
        test_bags, "angles", lambda k: np.array([angle(k, j) for j in range(6)])
    )
    return write_bag(tmp_path / "bag", num=NUM)


@pytest.fixture
def spec(tmp_path: Path) -> RecordingSpec:
    feature = "{dtype: float32, shape: [6], unit: rad, frame: joint, rate_hz: 200, range: [-3, 3], names: [%s]}"
    named = feature % ", ".join(f"{j}.pos" for j in JOINTS)
    (tmp_path / "data.yaml").write_text(
        f"spec_version: 1\nname: d\nrobot_type: r\nfps: 30\nfeatures:\n  observation.state: {named}\n"
    )
    (tmp_path / "spec.yaml").write_text(
        "spec_version: 1\ndataset: data.yaml\nreader: db3\nclock: header\nepisodes: {by: whole_file}\n"
        "instruction: {from: spec, text: t}\nchannels:\n"
        f"  j: {{topic: /joints, field: position, pick: [{', '.join(JOINTS)}], rate_hz: 200, max_age_s: 0.03}}\n"
        "features:\n  observation.state: {channels: [j], align: asof}\n"
    )
    return load_recording_spec(tmp_path / "spec.yaml")


def change(path: Path, old: bytes, new: bytes) -> None:
    """The first place of ``old``; ``new`` is as long."""
    content = path.read_bytes()
    assert old in content and len(old) == len(new)
    path.write_bytes(content.replace(old, new, 1))


def entry_of(path: Path, spec: RecordingSpec) -> dict[str, Any]:
    (job,) = find_jobs([path], spec, "spec.yaml", path.parent / "store", dry_run=True)
    return ingest_one(job)


def test_a_position_that_a_joint_cannot_reach_between_two_samples_is_named_with_its_place(
    bag, spec
):
    clean = entry_of(bag, spec)
    assert not [f for f in clean["episodes"][0]["findings"] if f["severity"] != "note"]
    # Sample 302 lies between row 45 (sample 300) and row 46 (sample 306.7): no row shows it.
    old = struct.pack("<d", angle(302, 2))
    wrong = bytearray(old)
    wrong[6] ^= (
        0x20  # the exponent's second bit: 0.3 sin(3.512) = -0.1086 becomes a quarter of that
    )
    value = struct.unpack("<d", wrong)[0]
    assert value == angle(302, 2) / 4
    change(db3_of(bag), old, bytes(wrong))
    entry = entry_of(bag, spec)
    assert entry["outcome"] == "written"
    (finding,) = [
        f for f in entry["episodes"][0]["findings"] if f["severity"] != "note"
    ]
    assert (finding["check"], finding["feature"]) == ("sample_jump", "j")
    # The joint went on meanwhile, so the way back is the longer one: to sample 303, 303 / 200 Hz = 1.515 s.
    # 2 × 3.93 rad/s × 5 ms = 0.0393 rad; between rows the step of 0.081 rad would be no news (2 × 3.93 / 30 = 0.26 rad).
    for fact in (
        f"joint3.pos goes from {value:.4g} to {angle(303, 2):.4g} rad",
        "5.0 ms",
        "1.515 s",
        "2 such steps",
        "0.0393 rad",
    ):
        assert fact in finding["text"]


def test_sqlites_integrity_check_names_the_message_whose_log_time_was_changed(
    bag, spec
):
    path = db3_of(bag)
    with sqlite3.connect(path) as connection:
        ((number, log_ns),) = connection.execute(
            "SELECT id, timestamp FROM messages WHERE id = 21"
        )
    changed = log_ns ^ 1
    change(
        path, log_ns.to_bytes(8, "big"), changed.to_bytes(8, "big")
    )  # the table's or the index's, as it lies
    entry = entry_of(bag, spec)
    assert entry["outcome"] == "split"
    assert f"row {number} missing from index timestamp_idx" in entry["reason"]


def test_a_stamp_with_one_bit_flipped_does_not_make_a_recording_of_years(bag, spec):
    sec, nanosec = divmod(START_NS + 300 * 5_000_000, 10**9)
    old = struct.pack("<iI", sec, nanosec)
    change(db3_of(bag), old, struct.pack("<iI", sec ^ 1 << 28, nanosec))
    expected = r"/joints:.*stamps span 74565.*at most 24 h.*message \d+.*"  # 2^28 s
    with pytest.raises(Unfit, match=expected), open_episodes(bag, spec):
        pass
    assert entry_of(bag, spec)["outcome"] == "quarantined"


def test_the_report_and_the_screen_say_that_a_bag_has_no_checksums(
    bag, spec, tmp_path, capsys
):
    entry = entry_of(bag, spec)
    assert "SQLite" in entry["unprotected"] and "no checksums" in entry["unprotected"]
    assert (
        main(["ingest", str(bag), f"--spec={tmp_path / 'spec.yaml'}", "--dry_run=true"])
        == 0
    )
    assert f"1 of 1 recordings: {entry['unprotected']}" in capsys.readouterr().out


def unprotected(path: Path, name: str, spec: str) -> str:
    reader = readers.get(name)(Source(path, (path,)), load_recording_spec(spec))
    for _ in reader.messages(
        {c.topic for c in load_recording_spec(spec).channels.values()}
    ):
        pass
    return reader.unprotected


def test_of_hdf5_only_datasets_without_a_checksum_are_named(tmp_path):
    path = write_hdf5(tmp_path / "e.hdf5")
    with h5py.File(path, "a") as file:
        for name, options in (
            ("action", {"fletcher32": True}),
            ("observations/qpos", {"compression": "gzip"}),
        ):
            values = file[name][:]
            del file[name]
            file.create_dataset(name, data=values, chunks=(31, 14), **options)
        where = file["action"].id.get_chunk_info_by_coord((31, 0))
    text = unprotected(path, "hdf5", "cobot_magic_hdf5")
    assert "/observations/images/cam_high" in text and "fletcher32=True" in text
    assert "/action" not in text and "qpos" not in text
    content = bytearray(path.read_bytes())
    content[where.byte_offset + 5] ^= 1
    path.write_bytes(content)
    reader = readers.get("hdf5")(Source(path, (path,)))
    assert sum(m.topic == "/action" for m in reader.messages({"/action"})) == 31
    (damage,) = reader.damage
    assert damage.reason.startswith("/action, rows 31 to 61 cannot be read")


def test_mcap_without_crcs_is_called_unprotected_and_with_them_not(tmp_path):
    path = tmp_path / "a.mcap"
    for options, is_protected in (
        ({}, True),
        ({"enable_crcs": False}, False),
        ({"use_chunking": False, "enable_data_crcs": True}, True),
        ({"use_chunking": False, "enable_data_crcs": False}, False),
    ):
        with path.open("wb") as file:
            writer = Writer(file, **options)
            writer.start()
            channel = writer.register_channel("/t", "json", 0)
            writer.add_message(channel, 1, b"{}", 1)
            writer.finish()
        reader = readers.get("mcap")(Source(path, (path,)))
        assert len(list(reader.messages(None))) == 1
        assert ("without a CRC" in reader.unprotected) is not is_protected


SECRET = "secret.bin"
OTHER = "other.h5"
SHAPE = (ROWS, 14)


def external(file: h5py.File, name: str) -> None:
    path = Path(file.filename).with_name(SECRET)
    np.full(SHAPE, 0.01, np.float32).tofile(path)
    file.create_dataset(
        name, SHAPE, "f4", external=[(str(path), 0, h5py.h5f.UNLIMITED)]
    )


def virtual(file: h5py.File, name: str) -> None:
    path = Path(file.filename).with_name(OTHER)
    with h5py.File(path, "w") as other:
        other["x"] = np.full(SHAPE, 0.01, np.float32)
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[:] = h5py.VirtualSource(str(path), "x", SHAPE)
    file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (
            lambda f, n: f.create_dataset(n, (ROWS, 10**10), "f4"),
            ("[10000000000]", "37.3 GiB", "1 GiB"),
        ),
        (
            lambda f, n: f.create_dataset(
                n, (ROWS, 14 * 10**6), "f4", chunks=(ROWS, 10**6), compression="gzip"
            ),
            ("62 rows", "[14000000]", "3.2 GiB", "smaller chunks"),
        ),
        (
            lambda f, n: f.create_dataset(
                n,
                SHAPE,
                "f8",
                maxshape=(None, None),
                chunks=(1, 250 * 10**6),
                compression="gzip",
            ),
            (
                "1.9 GiB",
                "1 GiB",
            ),  # HDF5 unpacks whole chunks, and these are wider than the rows
        ),
        (
            lambda f, n: f.create_dataset(n, SHAPE, "f4"),
            ("none of its 62 rows was ever written",),
        ),
        (external, (SECRET, "external storage", "not opened")),
        (virtual, (OTHER, "virtual dataset", "not opened")),
    ],
)
def test_a_dataset_that_must_not_be_read_costs_its_own_recording_only(
    make, facts, tmp_path
):
    folder = tmp_path / "in"
    write(folder / "episode_0.hdf5")
    with h5py.File(write(folder / "episode_1.hdf5"), "a") as file:
        del file["action"]
        make(file, "action")
    spec = load_recording_spec("cobot_magic_hdf5")
    jobs = find_jobs(
        [folder / f"episode_{k}.hdf5" for k in (1, 0)],
        spec,
        "s",
        tmp_path / "store",
        dry_run=True,
    )
    refused, written = ingest(jobs, tmp_path / "out", None)["recordings"]
    assert (refused["outcome"], written["outcome"]) == ("refused", "written")
    assert "episode_1.hdf5: /action: " in refused["reason"]
    assert all(fact in refused["reason"] for fact in facts)


def test_rows_that_were_never_written_are_no_zeros(tmp_path):
    path = write(tmp_path / "e.hdf5")
    with h5py.File(path, "a") as file:
        del file["action"]
        file.create_dataset("action", SHAPE, "f4", chunks=(10, 14))[:30] = np.stack(
            [state(k + 1) for k in range(30)]
        )
    reader = readers.get("hdf5")(Source(path, (path,)))
    assert len(list(reader.messages({"/action"}))) == 30
    assert (
        reader.damage[0].reason
        == "/action, rows 30 to 39 cannot be read (never written)"
    )


def test_a_thousand_million_rows_are_refused_at_once(tmp_path):
    path = tmp_path / "e.hdf5"
    with h5py.File(path, "w") as file:
        file.create_dataset("action", (10**9, 14), "f4", chunks=(1000, 14))[:1000] = 1.0
    begin_s = time.monotonic()
    reader = readers.get("hdf5")(Source(path, (path,)))
    with pytest.raises(
        RecordingError,
        match=r"e.hdf5: /action: it claims 1,000,000,000 rows; at most 1,000,000",
    ):
        list(reader.messages({"/action"}, stamps_only={"/action"}))
    (topic,) = inspect_source("hdf5", Source(path, (path,))).topics
    assert topic.num_messages == 0 and "1,000,000,000 rows" in topic.problem
    assert time.monotonic() - begin_s < 5


def test_a_recording_that_needs_too_much_memory_does_not_end_the_batch(
    tmp_path, monkeypatch
):
    path = write(tmp_path / "e.hdf5")

    def too_much(*_: Any) -> None:
        np.empty(10**15)  # 8 PB

    monkeypatch.setattr(ingest_module, "opened", too_much)
    (job,) = find_jobs(
        [path],
        load_recording_spec("cobot_magic_hdf5"),
        "s",
        tmp_path / "store",
        dry_run=True,
    )
    entry = ingest_one(job)
    assert entry["outcome"] == "refused"
    assert "more memory than there is" in entry["reason"]
