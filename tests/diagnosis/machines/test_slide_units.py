"""Units of a sliding joint of a robot file: numbers in N, m and kg wherever a hinge has N·m, rad and kg·m²."""

from pathlib import Path

import numpy as np
from made_rows import of_signal
from simulated_slide import robot_machine

from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.comparison.along import curves
from taccorl.diagnosis.comparison.regimes import regime_errors
from taccorl.diagnosis.machines.robot import RobotMachine
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.search.fit import fit
from taccorl.diagnosis.search.identifiable import identifiable_numbers
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
