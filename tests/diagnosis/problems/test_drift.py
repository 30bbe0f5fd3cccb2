"""Numbers that change between recordings: planted by this test's own equations of a link on a hinge, not by the kernel."""

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_rows import of_signal
from simulated_slide import robot_machine

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.comparison.compare import in_time
from taccorl.diagnosis.problems.joint_problem import GainsAre, JointProblem
from taccorl.diagnosis.problems.joints import apart, drifts_of
from taccorl.diagnosis.search.drift import Drift

RATE_HZ, PARTS, NOISE_RAD = 200, 20, 1e-4
KP, KD, INERTIA = 20.0, 1.5, 0.05
MINUTES = 10
MODEL = """<mujoco><compiler angle="radian"/><worldbody><body>
<joint name="swing" axis="0 0 1" range="-3 3"/>
<inertial pos="0 0 -0.2" mass="1" diaginertia="0.05 0.05 0.05"/></body></worldbody></mujoco>"""
FILE = f"""kind: robot
model: arm.xml
gravity_compensation: 0.0
joints:
  swing: {{kp: {KP}, kd: {KD}, gains: GAINS}}
"""


@functools.cache
def moved(
    viscous: float, dry: float, gain: float, constant: float, late_rows: int
) -> tuple[np.ndarray, np.ndarray]:
    """Targets and positions (T,) of a sweep: J q̈ = g (K_p e − K_d q̇) − b q̇ − F sign q̇ + c."""
    time_s = np.arange(8 * RATE_HZ) / RATE_HZ
    fade = np.clip(np.minimum(time_s - 0.3, 7.5 - time_s) / 0.5, 0, 1)
    target = 0.4 * fade * np.sin(2 * np.pi * (0.2 * time_s + 1.8 * time_s**2 / 16.0))
    step_s = 1.0 / (RATE_HZ * PARTS)
    stops = step_s * dry / INERTIA
    q = v = goal = 0.0
    rows = []
    for following in target.tolist():
        rows.append(q)
        goal = following
        for _ in range(PARTS):
            torque = gain * (KP * (goal - q) - KD * v) - viscous * v + constant
            free = v + step_s * torque / INERTIA
            v = 0.0 if abs(free) <= stops else free - math.copysign(stops, free)
            q += step_s * v
    return target, np.roll(rows, late_rows)


def recorded(
    name: str,
    seed: int,
    viscous: float = 0.6,
    dry: float = 0.1,
    gain: float = 1.0,
    constant: float = 0.0,
    late_rows: int = 0,
    minutes: float = 0.0,
    repeat_of: str | None = None,
) -> Measurement:
    target, rows = moved(viscous, dry, gain, constant, late_rows)
    noise = NOISE_RAD * np.random.default_rng(seed).standard_normal(len(rows))
    gains = {"kp": {"swing": KP}, "kd": {"swing": KD}}
    return of_signal(
        name,
        RATE_HZ,
        target,
        rows + noise,
        "swing",
        repeat_of=repeat_of,
        start_ns=round(minutes * 60e9),
        **gains,
    )


def found(
    folder: Path, *fit: Measurement, gains: GainsAre = "commanded"
) -> list[Drift]:
    own = Measurements(fit)
    machine = robot_machine(folder, MODEL, FILE.replace("GAINS", gains))
    return drifts_of(machine.robot, "swing", own, gains)


PLANTED = {
    "grease that warms": (
        {"viscous": 3.0},
        {"viscous": 1.0},
        "viscous_friction.damping_nms_per_rad",
    ),
    "a little grease": (
        {"viscous": 0.6},
        {"viscous": 0.5},
        "viscous_friction.damping_nms_per_rad",
    ),
    "a seal that runs in": ({"dry": 0.3}, {"dry": 0.1}, "coulomb_friction.torque_nm"),
    "a cable that pulls": ({}, {"constant": 0.1}, "torque_ff"),
}


