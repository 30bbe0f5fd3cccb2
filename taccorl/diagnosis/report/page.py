"""The page of a report: one HTML file with its pictures inside, which loads no other file."""

from collections.abc import Iterable, Sequence

from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.along import curves
from taccorl.diagnosis.comparison.cell_numbers import cell_lines
from taccorl.diagnosis.comparison.localise import WHERE_NOT_WHY, Cell, worst_regime
from taccorl.diagnosis.comparison.result import Comparison, Kind, Score, Trace, origin_words, shown, shown_unit
from taccorl.diagnosis.report.evidence import diagnosis_section, first_read
from taccorl.diagnosis.report.figure_style import data_uri, png
from taccorl.diagnosis.report.figures import heat_map_figure, joint_response, residual_along_variables
from taccorl.diagnosis.report.figures_touch import (
    cell_maps,
    reading_over_load,
    touch_heat_map_figure,
    touch_histogram,
    touch_maps,
    touch_over_time,
)
from taccorl.diagnosis.report.report import GENERATOR, Report, cells_of
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.html_page import Html, bullets, document, element, figure, inline, note, table

STYLE = """
:root{color-scheme:light}
body{font:15px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif;margin:0;color:#111827;background:#f8fafc}
main{max-width:1240px;margin:0 auto;padding:24px 20px 80px}
h1{font-size:26px;margin:8px 0}h2{font-size:20px;margin:40px 0 10px;border-bottom:2px solid #e5e7eb;padding-bottom:4px}
h3{font-size:16px;margin:24px 0 6px}
.data{background:#fef3c7;border:1px solid #f59e0b;border-radius:6px;padding:8px 12px;font-weight:600}
.note{color:#4b5563;font-size:13.5px;margin:6px 0}
.verdict{font-size:17px;background:#ecfeff;border:1px solid #06b6d4;border-radius:6px;padding:10px 14px;margin:12px 0}
.verdict.moderate{background:#fffbeb;border-color:#f59e0b}.verdict.low{background:#fef2f2;border-color:#ef4444}
.scroll{overflow-x:auto}
table{border-collapse:collapse;background:#fff;font-size:13px;margin:8px 0}
th,td{padding:5px 9px;border-bottom:1px solid #e5e7eb;text-align:left;vertical-align:top}
th{background:#f1f5f9}td.n{text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums}
tr.added td{background:#ecfdf5}tr.tie td{background:#fffbeb}
img{max-width:100%;height:auto;background:#fff;border:1px solid #e5e7eb;border-radius:6px;margin:8px 0}
figure{margin:12px 0}figcaption{color:#4b5563;font-size:13px}
details{background:#fff;border:1px solid #e5e7eb;border-radius:6px;padding:6px 14px;margin:10px 0}
summary{cursor:pointer;font-weight:600}
details.small{border:0;padding:0;margin:2px 0;background:none;max-width:300px}
details.small summary{font-weight:400;color:#6b7280;font-size:12px}td code{white-space:normal}
.good{color:#047857;font-weight:600}.bad{color:#b45309;font-weight:600}
code{background:#f1f5f9;padding:1px 4px;border-radius:3px}
"""
"""Style sheet of the page."""
USE_WORDS = {"fit": "fit", "validation": "validation", "test": "test"}
"""Use of recordings → word on the page."""


def page(report: Report) -> str:
    """HTML text of the whole page."""
    c, after = report.without_effects, report.after
    regimes = report.regimes()
    parts = [
        element("h1", report.title),
        element("p", origin_words(report.origins), class_="data"),
        *(first_read(v) for v in report.verdicts().values()),
        _about(report),
        *(
            diagnosis_section(
                part,
                d,
                report.can_tell.get(part),
                report.origins,
                known=report.known.get(part),
                regimes=regimes.get(part),
            )
            for part, d in report.diagnoses.items()
        ),
        element("h2", "How far off"),
        _score_table(report),
        *_where(report),
        *_pictures(report),
        element("h2", "Signal by signal") if c.signals else "",
        *(_signal(c, after, signal, kind) for signal, kind in c.signals),
        *_touch(c, after),
        *_left_over(report),
    ]
    return document(report.title, STYLE, GENERATOR, parts)


