"""Gains of cells and recordings compared with each other, on own simulations of an array of 4 × 5 cells."""

import dataclasses

import numpy as np
import pytest

from taccorl.alignment.checks.cell_gains import exchanged_cells
from taccorl.alignment.checks.cell_set import CellSet
from taccorl.alignment.checks.cells import check_cells, shifted_loads
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig, Load, Reading
from taccorl.alignment.measurements.folder import Measurements
from taccorl.data.finding import Finding
from taccorl.diagnosis.machines.cells import CellsMachine
from taccorl.diagnosis.problems.cells_problem import CellsProblem
from taccorl.surrogate.cells import HIDDEN, OF_GRIDS, draw_cells, simulated

K = 20
GAINS = 30.0 * np.exp(0.2 * np.random.default_rng(5).standard_normal(K))  # count per N
PEAKS_N = {
    "a": (4.0, 10.0, 19.0),
    "b": (12.0, 6.0, 18.0),
    "val": (8.0, 15.0, 3.0),
    "test": (5.0, 9.0, 14.0),
}


def config(shared: bool = True) -> CellsConfig:
    return CellsConfig(
        name="array",
        rows=4,
        columns=5,
        load=Load(unit="N", rated=20.0, shared=shared),
        reading=Reading(unit="count"),
    )


def of_cells(
    name: str, time_s: np.ndarray, load: np.ndarray, reading: np.ndarray
) -> CellMeasurement:
    columns = {
        "time_s": time_s,
        "target": load,
        "measured": reading,
        "quantum": np.ones(K),
    }
    return CellMeasurement(
        name=name, signals=config().names, units=("count",) * K, **columns
    )


