"""Controller identification on recordings of the simulated twin whose gains are known: the paper's table, App. B.1."""

import dataclasses
import math

import numpy as np
import pytest
from one_joint import REFERENCE_TWIN, TWIN, recorded

from taccorl.alignment.controller.identification import (
    PAPER_BOUNDS,
    identify_controller,
)
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.joint_recording import joint_motion
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect
from taccorl.sim.twin import TwinConfig

ELBOW = "left_joint5"
TRUTH = {
    f"left_{joint}": JointModel(TWIN, f"left_{joint}").gains for joint in ROBOT.joints
}


def motion_of(
    signal: str, seed: int = 0, *effects, config: TwinConfig = REFERENCE_TWIN, **options
) -> JointMotion:
    return joint_motion(recorded(signal, seed, *effects, **options), config, signal)


@pytest.mark.parametrize(
    "signal",
    [
        pytest.param(s, marks=[pytest.mark.slow] * (k % 3 > 0))
        for k, s in enumerate(TRUTH)
    ],
)
def test_the_paper_s_gains_are_found_from_its_sweep(signal: str) -> None:
    validation = motion_of(signal, 1, high_hz=1.0)
    fit = identify_controller(
        [motion_of(signal)], JointModel(REFERENCE_TWIN, signal), validation=[validation]
    )
    truth = TRUTH[signal]
    assert fit.converged, fit.remarks
    assert fit.gains.kd / fit.gains.kp == pytest.approx(
        truth.kd / truth.kp, rel=1e-3
    )  # the goal is 1 %
    lag, kp = fit.estimates["lag"], fit.estimates["kp"]
    assert (lag.high - lag.low) / lag.value < 1e-3
    wide = 1.3  # of 95 % intervals: six joints, one draw each
    for name, true in (
        ("lag", truth.kd / truth.kp),
        ("offset", truth.torque_ff / truth.kp),
        ("kp", truth.kp),
    ):
        found = fit.estimates[name]
        assert abs(found.value - true) < wide * (found.high - found.low) / 2, name
    assert kp.low > 0.8 * truth.kp and kp.high < 1.2 * truth.kp
    # What is left is the noise, on the recording that was not fitted as well.
    for error in fit.errors:
        assert error.rmse_after == pytest.approx(2e-4, rel=0.1)
        assert error.rmse_after < 0.1 * error.rmse_before
    assert [error.use for error in fit.errors] == ["fit", "validation"]


@pytest.mark.slow
def test_intervals_hold_what_they_promise() -> None:
    # 95 % intervals of 30 draws of noise: less than 24 hits have a chance of 1 in 1000.
    base, model = (
        motion_of(ELBOW, noise_rad=0.0, seconds=5.0),
        JointModel(REFERENCE_TWIN, ELBOW),
    )
    truth = TRUTH[ELBOW]
    true = truth._asdict() | {
        "lag": truth.kd / truth.kp,
        "offset": truth.torque_ff / truth.kp,
        "late": 0.0,
    }
    hits = dict.fromkeys(true, 0)
    for seed in range(30):
        noise = 2e-4 * np.random.default_rng(seed).normal(size=len(base.measured))
        noisy = base.measured + noise
        fit = identify_controller(
            [dataclasses.replace(base, measured=noisy, start=noisy[:20].mean())], model
        )
        for name, value in true.items():
            hits[name] += fit.estimates[name].low <= value <= fit.estimates[name].high
    assert min(hits.values()) >= 24, hits


def test_residuals_that_hang_together_widen_the_intervals() -> None:
    base, model = motion_of(ELBOW, noise_rad=0.0), JointModel(REFERENCE_TWIN, ELBOW)
    white = 2e-4 * np.random.default_rng(0).normal(size=len(base.measured))
    slow = np.convolve(
        white, np.ones(20) / math.sqrt(20), "same"
    )  # the same variance, 20 rows together
    fits = [
        identify_controller(
            [dataclasses.replace(base, measured=base.measured + noise)], model
        )
        for noise in (white, slow)
    ]
    widths = [fit.estimates["lag"].high - fit.estimates["lag"].low for fit in fits]
    assert 3 < widths[1] / widths[0] < 7  # about √20


