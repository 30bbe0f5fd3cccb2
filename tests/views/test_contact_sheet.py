"""The contact sheet has the right picture, the right counts and the right words in the right places."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from taccorl.data.episode import Episode
from taccorl.views.colors import CONTACT_COLOR, heat
from taccorl.views.contact_sheet import GATE_COLORS, ORIGIN_COLOR, PAPER, choose_instants, contact_sheet
from taccorl.views.touch import contact_gate, pads_of, peak_row

from .made_episode import ORIGIN, TOUCH, draw, made_episode, without

ROWS = 90


@pytest.fixture(scope="module")
def episode() -> Episode:
    return made_episode(ROWS)


@pytest.fixture(scope="module")
def sheet(episode: Episode, tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.mktemp("sheet") / "sheet.png"
    layout = contact_sheet(episode, path)
    return path, np.asarray(Image.open(path).convert("RGB")), layout


def cell(pixels: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
    left, top, right, bottom = box
    return pixels[top:bottom, left:right]


def test_instants_are_spread_from_first_to_last_and_hold_the_peak(episode: Episode):
    rows = choose_instants(episode)
    assert (rows[0], rows[-1], len(rows)) == (0, ROWS - 1, 6)
    assert peak_row(pads_of(episode)) in rows
    assert list(rows) == sorted(set(rows))
    quiet = without(episode, TOUCH)
    assert choose_instants(quiet) == (0, 18, 36, 53, 71, 89)  # 89/5 = 17.8 apart, rounded


@pytest.mark.parametrize("num_rows", [1, 2, 3])
def test_short_episodes_show_every_row(num_rows: int):
    assert choose_instants(made_episode(num_rows, picture_size=32)) == tuple(range(num_rows))


@pytest.mark.parametrize("camera", ["front", "left_wrist", "right_wrist"])
def test_each_cell_shows_its_cameras_picture_of_its_row(sheet, camera: str):
    _, pixels, layout = sheet
    for n, row in enumerate(layout.instants):
        shown = cell(pixels, layout.cells[n, camera])
        assert np.array_equal(shown, draw(f"observation.images.{camera}", row, ROWS, 224))  # 224 pixels: not scaled


def test_each_pad_cell_shows_its_counts_on_one_fixed_scale(episode: Episode, sheet):
    _, pixels, layout = sheet
    for pad in pads_of(episode):
        for n, row in enumerate(layout.instants):
            shown = cell(pixels, layout.cells[n, pad.name])
            assert shown.shape == (224, 84, 3)  # 7 pixels a taxel
            assert np.array_equal(shown[3::7, 3::7], heat(pad.counts[row] / 255))


def test_lane_is_red_exactly_while_the_gate_is_open(episode: Episode, sheet):
    _, pixels, layout = sheet
    gate = contact_gate(pads_of(episode))
    left, top, right, _ = layout.plots["contact gate"]
    for row in range(ROWS):
        x = round(left + (right - left) * (row + 0.5) / ROWS)
        if row not in layout.instants:  # a dotted line stands there
            assert tuple(pixels[top + 2, x]) == GATE_COLORS[bool(gate[row])], row


def test_contact_threshold_is_a_dashed_red_line_in_the_peak_plot(sheet):
    _, pixels, layout = sheet
    box = next(b for t, b in layout.plots.items() if t.startswith("touch peak"))
    plot = cell(pixels, box)
    red_per_row = (plot == CONTACT_COLOR).all(axis=2).sum(axis=1)
    # Ticks go from 0 to 150 (the peak is 120 and noise): 30 counts are a fifth of the way up.
    assert red_per_row.argmax() == pytest.approx((plot.shape[0] - 1) * (1 - 30 / 150), abs=2)


def test_origin_stands_on_the_sheet_and_inside_the_file(sheet):
    path, pixels, _ = sheet
    badge = (pixels[100:130, :400] == ORIGIN_COLOR).all(axis=2)
    assert badge.sum() > 3000
    with Image.open(path) as image:
        assert image.info["Source"] == str(ORIGIN)
        assert image.info["Software"] == "taccorl view"


def test_everything_lies_on_the_sheet_and_apart(sheet):
    _, pixels, layout = sheet
    boxes = [*layout.cells.values(), *layout.plots.values()]
    for left, top, right, bottom in boxes:
        assert 0 <= left < right <= pixels.shape[1]
        assert 0 <= top < bottom <= pixels.shape[0]
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
    assert (pixels[-2:] == PAPER).all(), "nothing runs over the lower edge"


def test_episode_without_touch_or_pictures_still_has_its_grippers(episode: Episode, tmp_path: Path):
    quiet = contact_sheet(without(episode, TOUCH), tmp_path / "quiet.png")
    assert {name for _, name in quiet.cells} == {"front", "left_wrist", "right_wrist"}
    assert list(quiet.plots) == ["stage", "gripper opening [m]"]
    bare = contact_sheet(without(episode, TOUCH, *episode.picture_keys), tmp_path / "bare.png")
    assert not bare.cells
    assert list(bare.plots) == ["stage", "gripper opening [m]"]


def test_pictures_are_decoded_in_one_pass(episode: Episode, tmp_path: Path):
    asked = []

    def stream():
        for row, pictures in enumerate(episode.pictures()):
            asked.append(row)
            yield pictures

    contact_sheet(dataclasses.replace(episode, pictures=stream), tmp_path / "sheet.png")
    assert asked == list(range(ROWS)), "once each"
