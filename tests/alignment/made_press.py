"""Press–hold–release recordings of a ball between the fingers, made here by arithmetic of their own: law, noise, converter.

Depth of a ball of radius R whose middle is c from a taxel: R − c; nothing of ``taccorl.sim`` or ``taccorl.alignment`` is used for
what the pads send. What is made is simulated, never a robot's.
"""

from collections.abc import Callable

import numpy as np

from taccorl.alignment.measurements.measurement import Measurement, Touch
from taccorl.alignment.measurements.pressed import PressedObject, indenter
from taccorl.data.origin import Origin

RADIUS_M = 0.012
GAIN_COUNT, BASELINE = 75.0, 20
K_N, K_D = 900.0, 9.0
_PITCH_M, _ROWS, _COLUMNS = 0.002, 32, 12
_SCAN_S = 0.010
Law = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Depth [m], rate [m/s] (T, 2, 32, 12) and times (T,) → readings."""


def plain(depth: np.ndarray, rate: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Paper eq. 10."""
    return np.where(depth > 0, np.maximum(K_N * depth + K_D * rate, 0.0), 0.0)


def ball_at(x_m: float, z_m: float) -> PressedObject:
    """A ball in the left hand, ``x_m`` across and ``z_m`` towards the tips from the middle of the pads."""
    return indenter("sphere", RADIUS_M, "left", position_m=(x_m, 0.0, z_m))


def penetration_m(time_s: np.ndarray, seed: int) -> np.ndarray:
    """Five presses to three depths at two speeds, with holds; below 0 without contact. Quick ones last 0.1 s."""
    depths = np.random.default_rng(seed).permutation(
        [0.3e-3, 0.6e-3, 1.0e-3, 0.6e-3, 1.0e-3]
    )
    knots_s, knots_m, at = [0.0, 2.0], [-1e-3, -1e-3], 2.0
    for k, depth in enumerate(depths):
        rise, hold = (0.1, 0.6)[k % 2], (0.5, 1.6)[k % 3 == 0]
        knots_s += [
            at + rise,
            at + rise + hold,
            at + 2 * rise + hold,
            at + 2 * rise + hold + 0.5,
        ]
        knots_m += [depth, depth, -1e-3, -1e-3]
        at += 2 * rise + hold + 0.5
    # Corners rounded as a finger of some inertia would: mean over 60 ms
    fine = np.arange(-0.1, at + 2.1, 1e-3)
    line = np.interp(fine, knots_s, knots_m)
    return np.interp(
        time_s,
        fine,
        np.convolve(np.pad(line, 30, mode="edge"), np.ones(61) / 61, mode="valid"),
    )


def press(
    seed: int,
    *,
    ball: PressedObject | None = None,
    law: Law = plain,
    noise_count: float = 1.3,
    opening_noise_m: float = 2e-6,
    name: str | None = None,
    repeat_of: str | None = None,
    motion_seed: int | None = None,
) -> Measurement:
    """About 12 s: openings at 200 Hz, both left pads at 100 Hz, each column read at its own instant of the scan."""
    ball, rng = ball or ball_at(0.001, 0.003), np.random.default_rng(1000 + seed)
    end_s = 12.0
    rows_s = np.arange(0.0, end_s, 0.005)
    motion = seed if motion_seed is None else motion_seed

    def opening(time_s: np.ndarray) -> np.ndarray:
        return 2 * (RADIUS_M - penetration_m(time_s, motion))

    stamps = np.arange(0.02, end_s - 0.02, 0.01)
    column_s = ((np.arange(_COLUMNS) + 0.5) / _COLUMNS - 1) * _SCAN_S
    x = (np.arange(_COLUMNS) - 5.5) * _PITCH_M
    y = (np.arange(_ROWS) - 15.5) * _PITCH_M
    place = np.asarray(ball.pose)[:3, 3]

    def depth_at(shift_s: float) -> np.ndarray:
        """(T, 2, 32, 12): x of pad a runs along x of the TCP, of pad b against it (z out of the pad, y to the tips)."""
        surface = opening(stamps[:, None] + column_s + shift_s)[:, None, None, :] / 2
        found = []
        for side in (1.0, -1.0):
            across = side * x - place[0]
            out = surface - side * place[1]
            distance = np.sqrt(across**2 + (y[:, None] - place[2]) ** 2 + out**2)
            found.append(RADIUS_M - distance)
        return np.concatenate(found, axis=1)

    signed = depth_at(0.0)
    rate = (depth_at(1e-4) - depth_at(-1e-4)) / 2e-4
    reading = law(np.maximum(signed, 0.0), np.where(signed > 0, rate, 0.0), stamps)
    counts = np.zeros((len(stamps), 4, _ROWS, _COLUMNS))
    counts[:, :2] = GAIN_COUNT * reading
    counts += noise_count * rng.standard_normal(counts.shape)
    counts = np.clip(np.floor(counts + BASELINE + 0.5), 0, 255) - BASELINE
    target = np.zeros((len(rows_s), 14))
    target[:, 6] = opening(rows_s)
    measured = target.copy()
    measured[:, 6] += opening_noise_m * rng.standard_normal(len(rows_s))
    touch = Touch(
        time_s=np.tile(stamps[:, None], (1, 4)),
        counts=counts.reshape(len(stamps), -1).astype(np.int16),
        baseline=np.full(4 * _ROWS * _COLUMNS, BASELINE),
    )
    return Measurement(
        name=name or f"press_{seed}",
        time_s=rows_s,
        target=target,
        measured=measured,
        touch=touch,
        origin=Origin("twin", "simulated by tests/alignment/made_press.py"),
        repeat_of=repeat_of,
    )
