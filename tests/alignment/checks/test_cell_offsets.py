"""Readings of cells without load, on own simulations of an array of 4 × 5 cells (``test_cell_gains``)."""

import dataclasses

import numpy as np
import pytest
from test_cell_gains import K, array, config, split

from taccorl.alignment.checks.cells import check_cells
from taccorl.alignment.machines.cell_model import responses
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.data.finding import Finding
from taccorl.diagnosis.machines.cells import CellsMachine
from taccorl.sim.effects.touch_memory import TaxelCreep


def force() -> np.ndarray:
    """(T, 1) load of recording a [N]."""
    return array()[0].target[:, :1]


def unclipped(below_rest: bool = True) -> CellsConfig:
    """The array, whose readings at rest are 20 counts."""
    one = config()
    return dataclasses.replace(
        one, reading=dataclasses.replace(one.reading, below_rest=below_rest)
    )


def offsets(
    recordings: list[CellMeasurement], below_rest: bool = False
) -> list[Finding]:
    return [
        f
        for own in check_cells(unclipped(below_rest), recordings, ["a", "b"]).values()
        for f in own
    ]


def creeping(share: float):
    """Law with creep of 2 s, exact for a load that is held for a row."""

    def law(f: np.ndarray) -> np.ndarray:
        crept = np.zeros_like(f)
        for k in range(1, len(f)):
            crept[k] = crept[k - 1] + (f[k] - crept[k - 1]) * -np.expm1(-0.02 / 2.0)
        return f + share * crept

    return law


def test_an_offset_that_differs_between_recordings_is_named_with_its_size_and_a_temperature_explains_it():
    def changed(counts: np.ndarray | float) -> list[CellMeasurement]:
        return [
            dataclasses.replace(
                m, measured=m.measured + counts * (m.name in ("val", "test"))
            )
            for m in array()
        ]

    (every,) = offsets(changed(24.0))
    assert (every.check, every.severity) == ("other_offset", "warning")
    assert "20 of 20 cells" in every.text and "temperature:" in every.text
    size, floors = (
        float(every.text.split(after)[1].split()[0]) for after in (" by ", " count, ")
    )
    assert size == pytest.approx(24, abs=1) and floors == pytest.approx(
        24, rel=0.2
    )  # the noise is 1 count
    (single,) = offsets(changed(-12.0 * (np.arange(K) == 7)))
    assert (
        "1 of 20 cells" in single.text
        and config().names[7] in single.text
        and " by -1" in single.text
    )
    assert (
        offsets(
            [
                dataclasses.replace(m, temperature_c=np.full(len(m.time_s), 20.0))
                for m in changed(24.0)
            ]
        )
        == []
    )
    remarks = (
        CellsMachine(config()).diagnose("array", split(changed(24.0))).diagnosis.remarks
    )
    assert any("20 of 20 cells" in text for text in remarks)


def drifting(count_per_s: float) -> list[CellMeasurement]:
    return [
        dataclasses.replace(m, measured=m.measured + count_per_s * m.time_s[:, None])
        for m in array()
    ]


def test_creep_and_a_drift_within_recordings_are_no_difference_of_offsets():
    for recordings in (
        drifting(1.0),
        drifting(-1.0),
        array(law=creeping(0.3)),
        array(law=creeping(-0.3)),
    ):
        assert not [f for f in offsets(recordings) if f.check == "other_offset"]


def test_readings_that_fall_below_rest_after_a_release_are_named_with_the_line_to_write():
    """After 2 s of 10 N a cell of 30 count/N and a share of −0.3 is up to 0.3 · (1 − 1/e) · 300 = 57 counts below rest."""
    (named,) = offsets(array(law=creeping(-0.3)))
    assert (named.check, named.severity) == ("falls_below_rest", "warning")
    assert "20 of 20 cells" in named.text and "`below_rest: true`" in named.text
    assert offsets(array(law=creeping(-0.3)), below_rest=True) == []
    limited = array(law=lambda f: np.maximum(creeping(-0.3)(f), 0.0))
    for recordings in (
        array(),
        drifting(-1.0),
        drifting(1.0),
        array(law=creeping(0.3)),
        limited,
    ):
        assert offsets(recordings) == []


def test_relaxation_that_reads_below_rest_is_found_with_its_numbers_where_the_file_says_so():
    recordings = array(law=creeping(-0.3))
    d = CellsMachine(unclipped()).diagnose("array", split(recordings)).diagnosis
    assert d.names == ("taxel_creep",) and d.status == "at_floor"
    (creep,) = d.effects
    assert (
        isinstance(creep, TaxelCreep) and not creep.below_rest
    )  # the cells file says it, not the effect
    assert (creep.share, creep.time_constant_s) == (
        pytest.approx(-0.3, abs=0.006),
        pytest.approx(2.0, rel=0.02),
    )
    least = creeping(-0.3)(force()).min() / 2  # in tenths of the rated 20 N
    assert responses(unclipped(), recordings[0], [creep]).min() == pytest.approx(
        least, rel=0.02
    )
    assert responses(unclipped(below_rest=False), recordings[0], [creep]).min() == 0.0
