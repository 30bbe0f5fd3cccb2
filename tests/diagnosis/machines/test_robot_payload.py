"""A mass that nobody knows at the tip of a two-joint arm, and a late command at the joint before: simulated by MuJoCo with that
mass in the model, apart from the one-joint model."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.machine import Addition, diagnose_parts
from taccorl.diagnosis.machines.robot import RobotMachine
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects, make_effect

MASS_KG, DELAY_S, NOISE_RAD, NOISE_NM = 0.35, 0.012, 1e-4, 0.02
JOINTS = ("yaw", "elbow")
KP, KD = np.array([150.0, 80.0]), np.array([6.0, 3.0])
TIP = '<body pos="0.25 0 0"><inertial pos="0 0 0" mass="0.35" diaginertia="1e-6 1e-6 1e-6"/></body>'
MODEL = """<mujoco><compiler angle="radian"/><option timestep="0.0005" integrator="implicitfast"/><worldbody>
<body name="column"><inertial pos="0.05 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
<joint name="yaw" axis="0 0 1" range="-2 2" armature="0.05"/>
<body name="forearm" pos="0.15 0 0"><inertial pos="0.1 0 0" mass="0.8" diaginertia="0.001 0.005 0.005"/>
<joint name="elbow" axis="0 1 0" range="-2 2" armature="0.02"/>{tip}</body></body></worldbody></mujoco>"""
FILE = """kind: robot
model: arm.xml
gravity_compensation: 1.0
joints:
  yaw: {kp: 150.0, kd: 6.0, rotor_inertia: 0.05, loop_hz: 1000.0, effort_after_target: true}
  elbow: {kp: 80.0, kd: 3.0, rotor_inertia: 0.02, loop_hz: 1000.0, effort_after_target: true}
