"""Fit all numbers of a hypothesis to recordings: residuals in noise floors, bounded least squares, several starts.

A hypothesis is a list of effects; its numbers are those that are always fitted and those of its effects, all at once.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from taccorl.alignment.measurements.correlation import (
    Rows,
    block_sums,
    independent_rows,
    lasting_square,
    rate_of,
    unstacked,
)
from taccorl.diagnosis.search.problem import (
    Case,
    Free,
    Problem,
    Recording,
    Values,
    chosen,
)
from taccorl.sim.effects.effect import Effect

FAR = 1e5
"""Residual [floors] of a simulation that ended in NaN, and upper bound for the residual of a row."""
MANY_BLOCKS = 20
"""Least number of blocks of time for an estimate from the scatter between blocks."""
MANY_RECORDINGS = 4
"""Least number of recordings for an estimate from the scatter between recordings."""
WIDE, COARSE, FINE = 0.1, 1e-3, 1e-4
"""Steps of finite differences, in coordinates of order 1. Coarse ones average over the kinks of dry friction and limits while
hypotheses are compared, wide ones over jumps, as where a link bounces in its play; fine ones are needed to follow the ridge of
K_p and K_d to its top."""
_SCALE_ROUNDS, _SAME_SCALE = 8, 1.5
"""``over_own_scale`` repeats its differences until no half width changes by more than the factor ``_SAME_SCALE``, at most
``_SCALE_ROUNDS`` times."""
LEFT_OVER = 1.5
"""RMS residual [floors] from which on the rest counts as an effect that the model lacks: below it, as noise."""
ENTRIES_LEFT_OVER = 4
"""Number of independent entries as which that rest counts for intervals, however many rows it has: unlike noise it does not
average out. On 27 simulated joints with one effect fitted and another one missing, intervals of the fitted strength held the
truth in 23 cases; in 17 without this, in 18 with 36 entries, in 24 with 1."""
_OPEN = 1e-14
"""Directions that move the residuals, squared, so little of the strongest one count as this: open."""
_AT_BOUND = 1e-3
"""Share of a parameter's range from its end that counts as being there."""


_ASIDE = tuple(side * step for side in (-1.0, 1.0) for step in (0.01, 0.03, 0.1, 0.3))
_DENTS, _DEEPER = 4, 0.998
"""``out_of_dents`` goes on at most ``_DENTS`` times, each time to at most ``_DEEPER`` times the error."""
DECADES = 100.0
"""Ratio of the ends of a range from which on it is no tolerance. A choice."""


