"""Planted effects of the pads, computed apart from the twin's own: the search finds them; nothing is found where nothing is."""

import dataclasses
from functools import cache
from typing import ClassVar

import numpy as np
import pytest
from made_press import K_D, K_N, Law, ball_at, plain, press

from taccorl.alignment.touch.motion import TouchMotion, touch_motion
from taccorl.diagnosis.problems.pads import gain_words, unjudged_gains
from taccorl.diagnosis.problems.touch_problem import (
    FRAMES_A_ROW,
    TouchProblem,
    _noise_gain,
    _repeat_floor,
    odd_cells,
)
from taccorl.diagnosis.search.fit import fit
from taccorl.diagnosis.search.problem import Problem, split_rows
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.diagnosis.search.screen import probe
from taccorl.diagnosis.search.search import diagnose
from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.pads import TaxelCrosstalk
from taccorl.sim.twin import TwinConfig

CONFIG = TwinConfig()
FEW = (
    "taxel_saturation",
    "touch_lag",
    "baseline_drift",
    "taxel_gain_map",
)  # all of them with make test-slow
PLACES = ((0.001, 0.003), (-0.004, -0.012))
GAINS = np.exp(0.25 * np.random.default_rng(5).standard_normal((2, 32, 12)))
DEAD = ((0, 16, 6), (1, 17, 5))
GAINS[0, 16, 6] = GAINS[1, 17, 5] = 0.0


def _followed(f: np.ndarray, time_constant_s: float) -> np.ndarray:
    """A low-pass in ten Euler steps a frame, its input in straight lines."""
    state, seen, before = np.zeros_like(f[0]), np.empty_like(f), f[0]
    for k, now in enumerate(f):
        for j in range(10):
            state = (
                state
                + (before + (now - before) * (j + 1) / 10 - state)
                * 0.001
                / time_constant_s
            )
        seen[k], before = state, now
    return seen


def _play(f: np.ndarray, half: float) -> np.ndarray:
    state, seen = np.zeros_like(f[0]), np.empty_like(f)
    for k, now in enumerate(f):
        state = np.clip(state, (1 - half) * now, (1 + half) * now)
        seen[k] = state
    return seen


def _neighbours(f: np.ndarray) -> np.ndarray:
    g = np.pad(f, ((0, 0), (0, 0), (1, 1), (1, 1)), mode="edge")
    return (
        g[:, :, 2:, 1:-1] + g[:, :, :-2, 1:-1] + g[:, :, 1:-1, 2:] + g[:, :, 1:-1, :-2]
    )


def _crossed(f: np.ndarray) -> np.ndarray:
    return f.sum(axis=2, keepdims=True) + f.sum(axis=3, keepdims=True) - 2 * f


