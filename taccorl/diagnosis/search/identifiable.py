"""Numbers of a fit that the recordings identify, and the range of those that they do not.

Positions identify ratios to K_p. Multiplying all torques of a joint by one factor does not change its motion, except through its
inertia:

    J q̈ = K_p (q* − q) − K_d q̇ + T_ref − F sign q̇ − b q̇ − k (q − q₀) …

J, taken from the twin, fixes the factor, but only by the term J q̈, to which the timing of the control loop also contributes. A
velocity that is filtered or delayed by τ gives −K_d (q̇ − τ q̈), so

    (J − K_d τ) q̈ = K_p (q* − q) − K_d q̇ + …

Times J / (J − K_d τ) this is the equation of a loop without delay whose torques are all greater by that factor. A fit with the
right J finds them, K_fit = K · J / (J − K_d τ), and with K_d = K_d,fit / s solved for s = K_fit / K:

    s = 1 + K_d,fit τ / J,    K = K_fit / s

Recordings of positions do not determine τ. It lies between 0 and ``TIMING_S``, so every absolute torque is known only to within
s. The ratios F / K_p, T_ref / K_p, b / K_p … do not contain s. Commanded gains, recorded efforts and weight that is known fix
the factor without the dynamics: then the absolute numbers are identified, too.

A loop that acts on a position of age a gives K_p (q* − q + a q̇): a fit finds K_d,fit = K_d − K_p a, so K_d / K_p is up to
``POSITION_AGE_S`` greater than fitted. ``test_identifiable.py`` tests all of this with loops of 0.5 to 8 kHz.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from taccorl.diagnosis.search.fit import Fit
from taccorl.diagnosis.search.problem import Free
from taccorl.sim.effects.effect import Parameter

TIMING_S = 3e-3
"""τ_max [s]. A choice: a loop of 1 kHz (difference of two samples, output held: 1 ms) that filters its speed over 2 ms."""
POSITION_AGE_S = 1.5e-3
"""a_max [s]. A choice: half a period of a loop of 500 Hz (1 ms), and half a step of the twin (0.4 ms), which has no such age."""
EARLY_S = 2e-3
"""Most by which a target may act before its row's position was read [s]: MuJoCo's default step. Half of it, or a position that is
read right after its target was sent, are usual."""
LATE = (".delay_s", ".time_constant_s")
"""Ends of the names of delays and lags."""
GAINS = ("kp", "kd", "torque_ff")
"""Names of the gains among the fitted numbers."""
OVER_KP = {
    "N·m": "rad",
    "N·m/rad": "1",
    "N·m·s/rad": "s",
    "N·m·s²/rad²": "s²/rad",
    "kg·m²": "s²",
    "kg": "kg·rad/(N·m)",
    "1": "rad/(N·m)",
}
"""Unit of a number → unit of its ratio to K_p [N·m/rad]."""
OVER_KP_OF_SLIDE = {
    "N": "m",
    "N/m": "1",
    "N·s/m": "s",
    "N·s²/m²": "s²/m",
    "kg": "s²",
    "1": "m/N",
}
"""Likewise with K_p of a slide [N/m]."""
INERTIA = "kg·m²"
"""Unit of inertias among the fitted numbers."""
_MOST = 700.0  # exp of it is the largest number there is


@dataclass(frozen=True, kw_only=True)
class Identified:
    """A number with its 95 % interval."""

    name: str
    """Name: ``coulomb_friction.torque_nm/kp``, ``kd/kp``; without ``/kp`` the number itself."""
    value: float
    low: float
    high: float
    unit: str
    """Unit of all three; "1" if dimensionless."""

    def words(self) -> str:
        """Text such as ``coulomb_friction.torque_nm/kp 0.002649 rad (0.002634 … 0.002663)``."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.name} {self.value:.4g}{unit} ({self.low:.4g} … {self.high:.4g})"


@dataclass(frozen=True, kw_only=True)
class Known:
    """Identified and absolute numbers of one part after a fit."""

    identifiable: tuple[Identified, ...]
    """The primary numbers: those that the recordings identify."""
    absolute: tuple[Identified, ...]
    """All numbers of the twin, with intervals that include the unknown timing of the loop."""
    pinned_by: tuple[str, ...]
    """Facts that fix the scale of the torques: commanded gains, recorded effort, known weight. Empty: none."""

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """Name of each absolute number → (low, high) of its 95 % interval."""
        return {n.name: (n.low, n.high) for n in self.absolute}


