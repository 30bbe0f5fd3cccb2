"""Sensors of cells: what is hidden in a simulated one is found, gains are those set, each cell of one load has its own range."""

import dataclasses
import itertools
import re

import numpy as np
import pytest
from made_rows import of_cells, play

from taccorl.alignment.checks.cell_set import CellSet
from taccorl.alignment.checks.cells import plateaus
from taccorl.alignment.machines.cell_model import (
    Calibration,
    calibrated,
    readings,
    responses,
    thinned,
    within_ends,
)
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import (
    CellsConfig,
    Load,
    Reading,
    make_cells_effect,
)
from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.machines.cells import CellsMachine
from taccorl.diagnosis.problems.cells_problem import CellsProblem, reading_floor
from taccorl.diagnosis.problems.numbers_of_cells import numbers_apart
from taccorl.diagnosis.search.problem import split_rows
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.search import diagnose
from taccorl.surrogate.cells import HIDDEN, CellsCase, draw_cells, record, simulated

RATE_HZ = 100.0


def config(**changes) -> CellsConfig:
    """One cell, rated for 20 N: 1 in the unit ``reading`` is 2 N."""
    reading = Reading(unit="count", lowest=0.0, highest=1023.0)
    return dataclasses.replace(
        CellsConfig(cells=["thumb"], load=Load(unit="N", rated=20.0), reading=reading),
        **changes,
    )


def press(
    load_n: np.ndarray,
    reading: np.ndarray | None = None,
    cells: int = 1,
    name: str = "press",
    **changes,
) -> CellMeasurement:
    """A recording at 100 Hz of a load (T,) that all cells bear."""
    load = np.repeat(np.asarray(load_n, float)[:, None], cells, axis=1)
    names = (
        ("thumb",)
        if cells == 1
        else tuple(
            f"r{i}c{j}" for i, j in itertools.product(range(2), range(cells // 2))
        )
    )
    return CellMeasurement(
        name=name,
        time_s=np.arange(len(load)) / RATE_HZ,
        target=load,
        measured=np.zeros_like(load)
        if reading is None
        else np.asarray(reading, float).reshape(load.shape),
        signals=names,
        units=("count",) * cells,
        **changes,
    )


def found(hidden: str, seed: int) -> tuple[CellsCase, Diagnosis]:
    case = draw_cells(hidden, seed)
    problem = CellsProblem(case.config(), simulated(case))
    return case, diagnose(
        problem, problem.fit, problem.validation, problem.test, start=problem.start
    )


def test_gain_and_offset_are_least_squares_and_the_converter_cuts_at_its_ends():
    m = press(np.linspace(0, 20, 101))
    calibration = Calibration(np.array([120.0]), np.array([30.0]))
    counts = readings(config(), responses(config(), m), calibration)
    assert counts[50, 0] == pytest.approx(
        120 * 5 + 30
    )  # 10 N are 5 in the unit reading
    assert counts[-1, 0] == 1023  # 1230 cut off
    assert responses(config(), press(np.array([-0.02, 0.02])))[:, 0] == pytest.approx(
        [-0.01, 0.01]
    )  # noise stays even
    m = dataclasses.replace(m, measured=counts)
    inside = np.where(within_ends(config(), m), m.measured, np.nan)
    assert np.isnan(inside[-1, 0]) and np.isfinite(inside[50, 0])
    again = calibrated(config(), [(responses(config(), m), inside)])
    assert again.gain == pytest.approx([120.0]) and again.offset == pytest.approx(
        [30.0]
    )


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("taxel_saturation", {"limit": 5.0}, 5.0 / (1 + 5.0 / 5.0)),
        ("taxel_threshold", {"threshold": 0.5}, 4.5),
        ("taxel_power_law", {"exponent": 0.5}, 5.0**0.5),
        ("taxel_creep", {"share": 0.2, "time_constant_s": 0.5}, 5.0 * 1.2),
        ("taxel_log_creep", {"share": 0.1}, 5.0 * (1 + 0.1 * np.log10(20.0 / 0.018))),
        ("touch_delay", {"delay_s": 0.1}, 5.0),
        ("baseline_drift", {"rate_per_min": 0.6}, 5.0 + 0.6 * 20 / 60),
    ],
)
def test_effects_of_pads_act_on_a_cell_by_their_equations_after_20_s_under_10_n(
    name, values, expected
):
    effect, m = make_cells_effect(name, **values), press(np.full(2001, 10.0))
    assert responses(config(), m, [effect])[-1, 0] == pytest.approx(expected, rel=2e-3)
    own = responses(config(effects=[effect]), m)
    np.testing.assert_array_equal(
        own, responses(config(), m, [effect])
    )  # in the file, or added to it


