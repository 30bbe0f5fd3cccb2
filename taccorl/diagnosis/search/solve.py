"""Diagnosis of one part, the same for every machine: choice of validation rows, identifiability, and the search."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from taccorl.diagnosis.search.drift import Drift
from taccorl.diagnosis.search.fit import residuals
from taccorl.diagnosis.search.identifiability import Identifiability, identifiability
from taccorl.diagnosis.search.identifiable import Known
from taccorl.diagnosis.search.known_numbers import limits_of_known
from taccorl.diagnosis.search.plain import plain_fit
from taccorl.diagnosis.search.problem import (
    Problem,
    Progress,
    Recording,
    Values,
    no_progress,
    split_rows,
)
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.search import diagnose
from taccorl.errors import TaccorlError

WAITS, SHARE = 0.5, 0.15
"""A remark names the wait of targets for the drive's loop if it can make at least the first share of the RMS error that is left,
and, where the loop's rate was fitted, if one wait fitted to each half second explains the second share of its square. Choices."""

CLEAR = ("nothing_missing", "numbers_off", "gains_moved")
"""Statuses with which no plain fit is asked for, if no effect was added."""


class Startable(Problem, Protocol):
    """Interface of a problem with start values."""

    start: Values
    """Start values of the search."""
    present: tuple[str, ...]
    """Names of the effects that the machine's file has already."""

    @property
    def known(self) -> Sequence[str]:
        """Names of numbers and effects that the machine's file marks as known."""
        ...


class RecordedProblem(Startable, Protocol):
    """A search problem together with its recordings."""

    fit: Sequence[Recording]
    validation: Sequence[Recording]
    """Recordings by whose error effects are chosen; empty if none is marked."""
    test: Sequence[Recording]


class PartProblem(RecordedProblem, Protocol):
    """A search problem together with its recordings, and texts about them, as in ``PartFinding``."""

    @property
    def noise(self) -> str: ...
    @property
    def numbers(self) -> str: ...
    @property
    def measured(self) -> str: ...


@dataclass(frozen=True, kw_only=True)
class PartFinding:
    """Finding about one part of a machine: result of the search, and texts about it for reports."""

    part: str
    """Name of the part in tables and reports."""
    diagnosis: Diagnosis
    can_tell: Identifiability
    """Effects that the fit recordings can show and separate, independent of the measured values."""
    recordings: dict[str, tuple[str, ...]]
    """fit, validation, test → names."""
    rows_split: bool
    """True if no recording was marked for validation, so that the last rows of each recording served as validation rows."""
    noise: str
    """The noise floors of the compared channels with their units, as text for reports."""
    numbers: str
    """Text that states which numbers are always fitted, and from where the other numbers are taken."""
    measured: str
    """Text that names the channels whose errors are minimised and reported, such as positions."""
    known: Known | None = None
    """Numbers that the recordings identify; None for parts for which they are not computed."""
    remark: str = ""
    """Text on what the search could not decide; empty if there is nothing."""
    drifts: tuple[Drift, ...] = ()
    """Numbers that changed from one recording of a motion to another one."""


class Solved(NamedTuple):
    """Result of ``solve``: the diagnosis, and which recordings (or rows of them) were fitted and which chose the effects."""

    diagnosis: Diagnosis
    can_tell: Identifiability
    fit_to: Sequence[Recording]
    validation: Sequence[Recording]
    rows_split: bool


