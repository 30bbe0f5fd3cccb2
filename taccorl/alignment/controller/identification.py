"""Controller identification (paper App. B.1): K_p, K_d and T_ref of one joint from its sweeps.

The joints are strongly over-damped, so that positions determine the time constant K_d / K_p and the offset T_ref / K_p, but
hardly K_p itself (the correlation of log K_p and log K_d is 0.9999): other errors of the model change K_p. So the ratios are
reported with their own intervals, commanded gains are taken as true, and recorded torques are fitted, too.

Letters in shapes: T rows, N sets of values, n measured entries, p fitted numbers.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline

from taccorl.alignment.controller import spsa
from taccorl.alignment.controller.joint_model import JointModel, Numbers
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.lanes import LANES
from taccorl.alignment.controller.rigid_joint import Gains
from taccorl.alignment.least_squares import (
    FINE,
    TIGHT,
    Estimate,
    Free,
    Solution,
    Values,
    inverse_of,
    minimise,
)
from taccorl.alignment.measurements.correlation import Rows
from taccorl.alignment.measurements.measurement import UNITS
from taccorl.errors import TaccorlError

PAPER_BOUNDS = {"kp": (10.0, 1e5), "kd": (1.0, 1e3), "torque_ff": (-8.0, 8.0)}
"""Bounds of K_p, K_d and T_ref [N·m/rad, N·m·s/rad, N·m] (App. B.1)."""
REFERENCE = Gains(500.0, 50.0, 0.0)
"""Gains of the paper's reference simulator, at which a search starts."""
_STEPS = 100  # of the solver
_DIVERGED = 1e3


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
    fits = _GainFits(motions_fit, model, [n for n in PAPER_BOUNDS if n in free])
    remarks = []
    if spsa_rng is None:
        found = fits.best()
    else:
        found, remarks = _by_spsa(fits, spsa_rng)
    estimates, ridge = _estimates(fits, found)
    estimates["late"] = fits.fit(found.values, late=True).estimates()["late"]
    unfinished = []
    if found.trouble:
        unfinished.append(f"{_STEPS} steps of the solver were not enough")
    if at_bound := [name for name in fits.free if estimates[name].at_bound]:
        unfinished.append(f"{' and '.join(at_bound)} ended at a bound of the search")
    gains = fits.gains(found.values)
    return ControllerFit(
        gains=gains,
        estimates=estimates,
        ridge=ridge,
        errors=(
            *(fits.error(motion, "fit", gains) for motion in motions_fit),
            *(fits.error(motion, "validation", gains) for motion in validation),
        ),
        converged=not unfinished,
        remarks=(
            *(f"not converged, because {why}" for why in unfinished),
            *remarks,
            *_remarks(fits.motions, estimates, ridge),
        ),
    )


def _by_spsa(fits: "_GainFits", rng: np.random.Generator) -> tuple[Solution, list[str]]:
    """The point at which SPSA ends, and remarks. The paper's search is over
    η = log K_p, log K_d, T_ref, of which only free ones are varied."""
    searched = [_bounded(name) for name in fits.free]

    def gains(eta: np.ndarray) -> Gains:
        found = {g.name: g.value(x) for g, x in zip(searched, eta, strict=True)}
        return fits.given._replace(**found)

    def loss(eta: np.ndarray) -> float:
        now = [gains(eta)]
        return sum(
            spsa.paper_loss(fits.responses(m, now)[0, 0], m.measured)
            for m in fits.motions
        )

    start = np.array([g.coordinate(getattr(fits.given, g.name)) for g in searched])
    low = np.array([g.coordinate(g.low) for g in searched])
    high = np.array([g.coordinate(g.high) for g in searched])
    best = spsa.minimise(loss, start, low, high, rng)
    remarks = [
        f"SPSA: loss (eq. 9) {best.start_loss:.4g} → {best.loss:.4g} rad in "
        f"{best.iterations} iterations. It ends near the minimum, not at it: intervals "
        "contain the distance as well as the noise"
    ]
    if not best.out_of_patience:
        remarks.append("SPSA was cut off while it still improved, if slowly")
    values = fits.values(gains(best.x))
    fits.weigh(values)
    ended = fits.fit(values, most=1)
    squares = ended.jacobian.T @ ended.jacobian
    distance = inverse_of(squares) @ (ended.jacobian.T @ ended.residuals)
    # Noise is what is left at the minimum, to first order: the distance is no noise.
    at_minimum = ended.residuals - ended.jacobian @ distance
    found = dataclasses.replace(ended, residuals=at_minimum, moved=distance, trouble="")
    return found, remarks


