"""Cylinders with one rod, simulated by this test's own equations: a gain that differs with the direction is found in a loop of
forces (pneumatic) and in one of speeds (hydraulic), with its factor, and in neither where there is none."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from axes import axis_answer, axis_motion, axis_of, effect_class
from simulated_slide import logged, one_round

from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.search.result import Diagnosis
from taccorl.sim.effects import effects

RATE_HZ, PARTS = 200, 50
MASS_KG, KP, KD = 30.0, 12_000.0, 900.0
OIL_KG, PER_S, STIFF = 50.0, 12.0, 4000.0
LIMITS = (-0.15, 0.15)
AIR = axis_of(
    name="rod", unit="m", inertia=25.0, kp=KP, kd=KD, limits=LIMITS, effort_limit=1500.0
)
OIL = axis_of(
    name="rod",
    unit="m",
    law="cascade",
    inertia=OIL_KG,
    kp=PER_S,
    kd=STIFF,
    limits=LIMITS,
    effort_limit=5000.0,
)
Force = Callable[
    [float, float], float
]  # (error of the position [m], speed [m/s]) → force [N]


def air(factor: float) -> Force:
    """A pressure that a controller sets: there is less area on the side of the rod."""

    def force(error_m: float, speed: float) -> float:
        asked = KP * error_m - KD * speed
        return asked * (factor if asked < 0.0 else 1.0)

    return force


def oil(factor: float) -> Force:
    """Oil whose flow the error sets: the same flow moves the side of the rod faster."""

    def force(error_m: float, speed: float) -> float:
        flow = PER_S * error_m
        return STIFF * (flow * (factor if flow < 0.0 else 1.0) - speed)

    return force


def moved(
    name: str,
    force: Force,
    mass_kg: float,
    wave_hz: tuple[float, float],
    seed: int,
    friction_n: tuple[float, float] = (0.0, 0.0),
    repeat_of: str | None = None,
) -> Measurement:
    """A log of 8 s at 200 Hz in steps of 0.1 ms: sines of 8 and 4 cm, dry friction both ways, noise 0.02 mm and 2 N."""
    time_s, dt_s = np.arange(8 * RATE_HZ) / RATE_HZ, 1.0 / RATE_HZ / PARTS
    fade = np.clip(np.minimum(time_s - 0.5, 7.5 - time_s), 0.0, 1.0)
    slow, fast = (np.sin(2 * math.pi * hz * time_s) for hz in wave_hz)
    target = fade * (0.08 * slow + 0.04 * fast)
    at, speed, goal, rows = 0.0, 0.0, 0.0, []
    for following in target.tolist():
        rows.append((at, force(goal - at, speed)))  # before the row's target acts
        goal = following
        for _ in range(PARTS):
            free = speed + dt_s * force(goal - at, speed) / mass_kg
            stops = dt_s * friction_n[free < 0.0] / mass_kg
            after = 0.0 if abs(free) <= stops else free - math.copysign(stops, free)
            at += dt_s * 0.5 * (speed + after)
            speed = after
    measured, effort = (
        np.array(rows)
        + np.random.default_rng(seed).standard_normal((len(rows), 2)) * (2e-5, 2.0)
    ).T
    return logged(
        name,
        ("rod",),
        ("m",),
        repeat_of,
        time_s=time_s,
        target=target,
        measured=measured,
        effort=effort,
    )


def found_in(
    axis: Robot, force: Force, mass_kg: float, friction_n=(0.0, 0.0), considered=effects
) -> Diagnosis:
    first = moved("first", force, mass_kg, (0.3, 1.1), 1, friction_n)
    again = moved("again", force, mass_kg, (0.3, 1.1), 2, friction_n, repeat_of="first")
    held = moved("held", force, mass_kg, (0.4, 0.9), 3, friction_n)
    return one_round(axis, Measurements((first, again), (held,)), considered)


NEAR = (
    "direction_gain",
    "asymmetric_friction",
    "coulomb_friction",
    "torque_scale",
    "viscous_friction",
    "backlash",
)


@pytest.mark.parametrize(
    ("axis", "force", "mass_kg", "factor", "considered"),
    [
        (AIR, air, MASS_KG, 0.6, NEAR),
        pytest.param(AIR, air, MASS_KG, 0.6, effects, marks=pytest.mark.slow),
        pytest.param(OIL, oil, OIL_KG, 1.5, effects, marks=pytest.mark.slow),
        pytest.param(AIR, air, MASS_KG, 1.5, effects, marks=pytest.mark.slow),
        pytest.param(OIL, oil, OIL_KG, 0.6, effects, marks=pytest.mark.slow),
    ],
)
def test_the_gain_of_a_cylinder_that_differs_by_direction_is_found(
    axis, force, mass_kg, factor, considered
):
    found = found_in(axis, force(factor), mass_kg, considered=considered)
    assert (
        found.names == ("direction_gain",)
        and not found.rivals
        and found.status == "at_floor"
    )
    assert found.errors["fitted"]["validation"] > 5.0
    assert found.after.values["direction_gain.factor"] == pytest.approx(
        factor, rel=0.005
    )


@pytest.mark.slow
def test_seals_that_rub_more_one_way_are_no_gain() -> None:
    """40 N forwards and 20 N backwards: a constant force differs by direction, too, at one amplitude."""
    found = found_in(AIR, air(1.0), MASS_KG, friction_n=(40.0, 20.0))
    assert (
        found.names[0] in ("coulomb_friction", "asymmetric_friction")
        and found.status == "at_floor"
    )
    assert "direction_gain" not in {
        *found.names,
        *found.rivals.get(found.names[0], ()),
        *found.rounds[0].ties,
    }


@pytest.mark.parametrize("target", [0.1, -0.1])
def test_a_velocity_loop_has_another_speed_backwards(target: float) -> None:
    """q̇ = q̇* forwards and 0.6 q̇* backwards, K_d / J = 80 1/s after the start."""
    axis = axis_of(name="rod", unit="m", law="velocity", inertia=OIL_KG, kd=STIFF)
    cls = effect_class(axis, "direction_gain")
    rest = moved("first", air(1.0), MASS_KG, (0.3, 1.1), 1)
    m = dataclasses.replace(
        rest, target=np.full_like(rest.target, target), target_kinds=("velocity",)
    )
    numbers: dict[str, Any] = {"factor": 0.6}
    at = axis_answer(axis, axis_motion(axis, m), [cls(**numbers)]).reported
    assert (at[400] - at[200]) * RATE_HZ / 200 == pytest.approx(
        target * (0.6 if target < 0 else 1.0), rel=1e-6
    )
