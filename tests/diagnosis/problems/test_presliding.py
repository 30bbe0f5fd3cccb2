"""Bristles of dry friction, a number of ``coulomb_friction`` that is absent at 0."""

import pytest
from axes import altered
from simulated_slide import AXIS, FRICTION_N, one_round, recorded_slide, simulated

from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.measurements.folder import Measurements

DRY = altered(AXIS, effects=(("coulomb_friction", {"torque_nm": FRICTION_N}),))
BRISTLES_M = 2e-4
CONSIDERED = ("coulomb_friction", "power_law_friction", "stribeck_friction")


@pytest.mark.parametrize("axis", [AXIS, pytest.param(DRY, marks=pytest.mark.slow)])
def test_bristles_are_found_with_the_friction_and_as_a_number_that_the_file_lacks(
    axis: Robot,
):
    """Stribeck friction with bristles explains as much with two numbers more."""
    fit = [
        simulated(n, 0.02, 0.5, k, r, BRISTLES_M)
        for k, (n, r) in enumerate((("sine", None), ("again", "sine")))
    ]
    made = Measurements(
        tuple(fit), (simulated("held", 0.025, 0.4, 3, None, BRISTLES_M),)
    )
    found = one_round(axis, made, CONSIDERED)
    assert (
        found.names == ("coulomb_friction",)
        and found.errors["after"]["validation"] < 1.3
    )
    assert found.after.values["coulomb_friction.presliding_rad"] == pytest.approx(
        BRISTLES_M, rel=0.1
    )
    low, high = found.intervals["coulomb_friction.presliding_rad"]
    assert low <= BRISTLES_M <= high
    if axis is DRY:
        assert found.status == "numbers_off"
        changed = {c.name: c.before for c in found.changed}
        assert changed == {"inertia": 80.0, "coulomb_friction.presliding_rad": 0.0}, (
            "it is 100 kg"
        )


@pytest.mark.slow
def test_bristles_are_fitted_where_rigid_friction_alone_is_at_the_floor(
    monkeypatch: pytest.MonkeyPatch,
):
    """4.6 N on 102 kg: without bristles 1.26 floors remain, which ends a search; Stribeck friction, whose bristles are always
    fitted, leaves 1.00 and was named."""
    monkeypatch.setattr("simulated_slide.FRICTION_N", 4.57)
    motions = {
        "sine": (0.0231, 0.438, None),
        "again": (0.0231, 0.438, "sine"),
        "other": (0.111, 0.701, None),
    }
    fit = [
        simulated(n, a, hz, k, r, BRISTLES_M)
        for k, (n, (a, hz, r)) in enumerate(motions.items())
    ]
    made = Measurements(
        tuple(fit), (simulated("held", 0.0253, 0.824, 3, None, BRISTLES_M),)
    )
    found = one_round(AXIS, made, CONSIDERED)
    assert found.names == ("coulomb_friction",)
    assert found.after.values["coulomb_friction.presliding_rad"] == pytest.approx(
        BRISTLES_M, rel=0.1
    )


@pytest.mark.parametrize("axis", [AXIS, pytest.param(DRY, marks=pytest.mark.slow)])
def test_friction_that_sticks_has_no_bristles(axis: Robot):
    found = one_round(axis, recorded_slide(), CONSIDERED)
    assert (
        found.names == ("coulomb_friction",)
        and found.after.values["coulomb_friction.presliding_rad"] == 0.0
    )
    assert "coulomb_friction.presliding_rad" not in found.intervals
