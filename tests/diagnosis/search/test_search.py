"""The search on problems whose answers can be written down (made_problem)."""

import dataclasses
from typing import ClassVar

import numpy as np
import pytest
from made_problem import (
    Bump,
    Hidden,
    MadeProblem,
    Ripple,
    Square,
    Squire,
    drive,
    kind,
    record,
)

from taccorl.diagnosis.search import fits
from taccorl.diagnosis.search.problem import EFFORT_SCALE, Found, Free, Stopped
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.search import diagnose
from taccorl.errors import TaccorlError
from taccorl.report.account import account
from taccorl.sim.effects.effect import number


def made(*effects, extra=0.0, seeds=(0, 1, 2), noise=0.1):
    return [
        [record(seed + k, *effects, extra=extra, noise=noise) for k in range(1)]
        for seed in seeds
    ]


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
    left_out = diagnose(
        MadeProblem(Ripple, Bump, Square), fit, validation, without=["ripple"]
    )
    assert left_out.status == "something_else" and left_out.names == ()


def test_nothing_is_added_where_nothing_is_missing():
    problem = MadeProblem(Ripple, Bump, Square, Squire, Hidden)
    for seed in range(40):
        found = diagnose(problem, [record(3 * seed)], [record(3 * seed + 1)])
        assert found.names == ()
        assert found.status == "nothing_missing"


@dataclasses.dataclass(kw_only=True)
class Wide(Squire):
    """A square whose second number no recording moves."""

    name: ClassVar = "wide"
    equals_when_wide: ClassVar = {"square": "idle"}
    idle: float = number("i", "1", None, 1.9, (0.5, 2.0), "made up")


@pytest.mark.parametrize("rival", [Squire, Wide])
def test_what_cannot_be_told_apart_is_a_tie_and_the_simpler_one_is_taken(
    rival: type[Squire],
):
    """Also where the other one contains the simpler one."""
    fit, validation, _ = made(rival(strength=2.0))
    found = diagnose(MadeProblem(Ripple, Square, rival), fit, validation)
    assert found.names == ("square",)
    assert found.rivals == {"square": (rival.name,)} and found.rounds[0].ties == (
        rival.name,
    )
    verdicts = {row.name: row.verdict for row in found.rounds[0].evidence}
    assert verdicts["square"] == "added"
    assert verdicts[rival.name] == "tied with square"


def test_an_effect_that_the_fitted_numbers_take_up_stays_unseen_and_explains_nothing():
    fit, validation, _ = made(Hidden(strength=1.0), Ripple(strength=1.0))
    found = diagnose(MadeProblem(Hidden, Ripple), fit, validation)
    assert found.names == ("ripple",) and found.base["gain"] == pytest.approx(
        4.0, abs=0.02
    )
    row = next(row for row in found.rounds[0].evidence if row.name == "hidden")
    assert row.explained == 0.0


def test_structure_that_no_effect_explains_or_one_recording_alone_shows_is_called_something_else():
    t = np.arange(0.0, 10.0, 0.005)
    fit, validation, _ = made(extra=np.sign(np.sin(3.0 * t)))
    for one, other in (
        (fit, validation),
        ([record(0, Ripple(strength=1.0))], [record(1, extra=1.0)]),
    ):
        found = diagnose(MadeProblem(Ripple, Bump, Square), one, other)
        assert (found.status, found.names) == ("something_else", ())
        assert all(row.verdict for row in found.rounds[0].evidence)
    parts = [
        [dataclasses.replace(r, name="a", regimes={"all": (t >= 0.0, 1.0)}) for r in of]
        for of in (fit, validation)
    ]
    nearest = diagnose(MadeProblem(Ripple, Bump, Square), *parts).nearest
    assert sorted(name for name, _ in nearest) == ["bump", "ripple", "square"], (
        "each once, though both parts stand out"
    )


