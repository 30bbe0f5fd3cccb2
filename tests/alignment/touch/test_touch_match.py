"""The paper's five numbers of a touch match, by arithmetic that is written out."""

import dataclasses
import math

import numpy as np
import pytest

from taccorl.alignment.touch.match import MATCH_NUMBERS, TouchMatch, touch_match
from taccorl.errors import TaccorlError
from taccorl.report.touch_match import touch_match_section

PITCH_M = 0.002
NOISE = 4.0  # counts

# One pad of 2 × 3 taxels, two frames. Active are readings above 4.
MEASURED = np.array([[[[10, 30, 0], [0, 0, 0]]], [[[20, 20, 0], [0, 0, 4]]]])
SIMULATED = np.array([[[[0, 40, 0], [0, 0, 0]]], [[[20, 0, 0], [20, 0, 10]]]])


def match(
    measured: np.ndarray = MEASURED,
    simulated: np.ndarray = SIMULATED,
    threshold: float | np.ndarray = NOISE,
) -> TouchMatch:
    return touch_match([measured], [simulated], threshold, PITCH_M)


def test_masks_share_what_both_have_of_what_either_has() -> None:
    # Frame 0: measured {00, 01}, simulated {01}: 1 of 2. Frame 1: {00, 01} and
    # {00, 10, 12}: 1 of 4. Together 2 of 6.
    assert match().mask_iou == pytest.approx(2 / 6)


def test_numbers_of_active_taxels_differ_by_one_in_each_frame() -> None:
    assert match().active_taxels == pytest.approx((abs(2 - 1) + abs(2 - 3)) / 2)


def test_centroids_are_weighted_by_counts() -> None:
    # Frame 0: column (10·0 + 30·1) / 40 = 0.75 against 1, row 0: 0.25 pitches.
    # Frame 1: (column, row) = (0.5, 0); simulated counts 20, 20, 10 in (0, 0), (0, 1),
    # (2, 1): column 2·10 / 50 = 0.4, row 30 / 50 = 0.6.
    distance = (0.25 + math.hypot(0.5 - 0.4, 0.6)) / 2
    assert match().centroid_m == pytest.approx(distance * PITCH_M)
    assert match().centroid_frames == 2


def test_histograms_are_as_far_apart_as_counts_must_move() -> None:
    # Measured 10, 20, 20, 30; simulated 10, 20, 20, 40: a quarter moves by 10 counts.
    assert match().histogram_count == pytest.approx(10 / 4)


def test_changes_between_frames_are_compared_taxel_by_taxel() -> None:
    # Ever active are 00, 01, 10, 12. Measured change: 10, −10, 0, 4; simulated: 20, −40,
    # 20, 10.
    squares = 10**2 + 30**2 + 20**2 + 6**2
    assert match().temporal_count == pytest.approx(math.sqrt(squares / 4))


def test_counts_differ_by_their_rms_over_taxels_that_are_ever_active() -> None:
    squares = 10**2 + 10**2 + 20**2 + 20**2 + 6**2
    assert match().rms_count == pytest.approx(math.sqrt(squares / 8))


def test_a_perfect_twin_is_0_and_1() -> None:
    same = match(MEASURED, MEASURED)
    zero = dataclasses.asdict(same)
    assert zero.pop("mask_iou") == 1.0
    assert (zero.pop("frames"), zero.pop("centroid_frames")) == (2, 2)
    assert set(zero.values()) == {0.0}
    assert same.undefined == {}


def test_recordings_are_pooled_by_frames_and_never_differenced_across() -> None:
    apart = touch_match(
        [MEASURED[:1], MEASURED[1:]], [SIMULATED[:1], SIMULATED[1:]], NOISE, PITCH_M
    )
    assert apart.temporal_count is None  # one frame each
    assert apart.mask_iou == match().mask_iou
    assert apart.active_taxels == match().active_taxels
    assert apart.centroid_m == match().centroid_m


def test_a_threshold_may_be_of_each_taxel_and_is_never_below_0() -> None:
    levels = np.full((1, 2, 3), NOISE)
    levels[0, 0, 1] = 100.0
    # 01 is never active: measured {00}, {00}, simulated {}, {00, 10, 12}.
    assert match(threshold=levels).mask_iou == pytest.approx(1 / 4)
    assert match(threshold=-5.0) == match(threshold=0.0)


def test_pads_have_centroids_of_their_own() -> None:
    # Pad a agrees, pad b is one row off: half a pitch in the mean.
    measured = np.zeros((1, 2, 2, 3))
    measured[0, :, 0, 0] = 10.0
    simulated = measured.copy()
    simulated[0, 1] = simulated[0, 1, ::-1]
    found = match(measured, simulated)
    assert found.centroid_m == pytest.approx(PITCH_M / 2)
    assert (found.frames, found.active_taxels, found.mask_iou) == (2, 0.0, 1 / 3)


@pytest.mark.parametrize(
    ("measured", "simulated", "undefined"),
    [
        pytest.param(0, 0, {n.name for n in MATCH_NUMBERS}, id="nothing active"),
        pytest.param(1, 0, {"centroid_m", "histogram_count"}, id="silent twin"),
        pytest.param(0, 1, {"centroid_m", "histogram_count"}, id="silent pad"),
    ],
)
def test_what_readings_do_not_determine_is_none_and_said(
    measured: int, simulated: int, undefined: set[str]
) -> None:
    found = match(measured * MEASURED, simulated * SIMULATED)
    assert {n for n, v in found.record().items() if v is None} - {
        "rms_count"
    } == undefined
    assert set(found.undefined) == undefined
    rows = {row[0]: row for row in touch_match_section(("twin",), [found]).rows}
    for number in MATCH_NUMBERS:
        assert (rows[number.label][1] == "undefined") == (number.name in undefined)


def test_frames_without_a_centroid_in_one_of_both_are_counted() -> None:
    simulated = SIMULATED.copy()
    simulated[0] = 0
    found = match(MEASURED, simulated)
    assert (found.frames, found.centroid_frames) == (2, 1)
    assert found.centroid_m == pytest.approx(math.hypot(0.1, 0.6) * PITCH_M)


def test_readings_of_another_shape_are_refused() -> None:
    with pytest.raises(TaccorlError, match=r"\(2, 1, 2, 3\).*\(1, 1, 2, 3\)"):
        match(MEASURED, SIMULATED[:1])


def test_the_table_has_units_and_centroids_in_mm() -> None:
    section = touch_match_section(
        ("before", "after"), [match(), match(MEASURED, MEASURED)]
    )
    rows = {row[0]: row[1:] for row in section.rows}
    assert rows["centroids"] == ["0.858", "0", "mm"]
    assert rows["histograms"] == ["2.5", "0", "counts"]
    assert rows["number of active taxels"] == ["1", "0", "taxels"]
    assert rows["changes between frames"] == ["18.9", "0", "counts/frame"]
    assert rows["masks, intersection over union"] == ["0.333", "1", ""]
