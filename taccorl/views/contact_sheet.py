"""Contact sheet of an episode: cameras and pads at a few instants, and below, touch and grippers over time.

Rows are instants, spread over the episode, one of them where touch is strongest. All pads share one fixed colour scale.
"""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from PIL import Image

from taccorl.data.episode import Episode, Pictures
from taccorl.views.colors import (
    ARM_COLORS,
    CONTACT_COLOR,
    LINE_COLORS,
    NOISE_COLOR,
    PAD_COLORS,
    heat,
)
from taccorl.views.groups import groups_of, short_name
from taccorl.views.outputs import save_png
from taccorl.views.part import part_of
from taccorl.views.provenance import outcome
from taccorl.views.touch import (
    CONTACT_THRESHOLD,
    MIN_ACTIVE_TAXELS,
    Pad,
    contact_gate,
    pads_of,
    peak_row,
)

NUM_INSTANTS = 6
DPI = 112
PICTURE_IN, LANE_IN, PLOT_IN = (
    2.0,
    0.28,
    1.3,
)  # heights [inches]; a picture of the data spec has 224 pixels
HEAD_IN, FOOT_IN, LABEL_IN, RIGHT_IN = 1.6, 0.6, 1.1, 1.9
GAP = 1 / 32  # of a picture's height: a taxel

SOFT, FAINT = "#64748b", "#e2e8f0"
ORIGIN_COLOR = (126, 34, 206)
GATE_COLORS = {True: CONTACT_COLOR, False: (203, 213, 225)}
STAGE_COLORS = (
    (147, 197, 253),
    (153, 246, 228),
    (253, 224, 71),
    (216, 180, 254),
    (251, 207, 232),
    (190, 242, 100),
)

Color = tuple[int, int, int]
Curve = tuple[str, Any, Color]
"""Name, values at each row (T,), or the one value of a horizontal line, and colour."""


def contact_sheet(episode: Episode, path: Path) -> None:
    """Draw the episode to a PNG at ``path``."""
    save_png(draw_sheet(episode), path, episode.name, str(episode.origin))


def draw_sheet(episode: Episode) -> Image.Image:
    """Draw the sheet as a picture."""
    canvas = FigureCanvasAgg(sheet_figure(episode))
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3])


def choose_instants(episode: Episode) -> tuple[int, ...]:
    """Choose at most ``NUM_INSTANTS`` rows of an episode, evenly spread, in ascending order. If there is touch, the row with the
    strongest touch takes the place of the chosen row nearest to it."""
    num = min(NUM_INSTANTS, episode.num_rows)
    rows = np.unique(np.linspace(0, episode.num_rows - 1, num).round().astype(int))
    pads = pads_of(episode)
    if pads and len(rows) > 2:
        rows[np.abs(rows - peak_row(pads)).argmin()] = peak_row(pads)
    return tuple(int(row) for row in rows)


def sheet_figure(episode: Episode) -> Figure:
    """The sheet as a figure. Axes are labelled by the camera or pad, or by what they show over time."""
    pads, curves, fps = pads_of(episode), _curves(episode), episode.spec.fps
    instants = choose_instants(episode) if episode.picture_keys or pads else ()
    shapes = {
        short_name(key): episode.spec.features[key].shape
        for key in episode.picture_keys
    }
    aspects = {name: shape[1] / shape[0] for name, shape in shapes.items()}
    aspects |= {pad.name: pad.sensor.columns / pad.sensor.rows for pad in pads}
    lanes = [
        name
        for name, there in (
            ("contact gate", bool(pads)),
            ("stage", bool(episode.stages)),
        )
        if there
    ]
    heights = [*[LANE_IN] * len(lanes), *[PLOT_IN] * len(curves)]
    above_in, below_in = PICTURE_IN * len(instants), 1.25 * sum(heights)
    inner_in = max(PICTURE_IN * sum(aspects.values()) * 1.03, 6.0)
    width, height = (
        LABEL_IN + inner_in + RIGHT_IN,
        HEAD_IN + above_in + below_in + FOOT_IN,
    )
    figure = Figure((width, height), dpi=DPI)
    sides = {"left": LABEL_IN / width, "right": 1 - RIGHT_IN / width}
    _draw_head(figure, episode)
    if instants:
        edges = {"top": 1 - HEAD_IN / height, "bottom": (below_in + FOOT_IN) / height}
        grid = figure.add_gridspec(
            1,
            len(aspects),
            **sides,
            **edges,
            wspace=0.05,
            width_ratios=[*aspects.values()],
        )
        _draw_instants(figure, grid, episode, instants, pads)
    if heights:
        edges = {
            "top": (0.94 * below_in + FOOT_IN) / height,
            "bottom": FOOT_IN / height,
        }
        grid = figure.add_gridspec(
            len(heights), 1, **sides, **edges, hspace=0.4, height_ratios=heights
        )
        for k, title in enumerate(titles := [*lanes, *curves]):
            axes = figure.add_subplot(
                grid[k], label=title, xlim=(0, episode.num_rows / fps)
            )
            if title in lanes:
                _draw_lane(axes, episode, title, pads)
            else:
                _draw_plot(axes, episode, title, curves[title])
            for row in instants:
                axes.axvline((row + 0.5) / fps, color=SOFT, lw=0.8, ls=":")
            axes.spines[:].set_visible(False)
            axes.tick_params(
                labelsize=9, labelcolor=SOFT, labelbottom=title == titles[-1], length=0
            )
        axes.set_xlabel(
            "time since the first row [s]; dotted: the instants above", color=SOFT
        )  # of the last one
    return figure


