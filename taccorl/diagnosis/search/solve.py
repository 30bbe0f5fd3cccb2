"""Diagnosis of one part, the same for every machine: choice of validation rows, identifiability, and the search."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from taccorl.diagnosis.search.fit import residuals
from taccorl.diagnosis.search.identifiability import Identifiability, identifiability
from taccorl.diagnosis.search.known_numbers import limits_of_known
from taccorl.diagnosis.search.problem import Problem, Progress, Recording, Values, no_progress, split_rows
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.search import diagnose
from taccorl.errors import TaccorlError

WAITS, SHARE = 0.5, 0.15
"""Targets that wait for the loop are named where waits of any length make at least ``WAITS`` of the error that is left, and, if
the file does not state the loop, one wait for each half second explains ``SHARE`` of its square. Choices: waits were seen to
explain 0.25 or more, an unknown friction 0.05."""


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


class Solved(NamedTuple):
    """Result of ``solve``: the diagnosis, the effects that the recordings can tell apart, and the recordings, or rows of them,
    that were fitted and by which effects were chosen."""

    diagnosis: Diagnosis
    can_tell: Identifiability
    """Effects that the fit recordings can show and separate, independent of the measured values."""
    fit_to: Sequence[Recording]
    """Recordings, or their first rows, that were fitted."""
    validation: Sequence[Recording]
    """Recordings, or their last rows, by whose error effects were chosen."""
    rows_split: bool
    """True if no recording was marked for validation, so that the last rows of each were used."""


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
        part: name of the part, for messages.
        fit_to: recordings to which numbers are fitted.
        validation: recordings by whose error effects are chosen; if there are none, the last rows of those of the fit.
        test: recordings on which no choice depends.
        search: criteria of acceptance; the default ones if not given.
        without: effects that are left out of the search.
        progress: function that is called with a text about the present step.

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
    absent = [name for name in problem.known if name in problem.candidates and name not in problem.present]
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
    waiting = _of_loop(problem, found, (*fit_to, *validation))
    found = dataclasses.replace(found, remarks=(*waiting, *found.remarks))
    if problem.known:
        progress("what the known numbers cost")
        limits = limits_of_known(problem, problem.known, found, fit_to, validation, search or SearchConfig())
        found = dataclasses.replace(found, remarks=(*found.remarks, *limits))
    return Solved(found, can_tell, fit_to, validation, rows_split)


def _of_loop(problem: Problem, found: Diagnosis, recordings: Sequence[Recording]) -> list[str]:
    """Sentence where an error is left of the size that targets make which wait for the next period of a drive's loop."""
    model, period_s = found.after, problem.loop_s or found.base.get("loop_s", 0.0)
    if not period_s or found.status not in ("something_else", "too_many"):
        return []
    squares = np.zeros(
        3
    )  # of what is left, of a wait of a whole period, of what such waits of half seconds make up for
    for r in recordings:
        left, late = (
            np.nan_to_num(residuals(problem, model.values | {"loop_waits_s": wait_s}, model.effects, r))
            for wait_s in (0.0, period_s)
        )
        starts = np.arange(0, len(left), max(1, round(0.5 / (r.time_s[1] - r.time_s[0]))))
        sums = [
            np.add.reduceat((x * y).sum(axis=1), starts)
            for x, y in ((left, left), (late - left, late - left), (left, late - left))
        ]
        squares += [sums[0].sum(), sums[1].sum(), (sums[2] ** 2 / np.maximum(sums[1], 1e-9)).sum()]
    spread = math.sqrt(squares[1] / 12.0 / sum(np.isfinite(r.measured).sum() for r in recordings))
    if squares[1] / 12.0 < WAITS**2 * squares[0] or (not problem.loop_s and squares[2] < SHARE * squares[0]):
        return []
    return [
        f"A target waits 0 … {1e3 * period_s:.2g} ms for the loop's next period, each row's another time where the loop's rate "
        f"({1.0 / period_s:.4g} Hz{' by the fit' * (not problem.loop_s)}) is no multiple of the rows': that alone can leave "
        f"{spread:.2g} noise floors, which no effect explains. Log rows at the loop's rate or a whole fraction of it, from its "
        "clock."
    ]
