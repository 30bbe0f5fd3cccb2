"""Criteria by which the search accepts an effect, and the result for verdicts and reports."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from taccorl.diagnosis.search.fit import Fit
from taccorl.diagnosis.search.plain import PlainFit
from taccorl.diagnosis.search.problem import Values
from taccorl.diagnosis.search.standing_out import Place
from taccorl.sim.effects.effect import Effect

Status = Literal[
    "nothing_missing",
    "numbers_off",
    "gains_moved",
    "at_floor",
    "something_else",
    "too_many",
    "not_converged",
]
"""How a search ended; ``WORDS`` explains each value."""
WORDS: dict[Status, str] = {
    "nothing_missing": "nothing is missing: the error is at the noise floor, or little above it and no effect explains the rest",
    "numbers_off": "numbers of the file are off: refitted, they bring the error to the noise floor",
    "gains_moved": "at the noise floor without any effect, but only with gains far from the twin's",
    "at_floor": "at the noise floor",
    "something_else": "something else: structure remains that no known effect explains",
    "not_converged": "not converged: the numbers were still moving, so nothing follows from the error",
    "too_many": "stopped above the noise floor at the largest number of added effects: 1, or 4 with --until=noise_floor",
}
"""Status → text for reports."""


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Thresholds by which the search accepts an effect. They are choices; docs/diagnosis.md: how often it is right."""

    floor: float = 1.3
    """Validation error [noise floors] at or below which the search ends, provided that the fit error is at most ``little``: the
    floor is known to some tenths."""
    little: float = 1.5
    """Largest fit error [noise floors] at which the search may end: a sampled control loop without a missing effect leaves up to
    1.45. If no effect is accepted, fit and validation errors up to this mean that nothing is missing."""
    little_share: float = 0.002
    """Share of the squared error that may remain, up to ``little``, where effects removed the rest: 1.4 floors of 22 or more."""
    min_gain: float = 0.10
    """Least share of the validation squared error above the floor that a better model removes: less is within what the floor and
    the twin's equations leave open."""
    min_score: float = 2.0
    """Least improvement of a better model in standard errors between blocks, but for ``sure_gain``; 2 are hardly chance."""
    sure_gain: float = 0.5
    """Share for which ``min_score`` is not required: an effect that acts rarely (a limit that is reached twice) never gets a high
    score."""
    sure_score: float = 3.0
    """Standard errors from which a tenth of the error is told whatever the model leaves besides: neither the interval of the
    strength nor ``min_bic`` speaks against it."""
    min_bic: float = 10.0
    """Least decrease of the Bayesian information criterion on the fit recordings for a model with more numbers: strong evidence
    (Kass and Raftery 1995). Any decrease suffices where ``sure_gain`` or ``sure_score`` is reached."""
    width: int = 2
    """Number of models that the search extends at each depth."""
    max_effects: int = 4
    """Most effects that the search adds."""
    last_steps: int = 100
    """Most steps of the solver in the last refit of the result, with finer finite differences."""

    def refusal(self, gain: float, score: float, bic: float) -> str:
        """Text: why a model is not better; empty if it is. ``gain, score, bic``: as in ``Evidence``."""
        if gain < self.min_gain:
            return f"takes away {max(gain, 0.0):.1%} of what lies above the floor, less than {self.min_gain:.0%}"
        if score < self.min_score and gain < self.sure_gain:
            return f"no more than chance: {score:.2f} standard errors, less than {self.min_score:g}"
        if bic < (
            0.0 if gain >= self.sure_gain or score >= self.sure_score else self.min_bic
        ):
            return f"improves the fit too little for its number of parameters: ΔBIC {bic:.0f}"
        return ""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Evidence for one effect in one round of the search."""

    name: str
    values: Values
    """Values of the effect's own parameters."""
    base: Values
    """Values of all other fitted numbers, refitted together with the effect."""
    explained: float
    """Share of the squared residual, 0 … 1, that the best multiple of the effect's change at its start value removes, before any
    number is refitted."""
    fit_error: float
    """RMS on the fit recordings after refitting everything [floors]."""
    validation_error: float
    """Validation RMS after refitting everything [floors]."""
    gain: float
    """Share of the validation squared error above the floor that the effect removes."""
    score: float
    """Share of the validation error that it removes (``gain``), divided by its standard error between half-second blocks."""
    bic: float
    """Decrease of the Bayesian information criterion on the fit recordings; 10 is strong evidence."""
    at_bound: tuple[str, ...]
    """Names of the numbers that ended at one of their bounds."""
    trouble: str
    """Reason why the refit did not converge; empty if it did."""
    verdict: str
    """Text of the decision: accepted, tied with, too little, no more than chance …"""
    units: Mapping[str, str] = field(default_factory=dict)
    """Parameter → unit of its entry in ``values``; for a slide N and m."""
    unsure: bool = False
    """True: it was refused because the 95 % interval of its strength holds the value at which it is absent."""


