"""Errors by recording and regime, of traces whose residuals are written down."""

import dataclasses

import numpy as np
import pytest
from axes import problem_of
from made_traces import FLOOR_RAD, swing, trace
from simulated_slide import AXIS, NOISE_M, recorded_slide

from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.comparison.regimes import ALL, RegimeErrors, regime_errors

_, POSITION = swing(seconds=8.0)
NOISE = FLOOR_RAD * np.random.default_rng(0).standard_normal(len(POSITION))
FORWARDS = np.gradient(POSITION) > 0


def pooled(found: RegimeErrors, use: str, regime: str = ALL) -> float:
    (row,) = [
        r for r in found.rows if r.use == use and r.regime == regime and not r.recording
    ]
    return row.error


def test_an_error_in_one_direction_of_one_recording_is_in_its_row_and_no_other():
    """3 floors forwards and noise of 1: √(9 + 1) = 3.16 there, 1 backwards, √(1 + 9 / 2) = 2.35 over all."""
    off = trace(NOISE + 3 * FLOOR_RAD * FORWARDS, POSITION, recording="off", use="fit")
    fine = trace(NOISE, POSITION, recording="fine", use="validation")
    found = regime_errors([off, fine])
    rows = {(r.recording, r.regime): r for r in found.rows}
    assert rows["off", "moving forwards"].error == pytest.approx(np.sqrt(10), rel=0.03)
    assert rows["off", "moving backwards"].error == pytest.approx(1.0, rel=0.1)
    assert rows["off", ALL].error == pytest.approx(np.sqrt(1 + 9 / 2), rel=0.03)
    assert rows["fine", ALL].error == pytest.approx(1.0, rel=0.05)
    assert rows["off", ALL].n == len(POSITION)
    assert (
        found.worst is not None
        and found.worst.recording == "off"
        and found.worst.error > 3.0
    )
    assert pooled(found, "fit") == rows["off", ALL].error


def test_fit_and_validation_that_disagree_are_remarked_in_either_way():
    """1.47 floors after the fit and 0.92 in validation were silent once."""
    one = NOISE / np.sqrt(np.mean((NOISE / FLOOR_RAD) ** 2))
    for uses in (("fit", "validation"), ("validation", "fit")):
        large = trace(1.47 * one, POSITION, recording="a", use=uses[0])
        small = trace(0.92 * one, POSITION, recording="b", use=uses[1])
        (remark,) = [
            r for r in regime_errors([large, small]).remarks if r.startswith(ALL)
        ]
        assert (
            f"{uses[0]} recordings end at 1.47" in remark
            or f"{uses[0]} recordings at 1.47" in remark
        )
        assert "0.92" in remark
    assert (
        regime_errors(
            [
                trace(one, POSITION, recording=use, use=use)
                for use in ("fit", "validation")
            ]
        ).remarks
        == ()
    )


def test_ranges_that_validation_does_not_cover_are_remarked():
    """0.4 of the amplitude and the same frequency: so much of the position, of the speed and of the acceleration."""
    half = trace(NOISE, 0.4 * POSITION, recording="small", use="validation")
    found = regime_errors([trace(NOISE, POSITION, recording="large", use="fit"), half])
    ranges = {c.variable: c.ranges for c in found.coverage}
    assert ranges["position"]["fit"] == pytest.approx((-0.3, 0.3), abs=0.01)
    assert ranges["position"]["validation"] == pytest.approx((-0.12, 0.12), abs=0.01)
    for variable in ("position", "velocity", "commanded acceleration"):
        (remark,) = [r for r in found.remarks if r.startswith(variable)]
        assert "not validated" in remark
    assert found.short("validation", "fit") == (
        "position",
        "velocity",
        "commanded acceleration",
    )
    assert found.short("fit", "validation") == ()
    assert [c.unit for c in found.coverage] == ["rad", "rad/s", "rad/s²"]
    for fields, unit in (
        ({"unit": "m"}, "m"),
        ({"kind": "effort", "unit": "N"}, "m"),
        ({"kind": "effort", "unit": "N·m"}, "rad"),
    ):
        assert (
            regime_errors([trace(NOISE, POSITION, **fields)]).coverage[0].unit == unit
        )


def test_rows_that_were_not_measured_count_nowhere():
    measured = POSITION.copy()
    measured[:400] = np.nan
    found = regime_errors([trace(NOISE, POSITION, measured=measured, use="fit")])
    assert (
        next(r for r in found.rows if r.recording and r.regime == ALL).n
        == len(POSITION) - 400
    )
    assert found.remarks == (), "no validation recording: nothing to disagree with"


def test_regimes_for_the_search_have_the_noise_of_their_own_repeats():
    """Repeats that differ by 10 floors more in fast rows have a noise of 10 / √2 floors there, and theirs elsewhere."""
    first, again = recorded_slide().fit
    speed = np.abs(np.gradient(first.target[:, 0], first.time_s))
    rough = (
        again.measured
        + (speed > 0.7 * speed.max())[:, None]
        * 10.0
        * NOISE_M
        * (-1.0) ** np.arange(6000)[:, None]
    )
    quiet, loud = (
        problem_of(
            AXIS, Measurements((first, dataclasses.replace(again, measured=m)))
        ).fit[0]
        for m in (again.measured, rough)
    )
    noise = {
        name: (
            loud.regimes[name][1] * loud.floor[0],
            quiet.regimes[name][1] * quiet.floor[0],
        )
        for name in quiet.regimes
    }
    assert noise["high speed"][0] == pytest.approx(10.0 * NOISE_M / np.sqrt(2), rel=0.2)
    assert noise["high speed"][1] < 0.3 * noise["high speed"][0]
    assert quiet.regimes["high speed"][0].sum() == pytest.approx(
        (speed > 0.7 * speed.max()).sum(), rel=0.1
    )
