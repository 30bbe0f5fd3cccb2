"""An integral in the position loop of a cascade, beside dry friction, is found; recordings by this test's own integration."""

import math

import numpy as np
from axes import axis_of, problem_of
from made_rows import of_signal

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.diagnosis.search.search import diagnose

INERTIA, KP, KD = 0.08, 25.0, 4.0
FRICTION_NM, RATE_PER_S = 0.5, 1.5
RATE_HZ, DT_S = 200, 1e-4
CONSIDERED = (
    "coulomb_friction",
    "viscous_friction",
    "integral_action",
    "position_integral",
    "torque_lag",
)


def recording(name: str, hz: float, seed: int) -> Measurement:
    """Two steps with holds, then a sweep: τ = kd (kp (e + 1.5 ∫ e dt) − q̇) − F sign q̇."""
    time_s = np.arange(8 * RATE_HZ) / RATE_HZ
    fade = np.clip(np.minimum(time_s - 4.0, 7.7 - time_s) / 0.4, 0, 1)
    target = np.interp(
        time_s, [0.3, 0.35, 1.9, 1.95, 3.5, 3.55], [0, 0.3, 0.3, -0.2, -0.2, 0]
    )
    target = target + 0.4 * fade * np.sin(
        2 * np.pi * (0.3 + hz * (time_s - 4.0)) * (time_s - 4.0)
    )
    q = v = total = goal = given = 0.0
    rows, stops = [], DT_S * FRICTION_NM / INERTIA
    for following in target.tolist():
        rows.append((q, given))
        goal = following
        for _ in range(round(1 / (RATE_HZ * DT_S))):
            total += DT_S * (goal - q)
            given = KD * (KP * (goal - q + RATE_PER_S * total) - v)
            free = v + DT_S * given / INERTIA
            v = math.copysign(max(abs(free) - stops, 0.0), free)
            q += DT_S * v
    position, effort = np.array(rows).T
    noise = np.random.default_rng(seed).standard_normal((2, len(rows)))
    return of_signal(
        name,
        RATE_HZ,
        target,
        position + 1e-4 * noise[0],
        "servo",
        effort=effort + 0.02 * noise[1],
    )


def test_an_integral_on_the_position_of_a_cascade_is_found_beside_dry_friction() -> (
    None
):
    """In the speed loop it would be another motion: ``integral_action`` alone leaves more than ten times the error."""
    axis = axis_of(
        name="servo", unit="rad", inertia=INERTIA, law="cascade", kp=KP, kd=KD
    )
    made = Measurements((recording("one", 0.4, 1),), (recording("held", 0.3, 2),))
    problem = problem_of(axis, made)
    found = diagnose(
        problem,
        problem.fit,
        problem.validation,
        start=problem.start,
        present=problem.present,
        without=[name for name in problem.candidates if name not in CONSIDERED],
        config=SearchConfig(),
    )
    assert sorted(found.names) == ["coulomb_friction", "position_integral"]
    numbers = {e.name: e for e in found.effects}
    rate = vars(numbers["position_integral"])["rate_per_s"]
    friction = vars(numbers["coulomb_friction"])["torque_nm"]
    assert (
        abs(rate / RATE_PER_S - 1.0) < 0.05 and abs(friction / FRICTION_NM - 1.0) < 0.05
    )
    assert found.errors["after"]["validation"] < 2.0