def _estimates(fits: "_GainFits", found: Solution) -> tuple[dict[str, Estimate], float]:
    """Intervals of the gains and of their ratios to K_p, and the correlation of log K_p
    and log K_d.

    Each number's (or its logarithm's) derivative by the coordinates of log K_p,
    log (K_d / K_p), T_ref / K_p: to first order its variance is dᵀ C d."""
    gains, spread = fits.gains(found.values), found.covariance()
    unit = {
        f.name: own if f.log else f.scale * own
        for f, own in zip(found.frees, np.eye(len(found.frees)), strict=True)
    }
    none = np.zeros(len(found.frees))
    kp = unit.get("kp", none)
    lag = unit.get("lag", -kp)
    kd = kp + lag
    offset = unit.get("offset", -gains.torque_ff / gains.kp * kp)
    torque_ff = gains.torque_ff * kp + gains.kp * offset
    velocity, effort = UNITS[fits.model.unit]
    numbers = {
        "kp": (gains.kp, kp, True, f"{effort}/{fits.model.unit}"),
        "kd": (gains.kd, kd, True, f"{effort}/({velocity})"),
        "torque_ff": (gains.torque_ff, torque_ff, False, effort),
        "lag": (gains.kd / gains.kp, lag, True, "s"),
        "offset": (gains.torque_ff / gains.kp, offset, False, fits.model.unit),
    }
    estimates = {}
    for name, (value, by_x, is_log, text) in numbers.items():
        reach = found.quantile * math.sqrt(max(float(by_x @ spread @ by_x), 0.0))
        factor = math.exp(min(reach, 50.0))
        estimates[name] = Estimate(
            value=value,
            low=value / factor if is_log else value - reach,
            high=value * factor if is_log else value + reach,
            unit=text,
            fixed=name in PAPER_BOUNDS and name not in fits.free,
            at_bound=name in fits.free and _bounded(name).is_at_end(value),
        )
    if not {"kp", "kd"} <= set(fits.free):
        return estimates, math.nan
    variances = (kp @ spread @ kp) * (kd @ spread @ kd)
    return estimates, float(kp @ spread @ kd / np.sqrt(variances))


def _bounded(name: str) -> Free:
    """A gain with the paper's bounds."""
    low, high = PAPER_BOUNDS[name]
    return Free(name=name, unit="1", start=low, low=low, high=high, log=low > 0.0)


def _remarks(
    motions: Sequence[JointMotion], estimates: dict[str, Estimate], ridge: float
) -> list[str]:
    remarks = []
    kp, lag, late = estimates["kp"], estimates["lag"], estimates["late"]
    stated = [motion.name for motion in motions if motion.kp_known]
    if 0 < len(stated) < len(motions):
        remarks.append(
            f"commanded gains are stated in {', '.join(stated)} and not in the others, which are taken to have had the twin's; "
            "state them for all"
        )
    if not kp.fixed and kp.high / kp.low > 1.2:
        remarks.append(
            f"K_p alone is known to a factor {kp.high / kp.low:.2g} only (ridge {ridge:.5f}); positions tell K_d / K_p = "
            f"{lag.value * 1e3:.2f} ms ({lag.low * 1e3:.2f} … {lag.high * 1e3:.2f}). State the commanded gains"
        )
    rows = late.value * motions[0].rate_hz
    if abs(rows) > 0.25 and not late.low <= 0.0 <= late.high:
        ends = sorted((abs(late.low), abs(late.high)))
        remarks.append(
            f"positions are {abs(late.value) * 1e3:.1f} ms ({ends[0] * 1e3:.1f} … {ends[1] * 1e3:.1f}), {abs(rows):.1f} rows, "
            f"{'later' if rows > 0 else 'earlier'} than any gains let them be: check the clock, or look for a delay, before "
            "believing K_p"
        )
    return remarks


