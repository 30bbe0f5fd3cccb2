"""Gains, offsets and errors of an array: a summary that names the right cells, and maps in the layout of the grid."""

import dataclasses

import numpy as np
import pytest
from made_traces import ORIGIN, touch_trace

from taccorl.diagnosis.comparison.cell_numbers import (
    cell_errors,
    cell_lines,
    spread_words,
    summarised,
)
from taccorl.diagnosis.comparison.result import CellNumbers, Comparison, TouchTrace
from taccorl.report.figures_touch import cell_maps
from taccorl.report.report import Report, as_json

NAMES = tuple(f"r{i}c{j}" for i in range(2) for j in range(4))
GAINS = np.array([[4.0, 5.0, 6.0, 7.0], [8.0, 0.0, 9.0, 10.0]])


def trace(recording: str, error: np.ndarray) -> TouchTrace:
    """100 rows in which every cell is off by ± ``error`` (R, C)."""
    measured = error * np.where(np.arange(100) % 2, 1.0, -1.0)[:, None, None, None]
    cells = CellNumbers(names=NAMES, gain=GAINS, offset=10 * GAINS)
    own = {
        "recording": recording,
        "use": "fit",
        "pads": ("palm",),
        "unit": "count",
        "thirds": (),
        "cells": cells,
    }
    return touch_trace(
        measured, 0 * measured, 0.5, load=np.ones_like(measured), load_unit="N", **own
    )


def test_summary_has_the_median_the_middle_half_and_the_farthest_cells():
    # Sorted: 0 4 5 6 7 8 9 10; the median is 6.5, the quartiles (7 intervals) are at 1.75 and 5.25: 4.75 and 8.25.
    words = spread_words(NAMES, GAINS.ravel(), "count/N")
    assert words.startswith(
        "median 6.5 count/N, middle half 4.75 … 8.25 count/N, farthest r1c1 0, r1c3 10, "
    )
    assert spread_words(NAMES, GAINS.ravel(), largest=True).endswith(
        "largest r1c3 10, r1c2 9, r1c0 8, r0c3 7"
    )


def test_numbers_of_few_cells_are_listed_and_those_of_an_array_are_not():
    base = (
        {"other": 1.0}
        | {f"gain_{name}": 2.0 for name in NAMES}
        | {"offset_thumb": 3.0, "offset_index": 4.0}
    )
    rest, words = summarised(base)
    assert rest == {"other": 1.0, "offset_thumb": 3.0, "offset_index": 4.0}
    assert list(words) == ["gain of 8 cells"]


def test_error_of_a_cell_is_over_all_recordings_in_its_own_floors():
    none, some = np.zeros((2, 4)), np.zeros((2, 4))
    some[1, 2] = 3.0
    traces = [trace("a", none), trace("b", some)]
    # RMS over 200 rows: √(100 · 9 / 200) = 2.12; in floors of 0.5: 4.24
    assert cell_errors(traces)[1, 2] == pytest.approx(np.sqrt(4.5) / 0.5)
    assert cell_errors(traces).sum() == pytest.approx(np.sqrt(4.5) / 0.5)
    lines = cell_lines(traces)
    assert (
        "r1c1 0" in lines[0]
        and "count/N" in lines[0]
        and "largest r1c2 4.24" in lines[2]
    )
    few = CellNumbers(names=NAMES[:4], gain=GAINS[:1], offset=GAINS[:1])
    assert cell_lines([dataclasses.replace(traces[0], cells=few)]) == []
    assert cell_lines([dataclasses.replace(traces[0], cells=None)]) == []


def test_the_numbers_of_a_report_hold_those_of_every_cell():
    compared = Comparison(
        twin="palm", effects=(), traces=(), touches=(trace("a", GAINS),), split={}
    )
    found = as_json(Report(title="palm", comparison=compared))["cells"]
    assert (
        found["names"] == list(NAMES)
        and found["gain"] == GAINS.tolist()
        and found["unit"] == "count"
    )
    np.testing.assert_allclose(found["rmse_floors"], 2 * GAINS)
    assert (
        as_json(
            Report(
                title="no cells", comparison=dataclasses.replace(compared, touches=())
            )
        )["cells"]
        == {}
    )


def test_maps_are_laid_out_as_the_grid_with_units_and_floor():
    figure = cell_maps([trace("a", GAINS)], "mended")
    pictures = [a.get_images()[0].get_array() for a in figure.axes if a.get_images()]
    for picture, expected in zip(
        pictures, (GAINS, 10 * GAINS, np.full((2, 4), 0.5), 2 * GAINS), strict=True
    ):
        np.testing.assert_allclose(np.asarray(picture), expected)
    texts = [a.get_title() for a in figure.axes] + [a.get_ylabel() for a in figure.axes]
    assert {"gain", "offset", "noise floor", "count/N", "count", "row"} <= set(texts)
    assert "mended" in figure.get_suptitle() and any(
        str(ORIGIN) in text.get_text() for text in figure.texts
    )
