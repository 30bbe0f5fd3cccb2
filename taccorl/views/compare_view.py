"""Write a comparison for Rerun: measured, replayed, residual and noise floor of every signal over time; pads measured and
replayed.

    /<recording>/<signal>/<kind>/{command,measured,twin,corrected}
    /<recording>/<signal>/<kind>/residual/{twin,corrected,floor_high,floor_low}
    /<recording>/touch/{measured,twin,corrected}     pads side by side, counts above baseline, one colour scale
    /provenance

One tab a signal, in it one row a recording, validation ones first, ``MOST_ROWS`` in a tab.
Time line: ``time`` (seconds since a recording's first row).
"""

import itertools
import re
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from taccorl.diagnosis.comparison.result import (
    Comparison,
    TouchTrace,
    Trace,
    origin_words,
    shown,
    shown_unit,
)
from taccorl.report.compared import how_far
from taccorl.report.markdown import escaped, markdown
from taccorl.report.section import Section
from taccorl.views.blueprint import arranged, plot
from taccorl.views.colors import GROUND_COLOR, NOISE_COLOR
from taccorl.views.episode import depth_style
from taccorl.views.outputs import check_free, replacing
from taccorl.views.rrd import recording_to

COMMAND_COLOR, MEASURED_COLOR = (120, 130, 145), (235, 235, 235)
TWIN_COLORS = ((230, 120, 40), (86, 180, 233))
"""Colours of the twin before and after a change: orange and blue as in the report's figures, for a dark background."""
TWIN_NAMES = ("twin", "corrected")
FIRST_USES = ("validation", "test", "fit")
"""Uses of recordings in a diagnosis, in the order in which they are shown."""
PAD_GAP_TAXELS = 3
"""Distance of neighbouring pads in the view [taxels]."""
MOST_ROWS = 5
"""Most recordings in one tab."""


def save_comparison(
    comparison: Comparison, rrd: Path, after: Comparison | None = None
) -> None:
    """Write all compared signals and the layout of their views as one .rrd file. ``after``: comparison of a second twin on the
    same recordings. Raises OutputError: ``rrd`` exists and was not written by taccorl, or the disk is full."""
    check_free(rrd)
    with (
        replacing(rrd) as part,
        recording_to(part, comparison_blueprint(comparison)) as rec,
    ):
        rec.send_recording_name(f"{comparison.twin} beside measurements")
        rec.log(
            "provenance",
            rr.TextDocument(_page(comparison, after), media_type=rr.MediaType.MARKDOWN),
            static=True,
        )
        for trace in comparison.traces:
            others = (
                after.of(trace.signal, trace.kind, trace.use)
                if after is not None
                else ()
            )
            _log_trace(
                rec,
                trace,
                next((o for o in others if o.recording == trace.recording), None),
            )
        for touch in comparison.touches:
            others = after.touches if after is not None else ()
            _log_touch(
                rec,
                touch,
                next((o for o in others if o.recording == touch.recording), None),
            )


def comparison_blueprint(comparison: Comparison) -> rrb.Blueprint:
    """Layout with one tab per signal; touch and provenance are last."""
    tabs: list[rrb.Container | rrb.View] = []
    for signal, kind in comparison.signals:
        traces = sorted(
            comparison.of(signal, kind), key=lambda t: FIRST_USES.index(t.use)
        )
        for k, some in enumerate(itertools.batched(traces, MOST_ROWS)):
            name = f"{signal} {kind}" + (f", from {k * MOST_ROWS + 1}" if k else "")
            tabs.append(rrb.Vertical(*[_row(t) for t in some], name=name))
    tabs += [
        _touch_view(t)
        for t in sorted(comparison.touches, key=lambda t: FIRST_USES.index(t.use))
    ]
    tabs.append(rrb.TextDocumentView(origin="/provenance", name="provenance"))
    return arranged(
        rrb.Tabs(*tabs, active_tab=0), rrb.TimePanel(state="collapsed", timeline="time")
    )


def _row(trace: Trace) -> rrb.Container:
    """Curves on the left, residual and floor on the right."""
    path, use = _path(trace), trace.use.replace("_", "-")
    unit = shown_unit(trace.unit)[1]
    origin = f" · {trace.origin}" if trace.origin else ""
    return rrb.Horizontal(
        plot(
            f"{trace.recording} ({use}) [{trace.unit}]{origin}",
            [f"{path}/{name}" for name in ("command", "measured", *TWIN_NAMES)],
            rrb.Corner2D.LeftTop,
        ),
        plot(
            f"residual = measured − replayed [{unit}], floor {shown(trace.floor.value, trace.unit)}",
            [f"{path}/residual/**"],
            rrb.Corner2D.LeftTop,
        ),
    )


def _touch_view(touch: TouchTrace) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin=f"/{_word(touch.recording)}/touch",
        name=f"touch: {touch.recording} ({touch.use.replace('_', '-')}): measured above, replayed below",
        background=GROUND_COLOR,
    )


