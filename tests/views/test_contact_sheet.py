"""The contact sheet shows the right pictures, counts and words, apart from each other."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from taccorl.data.episode import Episode
from taccorl.views.colors import CONTACT_COLOR, heat
from taccorl.views.contact_sheet import (
    GATE_COLORS,
    ORIGIN_COLOR,
    choose_instants,
    contact_sheet,
    sheet_figure,
)
from taccorl.views.touch import contact_gate, pads_of, peak_row

from .made_episode import ORIGIN, TOUCH, draw, made_episode, without

ROWS = 90


@pytest.fixture(scope="module")
def episode() -> Episode:
    return made_episode(ROWS)


@pytest.fixture(scope="module")
def axes(episode: Episode) -> dict[str, Axes]:
    """Label of each axes of the figure → the axes, drawn."""
    figure = sheet_figure(episode)
    FigureCanvasAgg(figure).draw()
    return {str(one.get_label()): one for one in figure.axes}


def test_instants_are_spread_from_first_to_last_and_hold_the_peak(episode: Episode):
    rows = choose_instants(episode)
    assert (rows[0], rows[-1], len(rows)) == (0, ROWS - 1, 6) and peak_row(
        pads_of(episode)
    ) in rows
    assert list(rows) == sorted(set(rows))
    quiet = without(episode, TOUCH)
    assert choose_instants(quiet) == (
        0,
        18,
        36,
        53,
        71,
        89,
    )  # 89/5 = 17.8 apart, rounded


@pytest.mark.parametrize("num_rows", [1, 2, 3])
def test_short_episodes_show_every_row(num_rows: int):
    assert choose_instants(made_episode(num_rows, picture_size=32)) == tuple(
        range(num_rows)
    )


@pytest.mark.parametrize("camera", ["front", "left_wrist", "right_wrist"])
def test_each_column_shows_its_cameras_pictures_of_its_rows(
    episode: Episode, axes: dict[str, Axes], camera: str
):
    shown = np.split(np.asarray(axes[camera].images[0].get_array()), 6)
    for row, picture in zip(choose_instants(episode), shown, strict=True):
        assert np.array_equal(
            picture[:224], draw(f"observation.images.{camera}", row, ROWS, 224)
        )
        assert (picture[224:] == 255).all() and len(picture) == 231


def test_each_pads_column_shows_its_counts_on_one_fixed_scale(
    episode: Episode, axes: dict[str, Axes]
):
    for pad in pads_of(episode):
        (image,) = axes[pad.name].images
        for row, counts in zip(
            choose_instants(episode),
            np.split(np.ma.getdata(image.get_array()), 6),
            strict=True,
        ):
            assert np.array_equal(counts[:32], pad.counts[row])
            shown = 255 * image.to_rgba(counts[:32])[..., :3]
            assert (
                np.abs(shown - heat(pad.counts[row] / 255)).max() <= 4
            )  # the next colour of 256


def test_lane_is_red_exactly_while_the_gate_is_open(
    episode: Episode, axes: dict[str, Axes]
):
    gate = contact_gate(pads_of(episode))
    spans = axes["contact gate"].patches
    for row in range(ROWS):
        (color,) = (
            span.get_facecolor()[:3]
            for span in spans
            if 0 < row / 30 + 0.5 / 30 - span.get_x() < span.get_width()
        )
        assert color == pytest.approx(np.array(GATE_COLORS[bool(gate[row])]) / 255), row


def test_contact_threshold_is_a_dashed_red_line_in_the_peak_plot(axes: dict[str, Axes]):
    peak = axes["touch peak [counts above baseline]"]
    (line,) = (line for line in peak.lines if line.get_label() == "contact 30")
    assert (
        line.get_color() == pytest.approx(np.array(CONTACT_COLOR) / 255)
        and line.get_linestyle() == "--"
    )
    assert list(line.get_ydata()) == pytest.approx([30, 30]) and peak.get_ylim()[0] == 0


def test_origin_stands_on_the_sheet_and_inside_the_file(
    episode: Episode, tmp_path: Path
):
    contact_sheet(episode, tmp_path / "sheet.png")
    with Image.open(tmp_path / "sheet.png") as image:
        assert image.info["Source"] == str(ORIGIN)
        assert image.info["Software"] == "taccorl view"
        assert (np.asarray(image.convert("RGB")) == ORIGIN_COLOR).all(
            axis=2
        ).sum() > 3000


def test_everything_lies_on_the_sheet_and_apart(axes: dict[str, Axes]):
    size = next(iter(axes.values())).figure.bbox
    boxes = [one.get_tightbbox() for one in axes.values()]
    assert all(
        size.x0 <= b.x0 < b.x1 <= size.x1 and size.y0 <= b.y0 < b.y1 <= size.y1
        for b in boxes
    )
    frames = [one.bbox for one in axes.values()]
    assert not any(a.overlaps(b) for i, a in enumerate(frames) for b in frames[:i])


def test_episode_without_touch_or_pictures_still_has_its_grippers(episode: Episode):
    below = ["stage", "gripper opening [m]"]
    for gone, beside in (
        ((TOUCH,), ["front", "left_wrist", "right_wrist"]),
        ((TOUCH, *episode.picture_keys), []),
    ):
        assert [
            one.get_label() for one in sheet_figure(without(episode, *gone)).axes
        ] == [*beside, *below]


def test_pictures_are_decoded_in_one_pass(episode: Episode, tmp_path: Path):
    asked = []

    def stream():
        for row, pictures in enumerate(episode.pictures()):
            asked.append(row)
            yield pictures

    contact_sheet(dataclasses.replace(episode, pictures=stream), tmp_path / "sheet.png")
    assert asked == list(range(ROWS)), "once each"
