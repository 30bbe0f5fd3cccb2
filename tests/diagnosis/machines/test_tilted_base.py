"""A robot whose base is mounted tilted, which its file does not say: what the turning joint at its base makes of it. Simulated by
MuJoCo with a gravity that leans, apart from the one-joint model."""

import dataclasses
import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from simulated_slide import logged, robot_machine

from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.machines.robot_joint import RobotJoint, TiltedBase
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.machine import Addition, diagnose_parts
from taccorl.diagnosis.machines.robot import GRAVITY, RobotMachine
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.errors import SpecError
from taccorl.report.account import account
from taccorl.report.evidence import Seen
from taccorl.sim.effects import effects

TILT_RAD = math.radians(4.0)
JOINTS, KP, KD = ("pan", "lift"), np.array([300.0, 300.0]), np.array([12.0, 12.0])
MODEL = """<mujoco><compiler angle="radian"/><option timestep="0.0005" integrator="implicitfast"/><worldbody>
<body name="column"><inertial pos="0 0 0.1" mass="2" diaginertia="0.01 0.01 0.01"/>
<joint name="pan" axis="0 0 1" range="-2 2" armature="0.1"/>
<body name="arm" pos="0 0 0.2"><inertial pos="0.3 0 0" mass="3" diaginertia="0.003 0.05 0.05"/>
<joint name="lift" axis="0 1 0" range="-2 2" armature="0.1"/></body></body></worldbody></mujoco>"""
FILE = """kind: robot
model: arm.xml
gravity_compensation: 1.0
joints:
  pan: {kp: 300.0, kd: 12.0, rotor_inertia: 0.1, loop_hz: 1000.0, effort_after_target: true}
  lift: {kp: 300.0, kd: 12.0, rotor_inertia: 0.1, loop_hz: 1000.0, effort_after_target: true}
"""
CONSIDERED = (
    "unbalance",
    "cable_spring",
    "cogging",
    "gravity_mismatch",
    "payload",
    "coulomb_friction",
    "armature",
)
WITHOUT = [name for name in effects if name not in CONSIDERED]


def machine(folder: Path) -> RobotMachine:
    return robot_machine(folder, MODEL, FILE)


def turned(
    name: str,
    amplitude: float,
    hz: float,
    seed: int,
    *,
    tilt_rad: float = TILT_RAD,
    spring: float = 0.0,
    lift: float = 0.0,
    swing: float = 0.0,
) -> Measurement:
    """The pan joint swings for 5 s, from rest, and lift is held or swings. At 1 kHz drives add an upright arm's weight."""
    model, upright = (
        mujoco.MjModel.from_xml_string(MODEL),
        mujoco.MjModel.from_xml_string(MODEL),
    )
    model.opt.gravity[:] = 9.81 * np.array(
        [math.sin(tilt_rad), 0.0, -math.cos(tilt_rad)]
    )
    data, believed, rng = (
        mujoco.MjData(model),
        mujoco.MjData(upright),
        np.random.default_rng(seed),
    )
    time_s = np.arange(1200) * 0.005
    moving = np.clip(time_s - 1.0, 0.0, None)
    pan = amplitude * np.sin(2 * np.pi * hz * moving) * np.clip(moving, 0, 1)
    target = np.column_stack(
        [pan, lift + swing * np.sin(2 * np.pi * 0.2 * moving) * np.clip(moving, 0, 1)]
    )
    measured, effort, last = (
        np.empty_like(target),
        np.empty_like(target),
        target[0].copy(),
    )
    data.qpos[:] = target[0]
    for step in range(-4000, 10 * len(time_s)):  # 2 s of rest before
        row = max(step, 0) // 10
        if step % 2 == 0:
            believed.qpos[:] = data.qpos
            mujoco.mj_forward(upright, believed)
            speed, last = (data.qpos - last) / 0.001, data.qpos.copy()
            torque = KP * (target[row] - data.qpos) - KD * speed + believed.qfrc_bias
            data.qfrc_applied[:] = torque - np.array([spring * data.qpos[0], 0.0])
        if step >= 0 and step % 10 == 0:
            measured[row], effort[row] = data.qpos, torque
        mujoco.mj_step(model, data)
    measured += rng.normal(0.0, 1e-4, target.shape)
    effort += rng.normal(0.0, 0.05, target.shape)
    return logged(
        name,
        JOINTS,
        ("rad", "rad"),
        time_s=time_s,
        target=target,
        measured=measured,
        effort=effort,
    )


