"""One joint as a problem: which numbers are free, also those that nobody states, what is a candidate, what residuals count in."""

import dataclasses

import numpy as np
import pytest
from imagined_motions import NOISE_NM, NOISE_RAD, RATE_HZ, SIGNAL, recorded

from taccorl.alignment.controller.arm_joint import AT_TCP
from taccorl.alignment.measurements.folder import Measurements, split
from taccorl.alignment.measurements.motions import (
    AGAIN,
    CHIRP,
    HELD_STEPS,
    STIFFER_CHIRP,
    VALIDATION,
    WIDE_TRIANGLE,
)
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.diagnosis.problems.joint_problem import GainsAre, JointProblem
from taccorl.diagnosis.problems.joints import diagnose_joint, set_numbers
from taccorl.diagnosis.search.fit import FINE, fit, moved_by, rms, stacked
from taccorl.diagnosis.search.fits import Fits, refusal
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.diagnosis.search.search import diagnose
from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.drive import SpeedDelay
from taccorl.sim.effects.effect import Effect
from taccorl.sim.twin import TwinConfig
from taccorl.surrogate.cases import Case, case_of, draw_case
from taccorl.surrogate.recordings import recordings

KP, KD = 151.1, 17.1  # of joint 5, paper App. B.1
NOMINAL = TwinConfig()


def friction(
    torque_nm: float, joints: tuple[str, ...] = ("joint5",), arm: str = "left"
) -> Effect:
    return make_effect(
        "coulomb_friction", torque_nm=torque_nm, arm=arm, joints=list(joints)
    )


def names(problem: JointProblem) -> list[str]:
    return [free.name for free in problem.base]


@pytest.fixture(scope="module")
def chirps():
    """Stated gains, with effort."""
    return tuple(
        recorded(NOMINAL, motion, seed, effort=True)
        for seed, motion in enumerate((CHIRP, AGAIN))
    )


def test_commanded_gains_efforts_or_known_weight_pin_the_torques_and_nothing_else_does(
    chirps,
):
    def pinned(recordings, gains: GainsAre = "fitted", effort=False, names=()):
        return JointProblem(
            NOMINAL, SIGNAL, Measurements(recordings), gains=gains, effort=effort
        ).pinned_by(names)

    assert pinned(chirps) == () and pinned(chirps, gains="auto") == ("commanded gains",)
    assert pinned(chirps, effort=True) == ("recorded effort",)
    # Slowly with 0.5 kg: weight varies by 0.14 N·m (standard deviation; 4.7 floors × K_p), J q̈ by 0.02 N·m.
    loaded = recorded(NOMINAL, dataclasses.replace(WIDE_TRIANGLE, payload_kg=0.5), 3)
    assert pinned((loaded,)) == ("known weight",)
    assert pinned((recorded(NOMINAL, WIDE_TRIANGLE, 3),)) == (), (
        "the arm's own weight is carried: nothing to be held"
    )
    assert pinned((loaded,), names=("payload",)) == (), (
        "an unknown mass beside it: the weight is not known"
    )


def test_commanded_gains_stay_fixed_where_every_recording_states_them(chirps):
    problem = JointProblem(NOMINAL, SIGNAL, Measurements(chirps), effort=False)
    assert problem.commanded
    assert names(problem) == ["torque_ff", "speed_delay_s"]
    model = fit(problem, problem.fit, (), problem.start)
    assert set(model.values) == {"torque_ff", "speed_delay_s"}
    assert model.error == pytest.approx(
        1.0, abs=0.05
    )  # the twin's gains are those that were commanded


def test_gains_are_fitted_if_one_recording_is_silent_or_they_are_not_believed(chirps):
    silent = dataclasses.replace(chirps[1], kp={}, kd={})
    for problem in (
        JointProblem(NOMINAL, SIGNAL, Measurements((chirps[0], silent)), effort=False),
        JointProblem(
            NOMINAL, SIGNAL, Measurements(chirps), gains="fitted", effort=False
        ),
        JointProblem(
            NOMINAL,
            SIGNAL,
            Measurements(chirps[:1], validation=(silent,)),
            effort=False,
        ),
    ):
        assert not problem.commanded
        assert names(problem) == ["kp", "kd", "torque_ff"]


