"""A robot file through the machine interface, on robots that MuJoCo simulates apart from the one-joint model."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipelines.studies import pairs as pair_study
from pipelines.studies import robots as robot_study
from pipelines.studies.foreign import (
    ROBOTS,
    Case,
    Plant,
    draw,
    with_robot,
    write_example,
)
from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.machine import Addition
from taccorl.diagnosis.machines.robot import RobotMachine
from taccorl.diagnosis.problems.joints import diagnose_joint
from taccorl.diagnosis.search.fit import fit
from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect

PLAIN = Case(
    robot="SCARA", joint="scara_2", hidden="", strength=1.0, seed=3, effort=False
)
TIME_S = np.arange(600) / 200
SINE = np.column_stack(
    [
        np.full(600, 0.4),
        -0.6 + 0.3 * np.sin(2 * np.pi * TIME_S) * np.clip(TIME_S - 0.5, 0, 1),
    ]
)


def scara(folder: Path) -> RobotMachine:
    return load_machine(Plant(PLAIN).robot_file(folder))


def test_a_saved_robot_is_loaded_as_the_same_with_effects_and_numbers(
    tmp_path: Path,
) -> None:
    machine = scara(tmp_path)
    friction = make_effect("coulomb_friction", torque_nm=0.4, evidence="by hand")
    added = machine.with_additions(
        [
            Addition(
                "scara_2",
                [friction],
                {"torque_ff": 0.2, "position_age_s": 4e-4},
                {"torque_ff": (0.1, 0.3)},
            )
        ]
    )
    path = tmp_path / "below" / "robot+friction.yaml"
    path.parent.mkdir()
    added.save(path)
    again = load_machine(path)
    assert (
        again.effects == ("coulomb_friction",) and "arm:" not in path.read_text()
    )  # nothing of the PiPER
    assert again.robot.config.joints == added.robot.config.joints
    assert again.robot.config.joints["scara_2"].position_age_s == 4e-4
    weaker = again.with_additions(
        [Addition("scara_2", [dataclasses.replace(friction, torque_nm=0.1)], {}, {})]
    )
    assert [e.torque_nm for e in weaker.robot.config.joints["scara_2"].effects] == [0.1]  # type: ignore[attr-defined]
    assert len({machine.digest(), again.digest(), weaker.digest()}) == 3


def test_names_are_the_users_and_mistakes_are_said_with_them(tmp_path: Path) -> None:
    machine = scara(tmp_path)
    assert dict(machine.units) == {"scara_1": "rad", "scara_2": "rad"}
    with pytest.raises(
        TaccorlError, match=r"--joints=scara: no such joint; did you mean .scara_"
    ):
        machine.select(("scara_2",), ["scara"], [])
    with pytest.raises(
        TaccorlError, match=r"--joints=scara_1:.*fit recording moves.*scara_2"
    ):
        machine.select(("scara_2",), ["scara_1"], [])
    with pytest.raises(TaccorlError, match="has no pads"):
        machine.select(("scara_2",), [], ["left"])
    assert (
        machine.effect("gravity_mismatch", "scara_2", {"share": 0.9}) is None
    )  # its controller carries no weight


def test_a_robot_that_lacks_nothing_is_replayed_to_its_noise_and_a_hidden_spring_is_not(
    tmp_path: Path,
) -> None:
    errors = {}
    for hidden, strength in (("", 1.0), ("cable_spring", 0.1)):
        plant = Plant(dataclasses.replace(PLAIN, hidden=hidden, strength=strength))
        made = Measurements((plant.record("sine", SINE, 1),))
        folder = tmp_path / (hidden or "plain")
        folder.mkdir()
        comparison = load_machine(plant.robot_file(folder)).compare(made)
        assert [t.signal for t in comparison.traces] == [
            "scara_2"
        ] and comparison.origins[0].domain == "surrogate"
        errors[hidden] = float(np.sqrt(np.mean(comparison.traces[0].residual ** 2)))
    assert (
        errors[""] < 4e-4
    )  # encoder noise of 1e-4 rad, and the drive's filter of 1 ms, which no fit has found yet
    assert errors["cable_spring"] > 10 * errors[""]


def test_known_numbers_of_a_robot_file_are_held_saved_and_checked(
    tmp_path: Path,
) -> None:
    plant = Plant(PLAIN)
    made, machine = Measurements((plant.record("sine", SINE, 1),)), scara(tmp_path)
    weighed = make_effect("payload", mass_kg=0.25)
    config = machine.robot.config.joints["scara_2"]
    known = dataclasses.replace(
        config, effects=[weighed], known=("payload.mass_kg", "torque_ff")
    )
    machine = dataclasses.replace(
        machine, robot=machine.robot.with_joint("scara_2", known)
    )
    path = tmp_path / "known.yaml"
    machine.save(path)
    again = load_machine(path)
    assert (
        isinstance(again, RobotMachine)
        and again.robot.config.joints["scara_2"].known == known.known
    )
    problem = again.motion_problem("scara_2", made, "auto")
    model = fit(problem, problem.fit, problem.present, problem.start, 5)
    assert (
        model.values["payload.mass_kg"] == 0.25
        and model.values["torque_ff"] == config.torque_ff
    )
    fitted = {f.name for f in model.frees}
    assert "payload.x_m" in fitted and not {"payload.mass_kg", "torque_ff"} & fitted
    text = path.read_text(encoding="utf-8").replace("torque_ff]", "gear]")
    path.write_text(text, encoding="utf-8")
    line = next(k for k, row in enumerate(text.splitlines(), 1) if "known" in row)
    with pytest.raises(TaccorlError, match=rf"known\.yaml:{line}: .*scara_2.*gear"):
        load_machine(path)


def test_the_example_names_its_joints_and_says_that_it_is_simulated(
    tmp_path: Path,
) -> None:
    case_rows = robot_study.jobs()
    assert (
        sum(bool(hidden) for _, hidden in case_rows) == 60
        and sum(not hidden for _, hidden in case_rows) == 30
    )
    assert {draw(seed, hidden).robot for seed, hidden in case_rows} == {*ROBOTS}
    (tmp_path / "arm").mkdir()
    with pytest.raises(TaccorlError, match="already exists"):
        write_example(tmp_path / "arm")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "hidden"),
    [(0, "coulomb_friction"), (1, "armature"), (2, "command_delay"), (1, "")],
)
def test_what_is_hidden_in_another_robot_is_found(seed: int, hidden: str) -> None:
    row = robot_study.run((seed, hidden))
    assert row["added"] == (hidden or None), row
    assert row["after"] < 2.0


@pytest.mark.slow
def test_two_effects_that_are_missing_at_once_are_both_found_and_nothing_else() -> None:
    """Dry friction and armature in a joint of the leg. Alone, Stribeck friction removes more than Coulomb friction: its further
    numbers fit a part of the armature."""
    row = pair_study.run((90001, "coulomb_friction+armature"))
    # noise floors, with the other one fitted
    assert row["left"]["coulomb_friction"] > 20.0 and row["left"]["armature"] > 5.0
    assert row["first"] == "coulomb_friction" and set(row["found"]) == {
        "coulomb_friction",
        "armature",
    }, row
    assert pair_study.exactly(row) and not pair_study.exactly(
        row | {"found": ["stribeck_friction", "armature"]}
    )
    assert row["status"] == "at_floor" and row["confidence"] != "low"
    assert row["errors"]["after"]["test"] < 1.1 < 50.0 < row["errors"]["fitted"]["test"]


@pytest.mark.slow
def test_unknown_gains_are_fitted_where_the_file_says_so(tmp_path: Path) -> None:
    robot, made = with_robot(
        dataclasses.replace(PLAIN, hidden="command_delay", strength=0.03), tmp_path
    )
    config = dataclasses.replace(
        robot.config.joints["scara_2"],
        gains="fitted",
        kp=2 * robot.config.joints["scara_2"].kp,
    )
    machine = RobotMachine(robot.with_joint("scara_2", config), "scara")
    finding = machine.diagnose("scara_2", made)
    assert "command_delay" in finding.diagnosis.names
    assert finding.diagnosis.base["kd"] / finding.diagnosis.base["kp"] == pytest.approx(
        robot.config.joints["scara_2"].kd / robot.config.joints["scara_2"].kp, rel=0.1
    )


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["a2", "a6"])
def test_a_link_that_is_heavier_than_in_the_model_is_told_as_a_missing_weight(
    tmp_path: Path, joint: str
) -> None:
    """By 25 %. The weight of a2's link differs from a constant torque by less than the recordings show, that of a6's does not."""
    case = Case(
        robot="arm of 7 joints",
        joint=joint,
        hidden="link_mass",
        strength=0.25,
        seed=5,
        effort=True,
    )
    robot, measurements = with_robot(case, tmp_path)
    d = diagnose_joint(robot, joint, measurements).diagnosis
    told = {
        *d.names,
        *(name for others in d.rivals.values() for name in others),
        *(n for c in d.changed for n in c.instead),
    }
    assert {"payload", "unbalance"} <= told and d.errors["after"]["validation"] < 1.3
