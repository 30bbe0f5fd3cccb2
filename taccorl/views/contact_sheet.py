"""Contact sheet of an episode: cameras and pads at a few instants, and below, touch and grippers over time.

Rows are instants, spread over the episode, one of them where touch is strongest. All pads share one fixed colour scale.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from taccorl.data.episode import Episode, Pictures
from taccorl.views.colors import ARM_COLORS, CONTACT_COLOR, LINE_COLORS, NOISE_COLOR, PAD_COLORS, heat
from taccorl.views.groups import groups_of, short_name
from taccorl.views.outputs import save_png
from taccorl.views.part import part_of
from taccorl.views.provenance import outcome
from taccorl.views.touch import CONTACT_THRESHOLD, MIN_ACTIVE_TAXELS, Pad, contact_gate, pads_of, peak_row

NUM_INSTANTS = 6

# Pixels.
MARGIN = 28
LABEL_WIDTH = 104
CELL_HEIGHT = 224  # a picture of the data spec, or 32 taxels of 7 pixels
GAP = 8
HEAD_HEIGHT = 132
SCALE_WIDTH = 120
STRIP_HEIGHT = 22
PLOT_HEIGHT = 110
PLOT_GAP = 34
LEGEND_WIDTH = 150

PAPER, INK, SOFT, FAINT = (255, 255, 255), (15, 23, 42), (100, 116, 139), (226, 232, 240)
ORIGIN_COLOR = (126, 34, 206)
GATE_COLORS = {True: CONTACT_COLOR, False: (203, 213, 225)}
STAGE_COLORS = ((147, 197, 253), (153, 246, 228), (253, 224, 71), (216, 180, 254), (251, 207, 232), (190, 242, 100))


Color = tuple[int, int, int]
Mark = tuple[str, float, Color]
"""Name, value and colour of a horizontal line."""


@dataclass(frozen=True)
class Line:
    """One curve of a plot: name, values, colour and width."""

    name: str
    values: np.ndarray
    """(T,) value at each row."""
    color: Color
    width: int = 2


@dataclass(frozen=True)
class Layout:
    """Positions of the elements on the sheet [pixels], for tests."""

    instants: tuple[int, ...]
    """Rows of the episode that are shown."""
    cells: dict[tuple[int, str], tuple[int, int, int, int]]
    """(index of the instant, camera or pad name) → left, top, right, bottom."""
    plots: dict[str, tuple[int, int, int, int]]
    """Title of a plot → left, top, right, bottom."""
    size: tuple[int, int]


def contact_sheet(episode: Episode, path: Path) -> Layout:
    """Draw the episode to a PNG at ``path``."""
    image, layout = draw_sheet(episode)
    save_png(image, path, episode.name, str(episode.origin))
    return layout


def choose_instants(episode: Episode, num: int = NUM_INSTANTS) -> tuple[int, ...]:
    """Return at most ``num`` rows, ascending, spread evenly from first to last; the one nearest to the strongest touch is
    replaced by the row of the strongest touch."""
    rows = np.unique(np.linspace(0, episode.num_rows - 1, min(num, episode.num_rows)).round().astype(int))
    pads = pads_of(episode)
    if pads and len(rows) > 2:
        rows[np.abs(rows - peak_row(pads)).argmin()] = peak_row(pads)
    return tuple(int(row) for row in rows)


def draw_sheet(episode: Episode) -> tuple[Image.Image, Layout]:
    """Draw the sheet; returns the picture and the positions of its elements."""
    pads, plots = pads_of(episode), _plots(episode)
    layout = _arrange(episode, pads, list(plots))
    sheet = _Sheet(layout)
    _draw_head(sheet, episode)
    _draw_labels(sheet, episode, pads)
    if pads:
        _draw_scale(sheet, pads)
    for title, box in layout.plots.items():
        axes = sheet.axes(box)
        axes.set_xlim(0, episode.num_rows / episode.spec.fps)
        if title in plots:
            _draw_plot(axes, episode, title, plots[title], _marks(title, pads))
        else:
            _draw_lane(axes, episode, pads, title)
        for row in layout.instants:
            axes.axvline((row + 0.5) / episode.spec.fps, color=_rgb(SOFT), lw=0.8, ls=":")
        axes.spines[:].set_visible(False)
        last = title == list(layout.plots)[-1]
        axes.tick_params(labelsize=9, labelcolor=_rgb(SOFT), labelbottom=last, length=0)
        axes.set_xlabel("time since the first row [s]; dotted: the instants above" * last, color=_rgb(SOFT))
    image = sheet.image()
    _paste_pictures(image, episode, pads, layout)
    return image, layout


class _Sheet:
    """A figure with one unit a pixel, from the upper left."""

    def __init__(self, layout: Layout) -> None:
        self.layout, (self.width, self.height) = layout, layout.size
        self.figure = Figure(figsize=(self.width / 100, self.height / 100), dpi=100)
        FigureCanvasAgg(self.figure)

    def text(self, x: float, y: float, text: str, color: Color, size: float, **how: Any) -> None:
        """Write ``text`` with its upper left corner at (x, y) unless ``how`` says otherwise; ``size`` in pixels."""
        place = x / self.width, 1 - y / self.height
        self.figure.text(*place, text, **{"color": _rgb(color), "fontsize": 0.72 * size, "va": "top", **how})

    def axes(self, box: tuple[float, float, float, float]) -> Axes:
        """Axes that fill left, top, right, bottom."""
        (left, top, right, bottom), w, h = box, self.width, self.height
        return self.figure.add_axes((left / w, 1 - bottom / h, (right - left) / w, (bottom - top) / h))

    def image(self) -> Image.Image:
        canvas = FigureCanvasAgg(self.figure)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3])


def _rgb(color: Color) -> tuple[float, ...]:
    return tuple(c / 255 for c in color)


def _arrange(episode: Episode, pads: list[Pad], titles: list[str]) -> Layout:
    instants = choose_instants(episode) if episode.picture_keys or pads else ()
    widths = {}
    for key in episode.picture_keys:
        rows, columns, _ = episode.spec.features[key].shape
        widths[short_name(key)] = round(CELL_HEIGHT * columns / rows)
    for pad in pads:
        widths[pad.name] = round(CELL_HEIGHT * pad.sensor.columns / pad.sensor.rows)
    cells, x, bottom = {}, MARGIN + LABEL_WIDTH, HEAD_HEIGHT
    for name, width in widths.items():
        for n in range(len(instants)):
            top = HEAD_HEIGHT + 34 + n * (CELL_HEIGHT + GAP)
            cells[n, name] = (x, top, x + width, top + CELL_HEIGHT)
            bottom = top + CELL_HEIGHT
        x += width + GAP
    right = max(x + (SCALE_WIDTH if pads else 0), 900)
    places, y = {}, bottom + PLOT_GAP
    lanes = [name for name, there in (("contact gate", bool(pads)), ("stage", bool(episode.stages))) if there]
    for title in [*lanes, *titles]:
        height = STRIP_HEIGHT if title in lanes else PLOT_HEIGHT
        y += 0 if title in lanes else PLOT_GAP - 10
        places[title] = (MARGIN + LABEL_WIDTH, y, right - LEGEND_WIDTH, y + height)
        y += height + GAP
    return Layout(instants, cells, places, (right + MARGIN, y + 60))


def _plots(episode: Episode) -> dict[str, list[Line]]:
    """Title → curves: grippers (or the whole state, where no element is one), touch sum and touch peak."""
    plots = {}
    feature = episode.spec.features.get("observation.state")
    if feature is not None and "observation.state" in episode.arrays:
        groups = groups_of(feature)
        for group in [g for g in groups if g.name == "grippers"] or groups:
            name = "gripper opening" if group.name == "grippers" else group.name
            plots[f"{name} [{group.unit}]" if group.unit else name] = [
                Line(label, episode.arrays["observation.state"][:, column], ARM_COLORS.get(label, color))
                for label, column, color in zip(group.labels, group.columns, itertools.cycle(LINE_COLORS), strict=False)
            ]
    pads = pads_of(episode)
    if pads:
        colored = list(zip(pads, itertools.cycle(PAD_COLORS), strict=False))
        plots["touch sum of active taxels [counts above baseline]"] = [
            Line(p.name, p.sum_count, color) for p, color in colored
        ]
        plots["touch peak [counts above baseline]"] = [Line(p.name, p.peak_count, color) for p, color in colored]
    return plots


def _marks(title: str, pads: list[Pad]) -> list[Mark]:
    """Horizontal lines of a plot: what untouched taxels may show, and where contact begins."""
    if "peak" in title:
        noise, gate = pads[0].sensor.noise_count, pads[0].gate_count
        return [(f"noise floor {noise:g}", noise, NOISE_COLOR), (f"contact {gate:.3g}", gate, CONTACT_COLOR)]
    if "sum" in title:  # taxels at or below the noise floor are not added: it is this plot's zero
        return [(f"noise floor: {pads[0].sensor.noise_count:g} a taxel", 0.0, NOISE_COLOR)]
    return []


def _draw_head(sheet: _Sheet, episode: Episode) -> None:
    spec = episode.spec
    sheet.text(MARGIN, 18, episode.name, INK, 26)
    sheet.text(MARGIN, 54, f"\u201c{episode.instruction}\u201d   outcome: {outcome(episode)}", INK, 17)
    facts = f"{episode.num_rows} rows, {episode.num_rows / spec.fps:.2f} s at {spec.fps} fps; {spec.robot_type}; {spec.name}"
    sheet.text(MARGIN, 79, facts, SOFT, 15)
    badge = {"boxstyle": "round,pad=0.35", "facecolor": _rgb(ORIGIN_COLOR), "edgecolor": "none"}
    sheet.text(MARGIN + 8, 107, f"data: {episode.origin}", PAPER, 17, bbox=badge)


def _draw_labels(sheet: _Sheet, episode: Episode, pads: list[Pad]) -> None:
    for (n, name), (left, top, right, _) in sheet.layout.cells.items():
        if n == 0:
            sheet.text((left + right) / 2, top - 8, name, INK, 15, ha="center", va="bottom")
    best = peak_row(pads) if pads else None
    for n, row in enumerate(sheet.layout.instants):
        top = HEAD_HEIGHT + 34 + n * (CELL_HEIGHT + GAP)
        sheet.text(MARGIN, top + 4, f"{row / episode.spec.fps:.2f} s", INK, 20)
        sheet.text(MARGIN, top + 32, f"row {row}", SOFT, 15)
        if row == best:
            sheet.text(MARGIN, top + 54, "most touch", CONTACT_COLOR, 15)


def _paste_pictures(image: Image.Image, episode: Episode, pads: list[Pad], layout: Layout) -> None:
    shown = dict(_pictures_at(episode, layout.instants))
    for (n, name), (left, top, right, bottom) in layout.cells.items():
        picture = next((p for key, p in shown.get(layout.instants[n], {}).items() if short_name(key) == name), None)
        if picture is None:
            pad = next(p for p in pads if p.name == name)
            picture = heat(pad.counts[layout.instants[n]] / pad.sensor.max_count)
        size = (right - left, bottom - top)
        method = Image.Resampling.NEAREST if picture.shape[0] < size[1] / 2 else Image.Resampling.LANCZOS
        image.paste(Image.fromarray(picture).resize(size, method), (left, top))


def _pictures_at(episode: Episode, rows: tuple[int, ...]) -> Iterator[tuple[int, Pictures]]:
    """Of a recording, decoded in one pass, and no further than the last wanted row."""
    if not episode.picture_keys:
        return
    if set(episode.picture_keys) <= set(episode.videos):
        for row in rows:
            yield row, next(part_of(episode, row / episode.spec.fps, (row + 1) / episode.spec.fps).pictures())
        return
    stream = itertools.islice(enumerate(episode.pictures()), max(rows) + 1)
    yield from ((row, pictures) for row, pictures in stream if row in rows)


def _draw_scale(sheet: _Sheet, pads: list[Pad]) -> None:
    sensor, (_, top, left, _) = pads[0].sensor, sheet.layout.cells[0, pads[-1].name]
    axes = sheet.axes((left + 2 * GAP, top, left + 2 * GAP + 18, top + 2 * CELL_HEIGHT))
    shades = heat(np.linspace(0, 1, 256)[:, None])
    axes.imshow(shades, origin="lower", aspect="auto", extent=(0, 1, 0, sensor.max_count))
    words = {0: "0", sensor.noise_count: f"{sensor.noise_count:g} noise"}
    words |= {pads[0].gate_count: f"{pads[0].gate_count:.3g} contact"}
    words |= {count: f"{count:g}" for count in (sensor.max_count / 2, sensor.max_count)}
    axes.yaxis.tick_right()
    axes.set_yticks(list(words), list(words.values()), fontsize=9)
    axes.set_xticks([])
    sheet.text(left + 2 * GAP, top + 2 * CELL_HEIGHT + 10, "counts\nabove\nbaseline", SOFT, 13)


def _draw_lane(axes: Axes, episode: Episode, pads: list[Pad], title: str) -> None:
    if title == "stage":
        rows, names = [row for row, _ in episode.stages], [name for _, name in episode.stages]
        order = list(dict.fromkeys(names))
        colors = [STAGE_COLORS[order.index(name) % len(STAGE_COLORS)] for name in names]
    else:
        gate = contact_gate(pads)
        rows = [0, *(np.flatnonzero(np.diff(gate)) + 1)]
        names, colors = ["contact" if gate[r] else "" for r in rows], [GATE_COLORS[bool(gate[r])] for r in rows]
        rule = f"{MIN_ACTIVE_TAXELS} taxel beyond {CONTACT_THRESHOLD}"
        axes.text(1.01, 0.5, rule, color=_rgb(SOFT), fontsize=9, va="center", transform=axes.transAxes)
    for start, end, name, color in zip(rows, [*rows[1:], episode.num_rows], names, colors, strict=True):
        axes.axvspan(start / episode.spec.fps, end / episode.spec.fps, color=_rgb(color), lw=0)
        if 8 * len(name) < axes.bbox.width * (end - start) / episode.num_rows:  # pixels
            ink = PAPER if color == CONTACT_COLOR else INK
            axes.text(start / episode.spec.fps, 0.5, f" {name}", color=_rgb(ink), fontsize=9, va="center")
    axes.set_ylabel(title, rotation=0, ha="right", va="center", fontsize=10)
    axes.set_yticks([])


def _draw_plot(axes: Axes, episode: Episode, title: str, lines: list[Line], marks: list[Mark]) -> None:
    values = np.concatenate([line.values for line in lines])
    low, high = min(0.0, float(values.min())), max(float(values.max()), *(m[1] for m in marks), 1e-9)
    ticks = MaxNLocator(4, steps=[1, 2, 5, 10]).tick_values(low, high)
    axes.set_yticks(ticks)
    axes.set_ylim(ticks[0], ticks[-1])
    axes.grid(axis="y", color=_rgb(FAINT))
    time_s = (np.arange(episode.num_rows) + 0.5) / episode.spec.fps
    for line in lines:
        axes.plot(time_s, line.values, color=_rgb(line.color), lw=0.72 * line.width, label=line.name)
    for name, value, color in marks:
        axes.axhline(value, color=_rgb(color), lw=0.72, ls="--", label=name)
    axes.set_title(title, loc="left", fontsize=10, pad=3)
    many = len(lines) + len(marks) > 6
    axes.legend(loc=2, bbox_to_anchor=(1, 1.05), frameon=False, ncols=1 + many, fontsize=9 - 3 * many, handlelength=1)