def test_positions_know_the_ratio_and_torques_the_scale() -> None:
    model = JointModel(REFERENCE_TWIN, ELBOW)
    positions = identify_controller([motion_of(ELBOW)], model)
    torques = identify_controller([motion_of(ELBOW, effort_noise_nm=1e-3)], model)
    assert positions.ridge > 0.999
    assert torques.ridge < 0.99
    widths = [
        fit.estimates["kp"].high - fit.estimates["kp"].low
        for fit in (positions, torques)
    ]
    assert widths[1] < 0.1 * widths[0]
    assert torques.gains.kp == pytest.approx(TRUTH[ELBOW].kp, rel=1e-3)


def test_a_joint_whose_inertia_hardly_shows_has_its_ridge_reported() -> None:
    fit = identify_controller(
        [motion_of("left_joint4", noise_rad=1e-3)],
        JointModel(REFERENCE_TWIN, "left_joint4"),
    )
    kp = fit.estimates["kp"]
    assert kp.high / kp.low > 1.5 and kp.low < TRUTH["left_joint4"].kp < kp.high
    assert fit.ridge > 0.99999
    assert any("K_p alone is known to a factor" in remark for remark in fit.remarks)


@pytest.mark.parametrize("rows_early", [1, -1])
def test_a_clock_one_row_off_is_told_before_k_p_is_believed(rows_early: int) -> None:
    # 5 ms: K_p 151 turns into several hundred, or into tens, and the fit says why.
    m = recorded(ELBOW, 0, rows_early=max(rows_early, 0))
    if rows_early < 0:
        m = dataclasses.replace(m, measured=np.roll(m.measured, 1, axis=0))
        m.measured[0] = m.measured[1]
    fit = identify_controller(
        [joint_motion(m, REFERENCE_TWIN, ELBOW)], JointModel(REFERENCE_TWIN, ELBOW)
    )
    assert not 0.8 < fit.gains.kp / TRUTH[ELBOW].kp < 1.25
    assert fit.estimates["late"].value == pytest.approx(-rows_early * 0.005, abs=0.0015)
    word = "earlier" if rows_early > 0 else "later"
    assert any(word in remark and "check the clock" in remark for remark in fit.remarks)
    good = identify_controller([motion_of(ELBOW)], JointModel(REFERENCE_TWIN, ELBOW))
    assert good.remarks == () and abs(good.estimates["late"].value) < 0.0015


@pytest.mark.slow
def test_a_number_at_its_bound_is_not_an_estimate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # T_ref of joint 5 is 1.73 N·m; with less allowed than that no gains rest where the joint rests.
    motion = motion_of(ELBOW)
    monkeypatch.setitem(PAPER_BOUNDS, "kp", (100.0, 1e5))
    monkeypatch.setitem(PAPER_BOUNDS, "torque_ff", (-1.0, 1.0))
    fit = identify_controller([motion], JointModel(REFERENCE_TWIN, ELBOW))
    assert not fit.converged
    assert any(remark.startswith("not converged, because") for remark in fit.remarks)
    assert any(fit.estimates[name].at_bound for name in ("kp", "torque_ff"))


def test_commanded_gains_are_believed_and_the_scale_of_repeats_too() -> None:
    # The same sweep at the paper's gains and at twice K_p, both stated: only T_ref is left to find.
    truth = TRUTH[ELBOW]
    stated = [
        dataclasses.replace(
            recorded(ELBOW, seed, seconds=5.0),
            kp={ELBOW: truth.kp},
            kd={ELBOW: truth.kd},
        )
        for seed in (0, 1)
    ]
    motions = [joint_motion(m, REFERENCE_TWIN, ELBOW) for m in stated]
    fit = identify_controller(motions, JointModel(REFERENCE_TWIN, ELBOW))
    assert fit.gains[:2] == pytest.approx((truth.kp, truth.kd)) and math.isnan(
        fit.ridge
    )
    assert (
        fit.estimates["kp"].fixed
        and fit.estimates["kd"].fixed
        and not fit.estimates["torque_ff"].fixed
    )
    offset = fit.estimates["torque_ff"]
    assert abs(offset.value - truth.torque_ff) < 1.3 * (offset.high - offset.low) / 2
    assert offset.high - offset.low < 0.01
    assert fit.errors[0].rmse_after == pytest.approx(2e-4, rel=0.1)
    # Free after all: a fit of relative gains, twice as stiff in the second recording.
    model = JointModel(TWIN, ELBOW)
    plain = joint_motion(dataclasses.replace(stated[0], kp={}, kd={}), TWIN, ELBOW)
    stiff = dataclasses.replace(plain, kp_scale=2.0)
    answer = model.simulate(stiff, truth).reported
    noise = 2e-4 * np.random.default_rng(2).normal(size=len(answer))
    stiff = dataclasses.replace(stiff, measured=answer + noise)
    both = identify_controller([plain, stiff], JointModel(REFERENCE_TWIN, ELBOW))
    assert both.gains.kp == pytest.approx(truth.kp, rel=0.05)
    assert all(error.rmse_after < 2.5e-4 for error in both.errors)


