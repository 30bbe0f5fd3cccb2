"""A comparison: every signal of every recording with its replay, and the errors.

Errors are given three times: RMSE in the signal's unit, NRMSE relative to the standard deviation of the measurement (1: no
better than a constant), and RMSE relative to the noise floor (1: the best possible).

Letters in shapes: T rows, N touch frames, P pads, R × C taxels of a pad, B blocks.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from taccorl.alignment.measurements.correlation import BLOCK_S
from taccorl.alignment.measurements.folder import Use
from taccorl.alignment.measurements.noise_floor import SignalFloor
from taccorl.alignment.touch.match import TouchMatch, touch_match
from taccorl.data.finding import Finding
from taccorl.data.origin import NOT_STATED, Origin
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT

Kind = Literal["position", "effort"]
"""Quantity that is compared."""
Way = Literal["joint", "twin"]
"""How it was replayed: each joint alone, or the whole twin."""
USES: tuple[Use, ...] = ("fit", "validation", "test")
"""Uses of recordings, in the order of tables."""
FELT_FLOORS = 4.0
"""A taxel is touched if it reads more than so many of its noise floors."""
DRAWS = 400
"""Number of bootstrap draws: the ends of a 95 % interval then scatter by a tenth of its width."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """One signal of one recording with its replay."""

    recording: str
    use: Use
    signal: str
    kind: Kind
    """Quantity in ``measured`` and ``replayed``."""
    unit: str
    """Unit of ``measured`` and ``replayed``."""
    way: Way
    time_s: np.ndarray
    """(T,) times [s]."""
    target: np.ndarray
    """(T,) commanded position [rad, m]."""
    position: np.ndarray
    """(T,) measured position [rad, m], also for traces of efforts."""
    measured: np.ndarray
    """(T,) measured values in ``unit``; NaN where not measured."""
    replayed: np.ndarray
    """(T,) replayed values in ``unit``."""
    torque: np.ndarray
    """(T,) torque of the twin's motor in the replay [N·m, N]."""
    touched: np.ndarray
    """(T,) bool: a pad of this arm is in contact; all False without pads."""
    floor: SignalFloor
    """Noise floor of ``measured``."""
    origin: Origin

    @property
    def residual(self) -> np.ndarray:
        """(T,) residual, measurement − replay, in ``unit``; NaN where not measured."""
        return self.measured - self.replayed

    @property
    def position_unit(self) -> str:
        """Unit of the signal's position, rad or m, also for traces of efforts."""
        return (
            self.unit if self.kind == "position" else "m" if self.unit == "N" else "rad"
        )

    @property
    def period_s(self) -> float:
        """Median time between rows [s]."""
        return float(np.median(np.diff(self.time_s)))


@dataclass(frozen=True, kw_only=True)
class CellNumbers:
    """Gain and offset of each cell of a sensor, as a replay used them. Letters in shapes: R × C the grid."""

    names: tuple[str, ...]
    """Names of the cells, row after row."""
    gain: np.ndarray
    """(R, C) gains, in the unit of the reading per unit of the load."""
    offset: np.ndarray
    """(R, C) offsets, in the unit of the reading."""
    places: int = 1
    """Number of places that a probe pressed; of several, ``gain`` is that of the place where the cell responds most."""


