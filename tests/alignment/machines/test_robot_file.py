"""Robot files: rigid bodies of MJCF and URDF against arithmetic, and what is refused."""

import dataclasses
import math
import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest
from made_rows import of_signal
from simulated_slide import logged

from taccorl.alignment.checks.robot import check_robot
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.machines.robot_draft import robot_draft
from taccorl.alignment.machines.robot_file import Robot, load_robot
from taccorl.alignment.machines.robot_joint import (
    Along,
    RobotJoint,
    moved_together,
    needed_along,
    under_gravity,
)
from taccorl.alignment.machines.robot_model import load_robot_model
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.cli import init_robot
from taccorl.errors import SpecError, TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.load import Payload

# Two links that turn about y and hang in gravity: point masses 2 kg at 0.3 m and 1 kg at 0.2 m beyond the elbow at 0.5 m.
TWO_LINKS = """
<mujoco><compiler angle="radian"/>
<asset><mesh name="cover" file="not_there.stl"/></asset>
<worldbody><body name="base"><freejoint/><inertial pos="0 0 0" mass="9" diaginertia="1 1 1"/><geom type="mesh" mesh="cover"/>
<body name="upper"><joint name="shoulder" axis="0 1 0" range="-2 2"/>
<inertial pos="0.3 0 0" mass="2" diaginertia="1e-9 1e-9 1e-9"/><geom type="mesh" mesh="cover"/>
<body name="lower" pos="0.5 0 0"><joint name="elbow" axis="0 1 0" range="-2 2" damping="0.2" frictionloss="0.1"/>
<inertial pos="0.2 0 0" mass="1" diaginertia="1e-9 1e-9 1e-9"/></body></body></body></worldbody>
<actuator><position name="servo" joint="elbow" kp="80" kv="4" gear="2" forcerange="-10 10"/></actuator>
<keyframe><key qpos="0 0 0 1 0 0 0 0 0"/></keyframe></mujoco>
"""
ROBOT_YAML = """\
kind: robot
model: arm.xml
joints:
  shoulder: {kp: 50.0, kd: 5.0}
  elbow: {kp: 20.0, kd: 1.0, rotor_inertia: 2.0e-5, gear: 50.0, effort_limit: 100.0}
"""


EFFORTS_ALONE = """\
kind: robot
model: arm.xml
gravity_compensation: 0.0
joints:
  shoulder: {law: effort}
  elbow: {law: effort}
"""
SWINGING = """
<mujoco><compiler angle="radian"/><worldbody><body><joint name="shoulder" axis="0 1 0" range="-3 3"/>
<inertial pos="0 0 -0.15" mass="1.5" diaginertia="0.01 0.01 0.01"/>
<body pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" range="-3 3"/>
<inertial pos="0 0 -0.15" mass="1.0" diaginertia="0.01 0.01 0.01"/></body></body></worldbody></mujoco>
"""


def robot(folder: Path, text: str = ROBOT_YAML, model: str = TWO_LINKS) -> Robot:
    (folder / "arm.xml").write_text(model)
    (folder / "robot.yaml").write_text(text)
    return load_robot(folder / "robot.yaml")


def swept(**motions: np.ndarray) -> Measurement:
    """Joints at 200 Hz exactly where these angles (T,) are."""
    angles = np.column_stack(list(motions.values()))
    rows = {
        "time_s": np.arange(len(angles)) / 200,
        "target": angles,
        "measured": angles.copy(),
    }
    return logged("sweep", tuple(motions), ("rad",) * len(motions), **rows)


def test_inertia_and_weight_are_those_of_the_point_masses(tmp_path: Path) -> None:
    made = robot(tmp_path)
    bent = swept(shoulder=np.zeros(400), elbow=np.full(400, 0.5 * np.pi))
    shoulder, elbow = (JointModel(made, name) for name in ("shoulder", "elbow"))
    seen = motion_of(bent, "shoulder", shoulder.joint)
    # 2 · 0.3² + 1 · (0.5² + 0.2²): the lower link hangs straight down.
    assert shoulder.inertia_kgm2(seen) == pytest.approx(0.18 + 0.29, rel=1e-6)
    # About +y a positive angle lowers the mass: the joint must hold − g (2 · 0.3 + 1 · 0.5) at 0.
    assert shoulder.joint.rigid(seen, []).gravity_cos == pytest.approx(
        -9.81 * 1.1, rel=1e-6
    )
    bent_elbow = motion_of(bent, "elbow", elbow.joint)
    assert elbow.inertia_kgm2(bent_elbow) == pytest.approx(
        0.04 + 2e-5 * 50**2, rel=1e-6
    )  # with its rotor
    weight = elbow.joint.rigid(bent_elbow, [])
    assert (weight.gravity_cos, weight.gravity_sin) == pytest.approx(
        (-9.81 * 0.2, 0.0), rel=1e-6, abs=1e-6
    )


