"""Each law that a drafted robot file offers, chosen as its line says, is read."""

import re
from pathlib import Path

import pytest

from taccorl.alignment.controller.drive_law import NEEDED
from taccorl.alignment.machines.robot_draft import _LAWS, robot_draft
from taccorl.alignment.machines.robot_file import TODO, load_robot

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