def test_fitted_gains_find_what_the_robot_has():
    config = TwinConfig()
    config.controller.kp_nm_per_rad[4], config.controller.kd_nms_per_rad[4] = 60.0, 6.0
    made = Measurements(
        tuple(
            recorded(config, m, k, stated=False) for k, m in enumerate((CHIRP, AGAIN))
        )
    )
    problem = JointProblem(NOMINAL, SIGNAL, made)
    assert problem.start["kp"] == KP
    model = fit(problem, problem.fit, (), problem.start)
    low, high = model.intervals()["kp"]
    assert low < 60.0 < high and high / low < 1.1
    assert model.values["kd"] == pytest.approx(
        6.0, rel=0.02
    ) and model.error == pytest.approx(1.0, abs=0.05)


def test_commanded_gains_that_nobody_stated_are_refused_with_the_way_out(chirps):
    silent = dataclasses.replace(chirps[1], kd={})
    with pytest.raises(
        TaccorlError,
        match=r"chirp_again: .*left_joint5 are not stated; .*measurements.yaml.*fitted",
    ):
        JointProblem(
            NOMINAL, SIGNAL, Measurements((chirps[0], silent)), gains="commanded"
        )


def test_a_gain_twice_as_high_acts_whether_it_is_stated_or_only_its_factor():
    stiffer = recorded(NOMINAL, STIFFER_CHIRP, 1, stated=False)
    assert stiffer.gain_scale == {SIGNAL: 2.0} and not stiffer.kp
    problem = JointProblem(
        NOMINAL,
        SIGNAL,
        Measurements((recorded(NOMINAL, CHIRP, 0, stated=False), stiffer)),
    )
    plain, scaled = problem.fit
    once = {"kp": KP, "kd": KD, "torque_ff": 1.73}
    twice = once | {"kp": 2 * KP, "kd": 2 * KD}
    same_command = dataclasses.replace(
        plain, data=dataclasses.replace(scaled.data, kp_scale=1.0, kd_scale=1.0)
    )
    np.testing.assert_array_equal(
        problem.simulate(once, [], scaled), problem.simulate(twice, [], same_command)
    )
    assert rms(stacked(problem, once, [], problem.fit)) == pytest.approx(1.0, abs=0.1)
    forgotten = dataclasses.replace(scaled, data=same_command.data)
    assert rms(stacked(problem, once, [], [forgotten])) > 3.0
    # stated gains are believed before a factor: 1 × the twin's, whatever gain_scale says
    both = dataclasses.replace(stiffer, kp={SIGNAL: KP}, kd={SIGNAL: KD})
    motion = JointProblem(NOMINAL, SIGNAL, Measurements((both,))).fit[0].data
    assert (motion.kp_scale, motion.kd_scale) == (1.0, 1.0)


def test_a_scale_of_all_torques_is_no_candidate_where_gains_are_fitted(chirps):
    """K_p, K_d and T_ref take it up: τ = s (K_p e − K_d q̇ + T_ref)."""
    fitted = JointProblem(NOMINAL, SIGNAL, Measurements(chirps), gains="fitted")
    commanded = JointProblem(NOMINAL, SIGNAL, Measurements(chirps))
    assert set(commanded.candidates) - set(fitted.candidates) == {
        "torque_scale",
        "direction_gain",
    }


def test_candidates_are_effects_of_this_joint_alone(chirps):
    problem = JointProblem(NOMINAL, SIGNAL, Measurements(chirps))
    assert (
        "taxel_gain_map" not in problem.candidates
        and "camera_latency" not in problem.candidates
    )
    c = problem.candidates["coulomb_friction"]
    assert c.make(
        {"coulomb_friction.torque_nm": 0.3, "coulomb_friction.presliding_rad": 0.0}
    ).acts_on() == [SIGNAL]
    assert problem.candidates["payload"].selectors == {"arm": "left"}


