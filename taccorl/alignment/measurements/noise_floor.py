"""Noise floor of every signal, the error that a perfect twin would still have, estimated from the recordings.

    repeats       RMS difference of two recordings of one motion / √2, after aligning them in time
    cycles        the same of equal cycles within one recording, from the second on (``cycles``)
    rest          RMS about a straight line while no motion was commanded
    residue       RMS about a Savitzky–Golay smooth that does not change the motion, / √(1 − h₀)
    quantisation  q / √12, q the encoder's step

Repeats are used if there are any, because they contain the robot's own variation. If few blocks hold most of their
difference (bursts), their median is used, so that the floor does not contain the bursts. A recording that differs ``ODD`` times
as much as the other repeats (a late clock, another load) is left out; of a single pair nothing tells which is right
(``is_unknown``). Without repeats the more certain one of rest and residue is used (the other one if it is clearly larger), which
is a lower bound, or cycles if they differ by more. The floor is never below the quantisation, and never 0 (``NUMBER``,
``EXACT``). All estimates are reported.

Letters in shapes: T rows, J signals, B blocks of rows, K taxels.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.signal import savgol_coeffs, savgol_filter
from scipy.stats import chi2
from scipy.stats import t as student

from taccorl.alignment.measurements.folder import motions, repeat_pairs
from taccorl.alignment.measurements.measurement import UNITS, Measurement
from taccorl.alignment.measurements.repeats import Overlay, cycles, overlay
from taccorl.errors import TaccorlError

Kind = Literal[
    "position", "velocity", "effort"
]  # Quantity of a signal whose noise is estimated
Method = Literal["repeats", "cycles", "rest", "residue", "quantisation", "number"]
"""How the noise was estimated, a row of the table above; ``number``: the least floor allowed, ``NUMBER`` or ``EXACT``."""
SETTLE_S = 1.5
"""Time after the last command until a joint counts as at rest [s]: with time constants of about 0.1 s, exp(−15) of the motion
remains."""
REST_TARGET = 2e-5  # Range within which a command counts as resting [rad, m]: 0.001°, PiPER's resolution
WINDOW, ORDER = 9, 4
"""Window [rows] and order of the Savitzky–Golay smooth. It follows motion up to 0.61 of half the row rate (Schafer 2011, f_c =
(ORDER + 1) / (3.2 M − 4.6), M = 4)."""
BANDWIDTH_FACTOR = 5.0
"""Least ratio of the smooth's bandwidth to the motion's highest frequency: with 5 the smooth misses 2 · 10⁻⁵ of the motion."""
MOTION_POWER = 0.99  # Share of the motion's power that defines its highest frequency
OTHER_START = 5.0
"""Two recordings of one motion began at different positions if they differ by so many times their usual difference."""
MOVING = (
    1e-3  # Range within which a command is no motion with a relevant bandwidth [rad, m]
)
BURST_POWER, BURST_SHARE, BURST_RATIO = 0.8, 0.25, 3.0
"""Repeats differ in bursts if less than ``BURST_SHARE`` of the blocks hold ``BURST_POWER`` of the squared difference, and the
RMS of all is ``BURST_RATIO`` times that of the typical block."""
ODD = 5.0
"""A repeat is left out if the RMS of its typical block is more than this many times the others' median. A choice."""
DISAGREE = 3.0  # Ratio of the floor from repeats to that from rest, residue or rounding above which they disagree
NUMBER = (
    2.0**-24
)  # Last bit of a 32-bit number of size 1: no floor is smaller than this rounding
EXACT = 1e-3
"""Least noise floor of an effort, as a share of its standard deviation. A choice: simulated efforts have no noise at all."""


@dataclass(frozen=True)
class NoiseEstimate:
    """One estimate of the noise of one signal, in the signal's unit."""

    method: Method  # How it was estimated
    value: float
    low: float
    high: float
    n: int
    without_bursts: bool = False
    """True if a few short blocks of time hold most of the difference between two repeats of a motion, so that ``value`` was
    computed from the median block instead of from all blocks."""
    left_out: tuple[tuple[str, float], ...] = ()
    """Repeats that were left out: name of the recording, its difference over that of the others."""
    pairs: int = 0  # Number of pairs of repeats that were used


