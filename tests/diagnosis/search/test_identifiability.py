"""What recordings can show at all, before anything was found in them."""

import pytest
from imagined_motions import NOISE_RAD, SIGNAL, recorded

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.motions import AGAIN, CHIRP, STIFFER_CHIRP
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.search.fit import fit
from taccorl.diagnosis.search.identifiability import (
    ALIKE,
    RIDGE,
    VISIBLE,
    Identifiability,
    identifiability,
)
from taccorl.sim.effects import make_effect
from taccorl.sim.twin import TwinConfig


def told(
    *motions,
    stated: bool = False,
    config: TwinConfig | None = None,
    noise_rad: float = NOISE_RAD,
) -> Identifiability:
    config = TwinConfig() if config is None else config
    made = Measurements(
        tuple(
            recorded(config, m, seed, stated=stated, noise_rad=noise_rad)
            for seed, m in enumerate(motions)
        )
    )
    problem = JointProblem(config, SIGNAL, made)
    assert problem.commanded is stated
    first = fit(problem, problem.fit, problem.present, problem.start)
    return identifiability(problem, problem.fit, first)


@pytest.fixture(scope="module")
def one_chirp() -> Identifiability:
    return told(CHIRP, AGAIN)


@pytest.fixture(scope="module")
def two_gains() -> Identifiability:
    return told(CHIRP, AGAIN, STIFFER_CHIRP)


def test_viscous_friction_hides_in_a_fitted_gain_until_the_gain_is_changed(
    one_chirp, two_gains
):
    """K_d q̇ + D q̇: one chirp knows the sum. At twice the gain it is 2 K_d + D, and D stands alone."""
    assert "viscous_friction" in one_chirp.invisible
    assert "viscous_friction" not in two_gains.invisible
    assert (
        two_gains.visible["viscous_friction"]
        > 4 * one_chirp.visible["viscous_friction"]
    )


def test_an_offset_of_the_encoder_is_never_visible(one_chirp, two_gains):
    """q* − (q + b) with T_ref free: K_p b is a constant torque; the joint's start is read with the same offset."""
    assert (
        "encoder_bias" in one_chirp.invisible and "encoder_bias" in two_gains.invisible
    )


def test_with_commanded_gains_one_chirp_shows_viscous_friction_but_no_late_command_from_a_late_report():
    """A loop that hears late is one that tells late: the same motion, reported at the same time. No gain lies on a ridge."""
    found = told(CHIRP, AGAIN, stated=True)
    assert "viscous_friction" not in found.invisible and found.ridges == ()
    pairs = {frozenset(pair[:2]): pair[2] for pair in found.pairs}
    assert pairs[frozenset({"command_delay", "sensor_delay"})] == pytest.approx(
        1.0, abs=1e-4
    )
    assert not {"command_delay", "sensor_delay"} & set(found.invisible)


def test_dry_friction_and_its_lopsided_kin_are_one_pair():
    """F (1 + a sign v) sign v = F sign v + a F: a constant torque more, which T_ref takes up."""
    found = told(
        CHIRP, AGAIN, noise_rad=2e-5
    )  # quiet: a tenth of the little torque that a stiff joint's chirp takes
    assert not {"coulomb_friction", "asymmetric_friction"} & set(found.invisible)
    assert {"coulomb_friction", "asymmetric_friction"} in [
        set(pair[:2]) for pair in found.pairs
    ]


def test_pairs_are_visible_effects_most_alike_first(two_gains):
    sizes = [pair[2] for pair in two_gains.pairs]
    assert sizes == sorted(sizes, reverse=True)
    assert all(ALIKE < size <= 1.0 + 1e-9 for size in sizes)
    assert all(
        two_gains.visible[name] >= VISIBLE
        for pair in two_gains.pairs
        for name in pair[:2]
    )


def test_stiff_and_damped_gains_lie_on_a_ridge_that_is_named(one_chirp):
    """K_d/K_p = 0.113 s is what a chirp below 2.5 Hz sees of this joint; its inertia is hardly felt."""
    (ridge,) = one_chirp.ridges
    assert set(ridge[:2]) == {"kp", "kd"}
    assert ridge[2] > RIDGE


def test_an_effect_that_the_twin_has_is_not_asked_about(one_chirp):
    twin = TwinConfig(
        effects=[
            make_effect(
                "coulomb_friction", torque_nm=0.5, arm="left", joints=["joint5"]
            )
        ]
    )
    found = told(CHIRP, AGAIN, config=twin)
    assert "coulomb_friction" not in found.visible
    assert set(one_chirp.visible) - set(found.visible) == {"coulomb_friction"}
