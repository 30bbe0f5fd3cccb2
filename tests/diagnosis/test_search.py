"""The search on problems whose answers can be written down (made_problem)."""

import dataclasses

import numpy as np
import pytest
from made_problem import Bump, Hidden, MadeProblem, Ripple, Square, Squire, drive, record

from taccorl.diagnosis import search
from taccorl.diagnosis.search import SearchConfig, diagnose
from taccorl.errors import TaccorlError


def made(*effects, extra=0.0, seeds=(0, 1, 2), noise=0.1):
    return [[record(seed + k, *effects, extra=extra, noise=noise) for k in range(1)] for seed in seeds]


def test_the_hidden_effect_is_found_with_its_strength_and_the_error_falls_to_the_floor():
    fit, validation, test = made(Ripple(strength=1.7))
    found = diagnose(MadeProblem(Ripple, Bump, Square), fit, validation, test)
    assert found.names == ("ripple",)
    assert found.status == "at_floor"
    low, high = found.effects[0].interval["strength"]
    assert low < 1.7 < high
    # 2000 rows of noise 0.1 and a sine of power 1/2: standard error 0.1 / √1000 = 0.0032
    assert high - low == pytest.approx(2 * 1.96 * 0.0032, rel=0.3)
    assert found.base["gain"] == pytest.approx(3.0, abs=0.02)
    # a ripple of 1.7 / √2 on noise of 0.1: √(1 + 12.02²) floors before, 1 after
    assert found.errors["fitted"]["test"] == pytest.approx(12.06, rel=0.02)
    assert found.errors["after"]["test"] == pytest.approx(1.0, abs=0.05)
    assert [name for name, _ in found.steps] == ["", "ripple"]


def test_nothing_is_added_where_nothing_is_missing():
    problem = MadeProblem(Ripple, Bump, Square, Squire, Hidden)
    for seed in range(40):
        found = diagnose(problem, [record(3 * seed)], [record(3 * seed + 1)])
        assert found.names == ()
        assert found.status == "nothing_missing"


def test_two_effects_are_found_one_after_the_other():
    fit, validation, test = made(Ripple(strength=1.0), Square(strength=-0.6))
    found = diagnose(MadeProblem(Ripple, Bump, Square), fit, validation, test)
    assert set(found.names) == {"ripple", "square"}
    assert found.status == "at_floor"
    errors = [error for _, error in found.steps]
    assert errors == sorted(errors, reverse=True)


def test_a_rare_event_counts_although_few_blocks_know_of_it():
    fit, validation, _ = made(Bump(strength=3.0))
    found = diagnose(MadeProblem(Ripple, Bump, Square), fit, validation)
    assert found.names == ("bump",)


def test_what_cannot_be_told_apart_is_a_tie_and_the_simpler_one_is_taken():
    fit, validation, _ = made(Squire(strength=2.0))
    found = diagnose(MadeProblem(Ripple, Square, Squire), fit, validation)
    assert found.names == ("square",)
    assert found.rivals == {"square": ("squire",)}
    verdicts = {row.name: row.verdict for row in found.rounds[0].evidence}
    assert verdicts["square"] == "added"
    assert verdicts["squire"] == "tied with square"


def test_an_effect_that_the_fitted_numbers_take_up_stays_unseen_and_explains_nothing():
    fit, validation, _ = made(Hidden(strength=1.0), Ripple(strength=1.0))
    found = diagnose(MadeProblem(Hidden, Ripple), fit, validation)
    assert found.names == ("ripple",)
    assert found.base["gain"] == pytest.approx(4.0, abs=0.02)
    row = next(row for row in found.rounds[0].evidence if row.name == "hidden")
    assert row.explained == 0.0


def test_structure_that_no_effect_explains_is_called_something_else():
    t = np.arange(0.0, 10.0, 0.005)
    fit, validation, _ = made(extra=np.sign(np.sin(3.0 * t)))
    found = diagnose(MadeProblem(Ripple, Bump, Square), fit, validation)
    assert found.status == "something_else"
    assert found.names == ()
    assert all(row.verdict for row in found.rounds[0].evidence)


def test_an_effect_that_fits_one_recording_only_is_not_believed():
    """Validation recordings decide: a ripple in the fit recording alone is an accident of it."""
    found = diagnose(MadeProblem(Ripple, Square), [record(0, Ripple(strength=1.0))], [record(1, extra=1.0)])
    assert found.names == ()
    assert found.status == "something_else"


def test_effects_that_the_twin_has_are_refitted_and_stay():
    fit, validation, _ = made(Ripple(strength=2.0), Square(strength=1.0))
    found = diagnose(MadeProblem(Ripple, Square), fit, validation, present=["ripple"], start={"ripple.strength": 0.5})
    assert found.present == ("ripple",)
    assert found.names == ("ripple", "square")
    assert found.after.values["ripple.strength"] == pytest.approx(2.0, abs=0.02)
    assert (
        found.errors["before"]["validation"]
        > found.errors["fitted"]["validation"]
        > found.errors["after"]["validation"]
    )


def test_the_true_effect_can_be_left_out_and_is_then_missed():
    fit, validation, _ = made(Ripple(strength=1.0))
    found = diagnose(MadeProblem(Ripple, Bump, Square), fit, validation, without=["ripple"])
    assert found.status == "something_else"
    assert "ripple" not in found.names


def test_an_unknown_effect_is_refused_with_the_nearest_name():
    fit, validation, _ = made()
    with pytest.raises(TaccorlError, match=r"no effect 'riple' for this part.*ripple"):
        diagnose(MadeProblem(Ripple), fit, validation, present=["riple"])


class Valley(MadeProblem):
    """measured = gain × drive + steep × (offset − gain²): a curved valley, along which a solver crawls."""

    def simulate(self, base, effects, recording):
        wall = 500.0 * (base["offset"] - base["gain"] ** 2)
        return (base["gain"] * drive(recording.time_s, recording.data) + wall)[:, None]


def test_a_fit_that_has_not_converged_is_no_proof_that_nothing_is_missing():
    """Gain 1 to gain 3 is further along the valley than 60 and 200 steps go; wide floors make every place of it look right."""
    fit, validation = ([dataclasses.replace(record(k, offset=0.0, noise=0.5), floor=np.array([2.0]))] for k in (0, 1))
    cut = diagnose(Valley(), fit, validation)
    assert cut.errors["after"]["validation"] < 1.25
    assert cut.trouble
    assert cut.status == "not_converged"
    whole = diagnose(Valley(), fit, validation, config=SearchConfig(last_steps=1000))
    assert whole.status == "nothing_missing"
    assert whole.base["gain"] == pytest.approx(3.0, abs=0.05)


def test_a_direction_that_the_recordings_leave_open_is_wide_and_no_trouble(monkeypatch):
    """With the solver stopped each time after two steps, at the best place there is, χ² has no more to give."""
    plain = search.fit
    monkeypatch.setattr(search, "fit", lambda p, r, n, s, most, step: plain(p, r, n, s, 2, step))
    fit, validation, _ = made(Squire(strength=1.7))
    found = diagnose(MadeProblem(Squire), fit, validation)
    assert found.names == ("squire",)
    assert found.trouble == ""
    low, high = found.effects[0].interval["idle"]  # nothing hangs on it: the whole of its range
    assert (low, high) == (0.5, 2.0)
