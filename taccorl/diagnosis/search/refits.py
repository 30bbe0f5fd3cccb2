"""Fits of hypotheses in one search: which recordings, from where the numbers begin, and when the rest counts as noise."""

import dataclasses
from collections.abc import Mapping, Sequence

from taccorl.diagnosis.search.evidence import Blocks, block_squares
from taccorl.diagnosis.search.fit import FINE, WIDE, Fit, best_fit, fit, moved_by, over_own_scale, rms, stacked
from taccorl.diagnosis.search.problem import Free, Problem, Progress, Recording, Values, chosen, with_frees
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.diagnosis.search.settle import settled
from taccorl.sim.effects.effect import Effect

BESIDE = (0.9, 0.97, 1.03, 1.1)
"""Factors on an effect's fitted values from which it is fitted again."""


class Refits:
    """Fits of hypotheses to the same recordings, and their errors.

    Args:
        start: start values; numbers that are left out start at their defaults.
        present: effects that the twin has already.
        report: function that is called with a text about the present step.
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
    ) -> None:
        self.problem, self.fit_to, self.validation = problem, list(fit_to), list(validation)
        self.present, self.config, self._report = present, config, report
        self.state = ""
        """Text of how far the search is, before that of each step."""
        self.evaluations = 0
        """Number of simulations of all fit recordings so far."""
        there = chosen(problem, present)
        self.given = {f.name: start.get(f.name, f.start) for f in (*problem.base, *(f for x in there for f in x.frees))}
        """Value of every number of the problem as the machine's file has it, before any fit."""
        self.progress("fitting the numbers that are always fitted")
        self.first = self.fitted(present, [self.given], most=60)
        """The fit without a further effect."""
        self.first_error = self.error(self.first)
        """Its validation error [floors]."""
        self.as_it_was = dataclasses.replace(
            self.first, values=self.given, effects=tuple(x.make(self.given) for x in there)
        )
        """The twin with the numbers that it has, not fitted."""

    def added(self, model: Fit) -> list[str]:
        """Names of the effects in ``model`` that the search added, that is without those of the twin's own file."""
        return [name for name in model.names if name not in self.present]

    def progress(self, text: str) -> None:
        """Report the present step, after the effects that are in the model and the error that they leave."""
        self._report(f"{self.state}{text}")

    def fitted(self, names: Sequence[str], starts: Sequence[Mapping[str, float]], most: int) -> Fit:
        """The best of several fits of the effects ``names``; at most ``most`` steps in each."""
        model = best_fit(self.problem, self.fit_to, names, starts, most)
        self.evaluations += model.evaluations
        return model

    def short(self, parent: Fit, name: str, start: Values) -> Fit:
        """``parent`` with one effect more, after a few steps; from where the numbers began if those of ``parent``, which have
        made up for the effect, do not go with it."""
        model = self.fitted((*parent.names, name), [start], self.config.first_steps)
        if model.error > 1.001 * parent.error:
            again = self.fitted((*parent.names, name), [start | self.given], self.config.first_steps)
            model = min((model, again), key=lambda m: m.error)
        return model

    def rough(self, model: Fit) -> Fit:
        """``model``, or the best robust fit from where the numbers began if that leaves less: stretches that answer by jumps,
        such as a swing that sticks earlier, hold a linear fit beside the truth."""
        found = [model]
        for start in self.problem.candidates[model.names[-1]].starts[:3]:
            steps = 2 * self.config.first_steps
            found.append(fit(self.problem, self.fit_to, model.names, self.given | start, steps, loss="cauchy"))
            self.evaluations += found[-1].evaluations
        return min(found, key=lambda m: m.error)

    def child(self, parent: Fit, name: str, starts: list[Values]) -> Fit:
        """``parent`` with one effect more; never worse than ``parent``, which it contains."""
        frees = self.problem.candidates[name].frees
        model = self.fitted((*parent.names, name), starts, self.config.steps)
        more = []
        if model.error > 1.001 * parent.error:  # stuck: from where the effect is hardly there
            faint = {f.name: f.start for f in frees} | {frees[0].name: frees[0].low if frees[0].log else 0.0}
            more.append(parent.values | faint)
        if (
            model.error > self.config.stop_at
        ):  # the numbers may have gone far to make up for the effect: from where they began
            more.append(starts[0] | self.given)
        if more:
            model = min((model, self.fitted((*parent.names, name), more, self.config.steps)), key=lambda m: m.error)
        return model

    def polished(self, model: Fit) -> Fit:
        """The same hypothesis from a little beside where it ended: what one effect's fit has left over, the next must not find.
        Limits and dry friction have no smooth way to their best values."""
        if self.error(model) <= self.config.stop_at:
            return model
        self.progress(f"refitting {model.names[-1]} from beside its values")
        own = [f for f in self.problem.candidates[model.names[-1]].frees if f.log]
        beside = [model.values | {f.name: model.values[f.name] * factor} for f in own for factor in BESIDE]
        wide = fit(self.problem, self.fit_to, model.names, model.values, self.config.steps, WIDE)
        self.evaluations += wide.evaluations
        again = self.fitted(model.names, [model.values, wide.values, *beside], self.config.steps)
        return min((model, wide, again), key=lambda m: m.error)

    def finished(self, model: Fit) -> Fit:
        """The same hypothesis to its very end, with slopes that its intervals can be told from. Numbers that go on moving while
        χ² falls by less than 1 lie in a direction that the recordings leave open: their intervals say so."""
        self.progress("last refit, with finer derivatives")
        fine = self._fine(model)
        if fine.trouble:
            further = self._fine(fine)
            fell = (fine.error**2 - further.error**2) / further.error**2 * further.effective_rows
            fine = dataclasses.replace(further, trouble="") if fell < 1.0 else further
        if not fine.frees:
            return fine
        problem, fine = self._without_ended(fine)
        fine, steps = over_own_scale(problem, fine, self.fit_to)
        if self.validation:
            moved = moved_by(problem, fine, self.fit_to, self.validation, steps)
            fine = dataclasses.replace(fine, moved=moved)
        found = settled(problem, fine, self.given, self.present, self.fit_to, self.validation)
        return fine if found is fine else over_own_scale(problem, found, self.fit_to)[0]

    def _without_ended(self, model: Fit) -> tuple[Problem, Fit]:
        """The problem and ``model`` with always fitted numbers, without gains, that were driven to an end of their range (a mass
        to nothing) back where they began and held there, and the others refitted, if that costs ``tie_share`` of what the effects
        removed at most."""
        ended = {f.name for f in model.fled} - {"kp", "kd"}
        won = self.first_error**2 - self.error(model) ** 2
        if not ended or not self.added(model):
            return self.problem, model

        def held(f: Free) -> Free:
            return dataclasses.replace(f, start=self.given[f.name], held=True) if f.name in ended else f

        problem = with_frees(self.problem, held)
        other = self._fine(model, problem)
        lost = self.error(other) ** 2 - self.error(model) ** 2
        return (problem, other) if lost <= self.config.tie_share * won else (self.problem, model)

    def _fine(self, model: Fit, problem: Problem | None = None) -> Fit:
        fine = fit(problem or self.problem, self.fit_to, model.names, model.values, self.config.last_steps, FINE)
        self.evaluations += fine.evaluations
        return fine

    def error(self, model: Fit) -> float:
        """Root mean square error of ``model`` on the validation recordings, in multiples of their noise floor."""
        return rms(stacked(self.problem, model.values, model.effects, self.validation))

    def squares(self, model: Fit) -> Blocks:
        """Squared errors on the validation recordings, block by block [floors²]."""
        return block_squares(self.problem, model, self.validation)

    def errors(self, values: Values, effects: Sequence[Effect], test: Sequence[Recording]) -> dict[str, float]:
        """fit, validation and, if there are any, test → RMS error [floors]."""
        uses = {"fit": self.fit_to, "validation": self.validation, "test": list(test)}
        return {use: rms(stacked(self.problem, values, effects, recs)) for use, recs in uses.items() if recs}

    def at_floor(self, model: Fit) -> bool:
        """Whether neither the validation nor the fit recordings have an error that another effect could explain. Where effects
        were added, an error up to ``little`` counts as the floor if it is ``little_share`` of what they removed: equations of
        a robot differ from the twin's by more than that."""
        c, error = self.config, self.error(model)
        if error <= c.stop_at and model.error <= c.stop_fit_at:
            return True
        is_little = len(model.names) > len(self.present) and max(error, model.error) <= c.little
        return is_little and error**2 - 1.0 <= c.little_share * self.first_error**2
