"""Units of a sliding joint of a robot file: numbers in N, m and kg wherever a hinge has N·m, rad and kg·m²."""

import math
from pathlib import Path

import numpy as np
import pytest
from made_rows import of_signal
from simulated_slide import (
    AXIS,
    FRICTION_N,
    KD,
    KP,
    MASS_KG,
    recorded_slide,
    robot_machine,
)

from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.comparison.along import curves
from taccorl.diagnosis.comparison.regimes import regime_errors
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.robot import RobotMachine
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.search.fit import best_fit, fit
from taccorl.diagnosis.search.identifiable import identifiable_numbers
from taccorl.errors import TaccorlError
from taccorl.report.figures import residual_along_variables

MODEL = """<mujoco><worldbody><body name="cart"><inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
<joint name="x" type="slide" axis="1 0 0" range="-0.5 0.5"/></body></worldbody></mujoco>"""
FILE = """kind: robot
model: arm.xml
joints:
  x: {kp: 3000.0, kd: 150.0, rotor_inertia: 1.0, gains: GAINS}
"""


def cart(folder: Path, gains: str) -> RobotMachine:
    return robot_machine(folder, MODEL, FILE.replace("GAINS", gains))


def sweep() -> Measurements:
    """A chirp of 0.1 m that the cart answers 50 ms late."""
    time_s, rng = np.arange(600) * 0.005, np.random.default_rng(1)
    target = 0.1 * np.sin(2 * np.pi * 0.8 * time_s**1.3)
    measured = np.interp(time_s - 0.05, time_s, target) + rng.normal(
        0.0, 2e-5, target.shape
    )
    m = of_signal(
        "sweep",
        200.0,
        target,
        measured,
        "x",
        "m",
        effort=rng.normal(0.0, 1.0, target.shape),
    )
    return Measurements(fit=(m,), validation=(m,))


def test_every_number_of_a_slide_has_the_unit_of_a_slide(tmp_path: Path) -> None:
    commanded, fitted = (
        JointProblem(cart(tmp_path, gains).robot, "x", sweep())
        for gains in ("commanded", "fitted")
    )
    units = {f.name: f.unit for p in (commanded, fitted) for f in p.base}
    assert (units["torque_ff"], units["kp"], units["kd"]) == ("N", "N/m", "N·s/m")
    units = {f.name: f.unit for c in commanded.candidates.values() for f in c.frees}
    assert (
        units["coulomb_friction.torque_nm"] == "N"
        and units["cable_spring.stiffness_nm_per_rad"] == "N/m"
    )
    assert units["cogging.torque_nm"] == "N" and units["cogging.periods"] == "rad/m"
    assert units["armature.added_kgm2"] == units["payload.mass_kg"] == "kg"
    angular = {name for name, unit in units.items() if "rad" in unit or "N·m" in unit}
    assert angular <= {
        "cogging.periods",
        "cogging.phase_rad",
        "encoder_eccentricity.phase_rad",
    }


def screw(name: str, pitch_m: float, amplitude_m: float, hz: float, seed: int):
    """6 s at 500 Hz of 2 kg on 3 N/mm and 150 N·s/m, pushed by 0.5 N sin(2π x / pitch)."""
    time_s, parts, at, speed = np.arange(3000) / 500, 10, 0.0, 0.0
    target = amplitude_m * np.sin(2 * np.pi * hz * time_s)
    rows = []
    for goal in target.tolist():
        rows.append((at, 3000.0 * (goal - at) - 150.0 * speed))
        for _ in range(parts):
            push = 0.5 * math.sin(2 * math.pi * at / pitch_m + 0.7)
            force = 3000.0 * (goal - at) - 150.0 * speed
            speed += (force + push) / 2.0 / 500 / parts
            at += speed / 500 / parts
    noise = np.random.default_rng(seed).normal(0.0, [2e-5, 0.05], (len(rows), 2))
    q, force = (np.array(rows) + noise).T
    return of_signal(name, 500.0, target, q, "x", "m", effort=force)


@pytest.mark.parametrize(
    ("pitch_m", "half_m"),
    [(0.003, 0.15), pytest.param(0.005, 0.5, marks=pytest.mark.slow)],
)
def test_a_screw_s_pitch_is_found_on_a_slide_of_a_robot_file(
    tmp_path: Path, pitch_m: float, half_m: float
) -> None:
    """Waves below a pitch of 31 mm were out of bounds."""
    model = MODEL.replace("-0.5 0.5", f"-{half_m} {half_m}")
    file = FILE.replace("rotor_inertia: 1.0, gains: GAINS", "effort_limit: 100.0")
    robot = robot_machine(tmp_path, model, file).robot
    recorded = Measurements(
        (screw("one", pitch_m, 0.05, 0.2, 1), screw("two", pitch_m, 0.03, 0.3, 2)),
        (screw("other", pitch_m, 0.04, 0.25, 3),),
    )
    problem = JointProblem(robot, "x", recorded)
    starts = [problem.start | own for own in problem.candidates["cogging"].starts]
    found = best_fit(problem, problem.fit, ("cogging",), starts[:3], 20)
    assert found.values["cogging.torque_nm"] == pytest.approx(0.5, rel=0.05)
    pitch = 2 * math.pi / found.values["cogging.periods"]
    assert pitch == pytest.approx(pitch_m, rel=1e-3)


