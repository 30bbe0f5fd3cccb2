"""One unknown mass in a body as the explanation of what several joints lack. It adds to the inertia of every joint that moves the
body, and to the load of those that weight loads; so it is fitted to all of them at once, and must hold at all of them."""

from collections.abc import Mapping, Sequence
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
from taccorl.diagnosis.search.problem import (
    Candidate,
    Case,
    Recording,
    Values,
    WithoutMaps,
    chosen,
    split_rows,
)
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.load import Payload

_FIRST_STEPS, _LIKELY, _NEXT_STEPS, _STEPS = 2, 2, 4, 40
"""Most steps from every start; number of the best that go on, and their further steps; steps of the last fit."""
ALIKE = 1.25
"""Factor on the squared validation error up to which a shared number explains as much at one joint (12 % of the error)."""
_BESIDE = 0.3
"""Share of its bound at which the mass starts beside the centre of mass of its body, in each direction that can be seen."""
_OFF = 0.5
"""Least share of a fitted ``torque_ff``, or of a change of the file, that a mass makes superfluous to count (a choice)."""


class OneMassProblem(WithoutMaps):
    """Search problem of several joints with one ``payload`` in a body that they all move. A number of joint j has the name
    ``j/name``; those of the payload have no prefix.

    Args:
        problems: joint → its own problem.
        names: joint → effects of the joint that are fitted besides the ``payload``, whose place has bounds.
    """

    def __init__(
        self,
        problems: Mapping[str, JointProblem],
        names: Mapping[str, Sequence[str]],
        payload: Candidate,
    ) -> None:
        self._problems = problems
        self._effects = {
            joint: chosen(problem, names[joint]) for joint, problem in problems.items()
        }
        own = {
            j: (*p.base, *(f for c in self._effects[j] for f in c.frees))
            for j, p in problems.items()
        }
        self.base = tuple(
            replace(f, name=f"{j}/{f.name}") for j, frees in own.items() for f in frees
        )
        self._names = {j: [f.name for f in frees] for j, frees in own.items()}
        self.candidates = {payload.name: payload}

    def own(
        self, joint: str, model: Fit
    ) -> tuple[tuple[Effect, ...], Values, dict[str, tuple[float, float]]]:
        """Effects, always fitted numbers and 95 % intervals of one joint in a fit of this problem."""
        head = f"{joint}/"
        values = {
            k.removeprefix(head): v
            for k, v in model.values.items()
            if k.startswith(head)
        }
        ends = {
            k.removeprefix(head): v
            for k, v in model.intervals().items()
            if k.startswith(head)
        }
        base = {
            f.name: values[f.name] for f in self._problems[joint].base if not f.held
        }
        return tuple(c.make(values) for c in self._effects[joint]), base, ends

    def recordings(self, joint: str, own: Sequence[Recording]) -> list[Recording]:
        """Recordings of one joint as recordings of this problem."""
        return [replace(r, name=f"{joint}/{r.name}", data=(joint, r)) for r in own]

    def simulate_all(
        self, cases: Sequence[Case], recordings: Sequence[Recording]
    ) -> list[list[np.ndarray]]:
        """Simulate each recording with each case: [recording][case] → (T, C) channels in units of ``Recording.measured``. A case
        holds the numbers of all joints, ``j/name`` → value, and the payload; joint j depends on its own numbers only."""
        answers = []
        for joint, r in (recording.data for recording in recordings):
            own = [
                {name: base[f"{joint}/{name}"] for name in self._names[joint]}
                for base, _ in cases
            ]
            keys = [
                (*values.values(), *map(repr, e))
                for values, (_, e) in zip(own, cases, strict=True)
            ]
            unlike = {key: k for k, key in enumerate(keys)}
            here = [
                (
                    own[k],
                    [c.make(own[k]) for c in self._effects[joint]]
                    + [*self.at(joint, r, cases[k][1])],
                )
                for k in unlike.values()
            ]
            found = dict(
                zip(
                    unlike,
                    self._problems[joint].simulate_all(here, [r])[0],
                    strict=True,
                )
            )
            answers.append([found[key] for key in keys])
        return answers

    def at(
        self, joint: str, own: Recording, effects: Sequence[Effect]
    ) -> Sequence[Effect]:
        """What the shared effects are at one joint in one of its recordings: themselves."""
        return effects


@dataclass(frozen=True)
class OneMass:
    """One mass fitted to several joints, beside what was found at each of them alone."""

    model: Fit
    """The fit; numbers of the payload are ``payload.mass_kg``, …"""
    holds: bool
    """Whether it leaves no joint with a larger error than what was found there alone."""
    is_simpler: bool
    """Whether it takes fewer numbers than the effects in whose place it stands, and the constant torques and changes of the
    file's numbers that it explains."""
    squares: Mapping[str, tuple[Blocks, Blocks]]
    """Joint → squared validation errors of what was found there alone, and with the mass [floors²]."""

    @property
    def errors(self) -> dict[str, float]:
        """Joint → validation error with the mass [noise floors], as by ``error_of``."""
        return {
            joint: error_of(with_it) for joint, (_, with_it) in self.squares.items()
        }

    @property
    def payload(self) -> Payload:
        """The fitted mass."""
        (found,) = self.model.effects
        assert isinstance(found, Payload)
        return found