def test_a_friction_s_starts_hang_on_what_the_motor_gives(chirps):
    """3, 10 and 30 % of the peak effort (Effect.starts)."""
    problem = JointProblem(NOMINAL, SIGNAL, Measurements(chirps))
    peak = max(
        float(np.abs(problem.model.simulate(r.data, problem.model.gains).effort).max())
        for r in problem.fit
    )
    starts = [
        start["coulomb_friction.torque_nm"]
        for start in problem.candidates["coulomb_friction"].starts
    ]
    assert starts == pytest.approx([0.03 * peak, 0.1 * peak, 0.3 * peak])


def test_an_effect_that_the_twin_has_is_refitted_and_is_no_candidate_twice():
    truth = TwinConfig(effects=[friction(0.8)])
    fit_to = tuple(recorded(truth, m, k) for k, m in enumerate((CHIRP, AGAIN)))
    made = Measurements(fit_to, (recorded(truth, VALIDATION[0], 5),))
    # the twin has it in all joints of both arms, and too little of it
    twin = TwinConfig(effects=[friction(0.3, ("joint4", "joint5"), "both")])
    problem = JointProblem(twin, SIGNAL, made)
    assert (
        problem.present == ("coulomb_friction",)
        and problem.start["coulomb_friction.torque_nm"] == 0.3
    )
    keep = ("coulomb_friction", "backlash", "cogging")
    found = diagnose(
        problem,
        problem.fit,
        problem.validation,
        start=problem.start,
        present=problem.present,
        without=[name for name in problem.candidates if name not in keep],
        config=SearchConfig(max_effects=1),
    )
    assert found.names == ("coulomb_friction",) and found.status == "numbers_off"
    assert [(c.name, c.before) for c in found.changed] == [
        ("coulomb_friction.torque_nm", 0.3)
    ]
    assert (
        found.errors["before"]["validation"] > 5.0
        and found.errors["after"]["validation"] < 1.25
    )
    assert found.after.values["coulomb_friction.torque_nm"] == pytest.approx(
        0.8, abs=0.02
    )
    assert not [
        e for r in found.rounds for e in r.evidence if e.name == "coulomb_friction"
    ]


def test_the_model_beneath_lacks_what_the_problem_adds_so_that_nothing_acts_twice(
    chirps,
):
    twin = TwinConfig(effects=[friction(0.8, ("joint4", "joint5"), "both")])
    problem = JointProblem(twin, SIGNAL, Measurements(chirps), effort=False)
    bare = JointProblem(NOMINAL, SIGNAL, Measurements(chirps), effort=False)
    r = problem.fit[0]
    np.testing.assert_array_equal(
        problem.simulate(problem.start, [], r), bare.simulate(bare.start, [], r)
    )
    once = problem.candidates["coulomb_friction"].make(problem.start)
    whole = JointProblem(
        TwinConfig(effects=[friction(0.8)]), SIGNAL, Measurements(chirps), effort=False
    )
    np.testing.assert_array_equal(
        problem.simulate(problem.start, [once], r),
        whole.model.simulate(r.data, whole.model.gains, [once]).reported[:, None],
    )
    assert (
        np.abs(
            problem.simulate(problem.start, [once], r)
            - bare.simulate(bare.start, [], r)
        ).max()
        > 1e-3
    )


def test_an_effect_of_another_joint_is_not_present_here(chirps):
    twin = TwinConfig(effects=[friction(0.8, arm="right"), friction(0.8, ("joint4",))])
    assert JointProblem(twin, SIGNAL, Measurements(chirps)).present == ()


def test_a_repeated_motion_is_judged_by_its_own_noise_floor():
    """Chirps with 0.2 mrad of noise and steps with 0.8 mrad, both made twice; a triangle was made once."""
    loud = 4 * NOISE_RAD
    again = dataclasses.replace(
        HELD_STEPS, name="held_steps_again", repeat_of="held_steps"
    )
    fit_to = [
        recorded(NOMINAL, m, k) for k, m in enumerate((CHIRP, AGAIN, WIDE_TRIANGLE))
    ]
    held = [
        recorded(NOMINAL, m, 10 + k, noise_rad=loud)
        for k, m in enumerate((HELD_STEPS, again))
    ]
    problem = JointProblem(NOMINAL, SIGNAL, Measurements(tuple(fit_to), tuple(held)))
    floor = {r.name: float(r.floor[0]) for r in (*problem.fit, *problem.validation)}
    assert floor["chirp"] == floor["chirp_again"] == pytest.approx(NOISE_RAD, rel=0.1)
    assert (
        floor["held_steps"] == floor["held_steps_again"] == pytest.approx(loud, rel=0.1)
    )
    assert (
        floor["wide_triangle"] == problem.floors[0].value
        and NOISE_RAD < floor["wide_triangle"] < loud
    )
    assert rms(
        stacked(problem, problem.start, [], problem.validation)
    ) == pytest.approx(1.0, abs=0.1)


