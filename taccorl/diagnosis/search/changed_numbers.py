"""Numbers that the machine's file states and that a fit had to change to explain the recordings.

The search refits the effects of the file, and a few other numbers of it, in every hypothesis. Where such a number is wrong in the
file, its refit removes the error, and no effect is missing: the change is then the result of the diagnosis.

A change is named by the rule of the search: with the number as the file states it, and all others refitted, the error is clearly
larger, and above the noise floor. Numbers can make up for each other, so they are returned to the file's values one after
another, the least significant first, and stay there where the error hardly rises.
All efforts by one factor, as of a wrong torque constant, act as another inertia does, unless weight, friction or a load is known.
A number of the drive may have moved because an effect is missing that acts alike in these recordings, such as a weight on a
constant torque: effects that do as well in its place are named with it (``Changed.instead``).
"""

import itertools
from collections.abc import Sequence
from functools import partial

import numpy as np

from taccorl.alignment.controller.drive_law import SHORTEST_STEP_S
from taccorl.diagnosis.search.evidence import gain_of
from taccorl.diagnosis.search.fit import Fit, best_fit
from taccorl.diagnosis.search.fits import (
    PROBED_BESIDE,
    STEPS,
    Fits,
    Model,
    best,
    model_of,
    refusal,
)
from taccorl.diagnosis.search.problem import (
    EFFORT_SCALE,
    Free,
    Problem,
    Values,
    with_held,
    with_scale,
)
from taccorl.diagnosis.search.result import Changed

STATED = {
    "torque_ff": "torque_ff",
    "inertia": "inertia",
    EFFORT_SCALE: "effort_scale",
    "weight_sin": "weight",
    "weight_cos": "weight",
    "stall_nm": "winding",
    "back_emf": "winding",
}
"""Always fitted number that a file can state → group of numbers that are judged together. Not here: gains that nobody knows and
that are fitted, and numbers of cells, pads and recordings, whose refit is expected."""
TIMES = {
    "speed_delay_s": "speed",
    "speed_late_s": "speed",
    "position_age_s": "position",
    "target_late_s": "target",
}
"""Delays of the drive, which are always fitted and may be stated in the machine's file → group, as in ``STATED``. They stay free
in every fit of ``_fewest``."""
NEGLIGIBLE = 0.01
"""If, with the added effects, a number is fitted within this share of the file's value, its change is not reported. A choice."""
BACK = 0.1
"""Likewise this share of the change that it needs without the added effects. A choice."""
REFIT_WORSE = 1.3
"""Factor on the validation error from which on a refit of the fitted numbers is a finding: more than another motion's noise."""
GAINS_MOVED = 2.0
"""Factor between the twin's gains and refitted ones from which on the refit is a finding of its own, caused by late positions, a
wrong unit of time, or gains other than the commanded ones."""
NEAR = (1.0, 0.7, 1.4)
"""Multiples of the file's value that are start values in fits of one or two numbers. From one start far from the solution a fit
may end with a wrong delay of the targets instead."""
OF_LOOP = ("loop_s", "speed_delay_s")
"""Numbers of a drive's loop whose rate, ``loop_hz``, the file does not state. They are named as that one."""


