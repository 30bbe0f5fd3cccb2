"""Where numbers that the machine's file marks as known limit a fit: each is freed by itself and fitted with the others.

A wrong one shows in two ways: a part of the error goes only if it is freed, or effects were added that only make up for it.
"""

import dataclasses
from collections.abc import Sequence

from taccorl.diagnosis.search.fit import Fit, best_fit
from taccorl.diagnosis.search.fits import model_of, refusal
from taccorl.diagnosis.search.problem import Free, Problem, Recording, with_frees
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig


def limits_of_known(
    problem: Problem,
    known: Sequence[str],
    found: Diagnosis,
    fit_to: Sequence[Recording],
    validation: Sequence[Recording],
    config: SearchConfig,
) -> list[str]:
    """A sentence for each of ``known`` that seems wrong: with it free the validation error is lower by what an effect must
    remove to be accepted, or as low without the effects that were added. [] for those that take no part in the fit. ``known``:
    names of held numbers, of effects with held numbers, or of effects that were left out of the search. ``found``: result of
    the search with all of them held. ``fit_to, validation``: recordings of that search."""
    remarks = []
    for name in known:
        freed, more = _freed(problem, name)
        if freed is None:
            continue
        added = [n for n in found.names if n not in found.present]
        model = model_of(problem, found.after, validation)
        starts = [s for c in more for s in freed.candidates[c].starts] or [{}]
        begun = [
            begun | s for s in starts for begun in (found.before.values, found.start)
        ]
        alone = model_of(
            freed, best_fit(freed, fit_to, (*found.present, *more), begun), validation
        )
        if added and alone.numbers <= model.numbers and refusal(model, alone, config):
            remarks.append(
                f"{_words(problem, name)}; {_numbers(alone.fit, name)} in place of {' and '.join(added)} leaves "
                f"{alone.error:.2f} instead of {model.error:.2f} noise floors: check it, or remove it from `known`"
            )
            continue
        if model.error <= config.floor and model.fit.error <= config.little:
            continue
        begun = [
            begun | s
            for s in starts
            for begun in (model.fit.values, model.fit.values | found.start)
        ]
        beside = model_of(
            freed, best_fit(freed, fit_to, (*found.names, *more), begun), validation
        )
        if not refusal(beside, model, config):
            remarks.append(
                f"{_words(problem, name)}; freeing it would lower the validation error from {model.error:.2f} to "
                f"{beside.error:.2f} noise floors, with {_numbers(beside.fit, name)}: check it, or remove it from `known`"
            )
    return remarks


def _freed(problem: Problem, name: str) -> tuple[Problem | None, tuple[str, ...]]:
    """The problem in which ``name`` is fitted, and the effect to add if it was left out; (None, ()) if it changes nothing."""
    names = {f.name for f in _held(problem, name)}
    if not names:
        return (problem, (name,)) if name in problem.candidates else (None, ())
    freed = with_frees(
        problem, lambda f: dataclasses.replace(f, held=f.held and f.name not in names)
    )
    return freed, ()


def _held(problem: Problem, name: str) -> list[Free]:
    every = (*problem.base, *(f for c in problem.candidates.values() for f in c.frees))
    return [f for f in every if f.held and name in (f.name, f.name.split(".")[0])]


def _words(problem: Problem, name: str) -> str:
    held = _held(problem, name)
    values = " and ".join(
        f"{f.name} {f.start:.4g}{'' if f.unit == '1' else f' {f.unit}'}" for f in held
    )
    return (
        f"{values} {'is' if len(held) == 1 else 'are'} marked as known"
        if held
        else f"{name} is marked as known to be absent"
    )


def _numbers(model: Fit, name: str) -> str:
    """Fitted numbers of ``name`` with their 95 % intervals."""
    intervals = model.intervals()
    return " and ".join(
        f"{f.name} {model.values[f.name]:.4g}{'' if f.unit == '1' else f' {f.unit}'} "
        f"({intervals[f.name][0]:.4g} … {intervals[f.name][1]:.4g})"
        for f in model.frees
        if name in (f.name, f.name.split(".")[0])
    )
