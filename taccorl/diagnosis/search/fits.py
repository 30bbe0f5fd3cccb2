"""Fits of the hypotheses of one search, each made once: a hypothesis is the set of its effects.

The first fit of a hypothesis begins where its parent, which has one effect less, ended. A few steps select those that are fitted
fully: the screening (``screen``) orders the effects and drops none that physics makes likely (``is_likely``).
"""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.least_squares import LOOSE
from taccorl.diagnosis.search.evidence import (
    Blocks,
    above_floor,
    bic_gain,
    block_squares,
    gain_of,
    standard_score,
)
from taccorl.diagnosis.search.fit import (
    FINE,
    Fit,
    best_fit,
    fit,
    inverse_of,
    moved_by,
    out_of_dents,
    over_own_scale,
    rms,
    stacked,
    stacked_all,
)
from taccorl.diagnosis.search.identifiable import (
    LATE,
    POSITION_AGE_S,
    not_told_from_none,
)
from taccorl.diagnosis.search.lateness import lateness_s
from taccorl.diagnosis.search.problem import (
    Candidate,
    Problem,
    Progress,
    Recording,
    Values,
    chosen,
    with_held,
    without_numbers,
)
from taccorl.diagnosis.search.result import Evidence, SearchConfig
from taccorl.diagnosis.search.screen import Probe, is_likely, probe
from taccorl.diagnosis.search.standing_out import Place, places
from taccorl.sim.effects.effect import Effect

FIRST_STEPS, STEPS = 5, 30
"""Most steps of the solver in the first fit of a hypothesis, and in a full one."""
PROBED = 4
"""Number of effects, in the order of the screening, that are fitted for a few steps,
besides those that are ``is_likely``."""
MOST_MORE = 0.02
"""Largest relative increase of a squared error that is none (``is_as_good``)."""
SURELY_FULL, NEAR_BEST = 2, 1.3
"""After a few steps these are fitted fully: the first 2 of the screening, the 2 with the least error, and all with at most 1.3
times the least error. The factor is that of ``SearchConfig.floor``."""
NEARLY = 0.1
"""An effect counts as a simpler one if its parameter, without unit, is this close to where both agree. A choice."""
SPEED_DELAY = "speed_delay_s"
"""Name of the delay of a drive's speed among the fitted numbers. Beside a fitted loop period it counts half a period, too."""
FAINT = (0.3, 3.0)
"""Fits of an optional number begin at its typical value times these factors."""


@dataclass(eq=False)
class Model:
    """One fitted hypothesis with its errors on the validation recordings."""

    fit: Fit
    squares: Blocks
    """Squared errors on the validation recordings, block by block [floors²]."""
    numbers: int
    """Number of fitted numbers, values of maps included."""
    full: bool
    """False: after a few steps only."""
    stands_out: tuple[Place, ...]
    """Regimes of the validation recordings that stand out."""
    flaw: str | None = None
    """Result of ``Fits.flaw``, once it was asked for."""
    standing_out: tuple[Place, ...] | None = None
    """Result of ``Fits.standing_out``, once it was asked for."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects, those of the twin included."""
        return self.fit.names

    @property
    def error(self) -> float:
        """RMS error on the validation recordings [floors]."""
        return self.squares.mean**0.5


def model_of(
    problem: Problem, found: Fit, validation: Sequence[Recording], full: bool = True
) -> Model:
    """``found`` with its errors on ``validation``."""
    maps = sum(c.num_maps for c in chosen(problem, found.names))
    out = tuple(
        p
        for p in places(problem, found, validation, SearchConfig().little)
        if p.error > p.most
    )
    return Model(
        found,
        block_squares(problem, found, validation),
        len(found.frees) + maps,
        full,
        out,
    )


