"""Numbers that the machine's file states and that the recordings contradict.

The search refits the effects of the file, and a few other numbers of it, in every
hypothesis. Where such a number is wrong in the file, its refit removes the error, and no
effect is missing: the change is then the result of the diagnosis.

Numbers can make up for each other. So they return to the file's values one after another,
the least significant first, and stay there where the error hardly rises. Those that do not
are named where their 95 % interval excludes the file's value.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from taccorl.alignment.controller.drive_law import SHORTEST_STEP_S
from taccorl.alignment.least_squares import LOOSE
from taccorl.diagnosis.search.fit import Fit, best_fit
from taccorl.diagnosis.search.fits import (
    FIRST_STEPS,
    NEAR_BEST,
    STEPS,
    SURELY_FULL,
    Fits,
    Model,
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

OF_LOOP = ("loop_s", "speed_delay_s")
"""Numbers of a drive's loop whose rate, ``loop_hz``, the file does not state. They are
named as that one."""
STATED = {
    "torque_ff": "torque_ff",
    "inertia": "inertia",
    EFFORT_SCALE: "effort_scale",
    "weight_sin": "weight",
    "weight_cos": "weight",
    "stall_nm": "winding",
    "back_emf": "winding",
}
"""Always fitted number that a file can state → group of numbers that are judged together.
Not here: gains that nobody knows and that are fitted, and numbers of cells, pads and
recordings, whose refit is expected."""
TIMES = {
    "speed_delay_s": "speed",
    "speed_late_s": "speed",
    "position_age_s": "position",
    "target_late_s": "target",
}
"""Delays of the drive, which are always fitted and may be stated in the machine's file →
group, as in ``STATED``. They stay free in every fit of ``_fewest``."""
NEGLIGIBLE = 0.01
"""Share of the file's value within which a fitted number is the same. A choice."""
REFIT_WORSE = 1.3
"""Factor on the validation error from which on a refit of the fitted numbers is a finding:
more than another motion's noise."""
GAINS_MOVED = 2.0
"""Factor between the twin's gains and refitted ones from which on the refit is a finding of
its own, caused by late positions, a wrong unit of time, or other gains than commanded."""
NEAR = (1.0, 0.7, 1.4)
"""Multiples of the file's value that are start values in fits of one or two numbers. From
one start far from the solution a fit may end with a wrong delay of the targets instead."""


def changed_numbers(fits: Fits, model: Fit) -> tuple[tuple[Changed, ...], Fit]:
    """Numbers of the file that are off, and ``model``; where few numbers of the file
    explain as much as it (``_fewest``), the fit of those."""
    given = fits.given | {f.name: f.start for f in fits.problem.of_file}
    fewest = _fewest(fits, model, given) if fits.problem.of_file else None
    off, model, ties = (_off(fits, model), model, ()) if fewest is None else fewest
    ends = model.intervals()
    found: dict[str, Changed] = {}
    for f, without in off:
        name, before, after = f.name, float(given[f.name]), float(model.values[f.name])
        low, high = ends.get(name, (after, after))
        unit = f.unit
        if "loop_s" in model.values and name in OF_LOOP:
            loop_s = model.values["loop_s"]
            if loop_s < SHORTEST_STEP_S:
                continue  # faster than the model's own steps
            name, before, after, unit = "loop_hz", np.inf, 1.0 / loop_s, "Hz"
        elif low <= before <= high and len(off) > 1:
            continue
        instead = _instead(fits, model, f)
        found.setdefault(
            name,
            Changed(
                name=name,
                before=before,
                after=after,
                unit=unit,
                without=without,
                instead=instead,
                ties=ties,
            ),
        )
    return tuple(found.values()), model


Off = list[tuple[Free, float]]
"""Numbers of the machine's file that are wrong, each with the validation error [floors] of
a fit in which it keeps the file's value."""


