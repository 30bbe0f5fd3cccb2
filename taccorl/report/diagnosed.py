"""Sections of a diagnosed part: its facts, errors, numbers, effects, evidence, and what its
recordings cannot tell."""

from collections.abc import Sequence

from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.cell_numbers import summarised
from taccorl.diagnosis.comparison.regimes import ALL, AT_FLOOR, RegimeErrors
from taccorl.diagnosis.comparison.result import USES
from taccorl.diagnosis.machines.machine import Finding, numbers_of
from taccorl.diagnosis.problems.joint_problem import OF_RECORDINGS
from taccorl.diagnosis.search.identifiable import TIMING_S, Known
from taccorl.diagnosis.search.result import Diagnosis, Evidence, Round
from taccorl.report.account import with_moved
from taccorl.report.evidence import added, effect_class, grade
from taccorl.report.fact import Account, Fact, Quantity, unit_words
from taccorl.report.section import Cell, Picture, Section, Value, change, floors
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect


def account_section(a: Account) -> Section:
    """The facts of one part: title and confidence, and a row for each."""
    rows = [
        (label, Cell(text, "code") if label in COMMANDS else text)
        for label, text in a.rows
    ]
    heading = Cell(f"{a.title}  [confidence: {a.level}]", "bold")
    return Section(text=[heading], rows=rows, style=a.level)


def next_section(found: Sequence[Fact]) -> Section:
    """What to do next with all parts together."""
    rows = [(f.label, Cell(f.text, "code")) for f in found]
    return Section(text=[Cell("all parts", "bold")], rows=rows, style="data")


COMMANDS = ("plan", "next")
"""Labels of lines that are command lines."""


def diagnosed(
    f: Finding, origins: Sequence[Origin], regimes: RegimeErrors | None = None
) -> Section:
    """What was found at one part, on a page, which has its facts in another place.
    ``origins``: of the recordings, for the titles of figures. ``regimes``: errors by
    recording and regime; None: left out."""
    d = f.diagnosis
    parts = [
        _errors(f),
        Section(figures=[_waterfall(f.part, d, origins)]),
        *([] if f.known is None else [_identified(f.known)]),
        *(_effect(d, e) for e in d.effects if e.name in added(d)),
        _numbers(d, f.known),
        *([] if regimes is None else [_regimes(regimes)]),
        *(_evidence(k, r) for k, r in enumerate(d.rounds, start=1)),
        *([Section(notes=[LEGEND])] if d.rounds else []),
        _can_tell(f),
    ]
    title = f"{f.part}: {', '.join(added(d)) or 'nothing was added'}"
    return Section(title=title, parts=parts)


def _values(e: Effect) -> str:
    """All numbers of an effect, with its symbols."""
    return ", ".join(
        f"{p.name} {p.symbol} = "
        f"{Quantity.of(getattr(e, p.name), p.unit, e.interval.get(p.name))}"
        for p in e.parameters()
    )


LEGEND = (
    "gain: share of the validation squared error above the floor that goes away after everything was refitted; z: that gain over "
    "its standard error between half-second blocks; evidence: from both and ΔBIC (in report.json), which must be above 10, as "
    "more parameters always fit better. Few places: most of the error goes, but in so few half seconds that z is below 2. Weak: "
    "not added, also where the 95 % interval of the strength holds the value at which the effect is absent. →: added; =: tied"
)


def _errors(f: Finding) -> Section:
    """Errors of each use before and after, and how they were judged."""
    d = f.diagnosis
    rows = []
    for use in ("validation", "test"):
        if use in d.errors["after"]:
            stages = ("before", "fitted", "after")
            before, fitted, after = (d.errors[stage][use] for stage in stages)
            own = map(floors, (before, fitted, after))
            rows.append([use, *own, change(fitted, after)])
    judged = ", ".join(f.recordings.get("validation", ()))
    if f.rows_split:
        judged = "the last rows of each"
    chosen = f"{f.numbers}; chosen by the error on {judged} (validation)"
    families = summarised(d.base)[1].items()
    notes = [f.remark] * bool(f.remark)
    notes += [f"{name}: {words}" for name, words in families]
    notes += [f"{name} was superfluous after the last refit" for name in d.removed]
    if d.undetermined:
        notes.append(f"not determined by these recordings: {', '.join(d.undetermined)}")
    heads = (
        f"error of {f.measured} [noise floors]",
        "as it was",
        "numbers refitted",
        "now",
        "by the effects",
    )
    return Section(
        text=[with_moved(d).words, f"noise floor {f.noise}", chosen],
        heads=heads,
        rows=rows,
        right=range(1, 5),
        notes=notes,
    )


def _waterfall(part: str, d: Diagnosis, origins: Sequence[Origin]) -> Picture:
    def draw() -> object:
        from taccorl.report.figures import Step, waterfall

        steps = [Step("as given", d.errors["before"]["validation"])]
        steps += [Step(name or "numbers refitted", error) for name, error in d.steps]
        if d.steps[-1][0]:
            steps.append(Step("last refit", d.errors["after"]["validation"]))
        return waterfall(steps, origins, f"{part}: validation error, effect by effect")

    return Picture(draw, "validation error over the noise floor; down is better")


def _identified(known: Known) -> Section:
    """The primary numbers, and what pins the others."""
    rows = []
    for n in known.identifiable:
        number = Quantity.of(n.value, n.unit, (n.low, n.high))
        rows.append([n.name, number.shown, number.ends])
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
    values, units = dict(d.base), {f.name: f.unit for f in d.after.frees}
    for name, (value, unit) in numbers_of(d.effects).items():
        values[name], units[name] = value, unit
    rows = []
    for name, value in summarised(values)[0].items():
        of_recordings = " (of the recordings, not in the twin)"
        words = name + of_recordings if name in OF_RECORDINGS else name
        start = f"{d.start[name]:.4g}" if name in d.start else ""
        ends = d.intervals.get(name)
        number = Quantity.of(value, units.get(name, "1"), ends)
        rows.append([words, start, number.shown, number.ends])
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


def _effect(d: Diagnosis, e: Effect) -> Section:
    """What it is, on a robot and for a policy, and who looks like it."""
    rows: list[tuple[str, Value]] = [
        ("equation", Cell(e.equation, "code")),
        ("in the twin", _values(e)),
        ("what this is", e.in_words),
        ("what it does to a policy", e.at_a_policy),
        ("what shows it best", e.to_record),
    ]
    twins = d.twins.get(e.name, {})
    rows += [(f"near-twin {other}", why) for other, why in twins.items()]
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
            Cell(floors(r.error), "good" if r.error <= AT_FLOOR else "bad") if r else ""
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
        floors(e.validation_error),
        f"{round(e.gain, 2) + 0.0:.0%}",
        f"{e.score:.1f}",
    ]
    words = "; ".join(w for w in (e.verdict, e.trouble, bounds) if w)
    return [
        mark,
        Cell(e.name, more=about),
        *numbers,
        Cell(grade(e), hint=f"ΔBIC {e.bic:.0f}"),
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
