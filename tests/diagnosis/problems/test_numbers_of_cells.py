"""Cells that bear unequal shares of one load: the total load at which each begins to read, or ends, is its own."""

import re

import numpy as np
import pytest
from made_rows import of_cells, play

from taccorl.alignment.checks.cell_readings import plateaus
from taccorl.alignment.checks.cell_set import CellSet
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig, Load, Reading
from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.problems.cells_problem import CellsProblem
from taccorl.diagnosis.problems.numbers_of_cells import numbers_apart
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.diagnosis.search.search import diagnose

RATE_HZ = 100.0
CONFIG = CellsConfig(
    rows=2,
    columns=3,
    load=Load(unit="N", rated=10.0),  # 1 in the unit reading is 1 N
    reading=Reading(unit="count", lowest=0.0, highest=4095.0),
)
SHARE = np.array([1.0, 0.25, 0.5, 0.125, 1.0, 0.5])
"""(K,) share of the load that each cell bears, over that of the first."""
GAIN = 200.0
"""Count per N that the cell bears."""


def ramps(seed: int) -> np.ndarray:
    """(T,) load [N]: presses to three peaks at two speeds, 2 s of nothing between them."""
    rng = np.random.default_rng(seed)
    pieces = [np.zeros(200)]
    for peak_n, speed in ((9.0, 4.0), (3.0, 8.0), (6.0, 2.0)):
        up = np.linspace(0, peak_n, int(peak_n / speed * RATE_HZ))
        pieces += [up, np.full(100, peak_n), up[::-1], np.zeros(200)]
    load = np.concatenate(pieces)
    return load + rng.normal(0, 0.002, len(load))


def recording(name: str, seed: int, response) -> CellMeasurement:
    """``response``: (T,) load → (T, K) counts above 50; noise of 1 count."""
    load = ramps(seed)
    counts = np.round(50 + response(load) + np.random.default_rng(seed + 90).normal(0, 1, (len(load), 6)))
    return of_cells(name, RATE_HZ, load, counts, CONFIG.names)


def recorded(response) -> Measurements:
    return Measurements((recording("one", 0, response), recording("two", 1, response)), (recording("v", 2, response),))


def remarks(response) -> tuple[list[str], float]:
    """Remarks after the search for a threshold alone, and the validation error that it left [floors]."""
    problem = CellsProblem(CONFIG, recorded(response))
    problem.candidates = {"taxel_threshold": problem.candidates["taxel_threshold"]}
    d = diagnose(problem, problem.fit, problem.validation, config=SearchConfig(max_effects=1))
    assert d.names == ("taxel_threshold",)
    return numbers_apart(problem, d), d.errors["after"]["validation"]


def test_a_threshold_of_the_share_of_each_cell_is_named_with_the_loads_at_which_cells_begin():
    # Each cell begins at 0.2 N of its own: at 0.2 N of the whole load where it bears all of it, and at 1.6 N where an eighth.
    (remark,), left = remarks(lambda load: GAIN * np.maximum(load[:, None] * SHARE - 0.2, 0))
    low, high = re.search(r"from ([\d.]+) \(r\dc\d\) to ([\d.]+) \(r1c0\) N", remark).groups()  # pyright: ignore[reportOptionalMemberAccess]
    assert float(low) == pytest.approx(0.2, rel=0.3) and float(high) == pytest.approx(1.6, rel=0.3)  # steps of √2
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
def test_readings_that_stop_below_the_converter_s_end_are_named_with_cells_and_loads(noise_after: bool):
    # 200 count per N times the share reach 1000 count at 5 N in r0c0 and r1c1, and in no other cell below 9 N.
    def clipped(name: str, seed: int) -> CellMeasurement:
        m = recording(name, seed, lambda load: GAIN * load[:, None] * SHARE)
        noise = np.random.default_rng(seed).normal(0, 1, m.measured.shape) if noise_after else 0.0
        m.measured[:] = np.minimum(m.measured, 1050.0) + np.round(noise)
        return m

    (finding,) = plateaus(CellSet(CONFIG, [clipped("one", 0), clipped("two", 1)]))
    assert "2 of 6 cells (r0c0, r1c1)" in finding.text and "4095" in finding.text
    first, last = map(float, re.search(r"from ([\d.]+) to ([\d.]+) N", finding.text).groups())  # pyright: ignore[reportOptionalMemberAccess]
    assert first == pytest.approx(5.0, abs=0.6) and last == pytest.approx(9.0, abs=0.1)
    assert ("`highest: 1050`" in finding.text) is not noise_after


def test_smooth_saturation_and_hysteresis_are_no_plateau():
    def saturated(load: np.ndarray) -> np.ndarray:
        return GAIN * (load / (1 + load / 2.0))[:, None] * SHARE

    for response in (saturated, lambda load: GAIN * play(load, 0.5)[:, None] * SHARE):
        assert not list(plateaus(CellSet(CONFIG, recorded(response).all)))  # pyright: ignore[reportArgumentType]