"""
CONSIDERED = ("payload", "command_delay", "command_lag", "coulomb_friction", "armature")
WITHOUT = [name for name in effects if name not in CONSIDERED]


def machine(folder: Path) -> RobotMachine:
    (folder / "arm.xml").write_text(MODEL.format(tip=""))
    (folder / "robot.yaml").write_text(FILE)
    made = load_machine(folder / "robot.yaml")
    assert isinstance(made, RobotMachine)
    return made


def recorded(
    name: str, joint: int, amplitude: float, fastest_hz: float, seed: int, again: str | None = None
) -> Measurement:
    """A chirp of one joint for 5 s; rows at 200 Hz, control at 1 kHz with the weight of the arm without the mass."""
    model, known = (mujoco.MjModel.from_xml_string(MODEL.format(tip=tip)) for tip in (TIP, ""))
    data, believed, rng = mujoco.MjData(model), mujoco.MjData(known), np.random.default_rng(seed)
    time_s = np.arange(1100) * 0.005
    moving = np.clip(time_s - 0.5, 0.0, None)
    target = np.tile([0.2, 0.4], (len(time_s), 1))
    target[:, joint] += amplitude * np.sin(2 * np.pi * (0.1 + 0.5 * (fastest_hz - 0.1) * moving / 5.0) * moving)
    data.qpos[:] = target[0] + [0.0, MASS_KG * 9.81 * 0.25 * np.cos(0.4) / 80.0]
    measured, effort = np.empty_like(target), np.empty_like(target)
    for step in range(10 * len(time_s)):
        row = step // 10
        if step % 2 == 0:
            late = max(int((0.0005 * step - DELAY_S) // 0.005), 0)
            asked = np.array([target[late, 0], target[row, 1]])
            believed.qpos[:] = data.qpos
            mujoco.mj_forward(known, believed)
            torque = KP * (asked - data.qpos) - KD * data.qvel + believed.qfrc_bias
            data.qfrc_applied[:] = torque
        if step % 10 == 0:
            measured[row], effort[row] = data.qpos, torque
        mujoco.mj_step(model, data)
    return Measurement(
        name=name,
        time_s=time_s,
        target=target,
        measured=measured + rng.normal(0.0, NOISE_RAD, target.shape),
        effort=effort + rng.normal(0.0, NOISE_NM, target.shape),
        signals=JOINTS,
        units=("rad", "rad"),
        repeat_of=again,
    )


@pytest.mark.slow
def test_a_mass_found_at_the_elbow_is_in_the_model_when_the_yaw_joint_is_judged(tmp_path: Path) -> None:
    """0.35 kg at 0.4 m from the yaw axis is half of its known inertia: without it the delay is wrong, and efforts fit only with a
    factor."""
    fit, validation = [], []
    for j, name in enumerate(JOINTS):
        fit += [recorded(name, j, 0.3, 2.5, j), recorded(f"{name}_again", j, 0.3, 2.5, 10 + j, name)]
        validation.append(recorded(f"{name}_other", j, 0.25, 2.2, 20 + j))
    made, arm, one = Measurements(tuple(fit), tuple(validation)), machine(tmp_path), SearchConfig(max_effects=1)

    alone = arm.diagnose("yaw", made, search=one, without=WITHOUT).diagnosis
    low, high = alone.intervals["command_delay.delay_s"]
    assert not low < DELAY_S < high
    assert alone.base["effort_scale"] > 1.15 and any("effort_scale" in r for r in alone.remarks)

    yaw, elbow = diagnose_parts(arm, JOINTS, made, search=one, without=WITHOUT)
    (payload,) = elbow.diagnosis.effects
    assert payload.name == "payload"
    values = {p.name: getattr(payload, p.name) for p in payload.parameters()}
    assert values["mass_kg"] == pytest.approx(MASS_KG, rel=0.02)
    assert values["x_link6_m"] == pytest.approx(0.15, abs=0.02)  # from the forearm's centre of mass
    assert abs(values["y_link6_m"]) < 2e-3, "the elbow turns about y"
    assert "forearm" in elbow.remark
    assert [e.name for e in yaw.diagnosis.effects] == ["command_delay"]
    low, high = yaw.diagnosis.intervals["command_delay.delay_s"]
    assert low < DELAY_S < high and high - low < 5e-3
    assert yaw.diagnosis.errors["after"]["validation"] < 0.2 * alone.errors["after"]["validation"]
    assert any("elbow" in r for r in yaw.diagnosis.remarks)
    assert not any("effort_scale" in r for r in yaw.diagnosis.remarks)

    mended, left = arm.mended([yaw, elbow])
    assert left == "" and mended.effects == ("command_delay", "payload")
    errors = [
        {
            t.signal: np.sqrt(np.mean(t.residual**2))
            for t in m.compare(made).traces
            if t.kind == "position" and t.use == "validation"
        }
        for m in (arm, mended)
    ]
    assert all(errors[1][name] < 0.1 * errors[0][name] for name in JOINTS)


def test_one_body_has_one_payload(tmp_path: Path) -> None:
    model = MODEL.format(tip="").replace('name="yaw" axis="0 0 1"', 'name="yaw" axis="0 1 0"')
    arm = machine(tmp_path)
    (tmp_path / "arm.xml").write_text(model)
    arm = dataclasses.replace(arm, robot=load_machine(tmp_path / "robot.yaml").robot)  # type: ignore[attr-defined]
    held = [Addition(name, [make_effect("payload", mass_kg=0.2)], {}, {}) for name in JOINTS]
    with pytest.raises(TaccorlError, match=r"payload.*elbow.*yaw.*forearm"):
        arm.with_additions(held)
    held_at_elbow = arm.with_additions(held[1:])
    assert held_at_elbow.effect("payload", "yaw", {"mass_kg": 0.1}) is None, "yaw feels the elbow's"
    # Bounds of a search follow the robot: half of 0.15 + 0.1 m of links, or twice 0.1 m from the elbow to the centre of mass.
    payload = arm.effect("payload", "elbow", {"mass_kg": 0.1, "x_link6_m": 0.18})
    assert payload is not None
    ends = {p.name: (p.low, p.high) for p in payload.parameters()}
    assert ends["x_link6_m"] == (-0.2, 0.2) and ends["y_link6_m"] == (-1e-3, 1e-3) and ends["mass_kg"] == (0.0, 1.5)
