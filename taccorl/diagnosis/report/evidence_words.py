"""Text of a diagnosis, the same in the terminal and on the page."""

from collections.abc import Sequence

from taccorl.diagnosis.search.result import Diagnosis, Evidence, SearchConfig
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect

OVERWHELMING_BIC, OVERWHELMING_SCORE = 100.0, 5.0
"""ΔBIC, twice the logarithm of a Bayes factor (above 10 is very strong: Kass and Raftery 1995), and standard errors."""
UNJUDGED = 1.3
"""Ratio of the errors on fit and validation recordings that is remarkable: more than another motion's noise makes it."""
NO_GAIN = 0.01
"""Of the validation squared error above the floor: less is none."""


def evidence_words(e: Evidence) -> str:
    """Evidence for an effect as text: ΔBIC on the recordings that it was fitted to, gain and standard errors on validation
    recordings.

    ``weak`` is what the search would not add; ``none``: nothing goes away.
    """
    if e.gain < NO_GAIN or e.bic <= 0:
        return "none"
    if SearchConfig().refusal(e.gain, e.score, e.bic):
        return "weak"
    return "overwhelming" if e.bic >= OVERWHELMING_BIC and e.score >= OVERWHELMING_SCORE else "strong"


def unjudged(d: Diagnosis) -> str:
    """Text on the regimes in which fit and validation recordings disagree after the fit; empty if there are none.

    What shows only in the recordings that were fitted can be neither confirmed nor refused; what shows only in those that
    validate was fitted to something else.
    """
    fit, validation = d.errors["after"]["fit"], d.errors["after"]["validation"]
    if fit > UNJUDGED * max(validation, 1.0):
        return (
            f"the recordings that were fitted keep {fit:.2f} noise floors, those that validate {validation:.2f}: something acts "
            "there that no validation recording shows; mark one recording of each kind of motion for validation"
        )
    if validation > UNJUDGED * max(fit, 1.0):
        return (
            f"the recordings that validate keep {validation:.2f} noise floors, those that were fitted {fit:.2f}: something acts "
            "there that no fit recording shows; mark one recording of each kind of motion for fitting"
        )
    return ""


def unit_words(unit: str) -> str:
    """Unit to print behind a number; empty for a dimensionless one."""
    return "" if unit == "1" else f" {unit}"


def excite_command(part: str, names: Sequence[str]) -> str:
    """Command that plans a recording which separates effects of a joint or of pads; empty for any other part."""
    where = part if "_joint" in part else f"--pads={part.removesuffix(' pads')}" if part.endswith(" pads") else ""
    return f"taccorl excite {where} --effects={','.join(names)}" if where else ""


def to_record(part: str, name: str, rivals: Sequence[str]) -> list[str]:
    """Recording that would separate an effect from its rivals: a command for a joint or pads, a description for other parts."""
    command = excite_command(part, (name, *rivals))
    if command:
        return [command]
    return list(dict.fromkeys(cls.to_record for other in (name, *rivals) if (cls := effect_class(other))))


def effect_class(name: str) -> type[Effect] | None:
    """None: an effect of a problem outside the registry, such as a one-axis drive's own."""
    try:
        return effects.get(name)
    except TaccorlError:
        return None