@pytest.mark.parametrize("mass_kg", [0.5, -0.25])
def test_an_unknown_payload_is_a_mass_at_its_place_in_the_last_link_and_every_joint_feels_it(
    mass_kg: float, tmp_path: Path
) -> None:
    """0.5 kg, or 0.25 kg less than the model has, 0.1 m beyond the lower link's centre of mass: 0.3 m from the elbow, and with
    the elbow bent √(0.5² + 0.3²) m from the shoulder. The controller carries the arm's weight, and not this one's."""
    held = f"effects: [{{effect: payload, mass_kg: {mass_kg}, x_m: 0.1, z_m: 0.0}}]"
    bent = swept(shoulder=np.zeros(400), elbow=np.full(400, 0.5 * np.pi))
    compensated = ROBOT_YAML.replace("joints:", "gravity_compensation: 1.0\njoints:")
    without = robot(tmp_path, compensated)
    made = robot(
        tmp_path,
        compensated.replace("effort_limit: 100.0}", f"effort_limit: 100.0, {held}}}"),
    )
    for name, square_m2, lever_m in (
        ("shoulder", 0.25 + 0.09, 0.5),
        ("elbow", 0.09, 0.3),
    ):
        with_it, bare = (
            joint.rigid(motion_of(bent, name, joint), joint.effects([]))
            for joint in (made.joint(name), without.joint(name))
        )
        assert with_it.inertia - bare.inertia == pytest.approx(
            mass_kg * square_m2, rel=1e-9
        )
        at_0 = (
            with_it.gravity_cos - with_it.compensation_cos
        )  # about +y a positive angle lowers the mass
        assert at_0 == pytest.approx(-9.81 * mass_kg * lever_m, rel=1e-6), name
    idle = {"y_m": 0.0}  # both turn about y
    assert [made.joint(name).selectors(Payload) for name in ("shoulder", "elbow")] == [
        None,
        idle,
    ], "one mass"
    assert without.joint("shoulder").selectors(Payload) == idle
    twice = ROBOT_YAML.replace("kd: 5.0}", f"kd: 5.0, {held}}}").replace(
        "100.0}", f"100.0, {held}}}"
    )
    with pytest.raises(SpecError, match=r"elbow.*payload.*shoulder.*lower"):
        robot(tmp_path, twice)
    with pytest.raises(SpecError, match=r"elbow → effects → 0: payload: write z_m"):
        robot(
            tmp_path,
            compensated.replace(
                "effort_limit: 100.0}", f"effort_limit: 100.0, {held}}}"
            ).replace(", z_m: 0.0", ""),
        )
    lighter = f"effort_limit: 100.0, {held.replace(f'{mass_kg}', '-0.96')}}}"
    too_light = compensated.replace("effort_limit: 100.0}", lighter)
    with pytest.raises(
        SpecError, match=r"elbow.*-0\.96 kg, and body lower.*-0\.95 kg or more"
    ):  # of its 1 kg
        robot(tmp_path, too_light)
    upright = robot(tmp_path, model=TWO_LINKS.replace('axis="0 1 0"', 'axis="0 0 1"'))
    assert upright.joint("elbow").selectors(Payload) == {"z_m": 0.0}, (
        "inertia shows it about a vertical axis"
    )


def test_a_payload_on_a_vertical_slide_weighs_and_has_inertia(tmp_path: Path) -> None:
    """0.5 kg on a slide of 2 kg: 4.905 N that the controller, which carries the slide, does not know of; anywhere in its body."""
    slide = """<mujoco><worldbody><body name="head"><inertial pos="0 0 0.1" mass="2" diaginertia="0.01 0.01 0.01"/>
    <joint name="lift" type="slide" axis="0 0 1"/></body></worldbody></mujoco>"""
    file = "kind: robot\nmodel: arm.xml\ngravity_compensation: 1.0\njoints:\n  lift: {kp: 1000.0, kd: 100.0EFFECTS}\n"
    held = ", effects: [{effect: payload, mass_kg: 0.5, x_m: 0.3, y_m: 0.0, z_m: 0.0}]"
    made, bare = (
        robot(tmp_path, file.replace("EFFECTS", text), slide) for text in (held, "")
    )
    m = dataclasses.replace(swept(lift=np.zeros(400)), units=("m",))
    place = dict.fromkeys(("x_m", "y_m", "z_m"), 0.0)
    assert bare.joint("lift").selectors(Payload) == place and bare.idle_axes(
        "lift"
    ) == (0, 1, 2)
    model = JointModel(made, "lift")
    motion = motion_of(m, "lift", model.joint)
    assert model.joint.rigid(motion, model.joint.effects([])).inertia == pytest.approx(
        2.5, rel=1e-9
    )
    assert motion.coupling_nm[0] == pytest.approx(2 * 9.81, rel=1e-9)
    answer = model.simulate(motion, model.gains)
    assert answer.reported[-1] == pytest.approx(-0.5 * 9.81 / 1000.0, rel=1e-4)
    assert answer.effort[-1] == pytest.approx(2.5 * 9.81, rel=1e-4)
    searched = JointModel(bare, "lift").simulate(
        motion, model.gains, [Payload(mass_kg=0.5)]
    )
    np.testing.assert_allclose(searched.reported, answer.reported, atol=1e-12)


