"""A real measured drive (EMPS benchmark): its floor and its checks. Skipped where the data is not at hand."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from taccorl.alignment.checks.clock import check_clock
from taccorl.alignment.checks.telemetry import check_measurement
from taccorl.alignment.checks.trial import Trial
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import noise_floor

DATA = Path(__file__).parents[4] / "shared" / "data" / "emps" / "DATA_EMPS.mat"
pytestmark = pytest.mark.skipif(
    not DATA.is_file(),
    reason=f"the EMPS benchmark is not at {DATA}; see nonlinearbenchmark.org",
)


@pytest.fixture(scope="module")
def emps() -> Measurement:
    data = scipy.io.loadmat(DATA)
    effort = data["gtau"] * data["vir"]
    columns = {
        "time_s": data["t"][:, 0],
        "target": data["qg"],
        "measured": data["qm"],
        "effort": effort,
    }
    return Measurement(
        name="emps", signals=("drive",), units=("m",), source=DATA, **columns
    )


def test_floor_of_the_real_drive_is_what_its_equal_cycles_differ_by(emps):
    """Cycles of 6240 rows, the last one short. The article's position error of a good model is a few µm; a step of the encoder
    and the noise of rows are below that."""
    for kind, values in (("position", emps.measured), ("effort", emps.effort)):
        floor = noise_floor([emps], kind)["drive"]
        differ = values[2 * 6240 :] - values[6240 : len(values) - 6240]
        assert floor.used.method == "cycles" and not floor.lower_bound
        assert floor.value == pytest.approx(
            float(np.sqrt(np.mean(differ**2) / 2)), rel=0.02
        )
        assert floor.value > 2.0 * next(
            e.value for e in floor.estimates if e.method == "residue"
        )
    assert 1e-9 < noise_floor([emps])["drive"].value < 5e-6


def test_the_real_recording_passes_the_checks(emps):
    assert not [f for f in check_measurement(emps) if f.severity == "error"]


def test_real_positions_one_millisecond_early_are_found_or_said_to_be_unknowable(emps):
    columns = {
        "time_s": emps.time_s[:-5],
        "target": emps.target[:-5],
        "measured": emps.measured[5:],
    }
    early = Measurement(name="early", signals=("drive",), units=("m",), **columns)
    assert {f.check for f in check_clock(Trial(early))} <= {
        "measured_before_command",
        "not_judged",
    }
    assert np.isfinite(early.measured).all()
