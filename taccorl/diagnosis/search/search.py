"""Search for missing effects: a beam search over sets of effects with one rule.

    1. The numbers that are always fitted are fitted to the fit recordings.
    2. While the validation error is above ``floor`` noise floors: each of the ``width``
       best models is extended by one effect. All effects are probed (``screen``), the
       likely ones are fitted together with all numbers (``Fits.children``). If none is
       accepted, those that remove much of the fit error are extended: two effects can
       hide each other on validation recordings.
    3. A model is better than another one (``fits.better``) if its error on validation
       recordings is clearly lower, by paired differences of half seconds, or if it is
       as good with fewer numbers. Beside a model of several effects all models with one
       of them exchanged, or without it, are fitted, until none of them is better.
    4. The best model is fitted to all fit recordings, of which the search used every
       second one. Effects and optional numbers that are superfluous go by the same rule.
    5. Its ties are all fitted models that it is not clearly better than, those with more
       numbers that contain it, too.

Numbers of the file that the recordings contradict are named (``changed_numbers``). The
test recordings, which no choice has seen, give the final figures.

Whiteness of residuals is no stop rule: it rejects correct models (research: 8 of 8), a robot does not repeat itself exactly.
"""

import copy
import dataclasses
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from taccorl.diagnosis.search.changed_numbers import (
    OF_LOOP,
    changed_numbers,
    moved_gains,
    of_refit,
)
from taccorl.diagnosis.search.evidence import above_floor, gain_of, standard_score
from taccorl.diagnosis.search.fit import Fit
from taccorl.diagnosis.search.fits import (
    Fits,
    Model,
    best,
    better,
    model_of,
    refusal,
    simple_forms,
)
from taccorl.diagnosis.search.identifiable import not_told_from_none
from taccorl.diagnosis.search.problem import (
    EFFORT_SCALE,
    Found,
    Problem,
    Progress,
    Recording,
    Stopped,
    Values,
    chosen,
    never_stopped,
    no_progress,
    thinned,
    with_held,
    with_other_number,
)
from taccorl.diagnosis.search.result import (
    Changed,
    Diagnosis,
    Offer,
    Round,
    SearchConfig,
    Status,
    of_test,
)
from taccorl.diagnosis.search.standing_out import Place, places
from taccorl.sim.effects.effect import Effect

SCALE_OFF = 1.15
"""Least factor on efforts that is a finding where gains are stated, so that it is fitted in any case. A choice."""
MOST, HARDLY = 0.5, 0.05
"""Share of the squared fit error, and change of the validation error, below which effects act in the fit recordings alone."""
EARLY_TARGET = "target_late_s"
"""Where it can only be early, it stays as the file has it while effects are sought, unless
its fit alone takes away a tenth of the error: beside an early target that is not there two
of sixteen pairs of effects were found wrongly."""
EXCHANGES = 4
"""Most times that the best model is exchanged for a better one with one effect another; a choice, two were seen."""


