"""``taccorl excite`` as a user types it, of joints and of pads."""

import csv
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml
from imagined_motions import NOISE_RAD, SIGNAL, recorded
from simulated_sweeps import write_folder

from taccorl.alignment.measurements.folder import (
    Measurements,
    PressedNote,
    read_measurements,
)
from taccorl.alignment.measurements.motions import (
    AGAIN,
    CHIRP,
    RATE_HZ,
    SPEED_RAD_PER_S,
)
from taccorl.cli.diagnose import DiagnoseConfig
from taccorl.cli.main import main
from taccorl.cli.parse import parse
from taccorl.diagnosis.experiment_design import presses
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig

VERB, ONE_LINE = "excite", True
RIVALS, OF_PADS = (
    "--effects=[command_lag,torque_fade]",
    "--effects=[touch_delay,touch_lag]",
)
OF_NAME = {p.name: p for p in presses.LIBRARY}


@pytest.fixture(autouse=True)
def two_presses(monkeypatch: pytest.MonkeyPatch) -> None:
    """What takes seconds to score, not minutes."""
    monkeypatch.setattr(
        presses, "LIBRARY", (OF_NAME["rod_across"], OF_NAME["quick_taps"])
    )


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = [
        recorded(TwinConfig(), m, k, noise_rad=2 * NOISE_RAD, effort=True)
        for k, m in enumerate((CHIRP, AGAIN))
    ]
    return write_folder(
        tmp_path_factory.mktemp("excite") / "sweeps",
        Measurements(tuple(made)),
        ROBOT.action_names,
    )


def test_a_plan_and_tables_of_targets_that_a_driver_can_send(said, tmp_path):
    out = tmp_path / "plan"
    code, text = said(
        SIGNAL, "--effects=[command_lag,integral_action]", f"--out={out}", "--num=2"
    )
    assert code == 0 and "wrote" in text and "0.2 mrad" in text
    plan = yaml.safe_load((out / "plan.yaml").read_text())
    assert (plan["joint"], plan["rate_hz"], len(plan["motions"])) == (
        SIGNAL,
        RATE_HZ,
        2,
    )
    assert plan["tells_apart"] == ["command_lag", "integral_action"]
    assert sorted(p.name for p in out.iterdir()) == sorted(
        ["plan.yaml", *(m["table"] for m in plan["motions"])]
    )
    apart = [
        m["floors_apart"]["command_lag | integral_action"] for m in plan["motions"]
    ]
    assert apart[0] >= apart[1] and apart[0] > 1.25
    j = ROBOT.action_names.index(SIGNAL)
    for motion in plan["motions"]:
        with (out / motion["table"]).open() as file:
            head, *rows = csv.reader(file)
        assert head == ["t", f"{SIGNAL}.q_target"]
        time_s, target = np.array(rows, dtype=float).T
        assert np.allclose(np.diff(time_s), 1 / RATE_HZ) and len(rows) == round(
            motion["seconds"] * RATE_HZ
        )
        assert (
            ROBOT.action_low[j] < target.min() and target.max() < ROBOT.action_high[j]
        )
        assert np.abs(np.diff(target)).max() * RATE_HZ <= SPEED_RAD_PER_S + 1e-3
        assert np.ptp(target[:RATE_HZ]) == np.ptp(target[-RATE_HZ:]) == 0.0, (
            "at rest at both ends"
        )
        assert motion["range_rad"] == pytest.approx(
            [target.min(), target.max()], abs=1e-3
        )
        assert 0 < motion["peak_torque_nm"] <= 10.0
    code, text = said(SIGNAL, RIVALS, f"--out={out}")
    assert code == 2 and "already exists" in text
    for wrong, named in (
        (("left_joint9", RIVALS), "no joint 'left_joint9'"),
        ((SIGNAL, "--effects=[lag]"), "lag"),
    ):
        code, text = said(*wrong, f"--out={out}")
        assert code == 2 and named in text and "already exists" not in text, (
            "names before places"
        )


