"""Figures show the numbers they were given: lines, bars and cells are read back from the drawn figure."""

import io

import numpy as np
import pytest
from made_traces import FLOOR_RAD, ORIGIN, comparison, swing, touch_trace, trace
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from taccorl.diagnosis.comparison.along import curves
from taccorl.diagnosis.comparison.localise import heat_map
from taccorl.diagnosis.comparison.localise_touch import touch_heat_map
from taccorl.diagnosis.comparison.result import TouchTrace
from taccorl.report.figure_style import AFTER, BEFORE
from taccorl.report.figures import (
    Step,
    heat_map_figure,
    joint_response,
    residual_along_variables,
    waterfall,
)
from taccorl.report.figures_touch import touch_histogram, touch_maps, touch_over_time

_, POSITION = swing(seconds=8.0)
LEFT = np.where(np.gradient(POSITION) >= 0, 2e-3, -2e-3)


def line(axes: Axes, color: str) -> np.ndarray:
    return np.asarray(
        next(
            found for found in axes.get_lines() if found.get_color() == color
        ).get_ydata()
    )


def words(figure: Figure) -> str:
    axes = figure.axes
    found = [t.get_text() for t in figure.texts] + [figure.get_suptitle()]
    found += [
        t
        for a in axes
        for t in (a.get_xlabel(), a.get_ylabel(), *(x.get_text() for x in a.texts))
    ]
    found += [
        x.get_text() for a in axes if a.get_legend() for x in a.get_legend().get_texts()
    ]
    return "\n".join(found)


def drawn(figure: Figure) -> Image.Image:
    """What a page shows: opens as a picture that is not blank."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    with Image.open(stream) as image:
        assert np.asarray(image.convert("L")).std() > 5
        return image


def test_joint_response_shows_measurement_twins_residual_floor_and_origin():
    before, after = trace(LEFT, POSITION), trace(0.1 * LEFT, POSITION)
    figure = joint_response(before, after, ("nominal", "mended"))
    position, error, residual, lanes = figure.axes
    np.testing.assert_allclose(line(position, BEFORE), before.replayed)
    np.testing.assert_allclose(
        line(error, AFTER), 1e3 * (after.replayed - after.target)
    )
    np.testing.assert_allclose(line(residual, BEFORE), 1e3 * LEFT)  # mrad
    np.testing.assert_allclose(line(residual, AFTER), 0.1e3 * LEFT)
    text = words(figure)
    assert str(ORIGIN) in text and "noise floor: ± 2 × 0.2 mrad" in text
    assert (
        "nominal: RMSE 2 mrad, 10 × floor" in text
        and "mended: RMSE 0.2 mrad, 1 × floor" in text
    )
    assert "time [s]" in text and "[mrad]" in text and "[rad]" in text
    band = residual.patches[0].get_extents().transformed(residual.transData.inverted())
    assert (band.y0, band.y1) == pytest.approx((-2e3 * FLOOR_RAD, 2e3 * FLOOR_RAD))
    assert "after a reversal" in [t.get_text() for t in lanes.get_yticklabels()]
    drawn(figure)


def test_heat_map_shows_every_cell_s_number():
    cells = heat_map(
        comparison(
            trace(LEFT, POSITION), trace(3 * LEFT, POSITION, signal="right_joint1")
        )
    )
    figure = heat_map_figure(cells, [ORIGIN], "where")
    shown = [t.get_text() for t in figure.axes[0].texts]
    assert sorted(shown) == sorted(f"{c.ratio:.3g}" for c in cells)
    assert "not why" in words(figure) and "noise floor" in words(figure)
    drawn(figure)


def test_residual_along_variables_shows_both_twins():
    one, two = (
        comparison(trace(LEFT, POSITION)),
        comparison(trace(0.1 * LEFT, POSITION)),
    )
    found = curves(one, "left_joint5")
    figure = residual_along_variables(
        found, curves(two, "left_joint5"), one.traces, ("nominal", "mended")
    )
    panel = next(a for a in figure.axes if a.get_xlabel() == "velocity [rad/s]")
    curve = next(c for c in found if c.variable == "velocity")
    np.testing.assert_allclose(line(panel, BEFORE), 1e3 * curve.middle)
    np.testing.assert_allclose(line(panel, AFTER), 1e2 * curve.middle)
    assert {a.get_ylabel() for a in figure.axes if a.get_visible()} == {
        "mean residual [mrad]",
        "RMS residual [mrad]",
    }
    drawn(figure)


def test_waterfall_falls_from_step_to_step():
    steps = [Step("twin", 20.0), Step("coulomb_friction", 4.0), Step("backlash", 1.0)]
    figure = waterfall(steps, [ORIGIN], "error")
    bars = [
        (p.get_y(), p.get_height())
        for p in figure.axes[0].patches
        if p.get_width() == pytest.approx(0.62)
    ]
    assert bars == [(0.0, 20.0), (4.0, 16.0), (1.0, 3.0)]
    assert (
        "-80%" in words(figure)
        and "noise floor (1.0)" in words(figure)
        and "at the floor: ≤ 1.3" in words(figure)
    )
    drawn(figure)


@pytest.fixture
def touch() -> TouchTrace:
    rng = np.random.default_rng(0)
    measured = rng.integers(-2, 3, (200, 2, 32, 12)).astype(float)
    measured[50:150, 0, 10:20, 3:9] += 80
    replayed = np.zeros_like(measured)
    replayed[50:150, 0, 10:20, 3:9] = 100
    return touch_trace(measured, replayed, 1.4)


def test_touch_figures(touch: TouchTrace):
    histogram = touch_histogram([touch], [touch], ("nominal", "mended"))
    assert "measured: n = 6000, mean 80" in words(
        histogram
    ) and "nominal: n = 6000, mean 100" in words(histogram)
    maps = touch_maps(touch, touch, ("nominal", "mended"))
    pictures = [a.get_images()[0].get_array() for a in maps.axes if a.get_images()]
    frame = int(np.argmax(touch.measured.sum(axis=(1, 2, 3))))
    np.testing.assert_array_equal(pictures[0], touch.measured[frame, 0])
    np.testing.assert_allclose(
        pictures[3], np.sqrt(np.mean(touch.residual[:, 0] ** 2, axis=0))
    )
    sums = touch_over_time(touch)
    np.testing.assert_allclose(
        line(sums.axes[0], BEFORE), touch.replayed[:, 0].sum(axis=(1, 2))
    )
    for figure in (
        histogram,
        maps,
        sums,
        heat_map_figure(touch_heat_map([touch]), [ORIGIN], "pads"),
    ):
        assert str(ORIGIN) in words(figure) and "noise floor" in words(figure)
        drawn(figure)
