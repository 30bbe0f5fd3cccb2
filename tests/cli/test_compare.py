"""``taccorl compare`` as a user types it, on sweeps simulated by the twin with dry friction in one joint (not a robot's)."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from made_rows import of_signal
from made_traces import comparison, trace
from simulated_sweeps import SIGNAL, friction, sweeps, write_folder

from taccorl.alignment.checks.clock import CLOCK
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.cli.measured import (
    of_recordings,
    of_replays,
    refuse_long,
    without_explained,
)
from taccorl.data.finding import Finding, not_judged
from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.result import Comparison
from taccorl.errors import TaccorlError
from taccorl.report.findings import found_in_recordings
from taccorl.report.terminal import show
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import save_twin

VERB = "compare"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``sweeps/``, ``twin.yaml`` without friction and ``mended.yaml`` with it."""
    path = tmp_path_factory.mktemp("compare")
    write_folder(path / "sweeps", sweeps(friction(), seconds=4.0))
    save_twin(TwinConfig(), path / "twin.yaml")
    save_twin(friction(), path / "mended.yaml")
    return path


def row(text: str, signal: str, use: str) -> list[str]:
    """Words of one line of the table."""
    return next(
        line.split()
        for line in text.splitlines()
        if line.startswith(signal) and use in line
    )


def test_table_says_how_far_off_and_where(folder, said):
    code, text = said(
        f"--twin={folder / 'twin.yaml'}", f"--measurements={folder / 'sweeps'}"
    )
    assert code == 0
    words = row(text, f"{SIGNAL} position", "validation")
    error, unit, ratio = float(words[4]), words[5], float(words[9])
    assert (
        unit == "mrad" and 3.0 < error < 7.0
    )  # F / K_p = 1 / 151 rad = 6.6 mrad at most
    assert ratio == pytest.approx(
        error / 0.2, rel=0.1
    )  # made with 0.2 mrad of noise; the floor is from the repeat
    assert f"{SIGNAL} position: largest in " in text
    assert row(text, f"{SIGNAL} effort", "fit")[5] == "N·m"
    assert "ok" in text and "4 recordings" in text, "the checks come first"
    assert text.index("4 recordings") < text.index("RMSE")
    assert "data: origin not stated" in text  # a table cannot say


@pytest.mark.slow
def test_before_and_after_side_by_side_with_report_and_rerun_file(
    folder, said, tmp_path
):
    out, rrd = tmp_path / "report", tmp_path / "x.rrd"
    words = [
        folder / "sweeps",
        f"--twin={folder / 'twin.yaml'}",
        f"--against={folder / 'mended.yaml'}",
    ]
    code, text = said(*words, f"--out={out}", f"--rerun={rrd}")
    assert code == 0
    assert "RMSE mended" in text and "-9" in " ".join(
        row(text, f"{SIGNAL} position", "validation")
    )
    found = json.loads((out / "report.json").read_text())
    before, after = (
        next(s for s in found[k] if s["use"] == "validation")
        for k in ("scores", "scores_after")
    )
    assert before["ratio"] > 10 and after["ratio"] < 1.2
    assert found["provenance"]["command"].startswith("taccorl compare ")
    assert found["recordings"]["validation"] == ["sweep_2.csv"]
    assert rrd.read_bytes()[:4] == b"RRF2"
    code, text = said(*words, f"--out={out}")
    assert code == 0 and "replaced the report of" in text


def test_errors_of_the_data_stop_it_with_what_to_do(folder, said, tmp_path):
    good = sweeps(TwinConfig(), seconds=3.0)
    m = good.fit[0]
    early = {n: getattr(m, n)[:-3] for n in ("time_s", "target")} | {
        n: getattr(m, n)[3:] for n in ("measured", "velocity", "effort")
    }
    write_folder(
        tmp_path / "early",
        dataclasses.replace(
            good, fit=(dataclasses.replace(m, **early),), validation=()
        ),
    )
    code, text = said(tmp_path / "early", f"--out={tmp_path / 'report'}")
    assert code == 1
    assert "before its command" in text and "target_rows_late: 3" in text, (
        "what is wrong, and the way out"
    )
    assert "not compared: errors in sweep_0.csv" in text
    assert "RMSE" not in text and not (tmp_path / "report").exists()


