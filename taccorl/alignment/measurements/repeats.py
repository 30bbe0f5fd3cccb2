"""Align two recordings of one motion by their commands, and find equal cycles within one recording, rows whose targets are those
of one period later. The remaining difference is noise and the robot's own variation.

Letters in shapes: M common rows, T rows, J signals.
"""

from dataclasses import dataclass

import numpy as np

from taccorl.alignment.measurements.measurement import Measurement, Stated
from taccorl.data.timing import runs
from taccorl.errors import TaccorlError

SAME_SHARE = 0.01
"""Largest difference of the commands, after alignment, as a share of the motion, for recordings of one motion."""


@dataclass(frozen=True)
class Overlay:
    """The second recording aligned with the rows of the first."""

    shift_s: float  # Time in the second recording − time in the first, at the same command [s]
    difference: dict[str, np.ndarray]
    """position, velocity, effort → (M, J) second − first, during the motion, in the quantity's unit."""
    time_s: np.ndarray  # (M,) time in the first recording [s]
    noise_gain: float
    """Variance of ``difference`` for noise of variance 1 in both recordings: 1 + Σ c², with the weights c of the interpolation
    between rows."""


def overlay(
    first: Measurement, second: Measurement, same_share: float = SAME_SHARE
) -> Overlay:
    """Align ``second`` with ``first``: the time shift is that of the best agreement of their commands, to a fraction of a row.
    ``same_share``: largest difference of the aligned commands, as a share of the motion; larger for loads, which are measured and
    not commanded. Raises TaccorlError: the signals or the commands differ."""
    no_repeat = f"{second.name} does not repeat {first.name}"
    if first.signals != second.signals:
        two = f"{second.name} and {first.name}"
        raise TaccorlError(
            f"{two} have different signals, so that one cannot repeat the other"
        )
    for what in Stated.names():
        one, other = getattr(first, what), getattr(second, what)
        silent = what in ("kp", "kd") and not (
            one and other
        )  # nobody wrote them down: not known to differ
        if one != other and not silent:
            values = f"{what} is {other or 'as usual'} in the latter and {one or 'as usual'} in the former"
            raise TaccorlError(f"{no_repeat}: {values}; correct repeat_of")
    if [m.torque_ff.any() for m in (first, second)] in ([True, False], [False, True]):
        raise TaccorlError(
            f"{no_repeat}: only one of them commands a torque_ff; correct repeat_of"
        )
    a, b = (m.resampled(rate_hz := first.rate_hz) for m in (first, second))
    scale = np.maximum(np.ptp(a.target, axis=0), 1e-9)
    lag = _lag(a.target / scale, b.target / scale)
    share, lag = _refine(a.target, b.target, lag)
    rows, start = _common(a.num_rows, b.num_rows, lag)
    target = _shifted(b.target, start, share, len(rows)) - a.target[rows]
    # The motion lasts from its first command to half a second after its last.
    moving, whole = (
        _moving(a.target[rows], round(0.5 * rate_hz)),
        _moving(a.target, 0).sum(),
    )
    rms = float(np.sqrt(np.mean(target[moving] ** 2))) if moving.any() else 0.0
    motion = float(np.sqrt(np.mean(np.var(a.target, axis=0))))
    speed = rate_hz * np.linalg.norm(np.diff(a.target, axis=0)) / np.sqrt(a.target.size)
    jitter_s = max(
        np.median(np.abs(np.diff(m.time_s) - m.period_s)) for m in (first, second)
    )  # that of their stamps
    # Commands may differ by 0.1 mrad or 0.1 mm: rounding.
    alike = max(same_share * motion, 1e-4, 2.0 * jitter_s * speed)
    # At least half of the shorter recording's motion must be common.
    if not moving.any() or moving.sum() < 0.5 * whole or rms > alike:
        loop = "; torques of an outer loop never repeat: then remove it" * (
            "torque" in first.target_kinds
        )
        squares = (target[moving] ** 2).sum(axis=0)
        most = int(np.argmax(squares))
        where = ""
        if len(squares) > 1 and squares[most] > 0.0:
            where = f", {squares[most] / squares.sum():.0%} of their squares in the target of {first.signals[most]},"
        raise TaccorlError(
            f"{no_repeat}: their commands differ by {rms:.4f} (RMS) of {motion:.4f}{where} "
            f"over {moving.sum() / rate_hz:.1f} s in common; correct repeat_of, or that column if it is not "
            f"what was sent, or record the same command file twice{loop}"
        )
    weights = _weights(share)
    columns = {"position": "measured", "velocity": "velocity", "effort": "effort"}
    both = {
        kind: (getattr(a, name), getattr(b, name)) for kind, name in columns.items()
    }
    difference = {
        k: (_shifted(y, start, share, len(rows)) - x[rows])[moving]
        for k, (x, y) in both.items()
    }
    shift_s = (lag + share) / rate_hz - first.time_s[0] + second.time_s[0]
    return Overlay(
        shift_s, difference, a.time_s[rows][moving], 1.0 + float((weights**2).sum())
    )


