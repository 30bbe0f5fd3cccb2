"""Sections of a comparison: how far off, where, signal by signal, pads, and what was not compared."""

from collections.abc import Iterator, Mapping, Sequence

from taccorl.alignment.measurements.folder import Use
from taccorl.data.finding import Finding
from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.along import curves
from taccorl.diagnosis.comparison.cell_numbers import cell_lines
from taccorl.diagnosis.comparison.localise import (
    REGIMES,
    WHERE_NOT_WHY,
    Cell,
    heat_map,
    worst_regime,
)
from taccorl.diagnosis.comparison.localise_touch import PHASES, touch_heat_map
from taccorl.diagnosis.comparison.result import (
    FELT_FLOORS,
    Comparison,
    Kind,
    Score,
    Trace,
    shown,
    shown_unit,
)
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.report.section import Cell as Styled
from taccorl.report.section import Picture, Section, Value, change, floors
from taccorl.report.touch_match import touch_match_section

DEFINITIONS = {r.name: r.words for r in REGIMES} | PHASES
"""Regime → its definition for readers."""
USES: tuple[Use, ...] = ("validation", "test", "fit")
"""Uses in the order in which a recording is looked for as an example."""


def cells_of(c: Comparison) -> list[Cell]:
    """Errors by regime, of positions, efforts and pads."""
    return [
        *heat_map(c, "position"),
        *heat_map(c, "effort"),
        *touch_heat_map(c.touches),
    ]


def how_far(c: Comparison, *others: Comparison) -> Section:
    """One row for each signal and use; beside each other the twin as it was and ``others``, such as with refitted numbers."""
    every = [
        {(s.signal, s.kind, s.use): s for s in (*o.scores(), *o.pad_scores())}
        for o in (c, *others)
    ]
    heads = ["signal", "recordings", f"RMSE {c.twin} (95 %)", "× floor"]
    for other in others:
        heads += [f"RMSE {other.twin} (95 %)", "× floor", "change"]
    scores = [*every[0].values()]
    rows = []
    for s in scores:
        row: list[Value] = [
            f"{s.signal} {'' if s.signal == 'touch' else s.kind}".strip(),
            f"{s.use} ({s.recordings})",
        ]
        row += _errors(s)
        before = s
        for found in every[1:]:
            other = found.get((s.signal, s.kind, s.use))
            row += (
                [*_errors(other), change(before.rmse, other.rmse)]
                if other is not None
                else [""] * 3
            )
            before = other or before
        floor = shown(s.floor, s.unit) + " or more" * s.lower_bound
        rows.append(
            [*row, f"{s.nrmse:.2%}", Styled(floor, hint=s.floor_words), f"{s.n:,}"]
        )
    notes = [
        "RMSE of measurement − replay; × floor: over the noise floor, 1 is as good as any twin can be; change: against the twin "
        "to its left; NRMSE: over the standard deviation of what was measured; 95 %: from half-second blocks drawn again. "
        "Validation recordings choose effects; test recordings were used for no choice."
    ]
    if any(s.lower_bound and s.kind == "touch" for s in scores):
        notes.append(
            "or more, of touch: the noise of each taxel; what presses do not repeat is not in it"
        )
    if any(s.lower_bound and s.kind != "touch" for s in scores):
        notes.append(
            "or more: no recording repeats another (repeat_of), so this floor is a lower bound"
        )
    for signal in dict.fromkeys(
        s.signal for s in scores if s.kind == "effort" and c.of(s.signal)
    ):
        words = ", ".join(
            f"{use} {' → '.join(_together(found, signal, use) for found in every)}"
            for use in c.uses
        )
        notes.append(
            f"{signal}: position and effort together: {words} × floor, as diagnose counts"
        )
    heads += ["NRMSE", "noise floor", "n"]
    return Section(
        title="How far off",
        heads=heads,
        rows=rows,
        right=range(2, len(heads)),
        notes=notes,
    )


def pad_matches(*comparisons: Comparison) -> list[Section]:
    """The paper's five numbers of each pad and use, a column for each twin; empty without
    pads."""
    every = {c.twin: c.pad_matches() for c in comparisons}
    sections = []
    for pad, use in comparisons[0].pad_matches():
        own = {twin: m[pad, use] for twin, m in every.items() if (pad, use) in m}
        title = f"{pad}, {use}"
        sections.append(touch_match_section([*own], [*own.values()], title))
    if not sections:
        return []
    note = f"A taxel above {FELT_FLOORS:g} of its noise floors is active."
    return [Section(title="Touch match", notes=[note], parts=sections)]


