"""Search for missing effects: fit, screen, refit, validate, accept or report "something else".

    1. The numbers that are always fitted are fitted to the fit recordings.
    2. While the validation error is above ``stop_at`` noise floors, or the fit error above ``stop_fit_at``:
       a. every effect is probed once (``screen``); the likeliest are refitted together with all numbers;
       b. they are ranked by their error on the validation recordings;
       c. an effect is accepted if it removes enough of the error above the floor, more than chance and more than its number of
       parameters justifies (BIC), and if it was not fitted to its absent value. The best of those is added. Effects with an
       equal error are its ties, and the simplest of them is taken. Below one floor nothing is better than anything else. Where
       even the best leaves much and more effects may follow, a simpler form of it that removes nearly as much is taken;
       d. if none is accepted, the search ends with "something else"; in the first round only after effects that remove much of
       the fit error alone were tried together with another one;
       e. every effect of an earlier round is exchanged if another one does better beside the newest one, or as well with fewer
       numbers: it was chosen while the newest one was missing.
    3. Where that ends above the floor, it is done again from the ties of the first effect. Effects that others have made
       superfluous go; each is tried against its ties once more, now that the others are in. An
       effect that contains a simpler one (Stribeck contains Coulomb friction) must do better than the simpler one and another.
    4. Numbers of the file whose refit removes a part of the error are named (``changed_numbers``). The test recordings, which no
       choice has seen, give the final figures.

Fits are in ``refits``, steps 2 in ``rounds``, 3 in ``final_checks``, and sentences about the result in ``remarks``.

Whiteness of residuals is no stop rule: it rejects correct models (research: 8 of 8), a robot does not repeat itself exactly.
"""

import itertools
import time
from collections.abc import Mapping, Sequence

from taccorl.diagnosis.search.changed_numbers import changed_numbers
from taccorl.diagnosis.search.final_checks import FinalChecks
from taccorl.diagnosis.search.fit import Fit
from taccorl.diagnosis.search.problem import Problem, Progress, Recording, Values, no_progress
from taccorl.diagnosis.search.refits import Refits
from taccorl.diagnosis.search.remarks import better_than_present, moved_gains, of_gains, of_pairs, of_refit
from taccorl.diagnosis.search.result import Changed, Diagnosis, Offer, Round, SearchConfig, Status, of_test
from taccorl.diagnosis.search.rounds import Rounds
from taccorl.sim.effects.effect import Effect


def diagnose(
    problem: Problem,
    fit_to: Sequence[Recording],
    validation: Sequence[Recording],
    test: Sequence[Recording] = (),
    *,
    start: Mapping[str, float] | None = None,
    present: Sequence[str] = (),
    without: Sequence[str] = (),
    config: SearchConfig | None = None,
    progress: Progress = no_progress,
) -> Diagnosis:
    """Search for the effects that are missing.

    Args:
        fit_to: recordings to which numbers are fitted.
        validation: recordings by whose error effects are chosen.
        test: recordings on which no choice depends; they give the final error.
        start: start values; defaults of the problem's numbers if not given.
        present: effects that the twin has already: they are refitted and never removed.
        without: effects that are left out of the search.
        config: criteria of acceptance; the default ones if not given.
        progress: function that is called with a text about the present step.
    """
    began = time.process_time()
    present = tuple(present)
    refits = Refits(problem, fit_to, validation, start or {}, present, config or SearchConfig(), progress)
    first, as_it_was = refits.first, refits.as_it_was
    problem.learn(first.values)
    names = [name for name in problem.candidates if name not in without]
    rounds = Rounds(refits)
    model, found = rounds.run(first, names, refits.config.max_effects)
    checks = FinalChecks(refits, rounds)
    model, found, rivals, entangled = checks.run(model, found, names)
    steps = [("", refits.first_error), *((r.added, r.validation_error) for r in found if r.added)]
    after = refits.errors(model.values, model.effects, test)
    without_it = _test_without(refits, model, test)
    changed = changed_numbers(refits, model)
    return Diagnosis(
        status=_status(refits, model, changed),
        changed=changed,
        effects=tuple(_described(refits, model, after.get("test"), without_it)),
        offers=tuple(_offers(refits, model, found, rivals, test)),
        present=present,
        base=_base(model),
        start=refits.given,
        intervals=model.intervals(),
        rounds=tuple(found),
        rivals=rivals,
        twins={n: dict(problem.candidates[n].cls.near_twins) for n in refits.added(model)},
        removed=tuple(checks.removed),
        swapped=tuple(rounds.swapped),
        errors={
            "before": refits.errors(as_it_was.values, as_it_was.effects, test),
            "fitted": refits.errors(first.values, first.effects, test),
            "after": after,
        },
        test_without=without_it,
        steps=tuple(steps),
        remarks=(
            *entangled,
            *of_refit(refits, model),
            *of_pairs(refits, rounds, model),
            *of_gains(refits, model),
            *better_than_present(refits, rounds, model, names),
        ),
        at_bound=tuple(f.name for f in model.ended),
        undetermined=_undetermined(model),
        trouble=model.trouble,
        evaluations=refits.evaluations,
        cpu_s=time.process_time() - began,
        before=first,
        after=model,
    )


