"""The simulated servo against closed forms, and its files as a user has them. Nothing here is of a real servo."""

import math
from pathlib import Path

import numpy as np
import pytest
from axes import problem_of

from pipelines.studies.pendulums import CASES, jobs, removed
from pipelines.studies.robots import run_missing
from pipelines.studies.servo import (
    GAINS,
    LOADS,
    MIDDLE_TICK,
    SOURCE_OHM,
    SUPPLY_V,
    TICK_RAD,
    Servo,
    _swing,  # pyright: ignore[reportPrivateUsage]
    write,
)
from taccorl.alignment.machines.robot_file import load_robot
from taccorl.alignment.measurements.folder import Measurements, read_measurements
from taccorl.diagnosis.search.fit import fit
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.diagnosis.search.search import diagnose


def test_a_study_whose_rows_are_all_there_runs_nothing(tmp_path):
    """A row names a wrong data sheet otherwise than its job does, so that the seed alone says whether a job is done."""
    shipped = Path(__file__).parents[2] / "docs" / "pendulum_study.jsonl"
    rows = tmp_path / "rows.jsonl"
    rows.write_text(shipped.read_text())
    assert len(
        run_missing(rows, jobs(), lambda job: pytest.fail(f"{job} was run again"))
    ) == sum(CASES.values())
    assert rows.read_text() == shipped.read_text()


def swung(
    goal_tick: float, on: float, hidden: list[float], seconds: float, start: float = 0.0
) -> np.ndarray:
    """(T,) rad at 1 kHz of a servo without back-EMF: 0.004 kg·m², 0.5 N·m/A, 5 Ω; 0.2 kg at 0.1 m."""
    cycles = np.arange(round(seconds * 1000))
    goals, ons = np.full(len(cycles), goal_tick), np.full(len(cycles), on)
    motor, load = (
        np.array([0.004, 0.5, 1e-9, 5.0]),
        np.array([0.2 * 0.1**2, 0.2 * 9.81 * 0.1]),
    )
    ticks, _ = _swing(
        cycles,
        goals,
        ons,
        np.zeros(len(cycles) + 2),
        motor,
        load,
        np.array(hidden),
        400.0,
    )
    return (ticks - MIDDLE_TICK) * TICK_RAD


def test_dry_friction_stops_the_servo_where_its_torque_and_the_weight_balance_within_friction():
    """At rest |K (q* − q) − m g l sin q| ≤ F; K = k_t V / R · 400 / 128 steps a tick / 885, the supply's sag left out."""
    q = swung(MIDDLE_TICK + 500, 1.0, [0.02, 0.0, 0.0, 0.0], 20.0)
    per_rad = 0.5 * SUPPLY_V / 5.0 * 400 / 128 / 885 / TICK_RAD
    assert np.ptp(q[-1000:]) <= TICK_RAD
    left = per_rad * (500 * TICK_RAD - q[-1]) - 0.2 * 9.81 * 0.1 * math.sin(q[-1])
    assert abs(left) <= 0.02 + per_rad * TICK_RAD


def test_friction_of_the_load_holds_by_its_share_of_both_torques():
    """|τ_m − m g l sin q| ≤ μ (τ_m + m g l sin q): with μ = 0.2, τ_m is between 1 / 1.5 and 1.5 of the weight."""
    q = swung(MIDDLE_TICK + 500, 1.0, [0.0, 0.0, 0.2, 0.0], 6.0)
    weight = 0.2 * 9.81 * 0.1 * math.sin(q[-1])
    torque = (
        0.5 * SUPPLY_V / 5.0 * 400 / 128 / 885 / TICK_RAD * (500 * TICK_RAD - q[-1])
    )
    assert np.ptp(q[-1000:]) <= TICK_RAD and 0.65 < torque / weight < 1.53
    assert abs(torque / weight - 1.0) > 0.05, "it does not stop where nothing rubs"


@pytest.fixture(scope="module")
def servo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Servo, Path]:
    folder = tmp_path_factory.mktemp("servo")
    made = Servo(seed=3, hidden="load_friction")
    write(made, folder)
    return made, folder


