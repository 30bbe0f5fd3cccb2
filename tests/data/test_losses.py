"""What does not become rows is counted: samples in = samples kept + samples left out, time in = rows + losses listed."""

from pathlib import Path

import pytest
from small_arm import CAMERA, COMMAND, STATE, Sent, ingest, messages, write_mcap, write_spec


def report_of(folder: Path, sent: list[Sent], *changes: tuple[str, str]) -> dict:
    return ingest(write_mcap(folder / "rec.mcap", sent), write_spec(folder, *changes))[1]


@pytest.mark.parametrize(
    ("silent", "outcome", "listed"),
    [
        (lambda m: False, "written", []),
        (lambda m: m.topic == CAMERA and m.time_s > 3.05, "split", ["top ends early"]),  # 0.95 s: its cable came loose
        (lambda m: m.topic == CAMERA and m.time_s > 3.85, "written", ["top ends early"]),  # 0.15 s: usual
        (lambda m: m.topic == STATE and m.time_s < 0.9, "written", ["state begins late"]),  # drivers start one by one
        (lambda m: m.topic == STATE and m.time_s < 1.4, "split", ["state begins late"]),
        (
            lambda m: (m.topic == CAMERA and m.time_s < 1.0) or (m.topic == COMMAND and m.time_s > 3.0),
            "split",
            ["command ends early", "top begins late"],
        ),
        (lambda m: m.topic == CAMERA and 1.5 < m.time_s < 2.2, "split", ["no fresh sample of top"]),
    ],
)
def test_every_stretch_is_rows_or_a_listed_loss(tmp_path: Path, silent, outcome: str, listed: list[str]) -> None:
    entry = report_of(tmp_path, [m for m in messages() if not silent(m)])
    assert entry["outcome"] == outcome, entry["reason"]
    reasons = sorted(loss["reason"] for loss in entry["losses"])
    assert [all(r.startswith(w) for r, w in zip(reasons, listed, strict=True))] == [True], reasons
    # the recording is 3.99 s: 120 rows from its first sample on, less a row that does not fit between two channels' ends
    rows = sum(e["rows"] for e in entry["episodes"])
    assert rows + entry["rows_lost"] == pytest.approx(119.5, abs=1.6)
    assert entry["rows_lost"] == sum(loss["rows"] for loss in entry["losses"])
    if outcome == "written" and listed:
        assert all(loss["within_slack"] for loss in entry["losses"])
        assert listed[0] in entry["reason"]


def test_the_printed_outcome_tells_a_whole_recording_from_a_shortened_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report_of(tmp_path / "whole", messages())
    assert "written, whole" in capsys.readouterr().out
    report_of(tmp_path / "late", [m for m in messages() if m.topic != STATE or m.time_s >= 0.9])
    assert "written, 27 rows lost" in capsys.readouterr().out


def test_samples_left_out_are_counted_by_reason(tmp_path: Path) -> None:
    sent = messages()
    states = [m for m in sent if m.topic == STATE]
    broken = [m.later(0) for m in sent if m.topic == CAMERA][40]
    broken.fields["data"] = b"\xff\xd8\xff broken"
    sent = [m for m in sent if m is not states[10]]
    sent += [states[20], states[30]]  # sent again
    sent.append(Sent(STATE, states[0].kind, states[0].fields, 0, states[7].log_ns + 1))  # before a first stamp
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
        assert counts["messages"] == sum(n for reason, n in counts.items() if reason != "messages")
