"""Checks of what the rounds of a search found: are other effects better from a tie, are all of them needed and determined?"""

import dataclasses
from collections.abc import Sequence

from taccorl.diagnosis.search.evidence import above_floor, gain_of, standard_score
from taccorl.diagnosis.search.fit import Fit
from taccorl.diagnosis.search.identifiable import not_told_from_none
from taccorl.diagnosis.search.problem import chosen
from taccorl.diagnosis.search.refits import Refits
from taccorl.diagnosis.search.remarks import entangled
from taccorl.diagnosis.search.result import Round
from taccorl.diagnosis.search.rounds import Rounds

MOST_TIES = 3
"""Most ties of one round from which the search is repeated if it ended above the floor."""


class FinalChecks:
    """Checks in the order of ``run``; each returns a model that is as good with less, or a better one."""

    def __init__(self, refits: Refits, rounds: Rounds) -> None:
        self.refits, self.rounds, self.problem, self.config = refits, rounds, refits.problem, refits.config
        self.removed: list[str] = []
        """Effects that were accepted and later found superfluous."""

    def run(
        self, model: Fit, rounds: list[Round], names: Sequence[str]
    ) -> tuple[Fit, list[Round], dict[str, tuple[str, ...]], list[str]]:
        """Check what ``rounds`` led to.

        Args:
            names: effects that may be added.

        Returns:
            the model in its last refit; its rounds; added effect → effects that explain as much in its place; remarks.
        """
        model, rounds = self._from_ties(model, rounds, names)
        model, rounds, contained = self._with_simpler(model, rounds, names)
        model = self._without_superfluous(model)
        exchanged = len(self.rounds.swapped)
        model, rivals = self._against_ties(model, rounds)
        taken = dict(self.rounds.swapped[exchanged:])
        rounds = [_taken_instead(r, new) if (new := taken.get(r.added or "")) in r.ties else r for r in rounds]
        rivals |= {name: (*others, *rivals.get(name, ())) for name, others in contained.items() if name in model.names}
        model, rounds, remarks = self._without_unsure(self.refits.finished(model), rounds)
        model, rounds = self._no_worse_than_it_was(model, rounds)
        return model, rounds, rivals, remarks

    def _from_ties(self, model: Fit, rounds: list[Round], names: Sequence[str]) -> tuple[Fit, list[Round]]:
        """What is found from a tie of the first added effect that has any, if the search ended above the floor.

        Effects that explain as much alone need not do so together with what else is missing. Of a sensor with creep and a voltage
        divider, logarithmic creep explained as much as creep; beside it, only hysteresis was accepted.
        """
        k = next((k for k, r in enumerate(rounds) if r.added and r.ties), None)
        if self.refits.at_floor(model) or k is None:
            return model, rounds
        before = _beside(rounds, k)
        if len(before) + 1 >= self.config.max_effects:
            return model, rounds
        here = above_floor(self.refits.squares(model))
        for tie in rounds[k].ties[:MOST_TIES]:
            self.refits.progress(f"looking for more with {tie} in place of {rounds[k].added}")
            ended = [e for e in rounds[k].evidence if e.name == tie]
            parent = self.refits.fitted(
                (*self.refits.present, *before, tie), [e.base | e.values for e in ended], self.config.steps
            )
            other, more = self.rounds.run(parent, names, self.config.max_effects - len(before) - 1)
            there = above_floor(self.refits.squares(other))
            if there < self.config.from_tie * here:
                retold = _taken_instead(rounds[k], tie)
                return other, [*rounds[:k], retold, *more]
        return model, rounds

    def _with_simpler(
        self, model: Fit, rounds: list[Round], names: Sequence[str]
    ) -> tuple[Fit, list[Round], dict[str, tuple[str, ...]]]:
        """What is found without an effect that contains a simpler one, if that is at the floor with no more numbers.

        Two effects often look like one with many numbers: Coulomb friction and a soft gear like Stribeck friction.

        Returns:
            model, its rounds, and added effect → the effect with more numbers that does as well.
        """
        if not self.refits.at_floor(model):
            return model, rounds, {}
        for k, name in enumerate(r.added for r in rounds):
            if name not in model.names or not self.problem.candidates[name].cls.reduces_to:
                continue
            self.refits.progress(f"looking for simpler effects than {name}")
            before = _beside(rounds, k)
            parent = (
                self.refits.fitted((*self.refits.present, *before), [model.values], self.config.steps)
                if before
                else self.refits.first
            )
            allowed = self.config.max_effects - len(before)
            other, found = self.rounds.run(parent, [n for n in names if n != name], allowed)
            here, there = (self.refits.squares(m) for m in (model, other))
            if (
                self.refits.at_floor(other)
                and self._num_parameters(other) <= self._num_parameters(model)
                and above_floor(there) <= self.config.simpler * above_floor(here)
            ):
                first = next(r.added for r in found if r.added)
                return other, [*rounds[:k], *found], {first: (name,)}
        return model, rounds, {}

    def _num_parameters(self, model: Fit) -> int:
        return sum(c.num_parameters for c in chosen(self.problem, model.names))

    def _without_superfluous(self, model: Fit) -> Fit:
        """Effects that would not be accepted if they were to be added now go again."""
        for name in self.refits.added(model)[:-1]:
            rest = tuple(other for other in model.names if other != name)
            smaller = self.refits.fitted(rest, [model.values], self.config.steps)
            before = self.refits.squares(smaller)
            better = before - self.refits.squares(model)
            if self.config.too_little(gain_of(better, before), standard_score(better)):
                self.removed.append(name)
                model = smaller
        return model

    def _against_ties(self, model: Fit, rounds: Sequence[Round]) -> tuple[Fit, dict[str, tuple[str, ...]]]:
        """Each effect against its ties, with the others in place: the better one stays, those that do as well are rivals."""
        ties = {r.added: r.ties for r in rounds if r.added}
        rivals: dict[str, tuple[str, ...]] = {}
        for name in model.names:
            here = self.refits.squares(model)
            found = []
            for other in (t for t in ties.get(name, ()) if t not in model.names):
                self.refits.progress(f"trying {other} in place of {name}")
                others = tuple(other if n == name else n for n in model.names)
                # From where its round ended; some effects have a hundred starts, nearly all of them far off.
                ended = [e.values for r in rounds if r.added == name for e in r.evidence if e.name == other]
                starts = [model.values | start for start in (*ended, *self.problem.candidates[other].starts[:3])]
                swapped = self.refits.fitted(others, starts, self.config.steps)
                found.append((other, swapped, self.refits.squares(swapped)))
            found.sort(key=lambda item: item[2].mean)
            kept = name
            if found:
                other, swapped, squares = found[0]
                better = here - squares
                fewer = len(swapped.frees) <= len(model.frees) + 1
                above = here.mean > 1.0 or len(swapped.frees) < len(model.frees)
                if fewer and above and better.mean > 0.03 * here.mean and standard_score(better) > 1.5:
                    self.rounds.swapped.append((name, other))
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

    def _without_unsure(self, model: Fit, rounds: list[Round]) -> tuple[Fit, list[Round], list[str]]:
        """The finished model without the effects whose strength is not told from none, the one that removes least first. An
        effect that removes ``sure_gain`` of the error stays: another number makes up for a change of its strength. What is left
        above the floor counts where no known effect explains it, not where the search may only add no more.

        Returns:
            model, its rounds, and a remark on each of those that stay.
        """
        while True:
            here, found = self.refits.squares(model), []
            added = self.refits.added(model)
            for name in added:
                if why := not_told_from_none(model, name, left_over=len(added) < self.config.max_effects):
                    rest = tuple(n for n in model.names if n != name)
                    smaller = self.refits.fitted(rest, [model.values], self.config.steps)
                    before = self.refits.squares(smaller)
                    found.append((gain_of(before - here, before), name, why, smaller))
            gain, name, why, smaller = min(found, key=lambda f: f[0], default=(1.0, "", "", model))
            if gain >= self.config.sure_gain:
                return model, rounds, [entangled(self.refits, model, name, smaller) for _, name, _, smaller in found]
            rounds = self._taken_back(rounds, name, why)
            model = self.refits.finished(smaller)

    def _no_worse_than_it_was(self, model: Fit, rounds: list[Round]) -> tuple[Fit, list[Round]]:
        """The model without its effects where they leave as much on validation recordings as the twin as it was: they only undo
        what the refit of the always fitted numbers made worse."""
        added = self.refits.added(model)
        before = self.refits.squares(self.refits.as_it_was)
        if not added or before.mean >= self.refits.first_error**2:
            return model, rounds
        better = before - self.refits.squares(model)
        if not (why := self.config.too_little(gain_of(better, before), standard_score(better))):
            return model, rounds
        for name in added:
            rounds = self._taken_back(rounds, name, f"compared with the twin as it was: {why}")
        return self.refits.finished(self.refits.first), rounds

    def _taken_back(self, rounds: Sequence[Round], name: str, why: str) -> list[Round]:
        """The rounds, of which none added ``name``."""
        kept, last = [], (self.refits.error(self.refits.first), self.refits.first.error)
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


def _taken_instead(found: Round, tie: str) -> Round:
    """The round with one of its ties added, and its errors."""
    ties = tuple(found.added if name == tie else name for name in found.ties if found.added)
    verdicts = {tie: "added"} | dict.fromkeys(ties, f"tied with {tie}")
    evidence = tuple(dataclasses.replace(e, verdict=verdicts.get(e.name, e.verdict)) for e in found.evidence)
    own = next(e for e in evidence if e.name == tie)
    errors = {"validation_error": own.validation_error, "fit_error": own.fit_error}
    return dataclasses.replace(found, evidence=evidence, added=tie, ties=ties, **errors)


def _beside(rounds: Sequence[Round], k: int) -> tuple[str, ...]:
    """Effects that the rounds before ``k`` left in the model, without one that round ``k`` replaced."""
    names: list[str] = []
    for r in rounds[:k]:
        names = [*(n for n in names if n != r.in_place_of), *([r.added] if r.added else [])]
    return tuple(n for n in names if n != rounds[k].in_place_of)