@pytest.mark.slow
def test_what_nothing_tells_apart_is_said_with_exit_code_1(said, tmp_path):
    """The same positions by algebra; efforts show the one that holds more, and a hobby servo measures none."""
    rivals, twin = (
        "--effects=[coulomb_friction,asymmetric_friction]",
        tmp_path / "servo.yaml",
    )
    code, text = said(SIGNAL, rivals, f"--out={tmp_path / 'arm'}", "--num=1")
    assert (
        code == 0
        and "coulomb_friction | asymmetric_friction: 0.00 floors at best" in text
    )
    (motion,) = yaml.safe_load((tmp_path / "arm" / "plan.yaml").read_text())["motions"]
    assert "effort" in motion["condition"]
    assert re.search(
        rf"if it is asymmetric_friction, {motion['table'][2:-4]} shows it", text
    )
    servo = "kp: 6.0\nsupply_v: 12.0\nresistance_ohm: 4.8\ntorque_nm_per_a: 1.0\nlimits: [-1.0, 1.0]\n"
    twin.write_text(f"kind: axis\nname: b\nunit: rad\nlaw: pwm\ninertia: 0.02\n{servo}")
    code, text = said(
        rivals, f"--twin={twin}", "--speed=1.5", f"--out={tmp_path / 'plan'}"
    )
    assert (
        code == 1
        and "coulomb_friction | asymmetric_friction: 0.00 floors at best" in text
    )
    assert "the same thing, pick either" in text
    assert "wrote nothing" in text and not (tmp_path / "plan").exists()


def suspected(
    folder: Path,
    part: str,
    base: dict[str, float],
    moved: str,
    /,
    **values: dict[str, float],
) -> Path:
    """Write the report.json of a diagnosis of ``part``: the effects ``values`` were fitted and explain equally much, or
    as much as the changed number ``moved``. Returns the folder."""
    rows = [
        {"name": n, "base": base, "values": {f"{n}.{k}": x for k, x in own.items()}}
        for n, own in values.items()
    ]
    first, *others = values
    found = {"rivals": {} if moved else {first: others}, "rounds": [{"evidence": rows}]}
    found["changed"] = [{"name": moved, "instead": [*values]}] * bool(moved)
    (folder / "report.json").write_text(json.dumps({"diagnoses": {part: found}}))
    return folder


@pytest.mark.parametrize("moved", ["", "torque_ff"])
def test_rivals_and_numbers_come_from_a_diagnosis(moved, said, tmp_path):
    numbers = {
        "coulomb_friction": {"torque_nm": 2.0},
        "viscous_friction": {"damping_nms_per_rad": 3.0},
    }
    found = suspected(
        tmp_path, SIGNAL, {"torque_ff": 1.73, "kp": 151.1, "kd": 17.1}, moved, **numbers
    )
    folder_or_file = found / "report.json" if moved else found
    code, _ = said(
        SIGNAL, f"--diagnosis={folder_or_file}", f"--out={tmp_path / 'plan'}"
    )
    plan = yaml.safe_load((tmp_path / "plan" / "plan.yaml").read_text())
    assert plan["tells_apart"] == ["coulomb_friction", "viscous_friction"]
    # both ten times as strong as is typical, with commanded gains
    assert code == 0 and min(plan["motions"][0]["floors_apart"].values()) > 5.0


def test_rivals_and_numbers_come_from_a_diagnosis_s_left_pads(said, tmp_path):
    base = {"k_n": 900.0, "k_d": 4.0, "zero_left_a": 0.0, "zero_left_b": 0.0}
    numbers = {"touch_delay": {"delay_s": 0.06}, "touch_lag": {"time_constant_s": 0.06}}
    found = suspected(tmp_path, "left pads", base, "", **numbers)
    code, _ = said("--pads=left", f"--diagnosis={found}", f"--out={tmp_path / 'plan'}")
    plan = yaml.safe_load((tmp_path / "plan" / "plan.yaml").read_text())
    assert code == 0 and plan["tells_apart"] == ["touch_delay", "touch_lag"]
    # both twice as late as is typical; typical ones leave 3.1 floors with k_n = 1200, so with 900 they leave 2.3
    assert plan["presses"][0]["floors_apart"]["touch_delay | touch_lag"] > 3.3


