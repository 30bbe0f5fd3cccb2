"""``taccorl excite`` as a user types it."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from imagined_motions import NOISE_RAD, SIGNAL, recorded
from simulated_sweeps import write_folder

from taccorl.alignment.measurements.folder import Measurements, read_measurements
from taccorl.alignment.measurements.motions import AGAIN, CHIRP, RATE_HZ, SPEED_RAD_PER_S
from taccorl.cli.main import main
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig

RIVALS = "--effects=[command_lag,torque_fade]"


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Any:
    def run(*words: Any) -> tuple[int, str]:
        code = main(["excite", *map(str, words)])
        shown = capsys.readouterr()
        assert "Traceback" not in shown.out + shown.err
        return code, " ".join((shown.out + shown.err).split())

    return run


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = [recorded(TwinConfig(), m, k, noise_rad=2 * NOISE_RAD, effort=True) for k, m in enumerate((CHIRP, AGAIN))]
    return write_folder(tmp_path_factory.mktemp("excite") / "sweeps", Measurements(tuple(made)), ROBOT.action_names)


def test_a_plan_and_tables_of_targets_that_a_driver_can_send(said: Any, tmp_path: Path):
    out = tmp_path / "plan"
    code, text = said(SIGNAL, "--effects=[command_lag,integral_action]", f"--out={out}", "--num=2")
    assert code == 0 and "wrote" in text and "0.2 mrad" in text
    plan = yaml.safe_load((out / "plan.yaml").read_text())
    assert (plan["joint"], plan["rate_hz"], len(plan["motions"])) == (SIGNAL, RATE_HZ, 2)
    assert plan["tells_apart"] == ["command_lag", "integral_action"]
    assert sorted(p.name for p in out.iterdir()) == sorted(["plan.yaml", *(m["table"] for m in plan["motions"])])
    apart = [m["floors_apart"]["command_lag | integral_action"] for m in plan["motions"]]
    assert apart[0] >= apart[1] and apart[0] > 1.25
    j = ROBOT.action_names.index(SIGNAL)
    for motion in plan["motions"]:
        with (out / motion["table"]).open() as file:
            head, *rows = csv.reader(file)
        assert head == ["t", f"{SIGNAL}.q_target"]
        time_s, target = np.array(rows, dtype=float).T
        assert np.allclose(np.diff(time_s), 1 / RATE_HZ) and len(rows) == round(motion["seconds"] * RATE_HZ)
        assert ROBOT.action_low[j] < target.min() and target.max() < ROBOT.action_high[j]
        assert np.abs(np.diff(target)).max() * RATE_HZ <= SPEED_RAD_PER_S + 1e-3
        assert np.ptp(target[:RATE_HZ]) == np.ptp(target[-RATE_HZ:]) == 0.0, "at rest at both ends"
        assert motion["range_rad"] == pytest.approx([target.min(), target.max()], abs=1e-3)
        assert 0 < motion["peak_torque_nm"] <= 10.0
    code, text = said(SIGNAL, RIVALS, f"--out={out}")
    assert code == 2 and "already exists" in text


@pytest.mark.slow
def test_what_nothing_tells_apart_is_said_with_exit_code_1(said: Any, tmp_path: Path):
    code, text = said(SIGNAL, "--effects=[coulomb_friction,asymmetric_friction]", f"--out={tmp_path / 'plan'}")
    assert code == 1
    assert "coulomb_friction | asymmetric_friction: 0.00 floors at best" in text
    assert "the same thing, pick either" in text
    assert "wrote nothing" in text and not (tmp_path / "plan").exists()


def test_rivals_and_numbers_come_from_a_diagnosis(said: Any, tmp_path: Path):
    values = {"coulomb_friction": {"torque_nm": 2.0}, "viscous_friction": {"damping_nms_per_rad": 3.0}}
    base = {"torque_ff": 1.73, "kp": 151.1, "kd": 17.1}
    evidence = [{"name": n, "base": base, "values": {f"{n}.{k}": x for k, x in v.items()}} for n, v in values.items()]
    found = {"rivals": {"coulomb_friction": ["viscous_friction"]}, "rounds": [{"evidence": evidence}]}
    (tmp_path / "report.json").write_text(json.dumps({"diagnoses": {SIGNAL: found}}))
    code, _ = said(SIGNAL, f"--diagnosis={tmp_path}", f"--out={tmp_path / 'plan'}")
    plan = yaml.safe_load((tmp_path / "plan" / "plan.yaml").read_text())
    assert plan["tells_apart"] == ["coulomb_friction", "viscous_friction"]
    # both ten times as strong as is typical, with commanded gains
    assert code == 0 and min(plan["motions"][0]["floors_apart"].values()) > 5.0


@pytest.mark.slow
def test_recordings_that_are_there_say_the_floor_and_where_the_arm_stands(sweeps: Path, said: Any, tmp_path: Path):
    out = tmp_path / "plan"
    _, text = said(SIGNAL, RIVALS, f"--measurements={sweeps}", f"--out={out}", "--num=1")
    assert "noise floors (0.4" in text or "noise floors (0.39" in text
    middle = read_measurements(sweeps).fit[0].target[0, 4]
    with (out / yaml.safe_load((out / "plan.yaml").read_text())["motions"][0]["table"]).open() as file:
        _, first, *_ = csv.reader(file)
    assert float(first[1]) == pytest.approx(middle, abs=1e-5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["left_joint9", RIVALS], "no joint 'left_joint9'"),
        ([SIGNAL, "--effects=[backlsh,cogging]"], "backlash"),
        ([SIGNAL, "--effects=[backlash]"], "two or more effects"),
        ([SIGNAL, "--effects=[speed_delay,backlash]"], "speed_delay: no search fits this effect"),
        ([SIGNAL], "no effects to separate:"),
        ([SIGNAL, RIVALS, "--twin={tmp}/no.yaml"], "no.yaml"),
        ([], "missing --joint="),
    ],
)
def test_what_cannot_be_done_is_said_and_nothing_written(words: list[str], message: str, said: Any, tmp_path: Path):
    words = [w.format(tmp=tmp_path) for w in words]
    code, text = said(*words, f"--out={tmp_path / 'plan'}", f"--diagnosis={tmp_path}")
    assert code == 2 and message in text
    assert not (tmp_path / "plan").exists()


@pytest.mark.slow
def test_a_table_of_the_joint_alone_is_enough(sweeps: Path, said: Any, tmp_path: Path):
    one = write_folder(tmp_path / "one", read_measurements(sweeps), (SIGNAL,))
    code, text = said(SIGNAL, RIVALS, f"--measurements={one}", f"--out={tmp_path / 'plan'}", "--num=1")
    assert code in (0, 1) and "wrote" in text