def test_a_tilted_base_is_an_unbalance_of_the_vertical_joint_and_no_spring(
    tmp_path: Path,
) -> None:
    """3 kg at 0.3 m and a base that leans by 4°: A = 3 · 9.81 · 0.3 · sin 4° = 0.6159 N·m, lowest at 0 rad."""
    torque_nm = 3.0 * 9.81 * 0.3 * math.sin(TILT_RAD)
    made = Measurements(
        (turned("a", 1.3, 0.25, 1), turned("b", 0.6, 0.8, 2)),
        (turned("c", 1.1, 0.4, 3),),
        (turned("d", 1.2, 0.3, 4),),
    )
    way = {"search": SearchConfig(max_effects=2), "without": WITHOUT}
    (found,) = diagnose_parts(machine(tmp_path), ["pan"], made, **way)
    d = found.diagnosis
    assert d.names == ("unbalance",) and not d.rivals and d.status == "at_floor"
    assert d.after.values["unbalance.torque_nm"] == pytest.approx(torque_nm, rel=0.01)
    assert d.after.values["unbalance.hangs_at_rad"] == pytest.approx(0.0, abs=0.01)
    assert d.one_pose == {"unbalance": ("lift",)}
    seen = Seen(can_tell=found.can_tell)
    a = account("pan", d, seen)
    (tilt,) = a.get("tilt")
    assert tilt.values["gravity"].startswith("[0.0") and a.level == "moderate"
    assert tilt.values["file"] == "robot.yaml"
    assert a.command == "taccorl excite pan --effects=unbalance,cable_spring"
    assert a.values("one_pose", "effect") == ["unbalance"]
    assert a.values("record_pose", "joints") == [("lift",)]
    rivals = {"unbalance": ("cable_spring",)}
    tied = account("pan", dataclasses.replace(d, rivals=rivals))
    assert tied.level == "moderate" and "record_pose" in tied.ids
    assert "unbalance,cable_spring" in tied.command
    elsewhere = account("pan", dataclasses.replace(d, one_pose={}, remarks=()))
    assert elsewhere.level == "high" and "record_pose" not in elsewhere.ids


@pytest.mark.slow
def test_a_spring_that_holds_in_two_poses_of_the_other_joint_is_named_without_that_doubt(
    tmp_path: Path,
) -> None:
    poses = [
        turned(
            f"{lift}_{seed}",
            1.2 - 0.1 * seed,
            0.3 + 0.1 * seed,
            seed,
            tilt_rad=0.0,
            spring=0.7,
            lift=lift,
        )
        for lift in (0.0, 0.9)
        for seed in (1, 2)
    ]
    d = (
        machine(tmp_path)
        .diagnose(
            "pan", Measurements(tuple(poses[::2]), tuple(poses[1::2])), without=WITHOUT
        )
        .diagnosis
    )
    assert d.names == ("cable_spring",) and not d.rivals and d.one_pose == {}
    assert d.after.values["cable_spring.stiffness_nm_per_rad"] == pytest.approx(
        0.7, rel=0.03
    )


def test_an_upright_robot_lacks_nothing(tmp_path: Path) -> None:
    made = Measurements(
        (turned("a", 1.3, 0.25, 1, tilt_rad=0.0),),
        (turned("c", 1.1, 0.4, 3, tilt_rad=0.0),),
    )
    assert (
        machine(tmp_path).diagnose("pan", made, without=WITHOUT).diagnosis.status
        == "nothing_missing"
    )


