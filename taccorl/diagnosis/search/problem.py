"""Problem of the search: a part of the robot with always fitted numbers, its recordings, and candidate effects.

Letters in shapes: T rows, C channels of a recording (position and effort of a joint; taxels of a pad).
"""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from taccorl.alignment.least_squares import Free, Values
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect, Parameter

LEAST_ROWS = 10
"""Fewer rows of a regime are not judged."""
_SMALLEST = 1e-3
"""A strength that fades to 0 is searched, on a logarithmic scale, down to this share of its typical value."""


def free(p: Parameter, cls: type[Effect]) -> Free:
    """The parameter ``p`` of the effect ``cls`` as a fitted number; on a logarithmic scale if it cannot change sign."""
    one_sided = p.low > 0 or (p.low == 0 and p.absent in (None, 0.0))
    low = max(p.low, _SMALLEST * p.typical) if one_sided else p.low
    shift = (
        abs(p.typical - p.absent)
        if p.absent is not None and math.isfinite(p.absent)
        else 0.0
    )
    scale = shift or 0.1 * (p.high - p.low)
    optional = p.name in cls.optional
    start = 0.0 if optional else p.typical
    name = f"{cls.name}.{p.name}"
    found = Free(
        name=name,
        unit=p.unit,
        start=start,
        low=low,
        high=p.high,
        log=one_sided,
        scale=scale,
    )
    return dataclasses.replace(
        found, optional=optional, unless=(cls.optional.get(p.name, ""),)
    )


def holding(
    frees: Sequence[Free], known: Sequence[str], stated: Mapping[str, float]
) -> tuple[Free, ...]:
    """``frees``, of which those with a value in ``stated`` are held at it if ``known`` has their name or that of their effect."""

    def is_known(f: Free) -> bool:
        return f.name in stated and (f.name in known or f.name.split(".")[0] in known)

    return tuple(
        dataclasses.replace(f, start=stated[f.name], held=True) if is_known(f) else f
        for f in frees
    )


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An effect that the part may have, with the parameters that a search fits and their start values."""

    cls: type[Effect]
    frees: tuple[Free, ...]
    """Parameters that are fitted."""
    starts: tuple[Values, ...]
    """Start values of searches; numbers that a start leaves out have typical values."""
    selectors: Mapping[str, Any]
    """Arguments that select where it acts (arm, joints, pads), and parameters that are not fitted."""
    num_maps: int = 0
    """Number of values besides ``frees`` that are estimated from the data (one for each taxel of a map), which count as
    parameters, too."""

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.cls.name

    @property
    def strengths(self) -> tuple[str, ...]:
        """Full names of the parameters that have a value at which the effect is absent."""
        return tuple(
            f"{self.name}.{p.name}"
            for p in self.cls.parameters()
            if p.absent is not None
        )

    def make(self, values: Mapping[str, float]) -> Effect:
        """Make the effect with the parameters in ``values``, whose keys are full names."""
        numbers: dict[str, Any] = {
            f.name.split(".", 1)[1]: values[f.name] for f in self.frees
        }
        return self.cls(**self.selectors, **numbers)


def candidate(
    cls: type[Effect], seen: Mapping[str, float], **selectors: Any
) -> Candidate:
    """Candidate for an effect, from its class.

    Start values are clipped to the bounds of their parameters: facts of recordings may lead beyond them, as a drive that the
    fit finds softer than the file says leads to a softer gear.

    Args:
        seen: facts of the recordings from which start values follow (``Effect.starts``), such as ``duration_s``.
        selectors: where it acts (``arm``, ``joints`` or ``pads``), and values of parameters that are not fitted.
    """
    frees = tuple(free(p, cls) for p in cls.parameters() if p.name not in selectors)
    starts = [
        {
            f"{cls.name}.{k}": cls.clipped(k, v)
            for k, v in start.items()
            if k not in selectors
        }
        for start in cls.starts(seen)
    ]
    unlike = {tuple(start.items()): start for start in starts}.values()
    return Candidate(cls=cls, frees=frees, starts=tuple(unlike), selectors=selectors)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """One measurement in the form for the search: measured channels over time, and their noise floors. Objects are equal only if
    they are the same, so that results for one can be kept; arrays are never changed."""

    name: str
    time_s: np.ndarray
    """(T,) times [s]."""
    measured: np.ndarray
    """(T, C) measured values; NaN where not measured."""
    floor: np.ndarray
    """(C,) noise floor of each channel in its unit; residuals are divided by it, times ``share``."""
    channels: tuple[str, ...]
    """Name and unit of each channel, such as "left_joint5 [rad]"."""
    data: Any = field(repr=False)
    """Data that the problem needs to simulate it."""
    regimes: Mapping[str, tuple[np.ndarray, float]] = field(
        default_factory=dict, repr=False
    )
    """Regime of motion → its rows, (T,) bool, and the noise of positions there by repeats [floors], at least 1."""
    short_noise: bool = False
    """True: noise does not last, so that what is left for longer than half a second is a misfit. False: as where joints or
    objects are not placed alike twice."""
    setting: tuple[float, ...] = ()
    """What others may have otherwise: load, gains."""
    share: np.ndarray | float = 1.0
    """(T, C) noise of an entry as a share of the floor of its channel."""

    def __post_init__(self) -> None:
        if self.measured.shape != (
            len(self.time_s),
            len(self.channels),
        ) or self.floor.shape != (len(self.channels),):
            raise TaccorlError(
                f"recording {self.name}: measured is {self.measured.shape} and floor {self.floor.shape} for "
                f"{len(self.time_s)} rows of {len(self.channels)} channels"
            )
        if not (np.isfinite(self.floor).all() and (self.floor > 0).all()):
            raise TaccorlError(
                f"recording {self.name}: the noise floor {self.floor} must be finite and above 0"
            )


Case = tuple[Mapping[str, float], Sequence[Effect]]
"""Always fitted numbers, name → value, and effects with their parameters."""


class Problem(Protocol):
    """Interface of a part of a machine for the search: one joint, or the pads."""

    base: tuple[Free, ...]
    """Numbers that are always fitted."""
    candidates: dict[str, Candidate]
    """Name of the effect → candidate."""
    at_once: int
    """Number of parameter sets that ``simulate_all`` simulates side by side in about the time of one."""
    loop_s: float
    """Period [s] of a drive's loop that the file states and whose rate is no multiple of the rows'; 0: none. ``simulate`` then
    takes ``loop_waits_s``, how long a row's target waits for the next period, beside the numbers of ``base``."""
    other_gain: Free | None
    """Gain of the file that is not fitted, but whose wrong value would look like an effect: the search tries it, too."""
    of_file: tuple[Free, ...]
    """Further numbers of the file, fitted one or two at a time where the recordings determine only ratios of the numbers of
    ``base``: supply, resistance and torque constant of a motor whose effort was not logged. ``simulate`` uses them in place
    of the numbers of ``base`` that follow from them. Empty for other problems."""

    def simulate(
        self, base: Mapping[str, float], effects: Sequence[Effect], recording: Recording
    ) -> np.ndarray:
        """Simulated measurement (T, C) in the units of ``recording.measured``.

        Args:
            base: always fitted numbers: name → value.
            effects: effects of the hypothesis, with their parameters.
        """
        ...

    def simulate_all(
        self, cases: Sequence[Case], recordings: Sequence[Recording]
    ) -> list[list[np.ndarray]]:
        """``simulate`` of each of ``recordings`` with each of ``cases``, (T, C) each."""
        ...

    def learn(self, values: Mapping[str, float]) -> None:
        """Called after the first fit of the always fitted numbers, with their ``values``; may update starts of effects."""
        ...

    def noisier(self, recording: Recording) -> Recording:
        """``recording`` with the noise of its measured inputs once more; itself if they have none."""
        ...

    def prepare(
        self,
        base: Mapping[str, float],
        effects: Sequence[Effect],
        recordings: Sequence[Recording],
    ) -> list[Effect]:
        """Copy of ``effects`` in which values estimated in closed form from the fit recordings (maps of taxels) are set."""
        ...


