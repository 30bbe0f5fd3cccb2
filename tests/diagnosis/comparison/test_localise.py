"""Errors planted in one regime, one phase, along one variable: found there, nowhere else, and not where there is nothing."""

import dataclasses

import numpy as np
import pytest
from made_traces import FLOOR_RAD, RATE_HZ, alike, comparison, swing, touch_trace, trace

from taccorl.diagnosis.comparison.along import curves
from taccorl.diagnosis.comparison.localise import (
    REGIMES,
    Cell,
    heat_map,
    motions_of,
    worst_regime,
)
from taccorl.diagnosis.comparison.localise_touch import phases, touch_heat_map
from taccorl.diagnosis.comparison.result import TouchTrace


def cells_of(residual: np.ndarray, position: np.ndarray, **fields) -> dict[str, Cell]:
    return {
        c.regime: c for c in heat_map(comparison(trace(residual, position, **fields)))
    }


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_reversals_are_where_the_velocity_changes_its_sign():
    time_s, position = swing(seconds=10.0, hz=0.5)  # reversals at 0.5, 1.5, … 9.5 s
    after = motions_of([trace(0 * position, position)])[0].after_reversal
    starts = time_s[np.flatnonzero(np.diff(after.astype(int)) == 1) + 1]
    np.testing.assert_allclose(starts, np.arange(10) + 0.5, atol=0.011)
    assert after.mean() == pytest.approx(10 * 0.15 / 10, rel=0.02)  # 0.15 s each


def test_a_stop_without_turning_round_is_no_reversal():
    time_s = np.arange(2000) / RATE_HZ
    position = (
        np.cumsum(np.where((time_s > 4) & (time_s < 6), 0.0, 0.2)) / RATE_HZ
    )  # goes, stands, goes on
    assert not motions_of([trace(0 * position, position)])[0].after_reversal.any()


@pytest.mark.parametrize(
    "regime",
    [
        "near zero speed",
        "high speed",
        "after a reversal",
        "highest third of the range",
        "last third of the time",
    ],
)
def test_error_planted_in_a_regime_is_found_there(regime):
    _, position = swing()
    rows = next(r for r in REGIMES if r.name == regime).rows(
        motions_of([trace(0 * position, position)])[0]
    )
    cells = cells_of(np.where(rows, 10 * FLOOR_RAD, 0.0), position)
    assert cells[regime].ratio == pytest.approx(10.0)
    assert cells[regime].share_of_error == pytest.approx(1.0)
    assert cells[regime].lift == pytest.approx(1 / cells[regime].share_of_time)
    worst = worst_regime(list(cells.values()), "left_joint5")
    assert worst is not None and worst.ratio == pytest.approx(10.0)
    others = [c for c in cells.values() if c.regime != regime]
    assert sum(c.ratio < 9.9 for c in others) >= len(others) - 2, (
        "overlapping regimes may be as high, not all"
    )


def test_regimes_of_a_group_exclude_each_other_and_shares_add_up():
    _, position = swing()
    noise = 1e-3 * rng().normal(size=len(position))
    cells = cells_of(noise, position)
    for group in ("speed", "pose", "time"):
        own = [cells[r.name] for r in REGIMES if r.group == group]
        assert sum(c.share_of_time for c in own) == pytest.approx(1.0)
        assert sum(c.share_of_error for c in own) == pytest.approx(1.0)
        assert sum(c.n for c in own) == len(position)
    motion = motions_of([trace(noise, position)])[0]
    for group in {r.group for r in REGIMES}:
        assert (
            sum(r.rows(motion).astype(int) for r in REGIMES if r.group == group).max()
            <= 1
        )


def test_high_load_and_contact_are_read_off_torque_and_pads():
    time_s, position = swing()
    touched = time_s > 7.0
    torque = np.where(time_s < 2.0, 5.0, 0.1) + 1e-3 * rng().normal(size=len(time_s))
    residual = np.where(touched, 4e-3, 0.0)
    cells = cells_of(residual, position, torque=torque, touched=touched)
    assert cells["in contact"].share_of_error == pytest.approx(1.0)
    assert cells["no contact"].ratio == 0.0
    # the highest quarter, within the first 2 s and beyond
    assert cells["high load"].share_of_time == pytest.approx(0.25, abs=0.01)
    assert "in contact" not in cells_of(residual, position), "no pads: neither regime"


