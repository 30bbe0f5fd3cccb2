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
    4. The test recordings, which no choice has seen, give the final figures.

Whiteness of residuals is no stop rule: it rejects correct models (research: 8 of 8), a robot does not repeat itself exactly.
"""

import dataclasses
import time
from collections.abc import Mapping, Sequence

import numpy as np

from taccorl.diagnosis.search.evidence import Blocks, above_floor, bic_gain, block_squares, gain_of, standard_score
from taccorl.diagnosis.search.fit import FINE, OUTLYING, Fit, best_fit, fit, moved_by, rms, stacked
from taccorl.diagnosis.search.identifiable import not_told_from_none
from taccorl.diagnosis.search.problem import Candidate, Free, Problem, Progress, Recording, Values, chosen, no_progress
from taccorl.diagnosis.search.refitted import Refitted
from taccorl.diagnosis.search.result import Diagnosis, Round, SearchConfig, Status, of_test
from taccorl.diagnosis.search.screen import Probe, can_fade, probe
from taccorl.diagnosis.search.settle import settled
from taccorl.sim.effects.effect import Effect

MOST_FIRST = 2
"""Number of effects, each refused alone because of the validation recordings, that are tried together with a second effect."""
REFIT_WORSE = 1.3
"""Factor on the validation error from which on a refit of the always fitted numbers is a finding: more than the noise of another
motion causes."""
MOST_TIES = 3
"""Most ties of one round from which the search is repeated if it ended above the floor."""
BESIDE = (0.9, 0.97, 1.03, 1.1)
"""Factors on an effect's fitted values from which it is fitted again."""
GAINS_MOVED = 2.0
"""Factor between the twin's gains and refitted ones from which on the refit is a finding of its own, caused by late positions, a
wrong unit of time, or gains other than the commanded ones."""


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
    search = _Search(problem, fit_to, validation, config or SearchConfig(), progress)
    return search.run(test, dict(start or {}), tuple(present), without)


