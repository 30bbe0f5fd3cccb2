"""Section of a report on the missing effects: evidence, ties, and effects that cannot be separated."""

from collections.abc import Sequence

from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.cell_numbers import summarised
from taccorl.diagnosis.comparison.regimes import ALL, AT_FLOOR, RegimeError, RegimeErrors
from taccorl.diagnosis.comparison.result import USES
from taccorl.diagnosis.problems.joint_problem import OF_RECORDINGS
from taccorl.diagnosis.report.evidence_words import (
    effect_class,
    evidence_words,
    last_refit_words,
    to_record,
    unit_words,
)
from taccorl.diagnosis.report.figure_style import data_uri, png
from taccorl.diagnosis.report.figures_evidence import Step, waterfall
from taccorl.diagnosis.report.verdict import Verdict, refitted_words
from taccorl.diagnosis.search.identifiability import Identifiability
from taccorl.diagnosis.search.identifiable import TIMING_S, Known
from taccorl.diagnosis.search.result import Diagnosis, Evidence, Round
from taccorl.html_page import Html, bullets, element, figure, inline, lines, note, table
from taccorl.sim.effects.effect import Effect


def first_read(v: Verdict) -> Html:
    """HTML of the first section of a report: verdict, confidence, and the next recording with its command."""
    said: list[str] = [element("b", v.finding), v.confidence, f"Record next: {v.record_next}"]
    if v.command:
        said.append(element("code", v.command))
    said += [f"Remark: {remark}" for remark in v.remarks]
    return element("div", lines(said), class_=f"verdict {v.level}")


def diagnosis_section(
    part: str,
    d: Diagnosis,
    can_tell: Identifiability | None,
    origins: Sequence[Origin],
    *,
    known: Known | None = None,
    regimes: RegimeErrors | None = None,
) -> Html:
    """HTML of the section of one diagnosed part: errors, waterfall, numbers, errors by regime, evidence of each round,
    description of effects.

    Args:
        can_tell: effects that its recordings can show and separate; None: left out.
        origins: of the recordings, for the figures' titles.
        known: numbers that its recordings identify; None: left out.
        regimes: errors by recording and regime; None: left out.
    """
    found = [e for e in d.effects if e.name not in d.present]
    named = ", ".join(e.name for e in found) or "nothing was added"
    parts = [
        element("h2", f"{part}: {named}"),
        element("div", f"{d.words}. {_errors(d)}", class_="verdict"),
    ]
    if d.trouble:
        parts.append(note(f"The last fit: {d.trouble}."))
    if d.undetermined:
        parts.append(
            note(f"Not determined by these recordings, one of many values that fit: {', '.join(d.undetermined)}.")
        )
    if d.at_bound:
        parts.append(note(f"At the end of its range: {', '.join(d.at_bound)}. Its value says little."))
    drawn = waterfall(_steps(d), origins, f"{part}: validation error, effect by effect")
    parts.append(figure(data_uri(png(drawn)), "validation error over the noise floor; down is better"))
    if known is not None:
        parts.append(_identified(known))
    parts += [_effect(part, d, e, known) for e in found]
    parts.append(_numbers(d, known))
    if regimes is not None:
        parts.append(_regimes(regimes))
    for k, r in enumerate(d.rounds, start=1):
        instead = f", in place of {r.in_place_of}" if r.in_place_of else ""
        parts += [element("h3", f"Evidence, round {k}{instead}"), _evidence(r)]
    if d.rounds:
        parts.append(
            note(
                "gain: share of the validation squared error above the floor that goes away after everything was refitted. z: "
                "that gain over its standard error between half-second blocks. Evidence: from both and ΔBIC, which must be "
                "above 10, because more parameters always fit better; it is shown when pointed at, and in report.json. Few "
                "places: most of the error goes, but in so few half seconds that z is below 2. Weak: not added, also where the "
                "95 % interval of the strength holds the value at which the effect is absent."
            )
        )
    if text := last_refit_words(d):
        parts.append(note(text))
    for name in d.removed:
        parts.append(note(f"{name} was accepted and later removed: the others made it superfluous."))
    for old, new in d.swapped:
        parts.append(note(f"{new} took the place of {old} once the others were in."))
    if can_tell is not None:
        parts += [element("h3", "What these recordings can tell"), _can_tell(can_tell)]
    return inline(*parts)