def _off(fits: Fits, model: Fit) -> Off:
    """Numbers whose return to the file's value costs more than what another model may
    leave; none where the numbers of the file leave no more than ``model``."""
    as_it_was, smaller = fits.model_of(fits.as_it_was), fits.model_of(model)
    own, config = _stated(fits, model), fits.config
    if (
        not own
        or as_it_was.error <= config.floor
        or refusal(smaller, as_it_was, config)
    ):
        return []
    fits.progress("which numbers of the file are off")
    kept, found = Values(), Off()
    for f in own:
        stated = {f.name: fits.given[f.name]}
        moved = abs(model.values[f.name] - fits.given[f.name])
        trial = _refitted(fits, model, with_held(fits.problem, kept | stated))
        same = moved <= NEGLIGIBLE * abs(fits.given[f.name])
        if same or refusal(smaller, trial, config) or fits.at_floor(trial):
            kept, smaller = kept | stated, trial
        else:
            found.append((f, trial.error))
    return found


def _stated(fits: Fits, model: Fit) -> list[Free]:
    """Fitted numbers that the file states; the one first whose return to the file's value
    costs least by the covariance of ``model``."""
    names = {f.name for f in model.frees}
    stated = {*STATED, *TIMES, *(OF_LOOP if "loop_s" in names else ())}
    if fits.problem.other_gain is not None:
        stated.add(fits.problem.other_gain.name)
    if "kp" in names:  # with unknown gains these may differ from the file's
        stated -= {"torque_ff"}
        stated -= {"speed_delay_s"} if "loop_s" not in names else set()
    size = np.sqrt(np.diag(model.covariance()))

    def significance(k: int) -> float:
        f = model.frees[k]
        moved = f.coordinate(fits.given[f.name]) - f.coordinate(model.values[f.name])
        return abs(moved) / size[k]

    own = [
        k
        for k, f in enumerate(model.frees)
        if f.name in stated or f.name.rpartition(".")[0] in fits.present
    ]
    return [model.frees[k] for k in sorted(own, key=significance)]


def _instead(fits: Fits, model: Fit, f: Free) -> tuple[str, ...]:
    """``EFFORT_SCALE`` where it alone explains as much as another inertia."""
    own = {other.name for other in model.frees} - {f.name}
    scaled = with_scale(
        with_held(
            fits.problem,
            {
                b.name: fits.given[b.name]
                for b in fits.problem.base
                if b.name not in own
            },
        )
    )
    if f.name != "inertia" or scaled is None:
        return ()
    trial = _refitted(fits, model, scaled)
    return (EFFORT_SCALE,) * bool(refusal(fits.model_of(model), trial, fits.config))


def _refitted(
    fits: Fits,
    model: Fit,
    problem: Problem,
    starts: Sequence[Values] = (),
    short: bool = False,
) -> Model:
    """The effects of ``model`` refitted to the same recordings with the free and held
    numbers of another ``problem``; ``short``: by a few steps only."""
    began, most = starts or [model.values, model.values | fits.given], STEPS
    if short:
        most = FIRST_STEPS
    found = best_fit(problem, fits.fit_to, model.names, began, most, LOOSE)
    return model_of(problem, found, fits.validation)


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

    def trial(*taken: list[Free], short: bool = False) -> Model:
        free = {f.name: given[f.name] for frees in taken for f in frees}
        problem = with_held(
            fits.problem, {f.name: given[f.name] for f in every if f.name not in free}
        )
        problem.base += tuple(f for f in fits.problem.of_file if f.name in free)
        begun = given | {
            n: v for n, v in model.values.items() if n in timing or n not in given
        }
        near = [
            model.values | given | {n: k * v for n, v in free.items()}
            for k in (NEAR[:1] if short or not free else NEAR)
        ]
        return _refitted(fits, model, problem, [begun, *near], short)

    def trials(*taken: list[Free]) -> list[tuple[Model, list[Free]]]:
        """Models with one group more; fitted until they converge where they may be the best."""
        rest = [frees for frees in groups if frees not in taken]
        first = [(trial(*taken, frees, short=True), frees) for frees in rest]
        first.sort(key=lambda pair: pair[0].error)
        enough = NEAR_BEST * max(first[0][0].error, 1.0)
        return [
            (trial(*taken, f), f) if k < SURELY_FULL or m.error <= enough else (m, f)
            for k, (m, f) in enumerate(first)
        ]

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
        before, tried = smaller, trials(*taken)
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
            (f, before.error if frees is own else trial(own).error)
            for frees in taken
            for f in frees
        ],
        smaller.fit,
        ties,
    )


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
