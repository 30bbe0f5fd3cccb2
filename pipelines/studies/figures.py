"""Figures of the studies: confusion of effects, and detection as a function of size."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
from scipy.stats import binomtest

from taccorl.data.origin import Origin
from taccorl.report.figure_style import AFTER, BEFORE, FLOOR, new_figure, tidy


def confusion_matrix(
    counts: Mapping[str, Mapping[str, int]], origins: Sequence[Origin], title: str
) -> Figure:
    """Confusion matrix: hidden effect × named effect. Rows add up to the number of seeds.

    Args:
        counts: hidden → named → number of seeds; names other than hidden effects ("nothing", "something else") come last.
    """
    hidden = list(counts)
    named = [
        *hidden,
        *dict.fromkeys(n for row in counts.values() for n in row if n not in counts),
    ]
    named = [
        n for n in named if n in hidden or any(row.get(n) for row in counts.values())
    ]
    table = np.array(
        [[counts[h].get(n, 0) for n in named] for h in hidden], dtype=float
    )
    share = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    figure = new_figure(
        3.4 + 0.42 * len(named), 3.0 + 0.32 * len(hidden), title, origins
    )
    axes = figure.subplots()
    image = axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in zip(*np.nonzero(table), strict=True):
        color = "white" if share[i, j] > 0.6 else "#111111"
        axes.text(
            j,
            i,
            f"{table[i, j]:.0f}",
            ha="center",
            va="center",
            fontsize=7.5,
            color=color,
        )
        if hidden[i] == named[j]:
            axes.add_patch(
                Rectangle((j - 0.5, i - 0.5), 1, 1, fill=False, ec="#0f766e", lw=1.4)
            )
    axes.set_xticks(range(len(named)), named, rotation=60, ha="right", fontsize=7.5)
    seeds = table.sum(axis=1)
    axes.set_yticks(
        range(len(hidden)),
        [f"{h} (n = {n:.0f})" for h, n in zip(hidden, seeds, strict=True)],
        fontsize=7.5,
    )
    axes.set_xlabel("named", fontsize=8)
    axes.set_ylabel("hidden", fontsize=8)
    bar = figure.colorbar(image, ax=axes, pad=0.02)
    bar.set_label("share of seeds", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return figure


SLOPE = 5.0
"""Slope of all detection curves, in log odds over log signal: from 10 to 90 % within a factor of 2.4 of the signal."""


def half_detected(
    signals: np.ndarray, found: np.ndarray, slope: float = SLOPE
) -> tuple[float, float, float]:
    """Signal-to-noise ratio at which half the seeds find an effect, with its 95 % interval: maximum-likelihood s½ of p = 1 / (1
    + (s½ / s)^slope).

    Args:
        signals: (n,) signal-to-noise ratios of single seeds, above 0.
        found: (n,) bool, whether the seed found the effect.

    Returns:
        s½ and the ends of its interval by likelihood ratio; 0 and inf stand for an end that the seeds do not determine.
    """
    grid = np.geomspace(0.02, 200.0, 2000)
    odds = slope * (np.log(signals)[:, None] - np.log(grid))
    likely = -np.logaddexp(0.0, np.where(found[:, None], -odds, odds)).sum(axis=0)
    inside = np.flatnonzero(likely > likely.max() - 1.92)
    best = grid[int(np.argmax(likely))]
    low = 0.0 if inside[0] == 0 else grid[inside[0]]
    high = np.inf if inside[-1] == len(grid) - 1 else grid[inside[-1]]
    return float(best), float(low), float(high)


def detection_curves(
    points: Mapping[str, tuple[np.ndarray, np.ndarray]],
    origins: Sequence[Origin],
    title: str,
    edges: Sequence[float],
) -> Figure:
    """Detection curves, one panel per effect: share of seeds that found it over signal-to-noise, with 95 % Wilson intervals.

    Args:
        points: effect → signals (n,) and whether it was found (n,).
        edges: edges of the bins in which seeds are counted together.
    """
    columns = 5
    rows = -(-len(points) // columns)
    figure = new_figure(12.0, 1.2 + 1.75 * rows, title, origins)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    line = np.geomspace(edges[0], edges[-1], 200)
    for axes, (name, (signals, found)) in zip(
        panels.flat, points.items(), strict=False
    ):
        axes.axvline(1.0, color=FLOOR, lw=2.5)
        axes.axhline(0.5, color="#64748b", lw=0.8, ls="--")
        bins = np.digitize(signals, edges)
        for k in np.unique(bins):
            own = bins == k
            count, n = int(found[own].sum()), int(own.sum())
            ends = binomtest(count, n).proportion_ci(method="wilson")
            x = float(np.exp(np.mean(np.log(signals[own]))))
            axes.plot([x, x], [ends.low, ends.high], color=AFTER, lw=0.9, alpha=0.6)
            axes.plot(x, count / n, "o", color=AFTER, ms=3.5)
        half, low, high = half_detected(signals, found)
        if low > 0 and np.isfinite(high):  # seeds on both sides of it
            axes.plot(line, 1.0 / (1.0 + (half / line) ** SLOPE), color=BEFORE, lw=1.2)
        axes.set_title(f"{name} (n = {len(signals)})", fontsize=8)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0,)))
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylim(-0.04, 1.06)
        tidy(axes)
    for k, axes in enumerate(panels.flat):
        axes.tick_params(labelbottom=len(points) - columns <= k < len(points))
        if k >= len(points):
            axes.set_axis_off()
    figure.supxlabel("signal of the effect / noise floor (grey line: 1)", fontsize=8)
    figure.supylabel("share of seeds in which it is found or named", fontsize=8)
    return figure