@dataclass(frozen=True)
class Fit:
    """Result of one fit: fitted values of all numbers of a hypothesis, with residuals and their derivatives."""

    names: tuple[str, ...]
    values: Values
    """Every number of the hypothesis in the unit of its parameter, fitted or held."""
    residuals: np.ndarray = field(repr=False)
    """(n,) simulation − measurement [noise floors], all recordings stacked."""
    layout: tuple[Rows, ...] = field(repr=False)
    """Rows and channels of each recording in the stacked residuals."""
    jacobian: np.ndarray = field(repr=False)
    """(n, p) derivatives of the residuals by the coordinates of ``frees``."""
    frees: tuple[Free, ...]
    """(p,) fitted numbers, with unit and bounds."""
    at_bound: tuple[str, ...]
    """Names of the numbers that ended at one of their bounds."""
    trouble: str
    """Reason why the fit did not converge; empty if it did."""
    effects: tuple[Effect, ...]
    """The effects with fitted parameters."""
    moved: np.ndarray | None = field(default=None, repr=False)
    """(p,) change of the coordinates if other recordings were fitted, too (``moved_by``); None if not computed."""

    @property
    def error(self) -> float:
        """RMS residual [floors] on the recordings that were fitted."""
        return rms(self.residuals)

    @cached_property
    def effective_rows(self) -> float:
        """Number of independent entries among the residuals, by their autocorrelation along time (``independent_rows``)."""
        return independent_rows(list(unstacked(self.residuals, self.layout)))

    def covariance(self, left_over: bool = True) -> np.ndarray:
        """(p, p) covariance of the coordinates.

        The largest, for each number, of four estimates: σ² (JᵀJ)⁻¹ with as many rows as are independent; the sandwich
        (JᵀJ)⁻¹ Σ_b g_b g_bᵀ (JᵀJ)⁻¹ with the gradients g_b of blocks b of time, all channels of a block together, which holds
        for slightly wrong models; the same with recordings as blocks, if there are ``MANY_RECORDINGS``; and (JᵀJ)⁻¹ times what
        is no noise: squared residuals above ``LEFT_OVER``, with only ``ENTRIES_LEFT_OVER`` independent rows, or the part of them
        that lasts (``lasting_square``), as one, since it may hide as much again in the numbers. The square of ``moved`` is added.
        Directions that the data do not determine have a very large variance.

        Args:
            left_over: False: without the fourth estimate, as if a further effect were to explain the rest.
        """
        n, p = self.jacobian.shape
        if p == 0:
            return np.zeros((0, 0))
        inverse = inverse_of(self.jacobian.T @ self.jacobian)
        variance = (
            float(self.residuals @ self.residuals)
            / max(n - p, 1)
            * n
            / self.effective_rows
        )
        plain = variance * inverse
        variances = np.diag(plain)
        pull = self.jacobian * self.residuals[:, None]
        pulls = block_sums(pull, self.layout)
        if (count := len(pulls)) >= max(MANY_BLOCKS, 2 * p):
            variances = np.maximum(
                variances, np.square(pulls @ inverse).sum(axis=0) * count / (count - p)
            )
        if (count := len(self.layout)) >= MANY_RECORDINGS:
            ends = np.cumsum([int(rows.measured.sum()) for rows in self.layout])
            pulls = np.array([part.sum(axis=0) for part in np.split(pull, ends[:-1])])
            few = (student.ppf(0.975, count - 1) / student.ppf(0.975, np.inf)) ** 2
            variances = np.maximum(
                variances,
                few * np.square(pulls @ inverse).sum(axis=0) * count / (count - 1),
            )
        if left_over:
            rest = max(self.error**2 - LEFT_OVER**2, 0.0) / min(
                ENTRIES_LEFT_OVER, self.effective_rows
            )
            rest = max(rest, lasting_square(self.residuals, self.layout))
            variances = np.maximum(variances, rest * n * np.diag(inverse))
        if self.moved is not None:
            variances = variances + self.moved**2
        wider = np.sqrt(variances / np.maximum(np.diag(plain), 1e-300))
        return plain * np.outer(wider, wider)

    def intervals(self) -> dict[str, tuple[float, float]]:
        """Parameter → 95 % interval in its unit, limited to its bounds."""
        spread = self.quantile * np.sqrt(np.diag(self.covariance()))
        middle = [f.coordinate(self.values[f.name]) for f in self.frees]
        return {
            f.name: (f.value(m - s), f.value(m + s))
            for f, m, s in zip(self.frees, middle, spread, strict=True)
        }

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

    @property
    def quantile(self) -> float:
        """Half width of a 95 % interval in standard errors: Student's t, with the number of blocks of time minus that of fitted
        numbers as degrees of freedom."""
        blocks = len(block_sums(self.residuals, self.layout))
        return float(student.ppf(0.975, max(blocks - len(self.frees), 3)))


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


def inverse_of(squares: np.ndarray) -> np.ndarray:
    """Inverse (p, p) of ``squares`` JᵀJ (p, p); directions that are open count as hardly seen."""
    strengths, ways = np.linalg.eigh(squares)
    return ways / np.maximum(strengths, _OPEN * strengths.max(initial=1e-300)) @ ways.T


