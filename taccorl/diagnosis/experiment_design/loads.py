"""Choose the load to apply next to a sensor of cells: a library of presses, scored by how well each separates rival effects.

    three_loads    fast presses to a third, two thirds and all of the range, 3 s each: gain, law
    slow_ramp      up and down in 10 s each: law of the reading over the load, saturation
    loops          a slow ramp with smaller loops on the way: hysteresis
    two_speeds     the same load fast and in 4 s: lag against creep
    taps           a dozen of 0.1 s: delay, lag
    long_hold      30 s, and 20 s without load: creep
    light          presses to 2 … 20 % of the range: thresholds
    rests          30 s without load before and after one press: a drifting zero
    one_cell       three loads on one cell alone: crosstalk (only where each cell has a load of its own)

The score is T-optimal, as in ``excitation``: readings of one rival are simulated on the new press and on the existing ones, and
the other rival, with all of its numbers and each cell's gain and offset, is fitted to them; what remains on the new press, in
noise floors, separates the two. Loads and their speed stay within those of existing recordings, or those that the user states.

Letters in shapes: T rows, K cells.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.machines.cell_model import Calibration, calibrated, readings, responses
from taccorl.alignment.machines.cell_places import with_places
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.alignment.measurements.folder import Measurements
from taccorl.data.origin import Origin
from taccorl.diagnosis.experiment_design.excitation import (
    STEPS,
    Explanation,
    Plan,
    Planned,
    best_first,
    check_rivals,
    explanations,
)
from taccorl.diagnosis.problems.cells_problem import CellsProblem, prepared_all
from taccorl.diagnosis.search.fit import fit, rms, stacked
from taccorl.diagnosis.search.problem import Values
from taccorl.errors import TaccorlError
from taccorl.sim.effects.effect import Effect

REST_S = 3.0
"""Time without load before and after each press [s]."""
SPEED_S = 0.05
"""The speed of existing recordings is the largest change of a load in this time [s]: noise of the load cell is no speed."""

Knots = tuple[tuple[float, float], ...]
"""(time [s], share of the highest load), connected by straight lines."""


@dataclass(frozen=True, kw_only=True)
class LoadProfile:
    """A load over time that could be applied."""

    name: str
    knots: Knots
    """Corners: (time [s], share of the highest load), connected by straight lines; ``load`` makes fast ramps longer."""
    one_cell: bool = False
    """True: only one cell is loaded. False: all are, with the same load."""

    def load(self, highest: float, speed: float, rate_hz: float) -> np.ndarray:
        """(T,) load in the unit of ``highest`` at ``rate_hz``.

        Args:
            highest: load of share 1.
            speed: largest change of the load in a second.
        """
        knots = np.array(self.knots)
        steps_s = np.maximum(np.diff(knots[:, 0]), highest * np.abs(np.diff(knots[:, 1])) / speed)
        times_s = np.concatenate([[0.0], np.cumsum(steps_s)])
        return np.interp(np.arange(round(times_s[-1] * rate_hz) + 1) / rate_hz, times_s, highest * knots[:, 1])


def _presses(*each: tuple[float, float, float], rest_s: float = REST_S) -> Knots:
    """Presses one after the other: (share of the highest load, seconds of loading and unloading, seconds of hold)."""
    now, knots = rest_s, [(0.0, 0.0), (rest_s, 0.0)]
    for share, ramp_s, hold_s in each:
        for duration_s, end in ((ramp_s, share), (hold_s, share), (ramp_s, 0.0), (rest_s, 0.0)):
            now += duration_s
            knots.append((now, end))
    return tuple(knots)


_THREE = ((1 / 3, 0.05, 3.0), (2 / 3, 0.05, 3.0), (1.0, 0.05, 3.0))
LIBRARY = (
    LoadProfile(name="three_loads", knots=_presses(*_THREE)),
    LoadProfile(name="slow_ramp", knots=_presses((1.0, 10.0, 0.5))),
    LoadProfile(
        name="loops",
        knots=(
            *((0.0, 0.0), (REST_S, 0.0), (7.0, 0.6), (9.0, 0.3), (11.0, 0.8), (13.0, 0.5), (15.0, 1.0)),
            *((17.0, 0.4), (19.0, 0.7), (23.0, 0.0), (23.0 + REST_S, 0.0)),
        ),
    ),
    LoadProfile(name="two_speeds", knots=_presses((0.7, 0.05, 3.0), (0.7, 4.0, 3.0))),
    LoadProfile(name="taps", knots=_presses(*((0.5, 0.05, 0.1),) * 12, rest_s=0.5)),
    LoadProfile(name="long_hold", knots=(*_presses((0.7, 0.05, 30.0)), (60.0, 0.0))),
    LoadProfile(name="light", knots=_presses(*((share, 0.5, 1.0) for share in (0.02, 0.05, 0.1, 0.2)))),
    LoadProfile(name="rests", knots=_presses((0.5, 0.5, 2.0), rest_s=30.0)),
    LoadProfile(name="one_cell", knots=_presses(*_THREE), one_cell=True),
)


@dataclass(frozen=True, kw_only=True)
class PlannedLoad(Planned):
    """A press of a sensor of cells that could be recorded."""

    profile: LoadProfile
    """The press of the library."""
    load: np.ndarray
    """(T, K) load of each cell in the unit of the cells file."""
    rate_hz: float
    """Rows of ``load`` per second: that of existing recordings, at most about 200."""
    place_mm: tuple[float, float] | None = None
    """Position (x, y) of the probe [mm], of a sensor with places; else None."""

    @property
    def duration_s(self) -> float:
        """Time from the first to the last row [s]."""
        return (len(self.load) - 1) / self.rate_hz


@dataclass(frozen=True, kw_only=True)
class LoadRange:
    """Loads that may be applied."""

    highest: float
    """Highest load, in the unit of the cells file."""
    speed: float
    """Largest change of the load in a second."""


def load_range(
    config: CellsConfig, measurements: Measurements, *, span: Sequence[float] = (), speed: float | None = None
) -> LoadRange:
    """Highest load and speed of planned presses: those of existing recordings, if they are not given.

    Args:
        span: 0 and the highest load, in the unit of the cells file.
        speed: largest change of the load in a second.

    Raises:
        TaccorlError: the load is beyond the rated one, or the span does not begin at 0.
    """
    unit, rated = config.load.unit, config.load.rated
    seen = [m.target for m in _cells(measurements)]
    if span and (len(span) != 2 or span[0] != 0 or not 0 < span[1] <= rated):
        raise TaccorlError(
            f"--span={list(span)}: a press begins without load and ends at most at the rated {rated:g} {unit}: "
            f"--span=[0, {rated:g}]"
        )
    if speed is not None and not speed > 0:
        raise TaccorlError(f"--speed={speed:g}: above 0, in {unit}/s")
    highest = float(span[1]) if span else min(max(float(np.nanmax(x)) for x in seen), rated)
    if speed is None:
        speed = 0.0
        for m in _cells(measurements):
            rows = min(max(round(SPEED_S * m.rate_hz), 1), m.num_rows - 1)
            change = np.abs(m.target[rows:] - m.target[:-rows])
            speed = max(speed, float(np.nanmax(change)) * m.rate_hz / rows)
    if not (highest > 0 and speed > 0):
        raise TaccorlError(f"{config.name}: no recording loads it; give --span=[0, {rated:g}] and --speed= in {unit}/s")
    return LoadRange(highest=highest, speed=speed)


def plan_loads(
    config: CellsConfig,
    rivals: Sequence[str],
    measurements: Measurements,
    allowed: LoadRange,
    *,
    fitted: Mapping[str, Values] | None = None,
    done: Callable[[str], None] = lambda _: None,
) -> Plan[PlannedLoad]:
    """Score every press of the library by how far apart it keeps the rivals, best first.

    Args:
        rivals: effects to separate, two or more.
        measurements: existing recordings; the fit recordings are part of every fit, and state rate, noise floor, gain and offset.
        fitted: effect → all numbers of the sensor with it, if it was fitted; otherwise typical values are used.
        done: function that is called with the name of each press that was scored.

    Raises:
        TaccorlError: there are fewer than two rivals, one cannot act on the sensor, or no fit recording loads it.
    """
    check_rivals(rivals)
    measurements = with_places(config, measurements)
    problem = CellsProblem(config, measurements)
    known = prepared_all(config, measurements.fit)
    present = [problem.candidates[name].make(problem.start) for name in problem.present]
    at = _longest_mm(known[0]) if known[0].place.size else None
    told = explanations(problem, rivals, problem.start, fitted or {})
    planned = []
    for profile in LIBRARY:
        if not (profile.one_cell and config.load.shared):
            new = _applied(known[0], profile, allowed, problem)

            def left(truth: str, other: str, new: CellMeasurement = new) -> float:
                return _left(config, problem, [*known, new], present, told[truth], told[other])

            ways = {f"{a} | {b}": (left(a, b), left(b, a)) for a, b in itertools.combinations(rivals, 2)}
            planned.append(
                PlannedLoad(profile=profile, load=new.target, rate_hz=known[0].rate_hz, ways=ways, place_mm=at)
            )
        done(profile.name)
    floor = float(np.median(problem.fit[0].floor))
    return Plan(part=config.name, rivals=tuple(rivals), floor=floor, planned=best_first(planned), refused={})


def _applied(like: CellMeasurement, profile: LoadProfile, allowed: LoadRange, problem: CellsProblem) -> CellMeasurement:
    """A measurement with the load of ``profile``, not yet answered. One cell: the middle one of those that recordings load.
    With places it is the place that ``like`` presses longest."""
    load = profile.load(allowed.highest, allowed.speed, like.rate_hz)
    target = np.repeat(load[:, None], like.target.shape[1], axis=1)
    if profile.one_cell:
        middle = problem.channels[len(problem.channels) // 2]
        target[:, np.arange(target.shape[1]) != middle] = 0.0
    temperature_c = np.full(len(load), np.nanmedian(like.temperature_c)) if like.temperature_c.size else np.empty(0)
    place = np.full(len(load), _longest(like)) if like.place.size else like.place
    return CellMeasurement(
        name=profile.name,
        time_s=np.arange(len(load)) / like.rate_hz,
        target=target,
        measured=np.zeros_like(target),
        signals=like.signals,
        units=like.units,
        quantum=like.quantum,
        temperature_c=temperature_c,
        place=place,
        num_places=like.num_places,
        origin=Origin("twin", "imagined: the model's own answer"),
    )


def _longest(m: CellMeasurement) -> int:
    """The place that ``m`` presses longest."""
    return int(np.bincount(m.place[m.place >= 0]).argmax())


def _longest_mm(m: CellMeasurement) -> tuple[float, float]:
    x, y = np.median(m.position_mm[m.place == _longest(m)], axis=0)
    return float(x), float(y)


def _left(
    config: CellsConfig,
    problem: CellsProblem,
    recordings: Sequence[CellMeasurement],
    present: Sequence[Effect],
    truth: Explanation,
    other: Explanation,
) -> float:
    """Residual RMS [noise floors] on the last recording after fitting ``other`` to readings simulated with ``truth``."""
    effects = [*present, truth.effect]
    plain = problem.config
    answers = [responses(plain, m, effects) for m in recordings]
    calibration: Calibration = calibrated(
        plain, [(r, m.measured) for r, m in zip(answers[:-1], recordings[:-1], strict=True)]
    )
    said = [
        dataclasses.replace(m, measured=readings(plain, r, calibration))
        for m, r in zip(recordings, answers, strict=True)
    ]
    # With a validation recording, gain and offset are those that fit all rows.
    again = CellsProblem(config, Measurements(tuple(said), (said[-1],), ()))
    judged = [dataclasses.replace(r, floor=problem.floor[again.channels]) for r in again.fit]
    names = (*(e.name for e in present), other.effect.name)
    model = fit(again, judged, names, other.values, STEPS)
    return rms(stacked(again, model.values, model.effects, judged[-1:]))


def _cells(measurements: Measurements) -> list[CellMeasurement]:
    return [m for m in measurements.all if isinstance(m, CellMeasurement)]
