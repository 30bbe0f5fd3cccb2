"""Bristles of dry friction that the machine's file states."""

import dataclasses

import pytest
from simulated_slide import AXIS, FRICTION_N, recorded_slide, simulated

from taccorl.alignment.machines.axis_file import EffectEntry
from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.problems.axis_problem import AxisProblem
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.search import diagnose

DRY = dataclasses.replace(AXIS, effects=(EffectEntry("coulomb_friction", {"torque_nm": FRICTION_N}),))
BRISTLES_M = 2e-4
CONSIDERED = ("presliding", "power_law_friction")


def diagnosed(measurements: Measurements) -> Diagnosis:
    problem = AxisProblem(DRY, measurements)
    return diagnose(
        problem,
        problem.fit,
        problem.validation,
        start=problem.start,
        present=problem.present,
        without=[name for name in problem.candidates if name not in CONSIDERED],
        config=SearchConfig(max_effects=1),
    )


def test_bristles_of_known_friction_are_found_and_no_friction_that_grows_with_the_speed():
    fit = [simulated(n, 0.02, 0.5, k, r, BRISTLES_M) for k, (n, r) in enumerate((("sine", None), ("again", "sine")))]
    found = diagnosed(Measurements(tuple(fit), (simulated("held", 0.025, 0.4, 3, None, BRISTLES_M),)))
    assert found.names == ("coulomb_friction", "presliding") and found.status == "at_floor"
    assert found.after.values["presliding.presliding_rad"] == pytest.approx(BRISTLES_M, rel=0.1)
    low, high = found.intervals["presliding.presliding_rad"]
    assert low <= BRISTLES_M <= high
    assert "power_law_friction" in {e.name for e in found.rounds[0].evidence}


def test_bristles_are_looked_for_only_in_friction_that_the_file_states():
    measurements = recorded_slide()
    assert "presliding" in AxisProblem(DRY, measurements).candidates
    assert "presliding" not in AxisProblem(AXIS, measurements).candidates
    assert diagnosed(measurements).names == ("coulomb_friction",), "it sticks"