def _together(found: Mapping[tuple, Score], signal: str, use: Use) -> str:
    """RMS error of all rows of position and effort [noise floors]; of ``diagnose`` it differs by rows at a limit."""
    own = [
        found[signal, kind, use]
        for kind in ("position", "effort")
        if (signal, kind, use) in found
    ]
    return (
        f"{(sum(s.n * s.ratio**2 for s in own) / sum(s.n for s in own)) ** 0.5:.2f}"
        if own
        else "–"
    )


def verdict(c: Comparison, after: Comparison | None) -> Section:
    """Error of each signal in noise floors, of the recordings that stand first in ``USES``; before and after a change."""
    lines: list[Value] = []
    later = (
        {(s.signal, s.kind, s.use): s for s in after.scores()}
        if after is not None
        else {}
    )
    for signal, kind in c.signals:
        own = {s.use: s for s in c.scores() if (s.signal, s.kind) == (signal, kind)}
        s = next(own[use] for use in USES if use in own)
        now = later.get((signal, kind, s.use))
        words = (
            f" with {c.twin}, {floors(now.ratio)} with {after.twin}"
            if now is not None and after is not None
            else ""
        )
        lines.append(
            f"{signal} {kind}: {floors(s.ratio)} noise floors off{words} ({s.use})"
        )
    worst = max((s.ratio for s in (after or c).scores()), default=0.0)
    return Section(
        text=lines, style="high" if worst <= SearchConfig().floor else "moderate"
    )


def _errors(s: Score) -> list[Value]:
    low, high = (f"{x * shown_unit(s.unit)[0]:.3g}" for x in s.interval)
    grade = "good" if s.ratio <= SearchConfig().floor else "bad"
    return [f"{shown(s.rmse, s.unit)} ({low} … {high})", Styled(floors(s.ratio), grade)]


def where(
    c: Comparison, origins: Sequence[Origin], after: Comparison | None = None
) -> Section:
    """The worst regime of each signal, and heat maps; ``after`` is drawn below with the same colours."""
    cells = cells_of(c)
    lines = []
    for signal, kind in dict.fromkeys((cell.signal, cell.kind) for cell in cells):
        worst = worst_regime(cells, signal, kind)
        if worst is not None:
            meaning = DEFINITIONS.get(worst.regime, "rows of the pad")
            lines.append(
                f"{signal} {kind}: largest in the regime “{worst.regime}” ({meaning}), "
                f"{floors(worst.ratio)} × floor; "
                f"{worst.share_of_error:.0%} of the squared error in {worst.share_of_time:.0%} of the time"
            )
    text = (
        [f"The first map is of the {c.twin}, the second of the {after.twin}."]
        if after is not None
        else []
    )
    drawn = [(c, cells)] + ([(after, cells_of(after))] if after is not None else [])
    figures = []
    for kind in ("position", "effort", "touch"):
        most = max(
            (cell.ratio for _, own in drawn for cell in own if cell.kind == kind),
            default=0.0,
        )
        for one, every in drawn:
            if own := [cell for cell in every if cell.kind == kind]:
                figures.append(_heat_map(own, kind, one.twin, origins, most))
    return Section(
        title="Where it is off",
        text=[*lines, *text],
        notes=[WHERE_NOT_WHY],
        figures=figures,
        folded=True,
    )


def _heat_map(
    cells: Sequence[Cell], kind: str, twin: str, origins: Sequence[Origin], most: float
) -> Picture:
    """With colours up to ``most`` floors, the same for maps that are compared."""

    def draw() -> object:
        from taccorl.report.figures import heat_map_figure

        return heat_map_figure(
            cells,
            origins,
            f"{kind}: where the {twin} is off (RMSE / noise floor)",
            most,
        )

    rows = (
        "pad × contact, phase, and third of the pad"
        if kind == "touch"
        else "joint × regime"
    )
    return Picture(draw, f"{kind}: {rows}; all recordings together")


def signals(c: Comparison, after: Comparison | None) -> Section:
    """Each signal: an example as curves, and all recordings along variables."""
    return Section(
        title="Signal by signal",
        parts=[
            _signal(c, after, *signal, opened=k == 0)
            for k, signal in enumerate(c.signals)
        ],
        only="page",
    )