@pytest.mark.parametrize(
    ("link", "gravity"),
    [("", ""), ("", "gravity: [1, -0.5, -5]\n"), ("upper", ""), ("like", "")],
)
def test_a_payload_is_felt_as_if_the_model_had_its_mass(
    tmp_path: Path, link: str, gravity: str
) -> None:
    """Both joints move: the torque that one costs the other, from MuJoCo's own inverse dynamics of a model with that mass."""
    time_s = np.arange(600) / 200
    both = swept(
        shoulder=0.4 * np.sin(3.0 * time_s), elbow=1.0 + 0.5 * np.sin(4.0 * time_s)
    )
    place = (
        "x_m: 0.0, y_m: 0.0, z_m: 0.0, like_link: true"
        if link == "like"
        else "x_m: 0.1, y_m: 0.02, z_m: -0.05"
    )
    upper = link.replace("like", "")
    held = f"effects: [{{effect: payload, mass_kg: 0.5, {place}, link: '{upper}'}}]"
    at, joint, end = (
        ("0.4", "shoulder", "kd: 5.0}")
        if upper
        else ("0.3", "elbow", "effort_limit: 100.0}")
    )
    ball = f'<body pos="{at} 0.02 -0.05"><inertial pos="0 0 0" mass="0.5" diaginertia="1e-9 1e-9 1e-9"/></body>'
    (tmp_path / "true").mkdir()
    file, after = (
        gravity + ROBOT_YAML,
        '<body name="lower"' if upper else "</body></body></body></worldbody>",
    )
    own, wide = (
        'mass="1" diaginertia="1e-9 1e-9 1e-9"',
        'quat="0.9 0.1 0.3 0.2" mass="{0}" diaginertia="{1} {1} {0}"',
    )
    light, heavy = (
        TWO_LINKS.replace(own, wide.format(kg, 0.6 * kg)) for kg in (1, 1.5)
    )
    true = robot(
        tmp_path / "true",
        file,
        heavy if link == "like" else light.replace(after, ball + after),
    )
    plain, made = (
        robot(tmp_path, file.replace(end, text), light)
        for text in (end, f"{end[:-1]}, {held}}}")
    )
    if upper:
        with pytest.raises(
            SpecError, match=r"elbow.*link: elbow moves no body 'upper'"
        ):
            robot(tmp_path, file.replace("100.0}", f"100.0, {held}}}"))
    moved = moved_together(true, both)
    period_s = both.period_s * both.num_rows / len(moved.positions)

    def along(r: Robot, name: str) -> RobotJoint:
        needed = needed_along(r, moved.positions, period_s)[:2]
        return RobotJoint(r, name, along=Along(moved.moving, moved.positions, *needed))

    for name in ("shoulder", "elbow"):
        seen = [motion_of(both, name, along(r, name)) for r in (made, true, plain)]
        terms = [
            r.joint(name).rigid(m, r.joint(name).effects([]))
            for r, m in zip((made, true), seen[:2], strict=True)
        ]
        np.testing.assert_allclose(terms[0], terms[1], atol=1e-7)
        (stated,) = made.joint(joint).effects([])
        one = Payload(
            **{
                key: getattr(stated, key)
                for key in ("mass_kg", "x_m", "y_m", "z_m", "link", "like_link")
            }
        )
        # At one joint the file has it; at the other one, of a robot without it, a search tries it.
        for r, m, own in (
            (made, seen[0], made.joint(name).effects([])),
            (plain, seen[2], [one]),
        ):
            loads = m.coupling_nm + r.joint(name).moving_masses_nm(m, own)
            np.testing.assert_allclose(loads, seen[1].coupling_nm, atol=1e-6)
        felt = (
            np.abs(seen[2].coupling_nm - seen[1].coupling_nm).max() > 0.3
        )  # N·m, without the payload
        assert felt == (not upper), "the elbow does not move the upper link"


def test_coupling_is_the_torque_that_the_other_joints_motion_costs(
    tmp_path: Path,
) -> None:
    made = robot(
        tmp_path,
        model=TWO_LINKS.replace(
            "<worldbody>", '<option gravity="0 0 0"/><worldbody>', 1
        ),
    )
    time_s = np.arange(1000) / 200
    elbow = 0.5 * np.pi + 0.2 * np.sin(2 * np.pi * 0.5 * time_s)
    seen = motion_of(
        swept(shoulder=np.zeros(1000), elbow=elbow),
        "shoulder",
        JointModel(made, "shoulder").joint,
    )
    # Two links of l = 0.5, c = 0.2, m = 1: (m c² + m l c cos q2) q̈2 − m l c sin q2 q̇2², the shoulder at rest.
    speed, acceleration = (
        np.gradient(elbow, 1 / 200),
        np.gradient(np.gradient(elbow, 1 / 200), 1 / 200),
    )
    expected = (0.04 + 0.1 * np.cos(elbow)) * acceleration - 0.1 * np.sin(
        elbow
    ) * speed**2
    inner = slice(100, -100)
    np.testing.assert_allclose(
        seen.coupling_nm[inner], expected[inner], atol=0.02 * np.abs(expected).max()
    )


def test_coupling_follows_a_step_of_another_joint_and_leaves_out_noise(
    tmp_path: Path,
) -> None:
    """The elbow steps by s = 0.1 (1 + tanh u), u = t / 20 ms, s̈ = − 0.2 tanh u / cosh² u / (20 ms)²; 20 Hz lose 28 %."""
    made = robot(
        tmp_path,
        model=TWO_LINKS.replace(
            "<worldbody>", '<option gravity="0 0 0"/><worldbody>', 1
        ),
    )
    u = (np.arange(2000) / 200 - 5.0) / 0.02
    bend, slope = 0.1 * (1 + np.tanh(u)), np.cosh(np.clip(u, -50, 50)) ** -2.0
    speed, acceleration = 0.1 * slope / 0.02, -0.2 * np.tanh(u) * slope / 0.02**2
    elbow = 0.5 * np.pi + bend
    expected = (0.04 + 0.1 * np.cos(elbow)) * acceleration - 0.1 * np.sin(
        elbow
    ) * speed**2
    noisy = elbow + 5e-5 * np.random.default_rng(0).normal(size=2000)
    seen = motion_of(
        swept(shoulder=np.zeros(2000), elbow=noisy),
        "shoulder",
        JointModel(made, "shoulder").joint,
    )
    off = seen.coupling_nm - expected
    assert np.linalg.norm(off[960:1040]) < 0.05 * np.linalg.norm(expected)
    assert (
        np.std(off[100:900]) < 0.007
    )  # N·m: noise of 0.05 mrad below 20 Hz is 0.006, below 60 Hz more


@pytest.mark.parametrize("bias_rad", [0.0, 0.2])
def test_carried_weight_is_no_load_for_the_controller_and_is_in_the_effort(
    bias_rad: float, tmp_path: Path
) -> None:
    model = JointModel(
        robot(
            tmp_path,
            ROBOT_YAML.replace("joints:", "gravity_compensation: 1.0\njoints:"),
        ),
        "elbow",
    )
    seen = motion_of(
        swept(shoulder=np.zeros(300), elbow=np.zeros(300)), "elbow", model.joint
    )
    answer, w_nm = (
        model.simulate(
            seen, model.gains, [make_effect("encoder_bias", bias_rad=bias_rad)]
        ),
        9.81 * 0.2,
    )
    read, load_nm = answer.reported[-1], -w_nm * np.cos(answer.reported[-1] - bias_rad)
    np.testing.assert_allclose(
        read, (-w_nm * np.cos(read) - load_nm) / model.gains.kp, rtol=1e-3, atol=1e-9
    )
    np.testing.assert_allclose(
        answer.effort[-1], load_nm, rtol=1e-3 if bias_rad else 1e-6
    )


