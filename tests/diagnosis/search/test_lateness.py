"""How late a recording follows its simulation, as a start value of delays."""

import dataclasses

import numpy as np
import pytest
from made_problem import MadeProblem, drive, record

from taccorl.diagnosis.search.lateness import lateness_s

GIVEN = {"gain": 2.0, "offset": 0.0}


@pytest.mark.parametrize("late_s", [-0.004, 0.0, 0.0121, 0.0255, 0.08])
def test_a_shift_of_time_is_found_between_rows_though_gain_and_offset_are_wrong(
    late_s: float,
):
    """Rows are 5 ms apart; the gain of the recordings is 3, that of the file 2."""
    late = []
    for seed in range(3):
        r = record(seed, noise=0.001)
        moved = 3.0 * drive(r.time_s - late_s, seed) + 0.4
        late.append(dataclasses.replace(r, measured=moved[:, None]))
    found = lateness_s(MadeProblem(), GIVEN, (), late)
    assert found == pytest.approx(late_s, abs=5e-4)


def test_a_recording_that_stands_still_or_has_no_rows_is_not_late():
    r = record(0)
    for measured in (np.zeros_like(r.measured), np.full_like(r.measured, np.nan)):
        still = dataclasses.replace(r, measured=measured)
        assert lateness_s(MadeProblem(), GIVEN, (), [still]) == 0.0