def _lag(a: np.ndarray, b: np.ndarray) -> int:
    """Whole rows by which ``b`` (T, J) lies later than ``a``: highest correlation of their steps."""
    da, db = np.diff(a, axis=0), np.diff(b, axis=0)
    size = len(da) + len(db) - 1
    spectrum = np.conj(np.fft.rfft(da, size, axis=0)) * np.fft.rfft(db, size, axis=0)
    correlation = np.fft.irfft(spectrum.sum(axis=1), size)
    best = int(np.argmax(correlation))
    return best - size if best >= len(db) else best


def _refine(a: np.ndarray, b: np.ndarray, lag: int) -> tuple[float, int]:
    """(share of a row in [0, 1), whole rows): lowest point of a parabola through the squared differences of commands."""
    costs = []
    for k in (lag - 1, lag, lag + 1):
        rows, start = _common(len(a), len(b), k)
        costs.append(
            float(np.mean((b[start : start + len(rows)] - a[rows]) ** 2))
            if len(rows)
            else np.inf
        )
    before, at, after = costs
    bend = before - 2 * at + after
    part = 0.5 * (before - after) / bend if np.isfinite(bend) and bend > 0 else 0.0
    if abs(part) < 0.02 or at <= 1e-12:
        return 0.0, lag
    whole = int(np.floor(part))
    return part - whole, lag + whole


def _common(num_a: int, num_b: int, lag: int) -> tuple[np.ndarray, int]:
    """Rows of a that have a partner row + lag in b with neighbours for the shift, and b's row for the first of them."""
    first, end = max(0, 1 - lag), min(num_a, num_b - 2 - lag)
    return np.arange(first, max(first, end)), first + lag


def _weights(share: float) -> np.ndarray:
    """(4,) Lagrange weights of rows −1, 0, 1, 2 for a point at ``share`` of the way from row 0 to row 1."""
    a, b, c, d = share + 1, share, share - 1, share - 2  # from each of the rows
    return np.array([-b * c * d / 6, a * c * d / 2, -a * b * d / 2, a * b * c / 6])


def _shifted(values: np.ndarray, start: int, share: float, count: int) -> np.ndarray:
    """(count, J) of ``values`` from row ``start + share`` on."""
    if share == 0.0:
        return values[start : start + count]
    rows = np.stack([values[start + k : start + k + count] for k in (-1, 0, 1, 2)])
    return np.tensordot(_weights(share), rows, axes=1)


def _moving(target: np.ndarray, after: int) -> np.ndarray:
    """(M,) bool: from the first change of a command to ``after`` rows past the last."""
    changed = np.flatnonzero(np.any(np.diff(target, axis=0) != 0, axis=1))
    inside = np.zeros(len(target), dtype=bool)
    if len(changed):
        inside[changed[0] : changed[-1] + 2 + after] = True
    return inside


SAME = 1e-6  # Largest difference of equal targets, as a share of their range: rounding of logged numbers. A choice.


@dataclass(frozen=True)
class Cycles:
    """The rows ``first`` to ``end`` (exclusive) of a recording have the same targets as those ``period_rows`` later."""

    period_rows: int
    first: int  # First row of the second cycle: the first one begins from rest
    end: int

    def difference(self, values: np.ndarray) -> np.ndarray:
        """(end − first, …) ``values`` (T, …) of one period later minus those of these rows."""
        later = slice(self.first + self.period_rows, self.end + self.period_rows)
        return values[later] - values[self.first : self.end]


def cycles(m: Measurement) -> Cycles | None:
    """Find the shortest period at which the recording's targets repeat for three cycles or more; None if there is none.

    The targets of all signals must repeat, with known loads, added torques, supply and stretches with the motor off. Targets
    that state a velocity or a torque have no cycles: from them positions drift.
    """
    period_s = np.diff(m.time_s)
    if (
        m.num_rows < 4
        or m.command_s.size
        or any(kind != "position" for kind in m.target_kinds)
    ):
        return None
    # Targets of rows that jitter act at other times in each cycle.
    if np.ptp(period_s) > 0.01 * float(np.median(period_s)):
        return None
    columns = np.nan_to_num(
        np.column_stack([m.target, *(getattr(m, name) for name in m.extra_columns)])
    )
    span = np.ptp(columns, axis=0)
    columns = columns[:, span > 0.0] / span[span > 0.0]
    if columns.shape[1] == 0:
        return None
    third = m.num_rows // 3
    at = third + int(
        np.argmax(np.abs(np.diff(columns[third : 2 * third + 1], axis=0)).max(axis=1))
    )
    alike = (np.abs(columns - columns[at]) <= SAME).all(axis=1)
    alike = np.flatnonzero(
        alike[:-1] & (np.abs(columns[1:] - columns[at + 1]) <= SAME).all(axis=1)
    )
    periods = np.unique(np.abs(alike - at))
    # The shortest twenty are tried. A choice.
    for period in periods[(periods > 0) & (periods <= third)][:20].tolist():
        same = np.asarray(
            (np.abs(columns[period:] - columns[:-period]) <= SAME).all(axis=1)
        )
        first, end = max(runs(same), key=lambda run: run[1] - run[0], default=(0, 0))
        # Each target must move by half of its range: a hold is equal at any period.
        if (
            end - first >= 2 * period
            and (np.ptp(columns[first:end], axis=0) >= 0.5).all()
        ):
            return Cycles(period, first + period, end)
    return None
