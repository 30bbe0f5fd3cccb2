"""Section of a report on the missing effects: evidence, ties, and effects that cannot be separated."""

import html
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
from taccorl.diagnosis.report.html import figure, note, table
from taccorl.diagnosis.report.verdict import Verdict, refitted_words
from taccorl.diagnosis.search.identifiability import Identifiability
from taccorl.diagnosis.search.identifiable import TIMING_S, Known
from taccorl.diagnosis.search.result import Diagnosis, Evidence, Round
from taccorl.sim.effects.effect import Effect


def first_read(v: Verdict) -> str:
    """HTML of the first section of a report: verdict, confidence, and the next recording with its command."""
    lines = [
        f"<b>{html.escape(v.finding)}</b>",
        html.escape(v.confidence),
        f"Record next: {html.escape(v.record_next)}",
    ]
    if v.command:
        lines.append(f"<code>{html.escape(v.command)}</code>")
    lines += [f"Remark: {html.escape(remark)}" for remark in v.remarks]
    return f'<div class="verdict {v.level}">{"<br>".join(lines)}</div>'


def diagnosis_section(
    part: str,
    d: Diagnosis,
    can_tell: Identifiability | None,
    origins: Sequence[Origin],
    *,
    known: Known | None = None,
    regimes: RegimeErrors | None = None,
) -> str:
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
        f"<h2>{html.escape(part)}: {html.escape(named)}</h2>",
        f'<div class="verdict">{html.escape(d.words)}. {_errors(d)}</div>',
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
        parts += [f"<h3>Evidence, round {k}{html.escape(instead)}</h3>", _evidence(r)]
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
        parts += ["<h3>What these recordings can tell</h3>", _can_tell(can_tell)]
    return "\n".join(parts)


def _can_tell(found: Identifiability) -> str:
    """Before any fit, at typical strengths."""
    lines = [f"{a} and {b}: their traces are alike (|cos| {cos:.3f})" for a, b, cos in found.pairs]
    lines += [
        f"{a} and {b}: only a combination of the two numbers is known (correlation {r:+.4f})"
        for a, b, r in found.ridges
    ]
    if found.invisible:
        lines.append(f"would hardly show at a typical strength: {', '.join(found.invisible)}")
    items = "".join(
        f"<li>{html.escape(line)}</li>" for line in lines or ["every effect would show, and none looks like another"]
    )
    return f"<ul>{items}</ul>"


def _errors(d: Diagnosis) -> str:
    lines = []
    for use, words in (("validation", "validation"), ("test", "test, which no choice has seen")):
        if use in d.errors["before"]:
            before, fitted, after = (d.errors[stage][use] for stage in ("before", "fitted", "after"))
            by_effects = f", by the effects {after / fitted - 1:+.0%}"
            lines.append(f"{words}: {before:.3g}, numbers refitted {fitted:.3g}, now {after:.3g} × floor{by_effects}")
    return "Error: " + "; ".join(lines)


def _steps(d: Diagnosis) -> list[Step]:
    first = [Step("as given", d.errors["before"]["validation"])]
    steps = first + [Step(name or refitted_words(d), error) for name, error in d.steps]
    if d.removed or d.swapped:
        steps.append(Step("superfluous ones removed, ties tried again", d.errors["after"]["validation"]))
    elif last_refit_words(d):
        steps.append(Step("last refit", d.errors["after"]["validation"]))
    return steps


def _identified(known: Known) -> str:
    """The primary numbers, and what pins the others."""
    rows = [
        [html.escape(n.name), f"{n.value:.4g}{html.escape(unit_words(n.unit))}", f"{n.low:.4g} … {n.high:.4g}"]
        for n in known.identifiable
    ]
    text = "<h3>Identified numbers</h3>" + table(("number", "fitted", "95 %"), rows, numbers=(1, 2))
    if known.pinned_by:
        return text + note(f"The scale of the torques is fixed by {' and '.join(known.pinned_by)}.")
    return text + note(
        "Positions identify torques only over K_p: all torques of a joint times one factor move it the same way, but for its "
        f"inertia, and a control loop whose speed is up to {1e3 * TIMING_S:g} ms late looks like another inertia. Record the "
        "motor's effort, or hold a known payload, to know the absolute numbers."
    )


def _numbers(d: Diagnosis, known: Known | None) -> str:
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
        rows.append([html.escape(words), start, f"{value:.4g}{html.escape(units.get(name, ''))}", ends])
    text = table(("number of the twin", "before", "fitted", "95 %"), rows, numbers=range(1, 4))
    text += "".join(note(f"{name}: {words}.") for name, words in summaries.items())
    if known is not None and not known.pinned_by and "kp" in d.base:
        text += note(
            "Together these numbers reproduce the recordings. Their intervals include what the loop's timing leaves open."
        )
    return text