@pytest.mark.parametrize(("first", "second", "number"), PLANTED.values(), ids=PLANTED)
def test_a_number_that_changed_is_named_with_both_values(
    first: dict[str, Any], second: dict[str, Any], number: str, tmp_path: Path
) -> None:
    key = number.split(".")[0].removesuffix("_friction").replace("coulomb", "dry")
    key = key.replace("torque_ff", "constant")
    usual = {"viscous": 0.6, "dry": 0.1, "constant": 0.0}
    (drift,) = found(
        tmp_path,
        recorded("cold", 1, **first),
        recorded("warm", 2, **second, minutes=MINUTES, repeat_of="cold"),
    )
    assert drift.number == number
    assert drift.before == pytest.approx((usual | first)[key], rel=0.03, abs=3e-3)
    assert drift.after == pytest.approx((usual | second)[key], rel=0.03, abs=3e-3)
    assert drift.before_interval[0] < drift.before < drift.before_interval[1]
    assert (drift.first, drift.second) == ("cold", "warm")
    assert drift.over_s == pytest.approx(600.0)
    assert drift.share > 0.98


def test_recordings_are_ordered_by_their_clock_else_by_their_files(
    tmp_path: Path,
) -> None:
    warm = recorded("a", 1, viscous=1.0, minutes=MINUTES)
    cold = recorded("b", 2, viscous=3.0, repeat_of="a")
    (drift,) = found(tmp_path, warm, cold)
    assert (drift.first, drift.second) == ("b", "a")
    assert drift.before > 2.0 * drift.after
    (drift,) = found(
        tmp_path,
        recorded("a", 1, viscous=1.0),
        recorded("b", 2, viscous=3.0, repeat_of="a"),
    )
    assert (drift.first, drift.second, drift.over_s) == ("a", "b", None)


def test_with_fitted_gains_it_is_a_part_of_the_damping(tmp_path: Path) -> None:
    (drift,) = found(
        tmp_path,
        recorded("cold", 1, viscous=3.0),
        recorded("warm", 2, viscous=1.0, minutes=MINUTES, repeat_of="cold"),
        gains="fitted",
    )
    assert drift.number == "kd"
    assert drift.before - drift.after == pytest.approx(2.0, rel=0.1)


def test_a_late_clock_is_no_drift(tmp_path: Path) -> None:
    assert not found(
        tmp_path,
        recorded("one", 1),
        recorded("late", 2, late_rows=1, minutes=MINUTES, repeat_of="one"),
    )


@pytest.mark.parametrize(
    "seeds", [range(3), pytest.param(range(3, 24), marks=pytest.mark.slow)]
)
def test_clean_repeats_drift_in_nothing(seeds: range, tmp_path: Path) -> None:
    for seed in seeds:
        dry, viscous = 0.02 * (seed % 5), 0.3 * (seed % 4)
        assert not found(
            tmp_path,
            recorded("one", 2 * seed, viscous, dry),
            recorded("two", 2 * seed + 1, viscous, dry, minutes=10, repeat_of="one"),
        )


def test_the_noise_floor_is_not_taken_from_recordings_that_drift(
    tmp_path: Path,
) -> None:
    own = Measurements(
        (
            recorded("cold", 1, viscous=3.0),
            recorded("warm", 2, viscous=1.0, minutes=MINUTES, repeat_of="cold"),
        )
    )
    machine = robot_machine(tmp_path, MODEL, FILE.replace("GAINS", "commanded"))
    problem = JointProblem(machine.robot, "swing", own)
    assert problem.floors[0].value > 30 * NOISE_RAD
    drifted = drifts_of(machine.robot, "swing", own)
    after = JointProblem(machine.robot, "swing", apart(own, drifted))
    assert after.floors[0].value == pytest.approx(NOISE_RAD, rel=0.1)


def test_errors_are_in_the_order_of_the_recordings_clock() -> None:
    late, early = recorded("a", 1, minutes=5), recorded("b", 2, minutes=2)
    assert in_time([late, early]) == [early, late]
    tables = [recorded("b", 1), recorded("a", 2)]
    assert in_time(tables) == tables
