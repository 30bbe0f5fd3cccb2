"""The engine of every fit: bounded least squares of stacked residuals, and the intervals of its numbers.

Letters in shapes: n measured entries of all recordings, p fitted numbers.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from taccorl.alignment.measurements.correlation import (
    Rows,
    block_sums,
    independent_rows,
    lasting_square,
    unstacked,
)

FAR = 1e5
"""Residual [floors] of a simulation that ended in NaN, and largest one of a row."""
MANY_RECORDINGS = 4
"""Least number of recordings for an estimate from the scatter between recordings."""
WIDE, COARSE, FINE = 0.1, 1e-3, 1e-4
"""Steps of finite differences, in coordinates of order 1. Coarse ones average over the
kinks of dry friction and limits while hypotheses are compared, wide ones over jumps, as
where a link bounces in its play; fine ones are needed to follow the ridge of K_p and K_d
to its top."""
TIGHT, LOOSE = 1e-5, 1e-3
"""Relative fall of the squared residuals below which a fit ends; the loose one while
hypotheses are compared."""
LEFT_OVER = 1.3
"""RMS residual [floors] from which on the rest counts as an effect that the model lacks:
below it, as noise."""
ENTRIES_LEFT_OVER = 4
"""Number of independent entries as which that rest counts for intervals, however many
rows it has: unlike noise it does not average out. On 27 simulated joints with one effect
fitted and another one missing, intervals of the fitted strength held the truth in 23
cases; in 17 without this, in 18 with 36 entries, in 24 with 1."""

Values = dict[str, float]
"""Name of a number, ``kp`` or ``coulomb_friction.torque_nm`` → value in its unit."""


@dataclass(frozen=True, kw_only=True)
class Free:
    """A number that is fitted, with its unit, start value and bounds."""

    name: str
    """``kp``, or ``coulomb_friction.torque_nm`` for a parameter of an effect."""
    unit: str
    """Unit of the number and its bounds; "1" if dimensionless."""
    start: float
    """Default start value of a fit."""
    low: float
    high: float
    log: bool = False
    """True: searched on a logarithmic scale; both bounds are then above 0."""
    scale: float = 1.0
    """For a linear scale: a change of the number that is relevant."""
    held: bool = False
    """True: the number stays at ``start``, because its user knows it (``known`` of the machine's file)."""
    optional: bool = False
    """True: the number may be absent while its effect is there (``Effect.optional``). It is fitted from starts above 0 only, and
    otherwise stays at 0."""
    leaves: bool = False
    """True: the machine's file need not state it. Where the recordings do not tell it from what the file has, the last refit
    leaves it out (``Fits.as_stated``)."""
    unless: tuple[str, ...] = ()
    """Names of effects with the same influence on the recordings: in a fit with one of them this number is held at ``start``."""

    def is_at_end(self, value: float) -> bool:
        """Whether ``value`` is at one of the bounds, or beyond it."""
        here, low, high = map(self.coordinate, (value, self.low, self.high))
        # A thousandth of the range from its end counts as being there.
        return bool(min(here - low, high - here) < 1e-3 * (high - low))

    def within(self, value: float) -> float:
        """``value`` clipped to the bounds."""
        return min(max(value, self.low), self.high)

    def coordinate(self, value: float) -> float:
        """Coordinate of the solver for a value of the number, which is first clipped to the bounds: its logarithm, or value /
        ``scale``, so that a relevant change is of order 1."""
        value = self.within(value)
        return math.log(value) if self.log else value / self.scale

    def value(self, coordinate: float) -> float:
        """The number, in its unit, at a coordinate of the solver; the inverse of
        ``coordinate``. A coordinate beyond a bound gives the bound."""
        if self.log:
            raw = math.exp(min(coordinate, 700.0))  # the largest float
        else:
            raw = float(coordinate * self.scale)
        return self.within(raw)


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimate of one number with its 95 % interval."""

    value: float
    low: float
    high: float
    unit: str
    """Unit of all three, such as ``N·m/rad``."""
    fixed: bool = False
    """True: not fitted, because it was commanded and known, or not requested."""
    at_bound: bool = False
    """True: the fit ended at one of the bounds of the search."""


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Result of one fit: values of its numbers, with residuals and their derivatives."""

    values: Values
    """Every number in its unit, fitted or held."""
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
    moved: np.ndarray | None = field(default=None, repr=False)
    """(p,) change of the coordinates by what the residuals do not show, such as further
    recordings; None: none. Its square is added to the variances."""

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
        # The scatter between blocks of time is known from about 20 of them on.
        if len(pulls) >= max(20, 2 * p):
            variances = np.maximum(variances, np.diag(sandwich(pulls, inverse, p)))
        if (count := len(self.layout)) >= MANY_RECORDINGS:
            ends = np.cumsum([int(rows.measured.sum()) for rows in self.layout])
            pulls = np.array([part.sum(axis=0) for part in np.split(pull, ends[:-1])])
            few = (student.ppf(0.975, count - 1) / student.ppf(0.975, np.inf)) ** 2
            variances = np.maximum(
                variances, few * np.diag(sandwich(pulls, inverse, 1))
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

    def estimates(self) -> dict[str, Estimate]:
        """Parameter → its estimate, in its unit."""
        ends = self.intervals()
        return {
            f.name: Estimate(
                value=self.values[f.name],
                low=ends[f.name][0],
                high=ends[f.name][1],
                unit=f.unit,
                at_bound=f.name in self.at_bound,
            )
            for f in self.frees
        }

    @property
    def quantile(self) -> float:
        """Half width of a 95 % interval in standard errors: Student's t, with the number of blocks of time minus that of fitted
        numbers as degrees of freedom."""
        blocks = len(block_sums(self.residuals, self.layout))
        return float(student.ppf(0.975, max(blocks - len(self.frees), 3)))


def sandwich(pulls: np.ndarray, inverse: np.ndarray, used: int) -> np.ndarray:
    """Covariance (p, p) by the scatter of B groups of residuals that hang together in any
    way: (JᵀJ)⁻¹ Σ g gᵀ (JᵀJ)⁻¹ · B / (B − ``used``).

    Args:
        pulls: (B, p) gradients g = Jᵀ r of each group.
        inverse: (p, p) (JᵀJ)⁻¹.
        used: degrees of freedom that the groups have lost.
    """
    moved = pulls @ inverse
    return moved.T @ moved * len(pulls) / max(len(pulls) - used, 1)


def inverse_of(squares: np.ndarray) -> np.ndarray:
    """Inverse (p, p) of ``squares`` JᵀJ (p, p); directions that are open count as hardly seen."""
    strengths, ways = np.linalg.eigh(squares)
    # A direction that moves the residuals, squared, less than 1e-14 of what the strongest
    # one does is open, and counts as that.
    return ways / np.maximum(strengths, 1e-14 * strengths.max(initial=1e-300)) @ ways.T


def rms(residuals: np.ndarray) -> float:
    """Root mean square of ``residuals`` (n,), in the unit of the residuals; NaN if n is 0."""
    return (
        float(np.sqrt(np.mean(np.square(residuals))))
        if len(residuals)
        else float("nan")
    )


def minimise(
    residuals_of: Callable[[Sequence[Values]], np.ndarray],
    frees: Sequence[Free],
    start: Mapping[str, float],
    layout: Sequence[Rows],
    *,
    at_once: int = 1,
    most: int = 40,
    step: float = COARSE,
    tolerance: float = TIGHT,
) -> Solution:
    """Fit the numbers ``frees`` by least squares within their bounds.

    Args:
        residuals_of: residuals (N, n) of each of N sets of values, in noise floors.
        start: start values; numbers that are left out start at their defaults.
        layout: rows and channels of each recording in the residuals.
        at_once: number of sets that ``residuals_of`` takes in about the time of one.
        most: most steps of the solver. With 1 it stays at its start, of which it gives
            the residuals and derivatives.
        step: step of its finite differences.
        tolerance: relative fall of the squared residuals below which it ends; a tenth of
            it for the step.
    """
    low = np.array([f.coordinate(f.low) for f in frees])
    high = np.array([f.coordinate(f.high) for f in frees])
    first = np.array([f.coordinate(start.get(f.name, f.start)) for f in frees])
    inside = 1e-6 * (high - low)
    first = np.clip(first, low + inside, high - inside)
    newest: dict[bytes, np.ndarray] = {}
    newest_slopes: list[np.ndarray] = []  # residuals and derivatives

    def at(coordinates: np.ndarray) -> Values:
        return {f.name: f.value(c) for f, c in zip(frees, coordinates, strict=True)}

    def simulated(points: Sequence[np.ndarray]) -> None:
        missing = [point for point in points if point.tobytes() not in newest]
        if missing:
            found = residuals_of([at(point) for point in missing])
            newest.update(
                (point.tobytes(), own)
                for point, own in zip(missing, found, strict=True)
            )

    def ways(coordinates: np.ndarray) -> np.ndarray:
        return np.where(coordinates + step <= high, step, -step)

    def beside(coordinates: np.ndarray) -> list[np.ndarray]:
        return list(coordinates + np.diag(ways(coordinates)))

    def measured(coordinates: np.ndarray) -> np.ndarray:
        if coordinates.tobytes() not in newest:
            newest.clear()
            simulated([coordinates, *beside(coordinates)][:at_once])
        return newest[coordinates.tobytes()]

    def slopes(coordinates: np.ndarray) -> np.ndarray:
        here, points = measured(coordinates), beside(coordinates)
        simulated(points)
        ends = np.array([newest[point.tobytes()] for point in points])
        return ((ends - here) / ways(coordinates)[:, None]).T

    # SciPy decomposes what it is given in every step. So it gets p + 1 rows with the same
    # JᵀJ, Jᵀr and |r| in place of n: in the direction of r, and a triangle for the rest.

    def size(coordinates: np.ndarray) -> np.ndarray:
        residual = np.zeros(len(frees) + 1)
        residual[0] = np.linalg.norm(measured(coordinates))
        return residual

    def triangle(coordinates: np.ndarray) -> np.ndarray:
        here = measured(coordinates)
        newest_slopes[:] = [here, slopes(coordinates)]
        direction = here / max(np.linalg.norm(here), 1e-300)
        along = direction @ newest_slopes[1]
        rest = np.linalg.qr(newest_slopes[1] - np.outer(direction, along), mode="r")
        found = np.zeros((len(frees) + 1, len(frees)))
        found[0], found[1 : 1 + len(rest)] = along, rest
        return found

    if len(frees) == 0:
        here = measured(first)
        return Solution(
            values={},
            residuals=here,
            layout=tuple(layout),
            jacobian=np.empty((len(here), 0)),
            frees=(),
            at_bound=(),
            trouble="",
        )
    # SciPy's first step is at most as long as the start is far from 0: all coordinates start at 1 there.
    shift = first - 1.0
    found = least_squares(
        lambda u: size(u + shift),
        first - shift,
        jac=lambda u: triangle(u + shift),  # pyright: ignore[reportArgumentType]
        bounds=(low - shift, high - shift),
        max_nfev=most,
        ftol=tolerance,
        xtol=0.1 * tolerance,
        gtol=1e-9,
    )
    ended = np.clip(found.x + shift, low, high)
    values = at(ended)
    return Solution(
        values=values,
        residuals=newest_slopes[0],
        layout=tuple(layout),
        jacobian=newest_slopes[1],
        frees=tuple(frees),
        at_bound=tuple(f.name for f in frees if f.is_at_end(values[f.name])),
        trouble=""
        if found.status > 0
        else f"not converged: still improving after {most} steps",
    )
