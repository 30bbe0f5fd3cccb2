"""Recordings of a slide with dry friction whose numbers are known here."""

from functools import cache

import numpy as np

from taccorl.alignment.machines.axis_file import AxisConfig
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.origin import Origin

MASS_KG, FRICTION_N, KP, KD = 100.0, 20.0, 4e4, 2800.0
NOISE_M, NOISE_N = 2e-5, 2.0
AXIS = AxisConfig(name="drive", unit="m", inertia=80.0, kp=KP, kd=KD, force_unit_n=10.0, length_unit_m=0.25)


def simulated(
    name: str, amplitude_m: float, hz: float, seed: int, repeat_of: str | None = None, bristles_m: float = 0.0
) -> Measurement:
    """A mass with dry friction on a slide, in N and m, at a tenth of a millisecond: equations of this test, not the twin's.

    Args:
        bristles_m: x_p of bristles that bend before it slides, dz/dx = 1 − |dx/dt| / (dx/dt) z / x_p; 0: it sticks.
    """
    rate_hz, parts = 1000, 10
    time_s = np.arange(6 * rate_hz) / rate_hz
    fade = np.clip(np.minimum(time_s - 0.5, 5.5 - time_s) / 0.5, 0, 1)
    target = amplitude_m * fade**2 * (3 - 2 * fade) * np.sin(2 * np.pi * hz * (time_s - 0.5))
    dt_s, at, speed, goal = 1.0 / (rate_hz * parts), 0.0, 0.0, 0.0
    stops = dt_s * FRICTION_N / MASS_KG  # speed that friction takes away in one step
    rows, bent = [], 0.0
    for following in target.tolist():
        rows.append((at, KP * (goal - at) - KD * speed))  # as it is before the row's command acts
        goal = following
        for _ in range(parts):
            free = speed + dt_s * (KP * (goal - at) - KD * speed) / MASS_KG
            if bristles_m:
                speed = free - stops * bent / bristles_m
                bent += dt_s * (speed - abs(speed) * bent / bristles_m)
            else:
                speed = 0.0 if abs(free) <= stops else free - np.sign(free) * stops
            at += dt_s * speed
    position, force = np.array(rows).T
    rng = np.random.default_rng(seed)
    return Measurement(
        name=name,
        time_s=time_s,
        target=target[:, None],
        measured=position[:, None] + NOISE_M * rng.standard_normal((len(target), 1)),
        effort=force[:, None] + NOISE_N * rng.standard_normal((len(target), 1)),
        signals=("drive",),
        units=("m",),
        repeat_of=repeat_of,
        origin=Origin("twin", "simulated by the test, not a drive"),
    )


@cache
def recorded_slide() -> Measurements:
    """A motion twice for the fit, and another one for validation."""
    fit = simulated("sine", 0.1, 0.6, 1), simulated("again", 0.1, 0.6, 2, repeat_of="sine")
    return Measurements(fit, (simulated("held", 0.12, 0.45, 3),))