def presses(
    name: str,
    law=lambda f: f,
    gains: np.ndarray = GAINS,
    share=None,
    load_factor: float = 1.0,
) -> CellMeasurement:
    """Three presses of 6 s at 50 Hz. The cells read ``gains`` · ``law``(their share of the load) + 20, with 1 count of noise.
    ``share``: share of the load of each cell in each press, (3, K); 1 by default. ``load_factor``: of the recorded load."""
    rng, t = np.random.default_rng(len(name)), np.arange(0.0, 18.0, 0.02)
    each = [
        np.interp(t - 6 * n, [0, 2, 3, 5, 6], [0, 0, 1, 1, 0]) * peak
        for n, peak in enumerate(PEAKS_N[name])
    ]
    force = np.sum(each, axis=0)
    own = (
        force[:, None]
        * (np.ones((3, K)) if share is None else share)[(t // 6).astype(int)]
    )
    reading = np.round(gains * law(own) + 20 + rng.standard_normal((len(t), K)))
    load = (
        np.tile((force + 0.01 * rng.standard_normal(len(t)))[:, None], K) * load_factor
    )
    return of_cells(name, t, load, reading)


def array(**changes) -> list[CellMeasurement]:
    return [presses(name, **changes) for name in PEAKS_N]


def found(
    measurements: list[CellMeasurement], shared: bool = True
) -> dict[str, list[Finding]]:
    """Recording → findings; recordings without one are left out."""
    return {
        name: own
        for name, own in check_cells(config(shared), measurements, ["a", "b"]).items()
        if own
    }


def split(m: list[CellMeasurement]) -> Measurements:
    return Measurements(fit=tuple(m[:2]), validation=(m[2],), test=(m[3],))


@pytest.mark.parametrize(
    "law",
    [
        lambda f: f,
        lambda f: f / (1 + f / 5),  # saturates at a quarter of the rated load
        lambda f: 0.2 * f**1.6,
        lambda f: 4 * f**0.5,
        lambda f: np.maximum(f - 2.5, 0),
    ],
    ids=["linear", "saturation", "steep", "flat", "threshold"],
)
def test_a_good_array_with_a_bent_law_and_unequal_gains_has_no_finding(law):
    assert found(array(law=law)) == {} and found(array(law=law), shared=False) == {}


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [*HIDDEN, ""])
def test_no_hidden_effect_of_a_simulated_array_is_taken_for_a_fault_of_the_recordings(
    hidden,
):
    for shared in (True, False):
        if not (shared and hidden in OF_GRIDS):
            sensor = dataclasses.replace(
                config(shared),
                reading=Reading(unit="count", lowest=0.0, highest=1023.0),
            )
            measurements = simulated(draw_cells(hidden, 71, sensor))
            findings = CellsMachine(sensor).check(measurements)
            assert [
                f for own in findings.values() for f in own if f.check != "resampled"
            ] == []


def test_a_light_press_of_a_bent_cell_is_no_other_unit(monkeypatch):
    """With y = f^1.6 a press to 0.6 N has (0.6 / 19)^0.6 = 1/8 of the gain of one to 19 N, and yet the same law."""
    monkeypatch.setitem(PEAKS_N, "val", (0.3, 0.6, 0.5))
    assert found(array(law=lambda f: 5 * f**1.6)) == {}
    assert found(array(law=lambda f: 5 * f / (1 + f / 2))) == {}


@pytest.mark.parametrize("shared", [True, False])
def test_dead_and_reversed_cells_are_named_left_out_and_written_without_gain(shared):
    gains = GAINS.copy()
    gains[[3, 7, 11]] = 0.0086, 0.0, -3.0
    names, recordings = [config().names[k] for k in (3, 7, 11)], array(gains=gains)
    own = [
        f
        for findings in found(recordings, shared).values()
        for f in findings
        if f.check == "dead_cells"
    ]
    assert [f.severity for f in own] == ["warning"]
    assert all(name in own[0].text for name in names) and "3 of 20" in own[0].text
    assert ("not touched" in own[0].text) == shared and "r0c0" not in own[0].text

    problem = CellsProblem(config(shared), split(recordings))
    assert set(range(K)) - set(problem.channels.tolist()) == {3, 7, 11}
    numbers = problem.file_numbers(())
    assert [numbers[f"gain_{name}"] for name in names] == [0.0, 0.0, 0.0]
    assert [numbers[f"offset_{name}"] for name in names] == pytest.approx(
        [20.0, 20.0, 20.0], abs=30
    )
    assert numbers["gain_r0c0"] == pytest.approx(GAINS[0], rel=0.01)
    remarks = (
        CellsMachine(config(shared))
        .diagnose("array", split(recordings))
        .diagnosis.remarks
    )
    assert any(all(name in text for name in names) for text in remarks)


def test_a_cell_that_always_reads_zero_adds_no_error_to_a_comparison():
    """Its readings are at the converter's end, so that nothing determines its gain; it must not get the median gain."""
    sensor = dataclasses.replace(
        config(), reading=Reading(unit="count", lowest=0.0, highest=1023.0)
    )

    def score(gains: np.ndarray, offset: float) -> float:
        recordings = array(gains=gains)
        for m in recordings:
            m.measured[:, gains == 0] = offset
        findings = check_cells(sensor, recordings, ["a", "b"])
        assert any(
            f.check == "dead_cells" and "r0c3" in f.text for f in findings["a"]
        ) == (0 in gains)
        assert not any(f.severity == "error" for f in findings["a"])
        return CellsMachine(sensor).compare(split(recordings)).pad_scores()[1].rmse

    stuck = GAINS.copy()
    stuck[3] = 0.0
    assert score(stuck, 0.0) == pytest.approx(score(GAINS, 20.0), rel=0.05)


def test_a_cell_that_is_hardly_loaded_is_not_called_dead():
    one = array()
    for k, m in enumerate(
        one
    ):  # cell 4 has a load of its own, 3 % of the others', below its threshold
        target, measured = m.target.copy(), m.measured.copy()
        target[:, 4] *= 0.03
        measured[:, 4] = 20 + np.random.default_rng(k).standard_normal(len(target))
        one[k] = dataclasses.replace(m, target=target, measured=measured)
    assert found(one, shared=False) == {}


@pytest.mark.parametrize("factor", [1e-3, 1 / 9.80665, 9.80665])
@pytest.mark.parametrize("name", list(PEAKS_N))
@pytest.mark.parametrize(
    "law", [lambda f: f, lambda f: f / (1 + f / 5)], ids=["linear", "saturation"]
)
def test_a_recording_with_its_load_in_another_unit_is_named_with_the_factor(
    factor, name, law
):
    recordings = [
        presses(n, law=law, load_factor=factor if n == name else 1.0) for n in PEAKS_N
    ]
    own = {
        n: f
        for n, findings in found(recordings).items()
        for f in findings
        if f.check == "other_gain"
    }
    assert own.keys() == {name} and own[name].severity == "error"
    told = float(own[name].text.split(" is ")[1].split(" times")[0])
    assert told == pytest.approx(
        1 / factor, rel=0.6
    )  # the gain of a bent law also depends on the load
    assert "columns file" in own[name].text


def test_of_two_recordings_both_are_named():
    found = check_cells(
        config(), [presses("a"), presses("val", load_factor=1e-3)], ["a"]
    )
    texts = [f.text for f in found["val"] if f.check == "other_gain"]
    assert len(texts) == 1 and "one of val and a" in texts[0]
    assert not any(f.check == "other_gain" for f in found["a"])


def place(*cells: int) -> np.ndarray:
    """(3, K) shares of a probe that presses one cell in each press: all its load, and a fifth of it on the next cell."""
    found = np.zeros((3, K))
    for n, k in enumerate(cells):
        found[n, k], found[n, k + 1] = 1.0, 0.2
    return found


def test_a_probe_that_moves_within_or_between_recordings_is_seen_and_one_that_stays_is_not():
    def own(shares: dict[str, np.ndarray], shared: bool = True) -> list[Finding]:
        recordings = [presses(name, share=share) for name, share in shares.items()]
        return [
            f
            for fs in found(recordings, shared).values()
            for f in fs
            if f.check == "uneven_load"
        ]

    moving = own({name: place(2, 8, 14) for name in PEAKS_N})
    assert (
        len(moving) == 1
        and moving[0].severity == "warning"
        and "same_place_mm" in moving[0].text
    )
    assert "within a, b" in moving[0].text
    between = own(
        {name: place(k, k, k) for name, k in zip(PEAKS_N, (2, 8, 14, 5), strict=True)}
    )
    assert "between a, b" in between[0].text
    assert own({name: place(6, 6, 6) for name in PEAKS_N}) == []
    assert own({name: place(2, 8, 14) for name in PEAKS_N}, shared=False) == []
    recordings = [presses(name, share=place(2, 8, 14)) for name in PEAKS_N]
    assert not any(
        f.check == "other_gain" for fs in found(recordings).values() for f in fs
    )
    d = CellsMachine(config()).diagnose("array", split(recordings)).diagnosis
    assert any("not shared alike" in text for text in d.remarks)


def loaded_apart(
    seed: int,
    crosstalk: float = 0.0,
    order: list[int] | None = None,
    off: tuple[float, float] = (0.0, 0.0),
) -> list[CellMeasurement]:
    """Four recordings of 4 × 5 cells with a load each: probes press eight places one after the other, 1.5 cells wide.
    ``crosstalk``: share of a cell's load that its four neighbours read in its place. ``order``: reading column k holds the
    reading of cell ``order[k]``; none: its own. ``off``: rows and columns by which the probe is farther on than the places
    from which the loads were computed."""
    rng, found = np.random.default_rng(seed), []
    i, j = np.divmod(np.arange(K), 5)
    for name in PEAKS_N:
        t, places = np.arange(0.0, 24.0, 0.02), rng.uniform((0, 0), (3, 4), (8, 2))
        press = (
            np.interp(t % 3, [0, 1, 1.5, 2, 3], [0, 0, 1, 1, 0])
            * rng.uniform(5, 19, 8)[(t // 3).astype(int)]
        )
        stated, force = (
            press[:, None]
            * np.exp(-((i - at[:, :1]) ** 2 + (j - at[:, 1:]) ** 2) / 2 / 1.5**2)[
                (t // 3).astype(int)
            ]
            for at in (places, places + off)
        )
        whole = np.pad(force.reshape(-1, 4, 5), ((0, 0), (1, 1), (1, 1)), mode="edge")
        around = (
            whole[:, 2:, 1:-1]
            + whole[:, :-2, 1:-1]
            + whole[:, 1:-1, 2:]
            + whole[:, 1:-1, :-2]
        ) / 4
        law = (1 - crosstalk) * force + crosstalk * around.reshape(-1, K)
        reading = np.round(GAINS * law + 20 + rng.standard_normal(law.shape))
        found.append(
            of_cells(
                name,
                t,
                stated + 0.01 * rng.standard_normal(law.shape),
                reading[:, order or range(K)],
            )
        )
    return found


@pytest.mark.parametrize(
    "others",
    [{2: 13, 13: 2}, {6: 7, 7: 6}, {0: 9, 9: 18, 18: 0}],
    ids=["pair", "neighbours", "three"],
)
def test_cells_with_exchanged_columns_are_named_with_their_lines(others):
    order = [others.get(k, k) for k in range(K)]
    for crosstalk in (0.0, 0.15):
        recordings = loaded_apart(3, crosstalk, order)
        assert {
            e.cell: e.load_of
            for e in exchanged_cells(CellSet(config(shared=False), recordings))
        } == others
        own = [
            f for findings in found(recordings, shared=False).values() for f in findings
        ]
        assert [(f.check, f.severity) for f in own] == [("exchanged_cells", "error")]
        assert all(f"`{config().names[k]}:`" in own[0].text for k in others)
        assert exchanged_cells(CellSet(config(shared=True), recordings)) == []


@pytest.mark.parametrize("crosstalk", [0.0, 0.15])
def test_no_cells_of_20_arrays_in_order_are_called_exchanged_or_shifted(crosstalk):
    for recordings in (loaded_apart(seed, crosstalk) for seed in range(100, 120)):
        assert exchanged_cells(CellSet(config(shared=False), recordings)) == []
        assert list(shifted_loads(CellSet(config(shared=False), recordings))) == []


@pytest.mark.parametrize("crosstalk", [0.0, 0.15])
@pytest.mark.parametrize("off", [(0.0, 0.3), (-0.25, 0.1)])
def test_loads_of_another_place_are_named_with_the_shift(
    crosstalk: float, off: tuple[float, float]
):
    recordings = loaded_apart(3, crosstalk, off=off)
    (only,) = (f for own in found(recordings, shared=False).values() for f in own)
    assert (only.check, only.severity) == ("shifted_loads", "warning")
    rows, columns = (
        float(only.text.split(word)[0].split()[-1]) for word in (" rows", " columns")
    )
    assert (rows, columns) == (
        pytest.approx(off[0], abs=0.05),
        pytest.approx(off[1], abs=0.05),
    )
    assert (
        list(shifted_loads(CellSet(config(), recordings))) == []
    )  # of one load for all cells nothing is known
