"""Least squares in noise floors, its intervals, and the statistics that judge it."""

import dataclasses

import numpy as np
import pytest
from made_problem import MadeProblem, Ripple, Square, drive, record
from scipy.optimize import least_squares

from taccorl.alignment.least_squares import minimise
from taccorl.alignment.measurements.correlation import Rows
from taccorl.diagnosis.search.evidence import (
    Blocks,
    bic_gain,
    block_squares,
    standard_score,
)
from taccorl.diagnosis.search.fit import (
    FAR,
    FINE,
    _scatter,
    fit,
    moved_by,
    out_of_dents,
    over_own_scale,
    residuals,
    rms,
)
from taccorl.diagnosis.search.problem import Free, free, thinned
from taccorl.diagnosis.search.screen import alike, probe


def test_intervals_hold_the_truth_as_often_as_they_say():
    inside = 0
    for seed in range(100):
        model = fit(MadeProblem(), [record(seed, seconds=3.0)], (), {})
        low, high = model.intervals()["gain"]
        inside += low <= 3.0 <= high
    assert 88 <= inside <= 100  # 95 of 100; fewer than 88 happens once in 1000


class Offset(MadeProblem):
    """measured = offset."""

    base = MadeProblem.base[1:]

    def simulate(self, base, effects, recording):
        return np.full((len(recording.time_s), 1), base["offset"])


def test_what_a_model_leaves_above_the_floor_widens_its_intervals_however_many_rows_there_are():
    """A square wave of 8 floors that no effect explains counts as 4 entries. With JᵀJ = n / 0.1² the offset's variance is that of
    the rest, (e² − 1.5²) 0.1² / 4, with e² = 1 + 8²."""
    t, problem = np.arange(0.0, 60.0, 0.005), Offset()
    square = 0.8 * np.sign(np.sin(40.0 * t))
    model = fit(problem, [record(0, gain=0.0, seconds=60.0, extra=square)], (), {})
    assert model.error == pytest.approx(np.sqrt(1.0 + 64.0), rel=0.01)
    (wide,), (narrow,) = (
        np.sqrt(model.covariance()),
        np.sqrt(model.covariance(left_over=False)),
    )
    assert wide[0] == pytest.approx(0.1 * np.sqrt((65.0 - 2.25) / 4), rel=0.02)
    assert narrow[0] < 0.1 * wide[0]
    clean = fit(problem, [record(0, gain=0.0, seconds=60.0)], (), {})
    assert np.array_equal(clean.covariance(), clean.covariance(left_over=False))


def test_of_what_is_left_within_the_noise_only_what_lasts_widens_intervals():
    """A square wave of 0.3 floors that lasts 6 s a side: of its 0.09 a share 1 − 2 · 0.75 s / 6 s is left 0.5 to 1 s later."""
    for period_s, expected in ((12.0, 0.09 * 0.75 * 0.1**2), (0.04, 0.0)):
        square = 0.03 * np.sign(
            np.sin(2.0 * np.pi / period_s * np.arange(0.0, 60.0, 0.005))
        )
        recording = record(0, gain=0.0, seconds=60.0, extra=square)
        model = fit(
            Offset(), [dataclasses.replace(recording, short_noise=True)], (), {}
        )
        assert model.covariance()[0, 0] == pytest.approx(
            expected, rel=0.2, abs=0.1**2 / 400
        )
        assert fit(Offset(), [recording], (), {}).covariance()[0, 0] < 0.1**2 / 400


class Stepped(Offset):
    """measured = offset in steps of q = 0.005, which each row takes at another offset."""

    def simulate(self, base, effects, recording):
        phase = np.random.default_rng(0).uniform(size=(len(recording.time_s), 1))
        return 0.005 * np.round(base["offset"] / 0.005 + phase) - 0.005 * phase


def test_where_a_response_jumps_an_interval_is_as_wide_as_over_its_own_range():
    """n = 400 rows with noise of 0.1: a standard error of 0.1 / √400 = 0.005 = q. A difference over h = 1e-4 makes a share h / q
    of the rows jump by q: Σ (q / h)² h / q = n q / h is n 7² in place of n."""
    recording = [record(0, gain=0.0, seconds=2.0)]
    model = fit(Stepped(), recording, (), {"offset": 0.4}, step=FINE)
    found, steps = over_own_scale(Stepped(), model, recording)
    assert np.sqrt(model.covariance()[0, 0]) == pytest.approx(0.005 / 7, rel=0.4)
    assert np.sqrt(found.covariance()[0, 0]) == pytest.approx(0.005, rel=0.4)
    assert steps[0] == pytest.approx(0.005, rel=0.4)
    smooth = fit(Offset(), recording, (), {}, step=FINE)
    assert over_own_scale(Offset(), smooth, recording)[0].covariance() == pytest.approx(
        smooth.covariance(), rel=1e-6
    )


