"""Distinguish a joint at a mechanical stop from one whose encoder's range ended, by the time at which the reading changes again.

In both cases the reading is constant while the command is beyond it. If the *reading* ended, the joint moved on: the reading
changes when the joint's free response comes back, about a lag τ (0.1 s on a PiPER) after the command. A joint that stood at a
*stop* was held there: it moves as soon as the command is back. With u = g q*(t − d) + b, everything mirrored for a lower end,
and τ, d, g from ``first_order``, fitted to the rows of free motion:

    free      f ← u + (f − u) e^(−h/τ)                   comes back below the reading q_held
    stopped   q ← min(q_held, u + (q − u) e^(−h/τ))      leaves q_held

The hypothesis whose time is nearer to the measured one is chosen.
"""

import math

import numpy as np

from taccorl.alignment.checks.first_order import LEAST_ROWS, fit_first_order
from taccorl.data.timing import runs
from taccorl.errors import TaccorlError

SETTLED_S = 0.3
"""Time after a hold in which a stop still influences the motion [s] (three time constants τ of 0.1 s): its rows are not
fitted."""


def stood_at_stop(
    target: np.ndarray, measured: np.ndarray, period_s: float, rows: tuple[int, int], sign: float, near: float
) -> bool:
    """True if the end of the hold shows a joint at a stop; False if it does not, or is unclear.

    Args:
        target: (T,) commands [rad].
        measured: (T,) readings [rad]; NaN where not measured.
        period_s: time between two rows.
        rows: first row and last row + 1 of the constant readings.
        sign: +1 for an upper end of the range, −1 for a lower end.
        near: readings within this distance [rad] of the held one may also be at the end, and are not used as free motion.
    """
    first, end = rows
    if end >= len(target):
        return False
    up, seen, held = sign * target, sign * measured, sign * float(measured[first])
    free = np.isfinite(seen)
    for start, stop in runs(np.asarray(seen >= held - near)):
        free[start : stop + round(SETTLED_S / period_s)] = False
    if free.sum() < LEAST_ROWS:
        return False
    try:
        fit = fit_first_order(up, np.where(free, seen, np.nan), period_s)
    except TaccorlError:
        return False
    keep = math.exp(-period_s / fit.time_constant_s)
    at = np.arange(len(up))
    answer = fit.response(up, period_s)
    offset = float(np.mean((seen - answer)[free]))
    command, answer = fit.gain * np.interp(at - fit.delay_s / period_s, at, up - up[0]) + offset, answer + offset
    steps = np.abs(np.diff(seen[np.isfinite(seen)]))
    below = held - 0.5 * float(np.min(steps[steps > 0]))  # a reading changes half a step from the held one
    stopped = np.full(len(up), held)
    for k in range(first, len(up) - 1):
        stopped[k + 1] = min(held, command[k] + (stopped[k] - command[k]) * keep)
    beyond = first + int(np.argmax(command[first:end]))  # both come back after this row
    back = [_first(answer < below, beyond), _first(stopped < below, beyond)]
    return abs(back[1] - end) < abs(back[0] - end)


def _first(reached: np.ndarray, after: int) -> int:
    """The first row from ``after`` on where ``reached`` is true; the number of rows if there is none."""
    found = np.flatnonzero(reached[after:])
    return after + int(found[0]) if len(found) else len(reached)