@dataclass(frozen=True, kw_only=True)
class TouchTrace:
    """The pads of one recording with their matched contact replay, in counts above baseline."""

    recording: str
    use: Use
    pads: tuple[str, ...]
    """Names of the pads that came near the object."""
    time_s: np.ndarray
    """(N, P) times of the frames [s]."""
    measured: np.ndarray
    """(N, P, R, C) measured readings."""
    replayed: np.ndarray
    """(N, P, R, C) replayed readings."""
    floor: np.ndarray
    """(P, R, C) noise floor of each taxel, in ``unit``; ``repeated`` says what it is estimated from."""
    origin: Origin
    touched: np.ndarray | None = None
    """(N, P) bool: the object is in contact with the pad, by their poses; None if that is not known."""
    unit: str = "counts"
    """Unit of ``measured``, ``replayed`` and ``floor``."""
    thirds: tuple[str, ...] = ("palm third", "middle third", "tip third")
    """Names of the parts into which the rows of a pad are divided for the errors by regime: palm, middle and tip. Empty if the
    pad has too few rows."""
    load: np.ndarray | None = None
    """(N, P, R, C) load on each cell, in ``load_unit``; None if only the object's shape and pose are known."""
    load_unit: str = ""
    """Unit of ``load``; empty if that is None."""
    pitch_m: float | None = None
    """Distance between neighbouring taxels of a pad [m]; None for cells."""
    repeated: bool = False
    """True: ``floor`` includes the variation between repeats of a press. False: it is the noise of each cell, a lower bound."""
    cells: CellNumbers | None = None
    """Gain and offset of each cell; None for pads, whose counts have one gain."""
    counted: np.ndarray | None = None
    """(N, P, R, C) bool: readings that count in errors. Those at an end of a converter do
    not, as in a fit. None: all."""

    @property
    def over_floor(self) -> np.ndarray:
        """(n,) residuals of the readings that count [noise floors]."""
        every = self.residual / self.floor
        return every.ravel() if self.counted is None else every[self.counted]

    @property
    def residual(self) -> np.ndarray:
        """(N, P, R, C) residual, measurement − replay, in ``unit``."""
        return self.measured.astype(float) - self.replayed

    @property
    def period_s(self) -> float:
        """Median time between the first pad's frames [s]."""
        return float(np.median(np.diff(self.time_s[:, 0])))

    def felt(self, pad: int) -> np.ndarray:
        """(R, C) bool: taxels of pad number ``pad`` (0 … P − 1) above the noise at some time, in the measurement or in the
        replay."""
        level = FELT_FLOORS * self.floor[pad]
        return (np.abs(self.measured[:, pad]) > level).any(axis=0) | (
            np.abs(self.replayed[:, pad]) > level
        ).any(axis=0)