def test_what_only_a_test_recording_shows_is_said_and_ends_no_diagnosis():
    """1.4 floors everywhere, √(1 + 0.098² / 0.1²), which the search may leave; and steps of 1 in the test recording."""
    t, rng = np.arange(0.0, 10.0, 0.005), np.random.default_rng(0)
    all_rows = {"all": (t >= 0.0, 1.0)}
    fit, validation, test = (
        [
            dataclasses.replace(
                record(k, extra=0.098 * rng.standard_normal(len(t)) + steps),
                name=f"recording {k}",
                regimes=all_rows,
            )
        ]
        for k, steps in enumerate((0.0, 0.0, np.sign(np.sin(3.0 * t))))
    )
    found = diagnose(MadeProblem(Ripple, Bump, Square), fit, validation, test)
    assert found.names == () and found.status == "something_else"
    assert [p.recording for p in found.standing_out] == ["recording 2"]
    assert found.nearest == ()
    (out,) = account("it", found).get("stands_out")
    assert out.values["place"].startswith("recording 2, ")


def test_a_search_reports_each_effect_that_it_accepts_and_its_end():
    split, reports = made(Ripple(strength=1.0), Tone(strength=0.5)), list[Found]()

    def progress(text: str) -> None:
        if isinstance(text, Found):
            reports.append(text)

    found = diagnose(MadeProblem(Ripple, Tone, Square), *split, progress=progress)
    named = [[e.name for e in r.effects] for r in reports]
    assert ["ripple"] in named and named[-1] == ["ripple", "tone"]
    assert [r.finished for r in reports] == [False] * (len(reports) - 1) + [True]
    assert reports[-1].base == found.base and reports[-1].errors == found.errors


def test_effects_that_the_twin_has_are_refitted_and_stay():
    fit, validation, _ = made(Ripple(strength=2.0), Square(strength=1.0))
    found = diagnose(
        MadeProblem(Ripple, Square),
        fit,
        validation,
        present=["ripple"],
        start={"ripple.strength": 0.5},
    )
    assert found.present == ("ripple",)
    assert found.names == ("ripple", "square")
    assert found.after.values["ripple.strength"] == pytest.approx(2.0, abs=0.02)
    before, fitted, after = (
        found.errors[stage]["validation"] for stage in ("before", "fitted", "after")
    )
    assert before > fitted > after


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
    fit, validation = (
        [dataclasses.replace(record(k, offset=0.0, noise=0.5), floor=np.array([2.0]))]
        for k in (0, 1)
    )
    cut = diagnose(Valley(), fit, validation)
    assert cut.errors["after"]["validation"] < 1.25 and cut.trouble
    assert cut.status == "not_converged"
    whole = diagnose(Valley(), fit, validation, config=SearchConfig(last_steps=1000))
    assert whole.status == "nothing_missing" and whole.base["gain"] == pytest.approx(
        3.0, abs=0.05
    )


def test_a_direction_that_the_recordings_leave_open_is_wide_and_no_trouble(monkeypatch):
    """With the solver stopped each time after two steps, at the best place there is, χ² has no more to give."""
    plain = fits.fit
    monkeypatch.setattr(
        fits, "fit", lambda p, r, n, s, most, step: plain(p, r, n, s, 2, step)
    )
    fit, validation, _ = made(Squire(strength=1.7))
    found = diagnose(MadeProblem(Squire), fit, validation)
    assert found.names == ("squire",)
    assert found.trouble == ""
    low, high = found.effects[0].interval[
        "idle"
    ]  # nothing hangs on it: the whole of its range
    assert (low, high) == (0.5, 2.0)


Overtone = kind(
    "overtone", lambda t, seed: Ripple.signal(t, seed) + 0.3 * np.sin(90.0 * t)
)
"""The ripple's signal, plus a sine at 90 rad/s that no recording contains."""


def test_a_round_goes_on_to_the_next_effect_when_the_best_one_is_refused():
    """The map has the least error, but a million numbers; the overtone is acceptable."""
    fit, validation, _ = made(Ripple(strength=1.0))
    problem = MadeProblem(Ripple, Overtone)
    problem.candidates["ripple"] = dataclasses.replace(
        problem.candidates["ripple"], num_maps=10**6
    )
    found = diagnose(problem, fit, validation, config=SearchConfig(max_effects=1))
    first, second = found.rounds[0].evidence[:2]
    assert (first.name, second.name) == ("ripple", "overtone")
    assert "ΔBIC -" in first.verdict
    assert second.verdict == "added" and found.names == ("overtone",)


