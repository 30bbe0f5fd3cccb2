"""Common style of all figures: colours, readable units, label of the data's origin.

The measurement is black, the twin before a change orange, after it blue (Okabe and Ito's colours, distinguishable with colour
blindness), the noise floor a grey band.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.result import origin_words, shown, shown_unit

MEASURED, BEFORE, AFTER, COMMAND, FLOOR = (
    "#111111",
    "#d55e00",
    "#0072b2",
    "#7a7a7a",
    "#b8bec8",
)
DOTS_PER_INCH = 110
"""Resolution of the figures."""


def new_figure(
    width_in: float, height_in: float, title: str, origins: Sequence[Origin]
) -> Figure:
    """Create a figure of ``width_in`` × ``height_in`` inches with the origin of the data in its second title line."""
    figure = Figure(
        figsize=(width_in, height_in), layout="constrained", dpi=DOTS_PER_INCH
    )
    FigureCanvasAgg(figure)
    figure.suptitle(f"{title}\n", fontsize=11, fontweight="bold", x=0.01, ha="left")
    figure.text(
        0.012,
        0.997 - 0.24 / height_in,
        origin_words(origins),
        fontsize=8,
        color="#6b7280",
        ha="left",
        va="top",
    )
    return figure


def floor_band(axes: Axes, floor: float, unit: str) -> None:
    """Draw the band of ± 2 noise floors, in which 95 % of a perfect twin's residual would lie. ``floor``: noise floor in
    ``unit``; the axis is in the unit for display (``shown_unit``)."""
    high = 2 * floor * shown_unit(unit)[0]
    axes.axhspan(
        -high,
        high,
        color=FLOOR,
        alpha=0.45,
        lw=0,
        label=f"noise floor: ± 2 × {shown(floor, unit)}",
        zorder=0,
    )


def tidy(axes: Axes, x: str = "", y: str = "") -> None:
    """Draw a faint grid, remove the box, and label the axes."""
    axes.set_xlabel(x or axes.get_xlabel(), fontsize=8)
    axes.set_ylabel(y or axes.get_ylabel(), fontsize=8)
    axes.grid(True, color="#e5e7eb", lw=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(labelsize=8)


def legend(axes: Axes, columns: int = 4) -> None:
    """Draw the legend above the axes on the right, where it covers no line."""
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=columns,
        fontsize=7.5,
        frameon=False,
        borderpad=0.1,
    )


def robust_limit(values: np.ndarray, least: float) -> float:
    """Limit of a symmetric axis: the 99.9 % quantile of |``values``|, (n,) or of any shape, with a margin of 15 %, but at least
    1.15 ``least``; NaN are ignored."""
    values = np.abs(values[np.isfinite(values)])
    return 1.15 * max(float(np.quantile(values, 0.999)) if len(values) else 0.0, least)