def _rgb(color: Color) -> tuple[float, ...]:
    return tuple(c / 255 for c in color)


def _curves(episode: Episode) -> dict[str, list[Curve]]:
    """Title of a plot → what it shows: grippers (or the whole state, where no element is one), touch sum and touch peak with
    what untouched taxels may show, and where contact begins."""
    plots: dict[str, list[Curve]] = {}
    feature = episode.spec.features.get("observation.state")
    if feature is not None and "observation.state" in episode.arrays:
        groups = groups_of(feature)
        for group in [g for g in groups if g.name == "grippers"] or groups:
            name = "gripper opening" if group.name == "grippers" else group.name
            plots[f"{name} [{group.unit}]" if group.unit else name] = [
                (
                    label,
                    episode.arrays["observation.state"][:, column],
                    ARM_COLORS.get(label, color),
                )
                for label, column, color in zip(
                    group.labels,
                    group.columns,
                    itertools.cycle(LINE_COLORS),
                    strict=False,
                )
            ]
    if pads := pads_of(episode):
        noise, gate = pads[0].sensor.noise_count, pads[0].gate_count
        colored = list(zip(pads, itertools.cycle(PAD_COLORS), strict=False))
        plots["touch sum of active taxels [counts above baseline]"] = [
            *((p.name, p.sum_count, color) for p, color in colored),
            (
                f"noise floor: {noise:g} a taxel",
                0.0,
                NOISE_COLOR,
            ),  # taxels at or below it are not added
        ]
        plots["touch peak [counts above baseline]"] = [
            *((p.name, p.peak_count, color) for p, color in colored),
            (f"noise floor {noise:g}", noise, NOISE_COLOR),
            (f"contact {gate:.3g}", gate, CONTACT_COLOR),
        ]
    return plots


def _draw_head(figure: Figure, episode: Episode) -> None:
    spec, (width, height) = episode.spec, figure.get_size_inches()
    facts = f"{episode.num_rows} rows, {episode.num_rows / spec.fps:.2f} s at {spec.fps} fps; {spec.robot_type}; {spec.name}"
    badge = {
        "boxstyle": "round,pad=0.35",
        "facecolor": _rgb(ORIGIN_COLOR),
        "edgecolor": "none",
    }
    lines: list[tuple[float, str, dict[str, Any]]] = [
        (0.2, episode.name, {"fontsize": 17}),
        (
            0.52,
            f"\u201c{episode.instruction}\u201d   outcome: {outcome(episode)}",
            {"fontsize": 11},
        ),
        (0.76, facts, {"fontsize": 10, "color": SOFT}),
        (
            1.03,
            f"data: {episode.origin}",
            {"fontsize": 11, "color": "white", "bbox": badge},
        ),
    ]
    for down_in, text, how in lines:
        figure.text(0.3 / width, 1 - down_in / height, text, va="top", **how)