Richer = kind(
    "richer",
    lambda t, seed: Square.signal(t, seed) + 0.0775 / 2.0 * np.sin(7.0 * t),
    Squire,
)
"""A square and a sine: explains a little more of what lies below the floor."""


def test_below_one_floor_the_simplest_effect_is_taken_and_not_the_one_with_less_error():
    """Noise 0.1, floor 0.12: squared error 0.69 with the sine and 0.69 + 0.0775² / 2 / 0.12² = 0.90 without, both below 1."""
    sine = 0.0775 * np.sin(7.0 * np.arange(0.0, 10.0, 0.005))
    fit, validation = (
        [
            dataclasses.replace(
                record(k, Square(strength=2.0), extra=sine), floor=np.array([0.12])
            )
        ]
        for k in (0, 1)
    )
    found = diagnose(MadeProblem(Square, Richer), fit, validation)
    errors = {row.name: row.validation_error for row in found.rounds[0].evidence}
    assert errors["richer"] ** 2 == pytest.approx(0.69, abs=0.06)
    assert errors["square"] ** 2 == pytest.approx(0.90, abs=0.06) and found.names == (
        "square",
    )
    assert found.rivals == {"square": ("richer",)}


Bumps = kind("bumps", lambda t, seed: np.exp(-(((t % 2.0 - 0.6) / 0.1) ** 2)))
WideAndMore = kind(
    "wide_and_more",
    lambda t, seed: Wide.signal(t, seed) + 3.0 * Bumps.signal(t, seed),
    Wide,
)
"""At its bound not yet a square: it has bumps besides."""


@pytest.mark.parametrize("present", [(), ("square",)])
def test_an_effect_at_its_bound_is_kept_where_the_simpler_one_leaves_far_more_or_is_there_already(
    present,
):
    fit, validation, _ = made(WideAndMore(strength=2.0))
    found = diagnose(MadeProblem(WideAndMore, Square), fit, validation, present=present)
    by_name = {e.name: e for e in found.rounds[0].evidence}
    assert found.names[0] == "wide_and_more" or found.names == (
        *present,
        "wide_and_more",
    )
    assert (
        present
        or by_name["square"].fit_error > 1.5 * by_name["wide_and_more"].fit_error
    )


def test_an_effect_that_was_fitted_to_nothing_is_not_added():
    class ShapeOnly(MadeProblem):
        """Ripple's own strength is not in the data; its base numbers can do more as soon as the effect is there."""

        def simulate(self, base, effects, recording):
            return (
                super().simulate(base, effects, recording)
                + len(effects) * np.sin(5.0 * recording.time_s)[:, None]
            )

    t = np.arange(0.0, 10.0, 0.005)
    fit, validation, _ = made(extra=np.sin(5.0 * t))
    found = diagnose(ShapeOnly(Ripple), fit, validation)
    assert found.names == ()
    row = found.rounds[0].evidence[0]
    assert row.gain > 0.9  # it would explain nearly all …
    assert row.at_bound == ("ripple.strength",)  # … with a strength of nothing
    assert "strength 0.001" in row.verdict


@dataclasses.dataclass(kw_only=True)
class Between(Squire):
    """What lies between a ripple and bumps, and is neither: a tenth of it is a signal of its own."""

    name: ClassVar = "between"
    reduces_to: ClassVar = {"ripple": "idle"}
    equals_when_wide: ClassVar = {"bumps": "idle"}

    @classmethod
    def signal(cls, t, seed):
        return (
            Ripple.signal(t, seed)
            + 3.0 * Bumps.signal(t, seed)
            + 0.1 * np.sin(77.0 * t)
        )


def test_both_effects_between_which_the_first_one_lies_take_its_place_before_others_are_tried_beside_it():
    fit, validation, test = made(Ripple(strength=3.0), Bumps(strength=9.0))
    said: list[str] = []
    found = diagnose(
        MadeProblem(Ripple, Bumps, Between), fit, validation, test, progress=said.append
    )
    assert set(found.names) == {"ripple", "bumps"} and found.status == "at_floor"
    assert not any(text.startswith("between, ") for text in said)
    alone = diagnose(
        MadeProblem(Ripple, Bumps, Between),
        fit,
        validation,
        test,
        config=SearchConfig(max_effects=1),
    )
    # two numbers, as many as the one between them has, which leaves more
    assert set(alone.names) == {"ripple", "bumps"}