class WithoutMaps:
    """Problem whose start values depend on the recordings alone, and whose effects have no values estimated in closed form, where
    it does not say otherwise."""

    at_once = 1
    loop_s = 0.0
    other_gain: Free | None = None
    of_file: tuple[Free, ...] = ()

    def simulate(
        self: Problem,
        base: Mapping[str, float],
        effects: Sequence[Effect],
        recording: Recording,
    ) -> np.ndarray:
        """``simulate_all`` of one case and one recording, (T, C). Subclasses define one of the two."""
        return self.simulate_all([(base, effects)], [recording])[0][0]

    def simulate_all(
        self: Problem, cases: Sequence[Case], recordings: Sequence[Recording]
    ) -> list[list[np.ndarray]]:
        """Simulate one case after another, (T, C) each."""
        return [
            [self.simulate(base, effects, r) for base, effects in cases]
            for r in recordings
        ]

    def learn(self, values: Mapping[str, float]) -> None:
        """Does nothing."""

    def noisier(self, recording: Recording) -> Recording:
        """``recording`` itself: its inputs have no noise."""
        return recording

    def prepare(
        self,
        base: Mapping[str, float],
        effects: Sequence[Effect],
        recordings: Sequence[Recording],
    ) -> list[Effect]:
        """Return ``effects`` unchanged."""
        return list(effects)


def split_rows(
    recordings: Sequence[Recording], share: float = 0.6
) -> tuple[list[Recording], list[Recording]]:
    """Split recordings without validation marks: (for fitting, for validation), each with all rows of all recordings.

    In the first, ``measured`` is NaN after the first ``share`` of the rows; in the second it is NaN before. Both parts are
    simulated from the beginning, where the robot was at rest.
    """
    early, late = [], []
    for r in recordings:
        cut = round(share * len(r.time_s))
        first, last = r.measured.copy(), r.measured.copy()
        first[cut:], last[:cut] = np.nan, np.nan
        early.append(dataclasses.replace(r, measured=first))
        late.append(dataclasses.replace(r, measured=last))
    return early, late


