"""Sections of a diagnosed part: verdict, errors, numbers, effects, evidence, and what its recordings cannot tell; and the few
lines of a terminal."""

import math
from collections.abc import Mapping, Sequence

from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.cell_numbers import summarised
from taccorl.diagnosis.comparison.regimes import ALL, AT_FLOOR, RegimeErrors
from taccorl.diagnosis.comparison.result import USES
from taccorl.diagnosis.machines.machine import Finding
from taccorl.diagnosis.problems.joint_problem import OF_RECORDINGS
from taccorl.diagnosis.search.identifiable import TIMING_S, Known
from taccorl.diagnosis.search.result import Diagnosis, Evidence, Round
from taccorl.report.evidence_words import (
    effect_class,
    evidence_words,
    last_refit_words,
    unit_words,
)
from taccorl.report.section import Cell, Picture, Section, Value, change
from taccorl.report.verdict import NEAR, Verdict, added, clean, refitted_words
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect

REMARKS = 3
"""Most remarks in a terminal; a page has all."""


def verdict_section(v: Verdict) -> Section:
    """Verdict, confidence, and the next recording with its command."""
    command = [Cell(v.command, "code")] if v.command else []
    remarks = [f"Remark: {remark}" for remark in v.remarks]
    text = [
        Cell(v.finding, "bold"),
        v.confidence,
        f"Record next: {v.record_next}",
        *command,
        *remarks,
    ]
    return Section(text=text, style=v.level)


def brief(f: Finding, v: Verdict, options: Sequence[str] = ()) -> Section:
    """What a terminal shows of one part: the verdict, numbers and command of what was added, the confidence, and what to record
    next. report.html has more. ``options``: as in ``verdict``."""
    d, names = f.diagnosis, added(f.diagnosis)
    text: list[Value] = [Cell(v.finding, "bold")]
    text += [
        f"{f'{e.name} ' * (len(names) > 1)}{_in_twin(d)}: {_values(e)}"
        for e in d.effects
        if e.name in names
    ]
    text += [Cell(f"to add it: {_to_add(f.part, names, options)}", "bold")] * (
        v.kind in ("effects", "ties")
    )
    text += [Cell(v.confidence, v.level)]
    text += [
        f"Record next: {v.record_next}",
        *[Cell(v.command, "bold")] * bool(v.command),
    ]
    text += [f"Remark: {remark}" for remark in v.remarks[:REMARKS]]
    text += [f"and {len(v.remarks) - REMARKS} more remarks: see the page"] * (
        len(v.remarks) > REMARKS
    )
    text += [
        f"{_judged(f)}; errors of {f.measured}; noise floor {f.noise}",
        *[f.remark] * bool(f.remark),
    ]
    return Section(title=_title(f), parts=[Section(text=text)])


def diagnosed(
    f: Finding,
    origins: Sequence[Origin],
    regimes: RegimeErrors | None = None,
    options: Sequence[str] = (),
) -> Section:
    """What was found at one part, on a page, which has its verdict in another place. ``origins``: of the recordings, for the
    titles of figures. ``regimes``: errors by recording and regime; None: left out. ``options``: as in ``verdict``."""
    d = f.diagnosis
    parts = [
        _errors(f, regimes),
        Section(figures=[_waterfall(f.part, d, origins)]),
        *([] if f.known is None else [_identified(f.known)]),
        *(_effect(f.part, d, e, options) for e in d.effects if e.name in added(d)),
        _numbers(d, f.known),
        *([] if regimes is None else [_regimes(regimes)]),
        *(_evidence(k, r) for k, r in enumerate(d.rounds, start=1)),
        *([Section(notes=[LEGEND])] if d.rounds else []),
        _can_tell(f),
    ]
    return Section(title=_title(f), parts=parts)


def _title(f: Finding) -> str:
    return f"{f.part}: {', '.join(added(f.diagnosis)) or 'nothing was added'}"


def _judged(f: Finding) -> str:
    judged = (
        "the last rows of each"
        if f.rows_split
        else ", ".join(f.recordings.get("validation", ()))
    )
    return f"{f.numbers}; chosen by the error on {judged} (validation)"


