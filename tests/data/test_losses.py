"""What does not become rows is counted: samples in = samples kept + samples left out, time in = rows + losses listed."""

import contextlib
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
import zstandard
from small_arm import (
    CAMERA,
    COMMAND,
    JOINTS,
    STATE,
    Sent,
    ingest,
    joint_state,
    messages,
    motion,
    write_bag,
    write_mcap,
    write_spec,
)

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from taccorl.data.ros import unpacked


def report_of(folder: Path, sent: list[Sent], *changes: tuple[str, str]) -> dict:
    return ingest(write_mcap(folder / "rec.mcap", sent), write_spec(folder, *changes))[
        1
    ]


@pytest.mark.parametrize(
    ("silent", "outcome", "listed"),
    [
        (lambda m: False, "written", []),
        (
            lambda m: m.topic == CAMERA and m.time_s > 3.05,
            "split",
            ["top ends early"],
        ),  # 0.95 s: its cable came loose
        (
            lambda m: m.topic == CAMERA and m.time_s > 3.85,
            "written",
            ["top ends early"],
        ),  # 0.15 s: usual
        (
            lambda m: m.topic == STATE and m.time_s < 0.9,
            "written",
            ["state begins late"],
        ),  # drivers start one by one
        (lambda m: m.topic == STATE and m.time_s < 1.4, "split", ["state begins late"]),
        (
            lambda m: (
                (m.topic == CAMERA and m.time_s < 1.0)
                or (m.topic == COMMAND and m.time_s > 3.0)
            ),
            "split",
            ["command ends early", "top begins late"],
        ),
        (
            lambda m: m.topic == CAMERA and 1.5 < m.time_s < 2.2,
            "split",
            ["no fresh sample of top"],
        ),
    ],
)
def test_every_stretch_is_rows_or_a_listed_loss(tmp_path, silent, outcome, listed):
    entry = report_of(tmp_path, [m for m in messages() if not silent(m)])
    assert entry["outcome"] == outcome, entry["reason"]
    reasons = sorted(loss["reason"] for loss in entry["losses"])
    assert [all(r.startswith(w) for r, w in zip(reasons, listed, strict=True))] == [
        True
    ], reasons
    # the recording is 3.99 s: 120 rows from its first sample on, less a row that does not fit between two channels' ends
    rows = sum(e["rows"] for e in entry["episodes"])
    assert rows + entry["rows_lost"] == pytest.approx(119.5, abs=1.6)
    assert entry["rows_lost"] == sum(loss["rows"] for loss in entry["losses"])
    if outcome == "written" and listed:
        assert all(loss["within_slack"] for loss in entry["losses"])
        assert listed[0] in entry["reason"]


def test_the_printed_outcome_tells_a_whole_recording_from_a_shortened_one(
    tmp_path, capsys
):
    report_of(tmp_path / "whole", messages())
    assert "written, whole" in capsys.readouterr().out
    report_of(
        tmp_path / "late",
        [m for m in messages() if m.topic != STATE or m.time_s >= 0.9],
    )
    assert "written, 27 rows lost" in capsys.readouterr().out


def test_samples_left_out_are_counted_by_reason(tmp_path):
    sent = messages()
    states = [m for m in sent if m.topic == STATE]
    broken = [m.later(0) for m in sent if m.topic == CAMERA][40]
    broken.fields["data"] = b"\xff\xd8\xff broken"
    sent = [m for m in sent if m is not states[10]]
    sent += [states[20], states[30]]  # sent again
    sent.append(
        Sent(STATE, states[0].kind, states[0].fields, 0, states[7].log_ns + 1)
    )  # before a first stamp
    zero = (
        "pick: [pan, lift, elbow, grip], rate_hz: 100, max_age_s: 0.1}\n  command",
        "pick: [pan, lift, elbow, grip], rate_hz: 100, max_age_s: 0.1, drop_zero_stamp: true}\n  command",
    )
    entry = report_of(tmp_path, sent, zero)
    assert entry["outcome"] == "split"  # by the broken picture
    assert entry["samples"] == {
        "state": {"messages": 402, "kept": 399, "stamp of 0": 1, "repeated stamp": 2},
        "command": {"messages": 400, "kept": 400},
        "top": {"messages": 120, "kept": 119, "broken picture": 1},
    }
    for counts in entry["samples"].values():
        assert counts["messages"] == sum(
            n for reason, n in counts.items() if reason != "messages"
        )


