"""A probe that presses several places of an array: simulated here with a contact that spreads as on an elastic half-space."""

import dataclasses

import numpy as np
import pytest
from made_rows import of_cells

from taccorl.alignment.checks.cells import check_cells
from taccorl.alignment.machines.cell_model import calibrated, responses
from taccorl.alignment.machines.cell_places import with_places
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig, Load, Reading
from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.experiment_design import loads
from taccorl.diagnosis.experiment_design.plan import TELLS, plan
from taccorl.diagnosis.machines.cells import CellsMachine
from taccorl.errors import TaccorlError

ROWS, COLUMNS, PITCH_MM, DEPTH_MM = 3, 4, 2.0, 3.0
PLACES_MM = np.array([(0.5, 1.0), (5.0, 3.5), (2.5, 2.0)])
RATE_HZ, PRESS_S = 100, 6.0
CONFIG = CellsConfig(
    rows=ROWS,
    columns=COLUMNS,
    load=Load(unit="N", rated=10.0),  # 1 in the unit reading is 1 N
    reading=Reading(unit="count", lowest=0.0, highest=1023.0),
    same_place_mm=0.5,
)
SHARE, TIME_CONSTANT_S = 0.2, 0.7


def gains() -> np.ndarray:
    """(K,) count per N where the probe is on the cell."""
    return np.random.default_rng(7).lognormal(np.log(60.0), 0.25, ROWS * COLUMNS)


def shares(at_mm: np.ndarray) -> np.ndarray:
    """(…, K) pressure at each cell below a cover, over that below the probe (Boussinesq): (1 + d² / h²)^(−5/2)."""
    y, x = np.meshgrid(
        PITCH_MM * np.arange(ROWS), PITCH_MM * np.arange(COLUMNS), indexing="ij"
    )
    far = np.square(x.ravel() - at_mm[..., :1]) + np.square(y.ravel() - at_mm[..., 1:])
    return (1 + far / DEPTH_MM**2) ** -2.5