def _check_usable(motion: JointMotion, model: JointModel) -> None:
    signal, unit = model.signal, model.unit
    span, seconds = (
        float(np.ptp(motion.target)),
        float(motion.time_s[-1] - motion.time_s[0]),
    )
    seen = np.isfinite(motion.measured)
    advice = "record a sweep of this joint: ± 0.2 rad, 0.1 to 2 Hz, 10 s"
    if seconds < 2.0:
        raise TaccorlError(
            f"{motion.name}: {seconds:.2f} s of {signal} are too short for K_p, K_d and T_ref; {advice}"
        )
    if span < 5e-3:
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


class _GainFits:
    """Fits of the gains to recordings, in numbers in which the valley of the loss is
    straight: ``kp``, ``lag`` = K_d / K_p [s] and ``offset`` = T_ref / K_p [rad], each if
    its gain is free. Positions determine the last two, and hardly K_p.

    Gains beyond their bounds are clipped. They are those in force in the first recording;
    the other recordings' are in proportion, if they were commanded so."""

    def __init__(
        self, motions: Sequence[JointMotion], model: JointModel, free: Sequence[str]
    ) -> None:
        first, own = motions[0], model.gains
        self._kp_scale, self._kd_scale = first.kp_scale, first.kd_scale
        self.motions = [self._scaled(motion) for motion in motions]
        self.model, self.free = model, free
        kp, kd = own.kp * self._kp_scale, own.kd * self._kd_scale
        self.given = Gains(kp, kd, own.torque_ff)
        """Values of the gains that are not free: those commanded in the first recording,
        or the twin's own."""
        self._noise = [1e-4, math.inf]
        """Of positions [rad] and efforts [N·m]; inf: efforts are not used."""

    def _numbers(self) -> tuple[Free, ...]:
        kp, kd, torque_ff = map(_bounded, PAPER_BOUNDS)
        if "kp" not in self.free:
            kp = dataclasses.replace(kp, low=self.given.kp, high=self.given.kp)
        lag = dataclasses.replace(
            kd, name="lag", low=kd.low / kp.high, high=kd.high / kp.low
        )
        offset = dataclasses.replace(
            torque_ff,
            name="offset",
            low=torque_ff.low / kp.low,
            high=torque_ff.high / kp.low,
            scale=0.01,
        )
        every = {"kp": kp, "kd": lag, "torque_ff": offset}
        return tuple(every[name] for name in self.free)

    def _scaled(self, motion: JointMotion) -> JointMotion:
        """``motion`` with gain scales relative to those of the first recording."""
        return dataclasses.replace(
            motion,
            kp_scale=motion.kp_scale / self._kp_scale,
            kd_scale=motion.kd_scale / self._kd_scale,
        )

    def gains(self, values: Mapping[str, float]) -> Gains:
        """Gains with these ``values``, clipped to their bounds."""
        kp, kd, torque_ff = self.given
        kp = values.get("kp", kp)
        if "lag" in values:
            kd = _bounded("kd").within(values["lag"] * kp)
        if "offset" in values:
            torque_ff = _bounded("torque_ff").within(values["offset"] * kp)
        return Gains(kp, kd, torque_ff)

    def values(self, gains: Gains) -> Values:
        """Start values of a fit from ``gains``, clipped to their bounds."""
        kp = _bounded("kp").within(gains.kp) if "kp" in self.free else self.given.kp
        kd = _bounded("kd").within(gains.kd)
        torque_ff = _bounded("torque_ff").within(gains.torque_ff)
        return {"kp": kp, "lag": kd / kp, "offset": torque_ff / kp}

    def responses(self, motion: JointMotion, cases: Sequence[Gains]) -> np.ndarray:
        """(N, 2, T) reported positions [rad] and efforts [N·m] with each of N ``cases``;
        after a divergence far from any measurement."""
        found = self.model.simulate_all([motion], [Numbers(gains) for gains in cases])
        both = np.array([(one.reported, one.effort) for one in found[0]])
        return np.nan_to_num(both, nan=_DIVERGED, posinf=_DIVERGED, neginf=-_DIVERGED)

    def _residuals(self, motion: JointMotion, cases: Sequence[Values]) -> np.ndarray:
        """(N, n) of the measured positions and, if used, efforts of one recording, in
        units of their noise."""
        answers = self.responses(motion, [self.gains(values) for values in cases])
        for (reported, _), values in zip(answers, cases, strict=True):
            if late_s := values.get("late", 0.0):
                times = np.maximum(motion.time_s - late_s, motion.time_s[0])
                reported[:] = CubicSpline(motion.time_s, reported)(times)
        measured = np.stack([motion.measured, motion.effort], axis=1)
        rows = (answers.transpose(0, 2, 1) - measured) / self._noise
        return rows[:, self._layout(motion).measured]

    def _layout(self, motion: JointMotion) -> Rows:
        measured = np.stack([motion.measured, motion.effort], axis=1)
        return Rows(np.isfinite(measured) & np.isfinite(self._noise), motion.rate_hz)

    def fit(
        self, start: Mapping[str, float], late: bool = False, most: int = _STEPS
    ) -> Solution:
        """Least squares from ``start`` in at most so many steps.

        Args:
            late: fit a delay of the measured rows [s], too.
        """
        numbers = self._numbers()
        if late:
            delay = Free(
                name="late", unit="s", start=0.0, low=-0.5, high=0.5, scale=0.01
            )
            numbers = (*numbers, delay)
        return minimise(
            lambda cases: np.concatenate(
                [self._residuals(motion, cases) for motion in self.motions], axis=1
            ),
            numbers,
            start,
            [self._layout(motion) for motion in self.motions],
            at_once=LANES,
            most=most,
            step=FINE,
            tolerance=1e-8 if late else TIGHT,
        )

    def best(self) -> Solution:
        """The best fit, of one from each of two starts, with the noise of its residuals."""
        starts = (self.values(gains) for gains in (REFERENCE, self.model.gains))
        found = min(map(self.fit, starts), key=lambda one: one.error)
        rounds, channels = 1, 1
        if all(np.isfinite(motion.effort).any() for motion in self.motions):
            # Positions and torques are weighed against each other.
            rounds, channels = 4, 2
        for _ in range(rounds):
            self.weigh(found.values, channels)
            found = self.fit(found.values)
        return found

    def weigh(self, values: Values, channels: int = 1) -> None:
        """Set the noise of the first ``channels``, positions and efforts, to the RMS
        residuals at ``values``."""
        gains = [self.gains(values)]
        apart = [
            self.responses(m, gains)[0, :channels] - [m.measured, m.effort][:channels]
            for m in self.motions
        ]
        noise = np.sqrt(np.nanmean(np.square(np.concatenate(apart, axis=1)), axis=1))
        self._noise[:channels] = np.maximum(noise, 1e-12)

    def error(
        self, motion: JointMotion, use: Literal["fit", "validation"], gains: Gains
    ) -> MotionError:
        """RMS errors of ``motion`` with the twin's own gains and with ``gains``."""
        answers = self.responses(self._scaled(motion), [self.model.gains, gains])
        squares = np.square(answers[:, 0] - motion.measured)
        before, after = np.sqrt(np.nanmean(squares, axis=1))
        return MotionError(
            name=motion.name,
            use=use,
            rmse_before=float(before),
            rmse_after=float(after),
        )