def _draw_instants(
    figure: Figure,
    grid: Any,
    episode: Episode,
    instants: tuple[int, ...],
    pads: list[Pad],
) -> None:
    """One column a camera or pad, one below the other the instants."""
    shown, best = (
        dict(_pictures_at(episode, instants)),
        peak_row(pads) if pads else None,
    )
    columns = {
        short_name(key): _column([shown[row][key] for row in instants], 255)
        for key in episode.picture_keys
    }
    columns |= {
        p.name: _column(p.counts[list(instants)].astype(float), np.nan) for p in pads
    }
    most = max((p.sensor.max_count for p in pads), default=0)
    colors = {
        "cmap": ListedColormap(heat(np.linspace(0, 1, 256)) / 255),
        "vmin": 0,
        "vmax": most,
    }
    image = None
    for k, (name, column) in enumerate(columns.items()):
        axes = figure.add_subplot(grid[k], label=name, title=name, xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        image = axes.imshow(column, aspect="auto", interpolation_stage="rgba", **colors)
        if k == 0:
            words = [
                f"{row / episode.spec.fps:.2f} s\nrow {row}"
                + "\nmost touch" * (row == best)
                for row in instants
            ]
            axes.set_yticks(
                (np.arange(len(instants)) + 0.5) * len(column) / len(instants), words
            )
            axes.tick_params(length=0)
    if pads and image is not None:
        edge, gate, noise = (
            image.axes.get_position(),
            pads[0].gate_count,
            pads[0].sensor.noise_count,
        )
        high = 2 * edge.height / max(len(instants), 2)
        bar = figure.add_axes((edge.x1 + 0.015, edge.y1 - high, 0.012, high))
        words = {0: "0", noise: f"{noise:g} noise", gate: f"{gate:.3g} contact"}
        words |= {most / 2: f"{most / 2:g}", most: f"{most}"}
        figure.colorbar(image, cax=bar).set_ticks(
            list(words), labels=list(words.values()), fontsize=9
        )
        bar.set_title("counts above\nbaseline", fontsize=9, color=SOFT, loc="left")


def _column(pictures: Sequence[np.ndarray] | np.ndarray, gap: float) -> np.ndarray:
    """Pictures (rows, columns, …) one below the other, each followed by a ``GAP`` of its rows."""
    rows = max(1, round(GAP * len(pictures[0])))
    beside = [(0, 0)] * (pictures[0].ndim - 1)
    return np.concatenate(
        [
            np.pad(picture, [(0, rows), *beside], constant_values=gap)
            for picture in pictures
        ]
    )


def _pictures_at(
    episode: Episode, rows: tuple[int, ...]
) -> Iterator[tuple[int, Pictures]]:
    """Of a recording, decoded in one pass, and no further than the last wanted row."""
    if not episode.picture_keys:
        return
    if set(episode.picture_keys) <= set(episode.videos):
        for row in rows:
            yield (
                row,
                next(
                    part_of(
                        episode, row / episode.spec.fps, (row + 1) / episode.spec.fps
                    ).pictures()
                ),
            )
        return
    stream = itertools.islice(enumerate(episode.pictures()), max(rows) + 1)
    yield from ((row, pictures) for row, pictures in stream if row in rows)


def _draw_lane(axes: Axes, episode: Episode, title: str, pads: list[Pad]) -> None:
    if title == "stage":
        rows, names = (
            [row for row, _ in episode.stages],
            [name for _, name in episode.stages],
        )
        order = list(dict.fromkeys(names))
        colors = [STAGE_COLORS[order.index(name) % len(STAGE_COLORS)] for name in names]
    else:
        gate = contact_gate(pads)
        rows = [0, *(np.flatnonzero(np.diff(gate)) + 1)]
        names, colors = (
            ["contact" if gate[r] else "" for r in rows],
            [GATE_COLORS[bool(gate[r])] for r in rows],
        )
        rule = f"{MIN_ACTIVE_TAXELS} taxel beyond {CONTACT_THRESHOLD}"
        axes.text(
            1.01,
            0.5,
            rule,
            color=SOFT,
            fontsize=9,
            va="center",
            transform=axes.transAxes,
        )
    for start, end, name, color in zip(
        rows, [*rows[1:], episode.num_rows], names, colors, strict=True
    ):
        axes.axvspan(
            start / episode.spec.fps, end / episode.spec.fps, color=_rgb(color), lw=0
        )
        if 8 * len(name) < axes.bbox.width * (end - start) / episode.num_rows:  # pixels
            ink = "white" if color == CONTACT_COLOR else "black"
            axes.text(
                start / episode.spec.fps,
                0.5,
                f" {name}",
                color=ink,
                fontsize=9,
                va="center",
            )
    axes.set_ylabel(title, rotation=0, ha="right", va="center", fontsize=10)
    axes.set_yticks([])


def _draw_plot(axes: Axes, episode: Episode, title: str, curves: list[Curve]) -> None:
    time_s = (np.arange(episode.num_rows) + 0.5) / episode.spec.fps
    for name, values, color in curves:
        if np.ndim(values):
            axes.plot(time_s, values, color=_rgb(color), lw=1.4, label=name)
        else:
            axes.axhline(values, color=_rgb(color), lw=0.8, ls="--", label=name)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.grid(axis="y", color=FAINT)
    axes.set_title(title, loc="left", fontsize=10, pad=3)
    many = len(curves) > 6
    axes.legend(
        loc=2,
        bbox_to_anchor=(1, 1.05),
        frameon=False,
        ncols=1 + many,
        fontsize=9 - 3 * many,
        handlelength=1,
    )