def test_a_lag_follows_a_load_on_straight_lines_between_rows():
    """ṙ = (f − r) / T under f = a t from rest: r = a (t − T (1 − exp(−t / T)))."""
    lag_s, t = 0.06, np.arange(101) / RATE_HZ
    m = press(20.0 * t)  # 10 a second in the unit reading
    exact = 10.0 * (t - lag_s * (1 - np.exp(-t / lag_s)))
    seen = responses(
        config(), m, [make_cells_effect("touch_lag", time_constant_s=lag_s)]
    )[:, 0]
    # A held load would be half a row early, 0.05; four steps a row err by Δt² / (192 T) = 9 µs.
    np.testing.assert_allclose(seen, exact, atol=10.0 * 10e-6)


def test_the_interval_of_a_lag_contains_the_lag_of_a_sensor_simulated_at_10_khz():
    rng, lag_s, fine_s = np.random.default_rng(1), 0.06, 1e-4

    def one(peak_n: float, name: str) -> CellMeasurement:
        t = np.arange(0.0, 20.0, fine_s)
        load = np.interp(t % 5.0, [0, 1, 1.2, 3, 3.15, 5], [0, 0, peak_n, peak_n, 0, 0])
        lagged = np.zeros_like(load)
        for k in range(1, len(load)):
            middle = 0.5 * (load[k - 1] + load[k])
            lagged[k] = lagged[k - 1] + (middle - lagged[k - 1]) * -np.expm1(
                -fine_s / lag_s
            )
        rows = slice(0, None, round(1 / RATE_HZ / fine_s))
        counts = np.round(20 + 60 * lagged[rows] + rng.normal(0, 1, len(lagged[rows])))
        return press(load[rows] + rng.normal(0, 0.003, len(counts)), counts, name=name)

    measurements = Measurements(
        tuple(one(p, f"press {p}") for p in (6.0, 12.0)), (one(9.0, "press 9"),), ()
    )
    problem = CellsProblem(config(), measurements)
    d = diagnose(problem, problem.fit, problem.validation, (), start=problem.start)
    assert d.names == ("touch_lag",)
    low, high = (d.effects[0].interval or {})["time_constant_s"]
    assert low <= lag_s <= high, (low, high)
    assert high - low < 2e-3


def test_temperature_changes_gain_and_zero_about_20_degrees():
    effect = make_cells_effect("taxel_temperature", gain_per_k=0.01, zero_per_k=0.05)
    m = press(np.full(3, 10.0), temperature_c=np.array([20.0, 30.0, 10.0]))
    assert responses(config(), m, [effect])[:, 0] == pytest.approx(
        [5.0, 5.0 * 1.1 + 0.5, 5.0 * 0.9 - 0.5]
    )
    cold = press(np.full(3, 10.0))
    assert responses(config(), cold, [effect])[:, 0] == pytest.approx(
        [5.0] * 3
    )  # not recorded: nominal


def test_crosstalk_keeps_the_sum_over_a_grid_and_is_no_candidate_of_one_cell():
    grid = CellsConfig(
        rows=2,
        columns=2,
        load=Load(unit="N", rated=20.0, shared=False),
        reading=Reading(unit="V"),
    )
    m = press(np.zeros(5), cells=4)
    m = dataclasses.replace(
        m, target=np.tile([8.0, 0.0, 0.0, 0.0], (5, 1)), units=("V",) * 4
    )
    spread = responses(grid, m, [make_cells_effect("taxel_crosstalk", share=0.4)])
    assert spread.sum(axis=1) == pytest.approx([4.0] * 5, rel=1e-5)
    assert spread[0] == pytest.approx([4 - 2 * 0.4, 0.4, 0.4, 0.0], abs=1e-6)
    case = draw_cells("", 1)
    one = CellsProblem(case.config(), simulated(case))
    assert "taxel_crosstalk" not in one.candidates
    assert {"taxel_creep", "taxel_temperature", "touch_lag"} <= one.candidates.keys()