def test_rows_that_were_not_measured_count_nowhere():
    _, position = swing()
    measured = position.copy()
    measured[100:400] = np.nan
    cells = cells_of(np.full(len(position), 1e-3), position, measured=measured)
    assert (
        sum(cells[r.name].n for r in REGIMES if r.group == "time")
        == len(position) - 300
    )


def test_friction_shows_as_a_step_along_velocity_within_its_band():
    time_s, position = swing(seconds=40.0)
    size, velocity = 5e-3, np.cos(2 * np.pi * 0.5 * time_s)
    residual = size * np.sign(velocity) + 1e-3 * alike(rng(), len(position))
    curve = {
        c.variable: c
        for c in curves(comparison(trace(residual, position)), "left_joint5")
    }["velocity"]
    sure = (
        np.abs(curve.at) > 0.15 * 0.3 * np.pi
    )  # away from the bin in which both signs mix
    assert (np.abs(curve.middle[sure] - size * np.sign(curve.at[sure])) < 1e-3).all()
    assert ((curve.low <= curve.middle) & (curve.middle <= curve.high)).all()
    assert curve.explained > max(curve.by_chance, 0.8)


@pytest.mark.slow
def test_band_holds_the_truth_although_neighbours_are_alike():
    # The residual does not depend on the position: its mean is 0 in every bin. 20 recordings of about 14 bins; 95 % bands
    # hold 0 in at least 85 % of them. Bands from independent rows would hold it in a third.
    held, bins = 0, 0
    for seed in range(20):
        _, position = swing(seconds=40.0, hz=0.41)
        found = curves(
            comparison(trace(1e-3 * alike(rng(seed), len(position)), position)),
            "left_joint5",
        )
        curve = {c.variable: c for c in found}["position"]
        held += int(((curve.low <= 0) & (curve.high >= 0)).sum())
        bins += len(curve.at)
    assert held >= 0.85 * bins


@pytest.mark.slow
def test_what_does_not_depend_on_a_variable_is_not_beyond_chance():
    false = 0
    for seed in range(40):
        _, position = swing(seconds=20.0, hz=0.41)
        found = curves(
            comparison(trace(1e-3 * alike(rng(seed), len(position)), position)),
            "left_joint5",
        )
        false += sum(
            c.explained > c.by_chance for c in found if c.variable == "velocity"
        )
    assert false <= 7  # 5 % of 40 are 2; more than 7 has probability 0.001


def test_growing_error_shows_along_time_as_rms():
    time_s, position = swing(seconds=40.0)
    residual = 1e-4 * time_s * np.sin(2 * np.pi * 0.5 * time_s)
    curve = {
        c.variable: c
        for c in curves(comparison(trace(residual, position)), "left_joint5")
    }["time"]
    assert curve.measure == "RMS"
    np.testing.assert_allclose(
        curve.middle, 1e-4 * curve.at / np.sqrt(2), rtol=0.1, atol=2e-5
    )


def test_several_recordings_are_one_curve_and_a_still_joint_has_none():
    _, position = swing(seconds=10.0)
    two = comparison(
        trace(1e-3 * position, position),
        trace(1e-3 * position, position, recording="other"),
    )
    found = {c.variable: c for c in curves(two, "left_joint5")}
    assert np.polyfit(found["position"].at, found["position"].middle, 1)[
        0
    ] == pytest.approx(1e-3, rel=1e-6)
    still = np.full(2000, 0.3)
    assert [
        c.variable
        for c in curves(comparison(trace(1e-3 * still, still)), "left_joint5")
    ] == ["time"]


def press(residual_while: str | None = None) -> TouchTrace:
    """One trapezoid on pad left_a at 100 Hz: 0.5 s up from 2 s on, 2 s hold, 0.5 s down; left_b feels nothing."""
    time_s = np.arange(1000) / 100.0
    shape = np.clip(np.minimum((time_s - 2.0) / 0.5, (5.0 - time_s) / 0.5), 0, 1)
    measured = np.zeros((1000, 2, 32, 12))
    measured[:, 0, 10:20, 3:9] = 120.0 * shape[:, None, None]
    one = touch_trace(measured, measured.copy(), 1.3, use="fit")
    if residual_while is not None:
        rows = phases(one, 0)[residual_while]
        one.replayed[rows, 0, 10:20, 3:9] -= 13.0
    return one