def test_an_unbalance_is_of_hinges_only(tmp_path: Path) -> None:
    machine(tmp_path)
    (tmp_path / "arm.xml").write_text(
        MODEL.replace('name="lift" axis', 'name="lift" type="slide" axis')
    )
    robot = load_machine(tmp_path / "robot.yaml")
    assert (
        robot.effect("unbalance", "lift", {"torque_nm": 1.0, "hangs_at_rad": 0.0})
        is None
    )
    assert (
        robot.effect("unbalance", "pan", {"torque_nm": 1.0, "hangs_at_rad": 0.0})
        is not None
    )
    entry = "effort_after_target: true, effects: [{effect: unbalance, torque_nm: 1.0, hangs_at_rad: 0.0}]}"
    head = FILE.rpartition("effort_after_target: true}")[0]
    (tmp_path / "robot.yaml").write_text(f"{head}{entry}\n")
    with pytest.raises(SpecError, match=r"unbalance.*lift is a slide"):
        load_machine(tmp_path / "robot.yaml")


def replay_error(robot: RobotMachine, m: Measurement) -> float:
    """Root mean square of simulated minus measured position of joint ``pan`` [rad], over all rows of ``m``."""
    (trace,) = [
        t
        for t in robot.compare(Measurements((m,))).traces
        if (t.signal, t.kind) == ("pan", "position")
    ]
    return float(np.sqrt(np.mean(trace.residual**2)))


def test_the_gravity_that_an_unbalance_stands_for_holds_in_another_pose_and_the_unbalance_does_not(
    tmp_path: Path,
) -> None:
    """With the arm raised by 0.9 rad the mass is 0.3 cos 0.9 = 0.186 m from the axis: the unbalance of the first pose is 0.23 N·m
    too much, 0.8 mrad of 300 N·m/rad. Noise is 0.1 mrad."""
    robot, raised = machine(tmp_path), turned("raised", 1.2, 0.3, 5, lift=-0.9)
    torque_nm = 3.0 * 9.81 * 0.3 * math.sin(TILT_RAD)
    down = (math.sin(TILT_RAD), 0.0, -math.cos(TILT_RAD))
    leaning = dataclasses.replace(
        robot.robot.config, gravity=[2.0 * float(x) for x in down]
    )  # of any length
    leaning = RobotMachine(dataclasses.replace(robot.robot, config=leaning), "leaning")
    leaning.save(tmp_path / "leaning.yaml")
    loaded = load_machine(tmp_path / "leaning.yaml")
    effect = robot.effect(
        "unbalance", "pan", {"torque_nm": torque_nm, "hangs_at_rad": 0.0}
    )
    loads = robot.with_additions([Addition("pan", [effect], {}, {})])
    errors = [replay_error(r, raised) for r in (loaded, loads, robot)]
    assert errors[0] < 1.5e-4 < 4e-4 < errors[1] and errors[2] > 4e-4


def test_gravity_also_turns_with_other_joints_that_move(tmp_path: Path) -> None:
    """Both joints swing: what the tilt adds about the pan axis changes with lift."""
    both, robot = turned("both", 0.5, 0.3, 7, swing=0.8), machine(tmp_path)
    config = dataclasses.replace(
        robot.robot.config, gravity=[math.sin(TILT_RAD), 0.0, -math.cos(TILT_RAD)]
    )
    leaning = RobotMachine(dataclasses.replace(robot.robot, config=config), "leaning")
    assert replay_error(leaning, both) < 0.3 * replay_error(robot, both)


