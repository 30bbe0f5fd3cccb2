"""Measurements whose truth is known: joints with the paper's gains, integrated here, apart from the twin.

    I q̈ = K_p (q* − q) − K_d q̇ + T_ref − F_c sign(q̇)

1 ms steps, implicit in q̇ (K_d h / I is far above 1). Letters in shapes: T rows, J joints.
"""

import dataclasses
from typing import Any

import numba
import numpy as np

from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.origin import Origin
from taccorl.robots import ROBOT

RATE_HZ = 200
PARTS = 5  # integration steps a row
HOME = np.array(
    [
        0.003,
        1.732,
        -0.883,
        -0.528,
        0.2,
        -0.4,
        0.07,
        -0.003,
        1.732,
        -0.883,
        0.528,
        0.2,
        0.4,
        0.07,
    ]
)
ARMS_JOINTS = [j for j in range(14) if j % 7 != 6]
INERTIA = np.array(
    [0.4, 0.4, 0.25, 0.05, 0.03, 0.02, 0.1] * 2
)  # kg m², of links and rotor: second poles of 1 to 4 ms


def chirp(
    seconds: float, amplitude: np.ndarray, phase: np.ndarray, high_hz: float = 2.0
) -> np.ndarray:
    """(T, J) rad: 0.1 Hz to ``high_hz``, beginning and ending softly at 0, as the paper's 10 s sweep."""
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    angle = 2 * np.pi * (0.1 * time_s + (high_hz - 0.1) * time_s**2 / (2 * seconds))
    fade = np.clip(np.minimum(time_s, seconds - time_s) / 0.5, 0, 1)
    return (
        amplitude * np.sin(angle[:, None] + phase) * (fade**2 * (3 - 2 * fade))[:, None]
    )


def rested(
    motion: np.ndarray, before_s: float = 1.0, after_s: float = 1.0
) -> np.ndarray:
    """``motion`` about the home pose between two rests."""
    still = [
        np.zeros((round(s * RATE_HZ), motion.shape[1])) for s in (before_s, after_s)
    ]
    return HOME + np.concatenate([still[0], motion, still[1]])


def answer(
    target: np.ndarray,
    friction_nm: float = 0.0,
    delay_s: float = 0.0,
    damping: float = 1.0,
    highest_rad: np.ndarray | float = np.inf,
) -> np.ndarray:
    """(T, 14) true positions at the time of each row, before its target acts; at rest at the first. ``damping`` times K_d.

    At ``highest_rad`` a joint hits a rigid stop and loses its speed.
    """
    kp = np.array([*ROBOT.kp_nm_per_rad, 1500.0] * 2)
    kd = damping * np.array([*ROBOT.kd_nms_per_rad, 40.0] * 2)
    torque = np.array([*ROBOT.torque_ff_nm, 0.0] * 2)
    step, late = 1.0 / (RATE_HZ * PARTS), round(delay_s * RATE_HZ * PARTS)
    held = np.concatenate(
        [np.repeat(target[:1], late, axis=0), np.repeat(target, PARTS, axis=0)]
    )
    numbers = (
        kp,
        torque,
        step / INERTIA,
        1 + step * kd / INERTIA,
        np.full(14, highest_rad),
    )
    return _integrated(held, len(target), *numbers, friction_nm, step)


@numba.njit(cache=True)
def _integrated(
    held, num_rows, kp, torque, mobility, weight, highest, friction_nm, step
):
    rows = np.empty((num_rows, held.shape[1]))
    for j in range(held.shape[1]):
        q, v = held[0, j] + torque[j] / kp[j], 0.0
        for k in range(num_rows * PARTS):
            if k % PARTS == 0:
                rows[k // PARTS, j] = q
            free = (v + mobility[j] * (kp[j] * (held[k, j] - q) + torque[j])) / weight[
                j
            ]
            v = np.sign(free) * max(
                abs(free) - mobility[j] * friction_nm / weight[j], 0.0
            )
            if q + step * v > highest[j] and v > 0:
                v = 0.0
            q = q + step * v
    return rows


def sweep(
    seed: int = 0,
    *,
    seconds: float = 8.0,
    noise_rad: float = 2e-4,
    quantum_rad: float = 0.0,
    friction_nm: float = 0.0,
    delay_s: float = 0.0,
    joints: list[int] | None = None,
    high_hz: float = 2.0,
    **fields: Any,
) -> Measurement:
    """A sweep of ``joints`` (all by default), with noise and quantisation."""
    rng, amplitude = np.random.default_rng(seed), np.zeros(14)
    moved = ARMS_JOINTS if joints is None else joints
    amplitude[moved] = rng.uniform(0.1, 0.3, len(moved))
    target = rested(chirp(seconds, amplitude, np.pi * rng.integers(0, 2, 14), high_hz))
    return measured(
        target,
        answer(target, friction_nm, delay_s),
        rng,
        noise_rad,
        quantum_rad,
        **fields,
    )


def measured(
    target: np.ndarray,
    true: np.ndarray,
    rng: np.random.Generator,
    noise_rad: float,
    quantum_rad: float = 0.0,
    **fields: Any,
) -> Measurement:
    """What a driver would have logged of it."""
    seen = true + noise_rad * rng.normal(size=true.shape)
    if quantum_rad:
        seen = np.round(seen / quantum_rad) * quantum_rad
    rate_hz = fields.pop("rate_hz", RATE_HZ)
    rows = {
        "time_s": np.arange(len(target)) / rate_hz,
        "target": target,
        "measured": seen,
    }
    return Measurement(
        **{"name": "sweep", "origin": Origin(text="synthetic")} | rows | fields
    )


def shifted(m: Measurement, rows: int) -> Measurement:
    """Positions paired with the commands of ``rows`` rows later (positive: they seem to lead)."""
    keep = m.num_rows - abs(rows)
    first, second = max(rows, 0), max(-rows, 0)
    return dataclasses.replace(
        m,
        time_s=m.time_s[:keep],
        target=m.target[second : second + keep],
        measured=m.measured[first : first + keep],
        velocity=m.velocity[first : first + keep],
        effort=m.effort[first : first + keep],
    )