def test_a_joint_that_was_never_measured_is_refused(chirps):
    blind = dataclasses.replace(
        chirps[0], measured=np.full_like(chirps[0].measured, np.nan)
    )
    with pytest.raises(
        TaccorlError,
        match="left_joint5: its position was not measured in any recording",
    ):
        JointProblem(NOMINAL, SIGNAL, Measurements((blind,)))


def test_effort_is_a_second_channel_and_its_scale_is_found(chirps):
    """Some firmware reports four times the torque (piper_sdk issue 73)."""
    four = tuple(dataclasses.replace(m, effort=4.0 * m.effort) for m in chirps)
    problem = JointProblem(NOMINAL, SIGNAL, Measurements(four))
    assert names(problem) == [
        "torque_ff",
        "effort_scale",
        "speed_delay_s",
        "effort_age_s",
    ]
    assert problem.fit[0].channels == ("left_joint5 [rad]", "left_joint5 effort [N·m]")
    assert problem.fit[0].floor == pytest.approx([NOISE_RAD, 4 * NOISE_NM], rel=0.15)
    model = fit(problem, problem.fit, (), problem.start)
    assert model.values["effort_scale"] == pytest.approx(4.0, rel=0.01)
    assert model.error == pytest.approx(1.0, abs=0.1)


def test_efforts_of_a_sampled_drive_are_no_effect_of_the_joint():
    """They are a fraction of a millisecond older than the torque that acts, which looks like a torque_lag."""
    robot = TwinConfig(effects=[friction(2.0, ("joint3",))])
    made = recordings(case_of(robot, "left_joint3", 0, "chirp"), "chirp")
    problem = JointProblem(NOMINAL, "left_joint3", made)
    begun = problem.start | {
        "coulomb_friction.torque_nm": 1.5,
        "coulomb_friction.presliding_rad": 0.0,
    }
    model = fit(problem, problem.fit, ("coulomb_friction",), begun)
    assert model.error < 1.1 and model.values[
        "coulomb_friction.torque_nm"
    ] == pytest.approx(2.0, rel=0.03)
    low, high = model.intervals()["effort_age_s"]
    assert 0.0 < low < high < 2e-3


def test_effort_that_one_recording_lacks_is_not_used(chirps):
    silent = dataclasses.replace(
        chirps[1], effort=np.full_like(chirps[1].effort, np.nan)
    )
    problem = JointProblem(NOMINAL, SIGNAL, Measurements((chirps[0], silent)))
    assert not problem.effort and problem.fit[0].measured.shape[1] == 1
    assert names(problem) == ["torque_ff", "speed_delay_s"]


@pytest.mark.slow
def test_a_lag_that_takes_the_gains_along_is_fitted_as_far_as_its_rivals():
    """K_p is 9.3 N·m/rad, and a fit without a lag has 4.5. From there five steps leave 3.2 floors of the true lag, and 1.04 of a
    lag of the torque, with K_p 4.5: fitted as far, they are a tie."""
    case = draw_case(("cogging", "command_lag"), 90401, design="chirp")
    problem = JointProblem(
        case.twin, case.signal, recordings(case, "chirp"), gains="fitted", effort=False
    )
    fits = Fits(
        problem,
        problem.fit,
        problem.validation,
        problem.start,
        (),
        SearchConfig(),
        lambda text: None,
    )
    ripple = {
        name: value
        for name, value in case.values().items()
        if name.startswith("cogging.")
    }
    parent = fits.model_of(fits.fitted(("cogging",), [fits.first.values | ripple]))
    rivals = "torque_lag", "command_lag", "sensor_delay", "command_delay", "slew_limit"
    made = {m.names[-1]: m for m in fits.children(parent, rivals)}
    assert made["command_lag"].full and refusal(
        made["torque_lag"], made["command_lag"], fits.config
    )


