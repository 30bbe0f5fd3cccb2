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

The score is T-optimal, as in ``plan``: readings of one rival are simulated on the new press and on the existing ones, and
the other rival, with all of its numbers and each cell's gain and offset, is fitted to them; what remains on the new press, in
noise floors, separates the two. Loads and their speed stay within those of existing recordings, or those that the user states.

Letters in shapes: T rows, K cells.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.machines.cell_model import (
    Calibration,
    calibrated,
    readings,
    responses,
)
from taccorl.alignment.machines.cell_places import with_places
from taccorl.alignment.machines.cell_tables import CellMeasurement, cells_of
from taccorl.alignment.machines.cells_file import LOADS, CellsConfig
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.presses import Knots, in_turn
from taccorl.data.origin import Origin
from taccorl.diagnosis.experiment_design.plan import Explanation, Part, Planned, Scene
from taccorl.diagnosis.machines.cells import CellsMachine
from taccorl.diagnosis.problems.cells_problem import CellsProblem, prepared_all
from taccorl.diagnosis.search.problem import Problem, Recording
from taccorl.errors import TaccorlError
from taccorl.sim.effects.effect import Effect

REST_S = 3.0
"""Time without load before and after each press [s]."""
SPEED_S = 0.05
"""The speed of existing recordings is the largest change of a load in this time [s]: noise of the load cell is no speed."""


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
        steps_s = np.maximum(
            np.diff(knots[:, 0]), highest * np.abs(np.diff(knots[:, 1])) / speed
        )
        times_s = np.concatenate([[0.0], np.cumsum(steps_s)])
        return np.interp(
            np.arange(round(times_s[-1] * rate_hz) + 1) / rate_hz,
            times_s,
            highest * knots[:, 1],
        )


def _presses(*each: tuple[float, float, float], rest_s: float = REST_S) -> Knots:
    """Presses one after the other: (share of the highest load, seconds of loading and unloading, seconds of hold)."""
    return in_turn(*each, rest_s=rest_s, before_s=rest_s)


_THREE = ((1 / 3, 0.05, 3.0), (2 / 3, 0.05, 3.0), (1.0, 0.05, 3.0))
LIBRARY = (
    LoadProfile(name="three_loads", knots=_presses(*_THREE)),
    LoadProfile(name="slow_ramp", knots=_presses((1.0, 10.0, 0.5))),
    LoadProfile(
        name="loops",
        knots=(
            *(
                (0.0, 0.0),
                (REST_S, 0.0),
                (7.0, 0.6),
                (9.0, 0.3),
                (11.0, 0.8),
                (13.0, 0.5),
                (15.0, 1.0),
            ),
            *((17.0, 0.4), (19.0, 0.7), (23.0, 0.0), (23.0 + REST_S, 0.0)),
        ),
    ),
    LoadProfile(name="two_speeds", knots=_presses((0.7, 0.05, 3.0), (0.7, 4.0, 3.0))),
    LoadProfile(name="taps", knots=_presses(*((0.5, 0.05, 0.1),) * 12, rest_s=0.5)),
    LoadProfile(name="long_hold", knots=(*_presses((0.7, 0.05, 30.0)), (60.0, 0.0))),
    LoadProfile(
        name="light",
        knots=_presses(*((share, 0.5, 1.0) for share in (0.02, 0.05, 0.1, 0.2))),
    ),
    LoadProfile(name="rests", knots=_presses((0.5, 0.5, 2.0), rest_s=30.0)),
    LoadProfile(name="one_cell", knots=_presses(*_THREE), one_cell=True),
)


@dataclass(frozen=True, kw_only=True)
class LoadRange:
    """Loads that may be applied."""

    highest: float
    """Highest load, in the unit of the cells file."""
    speed: float
    """Largest change of the load in a second."""


def load_range(
    config: CellsConfig,
    measurements: Measurements,
    *,
    span: Sequence[float] = (),
    speed: float | None = None,
) -> LoadRange:
    """Highest load and speed of planned presses: those of existing recordings, if they are not given.

    Args:
        span: 0 and the highest load, in the unit of the cells file.
        speed: largest change of the load in a second.

    Raises TaccorlError: the load is beyond the rated one, or the span does not begin at 0."""
    unit, rated = config.load.unit, config.load.rated
    cells = cells_of(measurements.all)
    if span and (len(span) != 2 or span[0] != 0 or not 0 < span[1] <= rated):
        raise TaccorlError(
            f"--span={list(span)}: a press begins without load and ends at most at the rated {rated:g} {unit}: "
            f"--span=[0, {rated:g}]"
        )
    if speed is not None and not speed > 0:
        raise TaccorlError(f"--speed={speed:g}: above 0, in {unit}/s")
    highest = (
        float(span[1])
        if span
        else min(max(float(np.nanmax(m.target)) for m in cells), rated)
    )
    if speed is None:
        speed = 0.0
        for m in cells:
            rows = min(max(round(SPEED_S * m.rate_hz), 1), m.num_rows - 1)
            change = np.abs(m.target[rows:] - m.target[:-rows])
            speed = max(speed, float(np.nanmax(change)) * m.rate_hz / rows)
    if not (highest > 0 and speed > 0):
        raise TaccorlError(
            f"{config.name}: no recording loads it; give --span=[0, {rated:g}] and --speed= in {unit}/s"
        )
    return LoadRange(highest=highest, speed=speed)


