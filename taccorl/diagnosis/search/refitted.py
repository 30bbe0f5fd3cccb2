"""One effect that was refitted beside a model: its numbers, and whether validation recordings support it."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from taccorl.diagnosis.search.evidence import Blocks, bic_gain, block_squares, gain_of, standard_score
from taccorl.diagnosis.search.fit import Fit, rms, stacked
from taccorl.diagnosis.search.identifiable import not_told_from_none
from taccorl.diagnosis.search.problem import Problem, Recording
from taccorl.diagnosis.search.result import Evidence, SearchConfig
from taccorl.diagnosis.search.screen import Probe


class Refitted:
    """One refitted effect beside its parent, on the validation recordings."""

    def __init__(
        self,
        problem: Problem,
        validation: Sequence[Recording],
        config: SearchConfig,
        parent: Fit,
        before: Blocks,
        model: Fit,
        seen: Probe,
        others: Mapping[str, Fit],
    ) -> None:
        """
        Args:
            validation: recordings by which effects are chosen.
            parent: the fit without the effect.
            before: squares of ``parent`` on these recordings [floors²].
            model: the fit with the effect, which is the last of its names.
            seen: what the screening said of the effect.
            others: effects that are refitted in the same round → their fits; may be filled later.
        """
        self.name, self.model, self.seen, self._config = model.names[-1], model, seen, config
        self._others, self._parent = others, parent
        self.squares = block_squares(problem, model, validation)
        self.validation_error = rms(stacked(problem, model.values, model.effects, validation))
        better = before - self.squares
        self.gain = gain_of(better, before)
        self.score = standard_score(better)
        self.candidate = problem.candidates[self.name]
        self.num_parameters = self.candidate.num_parameters
        self.bic = bic_gain(parent, model, self.num_parameters)

    def refused(self) -> str:
        """Why it is not believed; empty if it is."""
        return self._too_little() or self._not_told()

    def _too_little(self) -> str:
        return self.at_its_end() or self._config.refusal(self.gain, self.score, self.bic)

    def _not_told(self) -> str:
        sure = self.gain >= self._config.sure_gain
        return "" if sure else not_told_from_none(self.model, self.name, left_over=False)

    def at_its_end(self) -> str:
        """Why the fitted numbers are those of no effect, or of another one; empty if they are not."""
        cls = self.candidate.cls
        for name, shape in cls.reduces_to.items():
            if self._at_bound(shape) == "low" and self._is_no_more_than(name):
                return f"with {shape} at {self.model.values[f'{cls.name}.{shape}']:.3g} it is {name}"
        for name, shape in cls.equals_when_wide.items():
            value, high = (
                self.model.values[f"{cls.name}.{shape}"],
                next(p.high for p in cls.parameters() if p.name == shape),
            )
            if value > 0.9 * high and self._is_no_more_than(name):
                return f"with {shape} at {value:.3g} it is {name}"
        for p in cls.parameters():
            side = self._at_bound(p.name)
            if not side:
                continue
            value = f"{p.name} {self.model.values[f'{cls.name}.{p.name}']:.3g}{f' {p.unit}' * (p.unit != '1')}"
            if p.absent == (p.low if side == "low" else p.high):
                return f"no effect: the fit ends at {value}, where it is absent"
            if side == "high" and p.absent == np.inf:
                return f"the fit ends at the weakest effect of its range, {value}"
        # Of an effect with several numbers another one makes up for the end: a mass and its place.
        alone = len(self.candidate.frees) == 1
        ended = [f for f in self.model.ended if alone and f.name == self.candidate.frees[0].name]
        ended += [f for f in self.model.fled if f.name not in self._parent.at_bound]
        if ended:
            numbers = [f"{f.name} {self.model.values[f.name]:.3g}{f' {f.unit}' * (f.unit != '1')}" for f in ended]
            return f"no explanation: the fit ends with {' and '.join(numbers)} at the end of its range"
        return ""

    def _is_no_more_than(self, simpler: str) -> bool:
        """Whether the effect ``simpler`` explains about as much, or was not tried: this one may have further parameters. Where
        the model without this one has the simpler one already, that model is compared."""
        other = self._parent if simpler in self._parent.names else self._others.get(simpler)
        return other is None or other.error <= self._config.near_best * max(self.model.error, 1.0)

    def _at_bound(self, parameter: str) -> Literal["", "low", "high"]:
        """At which end of its range a parameter of the effect was fitted."""
        name = f"{self.candidate.name}.{parameter}"
        if name not in self.model.at_bound:
            return ""
        free = next(f for f in self.model.frees if f.name == name)
        place, low, high = (free.coordinate(x) for x in (self.model.values[name], free.low, free.high))
        return "low" if place - low < high - place else "high"

    def evidence(self, verdict: str) -> Evidence:
        """What a report says of the effect, with the ``verdict`` of the search on it (a text such as ``added``)."""
        own = f"{self.name}."
        fitted = {f.name: self.model.values[f.name] for f in self.model.frees}
        return Evidence(
            name=self.name,
            values={k: v for k, v in fitted.items() if k.startswith(own)},
            base={k: v for k, v in fitted.items() if not k.startswith(own)},
            explained=self.seen.explained,
            fit_error=self.model.error,
            validation_error=self.validation_error,
            gain=self.gain,
            score=self.score,
            bic=self.bic,
            at_bound=tuple(name for name in self.model.at_bound if name.startswith(own)),
            trouble=self.model.trouble,
            verdict=verdict,
            unsure=not self._too_little() and bool(self._not_told()),
            units={f.name: f.unit for f in self.model.frees if f.name.startswith(own)},
        )
