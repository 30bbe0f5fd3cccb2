"""Objective of controller identification: a joint's residuals as a function of its gains, with noise and intervals.

Letters in shapes: R residuals, P parameters.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import OptimizeResult, least_squares

from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.rigid_joint import Gains

_STEPS = {"kp": 1e-3, "kd": 1e-4, "torque_ff": 1e-6}  # of log K_p, log K_d / K_p and T_ref / K_p [rad], for derivatives
_LATE_STEP_S = 1e-4
_MOST_LATE_S = 0.5
_MOST_LOG = 50.0
_DIVERGED = 1e3


class GainSearch:
    """Residuals of recordings as a function of x, the free ones of log K_p, log (K_d / K_p) and T_ref / K_p. In these
    coordinates the valley of the loss is straight: positions determine the ratios, and hardly K_p. Values beyond the bounds are
    clipped. Gains are those in force in the first recording; the other recordings' gains are in proportion, if they were
    commanded so. ``bounds``: ``kp``, ``kd``, ``torque_ff`` → low, high."""

    def __init__(
        self,
        motions: Sequence[JointMotion],
        model: JointModel,
        free: tuple[str, ...],
        bounds: Mapping[str, tuple[float, float]],
    ) -> None:
        first = motions[0]
        self._kp_scale, self._kd_scale = first.kp_scale, first.kd_scale
        self.motions = [self.scaled(motion) for motion in motions]
        self.model, self.free, self.bounds = model, free, bounds
        own = model.gains
        self.given = Gains(own.kp * self._kp_scale, own.kd * self._kd_scale, own.torque_ff)
        """Values of the gains that are not free: commanded in the first recording, or the twin's own."""
        self.sigma_rad = 1e-4  # near to what an encoder has: keeps the solver's tolerances meaningful
        self.sigma_effort: float | None = None
        """Noise of the effort [N·m]; None: efforts are not used."""

    def scaled(self, motion: JointMotion) -> JointMotion:
        """``motion`` with gain scales relative to those of the first recording."""
        return replace(motion, kp_scale=motion.kp_scale / self._kp_scale, kd_scale=motion.kd_scale / self._kd_scale)

    def gains(self, x: np.ndarray) -> Gains:
        """Gains at coordinates ``x`` (P,), clipped to the bounds; gains that are not free have the values of ``given``."""
        at = dict(zip(self.free, x, strict=True))
        kp = self._within("kp", math.exp(min(at["kp"], _MOST_LOG))) if "kp" in at else self.given.kp
        kd = self._within("kd", kp * math.exp(min(at["kd"], _MOST_LOG))) if "kd" in at else self.given.kd
        torque_ff = self._within("torque_ff", kp * at["torque_ff"]) if "torque_ff" in at else self.given.torque_ff
        return Gains(float(kp), float(kd), float(torque_ff))

    def at(self, gains: Gains) -> np.ndarray:
        """Coordinates x (P,) of ``gains``, clipped to the bounds."""
        kp = self._within("kp", gains.kp) if "kp" in self.free else self.given.kp
        every = {"kp": math.log(kp), "kd": math.log(self._within("kd", gains.kd) / kp)}
        every["torque_ff"] = self._within("torque_ff", gains.torque_ff) / kp
        low, high = self.x_bounds()
        return np.clip(np.array([every[name] for name in self.free]), low + 1e-9, high - 1e-9)

    def x_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest (P,) and highest (P,) coordinates x."""
        (kp_low, kp_high), (kd_low, kd_high) = self.bounds["kp"], self.bounds["kd"]
        least, most = self.bounds["torque_ff"]
        every = {
            "kp": (math.log(kp_low), math.log(kp_high)),
            "kd": (math.log(kd_low / max(kp_high, self.given.kp)), math.log(kd_high / min(kp_low, self.given.kp))),
            "torque_ff": (least / min(kp_low, self.given.kp), most / min(kp_low, self.given.kp)),
        }
        low, high = np.array([every[name] for name in self.free]).T
        return low, high

    def _within(self, name: str, value: float) -> float:
        low, high = self.bounds[name]
        return min(max(value, low), high)

    def simulate(self, motion: JointMotion, gains: Gains) -> tuple[np.ndarray, np.ndarray]:
        """(T,) reported positions [rad] and (T,) efforts [N·m]; after a divergence both are far from any measurement."""
        done = self.model.simulate(motion, gains)
        return _finite(done.reported), _finite(done.effort)

    def parts(self, x: np.ndarray, late_s: float = 0.0) -> list[np.ndarray]:
        """Residuals in units of the channel's noise, where something was measured.

        Args:
            x: (P,) coordinates.
            late_s: the rows' positions are assumed to be older than their times by this [s].

        Returns:
            For each recording its position residuals, one per measured row, then its effort residuals if efforts are used.
        """
        parts = []
        for motion in self.motions:
            reported, effort = self.simulate(motion, self.gains(x))
            if late_s:
                reported = CubicSpline(motion.time_s, reported)(np.maximum(motion.time_s - late_s, motion.time_s[0]))
            seen = np.isfinite(motion.measured)
            parts.append((reported - motion.measured)[seen] / self.sigma_rad)
            if self.sigma_effort is not None:
                seen = np.isfinite(motion.effort)
                parts.append((effort - motion.effort)[seen] / self.sigma_effort)
        return parts

    def residual(self, x: np.ndarray, late_s: float = 0.0) -> np.ndarray:
        """Residuals (R,) of all recordings and channels at ``x`` (P,), in units of their noise: ``parts``, concatenated."""
        return np.concatenate(self.parts(x, late_s))

    def jacobian(self, x: np.ndarray, late_s: float = 0.0) -> np.ndarray:
        """Derivatives (R, P) of the residuals by ``x`` (P,), by central differences."""
        columns = []
        for name, unit in zip(self.free, np.eye(len(x)), strict=True):
            step = _STEPS[name]
            ends = [self.residual(x + sign * step * unit, late_s) for sign in (1, -1)]
            columns.append((ends[0] - ends[1]) / (2 * step))
        return np.column_stack(columns)

    def solve(self, start: np.ndarray) -> OptimizeResult:
        """Least squares from ``start`` (P,), a point within the bounds; returns SciPy's result."""
        return least_squares(
            self.residual,
            start,
            self.jacobian,  # pyright: ignore[reportArgumentType]
            self.x_bounds(),
            x_scale="jac",
            max_nfev=100,
            xtol=1e-10,
            ftol=1e-12,
        )

    def lateness(self, start: np.ndarray) -> tuple[float, float]:
        """Fit a delay of the measured rows as well, from ``start`` (P,); returns the delay [s] and its standard error [s]."""

        def residual(y: np.ndarray) -> np.ndarray:
            return self.residual(y[:-1], float(y[-1]))

        def jacobian(y: np.ndarray) -> np.ndarray:
            ends = [self.residual(y[:-1], float(y[-1]) + sign * _LATE_STEP_S) for sign in (1, -1)]
            own = self.jacobian(y[:-1], float(y[-1]))
            return np.column_stack([own, (ends[0] - ends[1]) / (2 * _LATE_STEP_S)])

        low, high = self.x_bounds()
        bounds = np.append(low, -_MOST_LATE_S), np.append(high, _MOST_LATE_S)
        first = np.append(start, 1e-6)
        found = least_squares(residual, first, jacobian, bounds, x_scale="jac", max_nfev=30)  # pyright: ignore[reportArgumentType]
        late_s = float(found.x[-1])
        correlated = correlation_time(self.parts(found.x[:-1], late_s))
        return late_s, math.sqrt(covariance(found.jac, found.fun, correlated)[-1, -1])

    def weigh(self, x: np.ndarray) -> None:
        """Set the noise of both channels to the RMS residuals at ``x`` (P,)."""
        left = [(self.simulate(motion, self.gains(x)), motion) for motion in self.motions]
        positions = np.concatenate([reported - motion.measured for (reported, _), motion in left])
        efforts = np.concatenate([effort - motion.effort for (_, effort), motion in left])
        self.sigma_rad = max(float(np.sqrt(np.nanmean(positions**2))), 1e-12)
        self.sigma_effort = max(float(np.sqrt(np.nanmean(efforts**2))), 1e-12)


