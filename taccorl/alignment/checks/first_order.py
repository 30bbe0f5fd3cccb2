"""Fit of the simplest response of a joint to its command: a first-order lag behind a pure delay.

    y(t) = g · f(t − d) + b,   τ ḟ = q* − f

A PiPER joint nearly responds like that (K_d / K_p ≈ 0.1 s; its second pole, inertia over K_d, is below 3 ms and appears as
delay). The delay is used to check clocks: no joint responds before its command, so that d < 0 is a fault of time stamps. If the
lag does not describe the joint (friction, backlash, …), ``rms`` is large and d has no meaning.

Letters in shapes: T rows.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares
from scipy.signal import lfilter

from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.joint_checks import find_lag
from taccorl.errors import TaccorlError

COMMAND_HZ = 150.0  # Row rate below which the command is interpolated between rows, as in ``taccorl.sim.replay`` [Hz]
TAU_S = (1e-3, 2.0)  # Range of time constants that are searched [s]
LEAST_ROWS = 20  # Least number of measured rows for a fit
MOST_ROWS = 5000  # If there are more rows, an even selection of so many is used for the start of the fit
DELAY_ROWS, DELAY_S, FAR_S = 8.0, 0.15, 2.0
"""Range of delays that are searched: from so many rows too early to so many seconds late; and by ``far_delay``."""
FAR_LEAVES = 0.3
"""A delay beyond ``DELAY_S`` must leave less than this share of what the best lag and delay within it leave. A choice."""


@dataclass(frozen=True, kw_only=True)
class Shift:
    """Delay of one response to a command relative to another, with differences of gains removed."""

    delay_s: (
        float  # Delay [s]; negative if the response leads the other, or its command
    )
    delay_sd_s: float
    """Standard deviation of the delay [s], with the autocorrelation of the residual taken into account."""
    rms: float  # RMS of the residual of the fit [rad, m]
    row_rms: float  # RMS residual that an offset of one row would cause [rad, m]


@dataclass(frozen=True, kw_only=True)
class FirstOrder(Shift):
    """Fitted first-order lag and delay of one joint behind its command."""

    time_constant_s: float  # τ of the lag [s]
    gain: float  # g: change of the position per change of the command; nearly 1

    def response(self, target: np.ndarray, period_s: float) -> np.ndarray:
        """(T,) g f(t − d) to ``target`` (T,), from its first row on [rad, m]."""
        rows = np.arange(len(target))
        return self.gain * _Answer(target - target[0], period_s).at(
            rows, self.time_constant_s, self.delay_s / period_s
        )


def fit_first_order(
    target: np.ndarray, measured: np.ndarray, period_s: float
) -> FirstOrder:
    """Fit the lag τ, delay d, gain g and offset b of the module's equation by least squares. ``target``: (T,) commands [rad, m],
    in force from row k on. ``measured``: (T,) positions at row k [rad, m]; rows with NaN are left out. ``period_s``: time between
    two rows [s]. Raises TaccorlError: there are too few rows."""
    rows = _rows(target, measured, period_s)
    answer = _Answer(target - target[0], period_s)

    def residual(x: np.ndarray, every: int = 1) -> np.ndarray:
        return beside(
            measured[rows[::every]], answer.at(rows[::every], math.exp(x[0]), x[1])
        )[0]

    low = np.array([math.log(TAU_S[0]), -DELAY_ROWS])
    high = np.array([math.log(TAU_S[1]), DELAY_S / period_s])

    def fit(start: np.ndarray, every: int) -> Any:
        return least_squares(
            residual, start, bounds=(low, high), x_scale=(0.1, 0.5), args=(every,)
        )

    every = math.ceil(len(rows) / MOST_ROWS)
    best = min(
        (fit(np.array([math.log(tau), 0.0]), every) for tau in (0.03, 0.1)),
        key=lambda found: found.cost,
    )
    best = fit(best.x, 1) if every > 1 else best
    shape = answer.at(rows, math.exp(best.x[0]), best.x[1])
    gain = beside(measured[rows], shape)[1]
    of_delay = _of_delay(
        float(best.x[1]), 1, best.fun, best.jac, gain * shape, period_s
    )
    return FirstOrder(**of_delay, time_constant_s=math.exp(best.x[0]), gain=gain)


def far_delay(
    target: np.ndarray, measured: np.ndarray, period_s: float
) -> FirstOrder | None:
    """The fit of ``measured`` (T,) to ``target`` (T,) with a delay from ``DELAY_S`` to ``FAR_S`` if it leaves much less than
    ``fit_first_order``, else None. Play and dry friction delay slow motion, but take their size off both ends of its range."""
    start = find_lag(
        target[:, None], measured[:, None], max(1, round(1 / period_s)), (0.0, FAR_S)
    )
    rows = max(0, round((start.lag_s - 0.1) / period_s))
    if rows == 0 or len(target) - rows < 2 * DELAY_S / period_s + LEAST_ROWS:
        return None
    fit = fit_first_order(target[:-rows], measured[rows:], period_s)
    fit = dataclasses.replace(fit, delay_s=fit.delay_s + rows * period_s)
    lost = np.ptp(target) - np.nanmax(measured) + np.nanmin(measured)
    error = np.sqrt(np.nanmean(np.square(target - measured)))
    real = fit.delay_s - 4.0 * fit.delay_sd_s > DELAY_S and lost < error
    return (
        fit
        if real
        and fit.rms < FAR_LEAVES * fit_first_order(target, measured, period_s).rms
        else None
    )


def delay_between(
    target: np.ndarray,
    measured: np.ndarray,
    other: np.ndarray,
    period_s: float,
    changed: Sequence[np.ndarray] = (),
) -> Shift:
    """Delay of ``measured`` (T,) relative to ``other`` (T,), both responses to ``target`` (T,) [rad, m].

    measured − other = b + δg f + δτ ∂f/∂τ + δd ∂f/∂d, linearised about the mean of both fits: a part of the response that the lag
    describes in neither cancels in the difference. Responses ``changed`` add a column each, their difference from ``other``.
    ``period_s``: time between two rows [s]. ``changed``: responses (T,) like ``other`` with another inertia, damping …, which may
    be the reason of the difference. Raises TaccorlError: there are too few rows."""
    fits = [fit_first_order(target, values, period_s) for values in (measured, other)]
    rows = _rows(target, measured, period_s)
    answer = _Answer(target - target[0], period_s)
    log_tau = float(np.mean([math.log(f.time_constant_s) for f in fits]))
    delay, gain = (
        float(np.mean([f.delay_s for f in fits])) / period_s,
        float(np.mean([f.gain for f in fits])),
    )

    def slope(d_log_tau: float, d_delay: float) -> np.ndarray:
        up = answer.at(rows, math.exp(log_tau + d_log_tau), delay + d_delay)
        return (
            (up - answer.at(rows, math.exp(log_tau - d_log_tau), delay - d_delay))
            * gain
            / 2
        )

    f = answer.at(rows, math.exp(log_tau), delay)
    own = [(values - other)[rows] for values in changed]
    design = np.column_stack(
        [np.ones(len(rows)), f, slope(0.05, 0.0) / 0.05, slope(0.0, 0.5) / 0.5, *own]
    )
    difference = (measured - other)[rows]
    solution = np.linalg.lstsq(design, difference, rcond=None)[0]
    return Shift(
        **_of_delay(
            float(solution[3]),
            3,
            difference - design @ solution,
            design,
            gain * f,
            period_s,
        )
    )


def pure_shift(measured: np.ndarray, other: np.ndarray, period_s: float) -> Shift:
    """Delay of ``measured`` (T,) relative to ``other`` (T,) without any other difference than a constant: a delay of commands or
    of a clock shifts a response, whatever the joint's physics is. Searched within ± ``DELAY_ROWS`` rows or ± 2 ``DELAY_S``.
    ``measured``, ``other``: (T,) positions [rad, m]; rows with NaN in ``measured`` are left out, as are those that a delay brings
    to an end. ``period_s``: time between two rows [s]. Raises TaccorlError: there are too few rows."""
    rows, ends = (
        np.arange(len(other)),
        math.ceil(max(DELAY_ROWS, 2 * DELAY_S / period_s)),
    )
    inner = rows[ends:-ends]
    inner = inner[np.isfinite(measured[inner])]
    if len(inner) < LEAST_ROWS:
        raise TaccorlError(
            f"shift: {len(other)} rows at {1 / period_s:g} Hz are too few"
        )

    def residual(x: np.ndarray) -> np.ndarray:
        left = measured[inner] - np.interp(inner - x[0], rows, other)
        return left - left.mean()

    start = min(
        np.arange(1 - ends, ends, 0.5),
        key=lambda d: float(np.square(residual(np.array([d]))).sum()),
    )
    best = least_squares(
        residual, [start], bounds=([start - 1], [start + 1]), diff_step=1e-3
    )
    return Shift(**_of_delay(float(best.x[0]), 0, best.fun, best.jac, other, period_s))


def left_by_change(
    measured: np.ndarray, other: np.ndarray, changed: np.ndarray
) -> float:
    """Least RMS of measured − other − a (changed − other) − b over factors a and constants b [rad, m]. ``measured``, ``other``,
    ``changed``: (T,) positions; rows with NaN in ``measured`` are left out."""
    known = np.isfinite(measured)
    return float(np.std(beside((measured - other)[known], (changed - other)[known])[0]))


def beside(wanted: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, float]:
    """``wanted`` (T,) without a constant and the multiple of ``shape`` (T,) that leaves least, and the factor."""
    wanted, shape = wanted - wanted.mean(), shape - shape.mean()
    power = float(shape @ shape)
    factor = float(shape @ wanted) / power if power > 0 else 0.0
    return wanted - factor * shape, factor


def _rows(target: np.ndarray, measured: np.ndarray, period_s: float) -> np.ndarray:
    """Rows that every delay looked for can reach, and that were measured."""
    rows = np.arange(
        math.ceil(DELAY_S / period_s) + 1, len(target) - math.ceil(DELAY_ROWS) - 1
    )
    rows = rows[np.isfinite(measured[rows])] if len(rows) else rows
    if len(rows) < LEAST_ROWS:
        raise TaccorlError(
            f"first-order fit: {len(target)} rows at {1 / period_s:g} Hz are too few"
        )
    return rows


def _of_delay(
    rows: float,
    column: int,
    left: np.ndarray,
    jacobian: np.ndarray,
    shape: np.ndarray,
    period_s: float,
) -> dict[str, float]:
    """Fields of ``Shift`` of a delay [rows], the parameter ``column`` of a fit with four. ``left``: residual; one that is like
    its neighbour counts for fewer samples. ``shape``: fitted response."""
    rms = math.sqrt(float(left @ left) / max(len(left) - 4, 1))
    likeness = float(
        np.clip(left[1:] @ left[:-1] / max(left @ left, 1e-300), 0.0, 0.999)
    )
    variance = (
        float(np.linalg.pinv(jacobian.T @ jacobian)[column, column])
        * (1 + likeness)
        / (1 - likeness)
    )
    return {
        "delay_s": rows * period_s,
        "delay_sd_s": rms * math.sqrt(max(variance, 0.0)) * period_s,
        "rms": rms,
        "row_rms": float(np.sqrt(np.mean(np.diff(shape) ** 2))),
    }


class _Answer:
    """f at any time, exactly: between two commands it is an exponential."""

    def __init__(self, target: np.ndarray, period_s: float) -> None:
        self.parts = (
            math.ceil(COMMAND_HZ * period_s - 1e-9) if period_s * COMMAND_HZ > 1 else 1
        )
        share = (
            np.arange(1, self.parts + 1) / self.parts if self.parts > 1 else np.zeros(1)
        )
        following = np.append(target[1:], target[-1:])
        self.command = (target[:, None] + share * (following - target)[:, None]).ravel()
        self.step_s = period_s / self.parts

    def at(self, rows: np.ndarray, tau_s: float, delay_rows: float) -> np.ndarray:
        """(len(rows),) f at ``rows`` − ``delay_rows``."""
        keep = math.exp(-self.step_s / tau_s)
        after = np.concatenate([[0.0], lfilter([1 - keep], [1, -keep], self.command)])
        when = (rows - delay_rows) * self.parts
        whole = np.clip(np.floor(when).astype(int), 0, len(self.command) - 1)
        command = self.command[whole]
        return command + (after[whole] - command) * keep ** (when - whole)


# Onsets of steps beside a replay. While a joint follows a step from rest, dry friction and a constant load take torque from the
# whole step: the joint moves as the replay does times a factor, and begins at the same time. Another inertia, too, changes the
# first motion by a factor. So q(t) − q₀ = s · r(t − d) with the replay's motion r gives the delay d, whatever is missing.

REST_S = 0.25  # Time for which all targets must have rested before a step [s]
HELD_S = 0.04  # Time for which the target must rest after a step [s]
WINDOW_S = 0.12  # Time after a step of the target within which the joint must have moved by ``SHARE`` of the step [s]
SHARE = 0.25  # Share of the step up to which the motion is compared. A choice.
SEEN_FLOORS, SEEN_ROWS = (
    6.0,
    3,
)  # Least number of rows in which the motion is above so many noise floors
ONSET_ROWS = -8.0, 20.0  # Range of delays that are tried
FINE_ROWS = 0.05  # Step between them
ALIKE = 0.04
"""Largest residual of the comparison, as a share of what an offset of one row would leave. A torque at its limit, play and a
wrong scale of torques change the motion's shape. On simulated joints delays were right within 1.9 ms below this share, and up to
9 ms off above it."""
LEAST_STEPS = 2  # Least number of steps by which a delay is judged


@dataclass(frozen=True)
class Onset:
    """Delay of a joint's measured motion after steps, compared with a replay."""

    delay_s: float  # Median over the steps [s]; negative if the measurement leads
    sd_s: float  # Standard error of the median, from the scatter of the steps [s]
    num_steps: int