def test_what_is_not_free_stays_the_twin_s() -> None:
    fit = identify_controller([motion_of(ELBOW)], JointModel(TWIN, ELBOW), free=["kd"])
    assert (fit.gains.kp, fit.gains.torque_ff) == (
        TRUTH[ELBOW].kp,
        TRUTH[ELBOW].torque_ff,
    )
    assert fit.gains.kd == pytest.approx(TRUTH[ELBOW].kd, rel=1e-3)


def test_gaps_in_the_measurement_are_left_out() -> None:
    m = recorded(ELBOW, 0)
    m.measured[300:500] = np.nan
    m.measured[900:1000, m.column(ELBOW)] = np.nan
    fit = identify_controller(
        [joint_motion(m, REFERENCE_TWIN, ELBOW)], JointModel(REFERENCE_TWIN, ELBOW)
    )
    assert fit.converged and fit.gains.kd / fit.gains.kp == pytest.approx(
        17.1 / 151.1, rel=1e-3
    )


def test_missing_physics_is_left_over_and_known_physics_is_not() -> None:
    friction = make_effect(
        "coulomb_friction", torque_nm=0.5, arm="left", joints=["joint5"]
    )
    motion = motion_of(ELBOW, 0, friction)
    without = identify_controller([motion], JointModel(REFERENCE_TWIN, ELBOW))
    knowing = dataclasses.replace(REFERENCE_TWIN, effects=[friction])
    with_it = identify_controller([motion], JointModel(knowing, ELBOW))
    assert without.errors[0].rmse_after > 4 * 2e-4 > 3.5 * with_it.errors[0].rmse_after
    assert with_it.gains.kp == pytest.approx(TRUTH[ELBOW].kp, rel=0.1)


def test_recordings_that_tell_nothing_are_refused_by_name() -> None:
    model, good = JointModel(REFERENCE_TWIN, ELBOW), motion_of(ELBOW, seconds=4.0)
    with pytest.raises(TaccorlError, match="no recording to fit"):
        identify_controller([], model)
    still = dataclasses.replace(
        good, name="still.mcap", target=np.full_like(good.target, 0.2)
    )
    said = r"still\.mcap: the targets of left_joint5 move by 0 rad only.*record a sweep"
    with pytest.raises(TaccorlError, match=said):
        identify_controller([still], model)
    short = {
        name: getattr(good, name)[:200]
        for name in ("time_s", "target", "measured", "effort", "coupling_nm")
    }
    with pytest.raises(TaccorlError, match=r"0\.99 s of left_joint5 are too short"):
        identify_controller([dataclasses.replace(good, **short)], model)
    silent = dataclasses.replace(
        good, measured=np.where(np.arange(800) < 500, np.nan, good.measured)
    )
    with pytest.raises(TaccorlError, match=r"measured.*38%.*rows"):
        identify_controller([silent], model)
    dead = dataclasses.replace(good, name="dead.mcap", measured=np.full(800, 0.2))
    said = (
        r"dead\.mcap: left_joint5 moved by 0 rad where its targets move by 0\.\d+ rad"
    )
    with pytest.raises(TaccorlError, match=said):
        identify_controller([good], model, validation=[dead])
    with pytest.raises(
        TaccorlError,
        match=r"free parameters \['mass'\]; choose among kp, kd, torque_ff",
    ):
        identify_controller([good], model, free=["mass"])