@pytest.mark.parametrize(("idle", "names"), [(0.52, ("ripple", "square")), (1.0, ())])
def test_an_effect_that_practically_equals_a_simpler_one_is_tried_as_that(idle, names):
    """``between`` equals a ripple at idle = 0.5, the end of its range."""
    fit, validation, _ = made(Ripple(strength=3.0))
    problem = MadeProblem(Ripple, Square, Between)
    one = fits.Fits(problem, fit, validation, {}, (), SearchConfig(), lambda text: None)
    model = one.whole(("between", "square"), {})
    values = model.fit.values | {"between.idle": idle}
    model.fit = dataclasses.replace(model.fit, values=values)
    assert one.simplified(model) == names


class Driven(MadeProblem):
    """The first number is a gain that the twin states."""

    base = (
        dataclasses.replace(MadeProblem.base[0], name="kp", unit="N·m/rad"),
        MadeProblem.base[1],
    )

    def simulate(self, base, effects, recording):
        return super().simulate({"gain": base["kp"], **base}, effects, recording)


@pytest.mark.parametrize(
    ("stated", "moved"), [(7.0, True), (1.0, True), (5.0, False), (2.0, False)]
)
def test_gains_that_move_by_more_than_twice_are_a_finding_of_their_own(
    stated: float, moved: bool
):
    """They are 3 in the data."""
    found = diagnose(
        Driven(Ripple), [record(0)], [record(1)], start={"kp": stated, "offset": 0.0}
    )
    assert found.names == ()
    assert found.status == ("gains_moved" if moved else "nothing_missing")
    assert found.remarks == ()


def test_an_error_that_only_the_fit_recordings_show_is_searched_too():
    """A ripple of 0.25: √(1 + 0.03 / 0.01) = 2 floors where noise is 0.1, √(1 + 0.03 / 0.09) = 1.16 where it is 0.3."""
    fit, validation = (
        [record(0, Ripple(strength=0.25))],
        [record(1, Ripple(strength=0.25), noise=0.3)],
    )
    found = diagnose(MadeProblem(Ripple, Square), fit, validation)
    assert found.errors["fitted"]["fit"] == pytest.approx(2.0, abs=0.1)
    assert found.errors["fitted"]["validation"] < 1.25
    assert found.names == ("ripple",)


Tone = kind("tone", lambda t, seed: np.sin(90.0 * t + seed))
Mix = kind(
    "mix",
    lambda t, seed: (
        Ripple.signal(t, seed) + 0.5 * Tone.signal(t, seed) + 0.3 * np.sin(60.0 * t)
    ),
)
"""A ripple, half a tone, and something that is not there."""


@pytest.mark.parametrize("most", [2, 4])
def test_an_effect_that_stood_for_two_is_exchanged_once_the_other_one_is_in(most: int):
    """Of ripple + tone, power 1/2 + 1/2, the mix alone explains 0.75² / 0.67 = 84 %, either of the two 50 %. It leaves a power of
    0.16, √(1 + 0.16 / 0.01) = 4.12 floors, beside the ripple, too, whose strength must not be negative."""
    fit, validation, test = made(Ripple(strength=1.0), Tone(strength=1.0))
    problem, said, config = (
        MadeProblem(Ripple, Tone, Mix),
        list[str](),
        SearchConfig(max_effects=most, width=1),
    )
    found = diagnose(
        problem, fit, validation, test, config=config, progress=said.append
    )
    assert set(found.names) == {"ripple", "tone"}
    assert not any(
        t.startswith(("mix and", "tone and mix", "ripple and mix")) for t in said
    ), "no third one is tried"
    assert [r.added for r in found.rounds] == ["ripple", "tone"]
    errors = {row.name: row.validation_error for row in found.rounds[1].evidence}
    assert errors["mix"] == pytest.approx(4.12, abs=0.05) and errors["tone"] < 1.1
    assert found.status == "at_floor"
    assert found.errors["after"]["test"] == pytest.approx(1.0, abs=0.05)


