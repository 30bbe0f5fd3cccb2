"""Control laws of a robot file's joints: recordings by this test's own integration (20 µs steps), not by the kernel.

A link of 1 kg whose centre hangs 0.2 m below its hinge: 0.05 kg·m² q̈ = τ(target, q, q̇) − F sign q̇ − 1.962 N·m sin q.
"""

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
import pytest
from made_rows import of_signal
from simulated_slide import robot_machine

from taccorl.alignment.checks.clock import FAR, check_clock
from taccorl.alignment.checks.effort_time import check_effort_time, target_share
from taccorl.alignment.checks.registry import find
from taccorl.alignment.checks.robot import check_robot
from taccorl.alignment.checks.trial import Trial
from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement, TargetKind
from taccorl.cli.measured import far_off
from taccorl.diagnosis.machines.robot import RobotMachine
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.search.fit import Fit, best_fit, rms, stacked
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.errors import SpecError, TaccorlError
from taccorl.report.account import account
from taccorl.sim.effects import effects

RATE_HZ, DT_S, NOISE_RAD = 200, 2e-5, 1e-4
INERTIA, WEIGHT_NM, FRICTION_NM = 0.05, 9.81 * 0.2, 0.15
MODEL = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="swing" axis="0 1 0" range="-3 3"/>
<inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>"""
FILES = {
    "impedance": "kp: 20.0, kd: 1.5",
    "cascade": "kp: 12.0, kd: 1.5",
    "velocity": "kd: 1.5",
    "torque": "effort_limit: 30.0",
    "pwm": "kp: 6.0, supply_v: 12.0, resistance_ohm: 4.0, torque_nm_per_a: 0.8",
}


def torque(law: str, goal: float, q: float, v: float) -> float:
    """N·m of the motor, law by law; of pwm by Ohm's law with the current as a step between."""
    if law == "impedance":
        return 20.0 * (goal - q) - 1.5 * v
    if law == "cascade":
        return 1.5 * (12.0 * (goal - q) - v)
    if law == "velocity":
        return 1.5 * (goal - v)
    if law == "torque":
        return goal
    volts = 12.0 * min(max(6.0 * (goal - q), -1.0), 1.0)
    return 0.8 * (volts - 0.8 * v) / 4.0


@functools.cache
def recording(
    law: str,
    name: str,
    high_hz: float,
    seed: int,
    friction_nm: float = FRICTION_NM,
    *,
    after: bool = False,
    held_steps: int = 1,
) -> Measurement:
    """8 s of a sweep of about ± 0.4 rad; under torques below the pendulum's 1 Hz, which friction alone damps."""
    high_hz *= 0.4 if law == "torque" else 1.0
    time_s = np.arange(8 * RATE_HZ) / RATE_HZ
    fade = np.clip(np.minimum(time_s - 0.3, 7.5 - time_s) / 0.5, 0, 1)
    phase = 2 * np.pi * (0.2 * time_s + (high_hz - 0.2) * time_s**2 / 16.0)
    target = {"velocity": 2.5, "torque": 0.8}.get(law, 0.4) * fade * np.sin(phase)
    q = v = goal = given = 0.0
    steps, rows = round(1 / (RATE_HZ * DT_S)), []
    slows = DT_S * friction_nm / INERTIA
    for row, following in enumerate(target.tolist()):
        rows.append(
            (
                q,
                torque(law, following if after else goal, q, v)
                if held_steps == 1
                else given,
            )
        )
        goal = following
        for step in range(steps):
            given = (
                torque(law, goal, q, v)
                if (row * steps + step) % held_steps == 0
                else given
            )
            free = v + DT_S * (given - WEIGHT_NM * math.sin(q)) / INERTIA
            v = math.copysign(max(abs(free) - slows, 0.0), free)
            q += DT_S * v
    rng, found = np.random.default_rng(seed), np.array(rows)
    kinds: dict[str, TargetKind] = {"velocity": "velocity", "torque": "torque"}
    measured = found[:, 0] + NOISE_RAD * rng.normal(size=len(found))
    effort = found[:, 1] + 2e-3 * np.abs(found[:, 1]).max() * rng.normal(
        size=len(found)
    )
    kind = (kinds.get(law, "position"),)
    return of_signal(
        name, RATE_HZ, target, measured, "swing", effort=effort, target_kinds=kind
    )


