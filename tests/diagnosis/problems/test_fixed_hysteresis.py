"""Hysteresis of fixed width on simulations with equations of their own: width, false alarms, and how to tell it from a lag."""

from collections.abc import Sequence

import numpy as np
import pytest
from made_rows import of_cells, play

from taccorl.alignment.machines.cell_model import responses
from taccorl.alignment.machines.cells_file import (
    CellsConfig,
    Load,
    Reading,
    make_cells_effect,
)
from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.experiment_design import loads
from taccorl.diagnosis.experiment_design.loads import CellsPart, load_range
from taccorl.diagnosis.experiment_design.plan import TELLS, plan
from taccorl.diagnosis.problems.cells_problem import CellsProblem
from taccorl.diagnosis.search.result import Diagnosis
from taccorl.diagnosis.search.search import diagnose

RATE_HZ, FINE = 100, 10  # Rows per second, and simulated steps of a row
COUNT_PER_N, OFFSET = 40.0, 100.0
CONFIG = CellsConfig(
    cells=["thumb"],
    load=Load(unit="N", rated=20.0),  # 1 in the unit reading is 2 N
    reading=Reading(unit="count", lowest=0.0, highest=1023.0),
)


def layers(load_n: np.ndarray, share: float, *half_widths_n: float) -> np.ndarray:
    """Elastic, and for ``share`` of it as layers that slip at several forces."""
    return (1.0 - share) * load_n + share * np.mean(
        [play(load_n, w) for w in half_widths_n], axis=0
    )


def creep(load_n: np.ndarray, share: float, time_constant_s: float) -> np.ndarray:
    """A spring and a damper beside a spring, by explicit steps of 1 ms."""
    crept = np.zeros(len(load_n))
    for k in range(1, len(load_n)):
        crept[k] = crept[k - 1] + (load_n[k - 1] - crept[k - 1]) / (
            RATE_HZ * FINE * time_constant_s
        )
    return load_n + share * crept


def lag(load_n: np.ndarray, time_constant_s: float) -> np.ndarray:
    return creep(load_n, 1.0, time_constant_s) - load_n


def ramps(
    rng: np.random.Generator, speeds: Sequence[float], hold_s: float, loops: bool
) -> np.ndarray:
    """Load [N] at 1 kHz: presses to 6, 12 and 18 N at each of ``speeds`` [N/s], with small to-and-fro."""
    corners = [(0.0, 0.0), (2.0, 0.0)]
    for speed in speeds:
        for peak in rng.permutation([6.0, 12.0, 18.0]) * rng.uniform(0.85, 1.0):
            way = (
                [peak, peak]
                + ([0.6 * peak, 0.9 * peak, 0.4 * peak] if loops else [])
                + [0.0, 0.0]
            )
            for goal in way:
                then_s, now = corners[-1]
                corners.append((then_s + (abs(goal - now) / speed or hold_s), goal))
    corners.append((corners[-1][0] + 2.0, 0.0))
    times_s, loads = np.array(corners).T
    return np.interp(np.arange(0, times_s[-1], 1 / (RATE_HZ * FINE)), times_s, loads)


def recorded(
    kind: str,
    values: Sequence[float],
    seed: int,
    speeds: Sequence[float] = (4.0, 40.0),
    loops: bool = True,
    load_noise_n: float = 0.01,
) -> Measurements:
    """Two fit recordings, one for validation, one for the test, with noise of the load cell and of the readings (1 count)."""
    rng, found = np.random.default_rng(seed), []
    for name in ("one", "two", "three", "four"):
        load = ramps(rng, speeds, 2.0, loops)
        response = {
            "": lambda f: f,
            "play": play,
            "layers": layers,
            "creep": creep,
            "lag": lag,
        }[kind](load, *values)
        rows = slice(None, None, FINE)
        counts = np.round(
            OFFSET + COUNT_PER_N * response[rows] + rng.normal(0, 1, len(load[rows]))
        )
        measured = load[rows] + rng.normal(0, load_noise_n, len(load[rows]))
        found.append(of_cells(name, RATE_HZ, measured, counts[:, None]))
    return Measurements(tuple(found[:2]), tuple(found[2:3]), tuple(found[3:]))


def diagnosed(measurements: Measurements) -> Diagnosis:
    problem = CellsProblem(CONFIG, measurements)
    return diagnose(
        problem, problem.fit, problem.validation, problem.test, start=problem.start
    )


