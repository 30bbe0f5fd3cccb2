"""Localise the error of a twin's pads: in contact or not, by phase of a touch, by third of the pad. As in ``localise``, this
shows where the error is, not its cause: creep, hysteresis and a late sensor all cause errors during unloading.

Letters in shapes: N touch frames, R × C taxels.
"""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d

from taccorl.data.timing import runs
from taccorl.diagnosis.comparison.localise import Cell, cell_of
from taccorl.diagnosis.comparison.replays import CONTACT_COUNTS
from taccorl.diagnosis.comparison.result import TouchTrace

PHASES = {
    "loading": "the pad's sum rises",
    "hold": "touched, and the sum stays",
    "unloading": "the pad's sum falls",
    "just released": "the first second after a touch",
    "untouched": "the rest",
}
"""Phase of a touch → its definition for readers."""
EVERYWHERE = ("in contact", "no contact", *PHASES)
"""Regimes of all cells; regimes for parts of the rows follow (``TouchTrace.thirds``)."""
RELEASED_S = 1.0
"""Time after a touch that counts as just released [s]."""
CHANGE_PER_S = 0.25
"""Rate of the summed touch, relative to its largest value [1/s]: faster is loading or unloading, slower is a hold."""
SMOOTH_S = 0.05
"""Standard deviation of the Gaussian that smooths the pad's sum before its slope is taken [s]."""


def phases(trace: TouchTrace, pad: int) -> dict[str, np.ndarray]:
    """Phase of contact (loading, hold, unloading, just released, untouched) → (N,) bool; each frame is in exactly one phase.
    Contact is determined from the poses of pad and object if they are known, else from the measured counts, and loading always
    from the counts."""
    counts = trace.measured[:, pad].reshape(len(trace.measured), -1).astype(float)
    period_s = trace.period_s
    total = gaussian_filter1d(counts.sum(axis=1), SMOOTH_S / period_s)
    rate = np.gradient(total, period_s)
    touched = (
        np.asarray((counts > CONTACT_COUNTS).any(axis=1))
        if trace.touched is None
        else trace.touched[:, pad]
    )
    found = {name: np.zeros(len(total), dtype=bool) for name in PHASES}
    for first, end in runs(touched):
        fast = CHANGE_PER_S * total[first:end].max()
        found["loading"][first:end] = rate[first:end] > fast
        found["unloading"][first:end] = rate[first:end] < -fast
        found["just released"][end : end + round(RELEASED_S / period_s)] = True
    found["just released"] &= ~touched
    found["hold"] |= touched & ~found["loading"] & ~found["unloading"]
    found["untouched"] |= ~touched & ~found["just released"]
    return found


def regimes(trace: TouchTrace, pad: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Regime → its frames (N,) bool and its taxels (R, C) bool. A regime is a phase of contact (all taxels), or a third of the
    pad, such as its tip (all frames)."""
    rows, columns = trace.measured.shape[2:]
    everywhere = np.ones((rows, columns), dtype=bool)
    always = np.ones(len(trace.measured), dtype=bool)
    found = phases(trace, pad)
    quiet = found["just released"] | found["untouched"]
    third = np.arange(rows)[:, None] * len(trace.thirds) // rows
    return {
        "in contact": (~quiet, everywhere),
        "no contact": (quiet, everywhere),
        **{name: (frames, everywhere) for name, frames in found.items()},
        **{
            name: (always, everywhere & (third == k))
            for k, name in enumerate(trace.thirds)
        },
    }


def touch_heat_map(traces: Sequence[TouchTrace]) -> list[Cell]:
    """One cell for every pad and regime with at least 1 % of the readings, over taxels that are above the noise at some time."""
    cells = []
    for pad in dict.fromkeys(pad for t in traces for pad in t.pads):
        own_traces = [t for t in traces if pad in t.pads]
        squares: dict[str, list[np.ndarray]] = {
            name: [] for name in (*EVERYWHERE, *own_traces[0].thirds)
        }
        floor_squares = []
        for t in own_traces:
            p = t.pads.index(pad)
            felt = t.felt(p)
            floor_squares.append(t.floor[p][felt] ** 2)
            for name, (rows, taxels) in regimes(t, p).items():
                squares[name].append(
                    (t.residual[rows, p][:, felt & taxels] ** 2).ravel()
                )
        parts = {name: np.concatenate(found) for name, found in squares.items()}
        total, count = (
            sum(float(parts[n].sum()) for n in PHASES),
            sum(len(parts[n]) for n in PHASES),
        )
        if count == 0:
            continue
        floor = float(np.sqrt(np.mean(np.concatenate(floor_squares))))
        cells += [
            cell_of(pad, "touch", name, own, total, count, floor)
            for name, own in parts.items()
        ]
    return [cell for cell in cells if cell]
