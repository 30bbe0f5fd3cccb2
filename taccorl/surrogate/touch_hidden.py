"""Effects that can be hidden in the surrogate's pads: the registry's, by name and parameters, with independent code.

Letters in shapes: M milliseconds, K taxels that the object comes near, T frames, R × C taxels of a pad.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from scipy.signal import lfilter

from taccorl.errors import TaccorlError, nearest

Values = dict[str, float]  # Name of a parameter → value in its unit
MILLISECOND = 1e-3  # [s]


@dataclass(frozen=True, kw_only=True)
class TouchKind:
    """One kind of hidden effect of pads: its range of strength, its parameters for a strength, and where it acts."""

    severity: tuple[
        float, float
    ]  # Range of the severity, from hardly visible to the largest realistic one
    values: Callable[[float, np.random.Generator], Values]
    """Function (severity, a board's random generator) → parameters with the registry's names. The same generator state gives the
    same form."""
    stage: str
    """Stage at which it acts: place (depths at other positions), material (each taxel at 1 kHz), spread (whole frames), board
    (gains), baseline."""
    registered: bool = True  # True: the effect is in the registry


def touch_kind(name: str) -> TouchKind:
    """The kind of hidden effect of that name. Raises TaccorlError: there is no hidden effect of that name."""
    if name not in TOUCH_KINDS:
        raise TaccorlError(
            f"surrogate pads: no hidden effect {name!r}; {nearest(name, TOUCH_KINDS)}"
        )
    return TOUCH_KINDS[name]


def _one(parameter: str) -> Callable[[float, np.random.Generator], Values]:
    return lambda s, rng: {parameter: s}


def _signed(parameter: str) -> Callable[[float, np.random.Generator], Values]:
    return lambda s, rng: {parameter: float(rng.choice([-1.0, 1.0])) * s}


def _creep(s: float, rng: np.random.Generator) -> Values:
    share = max(float(rng.choice([-1.0, 1.0])) * s, -0.8)
    return {
        "share": share,
        "time_constant_s": float(np.exp(rng.uniform(np.log(0.3), np.log(4.0)))),
    }


def _power(s: float, rng: np.random.Generator) -> Values:
    return {"exponent": float((1.0 + s) ** rng.choice([-1.0, 1.0]))}


def _shift(s: float, rng: np.random.Generator) -> Values:
    angle = rng.uniform(0, 2 * np.pi)
    return {"across_m": float(s * np.cos(angle)), "along_m": float(s * np.sin(angle))}


TOUCH_KINDS: dict[str, TouchKind] = {
    "depth_offset": TouchKind(
        severity=(5e-6, 6e-4), values=_signed("offset_m"), stage="place"
    ),
    "pad_shift": TouchKind(severity=(3e-5, 4e-3), values=_shift, stage="place"),
    "taxel_power_law": TouchKind(severity=(0.02, 1.5), values=_power, stage="material"),
    "taxel_saturation": TouchKind(
        severity=(0.01, 3.0), values=lambda s, rng: {"limit": 1.0 / s}, stage="material"
    ),
    "taxel_threshold": TouchKind(
        severity=(0.01, 0.6), values=_one("threshold"), stage="material"
    ),
    "taxel_hysteresis": TouchKind(
        severity=(0.01, 0.45), values=_one("half_width"), stage="material"
    ),
    "taxel_creep": TouchKind(severity=(0.02, 1.0), values=_creep, stage="material"),
    "touch_delay": TouchKind(
        severity=(1e-3, 0.15), values=_one("delay_s"), stage="material"
    ),
    "touch_lag": TouchKind(
        severity=(1e-3, 0.3), values=_one("time_constant_s"), stage="material"
    ),
    "taxel_crosstalk": TouchKind(
        severity=(0.01, 0.7), values=_one("share"), stage="spread"
    ),
    "taxel_ghosting": TouchKind(
        severity=(1e-3, 0.15), values=_one("share"), stage="spread"
    ),
    "taxel_gain_spread": TouchKind(
        severity=(0.02, 0.6), values=_one("log_std"), stage="board"
    ),
    "dead_taxels": TouchKind(severity=(0.02, 0.4), values=_one("share"), stage="board"),
    "baseline_drift": TouchKind(
        severity=(0.01, 2.0), values=_signed("rate_per_min"), stage="baseline"
    ),
    # outside the registry: a film that softens with speed, and gains that fall as the board warms up
    "rate_softening": TouchKind(
        severity=(1.0, 400.0),
        values=_one("per_mps"),
        stage="material",
        registered=False,
    ),
    "warming_gain": TouchKind(
        severity=(0.05, 3.0),
        values=_one("fall_per_min"),
        stage="baseline",
        registered=False,
    ),
}
"""Name → kind."""
REGISTERED_TOUCH = tuple(
    name for name, k in TOUCH_KINDS.items() if k.registered
)  # Names of the kinds in the registry
_DRAWN = [name for name, k in TOUCH_KINDS.items() if k.stage in ("board", "baseline")]
EXACT_TOUCH = tuple(
    name for name in REGISTERED_TOUCH if name not in (*_DRAWN, "taxel_power_law")
)
"""Those that all parameters of the registry determine; single taxels' gains and drifts are drawn."""
OUTSIDE_TOUCH = tuple(name for name, k in TOUCH_KINDS.items() if not k.registered)
"""Names of the kinds outside the registry."""


def material(
    name: str, values: Values, reading: np.ndarray, rate_mps: np.ndarray
) -> np.ndarray:
    """Readings (M, K) after an effect of the pad's material or driver, taxel by taxel; rows are milliseconds. ``reading``: (M, K)
    readings before it. ``rate_mps``: (M, K) depth rates [m/s]."""
    match name:
        case "taxel_power_law":
            return np.exp(values["exponent"] * np.log(np.maximum(reading, 1e-12))) * (
                reading > 0
            )
        case "taxel_saturation":  # supply voltage over two resistors in a row, of which one falls with pressure
            fixed, pressed = 1.0, values["limit"] / np.maximum(reading, 1e-9)
            return values["limit"] * fixed / (fixed + pressed) * (reading > 0)
        case "taxel_threshold":
            return np.where(
                reading > values["threshold"], reading - values["threshold"], 0.0
            )
        case "taxel_hysteresis":
            return _bouc_wen(
                reading, np.log1p(-values["half_width"]), np.log1p(values["half_width"])
            )
        case "taxel_creep":
            return _chain(reading, values["share"], values["time_constant_s"])
        case "touch_delay":
            at = np.arange(len(reading)) - values["delay_s"] / MILLISECOND
            before = np.clip(np.floor(at).astype(int), 0, len(reading) - 1)
            after, share = (
                np.minimum(before + 1, len(reading) - 1),
                np.clip(at - before, 0.0, 1.0)[:, None],
            )
            return reading[before] * (1 - share) + reading[after] * share
        case "touch_lag":
            rate = MILLISECOND / values["time_constant_s"]
            return _low_pass(reading, rate / (1.0 + 0.5 * rate))  # the trapezoidal rule
        case "rate_softening":
            return reading / (1.0 + values["per_mps"] * np.abs(rate_mps))
    raise AssertionError(name)


@numba.njit(cache=True)
def _bouc_wen(reading, low, high):
    """ρ = ln(r / f) follows dρ = −dln f (1 − (ρ / end)⁴) on the way to its end ``low`` (loading) or ``high`` (unloading)."""
    out = np.zeros_like(reading)
    for k in range(reading.shape[1]):
        rho, before = low, 0.0
        for m in range(reading.shape[0]):
            f = reading[m, k]
            if f <= 0.0:
                rho, before = low, 0.0
                continue
            if before > 0.0:
                way = np.log(f / before)
                parts = int(abs(way) / (0.1 * (high - low))) + 1
                for _ in range(parts):
                    end = low if way > 0.0 else high
                    share = rho / end if rho * end > 0.0 else 0.0
                    rho -= way / parts * (1.0 - min(share, 1.0) ** 4)
                    rho = min(max(rho, low), high)
            before = f
            out[m, k] = f * np.exp(rho)
    return out


def _chain(reading: np.ndarray, share: float, time_constant_s: float) -> np.ndarray:
    """Two springs with dampers in a row, of 0.8 and 1.25 times the time constant; Heun's steps."""
    rates = (MILLISECOND / (factor * time_constant_s) for factor in (0.8, 1.25))
    crept = sum(_low_pass(reading, rate * (1.0 - 0.5 * rate)) for rate in rates)
    return np.maximum(reading + 0.5 * share * crept, 0.0)


def _low_pass(reading: np.ndarray, rate: float) -> np.ndarray:
    """First order from 0: each step goes ``rate`` of the way to the mean of a reading and the one before."""
    return lfilter([0.5 * rate, 0.5 * rate], [1.0, rate - 1.0], reading, axis=0)


def spread(name: str, values: Values, frames: np.ndarray) -> np.ndarray:
    """``frames`` (T, R, C) of one pad after crosstalk in wires and cover; returns (T, R, C)."""
    match name:
        case (
            "taxel_crosstalk"
        ):  # along rows, then along columns: corners get a little as well
            for axis in (1, 2):
                flow = np.diff(frames, axis=axis)  # none over the edges
                frames = frames + 0.25 * values["share"] * np.diff(
                    flow, axis=axis, prepend=0.0, append=0.0
                )
            return frames
        case "taxel_ghosting":
            wires = (
                np.einsum("trc->tr", frames)[:, :, None]
                + np.einsum("trc->tc", frames)[:, None, :]
            )
            return (1.0 - 2.0 * values["share"]) * frames + values["share"] * wires
    raise AssertionError(name)


def board(
    name: str, values: Values, rng: np.random.Generator, shape: tuple[int, ...]
) -> np.ndarray:
    """(R, C) gains of one pad's taxels for a hidden effect of the board. ``name``: ``taxel_gain_spread`` or ``dead_taxels``.
    ``shape``: (R, C)."""
    match name:
        case "taxel_gain_spread":
            return np.exp(values["log_std"] * rng.standard_normal(shape))
        case "dead_taxels":
            return (rng.random(shape) >= values["share"]).astype(float)
    raise AssertionError(name)