@dataclass(frozen=True)
class SignalFloor:
    """The noise floor of one signal: the estimate that is used, and all others."""

    signal: str
    kind: Kind  # Quantity: position, velocity or effort
    unit: str  # Unit of the quantity, such as rad/s
    used: NoiseEstimate  # Estimate that is the floor
    estimates: tuple[NoiseEstimate, ...]  # All estimates that could be made
    lower_bound: bool  # True without repeats and equal cycles: the robot's own variation is then not included

    @property
    def value(self) -> float:
        """The floor, a standard deviation in ``unit``; always above 0."""
        return self.used.value

    @property
    def quiet(self) -> float:
        """The largest estimate from rest, residue and rounding, without use of repeats; ``value`` if there is none."""
        quiet = ("rest", "residue", "quantisation")
        return max(
            (e.value for e in self.estimates if e.method in quiet), default=self.value
        )

    @property
    def is_unknown(self) -> bool:
        """Whether a single pair of repeats differs by so much more than the noise of its rows that one of them may be wrong."""
        return self.used.pairs == 1 and self.value > DISAGREE * self.quiet

    def words(self) -> str:
        """Text such as ``0.204 mrad (0.198 … 0.211, from repeats, n = 4000)``."""
        factor, prefix = (1e3, "m") if self.kind != "effort" else (1.0, "")
        a, b, c = (
            f"{x * factor:.3g}"
            for x in (self.used.value, self.used.low, self.used.high)
        )
        bound = "; a lower bound: record the motion twice" if self.lower_bound else ""
        times = f"{self.value / self.quiet:.0f} times"
        bound += (
            f"; not known: two recordings differ {times} as much as rows"
            * self.is_unknown
        )
        bursts = ", bursts left out" if self.used.without_bursts else ""
        bursts += "".join(f", without {name}" for name, _ in self.used.left_out)
        return f"{a} {prefix}{self.unit} ({b} … {c}, from {self.used.method}{bursts}, n = {self.used.n}{bound})"


def noise_floor(
    measurements: Sequence[Measurement],
    kind: Kind = "position",
    unexplained: Sequence[Measurement] = (),
) -> dict[str, SignalFloor]:
    """Estimate the noise floor of every signal. ``measurements``: measurements of one robot. Those with ``repeat_of`` are aligned
    with the recording that they repeat. ``kind``: quantity whose noise is estimated. ``unexplained``: the same measurements, from
    whose efforts a share of a twin's is subtracted, for joints without a target: repeats whose motions differ then differ less.
    The noise between rows is then the least that is returned. Returns signal → its floor; signals that were never recorded
    (effort, velocity) are left out. Raises TaccorlError: there is no measurement, signals differ, or a repeat has other
    commands."""
    measurements = list(measurements)
    if not measurements:
        raise TaccorlError("noise floor: no measurement")
    signals, units = measurements[0].signals, measurements[0].units
    for m in (m for m in measurements if m.signals != signals):
        two = f"{m.name} and {measurements[0].name}"
        raise TaccorlError(
            f"noise floor: {two} have different signals; read them separately"
        )
    pairs = laid_pairs(unexplained or measurements)
    blocks: dict[Method, list[_Blocks]] = {
        "repeats": [
            _repeat_blocks(a.rate_hz, b.name, laid, kind) for a, b, laid in pairs
        ],
        "cycles": [_cycle_blocks(m, kind) for m in measurements],
        "rest": [_rest_blocks(m, kind) for m in measurements],
        "residue": [_residue_blocks(m, kind) for m in measurements],
    }
    estimates = {
        method: _estimate(method, found, len(signals), kind)
        for method, found in blocks.items()
    }
    floors = {}
    for j, (signal, unit) in enumerate(zip(signals, units, strict=True)):
        values = np.concatenate([_values(m, kind)[:, j] for m in measurements])
        if not np.isfinite(values).any():
            continue
        found = [e for method in blocks if (e := estimates[method][j]) is not None]
        step = (
            max(float(m.quantum[j]) for m in measurements)
            if kind == "position"
            else 0.0
        )
        if step > 0:
            rounding = step / math.sqrt(12)
            found.append(
                NoiseEstimate(
                    "quantisation",
                    rounding,
                    rounding,
                    rounding,
                    int(np.isfinite(values).sum()),
                )
            )
        last = float(
            max(
                NUMBER * max(1e-3, np.nanmax(np.abs(values))),
                EXACT * (kind == "effort") * np.nanstd(values),
            )
        )
        used = _chosen(found, bool(unexplained)) or NoiseEstimate(
            "number", last, last, last, 0
        )
        if used.value < last:
            used = NoiseEstimate("number", last, last, last, used.n)
        name = {"position": unit, "velocity": UNITS[unit][0], "effort": UNITS[unit][1]}[
            kind
        ]
        repeated = any(e.method in ("repeats", "cycles") for e in found)
        floors[signal] = SignalFloor(
            signal, kind, name, used, tuple(found), lower_bound=not repeated
        )
    return floors