def test_the_effort_holds_the_weight_that_a_slide_carries_and_one_that_others_turn(
    tmp_path: Path,
) -> None:
    """2 kg on a vertical slide with a rotor of 3 kg: at rest the motor gives m g, and moves 5 kg. An elbow that others tilt by a
    carries m g c cos a."""
    lift = (
        '<mujoco><worldbody><body><joint name="z" type="slide" axis="0 0 1" armature="3"/>'
        '<inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/></body></worldbody></mujoco>'
    )
    text = "kind: robot\nmodel: arm.xml\ngravity_compensation: 1.0\njoints: {z: {kp: 900.0, kd: 50.0, rotor_inertia: 3.0}}\n"
    model = JointModel(robot(tmp_path, text, lift), "z")
    seen = motion_of(
        dataclasses.replace(swept(z=np.zeros(300)), units=("m",)), "z", model.joint
    )
    answer = model.simulate(seen, model.gains)
    np.testing.assert_allclose(answer.reported, 0.0, atol=1e-9)
    np.testing.assert_allclose(answer.effort, 2 * 9.81, rtol=1e-6)
    assert model.inertia_kgm2(seen) == pytest.approx(5.0)
    weaker = model.simulate(
        seen, model.gains, [make_effect("gravity_mismatch", share=0.75)]
    )
    assert weaker.reported[-1] == pytest.approx(
        -0.25 * 2 * 9.81 / 900, rel=1e-3
    )  # a quarter is left to K_p
    assert weaker.effort[[0, -1]] == pytest.approx(
        [0.75 * 2 * 9.81, 2 * 9.81], rel=1e-3
    )

    bent = JointModel(
        robot(
            tmp_path,
            ROBOT_YAML.replace("joints:", "gravity_compensation: 1.0\njoints:"),
        ),
        "elbow",
    )
    tilt = (
        0.8 * (1 - np.cos(np.clip((np.arange(4000) / 200 - 1) / 18, 0, 1) * np.pi)) / 2
    )  # slow: 18 s
    seen = motion_of(swept(shoulder=tilt, elbow=np.zeros(4000)), "elbow", bent.joint)
    answer = bent.simulate(seen, bent.gains)
    np.testing.assert_allclose(
        answer.effort[-200:], -9.81 * 0.2 * np.cos(0.8), rtol=2e-3
    )


def test_a_draft_says_all_that_the_model_says_and_loads_once_its_todos_are_written(
    tmp_path: Path,
) -> None:
    (tmp_path / "arm.xml").write_text(TWO_LINKS)
    out = tmp_path / "arm_robot.yaml"
    assert init_robot.main([str(tmp_path / "arm.xml"), f"--out={out}"]) == 0
    text = out.read_text()
    assert all(
        f"#   {law}:" in text
        for law in ("impedance", "cascade", "velocity", "torque", "pwm")
    )
    for line in (
        "kp: 320",
        "kd: 16",
        "effort_limit: 20",
        "damping_nms_per_rad: 0.2",
        "torque_nm: 0.1",
        "free joint",
    ):
        assert line in text, (
            line
        )  # a gear of 2 turns 80 N·m/rad into 320, and 10 N·m into 20
    with pytest.raises(
        SpecError, match=r"arm_robot\.yaml:\d+: TODO.*\(1\.0 if.*shoulder/kp \(N·m/rad"
    ):
        load_robot(out)
    written = text.replace("gravity_compensation: TODO", "gravity_compensation: 0.0")
    out.write_text(
        written.replace("gains: TODO", "gains: commanded").replace(": TODO", ": 10.0")
    )
    made = load_robot(out)
    assert made.config.joints["elbow"].kp == 320.0
    again = tmp_path / "again.yaml"
    again.write_text(made.text(again))
    assert load_robot(again).config == made.config
    with pytest.raises(TaccorlError, match="already exists"):
        init_robot.main([str(tmp_path / "arm.xml"), f"--out={out}"])