def test_a_delay_of_whole_rows_is_found_beyond_its_jump():
    """The delayed target comes in a row's instant: before its effort is measured at three rows, after it at a little less."""
    delay = make_effect(
        "command_delay", delay_s=3 / RATE_HZ, arm="left", joints=["joint5"]
    )
    late = dataclasses.replace(NOMINAL, effects=(delay,))
    made = [
        recorded(late, motion, seed, effort=True)
        for seed, motion in enumerate((CHIRP, AGAIN, VALIDATION[0]))
    ]
    problem = JointProblem(
        NOMINAL, SIGNAL, split(made, validation=[VALIDATION[0].name])
    )
    fits = Fits(
        problem,
        problem.fit,
        problem.validation,
        problem.start,
        (),
        SearchConfig(),
        lambda text: None,
    )
    for begun in (
        1.2,
        3.6,
        6.0,
    ):  # rows; a few steps from there leave more than 10 floors, at 3.4 … 3.6 rows
        start = fits.base.fit.values | {"command_delay.delay_s": begun / RATE_HZ}
        model = fits._short(fits.base.fit, "command_delay", start)
        assert (
            model.values["command_delay.delay_s"] * RATE_HZ
            == pytest.approx(3, abs=0.05)
            and model.error < 1.3
        )


def test_a_motion_too_fast_for_a_smooth_has_the_floor_that_its_repeat_shows(chirps):
    fast = [
        dataclasses.replace(
            m, measured=m.measured + 0.3 * np.sin(80 * np.pi * m.time_s)[:, None]
        )
        for m in chirps
    ]
    problem = JointProblem(NOMINAL, SIGNAL, Measurements(tuple(fast)), effort=True)
    assert 0.5 * NOISE_NM < problem.fit[0].floor[-1] < 2 * NOISE_NM


def problem_of(
    case: Case, *, effort: bool = False, design: str = "chirp"
) -> JointProblem:
    return JointProblem(
        case.twin, case.signal, recordings(case, design), gains="fitted", effort=effort
    )


def test_the_delay_is_fitted_where_something_tells_it_from_the_gains():
    def base(measurement, gains="fitted", effort=False):
        problem = JointProblem(
            NOMINAL, SIGNAL, Measurements((measurement,)), gains=gains, effort=effort
        )
        return "speed_delay_s" in [f.name for f in problem.base]

    chirp = recorded(NOMINAL, CHIRP, 0, effort=True)
    assert not base(chirp), "positions alone: all torques scale with it"
    assert base(chirp, effort=True)
    assert base(chirp, gains="auto"), "commanded gains"
    assert base(
        recorded(NOMINAL, dataclasses.replace(WIDE_TRIANGLE, payload_kg=0.5), 1)
    ), "known weight that shows"


def test_a_sampled_loop_with_a_known_weight_is_no_effect_and_its_gains_are_found():
    """A clean surrogate: 4 kHz, a filter of 0.9 ms; 1.2 ms late in all. Without the delay, gravity_mismatch is found."""
    case = draw_case((), 30015, design="chirp", sampled=True, loaded=True)
    problem = problem_of(case)
    found = diagnose(
        problem, problem.fit, problem.validation, problem.test, start=problem.start
    )
    assert found.status == "nothing_missing"
    low, high = found.after.intervals()["speed_delay_s"]
    assert low < case.loop.late_s < high and high - low < 1e-3
    low, high = found.after.intervals()["kp"]
    assert low < case.values()["kp"] < high and high / low < 1.05
    new = TwinConfig()
    set_numbers(new, case.signal, found.base)
    (effect,) = new.effects
    assert isinstance(effect, SpeedDelay) and effect.acts_on() == [case.signal]
    assert effect.delay_s == found.base["speed_delay_s"]