def test_a_dataset_of_one_recording_is_stored_once_and_an_edit_of_it_is_not_served_again(
    tmp_path,
):
    entry = report_of(tmp_path, messages())
    out = tmp_path / "out"
    published = [
        path
        for kind in ("data", "videos")
        for path in (out / kind).rglob("*")
        if path.is_file()
    ]
    stored = [
        next((tmp_path / "store").glob(f"recording/*/dataset/{path.relative_to(out)}"))
        for path in published
    ]
    assert [path.suffix for path in published] == [".parquet", ".mp4"]
    if not published[0].samefile(stored[0]):
        pytest.skip("a file system that clones")
    assert all(a.samefile(b) for a, b in zip(published, stored, strict=True))
    assert all(
        path.is_dir() or path.stat().st_nlink == 1 for path in (out / "meta").rglob("*")
    )
    before = published[0].read_bytes()
    with published[0].open("r+b") as file:
        file.seek(len(before) // 2)
        file.write(b"edited")
    edited = published[0].read_bytes()
    words = [f"--spec={write_spec(tmp_path)}", f"--store={tmp_path / 'store'}"]
    assert (
        main(
            [
                "ingest",
                str(tmp_path / "rec.mcap"),
                *words,
                f"--out={tmp_path / 'again'}",
            ]
        )
        == 0
    )
    assert (tmp_path / "again" / published[0].relative_to(out)).read_bytes() == before
    assert published[0].read_bytes() == edited and entry["outcome"] == "written"
    assert main(["check", str(out)]) != 0


def test_videos_of_several_recordings_are_stored_once(tmp_path):
    (tmp_path / "in").mkdir()
    for k in range(3):
        write_mcap(tmp_path / f"in/rec_{k}.mcap", messages(3.0 + k))
    words = [
        f"--spec={write_spec(tmp_path)}",
        f"--store={tmp_path / 'store'}",
        f"--out={tmp_path / 'out'}",
    ]
    assert main(["ingest", str(tmp_path / "in"), *words]) == 0
    published = sorted((tmp_path / "out/videos").rglob("*.mp4"))
    stored = {path.read_bytes(): path for path in (tmp_path / "store").rglob("*.mp4")}
    assert len(published) == len(stored) == 3
    if not any(path.samefile(stored[path.read_bytes()]) for path in published):
        pytest.skip("a file system that clones")
    assert all(path.samefile(stored[path.read_bytes()]) for path in published)
    assert main(["check", str(tmp_path / "out")]) == 0


def test_an_instruction_of_megabytes_is_refused(tmp_path):
    entry = report_of(
        tmp_path, messages(1.0), ("put the cup on the plate", "put " * 2500)
    )
    assert (
        entry["outcome"] == "refused"
        and "an instruction of 9,999 characters" in entry["reason"]
    )


# --- joint states in parts, empty, compressed


def in_parts(sent: list[Sent], *, grip_hz: float = 100.0) -> list[Sent]:
    """Arm and gripper as two publishers on one topic; the gripper 1 ms later, perhaps less often."""
    found = []
    for m in sent:
        if m.topic != STATE:
            found.append(m)
            continue
        values = m.fields["position"]
        found.append(joint_state(STATE, m.time_s, JOINTS[:3], values[:3]))
        if round(m.time_s * 100) % round(100 / grip_hz) == 0:
            found.append(joint_state(STATE, m.time_s + 0.001, JOINTS[3:], values[3:]))
    return sorted(found, key=lambda m: m.log_ns)


TWO_CHANNELS = (
    (
        "state: {topic: /joint_states, field: position, pick: [pan, lift, elbow, grip],",
        "arm: {topic: /joint_states, field: position, pick: [pan, lift, elbow],",
    ),
    (
        "  command:",
        "  grip: {topic: /joint_states, field: position, pick: [grip], rate_hz: 10, max_age_s: 0.3}\n  command:",
    ),
    ("channels: [state]", "channels: [arm, grip]"),
)


@pytest.mark.parametrize("changes", [(), TWO_CHANNELS])
def test_several_partial_messages_make_one_state(tmp_path, changes):
    entry = report_of(tmp_path, in_parts(messages()), *changes)
    assert (entry["outcome"], entry["rows_lost"]) == ("written", 0)
    for name, counts in entry["samples"].items():
        assert counts["messages"] == sum(
            n for reason, n in counts.items() if reason != "messages"
        ), name
    state = Dataset(tmp_path / "out").episode(0).arrays["observation.state"]
    truth = np.stack([motion(k / 100) for k in range(400)])
    at = np.abs(truth[:, None, :3] - state[None, :, :3]).max(axis=2).argmin(axis=0)
    assert np.abs(state - truth[at])[:, :3].max() < 1e-6
    assert (
        np.abs(state[:, 3] - truth[at, 3]).max() < 2e-4
    )  # the gripper may be the one of 10 ms before


def test_a_joined_sample_is_complete_when_every_name_has_come_again(tmp_path):
    """The arm at 100 Hz, the gripper at 10 Hz: joined, there are 10 samples a second, none with an old gripper."""
    wide = (
        "rate_hz: 100, max_age_s: 0.1}\n  command",
        "rate_hz: 10, max_age_s: 0.2}\n  command",
    )
    entry = report_of(tmp_path / "joined", in_parts(messages(), grip_hz=10), wide)
    assert entry["samples"]["state"]["kept"] == 40
    entry = report_of(
        tmp_path / "apart", in_parts(messages(), grip_hz=10), *TWO_CHANNELS
    )
    assert (entry["samples"]["arm"]["kept"], entry["samples"]["grip"]["kept"]) == (
        400,
        40,
    )
    assert entry["samples"]["arm"]["messages"] == 440


@pytest.mark.parametrize("names", [((), ()), (("pan",), ())])
def test_empty_messages_are_skipped_and_counted(tmp_path, names):
    sent = messages()
    states = [i for i, m in enumerate(sent) if m.topic == STATE]
    for i in states[:5]:
        sent[i] = replace(
            sent[i],
            fields=sent[i].fields
            | {"name": list(names[0]), "position": list(names[1])},
        )
    entry = report_of(tmp_path, sent)
    assert entry["outcome"] == "written"
    assert entry["samples"]["state"] == {
        "messages": 400,
        "kept": 395,
        "position is empty": 5,
    }
    assert [f["check"] for f in entry["episodes"][0]["findings"]].count("skipped") == 1


def test_a_name_that_no_message_has_is_an_error(tmp_path):
    sent = [
        m
        for m in in_parts(messages())
        if m.topic != STATE or m.fields["name"] != ["grip"]
    ]
    entry = report_of(tmp_path, sent)
    assert (
        entry["outcome"] == "refused"
        and "none of its 400 messages gives a sample" in entry["reason"]
    )
    assert "'grip' is not among its names" in entry["reason"]


def test_inspect_lists_every_set_of_names_and_drafts_a_channel_for_each(
    tmp_path, capsys
):
    sent = in_parts(messages(), grip_hz=10)
    sent[0] = replace(sent[0], fields=sent[0].fields | {"name": [], "position": []})
    path = write_mcap(tmp_path / "rec.mcap", sent)
    assert (
        main(["ingest", "inspect", str(path), f"--draft={tmp_path / 'draft.yaml'}"])
        == 0
    )
    out = capsys.readouterr().out
    assert "names of /joint_states: pan, lift, elbow\n" in out
    assert "names of /joint_states: grip\n" in out
    assert "/joint_states: 1 messages, which give no sample" in out
    channels = yaml.safe_load((tmp_path / "draft.yaml").read_text())["channels"]
    drafted = {
        (*c["pick"], c["rate_hz"]) for c in channels.values() if c["topic"] == STATE
    }
    assert drafted == {("pan", "lift", "elbow", 100), ("grip", 10)}


@pytest.mark.parametrize("ros", ["mcap", "db3"])
def test_messages_compressed_one_by_one_are_read_without_metadata(tmp_path, ros):
    plain = report_of(tmp_path / "plain", messages())
    if ros == "mcap":
        path = write_mcap(tmp_path / "zstd" / "rec.mcap", messages(), zstd=True)
    else:
        path = next(write_bag(tmp_path / "zstd", messages(), 2).glob("*.db3"))
        with contextlib.closing(sqlite3.connect(path)) as bag:
            rows = bag.execute("SELECT id, data FROM messages").fetchall()
            pack = zstandard.ZstdCompressor().compress
            bag.executemany(
                "UPDATE messages SET data = ? WHERE id = ?",
                [(pack(data), k) for k, data in rows],
            )
            bag.commit()
        path.with_name("metadata.yaml").unlink()
    _, entry = ingest(path, write_spec(tmp_path, reader=ros))
    assert (entry["outcome"], entry["samples"]) == ("written", plain["samples"])
    a, b = (
        Dataset(folder / "out").episode(0)
        for folder in (tmp_path / "plain", path.parent)
    )
    assert all(np.array_equal(a.arrays[key], b.arrays[key]) for key in a.arrays)


def test_a_message_that_unpacks_to_gigabytes_is_refused(tmp_path):
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 29))
    assert len(bomb) < 1 << 16
    with pytest.raises(ValueError, match="unpacks to more than"):
        unpacked(bomb)
