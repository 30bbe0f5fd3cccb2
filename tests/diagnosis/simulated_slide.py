"""Recordings that tests simulate with equations of their own; those of a slide with dry friction whose numbers are known here."""

import math
from collections.abc import Collection
from functools import cache
from pathlib import Path

import numpy as np
from axes import axis_of, problem_of

from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.origin import Origin
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.robot import RobotMachine
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.search import diagnose
from taccorl.sim.effects import effects

MASS_KG, FRICTION_N, KP, KD = 100.0, 20.0, 4e4, 2800.0
NOISE_M, NOISE_N = 2e-5, 2.0
AXIS = axis_of(
    name="drive",
    unit="m",
    inertia=80.0,
    kp=KP,
    kd=KD,
    force_unit_n=10.0,
    length_unit_m=0.25,
)


def one_round(
    axis: Robot, measurements: Measurements, considered: Collection[str] = effects
) -> Diagnosis:
    """Search for one effect, of ``considered``."""
    problem, one = problem_of(axis, measurements), SearchConfig(max_effects=1)
    without = [name for name in problem.candidates if name not in considered]
    way = {"start": problem.start, "present": problem.present, "without": without}
    return diagnose(
        problem, problem.fit, problem.validation, problem.test, **way, config=one
    )


def logged(
    name: str,
    signals: tuple[str, ...],
    units: tuple[str, ...],
    repeat_of: str | None = None,
    **rows: np.ndarray,
) -> Measurement:
    """A recording of ``rows``: time_s (T,), target, measured and effort, (T,) or (T, signals)."""
    columns = {
        key: values if key == "time_s" else values.reshape(len(values), -1)
        for key, values in rows.items()
    }
    origin = Origin("twin", "simulated by the test, not a machine")
    return Measurement(
        name=name,
        signals=signals,
        units=units,
        repeat_of=repeat_of,
        origin=origin,
        **columns,
    )


def robot_machine(folder: Path, model: str, file: str) -> RobotMachine:
    (folder / "arm.xml").write_text(model)
    (folder / "robot.yaml").write_text(file)
    return load_machine(folder / "robot.yaml")


def simulated(
    name: str,
    amplitude_m: float,
    hz: float,
    seed: int,
    repeat_of: str | None = None,
    bristles_m: float = 0.0,
) -> Measurement:
    """A mass with dry friction on a slide, in N and m, at a tenth of a millisecond: equations of this test, not the twin's.
    ``bristles_m``: x_p of bristles that bend before it slides, dz/dx = 1 − |dx/dt| / (dx/dt) z / x_p; 0: it sticks."""
    rate_hz, parts = 1000, 10
    time_s = np.arange(6 * rate_hz) / rate_hz
    fade = np.clip(np.minimum(time_s - 0.5, 5.5 - time_s) / 0.5, 0, 1)
    target = (
        amplitude_m * fade**2 * (3 - 2 * fade) * np.sin(2 * np.pi * hz * (time_s - 0.5))
    )
    dt_s, at, speed, goal = 1.0 / (rate_hz * parts), 0.0, 0.0, 0.0
    stops = dt_s * FRICTION_N / MASS_KG  # speed that friction takes away in one step
    rows, bent = [], 0.0
    for following in target.tolist():
        rows.append(
            (at, KP * (goal - at) - KD * speed)
        )  # as it is before the row's command acts
        goal = following
        for _ in range(parts):
            free = speed + dt_s * (KP * (goal - at) - KD * speed) / MASS_KG
            if bristles_m:
                speed = free - stops * bent / bristles_m
                bent += dt_s * (speed - abs(speed) * bent / bristles_m)
            else:
                speed = (
                    0.0
                    if abs(free) <= stops
                    else free - math.copysign(1.0, free) * stops
                )
            at += dt_s * speed
    position, force = np.array(rows).T
    rng = np.random.default_rng(seed)
    noisy = {"measured": position + NOISE_M * rng.standard_normal(len(target))}
    noisy["effort"] = force + NOISE_N * rng.standard_normal(len(target))
    return logged(
        name, ("drive",), ("m",), repeat_of, time_s=time_s, target=target, **noisy
    )


@cache
def recorded_slide() -> Measurements:
    """A motion twice for the fit, and another one for validation."""
    fit = (
        simulated("sine", 0.1, 0.6, 1),
        simulated("again", 0.1, 0.6, 2, repeat_of="sine"),
    )
    return Measurements(fit, (simulated("held", 0.12, 0.45, 3),))