def _in_twin(d: Diagnosis) -> str:
    # a law's own kp may be another one, as of a cascade
    times = d.base["kp"] / d.start["kp"] if "kp" in d.base else 1.0
    return (
        "in the twin"
        if times == 1.0
        else f"in the twin, with kp {times:.4g} times the stated one"
    )


def _values(e: Effect) -> str:
    width = {name: high - low for name, (low, high) in e.interval.items()}
    return ", ".join(
        f"{p.name} {p.symbol} = {clean(getattr(e, p.name), width.get(p.name, 0.0))}{unit_words(p.unit)} "
        f"({_interval(e.interval, p.name)})"
        for p in e.parameters()
    ) + f": {e.reads_as}" * bool(e.reads_as)


def _to_add(part: str, names: Sequence[str], options: Sequence[str]) -> str:
    pads = [f"--pads={part.removesuffix(' pads')}"] * part.endswith(" pads")
    own = [
        option
        for option in options
        if not option.lstrip("'").startswith("--measurements=")
    ]  # quoted for a shell
    return " ".join(["taccorl add-effect", ",".join(names), *pads, *own])


LEGEND = (
    "gain: share of the validation squared error above the floor that goes away after everything was refitted; z: that gain over "
    "its standard error between half-second blocks; evidence: from both and ΔBIC (in report.json), which must be above 10, as "
    "more parameters always fit better. Few places: most of the error goes, but in so few half seconds that z is below 2. Weak: "
    "not added, also where the 95 % interval of the strength holds the value at which the effect is absent. →: added; =: tied"
)


def _errors(f: Finding, regimes: RegimeErrors | None) -> Section:
    d = f.diagnosis
    rows = []
    for use in ("validation", "test"):
        if use in d.errors["after"]:
            before, fitted, after = (
                d.errors[stage][use] for stage in ("before", "fitted", "after")
            )
            rows.append(
                [use, *map(_floors, (before, fitted, after)), change(fitted, after)]
            )
    text = [d.words, f"noise floor {f.noise}", _judged(f)]
    notes = [
        f.remark,
        last_refit_words(d),
        *(f"{name}: {words}" for name, words in summarised(d.base)[1].items()),
    ]
    if d.status == "something_else" and d.rounds and not d.standing_out:
        best = [e for e in d.rounds[-1].evidence[:1] if e.gain >= NEAR]
        near = [
            f"nearest: {', '.join(filter(None, (e.name, e.verdict)))}" for e in best
        ]
        notes.append(
            f"the figures show where the residual is; {(near or ['no effect comes near to it'])[0]}"
        )
    notes.append(d.trouble and f"the last fit: {d.trouble}")
    for names, what in (
        (
            d.undetermined,
            "not determined by these recordings, one of many values that fit",
        ),
        (
            d.at_bound,
            "at the end of its range, a symptom of missing physics or wrong units",
        ),
    ):
        notes.append(f"{what}: {', '.join(names)}" if names else "")
    notes += [f"{name} was superfluous after the last refit" for name in d.removed]
    if regimes is not None and (w := regimes.worst) is not None:
        place = f"{w.recording} ({w.use}), {w.regime}"
        notes.append(
            f"worst after the fit: {place}: {w.error:.2f} noise floors, n {w.n}"
        )
    heads = (
        f"error of {f.measured} [noise floors]",
        "as it was",
        "numbers refitted",
        "now",
        "by the effects",
    )
    return Section(
        text=text,
        heads=heads,
        rows=rows,
        right=range(1, 5),
        notes=[note for note in notes if note],
    )


def _floors(error: float) -> str:
    return f"{error:.2f}" if error >= 1.0 else f"{error:.3f}"


def _waterfall(part: str, d: Diagnosis, origins: Sequence[Origin]) -> Picture:
    def draw() -> object:
        from taccorl.report.figures import Step, waterfall

        steps = [Step("as given", d.errors["before"]["validation"])]
        steps += [Step(name or refitted_words(d), error) for name, error in d.steps]
        if last_refit_words(d):
            steps.append(Step("last refit", d.errors["after"]["validation"]))
        return waterfall(steps, origins, f"{part}: validation error, effect by effect")

    return Picture(draw, "validation error over the noise floor; down is better")


