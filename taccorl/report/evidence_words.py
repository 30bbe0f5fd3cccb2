"""Texts of a diagnosis, the same in the terminal and on the page."""

import shlex
from collections.abc import Iterable, Mapping, Sequence

from taccorl.diagnosis.search.fits import NEARLY
from taccorl.diagnosis.search.result import Diagnosis, Evidence, SearchConfig
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect

OVERWHELMING_BIC, OVERWHELMING_SCORE = 100.0, 5.0
"""Values from which on ΔBIC and the score are only shown as "more than". ΔBIC is twice the logarithm of a Bayes factor (above 10
is very strong: Kass and Raftery 1995); the score is in standard errors."""
UNJUDGED = 1.3
"""Ratio of the errors on fit and validation recordings from which on they disagree: more than the noise of another motion
causes."""
MOST_OF_IT = 0.75
"""Share of an effect's gain from which a simpler near-twin, and another effect besides, may explain the same error."""
NO_GAIN = 0.01
"""Least share of the validation squared error above the floor that counts as an improvement."""


def evidence_words(e: Evidence) -> str:
    """Strength of the evidence for an effect, by ΔBIC on the recordings that it was fitted to, gain and standard errors on
    validation recordings: ``overwhelming``, ``strong``, ``few places`` if it removes most of the error in too few half
    seconds for ``SearchConfig.min_score``, ``weak`` if the search would not add the effect, ``none`` if it removes no error."""
    if e.gain < NO_GAIN or e.bic <= 0:
        return "none"
    if e.unsure or SearchConfig().refusal(e.gain, e.score, e.bic):
        return "weak"
    if e.score < SearchConfig().min_score:
        return "few places"
    return (
        "overwhelming"
        if e.bic >= OVERWHELMING_BIC and e.score >= OVERWHELMING_SCORE
        else "strong"
    )


def unjudged(d: Diagnosis, short: Mapping[str, Sequence[str]] | None = None) -> str:
    """Text on fit and validation recordings that disagree after the fit; empty if they agree. ``short``: fit, validation →
    variables, such as velocity, whose range in the recordings of the other use its own do not cover; None if not known."""
    fit, validation = d.errors["after"]["fit"], d.errors["after"]["validation"]
    if fit > UNJUDGED * max(validation, 1.0):
        return (
            f"the recordings that were fitted keep {fit:.2f} noise floors, those that validate {validation:.2f}: something acts "
            f"there that no validation recording shows; {_to_mark('validation', short)}"
        )
    if validation > UNJUDGED * max(fit, 1.0):
        return (
            f"the recordings that validate keep {validation:.2f} noise floors, those that were fitted {fit:.2f}: something acts "
            f"there that no fit recording shows; {_to_mark('fit', short)}"
        )
    return ""


def _to_mark(use: str, short: Mapping[str, Sequence[str]] | None) -> str:
    """What to mark for a use, by what its recordings lack."""
    if short is None:
        return f"mark one recording of each kind of motion for {use}"
    if short[use]:
        return f"mark one for {use} that reaches as far in {' and '.join(short[use])}"
    return (
        "both cover the same range of positions, velocities and commanded accelerations"
    )


def may_be_two(d: Diagnosis) -> str:
    """Sentence on an added effect in whose place two simpler ones may act, as a near-twin with fewer numbers removes the share
    ``MOST_OF_IT`` of the error that it removes; empty if there is none. The search itself tries ``Effect.reduces_to``."""
    for found in d.rounds:
        cls = effect_class(found.added) if found.added in d.names else None
        if cls is None:
            continue
        own = next(e for e in found.evidence if e.name == found.added)
        for e in found.evidence:
            simpler = len(e.values) < len(own.values) and e.name in {
                *cls.near_twins,
                *cls.equals_when_wide,
            }
            others = {*d.rivals.get(own.name, ()), *cls.reduces_to, *d.names}
            if (
                simpler
                and own.gain > 0.0
                and e.name not in others
                and e.gain >= MOST_OF_IT * own.gain
            ):
                return (
                    f"{own.name} may be {e.name}, which by itself removes {e.gain:.0%} of the error, and another effect: check "
                    f"with --without=[{own.name}] --until=noise_floor"
                )
    return ""


def last_refit_words(d: Diagnosis) -> str:
    """Sentence with two validation errors: that at the end of the last round of the search, and that of the result, whose numbers
    were fitted once more after it. Empty if both round to the same two decimals, or if the search added nothing."""
    last, after = d.steps[-1][1], d.errors["after"]["validation"]
    if not d.steps[-1][0] or f"{last:.2f}" == f"{after:.2f}":
        return ""
    return f"The last round ended at {last:.2f} noise floors. The result was fitted once more, to the end: {after:.2f}."