@pytest.mark.parametrize(
    "tilt_of_lift_rad", [pytest.param(TILT_RAD, marks=pytest.mark.slow), 0.0]
)
def test_one_tilt_is_proposed_where_it_holds_at_all_joints_and_refused_where_one_stands_upright(
    tmp_path: Path, tilt_of_lift_rad: float
) -> None:
    """Gravity (sin 4°, 0, −cos 4°) loads both joints by 0.616 N·m times the sine of their angles. Where lift was
    recorded upright, no tilt fits: half of it leaves each joint half of that."""
    still = {"tilt_rad": tilt_of_lift_rad, "lift": -0.2}
    made = Measurements(
        (
            turned("a", 1.3, 0.25, 1),
            turned("b", 0.6, 0.8, 2),
            turned("l", 0.0, 0.3, 3, swing=0.9, **still),
            turned("m", 0.0, 0.3, 4, swing=0.6, **still),
        ),
        (turned("c", 1.1, 0.4, 5), turned("n", 0.0, 0.3, 6, swing=0.75, **still)),
    )
    found = diagnose_parts(
        machine(tmp_path),
        JOINTS,
        made,
        search=SearchConfig(max_effects=1),
        without=WITHOUT,
    )
    robot = machine(tmp_path)
    mended, _ = robot.mended(found)
    mended.save(tmp_path / "mended.yaml")
    written = load_machine(tmp_path / "mended.yaml")
    shared, without = ("shared", "shared_without")
    facts = [account(f.part, f.diagnosis) for f in found]
    if tilt_of_lift_rad:
        true = {"gravity_x": math.sin(TILT_RAD), "gravity_y": 0.0}
        for f, a in zip(found, facts, strict=True):
            d = f.diagnosis
            assert d.names == () and a.values(shared, "joints") == [[*JOINTS]]
            assert [c.name for c in d.changed] == ["gravity_x", "gravity_y"]
            for name, value in true.items():
                low, high = d.intervals[name]
                assert low <= value <= high and high - low < 0.004, name
            low, high = d.intervals["gravity_x"]
            assert high - low < 0.002
            assert d.errors["after"]["validation"] < 1.3 < d.errors["before"]["fit"]
        assert written.robot.config.gravity == pytest.approx(
            (math.sin(TILT_RAD), 0.0, -math.cos(TILT_RAD)), abs=1e-3
        )
        raised = turned("raised", 1.2, 0.3, 8, lift=-0.9)
        assert replay_error(written, raised) < 1.5e-4 < replay_error(robot, raised)
        # MuJoCo's semi-implicit steps of 0.5 ms answer half a step early: 0.25 ms newer are
        # speed, position and target.
        assert {*written.effects} <= {"speed_delay"}
        pan = found[0].diagnosis
        for name in ("speed_delay_s", "position_age_s", "target_late_s"):
            low, high = pan.intervals[name]
            assert low <= -0.25e-3 <= high < 0.0, name
    else:
        assert found[0].diagnosis.names == ("unbalance",)
        assert "tilt" not in facts[0].ids
        assert facts[0].values(without, "joints") == [[*JOINTS]]
        assert found[1].diagnosis.names == ()
        assert written.robot.config.gravity == [] and "unbalance" in written.effects


def test_a_tilt_in_a_search_is_the_gravity_of_a_file(tmp_path: Path) -> None:
    """Both joints swing: torques of a file that states the gravity, and of the number that a fit changes, are equal."""
    robot, m = machine(tmp_path), turned("both", 0.5, 0.3, 7, swing=0.8)
    tilt = TiltedBase(x=0.05, y=-0.03, z=0.0)
    down = tilt.tilted(np.array([0.0, 0.0, -1.0]))
    config = dataclasses.replace(robot.robot.config, gravity=[*map(float, down)])
    leaning = dataclasses.replace(robot.robot, config=config)
    for name in JOINTS:
        answers = []
        for of, effects_ in ((robot.robot, [tilt]), (leaning, []), (robot.robot, [])):
            model = JointModel(RobotJoint(of, name))
            motion = motion_of(model.joint.whole(m), name, model.joint)
            answers.append(model.simulate(motion, model.gains, effects_).effort)
        searched, stated, upright = answers
        most = np.abs(stated - upright).max()
        assert most > 0.1 and np.abs(searched - stated).max() < 0.01 * most, name
    found = dict(zip(GRAVITY, down, strict=True))
    written = robot.with_additions([Addition("pan", [], found, {})])
    assert written.robot.config.gravity == [*down]
    for name, value in found.items():
        assert written.numbers("lift")[name] == (pytest.approx(value), "1")