@pytest.mark.slow
def test_an_error_can_be_accepted_by_name_and_stays_in_the_report(
    folder, said, tmp_path
):
    good = sweeps(TwinConfig(), seconds=3.0)
    values = good.fit[0].measured.copy()
    j = good.fit[0].column(SIGNAL)
    values[250:350, j] = values[250, j]
    frozen = dataclasses.replace(good.fit[0], measured=values)
    write_folder(
        tmp_path / "frozen", dataclasses.replace(good, fit=(frozen,), validation=())
    )
    code, text = said(tmp_path / "frozen")
    assert code == 1 and text.rstrip().endswith("--accept=frozen_channel")
    code, text = said(
        tmp_path / "frozen",
        "--accept=frozen_channel,unit",
        f"--out={tmp_path / 'report'}",
    )
    assert code == 0 and "--accept=unit: no recording has that finding" in text
    findings = json.loads((tmp_path / "report" / "report.json").read_text())["findings"]
    (kept,) = [
        f for own in findings.values() for f in own if f["check"] == "frozen_channel"
    ]
    assert kept["severity"] == "warning"
    code, text = said(tmp_path / "frozen", "--accept=frozen_chanel")
    assert code == 2 and "frozen_channel" in text


def test_only_the_joints_that_were_asked_for(folder, said):
    code, text = said(folder / "sweeps", "--joints=[right_joint1]")
    assert code == 2 and "'right_joint1'" in text and SIGNAL in text
    whole = shutil.copytree(folder / "sweeps", folder / "also_broken")
    still = next(p for p in sorted(whole.glob("*.csv"))).read_text().splitlines()
    row = still[1].split(",", 1)[1]
    (whole / "still.csv").write_text(
        "\n".join([still[0], *(f"{line.split(',', 1)[0]},{row}" for line in still[1:])])
    )
    assert (
        said(whole)[0] == said(whole / "still.csv", f"--joints=[{SIGNAL}]")[0] == 1
    )  # nothing moves in it
    code, text = said(whole, f"--joints=[{SIGNAL}]")
    assert code == 0 and "still.csv" not in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{folder}/nothing"], "no such file or folder"),
        (["{folder}/sweeps", "--twin={folder}/no.yaml"], "no.yaml"),
        (["{folder}/sweeps", "--twin={tmp}/arm.urdf"], "arm.urdf` drafts one"),
        (
            ["{folder}/sweeps", "--against={tmp}/slide.yaml"],
            "--against={tmp}/slide.yaml: is of another machine",
        ),
        (["{folder}/sweeps", "--rerun={tmp}/x.png"], "must end in .rrd"),
        (["{folder}/sweeps", "--out={folder}/twin.yaml"], "is a file; give a folder"),
        (
            ["{folder}/sweeps", "--out={folder}/./sweeps"],
            "contains the recordings; give another folder",
        ),
        (["{folder}/sweeps", "--pressed.shape=cube"], "cube"),
        ([], "missing --measurements="),
    ],
)
def test_what_cannot_be_done_is_said_before_any_work(
    words, message, folder, said, tmp_path
):
    (tmp_path / "arm.urdf").touch()
    (tmp_path / "slide.yaml").write_text(
        "{kind: axis, name: slide, unit: m, inertia: 2, kp: 9, kd: 1}"
    )
    code, text = said(*[w.format(folder=folder, tmp=tmp_path) for w in words])
    assert code == 2 and message.format(tmp=tmp_path) in text


def test_somebody_else_s_page_is_left_alone(folder, said, tmp_path):
    (tmp_path / "report.html").write_text("mine")
    code, text = said(folder / "sweeps", f"--out={tmp_path}")
    assert code == 2 and "is not a report of taccorl" in text
    assert (tmp_path / "report.html").read_text() == "mine"


def test_a_shift_of_a_joint_whose_pose_is_unknown_is_a_warning():
    shift = Finding("shifted_from_twin", "error", "left_joint2", "leads")
    other = dataclasses.replace(shift, feature="right_joint2")
    comparison = Comparison(
        twin="",
        effects=(),
        traces=(),
        split={},
        clock={"a": (shift, other), "b": (shift,)},
    )
    for check, feature, expected in (
        ("pose_unknown", "", ["warning", "warning"]),
        ("pose_unknown", "left arm", ["warning", "error"]),
        ("other_gains", "left_joint2", ["warning", "error"]),
    ):
        late = of_replays(
            comparison, {"a": [Finding(check, "warning", feature, "lacks")]}, []
        )
        assert [f.severity for f in late["a"]] == expected and late["b"][
            0
        ].severity == "error"
        assert check in late["a"][0].text


def test_clocks_that_nothing_judged_are_one_line_after_the_replays(capsys):
    """elbow: judged by the onsets of another recording; wrist: by the replay of the same one; hand: by nothing."""
    joints = ("elbow", "wrist", "hand")
    findings = {
        "a.csv": [
            not_judged(name, "an offset of one row", f"why {name}", CLOCK)
            for name in joints
        ]
    }
    replayed = [
        not_judged(name, "its offset in time from the twin", "floors", CLOCK)
        for name in ("elbow", "hand")
    ]
    late = {
        "a.csv": replayed,
        "steps.csv": [
            Finding("same_onset", "note", "elbow", "elbow begins", topic=CLOCK)
        ],
    }
    comparison = Comparison(
        twin="",
        effects=(),
        traces=(),
        split={},
        clock={"a.csv": tuple(replayed), "steps.csv": ()},
    )
    show(*found_in_recordings(of_recordings(comparison, findings, late)))
    lines = [
        line for line in capsys.readouterr().out.splitlines() if "not_judged" in line
    ]
    assert (
        len(lines) == 1
        and "why hand" in lines[0]
        and "elbow" not in lines[0]
        and "wrist" not in lines[0]
    )