def robot(folder: Path, drive: str) -> Robot:
    return robot_machine(
        folder, MODEL, f"kind: robot\nmodel: arm.xml\njoints:\n  swing: {{{drive}}}\n"
    ).robot


def fitted(
    made: Robot, measurements: Measurements, *names: str
) -> tuple[JointProblem, Fit, float]:
    """Problem, fit with the effects ``names``, and its validation error in noise floors."""
    problem = JointProblem(made, "swing", measurements)
    faint = {f.name: f.start for name in names for f in problem.candidates[name].frees}
    model = best_fit(problem, problem.fit, names, [problem.start | faint], 60)
    return (
        problem,
        model,
        rms(stacked(problem, model.values, model.effects, problem.validation)),
    )


def swept(law: str, friction_nm: float = FRICTION_NM) -> Measurements:
    return Measurements(
        (recording(law, "sweep", 1.5, 1, friction_nm),),
        (recording(law, "other", 1.0, 2, friction_nm),),
    )


@pytest.mark.parametrize("law", FILES)
def test_friction_hidden_under_each_law_is_recovered_beside_commanded_gains(
    law: str, tmp_path: Path
) -> None:
    made, measurements = robot(tmp_path, f"law: {law}, {FILES[law]}"), swept(law)
    _, _, without = fitted(made, measurements)
    _, model, error = fitted(made, measurements, "coulomb_friction")
    assert error < 0.02 * without and error < 5.0, (without, error)
    assert model.values["coulomb_friction.torque_nm"] == pytest.approx(
        FRICTION_NM, rel=0.005
    )


@pytest.mark.parametrize(
    ("stated", "gains"), [(True, "commanded"), (False, "commanded"), (False, "fitted")]
)
def test_a_measured_speed_is_newer_than_a_difference_of_two_samples(
    stated: bool, gains: str, tmp_path: Path
) -> None:
    """A loop of 1 kHz holds its torque for 1 ms: position and measured speed are 0.5 ms old. The file's 1 ms for the speed, as
    of a difference, would be an inertia that lacks 1.5 N·m·s · 0.5 ms, 1.5 %, at every joint. A newer speed or
    position than the file's, or a rate that it does not state, is named, and written with the error that the diagnosis says."""
    drive = f"{FILES['impedance']}, gains: {gains}{', loop_hz: 1000.0, position_age_s: 4.0e-4' * stated}"
    machine = RobotMachine(robot(tmp_path, drive), "robot")
    one, other = (
        recording("impedance", name, hz, 1, 0.0, held_steps=50)
        for name, hz in (("a", 2.5), ("b", 2.0))
    )
    without = [name for name in effects if name not in ("armature", "command_delay")]
    found = machine.diagnose("swing", Measurements((one,), (other,)), without=without)
    d, after = found.diagnosis, found.diagnosis.errors["after"]["validation"]
    assert after < 1.2 and not [name for name in d.names if name not in d.present]
    assert d.base["speed_delay_s"] == pytest.approx(-0.5e-3 * stated, abs=0.1e-3)
    (off, *more), told = d.changed, account("swing", d)
    assert off.without > 2.0 and d.status == "numbers_off"
    if stated:
        changed = {c.name: c for c in d.changed}
        assert {*changed} == {"speed_delay_s", "position_age_s"}
        age = changed["position_age_s"]
        assert age.before == 4e-4 and age.after == pytest.approx(0.0, abs=0.05e-3)
        assert {"speed_delay_s"} <= {*told.values("changed", "name")}
        assert told.values("in_effect", "effect") == ["speed_delay"]
    else:
        assert (
            off.name == "loop_hz"
            and off.after == pytest.approx(1000.0, rel=0.1)
            and not more
        )
        (rate,) = told.get("not_stated")
        assert rate.values["name"] == "loop_hz"
        assert rate.values["after"].value == pytest.approx(off.after)
    problem = JointProblem(
        machine.mended([found])[0].robot, "swing", Measurements((one,), (other,))
    )
    assert rms(
        stacked(problem, problem.start, [], problem.validation)
    ) == pytest.approx(after, abs=0.02)


