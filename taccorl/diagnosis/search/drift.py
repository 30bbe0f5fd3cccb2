"""Numbers of a machine that change with time: warm grease, a motor that warms up.

Two recordings of one motion differ by more than the noise of their rows. Whatever the model
lacks, both lack alike, so that their difference shows a changed number alone: it is what
the model changes along that motion as the number goes from n − β / 2 to n + β / 2. A shift
of the clock is tried as well, and explains the difference of recordings that are late.

Letters in shapes: M common rows, T rows.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taccorl.diagnosis.search.fit import Fit, fit
from taccorl.diagnosis.search.problem import (
    Case,
    Free,
    Problem,
    Recording,
    chosen,
    with_held,
)

EXPLAINED = 0.9
"""Least share of the squared difference that a changed number explains. A choice."""
AS_GOOD = 2.0
"""Ratio of what two numbers leave below which both are named, and below which a shift of
the clock leaves as little. A choice."""
LEAST = 1.0  # Least RMS [noise floors] by which two recordings differ. A choice.
STEPS = 6  # Gauss–Newton steps for one number
NO_DRIFT = ("loop_s", "position_age_s", "speed_delay_s", "effort_age_s", "effort_scale")
"""Fitted numbers of the recording's timing and units, which no friction changes."""


@dataclass(frozen=True, kw_only=True)
class Drift:
    """A number that has one value in one recording of a motion and another one later."""

    number: str  # Name of the number, such as ``viscous_friction.damping_nms_per_rad``
    unit: str
    before: float  # Value in ``first``
    after: float  # Value in ``second``
    before_interval: tuple[float, float]  # 95 %; NaN where the recording has none
    after_interval: tuple[float, float]
    first: str  # Name of the earlier recording, by the recordings' clock
    second: str  # Name of the later one
    over_s: float | None
    """Time between their beginnings [s]; None if their clocks do not state it, so that
    their order is that of the files."""
    share: float  # Share of their squared difference that the change explains
    as_good: tuple[str, ...] = ()  # Other numbers that explain as much

    @property
    def words(self) -> str:
        """Sentence with the number, its two values, and the time between them."""
        when = "later" if self.over_s is None else f"{_duration(self.over_s)} later"
        ends = [
            f"{value:.4g} ({low:.4g} … {high:.4g})"
            for value, (low, high) in (
                (self.before, self.before_interval),
                (self.after, self.after_interval),
            )
        ]
        others = f", as {' or '.join(self.as_good)} would" if self.as_good else ""
        return (
            f"{self.number} changed with time: {ends[0]} {self.unit} in {self.first}, "
            f"{ends[1]} in {self.second}, {when}; that explains {self.share:.1%} of how "
            f"these two differ{others}. No noise floor is taken from the two: record the "
            "motion twice in a row, and all others warm"
        )


class Repeat(NamedTuple):
    """Two recordings of one motion, the earlier one first."""

    first: Recording
    second: Recording
    over_s: float | None  # As in ``Drift``
    time_s: np.ndarray  # (M,) times in ``first`` [s]
    difference: (
        np.ndarray
    )  # (M,) second − first in channel 0, in its unit; NaN: unknown


def drifts(
    problem: Problem,
    repeats: Iterable[Repeat],
    names: Sequence[str],
    start: dict[str, float],
) -> list[Drift]:
    """Numbers that changed between recordings, one for each of ``repeats`` whose difference
    one number explains. ``names``: effects whose numbers are tried beside those that are
    always fitted. ``start``: start values of the fit to both recordings."""
    found = [_drift(problem, repeat, names, start) for repeat in repeats]
    return [drift for drift in found if drift is not None]


def changed(
    problem: Problem,
    first: Recording,
    second: Recording,
    over_s: float | None,
    names: Sequence[str],
    start: Mapping[str, float],
) -> Drift | None:
    """The number whose own value in each of two recordings does nearly as much as fits of all
    numbers to each of them, if a fit to both together leaves ``LEAST`` floors more; for
    channels that no motion aligns row by row. Arguments as of ``drifts``."""
    pair = (first, second)
    together = fit(problem, pair, names, start)
    alone = [fit(problem, [one], names, together.values) for one in pair]
    least = sum(float(np.sum(own.residuals**2)) for own in alone)
    excess = float(np.sum(together.residuals**2)) - least
    if excess < LEAST**2 * len(together.residuals):
        return None
    left: dict[str, float] = {}
    ends: dict[str, list[Fit]] = {}
    for name in (f.name for f in together.frees if f.name not in NO_DRIFT):
        others = {k: v for k, v in together.values.items() if k != name}
        rest = with_held(problem, others)
        ends[name] = [fit(rest, [one], names, together.values) for one in pair]
        squares = sum(float(np.sum(own.residuals**2)) for own in ends[name])
        left[name] = (squares - least) / excess
    name = min(left, key=lambda n: left[n])
    if left[name] > 1.0 - EXPLAINED:
        return None
    return _named(name, ends[name], pair, over_s, left)


