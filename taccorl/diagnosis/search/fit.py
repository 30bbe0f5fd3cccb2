"""Fit all numbers of a hypothesis to recordings: residuals in noise floors, bounded least squares, several starts.

A hypothesis is a list of effects; its numbers are those that are always fitted and those of its effects, all at once.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from taccorl.alignment.least_squares import (
    COARSE,
    FAR,
    FINE,
    TIGHT,
    WIDE,
    Solution,
    inverse_of,
    minimise,
)
from taccorl.alignment.least_squares import rms as rms
from taccorl.alignment.measurements.correlation import Rows, rate_of
from taccorl.diagnosis.search.problem import (
    Case,
    Free,
    Problem,
    Recording,
    Values,
    chosen,
)
from taccorl.sim.effects.effect import Effect

_SCALE_ROUNDS, _SAME_SCALE = 8, 1.5
"""``over_own_scale`` repeats its differences until no half width changes by more than the factor ``_SAME_SCALE``, at most
``_SCALE_ROUNDS`` times."""
_ASIDE = tuple(side * step for side in (-1.0, 1.0) for step in (0.01, 0.03, 0.1, 0.3))
_DENTS, _DEEPER = 4, 0.998
"""``out_of_dents`` goes on at most ``_DENTS`` times, each time to at most ``_DEEPER`` times the error."""
DECADES = 100.0
"""Ratio of the ends of a range from which on it is no tolerance. A choice."""


@dataclass(frozen=True, kw_only=True)
class Fit(Solution):
    """Result of one fit: fitted values of all numbers of a hypothesis, with residuals and their derivatives."""

    names: tuple[str, ...]
    effects: tuple[Effect, ...]
    """The effects with fitted parameters."""

    @property
    def at_an_end(self) -> tuple[Free, ...]:
        """Fitted numbers that ended at a limit of their range, except those whose start value was that same limit."""

        def end(f: Free) -> float:
            return min(
                (f.low, f.high),
                key=lambda end: abs(
                    f.coordinate(self.values[f.name]) - f.coordinate(end)
                ),
            )

        return tuple(
            f for f in self.frees if f.name in self.at_bound and f.start != end(f)
        )

    @property
    def fled(self) -> tuple[Free, ...]:
        """Always fitted numbers at an end of a range of decades, such as a mass that went to nothing. The end of a tolerance, as
        of a delay or a stated gain, says no more than that another number makes up for it."""
        return tuple(
            f
            for f in self.at_an_end
            if "." not in f.name and f.log and f.high >= DECADES * f.low
        )

    @property
    def ended(self) -> tuple[Free, ...]:
        """Numbers that the recordings drove to an end of their range: of ``at_an_end``, whose interval is not all of it."""
        at = self.at_an_end
        ends = self.intervals() if at else {}
        return tuple(
            f for f in at if ends[f.name][0] > f.low or ends[f.name][1] < f.high
        )


def over_own_scale(
    problem: Problem, model: Fit, fitted_to: Sequence[Recording]
) -> tuple[Fit, np.ndarray]:
    """``model`` with central differences over the range in which its intervals are sought, in place of its derivatives, and the
    (p,) half widths of that range, from ``FINE`` to ``WIDE``.

    A number's range is where the squared error rises by as much as its interval allows while the other numbers stay. Where a
    response jumps, as where a link bounces in its play, a difference h over less than that range has a slope of jump / h, and an
    interval is too narrow: the range is widened until it fits its own slope. Smooth responses keep their derivatives.

    Args:
        fitted_to: recordings of ``model``.
    """
    steps = np.full(len(model.frees), FINE)
    for _ in range(_SCALE_ROUNDS):
        squares = model.jacobian.T @ model.jacobian
        wider = np.diag(model.covariance()) / np.diag(inverse_of(squares))
        before, steps = (
            steps,
            np.clip(np.sqrt(wider / np.maximum(np.diag(squares), 1e-300)), FINE, WIDE),
        )
        if np.abs(np.log(steps / before)).max() < np.log(_SAME_SCALE):
            break
        model = dataclasses.replace(
            model, jacobian=_secants(problem, model, fitted_to, fitted_to, steps)
        )
    return model, steps


def _secants(
    problem: Problem,
    model: Fit,
    fitted_to: Sequence[Recording],
    recordings: Sequence[Recording],
    steps: np.ndarray,
) -> np.ndarray:
    """(n, p) central differences of the residuals of ``recordings`` by the coordinates of ``model.frees``, over ``steps`` (p,) to
    both sides, less at a bound. ``fitted_to``: recordings of ``model``, which determine prepared numbers such as maps."""
    middle = np.array([f.coordinate(model.values[f.name]) for f in model.frees])
    candidates = chosen(problem, model.names)

    def case(k: int, to: float) -> Case:
        there = middle.copy()
        there[k] = to
        values = model.values | {
            f.name: f.value(c) for f, c in zip(model.frees, there, strict=True)
        }
        return values, problem.prepare(
            values, [c.make(values) for c in candidates], fitted_to
        )

    below = np.maximum(middle - steps, [f.coordinate(f.low) for f in model.frees])
    above = np.minimum(middle + steps, [f.coordinate(f.high) for f in model.frees])
    ends = [case(k, to) for side in (below, above) for k, to in enumerate(side)]
    low, high = np.split(stacked_all(problem, ends, recordings), 2)
    return ((high - low) / (above - below)[:, None]).T


def moved_by(
    problem: Problem,
    model: Fit,
    fitted_to: Sequence[Recording],
    others: Sequence[Recording],
    steps: np.ndarray,
) -> np.ndarray:
    """(p,) Gauss–Newton step from ``model`` to the fit of all recordings, those of ``fitted_to`` and ``others``, 0 for numbers at
    their bound, with ``_moved_by_noise`` as the root of the sum of squares. ``steps``: (p,) half widths of the differences."""
    columns = _secants(problem, model, fitted_to, others, steps)
    inside = np.array([f.name not in model.at_bound for f in model.frees])
    together = (model.jacobian.T @ model.jacobian + columns.T @ columns)[
        np.ix_(inside, inside)
    ]
    here = stacked(problem, model.values, model.effects, others)
    moved = np.zeros(len(inside))
    moved[inside] = -inverse_of(together) @ (columns.T @ here)[inside]
    return np.hypot(moved, _moved_by_noise(problem, model, fitted_to))


def _moved_by_noise(
    problem: Problem, model: Fit, fitted_to: Sequence[Recording]
) -> np.ndarray:
    """(p,) standard deviation of the coordinates because a response passes on peaks of its inputs' noise, as play does: half of
    the bias, by how another noise as large moves them (simulation extrapolation, Cook and Stefanski 1994), if it grows as the
    standard deviation of the noise does."""
    more = [problem.noisier(r) for r in fitted_to]
    if all(one is r for one, r in zip(more, fitted_to, strict=True)):
        return np.zeros(len(model.frees))
    moved = model.jacobian.T @ (
        stacked(problem, model.values, model.effects, more) - model.residuals
    )
    return (
        0.5
        / (np.sqrt(2.0) - 1.0)
        * inverse_of(model.jacobian.T @ model.jacobian)
        @ moved
    )


def residuals(
    problem: Problem,
    base: Mapping[str, float],
    effects: Sequence[Effect],
    recording: Recording,
) -> np.ndarray:
    """(T, C) simulation − measurement [floors] of one recording; NaN where not measured. ``base``: always fitted numbers."""
    left = np.full(recording.measured.shape, np.nan)
    left.flat[_entries(recording).measured] = stacked(
        problem, base, effects, [recording]
    )
    return left


def stacked(
    problem: Problem,
    base: Mapping[str, float],
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
) -> np.ndarray:
    """(n,) residuals of all recordings [floors], one after another, without entries that were not measured. ``base``: always
    fitted numbers."""
    return stacked_all(problem, [(base, effects)], recordings)[0]


def stacked_all(
    problem: Problem, cases: Sequence[Case], recordings: Sequence[Recording]
) -> np.ndarray:
    """(N, n) ``stacked`` with each of N ``cases``."""
    columns = []
    for recording, found in zip(
        recordings, problem.simulate_all(cases, recordings), strict=True
    ):
        measured, values, floors = _entries(recording)
        left = np.array(found).reshape(len(cases), -1).take(measured, axis=1)
        left -= values
        left /= floors
        left[~np.isfinite(left)] = FAR
        columns.append(np.clip(left, -FAR, FAR, out=left))
    return np.concatenate(columns, axis=1)


class _Entries(NamedTuple):
    """The n measured entries of a recording: places among the rows and channels (n,), values (n,) and noise floors (n,)."""

    measured: np.ndarray
    values: np.ndarray
    floors: np.ndarray


@lru_cache(maxsize=64)
def _entries(recording: Recording) -> _Entries:
    measured = np.isfinite(recording.measured)
    floors = np.broadcast_to(recording.floor * recording.share, measured.shape)
    return _Entries(
        np.flatnonzero(measured), recording.measured[measured], floors[measured]
    )


def layout_of(recordings: Sequence[Recording]) -> tuple[Rows, ...]:
    """Rows and channels of each recording in the stacked residuals."""
    return tuple(
        Rows(np.isfinite(r.measured), rate_of(r.time_s), r.short_noise)
        for r in recordings
    )


def fit(
    problem: Problem,
    recordings: Sequence[Recording],
    names: Sequence[str],
    start: Mapping[str, float],
    most: int = 40,
    step: float = COARSE,
    tolerance: float = TIGHT,
) -> Fit:
    """Fit all numbers of a hypothesis together, but for those that are held.

    Args:
        names: effects of the hypothesis.
        start: start values; numbers that are left out start at their defaults.
        most: most steps of the solver.
        step: step of its finite differences.
        tolerance: relative fall of the squared residuals below which a fit ends.
    """
    candidates = chosen(problem, names)
    every = (*problem.base, *(f for c in candidates for f in c.frees))
    absent = [f.name for f in every if f.optional and start.get(f.name, f.start) <= 0.0]
    held = {
        f.name: f.start for f in every if f.held or {*f.unless} & {*names}
    } | dict.fromkeys(absent, 0.0)
    frees = tuple(f for f in every if f.name not in held)

    def case(values: Values) -> Case:
        values = held | values
        return values, problem.prepare(
            values, [c.make(values) for c in candidates], recordings
        )

    found = minimise(
        lambda points: stacked_all(problem, [case(v) for v in points], recordings),
        frees,
        start,
        layout_of(recordings),
        at_once=problem.at_once,
        most=most,
        step=step,
        tolerance=tolerance,
    )
    values, effects = case(found.values)
    return Fit(
        names=tuple(names),
        values=dict(values),
        residuals=found.residuals,
        layout=found.layout,
        jacobian=found.jacobian,
        frees=frees,
        at_bound=found.at_bound,
        trouble=found.trouble,
        effects=tuple(effects),
    )


def out_of_dents(
    problem: Problem,
    model: Fit,
    recordings: Sequence[Recording],
    most: int,
    step: float = COARSE,
) -> Fit:
    """``model``, or fits (``fit``) from the best of points beside it, as long as they leave less.

    Where a link bounces in its play, sticks or is limited, the error has dents in which the solver stops, a fifth of the play off
    the truth. One coordinate at a time is moved by ``_ASIDE``; the others stay, or follow as the derivatives have it, such as a
    spring beside its play. ``recordings``: those of ``model``."""
    own = [
        k for k, f in enumerate(model.frees) if any("." in f.name for f in model.frees)
    ]
    candidates = chosen(problem, model.names)
    for _ in range(_DENTS if own else 0):
        here = np.array([f.coordinate(model.values[f.name]) for f in model.frees])
        inverse, alone = (
            inverse_of(model.jacobian.T @ model.jacobian),
            np.eye(len(here)),
        )
        ways = [way for k in own for way in (alone[k], inverse[k] / inverse[k, k])]
        points = [here + aside * way for way in ways for aside in _ASIDE]
        beside = [
            model.values
            | {f.name: f.value(c) for f, c in zip(model.frees, point, strict=True)}
            for point in points
        ]
        cases = [
            (v, problem.prepare(v, [c.make(v) for c in candidates], recordings))
            for v in beside
        ]
        errors = np.mean(np.square(stacked_all(problem, cases, recordings)), axis=1)
        if errors.min() > (_DEEPER * model.error) ** 2:
            break
        found = fit(
            problem, recordings, model.names, beside[int(errors.argmin())], most, step
        )
        if found.error > _DEEPER * model.error:
            break
        model = found
    return model


def best_fit(
    problem: Problem,
    recordings: Sequence[Recording],
    names: Sequence[str],
    starts: Sequence[Mapping[str, float]],
    most: int = 40,
    tolerance: float = TIGHT,
) -> Fit:
    """The fit (``fit``) that leaves least, of one from each of ``starts``."""
    fits = (
        fit(problem, recordings, names, start, most, tolerance=tolerance)
        for start in starts
    )
    return min(fits, key=lambda f: f.error)