def _hertz(depth: np.ndarray, rate: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Power law of depth alone: damping is not bent with it, as the twin's would be."""
    return np.where(
        depth > 0, np.maximum(K_N * 1e-3 * (depth / 1e-3) ** 1.4 + K_D * rate, 0.0), 0.0
    )


PLANTED: dict[str, Law] = {
    "taxel_saturation": lambda d, r, t: plain(d, r, t) / (1 + plain(d, r, t) / 2.0),
    "taxel_power_law": _hertz,
    "taxel_threshold": lambda d, r, t: np.maximum(plain(d, r, t) - 0.12, 0),
    "taxel_creep": lambda d, r, t: (
        plain(d, r, t) + 0.25 * _followed(plain(d, r, t), 0.8)
    ),
    "touch_lag": lambda d, r, t: _followed(plain(d, r, t), 0.04),
    "touch_delay": lambda d, r, t: (
        (np.roll(plain(d, r, t), 2, axis=0) + np.roll(plain(d, r, t), 3, axis=0)) / 2
    ),
    "taxel_crosstalk": lambda d, r, t: (
        0.8 * plain(d, r, t) + 0.05 * _neighbours(plain(d, r, t))
    ),
    "taxel_ghosting": lambda d, r, t: plain(d, r, t) + 0.012 * _crossed(plain(d, r, t)),
    "taxel_hysteresis": lambda d, r, t: _play(plain(d, r, t), 0.15),
    "baseline_drift": lambda d, r, t: plain(d, r, t) + 0.008 * t[:, None, None, None],
    "taxel_gain_map": lambda d, r, t: GAINS * plain(d, r, t),
    "depth_offset": plain,
    "pad_shift": plain,
}


@cache
def recorded(name: str, seed: int) -> TouchMotion:
    x_m, z_m = PLACES[seed % 2]
    made = press(seed, ball=ball_at(x_m, z_m), law=PLANTED.get(name, plain))
    if (
        name == "depth_offset"
    ):  # both pads 0.1 mm thicker: they reach so far into an opening that is 0.2 mm greater
        made = dataclasses.replace(made, measured=made.measured + 2e-4)
    if name == "pad_shift":  # the ball is taken to sit beside where it is
        x_m, z_m = x_m + 6e-4, z_m - 4e-4
    return touch_motion(made, CONFIG, ball_at(x_m, z_m))


@cache
def problem(name: str, num: int = 2) -> tuple[TouchProblem, list]:
    motions = [recorded(name, seed) for seed in range(num)]
    made = TouchProblem(motions, CONFIG)
    return made, [made.recording(motion) for motion in motions]


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[] if n in FEW else pytest.mark.slow) for n in PLANTED],
)
def test_the_planted_effect_explains_most_at_first_sight(name: str) -> None:
    """Of all candidates the probe of the true one takes up most of what is left, or is among the first three."""
    made, recordings = problem(name, 1)
    base = fit(made, recordings, [], {})
    assert base.error > 1.15
    probes = probe(made, recordings, base, list(made.candidates.values()))
    order = list(
        dict.fromkeys(p.name for p in sorted(probes, key=lambda p: -p.explained))
    )
    assert name in order[:3], [(p.name, round(p.explained, 3)) for p in probes]


def test_nothing_is_missing_where_nothing_is_and_the_base_is_recovered() -> None:
    made, recordings = problem("none", 4)
    found = diagnose(made, recordings[:2], recordings[2:])
    assert found.names == () and found.base["k_n"] == pytest.approx(K_N, rel=0.003)
    assert (
        found.base["k_d"] == pytest.approx(K_D, rel=0.03)
        and abs(found.base["zero_left_a"]) < 0.1
    )
    assert found.errors["fitted"]["validation"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(PLANTED))
def test_the_planted_effect_is_added_and_the_error_falls_to_the_floor(
    name: str,
) -> None:
    made, recordings = problem(name, 4)
    found = diagnose(made, recordings[:2], recordings[2:])
    assert name in found.names or name in found.rivals.get(found.names[0], ())
    assert found.names[0] == name
    assert found.errors["after"]["validation"] < 1.25


def test_a_gain_map_is_estimated_from_the_rows_that_are_fitted_to_and_dead_taxels_are_in_it() -> (
    None
):
    made, recordings = problem("taxel_gain_map")
    base = {f.name: f.start for f in made.base} | {"k_n": K_N, "k_d": K_D}
    (effect,) = made.prepare(
        base, [made.candidates["taxel_gain_map"].make({})], recordings
    )
    gains = np.reshape(effect.gains, GAINS.shape)
    pressed = (
        np.max([m.data.motion.depth()[0].max(axis=0) for m in recordings], axis=0)
        > 2e-4
    )
    assert pressed.sum() > 40
    true = GAINS / np.median(GAINS[pressed])
    assert np.abs(gains - true)[pressed].max() < 0.1
    never = (
        np.max([m.data.motion.near(1e-4).max(axis=0) for m in recordings], axis=0) == 0
    )
    np.testing.assert_array_equal(gains[never], 1.0)
    early, _ = split_rows(recordings, 0.5)
    (half,) = made.prepare(base, [made.candidates["taxel_gain_map"].make({})], early)
    assert half.gains != effect.gains