def may_stand_in(d: Diagnosis) -> str:
    """Text on the effects that a search added although the error did not reach the noise floor: they may stand in for an effect
    that is not known. Empty if it was reached, or if nothing was added."""
    names = [e.name for e in d.effects if e.name not in d.present]
    if d.status not in ("something_else", "not_converged") or not names:
        return ""
    left = d.errors["after"]["validation"]
    surest = (
        f"; {names[0]}, which was added first, is the surest" if len(names) > 1 else ""
    )
    return f"{left:.2f} noise floors remain, so {', '.join(names)} may stand in for an effect that is not known{surest}"


def untested_words(d: Diagnosis) -> str:
    """Text on the added effects that leave the test error as it is; empty if there are none."""
    after = d.errors["after"].get("test")
    if after is None or not d.untested:
        return ""
    changes = ", ".join(
        f"{name} ({d.test_without[name]:.2f} without it, {after:.2f} with it)"
        for name in d.untested
    )
    return f"test recordings gain nothing by {changes}: they lack what it acts on, or it stands in for another effect"


def unit_words(unit: str) -> str:
    """Unit to print behind a number, with a space before it; empty for a dimensionless one ("1")."""
    return "" if unit == "1" else f" {unit}"


def excite_command(part: str, names: Sequence[str]) -> str:
    """Command line (``taccorl excite …``) that plans a recording which separates the effects ``names`` of a joint, an axis, pads
    or a sensor of cells; empty for effects that are in no registry."""
    effects = f"--effects={','.join(names)}"
    if part.endswith(" pads"):
        return f"taccorl excite --pads={part.removesuffix(' pads')} {effects}"
    if "_joint" in part or _all_of("joint", names):
        return f"taccorl excite {shlex.quote(part)} {effects}"
    return f"taccorl excite {effects}" if _all_of("cells", names) else ""


def _all_of(kind: str, names: Sequence[str]) -> bool:
    """Whether all effects ``names`` act on this kind of part; False without any."""
    return bool(names) and all(
        cls is not None and kind in cls.kinds() for cls in map(effect_class, names)
    )


def recording_word(part: str, names: Sequence[str]) -> str:
    """Word for what is recorded to separate the effects ``names``: a press of pads and cells, otherwise a motion."""
    return "press" if part.endswith(" pads") or _all_of("cells", names) else "motion"


def separable(d: Diagnosis, name: str, others: Iterable[str]) -> tuple[str, ...]:
    """Those of ``others`` that some motion separates from the effect ``name``, beside the numbers that were fitted."""
    cls = effect_class(name) if "torque_ff" in d.base else None
    same = () if cls is None else cls.same_with_torque_ff
    return tuple(
        other
        for other in others
        if other not in same and not nested_words(d, name, other)
    )


def nested_words(d: Diagnosis, one: str, other: str) -> str:
    """Sentence on two effects of which one is the other with one more number (``Effect.reduces_to``), whose interval holds the
    value at which both are the same; empty if they are not."""
    for simple, general in ((one, other), (other, one)):
        cls = effect_class(general)
        for p in cls.parameters() if cls is not None else ():
            key = (
                f"{general}.{p.name}"
                if cls is not None and p.name == cls.reduces_to.get(simple)
                else ""
            )
            ends = next(
                (o.intervals[key] for o in (*d.offers, d) if key in o.intervals), None
            )
            if ends is not None and ends[0] <= p.low + NEARLY:
                same = f"{general} is {simple} with one more number, {p.name}, of which {ends[0]:.2g} … {ends[1]:.2g} is known"
                return f"{same}: at {p.low:g} both are the same, and no motion separates them. Take {simple}."
    return ""


def plannable(d: Diagnosis, name: str, others: Iterable[str]) -> list[str]:
    """Those of ``others`` that ``taccorl excite`` can separate from ``name``: none is in the file, the search has tried both."""
    tried = {
        n
        for r in d.rounds[:1]
        for n in (*(e.name for e in r.evidence), *r.not_refitted)
    }
    apart = () if name in d.present else separable(d, name, others)
    return [
        n
        for n in apart
        if effect_class(n) and n not in d.present and (name not in tried or n in tried)
    ]


def inseparable_words(d: Diagnosis, name: str, others: Sequence[str]) -> str:
    """Sentence on those of ``others`` that no motion separates from the effect ``name``; empty if there are none."""
    apart = separable(d, name, others)
    same = [other for other in others if other not in apart]
    nested = [words for other in same if (words := nested_words(d, name, other))]
    same = [other for other in same if not nested_words(d, name, other)]
    alike = (
        f"No motion separates {name} from {', '.join(same)}: with the fitted torque_ff they give the same positions. Only "
        "recorded efforts may, unless these recordings have them. Take either."
    )
    return " ".join([*[alike] * bool(same), *nested])


def effect_class(name: str) -> type[Effect] | None:
    """Class of a registered effect; None for an effect that only a problem defines."""
    try:
        return effects.get(name)
    except TaccorlError:
        return None
