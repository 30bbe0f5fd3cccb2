"""Drives of MJCF files: MuJoCo simulates each model, and the robot file that init-robot
drafts from it must move alike, or the draft must name what it lacks, with the line."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import pytest

from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.machines.robot_draft import robot_draft
from taccorl.alignment.machines.robot_file import load_robot
from taccorl.alignment.machines.robot_model import load_robot_model
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.cli import init_robot

MODEL = """<mujoco><compiler angle="radian"/><option INTEGRATION/><worldbody><body>
<joint name="j" axis="0 1 0" range="-2 2" {joint}/>
<inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody><actuator>
{actuators}
</actuator></mujoco>
"""
INTEGRATION = 'timestep="1e-4" integrator="implicitfast"'
JOINT_LINE, ACTUATOR_LINE = 2, 4
RATE_HZ, STEPS = 500, 20  # rows a second, and physics steps of a row
FLOOR_RAD = 2e-4  # noise of a joint's encoder, as in other tests of simulated arms
SERVO = '<position joint="j" kp="80" kv="6"/>'
STIFF = 'solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001 0.5 2"'
MOTOR = '<dcmotor joint="j" motorconst="0.8" resistance="2"'
GEARED = '<dcmotor joint="j" motorconst="0.4" resistance="2" gear="2"'
ON_BOARD = GEARED + ' input="pos" controller="20 {} 1.5 {} 0 {}" {}/>'
PASSIVE = '<dcmotor joint="j" input="none" motorconst="0" resistance="1"'


@dataclass(frozen=True, kw_only=True)
class Case:
    """A model with one feature, its commands, and what the draft says."""

    actuators: str = SERVO
    joint: str = ""
    per_control: float = 1.0
    """Target of the joint per control of the model."""
    kind: str = "position"
    """Control of the model: position; velocity; integral: speeds, of which the integral is
    logged; torque or duty: the test computes them from the position at each step."""
    written: Mapping[str, str] = field(default_factory=dict)
    """Key of the draft → what the user writes for TODO."""
    remarks: tuple[str, ...] = ()
    """Line, and words of each remark."""
    moves_alike: bool = True
    """False: the draft lacks what the remark names."""


def gains(kp: float, kd: float) -> dict[str, str]:
    return {"kp": str(kp), "kd": str(kd)}


def at(line: int, *words: str) -> tuple[str, ...]:
    return (f"arm.xml:{line}", *words)


CASES = {
    "servo": Case(),
    "gear": Case(
        actuators='<position joint="j" kp="20" kv="1.5" gear="2"/>',
        per_control=0.5,
        remarks=at(ACTUATOR_LINE, "factor: 0.5"),
    ),
    "gear backwards": Case(
        actuators='<position joint="j" kp="20" kv="1.5" gear="-2"/>',
        per_control=-0.5,
        remarks=at(ACTUATOR_LINE, "factor: -0.5"),
    ),
    "actuator damping": Case(
        actuators='<position joint="j" kp="80" kv="2" damping="3"/>'
    ),
    "actuator damping, squares": Case(
        actuators='<position joint="j" kp="20" kv="1" gear="2" damping="0.3 0.5"/>',
        joint='damping="1 1"',
        per_control=0.5,
        remarks=at(ACTUATOR_LINE, "factor"),
    ),
    "actuator armature": Case(
        actuators='<position joint="j" kp="20" kv="1.5" gear="2" armature="0.02"/>',
        joint='armature="0.03"',
        per_control=0.5,
        remarks=at(ACTUATOR_LINE, "factor"),
    ),
    "delay": Case(
        actuators='<position joint="j" kp="80" kv="6" delay="0.02" nsample="200"/>'
    ),
    "timeconst": Case(
        actuators='<position joint="j" kp="80" kv="6" timeconst="0.05"/>'
    ),
    "slide": Case(
        actuators='<position joint="j" kp="400" kv="30" damping="9 5" armature="0.3"/>',
        joint='type="slide" axis="1 0 0"',
    ),
    "springref": Case(joint='stiffness="10" springref="0.5"'),
    "frictionloss": Case(joint=f'frictionloss="0.5" {STIFF}'),
    "pid with ki": Case(
        actuators='<pid joint="j" kp="80" kv="6" ki="160" input="pos"/>'
    ),
    "pid with ki of 1": Case(
        actuators='<pid joint="j" kp="4" kv="1" ki="1" input="pos"/>',
        joint='axis="0 0 1"',
    ),
    "pid with slewmax": Case(
        actuators='<pid joint="j" kp="80" kv="6" slewmax="1" input="pos"/>'
    ),
    "pid with two inputs": Case(
        actuators='<pid joint="j" kp="80" kv="6"/>',
        remarks=at(ACTUATOR_LINE, "velocity_feedforward"),
    ),
    "pid with three inputs": Case(
        actuators='<pid joint="j" kp="80" kv="6" input="pos vel ff" ffrange="-9 9"/>',
        remarks=at(ACTUATOR_LINE, "velocity_feedforward", "torque_ff", "ctrlrange"),
    ),
    "velocity beside a position": Case(
        actuators='<position name="a" joint="j" kp="80" kv="2"/>'
        '<velocity name="b" joint="j" kv="3"/>',
        remarks=at(ACTUATOR_LINE, "actuator b", "beside a"),
    ),
    "motor beside a position": Case(
        actuators='<motor name="b" joint="j" gear="3"/>'
        '<position name="a" joint="j" kp="80" kv="6"/>',
        remarks=at(ACTUATOR_LINE, "actuator b", "torque_ff"),
    ),
    "gain that is not kp, constant": Case(
        actuators='<general joint="j" gainprm="40" biastype="affine" '
        'biasprm="1.5 -80 -6"/>',
        per_control=0.5,
        remarks=at(ACTUATOR_LINE, "factor: 0.5"),
    ),
    "velocity": Case(
        actuators='<velocity joint="j" kv="1.5" gear="2"/>',
        joint='axis="0 0 1"',
        kind="velocity",
        per_control=0.5,
        remarks=at(ACTUATOR_LINE, "factor: 0.5"),
    ),
    "intvelocity": Case(
        actuators='<intvelocity joint="j" kp="80" kv="6"/>',
        kind="integral",
        remarks=at(ACTUATOR_LINE, "integral"),
    ),
    "motor": Case(
        actuators='<motor joint="j" gear="2" ctrlrange="-2 2"/>',
        kind="torque",
        per_control=2.0,
        written=gains(80, 6),
        remarks=at(ACTUATOR_LINE, "factor: 2"),
    ),
    "motor with a lag": Case(
        actuators='<general joint="j" dyntype="filterexact" dynprm="0.01"/>',
        kind="torque",
        written=gains(40, 4),
    ),
    "dcmotor": Case(
        actuators=f'{GEARED} ctrlrange="-12 12"/>',
        kind="duty",
        per_control=1 / 12,
        written=gains(8, 0.3),
    ),
    "dcmotor with inductance": Case(
        actuators=f'{MOTOR} inductance="0.01" ctrlrange="-12 12"/>',
        kind="duty",
        per_control=1 / 12,
        written=gains(8, 0.3),
    ),
    "dcmotor with torque limit": Case(
        actuators=f'{MOTOR} saturation="2 0 0" ctrlrange="-12 12"/>',
        kind="duty",
        per_control=1 / 12,
        written=gains(8, 0.3),
    ),
    "dcmotor with a controller": Case(
        actuators=ON_BOARD.format(40, 2, 0, 'inductance="0.01"'),
        per_control=0.5,
        remarks=at(ACTUATOR_LINE, "factor"),
    ),
    "dcmotor with a controller and Vmax": Case(
        actuators=ON_BOARD.format(0, 0, 8, ""),
        per_control=0.5,
        remarks=at(ACTUATOR_LINE, "factor"),
    ),
    "dcmotor that brakes": Case(actuators=f'{SERVO}{GEARED} input="none"/>'),
    "dcmotor with cogging": Case(
        actuators=f'{SERVO}{PASSIVE} gear="-2" cogging="0.3 6 0.3"/>'
    ),
    "dcmotor with LuGre friction": Case(
        actuators=f'{SERVO}{PASSIVE} gear="2" lugre="500 0.5 0.25 0.4 0.1"/>'
    ),
    "forcerange": Case(
        actuators='<position joint="j" kp="20" kv="1.5" gear="2" forcerange="-2 2"/>',
        per_control=0.5,
        remarks=at(ACTUATOR_LINE, "factor"),
    ),
    "one-sided forcerange": Case(
        actuators='<position joint="j" kp="80" kv="6" forcerange="-4 0.5"/>',
        remarks=at(ACTUATOR_LINE, "actuator_forcerange[1] 0.5"),
        moves_alike=False,
    ),
    "forceranges of two": Case(
        actuators='<position name="a" joint="j" kp="80" kv="2" forcerange="-1 1"/>'
        '<velocity joint="j" kv="3"/>',
        remarks=at(ACTUATOR_LINE, "actuator_forcerange[1] 1", "not the sum"),
        moves_alike=False,
    ),
    "range of targets": Case(
        actuators='<position joint="j" kp="80" kv="6" ctrlrange="-0.2 0.2"/>',
        remarks=at(ACTUATOR_LINE, "clips targets to -0.2 … 0.2"),
        moves_alike=False,
    ),
    "range of targets that is the joint's": Case(
        actuators='<position joint="j" kp="80" kv="6" inheritrange="1"/>'
    ),
    "one-sided actuatorfrcrange": Case(
        joint='actuatorfrcrange="-4 0.5"',
        remarks=at(JOINT_LINE, "jnt_actfrcrange[1] 0.5"),
        moves_alike=False,
    ),
    "cubic damping": Case(
        joint='damping="1 2 5"',
        remarks=at(JOINT_LINE, "dof_dampingpoly[1] 5"),
        moves_alike=False,
    ),
    "polynomial stiffness": Case(
        joint='stiffness="10 5 60"',
        remarks=at(JOINT_LINE, "jnt_stiffnesspoly[0] 5", "jnt_stiffnesspoly[1] 60"),
        moves_alike=False,
    ),
    "springyield": Case(
        joint='stiffness="40" springyield="0.05"',
        remarks=at(JOINT_LINE, "jnt_springyield 0.05"),
        moves_alike=False,
    ),
    "stiffness beyond the effect's bounds": Case(
        joint='stiffness="120"',
        remarks=at(JOINT_LINE, "jnt_stiffness 120", "0 … 50"),
        moves_alike=False,
    ),
    "imax": Case(
        actuators='<pid joint="j" kp="80" kv="6" ki="160" imax="0.001" input="pos"/>',
        remarks=at(ACTUATOR_LINE, "actuator_dynprm[0] 0.001", "imax"),
        moves_alike=False,
    ),
    "delay beyond the effect's bounds": Case(
        actuators='<position joint="j" kp="80" kv="6" delay="0.3" nsample="3000"/>',
        remarks=at(ACTUATOR_LINE, "actuator_delay 0.3", "0 … 0.2 s"),
        moves_alike=False,
    ),
    "delay longer than its samples": Case(  # 40 of 0.1 ms, and 0.02 s are stated
        actuators='<position joint="j" kp="80" kv="6" delay="0.02" nsample="40"/>',
        remarks=at(ACTUATOR_LINE, "actuator_delay 0.02", "by 0.004 s", "nsample"),
        moves_alike=False,
    ),
    "gain that drives away": Case(
        actuators='<general joint="j" gainprm="8" biastype="affine" biasprm="0 8 -6"/>',
        joint='stiffness="40"',
        written=gains(8, 6),
        remarks=at(ACTUATOR_LINE, "actuator_biasprm[1] 8", "away"),
        moves_alike=False,
    ),
    "damper": Case(
        actuators=f'{SERVO}<damper joint="j" kv="9" ctrlrange="0 1"/>',
        remarks=at(ACTUATOR_LINE, "mjGAIN_AFFINE", "actuator_gainprm[2] -9"),
    ),
}
"""Rows with remarks that move alike state something that the test does not use, such as a
control for speeds, which stays 0, or that counts in how it logs, such as a gear."""


def model_file(folder: Path, case: Case) -> Path:
    joint = case.joint
    text = MODEL.replace("INTEGRATION", INTEGRATION)
    text = text.format(joint=joint, actuators=case.actuators)
    if "axis" in joint:
        text = text.replace('axis="0 1 0" ', "")
    (folder / "arm.xml").write_text(text)
    return folder / "arm.xml"


def commanded() -> np.ndarray:
    """(T,) 3 s of a chirp to 1.6 Hz with two steps at its end: 0.9 rad, up to 3.5 rad/s [rad]."""
    time_s = np.arange(3 * RATE_HZ) / RATE_HZ
    rising = np.clip(time_s / 0.5, 0.0, 1.0)
    chirp = 0.4 * rising * np.sin(2 * np.pi * (0.3 + 0.3 * time_s) * time_s)
    return chirp + 0.3 * (time_s > 2.2) - 0.2 * (time_s > 2.6)


def simulated(path: Path, case: Case, target: np.ndarray) -> np.ndarray:
    """(T,) position in MuJoCo at each row's time, before its command acts, after 3 s at the
    first target [rad]."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data, seen = mujoco.MjData(model), np.empty(len(target))
    names = [model.actuator(a).name for a in range(model.nactuator)]
    driven = model.actuator_ctrladr[names.index("a") if "a" in names else 0]
    computed = case.kind in ("torque", "duty")
    for row in range(-3 * RATE_HZ, len(target)):
        if row >= 0:
            seen[row] = data.qpos[0]
        goal = target[max(row, 0)]
        data.ctrl[driven] = goal / case.per_control
        if not computed:
            mujoco.mj_step(model, data, STEPS)
            continue
        kp, kd = float(case.written["kp"]), float(case.written["kd"])
        for _ in range(STEPS):
            output = kp * (goal - data.qpos[0]) - kd * data.qvel[0]
            data.ctrl[driven] = output / case.per_control
            mujoco.mj_step(model, data)
    return seen