def test_a_stopped_search_keeps_the_effects_of_its_rounds():
    """Of ripple + 0.5 tones and noise 0.1 the tone is left: √(1 + 0.125 / 0.01) = 3.7 floors."""
    split = made(Ripple(strength=1.0), Tone(strength=0.5))

    def diagnosed(begins: str) -> Diagnosis:
        def progress(text: str) -> None:
            if text.startswith(begins):
                raise Stopped

        return diagnose(MadeProblem(Ripple, Tone, Square), *split, progress=progress)

    found = diagnosed("ripple, validation error")
    assert found.names == ("ripple",) and found.status == "too_many"
    assert found.errors["after"]["test"] == pytest.approx(3.7, abs=0.1)
    assert found.remarks[0].startswith("Stopped after ripple")
    assert diagnosed("never").names == ("ripple", "tone")
    late = diagnosed("last refit")
    assert late.names == ("ripple", "tone"), "nothing more is sought then"
    with pytest.raises(Stopped):
        diagnosed("no effect added")


Slow = kind("slow", lambda t, seed: np.sin(40.0 * t))
"""Effect that adds a sine of 40 rad/s and amplitude 1 to every recording."""
Undoing = kind(
    "undoing",
    lambda t, seed: 0.3 * np.sin(60.0 * t) - 0.9 * (seed > 0) * np.sin(40.0 * t),
)
"""Effect that adds a sine of 60 rad/s. In all recordings but the first, that of the fit, it also subtracts 0.9 ``Slow``."""


def test_two_effects_that_hide_each_other_on_validation_recordings_are_found_together():
    """Powers of the waves, noise 0.01. Fit: 0.5 + 0.045 before, 0.045 with the slow one. Validation: 0.005 + 0.045 before,
    0.405 + 0.045 with the slow one alone, 0.5 with the other one alone: both make it worse."""
    hidden = Slow(strength=1.0), Undoing(strength=1.0)
    recordings = [record(k, *hidden) for k in range(3)]
    split = recordings[:1], recordings[1:2], recordings[2:]
    alone = diagnose(
        MadeProblem(Slow, Undoing), *split, config=SearchConfig(max_effects=1)
    )
    assert alone.status == "something_else" and alone.names == ()
    # 0.5 of 0.545 + 0.01
    assert any(
        "slow" in r and "90%" in r and "--until=noise_floor" in r for r in alone.remarks
    ), alone.remarks
    assert alone.errors["fitted"]["validation"] == pytest.approx(
        np.sqrt(1 + 0.05 / 0.01), rel=0.1
    )
    slow = next(e for e in alone.rounds[0].evidence if e.name == "slow")
    assert slow.validation_error == pytest.approx(np.sqrt(1 + 0.45 / 0.01), rel=0.1)
    found = diagnose(MadeProblem(Slow, Undoing), *split)
    assert set(found.names) == {"slow", "undoing"} and found.status == "at_floor"
    assert [r.added for r in found.rounds] == ["slow", "undoing"]
    assert found.errors["after"]["test"] == pytest.approx(1.0, abs=0.06)
    nothing = diagnose(MadeProblem(Slow, Ripple), *split)
    assert nothing.status == "something_else" and "slow" not in nothing.names


_of_both = lambda t, seed: Ripple.signal(t, seed) + 0.1 * Tone.signal(t, seed)  # noqa: E731
Varied = kind("varied", _of_both, Squire, near_twins={"ripple": "made up"})
"""A ripple with a tenth of a tone, and one number more."""