def test_what_was_not_judged_of_several_joints_is_one_line(capsys):
    late = [
        not_judged(name, "an offset of one row (5.0 ms)", f"why {name}")
        for name in ("elbow", "wrist")
    ]
    other = not_judged("elbow", "what is not repeated", "no repeats")
    show(
        *found_in_recordings({"a.csv": [late[0], other], "b.csv": late})
    )  # recordings are counted, not findings
    lines = [
        line for line in capsys.readouterr().out.splitlines() if "not_judged" in line
    ]
    assert len(lines) == 2 and "(and" not in lines[1]
    assert (
        "a.csv (and 1 more)" in lines[0]
        and "why elbow" in lines[0]
        and lines[0].endswith("Also: wrist")
    )


@pytest.mark.parametrize(("rows_late", "left"), [(3, 0), (0, 1)])
@pytest.mark.parametrize("both_late", [0, 250])
def test_a_late_answer_is_not_said_where_the_replay_is_as_late(
    rows_late, left, both_late
):
    """The measurement comes 3 rows after its target; so does the replay, or it comes with it. Noise of 0.1 mrad.
    Both 250 rows later: the twin has the delay."""
    at, rng = np.arange(1200), np.random.default_rng(0)
    target = 0.3 * np.sin(2 * np.pi * (at / 200) ** 1.5 / 3)
    measured, replayed = (
        np.interp(at - late - both_late, at, target) + 1e-4 * rng.normal(size=1200)
        for late in (3, rows_late)
    )
    made = trace(measured - replayed, measured, target=target, recording="a.csv")
    late, other = (
        Finding("late_answer", "note", made.signal, "late"),
        Finding("jitter", "warning", "", "rows"),
    )
    found = without_explained(
        {"a.csv": [late, other], "b.csv": [late]}, comparison(made)
    )
    assert found == {"a.csv": [late] * left + [other], "b.csv": [late]}


def at_rest(rows: int) -> Measurement:
    still = np.zeros(rows)
    return of_signal(
        "long.csv",
        1000.0,
        still,
        still,
        "drive",
        "m",
        origin=Origin("twin", "no robot"),
    )


def test_a_recording_of_more_rows_than_a_diagnosis_replays_is_refused_with_its_numbers():
    refuse_long(Measurements((at_rest(500_000),)))
    with pytest.raises(
        TaccorlError, match=r"long\.csv.*500001 rows, 500 s.*500000.*10 s"
    ):
        refuse_long(Measurements((at_rest(1000), at_rest(500_001))))


@pytest.mark.slow
def test_efforts_of_a_register_without_its_sign_are_read_by_the_printed_line(
    tmp_path, said
):
    step = 0.02  # N·m a count; −9 counts are 1033
    plain = sweeps(TwinConfig(), seconds=3.0)

    def logged(m: Measurement) -> Measurement:
        counts = np.round(m.effort / step)
        assert np.nanmax(np.abs(counts)) < 1024
        return dataclasses.replace(
            m, effort=np.where(counts < 0, 1024 - counts, counts)
        )

    made = {
        use: tuple(logged(m) for m in getattr(plain, use))
        for use in ("fit", "validation", "test")
    }
    folder = write_folder(tmp_path / "sweeps", dataclasses.replace(plain, **made))
    tau = f"tau: {{column: {SIGNAL}.tau, unit: Nm, factor: {step}}}"
    both = ", ".join(
        f"{key}: {{column: {SIGNAL}.{key}, unit: rad}}" for key in ("q", "q_target")
    )
    columns = tmp_path / "columns.yaml"
    text = f"time: {{column: t, unit: s}}\nsignals: {{{SIGNAL}: {{{both}, %s}}}}\n"
    columns.write_text(text % tau)
    code, told = said(folder, f"--columns={columns}")
    assert code == 1 and "factor: -1" not in told
    line = re.search("unsigned_effort: .*?`(.*?)`", told)
    assert line is not None
    assert "sign_bit: 1024" in line[1]
    columns.write_text(text % line[1])
    code, told = said(folder, f"--columns={columns}")
    assert code == 0 and "not compared" not in told
    # The twin's own efforts, but for 0.05 N·m of noise and the rounding to counts: √(0.05² + 0.02² / 12).
    words = row(told, f"{SIGNAL} effort", "fit")
    assert words[5] == "N·m"
    assert float(words[4]) == pytest.approx(0.0503, rel=0.1)
