"""Controller identification (paper App. B.1): K_p, K_d and T_ref of one joint from its sweeps.

The joints are strongly over-damped, so that positions determine the time constant K_d / K_p and the offset T_ref / K_p, but
hardly K_p itself (the correlation of log K_p and log K_d is 0.9999): other errors of the model change K_p. So the ratios are
reported with their own intervals, commanded gains are taken as true, and recorded torques are fitted, too.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from taccorl.alignment.controller.identification_search import GainSearch, correlation_time, covariance
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.rigid_joint import Gains
from taccorl.alignment.measurements.measurement import UNITS
from taccorl.errors import TaccorlError

PAPER_BOUNDS = {"kp": (10.0, 1e5), "kd": (1.0, 1e3), "torque_ff": (-8.0, 8.0)}
"""Bounds of K_p, K_d and T_ref [N·m/rad, N·m·s/rad, N·m] (App. B.1)."""
REFERENCE = Gains(500.0, 50.0, 0.0)
"""Gains of the paper's reference simulator, at which a search starts."""
RATE_WEIGHT = 0.1  # of the finite differences in the paper's loss, eq. 9
_NORMAL_95 = 1.96
_AT_BOUND = 1e-3  # so near to a bound, as a share of the value or of the span, is at it
_LEAST_MOTION = 5e-3  # rad, m
_LEAST_SECONDS = 2.0
_MOST_ROUNDS = 4  # of weighing positions and torques against each other
_MOST_LOG = 50.0


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimate of one number with its 95 % interval."""

    value: float
    low: float
    high: float
    unit: str
    """Unit of all three, such as ``N·m/rad``."""
    fixed: bool = False
    """True if the number was not fitted, because it was commanded and known, or not requested."""
    at_bound: bool = False
    """True if the fit ended at one of the bounds of the search."""


@dataclass(frozen=True, kw_only=True)
class MotionError:
    """Error of the model on one recording, before (gains of the twin's configuration) and after the fit."""

    name: str
    use: Literal["fit", "validation"]
    """Whether the gains were fitted to the recording, or not (validation)."""
    loss_before: float
    """Loss of eq. 9 of the paper before the fit [rad]."""
    loss_after: float
    """The same after the fit [rad]."""
    rmse_before: float
    """RMS error before the fit [rad]."""
    rmse_after: float
    """RMS error after the fit [rad]."""


@dataclass(frozen=True, kw_only=True)
class ControllerFit:
    """Fitted gains of one joint with intervals, and errors of the model before and after."""

    signal: str
    gains: Gains
    """Gains in force in the first recording."""
    estimates: dict[str, Estimate]
    """Always all six: ``kp``, ``kd``, ``torque_ff``; ``lag`` = K_d / K_p [s] and ``offset`` = T_ref / K_p, which positions alone
    determine; ``late``: delay of the measured rows [s], from a second fit that has it as a further unknown."""
    ridge: float
    """Correlation of log K_p and log K_d; 1 means that only their ratio is known. NaN if one is fixed."""
    errors: tuple[MotionError, ...]
    """One item per recording, those of the fit first."""
    converged: bool
    """True if the search ended at a minimum."""
    remarks: tuple[str, ...]
    """Remarks: reasons why it did not converge, numbers that cannot be determined, suspicious values."""


def paper_loss(reported: np.ndarray, measured: np.ndarray) -> float:
    """The paper's loss (eq. 9) [rad], Σ |e_sim − e_real| + 0.1 Σ |Δe_sim − Δe_real| over T rows, of the simulated angles
    ``reported`` (T,) and ``measured`` (T,) [rad]. e = angle − target: the targets cancel. Rows with NaN are left out."""
    difference = reported - measured
    return float(np.nansum(np.abs(difference)) + RATE_WEIGHT * np.nansum(np.abs(np.diff(difference))))


def identify_controller(
    motions_fit: Sequence[JointMotion],
    model: JointModel,
    *,
    free: Sequence[str] | None = None,
    validation: Sequence[JointMotion] = (),
    start: Gains = REFERENCE,
    bounds: Mapping[str, tuple[float, float]] = PAPER_BOUNDS,
) -> ControllerFit:
    """Fit the gains of ``model`` to recordings of its joint.

    Least squares of positions, and of torques if every recording has them: K_p and K_d are then as accurate as the driver's
    scale of torques. (The paper searches by SPSA.)

    Args:
        motions_fit: recordings to which the gains are fitted.
        free: of ``kp``, ``kd``, ``torque_ff``; by default all but gains that every recording states as commanded. The others
            have the commanded values, or the twin's.
        validation: recordings that are not used in the fit; their errors are reported.
        start: gains at which the search starts, besides the twin's.
        bounds: ``kp``, ``kd``, ``torque_ff`` → (low, high) [N·m/rad, N·m·s/rad, N·m].

    Raises TaccorlError: the recordings do not determine these parameters (no motion, too short, not measured), or a
    parameter is unknown."""
    if not motions_fit:
        raise TaccorlError(f"{model.signal}: no recording to fit; give at least one sweep of this joint")
    for motion in (*motions_fit, *validation):
        _check_usable(motion, model)
    if free is None:
        known = {"kp": all(m.kp_known for m in motions_fit), "kd": all(m.kd_known for m in motions_fit)}
        free = [name for name in PAPER_BOUNDS if not known.get(name, False)]
    if not free or not set(free) <= set(PAPER_BOUNDS):
        raise TaccorlError(f"{model.signal}: free parameters {list(free)}; choose among {', '.join(PAPER_BOUNDS)}")
    search = GainSearch(motions_fit, model, tuple(name for name in PAPER_BOUNDS if name in free), bounds)
    x, unfinished = _by_least_squares(search, start)
    parts = search.parts(x)
    correlated, residual = correlation_time(parts), np.concatenate(parts)
    estimates, ridge = _estimates(search, x, covariance(search.jacobian(x), residual, correlated))
    late, error = search.lateness(x)
    estimates["late"] = Estimate(value=late, low=late - _NORMAL_95 * error, high=late + _NORMAL_95 * error, unit="s")
    at_bound = [name for name in search.free if estimates[name].at_bound]
    if at_bound:
        unfinished = [*unfinished, f"{' and '.join(at_bound)} ended at a bound of the search"]
    return ControllerFit(
        signal=model.signal,
        gains=search.gains(x),
        estimates=estimates,
        ridge=ridge,
        errors=(*_errors(search, motions_fit, "fit", x), *_errors(search, validation, "validation", x)),
        converged=not unfinished,
        remarks=(*(f"not converged, because {why}" for why in unfinished), *_remarks(search, estimates, ridge)),
    )


def _by_least_squares(search: GainSearch, start: Gains) -> tuple[np.ndarray, list[str]]:
    """The best x, and why it is not to be trusted."""
    found = min((search.solve(search.at(gains)) for gains in (start, search.model.gains)), key=lambda done: done.cost)
    if all(np.isfinite(motion.effort).any() for motion in search.motions):
        for _ in range(_MOST_ROUNDS):
            search.weigh(found.x)
            found = search.solve(found.x)
    return found.x, [] if found.status > 0 else [f"{found.nfev} steps of the solver were not enough"]


def _estimates(search: GainSearch, x: np.ndarray, spread: np.ndarray) -> tuple[dict[str, Estimate], float]:
    """Intervals of the gains and of their ratios to K_p, and the correlation of log K_p and log K_d.

    Each number's (or its logarithm's) derivative by x, with x = log K_p, log K_d / K_p, T_ref / K_p: to first order its variance
    is dᵀ C d."""
    gains = search.gains(x)
    unit = dict(zip(search.free, np.eye(len(x)), strict=True))
    none = np.zeros(len(x))
    kp = unit.get("kp", none)
    lag = unit.get("kd", -kp)
    kd = kp + lag
    offset = unit.get("torque_ff", -gains.torque_ff / gains.kp * kp)
    torque_ff = gains.torque_ff * kp + gains.kp * offset
    velocity, effort = UNITS[search.model.unit]
    numbers = {
        "kp": (gains.kp, kp, True, f"{effort}/{search.model.unit}"),
        "kd": (gains.kd, kd, True, f"{effort}/({velocity})"),
        "torque_ff": (gains.torque_ff, torque_ff, False, effort),
        "lag": (gains.kd / gains.kp, lag, True, "s"),
        "offset": (gains.torque_ff / gains.kp, offset, False, search.model.unit),
    }
    estimates = {}
    for name, (value, by_x, is_log, text) in numbers.items():
        reach = _NORMAL_95 * math.sqrt(max(float(by_x @ spread @ by_x), 0.0))
        factor = math.exp(min(reach, _MOST_LOG))
        low, high = (value / factor, value * factor) if is_log else (value - reach, value + reach)
        estimates[name] = Estimate(
            value=value,
            low=low,
            high=high,
            unit=text,
            fixed=name in PAPER_BOUNDS and name not in unit,
            at_bound=name in unit and _is_at_bound(value, *search.bounds[name], is_log=is_log),
        )
    if "kp" not in unit or "kd" not in unit:
        return estimates, math.nan
    return estimates, float(kp @ spread @ kd / np.sqrt((kp @ spread @ kp) * (kd @ spread @ kd)))


def _is_at_bound(value: float, low: float, high: float, *, is_log: bool) -> bool:
    if is_log:
        return min(value / low, high / value) < 1.0 + _AT_BOUND
    return min(value - low, high - value) < _AT_BOUND * (high - low)


def _remarks(search: GainSearch, estimates: dict[str, Estimate], ridge: float) -> list[str]:
    remarks = []
    kp, lag, late = estimates["kp"], estimates["lag"], estimates["late"]
    stated = [motion.name for motion in search.motions if motion.kp_known]
    if 0 < len(stated) < len(search.motions):
        remarks.append(
            f"commanded gains are stated in {', '.join(stated)} and not in the others, which are taken to have had the twin's; "
            "state them for all"
        )
    if not kp.fixed and kp.high / kp.low > 1.2:
        remarks.append(
            f"K_p alone is known to a factor {kp.high / kp.low:.2g} only (ridge {ridge:.5f}); positions tell K_d / K_p = "
            f"{lag.value * 1e3:.2f} ms ({lag.low * 1e3:.2f} … {lag.high * 1e3:.2f}). State the commanded gains"
        )
    rows = late.value * search.motions[0].rate_hz
    if abs(rows) > 0.25 and not late.low <= 0.0 <= late.high:
        ends = sorted((abs(late.low), abs(late.high)))
        remarks.append(
            f"positions are {abs(late.value) * 1e3:.1f} ms ({ends[0] * 1e3:.1f} … {ends[1] * 1e3:.1f}), {abs(rows):.1f} rows, "
            f"{'later' if rows > 0 else 'earlier'} than any gains let them be: check the clock, or look for a delay, before "
            "believing K_p"
        )
    return remarks


def _errors(
    search: GainSearch, motions: Sequence[JointMotion], use: Literal["fit", "validation"], x: np.ndarray
) -> list[MotionError]:
    errors = []
    for motion in motions:
        before, after = (
            search.simulate(search.scaled(motion), gains)[0] for gains in (search.model.gains, search.gains(x))
        )
        errors.append(
            MotionError(
                name=motion.name,
                use=use,
                loss_before=paper_loss(before, motion.measured),
                loss_after=paper_loss(after, motion.measured),
                rmse_before=float(np.sqrt(np.nanmean((before - motion.measured) ** 2))),
                rmse_after=float(np.sqrt(np.nanmean((after - motion.measured) ** 2))),
            )
        )
    return errors


def _check_usable(motion: JointMotion, model: JointModel) -> None:
    signal, unit = model.signal, model.unit
    span, seconds = float(np.ptp(motion.target)), float(motion.time_s[-1] - motion.time_s[0])
    seen = np.isfinite(motion.measured)
    advice = "record a sweep of this joint: ± 0.2 rad, 0.1 to 2 Hz, 10 s"
    if seconds < _LEAST_SECONDS:
        raise TaccorlError(f"{motion.name}: {seconds:.2f} s of {signal} are too short for K_p, K_d and T_ref; {advice}")
    if span < _LEAST_MOTION:
        raise TaccorlError(
            f"{motion.name}: the targets of {signal} move by {span:.2g} {unit} only, which does not determine the gains; "
            f"{advice}"
        )
    if seen.mean() < 0.5:
        raise TaccorlError(
            f"{motion.name}: {signal} was measured in only {seen.mean():.0%} of the rows; find out why the driver sent no "
            f"data, then {advice}"
        )
    moved = float(np.ptp(motion.measured[seen]))
    if moved < 0.02 * span:
        raise TaccorlError(
            f"{motion.name}: {signal} moved by {moved:.2g} {unit} where its targets move by {span:.2g} {unit}: a dead or "
            "swapped channel, or a motor without power; correct that, then record again"
        )
