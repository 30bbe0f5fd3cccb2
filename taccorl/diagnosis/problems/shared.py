"""Numbers that several joints share: mass and place of a payload, direction of gravity.

They are fitted to all these joints at once, as any other number: in the problem of several
joints a number without the name of a joint is one number, whatever joint it acts on.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from taccorl.diagnosis.problems.joint_problem import TORQUE_FF, JointProblem
from taccorl.diagnosis.search.evidence import (
    Blocks,
    above_floor,
    block_squares,
    standard_score,
)
from taccorl.diagnosis.search.fit import FINE, Fit, best_fit, fit, moved_by
from taccorl.diagnosis.search.fits import is_as_good
from taccorl.diagnosis.search.problem import (
    EFFORT_SCALE,
    Candidate,
    Case,
    Problem,
    Recording,
    Values,
    WithoutMaps,
    chosen,
    split_rows,
    with_held,
)
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.solve import CLEAR, PartFinding
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.load import Payload

FIRST_STEPS, NEXT_STEPS, LAST_STEPS = 2, 4, 40
"""Most steps of the solver from every start, from the best two, and of the last fit."""
ALIKE = 1.25
"""Factor on the squared validation error up to which it counts as equal (12 % of the error)."""
RETURNS = 0.5
"""Share of its change by which a number of the file returns if it is superfluous (a choice)."""


class SeveralJoints(WithoutMaps):
    """Search problem of several joints. Number ``name`` of joint j is ``j/name``; numbers
    of the ``shared`` effect have no prefix.

    Args:
        problems: joint → its own problem.
        names: joint → effects that only this joint has.
        shared: the effect that acts on all of them.
    """

    def __init__(
        self,
        problems: Mapping[str, JointProblem],
        names: Mapping[str, Sequence[str]],
        shared: Candidate,
    ) -> None:
        self._problems = problems
        self._effects = {j: chosen(p, names[j]) for j, p in problems.items()}
        own = {
            j: [
                *(f for f in p.base if not _is_weight(f.name, p, shared)),
                *(f for c in self._effects[j] for f in c.frees),
            ]
            for j, p in problems.items()
        }
        self.base = tuple(
            replace(f, name=f"{j}/{f.name}") for j, frees in own.items() for f in frees
        )
        self._names = {j: [f.name for f in frees] for j, frees in own.items()}
        self.candidates = {shared.name: shared}

    def recordings(self, joint: str, own: Sequence[Recording]) -> list[Recording]:
        """Recordings of one joint as recordings of this problem."""
        return [replace(r, name=f"{joint}/{r.name}", data=(joint, r)) for r in own]

    def simulate_all(
        self, cases: Sequence[Case], recordings: Sequence[Recording]
    ) -> list[list[np.ndarray]]:
        """Each recording with each case: (T, C) channels in units of
        ``Recording.measured``. Cases that are equal for a joint are simulated once."""
        answers = []
        for joint, r in (recording.data for recording in recordings):
            names, effects = self._names[joint], self._effects[joint]
            own = [{n: base[f"{joint}/{n}"] for n in names} for base, _ in cases]
            keys = [
                (*values.values(), *map(repr, shared))
                for values, (_, shared) in zip(own, cases, strict=True)
            ]
            unlike = {key: k for k, key in enumerate(keys)}
            here = [
                (own[k], [*(c.make(own[k]) for c in effects), *cases[k][1]])
                for k in unlike.values()
            ]
            simulated = self._problems[joint].simulate_all(here, [r])[0]
            found = dict(zip(unlike, simulated, strict=True))
            answers.append([found[key] for key in keys])
        return answers


def _is_weight(name: str, problem: JointProblem, shared: Candidate) -> bool:
    """Whether a number of a slide is the weight of a payload as well."""
    slide = problem.model.joint.unit == "m"
    return slide and name == TORQUE_FF.name and issubclass(shared.cls, Payload)


@dataclass(frozen=True)
class SharedFit:
    """Fit of shared numbers to several joints, beside what was found at each alone."""

    fit: Fit
    """Its shared numbers are those of its only effect."""
    intervals: Mapping[str, tuple[float, float]]
    """Parameter of the effect → 95 % interval."""
    squares: Mapping[str, tuple[Blocks, Blocks]]
    """Joint → squared validation errors alone, and with the shared numbers [floors²]."""
    numbers: int
    """Count of the shared numbers."""
    saved: int
    """How many numbers of the joints' own diagnoses are superfluous, less the shared ones."""

    @property
    def effect(self) -> Effect:
        """The effect, with its intervals and the joints of the fit."""
        (found,) = self.fit.effects
        text = f"one fit to {' and '.join(self.squares)}"
        evidence = "; ".join(filter(None, (text, found.reads_as)))
        return replace(found, interval=dict(self.intervals), evidence=evidence)

    @property
    def errors(self) -> dict[str, float]:
        """Joint → validation error [noise floors], at least one."""
        return {j: above_floor(own) ** 0.5 for j, (_, own) in self.squares.items()}

    @property
    def worse(self) -> dict[str, tuple[float, float]]:
        """Joints with a larger error than alone → both errors [noise floors]."""
        errors = {
            j: [above_floor(squares) for squares in own]
            for j, own in self.squares.items()
        }
        return {
            j: (alone**0.5, with_it**0.5)
            for j, (alone, with_it) in errors.items()
            if with_it > ALIKE * alone
        }

    def is_better(
        self, other: "SharedFit", sure: float = SearchConfig().sure_score
    ) -> bool:
        """Whether only this one holds at its joints, or it leaves less at all joints of
        both by ``sure`` standard errors between half seconds. Joints on which one does
        not act keep what they have alone."""
        if self.worse or other.worse:
            return not self.worse
        joints = {**self.squares, **other.squares}
        return sure <= _score_of(
            other.squares.get(j, own[:1])[-1] - self.squares.get(j, own[:1])[-1]
            for j, own in joints.items()
        )

    @property
    def pays(self) -> bool:
        """Whether the shared numbers are worth their place: they replace more numbers of the single joints than they add, or the
        error falls by more than chance explains (``sure_score``)."""
        gains = (alone - with_it for alone, with_it in self.squares.values())
        return self.saved > 0 or _score_of(gains) >= SearchConfig().sure_score


