"""Figures of the studies hold the counts that they were given."""

import numpy as np
import pytest

from pipelines.studies.figures import SLOPE, confusion_matrix, detection_curves, half_detected
from taccorl.data.origin import Origin

ORIGIN = Origin("surrogate", "a test")


def test_confusion_matrix_holds_the_counts():
    counts = {"a": {"a": 18, "b": 1, "something else": 1}, "b": {"b": 20}, "none": {"nothing": 20}}
    figure = confusion_matrix(counts, [ORIGIN], "who is taken for whom")
    axes = figure.axes[0]
    labels = [t.get_text() for t in axes.get_xticklabels()]
    rows = [t.get_text() for t in axes.get_yticklabels()]
    found = {(rows[round(t.get_position()[1])], labels[round(t.get_position()[0])]): t.get_text() for t in axes.texts}
    assert found == {
        ("a (n = 20)", "a"): "18",
        ("a (n = 20)", "b"): "1",
        ("a (n = 20)", "something else"): "1",
        ("b (n = 20)", "b"): "20",
        ("none (n = 20)", "nothing"): "20",
    }


def test_half_detection_is_where_misses_turn_into_finds():
    signals = np.geomspace(0.25, 4.0, 41)
    half, low, high = half_detected(signals, signals > 1.0)
    assert half == pytest.approx(1.0, rel=0.1)
    assert 0.7 < low < half < high < 1.4
    # drawn from the curve itself: the true 2 lies within the interval
    rng = np.random.default_rng(0)
    signals = np.exp(rng.uniform(np.log(0.3), np.log(10), 200))
    half, low, high = half_detected(signals, rng.random(200) < 1 / (1 + (2.0 / signals) ** SLOPE))
    assert low < 2.0 < high < 1.3 * low
    assert half_detected(np.array([3.0, 5.0]), np.array([True, True]))[1] == 0.0  # never missed
    assert half_detected(np.array([0.1, 0.2]), np.array([False, False]))[2] == np.inf  # never found


def test_detection_curves_count_seeds_bin_by_bin():
    points = {"backlash": (np.array([4.0] * 10 + [1.0] * 10), np.array([True] * 10 + [True, False] * 5))}
    figure = detection_curves(points, [ORIGIN], "detection", (0.5, 2.0, 8.0))
    axes = figure.axes[0]
    assert axes.get_title() == "backlash (n = 20)"
    dots = [float(mark.get_ydata()[0]) for mark in axes.lines if mark.get_marker() == "o"]
    assert dots == [0.5, 1.0]
    bars = [list(mark.get_ydata()) for mark in axes.lines if mark.get_alpha() == 0.6]
    # Wilson, 10 of 10 at z = 1.96: low = 1 / (1 + z² / n) = 0.7225; 5 of 10: 0.5 ± 0.2634
    np.testing.assert_allclose(bars, [[0.2366, 0.7634], [0.7225, 1.0]], atol=1e-3)