def _signal(
    c: Comparison, after: Comparison | None, signal: str, kind: Kind, opened: bool
) -> Section:
    traces = c.of(signal, kind)
    one = representative(traces)
    pairs = (
        [t for t in after.of(signal, kind, one.use) if t.recording == one.recording]
        if after
        else []
    )
    names = (c.twin, after.twin if after is not None else "")

    def response() -> object:
        from taccorl.report.figures import joint_response

        return joint_response(one, pairs[0] if pairs else None, names)

    def along() -> object:
        from taccorl.report.figures import residual_along_variables

        same = (
            curves(after, signal, kind)
            if after is not None and after.of(signal, kind)
            else []
        )
        return residual_along_variables(found, same, traces, names)

    found = curves(c, signal, kind)
    figures = [
        Picture(
            response,
            f"{one.recording} ({one.use}): commanded, measured, replayed; below, the regimes",
        )
    ]
    figures += (
        [Picture(along, f"all recordings of {signal}; *: the share may be chance")]
        if found
        else []
    )
    return Section(title=f"{signal} {kind}", figures=figures, folded=not opened)


def representative(traces: Sequence[Trace]) -> Trace:
    """Of ``traces`` of one signal, the recording with the median error among the validation recordings (else test, else fit)."""
    for use in USES:
        own = sorted(
            (t for t in traces if t.use == use),
            key=lambda t: float((t.residual**2)[t.residual == t.residual].mean()),
        )
        if own:
            return own[(len(own) - 1) // 2]
    raise ValueError("no traces")


def cell_numbers(c: Comparison) -> Section:
    """Gains, offsets and errors of the cells of an array in few lines."""
    return Section(text=cell_lines(c.touches))


def touch(c: Comparison, after: Comparison | None) -> Section:
    """Histogram, reading over load, maps of cells, and each pad's strongest touch and its course."""
    return Section(
        title="Touch", figures=[*_touch(c, after)] if c.touches else (), only="page"
    )


def _touch(c: Comparison, after: Comparison | None) -> Iterator[Picture]:
    from taccorl.report import figures_touch as f

    names = (c.twin, after.twin if after is not None else "")
    later = after.touches if after is not None else ()
    yield Picture(
        lambda: f.touch_histogram(c.touches, later, names), "readings of all recordings"
    )
    if all(t.load is not None for t in c.touches):
        caption = "reading over load: a bend is a law, a loop is memory"
        yield Picture(lambda: f.reading_over_load(c.touches, later, names), caption)
    twin, shown_twin = (later, names[1]) if later else (c.touches, names[0])
    cells = twin[0].cells
    if cells is not None and min(cells.gain.shape) > 1:
        yield Picture(
            lambda: f.cell_maps(twin, shown_twin), "gain, offset and error of each cell"
        )
    for pads in dict.fromkeys(t.pads for t in c.touches):
        own = [t for t in c.touches if t.pads == pads]
        one = next(t for use in USES for t in own if t.use == use)
        other = next((t for t in later if t.recording == one.recording), None)
        caption = f"{' and '.join(pads)}: measured beside simulated, and where on the pads it is off"
        yield Picture(
            lambda one=one, other=other: f.touch_maps(one, other, names), caption
        )
        caption = "loading, hold, unloading, release; the error of every frame"
        yield Picture(
            lambda one=one, other=other: f.touch_over_time(one, other, names), caption
        )


def checked(findings: Mapping[str, Sequence[Finding]]) -> Section:
    """What the checks found in each recording."""
    rows = [
        [name, Styled(f.severity, f.severity), f.check, f.text]
        for name, own in findings.items()
        for f in own
    ]
    heads = ("recording", "severity", "check", "what")
    title = f"What the checks said ({len(rows)})" * bool(rows)
    return Section(
        title=title, heads=heads, rows=rows, folded=True if rows else None, only="page"
    )


def not_compared(c: Comparison) -> Section:
    """Recordings, or parts of them, that were left out."""
    skipped: Sequence[object] = c.split.get("skipped") or ()  # pyright: ignore[reportAssignmentType]
    left = [
        *(f"not compared: {line}" for line in c.left_out),
        *(f"not read: {line}" for line in skipped),
    ]
    return Section(notes=left)