def _score_of(gains: Iterable[Blocks]) -> float:
    """``standard_score`` of the gains of several joints, which count alike."""
    every = list(gains)
    squares = np.concatenate([g.squares for g in every])
    weights = np.concatenate([g.weights for g in every]) / len(every)
    return standard_score(Blocks(squares, weights))


def shared_fit(
    problems: Mapping[str, JointProblem],
    alone: Mapping[str, Diagnosis],
    stands_for: Mapping[str, Sequence[str]],
    shared: Candidate,
) -> SharedFit:
    """Fit one effect to all joints in place of those that it may stand for.

    Args:
        problems: joint → its problem.
        alone: joint → what was found at it alone.
        stands_for: joint → added effects, or the scale of its efforts, in whose place
            ``shared`` does as well.
    """
    names = {
        j: [n for n in alone[j].names if n not in stands_for.get(j, ())]
        for j in problems
    }
    whole = SeveralJoints(problems, names, shared)
    split = {
        j: (p.fit, p.validation) if p.validation else split_rows(p.fit)
        for j, p in problems.items()
    }
    fit_to, others = (
        [r for j, own in split.items() for r in whole.recordings(j, own[k])]
        for k in (0, 1)
    )
    start: Values = {
        f"{j}/{f.name}": alone[j].after.values[f.name]
        for j in problems
        for f in alone[j].after.frees
    }
    starts = [start | own for own in _starts(shared, [alone[j] for j in problems])]
    effect = (shared.name,)
    rough = [fit(whole, fit_to, effect, one, FIRST_STEPS) for one in starts]
    rough.sort(key=lambda f: f.error)
    near = [f.values for f in rough[:2]]
    model = best_fit(whole, fit_to, effect, near, NEXT_STEPS)
    model = _last_fit(whole, model, fit_to, others)
    of_file = {f"{j}/{TORQUE_FF.name}": alone[j].start for j in problems}
    ends = model.intervals()
    same = {
        name: start[TORQUE_FF.name]
        for name, start in of_file.items()
        if name in ends and ends[name][0] <= start[TORQUE_FF.name] <= ends[name][1]
    }
    if same:
        # A constant torque would take up a place of a mass that is a little off.
        simpler = _last_fit(with_held(whole, same), model, fit_to, others)
        if is_as_good(simpler.error, model.error):
            model = simpler
    squares, saved = {}, -len(shared.frees)
    for j, problem in problems.items():
        own, head = split[j][1], f"{j}/"
        squares[j] = (
            block_squares(problem, alone[j].after, own),
            block_squares(whole, model, whole.recordings(j, own)),
        )
        values = {n.removeprefix(head): v for n, v in model.values.items()}
        saved += _superfluous(alone[j], problem, stands_for.get(j, ()), values)
    head = f"{shared.name}."
    ends = {
        name.removeprefix(head): own
        for name, own in model.intervals().items()
        if name.startswith(head)
    }
    return SharedFit(model, ends, squares, len(shared.frees), saved)