def solve(
    part: str,
    problem: Startable,
    fit_to: Sequence[Recording],
    validation: Sequence[Recording],
    test: Sequence[Recording],
    search: SearchConfig | None = None,
    without: Sequence[str] = (),
    progress: Progress = no_progress,
) -> Solved:
    """Search for the effect that is missing in one part's problem.

    Args:
        part: name of the part, for messages; the others are those of ``diagnose``.
        validation: if there are none, the last rows of ``fit_to`` take their place.

    Raises:
        TaccorlError: nothing was measured in the validation rows.
    """
    rows_split = not validation
    if rows_split:
        fit_to, validation = split_rows(fit_to)
    if not any(np.isfinite(r.measured).any() for r in validation):
        raise TaccorlError(
            f"{part}: nothing was measured in the validation rows ({', '.join(r.name for r in validation)}), so that no effect "
            "can be evaluated; record a motion that is measured to its end, or mark another one with use: validation"
        )
    progress("which effects the recordings can show")
    can_tell = identifiability(problem, fit_to, problem.start, problem.present)
    absent = [
        name
        for name in problem.known
        if name in problem.candidates and name not in problem.present
    ]
    found = diagnose(
        problem,
        fit_to,
        validation,
        test,
        start=problem.start,
        present=problem.present,
        without=[*without, *absent],
        config=search,
        progress=progress,
    )
    found = dataclasses.replace(
        found,
        remarks=(*_of_loop(problem, found, (*fit_to, *validation)), *found.remarks),
    )
    if found.names != found.present or found.status not in CLEAR:
        sides, file = (fit_to, validation, test), (problem.start, problem.present)
        beside = plain_fit(problem, *sides, *file, held=problem.known)
        found = dataclasses.replace(found, plain=beside)
    if problem.known:
        limits = limits_of_known(
            problem, problem.known, found, fit_to, validation, search or SearchConfig()
        )
        found = dataclasses.replace(found, remarks=(*found.remarks, *limits))
    return Solved(found, can_tell, fit_to, validation, rows_split)


def solved(
    part: str,
    problem: PartProblem,
    search: SearchConfig | None = None,
    without: Sequence[str] = (),
    progress: Progress = no_progress,
) -> PartFinding:
    """Call ``solve`` for one joint, axis or pad, with the fit, validation and test recordings of ``problem``.

    Args:
        part: name of the part.
        without: effects that are left out of the search.
        progress: function that is called with a text about the present step.

    Raises:
        TaccorlError: nothing was measured in the validation rows.
    """
    found = solve(
        part,
        problem,
        problem.fit,
        problem.validation,
        problem.test,
        search,
        without,
        progress,
    )
    recordings = {
        use: tuple(r.name for r in getattr(problem, use))
        for use in ("fit", "validation", "test")
    }
    stated = {
        "noise": problem.noise,
        "numbers": problem.numbers,
        "measured": problem.measured,
    }
    judged = {
        "diagnosis": found.diagnosis,
        "can_tell": found.can_tell,
        "rows_split": found.rows_split,
    }
    return PartFinding(part=part, recordings=recordings, **stated, **judged)


def with_drifts[FindingT: PartFinding](
    found: FindingT, drifted: Sequence[Drift]
) -> FindingT:
    """The finding with numbers that changed between recordings, and a remark on each."""
    remarks = (*(drift.words for drift in drifted), *found.diagnosis.remarks)
    return dataclasses.replace(
        found,
        drifts=tuple(drifted),
        diagnosis=dataclasses.replace(found.diagnosis, remarks=remarks),
    )


def _of_loop(
    problem: Problem, found: Diagnosis, recordings: Sequence[Recording]
) -> list[str]:
    """Sentence where an error is left of the size that targets make which wait for the next period of a drive's loop."""
    model, period_s = found.after, problem.loop_s or found.base.get("loop_s", 0.0)
    if not period_s or found.status not in ("something_else", "too_many"):
        return []
    squares = np.zeros(
        3
    )  # of what is left, of the change by one wait, of what a wait of each half second explains
    for r in recordings:
        cases = [
            (model.values | {"loop_waits_s": wait_s}, model.effects)
            for wait_s in (0.0, period_s)
        ]
        left, late = (np.nan_to_num(residuals(problem, *case, r)) for case in cases)
        starts = np.arange(
            0, len(left), max(1, round(0.5 / (r.time_s[1] - r.time_s[0])))
        )
        rows = np.sum([left**2, (late - left) ** 2, left * (late - left)], axis=2)
        own, change, along = np.add.reduceat(rows, starts, axis=1)
        squares += [
            own.sum(),
            change.sum(),
            (along**2 / np.maximum(change, 1e-9)).sum(),
        ]
    if squares[1] / 12.0 < WAITS**2 * squares[0] or (
        not problem.loop_s and squares[2] < SHARE * squares[0]
    ):
        return []
    spread = math.sqrt(
        squares[1] / 12.0 / sum(np.isfinite(r.measured).sum() for r in recordings)
    )
    return [
        f"A target waits 0 … {1e3 * period_s:.2g} ms for the next period of the loop ({1.0 / period_s:.4g} Hz"
        f"{' by the fit' * (not problem.loop_s)}), each row's another time if no multiple of the rows' rate: this can leave "
        f"{spread:.2g} noise floors, and is no effect. Log rows at the loop's rate or a whole fraction of it, on its clock."
    ]