@dataclass(frozen=True, kw_only=True)
class Round:
    """One depth of the search: what was tried beside the effects of the result that came before."""

    evidence: tuple[Evidence, ...]
    """Evidence for each refitted effect, best first."""
    not_refitted: tuple[str, ...]
    """Names of effects that the screening ranked too low for a refit."""
    added: str | None
    """Name of the effect that was added; None if none was accepted."""
    ties: tuple[str, ...]
    """Those of ``Diagnosis.rivals`` of the added effect that were tried in this round."""
    validation_error: float
    """Validation error after the round [floors]."""
    fit_error: float
    """Fit error after the round [floors]."""


@dataclass(frozen=True, kw_only=True)
class Changed:
    """A number that the machine's file states, and whose refit removes a part of the error (``changed_numbers``)."""

    name: str
    """Name: ``coulomb_friction.torque_nm``, ``inertia``."""
    before: float
    """Value in the file; infinite for one that it does not state, ``loop_hz``."""
    after: float
    unit: str
    """Unit of both; "1" if dimensionless."""
    without: float
    """Validation error [floors] with this number as the file has it and the others refitted."""
    instead: tuple[str, ...] = ()
    """``effort_scale``, if a factor on all efforts explains as much as another inertia; else empty."""
    ties: tuple[str, ...] = ()
    """Texts, each of another number of the file and its change that explain as much in place of this one."""

    @property
    def was(self) -> str:
        """``before`` as text."""
        return f"{self.before:.4g}" if math.isfinite(self.before) else "(not stated)"

    @property
    def effect(self) -> str:
        """Effect of the file that has the number; empty for a number of the drive or the axis."""
        return self.name.rpartition(".")[0]


