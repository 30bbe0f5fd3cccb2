"""Controller identification (paper App. B.1): K_p, K_d and T_ref of one joint from its sweeps.

The joints are strongly over-damped, so that positions determine the time constant K_d / K_p and the offset T_ref / K_p, but
hardly K_p itself (the correlation of log K_p and log K_d is 0.9999): other errors of the model change K_p. So the ratios are
reported with their own intervals, commanded gains are taken as true, and recorded torques are fitted, too.

Letters in shapes: R residuals, P parameters.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import OptimizeResult, least_squares

from taccorl.alignment.controller import spsa
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.rigid_joint import Gains
from taccorl.alignment.measurements.correlation import independent_rows
from taccorl.alignment.measurements.measurement import UNITS
from taccorl.errors import TaccorlError

PAPER_BOUNDS = {"kp": (10.0, 1e5), "kd": (1.0, 1e3), "torque_ff": (-8.0, 8.0)}
"""Bounds of K_p, K_d and T_ref [N·m/rad, N·m·s/rad, N·m] (App. B.1)."""
REFERENCE = Gains(
    500.0, 50.0, 0.0
)  # Gains of the paper's reference simulator, at which a search starts
_NORMAL_95 = 1.96
_AT_BOUND = 1e-3  # so near to a bound, as a share of the value or of the span, is at it
_LEAST_MOTION = 5e-3  # rad, m
_LEAST_SECONDS = 2.0
_MOST_ROUNDS = 4  # of weighing positions and torques against each other
_MOST_LOG = 50.0
_STEPS = {
    "kp": 1e-3,
    "kd": 1e-4,
    "torque_ff": 1e-6,
}  # of log K_p, log K_d / K_p and T_ref / K_p [rad], for derivatives
_LOG_IN_PAPER = {"kp", "kd"}  # varied as logarithms
_LATE_STEP_S, _MOST_LATE_S = 1e-4, 0.5
_DIVERGED = 1e3


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimate of one number with its 95 % interval."""

    value: float
    low: float
    high: float
    unit: str  # Unit of all three, such as ``N·m/rad``
    fixed: bool = False  # True if the number was not fitted, because it was commanded and known, or not requested
    at_bound: bool = False  # True if the fit ended at one of the bounds of the search


@dataclass(frozen=True, kw_only=True)
class MotionError:
    """Error of the model on one recording, before (gains of the twin's configuration) and after the fit."""

    name: str
    use: Literal[
        "fit", "validation"
    ]  # Whether the gains were fitted to the recording, or not (validation)
    rmse_before: float  # RMS error before the fit [rad]
    rmse_after: float  # RMS error after the fit [rad]


@dataclass(frozen=True, kw_only=True)
class ControllerFit:
    """Fitted gains of one joint with intervals, and errors of the model before and after."""

    gains: Gains  # Gains in force in the first recording
    estimates: dict[str, Estimate]
    """Always all six: ``kp``, ``kd``, ``torque_ff``; ``lag`` = K_d / K_p [s] and ``offset`` = T_ref / K_p, which positions alone
    determine; ``late``: delay of the measured rows [s], from a second fit that has it as a further unknown."""
    ridge: float  # Correlation of log K_p and log K_d; 1 means that only their ratio is known. NaN if one is fixed.
    errors: tuple[MotionError, ...]  # One item per recording, those of the fit first
    converged: bool  # True if the search ended at a minimum
    remarks: tuple[str, ...]
    """Remarks: reasons why it did not converge, numbers that cannot be determined, suspicious values."""