def test_while_more_is_missing_the_simpler_form_of_an_effect_is_named_first():
    """Of ripple + 0.3 tones, power 0.545, the variant explains 0.515² / 0.505 = 0.525 and the ripple 0.500, 95 % of that. What
    the variant leaves, 0.0198, is 3.6 % and √(1 + 0.0198 / 0.0004) = 7.1 floors: the tone is missing, too."""
    fit, validation, _ = made(Ripple(strength=1.0), Tone(strength=0.3), noise=0.02)
    found = diagnose(
        MadeProblem(Ripple, Tone, Varied),
        fit,
        validation,
        config=SearchConfig(max_effects=2),
    )
    errors = {row.name: row.validation_error for row in found.rounds[0].evidence}
    assert (
        errors["varied"] == pytest.approx(7.1, abs=0.3)
        and errors["ripple"] > errors["varied"]
    )
    assert found.rounds[0].added == "ripple" and set(found.names) == {"ripple", "tone"}
    # A single effect is the best one: nothing follows that the simpler one would leave more to.
    one = diagnose(
        MadeProblem(Ripple, Tone, Varied),
        fit,
        validation,
        config=SearchConfig(max_effects=1),
    )
    assert one.names == ("varied",) and one.status == "too_many"
    alone = [[record(k, Varied(strength=1.0), noise=0.02)] for k in (0, 1)]
    assert diagnose(MadeProblem(Ripple, Varied), *alone).names == ("varied",)


@pytest.mark.parametrize(
    ("strength", "names"), [(5.0, {"ripple"}), (0.5, {"ripple", "square"})]
)
def test_what_little_remains_after_a_strong_effect_is_no_further_effect(
    strength: float, names: set[str]
):
    """Beside the ripple a square leaves 1.41 floors: what gain and offset do not take up of it has a power of 0.01, as the
    noise has. That is 1 / (1 + 1250) of the squared error where the ripple has 5, and 1 / (1 + 12.5) where it has 0.5."""
    t = np.arange(0.0, 10.0, 0.005)
    shape = np.column_stack([np.ones_like(t), drive(t, 1), drive(t, 1) ** 2])
    left = shape[:, 2] - shape[:, :2] @ np.linalg.lstsq(shape[:, :2], shape[:, 2])[0]
    square = Square(strength=0.1 / float(np.sqrt(np.mean(left**2))))
    fit, validation = ([record(1, Ripple(strength=strength), square)] for _ in range(2))
    found = diagnose(MadeProblem(Ripple, Square), fit, validation)
    assert set(found.names) == names and found.status == "at_floor"
    assert found.errors["after"]["validation"] == pytest.approx(
        np.sqrt(2.0) if len(names) == 1 else 1.0, abs=0.08
    )


@pytest.mark.parametrize(
    ("strengths", "is_open"), [((1.2, 0.0, 0.6, 0.1), True), ((0.475,) * 4, False)]
)
def test_an_effect_that_removes_much_for_sure_is_told_with_a_remark_where_its_strength_is_open(
    strengths: tuple[float, ...], is_open: bool
):
    """Mean strength 0.475 in both; in the first the recordings scatter by 0.55, so that the mean is known to
    ± 3.2 · 0.55 / √4 = 0.88. In both it removes about 0.12 of 0.12 + 0.6²/2, the same share of the validation error."""
    t = np.arange(0.0, 10.0, 0.005)
    fit = [record(k, Ripple(strength=s)) for k, s in enumerate(strengths)]
    found = diagnose(
        MadeProblem(Ripple),
        fit,
        [record(10, Ripple(strength=0.5), extra=0.6 * np.sin(11.0 * t))],
    )
    assert found.names == ("ripple",)
    row = found.rounds[0].evidence[0]
    assert (
        row.gain == pytest.approx(0.41, abs=0.02)
        and row.score > 10.0
        and row.bic > 100.0
    )
    assert (["ripple.strength" in r for r in found.remarks] == [True]) is is_open


@dataclasses.dataclass(kw_only=True)
class Late(Ripple):
    """A ripple of 100 / s times a delay; 0.9 ms are within what the timing of a loop leaves open."""

    name: ClassVar = "late"
    strength: float = 0.0
    delay_s: float = number("τ", "s", 0.0, 1e-3, (0.0, 0.05), "made up")

    def __post_init__(self):
        self.strength = 100.0 * self.delay_s