@pytest.mark.parametrize("held_steps", [50, 100])
def test_targets_that_wait_for_a_loop_unlike_the_rows_are_named(
    held_steps: int, tmp_path: Path
) -> None:
    """Rows of 5 ms. A loop of 1 ms takes each row's target at once; one of 2 ms every other target 1 ms late."""
    machine = RobotMachine(
        robot(
            tmp_path, f"{FILES['impedance']}, loop_hz: {1.0 / (held_steps * DT_S):.0f}"
        ),
        "robot",
    )
    one, other = (
        recording("impedance", *own, 1, 0.0, held_steps=held_steps)
        for own in (("a", 2.5), ("b", 2.0))
    )
    d = machine.diagnose(
        "swing",
        Measurements((one,), (other,)),
        without=[n for n in effects if n != "backlash"],
    ).diagnosis
    told = [
        remark
        for remark in d.remarks
        if "waits 0 … 2 ms" in remark and "(500 Hz)" in remark
    ]
    assert len(told) == (held_steps == 100) and (
        d.errors["after"]["validation"] > 1.2
    ) == bool(told)


def test_stall_torque_and_back_emf_of_a_servo_are_found_from_a_wrong_data_sheet(
    tmp_path: Path,
) -> None:
    made = robot(
        tmp_path,
        "law: pwm, kp: 6.0, supply_v: 12.0, resistance_ohm: 4.8, torque_nm_per_a: 1.0",
    )
    _, model, error = fitted(made, swept("pwm"), "coulomb_friction")
    assert error < 1.5 and model.values["stall_nm"] == pytest.approx(
        12.0 * 0.8 / 4.0, rel=0.005
    )
    assert model.values["back_emf"] == pytest.approx(0.8 * 0.8 / 4.0, rel=0.03)
    config = made.config.joints["swing"]
    mended = dataclasses.replace(config, **config.law_numbers(model.values))
    assert mended.stall_nm == pytest.approx(model.values["stall_nm"])
    assert mended.back_emf == pytest.approx(model.values["back_emf"])


@pytest.mark.parametrize("law", ["impedance", "velocity", "torque"])
def test_efforts_of_after_the_target_are_recognised_and_can_be_declared(
    law: str, tmp_path: Path
) -> None:
    after = tuple(
        recording(law, name, hz, 1, after=True)
        for name, hz in (("sweep", 1.5), ("other", 1.0))
    )
    before = recording(law, "sweep", 1.5, 1)
    fields = ("", ", effort_after_target: true", ", command_hz: 1000.0")
    plain, declared, faster = (
        robot(tmp_path, f"law: {law}, {FILES[law]}{more}") for more in fields
    )

    def checks(made: Robot, m: Measurement) -> list[str]:
        whole = made.joint("swing").whole(m)
        found = {m.name: check_robot(made, m, whole, ["swing"])}
        check_effort_time(
            made.config.joints["swing"],
            [whole],
            found,
            "swing",
            made.path.name,
            lambda m: INERTIA,
        )
        return [f.text for f in found[m.name] if f.severity == "error"]

    assert checks(plain, before) == [] and checks(declared, after[0]) == []
    assert checks(faster, after[0]) == [], "within a row the target moves on"
    (line,) = checks(plain, after[0])
    assert "Write `effort_after_target: true` for swing" in line
    assert "Remove effort_after_target of swing" in checks(declared, before)[0]
    share, sd = target_share(plain.config.joints["swing"], after, "swing") or (0.0, 1.0)
    assert share == pytest.approx(1.0, abs=0.05) and sd < 0.1
    errors = [
        fitted(x, Measurements(after[:1], after[1:]), "coulomb_friction")[2]
        for x in (plain, declared)
    ]
    assert errors[1] < min(5.0, 0.9 * errors[0]), errors
    smooth = dataclasses.replace(
        before, effort=np.sin(before.time_s)[:, None]
    )  # of a simulation, without noise
    (made,) = JointProblem(plain, "swing", Measurements((smooth,))).fit
    assert made.floor[-1] == pytest.approx(1e-3 * np.std(smooth.effort))


