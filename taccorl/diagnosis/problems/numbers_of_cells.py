"""Whether the number of an effect differs from cell to cell, where the model has one for all cells.

A shared load is not known cell by cell: gains absorb the share of each cell, but a threshold or a saturation that acts on the
cell's own share does not begin at the same total load in all cells.

Letters in shapes: T rows, C channels, S factors.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from taccorl.diagnosis.problems.cells_problem import CellsProblem
from taccorl.diagnosis.search.problem import Free, Recording
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.sim.effects.effect import Effect

FACTORS = 2.0 ** np.arange(-4.0, 4.5, 0.5)
"""(S,) factors of an effect's number that are tried in each cell."""
MOST_OF_IT = 0.5
"""Least share of the validation squared error above the floor that numbers of the cells' own remove."""
APART = 2.0
"""Least ratio of the cells' factors, of their 90 % quantile to their 10 % quantile."""


def numbers_apart(problem: CellsProblem, d: Diagnosis) -> list[str]:
    """A remark for each effect of ``d`` whose number differs from cell to cell, with the error that such numbers leave and the
    largest and least of them in the unit of the load; none if the diagnosis ended near the noise floor."""
    left = d.errors["after"]["validation"]
    judged, one_place = problem.validation, problem.config.same_place_mm is not None
    if (
        left <= SearchConfig().little
        or len(problem.channels) < 2
        or not judged
        or one_place
    ):
        return []
    remarks = []
    for k, effect in enumerate(d.effects):
        own = [f for f in problem.candidates[effect.name].frees if "reading" in f.unit]
        if not own:
            continue
        fit, validation = ([], [])  # (S, C) squares
        for factor in FACTORS:
            scaled = dataclasses.replace(
                effect, **dict(_scaled(effect, f, factor) for f in own)
            )
            effects = [*d.effects[:k], scaled, *d.effects[k + 1 :]]
            for squares, recordings in ((fit, problem.fit), (validation, judged)):
                squares.append(_squares(problem, d, effects, recordings))
        best = np.argmin(fit, axis=0)
        error = float(
            np.sqrt(np.mean(np.array(validation)[best, np.arange(len(best))]))
        )
        low, high = FACTORS[np.quantile(best, (0.1, 0.9)).round().astype(int)]
        if left**2 - error**2 < MOST_OF_IT * (left**2 - 1.0) or high < APART * low:
            continue
        remarks.append(_words(problem, effect, own[0], best, left, error))
    return remarks


def _scaled(effect: Effect, free: Free, factor: float) -> tuple[str, float]:
    """Name of the parameter and its value times ``factor``, within its bounds."""
    name = free.name.split(".", 1)[1]
    return name, float(np.clip(factor * getattr(effect, name), free.low, free.high))


def _squares(
    problem: CellsProblem,
    d: Diagnosis,
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
) -> np.ndarray:
    """(C,) mean squared residual of each channel [floors²]."""
    off = np.concatenate(
        [
            (problem.simulate(d.base, effects, r) - r.measured) / r.floor
            for r in recordings
        ]
    )
    return np.nanmean(np.square(off), axis=0)


def _words(
    problem: CellsProblem,
    effect: Effect,
    free: Free,
    best: np.ndarray,
    left: float,
    error: float,
) -> str:
    config = problem.config
    names = [config.names[k] for k in problem.channels]
    ends = [
        f"{config.in_load_units(_scaled(effect, free, float(FACTORS[best[c]]))[1], free.unit)[0]:.2g} ({names[c]})"
        for c in (int(np.argmin(best)), int(np.argmax(best)))
    ]
    why = (
        "the load is one for all cells, so that the share of each is not known: if cells bear unequal shares, record the load "
        "of each cell (`shared: false`), or press one cell at a time"
        if config.load.shared
        else "the file has one number for all cells"
    )
    of_load = config.in_load_units(1.0, free.unit)[1]
    return (
        f"{effect.name}: {free.name.split('.', 1)[1]} differs from cell to cell: with a number for each cell {error:.2f} instead "
        f"of {left:.2f} noise floors remain, from {ends[0]} to {ends[1]} {of_load}; {why}"
    )