@pytest.mark.parametrize(
    "seed",
    [213514, *(pytest.param(k, marks=pytest.mark.slow) for k in (213505, 213516))],
)
def test_a_sampled_loop_that_efforts_show_is_no_effect(seed):
    """500 Hz: the torque in force is of positions and targets newer than the reported one, which looked like an encoder_scale.
    4 kHz and 1.6 kHz with K_d (T + τ) of 1.08 and 0.62 times the inertia: a torque_lag, a velocity_feedforward."""
    problem = problem_of(draw_case((), seed, design="chirp", sampled=True), effort=True)
    found = diagnose(
        problem, problem.fit, problem.validation, problem.test, start=problem.start
    )
    assert (
        found.status == "nothing_missing" and max(found.errors["after"].values()) < 1.2
    )


def test_a_twin_that_has_the_delay_starts_from_it_and_has_it_once():
    twin = TwinConfig(
        effects=[
            make_effect("speed_delay", arm="left", joints=["joint5"], delay_s=2e-3)
        ]
    )
    made = Measurements((recorded(twin, CHIRP, 0, effort=True),))
    problem, bare = (
        JointProblem(config, SIGNAL, made, effort=True) for config in (twin, NOMINAL)
    )
    assert problem.start["speed_delay_s"] == 2e-3
    start = problem.start | {"speed_delay_s": 0.0}
    np.testing.assert_array_equal(
        *(p.simulate(start, [], problem.fit[0]) for p in (problem, bare))
    )


def test_a_payload_whose_place_nobody_states_is_found_beside_the_gains():
    """0.3 kg on joint 6 of a clean surrogate, 5.2 mm off the axis through the place where the twin has it; states no place."""
    case = draw_case((), 30038, design="pack")
    problem = problem_of(case, effort=True, design="pack")
    names = [f.name for f in problem.base]
    assert {"payload_sin_m", "payload_cos_m"} < {*names}
    model = fit(problem, problem.fit, (), problem.start, 60, FINE)
    assert model.error < 1.1
    off = np.subtract(case.payload_m, AT_TCP)[:2]
    found = np.hypot(model.values["payload_sin_m"], model.values["payload_cos_m"])
    assert found == pytest.approx(np.hypot(*off), abs=5e-4)


def test_a_place_that_is_stated_and_a_joint_that_weight_does_not_turn_need_no_lever():
    heavy = dataclasses.replace(CHIRP, payload_kg=0.3)
    unstated = recorded(NOMINAL, heavy, 0)
    stated = dataclasses.replace(unstated, payload_position_m={"left": AT_TCP})

    def levers(measurement, signal=SIGNAL):
        problem = JointProblem(
            NOMINAL, signal, Measurements((measurement,)), effort=False
        )
        return [f.name for f in problem.base if f.name.startswith("payload")]

    assert levers(unstated) == ["payload_sin_m", "payload_cos_m"]
    assert levers(stated) == []
    assert levers(unstated, "left_joint1") == []  # its axis is vertical


def test_an_effort_s_floor_is_at_least_what_no_smooth_curve_explains():
    """Twice the gain is twice the noise of K_p (q* − q); other recordings do not show it."""
    plain = tuple(recorded(NOMINAL, CHIRP, k, effort=True) for k in range(2))
    stiff = recorded(NOMINAL, STIFFER_CHIRP, 2, effort=True)
    rng = np.random.default_rng(0)
    noisy = dataclasses.replace(
        stiff, effort=stiff.effort + rng.normal(0.0, 0.5, stiff.effort.shape)
    )
    problem = JointProblem(NOMINAL, SIGNAL, Measurements((*plain, noisy)), effort=True)
    assert (
        problem.fit[2].floor[1] == pytest.approx(0.5, rel=0.2)
        and problem.fit[0].floor[1] < 0.1
    )
    assert problem.fit[2].floor[0] == pytest.approx(NOISE_RAD, rel=0.3)