def test_no_map_is_made_of_noise() -> None:
    made, recordings = problem("none")
    base = {f.name: f.start for f in made.base} | {"k_n": K_N, "k_d": K_D}
    (effect,) = made.prepare(
        base, [made.candidates["taxel_gain_map"].make({})], recordings
    )
    assert np.abs(np.array(effect.gains) - 1.0).max() < 0.02


def test_what_the_pads_do_not_repeat_is_in_the_floor() -> None:
    """A ball that sits 20 µm deeper the second time: K_N · 20 µm · 75 = 1.35 counts, RMS / √2 where it touches."""
    first = press(0)
    again = press(7, motion_seed=0, repeat_of="press_0", name="press_0_again")
    offset = dataclasses.replace(press(7, motion_seed=0), measured=again.measured)
    deeper, ball = dataclasses.replace(again, touch=offset.touch), ball_at(*PLACES[0])
    counts = deeper.touch.counts.reshape(-1, 4, 384).copy()
    pressed = touch_motion(first, CONFIG, ball)
    held = np.zeros((len(counts), 2, 384), bool)
    held[: len(pressed.time_s)] = pressed.near(0.0).reshape(len(pressed.time_s), 2, -1)
    counts[:, :2] += np.where(held, 3, 0).astype(np.int16)
    deeper = dataclasses.replace(
        deeper,
        touch=dataclasses.replace(deeper.touch, counts=counts.reshape(len(counts), -1)),
    )
    motions = [touch_motion(m, CONFIG, ball) for m in (first, deeper)]
    alone, both = TouchProblem(motions[:1], CONFIG), TouchProblem(motions, CONFIG)
    kept = both.recording(motions[0]).data.rows[:, None] * FRAMES_A_ROW + np.arange(
        FRAMES_A_ROW
    )
    share = (
        motions[0].near(0.0)[kept.ravel()].mean(axis=0)
    )  # of the rows that are judged, not of all
    often = share > 0.2
    expected = np.sqrt(np.square(alone.floor_count) + share * 9 / 2)
    np.testing.assert_allclose(both.floor_count[often], expected[often], rtol=0.2)
    assert np.median(both.floor_count[often] / alone.floor_count[often]) > 1.3


def test_an_effect_that_the_twin_has_is_refitted_where_it_acts_on_just_these_pads_and_else_stays() -> (
    None
):
    motions, pads = [recorded("none", 0)], ["left_a", "left_b"]
    own = TouchProblem(
        motions,
        TwinConfig(effects=[make_effect("touch_lag", time_constant_s=0.02, pads=pads)]),
    )
    assert own.present == ("touch_lag",)
    assert own.start["touch_lag.time_constant_s"] == 0.02
    wide = TouchProblem(
        motions, TwinConfig(effects=[make_effect("touch_lag", time_constant_s=0.02)])
    )
    assert wide.present == ()
    assert "touch_lag" not in wide.candidates
    assert "touch_delay" in wide.candidates


def test_candidates_are_all_effects_that_a_matched_replay_can_show() -> None:
    made: Problem
    made, recordings = problem("none", 1)
    assert set(made.candidates) >= set(PLANTED)
    assert len(made.candidates) >= 12
    assert not {
        "pad_compliance",
        "contact_compliance",
        "taxel_gain_spread",
        "dead_taxels",
    } & set(made.candidates)
    assert [f.name for f in made.candidates["taxel_power_law"].frees] == [
        "taxel_power_law.exponent"
    ]
    assert recordings[0].measured.shape[1] <= 64


