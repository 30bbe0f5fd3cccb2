"""``import taccorl``: the functions give what the verbs give, and import no torch."""

import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import taccorl
from taccorl.alignment.measurements.folder import Measurements
from taccorl.cli.main import main
from taccorl.diagnosis.machines.machine import Machine
from taccorl.report.report import Report
from tests.fresh_python import fresh_python
from tests.recordings.stand_in import StandInConfig, write_mcap

WORDS = "surrogate --secret=3 --effects=[coulomb_friction] --signal=left_joint4 --strength=12"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A surrogate's recordings, and its twin.yaml, with dry friction at one joint."""
    folder = tmp_path_factory.mktemp("api") / "robot"
    words = f"{WORDS} --design=chirp --gains_known=true --out={folder}"
    assert main(words.split()) == 0
    return folder


@pytest.fixture(scope="module")
def robot(recorded: Path) -> Machine:
    return taccorl.load_robot(recorded / "twin.yaml")


@pytest.fixture(scope="module")
def measurements(recorded: Path, robot: Machine) -> Measurements:
    return taccorl.read_measurements(recorded / "sweeps", robot)


@pytest.fixture(scope="module")
def diagnosis(robot: Machine, measurements: Measurements) -> Report:
    return taccorl.diagnose(robot, measurements)


def test_nothing_imports_torch_and_the_import_is_quick() -> None:
    names = [n for n in dir(taccorl) if not n.startswith("_") and n.islower()]
    assert {"compare", "diagnose", "load_robot", "plot", "ingest"} <= {*names}
    program = (
        "import sys, time; b = time.process_time(); import taccorl; "
        "taccorl.compare, taccorl.diagnose; print(time.process_time() - b); "
        "taccorl.load_robot(); print('torch' in sys.modules, 'lerobot' in sys.modules)"
    )
    used_s, torch, lerobot = fresh_python("-c", program).stdout.split()
    assert (torch, lerobot) == ("False", "False")
    assert float(used_s) <= 0.5


@pytest.mark.slow
def test_compare_gives_the_numbers_of_the_verb(
    recorded: Path, robot: Machine, measurements: Measurements, tmp_path: Path
) -> None:
    words = [
        str(recorded / "sweeps"),
        f"--twin={recorded / 'twin.yaml'}",
        f"--out={tmp_path}",
    ]
    assert main(["compare", *words]) == 0
    stored = json.loads((tmp_path / "report.json").read_text())
    report = taccorl.compare(robot, measurements)
    rmse = {(s.signal, s.kind, s.use): s.rmse for s in report.comparison.scores()}
    of_verb = {(s["signal"], s["kind"], s["use"]): s["rmse"] for s in stored["scores"]}
    assert rmse == of_verb and len(rmse) > 0
    report.save(tmp_path)  # an earlier report of taccorl is replaced
    assert (
        json.loads((tmp_path / "report.json").read_text())["scores"] == stored["scores"]
    )


@pytest.mark.slow
def test_diagnose_and_add_effect_give_what_the_verbs_give(
    recorded: Path, robot: Machine, diagnosis: Report, tmp_path: Path
) -> None:
    twin, out = f"--twin={recorded / 'twin.yaml'}", tmp_path / "diagnosis"
    assert main(["diagnose", str(recorded / "sweeps"), twin, f"--out={out}"]) == 0
    stored = json.loads((out / "report.json").read_text())
    (part, found), *_ = stored["diagnoses"].items()
    (finding,) = diagnosis.found
    assert finding.part == part
    assert [e.name for e in finding.diagnosis.effects] == [
        e["effect"] for e in found["effects"]
    ]
    name, new = found["effects"][0]["effect"], tmp_path / "new.yaml"
    words = ["add-effect", name, twin, f"--diagnosis={out}", f"--out={new}"]
    assert main(words) == 0
    by_verb = taccorl.load_robot(new)
    assert taccorl.add_effect(robot, name, out).digest() == by_verb.digest()
    diagnosis.save(tmp_path / "saved")
    for source in (diagnosis, tmp_path / "saved"):
        mended = taccorl.add_effect(robot, name, source)
        assert mended.numbers(part) == by_verb.numbers(part) != robot.numbers(part)