class _Search:
    def __init__(
        self,
        problem: Problem,
        fit_to: Sequence[Recording],
        validation: Sequence[Recording],
        config: SearchConfig,
        progress: Progress,
    ) -> None:
        self.problem, self.fit_to, self.validation = problem, list(fit_to), list(validation)
        self.config, self._report = config, progress
        self._state = ""
        """Text of how far the search is, before that of each step."""
        self.evaluations = 0
        self.removed: list[str] = []
        self.swapped: list[tuple[str, str]] = []
        self.refused: list[Fit] = []
        """Fits of the last round if it accepted no effect: those with one effect that removes much of the error on the fit
        recordings, the best first. Empty after a round that accepted one."""

    def run(
        self, test: Sequence[Recording], start: Values, present: tuple[str, ...], without: Sequence[str]
    ) -> Diagnosis:
        began = time.process_time()
        c = self.config
        self.present = present
        there = chosen(self.problem, present)
        given = {f.name: start.get(f.name, f.start) for f in (*self.problem.base, *(f for x in there for f in x.frees))}
        self.given = given
        self.progress("fitting the numbers that are always fitted")
        self.first = first = self._fitted(present, [given], most=60)
        self.first_error = self.error(first)
        self.problem.learn(first.values)
        names = [name for name in self.problem.candidates if name not in without]
        model, rounds = self._search(first, names, c.max_effects)
        model, rounds = self._from_ties(model, rounds, names)
        model, rounds, contained = self._with_simpler(model, rounds, names)
        model = self._without_superfluous(model)
        exchanged = len(self.swapped)
        model, rivals = self._against_ties(model, rounds)
        taken = dict(self.swapped[exchanged:])
        rounds = [self._taken_instead(r, new) if (new := taken.get(r.added or "")) in r.ties else r for r in rounds]
        rivals |= {name: (*others, *rivals.get(name, ())) for name, others in contained.items() if name in model.names}
        model, rounds, entangled = self._without_unsure(self._finished(model), rounds)
        as_it_was = dataclasses.replace(first, values=given, effects=tuple(x.make(given) for x in there))
        model, rounds = self._no_worse_than(as_it_was, model, rounds)
        steps = [("", self.error(first)), *((r.added, r.validation_error) for r in rounds if r.added)]
        after = self._errors(model.values, model.effects, test)
        without_it = self._test_without(model, test)
        return Diagnosis(
            status=self._status(model),
            effects=tuple(self._described(model, as_it_was, after.get("test"), without_it)),
            present=present,
            base={f.name: model.values[f.name] for f in self.problem.base},
            start=given,
            intervals=model.intervals(),
            rounds=tuple(rounds),
            rivals=rivals,
            twins={n: dict(self.problem.candidates[n].cls.near_twins) for n in model.names if n not in present},
            removed=tuple(self.removed),
            swapped=tuple(self.swapped),
            errors={
                "before": self._errors(given, as_it_was.effects, test),
                "fitted": self._errors(first.values, first.effects, test),
                "after": after,
            },
            test_without=without_it,
            steps=tuple(steps),
            remarks=(
                *entangled,
                *self._refit_remark(as_it_was, model),
                *self._remarks(model),
                *self._better_than_present(model, names),
            ),
            at_bound=tuple(
                f.name
                for f in model.frees
                if f.name in model.at_bound and not _untouched(f, model) and _determined(f, model)
            ),
            undetermined=tuple(f.name for f in model.frees if not _determined(f, model)),
            trouble=model.trouble,
            evaluations=self.evaluations,
            cpu_s=time.process_time() - began,
            before=first,
            after=model,
        )

    def _search(self, model: Fit, names: Sequence[str], most: int) -> tuple[Fit, list[Round]]:
        """``model`` with up to ``most`` effects more, one a round, until its error is at the floor or none is accepted. After
        each round the effects of earlier rounds are judged once more (``_exchanged``)."""
        rounds: list[Round] = []
        there = len(model.names)
        while not self._at_floor(model) and len(model.names) - there < most:
            found, better = self._round(model, names)
            together = [found]
            if better is None and model.names == self.present and most > 1:  # later the ties of the first are tried
                together, better = self._pair(model, found, names)
            rounds += together
            if better is None:
                break
            model = self._exchanged(better, better.names[there:-1], names, rounds)
        return model, rounds

    def progress(self, text: str) -> None:
        """Report the present step, after the effects that are in the model and the error that they leave."""
        self._report(f"{self._state}{text}")

    # one more effect -------------------------------------------------------------------------------------------------

    def _round(self, parent: Fit, names: Sequence[str]) -> tuple[Round, Fit | None]:
        c = self.config
        self.refused = []
        free = [name for name in names if name not in parent.names]
        before = block_squares(self.problem, parent, self.validation)
        has = " and ".join(n for n in parent.names if n not in self.present) or "no effect added"
        self._state = f"{has}, validation error {before.mean**0.5:.2f} noise floors; "
        self.progress(f"probing {len(free)} effects")
        probes = probe(self.problem, self.fit_to, parent, chosen(self.problem, free))
        self.evaluations += len(probes)
        best: dict[str, list[Probe]] = {}
        for p in sorted(probes, key=lambda p: -p.explained):
            best.setdefault(p.name, []).append(p)
        order = sorted(best, key=lambda name: -best[name][0].explained)
        starts = {
            name: [parent.values | _scaled(p, self.problem.candidates[name]) for p in self._likely(best[name])]
            for name in order
        }
        short = {}
        for k, name in enumerate(order[: c.num_refitted], 1):
            self.progress(f"first refit with {name}, {k} of {min(len(order), c.num_refitted)}")
            short[name] = self._short(parent, name, starts[name][0])
        if short and min(model.error for model in short.values()) > OUTLYING:
            self.progress("refitting without what is far off")
            short |= {name: self._rough(short[name]) for name in order[: c.num_rough]}
        by_error = sorted(short, key=lambda name: short[name].error)
        rows = []
        for place, name in enumerate(by_error):
            model = short[name]
            likely = place < c.num_finished or name in order[: c.num_likely]
            if likely or model.error <= c.near_best * short[by_error[0]].error:
                self.progress(f"refitting with {name}, {place + 1} of at most {len(by_error)}")
                model = self._child(parent, name, [model.values, *starts[name][1:]])
                short[name] = model
            rows.append(self._row(parent, before, model, best[name][0], short))
        rows.sort(key=lambda row: row.squares.mean)
        accepted = [row for row in rows if not row.refused()]
        if not accepted:
            most = (1.0 - c.sure_gain) * parent.error**2
            much = [row.model for row in rows if row.model.error**2 <= most and not row.at_its_end()]
            self.refused = sorted(much, key=lambda m: m.error)
            return self._told(parent, rows, order, None, []), None
        best_row = accepted[0]
        tied = [row for row in accepted if row is best_row or self._tie(row, best_row, before)]
        as_good = [row for row in tied if self._as_good(row, best_row)]
        if self._more_is_missing(best_row, before) and self.config.max_effects > 1:
            as_good += [row for row in accepted if row not in as_good and self._simpler_kin(row, best_row, before)]
        pick = min(as_good, key=lambda row: (row.num_parameters, row.squares.mean))
        if pick not in tied:
            tied = []
        pick.model = self._polished(pick.model)
        return self._told(parent, rows, order, pick, [row for row in tied if row is not pick]), pick.model

    def _pair(self, parent: Fit, found: Round, names: Sequence[str]) -> tuple[list[Round], Fit | None]:
        """Look for two effects that are accepted together, after no single effect was accepted. If two effects are missing,
        adding one of them can reduce the error on the fit recordings and increase it on the validation recordings, in which
        the other one acts differently.

        Returns:
            Rounds of both effects and the model with them; ``found`` alone and None if no pair is accepted.
        """
        first_error, c = block_squares(self.problem, parent, self.validation), self.config
        for first in self.refused[:MOST_FIRST]:
            name = first.names[-1]
            self.progress(f"looking for another effect beside {name}")
            second, both = self._round(first, names)
            if both is None:
                continue
            better = first_error - block_squares(self.problem, both, self.validation)
            more = sum(self.problem.candidates[n].num_parameters for n in both.names[-2:])
            if c.refusal(gain_of(better, first_error), standard_score(better), bic_gain(parent, both, more)):
                continue
            verdict = f"added together with {both.names[-1]}; alone refused"
            told = [dataclasses.replace(e, verdict=verdict) if e.name == name else e for e in found.evidence]
            begun = dataclasses.replace(
                found, evidence=tuple(told), added=name, validation_error=self.error(first), fit_error=first.error
            )
            return [begun, second], both
        return [found], None

    def _exchanged(self, model: Fit, earlier: Sequence[str], names: Sequence[str], rounds: list[Round]) -> Fit:
        """``model`` with each effect of ``earlier`` exchanged for one that does better, or as well with fewer numbers, now that
        the newest one is in; then the newest one likewise, if any was exchanged. Each exchange is appended to ``rounds``.

        An effect that is chosen while another is missing fits a part of that one, too, and one with more numbers does so better.
        Dry friction and armature are missing: Stribeck friction is added, then armature; Coulomb friction does the rest.
        """
        newest, before = model.names[-1], len(rounds)
        for name in (*earlier, newest):
            if name == newest and len(rounds) == before:
                break
            found, model = self._exchange(model, name, names)
            if found is not None:
                rounds.append(found)
                self.swapped.append((name, str(found.added)))
        return model

    def _exchange(self, model: Fit, name: str, names: Sequence[str]) -> tuple[Round | None, Fit]:
        """The best effect in place of ``name``, if it is another one; at the floor only effects with fewer numbers are tried."""
        candidates, at_floor = self.problem.candidates, self._at_floor(model)
        fewer = candidates[name].num_parameters - 1
        others = [n for n in names if n not in model.names and (not at_floor or candidates[n].num_parameters <= fewer)]
        if not others:
            return None, model
        self.progress(f"looking for a better effect than {name}, beside the others")
        rest = tuple(n for n in model.names if n != name)
        parent = self._fitted(rest, [model.values], self.config.steps)
        before = block_squares(self.problem, parent, self.validation)
        probes = probe(self.problem, self.fit_to, parent, chosen(self.problem, [*others, name]))
        self.evaluations += len(probes)
        best = {p.name: p for p in sorted(probes, key=lambda p: p.explained)}
        order = sorted(others, key=lambda n: -best[n].explained)[: self.config.num_exchanged]
        simpler = {*candidates[name].cls.reduces_to, *candidates[name].cls.equals_when_wide} & {*others}
        short = [
            self._short(parent, n, parent.values | _scaled(best[n], candidates[n]))
            for n in dict.fromkeys([*order, *simpler])
        ]
        least = min(m.error for m in short)
        likely = [m for m in short if m.error <= self.config.near_best * max(least, 1.0)]
        tried = {m.names[-1]: m for m in short}
        rows = [
            self._row(parent, before, self._child(parent, m.names[-1], [m.values]), best[m.names[-1]], tried)
            for m in likely
        ]
        own = self._row(parent, before, dataclasses.replace(model, names=(*rest, name)), best[name], tried)
        rows = sorted(
            (row for row in (*rows, own) if row is own or not row.refused()), key=lambda row: row.squares.mean
        )
        as_good = [row for row in rows if self._as_good(row, rows[0])]
        pick = min(as_good, key=lambda row: (row.num_parameters, row.squares.mean))
        better = own.squares - pick.squares
        clear = better.mean > 0.03 * own.squares.mean and standard_score(better) > 1.5
        if pick is own or not (clear or pick.num_parameters < own.num_parameters):
            return None, model
        pick.model = self._polished(pick.model)
        ties = [row for row in rows if row is not pick and self._tie(row, rows[0], before)]
        return dataclasses.replace(self._told(parent, rows, [], pick, ties), in_place_of=name), pick.model

    def _better_than_present(self, model: Fit, names: Sequence[str]) -> list[str]:
        """Remarks on effects of the twin in whose place others do much better, where the search ended above the floor: such an
        effect may have been added while another was missing. None where the other one does still better beside the twin's: then
        only the other one is missing."""
        remarks, here = [], block_squares(self.problem, model, self.validation)
        for name in self.present if not self._at_floor(model) else ():
            found, instead = self._exchange(model, name, names)
            there = block_squares(self.problem, instead, self.validation)
            if found is None or gain_of(here - there, here) < self.config.sure_gain:
                continue
            if not self._at_floor(instead):
                starts = [model.values | instead.values, instead.values | model.values]
                both = self._fitted((*model.names, str(found.added)), starts, self.config.steps)
                better = there - block_squares(self.problem, both, self.validation)
                if not self.config.too_little(gain_of(better, there), standard_score(better)):
                    continue
            remarks.append(
                f"{found.added} in place of {name}, which the twin has, would leave {found.validation_error:.2f} instead of "
                f"{self.error(model):.2f} noise floors, and beside it no less: if a diagnosis added {name}, remove it from the "
                "twin's file and diagnose again."
            )
        return remarks

    def _likely(self, probes: list[Probe]) -> list[Probe]:
        """The best start, and others that explain half as much."""
        return [p for p in probes[:3] if p.explained >= 0.5 * probes[0].explained]

    def _frees(self, name: str) -> tuple[Free, ...]:
        return self.problem.candidates[name].frees

    def _short(self, parent: Fit, name: str, start: Values) -> Fit:
        """``parent`` with one effect more, after a few steps; from where the numbers began if those of ``parent``, which have
        made up for the effect, do not go with it."""
        model = self._fitted((*parent.names, name), [start], self.config.first_steps)
        if model.error > 1.001 * parent.error:
            again = self._fitted((*parent.names, name), [start | self.given], self.config.first_steps)
            model = min((model, again), key=lambda m: m.error)
        return model

    def _rough(self, model: Fit) -> Fit:
        """``model``, or the best robust fit from where the numbers began if that leaves less: stretches that answer by jumps,
        such as a swing that sticks earlier, hold a linear fit beside the truth."""
        found = [model]
        for start in self.problem.candidates[model.names[-1]].starts[:3]:
            steps = 2 * self.config.first_steps
            found.append(fit(self.problem, self.fit_to, model.names, self.given | start, steps, loss="cauchy"))
            self.evaluations += found[-1].evaluations
        return min(found, key=lambda m: m.error)

    def _child(self, parent: Fit, name: str, starts: list[Values]) -> Fit:
        """``parent`` with one effect more; never worse than ``parent``, which it contains."""
        frees = self._frees(name)
        model = self._fitted((*parent.names, name), starts, self.config.steps)
        more = []
        if model.error > 1.001 * parent.error:  # stuck: from where the effect is hardly there
            faint = {f.name: f.start for f in frees} | {frees[0].name: frees[0].low if frees[0].log else 0.0}
            more.append(parent.values | faint)
        if (
            model.error > self.config.stop_at
        ):  # the numbers may have gone far to make up for the effect: from where they began
            more.append(starts[0] | self.given)
        if more:
            model = min((model, self._fitted((*parent.names, name), more, self.config.steps)), key=lambda m: m.error)
        return model

    def _polished(self, model: Fit) -> Fit:
        """The same hypothesis from a little beside where it ended: what one effect's fit has left over, the next must not find.
        Limits and dry friction have no smooth way to their best values."""
        if self.error(model) <= self.config.stop_at:
            return model
        self.progress(f"refitting {model.names[-1]} from beside its values")
        own = [f for f in self._frees(model.names[-1]) if f.log]
        beside = [model.values | {f.name: model.values[f.name] * factor} for f in own for factor in BESIDE]
        again = self._fitted(model.names, [model.values, *beside], self.config.steps)
        return min((model, again), key=lambda m: m.error)

    def _finished(self, model: Fit) -> Fit:
        """The same hypothesis to its very end, with slopes that its intervals can be told from. Numbers that go on moving while
        χ² falls by less than 1 lie in a direction that the recordings leave open: their intervals say so."""
        self.progress("last refit, with finer derivatives")
        fine = self._fine(model)
        if fine.trouble:
            further = self._fine(fine)
            fell = (fine.error**2 - further.error**2) / further.error**2 * further.effective_rows
            fine = dataclasses.replace(further, trouble="") if fell < 1.0 else further
        if fine.frees and self.validation:
            fine = dataclasses.replace(fine, moved=moved_by(self.problem, fine, self.fit_to, self.validation))
        return settled(self.problem, fine, self.given, self.present, self.fit_to, self.validation)

    def _fine(self, model: Fit) -> Fit:
        fine = fit(self.problem, self.fit_to, model.names, model.values, self.config.last_steps, FINE)
        self.evaluations += fine.evaluations
        return fine

    def _row(self, parent: Fit, before: Blocks, model: Fit, seen: Probe, tried: Mapping[str, Fit]) -> Refitted:
        return Refitted(self.problem, self.validation, self.config, parent, before, model, seen, tried)

    def _tie(self, row: Refitted, best: Refitted, before: Blocks) -> bool:
        """Whether validation recordings do not tell the two apart."""
        lost = above_floor(row.squares) - above_floor(best.squares)
        won = before.mean - best.squares.mean
        c = self.config
        close = lost <= c.tie_share * won and lost <= c.tie_rise * best.squares.mean
        unclear = lost < c.wide_tie_share * won and standard_score(row.squares - best.squares) < c.min_score
        return close or unclear

    def _as_good(self, row: Refitted, best: Refitted) -> bool:
        """Whether a simpler effect may stand for the best one."""
        return above_floor(row.squares) <= self.config.simpler * above_floor(best.squares)

    def _more_is_missing(self, best: Refitted, before: Blocks) -> bool:
        """Whether even the best effect leaves so much that another one must be missing besides."""
        left = above_floor(best.squares) - 1.0
        return best.validation_error > self.config.more_at and left > self.config.more_share * (before.mean - 1.0)

    def _simpler_kin(self, row: Refitted, best: Refitted, before: Blocks) -> bool:
        """Whether an effect is a simpler form of the best one, and removes nearly as much: the further numbers of the best one
        may be fitted to what is missing besides."""
        cls = best.candidate.cls
        kin = {*cls.reduces_to, *cls.equals_when_wide, *cls.near_twins}
        won = before.mean - best.squares.mean
        fewer = row.num_parameters < best.num_parameters
        return row.name in kin and fewer and before.mean - row.squares.mean >= self.config.kin_share * won

    def _told(
        self, parent: Fit, rows: list[Refitted], order: list[str], pick: Refitted | None, ties: list[Refitted]
    ) -> Round:
        def verdict(row: Refitted) -> str:
            if row is pick:
                few = f", though few half seconds decide: {row.score:.1f} standard errors"
                return "added" + few * (row.score < self.config.min_score)
            if row in ties:
                return f"tied with {pick.name}" if pick else ""
            if row.refused() or pick is None:
                return row.refused()
            if row.squares.mean < pick.squares.mean:
                return f"explains more than {pick.name} with more numbers, while more is missing"
            return f"explains less than {pick.name}"

        after = pick.model if pick else parent
        return Round(
            evidence=tuple(row.evidence(verdict(row)) for row in rows),
            not_refitted=tuple(order[len(rows) :]),
            added=pick.name if pick else None,
            ties=tuple(row.name for row in ties),
            validation_error=self.error(after),
            fit_error=after.error,
        )

    # are they all needed, and are they the right ones? ---------------------------------------------------------------

    def _from_ties(self, model: Fit, rounds: list[Round], names: Sequence[str]) -> tuple[Fit, list[Round]]:
        """What is found from a tie of the first added effect that has any, if the search ended above the floor.

        Effects that explain as much alone need not do so together with what else is missing. Of a sensor with creep and a voltage
        divider, logarithmic creep explained as much as creep; beside it, only hysteresis was accepted.
        """
        k = next((k for k, r in enumerate(rounds) if r.added and r.ties), None)
        if self._at_floor(model) or k is None:
            return model, rounds
        before = _beside(rounds, k)
        if len(before) + 1 >= self.config.max_effects:
            return model, rounds
        here = above_floor(block_squares(self.problem, model, self.validation))
        for tie in rounds[k].ties[:MOST_TIES]:
            self.progress(f"looking for more with {tie} in place of {rounds[k].added}")
            ended = [e for e in rounds[k].evidence if e.name == tie]
            parent = self._fitted((*self.present, *before, tie), [e.base | e.values for e in ended], self.config.steps)
            other, more = self._search(parent, names, self.config.max_effects - len(before) - 1)
            there = above_floor(block_squares(self.problem, other, self.validation))
            if there < self.config.from_tie * here:
                retold = self._taken_instead(rounds[k], tie)
                return other, [*rounds[:k], retold, *more]
        return model, rounds

    def _taken_instead(self, found: Round, tie: str) -> Round:
        """The round with one of its ties added, and its errors."""
        ties = tuple(found.added if name == tie else name for name in found.ties if found.added)
        verdicts = {tie: "added"} | dict.fromkeys(ties, f"tied with {tie}")
        evidence = tuple(dataclasses.replace(e, verdict=verdicts.get(e.name, e.verdict)) for e in found.evidence)
        own = next(e for e in evidence if e.name == tie)
        errors = {"validation_error": own.validation_error, "fit_error": own.fit_error}
        return dataclasses.replace(found, evidence=evidence, added=tie, ties=ties, **errors)

    def _without_superfluous(self, model: Fit) -> Fit:
        """Effects that would not be accepted if they were to be added now go again."""
        for name in [n for n in model.names if n not in self.present][:-1]:
            rest = tuple(other for other in model.names if other != name)
            smaller = self._fitted(rest, [model.values], self.config.steps)
            before = block_squares(self.problem, smaller, self.validation)
            better = before - block_squares(self.problem, model, self.validation)
            if self.config.too_little(gain_of(better, before), standard_score(better)):
                self.removed.append(name)
                model = smaller
        return model

    def _without_unsure(self, model: Fit, rounds: list[Round]) -> tuple[Fit, list[Round], list[str]]:
        """The finished model without the effects whose strength is not told from none, the one that removes least first. An
        effect that removes ``sure_gain`` of the error stays: another number makes up for a change of its strength. What is left
        above the floor counts where no known effect explains it, not where the search may only add no more.

        Returns:
            model, its rounds, and a remark on each of those that stay.
        """
        while True:
            here, found = block_squares(self.problem, model, self.validation), []
            added = [n for n in model.names if n not in self.present]
            for name in added:
                if why := not_told_from_none(model, name, left_over=len(added) < self.config.max_effects):
                    rest = tuple(n for n in model.names if n != name)
                    smaller = self._fitted(rest, [model.values], self.config.steps)
                    before = block_squares(self.problem, smaller, self.validation)
                    found.append((gain_of(before - here, before), name, why, smaller))
            gain, name, why, smaller = min(found, key=lambda f: f[0], default=(1.0, "", "", model))
            if gain >= self.config.sure_gain:
                return model, rounds, [self._entangled(model, name, smaller) for _, name, _, smaller in found]
            rounds = self._taken_back(rounds, name, why)
            model = self._finished(smaller)

    def _entangled(self, model: Fit, name: str, without: Fit) -> str:
        """Sentence on an effect whose strength is not known, although it removes most of the error."""
        frees, spread = model.frees, model.covariance()
        strengths = {f"{name}.{p.name}" for p in self.problem.candidates[name].cls.parameters() if p.absent is not None}
        own = next(k for k, f in enumerate(frees) if f.name in strengths)
        size = np.sqrt(np.diag(spread))
        other = max(
            (k for k in range(len(frees)) if k != own), key=lambda k: abs(spread[own, k]) / size[k], default=own
        )
        low, high = model.intervals()[frees[own].name]
        return (
            f"{frees[own].name} {model.values[frees[own].name]:.3g} is open (95 % {low:.3g} … {high:.3g}), although "
            f"{self.error(without):.2f} noise floors remain without {name}: {frees[other].name} makes up for a change of it "
            f"(correlation {spread[own, other] / size[own] / size[other]:+.2f})."
        )

    def _no_worse_than(self, as_it_was: Fit, model: Fit, rounds: list[Round]) -> tuple[Fit, list[Round]]:
        """The model without its effects where they leave as much on validation recordings as the twin as it was: they only undo
        what the refit of the always fitted numbers made worse."""
        added = [n for n in model.names if n not in self.present]
        before = block_squares(self.problem, as_it_was, self.validation)
        if not added or before.mean >= self.first_error**2:
            return model, rounds
        better = before - block_squares(self.problem, model, self.validation)
        if not (why := self.config.too_little(gain_of(better, before), standard_score(better))):
            return model, rounds
        for name in added:
            rounds = self._taken_back(rounds, name, f"compared with the twin as it was: {why}")
        return self._finished(self.first), rounds

    def _refit_remark(self, as_it_was: Fit, model: Fit) -> list[str]:
        """Sentence where no effect was added and the refit of the always fitted numbers is worse than the twin as it was."""
        before = self.error(as_it_was)
        if model.names != self.present or self.first_error <= REFIT_WORSE * max(before, 1.0):
            return []
        return [
            f"refitted to the fit recordings, the twin's numbers raise the validation error from {before:.2f} to "
            f"{self.first_error:.2f} noise floors: the twin lacks something that both kinds of recordings show differently, such "
            "as an effect of the speed, the pose or a warm gear."
        ]

    def _taken_back(self, rounds: Sequence[Round], name: str, why: str) -> list[Round]:
        """The rounds, of which none added ``name``."""
        kept, last = [], (self.error(self.first), self.first.error)
        for r in rounds:
            if r.added == name:
                told = tuple(
                    dataclasses.replace(e, verdict=why, unsure=True) if e.name == name else e for e in r.evidence
                )
                r = dataclasses.replace(
                    r, evidence=told, added=None, ties=(), validation_error=last[0], fit_error=last[1]
                )
            last = r.validation_error, r.fit_error
            kept.append(r)
        return kept

    def _with_simpler(
        self, model: Fit, rounds: list[Round], names: Sequence[str]
    ) -> tuple[Fit, list[Round], dict[str, tuple[str, ...]]]:
        """What is found without an effect that contains a simpler one, if that is at the floor with no more numbers.

        Two effects often look like one with many numbers: Coulomb friction and a soft gear like Stribeck friction.

        Returns:
            model, its rounds, and added effect → the effect with more numbers that does as well.
        """
        if not self._at_floor(model):
            return model, rounds, {}
        for k, name in enumerate(r.added for r in rounds):
            if name not in model.names or not self.problem.candidates[name].cls.reduces_to:
                continue
            self.progress(f"looking for simpler effects than {name}")
            before = _beside(rounds, k)
            parent = self._fitted((*self.present, *before), [model.values], self.config.steps) if before else self.first
            allowed = self.config.max_effects - len(before)
            other, found = self._search(parent, [n for n in names if n != name], allowed)
            here, there = (block_squares(self.problem, m, self.validation) for m in (model, other))
            if (
                self._at_floor(other)
                and self._num_parameters(other) <= self._num_parameters(model)
                and above_floor(there) <= self.config.simpler * above_floor(here)
            ):
                first = next(r.added for r in found if r.added)
                return other, [*rounds[:k], *found], {first: (name,)}
        return model, rounds, {}

    def _num_parameters(self, model: Fit) -> int:
        return sum(c.num_parameters for c in chosen(self.problem, model.names))

    def _against_ties(self, model: Fit, rounds: Sequence[Round]) -> tuple[Fit, dict[str, tuple[str, ...]]]:
        """Each effect against its ties, with the others in place: the better one stays, those that do as well are rivals."""
        ties = {r.added: r.ties for r in rounds if r.added}
        rivals: dict[str, tuple[str, ...]] = {}
        for name in model.names:
            here = block_squares(self.problem, model, self.validation)
            found = []
            for other in (t for t in ties.get(name, ()) if t not in model.names):
                self.progress(f"trying {other} in place of {name}")
                others = tuple(other if n == name else n for n in model.names)
                # From where its round ended; some effects have a hundred starts, nearly all of them far off.
                ended = [e.values for r in rounds if r.added == name for e in r.evidence if e.name == other]
                starts = [model.values | start for start in (*ended, *self.problem.candidates[other].starts[:3])]
                swapped = self._fitted(others, starts, self.config.steps)
                found.append((other, swapped, block_squares(self.problem, swapped, self.validation)))
            found.sort(key=lambda item: item[2].mean)
            kept = name
            if found:
                other, swapped, squares = found[0]
                better = here - squares
                fewer = len(swapped.frees) <= len(model.frees) + 1
                above = here.mean > 1.0 or len(swapped.frees) < len(model.frees)
                if fewer and above and better.mean > 0.03 * here.mean and standard_score(better) > 1.5:
                    self.swapped.append((name, other))
                    found[0] = (name, model, here)
                    model, here, kept = swapped, squares, other
            as_good = [
                o
                for o, _, squares in found
                if squares.mean < 1.5 * here.mean and standard_score(squares - here) < self.config.min_score
            ]
            if as_good:
                rivals[kept] = tuple(as_good)
        return model, rivals

    # helpers ---------------------------------------------------------------------------------------------------------

    def _fitted(self, names: Sequence[str], starts: Sequence[Mapping[str, float]], most: int) -> Fit:
        model = best_fit(self.problem, self.fit_to, names, starts, most)
        self.evaluations += model.evaluations
        return model

    def _at_floor(self, model: Fit) -> bool:
        """Whether neither the validation nor the fit recordings have an error that another effect could explain. Where effects
        were added, an error up to ``little`` counts as the floor if it is ``little_share`` of what they removed: equations of
        a robot differ from the twin's by more than that."""
        c, error = self.config, self.error(model)
        if error <= c.stop_at and model.error <= c.stop_fit_at:
            return True
        is_little = len(model.names) > len(self.present) and max(error, model.error) <= c.little
        return is_little and error**2 - 1.0 <= c.little_share * self.first_error**2

    def error(self, model: Fit) -> float:
        """RMS on the validation recordings [floors]."""
        return rms(stacked(self.problem, model.values, model.effects, self.validation))

    def _errors(self, values: Values, effects: Sequence[Effect], test: Sequence[Recording]) -> dict[str, float]:
        uses = {"fit": self.fit_to, "validation": self.validation, "test": list(test)}
        return {use: rms(stacked(self.problem, values, effects, recs)) for use, recs in uses.items() if recs}

    def _test_without(self, model: Fit, test: Sequence[Recording]) -> dict[str, float]:
        """Added effect → RMS error on the test recordings [floors] with the others refitted without it."""
        found = {}
        added = [n for n in model.names if n not in self.present] if test else []
        for name in added:
            rest = tuple(n for n in model.names if n != name)
            other = self.first if len(added) == 1 else self._fitted(rest, [model.values], self.config.steps)
            found[name] = self._errors(other.values, other.effects, test)["test"]
        return found

    def _status(self, model: Fit) -> Status:
        if model.trouble:
            return "not_converged"
        if self._at_floor(model):
            if len(model.names) > len(self.present):
                return "at_floor"
            return "gains_moved" if self._moved(self.first) else "nothing_missing"
        if len(model.names) == len(self.present) and max(self.error(model), model.error) <= self.config.little:
            return "gains_moved" if self._moved(self.first) else "nothing_missing"
        full = len(model.names) - len(self.present) >= self.config.max_effects
        return "too_many" if full else "something_else"

    def _moved(self, model: Fit) -> dict[str, tuple[float, float]]:
        """Gain → (the twin's, fitted) of those that are more than ``GAINS_MOVED`` times off."""
        pairs = {g: (self.given[g], model.values[g]) for g in ("kp", "kd") if g in model.values and self.given.get(g)}
        return {g: (old, new) for g, (old, new) in pairs.items() if not 1 / GAINS_MOVED <= new / old <= GAINS_MOVED}

    def _remarks(self, model: Fit) -> list[str]:
        """Sentences on what the error does not show."""
        units = {f.name: f.unit for f in model.frees}
        fits = {
            "with the effects added": self._moved(model),
            "before any effect was considered": self._moved(self.first),
        }
        moved = {gain: (when, *change) for when, found in fits.items() for gain, change in found.items()}
        pairs = []
        if self.refused and self.config.max_effects == 1 and model.names == self.present:
            removed = 1.0 - self.refused[0].error ** 2 / model.error**2
            pairs.append(
                f"{self.refused[0].names[-1]} alone takes away {removed:.0%} of the squared fit error and fails on validation "
                "recordings, as one of two missing effects may: --until=noise_floor tries pairs."
            )
        return pairs + [
            f"{gain} had to move from the twin's {old:.4g} to {new:.4g} {units[gain]} (× {new / old:.2g}) {when}. Check the time "
            "stamps (positions reported late, wrong unit of time) and which gains were commanded (kp, kd of the recording in "
            "measurements.yaml)."
            for gain, (when, old, new) in moved.items()
        ]

    def _described(
        self, model: Fit, as_it_was: Fit, test_error: float | None, test_without: Mapping[str, float]
    ) -> list[Effect]:
        """Return the effects of ``model``. Each states its 95 % intervals and, as evidence, the validation error before and
        after, and the error on the test recordings with and without it."""
        intervals = model.intervals()
        before, after = min(self.error(as_it_was), self.first_error), self.error(model)
        for effect in model.effects:
            prefix = f"{effect.name}."
            effect.interval = {k.removeprefix(prefix): v for k, v in intervals.items() if k.startswith(prefix)}
            effect.evidence = (
                f"validation error {before:.2f} to {after:.2f} noise floors with {', '.join(model.names)}; recordings "
                f"{', '.join(r.name for r in self.validation)}"
            )
            if test_error is not None and effect.name in test_without:
                effect.evidence += f"; test {of_test(test_without[effect.name], test_error)}"
        return list(model.effects)


def _untouched(f: Free, model: Fit) -> bool:
    """Whether a number is at the end of its range because it starts there and nothing moves it: absent, not far off."""
    return f.start in (f.low, f.high) and abs(f.coordinate(model.values[f.name]) - f.coordinate(f.start)) < 0.01


def _determined(f: Free, model: Fit) -> bool:
    """Whether the recordings say anything of a number: its interval is not the whole range."""
    low, high = model.intervals()[f.name]
    return low > f.low or high < f.high


def _beside(rounds: Sequence[Round], k: int) -> tuple[str, ...]:
    """Effects that the rounds before ``k`` left in the model, without one that round ``k`` replaced."""
    names: list[str] = []
    for r in rounds[:k]:
        names = [*(n for n in names if n != r.in_place_of), *([r.added] if r.added else [])]
    return tuple(n for n in names if n != rounds[k].in_place_of)


def _scaled(seen: Probe, c: Candidate) -> Values:
    """The probe's start with its strength multiplied as the score test suggests."""
    values = {f.name: f.start for f in c.frees} | seen.start
    if can_fade(c) and c.frees[0].log and seen.multiple > 0:
        values[c.frees[0].name] *= min(max(seen.multiple, 0.1), 10.0)
    return values