def refusal(a: Model, b: Model, config: SearchConfig) -> str:
    """Text: why the error of ``a`` is not clearly below that of ``b``, or not worth its further numbers; empty if it is.

    Paired differences on validation recordings decide: a tenth of what lies above the floor, more than chance, and more than its
    number of parameters justifies. That regimes stand out with ``b`` and none with ``a`` is no chance.
    """
    cleared = bool(b.stands_out) and not a.stands_out
    gain, score = (
        gain_of(a.squares, b.squares),
        np.inf if cleared else standard_score(b.squares - a.squares),
    )
    more = a.numbers - b.numbers
    return config.refusal(
        gain, score, bic_gain(b.fit, a.fit, more) if more > 0 else np.inf
    )


def better(a: Model, b: Model, config: SearchConfig) -> bool:
    """Whether the search prefers ``a``: its validation error is clearly below that of ``b`` (``refusal``), or neither is
    clearly below the other and ``a`` has fewer fitted numbers."""
    return not refusal(a, b, config) or (
        bool(refusal(b, a, config)) and a.numbers < b.numbers
    )


def is_as_good(error: float, before: float) -> bool:
    """Whether an RMS error [floors] has hardly risen."""
    return error**2 - before**2 <= MOST_MORE * max(before, 1.0) ** 2


def best(models: Iterable[Model], config: SearchConfig) -> Model:
    """Of the models that the one with the least error is not clearly better than, the one with the fewest numbers."""
    order = sorted(
        models, key=lambda m: (above_floor(m.squares), m.numbers, m.squares.mean)
    )
    as_good = [m for m in order if m is order[0] or refusal(order[0], m, config)]
    return min(as_good, key=lambda m: (m.numbers, m.squares.mean))


def simple_forms(cls: type[Effect]) -> tuple[str, ...]:
    """Effects with fewer numbers that ``cls`` equals at the ends of one of its own."""
    return (*cls.reduces_to, *cls.equals_when_wide)