@pytest.fixture(scope="module")
def swings(servo: tuple[Servo, Path]) -> Measurements:
    return read_measurements(servo[1] / "swings", units={"servo": "rad"})


def test_its_tables_hold_five_loads_at_three_gains_as_a_script_would_log_them(
    servo, swings
):
    made, folder = servo
    assert (
        len(swings.all) == len(LOADS) * len(GAINS) + 2
        and len(swings.validation) == len(swings.test) == 3
    )
    assert {m.payload_kg["servo"] for m in swings.all} == {mass for mass, _ in LOADS}
    assert {m.kp["servo"] for m in swings.all} == set(GAINS)
    domain, origin, header, *rows = (
        (folder / "swings" / "load1_p200.csv").read_text().splitlines()
    )
    assert header == "ms,goal,position,volts,torque_enable"
    assert domain == "# domain: surrogate" and origin.startswith(
        "# origin: simulated servo"
    )
    steps = np.diff([float(row.split(",")[0]) for row in rows])
    assert 0.02 < steps.std() * made.rate_hz / 1e3 < 0.3, (
        "time jitters by some of a period"
    )
    sag = min(float(np.nanmin(m.supply_v)) for m in swings.all)
    assert (
        SUPPLY_V - SOURCE_OHM * 2 * SUPPLY_V / made.resistance_ohm
        < sag
        < SUPPLY_V - 0.1
    )
    assert any((m.enabled == 0).any() for m in swings.all)
    assert (
        "SIMULATED" in "".join(p.name for p in folder.iterdir())
        and swings.fit[0].origin.domain == "surrogate"
    )


def test_what_is_hidden_is_in_no_file_that_the_user_has(servo):
    made, folder = servo
    text = (folder / "servo.yaml").read_text() + (
        folder / "swings" / "measurements.yaml"
    ).read_text()
    assert "load_friction" not in text and f"{made.strength:.3f}" not in text


def test_with_the_hidden_effect_its_own_numbers_reach_the_noise_and_without_they_do_not(
    servo, swings
):
    """Simulated truth: what the generator ran with, in 3 % or three floors; the search's model shares no code with it."""
    made, folder = servo
    problem = problem_of(load_robot(folder / "servo.yaml"), swings)
    stall = SUPPLY_V * made.torque_nm_per_a / made.resistance_ohm
    start = problem.start | {
        "inertia": made.inertia,
        "stall_nm": stall,
        "load_friction.share": made.strength,
    }
    start["back_emf"] = (
        made.torque_nm_per_a * made.emf_v_s_per_rad / made.resistance_ohm
    )
    with_it = fit(problem, problem.fit, [*problem.present, "load_friction"], start, 8)
    assert with_it.error < 2.0
    assert with_it.values["load_friction.share"] == pytest.approx(
        made.strength, rel=0.03
    )
    assert with_it.values["stall_nm"] == pytest.approx(stall, rel=0.03)
    assert 0.0 < with_it.values["target_late_s"] < 2e-3, (
        "half a cycle of the loop for the goal, and half for the reading"
    )
    assert fit(problem, problem.fit, problem.present, start, 8).error > 5.0


@pytest.mark.slow
def test_friction_that_grows_with_the_load_is_found_from_the_tables(servo, swings):
    problem = problem_of(load_robot(servo[1] / "servo.yaml"), swings)
    begun = {
        "start": problem.start,
        "present": problem.present,
        "config": SearchConfig(max_effects=1),
    }
    found = diagnose(problem, problem.fit, problem.validation, problem.test, **begun)
    assert found.names == ("coulomb_friction", "load_friction")
    row = {
        "fitted_test": found.errors["fitted"]["test"],
        "after_test": found.errors["after"]["test"],
    }
    assert removed(row) >= 0.8


def test_the_study_takes_the_kinds_in_turn():
    assert len(jobs()) == sum(CASES.values()) and len(
        {seed for seed, _ in jobs()}
    ) == len(jobs())
    assert {name for _, name in jobs()[: len(CASES)]} == set(CASES)


def test_of_an_error_of_nine_floors_five_are_removed_or_five_eighths_of_what_can_be():
    assert removed({"fitted_test": 9.0, "after_test": 4.0}) == pytest.approx(5.0 / 8.0)