def identifiable_numbers(
    fit: Fit, commanded: bool, effort: bool, kd: float | None = None
) -> tuple[Identified, ...]:
    """The numbers that the recordings identify, with intervals by the delta method from ``fit.covariance()``: ratios to K_p, and
    absolute numbers where something fixes the scale of the torques.

    Args:
        commanded: gains are known, so that every torque is.
        effort: the motor's effort was recorded, or something else fixes the scale of all torques: those of effects are absolute,
            too. The gains are not: on sampled loops none of 52 intervals held the true K_p.
        kd: K_d [N·m·s/rad], if it is commanded and not fitted: the influence of the loop's timing on an inertia depends on it.
    """
    frees = {f.name: k for k, f in enumerate(fit.frees)}
    if commanded or "kp" not in frees:
        return tuple(_timed(n, _kd_over(fit, "1", kd)) for n in _plain(fit, fit.frees))
    covariance = fit.covariance()
    divided = {name: _ratio_name(name, p) for name, p in _over_kp(fit).items()}
    order = ["kd", "torque_ff", *(f.name for f in fit.frees if f.name not in GAINS)]
    found = []
    for name in [n for n in order if n in frees]:
        if name in divided:
            ratio = _ratio(fit, name, divided[name], covariance)
            found.append(_timed(ratio, _kd_over(fit, "kp", kd)))
        else:
            found += [_timed(n, 0.0) for n in _plain(fit, [fit.frees[frees[name]]])]
    if effort:
        absolute = [f for f in fit.frees if f.name in divided and f.name not in GAINS]
        found += [_timed(n, _kd_over(fit, "1", kd)) for n in _plain(fit, absolute)]
    return tuple(found)


def absolute_numbers(
    fit: Fit, *, inertia_kgm2: float, pinned: bool, kd: float | None = None
) -> tuple[Identified, ...]:
    """Every fitted number, in the order of ``fit.frees``, with its interval, which covers τ between 0 and ``TIMING_S`` if nothing
    fixes the scale of the torques.

    Args:
        inertia_kgm2: inertia of the joint in the twin; the least of all recordings.
        pinned: commanded gains, efforts or known weight fix the scale of the torques.
        kd: K_d [N·m·s/rad], if it is commanded and not fitted.
    """
    plain = [_timed(n, _kd_over(fit, "1", kd)) for n in _plain(fit, fit.frees)]
    if not {"kp", "kd"} <= {f.name for f in fit.frees}:
        return tuple(plain)
    over = _over_kp(fit)
    kd_high = fit.intervals()["kd"][
        1
    ]  # of a gain that nothing determines, the end of its range
    inertia = inertia_kgm2 + sum(
        fit.values[f.name] for f in fit.frees if f.unit == INERTIA and f.name in over
    )
    most = 1.0 + kd_high * TIMING_S / inertia
    open_ = [
        name for name in over if not pinned or name in GAINS
    ]  # efforts fix torques, and the loop's timing still shifts gains
    return tuple(
        _scaled(n, _absent(over[n.name]), most) if n.name in open_ else n for n in plain
    )


def not_told_from_none(
    fit: Fit, effect: str, left_over: bool, age_s: float = 0.0
) -> str:
    """Text on an effect whose strength the recordings do not tell from none: the 95 % intervals of all of its fitted parameters
    that have an absent value hold that value. Empty if one does not, or if no such parameter was fitted.

    0 and ∞ are on no logarithmic scale: there the standard error relative to the value counts, as on a linear scale, so that a
    half width of a factor e or more holds them. A torque counts over K_p, if that ratio is known better.

    Args:
        left_over: whether intervals widen by what the model leaves above the floor (``Fit.covariance``).
        age_s: how much longer than it is a delay or lag may seem to be, by the loop's timing.
    """
    covariance, index = (
        fit.covariance(left_over),
        {f.name: k for k, f in enumerate(fit.frees)},
    )
    kp, texts = index.get("kp"), []
    for p in next(e for e in fit.effects if e.name == effect).parameters():
        name = f"{effect}.{p.name}"
        if p.absent is None or name not in index:
            continue
        k = index[name]
        f, value = fit.frees[k], fit.values[name]
        relative = f.log and not 0.0 < p.absent < math.inf
        far = 1.0 if relative else f.coordinate(value) - f.coordinate(p.absent)
        variance = covariance[k, k]
        if p.over == "kp" and kp is not None:
            variance = min(
                variance,
                variance + far**2 * covariance[kp, kp] - 2.0 * far * covariance[k, kp],
            )
        late_s = age_s * name.endswith(LATE)
        if abs(far) * (
            1.0 - late_s / value if late_s else 1.0
        ) > fit.quantile * math.sqrt(max(variance, 0.0)):
            return ""
        low, high = fit.intervals()[name]
        low = max(low - late_s, 0.0) if late_s else low
        texts.append(
            f"{p.name} {value:.3g} (95 % {low:.3g} … {high:.3g}) is not told from {p.absent:g}"
        )
    return f"{' and '.join(texts)}, where the effect is absent" if texts else ""


