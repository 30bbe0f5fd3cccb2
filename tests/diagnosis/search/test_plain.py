"""One fit of the usual numbers of a drive, beside which an answer is judged; recordings of ``tests.cli.simulated_loop``."""

from pathlib import Path

import numpy as np
import pytest

from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.machines.cells import CellsMachine
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.machine import Machine
from taccorl.diagnosis.search.plain import plain_fit
from taccorl.report.report import plain
from taccorl.sim.effects import effects
from taccorl.surrogate.cells import draw_cells, simulated
from tests.cli.simulated_loop import Loop, table

HINGE = """<mujoco><compiler angle="radian"/><worldbody><body>
<joint name="hinge" axis="0 0 1" range="-3 3"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.05 0.05 0.05"/>
</body></worldbody></mujoco>"""
KP, KD, FRICTION, NOISE_RAD = 20.0, 1.5, 0.15, 1e-4
FEW = [n for n in effects if n not in ("coulomb_friction", "viscous_friction")]


def machine(folder: Path, gains: str) -> Machine:
    (folder / "arm.xml").write_text(HINGE)
    (folder / "machine.yaml").write_text(
        f"kind: robot\nmodel: arm.xml\njoints:\n  hinge: {{{gains}}}\n"
    )
    return load_machine(folder / "machine.yaml")


def recordings(
    robot: Machine, folder: Path, friction: float, late_s: float
) -> Measurements:
    """Two motions to fit, the second a repeat, one to validate; logged ``late_s`` late."""
    loop, bench = Loop(0.05, KP, KD, friction), folder / "bench"
    bench.mkdir()
    for name, hz, seed in (("one", 2.5, 1), ("again", 2.5, 2), ("held", 2.0, 3)):
        time_s, target, q, _ = loop.recorded(0.4, hz, 500, 6.0)
        noise = NOISE_RAD * np.random.default_rng(seed).standard_normal(len(q))
        rows = {"t": time_s, "hinge.q_target": target}
        rows["hinge.q"] = np.interp(time_s - late_s, time_s, q) + noise
        table(bench / f"{name}.csv", rows)
    (bench / "measurements.yaml").write_text(
        "recordings:\n  again.csv: {repeat_of: one.csv}\n  held.csv: {use: validation}\n"
    )
    return robot.read(bench)


@pytest.mark.parametrize("gains", ["kp: 13, kd: 1.2", "kp: 13, kd: 1.2, gains: fitted"])
def test_one_fit_finds_gains_friction_and_a_delay_of_25_ms(
    gains: str, tmp_path: Path
) -> None:
    """Positions alone tell ratios to K_p, as the inertia is free, and K_d with damping."""
    robot = machine(tmp_path, gains)
    made = recordings(robot, tmp_path, FRICTION, 0.0248)
    problem = robot.motion_problem("hinge", made, "auto")
    sides = problem.fit, problem.validation, problem.test
    found = plain_fit(problem, *sides, problem.start, problem.present)
    assert found is not None
    values = found.values
    assert values["command_delay.delay_s"] == pytest.approx(0.0248, abs=3e-4)
    damping = values["kd"] + values["viscous_friction.damping_nms_per_rad"]
    assert damping / values["kp"] == pytest.approx(KD / KP, rel=0.01)
    dry = values["coulomb_friction.torque_nm"] / values["kp"]
    assert dry == pytest.approx(FRICTION / KP, rel=0.01)
    assert set(found.errors) == {"fit", "validation"}
    assert found.errors["validation"] < 1.2
    assert found.cpu_s < 3.0


def test_an_answer_stands_beside_the_plain_fit(tmp_path: Path) -> None:
    """Friction alone is missing, so that the plain fit, which has it, leaves as much."""
    robot = machine(tmp_path, f"kp: {KP}, kd: {KD}")
    made = recordings(robot, tmp_path, FRICTION, 0.0)
    found = robot.diagnose("hinge", made, without=FEW).diagnosis
    assert found.names == ("coulomb_friction",)
    assert found.plain is not None
    left, least = found.plain.errors["validation"], found.errors["after"]["validation"]
    assert left == pytest.approx(least, rel=0.05)
    assert found.errors["fitted"]["validation"] > 10.0 * left
    assert plain(found.plain)["errors"] == found.plain.errors


def test_there_is_none_where_nothing_is_missing(tmp_path: Path) -> None:
    robot = machine(tmp_path, f"kp: {KP}, kd: {KD}")
    made = recordings(robot, tmp_path, 0.0, 0.0)
    found = robot.diagnose("hinge", made, without=FEW).diagnosis
    assert not found.names
    assert found.plain is None


def test_a_sensor_has_none() -> None:
    case = draw_cells("taxel_saturation", 50_000)
    made, sensor = simulated(case), CellsMachine(case.config(), "cells")
    (part,) = sensor.parts(made)
    problem = sensor.problem(part, made, "auto")
    assert (
        plain_fit(problem, problem.fit, problem.validation, (), problem.start) is None
    )