def _interval(
    intervals: Mapping[str, Sequence[float]], name: str, none: str = "not fitted"
) -> str:
    low, high = intervals.get(name, (math.nan, math.nan))
    return (
        " … ".join(clean(end, high - low) for end in (low, high))
        if math.isfinite(high - low)
        else none
    )


def _identified(known: Known) -> Section:
    """The primary numbers, and what pins the others."""
    rows = [
        [
            n.name,
            f"{clean(n.value, n.high - n.low)}{unit_words(n.unit)}",
            _interval({n.name: (n.low, n.high)}, n.name),
        ]
        for n in known.identifiable
    ]
    note = f"The scale of the torques is fixed by {' and '.join(known.pinned_by)}."
    if not known.pinned_by:
        note = (
            "Positions identify torques only over K_p: all torques of a joint times one factor move it the same way, but for its "
            f"inertia, and a control loop whose speed is up to {1e3 * TIMING_S:g} ms late looks like another inertia. Record the "
            "motor's effort, or hold a known payload, to know the absolute numbers."
        )
    return Section(
        title="Identified numbers",
        heads=("number", "fitted", "95 %"),
        rows=rows,
        right=(1, 2),
        notes=[note],
    )


def _numbers(d: Diagnosis, known: Known | None) -> Section:
    """The always fitted ones and those of the effects, with intervals: what the twin's file holds."""
    values = d.base | {
        f"{e.name}.{p.name}": getattr(e, p.name)
        for e in d.effects
        for p in e.parameters()
    }
    units = {
        f"{e.name}.{p.name}": unit_words(p.unit)
        for e in d.effects
        for p in e.parameters()
    }
    units |= (
        {n.name: unit_words(n.unit) for n in known.absolute}
        if known is not None
        else {}
    )
    rows = []
    for name, value in summarised(values)[0].items():
        words = (
            f"{name} (of the recordings, not in the twin)"
            if name in OF_RECORDINGS
            else name
        )
        start = f"{d.start[name]:.4g}" if name in d.start else ""
        low, high = d.intervals.get(name, (0.0, 0.0))
        fitted = f"{clean(value, high - low)}{units.get(name, '')}"
        rows.append([words, start, fitted, _interval(d.intervals, name, "")])
    notes = []
    if known is not None and not known.pinned_by and "kp" in d.base:
        notes = [
            "Together they reproduce the recordings; intervals include what the loop's timing leaves open."
        ]
    return Section(
        heads=("number of the twin", "before", "fitted", "95 %"),
        rows=rows,
        right=range(1, 4),
        notes=notes,
    )


def _effect(part: str, d: Diagnosis, e: Effect, options: Sequence[str]) -> Section:
    """What it is, on a robot and for a policy, who looks like it, and what to do next."""
    rows: list[tuple[str, Value]] = [
        ("equation", Cell(e.equation, "code")),
        (_in_twin(d), _values(e)),
        ("what this is", e.in_words),
        ("what it does to a policy", e.at_a_policy),
        ("what shows it best", e.to_record),
    ]
    if rivals := d.rivals.get(e.name, ()):
        rows.append(
            (
                "does as well",
                Cell(
                    f"{', '.join(rivals)}: these recordings do not tell which it is",
                    "bold",
                ),
            )
        )
    rows += [
        (f"near-twin {other}", why) for other, why in d.twins.get(e.name, {}).items()
    ]
    rows.append(("to add it", Cell(_to_add(part, [e.name], options), "code")))
    return Section(title=f"→ {e.name}", rows=rows)