def identified_value(name: str, values: Mapping[str, float]) -> float:
    """Value of the number that an ``Identified`` calls ``name``, from other values, such as the truth of a simulated robot.

    Args:
        values: number, such as ``kp`` or ``coulomb_friction.torque_nm`` → value in the unit of its parameter.

    Raises:
        KeyError: ``values`` lacks a number from which it is computed.
    """
    if not name.endswith("/kp"):
        return values[name]
    name, absent = name.removesuffix("/kp"), 0.0
    if name.endswith(")"):
        effect, _, inner = name.partition(".(")
        parameter, _, offset = inner.removesuffix(")").partition("-")
        name, absent = f"{effect}.{parameter}", float(offset)
    return (values[name] - absent) / values["kp"]


def _over_kp(fit: Fit) -> dict[str, Parameter | None]:
    """Numbers of the fit that positions identify only over K_p → their parameter; None for the controller's own."""
    own: dict[str, Parameter | None] = {
        f.name: None for f in fit.frees if f.name in GAINS
    }
    for effect in fit.effects:
        own |= {
            f"{effect.name}.{p.name}": p for p in effect.parameters() if p.over == "kp"
        }
    return {f.name: own[f.name] for f in fit.frees if f.name in own}


def _absent(p: Parameter | None) -> float:
    return (
        p.absent
        if p is not None and p.absent is not None and math.isfinite(p.absent)
        else 0.0
    )


def _ratio_name(name: str, p: Parameter | None) -> str:
    absent = _absent(p)
    if absent == 0.0:
        return f"{name}/kp"
    effect, parameter = name.split(".", 1)
    return f"{effect}.({parameter}-{absent:g})/kp"


def _plain(fit: Fit, frees: Iterable[Free]) -> list[Identified]:
    """All but those whose interval is the whole range in which they were fitted: these are not determined."""
    intervals = fit.intervals()
    return [
        Identified(
            name=f.name, value=fit.values[f.name], low=low, high=high, unit=f.unit
        )
        for f in frees
        for low, high in [intervals[f.name]]
        if low > f.low or high < f.high
    ]


def _ratio(fit: Fit, name: str, ratio_name: str, covariance: np.ndarray) -> Identified:
    """(x − absent) / K_p. Of two numbers on logarithmic scales var(log x − log K_p) = v_xx + v_kk − 2 v_xk."""
    index = {f.name: k for k, f in enumerate(fit.frees)}
    x, kp = fit.frees[index[name]], fit.frees[index["kp"]]
    i, k = index[name], index["kp"]
    value = identified_value(ratio_name, fit.values)
    part = covariance[np.ix_([i, k], [i, k])]
    slide = kp.unit == "N/m"
    table, other = (OVER_KP_OF_SLIDE, "m/N") if slide else (OVER_KP, "rad/(N·m)")
    unit = table.get(x.unit, f"{x.unit} {other}")
    if x.log and kp.log and value == fit.values[name] / fit.values["kp"] and value > 0:
        spread = 1.96 * math.sqrt(max(part[0, 0] + part[1, 1] - 2.0 * part[0, 1], 0.0))
        low, high = (
            math.exp(min(math.log(value) + way, _MOST)) for way in (-spread, spread)
        )
        return Identified(name=ratio_name, value=value, low=low, high=high, unit=unit)
    slopes = np.array(
        [
            _slope(x, fit.values[name]) / fit.values["kp"],
            -value * _slope(kp, fit.values["kp"]) / fit.values["kp"],
        ]
    )
    spread = 1.96 * math.sqrt(max(float(slopes @ part @ slopes), 0.0))
    return Identified(
        name=ratio_name, value=value, low=value - spread, high=value + spread, unit=unit
    )


def _slope(f: Free, value: float) -> float:
    """d value / d coordinate."""
    return value if f.log else f.scale


def _kd_over(fit: Fit, over: str, kd: float | None) -> float:
    """K_d, or K_d / K_p; 0 where K_d is not known."""
    kd = fit.values.get("kd", kd)
    return 0.0 if kd is None else kd / (fit.values["kp"] if over == "kp" else 1.0)


def _timed(n: Identified, kd: float) -> Identified:
    """An inertia is seen less K_d τ: (J + ΔJ − K_d τ) q̈; K_d / K_p is seen less a, a delay or lag more by a. Others are as is."""
    if n.name == "kd/kp":
        return dataclasses.replace(n, high=n.high + POSITION_AGE_S)
    if n.name.endswith(LATE):
        return dataclasses.replace(n, low=max(n.low - POSITION_AGE_S, 0.0))
    if n.unit not in (INERTIA, OVER_KP[INERTIA]):
        return n
    return dataclasses.replace(n, high=n.high + kd * TIMING_S)


def _scaled(n: Identified, absent: float, most: float) -> Identified:
    """With every scale of its torque from 1 down to 1 / ``most``."""
    ends = [absent + (end - absent) / s for end in (n.low, n.high) for s in (1.0, most)]
    return dataclasses.replace(n, low=min(ends), high=max(ends))