def _test_without(refits: Refits, model: Fit, test: Sequence[Recording]) -> dict[str, float]:
    """Added effect → RMS error on the test recordings [floors] with the others refitted without it."""
    found = {}
    added = refits.added(model) if test else []
    for name in added:
        rest = tuple(n for n in model.names if n != name)
        other = refits.first if len(added) == 1 else refits.fitted(rest, [model.values], refits.config.steps)
        found[name] = refits.errors(other.values, other.effects, test)["test"]
    return found


def _offers(
    refits: Refits,
    model: Fit,
    rounds: Sequence[Round],
    rivals: Mapping[str, Sequence[str]],
    test: Sequence[Recording],
) -> list[Offer]:
    """Fits of every part of the added effects, and of those in which an effect that ties with one takes its place: alone, and
    beside all others."""
    added, present = refits.added(model), tuple(refits.present)
    sets = [names for count in range(1, len(added)) for names in itertools.combinations(added, count)]
    ties = {str(r.added): r.ties for r in rounds if r.added in added}
    begun = {e.name: e.values for r in rounds for e in r.evidence}
    for name in added:
        for tie in dict.fromkeys((*ties.get(name, ()), *rivals.get(name, ()))):
            if tie not in added:
                sets += [(tie,), tuple(tie if n == name else n for n in added)]
    found = []
    for names in dict.fromkeys(sets):
        refits.progress(f"fitting {' and '.join(names)} without the others, for add-effect")
        starts = [
            model.values | {k: v for name in names for k, v in begun.get(name, {}).items() if k not in model.values}
        ]
        own = refits.finished(refits.fitted((*present, *names), starts, refits.config.steps))
        errors = refits.errors(own.values, own.effects, test)
        found.append(
            Offer(
                added=names,
                effects=tuple(_described(refits, own, None, {})),
                base=_base(own),
                intervals=own.intervals(),
                errors=errors,
                at_bound=tuple(f.name for f in own.ended),
                undetermined=_undetermined(own),
            )
        )
    return found


def _base(model: Fit) -> Values:
    """The always fitted numbers of ``model``."""
    return {f.name: model.values[f.name] for f in model.frees if "." not in f.name}


def _status(refits: Refits, model: Fit, changed: Sequence[Changed]) -> Status:
    added, config = refits.added(model), refits.config
    if model.trouble:
        return "not_converged"
    if refits.at_floor(model) and added:
        return "at_floor"
    if refits.at_floor(model) or (not added and max(refits.error(model), model.error) <= config.little):
        if moved_gains(refits, refits.first):
            return "gains_moved"
        return "numbers_off" if changed else "nothing_missing"
    return "too_many" if len(added) >= config.max_effects else "something_else"


def _described(refits: Refits, model: Fit, test_error: float | None, test_without: Mapping[str, float]) -> list[Effect]:
    """The effects of ``model``. Each states its 95 % intervals and, as evidence, the validation error before and after, and the
    error on the test recordings with and without it."""
    intervals = model.intervals()
    as_it_was, after = refits.error(refits.as_it_was), refits.error(model)
    before = min(as_it_was, refits.first_error) if refits.added(model) else as_it_was
    for effect in model.effects:
        prefix = f"{effect.name}."
        effect.interval = {k.removeprefix(prefix): v for k, v in intervals.items() if k.startswith(prefix)}
        effect.evidence = (
            f"validation error {before:.2f} to {after:.2f} noise floors with {', '.join(model.names)}; recordings "
            f"{', '.join(r.name for r in refits.validation)}"
        )
        if test_error is not None and effect.name in test_without:
            effect.evidence += f"; test {of_test(test_without[effect.name], test_error)}"
    return list(model.effects)


def _undetermined(model: Fit) -> tuple[str, ...]:
    """Numbers of which the recordings say nothing: their interval is the whole range."""
    ends = model.intervals()
    return tuple(f.name for f in model.frees if ends[f.name][0] <= f.low and ends[f.name][1] >= f.high)