@dataclass(frozen=True, kw_only=True)
class Score:
    """Error of one signal over all recordings of one use."""

    signal: str
    """What was measured: the name of a joint, gripper or axis, or of a pad; "touch" for all pads together."""
    kind: Literal["position", "effort", "touch"]
    use: Use
    unit: str
    """Unit of ``rmse``, ``interval`` and ``floor``."""
    rmse: float
    """RMS residual over all recordings."""
    interval: tuple[float, float]
    """(low, high) of the 95 % interval of the RMSE, from blocks of ``BLOCK_S``."""
    nrmse: float
    """RMSE / standard deviation of the measurement."""
    floor: float
    """Noise floor; where recordings have different ones, their root mean square (``pooled_floor``)."""
    floor_words: str
    """Text of the floor, with its method."""
    lower_bound: bool
    """True if the floor is a lower bound, because no motion was recorded twice."""
    n: int
    """Number of rows (for touch: of taxel readings)."""
    recordings: int

    @property
    def ratio(self) -> float:
        """RMSE / noise floor."""
        return self.rmse / self.floor


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Replays of measurements by one twin, with their errors."""

    twin: str
    effects: tuple[str, ...]
    traces: tuple[Trace, ...]
    """Signals of joints and axes, recording by recording."""
    touches: tuple[TouchTrace, ...] = ()
    """Pads, recording by recording; empty without touch."""
    split: dict[str, object]
    """``Measurements.record``: the recordings for fit, validation and test, and the rule of the division."""
    clock: dict[str, tuple[Finding, ...]] = field(default_factory=dict)
    """Recording → findings about a time shift between the recording and its replay."""
    left_out: tuple[str, ...] = ()
    """Data that were not compared, with the reason."""

    @property
    def origins(self) -> tuple[Origin, ...]:
        """Origins of the recordings, each once."""
        return tuple(
            dict.fromkeys(t.origin for t in (*self.traces, *self.touches) if t.origin)
        )

    @property
    def uses(self) -> tuple[Use, ...]:
        """The uses (fit, validation, test) for which there are recordings."""
        return tuple(
            use
            for use in USES
            if any(t.use == use for t in (*self.traces, *self.touches))
        )

    @property
    def signals(self) -> tuple[tuple[str, Kind], ...]:
        """(signal, kind), positions first, in the order of the PiPER's actions, or else in the order of the recordings."""
        found: dict[tuple[str, Kind], None] = dict.fromkeys(
            (t.signal, t.kind) for t in self.traces
        )
        place = {name: k for k, name in enumerate(ROBOT.action_names)}
        return tuple(
            sorted(
                found, key=lambda s: (s[1] != "position", place.get(s[0], len(place)))
            )
        )

    def of(
        self, signal: str, kind: Kind = "position", use: Use | None = None
    ) -> tuple[Trace, ...]:
        """Traces of one signal, for one use or (None) for all."""
        return tuple(
            t
            for t in self.traces
            if t.signal == signal and t.kind == kind and (use is None or t.use == use)
        )

    def score(self, signal: str, kind: Kind, use: Use) -> Score | None:
        """Error of one signal for one use; None without such a recording."""
        traces = self.of(signal, kind, use)
        return _score(traces) if traces else None

    def scores(self) -> list[Score]:
        """Errors of every signal and use, then of all pads together for every use if there are several pads."""
        found = [
            self.score(signal, kind, use)
            for signal, kind in self.signals
            for use in self.uses
        ]
        if len({pad for t in self.touches for pad in t.pads}) > 1:
            found += [
                _touch_score([t for t in self.touches if t.use == use])
                for use in self.uses
            ]
        return [s for s in found if s is not None]

    def error(self, signal: str, use: Use) -> float | None:
        """RMS residual of one signal's position and effort together [noise floors], each
        row in those of its own recording, as a diagnosis states it. None without traces."""
        rows = [
            t.residual / t.floor.value
            for t in self.traces
            if t.signal == signal and t.use == use
        ]
        seen = np.concatenate([r[np.isfinite(r)] for r in rows] or [np.zeros(0)])
        return float(np.sqrt(np.mean(seen**2))) if seen.size else None

    @property
    def pads(self) -> list[str]:
        """Names of the pads, in the order of ``ROBOT.pads``; others follow."""
        place = {pad: k for k, pad in enumerate(ROBOT.pads)}
        known = dict.fromkeys(pad for t in self.touches for pad in t.pads)
        return sorted(known, key=lambda pad: place.get(pad, len(place)))

    def pad_scores(self) -> list[Score]:
        """Errors of every pad and use: pad by pad, in the order of ``pads``."""
        found = [
            _touch_score([t for t in self.touches if t.use == use], pad)
            for pad in self.pads
            for use in self.uses
        ]
        return [s for s in found if s is not None]

    def pad_matches(self) -> dict[tuple[str, Use], TouchMatch]:
        """(pad, use) → the paper's five numbers, for pads of known pitch, in the order of
        ``pad_scores``. Taxels that read more than ``FELT_FLOORS`` of their noise floors are
        active."""
        found = {}
        for pad in self.pads:
            for use in self.uses:
                traces = [t for t in self.touches if t.use == use and pad in t.pads]
                if not traces or (pitch_m := traces[0].pitch_m) is None:
                    continue
                found[pad, use] = touch_match(
                    [t.measured[:, [t.pads.index(pad)]] for t in traces],
                    [t.replayed[:, [t.pads.index(pad)]] for t in traces],
                    FELT_FLOORS * traces[0].floor[traces[0].pads.index(pad)],
                    pitch_m,
                )
        return found


# scores ----------------------------------------------------------------------------------------------------------------


def pooled_floor(traces: Sequence[Trace]) -> float:
    """Noise floor of several recordings of one signal, in its unit: root mean square, weighted by measured rows."""
    rows = [np.isfinite(t.residual).sum() for t in traces]
    return float(
        np.sqrt(
            np.average(
                [t.floor.value**2 for t in traces], weights=rows if any(rows) else None
            )
        )
    )


def _score(traces: Sequence[Trace]) -> Score:
    first = traces[0]
    left = np.concatenate([t.residual for t in traces])
    measured = np.concatenate(
        [t.measured[np.isfinite(t.measured)] - np.nanmean(t.measured) for t in traces]
    )
    rmse = float(np.sqrt(np.nanmean(left**2)))
    sums, counts = zip(
        *[block_sums(t.residual**2, round(BLOCK_S / t.period_s)) for t in traces],
        strict=True,
    )
    spread = float(np.sqrt(np.mean(measured**2)))
    return Score(
        signal=first.signal,
        kind=first.kind,
        use=first.use,
        unit=first.unit,
        rmse=rmse,
        interval=_rms_interval(np.concatenate(sums), np.concatenate(counts)),
        nrmse=rmse / spread if spread > 0 else math.inf,
        floor=pooled_floor(traces),
        floor_words=first.floor.words()
        + "; of each motion its own" * (len({t.floor.value for t in traces}) > 1),
        lower_bound=any(t.floor.lower_bound for t in traces),
        n=int(np.isfinite(left).sum()),
        recordings=len(traces),
    )


