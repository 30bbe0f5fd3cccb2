"""Numbers that recordings leave open return to where they began."""

import dataclasses

import numpy as np
import pytest
from made_problem import Hidden, MadeProblem, Ripple, drive, record

from taccorl.diagnosis.search.fit import FINE, fit
from taccorl.diagnosis.search.problem import Free
from taccorl.diagnosis.search.settle import settled


class Sum(MadeProblem):
    """measured = (a + b) × drive + offset: only the sum of a and b is in the data."""

    base = (
        Free(name="a", unit="1", start=1.0, low=-10.0, high=10.0),
        Free(name="b", unit="1", start=2.0, low=-10.0, high=10.0),
        MadeProblem.base[1],
    )

    def simulate(self, base, effects, recording):
        return super().simulate(
            {"gain": base["a"] + base["b"], **base}, effects, recording
        )


def seven(seed: int):
    """The recording of a sum of 7; ``record`` has a gain of 3."""
    return record(seed, extra=4.0 * drive(np.arange(0.0, 10.0, 0.005), seed))


def test_of_two_numbers_whose_sum_alone_is_known_both_end_as_near_as_they_can_to_where_they_began():
    """a + b = 7 and the least (a − 1)² + (b − 2)²: a = 3, b = 4; the fit begins at b's bound and ends there."""
    problem, fitted, validation = Sum(), [seven(0)], [seven(1)]
    began = {"a": 1.0, "b": 2.0, "offset": 9.0}
    model = fit(problem, fitted, (), {"a": -3.0, "b": 10.0, "offset": 0.0}, step=FINE)
    assert model.values["b"] > 9.9 and "b" in model.at_bound
    found = settled(problem, model, began, (), fitted, validation)
    assert found.values["a"] == pytest.approx(3.0, abs=0.02)
    assert found.values["b"] == pytest.approx(4.0, abs=0.02)
    assert found.at_bound == ()
    # the recordings determine the offset: it does not go back to 9
    sigma = np.sqrt(np.diag(model.covariance()))[2] * model.frees[2].scale
    assert abs(found.values["offset"] - model.values["offset"]) < 0.1 * sigma
    assert found.error == pytest.approx(model.error, rel=1e-3)


def test_numbers_that_the_recordings_determine_hardly_move():
    """Each moves by less than σ² / D² of its way to the start, D = 0.25 of its range: less than its standard error here."""
    problem, fitted = MadeProblem(Ripple), [record(0, Ripple(strength=1.7))]
    model = fit(problem, fitted, ("ripple",), {}, step=FINE)
    found = settled(
        problem,
        model,
        {"gain": 50.0, "offset": 9.0},
        (),
        fitted,
        [record(1, Ripple(strength=1.7))],
    )
    spread = np.sqrt(np.diag(model.covariance()))
    for f, sigma in zip(model.frees, spread, strict=True):
        moved = abs(
            f.coordinate(found.values[f.name]) - f.coordinate(model.values[f.name])
        )
        assert moved < 0.1 * sigma


def test_the_strength_of_an_added_effect_takes_up_what_an_open_number_gives_back():
    """Gain and ``hidden`` act alike, and together they are 3. The twin states a gain of 1; the strength is then 2."""
    problem, fitted, validation = MadeProblem(Hidden), [record(0)], [record(1)]
    model = fit(
        problem,
        fitted,
        ("hidden",),
        {"gain": 2.9, "offset": 0.0, "hidden.strength": 0.1},
        step=FINE,
    )
    assert model.values["gain"] > 2.5
    found = settled(
        problem, model, {"gain": 1.0, "offset": 0.0}, (), fitted, validation
    )
    assert found.values["gain"] + found.values["hidden.strength"] == pytest.approx(
        3.0, abs=0.02
    )
    there = dataclasses.asdict(found.effects[0])["strength"]
    assert there == found.values["hidden.strength"] > model.values["hidden.strength"]
    known = settled(
        problem,
        model,
        {"gain": 1.0, "offset": 0.0, "hidden.strength": 0.1},
        ("hidden",),
        fitted,
        validation,
    )
    assert known.values["hidden.strength"] < found.values["hidden.strength"]