def rms(residuals: np.ndarray) -> float:
    """Root mean square of ``residuals`` (n,), in their unit; NaN if there are none."""
    return (
        float(np.sqrt(np.mean(np.square(residuals))))
        if len(residuals)
        else float("nan")
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
    prior: Sequence[tuple[float, float]] = (),
) -> Fit:
    """Fit all numbers of a hypothesis together, but for those that are held.

    Args:
        names: effects of the hypothesis.
        start: start values; numbers that are left out start at their defaults.
        most: most steps of the solver.
        step: step of its finite differences.
        prior: mean and standard deviation of each coordinate, whose squared distance is added to the squared residuals; none: no
            prior. It is not part of the result's residuals and derivatives.
    """
    candidates = chosen(problem, names)
    every = (*problem.base, *(f for c in candidates for f in c.frees))
    absent = [f.name for f in every if f.optional and start.get(f.name, f.start) <= 0.0]
    held = {
        f.name: f.start for f in every if f.held or {*f.unless} & {*names}
    } | dict.fromkeys(absent, 0.0)
    frees = tuple(f for f in every if f.name not in held)
    low = np.array([f.coordinate(f.low) for f in frees])
    high = np.array([f.coordinate(f.high) for f in frees])
    first = np.array([f.coordinate(start.get(f.name, f.start)) for f in frees])
    inside = 1e-6 * (high - low)
    first = np.clip(first, low + inside, high - inside)
    newest: dict[bytes, np.ndarray] = {}
    layout = layout_of(recordings)

    def at(coordinates: np.ndarray) -> tuple[Values, list[Effect]]:
        values = held | {
            f.name: f.value(c) for f, c in zip(frees, coordinates, strict=True)
        }
        return values, problem.prepare(
            values, [c.make(values) for c in candidates], recordings
        )

    def simulated(points: Sequence[np.ndarray]) -> None:
        missing = [point for point in points if point.tobytes() not in newest]
        if missing:
            found = stacked_all(problem, [at(point) for point in missing], recordings)
            newest.update(
                (point.tobytes(), left)
                for point, left in zip(missing, found, strict=True)
            )

    def beside(coordinates: np.ndarray) -> list[np.ndarray]:
        return list(
            coordinates + np.diag(np.where(coordinates + step <= high, step, -step))
        )

    def left(coordinates: np.ndarray) -> np.ndarray:
        if coordinates.tobytes() not in newest:
            newest.clear()
            simulated([coordinates, *beside(coordinates)][: problem.at_once])
        return newest[coordinates.tobytes()]

    def slopes(coordinates: np.ndarray) -> np.ndarray:
        here, points = left(coordinates), beside(coordinates)
        simulated(points)
        ways = np.where(coordinates + step <= high, step, -step)
        return (
            np.array([newest[point.tobytes()] - here for point in points])
            / ways[:, None]
        ).T

    if len(frees) == 0:
        values, effects = at(first)
        here = left(first)
        return Fit(
            tuple(names),
            values,
            here,
            layout,
            np.empty((len(here), 0)),
            (),
            (),
            "",
            tuple(effects),
        )
    means, deviations = (
        np.array(prior).reshape(-1, 2).T if prior else (np.zeros(0), np.zeros(0))
    )

    def asked(coordinates: np.ndarray) -> np.ndarray:
        return (
            np.concatenate([left(coordinates), (coordinates - means) / deviations])
            if prior
            else left(coordinates)
        )

    def asked_slopes(coordinates: np.ndarray) -> np.ndarray:
        return (
            np.vstack([slopes(coordinates), np.diag(1.0 / deviations)])
            if prior
            else slopes(coordinates)
        )

    # SciPy's first step is at most as long as the start is far from 0: all coordinates start at 1 there.
    shift = first - 1.0
    found = least_squares(
        lambda u: asked(u + shift),
        first - shift,
        jac=lambda u: asked_slopes(u + shift),  # pyright: ignore[reportArgumentType]
        bounds=(low - shift, high - shift),
        max_nfev=most,
        ftol=1e-5,
        xtol=1e-6,
        gtol=1e-9,
    )
    ended = np.clip(found.x + shift, low, high)
    values, effects = at(ended)
    near = np.minimum(ended - low, high - ended) < _AT_BOUND * (high - low)
    return Fit(
        names=tuple(names),
        values=values,
        residuals=found.fun[: len(found.fun) - len(prior)],
        layout=layout,
        jacobian=found.jac[: len(found.fun) - len(prior)],
        frees=frees,
        at_bound=tuple(
            f.name for f, is_near in zip(frees, near, strict=True) if is_near
        ),
        trouble=""
        if found.status > 0
        else f"not converged: still improving after {most} steps",
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
) -> Fit:
    """The fit (``fit``) that leaves least, of one from each of ``starts``."""
    return min(
        (fit(problem, recordings, names, start, most) for start in starts),
        key=lambda f: f.error,
    )