def _about(report: Report) -> Html:
    c = report.comparison
    rows = [
        ("twin" if k == 0 else "beside it", f"{one.twin}: {', '.join(one.effects) or 'no added effects'}")
        for k, one in enumerate(_compared(report))
    ]
    names = {use: ", ".join(map(str, c.split.get(use) or ())) for use in USE_WORDS}  # pyright: ignore[reportArgumentType]
    rows += [(f"recordings, {USE_WORDS[use]}", listed or "none") for use, listed in names.items()]
    rows += [("split", str(c.split.get("rule", "")))]
    rows += list(report.provenance.items())
    return table((), rows)


def _compared(report: Report) -> list[Comparison]:
    """The twin as it was, with refitted numbers, and as it ends: those that there are."""
    return [one for one in (report.comparison, report.refitted, report.after) if one is not None]


def _score_table(report: Report) -> Html:
    """One line for each signal and use; beside each other the twin as it was, with refitted numbers, and as it ends."""
    c, *others = _compared(report)
    later = [{(s.signal, s.kind, s.use): s for s in (*o.scores(), *o.pad_scores())} for o in others]
    heads = ["signal", "recordings", f"RMSE, {c.twin} (95 %)", "× floor"]
    for other in others:
        heads += [f"RMSE, {other.twin} (95 %)", "× floor", "change"]
    heads += ["NRMSE", "noise floor", "n"]
    rows = []
    for s in (*c.scores(), *c.pad_scores()):
        row = [
            f"{s.signal} {'' if s.signal == 'touch' else s.kind}",
            f"{USE_WORDS[s.use]} ({s.recordings})",
            *_errors(s),
        ]
        before = s
        for found in later:
            other = found.get((s.signal, s.kind, s.use))
            row += [*_errors(other), f"{other.rmse / before.rmse - 1:+.0%}"] if other is not None else [""] * 3
            before = other or before
        floor = element("span", shown(s.floor, s.unit) + " (lower bound)" * s.lower_bound, title=s.floor_words)
        row += [f"{s.nrmse:.2%}", floor, f"{s.n:,}"]
        rows.append(row)
    notes = note(
        "RMSE of measurement − replay. × floor: RMSE over the noise floor; 1 is as good as any twin can be. change: against the "
        "twin to its left. NRMSE: RMSE of the first twin over the standard deviation of what was measured. 95 %: interval from "
        "half-second blocks drawn again. Validation recordings choose effects; test recordings were used for no choice."
    )
    if any(s.lower_bound for s in c.scores()):
        notes = inline(
            notes,
            note("A floor that is a lower bound makes the twin look worse than it may be: record one motion twice."),
        )
    return inline(table(heads, rows, numbers=range(2, len(heads))), notes)


def _errors(s: Score) -> list[str]:
    grade = "good" if s.ratio <= SearchConfig().stop_at else "bad"
    low, high = (f"{x * shown_unit(s.unit)[0]:.3g}" for x in s.interval)
    return [f"{shown(s.rmse, s.unit)} ({low} … {high})", element("span", f"{s.ratio:.3g}", class_=grade)]


def _where(report: Report) -> list[Html]:
    cells = report.cells()
    found = [element("h2", "Where it is off")]
    if report.refitted is not None:
        found.append(
            note(
                f"The first map of each kind is the {report.refitted.twin}: its gains (of pads: stiffness and damping) are "
                "fitted, and no effect is added. The second is the twin with the effects: the difference is what they removed."
            )
        )
    found.append(note(WHERE_NOT_WHY))
    lines = []
    for signal, kind in dict.fromkeys((cell.signal, cell.kind) for cell in cells):
        worst = worst_regime(cells, signal, kind)
        if worst is not None:
            lines.append(
                f"{signal} {kind}: worst {worst.regime}, {worst.ratio:.3g} × floor; "
                f"{worst.share_of_error:.0%} of its squared error in {worst.share_of_time:.0%} of its time"
            )
    found.append(bullets(lines))
    drawn = [(report.without_effects, cells)]
    if report.refitted is not None and report.after is not None:
        drawn.append((report.after, cells_of(report.after)))
    for kind in ("position", "effort", "touch"):
        most = max((cell.ratio for _, own in drawn for cell in own if cell.kind == kind), default=0.0)
        for one, all_cells in drawn:
            own = [cell for cell in all_cells if cell.kind == kind]
            if own:
                found.append(_heat_map(own, kind, one.twin, report.origins, most))
    return found


