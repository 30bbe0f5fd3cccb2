"""What the evidence of a search says about effects: how strong it is, which of them some
motion separates, and which may be two simpler ones."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from taccorl.diagnosis.comparison.regimes import RegimeError
from taccorl.diagnosis.search.fits import NEARLY
from taccorl.diagnosis.search.identifiability import Identifiability
from taccorl.diagnosis.search.identifiable import Known
from taccorl.diagnosis.search.result import Diagnosis, Evidence, SearchConfig
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect

OVERWHELMING_BIC, OVERWHELMING_SCORE = 100.0, 5.0
"""Values from which on evidence is overwhelming. ΔBIC is twice the logarithm of a Bayes
factor (above 10 is very strong: Kass and Raftery 1995); the score is in standard errors."""
MOST_OF_GAIN = 0.75
"""Share of an effect's gain from which a simpler near-twin, and another effect besides, may
explain the same error."""
NO_GAIN = 0.01
"""Least share of the validation squared error above the floor that is an improvement."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What is known about the recordings of one part, beside the diagnosis."""

    can_tell: Identifiability | None = None
    """Effects that they can show and separate."""
    known: Known | None = None
    """Its numbers, if they were divided into identified and other ones."""
    errors: Sequence[str] = ()
    """Errors of the checks, which come before any effect."""
    led: tuple[int, int] = (0, 0)
    """Recordings whose clock may lead in place of an added effect, and all of them."""
    drifts: Sequence[Any] = ()
    """Numbers that changed between recordings of one motion (``search.drift``)."""
    remarks: Sequence[str] = ()
    repeated: bool = False
    """The noise floor includes what differs between repeats."""
    floor: str = ""
    """The noise floor as text."""
    numbers: str = ""
    """Text on which numbers are always fitted."""
    judged_by: Sequence[str] = ()
    """Recordings by whose error effects are chosen."""
    floor_unknown: str = ""
    """Text on a noise floor that is not known; empty if it is."""
    short: Mapping[str, Sequence[str]] | None = None
    """fit, validation → variables in which the other ones reach further, if known."""
    has_effort: bool = False
    """Efforts of the part were recorded."""
    size: Mapping[str, Any] | None = None
    """Error in units: ``kind``, ``before``, ``after`` and ``nrmse``, if it is known."""
    worst: RegimeError | None = None
    """Recording and regime with the largest error after the fit, if known."""
    plans: bool = True
    """Whether a motion can be planned: not if the position is the input."""
    options: Sequence[str] = ()
    """Of commands, such as ``--twin=twin.yaml``."""


def added(d: Diagnosis) -> tuple[str, ...]:
    """Names of the effects that were added, which the twin lacked."""
    return tuple(name for name in d.names if name not in d.present)


def grade(e: Evidence) -> str:
    """Strength of the evidence for an effect, by ΔBIC on the fit recordings, gain and
    standard errors on validation recordings: ``overwhelming``, ``strong``, ``few places``
    if it removes most of the error in too few half seconds for ``SearchConfig.min_score``,
    ``weak`` if the search would not add the effect, ``none`` if it removes no error."""
    if e.gain < NO_GAIN or e.bic <= 0:
        return "none"
    if e.unsure or SearchConfig().refusal(e.gain, e.score, e.bic):
        return "weak"
    if e.score < SearchConfig().min_score:
        return "few places"
    if e.bic >= OVERWHELMING_BIC and e.score >= OVERWHELMING_SCORE:
        return "overwhelming"
    return "strong"


def effect_class(name: str) -> type[Effect] | None:
    """Class of a registered effect; None for an effect that only a problem defines."""
    try:
        return effects.get(name)
    except TaccorlError:
        return None


def undetermined(d: Diagnosis) -> list[str]:
    """Names of the added effects none of whose numbers the recordings determine."""
    known = {n.partition(".")[0] for n in d.intervals if n not in d.undetermined}
    unknown = {n.partition(".")[0] for n in d.undetermined} - known
    return [n for n in d.names if n in unknown and n not in d.present]


def simpler_twin(d: Diagnosis) -> dict[str, Any]:
    """An added effect in whose place two simpler ones may act, as a near-twin with fewer
    numbers removes the share ``MOST_OF_GAIN`` of the error that it removes; empty if there
    is none. The search itself tries ``Effect.reduces_to``."""
    for found in d.rounds:
        cls = effect_class(found.added) if found.added in d.names else None
        if cls is None:
            continue
        own = next(e for e in found.evidence if e.name == found.added)
        named = {*d.rivals.get(own.name, ()), *cls.reduces_to, *d.names}
        alike = {*cls.near_twins, *cls.equals_when_wide} - named
        for e in found.evidence:
            is_simpler = e.name in alike and len(e.values) < len(own.values)
            if is_simpler and e.gain >= MOST_OF_GAIN * own.gain > 0.0:
                return {"effect": own.name, "simpler": e.name, "share": e.gain}
    return {}


class Nested(NamedTuple):
    """Two effects of which one is the other with one more number."""

    simple: str
    general: str
    number: str
    """Name of that number,"""
    at: float
    """its value at which both are the same, which its interval holds,"""
    low: float
    high: float
    """and the ends of the interval."""


def nested(d: Diagnosis, one: str, other: str) -> Nested | None:
    """Whether one of two effects is the other with one more number
    (``Effect.reduces_to``), whose interval holds the value at which both are the same."""
    for simple, general in ((one, other), (other, one)):
        cls = effect_class(general)
        for p in cls.parameters() if cls is not None else ():
            if cls is None or p.name != cls.reduces_to.get(simple):
                continue
            key = f"{general}.{p.name}"
            for fit in (*d.offers, d):
                if key in fit.intervals and fit.intervals[key][0] <= p.low + NEARLY:
                    return Nested(simple, general, p.name, p.low, *fit.intervals[key])
                if key in fit.intervals:
                    break
    return None


def separable(d: Diagnosis, name: str, others: Iterable[str]) -> tuple[str, ...]:
    """Those of ``others`` that some motion separates from the effect ``name``, beside the
    numbers that were fitted."""
    cls = effect_class(name) if "torque_ff" in d.base else None
    same = () if cls is None else cls.same_with_torque_ff
    return tuple(o for o in others if o not in same and nested(d, name, o) is None)


def plannable(d: Diagnosis, name: str, others: Iterable[str]) -> list[str]:
    """Those of ``others`` that ``taccorl excite`` can separate from ``name``: none is in
    the file, and the search has tried both."""
    tried = set[str]()
    for r in d.rounds[:1]:
        tried |= {*(e.name for e in r.evidence), *r.not_refitted}
    if name in d.present:
        return []
    apart = [n for n in separable(d, name, others) if n not in d.present]
    return [n for n in apart if effect_class(n) and (name not in tried or n in tried)]