# ± 3.2 · 0.14 / √4 = 0.22 about 0.12 holds none; 0.12 is three times as much as in any recording that was fitted
@pytest.mark.parametrize(
    ("kind", "fitted", "validating", "names"),
    [
        (Ripple, (0.3, 0.0, 0.03, 0.15), 0.09, ()),
        (Ripple, (0.04,) * 3, 0.12, ()),
        (Ripple, (0.09,) * 3, 0.09, ("ripple",)),
        (Late, (0.09,) * 3, 0.09, ()),
    ],
)
def test_near_the_floor_an_effect_has_to_repeat_on_recordings_that_were_not_fitted(
    kind, fitted, validating, names
):
    """A ripple of 0.12 leaves √(1 + 0.12² / 2 / 0.1²) = 1.31 floors; the other wave, in the first second, starts the search."""
    t = np.arange(0.0, 10.0, 0.005)
    fit = [
        record(k, Ripple(strength=s), extra=1.2 * (t < 1) * np.sin(60.0 * t))
        for k, s in enumerate(fitted)
    ]
    found = diagnose(MadeProblem(kind), fit, [record(10, Ripple(strength=validating))])
    assert found.errors["fitted"]["fit"] > 1.5 > found.errors["fitted"]["validation"]
    row = found.rounds[0].evidence[0]
    assert 0.1 < row.gain < 0.5 and row.score > 3.0 and row.bic > 0.0
    assert found.names == names


@dataclasses.dataclass(kw_only=True)
class Product(Squire):
    """Strength times idle times a ripple: no recording tells the two numbers apart."""

    name: ClassVar = "product"
    strength: float = number("s", "1", 0.0, 1.0, (0.0, 50.0), "made up")


class Products(MadeProblem):
    def simulate(self, base, effects, recording):
        wave = Ripple.signal(recording.time_s, recording.data)
        total = sum(vars(e)["strength"] * vars(e)["idle"] for e in effects) * wave
        return super().simulate(base, [], recording) + total[:, None]


def test_an_effect_that_removes_most_of_the_error_stays_though_another_number_makes_up_for_its_strength():
    fit, validation, _ = made(Ripple(strength=1.0))
    found = diagnose(Products(Product), fit, validation)
    assert found.names == ("product",) and found.status == "at_floor"
    (remark,) = found.remarks
    assert "product.strength" in remark and "product.idle" in remark
    assert "7.1" in remark  # √(1 + 10² / 2) floors remain without it


@dataclasses.dataclass(kw_only=True)
class Double(Hidden):
    """With a number more, which does nothing."""

    name: ClassVar = "double"
    idle: float = number("i", "1", None, 1.0, (0.5, 2.0), "made up")


class Scaled(MadeProblem):
    """measured = effort_scale × 3 drive + offset + effects."""

    base = (
        *MadeProblem.base[1:],
        Free(
            name=EFFORT_SCALE,
            unit="1",
            start=1.0,
            low=0.1,
            high=10.0,
            log=True,
            held=True,
        ),
    )

    def simulate(self, base, effects, recording):
        return super().simulate(
            {"gain": 3.0 * base[EFFORT_SCALE], **base}, effects, recording
        )


@pytest.mark.parametrize(("kind", "names"), [(Hidden, ("hidden",)), (Double, ())])
def test_one_factor_on_all_efforts_is_told_beside_an_effect_of_one_number_and_in_place_of_one_of_two(
    kind, names
):
    fit, validation = ([record(k, gain=4.5)] for k in (0, 1))
    found = diagnose(Scaled(kind), fit, validation)
    assert found.names == names and found.or_number[0] == EFFORT_SCALE * bool(names)
    assert [c.after for c in found.changed] == pytest.approx(
        [1.5] * (not names), rel=0.01
    )
    assert {"tie_efforts", "scale_efforts"} & {*account("it", found).ids}


class Damped(MadeProblem):
    """measured = gain × drive + offset + effects + (kd − 2) × a ripple, of which the file states kd = 2."""

    other_gain: Free | None = Free(
        name="kd", unit="N·m·s/rad", start=2.0, low=0.2, high=20.0, log=True
    )

    def simulate(self, base, effects, recording):
        more = (base.get("kd", 2.0) - 2.0) * Ripple.signal(
            recording.time_s, recording.data
        )
        return super().simulate(base, effects, recording) + more[:, None]