class Fits:
    """Fits of hypotheses to the same recordings, and their errors.

    Args:
        start: start values; numbers that are left out start at their defaults.
        present: effects that the twin has already.
        report: function that is called with a text about the present step.
        begin: where the first fit begins; ``start`` if not given.
    """

    def __init__(
        self,
        problem: Problem,
        fit_to: Sequence[Recording],
        validation: Sequence[Recording],
        start: Mapping[str, float],
        present: tuple[str, ...],
        config: SearchConfig,
        report: Progress,
        begin: Mapping[str, float] | None = None,
    ) -> None:
        self.problem = problem
        self.fit_to, self.validation = list(fit_to), list(validation)
        self.present, self.config, self.report = present, config, report
        self.models: dict[frozenset[str], Model] = {}
        self.probes: dict[tuple[frozenset[str], str], Probe] = {}
        """(effects of a model, effect) → its best probe beside them."""
        self._extended: set[tuple[frozenset[str], frozenset[str]]] = set()
        self._repeats: dict[tuple[Model, Model], str] = {}
        there = chosen(problem, present)
        self.given = {
            f.name: start.get(f.name, f.start)
            for f in (*problem.base, *(f for x in there for f in x.frees))
        }
        """Value of every number of the problem as the machine's file has it, before any fit."""
        self.late_s = max(lateness_s(problem, self.given, present, self.fit_to), 0.0)
        """How much later than simulated with the machine's numbers it moves [s]."""
        self.state = ""
        """Text of how far the search is, before that of each step."""
        self.progress("fitting the numbers that are always fitted")
        first = [self.given if begin is None else self.given | dict(begin)]
        self._keep(best_fit(problem, fit_to, present, first, 60), full=True)
        self.as_it_was = dataclasses.replace(
            self.first,
            values=self.given,
            effects=tuple(x.make(self.given) for x in there),
        )
        """The twin with the numbers that it has, not fitted."""

    @property
    def base(self) -> Model:
        """The model without a further effect."""
        return self.models[frozenset(self.present)]

    @property
    def first(self) -> Fit:
        """Its fit."""
        return self.base.fit

    def added(self, model: Model | Fit) -> list[str]:
        """Names of the effects in ``model`` that the search added, that is without those of the twin's own file."""
        return [name for name in model.names if name not in self.present]

    def progress(self, text: str) -> None:
        """Report the present step, after the effects that are in the model and the error that they leave."""
        self.report(f"{self.state}{text}")

    def fitted(
        self,
        names: Sequence[str],
        starts: Sequence[Mapping[str, float]],
        most: int = STEPS,
    ) -> Fit:
        """The best of several fits of the effects ``names``; at most ``most`` steps in each."""
        return best_fit(self.problem, self.fit_to, names, starts, most, LOOSE)

    def model_of(self, found: Fit, full: bool = True) -> Model:
        """``found`` with its errors."""
        return model_of(self.problem, found, self.validation, full)

    def _keep(self, found: Fit, full: bool) -> Model:
        """Keep a fit as the model of its effects unless there is a better one; returns the model that is kept."""
        key, there = frozenset(found.names), self.models.get(frozenset(found.names))
        if there is None or found.error < there.fit.error or (full and not there.full):
            self.models[key] = self.model_of(found, full)
        return self.models[key]

    def without(self, model: Model, name: str, again: bool = False) -> Model:
        """The model with one effect less, the others refitted; ``again``: from where
        ``model`` ended, so that both had the same refits, even if it was fitted before.

        What makes the motion late gives its time to each other effect that does."""
        others = tuple(n for n in model.names if n != name)
        values = model.fit.values
        late = [f.name for f in model.fit.frees if f.name.endswith(LATE)]
        gone = sum(values[n] for n in late if n.startswith(f"{name}."))
        shifted = [
            values | {n: values[n] + gone}
            for n in late
            if gone > 0.0 and not n.startswith(f"{name}.")
        ]
        return self.whole(others, values, again, shifted)

    def whole(
        self,
        names: Sequence[str],
        start: Values,
        again: bool = False,
        further: Sequence[Values] = (),
    ) -> Model:
        """The model that has the effects ``names`` and no others, with all its numbers
        fitted until they converge.

        Args:
            start: values where a fit begins.
            further: values where more fits begin; the best fit counts.
            again: fit it also if such a model was fitted before.
        """
        there = self.models.get(frozenset(names))
        if there is not None and there.full and not again:
            return there
        self.progress(f"fitting {' and '.join(names) or 'no effect'}")
        return self._keep(self.fitted(names, [start, *further]), full=True)

    def children(
        self, parent: Model, names: Sequence[str], likely: bool = True
    ) -> list[Model]:
        """Models with one effect of ``names`` more, those of the likeliest effects
        fitted fully.

        Args:
            likely: whether effects that ``is_likely`` are fitted wherever the
                screening ranks them.
        """
        key = frozenset(parent.names)
        free = [n for n in names if n not in key]
        done = [tried for own, tried in self._extended if own == key]
        if not any(tried.issuperset(free) for tried in done):
            self._extended.add((key, frozenset(free)))
            self._extend(parent, free, likely)
        return [m for n in free if (m := self.models.get(key | {n})) is not None]

    def _extend(self, parent: Model, free: list[str], likely: bool) -> None:
        key, candidates = frozenset(parent.names), self.problem.candidates
        has = " and ".join(self.added(parent)) or "no effect added"
        self.state = f"{has}, validation error {parent.error:.2f} noise floors; "
        self.progress(f"probing {len(free)} effects")
        probes = probe(
            self.problem, self.fit_to, parent.fit, chosen(self.problem, free)
        )
        seen: dict[str, list[Probe]] = {}
        for p in sorted(probes, key=lambda p: -p.explained):
            seen.setdefault(p.name, []).append(p)
            self.probes.setdefault((key, p.name), p)
        order = list(seen)
        names = [
            n
            for k, n in enumerate(order)
            if k < PROBED or (likely and is_likely(candidates[n]))
        ]
        starts = {
            n: [
                parent.fit.values | p.scaled(candidates[n])
                for p in own[:3]
                if 2 * p.explained >= own[0].explained
            ]
            for n, own in seen.items()
        }
        short: dict[str, Fit] = {}

        def leading() -> set[str]:
            least = sorted(short, key=lambda n: short[n].error)
            return {*least[:SURELY_FULL], *order[:SURELY_FULL]}

        def first_refits(names: Sequence[str]) -> None:
            for k, n in enumerate(names, 1):
                there = self.models.get(key | {n})
                self.progress(f"first refit with {n}, {k} of {len(names)}")
                short[n] = (
                    there.fit
                    if there is not None and there.full
                    else self._short(parent.fit, n, starts[n][0])
                )

        first_refits(names)
        forms = {f for n in leading() for f in simple_forms(candidates[n].cls)}
        forms |= {f for n in leading() for f in self._simpler_twins(n)}
        first_refits([f for f in order if f in forms and f not in short])
        names = list(short)
        left = min((f.error**2 for f in short.values()), default=0.0)
        most_removed = parent.fit.error**2 - left
        # Along a ridge of several numbers a few steps do not go far.
        for n in [n for n in names if short[n].trouble]:
            if parent.fit.error**2 - short[n].error ** 2 > 0.5 * most_removed > 0.0:
                self.progress(f"further steps with {n}")
                short[n] = self.fitted(
                    short[n].names, [short[n].values], 3 * FIRST_STEPS
                )
        by_error = sorted(names, key=lambda n: short[n].error)
        enough = NEAR_BEST * max(short[by_error[0]].error, 1.0) if names else 0.0
        for k, n in enumerate(by_error, 1):
            there = self.models.get(key | {n})
            if there is not None and there.full:
                continue
            if n in leading() | forms or short[n].error <= enough:
                self.progress(f"refitting with {n}, {k} of at most {len(names)}")
                began = [short[n].values, *starts[n][1:]]
                self._keep(self._full(parent.fit, n, began), full=True)
            else:
                self._keep(short[n], full=False)

    def _simpler_twins(self, name: str) -> list[str]:
        """Effects like ``name`` with fewer fitted numbers, which a weak start may hide."""
        candidates = self.problem.candidates
        numbers = {
            n: sum(not f.optional for f in c.frees) for n, c in candidates.items()
        }
        twins = [n for n in candidates[name].cls.near_twins if n in numbers]
        return [n for n in twins if 0 < numbers[n] < numbers[name]]

    def _short(self, parent: Fit, name: str, start: Values) -> Fit:
        """``parent`` with one effect more, after a few steps for each of its numbers; one
        that makes the motion late also from as late as the recordings are (``late_s``),
        beside the numbers of the file: those of ``parent`` have made up for it."""
        own = self.problem.candidates[name].frees
        steps = FIRST_STEPS * max(sum(not f.optional for f in own), 1)
        starts = [start]
        late = [f.name for f in own if f.name.endswith(LATE)]
        if late and self.late_s > 0.0:
            starts.append(start | self.given | {late[0]: self.late_s})
        return self.fitted((*parent.names, name), starts, steps)

    def _full(self, parent: Fit, name: str, starts: list[Values]) -> Fit:
        """``parent`` with one effect more. Above the floor also from the numbers of the
        file: those of ``parent`` may have gone far to make up for the effect."""
        names = (*parent.names, name)
        model = self.fitted(names, starts)
        if model.error > self.config.floor:
            afresh = self.fitted(names, [starts[0] | self.given])
            model = min(model, afresh, key=lambda m: m.error)
        return self._in_best_row(model, name)

    def _in_best_row(self, model: Fit, name: str) -> Fit:
        """``model``, or a better one in which ``name`` makes the motion a row later or
        earlier: efforts jump where a delay reaches the next row, so that between any two
        rows the error has a minimum of its own."""
        late = [f for f in model.frees if f.name == f"{name}.delay_s"]
        if not late or self.error(model) <= self.config.floor:
            return model
        row_s = float(np.median(np.diff(self.fit_to[0].time_s)))
        value = model.values[late[0].name]
        others = [late[0].within(value + by * row_s) for by in (-1.0, 1.0)]
        found = [
            self.fitted(
                model.names, [model.values | {late[0].name: other}], FIRST_STEPS
            )
            for other in others
        ]
        best_one = min(found, key=lambda f: f.error)
        if best_one.error >= model.error:
            return model
        return self.fitted(model.names, [best_one.values])

    def with_optional(self, model: Model) -> Model:
        """``model``, or the same with the optional numbers of its effects if these are worth it (``better``): bristles. Also of a
        model at the floor, where an effect that always has such numbers may still do better: not where nothing can."""
        if above_floor(model.squares) < 1.0 + self.config.min_gain:
            return model
        for c in chosen(self.problem, model.names):
            open_ = [n for n, same in c.cls.optional.items() if same not in model.names]
            typical = {
                f"{c.name}.{p.name}": p.typical
                for p in c.cls.parameters()
                if p.name in open_
            }
            if (
                not typical
                or any(model.fit.values.get(n, 1.0) > 0.0 for n in typical)
                or c.frees[0].held
            ):
                continue
            self.progress(f"refitting with {' and '.join(typical)}")
            starts = [
                model.fit.values | {n: v * by for n, v in typical.items()}
                for by in FAINT
            ]
            other = self.model_of(self.fitted(model.names, starts))
            if not refusal(other, model, self.config) and not self.flaw(other):
                self.models[frozenset(model.names)] = model = other
        return model

    def finished(self, model: Fit) -> Fit:
        """Fit of the same hypothesis until it converges, with derivatives fine enough for its intervals. Numbers that go on
        moving while χ² falls by less than 1 lie in a direction that the recordings leave open: their intervals say so."""
        self.progress("last refit, with finer derivatives")
        if model.error > self.config.floor:
            model = out_of_dents(self.problem, model, self.fit_to, STEPS)
        fine = self._fine(model)
        if fine.trouble:
            further = self._fine(fine)
            fell = (
                (fine.error**2 - further.error**2)
                / further.error**2
                * further.effective_rows
            )
            fine = dataclasses.replace(further, trouble="") if fell < 1.0 else further
        if not fine.frees:
            return fine
        return self._with_intervals(self.problem, fine)

    def as_stated(self, model: Fit, keep: Collection[str] = ()) -> Fit:
        """``model`` without the numbers of a drive's loop (``Free.leaves``) whose 95 % interval holds what the file has: they
        stay as they are there, and all others are refitted. With them where the error would rise, and those in ``keep``."""

        def stated(
            name: str, values: Values
        ) -> float:  # a speed is half a fitted period older than its delay in the file
            later_s = 0.5 * values.get("loop_s", 0.0)
            return self.given[name] + later_s * (name == SPEED_DELAY)

        ends = model.intervals()
        same = [
            f.name
            for f in model.frees
            if f.leaves
            and f.name not in keep
            and ends[f.name][0] <= stated(f.name, model.values) <= ends[f.name][1]
        ]
        fitted = {f.name for f in model.frees}
        held = {f.name: model.values[f.name] for f in self.problem.base}
        held = {name: value for name, value in held.items() if name not in fitted}
        for names in dict.fromkeys([tuple(same), *((name,) for name in same)]):
            if not names:
                break
            self.progress(f"last refit with {' and '.join(names)} of the file")
            problem = with_held(without_numbers(self.problem, names), held)
            other = self._with_intervals(problem, self._fine(model, problem))
            if is_as_good(other.error, model.error) and is_as_good(
                self.error(other), self.error(model)
            ):
                of_file = {name: stated(name, other.values) for name in names}
                moved = _moved_from(model, other)
                if other.moved is not None:
                    moved = np.hypot(other.moved, moved)
                return dataclasses.replace(
                    other, values=other.values | of_file, moved=moved
                )
        return model

    def _with_intervals(self, problem: Problem, fine: Fit) -> Fit:
        """``fine``, fitted with fine derivatives, with all that its intervals need."""
        fine, steps = over_own_scale(problem, fine, self.fit_to)
        if self.validation:
            moved = moved_by(problem, fine, self.fit_to, self.validation, steps)
            fine = dataclasses.replace(
                fine, moved=np.hypot(moved, self._moved_by_late_targets(problem, fine))
            )
        return fine

    def _moved_by_late_targets(self, problem: Problem, model: Fit) -> np.ndarray:
        """(p,) standard deviation of the fitted coordinates because recordings do not state how long a target waits for the
        next period of the control loop, 0 … ``loop_s``; a fit makes up for a wrong wait by another period. 0 for
        ``speed_delay_s``: robot files state the part of it beyond half a period, which hardly depends on the wait."""
        period_s = model.values.get("loop_s", 0.0) or problem.loop_s
        moved = np.zeros(len(model.frees))
        if period_s > 0.0:
            late = stacked(
                problem,
                model.values | {"loop_waits_s": period_s},
                model.effects,
                self.fit_to,
            )
            inside = np.array([f.name not in model.at_bound for f in model.frees])
            columns = model.jacobian[:, inside]
            moved[inside] = (
                0.5
                * inverse_of(columns.T @ columns)
                @ (columns.T @ (late - model.residuals))
            )
        return np.where([f.name == "speed_delay_s" for f in model.frees], 0.0, moved)

    def _fine(self, model: Fit, problem: Problem | None = None) -> Fit:
        return fit(
            problem or self.problem,
            self.fit_to,
            model.names,
            model.values,
            self.config.last_steps,
            FINE,
        )

    def changed_by(self, a: Fit, b: Fit, recordings: Sequence[Recording]) -> float:
        """RMS difference of what ``a`` and ``b`` simulate for ``recordings`` [floors]."""
        ends = [(m.values, m.effects) for m in (a, b)]
        one, other = stacked_all(self.problem, ends, recordings)
        return rms(one - other)

    def error(self, model: Fit) -> float:
        """Root mean square error of ``model`` on the validation recordings, in multiples of their noise floor."""
        return rms(stacked(self.problem, model.values, model.effects, self.validation))

    def errors(
        self, values: Values, effects: Sequence[Effect], test: Sequence[Recording]
    ) -> dict[str, float]:
        """fit, validation and, if there are any, test → RMS error [floors]."""
        uses = {"fit": self.fit_to, "validation": self.validation, "test": list(test)}
        return {
            use: rms(stacked(self.problem, values, effects, recs))
            for use, recs in uses.items()
            if recs
        }

    def at_floor(self, model: Model) -> bool:
        """Whether neither the validation nor the fit recordings have an error that another effect could explain, and none of
        their regimes stands out. Where effects were added, an error up to ``little`` counts as the floor if it is
        ``little_share`` of what they removed: equations of a robot differ from the twin's by more than that."""
        c, error = self.config, model.error
        is_little = bool(self.added(model)) and max(error, model.fit.error) <= c.little
        is_low = error <= c.floor and model.fit.error <= c.little
        if not (
            is_low
            or (is_little and error**2 - 1.0 <= c.little_share * self.base.error**2)
        ):
            return False
        return not self.standing_out(model)

    def standing_out(
        self, model: Model, others: Sequence[Recording] = ()
    ) -> tuple[Place, ...]:
        """Regimes of the fit and validation recordings, or of ``others`` in their place, that stand out, the worst first.
        ``little_share`` of what added effects removed there is left, as in ``at_floor``."""
        if model.standing_out is not None and not others:
            return model.standing_out
        recordings, little = (
            others or (*self.fit_to, *self.validation),
            self.config.little,
        )
        now, before = (
            list(places(self.problem, m.fit, recordings, little))
            for m in (model, self.base)
        )
        share = self.config.little_share * bool(self.added(model))
        found = [
            p
            for p, b in zip(now, before, strict=True)
            if p.error**2 > p.most**2 + share * b.error**2
        ]
        own = tuple(sorted(found, key=lambda p: -p.error / p.most))
        model.standing_out = model.standing_out if others else own
        return own

    def flaw(self, model: Model) -> str:
        """Text: why the fitted numbers explain nothing; empty if they do. A strength is where its effect is absent, the effect
        practically equals a simpler one, the only number of an effect went to an end of its range above the floor, or an always
        fitted one did."""
        if model.flaw is None:
            model.flaw = self._flaw(model)
        return model.flaw

    def _flaw(self, model: Model) -> str:
        found = model.fit
        for c in chosen(self.problem, self.added(model)):
            for p in c.cls.parameters():
                f = next(
                    (f for f in found.frees if f.name == f"{c.name}.{p.name}"), None
                )
                if f is None or f.optional or f.name not in found.at_bound:
                    continue
                place, low, high = (
                    f.coordinate(x) for x in (found.values[f.name], f.low, f.high)
                )
                end = p.low if place - low < high - place else p.high
                value = f"{p.name} {found.values[f.name]:.3g}{f' {p.unit}' * (p.unit != '1')}"
                if p.absent == end:
                    return f"no effect: the fit ends at {value}, where it is absent"
                if end == p.high and p.absent == np.inf:
                    return f"the fit ends at the weakest effect of its range, {value}"
            if simpler := _simpler_form(c, found.values):
                return f"no more than {simpler}"
            ended = len(c.frees) == 1 and any(
                f.name == c.frees[0].name for f in found.ended
            )
            if ended and not self.at_floor(
                model
            ):  # the truth may lie at the end of a range, but then nothing is left
                return f"no explanation: {c.frees[0].name} ends at {found.values[c.frees[0].name]:.3g}, an end of its range"
        fled = [f.name for f in found.fled if f.name not in self.base.fit.at_bound]
        ends = " and ".join(f"{name} {found.values[name]:.3g}" for name in fled)
        return (
            f"no explanation: the fit ends with {ends} at the end of its range"
            if fled
            else ""
        )

    def simplified(self, model: Model) -> tuple[str, ...]:
        """The effects of ``model`` with simpler ones in place of those that practically
        equal them; empty if none does."""
        found = list(model.names)
        for c in chosen(self.problem, self.added(model)):
            same = [n for n in c.cls.reduces_to if n in self.problem.candidates]
            if same and _simpler_form(c, model.fit.values):
                found[found.index(c.name)] = same[0]
        return () if found == [*model.names] else tuple(dict.fromkeys(found))

    def why_not(self, model: Model, parent: Model, left_over: bool = False) -> str:
        """Text: why the newest effect of ``model`` is not added to ``parent``; empty if it may be. An effect that removes much of
        the error, or a tenth of it for sure, is told even if other numbers make up for its strength. Near the floor, where noise
        and equations leave as much, it is not, and what is not much must be there the other way round, too (``_unrepeated``).

        Args:
            left_over: whether intervals widen by what ``model`` leaves above the floor.
        """
        if why := self.flaw(model) or refusal(model, parent, self.config):
            return why
        name = next(n for n in model.names if n not in parent.names)
        gain, score = (
            gain_of(model.squares, parent.squares),
            standard_score(parent.squares - model.squares),
        )
        near, much = parent.error <= self.config.little, gain >= self.config.sure_gain
        sure = much or score >= self.config.sure_score
        why = (
            not_told_from_none(model.fit, name, left_over and not sure, POSITION_AGE_S)
            if near or not sure
            else ""
        )
        return why or (self._unrepeated(model, parent) if near and not much else "")

    def _unrepeated(self, model: Model, parent: Model) -> str:
        """Text: why ``model``, fitted to the validation recordings, leaves no less than ``parent`` of those that it was fitted
        to; empty if it does."""
        if (key := (model, parent)) not in self._repeats:
            self.progress(f"does {model.names[-1]} repeat on other recordings")
            fits = [
                fit(self.problem, self.validation, m.names, m.fit.values, STEPS)
                for m in key
            ]
            with_it, without = (model_of(self.problem, f, self.fit_to) for f in fits)
            surely = (
                standard_score(without.squares - with_it.squares)
                >= self.config.min_score
            )
            self._repeats[key] = (
                "" if surely else refusal(with_it, without, self.config)
            )
        why = self._repeats[key]
        return (
            f"fitted to the validation recordings, it does not repeat on the others: {why}"
            if why
            else ""
        )

    def evidence(self, model: Model, parent: Model, verdict: str) -> Evidence:
        """What a report says of the newest effect of ``model``, with the ``verdict`` of the search on it."""
        name = next(n for n in model.names if n not in parent.names)
        fitted = {f.name: model.fit.values[f.name] for f in model.fit.frees}
        own = {k: v for k, v in fitted.items() if k.startswith(f"{name}.")}
        seen = self.probes.get((frozenset(parent.names), name))
        plain = self.flaw(model) or refusal(model, parent, self.config)
        return Evidence(
            name=name,
            values=own,
            base={k: v for k, v in fitted.items() if k not in own},
            explained=0.0 if seen is None else seen.explained,
            fit_error=model.fit.error,
            validation_error=model.error,
            gain=gain_of(model.squares, parent.squares),
            score=standard_score(parent.squares - model.squares),
            bic=bic_gain(parent.fit, model.fit, model.numbers - parent.numbers),
            at_bound=tuple(n for n in model.fit.at_bound if n in own),
            trouble=model.fit.trouble,
            verdict=verdict,
            unsure=not plain and bool(self.why_not(model, parent)),
            units={f.name: f.unit for f in model.fit.frees if f.name in own},
        )