def recording(
    name: str,
    seed: int,
    creep: float,
    places_mm: np.ndarray = PLACES_MM,
    slide_mm: float = 0.0,
):
    """Presses of all places in any order, each cell with a creep of its own (trapezoidal rule); noise of 1 count."""
    rng = np.random.default_rng([seed, *map(ord, name)])
    order, time_s = (
        rng.permutation(len(places_mm)),
        np.arange(0, PRESS_S * len(places_mm), 1 / RATE_HZ),
    )
    number = np.minimum((time_s // PRESS_S).astype(int), len(order) - 1)
    highest, ramp_s = (
        rng.uniform(4, 9, len(order))[number],
        rng.uniform(0.1, 0.6, len(order))[number],
    )
    within = time_s % PRESS_S
    load = highest * np.clip(
        np.minimum((within - 1.5) / ramp_s, (4.5 - within) / ramp_s), 0, 1
    )
    at = places_mm[order][number] + np.outer(
        np.where(number == 0, slide_mm * (within - 3.0) / 3.0, 0.0), [1.0, 0.0]
    )
    local = load[:, None] * shares(at)
    crept = np.zeros_like(local)
    rate = 1 / (2 * RATE_HZ * TIME_CONSTANT_S)
    for k in range(1, len(local)):
        crept[k] = ((1 - rate) * crept[k - 1] + rate * (local[k - 1] + local[k])) / (
            1 + rate
        )
    counts = np.round(
        30 + gains() * (local + creep * crept) + rng.normal(0, 1, local.shape)
    )
    load = load + rng.normal(0, 0.002, len(load))
    return of_cells(
        name,
        RATE_HZ,
        load,
        counts,
        CONFIG.names,
        position_mm=at + rng.normal(0, 0.01, at.shape),
    )


def recorded(creep: float, seed: int = 0) -> Measurements:
    one, two, three, four = (
        recording(name, seed, creep) for name in ("one", "two", "three", "four")
    )
    return Measurements((one, two), (three,), (four,))


def test_every_cell_has_the_gain_of_each_place():
    measurements = with_places(CONFIG, recorded(0.0))
    found = calibrated(
        CONFIG, [(responses(CONFIG, m), m.measured) for m in measurements.fit]
    )  # pyright: ignore[reportArgumentType]
    first = measurements.fit[0]
    assert isinstance(first, CellMeasurement) and first.num_places == 3
    # Places are numbered in the order of the presses of the first recording.
    at = np.array(
        [np.median(first.position_mm[first.place == p], axis=0) for p in range(3)]
    )
    expected = gains()[:, None] * shares(at).T
    np.testing.assert_allclose(found.gain, expected, rtol=0.01, atol=0.3)
    np.testing.assert_allclose(found.offset, 30, atol=0.3)


def test_creep_is_found_in_presses_of_several_places_at_the_noise_floor():
    machine, measurements = CellsMachine(CONFIG, "array"), recorded(SHARE)
    finding = machine.diagnose("array", measurements)
    d = finding.diagnosis
    assert (
        d.names == ("taxel_creep",)
        and d.status == "at_floor"
        and not d.rivals.get("taxel_creep")
    )
    effect = d.effects[0]
    for name, truth in (("share", SHARE), ("time_constant_s", TIME_CONSTANT_S)):
        low, high = effect.interval[name]
        assert low <= truth <= high and high - low < 0.02 * truth
    assert d.remarks == ()
    mended, why = machine.mended([finding])
    assert why == "" and mended.config.gain == []  # fitted anew for each place
    before, after = (m.compare(measurements).pad_scores() for m in (machine, mended))
    assert all(
        a.ratio < 1.2 < 3.0 < b.ratio for a, b in zip(after, before, strict=True)
    )


def test_the_next_press_is_planned_at_a_known_place(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        loads,
        "LIBRARY",
        [p for p in loads.LIBRARY if p.name in ("slow_ramp", "long_hold")],
    )
    known = recorded(SHARE)
    part = loads.CellsPart(CONFIG, known, loads.load_range(CONFIG, known))
    best = plan(part, ("taxel_creep", "touch_lag")).planned[0]
    assert (
        best.name == "long_hold"
        and best.ways["taxel_creep | touch_lag"][0] > 2.0 * TELLS
    )
    assert (
        part.place_mm is not None
        and np.linalg.norm(PLACES_MM - part.place_mm, axis=1).min() < 0.01
    )
    assert [
        float(best.columns[key].mean()) for key in ("x_mm", "y_mm")
    ] == pytest.approx(part.place_mm)


def test_nothing_is_found_in_a_clean_array_and_one_place_for_all_is_named_as_the_fault():
    measurements = recorded(0.0)
    d = CellsMachine(CONFIG, "array").diagnose("array", measurements).diagnosis
    assert d.names == () and d.errors["after"]["test"] < 1.2
    one_place = dataclasses.replace(CONFIG, same_place_mm=None)
    found = check_cells(
        one_place, list(measurements.fit), [m.name for m in measurements.fit]
    )  # pyright: ignore[reportArgumentType]
    warnings = [f for own in found.values() for f in own if f.check == "uneven_load"]
    assert len(warnings) == 1 and "same_place_mm" in warnings[0].text


def test_a_law_of_each_cells_own_load_is_named_with_the_remark_that_its_number_is_a_mean():
    def saturated(name: str) -> CellMeasurement:
        m = recording(name, 0, 0.0)
        own = (m.measured - 30) / gains()
        return dataclasses.replace(
            m, measured=np.round(30 + gains() * own / (1 + own / 20.0))
        )

    one, two, three = map(saturated, ("one", "two", "three"))
    d = (
        CellsMachine(CONFIG, "array")
        .diagnose("array", Measurements((one, two), (three,)))
        .diagnosis
    )
    assert d.names[0] == "taxel_saturation"
    assert (
        len(
            [
                r
                for r in d.remarks
                if r.startswith("taxel_saturation: with several places")
            ]
        )
        == 1
    )


@pytest.mark.slow
@pytest.mark.parametrize("creep", [0.0, SHARE])
def test_in_twenty_arrays_creep_is_found_where_it_is_and_nowhere_else(creep: float):
    found = [
        CellsMachine(CONFIG, "array").diagnose("array", recorded(creep, k)).diagnosis
        for k in range(20)
    ]
    assert all(
        d.names == (("taxel_creep",) if creep else ())
        and d.errors["after"]["test"] < 1.2
        for d in found
    )
    inside = [
        d.effects[0].interval["share"][0] <= SHARE <= d.effects[0].interval["share"][1]
        for d in found
        if d.effects
    ]
    assert sum(inside) >= 0.85 * len(inside)


def test_presses_that_slide_or_are_elsewhere_are_named_and_not_used():
    elsewhere = PLACES_MM.copy()
    elsewhere[2] = (6.0, 0.0)
    known, other = recorded(0.0), recording("other", 0, 0.0, elsewhere)
    slides = recording("slides", 0, 0.0, slide_mm=2.0)
    measurements = with_places(CONFIG, Measurements(known.fit, (other, slides)))
    for m, share, words in zip(
        measurements.validation,
        (1 / 3, 1 / 3),
        ("0 of them move", "1 of them move"),
        strict=True,
    ):
        assert np.mean(m.place < 0) == pytest.approx(share, abs=0.01)
        (finding,) = [
            f for f in check_cells(CONFIG, [m], ())[m.name] if f.check == "other_places"
        ]
        assert "1 presses are not used" in finding.text and words in finding.text
    with pytest.raises(TaccorlError, match=r"^far: .*same_place_mm 0\.5 mm"):
        with_places(
            CONFIG,
            Measurements(known.fit, (recording("far", 0, 0.0, PLACES_MM + 20.0),)),
        )
    with pytest.raises(TaccorlError, match=r"one: has no position"):
        still = dataclasses.replace(recording("one", 0, 0.0), position_mm=np.empty(0))
        with_places(CONFIG, Measurements((still,)))