class Dented(MadeProblem):
    """A strength s acts as s + 0.02 sin(s / 0.004): its slope is negative in places."""

    def simulate(self, base, effects, recording):
        acts = [
            Ripple(strength=one.strength + 0.02 * np.sin(one.strength / 0.004))
            for one in effects
        ]
        return super().simulate(base, acts, recording)


@pytest.mark.parametrize("start", [1.5, 1.8, 2.5])
def test_a_fit_goes_on_from_a_dent_that_it_stopped_in(start):
    recording, begun = [record(0, Ripple(strength=2.0))], {"ripple.strength": start}
    stopped = fit(Dented(Ripple), recording, ("ripple",), begun, step=FINE)
    found = out_of_dents(Dented(Ripple), stopped, recording, 30, FINE)
    assert stopped.error > 1.5 and abs(stopped.values["ripple.strength"] - 2.0) > 0.2
    assert found.error < 1.0 and abs(found.values["ripple.strength"] - 2.0) < 0.05
    smooth = fit(MadeProblem(Ripple), recording, ("ripple",), begun)
    assert out_of_dents(MadeProblem(Ripple), smooth, recording, 30) is smooth


class Furrowed(MadeProblem):
    """Rows hold the sum of the strength s and the offset o, 30 (s + o − 2.4): a furrow, with dents along s."""

    def simulate(self, base, effects, recording):
        strength = vars(effects[0])["strength"]
        dents = 0.06 * (1.0 - np.cos(40.0 * (strength - 2.0))) + 0.6 * abs(
            strength - 2.0
        )
        wave = Ripple.signal(recording.time_s, recording.data)
        return (
            3.0 * drive(recording.time_s, recording.data)
            + 30.0 * (strength + base["offset"] - 2.4)
            + dents * wave
        )[:, None]


def test_a_fit_leaves_a_dent_along_a_furrow_of_two_numbers():
    """The dents are 2π / 40 = 0.157 apart; a strength that moves alone by 0.02 leaves 6 noise floors."""
    recording = [record(0, offset=0.0)]
    stopped = fit(
        Furrowed(Square),
        recording,
        ("square",),
        {"square.strength": 2.3, "offset": 0.1},
        step=FINE,
    )
    found = out_of_dents(Furrowed(Square), stopped, recording, 30, FINE)
    assert abs(stopped.values["square.strength"] - 2.0) > 0.1
    assert found.values["square.strength"] == pytest.approx(2.0, abs=0.05)
    assert found.values["offset"] == pytest.approx(0.4, abs=0.05)


class Peaks(MadeProblem):
    """gain × the largest input so far; ``data`` are the inputs (T,) with noise of 0.02."""

    base = MadeProblem.base[:1]

    def simulate(self, base, effects, recording):
        return base["gain"] * np.maximum.accumulate(recording.data)[:, None]

    def noisier(self, recording):
        noise = np.random.default_rng(9).normal(0.0, 0.02, len(recording.data))
        return dataclasses.replace(recording, data=recording.data + noise)


def test_an_interval_holds_a_gain_that_the_peaks_of_an_input_s_noise_make_seem_smaller():
    """Inputs of 1 … 5, whose peaks are about 3 × 0.02 higher: 2 % of 3, and noise of 0.1 in 2000 rows has 0.02 %."""
    inputs = np.repeat(np.arange(1.0, 6.0), 400)
    seen = inputs + np.random.default_rng(8).normal(0.0, 0.02, 2000)
    recording = [
        dataclasses.replace(
            record(0, gain=0.0, offset=0.0, extra=3.0 * inputs), data=seen
        )
    ]
    model = fit(Peaks(), recording, (), {}, step=FINE)
    moved = moved_by(Peaks(), model, recording, recording, np.full(1, FINE))
    low, high = dataclasses.replace(model, moved=moved).intervals()["gain"]
    assert model.intervals()["gain"][1] < 2.98 and 2.8 < low < 3.0 < high < 3.1


def test_a_number_at_its_bound_is_said_to_be_there():
    problem = MadeProblem()
    problem.base = (
        Free(name="gain", unit="1", start=1.0, low=0.1, high=2.0, log=True),
        problem.base[1],
    )
    assert fit(problem, [record(0)], (), {}).at_bound == ("gain",)
    assert fit(MadeProblem(), [record(0)], (), {}).at_bound == ()
    alone, recordings = Offset(), [record(0, gain=0.0)]
    alone.base = (dataclasses.replace(Offset.base[0], low=0.6, high=0.7),)
    model = fit(alone, recordings, (), {})
    assert model.at_bound == ("offset",) and moved_by(
        alone, model, recordings, recordings, np.full(1, FINE)
    ) == [0.0]


