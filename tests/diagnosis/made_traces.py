"""Traces and comparisons made by arithmetic, whose answers can be written down."""

from typing import Any

import numpy as np

from taccorl.alignment.measurements.noise_floor import NoiseEstimate, SignalFloor
from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.result import Comparison, TouchTrace, Trace

RATE_HZ = 200.0
FLOOR_RAD = 2e-4
ORIGIN = Origin(text="made by arithmetic, not a robot")


def floor(
    value: float = FLOOR_RAD, kind: str = "position", *, lower_bound: bool = False
) -> SignalFloor:
    used = NoiseEstimate("repeats", value, value, value, 100)
    return SignalFloor("left_joint5", kind, "rad", used, (used,), lower_bound)  # pyright: ignore[reportArgumentType]


def swing(
    seconds: float = 10.0, hz: float = 0.5, amplitude: float = 0.3
) -> tuple[np.ndarray, np.ndarray]:
    """(T,) times and positions of a sine."""
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return time_s, amplitude * np.sin(2 * np.pi * hz * time_s)


def trace(residual: np.ndarray, position: np.ndarray, **fields: Any) -> Trace:
    """A joint that moves along ``position`` and whose replay is off by ``residual``."""
    return Trace(
        **{
            "recording": "made",
            "use": "validation",
            "signal": "left_joint5",
            "kind": "position",
            "unit": "rad",
            "way": "joint",
            "time_s": np.arange(len(position)) / RATE_HZ,
            "target": position,
            "position": position,
            "measured": position,
            "replayed": position - residual,
            "torque": np.zeros(len(position)),
            "touched": np.zeros(len(position), dtype=bool),
            "floor": floor(),
            "origin": ORIGIN,
        }
        | fields
    )


def comparison(*traces: Trace, **fields: Any) -> Comparison:
    split = {
        "rule": "by hand",
        "fit": [],
        "validation": [t.recording for t in traces],
        "test": [],
        "skipped": [],
    }
    return Comparison(
        **{"twin": "made twin", "effects": (), "traces": traces, "split": split}
        | fields
    )


def touch_trace(
    measured: np.ndarray, replayed: np.ndarray, floor_count: float, **fields: Any
) -> TouchTrace:
    """Readings [counts] of P pads of R × C taxels in N frames at 100 Hz, (N, P, R, C); one noise floor for all taxels."""
    time_s = np.repeat(
        np.arange(len(measured))[:, None] / 100, measured.shape[1], axis=1
    )
    own = {
        "recording": "press",
        "use": "validation",
        "pads": ("left_a", "left_b"),
        "origin": ORIGIN,
        "time_s": time_s,
    }
    floor = np.full(measured.shape[1:], floor_count)
    return TouchTrace(
        **own | {"measured": measured, "replayed": replayed, "floor": floor} | fields
    )


def alike(rng: np.random.Generator, size: int, time_s: float = 0.1) -> np.ndarray:
    """Noise of variance 1 whose neighbours are alike for ``time_s``: y_k = a y_(k−1) + √(1 − a²) e_k."""
    from scipy.signal import lfilter

    a = float(np.exp(-1 / (RATE_HZ * time_s)))
    return lfilter([np.sqrt(1 - a * a)], [1, -a], rng.normal(size=size + 500))[500:]
