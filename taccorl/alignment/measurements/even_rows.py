"""Resample a table with jitter or lost rows to an even grid; gaps in the measurement stay gaps.

Row k of the grid is at t_0 + k / rate.

    target      of the row that came last, at most half a period after row k: held between rows. Across lost rows a command
                that changes with every row is on the straight line (the drive received what was streamed); any other is held.
    measured    on the cubic through the four rows around, or the straight line between two, that are at most 1.5 periods apart;
                NaN in gaps. Nothing is interpolated across a gap.
    command_s   arrival time of the row's target: an axis is simulated with targets at their own times.

Jitter above ``MOST_JITTER`` of a period, a gap longer than ``LONGEST_GAP_S``, or more than ``MOST_LOST`` of the rows lost: the
table is not changed, a check states the reason, and functions that need even time reject it.

Letters in shapes: T rows, J signals, G rows of the grid.
"""

import dataclasses

import numpy as np

from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.finding import Finding
from taccorl.sim.twin import PhysicsConfig

EVEN = 0.1  # Steps within this share of the period are even enough for a replay
GAP = 1.5  # A step longer than this [periods] has lost rows
MOST_JITTER = 0.5  # Largest jitter [periods] of 95 % of the steps that are no gaps
LONGEST_GAP_S = 0.25  # Longest gap of a table that is resampled [s]
MOST_LOST = 0.1  # Largest share of lost rows of a table that is resampled


def even_rows(m: Measurement) -> Measurement:
    """``m`` resampled to an even grid, with a finding that states it; ``m`` itself if it is even, or too uneven."""
    steps = np.diff(m.time_s)
    if m.num_rows < 3 or not np.isfinite(m.time_s).all() or (steps <= 0).any():
        return m
    start_s, period = _grid(m.time_s)
    gaps = steps > GAP * period
    off = np.abs(steps - period) / period
    jitter = float(np.quantile(off[~gaps], 0.95)) if (~gaps).any() else np.inf
    lost = int(np.round(steps[gaps] / period - 1).sum())
    if (off < EVEN).all():
        return m
    if (
        jitter > MOST_JITTER
        or (steps[gaps] > LONGEST_GAP_S).any()
        or lost > MOST_LOST * (m.num_rows + lost)
    ):
        return m
    grid = start_s + np.arange(round((m.time_s[-1] - start_s) / period) + 1) * period
    columns = {
        name: _between(grid, m.time_s, getattr(m, name), period)
        for name in ("measured", "velocity", "effort")
    }
    target = _commands(grid, m.time_s, m.target, period)
    inputs = np.array(
        [kind == "effort" for kind in m.target_kinds] or [False]
    )  # no commands, but measured positions
    target = np.where(
        inputs & np.isfinite(columns["measured"]), columns["measured"], target
    )
    command_s = _commands(grid, m.time_s, m.time_s[:, None], period)[:, 0] - grid[0]
    columns |= {
        name: _commands(grid, m.time_s, getattr(m, name), period)
        for name in m.extra_columns
    }
    if m.enabled.size:
        columns["enabled"] = np.where(columns["enabled"] < 0.5, 0.0, 1.0)
    masked = int((~np.isfinite(columns["measured"]).any(axis=1)).sum())
    where = ""
    if gaps.any():
        worst = int(np.flatnonzero(gaps)[np.argmax(steps[gaps])])
        longest = f"{steps[worst] * 1e3:.1f} ms at {m.time_s[worst]:.3f} s"
        where = f", {lost} rows lost in {int(gaps.sum())} gaps, the longest {longest}"
    text = (
        f"rows were not even (steps ± {jitter * period * 1e3:.2f} ms about {period * 1e3:.3f} ms{where}): brought to "
        f"{1 / period:.6g} Hz, {len(grid)} rows, {masked} of them without a measurement; commands are held between rows, "
        "measurements interpolated within a period of jitter, gaps stay gaps. Log the driver's or the bus's own stamps to "
        "avoid it"
    )
    finding = Finding("resampled", "warning", "time", text)
    return dataclasses.replace(
        m,
        time_s=grid - grid[0],
        target=target,
        command_s=command_s,
        **columns,
        findings=(*m.findings, finding),
    )