def test_a_fit_that_runs_out_of_steps_says_so():
    short = fit(
        MadeProblem(Square), [record(0, Square(strength=3.0))], ("square",), {}, most=1
    )
    assert "not converged" in short.trouble
    assert (
        fit(
            MadeProblem(Square), [record(0, Square(strength=3.0))], ("square",), {}
        ).trouble
        == ""
    )


def test_a_simulation_that_ends_in_nan_counts_as_far_off_and_unmeasured_rows_count_nothing():
    recording = record(0)
    recording.measured[:10] = np.nan

    class Broken(MadeProblem):
        def simulate(self, base, effects, recording):
            values = super().simulate(base, effects, recording)
            values[20:30] = np.nan
            return values

    left = residuals(Broken(), {"gain": 3.0, "offset": 0.4}, [], recording)
    assert np.isnan(left[:10]).all()
    assert (left[20:30] == FAR).all()
    assert np.isfinite(left[10:]).all()


def test_blocks_are_means_of_half_a_second():
    recording = record(0, seconds=2.0)
    model = fit(MadeProblem(), [recording], (), {})
    blocks = block_squares(MadeProblem(), model, [recording])
    assert len(blocks.squares) == 4  # 400 rows at 200 Hz
    assert blocks.mean == pytest.approx(rms(model.residuals) ** 2)


def test_standard_score_is_mean_over_its_error():
    # mean 2, deviation √(((1−2)² + 0 + (3−2)²) / 2) = 1, error 1/√3
    assert standard_score(
        Blocks(np.array([1.0, 2.0, 3.0]), np.full(3, 1 / 3))
    ) == pytest.approx(2 * np.sqrt(3))
    assert standard_score(Blocks(np.array([5.0]), np.ones(1))) == 0.0
    assert standard_score(Blocks(np.zeros(4), np.full(4, 0.25))) == 0.0


def test_a_block_with_little_weight_decides_little():
    # 24 blocks of 100 rows gain 1 ± 0.2, and one of a single row loses 100. With equal weights it would outweigh them all.
    gains = np.append(1.0 + 0.2 * (-1.0) ** np.arange(24), -100.0)
    weights = np.append(np.full(24, 100.0), 1.0) / 2401.0
    equal = Blocks(gains, np.full(25, 1 / 25))
    assert equal.mean == pytest.approx((24 - 100) / 25)
    weighed = Blocks(gains, weights)
    assert weighed.mean == pytest.approx((2400 - 100) / 2401)
    assert standard_score(weighed) > 10 > 0 > standard_score(equal)


def test_bic_of_a_needless_parameter_falls_below_zero():
    recordings, problem = [record(0)], MadeProblem(Ripple)
    parent, child = (
        fit(problem, recordings, (), {}),
        fit(problem, recordings, ("ripple",), {}),
    )
    # one number of ln n less a trifle: on its logarithmic scale it cannot quite reach 0
    assert -np.log(3000) - 2 < bic_gain(parent, child, 1) < -np.log(1000)
    there = [record(0, Ripple(strength=0.5))]
    parent, child = fit(problem, there, (), {}), fit(problem, there, ("ripple",), {})
    assert bic_gain(parent, child, 1) > 50


def test_the_probe_of_the_true_effect_explains_what_it_is_and_says_how_strong():
    problem, recordings = MadeProblem(Ripple, Square), [record(0, Ripple(strength=0.3))]
    parent = fit(problem, recordings, (), {})
    found = probe(problem, recordings, parent, list(problem.candidates.values()))
    ripple, other = [p for p in found if p.name == "ripple"][:2]
    square = next(p for p in found if p.name == "square")
    strength = ripple.start["ripple.strength"]
    # power 0.3²/2 of the signal against 0.1² of noise: 0.045 / 0.055
    assert ripple.explained == pytest.approx(0.818, abs=0.02)
    assert ripple.multiple * strength == pytest.approx(0.3, abs=0.01)
    assert ripple.visible == pytest.approx(10 * strength / np.sqrt(2), rel=0.01)
    # what is left to be explained is √(0.045 + 0.01) / 0.1 = 2.35 floors: a start of thrice that has been weakened
    assert ripple.visible <= 3 * 2.35
    assert square.explained < 0.02
    assert alike(ripple, other) == pytest.approx(1.0)
    assert alike(ripple, square) < 0.05