def test_phases_of_a_press():
    found = phases(press(), 0)
    seconds = {name: rows.sum() / 100 for name, rows in found.items()}
    # Contact is beyond 30 of 120 counts: a quarter of each 0.5 s slope comes before it.
    assert seconds["loading"] == pytest.approx(0.375, abs=0.08)
    assert seconds["unloading"] == pytest.approx(0.375, abs=0.08)
    assert seconds["hold"] == pytest.approx(2.0, abs=0.15)
    assert seconds["just released"] == pytest.approx(1.0, abs=0.02)
    assert sum(rows.astype(int) for rows in found.values()).tolist() == [1] * 1000
    assert phases(press(), 1)["untouched"].all()


@pytest.mark.parametrize("phase", ["loading", "hold", "unloading", "just released"])
def test_error_planted_in_a_phase_is_found_there(phase):
    cells = {(c.signal, c.regime): c for c in touch_heat_map([press(phase)])}
    assert cells["left_a", phase].share_of_error == pytest.approx(1.0)
    assert cells["left_a", phase].ratio == pytest.approx(10.0)  # 13 counts of 1.3
    assert not any(signal == "left_b" for signal, _ in cells), (
        "it feels nothing at any time"
    )


def test_contact_and_thirds_of_the_pad_are_regimes_too():
    one = press()
    # touched in rows 20 to 29 instead of 10 to 19, and off by 13 counts there where the tip third begins, from row 22 on
    for values in (one.measured, one.replayed):
        values[:, 0, 10:20], values[:, 0, 20:30] = 0.0, values[:, 0, 10:20].copy()
    one.replayed[:, 0, 22:30, 3:9] -= np.where(
        one.measured[:, 0, 22:30, 3:9] > 30, 13.0, 0.0
    )
    cells = {c.regime: c for c in touch_heat_map([one]) if c.signal == "left_a"}
    assert "palm third" not in cells, "it feels nothing there"
    assert (
        cells["tip third"].share_of_error == pytest.approx(1.0)
        and cells["middle third"].ratio == 0.0
    )
    assert cells["tip third"].share_of_time == pytest.approx(
        0.8
    )  # 8 of the 10 rows that feel something
    assert (
        cells["in contact"].share_of_error == pytest.approx(1.0)
        and cells["no contact"].ratio == 0.0
    )
    assert cells["in contact"].ratio == pytest.approx(10.0 * np.sqrt(0.8))
    assert cells["in contact"].n + cells["no contact"].n == 1000 * 10 * 6


def test_a_floor_of_touch_is_a_lower_bound_unless_presses_were_repeated():
    for repeated in (False, True):
        scores = comparison(
            touches=(dataclasses.replace(press("hold"), repeated=repeated),)
        ).pad_scores()
        assert [s.lower_bound for s in scores] == [not repeated]


def test_contact_is_taken_from_geometry_where_it_is_known():
    soft = press()
    soft.measured[:] *= 0.2  # 24 counts at most: no taxel says contact
    assert phases(soft, 0)["untouched"].all()
    touched = np.zeros((1000, 2), dtype=bool)
    touched[200:500, 0] = True
    known = phases(dataclasses.replace(soft, touched=touched), 0)
    held = known["loading"] | known["hold"] | known["unloading"]
    np.testing.assert_array_equal(held, touched[:, 0])
    assert (
        known["loading"][200:240].mean() > 0.9 and known["just released"].sum() == 100
    )


def test_every_pad_has_a_score_of_its_own():
    one = press()
    one.replayed[:, 0] -= np.where(one.measured[:, 0] > 0, 13.0, 0.0)
    one.measured[300:400, 1, 5, 5], one.replayed[300:400, 1, 5, 5] = 60.0, 40.0
    found = comparison(touches=(one,), split={}).pad_scores()
    assert [(s.signal, s.kind, s.use, s.n) for s in found][1] == (
        "left_b",
        "touch",
        "fit",
        100,
    )
    assert [s.rmse for s in found] == pytest.approx([13.0, 20.0])
    assert [s.ratio for s in found] == pytest.approx([10.0, 20.0 / 1.3])
    (both,) = comparison(touches=(one,), split={}).scores()
    first, second = found
    assert both.rmse**2 * both.n == pytest.approx(
        first.rmse**2 * first.n + second.rmse**2 * second.n
    )
