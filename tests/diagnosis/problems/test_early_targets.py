"""A position servo that MuJoCo simulates at its default step of 2 ms: no effect is missing, and its numbers are found.

MuJoCo's steps are semi-implicit: v⁺ = v + h a(q, v⁺), q⁺ = q + h v⁺. With q(t) the continuous answer, q_k = q(t_k + ½ h) to the
first order in h: the target of row k acts ½ h before the position of row k. K_d taken at the end of the step is an inertia more:
(J + ½ h K_d) q̈ = K_p (q* − q) − K_d q̇.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.origin import Origin
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.machine import Addition, Machine
from taccorl.diagnosis.search.fit import fit, rms, stacked
from taccorl.diagnosis.search.plain import plain_fit

J, KP, KD, STEP_S, RATE_HZ = 0.05, 20.0, 1.2, 2e-3, 100
MODEL = f"""<mujoco><compiler angle="radian"/>
<option timestep="{STEP_S}" integrator="implicitfast"/><worldbody><body>
<joint name="hinge" axis="0 0 1" range="-3 3"/>
<inertial pos="0 0 0" mass="1" diaginertia="{J} {J} {J}"/>
</body></worldbody>{{servo}}</mujoco>"""
SERVO = f'<actuator><position joint="hinge" kp="{KP}" kv="{KD}"/></actuator>'


def recorded(
    name: str,
    high_hz: float,
    seed: int,
    repeat_of: str | None = None,
    late_steps: int = 0,
) -> Measurement:
    """A chirp of 6 s; each row before its target acts, which it does so many steps late."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(servo=SERVO))
    data, time_s = mujoco.MjData(model), np.arange(6 * RATE_HZ) / RATE_HZ
    since = np.clip(time_s - 0.5, 0.0, None)
    turns = 0.1 * since + (high_hz - 0.1) * since**2 / 12.0
    target = 0.3 * np.sin(2.0 * np.pi * turns) * np.clip(6.0 - time_s, 0.0, 0.5) / 0.5
    measured = np.empty_like(target)
    steps = round(1.0 / (RATE_HZ * STEP_S))
    for step in range(steps * len(target)):
        if step % steps == 0:
            measured[step // steps] = data.qpos[0]
        data.ctrl[0] = target[max(step - late_steps, 0) // steps]
        mujoco.mj_step(model, data)
    measured += 1e-4 * np.random.default_rng(seed).normal(size=len(target))
    return Measurement(
        name=name,
        time_s=time_s,
        target=target[:, None],
        measured=measured[:, None],
        signals=("hinge",),
        units=("rad",),
        repeat_of=repeat_of,
        origin=Origin("surrogate", "simulated by this test"),
    )


def servo(
    folder: Path, drive: str, late_steps: int = 0
) -> tuple[Machine, Measurements]:
    (folder / "arm.xml").write_text(MODEL.format(servo=""))
    path = folder / "robot.yaml"
    path.write_text(f"kind: robot\nmodel: arm.xml\njoints:\n  hinge: {{{drive}}}\n")
    sides = [
        recorded("a", 3.0, 1, late_steps=late_steps),
        recorded("again", 3.0, 2, repeat_of="a", late_steps=late_steps),
    ]
    held = recorded("b", 2.0, 3, late_steps=late_steps)
    return load_machine(path), Measurements(tuple(sides), (held,))


def test_a_delay_is_the_one_that_acts_less_half_a_step_of_mujoco(
    tmp_path: Path,
) -> None:
    """12 steps are 24 ms, which the model's own steps need not divide: 23 ms are found."""
    robot, made = servo(tmp_path, f"kp: {KP}, kd: {KD}", late_steps=12)
    problem = robot.motion_problem("hinge", made, "auto")
    start = {**problem.start, "command_delay.delay_s": 0.02}
    found = fit(problem, problem.fit, ["command_delay"], start)
    acts_s = 12 * STEP_S - STEP_S / 2
    assert found.values["command_delay.delay_s"] == pytest.approx(acts_s, abs=1e-4)
    assert abs(found.values["command_delay.delay_s"] - 12 * STEP_S) > 8e-4


def test_timing_of_a_simulated_servo_with_commanded_gains_is_half_a_step(
    tmp_path: Path,
) -> None:
    robot, made = servo(tmp_path, f"kp: {KP}, kd: {KD}")
    problem = robot.motion_problem("hinge", made, "auto")
    found = fit(problem, problem.fit, [], problem.start)
    assert found.values["target_late_s"] == pytest.approx(-STEP_S / 2, abs=5e-5)
    assert found.values["speed_delay_s"] == pytest.approx(-STEP_S / 2, abs=1e-4)
    left = rms(stacked(problem, found.values, (), problem.validation))
    assert left < 1.15
    sides = problem.fit, problem.validation, problem.test
    plain = plain_fit(problem, *sides, problem.start)
    assert plain is not None
    assert plain.errors["validation"] < 1.15
    base = {f.name: found.values[f.name] for f in found.frees}
    robot.with_additions([Addition("hinge", [], base, {})]).save(tmp_path / "new.yaml")
    (joint,) = yaml.safe_load((tmp_path / "new.yaml").read_text())["joints"].values()
    assert joint["target_late_s"] == pytest.approx(found.values["target_late_s"])
    compared = load_machine(tmp_path / "new.yaml").compare(made)
    (score,) = [s for s in compared.scores() if s.use == "validation"]
    assert score.ratio == pytest.approx(left, rel=5e-3)


def test_gains_of_a_simulated_servo_are_found(tmp_path: Path) -> None:
    """K_d / K_p without the ½ h of the targets; both over an inertia that is ½ h K_d more."""
    robot, made = servo(tmp_path, "kp: 15.0, kd: 1.0, gains: fitted")
    problem = robot.motion_problem("hinge", made, "auto")
    values = fit(problem, problem.fit, [], problem.start).values
    assert values["kd"] / values["kp"] == pytest.approx(KD / KP, abs=1e-4)
    assert values["kp"] == pytest.approx(KP / (1.0 + STEP_S * KD / (2.0 * J)), rel=3e-3)


def test_an_axis_has_early_targets_too(tmp_path: Path) -> None:
    """Its inertia is fitted: J + ½ h K_d = 0.0512 kg·m²."""
    _, made = servo(tmp_path, f"kp: {KP}, kd: {KD}")
    (tmp_path / "axis.yaml").write_text(
        f"kind: axis\nname: hinge\nunit: rad\ninertia: 0.06\nkp: {KP}\nkd: {KD}\n"
    )
    problem = load_machine(tmp_path / "axis.yaml").motion_problem("hinge", made, "auto")
    found = fit(problem, problem.fit, [], problem.start)
    assert found.error < 1.15
    assert found.values["target_late_s"] == pytest.approx(-STEP_S / 2, abs=5e-5)
    assert found.values["inertia"] == pytest.approx(J + STEP_S * KD / 2.0, rel=5e-3)


def test_a_simulated_servo_lacks_nothing(tmp_path: Path) -> None:
    robot, made = servo(tmp_path, "kp: 15.0, kd: 1.0, gains: fitted")
    found = robot.diagnose("hinge", made).diagnosis
    assert not found.names
    assert found.errors["after"]["validation"] < 1.15
