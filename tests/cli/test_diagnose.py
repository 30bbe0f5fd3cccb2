"""``taccorl diagnose`` as a user types it, on one surrogate robot with dry friction in a joint (simulated, not a robot)."""

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from taccorl.cli.main import main
from taccorl.sim.effects import effects
from taccorl.sim.twin_file import load_twin

SIGNAL = "left_joint4"
TRUTH_NM = 0.0286331  # of this surrogate; `taccorl surrogate --reveal` prints it


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("diagnose") / "robot"
    words = ["--secret=3", "--effects=[coulomb_friction]", f"--signal={SIGNAL}", "--strength=12", "--gains_known=true"]
    assert main(["surrogate", *words, "--design=chirp", f"--out={folder}"]) == 0
    return folder


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Any:
    def run(*words: Any) -> tuple[int, str]:
        code = main(["diagnose", *map(str, words)])
        shown = capsys.readouterr()
        assert "Traceback" not in shown.out + shown.err
        return code, shown.out + shown.err

    return run


def few(*kept: str) -> str:
    """All effects but these are left out: a search in a second."""
    return f"--without=[{','.join(name for name in effects if name not in kept)}]"


@pytest.fixture(scope="module")
def mended(robot: Path) -> Path:
    """All effects, until the noise floor."""
    out = robot.parent / "whole"
    words = [f"--twin={robot / 'twin.yaml'}", f"--measurements={robot / 'sweeps'}", f"--out={out}", "--workers=1"]
    assert main(["diagnose", *words, "--until=noise_floor"]) == 0
    return out


def test_the_hidden_friction_is_found_among_all_effects(robot: Path, mended: Path):
    report = json.loads((mended / "report.json").read_text())
    found = report["diagnoses"][SIGNAL]
    assert found["status"] == "at_floor"
    assert [e["effect"] for e in found["effects"]] == ["coulomb_friction"]
    assert found["effects"][0]["torque_nm"] == pytest.approx(TRUTH_NM, rel=0.03)
    assert found["rounds"][0]["ties"] == ["asymmetric_friction"]
    assert len(found["rounds"][0]["evidence"]) >= 4
    for use in ("fit", "held_out", "test"):
        assert found["errors"]["after"][use] < 1.5 < 6.0 < found["errors"]["fitted"][use]
    assert report["data"] == [f"surrogate robot, simulated; not a robot; {SIGNAL} under test"]
    before, after = (next(s for s in report[k] if s["use"] == "test") for k in ("scores", "scores_after"))
    assert after["ratio"] < 0.3 * before["ratio"]
    assert (mended / "report.html").stat().st_size > 10_000


def test_the_mended_twin_holds_the_effect_and_only_there(robot: Path, mended: Path):
    twin, start = load_twin(mended / "twin.yaml"), load_twin(robot / "twin.yaml")
    (effect,) = twin.effects
    assert effect.acts_on() == [SIGNAL]
    left, right = twin.controller_of("left"), twin.controller_of("right")
    assert right == start.controller
    assert left.kp_nm_per_rad == start.controller.kp_nm_per_rad, "commanded gains are not touched"
    assert left.torque_ff_nm[3] != 0.0 and left.torque_ff_nm[:3] == start.controller.torque_ff_nm[:3]


def test_the_terminal_tells_evidence_verdict_and_what_to_do_next(robot: Path, said: Any, tmp_path: Path):
    out = tmp_path / "found"
    keep = few("coulomb_friction", "asymmetric_friction", "backlash", "encoder_bias")
    code, text = said(robot / "sweeps", f"--twin={robot / 'twin.yaml'}", f"--out={out}", keep)
    assert code == 0
    assert f"\n{SIGNAL}\n" in text and "noise floor 0.3" in text
    assert "commanded gains; judged on 03_held_chirp.mcap" in text
    assert "these recordings cannot show: encoder_bias (taken up by torque_ff)" in text
    assert "tied with coulomb_friction" in text and "cannot be told from asymmetric_friction" in text
    assert "→ coulomb_friction: torque_nm 0.028" in text and "N·m (0.028" in text
    assert "held-out error 11" in text or "held-out error 10" in text
    assert f"next: taccorl add-effect coulomb_friction --twin={robot / 'twin.yaml'} --diagnosis={out}" in text
    assert not (out / "twin.yaml").exists(), "one effect: add-effect writes the twin"


def test_without_the_true_effect_something_else_remains(robot: Path, said: Any, tmp_path: Path):
    out = tmp_path / "found"
    words = [robot / "sweeps", f"--twin={robot / 'twin.yaml'}", f"--out={out}"]
    code, text = said(*words, few("backlash", "cogging", "encoder_scale"))
    assert code == 1
    found = json.loads((out / "report.json").read_text())["diagnoses"][SIGNAL]
    assert found["status"] in ("something_else", "too_many")
    assert "add-effect coulomb_friction" not in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--joints=[left_joint9]"], "left_joint9: no such joint is swept in these recordings; "),
        (["--joints=[right_joint4]"], "right_joint4: no such joint is swept"),
        (["--joints=[J4]"], "J4: no such joint is swept"),  # the paper's J4 is joint5
        (["--without=[coulomb_frictoin]"], "coulomb_friction"),
        (["--gains=guessed"], "guessed"),
        (["--twin={tmp}/no.yaml"], "no.yaml"),
        (["--out={tmp}/file"], "is a file; give a folder"),
    ],
)
def test_what_cannot_be_done_is_said(words: list[str], message: str, robot: Path, said: Any, tmp_path: Path):
    (tmp_path / "file").write_text("mine")
    words = [w.format(tmp=tmp_path) for w in words]
    code, text = said(robot / "sweeps", f"--out={tmp_path / 'out'}", *words)
    assert code == 2
    assert message in " ".join(text.split())
    assert not (tmp_path / "out").exists()


