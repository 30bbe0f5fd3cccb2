"""Compare friction laws on measurements of a real drive, the EMPS benchmark (nonlinearbenchmark.org).

``python -m pipelines.studies.emps FOLDER`` reads ``DATA_EMPS.mat`` and ``DATA_EMPS_PULSES.mat`` there. The recorded force is
regressed on acceleration, its derivative, a constant and one friction law, all low-passed at 100 Hz without phase; numbers are
fitted to the first file. It prints what is left of the force, how well the four equal cycles of the first file repeat, and the
ripple of the force over the position in its stretches of constant speed.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.signal import butter, sosfiltfilt

RATE_HZ = 1000.0
"""Rows per second of both files."""
CYCLE_ROWS = 6240
"""Rows of one of the four equal cycles of the first file, read off its target."""
N_PER_V = 35.15065
"""Force per volt of the drive's command ``vir`` [N/V], ``gtau`` of the benchmark's files."""
MASS_KG = 95.2
"""Moving mass [kg] that is subtracted before the ripple is computed: fitted here; the benchmark's authors state 95.1."""
PITCH_M = 2.5025e-3
"""Pitch of the ripple [m], the peak of the spectrum of the force over the position."""
SKIPPED = 800
"""Rows at the start, in which the drive comes into its cycle."""
Law = Callable[[np.ndarray, np.ndarray], list[np.ndarray]]


def smooth(values: np.ndarray, hz: float = 100.0) -> np.ndarray:
    """(T,) ``values`` behind a Butterworth low-pass of third order with the corner frequency ``hz``, forwards and backwards."""
    return sosfiltfilt(butter(3, hz, output="sos", fs=RATE_HZ), values)


def dahl(position: np.ndarray, length_m: float) -> np.ndarray:
    """Friction of Dahl (1968) as a share of its limit, dz/dx = (1 − z sign v) / length: hysteresis at each reversal."""
    z = np.zeros(len(position))
    for k, moved in enumerate(np.diff(position).tolist()):
        side = 1.0 if moved > 0.0 else -1.0
        z[k + 1] = side - (side - z[k]) * np.exp(-abs(moved) / length_m)
    return z


def sign_and_speed(q: np.ndarray, v: np.ndarray) -> list[np.ndarray]:
    """Coulomb and viscous friction."""
    return [np.sign(v), v]


def power(q: np.ndarray, v: np.ndarray) -> list[np.ndarray]:
    """|v|ⁿ with n = 0.4, in each direction its own."""
    return [np.sign(v) * np.abs(v) ** 0.4, np.abs(v) ** 0.4]


LAWS: dict[str, Law] = {
    "Coulomb, viscous": sign_and_speed,
    "… viscous in each direction its own": lambda q, v: [*sign_and_speed(q, v), np.abs(v)],
    "… Dahl 30 µm in place of Coulomb": lambda q, v: [dahl(q, 3e-5), v, np.abs(v)],
    "… Dahl 30 µm beside Coulomb": lambda q, v: [*sign_and_speed(q, v), np.abs(v), dahl(q, 3e-5)],
    "… tanh(v / 10 mm/s) beside Coulomb": lambda q, v: [*sign_and_speed(q, v), np.abs(v), np.tanh(v / 0.01)],
    "speed to the power 0.4 in each direction": power,
    "… and viscous in each direction": lambda q, v: [*power(q, v), v, np.abs(v)],
}


def main(folder: Path) -> None:
    files = [loadmat(folder / name, squeeze_me=True) for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")]
    positions, forces = [f["qm"] for f in files], [N_PER_V * f["vir"] for f in files]
    seen = slice(SKIPPED, -200)
    print("force that is left [N], first file (fitted) and second:")
    for name, law in LAWS.items():
        left, numbers = [], np.zeros(0)
        for position, force in zip(positions, forces, strict=True):
            q, finer = smooth(position), smooth(position, 200.0)
            a = np.gradient(np.gradient(q)) * RATE_HZ**2
            friction = law(finer, np.gradient(finer) * RATE_HZ)
            columns = [a, np.gradient(a) * RATE_HZ, np.ones_like(a), *map(smooth, friction)]
            around, wanted = np.column_stack(columns)[seen], smooth(force)[seen]
            numbers = numbers if numbers.size else np.linalg.lstsq(around, wanted, rcond=None)[0]
            left.append(float(np.std(wanted - around @ numbers)))
        print(f"  {name:42s} {left[0]:.2f}  {left[1]:.2f}")
    for values, unit in ((1e6 * positions[0], "µm"), (forces[0], "N")):
        cycles = [values[k * CYCLE_ROWS : (k + 1) * CYCLE_ROWS] for k in (1, 2)]  # the first begins, the last is short
        print(f"cycles repeat to {np.std(cycles[0] - cycles[1]) / np.sqrt(2):.2f} {unit}")
    for name, position, force in zip(("first", "second"), positions, forces, strict=True):
        q = smooth(position)
        v = np.gradient(q) * RATE_HZ
        a = np.gradient(v) * RATE_HZ
        steady, rest = np.abs(a) < 0.12, smooth(force) - MASS_KG * a
        for speed in (0.0415, 0.083, 0.1245, -0.0415, -0.083, -0.1245):
            here = steady & (np.abs(v - speed) < 0.004)
            found = []
            for rows in np.split(np.arange(len(q)), np.flatnonzero(np.diff(here.astype(int))) + 1):
                if len(rows) < 300 or not here[rows].all() or rows[0] < SKIPPED:
                    continue
                at = q[rows] - q[rows].mean()
                ripple = rest[rows] - np.polyval(np.polyfit(at, rest[rows], 2), at)
                wave = 4 * np.mean(np.hanning(len(rows)) * ripple * np.exp(-2j * np.pi * q[rows] / PITCH_M))
                found.append(wave)
            if found:
                mean = np.mean(found)
                print(
                    f"{name} file, {speed:+.4f} m/s, {len(found)} stretches: {abs(mean):.2f} N, {np.angle(mean):+.1f} rad"
                )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