def test_rows_above_200_hz_become_means_of_neighbours():
    m = dataclasses.replace(press(np.arange(1000.0)), time_s=np.arange(1000) / 1000.0)
    fewer = thinned(m)
    assert fewer.rate_hz == pytest.approx(200.0)
    assert fewer.target[0, 0] == pytest.approx(2.0)  # mean of 0 … 4


def test_the_noise_floor_is_that_of_reading_and_load_together():
    rng = np.random.default_rng(3)
    load = np.interp(np.arange(4000) / RATE_HZ, [0, 5, 15, 25, 40], [0, 0, 15, 15, 0])
    reading = 20.0 * load + 10 + rng.normal(0, 2.0, 4000)
    m = press(load + rng.normal(0, 0.05, 4000), reading)
    assert reading_floor(config(), [m])[0] == pytest.approx(
        np.hypot(2.0, 20.0 * 0.05), rel=0.08
    )


def test_recordings_of_a_second_have_a_noise_floor_too():
    rng = np.random.default_rng(4)
    load = np.interp(np.arange(20) / RATE_HZ, [0, 0.05, 0.1, 0.2], [0, 0, 10, 10])
    short = [press(load, 20.0 * load + rng.normal(0, 2.0, 20)) for _ in range(40)]
    assert reading_floor(config(), short)[0] == pytest.approx(2.0, rel=0.25)