def _touch_score(traces: Sequence[TouchTrace], pad: str | None = None) -> Score | None:
    """Over the readings in which measurement or replay is beyond its noise: frames of nothing would hide the rest.

    Args:
        pad: this one alone; all together if not given.
    """
    traces = [t for t in traces if pad is None or pad in t.pads]
    if not traces:
        return None
    sums, counts, readings, floors = [], [], [], []
    for t in traces:
        level = FELT_FLOORS * t.floor
        felt = (np.abs(t.measured) > level) | (np.abs(t.replayed) > level)
        felt = felt if t.counted is None else felt & t.counted
        if pad is not None:
            felt = felt & (np.arange(len(t.pads)) == t.pads.index(pad))[:, None, None]
        rows = round(BLOCK_S / t.period_s)
        sums.append(
            block_sums(np.where(felt, t.residual**2, 0.0).sum(axis=(1, 2, 3)), rows)[0]
        )
        counts.append(block_sums(felt.sum(axis=(1, 2, 3)).astype(float), rows)[0])
        readings.append(t.measured[felt].astype(float))
        floors.append(np.broadcast_to(t.floor, felt.shape)[felt])
    total, number = np.concatenate(sums), np.concatenate(counts)
    if number.sum() == 0:
        return None
    rmse = math.sqrt(total.sum() / number.sum())
    level = float(np.sqrt(np.mean(np.concatenate(floors) ** 2)))
    spread = float(np.std(np.concatenate(readings)))
    repeated = all(t.repeated for t in traces)
    return Score(
        signal="touch" if pad is None else pad,
        kind="touch",
        use=traces[0].use,
        unit=traces[0].unit,
        rmse=rmse,
        interval=_rms_interval(total, number),
        nrmse=rmse / spread if spread > 0 else math.inf,
        floor=level,
        floor_words=f"{level:.3g} {traces[0].unit} ({'repeats' if repeated else 'residue of each taxel; a lower bound'})",
        lower_bound=not repeated,
        n=int(number.sum()),
        recordings=len(traces),
    )


def block_sums(values: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """(B,) sums and (B,) numbers of the finite ``values`` (T,) in blocks of ``rows``; the last block may be shorter."""
    starts = np.arange(0, len(values), max(rows, 1))
    finite = np.isfinite(values)
    return np.add.reduceat(np.where(finite, values, 0.0), starts), np.add.reduceat(
        finite.astype(float), starts
    )


def _rms_interval(sums: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """95 %: blocks drawn again with replacement, the same draw for the same number of blocks."""
    weights = drawn_blocks(len(sums))
    with np.errstate(invalid="ignore", divide="ignore"):
        means = (weights @ sums) / (weights @ counts)
    low, high = np.nanquantile(np.sqrt(means), (0.025, 0.975))
    return float(low), float(high)


def drawn_blocks(num_blocks: int) -> np.ndarray:
    """(DRAWS, B) number of times that each of the B = ``num_blocks`` blocks is drawn; it depends on B only."""
    return (
        np.random.default_rng(0)
        .multinomial(num_blocks, np.full(num_blocks, 1 / num_blocks), DRAWS)
        .astype(float)
    )


def origin_words(origins: Sequence[Origin]) -> str:
    """Text of the data's origin, such as ``data: surrogate …``."""
    return "data: " + (", ".join(dict.fromkeys(map(str, origins))) or NOT_STATED)


def shown_unit(unit: str) -> tuple[float, str]:
    """(factor, unit) for the display of errors in ``unit``: rad → (1000, "mrad"), m → (1000, "mm"), others unchanged."""
    return {"rad": (1e3, "mrad"), "m": (1e3, "mm")}.get(unit, (1.0, unit))


def shown(value: float, unit: str) -> str:
    """Text of ``value`` [``unit``] in a readable unit, such as ``2.01 mrad``."""
    factor, name = shown_unit(unit)
    return f"{value * factor:.3g} {name}"


def only(comparison: Comparison, signals: Iterable[str]) -> Comparison:
    """The comparison restricted to some of its signals. Raises TaccorlError: a signal was not compared."""
    known = [s for s, _ in comparison.signals]
    wanted = list(signals)
    for name in wanted:
        if name not in known:
            raise TaccorlError(f"{name!r} was not compared; {nearest(name, known)}")
    return dataclasses.replace(
        comparison, traces=tuple(t for t in comparison.traces if t.signal in wanted)
    )