def test_strengths_that_cannot_change_sign_are_searched_on_a_logarithmic_scale():
    one, both = (free(cls.parameters()[0], cls) for cls in (Ripple, Square))
    assert one.log
    assert not both.log
    assert one.value(one.coordinate(2.5)) == pytest.approx(2.5)
    assert both.value(both.coordinate(-2.5)) == pytest.approx(-2.5)
    assert one.value(one.coordinate(1e9)) == pytest.approx(one.high)
    assert one.value(9e9) == one.high


@pytest.mark.parametrize(("start", "told"), [(0.0, ()), (1.0, ("size",))])
def test_a_number_that_ends_where_its_range_begins_is_no_warning_if_it_began_there(
    start, told
):
    size = Free(name="size", unit="m", start=start, low=0.0, high=1.0, scale=1e-5)
    ended = dataclasses.replace(
        fit(Offset(), [record(0, gain=0.0)], (), {}),
        frees=(size,),
        values={"size": 1e-6},
        at_bound=("size",),
    )
    assert tuple(f.name for f in ended.at_an_end) == told


@pytest.mark.parametrize(
    ("settings", "steps", "kept"),
    [
        ("a", "n", "0"),
        ("aa", "nn", "01"),
        ("aaaa", "nnnn", "02"),
        ("aaaaaaa", "nnnnnnn", "0246"),
        ("abab", "nnnn", "012"),
        ("aaaa", "nynn", "012"),
    ],
)
def test_every_second_recording_is_searched_and_each_setting_and_regime_stays(
    settings: str, steps: str, kept: str
):
    """Letters: the setting of each recording, and whether it has rows of a regime."""
    every = [
        dataclasses.replace(
            record(k),
            setting=(float(ord(setting)),),
            regimes={"held_steps": (np.full(2000, step == "y"), 1.0)},
        )
        for k, (setting, step) in enumerate(zip(settings, steps, strict=True))
    ]
    assert "".join(str(r.data) for r in thinned(every)) == kept


def test_an_interval_takes_in_the_scatter_between_groups_of_rows():
    """One number, whose derivative is 1: its step is minus the mean residual, and the
    jackknife's variance that of the mean of four groups of as many rows."""
    means = np.array([1.0, -2.0, 0.5, 3.0])
    left = np.repeat(means, 10)
    groups = [np.repeat(np.arange(4), 10) == k for k in range(4)]
    found = _scatter(np.ones((40, 1)), left, groups)
    # Student's t of 3 degrees of freedom over the normal quantile: 3.182 / 1.960
    assert found == pytest.approx(3.182 / 1.960 * means.std(ddof=1) / 2.0, rel=1e-3)


def test_a_group_without_which_a_number_is_hardly_known_does_not_count_for_it():
    """The first group holds 100 of 103 rows of information, and the others agree."""
    left = np.repeat([0.0, 1.0, 1.0, 1.0], 10)
    steep = np.repeat([10.0, 1.0, 1.0, 1.0], 10)[:, None]
    groups = [np.repeat(np.arange(4), 10) == k for k in range(4)]
    assert _scatter(steep, left, groups) == pytest.approx(0.0, abs=1e-12)


def test_a_solver_of_few_rows_ends_where_one_of_all_rows_ends():
    """An exponential of 3000 rows: SciPy with all of them, and ``minimise`` with p + 1."""
    rng, t = np.random.default_rng(4), np.linspace(0.0, 3.0, 3000)
    measured = 2.0 * np.exp(-1.3 * t) + 0.4 + 0.02 * rng.normal(size=len(t))
    names = ("size", "rate", "offset")
    frees = [Free(name=n, unit="1", start=1.0, low=-9.0, high=9.0) for n in names]

    def residuals_of(points):
        return np.array(
            [
                p["size"] * np.exp(-p["rate"] * t) + p["offset"] - measured
                for p in points
            ]
        )

    layout = (Rows(np.ones((len(t), 1), dtype=bool), 1000.0, False),)
    found = minimise(residuals_of, frees, {}, layout, at_once=2, step=1e-6)
    all_rows = least_squares(
        lambda x: residuals_of([dict(zip(names, x, strict=True))])[0], np.ones(3)
    )
    values = [found.values[n] for n in names]
    np.testing.assert_allclose(values, all_rows.x, rtol=1e-5)
    np.testing.assert_allclose(found.residuals, all_rows.fun, atol=1e-5)
    np.testing.assert_allclose(found.jacobian, all_rows.jac, atol=1e-4)