def changed_numbers(
    fits: Fits, model: Fit, names: Sequence[str]
) -> tuple[tuple[Changed, ...], Fit]:
    """Numbers of the file whose refit explains a part of the error of the twin as it was: before an effect was added, unless the
    added ones bring them back into their 95 % intervals or near the file's value; and beside the added ones. ``names``: effects
    that may be missing. Also ``model``; where few numbers explain as much (``_fewest``), the fit of those."""
    found: dict[str, Changed] = {}
    given = fits.given | {f.name: f.start for f in fits.problem.of_file}
    fewest = _fewest(fits, model, given) if fits.problem.of_file else None
    before = _off(fits, fits.first) if fits.added(model) and fewest is None else []
    beside, model, ties = (_off(fits, model), model, ()) if fewest is None else fewest
    intervals = model.intervals()
    for fit, off in ((fits.first, before), (model, beside)):
        for frees, without in off:
            ends = {
                f.name: intervals.get(f.name, 2 * (model.values.get(f.name, f.start),))
                for f in frees
            }
            moved = [
                f
                for f in frees
                if not ends[f.name][0] <= given[f.name] <= ends[f.name][1]
            ]
            change = {f.name: abs(model.values[f.name] - given[f.name]) for f in moved}
            first = {f.name: abs(fit.values[f.name] - given[f.name]) for f in moved}
            least = {
                name: max(NEGLIGIBLE * abs(given[name]), BACK * more)
                for name, more in first.items()
            }
            moved = [f for f in moved if fit is model or change[f.name] > least[f.name]]
            of_drive = "." not in frees[0].name
            instead = _instead(fits, model, frees, names) if of_drive else ()
            rate = "loop_s" in model.values and frees[0].name in OF_LOOP
            changed = partial(
                Changed,
                without=without,
                alone=fit is not model,
                instead=instead,
                ties=ties,
            )
            for f in frees if rate else moved or (frees if fit is model else []):
                name, before, after, unit = (
                    f.name,
                    float(given[f.name]),
                    float(model.values[f.name]),
                    f.unit,
                )
                if rate and model.values["loop_s"] < SHORTEST_STEP_S:
                    continue  # faster than the model's own steps
                if rate:
                    name, before, after, unit = (
                        "loop_hz",
                        np.inf,
                        1.0 / max(model.values["loop_s"], 1e-9),
                        "Hz",
                    )
                found.setdefault(
                    name, changed(name=name, before=before, after=after, unit=unit)
                )
    return tuple(found.values()), model


Off = list[tuple[list[Free], float]]
"""Groups of numbers of the machine's file that are wrong, each with the validation error [noise floors] of a fit in which the
group keeps the file's values."""


def _off(fits: Fits, model: Fit) -> Off:
    """Groups of numbers whose change in ``model`` meets the criteria."""
    as_it_was, smaller = fits.model_of(fits.as_it_was), fits.model_of(model)
    groups, config = _groups(fits, model), fits.config
    if (
        not groups
        or as_it_was.error <= config.floor
        or refusal(smaller, as_it_was, config)
    ):
        return []
    fits.progress("which numbers of the file are off")
    kept, found = dict[str, float](), []
    for frees in groups:
        stated = {f.name: fits.given[f.name] for f in frees}
        trial = _refitted(fits, model, with_held(fits.problem, kept | stated))
        if refusal(smaller, trial, config) or fits.at_floor(trial):
            kept, smaller = kept | stated, trial
        else:
            found.append((frees, trial.error))
    return found