@pytest.mark.slow
def test_a_notebook_shows_the_verdict(diagnosis: Report) -> None:
    (account,) = diagnosis.accounts().values()
    html = diagnosis._repr_html_()
    assert account.title in repr(diagnosis)
    assert html.startswith("<div") and html.rstrip().endswith("</div>")
    assert html.count("<table") >= 2 and "<script" not in html
    # Rules of the style name elements: they hold only inside the cell's own element.
    assert "<style>.taccorl{" in html and "body{" not in html


@pytest.mark.slow
def test_plot_draws_the_largest_error(
    robot: Machine, measurements: Measurements
) -> None:
    report = taccorl.compare(robot, measurements)
    worst = max(
        report.comparison.traces,
        key=lambda t: np.sqrt(np.nanmean(t.residual**2)) / t.floor.value,
    )
    title = taccorl.plot(report).get_suptitle()
    assert worst.signal in title and worst.recording in title
    with pytest.raises(taccorl.TaccorlError, match="left_joint9"):
        taccorl.plot(report, "left_joint9")
    with pytest.raises(taccorl.TaccorlError, match="nothing_such"):
        taccorl.plot(report, recording="nothing_such")


@pytest.mark.slow
def test_errors_are_those_of_the_verbs(
    recorded: Path,
    robot: Machine,
    measurements: Measurements,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(taccorl.TaccorlError) as error:
        taccorl.compare(robot, measurements, joints=["left_joint9"])
    twin = f"--twin={recorded / 'twin.yaml'}"
    assert (
        main(["compare", str(recorded / "sweeps"), twin, "--joints=left_joint9"]) == 2
    )
    assert capsys.readouterr().err == f"taccorl compare: {error.value}\n"


def test_values_by_hand_need_no_diagnosis() -> None:
    robot = taccorl.load_robot()  # the nominal twin
    part, values = "left_joint5", {"torque_nm": 0.25}
    new = taccorl.add_effect(robot, "coulomb_friction", values=values, joints=[part])
    assert new.numbers(part)["coulomb_friction.torque_nm"] == (0.25, "N·m")
    assert "coulomb_friction.torque_nm" not in robot.numbers(part)
    with pytest.raises(taccorl.TaccorlError, match="diagnosis="):
        taccorl.add_effect(robot, "coulomb_friction")


@pytest.mark.slow
def test_measurements_with_errors_are_refused_with_the_findings(
    recorded: Path, robot: Machine, measurements: Measurements
) -> None:
    first, *rest = measurements.fit
    frozen = dataclasses.replace(first, measured=np.zeros_like(first.measured))
    wrong = dataclasses.replace(measurements, fit=(frozen, *rest))
    with pytest.raises(taccorl.TaccorlError, match="--accept=") as error:
        taccorl.compare(robot, wrong)
    assert first.name in str(error.value)


def test_ingest_and_load_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("av", reason="pictures need the extra lerobot")
    monkeypatch.chdir(tmp_path)
    recording = tmp_path / "one.mcap"
    write_mcap(recording, StandInConfig(duration_s=2.5, camera_size=(96, 128)))
    options: dict[str, Any] = {"spec": "piper_flexitac_mcap"}
    dry = taccorl.ingest(recording, "dataset", dry_run=True, **options)
    assert dry["episodes"] == 1 and not Path("dataset").exists()
    report = taccorl.ingest([recording], "dataset", **options)
    assert report == json.loads(Path("dataset.ingest_report.json").read_text())
    stored = taccorl.load_episode("dataset")
    assert stored.num_rows == report["rows"] == 70
    direct = taccorl.load_episode(recording, **options)
    for key, values in stored.arrays.items():
        np.testing.assert_array_equal(values, direct.arrays[key])
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        chosen = taccorl.load_episode(recording)
    assert "piper_flexitac_mcap" in str(found[0].message)
    first = next(chosen.pictures())  # its file is open as long as the episode is there
    assert {p.shape[-1] for p in first.values()} == {3}
    with pytest.raises(taccorl.TaccorlError, match="episode"):
        taccorl.load_episode("dataset", 7)


def test_the_types_name_what_there_is() -> None:
    stub = (Path(taccorl.__file__).parent / "__init__.pyi").read_text()
    for name in vars(taccorl)["_LAZY"]:
        assert f"import {name} as {name}" in stub
        assert getattr(taccorl, name) is not None
    with pytest.raises(AttributeError, match="comparee"):
        _ = taccorl.comparee  # pyright: ignore[reportAttributeAccessIssue]