def test_a_velocity_actuator_becomes_a_velocity_loop(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(
        TWO_LINKS.replace(
            '<position name="servo" joint="elbow" kp="80" kv="4"',
            '<velocity joint="elbow" kv="4"',
        )
    )
    text, _ = robot_draft(tmp_path / "arm.xml", tmp_path / "robot.yaml")
    assert "of actuator 0;" in text  # it has no name
    elbow = text[text.index("  elbow:") :]
    assert (
        "law: velocity" in elbow and "kd: 16" in elbow and "kp:" not in elbow
    )  # through a gear of 2: 4 · 2²


# A carriage on a beam, with two motors on belts of length x + y and x − y, and a third one that holds the beam by a gear of 2.
GANTRY = """
<mujoco><worldbody>
<body><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="y" type="slide" axis="0 1 0"/><site name="on_beam"/>
<body><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="x" type="slide" axis="1 0 0"/><site name="on_carriage"/>
<body><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="ball" type="ball"/></body></body></body></worldbody>
<tendon><fixed name="belt_a"><joint joint="x" coef="1"/><joint joint="y" coef="1"/></fixed>
<fixed name="belt_b"><joint joint="x" coef="1"/><joint joint="y" coef="-1"/></fixed>
<spatial name="rope"><site site="on_beam"/><site site="on_carriage"/></spatial></tendon>
<actuator><position name="a" tendon="belt_a" kp="20000" kv="150"/><position name="b" tendon="belt_b" kp="KP_B" kv="150" gear="2"/>
OTHERS</actuator></mujoco>
"""


def drafted(folder: Path, kp_b: float, others: str = "") -> tuple[str, list[str]]:
    """Draft of the gantry, and its remarks; the stiffness of motor b at its belt is 2² times ``kp_b``."""
    (folder / "gantry.xml").write_text(
        GANTRY.replace("KP_B", str(kp_b)).replace("OTHERS", others)
    )
    text, model = robot_draft(folder / "gantry.xml", folder / "robot.yaml")
    assert all(f"# Of the model: {remark}" in text for remark in model.remarks)
    return text, [
        remark
        for remark in model.remarks
        if "held fixed" not in remark or "actuator" in remark
    ]


def test_motors_on_belts_are_left_out_with_their_line_numbers_and_what_to_write(
    tmp_path: Path,
) -> None:
    text, (of_a, of_b, way_out) = drafted(tmp_path, 5000.0)
    line = GANTRY[: GANTRY.index('name="a"')].count("\n") + 1
    place = f"(gantry.xml:{line})"
    for remark, words in (
        (of_a, ("actuator a ", place, "tendon belt_a", "kp 20000")),
        (of_b, ("actuator b ", place, "tendon belt_b", "gear 2")),
    ):
        for word in words:
            assert word in remark
    assert "kp and kd" in way_out
    assert text.count("kp: TODO") == 2


def test_actuators_on_anything_but_a_joint_are_named(tmp_path: Path) -> None:
    others = """<motor name="pull" tendon="rope"/><motor name="jet" site="on_carriage"/><motor name="rod" site="on_carriage"
    refsite="on_beam"/><general name="crank" cranksite="on_carriage" slidersite="on_beam" cranklength="0.1"/>
    <adhesion name="glue" body="world" ctrlrange="0 1"/><motor name="wrist" joint="ball"/>
    <position name="own" jointinparent="y" kp="70"/>"""
    text, remarks = drafted(tmp_path, 5000.0, others)
    said = {
        remark.split()[1]: remark
        for remark in remarks
        if remark.startswith("actuator ")
    }
    assert list(said) == ["a", "b", "pull", "jet", "rod", "crank", "glue", "wrist"]
    where = (
        ("pull", "tendon rope"),
        ("jet", "site on_carriage"),
        ("crank", "slidercrank"),
        ("glue", "body"),
    )
    assert all(word in said[name] for name, word in (*where, ("wrist", "joint ball")))
    assert (
        "kp: 70 " in text and "of actuator own" in text
    )  # on a slide jointinparent is joint


def test_targets_that_move_between_rows_lead_held_ones_by_half_a_row(tmp_path: Path):
    # 1 rad/s from 0.5 s on, 200 Hz
    ramp = swept(
        shoulder=np.zeros(400), elbow=np.clip(np.arange(400) / 200 - 0.5, 0, 1)
    )
    fast = ROBOT_YAML.replace("kd: 1.0", "kd: 1.0, command_hz: 1000")
    assert fast != ROBOT_YAML
    reached = []
    for text in (ROBOT_YAML, fast):
        model = JointModel(robot(tmp_path, text), "elbow")
        motion = dataclasses.replace(motion_of(ramp, "elbow", model.joint), start=0.0)
        reached.append(model.simulate(motion, model.gains).reported)
    # Held for 5 ms a target is 2.5 ms late on average, in steps of 1 ms along the line to the next row 0.5 ms.
    lead_s = float(np.median((reached[1] - reached[0])[250:290]))
    assert lead_s == pytest.approx(0.0025 - 0.0005, abs=2e-4)


URDF = """<robot name="r"><link name="base"/>
<link name="a"><visual><geometry><mesh filename="package://x/a.stl"/></geometry></visual>{inertial}</link>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="5" velocity="3"/><dynamics damping="0.3" friction="0.2"/></joint></robot>"""
INERTIAL = (
    '<inertial><origin xyz="0.1 0 0"/><mass value="2"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def test_a_joint_that_mimics_another_is_told_of(tmp_path: Path):
    path = tmp_path / "gripper.urdf"
    text = URDF.format(inertial=INERTIAL).replace(
        "<axis", '<mimic joint="thumb"/><axis', 1
    )
    assert "<mimic" in text
    path.write_text(text)
    assert any(
        "mimic" in remark and "thumb" in remark
        for remark in load_robot_model(path).remarks
    )
    path.write_text(text.replace('joint="thumb"', 'joint="thumb" multiplier="-0.5"'))
    # 0.01 kg·m² about the link's centre and 2 kg at 0.1 m, seen by the motor of thumb through a factor of −0.5.
    assert any("0.0075 kg·m²" in remark for remark in load_robot_model(path).remarks)


def test_a_joint_that_an_equality_ties_to_another_is_told_of(tmp_path: Path) -> None:
    # x follows y times −2: the motor of y also moves the carriage, 2² times as heavy.
    tied = '</tendon><equality><joint joint1="x" joint2="y" polycoef="0 -2 0 0 0"/></equality>'
    (tmp_path / "gantry.xml").write_text(
        GANTRY.replace("KP_B", "1").replace("OTHERS", "").replace("</tendon>", tied)
    )
    remarks = load_robot_model(tmp_path / "gantry.xml").remarks
    (remark,) = [text for text in remarks if text.startswith("joint x follows y")]
    assert (
        "2² × 2 = 8 kg" in remark
    )  # the carriage and what hangs at it by the ball joint, 1 kg each


def test_a_urdf_needs_its_inertias_and_not_its_meshes(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(URDF.format(inertial=INERTIAL))
    facts = load_robot_model(path).joints["j1"]
    assert facts.inertia == pytest.approx(0.01 + 2 * 0.1**2)
    viscous, dry = facts.effects
    assert (facts.limits, facts.drive.numbers) == ((-1.0, 1.0), {"effort_limit": 5.0})
    assert viscous == make_effect("viscous_friction", damping_nms_per_rad=0.3)
    assert dry == make_effect("coulomb_friction", torque_nm=0.2)
    assert "effort_limit: 5" in robot_draft(path, tmp_path / "out.yaml")[0]
    path.write_text(URDF.format(inertial=""))
    with pytest.raises(
        TaccorlError,
        match=r'link a moves and has no mass.*write <inertial>.*<link name="a">',
    ):
        load_robot_model(path)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize(
    ("stated", "limits", "word"),
    [
        ('upper="1.5"', (0.0, 1.5), "upper alone"),
        ('lower="-1.5"', (-1.5, 0.0), "lower alone"),
        ('lower="0" upper="1.5"', (0.0, 1.5), ""),
        ("", None, ""),
    ],
)
def test_a_limit_that_a_urdf_leaves_out_is_0(
    stated: str,
    limits: tuple[float, float] | None,
    word: str,
    kind: str,
    tmp_path: Path,
) -> None:
    """The rules of URDF; MuJoCo takes such a joint for one without limits."""
    path = tmp_path / "r.urdf"
    text = URDF.format(inertial=INERTIAL).replace('lower="-1" upper="1"', stated)
    path.write_text(text.replace("revolute", kind))
    draft, robot = robot_draft(path, tmp_path / "out.yaml")
    assert robot.joints["j1"].limits == limits
    assert ("no limits" in draft) == (limits is None)
    said = [remark for remark in robot.remarks if "r.urdf:4" in remark]
    assert len(said) == bool(word) and all(word in remark for remark in said)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("<keyframe>", '<equality><connect name="loop" body1="lower" body2="base" anchor="0 0 0"/></equality><keyframe>'),
         "closed chain: connect loop between lower and base"),
        (('<inertial pos="0.3 0 0" mass="2" diaginertia="1e-9 1e-9 1e-9"/>', ""),
         r'body upper.*inertia from mesh.*<inertial.*in <body name="upper">'),
        (("<mujoco>", "<mujoco"), "is not XML"),
        (("mujoco", "sdf"), "neither MJCF.*nor URDF"),
        (("shoulder:", "sholder:"), r"robot\.yaml:4: joints → sholder: arm.xml has no joint 'sholder'.*shoulder"),
        (("model: arm.xml", "model: leg.xml"), r"robot\.yaml:2: model: no file 'leg.xml' beside it"),
        (("kp: 50.0", "kp: -50.0"), r"robot\.yaml:4.*kp"),
        (("kp: 50.0", "kp: 50.0, position_age_s: -1.0"), r"robot\.yaml:4.*position_age_s: is -1 s; write a value above −0\.01 s"),
        (("kp: 50.0", "kp: 50.0, position_age_s: .inf"), r"robot\.yaml:4.*position_age_s"),
        (("kd: 5.0}", "kd: 5.0, effects: [{effect: backlash, play_rad: 0.01}]}"),
         r"backlash needs.*inertia.*write rotor_inertia \(kg·m²\).*gear.*shoulder"),
        (("kd: 5.0}", "kd: 5.0, effects: [{effect: taxel_creep}]}"), "taxel_creep cannot act on one joint"),
        (("kd: 5.0}", f"kd: 5.0, effects: [{2 * '{effect: viscous_friction, damping_nms_per_rad: 1}, '}]}}"),
         "viscous_friction stands twice at"),
        (("joints:", "gravity_compensation: 3.0\njoints:"), r"robot\.yaml:3: .*is 3; give the share of the weight, 0 … 1"),
    ],
)  # fmt: skip
def test_wrong_models_and_robot_files_are_refused(
    change: tuple[str, str], says: str, tmp_path: Path
) -> None:
    with pytest.raises(TaccorlError, match=says):
        robot(tmp_path, *(text.replace(*change) for text in (ROBOT_YAML, TWO_LINKS)))


