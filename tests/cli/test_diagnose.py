"""``taccorl diagnose`` as a user types it, on one surrogate robot with dry friction in a joint (simulated, not a robot)."""

import csv
import json
import os
import shlex
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from simulated_sweeps import write_folder

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.motions import AGAIN, CHIRP, VALIDATION
from taccorl.cli.main import main
from taccorl.cli.progress import Steps
from taccorl.data.dataset import read_info
from taccorl.data.lerobot_format import change_features
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.twin_file import load_twin, save_twin
from taccorl.surrogate.cases import draw_case
from taccorl.surrogate.recordings import record
from tests.cli.printed import commands, facts, of_page
from tests.fresh_python import fresh_python

VERB = "diagnose"
SIGNAL = "left_joint4"
TRUTH_NM = 0.0286331  # of this surrogate; `taccorl surrogate --reveal` prints it


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("diagnose") / "robot"
    words = [
        "--secret=3",
        "--effects=[coulomb_friction]",
        f"--signal={SIGNAL}",
        "--strength=12",
        "--gains_known=true",
    ]
    assert main(["surrogate", *words, "--design=chirp", f"--out={folder}"]) == 0
    return folder


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three recordings of the same robot as tables, which are read faster: a chirp, the same again, one to judge on."""
    case = draw_case(
        ["coulomb_friction"],
        3,
        signal=SIGNAL,
        strength=12.0,
        gains_known=True,
        design="chirp",
    )
    chirp, again, held = (
        record(case, motion) for motion in (CHIRP, AGAIN, VALIDATION[0])
    )
    folder = tmp_path_factory.mktemp("sweeps")
    save_twin(case.twin, folder / "twin.yaml")
    write_folder(
        folder / "sweeps", Measurements((chirp, again), (held,)), ROBOT.action_names[:7]
    )
    path = folder / "sweeps" / "measurements.yaml"
    index = yaml.safe_load(path.read_text())
    for note in index["recordings"].values():
        note |= {"kp": chirp.kp, "kd": chirp.kd}
    path.write_text(yaml.safe_dump(index))
    return folder / "sweeps"


def few(*kept: str) -> str:
    """All effects but these are left out: a search in a second."""
    return f"--without=[{','.join(name for name in effects if name not in kept)}]"


@pytest.fixture(scope="module")
def mended(robot: Path) -> Path:
    """All effects, until the noise floor."""
    out = robot.parent / "whole"
    words = [
        f"--twin={robot / 'twin.yaml'}",
        f"--measurements={robot / 'sweeps'}",
        f"--out={out}",
        "--workers=1",
    ]
    assert main(["diagnose", *words, "--until=noise_floor"]) == 0
    return out


@pytest.mark.slow
def test_the_hidden_friction_is_found_among_all_effects(robot: Path, mended: Path):
    report = json.loads((mended / "report.json").read_text())
    found = report["diagnoses"][SIGNAL]
    assert found["status"] == "at_floor"
    assert [e["effect"] for e in found["effects"]] == ["coulomb_friction"]
    assert found["effects"][0]["torque_nm"] == pytest.approx(TRUTH_NM, rel=0.03)
    # Forms of dry friction with one or two more parameters fit as well: ties. Friction over speed**0.05 counts as dry friction.
    (ties,), own = found["rivals"].values(), facts(mended, SIGNAL)
    forms = {f"{kind}_friction" for kind in ("asymmetric", "position_dependent")}
    assert {"asymmetric_friction"} <= {*ties} <= forms and ties == found["rounds"][0][
        "ties"
    ]
    assert [values["other"] for values in own["tie"]] == [*ties]
    assert own["missing"][0]["effect"] == "coulomb_friction"
    assert len(found["rounds"][0]["evidence"]) >= 4
    for use in ("fit", "validation", "test"):
        assert (
            found["errors"]["after"][use] < 1.5 < 6.0 < found["errors"]["fitted"][use]
        )
    (data,) = report["data"]
    assert data.startswith("surrogate: ") and data.endswith(
        f"not a robot; {SIGNAL} under test"
    )
    before, after = (
        next(s for s in report[k] if s["use"] == "test")
        for k in ("scores", "scores_after")
    )
    assert (
        after["ratio"] < 0.3 * before["ratio"]
        and (mended / "report.html").stat().st_size > 10_000
    )


@pytest.mark.slow
def test_the_mended_twin_holds_the_effect_and_only_there(robot: Path, mended: Path):
    twin, start = load_twin(mended / "twin.yaml"), load_twin(robot / "twin.yaml")
    (effect,) = twin.effects
    assert effect.acts_on() == [SIGNAL]
    left, right = twin.controller_of("left"), twin.controller_of("right")
    assert right == start.controller
    assert left.kp_nm_per_rad == start.controller.kp_nm_per_rad, (
        "commanded gains are not touched"
    )
    assert (
        left.torque_ff_nm[3] != 0.0
        and left.torque_ff_nm[:3] == start.controller.torque_ff_nm[:3]
    )


def test_the_terminal_tells_evidence_verdict_and_what_to_do_next(
    sweeps: Path, said: Any, tmp_path: Path
):
    out = tmp_path / "found"
    keep = few("coulomb_friction", "asymmetric_friction", "encoder_bias")
    code, text = said(
        sweeps, f"--twin={sweeps.parent / 'twin.yaml'}", f"--out={out}", keep
    )
    assert code == 0
    own = facts(out, SIGNAL)
    assert {"ties", "error_untested", "tie", "record_either", "next"} <= {*own}
    assert own["tie"] == [
        {"other": "asymmetric_friction", "effect": "coulomb_friction"}
    ]
    assert own["record_either"][0]["other"] == "asymmetric_friction"
    assert own["missing"][0]["numbers"][0].startswith("torque_nm 0.028")
    assert "taccorl excite" not in text
    lines = text.split(f"{SIGNAL} lacks ", 1)[1].partition("\nwrote ")[0].splitlines()
    assert len(lines) <= 12
    page, found = (
        (out / "report.html").read_text(),
        json.loads((out / "report.json").read_text()),
    )
    assert lines[0].endswith("[confidence: moderate]")
    assert found["verdicts"][SIGNAL]["confidence"] == "moderate"
    assert "fixed by commanded gains" in page
    assert "→ coulomb_friction" in page
    assert found["identified"][SIGNAL]["pinned_by"] == ["commanded gains"]
    friction = {n["name"]: n for n in found["identified"][SIGNAL]["identifiable"]}[
        "coulomb_friction.torque_nm"
    ]
    assert friction["low"] <= TRUTH_NM <= friction["high"]
    assert "encoder_bias (looks like torque_ff, always fitted)" in page
    assert found["diagnoses"][SIGNAL]["status"] == "at_floor"
    assert found["diagnoses"][SIGNAL]["words"] == "at the noise floor"
    assert "tied with coulomb_friction" in page
    command = f"taccorl add-effect coulomb_friction --twin={sweeps.parent / 'twin.yaml'} --diagnosis={out}"
    assert {*commands(text)} == {*of_page(out / "report.html")} == {command}
    tied = f"{command}/report.json".replace("coulomb", "asymmetric")
    assert [main(shlex.split(words)[1:]) for words in (command, tied)] == [0, 0]
    assert not (out / "twin.yaml").exists(), "one effect: add-effect writes the twin"


@pytest.mark.slow
def test_a_report_is_replaced_and_other_files_are_left_alone(
    sweeps: Path, said: Any, tmp_path: Path
):
    out, keep = (
        tmp_path / "found",
        few("coulomb_friction", "asymmetric_friction", "encoder_bias"),
    )
    assert (
        said(sweeps, f"--twin={sweeps.parent / 'twin.yaml'}", f"--out={out}", keep)[0]
        == 0
    )
    (out / "notes.txt").write_text("mine")
    code, text = said(
        sweeps,
        f"--twin={sweeps.parent / 'twin.yaml'}",
        f"--out={out}",
        keep,
        "--joints=[J3]",
    )
    assert code == 0 and [*facts(out, SIGNAL)][0] == "ties", "the paper's name"
    assert (
        "replaced the report of" in text and (out / "notes.txt").read_text() == "mine"
    )
    (out / "report.html").write_text("mine, too")
    code, text = said(
        sweeps, f"--twin={sweeps.parent / 'twin.yaml'}", f"--out={out}", keep
    )
    assert code == 2 and (out / "report.html").read_text() == "mine, too"


@pytest.mark.slow
def test_without_the_true_effect_something_else_remains(
    sweeps: Path, said: Any, tmp_path: Path
):
    out = tmp_path / "found"
    words = [sweeps, f"--twin={sweeps.parent / 'twin.yaml'}", f"--out={out}"]
    code, text = said(*words, few("backlash", "cogging", "encoder_scale"))
    assert code == 1
    found = json.loads((out / "report.json").read_text())["diagnoses"][SIGNAL]
    assert found["status"] in ("something_else", "too_many")
    assert "add-effect coulomb_friction" not in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--joints=[left_joint9]"],
            "left_joint9: no such joint is swept in these recordings; ",
        ),
        (["--joints=[right_joint4]"], "right_joint4: no such joint is swept"),
        (["--joints=[J4]"], "J4: no such joint is swept"),  # the paper's J4 is joint5
        (["--without=[coulomb_frictoin]"], "coulomb_friction"),
        (["--gains=guessed"], "guessed"),
        (["--twin={tmp}/no.yaml"], "no.yaml"),
        (["--out={tmp}/file"], "is a file; give a folder"),
    ],
)
def test_what_cannot_be_done_is_said(
    words: list[str], message: str, sweeps: Path, said: Any, tmp_path: Path
):
    (tmp_path / "file").write_text("mine")
    words = [w.format(tmp=tmp_path) for w in words]
    code, text = said(sweeps, f"--out={tmp_path / 'out'}", *words)
    assert code == 2
    assert message in " ".join(text.split())
    assert not (tmp_path / "out").exists()


def test_recordings_that_sweep_no_joint_are_refused(said: Any, tmp_path: Path):
    """A gripper that opens and closes is compared, and has no gains to be fitted."""
    folder = tmp_path / "gripper"
    folder.mkdir()
    rng = np.random.default_rng(0)
    target = 0.02 + 0.015 * np.sin(np.arange(600) / 60)
    with (folder / "gripper.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t", "left_gripper.q_target", "left_gripper.q"])
        late = np.concatenate(
            [target[:1].repeat(10), target[:-10]]
        ) + 1e-5 * rng.standard_normal(600)
        rows.writerows(
            [f"{k / 200:.3f}", f"{target[k]:.7f}", f"{late[k]:.7f}"] for k in range(600)
        )
    code, text = said(folder, f"--out={tmp_path / 'out'}")
    assert code == 2 and "no fit recording moves a joint" in " ".join(text.split())


def stepped(folder: Path, late_rows: int) -> Path:
    """One table of steps of left_joint5, as the nominal twin answers them, its positions stamped ``late_rows`` too late."""
    from taccorl.sim.bench import Bench
    from taccorl.sim.replay import replay
    from taccorl.sim.simulation import Simulation

    sim = Simulation(Bench())
    sim.reset([0])
    target = np.tile(sim.targets[0], (1000, 1))
    for k, level in enumerate((0.0, 0.2, -0.1, 0.25, 0.0)):
        target[200 * k :, 4] += level - (0.0, 0.0, 0.2, -0.1, 0.25)[k]
    reported = replay(sim, target, 200.0, sim.proprioception()[0].copy()).reported[:, 4]
    rows = np.clip(np.arange(len(reported)) - late_rows, 0, len(reported) - 1)
    seen = reported[rows] + 2e-4 * np.random.default_rng(1).standard_normal(
        len(reported)
    )
    folder.mkdir()
    with (folder / "steps.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["t", "left_joint5.q_target", "left_joint5.q"])
        table.writerows(
            [f"{k / 200:.3f}", f"{target[k, 4]:.8f}", f"{seen[k]:.8f}"]
            for k in range(len(seen))
        )
    return folder


LATE = pytest.param(1, (0, 1), "at_floor", marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("late_rows", "codes", "status"),
    [(-1, (1,), None), (0, (0,), "nothing_missing"), LATE],
)
def test_positions_one_row_too_early_stop_it_before_an_effect_is_blamed(
    late_rows, codes, status, said, tmp_path: Path
):
    """On one clock they are diagnosed; one row too late is a delay or a clock."""
    keep = few("command_delay", "sensor_delay", "coulomb_friction")
    code, text = said(
        stepped(tmp_path / "made", late_rows), f"--out={tmp_path / 'out'}", keep
    )
    assert code in codes, text
    assert ("not diagnosed" in " ".join(text.split())) == (status is None)
    assert (tmp_path / "out").exists() == (status is not None)
    if status:
        report = json.loads((tmp_path / "out" / "report.json").read_text())
        found = report["diagnoses"]["left_joint5"]
        delays = [
            e["effect"] for e in found["effects"] if e["effect"].endswith("delay")
        ]
        assert (found["status"], len(delays)) == (status, int(late_rows > 0))
        assert ("a real delay" in " ".join(text.split())) == (late_rows > 0)


@pytest.mark.slow
def test_a_recording_s_stated_gains_are_needed_only_if_they_are_to_be_believed(
    said: Any, tmp_path: Path
):
    folder = stepped(tmp_path / "silent", 0)
    code, text = said(
        folder, f"--out={tmp_path / 'out'}", "--gains=commanded", few("backlash")
    )
    assert code == 2 and "kp and kd into its measurements.yaml" in " ".join(
        text.split()
    )
    note = {
        "recordings": {
            "steps.csv": {"kp": {"left_joint5": 151.1}, "kd": {"left_joint5": 17.1}}
        }
    }
    (folder / "measurements.yaml").write_text(yaml.safe_dump(note))
    code, text = said(
        folder, f"--out={tmp_path / 'out'}", "--gains=commanded", few("backlash")
    )
    own = facts(tmp_path / "out", "left_joint5")
    assert code == 0 and own["fitted"] == [{"text": "commanded gains"}]
    assert own["judged"] == [{"recordings": ["the last rows of each"]}]


@pytest.fixture(scope="module")
def bench(sweeps: Path, recordings: Path, dataset: Path) -> Path:
    """Folder with recordings, and a dataset without pictures."""
    (sweeps.parent / "recordings").symlink_to(recordings)
    keys = [
        key
        for key, f in read_info(dataset)["features"].items()
        if f["dtype"] != "video"
    ]
    change_features(dataset, sweeps.parent / "dataset", keys, {})
    return sweeps.parent


LIGHT = """
import json, sys; from taccorl.extras import EXTRAS; from taccorl.cli.main import main; from tests.conftest import figures_once
class Absent:
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in sum(EXTRAS.values(), ()):
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Absent); sys.stderr = sys.stdout
with figures_once():
    for words in json.loads(sys.argv[1]):
        print(f"=== {words} === {main(words)}")
