"""Rounds of the search: each adds one effect, then exchanges those of earlier rounds where another one does better."""

import dataclasses
from collections.abc import Mapping, Sequence

from taccorl.diagnosis.search.evidence import Blocks, above_floor, bic_gain, gain_of, standard_score
from taccorl.diagnosis.search.fit import OUTLYING, Fit
from taccorl.diagnosis.search.problem import Candidate, Values, chosen
from taccorl.diagnosis.search.refits import Refits
from taccorl.diagnosis.search.refitted import Refitted
from taccorl.diagnosis.search.result import Round
from taccorl.diagnosis.search.screen import Probe, can_fade, probe

MOST_FIRST = 2
"""Number of effects, each refused alone because of the validation recordings, that are tried together with a second effect."""


class Rounds:
    """Search for one effect after another."""

    def __init__(self, refits: Refits) -> None:
        self.refits, self.problem, self.config = refits, refits.problem, refits.config
        self.swapped: list[tuple[str, str]] = []
        """(effect of an earlier round, effect that took its place)."""
        self.refused: list[Fit] = []
        """Fits of the last round if it accepted no effect: those with one effect that removes much of the error on the fit
        recordings, the best first. Empty after a round that accepted one."""

    def run(self, model: Fit, names: Sequence[str], most: int) -> tuple[Fit, list[Round]]:
        """``model`` with up to ``most`` effects more, one a round, until its error is at the floor or none is accepted. After
        each round the effects of earlier rounds are judged once more (``_exchanged``)."""
        rounds: list[Round] = []
        there = len(model.names)
        while not self.refits.at_floor(model) and len(model.names) - there < most:
            found, better = self._round(model, names)
            together = [found]
            if (
                better is None and model.names == self.refits.present and most > 1
            ):  # later the ties of the first are tried
                together, better = self._pair(model, found, names)
            rounds += together
            if better is None:
                break
            model = self._exchanged(better, better.names[there:-1], names, rounds)
        return model, rounds

    def _round(self, parent: Fit, names: Sequence[str]) -> tuple[Round, Fit | None]:
        c = self.config
        self.refused = []
        free = [name for name in names if name not in parent.names]
        before = self.refits.squares(parent)
        has = " and ".join(self.refits.added(parent)) or "no effect added"
        self.refits.state = f"{has}, validation error {before.mean**0.5:.2f} noise floors; "
        self.refits.progress(f"probing {len(free)} effects")
        probes = probe(self.problem, self.refits.fit_to, parent, chosen(self.problem, free))
        self.refits.evaluations += len(probes)
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
            self.refits.progress(f"first refit with {name}, {k} of {min(len(order), c.num_refitted)}")
            short[name] = self.refits.short(parent, name, starts[name][0])
        if short and min(model.error for model in short.values()) > OUTLYING:
            self.refits.progress("refitting without what is far off")
            short |= {name: self.refits.rough(short[name]) for name in order[: c.num_rough]}
        by_error = sorted(short, key=lambda name: short[name].error)
        rows = []
        for place, name in enumerate(by_error):
            model = short[name]
            likely = place < c.num_finished or name in order[: c.num_likely]
            if likely or model.error <= c.near_best * short[by_error[0]].error:
                self.refits.progress(f"refitting with {name}, {place + 1} of at most {len(by_error)}")
                model = self.refits.child(parent, name, [model.values, *starts[name][1:]])
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
        pick.model = self.refits.polished(pick.model)
        return self._told(parent, rows, order, pick, [row for row in tied if row is not pick]), pick.model

    def _pair(self, parent: Fit, found: Round, names: Sequence[str]) -> tuple[list[Round], Fit | None]:
        """Look for two effects that are accepted together, after no single effect was accepted. If two effects are missing,
        adding one of them can reduce the error on the fit recordings and increase it on the validation recordings, in which
        the other one acts differently.

        Returns:
            Rounds of both effects and the model with them; ``found`` alone and None if no pair is accepted.
        """
        first_error, c = self.refits.squares(parent), self.config
        for first in self.refused[:MOST_FIRST]:
            name = first.names[-1]
            self.refits.progress(f"looking for another effect beside {name}")
            second, both = self._round(first, names)
            if both is None:
                continue
            better = first_error - self.refits.squares(both)
            more = sum(self.problem.candidates[n].num_parameters for n in both.names[-2:])
            if c.refusal(gain_of(better, first_error), standard_score(better), bic_gain(parent, both, more)):
                continue
            verdict = f"added together with {both.names[-1]}; alone refused"
            told = [dataclasses.replace(e, verdict=verdict) if e.name == name else e for e in found.evidence]
            begun = dataclasses.replace(
                found,
                evidence=tuple(told),
                added=name,
                validation_error=self.refits.error(first),
                fit_error=first.error,
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
            found, model = self.exchange(model, name, names)
            if found is not None:
                rounds.append(found)
                self.swapped.append((name, str(found.added)))
        return model

    def exchange(self, model: Fit, name: str, names: Sequence[str]) -> tuple[Round | None, Fit]:
        """The best effect in place of ``name``, if it is another one; at the floor only effects with fewer numbers are tried."""
        candidates, at_floor = self.problem.candidates, self.refits.at_floor(model)
        fewer = candidates[name].num_parameters - 1
        others = [n for n in names if n not in model.names and (not at_floor or candidates[n].num_parameters <= fewer)]
        if not others:
            return None, model
        self.refits.progress(f"looking for a better effect than {name}, beside the others")
        rest = tuple(n for n in model.names if n != name)
        parent = self.refits.fitted(rest, [model.values], self.config.steps)
        before = self.refits.squares(parent)
        probes = probe(self.problem, self.refits.fit_to, parent, chosen(self.problem, [*others, name]))
        self.refits.evaluations += len(probes)
        best = {p.name: p for p in sorted(probes, key=lambda p: p.explained)}
        order = sorted(others, key=lambda n: -best[n].explained)[: self.config.num_exchanged]
        simpler = {*candidates[name].cls.reduces_to, *candidates[name].cls.equals_when_wide} & {*others}
        short = [
            self.refits.short(parent, n, parent.values | _scaled(best[n], candidates[n]))
            for n in dict.fromkeys([*order, *simpler])
        ]
        least = min(m.error for m in short)
        likely = [m for m in short if m.error <= self.config.near_best * max(least, 1.0)]
        tried = {m.names[-1]: m for m in short}
        rows = [
            self._row(parent, before, self.refits.child(parent, m.names[-1], [m.values]), best[m.names[-1]], tried)
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
        pick.model = self.refits.polished(pick.model)
        ties = [row for row in rows if row is not pick and self._tie(row, rows[0], before)]
        return dataclasses.replace(self._told(parent, rows, [], pick, ties), in_place_of=name), pick.model

    def _likely(self, probes: list[Probe]) -> list[Probe]:
        """The best start, and others that explain half as much."""
        return [p for p in probes[:3] if p.explained >= 0.5 * probes[0].explained]

    def _row(self, parent: Fit, before: Blocks, model: Fit, seen: Probe, tried: Mapping[str, Fit]) -> Refitted:
        return Refitted(self.problem, self.refits.validation, self.config, parent, before, model, seen, tried)

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
            validation_error=self.refits.error(after),
            fit_error=after.error,
        )


def _scaled(seen: Probe, c: Candidate) -> Values:
    """The probe's start with its strength multiplied as the score test suggests."""
    values = {f.name: f.start for f in c.frees} | seen.start
    if can_fade(c) and c.frees[0].log and seen.multiple > 0:
        values[c.frees[0].name] *= min(max(seen.multiple, 0.1), 10.0)
    return values