def diagnose(
    problem: Problem,
    fit_to: Sequence[Recording],
    validation: Sequence[Recording],
    test: Sequence[Recording] = (),
    *,
    start: Mapping[str, float] | None = None,
    begin: Mapping[str, float] | None = None,
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
        begin: where the first fit begins; ``start`` if not given.
        present: effects that the twin has already: they are refitted and never removed.
        without: effects that are left out of the search.
        config: criteria of acceptance; the default ones if not given.
        progress: function that is called with a text about the present step. Where it raises ``Stopped``, the effects of the
            rounds so far are the result, with a remark.

    Raises:
        Stopped: by ``progress``, before an effect was added.
    """
    began = time.process_time()
    how = (
        fit_to,
        validation,
        start or {},
        tuple(present),
        config or SearchConfig(),
        progress,
    )
    fits = Fits(problem, *how, begin)
    others = (
        {}
        if fits.at_floor(fits.base)
        else {n: Fits(p, *how) for n, p in with_other_number(problem).items()}
    )
    number, other = next(
        ((n, own) for n, own in others.items() if own.at_floor(own.base)), ("", None)
    )
    if other is not None and other.base.numbers <= fits.base.numbers:
        fits, other = other, None
    fits.problem.learn(fits.first.values)
    beam = Beam(fits, [name for name in fits.problem.candidates if name not in without])
    answer, removed, remarks = beam.pruned(beam.search())
    if other is not None and better(other.base, answer, fits.config):
        fits, other, beam = other, None, Beam(other, beam.names)
        answer, removed, remarks = beam.pruned(beam.search())
    steps = beam.steps(answer)
    rivals = beam.rivals(answer, steps)
    rounds = beam.rounds(answer, steps, rivals)
    changed, model = changed_numbers(fits, answer.fit)
    model = fits.as_stated(model, _named(changed))
    changed = tuple(
        dataclasses.replace(c, after=float(model.values.get(c.name, c.after)))
        for c in changed
    )
    stages = {"before": fits.as_it_was, "fitted": fits.first, "after": model}
    errors = {
        stage: fits.errors(one.values, one.effects, test)
        for stage, one in stages.items()
    }
    without_it = {
        name: fits.errors(m.fit.values, m.fit.effects, test)["test"]
        for name in fits.added(answer)
        for m in [fits.without(answer, name)]
        if test
    }
    if (
        fits.problem is problem
    ):  # the scale was fitted anyway, beside gains that are stated
        changed = tuple(
            c
            for c in changed
            if c.name != EFFORT_SCALE or abs(np.log(c.after)) > np.log(SCALE_OFF)
        )
    tied = (
        other is not None
        and fits.added(answer)
        and refusal(answer, other.base, fits.config)
    )
    standing = fits.standing_out(answer) or fits.standing_out(answer, test)
    found = Diagnosis(
        status=_status(fits, answer, changed, bool(standing)),
        standing_out=standing,
        nearest=beam.nearest(answer, standing, (*fits.fit_to, *fits.validation)),
        changed=changed,
        effects=tuple(_described(fits, model, errors, without_it)),
        offers=tuple(_offers(beam, answer, rivals, test)),
        or_number=(number, other.first.values[number] / other.given[number])
        if other and tied
        else ("", 1.0),
        present=fits.present,
        base=_base(fits, model),
        start=fits.given,
        intervals=model.intervals(),
        rounds=rounds,
        rivals=rivals,
        twins={
            n: dict(fits.problem.candidates[n].cls.near_twins)
            for n in fits.added(model)
        },
        removed=tuple(removed),
        errors=errors,
        test_without=without_it,
        steps=(
            ("", fits.base.error),
            *((r.added, r.validation_error) for r in rounds if r.added),
        ),
        remarks=(
            *remarks,
            *beam.remarks,
            *of_refit(fits, answer),
            *_of_pairs(beam, answer),
        ),
        at_bound=tuple(f.name for f in model.ended),
        undetermined=_undetermined(model),
        trouble=model.trouble,
        cpu_s=time.process_time() - began,
        before=fits.first,
        after=model,
    )
    fits.report(
        Found(
            f"finished: {found.words}",
            effects=found.effects,
            present=found.present,
            base=found.base,
            errors=found.errors,
            intervals=found.intervals,
            finished=not beam.stopped,
        )
    )
    return found


Step = tuple[Model, Model, str]
"""Model before an effect was added, the one with it, and its name."""


class Beam:
    """Beam search over sets of the effects ``names``.

    Args:
        whole: fits to all fit recordings; the search itself uses fewer (``thinned``).
    """

    def __init__(self, whole: Fits, names: Sequence[str]) -> None:
        self.whole, self.config, self.names = whole, whole.config, list(names)
        self.remarks: list[str] = []
        self.stopped = False
        self.fits = whole
        if whole.at_floor(whole.base):
            return
        base = {f.name: f for f in whole.problem.base}
        early = base.get(EARLY_TARGET)
        if early is not None and early.high <= whole.given[EARLY_TARGET]:
            file = {EARLY_TARGET: whole.given[EARLY_TARGET]}
            self.fits = self._fits(with_held(whole.problem, file))
            if refusal(whole.base, self.fits.base, self.config):
                return
        self.fits = self._fits(whole.problem)

    def _fits(self, problem: Problem) -> Fits:
        """Make the store of fitted models of ``problem``. To save time the search fits only some of the recordings."""
        whole = self.whole
        fewer = thinned(whole.fit_to)
        if problem is whole.problem and len(fewer) == len(whole.fit_to):
            return whole
        data = fewer, whole.validation, whole.given, whole.present
        how = whole.config, whole.report, whole.first.values
        return Fits(problem, *data, *how)

    def search(self) -> Model:
        """The best model with at most ``max_effects`` effects more than the twin has, or
        of the rounds before ``Stopped``."""
        fits = self.fits
        answer = fits.base
        try:
            for answer in self._answers():
                if fits.added(answer):
                    fits.report(_found(fits, answer))
            if fits.problem is not self.whole.problem and not fits.at_floor(answer):
                fitted = self.whole.whole(answer.names, answer.fit.values)
                if not refusal(fitted, answer, self.config):
                    self.fits = fits = self._fits(self.whole.problem)
                    for answer in self._answers():
                        fits.report(_found(fits, answer))
        except Stopped:
            if not (names := fits.added(answer)):
                raise
            self.stopped = True
            self.config = dataclasses.replace(self.config, max_effects=len(names))
            self.remarks.append(
                f"Stopped after {' and '.join(names)}: what may be beside or in place of "
                "it was not tried."
            )
        for one in (fits, self.whole):
            one.config, one.report = self.config, never_stopped(one.report)
        return answer

    def _answers(self) -> Iterator[Model]:
        """The best model after each round."""
        fits, c = self.fits, self.config
        answer = fits.with_optional(fits.base)
        level = [answer]
        for depth in range(c.max_effects):
            if any(fits.at_floor(m) for m in level):
                break
            children = {
                id(k): (k, m)
                for m in level
                for k in fits.children(m, self.names)
                if k.full
            }
            sound = [k for k, m in children.values() if not fits.why_not(k, m)]
            found = best([answer, *sound], c)
            if found is not answer:
                more = self.much(level[0])  # which may hide on validation recordings
                rest = [
                    k
                    for k in sound
                    if k.names != found.names and not refusal(k, answer, c)
                ]
                rest.sort(key=lambda k: above_floor(k.squares))
                yield (answer := self._both(fits.with_optional(found)))
                if depth > 0:
                    answer = self._exchanged(answer, further=False)
                rest += [k for k in more if k.fit.error < answer.fit.error]
                level = [answer, *rest[: c.width - 1]]
            elif level[0] is answer:
                level = self.much(answer)
            else:
                break
            if not level:
                break
        yield self._exchanged(answer)

    def _both(self, answer: Model) -> Model:
        """``answer``, or the best model with two effects in place of one that lies between
        them and leaves clearly less, as friction over a power of the speed lies between
        dry and viscous friction. The dry one may be another with one number.

        With more effects only if ``answer`` is above the floor, or for no more numbers.
        """
        fits, candidates = self.fits, self.fits.problem.candidates
        room = self.config.max_effects - len(fits.added(answer))

        def numbers(names: Sequence[str]) -> int:
            return sum(not f.optional for n in names for f in candidates[n].frees)

        pairs = []
        for name in fits.added(answer):
            forms = [n for n in simple_forms(candidates[name].cls) if n in self.names]
            if len(forms) < 2:
                continue
            others = [n for n in answer.names if n != name]
            key = frozenset(others)
            twins = [
                n
                for n in candidates[forms[0]].cls.near_twins
                if (key, n) in fits.probes and numbers([n]) == 1 and n not in forms
            ]
            twins.sort(key=lambda n: -fits.probes[key, n].explained)
            for dry in (forms[0], *twins[:1]):
                names = tuple(dict.fromkeys([*others, dry, *forms[1:]]))
                more = len(names) - len(answer.names)
                if more <= (0 if fits.at_floor(answer) else room) or (
                    numbers([dry, *forms[1:]]) <= numbers([name])
                ):
                    pairs.append(fits.whole(names, answer.fit.values))
        sound = [m for m in pairs if not fits.flaw(m)]
        found = best(sound, self.config) if sound else answer
        return found if refusal(answer, found, self.config) else answer

    def much(self, parent: Model) -> list[Model]:
        """Extensions of ``parent`` that remove much of the fit error, the best first."""
        most = (1.0 - self.config.sure_gain) * parent.fit.error**2
        found = [
            m
            for m in self.fits.children(parent, self.names)
            if m.fit.error**2 <= most and not self.fits.flaw(m)
        ]
        return sorted(found, key=lambda m: m.fit.error)[: self.config.width]

    def _exchanged(self, answer: Model, further: bool = True) -> Model:
        """The best of ``answer`` and the models with one effect exchanged, taken away or,
        if ``further``, added; and again. What was added first may only have been the
        nearest to two that are missing, or to one that needs its optional numbers."""
        fits = self.fits
        alone = [m for m in fits.models.values() if len(fits.added(m)) == 1]
        for m in alone if further and not fits.at_floor(answer) else ():
            if any(c.cls.optional for c in chosen(fits.problem, fits.added(m))):
                fits.with_optional(fits.whole(m.names, m.fit.values))
        for _ in range(EXCHANGES):
            for m in [m for m in fits.models.values() if m.full]:
                if m.fit.error < answer.fit.error and (names := fits.simplified(m)):
                    fits.whole(names, m.fit.values)
            parts = self.parts(answer)
            for _, part in parts if len(parts) > 1 else ():
                fits.children(part, self.names, likely=False)
            open_ = 0 < len(parts) < self.config.max_effects
            if further and open_ and not fits.at_floor(answer):
                fits.children(answer, self.names)
            found = best([answer, *self.sound(answer)], self.config)
            if found.names == answer.names:
                return found
            answer = fits.with_optional(found)
        return answer

    def parts(self, model: Model) -> list[tuple[str, Model]]:
        """(added effect, the model without it)."""
        return [
            (name, self.fits.without(model, name)) for name in self.fits.added(model)
        ]

    def sound(self, answer: Model) -> list[Model]:
        """Fully fitted models that are ``better`` than the same model without any one of their effects, where that was fitted."""
        fits, found = self.fits, []
        for key, m in list(fits.models.items()):
            if (
                m is answer
                or not m.full
                or len(fits.added(m)) > self.config.max_effects
                or fits.flaw(m)
            ):
                continue
            parts = [fits.models.get(key - {n}) for n in fits.added(m)]
            if all(p is None or not p.full or better(m, p, self.config) for p in parts):
                found.append(m)
        return found

    def _repeated(self, answer: Model) -> tuple[Model, list[str]]:
        """``answer`` without effects that gain nothing beside others on fit recordings that
        the search has not used, though they change the simulation there by as much as
        would be a gain; and their names."""
        fits, removed = self.fits, list[str]()
        unused = [r for r in self.whole.fit_to if r not in fits.fit_to]
        while unused and len(fits.added(answer)) > 1:
            own = model_of(fits.problem, answer.fit, unused)
            gone = []
            for name, part in self.parts(answer):
                without = model_of(fits.problem, part.fit, unused)
                changed = fits.changed_by(answer.fit, part.fit, unused)
                needed = self.config.min_gain * max(without.squares.mean - 1.0, 1.0)
                gain = gain_of(own.squares, without.squares)
                if gain < self.config.min_gain and changed**2 >= needed:
                    gone.append((gain, name, part))
            if not gone:
                break
            _, name, answer = min(gone, key=lambda item: item[:2])
            removed.append(name)
        return answer, removed

    def pruned(self, answer: Model) -> tuple[Model, list[str], list[str]]:
        """The model in its last refit, to all fit recordings, without effects and optional
        numbers that are superfluous there; names of the effects that went; remarks on
        those that stay although their strength is open."""
        fits, c = self.whole, self.config
        answer, removed = self._repeated(answer)
        answer = fits.whole(answer.names, answer.fit.values)
        plain = {
            f"{x}.{n}": 0.0
            for x in answer.names
            for n in fits.problem.candidates[x].cls.optional
        }
        if any(answer.fit.values[n] > 0.0 for n in plain):
            rigid = fits.model_of(
                fits.fitted(answer.names, [answer.fit.values | plain])
            )
            answer = rigid if better(rigid, answer, c) else answer
        while True:
            last = fits.model_of(fits.finished(answer.fit))
            parts = [(n, fits.without(last, n, again=True)) for n in fits.added(last)]
            # What is left above the floor widens intervals where no known effect explains it, not where none may be added.
            left_over = len(parts) < c.max_effects
            gone = [
                (gain_of(last.squares, p.squares), n, p)
                for n, p in parts
                if fits.why_not(last, p, left_over)
            ]
            if not gone:
                break
            _, name, answer = min(gone, key=lambda item: item[:2])
            removed.append(name)
        as_it_was = fits.model_of(fits.as_it_was)
        worse = as_it_was.squares.mean < fits.base.squares.mean and refusal(
            last, as_it_was, c
        )
        if parts and worse and not self._acts_in_fit_alone(last):
            removed += [
                n for n, _ in parts
            ]  # they only undo what the refit of the always fitted numbers made worse
            return fits.model_of(fits.finished(fits.base.fit)), removed, []
        return (
            last,
            removed,
            [text for n, p in parts if (text := self._entangled(last, n, p))],
        )

    def _acts_in_fit_alone(self, model: Model) -> bool:
        """Whether the added effects remove most of the fit error, and do nothing in the validation recordings: a limit."""
        fits, fit = self.fits, model.fit
        kept = tuple(e for e in fit.effects if e.name in fits.present)
        error = fits.errors(fit.values, kept, ())["validation"]
        return (
            fit.error**2 < MOST * fits.base.fit.error**2
            and abs(error / model.error - 1.0) < HARDLY
        )

    def _entangled(self, model: Model, name: str, without: Model) -> str:
        """Sentence on an effect whose strength is not known, although it removes much of the error; empty if it is known."""
        if not not_told_from_none(model.fit, name, left_over=False):
            return ""
        frees, spread = model.fit.frees, model.fit.covariance()
        own = next(
            k
            for k, f in enumerate(frees)
            if f.name in self.fits.problem.candidates[name].strengths
        )
        size = np.sqrt(np.diag(spread))
        others = [k for k in range(len(frees)) if k != own]
        other = max(others, key=lambda k: abs(spread[own, k]) / size[k], default=own)
        low, high = model.fit.intervals()[frees[own].name]
        return (
            f"{frees[own].name} {model.fit.values[frees[own].name]:.3g} is open (95 % {low:.3g} … {high:.3g}), although "
            f"{without.error:.2f} noise floors remain without {name}: {frees[other].name} makes up for a change of it "
            f"(correlation {spread[own, other] / size[own] / size[other]:+.2f})."
        )

    def nearest(
        self, answer: Model, standing: Sequence[Place], recordings: Sequence[Recording]
    ) -> tuple[tuple[str, float], ...]:
        """(effect, error that it leaves [floors]) at the worst of the regimes that stand out, the least first."""
        found = {}
        for worst in standing[:1]:
            own = [
                r for r in recordings if r.name == worst.recording
            ]  # both parts of one whose rows were split
            for name, m in self._beside(answer).items():
                at = places(self.fits.problem, m.fit, own, self.config.little)
                here = [p.error for p in at if p.words() == worst.words()]
                if here:  # none where a test recording stands out
                    found[name] = max(here)
        return tuple(sorted(found.items(), key=lambda item: item[1]))

    def ties(self, answer: Model) -> list[Model]:
        """Fitted models with other effects that the result is not clearly better than."""
        own = set(answer.names)
        like = self.fits.whole(answer.names, answer.fit.values)
        if self.fits is self.whole:
            like = answer
        others = [
            m for m in self.sound(like) if own - set(m.names) and set(m.names) - own
        ]
        return sorted(
            (m for m in others if refusal(like, m, self.config)),
            key=lambda m: above_floor(m.squares),
        )

    def rivals(
        self, answer: Model, steps: Sequence[Step]
    ) -> dict[str, tuple[str, ...]]:
        """Added effect → effects that explain as much in its place, alone or in place of others, too. What does so where the
        effect was added is fitted beside the other effects of ``answer``, too, which may tell it apart."""
        for parent, pick, name in steps:
            for n, m in self._beside(parent).items():
                tied = (
                    m.full
                    and not self.fits.why_not(m, parent)
                    and refusal(pick, m, self.config)
                )
                if tied and n not in answer.names:
                    exchanged = tuple(n if own == name else own for own in answer.names)
                    self.fits.whole(exchanged, answer.fit.values | m.fit.values)
        found: dict[str, list[str]] = {}
        for m in self.ties(answer) if self.fits.added(answer) else ():
            gone = [n for n in self.fits.added(answer) if n not in m.names]
            new = [n for n in m.names if n not in answer.names]
            if gone and len(new) == 1 and new[0] not in found.setdefault(gone[0], []):
                found[gone[0]].append(new[0])
        return {name: tuple(others) for name, others in found.items() if others}

    def steps(self, answer: Model) -> list[Step]:
        """The effects of ``answer`` one after another, each the one that explains most beside those before: (the model before it,
        the model with it, the effect)."""
        fits, parent, found = self.fits, self.fits.base, []
        left = fits.added(answer)
        while left:
            starts = parent.fit.values
            models = {
                n: fits.whole((*parent.names, n), starts) if len(left) > 1 else answer
                for n in left
            }
            name = min(left, key=lambda n: above_floor(models[n].squares))
            left.remove(name)
            found.append((parent, models[name], name))
            parent = models[name]
        return found

    def rounds(
        self, answer: Model, steps: Sequence[Step], rivals: Mapping[str, Sequence[str]]
    ) -> tuple[Round, ...]:
        """Each of ``steps``, and what else was tried there; ``rivals``: as in ``Diagnosis``."""
        found = [
            self._round(parent, pick, name, rivals.get(name, ()))
            for parent, pick, name in steps
        ]
        open_ = (
            not self.fits.at_floor(answer)
            and len(self.fits.added(answer)) < self.config.max_effects
        )
        if open_ and self._beside(answer):
            found.append(self._round(answer, None, "", ()))
        return tuple(found)

    def _beside(self, parent: Model) -> dict[str, Model]:
        """Effect → fitted model with it beside those of ``parent``."""
        key, fitted = frozenset(parent.names), self.fits.models
        return {
            n: m
            for n in self.names
            if n not in key and (m := fitted.get(key | {n})) is not None
        }

    def _round(
        self, parent: Model, pick: Model | None, added: str, tied: Sequence[str]
    ) -> Round:
        fits, c, key = self.fits, self.config, frozenset(parent.names)
        models = self._beside(parent) | ({added: pick} if pick is not None else {})
        verdicts = {}
        for n, m in models.items():
            why = fits.why_not(m, parent)
            if n == added:
                score = standard_score(parent.squares - m.squares)
                few = f", though few half seconds decide: {score:.1f} standard errors"
                verdicts[n] = "added" + few * (score < c.min_score)
            elif n in tied:
                verdicts[n] = f"tied with {added}"
            elif why or pick is None:
                verdicts[n] = why
            elif m.full and refusal(pick, m, c):
                verdicts[n] = (
                    f"explains as much as {added}, but less beside what was added later"
                )
            else:
                verdicts[n] = (
                    f"explains {'more' if m.squares.mean < pick.squares.mean else 'less'} than {added}"
                )
        order = sorted(models, key=lambda n: models[n].squares.mean)
        probed = sorted(
            (n for k, n in fits.probes if k == key and n not in models),
            key=lambda n: -fits.probes[key, n].explained,
        )
        return Round(
            evidence=tuple(
                fits.evidence(models[n], parent, verdicts[n]) for n in order
            ),
            not_refitted=tuple(probed),
            added=added or None,
            ties=tuple(n for n in tied if n in models),
            validation_error=(pick or parent).error,
            fit_error=(pick or parent).fit.error,
        )


def _offers(
    beam: Beam,
    answer: Model,
    rivals: Mapping[str, Sequence[str]],
    test: Sequence[Recording],
) -> list[Offer]:
    """Fits of every part of the added effects, and of those in which an effect that ties with one takes its place: alone, and
    beside all others."""
    fits = beam.whole
    added = fits.added(answer)
    sets = [
        names
        for count in range(1, len(added))
        for names in itertools.combinations(added, count)
    ]
    for name in added:
        for tie in rivals.get(name, ()):
            sets += [(tie,), tuple(tie if n == name else n for n in added)]
    found = []
    for names in dict.fromkeys(sets):
        fits.progress(
            f"fitting {' and '.join(names)} without the others, for add-effect"
        )
        own = fits.as_stated(
            fits.finished(fits.whole((*fits.present, *names), answer.fit.values).fit)
        )
        found.append(
            Offer(
                added=names,
                effects=tuple(_described(fits, own, {}, {})),
                base=_base(fits, own),
                intervals=own.intervals(),
                errors=fits.errors(own.values, own.effects, test),
                at_bound=tuple(f.name for f in own.ended),
                undetermined=_undetermined(own),
            )
        )
    return found


def _found(fits: Fits, answer: Model) -> Found:
    """What was found so far, before the last refit."""
    names = " and ".join(fits.added(answer))
    return Found(
        f"accepted: {names}, validation error {answer.error:.2f} noise floors",
        effects=answer.fit.effects,
        present=fits.present,
        base=_base(fits, answer.fit),
        errors={"after": {"fit": answer.fit.error, "validation": answer.error}},
        intervals={},
        finished=False,
    )


def _named(changed: Sequence[Changed]) -> set[str]:
    """Names of the fitted numbers of which ``changed`` are; ``loop_hz`` is of all numbers of a loop."""
    names = {c.name for c in changed}
    return names | {*OF_LOOP} if "loop_hz" in names else names


def _base(fits: Fits, model: Fit) -> Values:
    """The always fitted numbers of ``model``, with those that its last refit left as the file has them."""
    names = [f.name for f in model.frees if "." not in f.name]
    names += [f.name for f in fits.problem.base if f.leaves and not f.held]
    return {name: model.values[name] for name in names if name in model.values}


def _status(
    fits: Fits, answer: Model, changed: Sequence[Changed], standing_out: bool
) -> Status:
    added, config = fits.added(answer), fits.config
    if answer.fit.trouble:
        return "not_converged"
    if fits.at_floor(answer) and added:
        return "at_floor"
    if (
        not (added or standing_out)
        and max(answer.error, answer.fit.error) <= config.little
    ):
        if moved_gains(fits, fits.first):
            return "gains_moved"
        return "numbers_off" if changed else "nothing_missing"
    return "too_many" if len(added) >= config.max_effects else "something_else"


def _described(
    fits: Fits, model: Fit, errors: Mapping[str, Any], test_without: Mapping[str, float]
) -> list[Effect]:
    """The effects of ``model``. Each states its 95 % intervals and, as evidence, the validation error before and after, and the
    test error: before and after if it is the only one, else without and with it."""
    intervals = model.intervals()
    as_it_was, after = fits.error(fits.as_it_was), fits.error(model)
    stage = (
        "fitted"
        if fits.added(model)
        and (fits.base.error <= as_it_was or 0.9 * as_it_was < after)
        else "before"
    )
    before = fits.base.error if stage == "fitted" else as_it_was
    how = (
        ", ".join(model.names) if fits.added(model) else "numbers of the file refitted"
    )
    described = [copy.copy(effect) for effect in model.effects]
    for effect in described:
        prefix = f"{effect.name}."
        effect.interval = {
            k.removeprefix(prefix): v
            for k, v in intervals.items()
            if k.startswith(prefix)
        }
        effect.evidence = (
            f"validation error {before:.2f} to {after:.2f} noise floors with {how}; recordings "
            f"{', '.join(r.name for r in fits.validation)}"
        )
        if effect.name in test_without:
            only = len(test_without) == 1
            without = errors[stage]["test"] if only else test_without[effect.name]
            effect.evidence += f"; test {'' if only else 'without it, '}{of_test(without, errors['after']['test'])}"
    return described


def _undetermined(model: Fit) -> tuple[str, ...]:
    """Numbers of which the recordings say nothing: their interval is the whole range."""
    ends = model.intervals()
    return tuple(
        f.name
        for f in model.frees
        if ends[f.name][0] <= f.low and ends[f.name][1] >= f.high
    )


def _of_pairs(beam: Beam, answer: Model) -> list[str]:
    """Sentence where an effect was refused that may be one of two missing ones, and only one was to be added."""
    fits = beam.fits
    if fits.config.max_effects > 1 or fits.added(answer) or fits.at_floor(answer):
        return []
    return [
        f"{m.names[-1]} alone takes away {1.0 - m.fit.error**2 / fits.base.fit.error**2:.0%} of the squared fit error and fails "
        "on validation recordings, as one of two missing effects may: --until=noise_floor tries pairs."
        for m in beam.much(fits.base)[:1]
    ]