def identify_controller(
    motions_fit: Sequence[JointMotion],
    model: JointModel,
    *,
    free: Sequence[str] | None = None,
    validation: Sequence[JointMotion] = (),
    spsa_rng: np.random.Generator | None = None,
) -> ControllerFit:
    """Fit the gains of ``model`` to recordings of its joint.

    Least squares of positions, and of torques if every recording has them: K_p and K_d are then as accurate as the driver's
    scale of torques. Or SPSA with the paper's loss of positions, from the twin's gains, if ``spsa_rng`` is given.

    Args:
        motions_fit: recordings to which the gains are fitted.
        free: of ``kp``, ``kd``, ``torque_ff``; by default all but gains that every recording states as commanded. The others
            have the commanded values, or the twin's.
        validation: recordings that are not used in the fit; their errors are reported.
        spsa_rng: generator of SPSA's random signs; None: least squares.

    Raises TaccorlError: the recordings do not determine these parameters (no motion, too short, not measured), or a
    parameter is unknown."""
    if not motions_fit:
        raise TaccorlError(
            f"{model.signal}: no recording to fit; give at least one sweep of this joint"
        )
    for motion in (*motions_fit, *validation):
        _check_usable(motion, model)
    if free is None:
        known = {
            "kp": all(m.kp_known for m in motions_fit),
            "kd": all(m.kd_known for m in motions_fit),
        }
        free = [name for name in PAPER_BOUNDS if not known.get(name, False)]
    if not free or not set(free) <= set(PAPER_BOUNDS):
        raise TaccorlError(
            f"{model.signal}: free parameters {list(free)}; choose among {', '.join(PAPER_BOUNDS)}"
        )
    search = _GainSearch(
        motions_fit, model, tuple(name for name in PAPER_BOUNDS if name in free)
    )
    if spsa_rng is None:
        x, unfinished = _by_least_squares(search)
        spread, remarks = search.covariance(x), []
    else:
        x, remarks = _by_spsa(search, spsa_rng)
        unfinished = []
        to_minimum = search.step_to_minimum(x)
        spread = search.covariance(x) + np.outer(to_minimum, to_minimum)
    estimates, ridge = _estimates(search, x, spread)
    later = search.solve(
        np.append(x, 1e-6), most=30
    ).x  # with a delay of the rows as a further unknown
    late, error = float(later[-1]), math.sqrt(search.covariance(later)[-1, -1])
    estimates["late"] = Estimate(
        value=late,
        low=late - _NORMAL_95 * error,
        high=late + _NORMAL_95 * error,
        unit="s",
    )
    at_bound = [name for name in search.free if estimates[name].at_bound]
    if at_bound:
        unfinished = [
            *unfinished,
            f"{' and '.join(at_bound)} ended at a bound of the search",
        ]
    return ControllerFit(
        gains=search.gains(x),
        estimates=estimates,
        ridge=ridge,
        errors=(
            *_errors(search, motions_fit, "fit", x),
            *_errors(search, validation, "validation", x),
        ),
        converged=not unfinished,
        remarks=(
            *(f"not converged, because {why}" for why in unfinished),
            *remarks,
            *_remarks(search, estimates, ridge),
        ),
    )


def _by_least_squares(search: "_GainSearch") -> tuple[np.ndarray, list[str]]:
    """The best x, and why it is not to be trusted."""
    starts = (search.at(gains) for gains in (REFERENCE, search.model.gains))
    found = min(map(search.solve, starts), key=lambda done: done.cost)
    if all(np.isfinite(motion.effort).any() for motion in search.motions):
        for _ in range(_MOST_ROUNDS):
            search.weigh(found.x)
            found = search.solve(found.x)
    return found.x, [] if found.status > 0 else [
        f"{found.nfev} steps of the solver were not enough"
    ]


def _by_spsa(
    search: "_GainSearch", rng: np.random.Generator
) -> tuple[np.ndarray, list[str]]:
    """The best x, and remarks. The paper's search is over η = log K_p, log K_d, T_ref, of
    which only free ones are varied."""

    def gains(eta: np.ndarray) -> Gains:
        found = dict(zip(search.free, eta, strict=True))
        for name in _LOG_IN_PAPER & found.keys():
            found[name] = math.exp(found[name])
        return search.given._replace(**found)

    def loss(eta: np.ndarray) -> float:
        positions = (search.simulate(m, gains(eta))[0] for m in search.motions)
        measured = (m.measured for m in search.motions)
        return sum(map(spsa.paper_loss, positions, measured))

    values = [(getattr(search.given, n), *PAPER_BOUNDS[n]) for n in search.free]
    eta = [
        np.log(own) if name in _LOG_IN_PAPER else np.array(own)
        for name, own in zip(search.free, values, strict=True)
    ]
    start, low, high = np.transpose(eta)
    found = spsa.minimise(loss, start, low, high, rng)
    remarks = [
        f"SPSA: loss (eq. 9) {found.start_loss:.4g} → {found.loss:.4g} rad in "
        f"{found.iterations} iterations. It ends near the minimum, not at it: intervals "
        "contain the distance as well as the noise"
    ]
    if not found.out_of_patience:
        remarks.append("SPSA was cut off while it still improved, if slowly")
    return search.at(gains(found.x)), remarks


def _estimates(
    search: "_GainSearch", x: np.ndarray, spread: np.ndarray
) -> tuple[dict[str, Estimate], float]:
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
        low, high = (
            (value / factor, value * factor)
            if is_log
            else (value - reach, value + reach)
        )
        estimates[name] = Estimate(
            value=value,
            low=low,
            high=high,
            unit=text,
            fixed=name in PAPER_BOUNDS and name not in unit,
            at_bound=name in unit
            and _is_at_bound(value, *PAPER_BOUNDS[name], is_log=is_log),
        )
    if "kp" not in unit or "kd" not in unit:
        return estimates, math.nan
    return estimates, float(
        kp @ spread @ kd / np.sqrt((kp @ spread @ kp) * (kd @ spread @ kd))
    )