@pytest.mark.parametrize(
    ("drive", "words"),
    [
        ("kp: 20.0", "kd: law impedance requires this number; write `kd: …`"),
        ("law: cascade, kp: 12.0", "kd: law cascade requires this"),
        ("law: velocity, kp: 0.0, kd: 1.0", "kp: law velocity does not use this number; remove it"),
        ("law: torque, kd: 1.0", "kd: law torque does not use this"),
        ("law: pwm, kp: 6.0, supply_v: 12.0, torque_nm_per_a: 1.0", "resistance_ohm: law pwm requires this"),
        ("kp: 20.0, kd: 1.0, supply_v: 12.0", "supply_v: law impedance does not use this"),
        ("law: pwm, kp: 6.0, supply_v: 12.0, resistance_ohm: 4.0, torque_nm_per_a: 1.0, gains: fitted", "`gains: commanded`"),
        ("law: velocity, kd: 1.0, effects: [{effect: error_deadband, width_rad: 0.01}]", "loop that law velocity does not"),
        ("law: torque, effects: [{effect: integral_action, rate_per_s: 1.0}]", "loop that law torque does not have"),
        ("law: pd, kp: 1.0, kd: 1.0", "'pd' is not one of 'impedance'"),
    ],
)  # fmt: skip
def test_numbers_that_a_law_lacks_or_has_none_of_are_refused_with_their_line(
    drive: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(SpecError) as error:
        robot(tmp_path, drive)
    assert "robot.yaml:4" in str(error.value) and words in str(error.value), error.value


def test_targets_that_a_law_does_not_take_are_refused_with_the_column_to_give(
    tmp_path: Path,
) -> None:
    made = robot(tmp_path, f"law: velocity, {FILES['velocity']}")
    position = dataclasses.replace(
        recording("velocity", "a", 1.0, 1), target_kinds=("position",)
    )
    message = (
        r"swing is commanded by position, but its law requires a velocity.*qd_target"
    )
    with pytest.raises(TaccorlError, match=message):
        JointProblem(made, "swing", Measurements((position,)))


@pytest.mark.parametrize("law", ["velocity", "torque"])
def test_a_motion_that_is_no_position_command_is_compared_by_what_was_measured(
    law: str, tmp_path: Path
) -> None:
    machine = RobotMachine(robot(tmp_path, f"law: {law}, {FILES[law]}"), "robot")
    plain = Measurements((recording(law, "sweep", 1.5, 1, friction_nm=0.0),))
    assert machine.parts(plain) == ("swing",)
    trace = machine.compare(plain).of("swing")[0]
    assert float(np.sqrt(np.mean(trace.residual**2))) < 3 * NOISE_RAD
    assert float(np.ptp(trace.target)) == pytest.approx(
        float(np.ptp(trace.position)), rel=0.05
    )


@pytest.mark.parametrize("law", ["impedance", "cascade", "pwm"])
def test_exchanged_columns_of_target_and_position_are_told_from_early_stamps(
    law: str,
) -> None:
    m = recording(law, "sweep", 1.5, 1)
    exchanged = dataclasses.replace(m, target=m.measured, measured=m.target)
    early = dataclasses.replace(
        m, measured=np.roll(m.measured, -40, axis=0)
    )  # 0.2 s; it rests at both ends
    ways_out = ("swing.q the column that swing.q_target has", "target_rows_late")
    for one, expected in ((m, ()), (exchanged, ways_out[:1]), (early, ways_out[1:])):
        one = dataclasses.replace(one, source=Path("sweep.csv"))
        said = [f.text for f in check_clock(Trial(one)) if f.severity == "error"]
        assert len(said) == len(expected) and all(
            word in text for word, text in zip(expected, said, strict=True)
        ), said


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("", "", False),
        ("supply_v: 12.0", "supply_v: 12000.0", True),
        ("kp: 6.0", "kp: 343.8", True),
        ("kp: 6.0", "kp: 0.105", True),
    ],
)
def test_millivolts_and_gains_per_degree_are_suspected_and_hidden_friction_is_not(
    old: str, new: str, expected: bool, tmp_path: Path
) -> None:
    made = robot(tmp_path, f"law: pwm, {FILES['pwm'].replace(old, new)}")
    lines = far_off(
        RobotMachine(made, "robot").compare(
            Measurements((recording("pwm", "sweep", 1.5, 1),))
        ),
        (),
        {},
    )
    assert len(lines) == expected and all(
        "swing" in line and "supply_v" in line for line in lines
    ), lines