@pytest.mark.slow
def test_recordings_that_are_there_say_the_floor_and_where_the_arm_stands(
    sweeps, said, tmp_path
):
    out = tmp_path / "plan"
    _, text = said(
        SIGNAL, RIVALS, f"--measurements={sweeps}", f"--out={out}", "--num=1"
    )
    assert "noise floors (0.4" in text or "noise floors (0.39" in text
    middle = read_measurements(sweeps).fit[0].target[0, 4]
    with (
        out / yaml.safe_load((out / "plan.yaml").read_text())["motions"][0]["table"]
    ).open() as file:
        _, first, *_ = csv.reader(file)
    assert float(first[1]) == pytest.approx(middle, abs=1e-5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["left_joint9", RIVALS], "no joint 'left_joint9'"),
        ([SIGNAL, "--effects=[backlsh,cogging]"], "backlash"),
        ([SIGNAL, "--effects=[backlash]"], "two or more effects"),
        ([SIGNAL, "--effects=backlash,cogging,backlash"], "each once"),
        (
            [SIGNAL, "--effects=[speed_delay,backlash]"],
            "speed_delay: no search fits this effect",
        ),
        ([SIGNAL], "no effects to separate:"),
        ([SIGNAL, RIVALS, "--twin={tmp}/no.yaml"], "no.yaml"),
        (["--pads=lft", OF_PADS], "--pads=lft: no such arm; did you mean 'left'"),
        (
            ["left_joint5", "--pads=left", OF_PADS],
            "left_joint5 and --pads=left: give one of them",
        ),
        (
            ["--pads=left", "--effects=[touch_lag,backlash]"],
            "backlash is not an effect of pads",
        ),
        (
            ["left_joint5", "--effects=[touch_lag,touch_delay]"],
            "no effect 'touch_lag' for this part",
        ),
        (["--pads=left", "--effects=[touch_lag]"], "two or more effects"),
        (
            ["--pads=left"],
            "names no rival effects of left pads; give --effects=touch_lag,touch_delay",
        ),
        (
            ["--pads=left", OF_PADS, "--gains=fitted"],
            "--gains applies to joints only; remove it with --pads=left",
        ),
        ([], "missing --joint=left_joint5, or --pads=left for the pads of that arm"),
        (
            [SIGNAL, RIVALS, "--pose={{left_joint2: 1.2}}"],
            "--pose: motions are planned in the pose of the recordings; record one",
        ),
    ],
)
def test_what_cannot_be_done_is_said_and_nothing_written(
    words, message, said, tmp_path
):
    words = [w.format(tmp=tmp_path) for w in words]
    code, text = said(*words, f"--out={tmp_path / 'plan'}", f"--diagnosis={tmp_path}")
    assert code == 2 and message in text
    assert not (tmp_path / "plan").exists()


@pytest.mark.slow
def test_a_table_of_the_joint_alone_is_enough(sweeps, said, tmp_path):
    one = write_folder(tmp_path / "one", read_measurements(sweeps), (SIGNAL,))
    code, text = said(
        SIGNAL, RIVALS, f"--measurements={one}", f"--out={tmp_path / 'plan'}", "--num=1"
    )
    assert code == 0 and "wrote" in text and (tmp_path / "plan" / "plan.yaml").exists()


JOINT = '<joint name="{}" axis="0 0 1" range="-1 1"/><inertial pos=".1 0 0" mass="1" diaginertia="1 1 1"/>'
MODEL = f"<mujoco><worldbody><body>{JOINT.format('a')}<body>{JOINT.format('b')}</body></body></worldbody></mujoco>"
FRICTION = "{effect: coulomb_friction, torque_nm: 0.2"
AXIS = "kind: axis\nname: b\nunit: rad\ninertia: 1.0\nkp: 50.0\nkd: 5.0\nlimits: [-1.0, 1.0]\neffects: [{effect: "
ROBOT_FILE = "kind: robot\nmodel: arm.xml\njoints:\n  a: {kp: 50.0, kd: 5.0}\n  b: {kp: 50.0, kd: 5.0, effects: ["
CELLS = "kind: cells\ncells: [foot]\nload: {unit: N, rated: 9}\nreading: {unit: V, lowest: 0.0, highest: 3.0}\neffects: "
LAG = "{effect: touch_lag, time_constant_s: 0.02"