def _simpler_form(c: Candidate, values: Values) -> str:
    """Text: what a fitted effect practically equals, and the parameter that shows it; empty if there is nothing simpler. Friction
    over speed**0.05 is dry friction, over speed**0.95 with a yield torque dry and viscous friction, unless a parameter that is 0
    by default, such as its asymmetry, exceeds 0.1."""
    own = {p.name: values.get(f"{c.name}.{p.name}", 0.0) for p in c.cls.parameters()}
    if any(abs(own[p.name]) > NEARLY for p in c.cls.parameters() if p.typical == 0.0):
        return ""
    ends = {p.name: (p.low, p.high) for p in c.cls.parameters()}
    limits = [
        (simpler, name, ends[name][0]) for simpler, name in c.cls.reduces_to.items()
    ]
    for same in [same for n, same in c.cls.optional.items() if same and own[n] > 0.0]:
        limits += [
            (f"{same} and {wide}", name, ends[name][1])
            for wide, name in c.cls.equals_when_wide.items()
        ]
    found = [
        (words, name)
        for words, name, limit in limits
        if abs(own[name] - limit) <= NEARLY
    ]
    return " or ".join(f"{words}: {name} {own[name]:.3g}" for words, name in found)


def _moved_from(model: Fit, other: Fit) -> np.ndarray:
    """(p,) how far the coordinates of ``other`` are from those of ``model``, in which more
    numbers are free: the recordings hold either."""
    return np.array(
        [
            f.coordinate(other.values[f.name]) - f.coordinate(model.values[f.name])
            for f in other.frees
        ]
    )