def test_interpolated_repeats_do_not_lower_the_floor() -> None:
    """White noise of 4 counts a frame in both, the second shifted by half a frame: √(0.5² + 4 + 0.5²) / 5 · 4 of the laid row,
    where an untouched one has 4 / √5. Without a correction the floor is √(1.9 / 2), 2.5 %, too low."""
    first = press(0, ball=ball_at(*PLACES[0]), noise_count=4.0)
    again = press(
        7,
        ball=ball_at(*PLACES[0]),
        noise_count=4.0,
        motion_seed=0,
        repeat_of="press_0",
        name="again",
    )
    late = dataclasses.replace(
        again, touch=dataclasses.replace(again.touch, time_s=again.touch.time_s + 0.005)
    )
    still = np.zeros((2, 32, 12))
    exact, half = (
        _repeat_floor(
            [touch_motion(m, CONFIG, ball_at(*PLACES[0])) for m in (first, other)],
            still,
        ).taxel_count
        for other in (again, late)
    )
    untouched = slice(26, 32)  # the ball is in the middle
    known = np.sqrt((4.0**2 + 1 / 12) / FRAMES_A_ROW)
    assert np.sqrt(np.mean(np.square(exact[:, untouched]))) == pytest.approx(
        known, rel=0.008
    )
    assert np.sqrt(np.mean(np.square(half[:, untouched]))) == pytest.approx(
        known, rel=0.008
    )


def test_the_noise_of_an_interpolated_row_is_that_of_its_weights() -> None:
    np.testing.assert_allclose(_noise_gain(np.zeros(5)), [1.0])
    np.testing.assert_allclose(_noise_gain(np.full(5, 0.5)), [(0.25 + 4 + 0.25) / 5])
    # Weights of six frames: 1, 1 − 0.1 five times over less the last, which keeps 0.4
    np.testing.assert_allclose(
        _noise_gain(np.arange(5) * 0.1), [(1 + 4 * 0.9**2 + 0.4**2) / 5]
    )


