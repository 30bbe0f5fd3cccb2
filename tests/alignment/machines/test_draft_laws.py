"""Each law that a drafted robot file offers, chosen as its line says, is read."""

import json
import re
from pathlib import Path

import pytest

from taccorl.alignment.controller.drive_law import NEEDED, Law
from taccorl.alignment.machines.robot_draft import (
    _LAWS,
    StatedFacts,
    robot_draft,
    servo_of,
    servos,
)
from taccorl.alignment.machines.robot_file import TODO, load_robot
from taccorl.cli import init_robot
from taccorl.errors import TaccorlError

ARM = """<mujoco><worldbody><body>
<joint name="swing" axis="0 1 0" range="-1 1" limited="true"/>
<inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody>
<actuator><position joint="swing" kp="20" kv="1.5" forcerange="-9 9"/></actuator>
</mujoco>"""
WINDING = {"supply_v": 12.0, "resistance_ohm": 4.0, "torque_nm_per_a": 0.8}


@pytest.mark.parametrize("law", list(_LAWS))
def test_a_draft_with_any_law_that_it_offers_is_read(law: str, tmp_path: Path):
    """What the line of the law excludes with "no …" is removed, TODOs are filled in."""
    model, out = tmp_path / "arm.xml", tmp_path / "robot.yaml"
    model.write_text(ARM)
    text, _ = robot_draft(model, out)
    text = re.sub(r"law: \w+ ", f"law: {law} ", text)
    excluded = re.findall(r"; no (.*)$", _LAWS[law])
    for key in re.split(r", (?:no )?", excluded[0]) if excluded else ():
        text = re.sub(rf"\n    {key}: [^\n]*", "", text)
    text = text.replace(f"gravity_compensation: {TODO}", "gravity_compensation: 0.0")
    text = text.replace(f"gains: {TODO}", "gains: commanded")
    missing = {name: WINDING[name] for name in NEEDED[law] if name in WINDING}
    lines = [f"    {name}: {value}" for name, value in missing.items()]
    text = text.replace(
        "\n    law:", "".join(f"\n{line}" for line in lines) + "\n    law:"
    )
    out.write_text(text)
    assert load_robot(out).config.joints["swing"].law == law


@pytest.mark.parametrize("law", list(_LAWS))
def test_a_stated_law_and_share_leave_todos_for_unknown_numbers_only(
    law: Law, tmp_path: Path
):
    """The model's servo has kp in N·m/rad and kd in N·m·s/rad: of no other unit."""
    model, out = tmp_path / "arm.xml", tmp_path / "robot.yaml"
    model.write_text(ARM)
    stated = StatedFacts(law=law, gains="fitted", gravity_compensation=0.0)
    text, _ = robot_draft(model, out, stated)
    todo = re.findall(rf"(\w+): {TODO}", text)
    assert todo == {
        "impedance": [],
        "cascade": ["kp"],
        "pwm": ["kp", "kd", *WINDING],
    }.get(law, [])
    out.write_text(text.replace(f": {TODO}", ": 2.0"))
    drive = load_robot(out).config.joints["swing"]
    assert drive.law == law
    assert drive.is_uncertain == (law not in ("torque", "effort"))
    if law in ("impedance", "cascade", "velocity"):
        assert (drive.gains, drive.kd) == ("fitted", 1.5)


def test_numbers_of_a_servo_are_those_that_its_authors_published():
    folder = Path(__file__).parents[4] / "shared" / "data" / "bam"
    if not folder.is_dir():
        pytest.skip("needs ../shared/data/bam")
    names = {"sts3215": "feetech_sts3215_7_4V"}
    keys = {
        "torque_nm_per_a": "kt",
        "resistance_ohm": "R",
        "rotor_inertia": "armature",
        "coulomb_friction": "friction_base",
        "viscous_friction": "friction_viscous",
    }
    compared = 0
    for name, servo in servos().items():
        if name == "so101":
            continue
        published = json.loads((folder / names.get(name, name) / "m1.json").read_text())
        for key in keys.keys() & servo.keys():
            assert servo[key][0] == pytest.approx(published[keys[key]], rel=1e-5), key
            compared += 1
    assert {*servos()} >= {p.name for p in folder.iterdir() if p.is_dir()} - {
        *names.values()
    }
    assert compared == 31  # 5 numbers of 5 servos, 3 of 2: their winding is a factor


@pytest.mark.parametrize("name", list(servos()))
def test_a_draft_of_a_servo_is_read_once_its_gains_are_written(
    name: str, tmp_path: Path
):
    model, out = tmp_path / "arm.xml", tmp_path / "robot.yaml"
    model.write_text(ARM.replace("<joint ", '<joint damping="0.7" '))
    text, _ = robot_draft(model, out, StatedFacts(servo=servo_of(name)))
    todo = {*re.findall(rf"(\w+): {TODO}", text)}
    firmware = {"kp", "kd", "gains"} if name.startswith("erob") else {"kp"}
    assert todo == (set() if name == "so101" else firmware)
    text = text.replace(f"gains: {TODO}", "gains: commanded")
    out.write_text(text.replace(f": {TODO}", ": 16"))
    drive = load_robot(out).config.joints["swing"]
    number, source = servo_of(name)["viscous_friction"]
    (viscous,) = [e for e in drive.effects if e.name == "viscous_friction"]
    assert (viscous.damping_nms_per_rad, drive.armature) == (
        number,
        servo_of(name)["rotor_inertia"][0],
    )
    assert source in text
    assert "damping_nms_per_rad: 0.7}" in text  # the model's, in a comment
    if name == "so101":  # 16 steps of 0.166 / rad; 7.4 V · 1.21164 N·m/A / 2.67617 Ω
        assert drive.kp * drive.kp_factor == pytest.approx(2.656)
        assert drive.stall_nm == pytest.approx(3.3504, abs=1e-4)


def test_a_law_that_the_servo_does_not_have_and_an_unknown_servo_are_errors(
    tmp_path: Path,
):
    model = tmp_path / "arm.xml"
    model.write_text(ARM)
    stated = StatedFacts(servo=servo_of("sts3215"), law="impedance")
    with pytest.raises(TaccorlError, match=r"--law=impedance: the servo has law pwm"):
        robot_draft(model, tmp_path / "robot.yaml", stated)
    with pytest.raises(TaccorlError, match=r"--servo=sts3125: .*sts3215"):
        servo_of("sts3125")


def test_an_so101_needs_no_value_and_a_note_says_which_option_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    model, out = tmp_path / "arm.xml", tmp_path / "robot.yaml"
    model.write_text(ARM)
    words = [str(model), f"--out={out}", "--servo=so101", "--gains=fitted"]
    assert init_robot.main(words) == 0
    shown = capsys.readouterr().out
    assert "note: --gains=fitted is not written" in shown
    assert TODO not in shown
    assert load_robot(out).config.gravity_compensation == 0.0
    with pytest.raises(TaccorlError, match=r"--gravity_compensation=2"):
        init_robot.main([str(model), "--out=x.yaml", "--gravity_compensation=2"])