@pytest.mark.parametrize("has_model", [True, False])
def test_a_slide_has_the_same_friction_with_a_model_and_without(
    tmp_path: Path, has_model: bool
) -> None:
    """20 N on 100 kg. With the model gains and mass stay, without it they are fitted."""
    robot = AXIS
    if has_model:
        model = MODEL.replace('mass="2"', f'mass="{MASS_KG}"')
        gains = f"  drive: {{kp: {KP}, kd: {KD}}}\n"
        file = f"kind: robot\nmodel: arm.xml\njoints:\n{gains}"
        robot = robot_machine(tmp_path, model.replace('"x"', '"drive"'), file).robot
    problem = JointProblem(robot, "drive", recorded_slide())
    assert ("inertia" in [f.name for f in problem.base]) is not has_model
    start = problem.start | {"coulomb_friction.torque_nm": 10.0}
    found = best_fit(problem, problem.fit, ("coulomb_friction",), [start], 10)
    friction = found.values["coulomb_friction.torque_nm"]
    assert friction == pytest.approx(FRICTION_N, rel=0.05)


def test_effects_of_a_slide_may_be_as_large_as_its_motor(tmp_path: Path) -> None:
    """200 N of 4 kN were refused: bounds were those of a joint of a small arm."""
    entry = "{effect: coulomb_friction, torque_nm: 200.0}"
    cogs = "{effect: cogging, torque_nm: 90.0, periods: 1256.6}"
    more = f"effort_limit: 4000.0, effects: [{entry}, {cogs}]"
    file = FILE.replace("rotor_inertia: 1.0, gains: GAINS", more)
    machine = robot_machine(tmp_path, MODEL, file)
    assert machine.numbers("x")["coulomb_friction.torque_nm"] == (200.0, "N")
    machine.save(tmp_path / "again.yaml")
    again = load_machine(tmp_path / "again.yaml")
    assert again.digest() == machine.digest()
    assert again.numbers("x") == machine.numbers("x")
    (tmp_path / "robot.yaml").write_text(file.replace("200.0", "20000.0"))
    with pytest.raises(TaccorlError, match=r"robot\.yaml:4: .*20000 N, outside of"):
        load_machine(tmp_path / "robot.yaml")


def test_a_recording_of_a_robot_s_joint_may_begin_in_motion(tmp_path: Path) -> None:
    """0.3 m/s at the first row; it was simulated from rest."""
    time_s = np.arange(600) * 0.005
    q = 0.1 * np.sin(3.0 * time_s)
    m = of_signal("moving", 200.0, q, q, "x", "m")
    joint = cart(tmp_path, "commanded").robot.joint("x")
    assert motion_of(m, "x", joint).start_speed == pytest.approx(0.3, rel=2e-3)


def test_numbers_over_kp_of_a_slide_are_in_metres_and_seconds(tmp_path: Path) -> None:
    """F / K_p [N / (N/m)] is a distance, K_d / K_p [N·s/m / (N/m)] a time."""
    fitted = JointProblem(cart(tmp_path, "fitted").robot, "x", sweep())
    model = fit(fitted, fitted.fit, ("coulomb_friction",), {}, most=1)
    found = {
        n.name: n.unit
        for n in identifiable_numbers(model, commanded=False, effort=False)
    }
    assert found["torque_ff/kp"] == found["coulomb_friction.torque_nm/kp"] == "m"
    assert found["kd/kp"] == "s"


def test_figures_and_regimes_of_a_slide_are_in_metres(tmp_path: Path) -> None:
    comparison = cart(tmp_path, "commanded").compare(sweep())
    for kind, unit in (("effort", "N"), ("position", "m")):
        traces = [t for t in comparison.traces if t.kind == kind]
        assert {t.unit for t in traces} == {unit}
        assert {c.unit for c in regime_errors(traces).coverage} == {"m", "m/s", "m/s²"}
        figure = residual_along_variables(curves(comparison, "x", kind), [], traces)
        labels = " ".join(axis.get_xlabel() for axis in figure.axes)
        assert (
            "[m]" in labels
            and "[m/s]" in labels
            and "rad" not in labels
            and "N·m" not in labels
        )