"""
"""Program that runs commands in turn while packages that only extras install cannot be imported."""


def test_a_light_install_works_without_extras_or_names_the_one_it_needs(bench: Path):
    commands: list[tuple[list[str], int, str]] = [
        (["effects", "coulomb_friction"], 0, "torque_nm [N·m]"),
        (
            ["surrogate", "--secret=3", "--signal=left_joint4", "--strength=0"],
            2,
            "--strength=0",
        ),
        (
            ["compare", "sweeps", "--twin=twin.yaml", "--out=report"],
            0,
            "wrote report/report.html",
        ),
        (
            [
                "diagnose",
                "sweeps",
                "--twin=twin.yaml",
                few("coulomb_friction", "backlash"),
            ],
            0,
            "lacks coulomb_friction",
        ),
        (
            ["check", "dataset", "--pictures=false", "--lerobot=true"],
            0,
            "whether LeRobot loads it could not be checked: needs lerobot",
        ),
        (
            ["ingest", "inspect", "recordings"],
            2,
            "needs cv2, which is not installed: pip install",
        ),
        (["ingest", "recordings", "--out=new"], 2, "lerobot_policy_taccorl[lerobot]"),
        (
            ["collect", "--task=assembly_1", "--out=new"],
            2,
            "lerobot_policy_taccorl[lerobot]",
        ),
        (
            ["compare", "sweeps", "--twin=twin.yaml", "--rerun=x.rrd"],
            2,
            "lerobot_policy_taccorl[lerobot]",
        ),
        (
            ["evaluate", "--task=assembly_1", "--policy.path=x"],
            2,
            "lerobot_policy_taccorl[train]",
        ),
    ]
    done = fresh_python(
        "-c", LIGHT, json.dumps([words for words, _, _ in commands]), cwd=bench
    )
    assert (done.returncode, "Traceback" in done.stdout) == (0, False), (
        done.stdout + done.stderr
    )
    shown = done.stdout
    for words, status, printed in commands:
        own, end, shown = shown.partition(f"=== {words} === {status}\n")
        assert end, f"{words} does not end with {status}: {own}"
        assert printed in own, words


def test_ctrl_c_ends_with_what_was_found(
    sweeps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd
):
    """After the first round has added the friction, Ctrl-C keeps it; before that nothing is written."""
    words = [
        "diagnose",
        f"--measurements={sweeps}",
        f"--twin={sweeps.parent / 'twin.yaml'}",
        f"--joints=[{SIGNAL}]",
    ]
    words += [few("coulomb_friction", "encoder_offset"), "--until=noise_floor"]

    def typed_at(begins: str, out: str) -> int:
        def step(self: Steps, part: str, text: str = "") -> None:
            if text.startswith(begins) and not self.asked.exists():
                os.kill(os.getpid(), signal.SIGINT)
            plain(self, part, text)

        monkeypatch.setattr(Steps, "__call__", step)
        return main([*words, f"--out={tmp_path / out}"])

    plain, before = Steps.__call__, signal.getsignal(signal.SIGINT)
    assert (
        typed_at("no effect added", "nothing") == 130
        and not (tmp_path / "nothing").exists()
    )
    assert typed_at("coulomb_friction", "found") in (0, 1)
    assert signal.getsignal(signal.SIGINT) is before
    told = json.loads((tmp_path / "found" / "report.json").read_text())["diagnoses"][
        SIGNAL
    ]
    assert [e["effect"] for e in told["effects"]] == ["coulomb_friction"]
    assert "stopping with what was found" in capfd.readouterr().err