@pytest.mark.parametrize(
    ("words", "part", "name", "text"),
    [
        (
            (SIGNAL,),
            SIGNAL,
            "coulomb_friction",
            f"effects: [{FRICTION}, arm: left, joints: [joint5]}}]\n",
        ),
        (
            ("--pads=left",),
            "left pads",
            "touch_lag",
            f"effects: [{LAG}, pads: [left_a, left_b]}}]\n",
        ),
        (("b",), "b", "coulomb_friction", f"{ROBOT_FILE}{FRICTION}}}]}}\n"),
        (
            (),
            "b",
            "torque_saturation",
            f"{AXIS}torque_saturation, torque_max_nm: 8.0}}]\n",
        ),
        ((), "my twin", "touch_lag", f"{CELLS}[{LAG}}}]\n"),
    ],
)
def test_a_rival_that_is_in_the_file_is_said_to_be_with_commands_that_run(
    words, part, name, text, said, tmp_path
):
    """What is in the file is fitted beside every rival: 0.00 floors apart on every motion, and the message said so of motions."""
    (tmp_path / "arm.xml").write_text(MODEL)
    twin, out = tmp_path / "my twin.yaml", tmp_path / "plan"
    twin.write_text(text)
    other = "touch_delay" if name == "touch_lag" else "viscous_friction"
    out.mkdir()
    (out / "full").touch()
    code, text = said(
        *words, f"--effects={name},{other}", f"--twin={twin}", f"--out={out}"
    )
    assert (
        code == 2
        and f"the file of my twin has {name} at {part} already" in text
        and "already exists" not in text
    )
    refit, remove = (
        shlex.split(command) for command in re.findall("`(taccorl .*?)`", text)
    )
    assert refit[:2] == ["taccorl", "diagnose"] and refit[3:] == [f"--twin={twin}"]
    parse(DiagnoseConfig, refit[2:], positional="measurements")
    assert main(remove[1:]) == 0
    bare = tmp_path / f"my twin_without_{name}.yaml"
    assert f"--twin={bare}" in text and bare.exists()
    code, text = said(
        *words, f"--effects={name},{other}", f"--twin={bare}", f"--out={out}"
    )
    assert code == 2 and f"{out}: already exists" in text, (
        "no rival is in the file, and the place is the next question"
    )


@pytest.mark.slow
def test_a_plan_tables_of_targets_and_what_to_say_of_them(said, tmp_path):
    out = tmp_path / "plan"
    code, text = said("--pads=right", OF_PADS, f"--out={out}", "--num=2")
    assert (
        code == 0
        and "right pads: noise floors (0.6 counts, a taxel's mean over 5 frames)"
        in text
    )
    plan = yaml.safe_load((out / "plan.yaml").read_text())
    assert (plan["pads"], plan["rate_hz"]) == ("right pads", 200)
    assert plan["tells_apart"] == ["touch_delay", "touch_lag"]
    assert [p["table"] for p in plan["presses"]] == [
        "1_quick_taps.csv",
        "2_rod_across.csv",
    ]
    assert sorted(p.name for p in out.iterdir()) == [
        "1_quick_taps.csv",
        "2_rod_across.csv",
        "plan.yaml",
    ]
    apart = [p["floors_apart"]["touch_delay | touch_lag"] for p in plan["presses"]]
    assert apart[0] > 2.0 > apart[1] > 0.0
    for entry, name in zip(plan["presses"], ("quick_taps", "rod_across"), strict=True):
        with (out / entry["table"]).open() as file:
            head, *rows = csv.reader(file)
        assert head == ["t", "right_gripper.q_target", "right_gripper.opening"]
        time_s, target, opening = np.array(rows, dtype=float).T
        assert np.allclose(np.diff(time_s), 1 / 200) and len(rows) == round(
            entry["seconds"] * 200
        )
        assert entry["range_m"] == pytest.approx([target.min(), target.max()], abs=1e-9)
        assert target.min() >= 0 and target.max() <= 0.07
        assert opening == pytest.approx(OF_NAME[name].opening_m(), abs=1e-6)
        pressed = PressedNote(**entry["pressed"])
        assert (
            pressed.arm == "right"
            and pressed.radius_m == {"sphere": 0.012, "rod": 0.008}[pressed.shape]
        )
        deepest = pressed.radius_m - opening.min() / 2
        assert entry["depth_m"] == pytest.approx(deepest, abs=1e-6)
        assert entry["peak_force_n"] == pytest.approx(2e4 * deepest, abs=0.06)
        assert opening.min() - target.min() == pytest.approx(10 * deepest, abs=3e-6), (
            "20 kN/m on 2 kN/m"
        )


def test_what_only_one_truth_would_show_is_said(said, tmp_path, monkeypatch):
    monkeypatch.setattr(presses, "LIBRARY", (OF_NAME["long_hold"],))
    code, text = said(
        "--pads=left", "--effects=taxel_creep,touch_lag", f"--out={tmp_path / 'plan'}"
    )
    assert code == 0 and "taxel_creep | touch_lag: 0." in text and "wrote" in text, (
        "a plan was written"
    )
    assert "if it is taxel_creep, long_hold shows it (4." in text
    (press,) = yaml.safe_load((tmp_path / "plan" / "plan.yaml").read_text())["presses"]
    assert press["table"] == "1_long_hold.csv"