def test_intervals_widen_by_what_the_other_recordings_would_move():
    """Torque of rest: θ from recordings that differ in it. Both have as many rows, so all together would fit half-way."""
    one, other = (TwinConfig() for _ in range(2))
    set_numbers(one, SIGNAL, {"torque_ff": 1.0})
    set_numbers(other, SIGNAL, {"torque_ff": 1.2})
    here, there = (recorded(twin, CHIRP, k) for k, twin in enumerate((one, other)))
    problem = JointProblem(
        NOMINAL, SIGNAL, Measurements((here,), validation=(there,)), effort=False
    )
    model = fit(problem, problem.fit, (), problem.start, 60, FINE)
    index = [f.name for f in model.frees].index("torque_ff")
    assert model.values["torque_ff"] == pytest.approx(1.0, abs=0.02)
    moved = moved_by(
        problem, model, problem.fit, problem.validation, np.full(len(model.frees), FINE)
    )
    assert moved[index] == pytest.approx(0.1, abs=0.02)
    wider = dataclasses.replace(model, moved=moved)
    low, high = wider.intervals()["torque_ff"]
    assert low < 0.85 and high > 1.15
    assert np.ptp(model.intervals()["torque_ff"]) < 0.1


@pytest.mark.parametrize("delay_s", [0.0, 1e-3, 2.5e-3])
def test_with_commanded_gains_the_delay_is_found_from_a_start_of_zeros(delay_s: float):
    """All numbers start at 0 here: a solver whose first step is as long as its start would not move."""
    late = make_effect("speed_delay", arm="left", joints=["joint5"], delay_s=delay_s)
    twin, robot = TwinConfig(), TwinConfig(effects=[late])
    for one in (twin, robot):  # soft gains leave room for a late speed
        set_numbers(one, SIGNAL, {"kp": 6.0, "kd": 0.6, "torque_ff": 0.0})
    made = [
        recorded(robot, motion, k, effort=True)
        for k, motion in enumerate((CHIRP, CHIRP, VALIDATION[0], VALIDATION[1]))
    ]
    measurements = Measurements(tuple(made[:2]), validation=tuple(made[2:]))
    problem = JointProblem(twin, SIGNAL, measurements)
    assert problem.commanded
    found = diagnose(problem, problem.fit, problem.validation, start=problem.start)
    assert found.names == () and found.base["speed_delay_s"] == pytest.approx(
        delay_s, abs=2e-4
    )
    assert (
        "speed_delay_s" not in found.at_bound
    )  # absent is no end of a range that says anything


def test_a_payload_off_its_place_is_said_with_the_way_out_and_is_nothing_of_the_twin():
    case = draw_case((), 30038, design="pack")
    found = diagnose_joint(
        case.twin, case.signal, recordings(case, "pack"), gains="fitted"
    )
    (remark,) = [r for r in found.diagnosis.remarks if "payload" in r]
    assert "5.2 mm" in remark and "payload_position_m" in remark
    assert PiperTwin(case.twin).mended([found])[0].config.effects == case.twin.effects


def test_validation_rows_without_a_measurement_are_refused():
    whole = recorded(NOMINAL, CHIRP, 0)
    alone = dataclasses.replace(whole, measured=whole.measured.copy())
    alone.measured[len(alone.measured) // 2 :, alone.column(SIGNAL)] = np.nan
    with pytest.raises(
        TaccorlError, match="nothing was measured in the validation rows"
    ):
        diagnose_joint(NOMINAL, SIGNAL, Measurements((alone,)))


@pytest.mark.slow
def test_dry_friction_and_a_late_command_are_found_together():
    """As in the pairs of docs/diagnosis.md."""
    case = draw_case(
        ("coulomb_friction", "command_delay"),
        51000,
        design="pack",
        sampled=True,
        coloured=True,
    )
    problem = problem_of(case, effort=True, design="pack")
    found = diagnose(
        problem, problem.fit, problem.validation, problem.test, start=problem.start
    )
    assert {"coulomb_friction", "command_delay"} <= {*found.names}
    assert (
        found.errors["after"]["validation"] < 1.3 < found.errors["fitted"]["validation"]
    )


def test_a_speed_earlier_than_its_effect_allows_is_simulated_at_the_end_of_its_range(
    chirps,
):
    """−4.2 ms, as −1.2 ms less half of a loop of 6 ms; the effect goes to −3 ms."""
    problem = JointProblem(NOMINAL, SIGNAL, Measurements(chirps))
    early, end = (
        problem.simulate(problem.start | {"speed_delay_s": s}, [], problem.fit[0])
        for s in (-4.2e-3, -3e-3)
    )
    np.testing.assert_array_equal(early, end)
