"""Contact sheet of an episode: cameras and pads at a few instants, and below, touch and grippers over time.

Rows are instants, spread over the episode, one of them where touch is strongest. All pads share one fixed colour scale.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

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


@dataclass(frozen=True)
class Line:
    """One curve of a plot: name, values, colour and width."""

    name: str
    values: np.ndarray
    """(T,) value at each row."""
    color: tuple[int, int, int]
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
    image = Image.new("RGB", layout.size, PAPER)
    draw = ImageDraw.Draw(image)
    _draw_head(draw, episode, layout)
    _draw_cells(image, draw, episode, pads, layout)
    if pads:
        _draw_scale(image, draw, pads, layout)
    for title, box in layout.plots.items():
        if title in plots:
            _draw_plot(image, draw, title, box, plots[title], _marks(title, pads))
        else:
            _draw_lane(draw, episode, pads, title, box)
    _draw_time_axis(draw, episode, layout)
    return image, layout


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


def _marks(title: str, pads: list[Pad]) -> list[tuple[str, float, tuple[int, int, int]]]:
    """Horizontal lines of a plot: what untouched taxels may show, and where contact begins."""
    if "peak" in title:
        sensor = pads[0].sensor
        return [
            (f"noise floor {sensor.noise_count:g}", sensor.noise_count, NOISE_COLOR),
            (f"contact {pads[0].gate_count:.3g}", pads[0].gate_count, CONTACT_COLOR),
        ]
    if "sum" in title:  # taxels at or below the noise floor are not added: it is this plot's zero
        return [(f"noise floor: {pads[0].sensor.noise_count:g} a taxel", 0.0, NOISE_COLOR)]
    return []


def _draw_head(draw: ImageDraw.ImageDraw, episode: Episode, layout: Layout) -> None:
    spec = episode.spec
    draw.text((MARGIN, 18), episode.name, INK, font(26))
    draw.text((MARGIN, 54), f"\u201c{episode.instruction}\u201d   outcome: {outcome(episode)}", INK, font(17))
    facts = f"{episode.num_rows} rows, {episode.num_rows / spec.fps:.2f} s at {spec.fps} fps; {spec.robot_type}; {spec.name}"
    draw.text((MARGIN, 79), facts, SOFT, font(15))
    text = f"data: {episode.origin}"
    width = draw.textlength(text, font(17))
    draw.rounded_rectangle((MARGIN, 102, MARGIN + width + 20, 128), 8, fill=ORIGIN_COLOR)
    draw.text((MARGIN + 10, 105), text, PAPER, font(17))


def _draw_cells(
    image: Image.Image, draw: ImageDraw.ImageDraw, episode: Episode, pads: list[Pad], layout: Layout
) -> None:
    for (n, name), (left, top, right, _) in layout.cells.items():
        if n == 0:
            draw.text(((left + right) / 2, top - 8), name, INK, font(15), anchor="ms")
    best = peak_row(pads) if pads else None
    for n, row in enumerate(layout.instants):
        top = HEAD_HEIGHT + 34 + n * (CELL_HEIGHT + GAP)
        draw.text((MARGIN, top + 4), f"{row / episode.spec.fps:.2f} s", INK, font(20))
        draw.text((MARGIN, top + 32), f"row {row}", SOFT, font(15))
        if row == best:
            draw.text((MARGIN, top + 54), "most touch", CONTACT_COLOR, font(15))
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


def _draw_scale(image: Image.Image, draw: ImageDraw.ImageDraw, pads: list[Pad], layout: Layout) -> None:
    sensor = pads[0].sensor
    _, top, left, _ = layout.cells[0, pads[-1].name]
    left, height = left + 2 * GAP, 2 * CELL_HEIGHT
    bar = heat(np.repeat(np.linspace(1, 0, height)[:, None], 18, axis=1))
    image.paste(Image.fromarray(bar), (left, top))
    for count, text in (
        (0, "0"),
        (sensor.noise_count, f"{sensor.noise_count:g} noise"),
        (pads[0].gate_count, f"{pads[0].gate_count:.3g} contact"),
        (sensor.max_count / 2, f"{sensor.max_count / 2:g}"),
        (sensor.max_count, f"{sensor.max_count}"),
    ):
        y = top + (height - 1) * (1 - count / sensor.max_count)
        draw.line((left + 18, y, left + 23, y), INK)
        draw.text((left + 27, y), text, INK, font(14), anchor="lm")
    for n, word in enumerate(("counts", "above", "baseline")):
        draw.text((left, top + height + 10 + 17 * n), word, SOFT, font(14))


def _draw_lane(
    draw: ImageDraw.ImageDraw, episode: Episode, pads: list[Pad], title: str, box: tuple[int, int, int, int]
) -> None:
    left, top, right, bottom = box
    draw.text((left - 10, (top + bottom) / 2), title, INK, font(14), anchor="rm")
    if title == "stage":
        rows, names = [row for row, _ in episode.stages], [name for _, name in episode.stages]
        order = list(dict.fromkeys(names))
        colors = [STAGE_COLORS[order.index(name) % len(STAGE_COLORS)] for name in names]
    else:
        gate = contact_gate(pads)
        rows = [0, *(np.flatnonzero(np.diff(gate)) + 1)]
        names, colors = ["contact" if gate[r] else "" for r in rows], [GATE_COLORS[bool(gate[r])] for r in rows]
        rule = f"{MIN_ACTIVE_TAXELS} taxel beyond {CONTACT_THRESHOLD}"
        draw.text((right + 12, (top + bottom) / 2), rule, SOFT, font(14), anchor="lm")
    for start, end, name, color in zip(rows, [*rows[1:], episode.num_rows], names, colors, strict=True):
        x0, x1 = (left + (right - left) * r / episode.num_rows for r in (start, end))
        draw.rectangle((x0, top, x1 - 1, bottom), fill=color)
        if draw.textlength(name, font(14)) < x1 - x0 - 6:
            ink = PAPER if color == CONTACT_COLOR else INK
            draw.text((x0 + 5, (top + bottom) / 2), name, ink, font(14), anchor="lm")


def _draw_plot(
    image: Image.Image,
    draw: ImageDraw.ImageDraw,
    title: str,
    box: tuple[int, int, int, int],
    lines: list[Line],
    marks: list[tuple[str, float, tuple[int, int, int]]],
) -> None:
    left, top, right, bottom = box
    width, height = right - left, bottom - top
    values = np.concatenate([line.values for line in lines])
    ticks = nice_ticks(min(0.0, float(values.min())), max(float(values.max()), *(m[1] for m in marks), 1e-9))
    low, high = ticks[0], ticks[-1]

    def y_of(value: np.ndarray | float) -> np.ndarray:
        return (height - 1) * (1 - (np.asarray(value, dtype=float) - low) / (high - low))

    canvas = np.full((height, width, 3), 255, np.uint8)
    for tick in ticks:
        cv2.line(canvas, (0, round(float(y_of(tick)))), (width, round(float(y_of(tick)))), FAINT, 1)
        draw.text((left - 8, top + float(y_of(tick))), f"{tick:g}", SOFT, font(13), anchor="rm")
    for _, value, color in marks:
        y = round(float(y_of(value)))
        for x in range(0, width, 10):
            cv2.line(canvas, (x, y), (x + 5, y), color, 1)
    for line in lines:
        x = (np.arange(len(line.values)) + 0.5) * width / len(line.values)
        points = np.stack([x, y_of(line.values)], axis=1)
        fixed = np.round(points * 16).astype(np.int32)  # cv2: 4 bits behind the point
        cv2.polylines(canvas, [fixed], False, line.color, line.width, cv2.LINE_AA, 4)
    image.paste(Image.fromarray(canvas), (left, top))
    draw.rectangle((left, top, right, bottom), outline=FAINT)
    draw.text((left + 4, top - 5), title, INK, font(15), anchor="ls")
    legend = [(line.name, line.color) for line in lines] + [(name, color) for name, _, color in marks]
    _draw_legend(draw, legend, right, top)


def _draw_legend(
    draw: ImageDraw.ImageDraw, entries: list[tuple[str, tuple[int, int, int]]], left: int, top: int
) -> None:
    """One column, or two where one would be longer than the plot is high."""
    columns = 1 if len(entries) <= 6 else 2
    rows = math.ceil(len(entries) / columns)
    step = min(19, PLOT_HEIGHT / rows)
    for n, (name, color) in enumerate(entries):
        x, y = left + 12 + (n // rows) * LEGEND_WIDTH / 2, top + 8 + step * (n % rows)
        draw.rectangle((x, y - 2, x + 14, y + 2), fill=color)
        draw.text((x + 21, y), name, INK, font(14 if step > 15 else 11), anchor="lm")


def _draw_time_axis(draw: ImageDraw.ImageDraw, episode: Episode, layout: Layout) -> None:
    """Ticks in seconds below the last plot, and through all of them the instants shown above."""
    if not layout.plots:
        return
    boxes = list(layout.plots.values())
    left, _, right, bottom = boxes[-1]
    end_s = episode.num_rows / episode.spec.fps
    for tick in nice_ticks(0.0, end_s, most=9):
        if tick <= end_s:
            x = left + (right - left) * tick / end_s
            draw.line((x, bottom, x, bottom + 6), INK)
            draw.text((x, bottom + 9), f"{tick:g}", SOFT, font(14), anchor="mt")
    draw.text(
        ((left + right) / 2, bottom + 30),
        "time since the first row [s]; dotted: the instants above",
        SOFT,
        font(14),
        "mt",
    )
    for row in layout.instants:
        x = left + (right - left) * (row + 0.5) / episode.num_rows
        for y in range(boxes[0][1], bottom, 6):
            draw.line((x, y, x, y + 2), SOFT)


def nice_ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Return round numbers for an axis, ascending, at most ``most`` of them: the first at or below ``low``, the last at or above
    ``high``."""
    for exponent in range(math.floor(math.log10(high - low)) - 1, 300):
        for step in (1.0, 2.0, 5.0):
            size = step * 10.0**exponent
            first, last = math.floor(low / size + 1e-9), math.ceil(high / size - 1e-9)
            if last - first < most:
                return [n * size for n in range(first, last + 1)]
    raise ValueError(f"no ticks between {low} and {high}")


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font, which is the same on every machine; ``size`` in pixels."""
    return ImageFont.load_default(size)  # Pillow's own: the same on every machine
