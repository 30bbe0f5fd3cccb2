"""Errors by recording and regime, and differences in coverage between fit and validation recordings.

A single error over all rows can hide a large error in one recording, at one speed, in one direction or in a part of the range.

Letters in shapes: T rows.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.measurements.folder import Use
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import EXACT, SignalFloor, laid_pairs
from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.along import VARIABLES, variable_unit
from taccorl.diagnosis.comparison.localise import (
    LEAST_SHARE,
    REGIMES,
    Motion,
    motions_of,
)
from taccorl.diagnosis.comparison.result import USES, Trace
from taccorl.diagnosis.search.problem import LEAST_ROWS, Recording
from taccorl.diagnosis.search.result import SearchConfig

ALL = "all rows"
"""Name of the regime that holds every row."""
GROUPS = ("speed", "direction", "pose")
"""Groups of ``localise.REGIMES`` that are evaluated."""
AT_FLOOR = SearchConfig().floor
"""An error up to so many noise floors counts as at the floor, as in the search."""
DISAGREE = 1.3
"""Ratio of two errors from which on a remark is made."""
COVERED = 0.5
"""Least share of a range that recordings of the other use must cover; below it a remark is made."""
INNER = (0.005, 0.995)
"""Quantiles that count as the ends of a range, so that single noisy rows are ignored."""


@dataclass(frozen=True, kw_only=True)
class RegimeError:
    """Error of one recording, or of all recordings of one use, in one regime."""

    recording: str
    """Name of the recording; empty for all recordings of the use."""
    use: Use
    regime: str
    error: float
    """RMS residual [noise floors]."""
    n: int

    @property
    def place(self) -> str:
        """Recording and regime as text."""
        return f"{self.recording}, {self.regime}"


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """The range of one variable in the recordings of each use."""

    variable: str
    unit: str
    ranges: dict[Use, tuple[float, float]]
    """Use → (lowest, highest) value, without the outermost 0.5 % at both ends."""


@dataclass(frozen=True, kw_only=True)
class RegimeErrors:
    """Errors of one signal after the fit, by recording and regime."""

    signal: str
    rows: tuple[RegimeError, ...]
    """Errors of single recordings and of all recordings of a use, in every regime."""
    coverage: tuple[Coverage, ...]
    """Ranges of the variables in the recordings of each use."""
    remarks: tuple[str, ...]
    """Sentences on regimes in which fit and validation disagree, or ranges that differ; the most important first."""

    def short(self, use: Use, other: Use) -> tuple[str, ...]:
        """Names of the variables of which recordings of one use do not cover the range of the other's."""
        return tuple(
            c.variable
            for c in self.coverage
            if {use, other} <= {*c.ranges}
            and not _covers(c.ranges[use], c.ranges[other])
        )

    @property
    def worst(self) -> RegimeError | None:
        """Entry with the greatest error among recordings and regimes; None if nothing was measured."""
        own = [r for r in self.rows if r.recording and r.regime != ALL]
        return max(own, key=lambda r: r.error, default=None)


def regime_errors(traces: Sequence[Trace]) -> RegimeErrors:
    """Errors of one signal by recording and regime. ``traces``: all recordings of the signal, replayed with the fitted twin."""
    motions, regimes = motions_of(traces), _regimes()
    rows = [
        _row(m.trace.recording, m.trace.use, name, [m], inside)
        for m in motions
        for name, inside in regimes
    ]
    uses: list[Use] = [use for use in USES if any(m.trace.use == use for m in motions)]
    pooled = [
        _row("", use, name, [m for m in motions if m.trace.use == use], inside)
        for use in uses
        for name, inside in regimes
    ]
    found = [r for r in (*pooled, *rows) if r is not None]
    coverage = _coverage(motions)
    remarks = (*_disagreements(found), *_gaps(coverage))
    return RegimeErrors(
        signal=traces[0].signal,
        rows=tuple(found),
        coverage=tuple(coverage),
        remarks=remarks,
    )


def with_regimes(
    sides: Sequence[Sequence[Recording]],
    measurements: Sequence[Measurement],
    floor: SignalFloor,
) -> list[Sequence[Recording]]:
    """``sides`` (fit, validation, test) of a joint or axis, each recording with the rows of its regimes and the noise of
    positions there: by repeats of a motion, and ``EXACT`` of the tracking error, which no equations have more exactly (arms
    without an effect kept 0.3 % of it in steps). As they are if ``floor`` is that of efforts. ``measurements``: those that the
    recordings were made of, by name. ``floor``: noise floor of the first channel."""
    if floor.kind != "position":
        return [[*side] for side in sides]
    motions = motions_of([_trace(r, floor) for side in sides for r in side])
    rows = {
        m.trace.recording: {name: inside(m) for name, inside in _regimes()}
        for m in motions
    }
    noise = {name: 0.0 for name, _ in _regimes()}
    odd = {name for name, _ in floor.used.left_out}
    for first, second, laid in laid_pairs(measurements):
        if second.name in odd:
            continue
        j = first.column(floor.signal)
        at = np.searchsorted(first.time_s, laid.time_s - 1e-9).clip(
            max=first.num_rows - 1
        )
        for name, inside in rows[first.name].items():
            own = laid.difference["position"][inside[at], j]
            own = own[np.isfinite(own)]
            if len(own) >= LEAST_ROWS:
                noise[name] = max(
                    noise[name], float(np.sqrt(np.mean(own**2) / laid.noise_gain))
                )

    def marked(r: Recording) -> Recording:
        off = (
            EXACT
            * (r.data.measured - r.data.target)
            * (measurements[0].target_kind(floor.signal) == "position")
        )
        own = {}
        for name, inside in rows[r.name].items():
            known = off[inside & np.isfinite(off)]
            inexact = float(np.std(known)) if len(known) else 0.0
            own[name] = (
                inside,
                math.hypot(max(noise[name], r.floor[0]), inexact) / r.floor[0],
            )
        return dataclasses.replace(r, regimes=own)

    return [[marked(r) for r in side] for side in sides]