def drawn(kind: str, seed: int) -> tuple[float, ...]:
    """Moderate to strong effects; widths in N, times in s."""
    rng = np.random.default_rng(900 + seed)

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    match kind:
        case "play":
            return (between(0.1, 1.2),)
        case "creep":
            return (between(0.05, 0.4), between(0.3, 4.0))
        case "lag":
            return (between(0.02, 0.15),)
    return ()


def test_the_operator_is_that_of_the_equations_here():
    load = ramps(np.random.default_rng(0), (4.0,), 1.0, True)
    effect = make_cells_effect("taxel_play", half_width=0.25)  # 0.5 N
    m = of_cells("press", 1000.0, load, np.zeros((len(load), 1)))
    np.testing.assert_allclose(
        2.0 * responses(CONFIG, m, [effect])[:, 0], play(load, 0.5), atol=1e-4
    )
    # 6 N at most on the way in, 0.5 N less; after release 0.5 N remain
    assert play(np.array([0.0, 3.0, 6.0, 5.5, 5.0, 0.0]), 0.5).tolist() == [
        0.0,
        2.5,
        5.5,
        5.5,
        5.5,
        0.5,
    ]


def width_seen(seed: int, load_noise_n: float) -> tuple[float, float, float, float]:
    """True half-width, fitted one, and the ends of its 95 % interval, in N."""
    (truth,) = drawn("play", seed)
    found = diagnosed(recorded("play", (truth,), seed, load_noise_n=load_noise_n))
    assert found.names == ("taxel_play",) and found.status == "at_floor", seed
    effect = found.effects[0]
    low, high = effect.interval["half_width"]
    return truth, 2.0 * effect.half_width, 2.0 * low, 2.0 * high  # pyright: ignore[reportAttributeAccessIssue]


def test_the_width_is_found_within_its_interval():
    truth, value, low, high = width_seen(1, load_noise_n=0.001)
    assert low <= truth <= high and high - low < 0.01 * truth
    assert value == pytest.approx(truth, rel=0.003)


def test_what_slipping_layers_keep_of_a_load_is_no_drift_in_time():
    """At rest 0.15 (0.5 + 2 + 3.5 + 5 + 6.5 + 8) / 6 N = 0.64 N may be left, which the next press changes."""
    found = diagnosed(recorded("layers", (0.15, *np.linspace(0.5, 8.0, 6)), 1))
    assert found.names == ("taxel_play",) and found.status == "at_floor"


@pytest.mark.slow
def test_noise_of_the_load_widens_the_band_by_less_than_itself():
    truth, value, _, _ = width_seen(0, load_noise_n=0.01)
    assert 0.0 < value - truth < 0.01


@pytest.mark.slow
def test_in_twenty_sensors_the_interval_holds_the_width_as_often_as_it_says():
    widths = [width_seen(seed, load_noise_n=0.001) for seed in range(20)]
    assert (
        sum(low <= truth <= high for truth, _, low, high in widths) >= 17
    )  # of 95 %, 17 or more come with 98 %


FOUND = {"": (), "creep": ("taxel_creep",), "lag": ("touch_lag",)}
SEEDS = [(kind, seed) for seed in range(20) for kind in FOUND]


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        pytest.param(
            *one, marks=[pytest.mark.slow] * (one not in (("", 0), ("lag", 0)))
        )
        for one in SEEDS
    ],
)
def test_no_width_is_found_where_there_is_none(kind: str, seed: int):
    assert diagnosed(recorded(kind, drawn(kind, seed), seed)).names == FOUND[kind]


def test_a_fast_press_tells_it_from_a_lag_and_a_slow_ramp_hardly_does(
    monkeypatch: pytest.MonkeyPatch,
):
    """On ramps of 4 N/s a lag of 75 ms and a half-width of 0.3 N are late by the same load."""
    known = recorded("lag", (0.075,), 3, speeds=(4.0,), loops=False)
    monkeypatch.setattr(
        loads,
        "LIBRARY",
        [p for p in loads.LIBRARY if p.name in ("slow_ramp", "two_speeds")],
    )
    part = CellsPart(CONFIG, known, load_range(CONFIG, known, speed=40.0))
    found = plan(part, ("taxel_play", "touch_lag"))
    assert [p.name for p in found.planned] == ["two_speeds", "slow_ramp"]
    fast, slow = (p.worst for p in found.planned)
    assert fast > 4.0 * slow and fast > 2.0 * TELLS
