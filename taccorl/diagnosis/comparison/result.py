"""A comparison: every signal of every recording beside its replay, and how far off it is.

Errors are given three times: RMSE in the signal's unit, NRMSE as a share of the standard deviation of what was measured (1: as
bad as a constant), and RMSE over the noise floor (1: as good as any twin can be).

Letters in shapes: T rows, N touch frames, P pads, R × C taxels of a pad, B blocks.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from taccorl.alignment.measurements.folder import Use
from taccorl.alignment.measurements.noise_floor import SignalFloor
from taccorl.data.finding import Finding
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT

Kind = Literal["position", "effort"]
Way = Literal["joint", "twin"]
USES: tuple[Use, ...] = ("fit", "validation", "test")
BLOCK_S = 0.5
"""Residuals of neighbouring rows are alike: intervals come from whole blocks (block bootstrap, Carlstein 1986)."""
FELT_FLOORS = 4.0
"""A taxel feels something beyond so many of its noise floors."""
NOT_STATED = "origin not stated by the recordings"
DRAWS = 400
"""Of the bootstrap: the ends of a 95 % interval then scatter by a tenth of its width."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """One signal of one recording beside its replay."""

    recording: str
    use: Use
    signal: str
    kind: Kind
    unit: str
    way: Way
    time_s: np.ndarray
    """(T,)."""
    target: np.ndarray
    """(T,) the position that is commanded, in its own unit."""
    position: np.ndarray
    """(T,) as measured, for efforts, too."""
    measured: np.ndarray
    """(T,) in ``unit``; NaN where nothing was measured."""
    replayed: np.ndarray
    """(T,) in ``unit``."""
    torque: np.ndarray
    """(T,) N·m, N: what the twin's motor gives in the replay."""
    touched: np.ndarray
    """(T,) bool: a pad of this arm is in contact; all False without pads."""
    floor: SignalFloor
    origin: str

    @property
    def residual(self) -> np.ndarray:
        """(T,) measurement − replay; NaN where nothing was measured."""
        return self.measured - self.replayed

    @property
    def period_s(self) -> float:
        return float(np.median(np.diff(self.time_s)))


@dataclass(frozen=True, kw_only=True)
class TouchTrace:
    """The pads of one recording beside their matched contact replay; counts above baseline."""

    recording: str
    use: Use
    pads: tuple[str, ...]
    """Those that came near the object."""
    time_s: np.ndarray
    """(N, P)."""
    measured: np.ndarray
    """(N, P, R, C)."""
    replayed: np.ndarray
    """(N, P, R, C)."""
    floor: np.ndarray
    """(P, R, C)."""
    origin: str
    touched: np.ndarray | None = None
    """(N, P) bool: what is pressed is in the pad, by where both are; None where that is not known."""
    unit: str = "counts"
    """Of the readings."""
    thirds: tuple[str, ...] = ("palm third", "middle third", "tip third")
    """Names of parts of the rows with about as many rows each; () where the rows are too few."""
    load: np.ndarray | None = None
    """(N, P, R, C) what pressed each cell, in ``load_unit``; None where only its shape and place are known."""
    load_unit: str = ""
    repeated: bool = False
    """``floor`` holds what repeats of a press do not repeat; else it is the noise of each cell, a lower bound."""

    @property
    def residual(self) -> np.ndarray:
        """(N, P, R, C)."""
        return self.measured.astype(float) - self.replayed

    @property
    def period_s(self) -> float:
        return float(np.median(np.diff(self.time_s[:, 0])))

    def felt(self, pad: int) -> np.ndarray:
        """(R, C) bool: taxels of a pad that feel something at some time, in the measurement or in the replay."""
        level = FELT_FLOORS * self.floor[pad]
        return (np.abs(self.measured[:, pad]) > level).any(axis=0) | (np.abs(self.replayed[:, pad]) > level).any(axis=0)