def _last_fit(
    whole: Problem, model: Fit, fit_to: Sequence[Recording], others: Sequence[Recording]
) -> Fit:
    """Fit from ``model`` with fine derivatives, and with all that its intervals need."""
    found = fit(whole, fit_to, model.names, model.values, LAST_STEPS, FINE)
    steps = np.full(len(found.frees), FINE)
    return replace(found, moved=moved_by(whole, found, fit_to, others, steps))


def _starts(shared: Candidate, alone: Sequence[Diagnosis]) -> list[Values]:
    """Start values of the shared numbers: those of single joints, else typical ones. Of a
    payload also minus its mass, and both sides of the centre of its body."""
    own = [d.after.values for d in alone if shared.name in d.names]
    start = {}
    for f in shared.frees:
        values = [of[f.name] for of in own if f.name in of]
        start[f.name] = float(np.median(values or [f.start]))
    if not issubclass(shared.cls, Payload):
        return [start]
    mass, *place = shared.frees
    middle = start | dict.fromkeys((f.name for f in place), 0.0)
    below = [middle | {mass.name: -mass.start}] if mass.low < 0.0 and not own else []
    beside = [
        middle | {f.name: side * 0.3 * f.high} for f in place for side in (-1.0, 1.0)
    ]
    return [middle, *below, *beside]


def _superfluous(
    d: Diagnosis,
    problem: JointProblem,
    effects: Sequence[str],
    values: Mapping[str, float],
) -> int:
    """Count of the numbers of a joint's own diagnosis that are superfluous beside shared
    ones: those of ``effects``, of each those of the simplest that ties with it, and
    numbers of the file that return to it.

    Args:
        values: numbers of the joint beside the shared ones; without the constant torque
            of a slide, which is then as in the file.
    """
    count = 0
    for name in effects:
        ties = [name, *d.rivals.get(name, ())]
        sizes = [len(c.frees) for n in ties if (c := problem.candidates.get(n))]
        count += min(sizes, default=1)  # of the scale of efforts
    moved = {c.name: (c.before, c.after) for c in d.changed if c.name not in effects}
    name = TORQUE_FF.name
    if name in d.base and name in d.intervals:
        low, high = d.intervals[name]
        if not low <= d.start[name] <= high:
            moved[name] = d.start[name], d.base[name]
    for number, (before, after) in moved.items():
        now = values.get(number, before if number == name else after)
        count += abs(now - before) < RETURNS * abs(after - before)
    return count


def standing_in(d: Diagnosis, effect: str) -> tuple[str, ...]:
    """Added effects of one joint in whose place ``effect`` explains as much, itself
    included, and the scale of its efforts where that is off instead."""
    scale = [c.name for c in d.changed if c.name == EFFORT_SCALE if effect in c.instead]
    added = [n for n in d.names if n not in d.present]
    return (*scale, *(n for n in added if effect in (n, *d.rivals.get(n, ()))))


def left_of(d: Diagnosis) -> float:
    """Mean squared validation error that is left [noise floors²], 1 at least."""
    return max(d.errors["after"]["validation"], 1.0) ** 2


def beside_alone(d: Diagnosis, alone: Diagnosis) -> Diagnosis:
    """``d`` with shared numbers in the file, compared with the file without them."""
    errors = {**alone.errors, "after": d.errors["after"]}
    return replace(d, errors=errors, before=alone.before)


def with_effect[FindingT: PartFinding](
    f: FindingT, alone: Diagnosis, effect: Effect, ties: Sequence[str] = ()
) -> FindingT:
    """``f``, judged with ``effect`` in the file, as a finding that adds it.

    Args:
        alone: what was found without it.
        ties: other bodies in which a payload explains as much.
    """
    d = f.diagnosis
    ends = {f"{effect.name}.{name}": own for name, own in effect.interval.items()}
    d = replace(
        beside_alone(d, alone),
        status="at_floor" if d.status in CLEAR else d.status,
        effects=(*d.effects, effect),
        intervals={**d.intervals, **ends},
        steps=(alone.steps[0], (effect.name, d.steps[0][1]), *d.steps[1:]),
        twins={**d.twins, effect.name: dict(effect.near_twins)},
        or_in=tuple(ties),
    )
    return replace(f, diagnosis=d)