def floors_by_motion(
    measurements: Sequence[Measurement],
    kind: Kind = "position",
    unexplained: Sequence[Measurement] = (),
) -> dict[str, dict[str, SignalFloor]]:
    """Noise floors of each recording: recording → signal → floor. If its motion was repeated, the floor is estimated from the
    recordings of that motion, else from all ``measurements``. The noise of an effort grows with gains and motion, so its floor
    is at least the ``residue`` of the recording. Arguments and errors as of ``noise_floor``."""
    roots, every = motions(measurements), noise_floor(measurements, kind, unexplained)
    own: dict[str, dict[str, SignalFloor]] = {}
    for root in dict.fromkeys(roots.values()):
        group, left = (
            [m for m in of if roots[m.name] == root]
            for of in (measurements, unexplained)
        )
        own[root] = every | (
            noise_floor(group, kind, left) if repeat_pairs(group) else {}
        )
    found = {name: dict(own[root]) for name, root in roots.items()}
    for m in measurements if kind == "effort" else ():
        for signal, alone in noise_floor([m], kind).items():
            for residue in (e for e in alone.estimates if e.method == "residue"):
                if residue.value > (there := found[m.name][signal]).value:
                    found[m.name][signal] = dataclasses.replace(there, used=residue)
    return found


def laid_pairs[M: Measurement](measurements: Iterable[M]) -> list[tuple[M, M, Overlay]]:
    """``repeat_pairs`` with their overlays. Where the first of three or more recordings of a motion is the odd one, as it differs
    ``ODD`` times as much from most others as these do from each other, the second stands in its place."""
    pairs = [(a, b, overlay(a, b)) for a, b in repeat_pairs(measurements)]
    for name in dict.fromkeys(a.name for a, _, _ in pairs):
        own = [pair for pair in pairs if pair[0].name == name]
        if len(own) < 2:
            continue
        (first, second, _), *others = own
        among = [(second, b, overlay(second, b)) for _, b, _ in others]
        usual, odd = (
            np.median([_typical(laid) for _, _, laid in of], axis=0)
            for of in (among, own)
        )
        if ((odd > ODD**2 * usual) & (usual > 0.0)).any():
            pairs = [p for p in pairs if p not in own] + [
                (second, first, overlay(second, first)),
                *among,
            ]
    return pairs


def _typical(laid: Overlay) -> np.ndarray:
    """(J,) median of the squared differences of positions; 0 where none was measured."""
    squares = np.square(laid.difference["position"])
    return np.array(
        [
            np.median(own[np.isfinite(own)]) if np.isfinite(own).any() else 0.0
            for own in squares.T
        ]
    )


def touch_floor(measurements: Iterable[Measurement]) -> np.ndarray | None:
    """(K,) noise of every taxel [counts] from the residue at the pads' own rate, at least 1 / √12; None without touch."""
    touched = [m.touch for m in measurements if m.touch is not None]
    frames = [
        (t.counts.astype(np.float32), 1.0 / float(np.median(np.diff(t.time_s[:, 0]))))
        for t in touched
    ]
    values = residue_floor(frames) if frames else np.zeros(0)
    return (
        np.maximum(values, 1.0 / math.sqrt(12))
        if values.size and np.isfinite(values).all()
        else None
    )


