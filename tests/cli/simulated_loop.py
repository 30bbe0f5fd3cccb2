"""Recordings of one mass with dry friction under a sampled loop, and files of the machine, as tables that commands read.

Equations of this module, not of the twin's.
"""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

SWING = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="swing" axis="0 1 0" range="-3 3"/>
<inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>"""


def table(path: Path, rows: Mapping[str, np.ndarray]) -> None:
    lines = [",".join(rows)]
    lines += [
        ",".join(f"{x:.9g}" for x in row) for row in zip(*rows.values(), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@dataclasses.dataclass(frozen=True)
class Loop:
    """One mass with dry friction under a sampled loop, in steps ``dt_s``; the file knows all but the friction and the timing."""

    inertia: float
    kp: float
    kd: float
    friction: float
    weight: float = 0.0
    """m g l of a pendulum [N·m]."""
    cogging: float = 0.0
    """Amplitude of 30 waves a turn, which no effect of the search explains."""
    filter_s: float = 0.0
    """Time constant of the filter of the measured speed [s]."""
    hold: int = 1
    """Steps for which the loop holds its output."""
    dt_s: float = 5e-5

    def recorded(
        self, amplitude: float, hz: float, rate_hz: int, seconds: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Times, targets, positions and efforts (T,) of a sweep up to ``hz``, each row before its target acts."""
        time_s = np.arange(round(seconds * rate_hz)) / rate_hz
        fade = np.clip(np.minimum(time_s - 0.3, seconds - 0.3 - time_s) / 0.5, 0, 1)
        phase = 2 * np.pi * (0.2 + (hz - 0.2) * time_s / (2 * seconds)) * time_s
        target = amplitude * fade**2 * (3 - 2 * fade) * np.sin(phase)
        q = v = seen = goal = given = 0.0
        rows, n, steps = [], 0, round(1 / (rate_hz * self.dt_s))
        stops = self.dt_s * self.friction / self.inertia
        for following in target.tolist():
            rows.append((q, given))
            goal = following
            for _ in range(steps):
                seen += (v - seen) * min(1.0, self.dt_s / max(self.filter_s, self.dt_s))
                if n % self.hold == 0:
                    given = self.kp * (goal - q) - self.kd * seen
                n += 1
                other = self.cogging * math.sin(30 * q) - self.weight * math.sin(q)
                free = v + self.dt_s * (given + other) / self.inertia
                v = math.copysign(max(abs(free) - stops, 0.0), free)
                q += self.dt_s * v
        position, effort = np.array(rows).T
        return time_s, target, position, effort


def robot(folder: Path) -> str:
    """A pendulum whose drive filters its speed by 1 ms, with a cogging that is not searched: errors of 3 floors."""
    loop = Loop(0.05, 20.0, 1.5, 0.15, weight=1.962, cogging=0.02, filter_s=1e-3)
    (folder / "arm.xml").write_text(SWING)
    (folder / "machine.yaml").write_text(
        "kind: robot\nmodel: arm.xml\njoints:\n  swing: {kp: 20.0, kd: 1.5, loop_hz: 1000.0}\n"
    )
    for name, hz, seed in (("one", 2.5, 1), ("held", 2.0, 2)):
        time_s, target, q, _ = loop.recorded(0.4, hz, 200, 8.0)
        q = q + 1e-4 * np.random.default_rng(seed).standard_normal(len(q))
        table(
            folder / "bench" / f"{name}.csv",
            {"t": time_s, "swing.q": q, "swing.q_target": target},
        )
    return "coulomb_friction"
