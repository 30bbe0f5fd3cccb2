"""How late a recording follows its simulation, as a start value of delays."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from made_problem import MadeProblem, drive, record

from pipelines.studies import pairs
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.search.fits import Fits
from taccorl.diagnosis.search.lateness import lateness_s
from taccorl.diagnosis.search.problem import no_progress, thinned
from taccorl.diagnosis.search.result import SearchConfig

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


def test_a_delay_is_found_in_its_row_where_efforts_show_each_row_a_minimum(
    tmp_path: Path,
) -> None:
    """A slide with dry friction and a delay of 13.53 ms, logged every 5 ms. From 17 ms a
    fit stays there, at 1.26 noise floors; other recordings have 3.9 then."""
    names = ("coulomb_friction", "command_delay")
    machine, part, made = pairs.made(91001, *names, tmp_path)
    problem = machine.motion_problem(part, made, "auto")
    assert isinstance(problem, JointProblem)
    how = problem.validation, problem.start, (), SearchConfig(), no_progress
    fits = Fits(problem, thinned(problem.fit), *how)
    begin = fits.first.values | {"coulomb_friction.torque_nm": 13.0}
    parent = fits.whole(names[:1], begin).fit
    begin = parent.values | {"command_delay.delay_s": 0.004}
    stuck = fits.fitted(names, [fits._short(parent, names[1], begin).values])
    assert stuck.values["command_delay.delay_s"] > 0.015 and fits.error(stuck) > 2.0
    found = fits._in_best_row(stuck, "command_delay")
    assert found.values["command_delay.delay_s"] == pytest.approx(0.01353, abs=1e-4)
    assert fits.error(found) < 1.1