def _fewest(
    fits: Fits, model: Fit, given: Values
) -> tuple[Off, Fit, tuple[str, ...]] | None:
    """Find at most two numbers, as few as possible, of the machine's file such that a fit of these alone, all others as the file
    states them, explains the recordings as well as ``model``. Returns these numbers, the fit, and a text for each number that
    does as well as the last one; None if two are too few. ``given``: values of the file."""
    every = [f for f in fits.problem.base if f.name in STATED] + [
        f for n in fits.present for f in fits.problem.candidates[n].frees
    ]
    groups, timing = (
        [[f] for f in fits.problem.of_file],
        given.keys() - {f.name for f in every},
    )
    for _, together in itertools.groupby(
        every, lambda f: f.name.rpartition(".")[0] or STATED[f.name]
    ):
        if (frees := [f for f in together if not f.held]) and frees[0].name not in (
            "stall_nm",
            "back_emf",
        ):
            groups.append(frees)

    def trial(*taken: list[Free]) -> Model:
        free = {f.name: given[f.name] for frees in taken for f in frees}
        problem = with_held(
            fits.problem, {f.name: given[f.name] for f in every if f.name not in free}
        )
        problem.base += tuple(f for f in fits.problem.of_file if f.name in free)
        begun = given | {
            n: v for n, v in model.values.items() if n in timing or n not in given
        }
        near = [
            model.values | given | {n: k * v for n, v in free.items()} for k in NEAR
        ]
        return _refitted(fits, model, problem, [begun, *near])

    answer, taken, tried, smaller = (
        fits.model_of(model),
        list[list[Free]](),
        list[tuple[Model, list[Free]]](),
        trial(),
    )
    before, own = smaller, list[Free]()
    while not refusal(answer, smaller, fits.config):
        if len(taken) == 2:
            return None
        fits.progress("which number of the file is off")
        before, tried = (
            smaller,
            [(trial(*taken, frees), frees) for frees in groups if frees not in taken],
        )
        smaller, own = min(tried, key=lambda pair: pair[0].error)
        taken.append(own)
    if not taken:
        return [], smaller.fit, ()
    as_good = [
        (m, f)
        for m, frees in tried
        for f in frees
        if frees is not own and refusal(answer, m, fits.config)
    ]
    ties = tuple(
        f"{f.name} {given[f.name]:.4g} → {m.fit.values[f.name]:.4g} {f.unit}"
        for m, f in as_good
    )
    return (
        [
            (frees, before.error if frees is own else trial(own).error)
            for frees in taken
        ],
        smaller.fit,
        ties,
    )


def _groups(fits: Fits, model: Fit) -> list[list[Free]]:
    """Fitted numbers that the file states, those of one effect together; the group first whose return to the file's values costs
    least by the covariance of ``model``."""
    names = {f.name for f in model.frees}
    stated = (
        STATED | TIMES | dict.fromkeys(OF_LOOP if "loop_s" in names else (), "loop")
    )
    stated |= (
        {}
        if fits.problem.other_gain is None
        else {fits.problem.other_gain.name: "gain"}
    )
    # Where the gains are unknown, the constant torque and the speed's delay may differ from the file's, and are not reported.
    unknown = (
        {"torque_ff", *(("speed_delay_s",) if "loop_s" not in names else ())}
        if "kp" in names
        else ()
    )
    groups: dict[str, list[Free]] = {}
    for f in model.frees:
        effect, _, _ = f.name.rpartition(".")
        own = stated.get(f.name) if f.name not in unknown else None
        if group := effect if effect in fits.present else own:
            groups.setdefault(group, []).append(f)
    index, covariance = (
        {f.name: k for k, f in enumerate(model.frees)},
        model.covariance(),
    )

    def cost(frees: list[Free]) -> float:
        at = [index[f.name] for f in frees]
        moved = np.array(
            [
                f.coordinate(fits.given[f.name]) - f.coordinate(model.values[f.name])
                for f in frees
            ]
        )
        return float(moved @ np.linalg.pinv(covariance[np.ix_(at, at)]) @ moved)

    return sorted(groups.values(), key=cost)


def _instead(
    fits: Fits, model: Fit, frees: Sequence[Free], names: Sequence[str]
) -> tuple[str, ...]:
    """Effects of which each, with ``frees`` as the file has them, explains as much as ``model``, where none was added; instead of
    an inertia ``EFFORT_SCALE`` alone, if it does."""
    own, answer = (
        {f.name for f in model.frees} - {f.name for f in frees},
        fits.model_of(model),
    )
    problem = with_held(
        fits.problem,
        {f.name: fits.given[f.name] for f in fits.problem.base if f.name not in own},
    )
    if frees[0].name == "inertia" and (scaled := with_scale(problem)) is not None:
        problem = scaled
        if refusal(answer, _refitted(fits, model, problem), fits.config):
            return (EFFORT_SCALE,)
    if fits.added(model):
        return ()
    beside = Fits(
        problem,
        fits.fit_to,
        fits.validation,
        fits.given,
        fits.present,
        fits.config,
        fits.report,
    )
    found = beside.children(beside.base, names)
    as_good = [
        m
        for m in found
        if m.full and not beside.flaw(m) and refusal(answer, m, fits.config)
    ]
    return tuple(
        m.names[-1] for m in sorted(as_good, key=lambda m: (m.numbers, m.error))
    )