def replayed(
    folder: Path, case: Case, target: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """(T,) position of the twin of the drafted file, once TODO is replaced [rad]."""
    text = (folder / "robot.yaml").read_text()
    written = {"gravity_compensation": "0.0", "gains": "commanded", **case.written}
    for key, value in written.items():
        text = text.replace(f"{key}: TODO", f"{key}: {value}")
    if case.kind == "integral":
        text = text.replace("# command_hz", "command_hz")
    (folder / "robot.yaml").write_text(text)
    model = JointModel(load_robot(folder / "robot.yaml"), "j")
    m = Measurement(
        name="chirp",
        time_s=np.arange(len(target)) / RATE_HZ,
        target=target[:, None],
        measured=seen[:, None],
        signals=("j",),
        units=("m" if "slide" in case.joint else "rad",),
        target_kinds=("velocity" if case.kind == "velocity" else "position",),
    )
    return model.simulate(motion_of(m, "j", model.joint), model.gains).reported


@pytest.mark.parametrize("name", CASES)
def test_a_drafted_drive_moves_as_mujoco_or_its_draft_names_what_it_lacks(
    name: str, tmp_path: Path
) -> None:
    case = CASES[name]
    path = model_file(tmp_path, case)
    assert init_robot.main([str(path), f"--out={tmp_path / 'robot.yaml'}"]) == 0
    said = "\n".join(load_robot_model(path).remarks)
    assert all(words in said for words in case.remarks)
    assert case.remarks or not said
    target = commanded()
    logged = target
    if case.kind == "integral":
        logged = np.concatenate([[0.0], np.cumsum(target)[:-1]]) / RATE_HZ
    seen = simulated(path, case, target)
    assert np.ptp(seen) > 0.1
    off = replayed(tmp_path, case, logged, seen) - seen
    floors = float(np.sqrt(np.mean(off**2))) / FLOOR_RAD
    assert floors < 2.0 if case.moves_alike else floors > 10.0, floors


BASES: dict[str, dict[str, str | None]] = {
    "joint": {
        "axis": "0 1 0",
        "range": "-1 1",
        "frictionloss": "1",
        "damping": "1",
        "stiffness": "5",
    },
    "general": {"gainprm": "20", "biastype": "affine", "biasprm": "0 -20 -2"},
    "position": {"kp": "20", "kv": "2"},
    "intvelocity": {"kp": "20", "kv": "2"},
    "velocity": {"kv": "2"},
    "motor": {},
    "cylinder": {"timeconst": "0.1", "area": "3"},
    "pid": {"kp": "20", "kv": "2", "ki": "8", "input": "pos vel ff"},
    "dcmotor": {"motorconst": "0.8", "resistance": "2", "ctrlrange": "-12 12"},
    "damper": {"kv": "2", "ctrlrange": "0 1"},
}
"""Element of MJCF → the attributes to which one is added."""
OTHERS: dict[str, dict[str, str | None]] = {
    "actuatorfrclimited": {"actuatorfrclimited": "true", "actuatorfrcrange": "-1 2"},
    "actlimited": {"actlimited": "true", "actrange": "-0.1 0.1", "dyntype": "filter"},
    "actrange": {"actrange": "-0.1 0.1", "dyntype": "filter"},
    "biastype": {"biastype": "none"},
    "biasprm": {"biasprm": "1 -20 -2"},
    "controller": {"controller": "10 0 1 0 0 0", "input": "pos", "ctrlrange": None},
    "ctrllimited": {"ctrllimited": "true", "ctrlrange": "0 0.1"},
    "dampratio": {"dampratio": "0.3", "kv": None},
    "delay": {"delay": "0.02", "nsample": "10"},
    "diameter": {"diameter": "3"},
    "dyntype": {"dyntype": "integrator"},
    "dynprm": {"dynprm": "0.3", "dyntype": "filter"},
    "ffrange": {"ffrange": "-1 1"},
    "forcelimited": {"forcelimited": "true", "forcerange": "-1 2"},
    "gaintype": {"gaintype": "affine", "gainprm": "0 0 -3"},
    "pid input": {"input": "pos"},
    "dcmotor input": {"input": "none", "ctrlrange": None},
    "limited": {"limited": "false"},
    "nominal": {"nominal": "12 3 5", "motorconst": None, "resistance": None},
    "thermal": {"thermal": "1 2 0 0.004 20 21"},
}
"""Attribute → attributes to add, where it means nothing without others; None: to remove."""
RANGES = (
    "actuatorfrcrange",
    "ctrlrange",
    "forcerange",
    "posrange",
    "range",
    "velrange",
)
VALUES = {
    **dict.fromkeys(RANGES, "0 0.1"),
    "bias": "1 -2 -3",
    "cogging": "0.1 7 0",
    "gainprm": "30",
    "gear": "3",
    "inductance": "0.01",
    "inheritrange": "0.5",
    "lugre": "500 0.5 0.25 0.4 0.1",
    "motorconst": "0.7",
    "saturation": "1 0 0",
    "solimpfriction": "0.5 0.6 0.001 0.5 2",
    "solimplimit": "0.5 0.6 0.001 0.5 2",
    "solreffriction": "0.1 1",
    "solreflimit": "0.1 1",
    "springdamper": "0.1 1",
}
"""Attribute → value that differs from the default; 0.37 for all others."""
LABELS = {"class", "group", "lengthrange", "name", "user"}
TREE = {"actuatorgravcomp", "axis", "pos", "ref", "type"}  # the twin keeps the model
OF_STEPS = {"actearly", "interp", "nsample"}
TRANSMISSIONS = {"body", "joint", "jointinparent", "site", "refsite", "tendon"}
TRANSMISSIONS |= {"cranklength", "cranksite", "slidersite"}
OF_OTHERS = {
    ("general", "actdim"),
    ("general", "ffrange"),
    ("general", "input"),
    ("general", "velrange"),
    ("dcmotor", "inheritrange"),
}
"""Attributes that MuJoCo documents as without effect beside the base's."""


REST = """<mujoco><option density="1.2"><flag spring="disable"/></option><worldbody>
<body name="b" gravcomp="0.5"><joint name="j"/><joint name="k" type="slide"/>
<inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody>
<tendon>
<fixed name="t" damping="3"><joint joint="j" coef="1"/></fixed>
<fixed name="s"><joint joint="k" coef="1"/></fixed></tendon><actuator>
<position name="a" tendon="s" kp="7" dampratio="1" forcerange="-5 5" delay="0.1" nsample="9"/>
</actuator><equality>
<joint joint1="j" polycoef="0.3 0 0 0 0"/></equality></mujoco>
"""


def test_what_a_model_states_beside_its_joints_is_named_with_its_line(
    tmp_path: Path,
) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(REST)
    text, robot = robot_draft(path, tmp_path / "robot.yaml")
    for words in (
        ("option (arm.xml:1)", "density 1.2"),
        ("flag (arm.xml:1)", "spring disable"),
        ("body b (arm.xml:2)", "gravcomp 0.5"),
        ("fixed t (arm.xml:5)", "damping 3"),
        ("actuator a", "forcerange -5 5", "delay 0.1", "dampratio 1"),
        ("joint j (arm.xml:9)", "0.3"),
    ):
        assert any(all(w in remark for w in words) for remark in robot.remarks), words
    assert "kd: TODO" in text  # dampratio is no gain


MUSCLE = """<mujoco><worldbody>
<body><joint name="j" axis="0 1 0" range="-1 1" limited="true"/><geom size=".1"/>
</body></worldbody>
<actuator><position name="a" joint="j" kp="40" kv="2"/>
<muscle name="m" joint="j"/></actuator></mujoco>"""


def test_the_range_of_a_muscle_is_not_sought(tmp_path: Path) -> None:
    """MuJoCo moves the model to find it, which may take minutes; no robot file uses it."""
    path = tmp_path / "arm.xml"
    path.write_text(MUSCLE)
    by_mujoco = mujoco.MjModel.from_xml_path(str(path))
    assert by_mujoco.actuator_lengthrange[1].any()
    model = load_robot_model(path).model
    assert not model.actuator_lengthrange.any()
    _, robot = robot_draft(path, tmp_path / "robot.yaml")
    assert any("actuator m (arm.xml:5)" in remark for remark in robot.remarks)


def attributes(tag: str) -> list[str]:
    """Attributes of an element, by the schema of the MuJoCo that is installed."""
    schema = mujoco.mj_printSchema(False, False)
    block = rf"^      {tag} \(\*\) +([a-z0-9 ]+\n(?: {{20,}}[a-z0-9 ]+\n)*)"
    found = re.search(block, schema, re.MULTILINE)
    assert found
    return found[1].split()


def drafted_with(folder: Path, tag: str, more: Mapping[str, str | None]) -> str:
    """Draft of a model with one joint and one actuator, one of which has more attributes."""
    elements = []
    for element in ("joint", "position" if tag == "joint" else tag):
        stated = {**BASES[element], **(more if element == tag else {})}
        text = " ".join(f'{k}="{v}"' for k, v in stated.items() if v is not None)
        elements.append(
            f'<{element} {"name" if element == "joint" else "joint"}="j" {text}/>'
        )
    path = folder / "arm.xml"
    path.write_text(
        f"""<mujoco><compiler angle="radian"/><worldbody><body>{elements[0]}
        <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody>
        <actuator>{elements[1]}</actuator></mujoco>"""
    )
    return robot_draft(path, folder / "robot.yaml")[0]


@pytest.mark.parametrize("tag", BASES)
def test_no_attribute_of_the_schema_leaves_the_draft_as_it_was(
    tag: str, tmp_path: Path
) -> None:
    base = drafted_with(tmp_path, tag, {})
    silent = LABELS | TREE | OF_STEPS | TRANSMISSIONS
    for name in attributes(tag):
        if name in silent or (tag, name) in OF_OTHERS:
            continue
        one: dict[str, str | None] = {name: VALUES.get(name, "0.37")}
        more = OTHERS.get(f"{tag} {name}", OTHERS.get(name, one))
        if tag in ("intvelocity", "cylinder"):
            more = {k: v for k, v in more.items() if k != "dyntype"}
        assert drafted_with(tmp_path, tag, more) != base, name