def residue_floor(channels: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
    """(K,) noise of each column by the residue method, in the unit of the values; NaN if all channels are too short. The median
    over blocks is used, because contact changes in few of them. Blocks of more than half NaN are not used.
    ``channels``: several (values (T, K), rate [Hz]), with the same K columns."""
    found = [
        b
        for b in (_smooth_blocks(values, rate_hz) for values, rate_hz in channels)
        if len(b.mean_squares)
    ]
    if not found:
        return np.full(channels[0][0].shape[1], np.nan)
    own = [
        column[np.isfinite(column)]
        for column in np.concatenate([b.mean_squares for b in found]).T
    ]
    return np.sqrt(
        [float(_median(c, found[0].freedom)) if len(c) else np.nan for c in own]
    )


def _chosen(found: list[NoiseEstimate], is_smoothed: bool) -> NoiseEstimate | None:
    """Repeats; else the surer one of rest and residue, unless the other lies above its interval, or cycles if these are larger;
    never below rounding, nor below noise of rows if repeats are ``is_smoothed``."""
    by = {e.method: e for e in found}
    surer, other = by.get("rest"), by.get("residue")
    if surer is None or (
        other is not None and other.high - other.low < surer.high - surer.low
    ):
        surer, other = other, surer
    if surer is not None and other is not None and other.low > surer.high:
        surer = other
    own = (
        [by["repeats"]]
        if "repeats" in by
        else [e for e in (surer, by.get("cycles")) if e is not None]
    )
    own += [surer] if is_smoothed and surer is not None else []
    own += [by["quantisation"]] if "quantisation" in by else []
    return max(own, key=lambda e: e.value, default=None)


def _values(m: Measurement, kind: Kind) -> np.ndarray:
    return {"position": m.measured, "velocity": m.velocity, "effort": m.effort}[kind]


@dataclass(frozen=True)
class _Blocks:
    """Mean squares of blocks of one recording, scaled so that white noise of variance σ² gives σ² on average."""

    mean_squares: np.ndarray  # (B, J); NaN where a block says nothing about a signal
    rows: int  # Rows in a block
    freedom: float  # Degrees of freedom of a block of white noise
    name: str = ""  # Name of the recording that repeats another


def _repeat_blocks(rate_hz: float, name: str, laid: Overlay, kind: Kind) -> _Blocks:
    rows = _block_rows(rate_hz)
    squares = (
        _mean_squares(without_beginning(laid.difference[kind], rate_hz), rows)
        / laid.noise_gain
    )
    return _Blocks(squares, rows, float(rows), name)


def _cycle_blocks(m: Measurement, kind: Kind) -> _Blocks:
    rows, values = _block_rows(m.rate_hz), _values(m, kind)
    found = cycles(m)
    squares = (
        np.empty((0, values.shape[1]))
        if found is None
        else _mean_squares(found.difference(values), rows) / 2.0
    )
    return _Blocks(squares, rows, float(rows))


def without_beginning(difference: np.ndarray, rate_hz: float) -> np.ndarray:
    """(T, J) with NaN at first, in whole blocks, while the two differ ``OTHER_START`` times as much as later: a joint with dry
    friction rests elsewhere each time, until it is moved. That is no noise: the twin begins where the recording began."""
    rows = _block_rows(rate_hz)
    squares = _mean_squares(difference, rows)
    if not len(squares):
        return difference
    measured = np.where(np.isfinite(squares).any(axis=0), squares, 0.0)
    usual = OTHER_START**2 * np.nanmedian(measured, axis=0)
    blocks = np.logical_and.accumulate(squares > usual, axis=0).sum(axis=0)
    return np.where(
        np.arange(len(difference))[:, None] < rows * blocks, np.nan, difference
    )


def _rest_blocks(m: Measurement, kind: Kind) -> _Blocks:
    """Blocks in which no joint is commanded to move, each about its own straight line."""
    rows = _block_rows(m.rate_hz)
    values = _values(m, kind)
    line = np.column_stack([np.ones(rows), np.linspace(-1, 1, rows)])
    projector = line @ np.linalg.pinv(line)
    found = []
    for first, end in rest_stretches(m):
        for at in range(first, end - rows + 1, rows):
            block = values[at : at + rows]
            found.append(((block - projector @ block) ** 2).sum(axis=0) / (rows - 2))
    return _Blocks(np.array(found).reshape(-1, values.shape[1]), rows, float(rows - 2))


def rest_stretches(m: Measurement) -> list[tuple[int, int]]:
    """[first, end) rows of every interval in which all commands rest, from 1.5 s (``SETTLE_S``) after the last motion on."""
    changed = (
        np.flatnonzero(np.any(np.abs(np.diff(m.target, axis=0)) > REST_TARGET, axis=1))
        + 1
    )
    settle = round(SETTLE_S / m.period_s)
    begins, ends = [0, *(changed + settle).tolist()], [*changed.tolist(), m.num_rows]
    return [
        (begin, end) for begin, end in zip(begins, ends, strict=True) if end > begin
    ]


def _residue_blocks(m: Measurement, kind: Kind) -> _Blocks:
    """Blocks about the smooth; NaN for signals that move too fast for it."""
    jumps = _jumps(m) if kind == "effort" else None
    blocks = _smooth_blocks(_values(m, kind), m.rate_hz, jumps)
    half = WINDOW // 2
    reach_hz = (ORDER + 1) / (3.2 * half - 4.6) * m.rate_hz / 2
    fast = motion_hz(m) * BANDWIDTH_FACTOR > reach_hz
    blocks.mean_squares[:, fast] = np.nan
    return blocks


def _jumps(m: Measurement) -> np.ndarray:
    """(T, J) bool: rows of which the smooth takes in a step of the joint's target, as an
    effort jumps there. None where targets step so often that less than half is left."""
    steps = np.abs(np.diff(m.target, axis=0, prepend=m.target[:1])) > MOVING
    near = maximum_filter1d(steps, WINDOW, axis=0)
    held = np.median(np.abs(np.diff(m.target, axis=0)), axis=0) == 0.0
    return near & held & (near.mean(axis=0) < 0.5)


def _smooth_blocks(
    values: np.ndarray, rate_hz: float, left_out: np.ndarray | None = None
) -> _Blocks:
    """``left_out``: (T, J) bool, rows that do not count."""
    rows = _block_rows(rate_hz)
    half = WINDOW // 2
    if len(values) < WINDOW + rows:
        return _Blocks(np.empty((0, values.shape[1])), rows, 1.0)
    residue = values - savgol_filter(values, WINDOW, ORDER, axis=0, mode="nearest")
    if left_out is not None:
        residue[left_out] = np.nan
    residue = residue[half:-half]
    kernel = -savgol_coeffs(WINDOW, ORDER)
    kernel[half] += 1.0
    correlation = np.convolve(kernel, kernel[::-1])
    passed = float(
        correlation[WINDOW - 1]
    )  # 1 − h₀: the share of white noise that the residue keeps
    freedom = rows * passed**2 / float((correlation**2).sum())
    return _Blocks(_mean_squares(residue, rows) / passed, rows, freedom)


def motion_hz(m: Measurement) -> np.ndarray:
    """(J,) frequency below which ``MOTION_POWER`` of each joint's motion lies [Hz]; 0 for joints without commanded motion."""
    found = np.zeros(len(m.signals))
    window = np.hanning(m.num_rows)
    frequency = np.fft.rfftfreq(m.num_rows, m.period_s)
    for j in np.flatnonzero(np.ptp(m.target, axis=0) > MOVING):
        known = np.isfinite(m.measured[:, j])
        x = (
            np.interp(m.time_s, m.time_s[known], m.measured[known, j])
            if known.any()
            else np.zeros(m.num_rows)
        )
        power = np.cumsum(np.abs(np.fft.rfft((x - x.mean()) * window)) ** 2)
        found[j] = (
            frequency[int(np.searchsorted(power, MOTION_POWER * power[-1]))]
            if power[-1] > 0
            else 0.0
        )
    return found


def _block_rows(rate_hz: float) -> int:
    """Rows in a block of a quarter of a second, or of 24 rows: 0.8 s at 30 rows per
    second. Estimates are made per block, and their scatter gives the interval."""
    return max(24, round(0.25 * rate_hz))


def _mean_squares(values: np.ndarray, rows: int) -> np.ndarray:
    """(B, J) of the whole blocks in ``values`` (T, J), NaN where most rows are NaN; (0, J) if T is less than ``rows``."""
    count = len(values) // rows
    squares = values[: count * rows].reshape(count, rows, values.shape[1]) ** 2
    known = np.isfinite(squares)
    enough = known.mean(axis=1) >= 0.5  # lost rows leave gaps everywhere
    return np.where(
        enough,
        np.where(known, squares, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1),
        np.nan,
    )


def _estimate(
    method: Method, blocks: list[_Blocks], num_signals: int, kind: Kind
) -> list[NoiseEstimate | None]:
    """One estimate per signal over the blocks of all recordings; None where there are none."""
    blocks = [b for b in blocks if len(b.mean_squares)]
    if not blocks:
        return [None] * num_signals
    rows, freedom = min(b.rows for b in blocks), min(b.freedom for b in blocks)
    found: list[NoiseEstimate | None] = []
    for j in range(num_signals):
        parts = [
            (b.name, own[np.isfinite(own)])
            for b in blocks
            for own in (b.mean_squares[:, j],)
        ]
        parts = [part for part in parts if len(part[1])]
        if not parts:
            found.append(None)
            continue
        odd = (
            _odd({name: float(np.median(own)) for name, own in parts})
            if method == "repeats"
            else {}
        )
        own = np.concatenate([own for name, own in parts if name not in odd])
        # Repeats in the mean (unless positions differ in bursts): what happens once belongs to it, and the noise of an effort
        # grows with the motion. The others in the median: a stretch that
        # still creeps, or a kink that the smooth cuts, is not noise.
        repeated = method in ("repeats", "cycles")
        bursts = repeated and kind == "position" and _in_bursts(own, freedom)
        robust = not repeated or bursts
        square = (
            float(_median(own[:, None], freedom)[0]) if robust else float(own.mean())
        )
        spread = _log_spread(own, freedom, robust=robust)
        value = math.sqrt(square)
        pairs = (len(parts) - len(odd)) * (method == "repeats")
        ends = value / spread, value * spread
        found.append(
            NoiseEstimate(
                method, value, *ends, len(own) * rows, bursts, (*odd.items(),), pairs
            )
        )
    return found


def _odd(squares: dict[str, float]) -> dict[str, float]:
    """Repeats that differ over ``ODD`` times as much as the others: name → ratio. ``squares``: name → typical difference²."""
    others = {
        name: [square for other, square in squares.items() if other != name]
        or [math.inf]
        for name in squares
    }
    ratios = {
        name: (own, float(np.median(others[name]))) for name, own in squares.items()
    }
    return {
        name: math.sqrt(own / usual)
        for name, (own, usual) in ratios.items()
        if own > ODD**2 * usual > 0.0
    }


def _in_bursts(squares: np.ndarray, freedom: float) -> bool:
    """True if few of the blocks (B,) hold most of the squared difference."""
    ordered = np.sort(squares)[::-1]
    few = math.ceil(BURST_SHARE * len(ordered))
    usual = float(_median(squares[:, None], freedom)[0])
    return bool(
        ordered[:few].sum() > BURST_POWER * ordered.sum()
        and ordered.mean() > BURST_RATIO**2 * usual
    )


def _median(squares: np.ndarray, freedom: float) -> np.ndarray:
    """(J,) variance from the median of blocks (B, J): a χ²'s median lies below its mean by a known share."""
    return np.median(squares, axis=0) / (chi2.median(freedom) / freedom)


def _log_spread(squares: np.ndarray, freedom: float, *, robust: bool) -> float:
    """Factor to both sides of a standard deviation, 95 %, from the scatter of its blocks, at least that of white noise."""
    least = math.sqrt(2.0 / freedom)
    count = len(squares)
    if count > 1 and (squares > 0).all():
        log = np.log(squares)
        spread = (
            1.4826 * np.median(np.abs(log - np.median(log)))
            if robust
            else squares.std() / squares.mean()
        )
    else:
        spread = least
    # a median scatters √(π/2) times as much
    error = float(max(spread, least)) / math.sqrt(count) * (1.2533 if robust else 1.0)
    return math.exp(0.5 * float(student.ppf(0.975, max(count - 1, 2))) * error)