def _grid(time_s: np.ndarray) -> tuple[float, float]:
    """(start, period) [s]: time over row numbers that count lost rows; the period snapped to whole physics steps."""
    period = float(np.median(np.diff(time_s)))
    number = np.concatenate(
        [[0.0], np.cumsum(np.maximum(np.round(np.diff(time_s) / period), 1.0))]
    )
    period = float(np.polyfit(number, time_s, 1)[0])
    step_s = PhysicsConfig().timestep_s
    whole = max(1, round(period / step_s)) * step_s
    # A rate within 2 % of a whole number of physics steps is set to it.
    period = whole if abs(period / whole - 1) < 0.02 else period
    return float(np.median(time_s - number * period)), period


def _commands(
    grid: np.ndarray, time_s: np.ndarray, target: np.ndarray, period: float
) -> np.ndarray:
    """(G, J) targets in force."""
    last = np.clip(
        np.searchsorted(time_s, grid + 0.5 * period, side="right") - 1,
        0,
        len(time_s) - 1,
    )
    held = target[last]
    following = np.minimum(last + 1, len(time_s) - 1)
    in_gap = (time_s[following] - time_s[last] > GAP * period) & (
        grid > time_s[last] + 0.5 * period
    )
    changes = np.diff(target, axis=0) != 0
    # A command that changes on both sides of a gap was streamed: it is interpolated. Any other command was held.
    streamed = (
        changes[np.clip(last - 1, 0, len(changes) - 1)]
        & changes[np.clip(following, 0, len(changes) - 1)]
    )
    line = np.column_stack([np.interp(grid, time_s, column) for column in target.T])
    return np.where(in_gap[:, None] & streamed, line, held)


def _between(
    grid: np.ndarray, time_s: np.ndarray, values: np.ndarray, period: float
) -> np.ndarray:
    """(G, J) of (T, J) between rows that are near each other; NaN elsewhere."""
    after = np.clip(np.searchsorted(time_s, grid, side="left"), 1, len(time_s) - 1)
    before = after - 1
    width = time_s[after] - time_s[before]
    share = np.clip((grid - time_s[before]) / width, 0.0, 1.0)
    line = values[before] + share[:, None] * (values[after] - values[before])
    near = np.diff(time_s) <= GAP * period
    around = (before >= 1) & (after <= len(time_s) - 2)
    k = before[around]
    whole = near[k - 1] & near[k] & near[k + 1]
    around[around] = whole
    line[around] = _cubic(grid[around], time_s, values, k[whole])
    nearer = np.where(share < 0.5, before, after)
    # Beside a gap, a row within a tenth of a period of a grid row counts as being at it.
    exact = np.abs(grid - time_s[nearer]) < 0.1 * period
    return np.where(
        (width <= GAP * period)[:, None],
        line,
        np.where(exact[:, None], values[nearer], np.nan),
    )


def _cubic(
    at: np.ndarray, time_s: np.ndarray, values: np.ndarray, before: np.ndarray
) -> np.ndarray:
    """(G, J) at times ``at`` on the cubics through rows ``before`` − 1 to ``before`` + 2 (Lagrange). A line errs by a h² / 8,
    which is an encoder's step where a pendulum swings: 1.2 mrad at 100 rad/s² and 100 Hz."""
    rows = before[:, None] + np.arange(-1, 3)
    t = time_s[rows]
    found = np.zeros((len(at), values.shape[1]))
    for k in range(4):
        others = [j for j in range(4) if j != k]
        weight = np.prod([(at - t[:, j]) / (t[:, k] - t[:, j]) for j in others], axis=0)
        found += weight[:, None] * values[rows[:, k]]
    return found