def _is_at_bound(value: float, low: float, high: float, *, is_log: bool) -> bool:
    if is_log:
        return min(value / low, high / value) < 1.0 + _AT_BOUND
    return min(value - low, high - value) < _AT_BOUND * (high - low)


def _remarks(
    search: "_GainSearch", estimates: dict[str, Estimate], ridge: float
) -> list[str]:
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
    search: "_GainSearch",
    motions: Sequence[JointMotion],
    use: Literal["fit", "validation"],
    x: np.ndarray,
) -> list[MotionError]:
    errors = []
    for motion in motions:
        both = [
            search.simulate(search.scaled(motion), g)[0]
            for g in (search.model.gains, search.gains(x))
        ]
        before, after = (
            float(np.sqrt(np.nanmean((q - motion.measured) ** 2))) for q in both
        )
        errors.append(
            MotionError(name=motion.name, use=use, rmse_before=before, rmse_after=after)
        )
    return errors


def _check_usable(motion: JointMotion, model: JointModel) -> None:
    signal, unit = model.signal, model.unit
    span, seconds = (
        float(np.ptp(motion.target)),
        float(motion.time_s[-1] - motion.time_s[0]),
    )
    seen = np.isfinite(motion.measured)
    advice = "record a sweep of this joint: ± 0.2 rad, 0.1 to 2 Hz, 10 s"
    if seconds < _LEAST_SECONDS:
        raise TaccorlError(
            f"{motion.name}: {seconds:.2f} s of {signal} are too short for K_p, K_d and T_ref; {advice}"
        )
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