@pytest.mark.parametrize("phase", [0.0, 1.0, 2.0, math.pi])
@pytest.mark.parametrize("ratio", [0.5, 1.0, 1.7])
def test_exact_inverse_dynamics_of_a_moving_arm_has_no_reversed_effort(
    phase: float, ratio: float, tmp_path: Path
):
    """Efforts are MuJoCo's inverse dynamics while both joints swing; the shoulder's motion asks the elbow for more than its own
    acceleration does, often the other way. Negated efforts are named, at that joint alone. A model with the forearm's centre of
    mass on the other side of the elbow asks for other torques, which is no sign of the effort."""
    made = robot(tmp_path, model=SWINGING, text=EFFORTS_ALONE)
    model = made.rigid.model
    data = mujoco.MjData(model)
    time_s = np.arange(1000) / 200
    fade = 0.5 * (1 - np.cos(np.pi * np.minimum(time_s, 1.0)))
    rate = 2 * np.pi * 0.4
    q = (
        np.column_stack(
            [1.2 * np.sin(rate * time_s), 0.5 * np.sin(ratio * rate * time_s + phase)]
        )
        * fade[:, None]
    )
    v, effort = np.gradient(q, time_s, axis=0), np.empty_like(q)
    for k, a in enumerate(np.gradient(v, time_s, axis=0)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a
        mujoco.mj_inverse(model, data)
        effort[k] = data.qfrc_inverse
    noise = np.random.default_rng(0).standard_normal((2, *q.shape))
    plain = swept(shoulder=q[:, 0], elbow=q[:, 1])
    measured = q + 2e-5 * noise[0]
    for sign in (1.0, -1.0):
        felt = (effort + 0.005 * noise[1]) * (1.0, sign)
        m = dataclasses.replace(
            plain,
            target=measured,
            measured=measured,
            effort=felt,
            target_kinds=("effort",) * 2,
        )
        checked = check_robot(
            made, m, made.joint("elbow").whole(m), ["shoulder", "elbow"]
        )
        named = [
            f.feature
            for f in checked
            if f.check in ("reversed_effort", "wrong_inertia")
        ]
        assert named == ["elbow"] * (sign < 0.0), checked
        alike = (ratio, phase) == (
            1.0,
            math.pi,
        )  # both accelerations are one there, and nothing tells the two
        if sign > 0.0 and not alike:
            opposite = SWINGING.replace(
                '"0 0 -0.15" mass="1.0"', '"0 0 0.15" mass="1.0"'
            )
            checked = check_robot(
                robot(tmp_path, EFFORTS_ALONE, opposite),
                m,
                made.joint("elbow").whole(m),
                ["elbow"],
            )
            assert not [
                f
                for f in checked
                if f.check == "reversed_effort" and f.severity == "error"
            ], checked


def test_recordings_that_do_not_belong_to_the_robot_are_found_out(
    tmp_path: Path,
) -> None:
    made = robot(
        tmp_path,
        model=TWO_LINKS.replace(
            "<worldbody>", '<option gravity="0 0 0"/><worldbody>', 1
        ),
    )
    time_s = np.arange(1200) / 200
    angle = 0.4 * np.sin(2 * np.pi * (0.2 + 0.2 * time_s) * time_s)
    plain = swept(shoulder=np.zeros(1200), elbow=angle)
    torque = 0.09 * np.gradient(
        np.gradient(angle, 1 / 200), 1 / 200
    ) + 0.1 * np.gradient(angle, 1 / 200)

    def checks(m: Measurement) -> dict[str, str]:
        return {
            f.check: f.text
            for f in check_robot(made, m, made.joint("elbow").whole(m), ["elbow"])
        }

    def with_effort(factor: float) -> Measurement:
        return dataclasses.replace(
            plain, effort=np.column_stack([np.zeros(1200), factor * torque])
        )

    assert checks(with_effort(1.0)) == {}
    degrees = dataclasses.replace(
        plain, target=np.degrees(plain.target), measured=np.degrees(plain.measured)
    )
    line = "Write `unit: deg` for elbow.q and elbow.q_target"
    assert f"{line} in a columns file" in checks(degrees)["beyond_limits"]
    slope = np.gradient(degrees.measured, 1 / 200, axis=0)
    for factor, qd in (
        (1.0, " (`deg/s` for elbow.qd)"),
        (np.pi / 180, ""),
    ):  # in deg/s and in rad/s
        assert (
            f"{line}{qd} in"
            in checks(dataclasses.replace(degrees, velocity=factor * slope))[
                "beyond_limits"
            ]
        )
    assert "`effort_scale: {elbow: -1}`" in checks(with_effort(-1.0))["reversed_effort"]
    assert "8 times. That is" in checks(with_effort(8.0))["wrong_inertia"]
    bare = robot(
        tmp_path,
        ROBOT_YAML.replace("rotor_inertia: 2.0e-5, gear: 50.0, ", ""),
        TWO_LINKS,
    )
    heavier = with_effort(8.0)  # 8 · 0.09 kg·m², of which the link is 0.04
    (found,) = check_robot(bare, heavier, bare.joint("elbow").whole(heavier), ["elbow"])
    assert found.check == "wrong_inertia" and "`rotor_inertia: 0.677`" in found.text, (
        found.text
    )
    assert (
        "`unit: deg` for elbow.q and"
        in checks(with_effort(np.pi / 180))["wrong_inertia"]
    )  # as of q in degrees
    assert "mA" in checks(with_effort(1000.0))["beyond_effort"]
    # Efforts of the law, kp (q* − q) − kd q̇, in mA at 0.5 N·m/A: the unit follows from the gains, whatever the inertia is.
    late = 0.4 * np.sin(2 * np.pi * (0.2 + 0.2 * (time_s - 0.05)) * (time_s - 0.05))
    law, speed = made.config.joints["elbow"], np.gradient(late, 1 / 200)
    asked = (
        law.loop_gains.kp * (np.append(angle[:1], angle[:-1]) - late)
        - law.loop_gains.kd * speed
    )
    columns = {"measured": late, "effort": 2000.0 * asked}
    current = dataclasses.replace(
        plain, **{k: np.column_stack([np.zeros(1200), v]) for k, v in columns.items()}
    )
    said = checks(current)
    assert set(said) == {"effort_unit"} and "2e+03 times" in said["effort_unit"]
    assert (
        "{elbow: 0.0005}" in said["effort_unit"]
        and "measurements.yaml" in said["effort_unit"]
    )
    assert "elbow.tau" not in said["effort_unit"] and ".csv" not in str(current.source)
    turned = dataclasses.replace(
        current, **{x: np.degrees(getattr(current, x)) for x in ("target", "measured")}
    )
    assert (
        set(checks(turned)) >= {"beyond_limits"} > set(checks(turned)) & {"effort_unit"}
    ), "of angles, not of efforts"
    assert "it lacks shoulder" in checks(swept(elbow=angle))["pose_unknown"]
    renamed = dataclasses.replace(plain, signals=("shoulder", "elbo"))
    with pytest.raises(
        TaccorlError, match=r"arm\.xml.*joint 'elbo' .*elbow.*Rename.*columns"
    ):
        checks(renamed)


def test_a_robot_under_another_gravity_leaves_its_model_as_it_is(
    tmp_path: Path,
) -> None:
    """The model is shared by all joints, and by threads."""
    model = robot(tmp_path, ROBOT_YAML, TWO_LINKS).rigid.model
    own = model.opt.gravity.copy()
    leaned = under_gravity(model, np.array([1.0, 2.0, 3.0]))
    assert leaned.opt.gravity.tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(model.opt.gravity, own)


def test_motions_that_a_robot_keeps_are_its_own_and_do_not_travel(
    tmp_path: Path,
) -> None:
    one, other = (robot(tmp_path, ROBOT_YAML, TWO_LINKS) for _ in range(2))
    assert one.motions.of(b"key", lambda: None) is None

    def unexpected() -> None:
        raise AssertionError("it was kept")

    changed = one.with_joint("elbow", one.config.joints["elbow"])
    assert changed.motions.of(b"key", unexpected) is None
    for empty in (other, pickle.loads(pickle.dumps(one))):
        with pytest.raises(AssertionError):
            empty.motions.of(b"key", unexpected)


AXIS_YAML = """kind: axis
name: slide
unit: m
inertia: 40.0
kp: 40000.0
kd: 2000.0
limits: [-0.15, 0.15]
effects:
- {effect: coulomb_friction, torque_nm: 3.0}
"""
ALONE_YAML = """kind: robot
joints:
  slide:
    {unit: m, inertia: 40.0, kp: 40000.0, kd: 2000.0, limits: [-0.15, 0.15],
     effects: [{effect: coulomb_friction, torque_nm: 3.0}]}
"""


def test_an_axis_file_is_a_robot_of_one_joint_without_a_model(tmp_path: Path) -> None:
    for name, text in (("axis", AXIS_YAML), ("alone", ALONE_YAML)):
        (tmp_path / f"{name}.yaml").write_text(text)
    axis, alone = (load_robot(tmp_path / f"{n}.yaml") for n in ("axis", "alone"))
    assert axis.config == alone.config and axis.digest() == alone.digest()
    written = tmp_path / "written.yaml"
    written.write_text(axis.text(written))
    assert load_robot(written).config == axis.config
    assert axis.units == {"slide": "m"}
    joint = axis.joint("slide")
    assert joint.known.limits == (-0.15, 0.15) and not joint.has_model
    assert joint.with_values({"inertia": 50.0}).config.inertia == 50.0


def test_joints_without_a_model_do_not_load_each_other(tmp_path: Path) -> None:
    other = "  wheel: {unit: rad, inertia: 0.02, kp: 10.0, kd: 0.8}\n"
    (tmp_path / "two.yaml").write_text(ALONE_YAML + other)
    two = load_robot(tmp_path / "two.yaml")
    t = np.arange(200) / 200
    rows = np.column_stack([0.1 * np.sin(9.0 * t), np.sin(9.0 * t)])
    signals, units = ("slide", "wheel"), ("m", "rad")
    moving = {"time_s": t, "target": rows, "measured": rows, "effort": 0.0 * rows}
    m = logged("both", signals, units, **moving)
    for name, inertia in (("slide", 40.0), ("wheel", 0.02)):
        joint = two.joint(name)
        motion = motion_of(joint.whole(m), name, joint)
        assert not motion.coupling_nm.any()
        assert joint.rigid(motion, []).inertia == inertia
    whole = two.joint("wheel").whole(m.only(["wheel"]))
    assert whole.signals == signals and not whole.target[:, 0].any()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (ALONE_YAML.replace("unit: m, ", ""), r"bad\.yaml:3: .*'unit' is missing"),
        (ALONE_YAML.replace("inertia: 40.0, ", ""), "'inertia' is missing"),
        (ALONE_YAML.replace("40.0, ", "40.0, arm_kg: 1.0, "), "arm_kg: does not apply"),
        (
            ROBOT_YAML.replace("effort_limit: 100.0}", "inertia: 2.0}"),
            r"bad\.yaml:\d+: .*inertia: the model states it",
        ),
    ],
)
def test_a_model_or_the_file_states_a_joint_s_body(
    tmp_path: Path, text: str, words: str
) -> None:
    (tmp_path / "arm.xml").write_text(TWO_LINKS)
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(SpecError, match=words):
        load_robot(tmp_path / "bad.yaml")