def _path(trace: Trace) -> str:
    return f"/{_word(trace.recording)}/{trace.signal}/{trace.kind}"


def _word(name: str) -> str:
    """A name as a part of an entity path."""
    return re.sub(r"\W+", "_", name).strip("_")


def _log_trace(rec: rr.RecordingStream, trace: Trace, after: Trace | None) -> None:
    path, factor = _path(trace), shown_unit(trace.unit)[0]
    twins = [(TWIN_NAMES[0], trace, TWIN_COLORS[0])] + (
        [(TWIN_NAMES[1], after, TWIN_COLORS[1])] if after else []
    )
    if trace.kind == "position":
        _line(
            rec,
            f"{path}/command",
            "command",
            trace.time_s,
            trace.target,
            COMMAND_COLOR,
            1.0,
        )
    _line(
        rec,
        f"{path}/measured",
        "measured",
        trace.time_s,
        trace.measured,
        MEASURED_COLOR,
        2.5,
    )
    for name, one, color in twins:
        _line(rec, f"{path}/{name}", name, one.time_s, one.replayed, color, 1.5)
        _line(
            rec,
            f"{path}/residual/{name}",
            name,
            one.time_s,
            one.residual * factor,
            color,
            1.5,
        )
    ends = trace.time_s[[0, -1]]
    for name, sign in (("floor_high", 1.0), ("floor_low", -1.0)):
        level = np.full(2, sign * 2 * trace.floor.value * factor)
        _line(
            rec,
            f"{path}/residual/{name}",
            "± 2 noise floors",
            ends,
            level,
            NOISE_COLOR,
            1.0,
        )


def _line(
    rec: rr.RecordingStream,
    path: str,
    name: str,
    time_s: np.ndarray,
    values: np.ndarray,
    color: tuple[int, int, int],
    width: float,
) -> None:
    """A curve; rows without a number are left out."""
    rec.log(path, rr.SeriesLines(colors=color, names=name, widths=width), static=True)
    known = np.isfinite(values)
    rr.send_columns(
        path,
        [_times(time_s[known])],
        rr.Scalars.columns(scalars=values[known]),
        recording=rec,
    )


def _times(time_s: np.ndarray) -> rr.TimeColumn:
    return rr.TimeColumn(
        "time", duration=np.round(1e9 * time_s).astype("timedelta64[ns]")
    )


def _log_touch(
    rec: rr.RecordingStream, touch: TouchTrace, after: TouchTrace | None
) -> None:
    """Pads side by side; one row of pads each for measured and replayed."""
    rows = [("measured", touch.measured), (TWIN_NAMES[0], touch.replayed)]
    rows += [(TWIN_NAMES[1], after.replayed)] if after is not None else []
    top = max(1.0, *(float(values.max()) for _, values in rows))
    for k, (name, values) in enumerate(rows):
        image = _side_by_side(np.clip(np.round(values), 0, 65535).astype(np.uint16))
        path = f"/{_word(touch.recording)}/touch/{name}"
        height, width = image.shape[1:]
        rec.log(
            path,
            rr.Transform3D(translation=(0.0, k * (height + 6.0), 0.0)),
            static=True,
        )
        rec.log(path, depth_style(height, width, np.uint16, (0.0, top)), static=True)
        label = rr.Points2D(
            [(width / 2, -2.5)],
            labels=[f"{name}, {', '.join(touch.pads)}"],
            radii=0.001,
            show_labels=True,
        )
        rec.log(f"{path}/name", label, static=True)
        buffers = rr.DepthImage.columns(
            buffer=image.reshape(len(image), -1).view(np.uint8)
        )
        rr.send_columns(path, [_times(touch.time_s[:, 0])], buffers, recording=rec)


def _side_by_side(counts: np.ndarray) -> np.ndarray:
    """(N, P, R, C) → (N, R, columns of all pads and the gaps between them)."""
    frames, pads, rows, columns = counts.shape
    step = columns + PAD_GAP_TAXELS
    image = np.zeros((frames, rows, pads * step - PAD_GAP_TAXELS), dtype=counts.dtype)
    for p in range(pads):
        image[:, :, p * step : p * step + columns] = counts[:, p]
    return image


def _page(comparison: Comparison, after: Comparison | None) -> str:
    """What was compared with what, in Markdown."""
    twins = [comparison] if after is None else [comparison, after]
    names = [
        f"{name}: {escaped(c.twin)}, effects {escaped(', '.join(c.effects) or 'none')}"
        for name, c in zip(TWIN_NAMES, twins, strict=False)
    ]
    return markdown(
        Section(text=[escaped(origin_words(comparison.origins))], style="data"),
        Section(text=[*names, f"split: {escaped(comparison.split.get('rule', ''))}"]),
        how_far(*twins),
    )
