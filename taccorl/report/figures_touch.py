"""Figures of touch: histograms and maps of readings as in the paper (App. B.2); sums and errors over time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.cell_numbers import best_of, cell_errors
from taccorl.diagnosis.comparison.result import FELT_FLOORS, TouchTrace
from taccorl.report.figure_style import (
    AFTER,
    BEFORE,
    FLOOR,
    MEASURED,
    legend,
    new_figure,
    tidy,
)
from taccorl.report.figures import TWINS

BINS = 48
"""Number of bins of the histogram."""


def touch_histogram(
    before: Sequence[TouchTrace],
    after: Sequence[TouchTrace] = (),
    names: tuple[str, str] = TWINS,
) -> Figure:
    """Histogram of the readings of taxels above four noise floors. ``before``: pads of all recordings, replayed by a twin.
    ``after``: the same, replayed by another twin; empty without one. ``names``: names of the twins."""
    figure = new_figure(
        8.0,
        4.0,
        f"readings of active taxels, {len(before)} recordings",
        _origins(before),
    )
    axes = figure.subplots()
    least = FELT_FLOORS * float(np.median(before[0].floor))
    series = [
        (np.concatenate([getattr(t, field).ravel() for t in traces]), color, name)
        for field, color, traces, name in _series(before, after, names)
    ]
    top = max(float(values.max()) for values, _, _ in series)
    edges = np.linspace(least, max(top, 2 * least), BINS).tolist()
    axes.axvspan(
        0,
        least,
        color=FLOOR,
        alpha=0.45,
        lw=0,
        label=f"{FELT_FLOORS:g} × noise floor ({least:.2g} {before[0].unit})",
    )
    for values, color, name in series:
        active = values[values > least]
        label = (
            f"{name}: n = {len(active)}, mean {active.mean() if len(active) else 0:.3g}"
        )
        axes.hist(active, edges, histtype="step", color=color, lw=1.4, label=label)
    axes.set_yscale("log")
    axes.set_xlim(0, edges[-1])
    tidy(axes, f"{before[0].unit} above baseline", "readings")
    legend(axes, 2)
    return figure


def touch_maps(
    before: TouchTrace, after: TouchTrace | None = None, names: tuple[str, str] = TWINS
) -> Figure:
    """Maps of the pads at the frame of the strongest touch: measured, twin, and RMS residual of every taxel over time.
    ``after``: the same recording, replayed by another twin. ``names``: names of the twins."""
    strength = before.measured.sum(axis=(1, 2, 3)).astype(float)
    if before.touched is not None and before.touched.any():
        strength[
            ~before.touched.any(axis=1)
        ] = -np.inf  # a zero that drifts is no touch
    frame = int(np.argmax(strength))
    rows = [("measured", before.measured[frame]), (names[0], before.replayed[frame])]
    left = [(f"RMS residual, {names[0]}", before)]
    if after is not None:
        rows.append((names[1], after.replayed[frame]))
        left.append((f"RMS residual, {names[1]}", after))
    maps = rows + [(name, np.sqrt(np.mean(t.residual**2, axis=0))) for name, t in left]
    tops = [
        max(float(v.max()) for _, v in part)
        for part in (maps[: len(rows)], maps[len(rows) :])
    ]
    where = f"{before.recording} ({before.use.replace('_', '-')}), strongest touch at {before.time_s[frame, 0]:.2f} s"
    size_in = (1.7 * len(maps) + 0.8, 1.2 + 2.6 * len(before.pads))
    figure = new_figure(
        *size_in, f"{before.unit} above baseline: {where}", [before.origin]
    )
    axes = figure.subplots(len(before.pads), len(maps), squeeze=False)
    for j, (name, values) in enumerate(maps):
        residual = j >= len(rows)
        top = tops[residual] or 1.0
        for p, pad in enumerate(before.pads):
            axis = axes[p, j]
            cmap = "magma" if residual else "turbo"
            image = axis.imshow(values[p], cmap=cmap, vmin=0, vmax=top, aspect="equal")
            axis.set_xticks([])
            axis.set_yticks([])
            if p == 0:
                axis.set_title(name, fontsize=7.5)
            if j == 0:
                axis.set_ylabel(
                    f"{pad} ({before.thirds[0]} above)" if before.thirds else pad,
                    fontsize=8,
                )
        if j in (len(rows) - 1, len(maps) - 1):
            bar = figure.colorbar(image, ax=axes[:, j].tolist(), shrink=0.5, pad=0.02)
            bar.ax.tick_params(labelsize=7)
            noise = f"noise floor {np.median(before.floor):.2g}"
            bar.set_label(
                before.unit if not residual else f"{before.unit}, RMS ({noise})",
                fontsize=7.5,
            )
    return figure


def cell_maps(traces: Sequence[TouchTrace], name: str) -> Figure:
    """Maps of a grid of cells: gain, offset, noise floor, and error over the noise floor. ``traces``: all recordings of a
    sensor with ``cells``, replayed by one twin. ``name``: name of the twin."""
    first = traces[0]
    assert first.cells is not None
    maps = (
        ("gain", first.cells.gain, f"{first.unit}/{first.load_unit}"),
        ("offset", first.cells.offset, first.unit),
        ("noise floor", first.floor[0], first.unit),
        ("RMSE / noise floor", cell_errors(traces), "× floor"),
    )
    rows, columns = first.cells.gain.shape
    size_in = (12.0, 1.2 + min(max(2.4 * rows / columns, 1.2), 6.0))
    title = f"cells of {first.pads[0]}, {name}: {len(traces)} recordings together{best_of(first.cells).replace('each', 'gains')}"
    figure = new_figure(*size_in, title, _origins(traces))
    for axis, (what, values, unit) in zip(
        figure.subplots(1, len(maps)), maps, strict=True
    ):
        image = axis.imshow(
            values, cmap="viridis", aspect="equal", interpolation="nearest"
        )
        axis.set_title(what, fontsize=8)
        axis.set_xlabel("column", fontsize=7.5)
        axis.set_ylabel("row", fontsize=7.5)
        for side in (axis.xaxis, axis.yaxis):
            side.set_major_locator(MaxNLocator(8, integer=True))
        axis.tick_params(labelsize=7)
        bar = figure.colorbar(image, ax=axis, shrink=0.8, pad=0.03)
        bar.ax.tick_params(labelsize=7)
        bar.set_label(unit, fontsize=7.5)
    return figure


def touch_over_time(
    before: TouchTrace, after: TouchTrace | None = None, names: tuple[str, str] = TWINS
) -> Figure:
    """Sum of each pad over time (loading, hold, unloading, remainder after release), and below it the error of its taxels.
    ``after``: the same recording, replayed by another twin. ``names``: names of the twins."""
    title = f"sum of each pad, and RMS error of its taxels: {before.recording} ({before.use.replace('_', '-')})"
    figure = new_figure(10.0, 1.4 + 3.0 * len(before.pads), title, [before.origin])
    rows = figure.subplots(
        2 * len(before.pads),
        1,
        sharex=True,
        squeeze=False,
        height_ratios=[1.7, 1.3] * len(before.pads),
    )
    axes, below = rows[::2, 0], rows[1::2, 0]
    for p, pad in enumerate(before.pads):
        _error_over_time(below[p], before, after, p)
        floor = 2 * float(np.sqrt((before.floor[p] ** 2).sum()))
        axes[p].axhspan(
            -floor,
            floor,
            color=FLOOR,
            alpha=0.45,
            lw=0,
            label=f"noise floor ± {floor:.3g}",
        )
        later = [] if after is None else [after]
        for field, color, (trace,), name in _series([before], later, names):
            axes[p].plot(
                before.time_s[:, p],
                getattr(trace, field)[:, p].sum(axis=(1, 2)),
                color=color,
                lw=1.1,
                label=name,
            )
        tidy(axes[p], y=f"{pad}, sum\n[{before.unit}]")
    legend(axes[0])
    below[-1].set_xlabel("time [s]", fontsize=8)
    return figure


def reading_over_load(
    before: Sequence[TouchTrace],
    after: Sequence[TouchTrace] = (),
    names: tuple[str, str] = TWINS,
) -> Figure:
    """Reading of the most loaded cell over its load, measured and simulated: curvature indicates a nonlinear law, a loop
    memory. ``before, after, names``: as in ``touch_histogram``."""
    first = before[0]
    assert first.load is not None
    strongest = np.max(
        [np.max(t.load, axis=0) for t in before if t.load is not None], axis=0
    )
    cell = np.unravel_index(int(np.argmax(strongest)), strongest.shape)
    where = f"{first.pads[cell[0]]}" + (
        f"[{cell[1]}, {cell[2]}]" if strongest.size > 1 else ""
    )
    figure = new_figure(
        8.0,
        4.6,
        f"reading over load of {where}, {len(before)} recordings",
        _origins(before),
    )
    axes = figure.subplots()
    for field, color, traces, name in _series(before, after, names):
        for k, t in enumerate(traces):
            assert t.load is not None
            load, reading = t.load[:, *cell], getattr(t, field)[:, *cell]
            axes.plot(
                load,
                reading,
                color=color,
                lw=0.8,
                alpha=0.7,
                label=name if k == 0 else None,
            )
    tidy(axes, f"load [{first.load_unit}]", f"{first.unit} above baseline")
    legend(axes)
    return figure


def _error_over_time(
    axes: Axes, before: TouchTrace, after: TouchTrace | None, pad: int
) -> None:
    """RMS over the taxels that feel something at some time, in every frame; noise alone stays at the floor."""
    felt = before.felt(pad)
    floor = (
        float(np.sqrt(np.mean(before.floor[pad][felt] ** 2)))
        if felt.any()
        else float(np.median(before.floor[pad]))
    )
    axes.axhspan(0, floor, color=FLOOR, alpha=0.45, lw=0)
    for trace, color in ((before, BEFORE), (after, AFTER)):
        if trace is not None and felt.any():
            error = np.sqrt(np.mean(trace.residual[:, pad][:, felt] ** 2, axis=1))
            axes.plot(trace.time_s[:, pad], error, color=color, lw=0.9)
    axes.set_ylim(bottom=0)
    tidy(axes, y=f"RMS error of\n{felt.sum()} cells [{before.unit}]")


def _series(
    before: Sequence[TouchTrace], after: Sequence[TouchTrace], names: tuple[str, str]
) -> list[tuple[str, str, Sequence[TouchTrace], str]]:
    """Field of the traces, colour, traces and name of each curve: measured, and replayed by
    the one or two twins."""
    found = [
        ("measured", MEASURED, before, "measured"),
        ("replayed", BEFORE, before, names[0]),
        ("replayed", AFTER, after, names[1]),
    ]
    return [one for one in found if one[2]]


def _origins(traces: Sequence[TouchTrace]) -> list[Origin]:
    return list(dict.fromkeys(t.origin for t in traces))