class _GainSearch:
    """Residuals of recordings as a function of x, the free ones of log K_p, log (K_d / K_p) and T_ref / K_p. In these
    coordinates the valley of the loss is straight: positions determine the ratios, and hardly K_p. Values beyond the bounds are
    clipped. Gains are those in force in the first recording; the other recordings' gains are in proportion, if they were
    commanded so. A coordinate beyond P is the time by which the rows' positions are older than their times [s]."""

    def __init__(
        self, motions: Sequence[JointMotion], model: JointModel, free: tuple[str, ...]
    ) -> None:
        first = motions[0]
        self._kp_scale, self._kd_scale = first.kp_scale, first.kd_scale
        self.motions = [self.scaled(motion) for motion in motions]
        self.model, self.free = model, free
        own = model.gains
        self.given = Gains(
            own.kp * self._kp_scale, own.kd * self._kd_scale, own.torque_ff
        )
        """Values of the gains that are not free: commanded in the first recording, or the twin's own."""
        self.sigma_rad = 1e-4  # near to what an encoder has: keeps the solver's tolerances meaningful
        self.sigma_effort: float | None = None
        """Noise of the effort [N·m]; None: efforts are not used."""

    def scaled(self, motion: JointMotion) -> JointMotion:
        """``motion`` with gain scales relative to those of the first recording."""
        return replace(
            motion,
            kp_scale=motion.kp_scale / self._kp_scale,
            kd_scale=motion.kd_scale / self._kd_scale,
        )

    def gains(self, x: np.ndarray) -> Gains:
        """Gains at coordinates ``x`` (P,), clipped to the bounds; gains that are not free have the values of ``given``."""
        at = dict(zip(self.free, x, strict=False))
        kp = (
            self._within("kp", math.exp(min(at["kp"], _MOST_LOG)))
            if "kp" in at
            else self.given.kp
        )
        kd = (
            self._within("kd", kp * math.exp(min(at["kd"], _MOST_LOG)))
            if "kd" in at
            else self.given.kd
        )
        torque_ff = (
            self._within("torque_ff", kp * at["torque_ff"])
            if "torque_ff" in at
            else self.given.torque_ff
        )
        return Gains(float(kp), float(kd), float(torque_ff))

    def at(self, gains: Gains) -> np.ndarray:
        """Coordinates x (P,) of ``gains``, clipped to the bounds."""
        kp = self._within("kp", gains.kp) if "kp" in self.free else self.given.kp
        every = {"kp": math.log(kp), "kd": math.log(self._within("kd", gains.kd) / kp)}
        every["torque_ff"] = self._within("torque_ff", gains.torque_ff) / kp
        low, high = self.x_bounds()
        return np.clip(
            np.array([every[name] for name in self.free]), low + 1e-9, high - 1e-9
        )

    def x_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest (P,) and highest (P,) coordinates x."""
        (kp_low, kp_high), (kd_low, kd_high), (least, most) = (
            PAPER_BOUNDS[name] for name in Gains._fields
        )
        every = {
            "kp": (math.log(kp_low), math.log(kp_high)),
            "kd": (
                math.log(kd_low / max(kp_high, self.given.kp)),
                math.log(kd_high / min(kp_low, self.given.kp)),
            ),
            "torque_ff": (
                least / min(kp_low, self.given.kp),
                most / min(kp_low, self.given.kp),
            ),
        }
        low, high = np.array([every[name] for name in self.free]).T
        return low, high

    def _within(self, name: str, value: float) -> float:
        low, high = PAPER_BOUNDS[name]
        return min(max(value, low), high)

    def simulate(
        self, motion: JointMotion, gains: Gains
    ) -> tuple[np.ndarray, np.ndarray]:
        """(T,) reported positions [rad] and (T,) efforts [N·m]; after a divergence both are far from any measurement."""
        done = self.model.simulate(motion, gains)
        return _finite(done.reported), _finite(done.effort)

    def parts(self, x: np.ndarray) -> list[np.ndarray]:
        """Residuals at ``x`` in units of the channel's noise, where something was measured: of each recording those of its
        positions, one per measured row, then those of its efforts if efforts are used."""
        late_s, parts = float(sum(x[len(self.free) :])), []
        for motion in self.motions:
            reported, effort = self.simulate(motion, self.gains(x))
            if late_s:
                reported = CubicSpline(motion.time_s, reported)(
                    np.maximum(motion.time_s - late_s, motion.time_s[0])
                )
            seen = np.isfinite(motion.measured)
            parts.append((reported - motion.measured)[seen] / self.sigma_rad)
            if self.sigma_effort is not None:
                seen = np.isfinite(motion.effort)
                parts.append((effort - motion.effort)[seen] / self.sigma_effort)
        return parts

    def residual(self, x: np.ndarray) -> np.ndarray:
        """(R,) ``parts``, concatenated."""
        return np.concatenate(self.parts(x))

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Derivatives (R, P) of the residuals by ``x``, by central differences."""
        steps = [*(_STEPS[name] for name in self.free), _LATE_STEP_S][: len(x)]
        ends = [
            [self.residual(x + sign * step) for sign in (1, -1)]
            for step in np.diag(steps)
        ]
        return np.column_stack(
            [(a - b) / (2 * step) for (a, b), step in zip(ends, steps, strict=True)]
        )

    def solve(self, start: np.ndarray, most: int = 100) -> OptimizeResult:
        """Least squares from ``start``, a point within the bounds, in at most so many evaluations; returns SciPy's result."""
        late_s = np.full(len(start) - len(self.free), _MOST_LATE_S)
        bounds = tuple(
            np.append(end, sign * late_s)
            for end, sign in zip(self.x_bounds(), (-1, 1), strict=True)
        )
        jac: Any = self.jacobian
        return least_squares(
            self.residual,
            start,
            jac,
            bounds,
            x_scale="jac",
            max_nfev=most,
            xtol=1e-10,
            ftol=1e-12,
        )

    def covariance(self, x: np.ndarray) -> np.ndarray:
        """Covariance (P, P) of the fitted parameters: σ² (JᵀJ)⁻¹, and σ² that of the residuals times their number for each
        independent one (``independent_rows``); very large where J is singular."""
        parts, jacobian = self.parts(x), self.jacobian(x)
        residual, norms = (
            np.concatenate(parts),
            np.maximum(np.linalg.norm(jacobian, axis=0), 1e-30),
        )
        _, singular, right = np.linalg.svd(jacobian / norms, full_matrices=False)
        half = right / np.maximum(singular, 1e-12)[:, None] / norms
        variance = float(residual @ residual) / max(len(residual) - len(norms), 1)
        return (
            half.T
            @ half
            * variance
            * len(residual)
            / independent_rows([part[:, None] for part in parts])
        )

    def step_to_minimum(self, x: np.ndarray) -> np.ndarray:
        """(P,) step from ``x`` to the minimum of least squares, to first order: −J⁺ r."""
        return np.linalg.lstsq(self.jacobian(x), -self.residual(x))[0]

    def weigh(self, x: np.ndarray) -> None:
        """Set the noise of both channels to the RMS residuals at ``x`` (P,)."""
        left = [
            (self.simulate(motion, self.gains(x)), motion) for motion in self.motions
        ]
        positions = np.concatenate(
            [reported - motion.measured for (reported, _), motion in left]
        )
        efforts = np.concatenate(
            [effort - motion.effort for (_, effort), motion in left]
        )
        self.sigma_rad = max(float(np.sqrt(np.nanmean(positions**2))), 1e-12)
        self.sigma_effort = max(float(np.sqrt(np.nanmean(efforts**2))), 1e-12)


def _finite(values: np.ndarray) -> np.ndarray:
    return np.nan_to_num(values, nan=_DIVERGED, posinf=_DIVERGED, neginf=-_DIVERGED)
