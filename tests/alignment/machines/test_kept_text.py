"""A robot file that is saved with other numbers keeps what its user wrote, and says exactly what it must."""

import dataclasses
from pathlib import Path

import pytest

from taccorl.alignment.machines.robot_file import Robot, load_robot
from taccorl.sim.effects import make_effect

MODEL = """<mujoco><compiler angle="radian"/><worldbody><body>
<joint name="swing" axis="0 0 1" range="-3 3"/><geom size="0.1" mass="1"/>
<body pos="0.2 0 0"><joint name="elbow" axis="0 1 0" range="-2 2"/><geom size="0.1" mass="1"/></body>
</body></worldbody></mujoco>"""
TEXT = """# My arm, bench 3: do not lose this line
kind: robot
model: 'arm.xml'        # from CAD, November
gravity_compensation: 0.0

joints:
  # its joints
  elbow:
    kd: 0.5     # measured by hand
    kp: 12.50   # 25 / 2
  swing: {kp: 20.0, kd: 1.5}  # by the datasheet
# the end
"""
COMMENTS = [line[line.index("#") :] for line in TEXT.splitlines() if "#" in line]


def written(folder: Path, text: str = TEXT) -> Robot:
    (folder / "arm.xml").write_text(MODEL, encoding="utf-8")
    path = folder / "robot.yaml"
    path.write_bytes(text.encode())
    return load_robot(path)


def changed(robot: Robot, name: str, **numbers: object) -> Robot:
    joints = dict(robot.config.joints)
    joints[name] = dataclasses.replace(joints[name], **numbers)
    return dataclasses.replace(
        robot, config=dataclasses.replace(robot.config, joints=joints)
    )


def saved(robot: Robot, path: Path) -> str:
    """The text that was written; what it says is what the robot is, and nothing else is left beside it."""
    before = {*path.parent.iterdir()}
    robot.save(path)
    assert load_robot(path).text(path) == robot.text(path)
    assert {*path.parent.iterdir()} - before <= {path}
    return path.read_bytes().decode()


FRICTION = make_effect("coulomb_friction", torque_nm=0.2)


def test_only_the_line_of_the_changed_number_changes(tmp_path):
    robot = changed(written(tmp_path), "elbow", kp=13.25)
    text = saved(robot, tmp_path / "new.yaml")
    assert text == TEXT.replace("kp: 12.50 ", "kp: 13.25 ")


@pytest.mark.parametrize(
    "numbers",
    [
        {"effects": [FRICTION]},
        {"torque_ff": 0.01, "effects": [FRICTION]},
        {"kd": 0.7},
        {},
    ],
)
@pytest.mark.parametrize("name", ["elbow", "swing"])
def test_comments_stay_whatever_changes(name, numbers, tmp_path):
    robot = changed(written(tmp_path), name, **numbers)
    text = saved(robot, tmp_path / "new.yaml")
    assert all(comment in text for comment in COMMENTS)
    assert "model: 'arm.xml'" in text
    assert text.index("elbow") < text.index("swing")
    if not numbers:
        assert text == TEXT


def test_effects_come_and_go(tmp_path):
    one = changed(written(tmp_path), "elbow", effects=[FRICTION])
    saved(one, tmp_path / "one.yaml")
    more = make_effect("viscous_friction", damping_nms_per_rad=0.1)
    loaded = load_robot(tmp_path / "one.yaml")
    two = changed(
        loaded, "elbow", effects=[*loaded.config.joints["elbow"].effects, more]
    )
    text = saved(two, tmp_path / "two.yaml")
    assert "viscous_friction" in text and "measured by hand" in text
    none = changed(load_robot(tmp_path / "two.yaml"), "elbow", effects=[])
    text = saved(none, tmp_path / "none.yaml")
    assert "friction" not in text and "measured by hand" in text


def test_line_ends_of_windows_stay(tmp_path):
    robot = changed(written(tmp_path, TEXT.replace("\n", "\r\n")), "swing", kp=21.0)
    text = saved(robot, tmp_path / "new.yaml")
    assert text.count("\r\n") == text.count("\n") == TEXT.count("\n")
    assert all(comment in text for comment in COMMENTS)


def test_another_folder_gets_another_path_of_the_model(tmp_path):
    (tmp_path / "deep").mkdir()
    robot = changed(written(tmp_path), "swing", kp=21.0)
    text = saved(robot, tmp_path / "deep" / "new.yaml")
    assert "../arm.xml" in text and "from CAD, November" in text


def test_what_cannot_be_kept_is_written_anew(tmp_path):
    """The file that was loaded is gone: the numbers are right, and the header is ours."""
    robot = changed(written(tmp_path), "elbow", kp=13.25)
    robot.path.unlink()
    assert saved(robot, tmp_path / "new.yaml") == robot.text(tmp_path / "new.yaml")


def test_a_file_replaced_by_another_since_it_was_loaded_does_not_leak_in(tmp_path):
    robot = changed(written(tmp_path), "elbow", kp=13.25)
    robot.path.write_text(TEXT.replace("20.0", "99.0"), encoding="utf-8")
    saved(robot, tmp_path / "new.yaml")
    assert load_robot(tmp_path / "new.yaml").config.joints["swing"].kp == 20.0