def test_nothing_is_found_in_a_clean_sensor_and_its_gain_and_offset_are_those_that_were_set():
    case, d = found("", 7)
    assert d.status == "nothing_missing"
    board = np.random.default_rng([7, 1])
    gain = board.uniform(45, 85) * np.exp(0.15 * board.standard_normal(1))
    offset = board.uniform(5, 60, 1)
    problem = CellsProblem(case.config(), simulated(case))
    numbers = problem.file_numbers(())
    assert numbers["gain_thumb"] == pytest.approx(
        gain[0] / 2.0, rel=2e-3
    )  # count per N
    assert numbers["offset_thumb"] == pytest.approx(offset[0], abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", HIDDEN)
def test_every_hidden_effect_is_found_in_one_sensor(hidden):
    _, d = found(hidden, 12)
    assert d.names[:1] == (hidden,)


def test_a_divider_whose_reading_falls_is_the_saturation_law_with_a_negative_gain():
    """y = 5 V R / (R + R_s) of a cell with R = R_0 / (1 + F / F_0) falls as 1 / (1 + F / F_s): F_s = F_0 (1 + R_0 / R_s)."""
    case = draw_cells("", 15)
    resistance, series, f0_n = 30.0, 10.0, 4.0
    falling = Reading(unit="V", lowest=0.0, highest=5.0, falls=True)

    def divided(m: CellMeasurement, seed: int) -> CellMeasurement:
        cell = resistance / (1 + np.maximum(m.target, 0) / f0_n)
        volts = 5.0 * cell / (cell + series) + np.random.default_rng(seed).normal(
            0, 0.003, m.target.shape
        )
        return dataclasses.replace(
            m, measured=volts, units=("V",), quantum=np.zeros(1), repeat_of=None
        )

    made = simulated(case)
    sides = [
        tuple(divided(m, 10 * k + n) for n, m in enumerate(side))
        for k, side in enumerate((made.fit, made.validation))
    ]
    measurements = dataclasses.replace(made, fit=sides[0], validation=sides[1], test=())
    problem = CellsProblem(
        dataclasses.replace(case.config(), reading=falling), measurements
    )
    d = diagnose(problem, problem.fit, problem.validation, (), start=problem.start)
    assert d.names == ("taxel_saturation",)
    limit_n = 2.0 * d.effects[0].limit  # pyright: ignore[reportAttributeAccessIssue]
    assert limit_n == pytest.approx(f0_n * (1 + resistance / series), rel=0.03)
    assert problem.file_numbers(d.effects)["gain_thumb"] < 0


def test_an_effect_of_the_file_is_fitted_anew_and_stays():
    case = draw_cells("taxel_saturation", 13)
    rough = make_cells_effect("taxel_saturation", limit=1.3 * case.values["limit"])
    problem = CellsProblem(
        dataclasses.replace(case.config(), effects=[rough]), simulated(case)
    )
    assert problem.present == ("taxel_saturation",)
    d = diagnose(
        problem,
        problem.fit,
        problem.validation,
        problem.test,
        start=problem.start,
        present=problem.present,
    )
    assert d.names == ("taxel_saturation",)
    assert d.effects[0].limit == pytest.approx(case.values["limit"], rel=0.05)  # pyright: ignore[reportAttributeAccessIssue]
    assert d.status == "numbers_off"  # the limit of the file was 1.3 times the true one


def test_rows_at_the_ends_of_the_converter_do_not_bend_the_gain():
    case = draw_cells("", 14)
    cut = dataclasses.replace(
        case.config(), reading=Reading(unit="count", lowest=0.0, highest=400.0)
    )
    clean = simulated(case)
    clipped = Measurements(
        tuple(
            dataclasses.replace(m, measured=np.minimum(m.measured, 400.0))
            for m in clean.fit
        )
    )
    assert np.mean(record(case, "loops").measured > 400) > 0.1
    whole = CellsProblem(case.config(), clean).file_numbers(())
    assert CellsProblem(cut, clipped).file_numbers(())["gain_thumb"] == pytest.approx(
        whole["gain_thumb"], rel=2e-3
    )


@pytest.mark.parametrize(
    "hidden", ["taxel_creep", pytest.param("taxel_temperature", marks=pytest.mark.slow)]
)
def test_a_hidden_effect_is_found_with_its_numbers_and_the_mended_machine_is_at_the_floor(
    hidden,
):
    case = draw_cells(hidden, 11)
    measurements, machine = simulated(case), CellsMachine(case.config(), "taxel")
    finding = machine.diagnose("fingertip", measurements)
    d = finding.diagnosis
    assert d.names == (hidden,) and d.errors["after"]["test"] < 1.3
    for name, truth in case.values.items():
        assert getattr(d.effects[0], name) == pytest.approx(truth, rel=0.1, abs=2e-3)
    mended, why = machine.mended([finding])
    assert why == "" and mended.effects == (hidden,)
    assert len(mended.config.gain) == 1
    before, after = (m.compare(measurements).pad_scores() for m in (machine, mended))
    assert {s.unit for s in before} == {"count"}
    for one, other in zip(before, after, strict=True):
        assert one.ratio > 2.5
        assert other.ratio < 1.2


def test_creep_with_a_voltage_divider_is_found_although_logarithmic_creep_explains_as_much_alone():
    rng = np.random.default_rng(3)
    share, time_constant_s, half_n = 0.25, 1.5, 12.0

    def one(peak_n: float, name: str) -> CellMeasurement:
        t = np.arange(3000) / RATE_HZ
        load = np.where(t > 2, np.maximum(peak_n * np.sin(2 * np.pi * t / 7), 0), 0)
        load[(t > 15) & (t < 22)] = 6.0
        crept, creep = np.zeros_like(t), 0.0
        for k, force in enumerate(load):  # explicit Euler at 100 Hz
            creep += (share * force - creep) / RATE_HZ / time_constant_s
            crept[k] = force + creep
        counts = np.round(
            20 + 1000 * crept / (crept + half_n) + rng.normal(0, 1, len(t))
        )
        return press(load + rng.normal(0, 0.02, len(t)), counts, name=name)

    sensor = config(load=Load(unit="N", rated=10.0))  # 1 in the unit reading is 1 N
    recorded = tuple(one(peak, f"press {peak}") for peak in (4.0, 5.0, 6.0, 7.0))
    problem = CellsProblem(sensor, Measurements(fit=recorded, validation=(), test=()))
    sides = split_rows(problem.fit)
    result = diagnose(problem, *sides, start=problem.start)
    assert result.status == "at_floor"
    assert set(result.names) == {"taxel_creep", "taxel_saturation"}
    numbers = {
        f"{e.name}.{p.name}": getattr(e, p.name)
        for e in result.effects
        for p in e.parameters()
    }
    assert numbers["taxel_creep.share"] == pytest.approx(share, rel=0.03)
    assert numbers["taxel_creep.time_constant_s"] == pytest.approx(
        time_constant_s, rel=0.05
    )
    assert numbers["taxel_saturation.limit"] == pytest.approx(half_n, rel=0.03)
    one = diagnose(
        problem, *sides, start=problem.start, config=SearchConfig(max_effects=1)
    )
    assert "taxel_log_creep" in {
        *one.names,
        *one.rounds[0].ties,
        *(o for own in one.rivals.values() for o in own),
    }


CONFIG = CellsConfig(
    rows=2,
    columns=3,
    load=Load(unit="N", rated=10.0),  # 1 in the unit reading is 1 N
    reading=Reading(unit="count", lowest=0.0, highest=4095.0),
)
SHARE = np.array([1.0, 0.25, 0.5, 0.125, 1.0, 0.5])
"""(K,) share of the load that each cell bears, over that of the first."""
GAIN = 200.0  # Count per N that the cell bears


def ramps(seed: int) -> np.ndarray:
    """(T,) load [N]: presses to three peaks at two speeds, 2 s of nothing between them."""
    rng, pieces = np.random.default_rng(seed), [np.zeros(200)]
    for peak_n, speed in ((9.0, 4.0), (3.0, 8.0), (6.0, 2.0)):
        up = np.linspace(0, peak_n, int(peak_n / speed * RATE_HZ))
        pieces += [up, np.full(100, peak_n), up[::-1], np.zeros(200)]
    load = np.concatenate(pieces)
    return load + rng.normal(0, 0.002, len(load))


def recording(name: str, seed: int, response) -> CellMeasurement:
    """``response``: (T,) load → (T, K) counts above 50; noise of 1 count."""
    load = ramps(seed)
    counts = np.round(
        50
        + response(load)
        + np.random.default_rng(seed + 90).normal(0, 1, (len(load), 6))
    )
    return of_cells(name, RATE_HZ, load, counts, CONFIG.names)


def recorded(response) -> Measurements:
    return Measurements(
        (recording("one", 0, response), recording("two", 1, response)),
        (recording("v", 2, response),),
    )


def remarks(response) -> tuple[list[str], float]:
    """Remarks after the search for a threshold alone, and the validation error that it left [floors]."""
    problem = CellsProblem(CONFIG, recorded(response))
    problem.candidates = {"taxel_threshold": problem.candidates["taxel_threshold"]}
    d = diagnose(
        problem, problem.fit, problem.validation, config=SearchConfig(max_effects=1)
    )
    assert d.names == ("taxel_threshold",)
    return numbers_apart(problem, d), d.errors["after"]["validation"]


def test_a_threshold_of_the_share_of_each_cell_is_named_with_the_loads_at_which_cells_begin():
    # Each cell begins at 0.2 N of its own: at 0.2 N of the whole load where it bears all of it, and at 1.6 N where an eighth.
    (remark,), left = remarks(
        lambda load: GAIN * np.maximum(load[:, None] * SHARE - 0.2, 0)
    )
    low, high = re.search(
        r"from ([\d.]+) \(r\dc\d\) to ([\d.]+) \(r1c0\) N", remark
    ).groups()  # pyright: ignore[reportOptionalMemberAccess]
    assert float(low) == pytest.approx(0.2, rel=0.3) and float(high) == pytest.approx(
        1.6, rel=0.3
    )  # steps of √2
    apart = float(re.search(r"each cell ([\d.]+) instead", remark).group(1))  # pyright: ignore[reportOptionalMemberAccess]
    assert left > 4.0 and apart < 0.5 * left
    assert "shared: false" in remark


def test_one_threshold_for_all_cells_has_no_remark_although_another_effect_leaves_an_error():
    def creeping(load: np.ndarray) -> np.ndarray:
        over, creep = np.maximum(load - 0.4, 0), np.zeros_like(load)
        for k in range(1, len(load)):
            creep[k] = creep[k - 1] + (0.1 * over[k] - creep[k - 1]) / RATE_HZ / 0.8
        return GAIN * (over + creep)[:, None] * SHARE

    said, left = remarks(creeping)
    assert left > 3.0 and said == []


@pytest.mark.parametrize("noise_after", [False, True])
def test_readings_that_stop_below_the_converter_s_end_are_named_with_cells_and_loads(
    noise_after: bool,
):
    # 200 count per N times the share reach 1000 count at 5 N in r0c0 and r1c1, and in no other cell below 9 N.
    def clipped(name: str, seed: int) -> CellMeasurement:
        m = recording(name, seed, lambda load: GAIN * load[:, None] * SHARE)
        noise = (
            np.random.default_rng(seed).normal(0, 1, m.measured.shape)
            if noise_after
            else 0.0
        )
        m.measured[:] = np.minimum(m.measured, 1050.0) + np.round(noise)
        return m

    (finding,) = plateaus(CellSet(CONFIG, [clipped("one", 0), clipped("two", 1)]))
    assert "2 of 6 cells (r0c0, r1c1)" in finding.text and "4095" in finding.text
    first, last = map(
        float, re.search(r"from ([\d.]+) to ([\d.]+) N", finding.text).groups()
    )  # pyright: ignore[reportOptionalMemberAccess]
    assert first == pytest.approx(5.0, abs=0.6) and last == pytest.approx(9.0, abs=0.1)
    assert ("`highest: 1050`" in finding.text) is not noise_after


def test_smooth_saturation_and_hysteresis_are_no_plateau():
    def saturated(load: np.ndarray) -> np.ndarray:
        return GAIN * (load / (1 + load / 2.0))[:, None] * SHARE

    for response in (saturated, lambda load: GAIN * play(load, 0.5)[:, None] * SHARE):
        assert not list(plateaus(CellSet(CONFIG, recorded(response).all)))  # pyright: ignore[reportArgumentType]


def test_a_few_rows_of_the_hardest_press_are_no_plateau():
    """Held at 7 N for 40 rows, and at 8 N for 8, fewer than are left out as outliers of 4000."""
    load = np.concatenate([np.linspace(0, 6, 4000), np.full(40, 7.0), np.full(8, 8.0)])
    noise = np.random.default_rng(0).normal(0, 1, (len(load), 6))
    pressed = of_cells(
        "one",
        RATE_HZ,
        load,
        np.round(50 + GAIN * load[:, None] * SHARE + noise),
        CONFIG.names,
    )
    assert not list(plateaus(CellSet(CONFIG, [pressed])))


def test_compare_states_the_error_of_the_diagnosis_where_readings_reach_an_end() -> (
    None
):
    """A tenth of the rows reads 0, as the converter does below it: a replay that is cut
    off there as well would make the error smaller."""
    case = draw_cells("taxel_creep", 50026)
    made, machine = simulated(case), CellsMachine(case.config(), "cells")
    (part,) = machine.parts(made)
    found = machine.diagnose(part, made, search=SearchConfig(max_effects=1))
    written, _ = machine.mended([found])
    after = written.compare(made)
    for use, stated in found.diagnosis.errors["after"].items():
        rows = [t.over_floor for t in after.touches if t.use == use]
        error = np.sqrt(np.mean(np.concatenate(rows) ** 2))
        assert error == pytest.approx(stated, rel=1e-6), use
    ends = [~t.counted for t in after.touches if t.counted is not None]
    assert 0.05 < np.mean(np.concatenate([e.ravel() for e in ends])) < 0.3
    every = [t.residual / t.floor for t in after.touches if t.use == "fit"]
    most = np.sqrt(np.mean(np.concatenate([r.ravel() for r in every]) ** 2))
    assert most < 0.95 * found.diagnosis.errors["after"]["fit"]