def test_a_zero_that_only_one_of_two_columns_has_is_named_with_its_size(
    tmp_path: Path,
) -> None:
    made = RobotMachine(robot(tmp_path, FILES["impedance"]), "robot")
    m = recording("impedance", "sweep", 1.5, 1)
    moved = made.compare(
        Measurements((dataclasses.replace(m, measured=m.measured + 0.26),))
    )
    (line,) = far_off(moved, (), {})
    assert "swing" in line and "`zero:`" in line
    moved_rad = float(line.split(" rad from the replay")[0].split()[-1])
    assert moved_rad == pytest.approx(0.26, abs=0.01)  # less the first swing
    late = find(
        "late_answer",
        "swing",
        "swing answers its target 0.51 s late",
        severity="warning",
        topic=FAR,
    )
    (line,) = far_off(moved, (), {m.name: [late]})
    assert "correct its times" in line and "`zero:`" not in line


@pytest.mark.slow
def test_a_servo_that_clips_its_duty_under_law_impedance_is_suspected_to_be_one(
    tmp_path: Path,
) -> None:
    """kp V k_t / R = 6 · 2.4 N·m/rad and k_t k_e / R = 0.16 N·m·s/rad below a clip at 1/6 rad, which 30 % of the rows exceed."""
    recorded = Measurements(
        (recording("pwm", "sweep", 3.0, 1),), (recording("pwm", "other", 2.1, 2),)
    )
    assert (
        np.mean(np.abs(recorded.fit[0].target - recorded.fit[0].measured) > 1 / 6) > 0.2
    )
    machine = RobotMachine(robot(tmp_path, "kp: 14.4, kd: 0.16"), "robot")
    found = machine.diagnose(
        "swing", recorded, search=SearchConfig(max_effects=1)
    ).diagnosis
    assert any(
        "swing" in remark and "law: pwm" in remark for remark in found.remarks
    ), found.remarks


@pytest.mark.slow
@pytest.mark.parametrize("law", FILES)
def test_the_search_names_the_friction_under_each_law(law: str, tmp_path: Path) -> None:
    machine = RobotMachine(robot(tmp_path, f"law: {law}, {FILES[law]}"), "robot")
    found = machine.diagnose(
        "swing", swept(law), search=SearchConfig(max_effects=1)
    ).diagnosis
    assert found.names and found.names[0] in ("coulomb_friction", "asymmetric_friction")
    assert (
        machine.diagnose(
            "swing", swept(law, 0.0), search=SearchConfig(max_effects=1)
        ).diagnosis.names
        == ()
    )