@pytest.mark.parametrize("name", [*PLANTED, "none"])
def test_a_window_of_the_pads_reads_what_whole_pads_read(name: str) -> None:
    """Also where a taxel passes its reading on, and where the pads are shifted."""
    made, recordings = problem("none", 1)
    (recording,), values = recordings, {f.name: f.start for f in made.base}
    if name != "none":
        c = made.candidates[name]
        values |= {f.name: f.start for f in c.frees} | c.starts[0]
        effects = made.prepare(values, [c.make(values)], recordings)
    else:
        effects = []
    chosen = recording.data
    assert chosen.window.size < 768
    reading = made._model.simulate(chosen.motion, values["k_n"], values["k_d"], effects)
    counts = made._model.counts(chosen.motion, reading)
    rows = (
        counts[: len(counts) // FRAMES_A_ROW * FRAMES_A_ROW]
        .reshape(-1, FRAMES_A_ROW, counts[0].size)
        .mean(axis=1)
    )
    quick = made.simulate(values, effects, recording)
    np.testing.assert_allclose(quick, rows[chosen.rows][:, chosen.taxels], atol=2e-4)
    assert quick.max() > 20


@dataclasses.dataclass(kw_only=True)
class Whole(TaxelCrosstalk):
    """As an effect of another package that says nothing of windows."""

    windows: ClassVar = False


def test_an_effect_that_must_have_whole_pads_gets_them() -> None:
    made, (recording,) = problem("none", 1)
    values = {f.name: f.start for f in made.base}
    one, other = (
        made.simulate(values, [cls(share=0.3, pads=["left_a", "left_b"])], recording)
        for cls in (TaxelCrosstalk, Whole)
    )
    np.testing.assert_allclose(one, other, atol=2e-4)
    with pytest.raises(TaccorlError, match=r"taxel_crosstalk.*whole pads"):
        made._model.simulate(recording.data.cut, 900.0, 9.0, [Whole(share=0.3)])


def with_gains(place: tuple[float, float], seed: int) -> TouchMotion:
    law = PLANTED["taxel_gain_map"]
    return touch_motion(
        press(seed, ball=ball_at(*place), law=law), CONFIG, ball_at(*place)
    )


def of_elsewhere(place: tuple[float, float]) -> tuple[TouchProblem, list, list]:
    """Fitted to a ball at the first place, judged on one that is pressed elsewhere."""
    fitted, other = with_gains(PLACES[0], 0), with_gains(place, 3)
    made = TouchProblem([fitted, other], CONFIG)
    return made, *made.recordings([fitted], [other])[:2]


FEW = (
    "pad_shift",
    "depth_offset",
    "taxel_creep",
    "taxel_power_law",
    "taxel_hysteresis",
    "taxel_ghosting",
    "touch_lag",
)


@pytest.mark.slow
def test_a_gain_map_is_judged_on_the_taxels_that_both_fit_and_validation_press() -> (
    None
):
    """6 mm to the side: half of the patch was never pressed in the fit, and no map can know its gains."""
    made, fit_to, validation = of_elsewhere((0.007, 0.003))
    assert made.not_shared == []
    pressed = [
        (r.data.motion.depth()[0] > 5e-5).sum(axis=0).ravel() >= 25
        for r in (fit_to[0], validation[0])
    ]
    judged = np.zeros(768, bool)
    judged[validation[0].data.taxels] = True
    assert (pressed[1] & ~pressed[0]).sum() > 5
    assert not (judged & pressed[1] & ~pressed[0]).any()
    assert (judged & pressed[1] & pressed[0]).sum() >= 8
    found = diagnose(made, fit_to, validation, without=FEW)
    assert found.names[0] == "taxel_gain_map"
    assert (
        found.errors["fitted"]["validation"] > 2.0
        and found.errors["after"]["validation"] < 1.3
    )


@pytest.mark.slow
def test_gains_that_no_validation_recording_can_judge_are_named_by_their_statistics() -> (
    None
):
    made, fit_to, validation = of_elsewhere((-0.003, -0.018))
    assert made.not_shared == ["press_3"]
    found = diagnose(
        made, fit_to, validation, without=FEW, config=SearchConfig(max_effects=1)
    )
    assert found.status in ("something_else", "too_many")
    gains = unjudged_gains(made, found, fit_to, validation, SearchConfig())
    # The gains' logarithms were drawn with 0.25; of 50 of them the standard deviation has an error of a tenth.
    assert gains.log_std == pytest.approx(0.25, rel=0.3)
    dead = sum(
        bool(m.data.motion.depth()[0][:, p, r, c].max() > 2e-4)
        for m in fit_to
        for p, r, c in DEAD
    )
    assert gains.num_dead == dead > 0
    words = gain_words(gains, made.not_shared)
    assert (
        "dead_taxels" in words
        and "taxel_gain_spread" in words
        and "press_3 presses other taxels" in words
    )
    assert "excite --pads: rod_across" in words


def test_dead_and_odd_cells_are_named_by_pad_row_and_column() -> None:
    """Gains of a twentieth, 1.9 and 1.05 among such of 1 ± 0.05; what nothing pressed has 1."""
    gains = np.ones((2, 32, 12))
    gains[:, 4:20, 2:9] += 0.05 * np.random.default_rng(0).standard_normal((2, 16, 7))
    gains[0, 5, 7], gains[1, 10, 3], gains[1, 11, 3] = 0.05, 1.9, 1.05
    dead, odd = odd_cells(gains, ("left_a", "left_b")).split("; ")
    assert dead == "left_a: 1 taxel (row, column): (5, 7) read nothing"
    assert odd.startswith("left_b: 1 taxel (row, column): (10, 3) read 1.9 times")
    assert odd_cells(np.ones((2, 32, 12)), ("left_a", "left_b")) == ""


def test_no_statistics_are_named_where_nothing_is_left_over() -> None:
    fitted, other = recorded("none", 0), recorded("none", 1)
    made = TouchProblem([fitted, other], CONFIG)
    fit_to, validation, _ = made.recordings([fitted], [other])
    found = diagnose(made, fit_to, validation)
    assert found.status == "nothing_missing"
    assert unjudged_gains(made, found, fit_to, validation, SearchConfig()) is None