def _regimes(found: RegimeErrors) -> Section:
    """Error after the fit, recording × regime, with the ranges that the recordings cover."""
    regimes = list(dict.fromkeys(r.regime for r in found.rows))
    cells = {(r.use, r.recording, r.regime): r for r in found.rows}
    rows: list[list[Value]] = []
    for use, recording in dict.fromkeys((r.use, r.recording) for r in found.rows):
        own = [cells.get((use, recording, regime)) for regime in regimes]
        n = cells[use, recording, ALL].n if (use, recording, ALL) in cells else 0
        ratios = [
            Cell(f"{r.error:.3g}", "good" if r.error <= AT_FLOOR else "bad")
            if r
            else ""
            for r in own
        ]
        rows.append([use, recording or Cell("all of them", "bold"), f"{n:,}", *ratios])
    heads, title = (
        ("use", "recording", "n", *regimes),
        "Error after the fit, by recording and regime",
    )
    note = "RMSE over the noise floor; 1 is as good as any twin can be. Regimes with hardly a row are left out."
    ends = [[c.ranges.get(use) for use in USES] for c in found.coverage]
    ranges = [
        [
            f"{c.variable} [{c.unit}]",
            *("" if e is None else f"{e[0]:.3g} … {e[1]:.3g}" for e in own),
        ]
        for c, own in zip(found.coverage, ends, strict=True)
    ]
    covered = Section(
        heads=("range covered", *USES),
        rows=ranges,
        right=range(1, 4),
        notes=found.remarks,
    )
    marks = [
        "" if row[1] else "tie"
        for row in dict.fromkeys((r.use, r.recording) for r in found.rows)
    ]
    return Section(
        title=title,
        heads=heads,
        rows=rows,
        right=range(2, len(heads)),
        marks=marks,
        notes=[note],
        parts=[covered],
        folded=True,
    )


def _evidence(number: int, r: Round) -> Section:
    heads = (
        "",
        "effect",
        "fitted",
        "validation × floor",
        "gain",
        "z",
        "evidence",
        "verdict",
    )
    kinds = dict.fromkeys(r.ties, "tie") | {r.added: "added"}
    marks = [kinds.get(e.name, "") for e in r.evidence]
    rows = [
        _evidence_row(e, {"added": "→", "tie": "="}.get(m, ""))
        for e, m in zip(r.evidence, marks, strict=True)
    ]
    left = (
        [f"Screened out by their first probe: {', '.join(r.not_refitted)}."]
        if r.not_refitted
        else []
    )
    title = f"Evidence, round {number}"
    return Section(
        title=title,
        heads=heads,
        rows=rows,
        right=range(3, 6),
        marks=marks,
        notes=left,
        folded=True,
    )


def _evidence_row(e: Evidence, mark: str) -> list[Value]:
    cls = effect_class(e.name)
    about = (
        []
        if cls is None
        else [
            cls.equation,
            cls.in_words,
            f"A policy trained without it: {cls.at_a_policy}",
        ]
    )
    about += (
        []
        if cls is None
        else [f"near-twin {other}: {why}" for other, why in cls.near_twins.items()]
    )
    fitted = ", ".join(
        f"{k.split('.', 1)[1]} {v:.4g}{unit_words(e.units.get(k, '1'))}"
        for k, v in e.values.items()
    )
    bounds = f"at bound: {', '.join(e.at_bound)}" if e.at_bound else ""
    numbers = [
        fitted,
        _floors(e.validation_error),
        f"{round(e.gain, 2) + 0.0:.0%}",
        f"{e.score:.1f}",
    ]
    words = "; ".join(w for w in (e.verdict, e.trouble, bounds) if w)
    return [
        mark,
        Cell(e.name, more=about),
        *numbers,
        Cell(evidence_words(e), hint=f"ΔBIC {e.bic:.0f}"),
        words,
    ]


def _can_tell(f: Finding) -> Section:
    """Before any fit, at typical strengths."""
    found, d = f.can_tell, f.diagnosis
    rows = [
        [f"{a} and {b}", f"traces are alike (|cos| {cos:.3f})"]
        for a, b, cos in found.pairs
    ]
    rows += [
        [
            f"{a} and {b}",
            f"only a combination of the two numbers is known (correlation {r:+.4f})",
        ]
        for a, b, r in found.ridges
    ]
    hardly = []
    for name in found.invisible:
        twins = (
            [t for t in effects.get(name).near_twins if t in d.start]
            if effect_class(name)
            else []
        )
        hardly.append(
            f"{name} (looks like {' and '.join(twins)}, always fitted)"
            if twins
            else name
        )
    notes = [f"would hardly show at a typical strength: {', '.join(hardly)}"] * bool(
        hardly
    )
    text = (
        []
        if rows or hardly
        else ["every effect would show, and none looks like another"]
    )
    return Section(
        title="What these recordings can tell",
        text=text,
        rows=rows,
        notes=notes,
        folded=True,
    )