def _finite(values: np.ndarray) -> np.ndarray:
    return np.nan_to_num(values, nan=_DIVERGED, posinf=_DIVERGED, neginf=-_DIVERGED)


def covariance(jacobian: np.ndarray, residual: np.ndarray, correlated: float) -> np.ndarray:
    """Covariance (P, P) of the fitted parameters: σ² (JᵀJ)⁻¹ with J ``jacobian`` (R, P), and σ² that of ``residual`` (R,) times
    its correlation time ``correlated`` [rows]; very large where J is singular."""
    norms = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-30)
    _, singular, right = np.linalg.svd(jacobian / norms, full_matrices=False)
    half = right / np.maximum(singular, 1e-12)[:, None] / norms
    variance = float(residual @ residual) / max(len(residual) - len(norms), 1) * correlated
    return half.T @ half * variance


def correlation_time(parts: Sequence[np.ndarray]) -> float:
    """Number of rows after which residuals are independent, 1 + 2 Σ ρ_k up to the first ρ_k ≤ 0; the largest over ``parts``.
    ``parts``: residuals (R,) of one recording and channel each."""
    longest = 1.0
    for part in parts:
        centred = part - part.mean()
        size = 2 ** math.ceil(math.log2(2 * len(part)))
        rho = np.fft.irfft(np.abs(np.fft.rfft(centred, size)) ** 2, size)[: len(part)]
        if rho[0] > 0:
            rho /= rho[0]
            end = int(np.argmax(rho <= 0.0)) or len(rho)
            longest = max(longest, 1.0 + 2.0 * float(rho[1:end].sum()))
    return longest