def _can_tell(found: Identifiability) -> Html:
    """Before any fit, at typical strengths."""
    said = [f"{a} and {b}: their traces are alike (|cos| {cos:.3f})" for a, b, cos in found.pairs]
    said += [
        f"{a} and {b}: only a combination of the two numbers is known (correlation {r:+.4f})"
        for a, b, r in found.ridges
    ]
    if found.invisible:
        said.append(f"would hardly show at a typical strength: {', '.join(found.invisible)}")
    return bullets(said or ["every effect would show, and none looks like another"])


def _errors(d: Diagnosis) -> str:
    said = []
    for use, words in (("validation", "validation"), ("test", "test, which no choice has seen")):
        if use in d.errors["before"]:
            before, fitted, after = (d.errors[stage][use] for stage in ("before", "fitted", "after"))
            by_effects = f", by the effects {after / fitted - 1:+.0%}"
            said.append(f"{words}: {before:.3g}, numbers refitted {fitted:.3g}, now {after:.3g} × floor{by_effects}")
    return "Error: " + "; ".join(said)


def _steps(d: Diagnosis) -> list[Step]:
    first = [Step("as given", d.errors["before"]["validation"])]
    steps = first + [Step(name or refitted_words(d), error) for name, error in d.steps]
    if d.removed or d.swapped:
        steps.append(Step("superfluous ones removed, ties tried again", d.errors["after"]["validation"]))
    elif last_refit_words(d):
        steps.append(Step("last refit", d.errors["after"]["validation"]))
    return steps


def _identified(known: Known) -> Html:
    """The primary numbers, and what pins the others."""
    rows = [[n.name, f"{n.value:.4g}{unit_words(n.unit)}", f"{n.low:.4g} … {n.high:.4g}"] for n in known.identifiable]
    text = inline(element("h3", "Identified numbers"), table(("number", "fitted", "95 %"), rows, numbers=(1, 2)))
    if known.pinned_by:
        return inline(text, note(f"The scale of the torques is fixed by {' and '.join(known.pinned_by)}."))
    remark = note(
        "Positions identify torques only over K_p: all torques of a joint times one factor move it the same way, but for its "
        f"inertia, and a control loop whose speed is up to {1e3 * TIMING_S:g} ms late looks like another inertia. Record the "
        "motor's effort, or hold a known payload, to know the absolute numbers."
    )
    return inline(text, remark)


def _numbers(d: Diagnosis, known: Known | None) -> Html:
    """The always fitted ones and those of the effects, with intervals: what the twin's file holds."""
    rows = []
    values = d.base | {f"{e.name}.{p.name}": getattr(e, p.name) for e in d.effects for p in e.parameters()}
    units = {n.name: unit_words(n.unit) for n in known.absolute} if known is not None else {}
    values, summaries = summarised(values)
    for name, value in values.items():
        low, high = d.intervals.get(name, (None, None))
        ends = "" if low is None else f"{low:.4g} … {high:.4g}"
        start = f"{d.start[name]:.4g}" if name in d.start else ""
        words = f"{name} (of the recordings, not in the twin)" if name in OF_RECORDINGS else name
        rows.append([words, start, f"{value:.4g}{units.get(name, '')}", ends])
    parts = [table(("number of the twin", "before", "fitted", "95 %"), rows, numbers=range(1, 4))]
    parts += [note(f"{name}: {words}.") for name, words in summaries.items()]
    if known is not None and not known.pinned_by and "kp" in d.base:
        parts.append(
            note(
                "Together these numbers reproduce the recordings. Their intervals include what the loop's timing leaves open."
            )
        )
    return inline(*parts)