def _named(
    name: str,
    ends: Sequence[Fit],
    pair: tuple[Recording, Recording],
    over_s: float | None,
    left: Mapping[str, float],
) -> Drift:
    before, after = (own.values[name] for own in ends)
    intervals = [own.intervals().get(name, (math.nan, math.nan)) for own in ends]
    least = AS_GOOD * max(left[name], 1e-9)
    return Drift(
        number=name,
        unit=next(f.unit for f in ends[0].frees if f.name == name),
        before=before,
        after=after,
        before_interval=intervals[0],
        after_interval=intervals[1],
        first=pair[0].name,
        second=pair[1].name,
        over_s=over_s,
        share=1.0 - left[name],
        as_good=tuple(n for n in left if n != name and left[n] < least),
    )


def _drift(
    problem: Problem, repeat: Repeat, names: Sequence[str], start: dict[str, float]
) -> Drift | None:
    is_known = np.isfinite(repeat.difference)
    if not is_known.any():
        return None
    middle = fit(problem, [repeat.first, repeat.second], names, start)
    total = float(np.sum(repeat.difference[is_known] ** 2))
    left = {
        free.name: _left_by_change(problem, middle, free, repeat) / total
        for free in middle.frees
        if free.name not in NO_DRIFT
    }
    if not left:
        return None
    name = min(left, key=lambda n: left[n])
    late = _left_by_shift(repeat) / total
    if left[name] > min(1.0 - EXPLAINED, late / AS_GOOD):
        return None
    alone = [
        fit(problem, [recording], names, middle.values)
        for recording in (repeat.first, repeat.second)
    ]
    return _named(name, alone, (repeat.first, repeat.second), repeat.over_s, left)


def _left_by_change(problem: Problem, middle: Fit, free: Free, repeat: Repeat) -> float:
    """Squares that the best change of one number leaves of the difference."""
    value = middle.values[free.name]
    most = 2.0 * min(value - free.low, free.high - value)
    tiny = min(0.02 * max(abs(value), 1e-3 * (free.high - free.low)), 0.5 * most)
    is_known = np.isfinite(repeat.difference)
    wanted = repeat.difference[is_known]

    def effect_of(by: float) -> np.ndarray:
        ends = [_with(problem, middle, free.name, value + s * by) for s in (0.5, -0.5)]
        high, low = problem.simulate_all(ends, [repeat.first])[0]
        apart = high[:, 0] - low[:, 0]
        return np.interp(repeat.time_s, repeat.first.time_s, apart)[is_known]

    least = float(np.sum(wanted**2))
    if most <= 0.0:
        return least
    by, here, there = 0.0, np.zeros_like(wanted), effect_of(tiny)
    slope = there / tiny
    for _ in range(STEPS):
        power = float(slope @ slope)
        if not (power > 0.0 and math.isfinite(power)):
            break
        by = float(np.clip(by + slope @ (wanted - here) / power, -most, most))
        here = effect_of(by)
        remains = float(np.sum((wanted - here) ** 2))
        if not remains < 0.999 * least:
            break
        least = remains
        slope = here / by if by else slope
    return least


def _with(problem: Problem, middle: Fit, name: str, value: float) -> Case:
    """A case of ``simulate_all``: the fit's numbers, one of them with another value."""
    values = {**middle.values, name: value}
    return values, [c.make(values) for c in chosen(problem, middle.names)]


def _left_by_shift(repeat: Repeat) -> float:
    """Squares that a shift of the second recording's clock leaves of the difference."""
    speed = np.gradient(repeat.first.measured[:, 0], repeat.first.time_s)
    there = np.isfinite(speed)
    if not there.any():
        return math.inf
    speed = np.interp(repeat.time_s, repeat.first.time_s[there], speed[there])
    is_known = np.isfinite(repeat.difference)
    speed, wanted = speed[is_known], repeat.difference[is_known]
    share = float(speed @ wanted) / max(float(speed @ speed), 1e-300)
    return float(np.sum((wanted - share * speed) ** 2))


def _duration(time_s: float) -> str:
    return f"{time_s:.3g} s" if time_s < 120.0 else f"{time_s / 60.0:.3g} min"