def _refitted(
    fits: Fits, model: Fit, problem: Problem, starts: Sequence[Values] = ()
) -> Model:
    """The effects of ``model`` refitted to the same recordings with the free and held numbers of another ``problem``."""
    found = best_fit(
        problem,
        fits.fit_to,
        model.names,
        starts or [model.values, model.values | fits.given],
        STEPS,
    )
    return model_of(problem, found, fits.validation)


def of_refit(fits: Fits, answer: Model) -> list[str]:
    """Remark if no effect was added and refitting the always fitted numbers raised the validation error; else none."""
    before = fits.error(fits.as_it_was)
    if fits.added(answer) or fits.base.error <= REFIT_WORSE * max(before, 1.0):
        return []
    return [
        f"refitted to the fit recordings, the twin's numbers raise the validation error from {before:.2f} to "
        f"{fits.base.error:.2f} noise floors: the twin lacks something that both kinds of recordings show differently, such "
        "as an effect of the speed, the pose or a warm gear."
    ]


def moved_gains(fits: Fits, model: Fit) -> dict[str, tuple[float, float]]:
    """Gain → (the twin's, fitted) of those that are more than ``GAINS_MOVED`` times off."""
    pairs = {
        g: (fits.given[g], model.values[g])
        for g in ("kp", "kd")
        if g in model.values and fits.given.get(g)
    }
    return {
        g: (old, new)
        for g, (old, new) in pairs.items()
        if not 1 / GAINS_MOVED <= new / old <= GAINS_MOVED
    }


def of_gains(fits: Fits, model: Fit) -> list[str]:
    """Sentences on gains that had to move far, as they are in the result, or before any effect where only those moved."""
    units = {f.name: f.unit for f in model.frees}
    moved = {
        g: ("before any effect was considered", *m)
        for g, m in moved_gains(fits, fits.first).items()
    }
    moved |= {
        g: ("with the effects added", *m) for g, m in moved_gains(fits, model).items()
    }
    return [
        f"{gain} had to move from the twin's {old:.4g} to {new:.4g} {units[gain]} (× {new / old:.2g}) {when}. Check the time "
        "stamps (positions reported late, wrong unit of time) and which gains were commanded (kp, kd of the recording in "
        "measurements.yaml)."
        for gain, (when, old, new) in moved.items()
    ]


def better_than_present(fits: Fits, answer: Model, names: Sequence[str]) -> list[str]:
    """Remarks on effects of the twin in whose place others do much better, where the search ended above the floor: such an
    effect may have been added while another was missing. None where the other one does still better beside the twin's: then
    only the other one is missing."""
    remarks = []
    for name in fits.present if not fits.at_floor(answer) else ():
        part = fits.without(answer, name)
        others = [n for n in names if n not in answer.names]
        found = [
            m
            for m in fits.children(part, others, PROBED_BESIDE)
            if m.full and not fits.why_not(m, part)
        ]
        instead = best(found, fits.config) if found else answer
        if gain_of(instead.squares, answer.squares) < fits.config.sure_gain:
            continue
        new = instead.names[-1]
        if not fits.at_floor(instead):
            starts = [
                answer.fit.values | instead.fit.values,
                instead.fit.values | answer.fit.values,
            ]
            if not refusal(
                fits.model_of(fits.fitted((*answer.names, new), starts)),
                instead,
                fits.config,
            ):
                continue
        remarks.append(
            f"{new} in place of {name}, which the twin has, would leave {instead.error:.2f} instead of {answer.error:.2f} noise "
            f"floors, and beside it no less: if a diagnosis added {name}, remove it from the twin's file and diagnose again."
        )
    return remarks