def test_the_paper_s_name_of_the_joint_is_understood(robot: Path, said: Any, tmp_path: Path):
    words = [robot / "sweeps", f"--twin={robot / 'twin.yaml'}", f"--out={tmp_path / 'out'}", "--joints=[J3]"]
    code, text = said(*words, few("coulomb_friction", "backlash"))
    assert code == 0 and f"\n{SIGNAL}\n" in text


def test_recordings_that_sweep_nothing_are_refused(robot: Path, said: Any, tmp_path: Path):
    rows = [[f"{k / 200:.3f}", "0.1", f"{0.1 + 1e-4 * np.sin(k):.6f}"] for k in range(400)]
    folder = tmp_path / "still"
    folder.mkdir()
    with (folder / "still.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["t", f"{SIGNAL}.q_target", f"{SIGNAL}.q"], *rows])
    code, text = said(folder, f"--out={tmp_path / 'out'}")
    assert code == 2 and "no fit recording sweeps a joint" in " ".join(text.split())


def test_an_earlier_report_is_replaced_and_anything_else_left_alone(robot: Path, said: Any, tmp_path: Path):
    out = tmp_path / "out"
    words = [robot / "sweeps", f"--twin={robot / 'twin.yaml'}", f"--out={out}", few("coulomb_friction", "backlash")]
    assert said(*words)[0] == 0
    (out / "notes.txt").write_text("mine")
    code, text = said(*words)
    assert code == 0 and "replaced the report of" in text
    assert (out / "notes.txt").read_text() == "mine"
    (out / "report.html").write_text("mine, too")
    code, text = said(*words)
    assert code == 2 and (out / "report.html").read_text() == "mine, too"


def stepped(folder: Path, late_rows: int) -> Path:
    """One table of steps of left_joint5, as the nominal twin answers them, its positions stamped ``late_rows`` too late."""
    from taccorl.sim.replay import replay
    from taccorl.sim.simulation import Simulation
    from taccorl.sim.tasks.bench import Bench

    sim = Simulation(Bench())
    sim.reset([0])
    target = np.tile(sim.targets[0], (1000, 1))
    for k, level in enumerate((0.0, 0.2, -0.1, 0.25, 0.0)):
        target[200 * k :, 11 - 7] += level - (0.0, 0.0, 0.2, -0.1, 0.25)[k]
    reported = replay(sim, target, 200.0, sim.proprioception()[0].copy()).reported[:, 4]
    seen = np.concatenate([np.full(late_rows, reported[0]), reported])[: len(reported)]
    seen = np.concatenate([reported[-late_rows:], np.full(-late_rows, reported[-1])]) if late_rows < 0 else seen
    seen = seen + 2e-4 * np.random.default_rng(1).standard_normal(len(seen))
    folder.mkdir()
    with (folder / "steps.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t", "left_joint5.q_target", "left_joint5.q"])
        rows.writerows([f"{k / 200:.3f}", f"{target[k, 4]:.8f}", f"{seen[k]:.8f}"] for k in range(len(seen)))
    return folder


def test_positions_one_row_too_early_stop_it_before_an_effect_is_blamed(said: Any, tmp_path: Path):
    keep = few("command_delay", "sensor_delay", "coulomb_friction")
    code, text = said(stepped(tmp_path / "early", -1), f"--out={tmp_path / 'out'}", keep)
    assert code == 1
    assert "not diagnosed" in text
    assert not (tmp_path / "out").exists()


def test_the_same_steps_on_one_clock_are_diagnosed(said: Any, tmp_path: Path):
    keep = few("command_delay", "sensor_delay", "coulomb_friction")
    code, text = said(stepped(tmp_path / "even", 0), f"--out={tmp_path / 'out'}", keep)
    assert code == 0
    assert "nothing is missing" in text


def test_positions_one_row_too_late_are_said_to_be_a_delay_or_a_clock(said: Any, tmp_path: Path):
    keep = few("command_delay", "sensor_delay", "coulomb_friction")
    _, text = said(stepped(tmp_path / "late", 1), f"--out={tmp_path / 'out'}", keep)
    assert "a real delay" in " ".join(text.split())


def test_a_recording_s_stated_gains_are_needed_only_if_they_are_to_be_believed(robot: Path, said: Any, tmp_path: Path):
    folder = stepped(tmp_path / "silent", 0)
    code, text = said(folder, f"--out={tmp_path / 'out'}", "--gains=commanded", few("backlash"))
    assert code == 2 and "kp and kd into its measurements.yaml" in " ".join(text.split())
    note = {"recordings": {"steps.csv": {"kp": {"left_joint5": 151.1}, "kd": {"left_joint5": 17.1}}}}
    (folder / "measurements.yaml").write_text(yaml.safe_dump(note))
    code, text = said(folder, f"--out={tmp_path / 'out'}", "--gains=commanded", few("backlash"))
    assert code == 0 and "commanded gains; judged on the last rows of each" in text


def test_the_truth_may_be_removed_and_nothing_changes(robot: Path, said: Any, tmp_path: Path):
    """Whoever diagnoses has no need of it."""
    blind = tmp_path / "blind"
    shutil.copytree(robot, blind)
    (blind / "sealed_truth.json").unlink()
    reports = []
    for folder in (robot, blind):
        out = tmp_path / f"out of {folder.name}"
        words = [folder / "sweeps", f"--twin={folder / 'twin.yaml'}", f"--out={out}"]
        assert said(*words, few("coulomb_friction", "backlash"))[0] == 0
        reports.append(json.loads((out / "report.json").read_text())["diagnoses"][SIGNAL])
    for report in reports:
        report.pop("cpu_s")
    assert reports[0] == reports[1]
