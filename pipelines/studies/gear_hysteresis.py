"""Study: does the hysteresis of a gear show in recordings, if the joint's encoder is on the motor's side of the gear?

``python -m pipelines.studies.gear_hysteresis`` simulates a motor and its link, joined by a gear: a spring and a damper, and
beside them Dahl's friction z, ż = σ φ̇ (1 − (z / F) sign φ̇) with the twist φ, which at rest keeps up to F / σ of it (windup). A
gear without z is fitted to position and torque of the motor, with all other numbers: K_p, K_d, T_ref, both inertias, stiffness
and damping of the gear, weight, Coulomb and viscous friction. What is left is printed in noise floors: 0.1 mrad, and 0.2 % of the
largest torque. No noise is added, so that 0 is a perfect fit. ``behind the gear`` is what an encoder there would have seen.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from scipy.optimize import least_squares

RATE_HZ, PARTS = 500, 20
"""Rows per second; physics steps per row."""
NOISE_RAD, NOISE_SHARE = 1e-4, 2e-3
"""Noise floor of positions [rad], and of torques as a share of the largest."""
LOOP_RAD_PER_S, DAMPING_RATIO = 2 * math.pi * 4.0, 0.8
"""Natural frequency and damping ratio of the drive's position loop."""


class Gear(NamedTuple):
    """One joint, in N·m and rad."""

    name: str
    stiffness: float
    """[N·m/rad]"""
    motor: float
    """Inertia of the motor at the joint [kg·m²]."""
    link: float
    """Inertia of the link [kg·m²]."""
    weight: float
    """Largest torque of the link's weight [N·m]."""
    most: float
    """F [N·m]."""
    slope: float
    """σ [N·m/rad]."""


# Catalogue: a harmonic drive of size 17 has 1.3e4 N·m/rad and loses at most an arc minute at 24 N·m (0.29 mrad, here 4 N·m).
GEARS = (
    Gear("harmonic drive, as in catalogues", 1.3e4, 0.3, 1.0, 20.0, 2.0, 2.6e4),
    Gear("… with five times its hysteresis", 1.3e4, 0.3, 1.0, 20.0, 10.0, 2.6e4),
    Gear("soft gear of a small arm", 5e2, 0.02, 0.08, 2.0, 0.2, 1e3),
    Gear("… with three times its hysteresis", 5e2, 0.02, 0.08, 2.0, 0.6, 1e3),
)


@numba.njit(cache=True)
def _moved(target: np.ndarray, x: np.ndarray, most: float, slope: float) -> np.ndarray:
    """(T, 3) position and torque of the motor, position of the link; ``x`` are the numbers that ``main`` fits."""
    kp, kd, torque_ff, motor, link, stiffness, damping, weight, coulomb, viscous = x
    rows = np.empty((len(target), 3))
    q, v, w, z, h = target[0], 0.0, 0.0, 0.0, 1.0 / RATE_HZ / PARTS
    at = q - weight * math.sin(q) / stiffness
    for n in range(len(target)):
        rows[n] = q, kp * (target[max(n - 1, 0)] - q) - kd * v + torque_ff, at
        for _ in range(PARTS):
            twisting = v - w
            if most > 0.0:
                z += h * slope * twisting * (1.0 - z / most * math.copysign(1.0, twisting))
            passed = stiffness * (q - at) + damping * twisting + z
            rubbed = coulomb * math.tanh(v / 1e-3) + viscous * v
            v += h * (kp * (target[n] - q) - kd * v + torque_ff - passed - rubbed) / motor
            w += h * (passed - weight * math.sin(at)) / link
            q, at = q + h * v, at + h * w
    return rows


def motions() -> dict[str, np.ndarray]:
    """Name → (T,) targets [rad] about 0.6 rad, 8 s each."""
    time_s = np.arange(8 * RATE_HZ) / RATE_HZ
    begins = np.clip(time_s, 0.0, 1.0)
    slow, fast = (
        begins * np.sin(2 * np.pi * (low * time_s + (high - low) * time_s**2 / 16))
        for low, high in ((0.1, 2.5), (0.5, 12.0))
    )
    triangle = np.interp(time_s / 4 % 1.0, [0.0, 0.25, 0.75, 1.0], [0.0, 1.0, -1.0, 0.0])
    return {"chirp to 2.5 Hz": 0.6 + 0.3 * slow, "triangle": 0.6 + 0.8 * triangle, "chirp to 12 Hz": 0.6 + 0.03 * fast}


def main() -> None:
    targets = motions()
    for gear in GEARS:
        kp = (gear.motor + gear.link) * LOOP_RAD_PER_S**2
        kd = 2 * DAMPING_RATIO * (gear.motor + gear.link) * LOOP_RAD_PER_S
        damping = 0.04 * math.sqrt(gear.stiffness * gear.link)
        true = np.array([kp, kd, 0.0, gear.motor, gear.link, gear.stiffness, damping, gear.weight, 0.0, 0.0])
        seen = [_moved(target, true, gear.most, gear.slope) for target in targets.values()]
        torque = max(float(np.abs(rows[:, 1]).max()) for rows in seen)
        floors = np.array([NOISE_RAD, NOISE_SHARE * torque, NOISE_RAD])
        scale = np.array([*true[:2], torque, *true[3:8], torque, kd]) * 0.05

        def left(steps: np.ndarray, true=true, scale=scale, seen=seen, floors=floors) -> np.ndarray:
            numbers = [_moved(target, true + steps * scale, 0.0, 1.0) for target in targets.values()]
            return np.stack([(a - b) / floors for a, b in zip(numbers, seen, strict=True)])

        low = np.array([-19.0, -19.0, -9.0, -19.0, -19.0, -15.0, -19.0, -19.0, 0.0, 0.0])
        found = least_squares(lambda s: left(s)[..., :2].ravel(), np.full(10, 1e-6), bounds=(low, 1e4), max_nfev=100)
        rms = np.sqrt(np.mean(left(found.x) ** 2, axis=1))
        print(f"{gear.name}: windup {1e3 * gear.most / gear.slope:.2f} mrad, largest torque {torque:.1f} N·m")
        for name, (q, tau, behind) in zip(targets, rms, strict=True):
            print(f"  {name:16s} position {q:.2f}, torque {tau:.2f} floors left; behind the gear {behind:.2f}")
        whole = float(np.sqrt(np.mean(left(found.x)[..., :2] ** 2)))
        fitted = true + found.x * scale
        late_ms = 1e3 * fitted[6] / fitted[5], 1e3 * damping / gear.stiffness
        print(f"  all {whole:.2f} floors; damping {late_ms[0]:.2f} ms instead of {late_ms[1]:.2f} ms")


if __name__ == "__main__":
    main()