def _trace(r: Recording, floor: SignalFloor) -> Trace:
    """What the regimes of a recording depend on; nothing was replayed."""
    none = np.full(len(r.time_s), np.nan)
    return Trace(
        recording=r.name,
        use="fit",
        signal=floor.signal,
        kind="position",
        unit=floor.unit,
        way="joint",
        time_s=r.time_s,
        target=r.data.target,
        position=r.data.measured,
        measured=r.data.measured,
        replayed=none,
        torque=none,
        touched=none > 0.0,
        floor=floor,
        origin=Origin(),
    )


def _regimes() -> list[tuple[str, Callable[[Motion], np.ndarray]]]:
    return [
        (ALL, lambda m: np.ones(len(m.trace.time_s), dtype=bool)),
        *((r.name, r.rows) for r in REGIMES if r.group in GROUPS),
    ]


def _row(
    recording: str,
    use: Use,
    regime: str,
    motions: Sequence[Motion],
    inside: Callable[[Motion], np.ndarray],
) -> RegimeError | None:
    """None: fewer rows of it than ``LEAST_SHARE``."""
    squares = [(m.trace.residual / m.trace.floor.value) ** 2 for m in motions]
    chosen = np.concatenate(
        [s[inside(m)] for s, m in zip(squares, motions, strict=True)]
    )
    n = int(np.isfinite(chosen).sum())
    if n == 0 or n < LEAST_SHARE * sum(np.isfinite(s).sum() for s in squares):
        return None
    return RegimeError(
        recording=recording,
        use=use,
        regime=regime,
        error=float(np.sqrt(np.nanmean(chosen))),
        n=n,
    )


def _coverage(motions: Sequence[Motion]) -> list[Coverage]:
    unit, variables = motions[0].trace.position_unit, {v.name: v for v in VARIABLES}
    found = []
    for name in ("position", "velocity", "commanded acceleration"):
        ranges: dict[Use, tuple[float, float]] = {}
        for use in USES:
            own = [variables[name].values(m) for m in motions if m.trace.use == use]
            if own:
                low, high = np.quantile(np.concatenate(own), INNER)
                ranges[use] = (float(low), float(high))
        found.append(
            Coverage(variable=name, unit=variable_unit(name, unit), ranges=ranges)
        )
    return found


def _disagreements(rows: Sequence[RegimeError]) -> list[str]:
    """Pooled errors of fit and validation, in all rows and regime by regime."""
    pooled = {(r.use, r.regime): r.error for r in rows if not r.recording}
    found = []
    for regime in dict.fromkeys(r.regime for r in rows):
        fit, validation = (
            pooled.get(("fit", regime)),
            pooled.get(("validation", regime)),
        )
        if fit is None or validation is None:
            continue
        high, low = max(fit, validation), min(fit, validation)
        if high > AT_FLOOR and high > DISAGREE * low:
            found.append(
                f"{regime}: fit recordings end at {fit:.2f} noise floors, validation recordings at {validation:.2f}"
            )
    return found


def _gaps(coverage: Sequence[Coverage]) -> list[str]:
    """Ranges of fit recordings that validation recordings do not cover, and the other way round."""
    found = []
    for c in coverage:
        if "fit" not in c.ranges or "validation" not in c.ranges:
            continue
        fit, validation = c.ranges["fit"], c.ranges["validation"]
        for mine, other, words in (
            (
                fit,
                validation,
                "fit recordings reach {0}, validation recordings {1}: what acts beyond is not validated",
            ),
            (
                validation,
                fit,
                "validation recordings reach {0}, fit recordings {1}: what acts beyond was not fitted",
            ),
        ):
            if not _covers(other, mine):
                told = [
                    f"{ends[0]:.3g} … {ends[1]:.3g} {c.unit}" for ends in (mine, other)
                ]
                found.append(f"{c.variable}: " + words.format(*told))
    return found


def _covers(other: tuple[float, float], mine: tuple[float, float]) -> bool:
    """Whether the range ``other`` covers ``COVERED`` of the range ``mine``."""
    shared = max(0.0, min(mine[1], other[1]) - max(mine[0], other[0]))
    return shared >= COVERED * (mine[1] - mine[0])
