"""Figures of joints: response with its residual and regimes, heat map, residual along variables, error after each effect."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.along import Curve, variable_unit
from taccorl.diagnosis.comparison.localise import REGIMES, Cell, motions_of
from taccorl.diagnosis.comparison.localise_touch import EVERYWHERE
from taccorl.diagnosis.comparison.result import Trace, shown_unit
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.report.figure_style import (
    AFTER,
    BEFORE,
    COMMAND,
    FLOOR,
    MEASURED,
    floor_band,
    legend,
    new_figure,
    robust_limit,
    tidy,
)
from taccorl.report.section import floors

TWINS = ("twin", "twin with effect")
"""Default names of the twin before and after."""
LANES = ("near zero speed", "after a reversal", "high speed", "high load", "in contact")
"""Regimes drawn as bars below a residual."""


def joint_response(
    before: Trace, after: Trace | None = None, names: tuple[str, str] = TWINS
) -> Figure:
    """Figure of one joint over time: commanded, measured and replayed position, tracking error, residual, and regimes.
    ``after``: the same signal of the same recording, replayed by another twin. ``names``: names of the twins."""
    motion = motions_of([before])[0]
    lanes = [(r.name, r.rows(motion)) for r in REGIMES if r.name in LANES]
    lanes = [(name, rows) for name, rows in lanes if rows.any()]
    effort = before.kind == "effort"
    heights = [1.0] * (2 if effort else 3) + [0.2 + 0.14 * len(lanes)]
    title = f"{before.signal} {before.kind}: {before.recording} ({before.use.replace('_', '-')})"
    figure = new_figure(10.0, 1.2 + 2.0 * sum(heights), title, [before.origin])
    *axes, below = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    twins = [(before, BEFORE, names[0])] + (
        [(after, AFTER, names[1])] if after is not None else []
    )
    time_s, factor, unit = before.time_s, *shown_unit(before.unit)
    curves = [(before.measured, MEASURED, 2.4, "measured")]
    curves += [(trace.replayed, color, 1.0, name) for trace, color, name in twins]
    for values, color, lw, name in curves:
        axes[0].plot(time_s, values, color=color, lw=lw, label=name)
        if not effort:
            error = (values - before.target) * factor
            axes[1].plot(time_s, error, color=color, lw=lw, label=name)
    axes[0].set_ylabel(f"{before.kind} [{before.unit}]", fontsize=8)
    if not effort:
        axes[0].plot(
            time_s, before.target, color=COMMAND, lw=1.0, ls="--", label="command"
        )
        axes[1].set_ylabel(f"tracking error\nq − q* [{unit}]", fontsize=8)
    _residuals(axes[-1], twins)
    for axis in axes:
        tidy(axis)
        legend(axis)
    _lanes(below, time_s, lanes)
    return figure


def _lanes(
    axes: Axes, time_s: np.ndarray, lanes: Sequence[tuple[str, np.ndarray]]
) -> None:
    """A bar wherever the joint is in a regime."""
    for k, (_, rows) in enumerate(lanes):
        axes.fill_between(
            time_s,
            -k - 0.4,
            np.where(rows, -k + 0.4, -k - 0.4),
            step="post",
            color="#64748b",
            lw=0,
        )
    axes.set_yticks([-k for k in range(len(lanes))], [name for name, _ in lanes])
    axes.set_ylim(-len(lanes) + 0.5, 0.5)
    tidy(axes, "time [s]")
    axes.grid(axis="y", visible=False)


def _residuals(axes: Axes, twins: Sequence[tuple[Trace, str, str]]) -> None:
    """Measurement − replay, with the floor."""
    first = twins[0][0]
    factor, unit = shown_unit(first.unit)
    floor_band(axes, first.floor.value, first.unit)
    for trace, color, name in twins:
        rmse = float(np.sqrt(np.nanmean(trace.residual**2)))
        label = f"{name}: RMSE {rmse * factor:.3g} {unit}, {floors(rmse / trace.floor.value)} × floor"
        axes.plot(
            trace.time_s, trace.residual * factor, color=color, lw=0.9, label=label
        )
    limit = (
        robust_limit(
            np.concatenate([t.residual for t, _, _ in twins]), 2.5 * first.floor.value
        )
        * factor
    )
    axes.set_ylim(-limit, limit)
    axes.set_ylabel(f"residual\nmeasured − twin [{unit}]", fontsize=8)


def heat_map_figure(
    cells: Sequence[Cell], origins: Sequence[Origin], title: str, most: float = 0.0
) -> Figure:
    """Heat map, signal × regime, of RMSE over the noise floor. Empty cells have too few rows. ``most``: least upper end of the
    colour scale [noise floors]."""
    there, groups = (
        dict.fromkeys(c.regime for c in cells),
        {r.name: r.group for r in REGIMES},
    )
    known = [name for name in dict.fromkeys((*groups, *EVERYWHERE)) if name in there]
    regimes = [*known, *(name for name in there if name not in known)]
    signals = list(dict.fromkeys(c.signal for c in cells))
    ratio = np.full((len(signals), len(regimes)), np.nan)
    for c in cells:
        ratio[signals.index(c.signal), regimes.index(c.regime)] = c.ratio
    figure = new_figure(
        max(7.0, 3.6 + 0.62 * len(regimes)), 3.0 + 0.34 * len(signals), title, origins
    )
    axes = figure.subplots()
    top = max(10.0, most, float(np.nanmax(ratio)))
    image = axes.imshow(
        np.maximum(ratio, 1.0), cmap="YlOrRd", norm=LogNorm(1.0, top), aspect="auto"
    )
    for i, j in zip(*np.nonzero(np.isfinite(ratio)), strict=True):
        color = "white" if ratio[i, j] > top**0.7 else "#111111"
        axes.text(
            j,
            i,
            f"{ratio[i, j]:.3g}",
            ha="center",
            va="center",
            fontsize=7.5,
            color=color,
        )
    axes.set_xticks(range(len(regimes)), regimes, rotation=35, ha="right", fontsize=8)
    axes.set_yticks(range(len(signals)), signals, fontsize=8)
    bar = figure.colorbar(image, ax=axes, pad=0.02)
    bar.set_label("RMSE / noise floor", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    axes.set_xlabel(
        "where, not why: several causes show in the same regimes", fontsize=8
    )
    for k in range(1, len(regimes)):
        if groups.get(regimes[k]) != groups.get(regimes[k - 1]):
            axes.axvline(k - 0.5, color="white", lw=3)
    return figure


def residual_along_variables(
    before: Sequence[Curve],
    after: Sequence[Curve],
    traces: Sequence[Trace],
    names: tuple[str, str] = TWINS,
) -> Figure:
    """Figure of the mean or RMS residual along each variable, with its 95 % band. ``before``: curves of one signal with a
    twin. ``after``: curves of the same signal with another twin; empty without one. ``traces``: traces of the same signal, for
    its floor and units. ``names``: names of the twins."""
    first = traces[0]
    factor, unit = shown_unit(first.unit)
    columns = 3
    rows = -(-len(before) // columns)
    title = f"{first.signal} {first.kind}: residual along what physical effects depend on, {len(traces)} recordings"
    figure = new_figure(
        10.0, 1.2 + 2.5 * rows, title, list(dict.fromkeys(t.origin for t in traces))
    )
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    found = {c.variable: c for c in after}
    for axis, curve in zip(axes.flat, before, strict=False):
        floor_band(axis, first.floor.value, first.unit)
        shares = []
        for one, color, name in (
            (curve, BEFORE, names[0]),
            (found.get(curve.variable), AFTER, names[1]),
        ):
            if one is None:
                continue
            shares.append(
                f"{one.explained:.0%}" + "*" * (one.explained <= one.by_chance)
            )
            axis.fill_between(
                one.at,
                one.low * factor,
                one.high * factor,
                color=color,
                alpha=0.25,
                lw=0,
            )
            axis.plot(
                one.at,
                one.middle * factor,
                color=color,
                lw=1.4,
                marker="o",
                ms=2.5,
                label=f"{name}, 95 % band",
            )
        axis.set_title(
            f"{' → '.join(shares)} of the variance",
            fontsize=7,
            color="#4b5563",
            loc="right",
        )
        of = f"{curve.variable} [{variable_unit(curve.variable, first.position_unit)}]"
        tidy(axis, of, f"{curve.measure} residual [{unit}]")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower right", ncols=3, fontsize=7.5, frameon=False
    )
    for axis in list(axes.flat)[len(before) :]:
        axis.set_visible(False)
    return figure


@dataclass(frozen=True)
class Step:
    """One step of a waterfall: name of the added effect, and error after it."""

    label: str
    """Name of the added effect, or of the original twin."""
    error: float
    """Validation RMSE [noise floors]."""


def waterfall(steps: Sequence[Step], origins: Sequence[Origin], title: str) -> Figure:
    """Waterfall figure: validation error after each added effect, down to the noise floor. ``steps``: the original twin, then
    one entry for each effect."""
    goal = SearchConfig().floor
    figure = new_figure(max(6.0, 2.2 + 1.15 * len(steps)), 4.4, title, origins)
    axes = figure.subplots()
    axes.axhspan(0, 1.0, color=FLOOR, alpha=0.5, lw=0, label="noise floor (1.0)")
    axes.axhline(
        goal, color="#64748b", lw=1.0, ls="--", label=f"at the floor: ≤ {goal:g}"
    )
    for k, step in enumerate(steps):
        last = k == len(steps) - 1
        before = steps[k - 1].error if k else 0.0
        if k == 0:
            axes.bar(k, step.error, color=BEFORE, width=0.62)
        else:
            low, high = sorted((before, step.error))
            axes.bar(
                k,
                high - low,
                bottom=low,
                color="#0f766e" if step.error < before else "#b91c1c",
                width=0.62,
            )
            axes.plot(
                [k - 1.31 + 1.0 - 0.38, k + 0.31],
                [before, before],
                color="#9ca3af",
                lw=0.8,
            )
        if last and k:
            axes.plot([k - 0.31, k + 0.31], [step.error] * 2, color=AFTER, lw=3)
        change = f"\n{step.error / before - 1:+.0%}" if k and before > 0 else ""
        top = max(before, step.error)
        axes.annotate(
            f"{step.error:.3g}{change}",
            (k, top),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
    labels = [s.label if k == 0 else f"+ {s.label}" for k, s in enumerate(steps)]
    axes.set_xticks(range(len(steps)), labels, rotation=20, ha="right", fontsize=8)
    axes.set_ylim(0, 1.22 * max(s.error for s in steps))
    tidy(axes, y="validation RMSE / noise floor")
    axes.grid(axis="x", visible=False)
    legend(axes)
    return figure