def thinned(recordings: Sequence[Recording]) -> list[Recording]:
    """Every second recording, at least two, and those without which a regime of motion or
    a value of a setting were lost. In their order."""
    if len(recordings) <= 2:
        return list(recordings)

    def facts(r: Recording) -> set[Any]:
        seen = {n for n, (rows, _) in r.regimes.items() if rows.sum() >= LEAST_ROWS}
        return seen | set(enumerate(r.setting))

    kept = list(recordings[::2])
    for r in recordings[1::2]:
        if facts(r) - set[Any]().union(*map(facts, kept)):
            kept.append(r)
    return [r for r in recordings if r in kept]


def with_frees(problem: Problem, change: Callable[[Free], Free]) -> Problem:
    """Copy of ``problem`` in which ``change`` was applied to each number of its base and of its candidates."""
    copied = copy.copy(problem)
    copied.base = tuple(map(change, problem.base))
    copied.candidates = {
        name: dataclasses.replace(c, frees=tuple(map(change, c.frees)))
        for name, c in problem.candidates.items()
    }
    return copied


def with_held(problem: Problem, stated: Mapping[str, float]) -> Problem:
    """Copy of ``problem`` in which the numbers in ``stated`` are held at their values there."""

    def held(f: Free) -> Free:
        return (
            dataclasses.replace(f, start=stated[f.name], held=True)
            if f.name in stated
            else f
        )

    return with_frees(problem, held)


def without_numbers(problem: Problem, names: Collection[str]) -> Problem:
    """Copy of ``problem`` in which no always fitted number is one of ``names``: they are as the machine's file has them."""
    copied = copy.copy(problem)
    copied.base = tuple(f for f in problem.base if f.name not in names)
    return copied


EFFORT_SCALE = "effort_scale"
"""Name of the ratio of recorded efforts to the true ones, that of a torque constant to the true one. Held where the inertia is
fitted: both change alike all that efforts show."""


def with_scale(problem: Problem) -> Problem | None:
    """Copy of ``problem`` in which the scale of efforts is fitted and the inertia stays, where it is the other way round."""
    if not any(f.name == EFFORT_SCALE and f.held for f in problem.base):
        return None
    held = {"inertia": True, EFFORT_SCALE: False}
    return with_frees(
        problem, lambda f: dataclasses.replace(f, held=held.get(f.name, f.held))
    )


def with_other_number(problem: Problem) -> dict[str, Problem]:
    """Number whose value in the file may be off where an effect seems to be missing → ``problem`` in which it is fitted."""
    found = {} if (scaled := with_scale(problem)) is None else {EFFORT_SCALE: scaled}
    if (gain := problem.other_gain) is not None:
        found[gain.name] = copy.copy(problem)
        found[gain.name].base = (*problem.base, gain)
    return found


Progress = Callable[[str], None]
"""Function that is called with a text about the present step."""


class Stopped(Exception):
    """Raised by a ``Progress``: no further fit is wanted."""


class Found(str):
    """Text with which a search reports what it has found so far: after each accepted effect, and at its end."""

    effects: Sequence[Effect]
    """Effects of the model so far, those of the machine's file included."""
    present: Sequence[str]
    """Names of those of the file."""
    base: Values
    """The always fitted numbers."""
    errors: Mapping[str, Mapping[str, float]]
    """``after`` → fit, validation → RMS error [floors]."""
    intervals: Mapping[str, tuple[float, float]]
    """Fitted number → 95 % interval; empty before the end."""
    finished: bool
    """True if the search has ended; false while it still adds effects."""

    def __new__(cls, text: str, **facts: Any) -> "Found":
        """``facts``: values of all attributes."""
        found = super().__new__(cls, text)
        vars(found).update(facts)
        return found


def never_stopped(report: Progress) -> Progress:
    """``report``, for steps in which a search that has found something must not end: ``Stopped`` is ignored."""

    def going_on(text: str) -> None:
        with contextlib.suppress(Stopped):
            report(text)

    return going_on


def no_progress(*text: str) -> None:
    """Progress that nobody reads; no lambda, since workers are sent it."""


def chosen(problem: Problem, names: Sequence[str]) -> list[Candidate]:
    """Candidates of these names, in their order.

    Raises:
        TaccorlError: an effect is not a candidate of this problem.
    """
    for name in names:
        if name not in problem.candidates:
            if name in effects and not effects.get(name).fitted:
                raise TaccorlError(
                    f"{name}: no search fits this effect, so that no recording can be planned for it; remove it. Recording "
                    f"that shows it: {effects.get(name).to_record}"
                )
            raise TaccorlError(
                f"no effect {name!r} for this part; {nearest(name, problem.candidates)}"
            )
    return [problem.candidates[name] for name in names]