def _regimes(found: RegimeErrors) -> Html:
    """Error after the fit, recording × regime, with the ranges that the recordings cover."""
    regimes = list(dict.fromkeys(r.regime for r in found.rows))
    cells = {(r.use, r.recording, r.regime): r for r in found.rows}
    rows, classes = [], []
    for use, recording in dict.fromkeys((r.use, r.recording) for r in found.rows):
        own = [cells.get((use, recording, regime)) for regime in regimes]
        n = cells[use, recording, ALL].n if (use, recording, ALL) in cells else 0
        name = recording or element("b", "all of them")
        rows.append([use, name, f"{n:,}", *(_ratio(r) for r in own)])
        classes.append("tie" if not recording else "")
    heads = ("use", "recording", "n", *regimes)
    parts = [
        element("h3", "Error after the fit, by recording and regime"),
        table(heads, rows, numbers=range(2, len(heads)), classes=classes),
    ]
    parts.append(
        note("RMSE over the noise floor; 1 is as good as any twin can be. Regimes with hardly a row are left out.")
    )
    ranges = [[f"{c.variable} [{c.unit}]", *(_range(c.ranges.get(use)) for use in USES)] for c in found.coverage]
    parts.append(table(("range covered", *USES), ranges, numbers=range(1, 4)))
    if found.remarks:
        parts.append(bullets(found.remarks))
    return inline(*parts)


def _ratio(r: RegimeError | None) -> str:
    if r is None:
        return ""
    return element("span", f"{r.error:.3g}", class_="good" if r.error <= AT_FLOOR else "bad")


def _range(ends: tuple[float, float] | None) -> str:
    return "" if ends is None else f"{ends[0]:.3g} … {ends[1]:.3g}"


def _effect(part: str, d: Diagnosis, e: Effect, known: Known | None) -> Html:
    """What it is, on a robot and for a policy, who looks like it, and what to do next."""
    cls = type(e)
    values = [f"{p.symbol} = {getattr(e, p.name):.4g}{unit_words(p.unit)}" for p in e.parameters()]
    own = [n.words() for n in known.identifiable if n.name.startswith(f"{e.name}.")] if known is not None else []
    rows = [
        ["equation", element("code", cls.equation)],
        *([["identified", lines(own)]] if own else []),
        ["in the twin", ", ".join(values)],
        ["what this is", cls.in_words],
        ["what it does to a policy", cls.at_a_policy],
        ["what shows it best", cls.to_record],
    ]
    if e.name in d.rivals:
        words = f"{', '.join(d.rivals[e.name])}: these recordings do not tell which it is"
        rows.append([element("b", "does as well"), element("b", words)])
        told = to_record(part, d, e.name, d.rivals[e.name])
        rows.append(["what to record next", lines(element("code", x) if x.startswith("taccorl ") else x for x in told)])
    how = inline(element("code", f"taccorl add-effect {e.name}"), ", with the twin and the folder of this page")
    rows.append(["to add it", how])
    for other, why in d.twins.get(e.name, {}).items():
        rows.append([f"near-twin {other}", why])
    return inline(element("h3", e.name), table((), rows))


def _evidence(r: Round) -> Html:
    heads = ("effect", "equation", "validation × floor", "gain", "z", "evidence", "fitted", "at bound", "verdict")
    rows, classes = [], []
    for e in r.evidence:
        cls = effect_class(e.name)
        values = ", ".join(f"{k.split('.', 1)[1]} {v:.4g}" for k, v in e.values.items())
        verdict = "; ".join(part for part in (e.verdict, e.trouble) if part)
        rows.append(
            [
                inline(e.name, _in_words(cls) if cls else ""),
                element("code", cls.equation) if cls else "",
                f"{e.validation_error:.3g}",
                f"{round(e.gain, 2) + 0.0:.0%}",
                f"{e.score:.1f}",
                element("span", evidence_words(e), title=f"ΔBIC {e.bic:.0f}"),
                values,
                ", ".join(name.split(".", 1)[1] for name in e.at_bound),
                verdict,
            ]
        )
        classes.append(_roweffect_class(e, r))
    text = table(heads, rows, numbers=range(2, 5), classes=classes)
    if r.not_refitted:
        text = inline(text, note(f"Screened out by their first probe: {', '.join(r.not_refitted)}."))
    return text


def _in_words(cls: type[Effect]) -> Html:
    """What a row is about, to be opened."""
    said = [cls.in_words, f"A policy trained without it: {cls.at_a_policy}"]
    said += [f"near-twin {other}: {why}" for other, why in cls.near_twins.items()]
    return element("details", element("summary", "what is it?"), lines(said), class_="small")


def _roweffect_class(e: Evidence, r: Round) -> str:
    return "added" if e.name == r.added else "tie" if e.name in r.ties else ""