FREE_HINGE = """<mujoco><worldbody><body><joint name="j" axis="0 0 1"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.05 0.05 0.05"/></body></worldbody></mujoco>"""
SAME_HINGE = {
    "axis": "kind: axis\nname: j\nunit: rad\nlaw: effort\ninertia: 0.05\n",
    "alone": "kind: robot\njoints:\n  j: {law: effort, unit: rad, inertia: 0.05}\n",
    "model": "kind: robot\nmodel: arm.xml\ngravity_compensation: 0.0\n"
    "joints:\n  j: {law: effort}\n",
}


def test_efforts_that_start_in_motion_have_one_answer_for_every_kind_of_file(
    tmp_path: Path,
) -> None:
    """τ = J q̈ with noise of 5 mN·m, from 0.82 rad/s on: nothing but noise is left."""
    rng = np.random.default_rng(1)
    time_s = np.arange(800) / 200
    phase = 2 * np.pi * 0.7 * time_s + 0.9
    q = 0.3 * np.sin(phase) + rng.normal(0.0, 2e-5, 800)
    tau = -0.05 * 0.3 * (2 * np.pi * 0.7) ** 2 * np.sin(phase)
    tau += rng.normal(0.0, 5e-3, 800)
    m = of_signal("in motion", 200, q, q, "j", effort=tau)
    m = dataclasses.replace(m, target_kinds=("effort",))
    (tmp_path / "arm.xml").write_text(FREE_HINGE)
    errors = []
    for name, text in SAME_HINGE.items():
        (tmp_path / f"{name}.yaml").write_text(text)
        machine = load_robot(tmp_path / f"{name}.yaml")
        model = JointModel(machine, "j")
        motion = motion_of(machine.joint("j").whole(m), "j", model.joint)
        assert motion.start_speed == pytest.approx(0.82, abs=0.02)
        errors.append(model.simulate(motion, model.gains).effort - tau)
    for error in errors[1:]:
        np.testing.assert_allclose(error, errors[0], atol=1e-9)
    assert np.sqrt(np.mean(errors[0][:60] ** 2)) < 6e-3
