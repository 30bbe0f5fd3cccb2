"""Criteria by which the search accepts an effect, and the result that it hands to verdicts and reports."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from taccorl.diagnosis.search.fit import Fit
from taccorl.diagnosis.search.problem import Values
from taccorl.sim.effects.effect import Effect

Status = Literal["nothing_missing", "gains_moved", "at_floor", "something_else", "too_many", "not_converged"]
WORDS: dict[Status, str] = {
    "nothing_missing": "nothing is missing: the error is at the noise floor, or little above it and no effect explains the rest",
    "gains_moved": "at the noise floor without any effect, but only with gains far from the twin's",
    "at_floor": "at the noise floor",
    "something_else": "something else: structure remains that no known effect explains",
    "not_converged": "not converged: the numbers were still moving, so nothing follows from the error",
    "too_many": "stopped: as many effects as were allowed, and not at the noise floor",
}


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Acceptance criteria of an effect. The values are choices, checked in docs/diagnosis.md."""

    stop_at: float = 1.3
    """Validation error in noise floors at which nothing more is looked for,"""
    stop_fit_at: float = 1.5
    """if the error of the fit recordings is at most this: a sampled control loop, with nothing missing, leaves up to 1.45."""
    little: float = 1.5
    """Where no effect is accepted, fit and validation errors up to so many floors say that nothing is missing: the floor itself
    is known only to some tenths."""
    min_gain: float = 0.10
    """Of the validation error squared that lies above the floor, an effect must take away so much,"""
    min_score: float = 2.0
    """by so many standard errors between blocks,"""
    sure_gain: float = 0.5
    """or so much of it: rare events (a limit that is reached twice) never get a great score,"""
    min_bic: float = 10.0
    """and lower the Bayesian information criterion by so much on the fit recordings; those that are sure on the validation ones
    by both measures above need only lower it at all."""
    tie_share: float = 0.05
    """Effects that take away as much but for this share are ties,"""
    tie_rise: float = 0.25
    """if what they leave is greater by no more than this share (of squares: 12 % of the error); so are,"""
    wide_tie_share: float = 0.2
    """up to this share, those whose blocks do not differ by ``min_score``."""
    simpler: float = 1.1
    """Of ties the one with the fewest parameters is taken if what it leaves, squared, is at most so many times the least."""
    from_tie: float = 0.25
    """Where the search ended above the floor, a search from a tie of an added effect replaces it if what that leaves, squared, is
    below this share: half of the error."""
    max_effects: int = 4
    num_refitted: int = 12
    """Effects that are refitted after the screening: the true one was among the first 12 in every case (research §4.4)."""
    first_steps: int = 5
    """Of the refits that find out which of them are worth more;"""
    num_finished: int = 2
    """so many are refitted to the end, from several starts, so are"""
    num_likely: int = 2
    """so many that the screening put first, and those whose error is within"""
    near_best: float = 1.3
    """times the best."""
    steps: int = 30
    """Most steps of the least-squares solver in such a refit."""
    last_steps: int = 100
    """Of the last refit of what was found, with finer slopes."""

    def refusal(self, gain: float, score: float, bic: float) -> str:
        """Reason why an effect is not accepted; empty if it is."""
        sure = gain >= self.sure_gain and score >= self.min_score
        if bic < (0.0 if sure else self.min_bic):
            return self.too_little(gain, score) or f"does not pay for its parameters: ΔBIC {bic:.0f}"
        return self.too_little(gain, score)

    def too_little(self, gain: float, score: float) -> str:
        """Reason why an effect with this gain is not accepted; empty if it is."""
        if gain < self.min_gain:
            return f"takes away {max(gain, 0.0):.0%} of what lies above the floor, less than {self.min_gain:.0%}"
        if score < self.min_score and gain < self.sure_gain:
            return f"no more than chance: {score:.1f} standard errors"
        return ""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Evidence for one effect in one round of the search."""

    name: str
    values: Values
    """The effect's own."""
    base: Values
    """All other numbers, refitted with it."""
    explained: float
    """Share of the residual that its probe explained, before any refit."""
    fit_error: float
    validation_error: float
    """RMS in floors, after refitting everything."""
    gain: float
    """Share of the validation squared error above the floor that goes away."""
    score: float
    """That gain over its standard error between half-second blocks."""
    bic: float
    at_bound: tuple[str, ...]
    trouble: str
    verdict: str
    """In words: accepted, tied with, too little, no more than chance …"""
    units: Mapping[str, str] = field(default_factory=dict)
    """Of ``values``: of a slide N and m."""


@dataclass(frozen=True, kw_only=True)
class Round:
    """One search for one more effect."""

    evidence: tuple[Evidence, ...]
    """Best first."""
    not_refitted: tuple[str, ...]
    added: str | None
    ties: tuple[str, ...]
    """Effects that explain as much as the added one, without it."""
    validation_error: float
    """Afterwards."""
    fit_error: float


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Result of a search: missing effects, evidence, ties and remarks."""

    status: Status
    effects: tuple[Effect, ...]
    """To be added to the twin, with intervals and evidence."""
    present: tuple[str, ...]
    """Those of ``effects`` that the twin had from the beginning."""
    base: Values
    """The always fitted numbers, refitted with the effects."""
    start: Values
    """The same before anything was added."""
    intervals: dict[str, tuple[float, float]]
    rounds: tuple[Round, ...]
    rivals: dict[str, tuple[str, ...]]
    """Added effect → effects that do as well in its place: these recordings do not tell which it is."""
    twins: dict[str, dict[str, str]]
    """Added effect → its near-twins by nature and what would tell them apart."""
    removed: tuple[str, ...]
    """Accepted and later found superfluous."""
    swapped: tuple[tuple[str, str], ...]
    errors: dict[str, dict[str, float]]
    """``before`` (with the start numbers as given), ``fitted`` (numbers fitted, no effect) and ``after`` → fit, validation, test
    in floors. Test recordings were not looked at for any choice."""
    steps: tuple[tuple[str, float], ...]
    """(what was added, validation error in floors) for the waterfall."""
    remarks: tuple[str, ...]
    """What else must be known about the result, a sentence each."""
    at_bound: tuple[str, ...]
    trouble: str
    evaluations: int
    cpu_s: float
    before: Fit = field(repr=False)
    after: Fit = field(repr=False)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(effect.name for effect in self.effects)

    @property
    def words(self) -> str:
        return WORDS[self.status]
