"""One measured motion as the checks see it: the measurement, and what several checks compute from it. T rows, J signals."""

import dataclasses
import itertools
import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import noise_floor
from taccorl.alignment.measurements.tables import is_table
from taccorl.robots import ROBOT

MOVED = {
    "rad": 0.02,
    "m": 0.002,
}  # Least range of a command that counts as motion [rad; a tenth of it in m]
MOVED_STEPS = 100.0
"""A command of a machine other than the PiPER also counts as motion if its range is so many encoder steps (± 1 mm on a stage)."""


def scale(m: Measurement, j: int) -> float:
    """Factor on positions of signal ``j`` in m after which the thresholds in rad apply: a tenth of them in m."""
    return 10.0 if m.units[j] == "m" else 1.0


def noise_of_rows(values: np.ndarray) -> float:
    """Standard deviation of white noise with the same median of fourth differences as ``values`` (T,); their variance is 70 times
    the noise's, and slow motion is nothing in them."""
    return float(1.4826 * np.median(np.abs(np.diff(values, n=4))) / math.sqrt(70))


def least_motion(m: Measurement, name: str) -> float:
    """Least range of the command of signal ``name`` that counts as motion [rad, m]."""
    j = m.column(name)
    usual = MOVED[m.units[j]]
    if name in ROBOT.action_names:
        return usual
    q = m.measured[np.isfinite(m.measured[:, j]), j]
    resolved = max(float(m.quantum[j]), noise_of_rows(q) if len(q) > 20 else 0.0)
    return min(usual, MOVED_STEPS * resolved) if resolved > 0.0 else usual


def place(m: Measurement, first: int, end: int) -> str:
    """Text of rows ``first`` to ``end`` − 1 and their times."""
    return f"rows {first} to {end - 1} ({m.time_s[first]:.3f} to {m.time_s[min(end, m.num_rows - 1)]:.3f} s)"


def write(m: Measurement, columns_file: str, otherwise: str) -> str:
    """The way out for a table, which has a columns file, or for another recording."""
    return columns_file if is_table(m) else otherwise


def without(m: Measurement, first: int) -> str:
    """The way to leave out row ``first`` and those after it: a command for a CSV file whose rows are as they were written."""
    is_changed = any(f.check == "resampled" for f in m.findings)
    if (
        is_changed
        or not (m.source.suffix == ".csv" and m.source.is_file())
        or first * m.period_s < 1.0
    ):
        return "leave this recording out"
    with m.source.open(encoding="utf-8", errors="replace") as file:
        head = 1 + sum(
            1 for _ in itertools.takewhile(lambda line: line.startswith("#"), file)
        )
    cut, name = shlex.quote(f"{m.source.stem}_cut.csv"), shlex.quote(m.source.name)
    return f"keep the rows before: `head -n {head + first} {name} > {cut}`, and move {name} out of the folder"


@dataclass(frozen=True)
class Trial:
    """One measurement, and what several checks compute from it."""

    m: Measurement
    limits: Mapping[str, float] = field(default_factory=dict)
    """Signal → largest effort that its machine states [N·m, N]."""
    rates: Mapping[str, float] = field(default_factory=dict)
    """Signal → rate at which its drive receives targets [Hz], where its machine states one."""

    def early_rows(self, signal: str) -> int:
        """Rows by which ``signal`` may move before its target: 1 where targets are sent between rows that have the newest."""
        return int(self.rates.get(signal, 0.0) * self.m.period_s > 1.0)

    @cached_property
    def floor(self) -> Mapping[str, float]:
        """Signal → noise floor of positions [rad, m]; infinite for one that was not measured."""
        known = noise_floor([dataclasses.replace(self.m, repeat_of=None)])
        return {
            name: known[name].value if name in known else math.inf
            for name in self.m.signals
        }

    @cached_property
    def even(self) -> Measurement:
        """The measurement on an even grid of its own rate."""
        return self.m.resampled(self.m.rate_hz)

    @cached_property
    def moves(self) -> np.ndarray:
        """(J,) bool: the signal is commanded to move. A command that stands still moves a joint that starts away from it and
        comes: more than its least motion off at the start, and less than half as far at the end."""
        found = []
        for j, (name, target) in enumerate(
            zip(self.m.signals, self.m.target.T, strict=True)
        ):
            known, least = target[np.isfinite(target)], least_motion(self.m, name)
            off = np.abs(target - self.m.measured[:, j])
            off = off[np.isfinite(off)]
            comes = (
                len(off)
                and self.m.target_kind(name) == "position"
                and off[0] > least
                and off[-1] < 0.5 * off[0]
            )
            found.append(bool(len(known) and (np.ptp(known) > least or comes)))
        return np.array(found)

    @cached_property
    def moving(self) -> list[int]:
        """Column indices of the signals whose command and measurement both move enough to correlate: by 0.02 rad (2 mm) and 5
        mrad (0.5 mm)."""
        m = self.even
        spans = [
            np.ptp(c[np.isfinite(c)]) if np.isfinite(c).any() else 0.0
            for c in m.measured.T
        ]
        least = [MOVED["rad"] / scale(m, j) for j in range(len(m.signals))]
        commanded = np.ptp(m.target, axis=0)
        return [
            j
            for j, low in enumerate(least)
            if commanded[j] > low and spans[j] > low / 4
        ]