def _regimes(found: RegimeErrors) -> str:
    """Error after the fit, recording × regime, with the ranges that the recordings cover."""
    regimes = list(dict.fromkeys(r.regime for r in found.rows))
    cells = {(r.use, r.recording, r.regime): r for r in found.rows}
    rows, classes = [], []
    for use, recording in dict.fromkeys((r.use, r.recording) for r in found.rows):
        own = [cells.get((use, recording, regime)) for regime in regimes]
        n = cells[use, recording, ALL].n if (use, recording, ALL) in cells else 0
        name = html.escape(recording) if recording else "<b>all of them</b>"
        rows.append([use, name, f"{n:,}", *(_ratio(r) for r in own)])
        classes.append("tie" if not recording else "")
    heads = ("use", "recording", "n", *regimes)
    text = "<h3>Error after the fit, by recording and regime</h3>" + table(
        heads, rows, numbers=range(2, len(heads)), classes=classes
    )
    text += note("RMSE over the noise floor; 1 is as good as any twin can be. Regimes with hardly a row are left out.")
    ranges = [
        [f"{c.variable} [{html.escape(c.unit)}]", *(_range(c.ranges.get(use)) for use in USES)] for c in found.coverage
    ]
    text += table(("range covered", *USES), ranges, numbers=range(1, 4))
    if found.remarks:
        text += f"<ul>{''.join(f'<li>{html.escape(remark)}</li>' for remark in found.remarks)}</ul>"
    return text


def _ratio(r: RegimeError | None) -> str:
    if r is None:
        return ""
    return f'<span class="{"good" if r.error <= AT_FLOOR else "bad"}">{r.error:.3g}</span>'


def _range(ends: tuple[float, float] | None) -> str:
    return "" if ends is None else f"{ends[0]:.3g} … {ends[1]:.3g}"


def _effect(part: str, d: Diagnosis, e: Effect, known: Known | None) -> str:
    """What it is, on a robot and for a policy, who looks like it, and what to do next."""
    cls = type(e)
    values = [f"{p.symbol} = {getattr(e, p.name):.4g}{unit_words(p.unit)}" for p in e.parameters()]
    own = [n.words() for n in known.identifiable if n.name.startswith(f"{e.name}.")] if known is not None else []
    rows = [
        ["equation", f"<code>{html.escape(cls.equation)}</code>"],
        *([["identified", "<br>".join(html.escape(line) for line in own)]] if own else []),
        ["in the twin", html.escape(", ".join(values))],
        ["what this is", html.escape(cls.in_words)],
        ["what it does to a policy", html.escape(cls.at_a_policy)],
        ["what shows it best", html.escape(cls.to_record)],
    ]
    if e.name in d.rivals:
        words = f"{', '.join(d.rivals[e.name])}: these recordings do not tell which it is"
        rows.append(["<b>does as well</b>", f"<b>{html.escape(words)}</b>"])
        lines = [html.escape(line) for line in to_record(part, d, e.name, d.rivals[e.name])]
        told = [f"<code>{x}</code>" if x.startswith("taccorl ") else x for x in lines]
        rows.append(["what to record next", "<br>".join(told)])
    rows.append(["to add it", f"<code>taccorl add-effect {e.name}</code>, with the twin and the folder of this page"])
    for other, why in d.twins.get(e.name, {}).items():
        rows.append([f"near-twin {html.escape(other)}", html.escape(why)])
    return f"<h3>{html.escape(e.name)}</h3>" + table((), rows)


def _evidence(r: Round) -> str:
    heads = ("effect", "equation", "validation × floor", "gain", "z", "evidence", "fitted", "at bound", "verdict")
    rows, classes = [], []
    for e in r.evidence:
        cls = effect_class(e.name)
        values = ", ".join(f"{k.split('.', 1)[1]} {v:.4g}" for k, v in e.values.items())
        verdict = "; ".join(part for part in (e.verdict, e.trouble) if part)
        rows.append(
            [
                html.escape(e.name) + (_in_words(cls) if cls else ""),
                f"<code>{html.escape(cls.equation)}</code>" if cls else "",
                f"{e.validation_error:.3g}",
                f"{round(e.gain, 2) + 0.0:.0%}",
                f"{e.score:.1f}",
                f'<span title="ΔBIC {e.bic:.0f}">{evidence_words(e)}</span>',
                html.escape(values),
                html.escape(", ".join(name.split(".", 1)[1] for name in e.at_bound)),
                html.escape(verdict),
            ]
        )
        classes.append(_roweffect_class(e, r))
    text = table(heads, rows, numbers=range(2, 5), classes=classes)
    if r.not_refitted:
        text += note(f"Screened out by their first probe: {', '.join(r.not_refitted)}.")
    return text


def _in_words(cls: type[Effect]) -> str:
    """What a row is about, to be opened."""
    lines = [cls.in_words, f"A policy trained without it: {cls.at_a_policy}"]
    lines += [f"near-twin {other}: {why}" for other, why in cls.near_twins.items()]
    return f"<details class=small><summary>what is it?</summary>{'<br>'.join(html.escape(line) for line in lines)}</details>"


def _roweffect_class(e: Evidence, r: Round) -> str:
    return "added" if e.name == r.added else "tie" if e.name in r.ties else ""