@dataclass(frozen=True, kw_only=True)
class Score:
    """How far off one signal is, over all recordings of one use."""

    signal: str
    kind: Literal["position", "effort", "touch"]
    use: Use
    unit: str
    rmse: float
    interval: tuple[float, float]
    """95 % of the RMSE, from blocks of ``BLOCK_S``."""
    nrmse: float
    """RMSE / standard deviation of what was measured."""
    floor: float
    floor_words: str
    lower_bound: bool
    """The floor is one: no motion was recorded twice."""
    n: int
    """Rows (taxel readings for touch)."""
    recordings: int

    @property
    def ratio(self) -> float:
        """RMSE / noise floor."""
        return self.rmse / self.floor


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A twin beside measurements."""

    twin: str
    """Its name, for titles."""
    effects: tuple[str, ...]
    """That the twin has."""
    traces: tuple[Trace, ...]
    touches: tuple[TouchTrace, ...] = ()
    split: dict[str, object]
    """Which recordings are fit, validation, test, and by what rule."""
    clock: dict[str, tuple[Finding, ...]] = field(default_factory=dict)
    """Recording → what its replay says about its clock."""
    left_out: tuple[str, ...] = ()
    """What was not compared, and why."""

    @property
    def origins(self) -> tuple[str, ...]:
        """What made the recordings, each once."""
        return tuple(dict.fromkeys(t.origin for t in (*self.traces, *self.touches) if t.origin))

    @property
    def uses(self) -> tuple[Use, ...]:
        """Those that there are recordings for."""
        return tuple(use for use in USES if any(t.use == use for t in (*self.traces, *self.touches)))

    @property
    def signals(self) -> tuple[tuple[str, Kind], ...]:
        """(signal, kind), positions first, in the order of the PiPER's actions, or else as they come."""
        found: dict[tuple[str, Kind], None] = dict.fromkeys((t.signal, t.kind) for t in self.traces)
        return tuple(sorted(found, key=lambda s: (s[1] != "position", _order(s[0]))))

    def of(self, signal: str, kind: Kind = "position", use: Use | None = None) -> tuple[Trace, ...]:
        """Traces of one signal, of one use or of all."""
        return tuple(t for t in self.traces if t.signal == signal and t.kind == kind and (use is None or t.use == use))

    def score(self, signal: str, kind: Kind, use: Use) -> Score | None:
        """None: no such recording."""
        traces = self.of(signal, kind, use)
        return _score(traces) if traces else None

    def scores(self) -> list[Score]:
        """Every signal and use, and all pads together where there are several."""
        found = [self.score(signal, kind, use) for signal, kind in self.signals for use in self.uses]
        if len({pad for t in self.touches for pad in t.pads}) > 1:
            found += [_touch_score([t for t in self.touches if t.use == use]) for use in self.uses]
        return [s for s in found if s is not None]

    def pad_scores(self) -> list[Score]:
        """Every pad and use."""
        there = dict.fromkeys(pad for t in self.touches for pad in t.pads)
        pads = sorted(there, key=lambda pad: ROBOT.pads.index(pad) if pad in ROBOT.pads else len(ROBOT.pads))
        found = [_touch_score([t for t in self.touches if t.use == use], pad) for pad in pads for use in self.uses]
        return [s for s in found if s is not None]


# scores ----------------------------------------------------------------------------------------------------------------


def _score(traces: Sequence[Trace]) -> Score:
    first = traces[0]
    left = np.concatenate([t.residual for t in traces])
    measured = np.concatenate([t.measured[np.isfinite(t.measured)] - np.nanmean(t.measured) for t in traces])
    rmse = float(np.sqrt(np.nanmean(left**2)))
    sums, counts = zip(*[block_sums(t.residual**2, round(BLOCK_S / t.period_s)) for t in traces], strict=True)
    spread = float(np.sqrt(np.mean(measured**2)))
    return Score(
        signal=first.signal,
        kind=first.kind,
        use=first.use,
        unit=first.unit,
        rmse=rmse,
        interval=_rms_interval(np.concatenate(sums), np.concatenate(counts)),
        nrmse=rmse / spread if spread > 0 else math.inf,
        floor=first.floor.value,
        floor_words=first.floor.words(),
        lower_bound=first.floor.lower_bound,
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
        if pad is not None:
            felt = felt & (np.arange(len(t.pads)) == t.pads.index(pad))[:, None, None]
        rows = round(BLOCK_S / t.period_s)
        sums.append(block_sums(np.where(felt, t.residual**2, 0.0).sum(axis=(1, 2, 3)), rows)[0])
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
    """((B,) sums, (B,) numbers) of the finite ones in blocks of ``rows``; the last block may be shorter."""
    starts = np.arange(0, len(values), max(rows, 1))
    finite = np.isfinite(values)
    return np.add.reduceat(np.where(finite, values, 0.0), starts), np.add.reduceat(finite.astype(float), starts)


def _rms_interval(sums: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """95 %: blocks drawn again with replacement, the same draw for the same number of blocks."""
    weights = drawn_blocks(len(sums))
    with np.errstate(invalid="ignore", divide="ignore"):
        means = (weights @ sums) / (weights @ counts)
    low, high = np.nanquantile(np.sqrt(means), (0.025, 0.975))
    return float(low), float(high)


def drawn_blocks(num_blocks: int) -> np.ndarray:
    """(DRAWS, B) how often each block is drawn; the same for the same number of blocks."""
    return np.random.default_rng(0).multinomial(num_blocks, np.full(num_blocks, 1 / num_blocks), DRAWS).astype(float)


def origin_words(origins: Sequence[str]) -> str:
    """``data: surrogate …``"""
    return "data: " + (", ".join(dict.fromkeys(origins)) or NOT_STATED)


def shown_unit(unit: str) -> tuple[float, str]:
    """Factor and unit in which errors are read: 1 mrad, and not 0.001 rad."""
    return {"rad": (1e3, "mrad"), "m": (1e3, "mm")}.get(unit, (1.0, unit))


def shown(value: float, unit: str) -> str:
    """``2.01 mrad``"""
    factor, name = shown_unit(unit)
    return f"{value * factor:.3g} {name}"


def _order(signal: str) -> int:
    return ROBOT.action_names.index(signal) if signal in ROBOT.action_names else len(ROBOT.action_names)


def only(comparison: Comparison, signals: Iterable[str]) -> Comparison:
    """The same with some of its signals.

    Raises:
        TaccorlError: one that was not compared.
    """
    known = [s for s, _ in comparison.signals]
    wanted = list(signals)
    for name in wanted:
        if name not in known:
            raise TaccorlError(f"{name!r} was not compared; {nearest(name, known)}")
    return dataclasses.replace(comparison, traces=tuple(t for t in comparison.traces if t.signal in wanted))