def onset_delay(
    m: Measurement, signal: str, reported: np.ndarray, floor: float
) -> Onset | None:
    """Compare the motion of one joint after the steps of its target; None if fewer than ``LEAST_STEPS`` are alike in both.
    ``reported``: (T,) positions of the replay [rad, m]. ``floor``: noise floor of the positions [rad, m]."""
    j, rate_hz = m.column(signal), m.rate_hz
    target, measured = m.target[:, j], m.measured[:, j]
    rest, held, window = (
        max(1, round(seconds * rate_hz)) for seconds in (REST_S, HELD_S, WINDOW_S)
    )
    still = np.all(np.abs(np.diff(m.target, axis=0)) < 1e-6, axis=1)
    found = []
    for k in np.flatnonzero(np.abs(np.diff(target)) > 1e-6) + 1:
        if k < rest or not (
            still[k - rest : k - 1].all() and still[k : k + held].all()
        ):
            continue
        step, before, after = (
            float(target[k] - target[k - 1]),
            slice(k - rest // 2, k - 1),
            slice(k, k + window),
        )
        own, other = (
            np.sign(step) * (q[after] - q[before].mean()) for q in (measured, reported)
        )
        beyond = np.flatnonzero(own > SHARE * abs(step))
        if len(beyond) and np.isfinite(other).all():
            own = own[: beyond[0] + 1]
            if (
                np.isfinite(own).all()
                and np.sum(own > SEEN_FLOORS * floor) >= SEEN_ROWS
            ):
                found += _delay_rows(own, other)
    if len(found) < LEAST_STEPS:
        return None
    error_rows = (
        1.25 * float(np.std(found, ddof=1)) / np.sqrt(len(found))
    )  # of a median
    return Onset(
        float(np.median(found)) / rate_hz,
        max(error_rows, FINE_ROWS) / rate_hz,
        len(found),
    )


def _delay_rows(own: np.ndarray, replay: np.ndarray) -> list[float]:
    """Delay [rows] of a motion (N,) after a replay's, from rest at row 0; empty if their shapes differ."""
    rows, still = np.arange(len(own)), int(np.ceil(ONSET_ROWS[1]))
    motion = PchipInterpolator(
        np.arange(-still, len(replay)), np.concatenate([np.zeros(still), replay])
    )
    delays = np.arange(*ONSET_ROWS, FINE_ROWS)
    shifted = motion(np.clip(rows - delays[:, None], -still, len(replay) - 1))
    power = np.maximum((shifted**2).sum(1), 1e-300)
    left = own - (shifted @ own / power)[:, None] * shifted
    best = int(np.argmin((left**2).sum(1)))
    late = motion(np.clip(rows - delays[best] - 1.0, -still, len(replay) - 1))
    of_one_row = float(shifted[best] @ own / power[best]) * (late - shifted[best])
    return (
        [float(delays[best])]
        if np.linalg.norm(left[best]) < ALIKE * np.linalg.norm(of_one_row)
        else []
    )