def _heat_map(cells: Sequence[Cell], kind: str, twin: str, origins: Sequence[Origin], most: float) -> Html:
    """With colours up to ``most`` floors, the same for maps that are compared."""
    if kind == "touch":
        title = f"touch: where the {twin} is off (RMSE / noise floor)"
        drawn = touch_heat_map_figure(cells, origins, title, most)
        return figure(
            data_uri(png(drawn)), "touch: pad × contact, phase, and third of the pad; all recordings together"
        )
    drawn = heat_map_figure(cells, origins, f"{kind}s: where the {twin} is off (RMSE / noise floor)", most)
    return figure(data_uri(png(drawn)), f"{kind}: joint × regime, all recordings together")


def _pictures(report: Report) -> list[Html]:
    if not report.pictures:
        return []
    return [
        element("h2", "Pictures"),
        *(figure(data_uri(picture), words) for words, picture in report.pictures.items()),
    ]


def _signal(c: Comparison, after: Comparison | None, signal: str, kind: Kind) -> Html:
    """The validation recording as curves, and all recordings along variables."""
    shown_one = representative(c.of(signal, kind))
    pairs = [t for t in after.of(signal, kind, shown_one.use) if t.recording == shown_one.recording] if after else []
    later = pairs[0] if pairs else None
    names = (c.twin, after.twin if after is not None else "")
    drawn = joint_response(shown_one, later, names)
    found = curves(c, signal, kind)
    same = curves(after, signal, kind) if after is not None and after.of(signal, kind) else []
    words = f"{shown_one.recording} ({USE_WORDS[shown_one.use]}): commanded, measured, replayed; below, the regimes"
    figures = [figure(data_uri(png(drawn)), words)]
    if found:
        drawn = residual_along_variables(found, same, c.of(signal, kind), names)
        figures.append(figure(data_uri(png(drawn)), f"all recordings of {signal}. {WHERE_NOT_WHY}"))
    first = (signal, kind) == c.signals[0]
    return element("details", element("summary", f"{signal} {kind}"), *figures, open="open" * first)


def representative(traces: Sequence[Trace]) -> Trace:
    """Of ``traces`` of one signal, the recording with the median error among the validation recordings (else test, else fit)."""
    for use in ("validation", "test", "fit"):
        own = sorted(
            (t for t in traces if t.use == use), key=lambda t: float((t.residual**2)[t.residual == t.residual].mean())
        )
        if own:
            return own[(len(own) - 1) // 2]
    raise ValueError("no traces")


def _touch(c: Comparison, after: Comparison | None) -> Iterable[Html]:
    if not c.touches:
        return []
    names = (c.twin, after.twin if after is not None else "")
    later = after.touches if after is not None else ()
    parts = [element("h2", "Touch"), figure(data_uri(png(touch_histogram(c.touches, later, names))), "all recordings")]
    if all(t.load is not None for t in c.touches):
        drawn = reading_over_load(c.touches, later, names)
        parts.append(figure(data_uri(png(drawn)), "reading over load: a bend is a law, a loop is memory"))
    twin, shown_twin = (later, names[1]) if later else (c.touches, names[0])
    cells = twin[0].cells
    if cells is not None and min(cells.gain.shape) > 1:
        drawn = cell_maps(twin, shown_twin)
        parts.append(figure(data_uri(png(drawn)), "; ".join(cell_lines(twin)) or "gain, offset and error of each cell"))
    else:
        parts += [note(line) for line in cell_lines(twin)]
    for pads in dict.fromkeys(t.pads for t in c.touches):
        own = [t for t in c.touches if t.pads == pads]
        shown_one = next(t for use in ("validation", "test", "fit") for t in own if t.use == use)
        other = next((t for t in later if t.recording == shown_one.recording), None)
        maps, over_time = touch_maps(shown_one, other, names), touch_over_time(shown_one, other, names)
        parts.append(
            figure(
                data_uri(png(maps)), f"{' and '.join(pads)}: measured beside simulated, and where on the pads it is off"
            )
        )
        parts.append(figure(data_uri(png(over_time)), "loading, hold, unloading, release; the error of every frame"))
    return parts


def _left_over(report: Report) -> list[Html]:
    """What the checks said, and what was not compared."""
    rows = [[name, f.severity, f.check, f.text] for name, found in report.findings.items() for f in found]
    parts = []
    if rows:
        parts += [element("h2", "What the checks said"), table(("recording", "severity", "check", "what"), rows)]
    skipped = report.comparison.split.get("skipped") or ()
    left = [*report.comparison.left_out, *(f"not read: {s}" for s in skipped)]  # pyright: ignore[reportGeneralTypeIssues]
    if left:
        parts += [element("h2", "Not compared"), bullets(map(str, left))]
    return parts