def one_mass(
    problems: Mapping[str, JointProblem],
    alone: Mapping[str, Diagnosis],
    stands_for: Mapping[str, Sequence[str]],
    payload: Candidate,
) -> OneMass:
    """Fit one payload to all joints in place of the effects that it may stand for.

    Args:
        problems: joint → its problem. A slide's may hold ``torque_ff``, which is the same as a weight there.
        alone: joint → what was found at it alone.
        stands_for: joint → added effects, or the scale of its efforts, in whose place the ``payload`` does as well.
    """
    names = {
        j: [n for n in d.names if n not in stands_for.get(j, ())]
        for j, d in alone.items()
    }
    whole = OneMassProblem(problems, names, payload)
    split = {
        j: (p.fit, p.validation) if p.validation else split_rows(p.fit)
        for j, p in problems.items()
    }
    fit_to, others = (
        [r for j, own in split.items() for r in whole.recordings(j, own[k])]
        for k in (0, 1)
    )
    start: Values = {
        f"{j}/{name}": value
        for j, d in alone.items()
        for name, value in fitted_numbers(d).items()
    }
    masses = [
        start.pop(name) for name in list(start) if name.endswith("/payload.mass_kg")
    ]
    start |= dict.fromkeys((f.name for f in payload.frees[1:]), 0.0)
    mass = payload.frees[0]
    start |= {mass.name: float(np.median(masses))} if masses else {}
    beside = [start | {mass.name: -mass.start}] * (mass.low < 0.0 and not masses)
    beside += [
        start | {f.name: side * _BESIDE * f.high}
        for f in payload.frees[1:]
        for side in (-1.0, 1.0)
    ]
    rough = sorted(
        (
            fit(whole, fit_to, (payload.name,), one, _FIRST_STEPS)
            for one in (start, *beside)
        ),
        key=lambda f: f.error,
    )
    rough = best_fit(
        whole, fit_to, (payload.name,), [f.values for f in rough[:_LIKELY]], _NEXT_STEPS
    )
    model = fit(whole, fit_to, (payload.name,), rough.values, _STEPS, FINE)
    model = replace(
        model,
        moved=moved_by(whole, model, fit_to, others, np.full(len(model.frees), FINE)),
    )
    holds, before, after, squares = True, 0, len(payload.frees), {}
    for j, d in alone.items():
        squares[j], here = holds_at(whole, model, problems[j], d, j, split[j][1])
        holds = holds and here
        before += sum(
            _least_numbers(name, d, problems[j]) for name in stands_for.get(j, ())
        )
        before += is_explained(d, model.values.get(f"{j}/{TORQUE_FF.name}"))
        counted = (TORQUE_FF.name, *stands_for.get(j, ()))
        now = [
            (c, model.values.get(f"{j}/{c.name}", c.after))
            for c in d.changed
            if c.name not in counted
        ]
        before += sum(
            abs(value - c.before) < _OFF * abs(c.after - c.before) for c, value in now
        )
    return OneMass(model, holds, after < before, squares)


def holds_at(
    whole: OneMassProblem,
    model: Fit,
    problem: JointProblem,
    alone: Diagnosis,
    joint: str,
    recordings: Sequence[Recording],
) -> tuple[tuple[Blocks, Blocks], bool]:
    """Squared validation errors at one joint [floors²] of what was found there alone and of ``model``, a fit to several, and
    whether the second is about as low."""
    own = block_squares(problem, alone.after, recordings)
    with_it = block_squares(whole, model, whole.recordings(joint, recordings))
    return (own, with_it), above_floor(with_it) <= ALIKE * above_floor(own)


def is_better(
    one: OneMass,
    other: OneMass,
    everywhere: OneMass,
    sure: float = SearchConfig().sure_score,
) -> bool:
    """Whether ``one`` is better than ``other``: it alone holds, or it leaves less at all joints of ``everywhere`` together, by
    ``sure`` standard errors between half seconds. A joint that a mass does not load keeps its own diagnosis."""
    if not (one.holds and other.holds):
        return one.holds
    pairs = [
        [o.squares.get(j, own[:1])[-1] for o in (other, one)]
        for j, own in everywhere.squares.items()
    ]
    gains = [more - less for more, less in pairs]
    squares, weights = (
        np.concatenate(own)
        for own in zip(*((g.squares, g.weights) for g in gains), strict=True)
    )
    return standard_score(Blocks(squares, weights / len(gains))) >= sure


def error_of(squares: Blocks) -> float:
    """Root mean square error [noise floors]; 1 where it is below 1."""
    return float(np.sqrt(above_floor(squares)))


def fitted_numbers(d: Diagnosis) -> Values:
    """Fitted numbers of a diagnosis: name → value."""
    return {f.name: d.after.values[f.name] for f in d.after.frees}


def _least_numbers(name: str, d: Diagnosis, problem: JointProblem) -> int:
    """Count of fitted numbers of an added effect, or of the rival with the fewest; of a number, 1."""
    own = sum(f.name.split(".")[0] == name for f in d.after.frees)
    return min(
        [
            own,
            *(
                len(problem.candidates[n].frees)
                for n in d.rivals.get(name, ())
                if n in problem.candidates
            ),
        ]
    )


def is_explained(d: Diagnosis, after: float | None) -> bool:
    """Whether a joint alone needs a constant torque that it does not need with a shared number: ``torque_ff`` is ``after`` with
    it [N·m]; None: held as stated."""
    if TORQUE_FF.name not in d.base:
        return False
    stated, fitted = d.start[TORQUE_FF.name], d.base[TORQUE_FF.name]
    low, high = d.intervals[TORQUE_FF.name]
    left = 0.0 if after is None else abs(after - stated)
    return not low <= stated <= high and left < _OFF * abs(fitted - stated)