class CellsPart(Part):
    """A sensor of cells; loads have the names and units of its recordings.

    Args:
        measurements: existing recordings; the fit recordings are part of every fit, and state rate, noise floor, gain and offset.
        allowed: loads that may be applied.

    Raises TaccorlError: no fit recording loads it."""

    def __init__(
        self, config: CellsConfig, measurements: Measurements, allowed: LoadRange
    ) -> None:
        measurements = with_places(config, measurements)
        self.machine, self.name, self.config, self._allowed = (
            CellsMachine(config),
            config.name,
            config,
            allowed,
        )
        self.problem, self._known = (
            CellsProblem(config, measurements),
            prepared_all(config, measurements.fit),
        )
        self.library = [p for p in LIBRARY if not (p.one_cell and config.load.shared)]
        like = self._known[0]
        self.rate_hz = like.rate_hz
        self.floor = float(np.median(self.problem.fit[0].floor))
        self.place_mm = _longest_mm(like) if like.place.size else None
        """Position (x, y) of the probe [mm], of a sensor with places; else None."""

    def offer(self, item: LoadProfile, suspected: Mapping[str, Explanation]) -> Planned:
        new, sensor = self._applied(item), self.config
        column, factor = LOADS[sensor.load.unit]
        columns = {column: factor * new.target[:, 0]}
        if not sensor.load.shared:
            columns = {
                f"{cell}.{column}": factor * new.target[:, k]
                for k, cell in enumerate(sensor.names)
            }
        if self.place_mm is not None:
            columns |= {
                key: np.full(new.num_rows, mm)
                for key, mm in zip(("x_mm", "y_mm"), self.place_mm, strict=True)
            }
        return Planned(
            part=self,
            item=item,
            columns=columns,
            peak=float(new.target.max()),
            made=new,
        )

    def scene(self, p: Planned) -> Scene:
        return LoadScene(self.config, self.problem, [*self._known, p.made])

    def _applied(self, profile: LoadProfile) -> CellMeasurement:
        """A measurement with the load of ``profile``, not yet answered. One cell: the middle one of those that recordings load.
        With places it is the place that the first recording presses longest."""
        like = self._known[0]
        load = profile.load(self._allowed.highest, self._allowed.speed, like.rate_hz)
        target = np.repeat(load[:, None], like.target.shape[1], axis=1)
        if profile.one_cell:
            middle = self.problem.channels[len(self.problem.channels) // 2]
            target[:, np.arange(target.shape[1]) != middle] = 0.0
        temperature_c = (
            np.full(len(load), np.nanmedian(like.temperature_c))
            if like.temperature_c.size
            else np.empty(0)
        )
        return CellMeasurement(
            name=profile.name,
            time_s=np.arange(len(load)) / like.rate_hz,
            target=target,
            measured=np.zeros_like(target),
            signals=like.signals,
            units=like.units,
            quantum=like.quantum,
            temperature_c=temperature_c,
            place=np.full(len(load), _longest(like)) if like.place.size else like.place,
            num_places=like.num_places,
            origin=Origin("twin", "imagined: the model's own answer"),
        )


class LoadScene(Scene):
    """A press that could be made, after existing ones: readings with the gain and offset that fit those, and a problem that fits
    its own."""

    problem: CellsProblem

    def __init__(
        self,
        config: CellsConfig,
        problem: CellsProblem,
        measurements: Sequence[CellMeasurement],
    ) -> None:
        super().__init__(problem, [])
        self.config, self._measurements = config, measurements

    def said(
        self, truth: Explanation, other: Explanation, effects: Sequence[Effect]
    ) -> tuple[Problem, Sequence[Recording]]:
        plain, every = self.problem.config, self._measurements
        answers = [responses(plain, m, effects) for m in every]
        pairs = [(r, m.measured) for r, m in zip(answers[:-1], every[:-1], strict=True)]
        calibration: Calibration = calibrated(plain, pairs)
        said = [
            dataclasses.replace(m, measured=readings(plain, r, calibration))
            for m, r in zip(every, answers, strict=True)
        ]
        # With a validation recording, gain and offset are those that fit all rows.
        again = CellsProblem(self.config, Measurements(tuple(said), (said[-1],), ()))
        return again, [
            dataclasses.replace(r, floor=self.problem.floor[again.channels])
            for r in again.fit
        ]


def _longest(m: CellMeasurement) -> int:
    """The place that ``m`` presses longest."""
    return int(np.bincount(m.place[m.place >= 0]).argmax())


def _longest_mm(m: CellMeasurement) -> tuple[float, float]:
    x, y = np.median(m.position_mm[m.place == _longest(m)], axis=0)
    return float(x), float(y)