@pytest.mark.parametrize(("kd", "names"), [(3.2, ("ripple",)), (1.2, ())])
def test_another_gain_than_the_stated_one_is_told_beside_the_effect_that_it_looks_like_and_alone_where_none_does(
    kd, names
):
    """A ripple has a strength of 0 or more, so that it stands for more of the gain, and not for less."""
    fit, validation = (
        [record(k, extra=(kd - 2.0) * Ripple.signal(np.arange(2000) / 200.0, k))]
        for k in (0, 1)
    )
    found = diagnose(Damped(Ripple), fit, validation)
    told = account("it", found)
    assert found.names == names
    if names:
        assert found.or_number == ("kd", pytest.approx(1.6, rel=0.01))
        (tie,) = told.get("tie_number")
        assert tie.values == {"name": "kd", "factor": found.or_number[1]}
    else:
        assert [(c.name, c.after) for c in found.changed] == [
            ("kd", pytest.approx(1.2, rel=0.01))
        ]
        assert found.status == told.kind == "numbers_off"
        assert "kd" in told.values("changed", "name")


Cube = kind("cube", lambda t, seed: drive(t, seed) ** 3, Square)
"""Much like what the gain does."""


@pytest.mark.parametrize("stated", [0.05, 1.0])
def test_an_effect_that_drives_a_number_to_the_end_of_its_range_is_not_told(stated):
    """The data have no gain; without the cube it stands for it, with the cube it goes to 0.01."""
    fit, validation = ([record(k, Cube(strength=2.0), gain=0.0)] for k in (0, 1))
    found = diagnose(MadeProblem(Cube), fit, validation, start={"gain": stated})
    assert found.names == ()
    assert "gain 0.01 at the end of its range" in found.rounds[0].evidence[0].verdict


def test_a_strength_at_the_end_of_its_range_is_told_where_nothing_is_left_above_the_floor():
    fit, validation = (
        [record(k, Cube(strength=Cube.parameters()[0].high))] for k in (0, 1)
    )
    assert diagnose(MadeProblem(Cube), fit, validation).names == ("cube",)


def test_an_effect_that_only_undoes_what_the_refit_made_worse_is_not_added():
    """The twin's gain is the best one for the validation recording, whose cube is smaller than that of the fit recording."""
    fit, validation = (
        [record(k, Cube(strength=s), noise=0.02, seconds=60.0)]
        for k, s in enumerate((0.4, 0.25))
    )
    best = diagnose(MadeProblem(), validation, validation).base
    found = diagnose(MadeProblem(Cube), fit, validation, start=best)
    before, fitted = (
        found.errors[stage]["validation"] for stage in ("before", "fitted")
    )
    assert before < 0.7 * fitted and found.baseline == "before"
    row = found.rounds[0].evidence[0]
    assert row.gain > 0.2 and row.score > 2.0  # of the refitted twin
    assert found.names == () and all(r.added is None for r in found.rounds)
    assert f"{before:.2f}" in found.remarks[0] and f"{fitted:.2f}" in found.remarks[0]


@pytest.mark.parametrize("everywhere", [True, False])
def test_an_effect_that_unused_recordings_contradict_is_not_added(everywhere: bool):
    """The search uses recordings 0 and 2 of the fit; a tone of 0.5 is in these and in the
    validation recording, and in 1 and 3 only if it is real."""
    fit = [
        record(k, Ripple(strength=1.0), Tone(strength=0.5 * (everywhere or k % 2 == 0)))
        for k in range(4)
    ]
    validation = [record(4, Ripple(strength=1.0), Tone(strength=0.5))]
    found = diagnose(MadeProblem(Ripple, Tone, Square), fit, validation)
    assert set(found.names) == ({"ripple", "tone"} if everywhere else {"ripple"})
    assert found.removed == (() if everywhere else ("tone",))


def test_an_effect_that_unused_recordings_do_not_show_stays():
    """Bumps are in the first second, of which recordings 1 and 3 were not measured."""
    every = [record(k, Bump(strength=3.0)) for k in range(5)]
    cut = [
        dataclasses.replace(
            r, measured=np.where(r.time_s[:, None] < 1.2, np.nan, r.measured)
        )
        for r in every
    ]
    fit = [cut[k] if k % 2 else every[k] for k in range(4)]
    found = diagnose(MadeProblem(Ripple, Bump, Square), fit, every[4:])
    assert found.names == ("bump",)