@dataclass(frozen=True, kw_only=True)
class Offer:
    """A fit of a part of what was found, or with an effect that ties, which ``taccorl add-effect`` can write. All that was found
    together is the ``Diagnosis`` itself, whose fields have the same names."""

    added: tuple[str, ...]
    """Effects that the file does not have: exactly these were fitted beside those that it has."""
    effects: tuple[Effect, ...]
    """Effects of the fit, those of the file included, with intervals and evidence."""
    base: Values
    """The always fitted numbers."""
    intervals: dict[str, tuple[float, float]]
    """Fitted number → (low, high) of its 95 % interval."""
    errors: dict[str, float]
    """fit, validation, test → RMS error [floors]."""
    at_bound: tuple[str, ...]
    """Names of the numbers that are at one of their bounds."""
    undetermined: tuple[str, ...]
    """Names of the numbers that the recordings leave open over their whole range."""


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Result of a search: missing effects, evidence, ties and remarks."""

    status: Status
    """How the search ended."""
    effects: tuple[Effect, ...]
    """Effects to add to the twin, with intervals and evidence."""
    present: tuple[str, ...]
    """Names of those of ``effects`` that the twin had from the beginning."""
    base: Values
    """The always fitted numbers, refitted with the effects."""
    start: Values
    """The always fitted numbers before anything was added."""
    changed: tuple[Changed, ...] = ()
    """Numbers of the file whose refit removes a part of the error."""
    intervals: dict[str, tuple[float, float]]
    """Fitted number → (low, high) of its 95 % interval, in its unit."""
    rounds: tuple[Round, ...]
    """One for each effect of the result, the one that explains most first; another one if no effect was accepted beside them."""
    rivals: dict[str, tuple[str, ...]]
    """Added effect → other effects that fit these recordings as well in its place, among them more general forms of it, which
    have more parameters."""
    or_number: tuple[str, float] = ("", 1.0)
    """Number of the file that explains as much as the added effects, ``effort_scale`` or ``kd``, and the factor by which it is
    off then; empty if none does."""
    or_in: tuple[str, ...] = ()
    """Other bodies of the model in which the added ``payload`` explains as much."""
    twins: dict[str, dict[str, str]]
    """Added effect → its near-twins by nature, each with the recording that would separate them."""
    removed: tuple[str, ...]
    """Effects that were superfluous after the last refit."""
    errors: dict[str, dict[str, float]]
    """RMS errors [floors]: ``before`` (with the given start values), ``fitted`` (numbers fitted, no effect) and ``after`` → fit,
    validation, test. No choice depends on test recordings."""
    plain: PlainFit | None = None
    """One fit of the usual numbers of a drive, beside which ``errors["after"]`` shows what the
    added effects are worth; None for sensors, and where nothing is missing."""
    test_without: dict[str, float]
    """Added effect → test error [floors] if all others are refitted without it; empty without test recordings."""
    steps: tuple[tuple[str, float], ...]
    """(name of the added effect, validation error afterwards [floors]) for the waterfall figure."""
    remarks: tuple[str, ...]
    """Remarks about the result, a sentence each."""
    offers: tuple[Offer, ...] = ()
    """Fits of every part of what was found, and of what ties with one of its effects in its place."""
    standing_out: tuple[Place, ...] = ()
    """Regimes of recordings that stand clearly above the floor, the worst first; those of test recordings if no others do."""
    nearest: tuple[tuple[str, float], ...] = ()
    """(effect, error that it leaves [floors]) at the first of them, the least first."""
    one_pose: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Added effect whose torque depends on the position → other joints, if all of them stood in one pose in all recordings. A
    weight that the model lacks makes a like torque there."""
    at_bound: tuple[str, ...]
    """Names of the numbers of the result that are at one of their bounds."""
    undetermined: tuple[str, ...]
    """Names of the numbers that the recordings leave open over their whole range: near where they began (``settle``), or one of
    many values that fit."""
    trouble: str
    """Reason why the last fit did not converge; empty if it did."""
    cpu_s: float
    """CPU time of the search [s]."""
    before: Fit = field(repr=False)
    """Fit of the always fitted numbers without a further effect."""
    after: Fit = field(repr=False)
    """Fit with all effects of the result."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of ``effects``, in their order."""
        return tuple(effect.name for effect in self.effects)

    @property
    def baseline(self) -> Literal["before", "fitted"]:
        """Key of ``errors`` with which ``after`` is compared: ``before`` (numbers of the file) or ``fitted`` (refitted, no effect
        added), by the smaller validation error; ``fitted`` too where effects take less than a tenth away from ``before``."""
        before, fitted, after = (
            self.errors[stage]["validation"] for stage in ("before", "fitted", "after")
        )
        return (
            "fitted"
            if fitted <= before or (self.names != self.present and 0.9 * before < after)
            else "before"
        )

    @property
    def words(self) -> str:
        """Text of ``status``."""
        return WORDS[self.status]

    @property
    def untested(self) -> tuple[str, ...]:
        """Added effects without which test recordings have the same error, or a smaller one (``gains_nothing``)."""
        after = self.errors["after"].get("test", 0.0)
        return tuple(
            name
            for name, without in self.test_without.items()
            if gains_nothing(without, after)
        )


def may_go_on(d: Diagnosis) -> bool:
    """Whether the search ended only because it was to add no further effect, fewer than ``SearchConfig().max_effects``."""
    return (
        d.status == "too_many"
        and len(d.effects) - len(d.present) < SearchConfig().max_effects
    )


def gains_nothing(before: float, after: float) -> bool:
    """Whether test recordings show no improvement: less than the share of the squared error above the floor that a search asks of
    validation recordings, and of at least one squared floor.

    Args:
        before, after: RMS errors [floors].
    """
    return before**2 - after**2 < SearchConfig().min_gain * max(before**2 - 1.0, 1.0)


def of_test(before: float, after: float) -> str:
    """Text of the change of a test error [floors], such as ``14.10 → 14.10 floors: no gain``."""
    return f"{before:.2f} → {after:.2f} floors" + ": no gain" * gains_nothing(
        before, after
    )
