"""The delay of a sampled loop and the place of a payload: fitted beside the gains, so that no effect is blamed for them."""

import dataclasses

import numpy as np
import pytest
from imagined_motions import NOISE_RAD, SIGNAL, recorded

from taccorl.alignment.controller.arm_bench import AT_TCP
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.motions import CHIRP, STIFFER_CHIRP, VALIDATION, WIDE_TRIANGLE
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.problems.joints import diagnose_joint, set_numbers
from taccorl.diagnosis.search.fit import FINE, fit, moved_by
from taccorl.diagnosis.search.search import diagnose
from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.drive import SpeedDelay
from taccorl.sim.twin import TwinConfig
from taccorl.surrogate.cases import Case, draw_case
from taccorl.surrogate.recordings import recordings

NOMINAL = TwinConfig()


def problem_of(case: Case, *, effort: bool = False, design: str = "chirp") -> JointProblem:
    return JointProblem(case.twin, case.signal, recordings(case, design), gains="fitted", effort=effort)


def test_the_delay_is_fitted_where_something_tells_it_from_the_gains():
    def base(measurement, gains="fitted", effort=False):
        problem = JointProblem(NOMINAL, SIGNAL, Measurements((measurement,)), gains=gains, effort=effort)
        return "speed_delay_s" in [f.name for f in problem.base]

    chirp = recorded(NOMINAL, CHIRP, 0, effort=True)
    assert not base(chirp), "positions alone: all torques scale with it"
    assert base(chirp, effort=True)
    assert base(chirp, gains="auto"), "commanded gains"
    assert base(recorded(NOMINAL, dataclasses.replace(WIDE_TRIANGLE, payload_kg=0.5), 1)), "known weight that shows"


def test_a_sampled_loop_with_a_known_weight_is_no_effect_and_its_gains_are_found():
    """A clean surrogate: 4 kHz, a filter of 0.9 ms; 1.2 ms late in all. Without the delay, gravity_mismatch is found."""
    case = draw_case((), 30015, design="chirp", sampled=True, loaded=True)
    problem = problem_of(case)
    found = diagnose(problem, problem.fit, problem.validation, problem.test, start=problem.start)
    assert found.status == "nothing_missing"
    low, high = found.after.intervals()["speed_delay_s"]
    assert low < case.loop.late_s < high
    assert high - low < 1e-3
    low, high = found.after.intervals()["kp"]
    assert low < case.values()["kp"] < high
    assert high / low < 1.05
    new = TwinConfig()
    set_numbers(new, case.signal, found.base, found.intervals)
    (effect,) = new.effects
    assert isinstance(effect, SpeedDelay)
    assert effect.acts_on() == [case.signal]
    assert effect.delay_s == found.base["speed_delay_s"]


@pytest.mark.parametrize("seed", [213514, *(pytest.param(k, marks=pytest.mark.slow) for k in (213505, 213516))])
def test_a_sampled_loop_that_efforts_show_is_no_effect(seed: int):
    """500 Hz: the torque in force is of positions and targets newer than the reported one, which looked like an encoder_scale.
    4 kHz and 1.6 kHz with K_d (T + τ) of 1.08 and 0.62 times the inertia: a torque_lag, a velocity_feedforward."""
    problem = problem_of(draw_case((), seed, design="chirp", sampled=True), effort=True)
    found = diagnose(problem, problem.fit, problem.validation, problem.test, start=problem.start)
    assert found.status == "nothing_missing" and max(found.errors["after"].values()) < 1.2


def test_a_twin_that_has_the_delay_starts_from_it_and_has_it_once():
    twin = TwinConfig(effects=[make_effect("speed_delay", arm="left", joints=["joint5"], delay_s=2e-3)])
    made = Measurements((recorded(twin, CHIRP, 0, effort=True),))
    problem, bare = (JointProblem(config, SIGNAL, made, effort=True) for config in (twin, NOMINAL))
    assert problem.start["speed_delay_s"] == 2e-3
    start = problem.start | {"speed_delay_s": 0.0}
    np.testing.assert_array_equal(*(p.simulate(start, [], problem.fit[0]) for p in (problem, bare)))


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
        problem = JointProblem(NOMINAL, signal, Measurements((measurement,)), effort=False)
        return [f.name for f in problem.base if f.name.startswith("payload")]

    assert levers(unstated) == ["payload_sin_m", "payload_cos_m"]
    assert levers(stated) == []
    assert levers(unstated, "left_joint1") == []  # its axis is vertical


def test_an_effort_s_floor_is_at_least_what_no_smooth_curve_explains():
    """Twice the gain is twice the noise of K_p (q* − q); other recordings do not show it."""
    plain = tuple(recorded(NOMINAL, CHIRP, k, effort=True) for k in range(2))
    stiff = recorded(NOMINAL, STIFFER_CHIRP, 2, effort=True)
    rng = np.random.default_rng(0)
    noisy = dataclasses.replace(stiff, effort=stiff.effort + rng.normal(0.0, 0.5, stiff.effort.shape))
    problem = JointProblem(NOMINAL, SIGNAL, Measurements((*plain, noisy)), effort=True)
    assert problem.fit[2].floor[1] == pytest.approx(0.5, rel=0.2)
    assert problem.fit[0].floor[1] < 0.1
    assert problem.fit[2].floor[0] == pytest.approx(NOISE_RAD, rel=0.3)


def test_intervals_widen_by_what_the_other_recordings_would_move():
    """Torque of rest: θ from recordings that differ in it. Both have as many rows, so all together would fit half-way."""
    one, other = (TwinConfig() for _ in range(2))
    set_numbers(one, SIGNAL, {"torque_ff": 1.0}, {})
    set_numbers(other, SIGNAL, {"torque_ff": 1.2}, {})
    here, there = (recorded(twin, CHIRP, k) for k, twin in enumerate((one, other)))
    problem = JointProblem(NOMINAL, SIGNAL, Measurements((here,), validation=(there,)), effort=False)
    model = fit(problem, problem.fit, (), problem.start, 60, FINE)
    index = [f.name for f in model.frees].index("torque_ff")
    assert model.values["torque_ff"] == pytest.approx(1.0, abs=0.02)
    moved = moved_by(problem, model, problem.fit, problem.validation, np.full(len(model.frees), FINE))
    assert moved[index] == pytest.approx(0.1, abs=0.02)
    wider = dataclasses.replace(model, moved=moved)
    low, high = wider.intervals()["torque_ff"]
    assert low < 0.85
    assert high > 1.15
    assert np.ptp(model.intervals()["torque_ff"]) < 0.1


@pytest.mark.parametrize("delay_s", [0.0, 1e-3, 2.5e-3])
def test_with_commanded_gains_the_delay_is_found_from_a_start_of_zeros(delay_s: float):
    """All numbers start at 0 here: a solver whose first step is as long as its start would not move."""
    late = make_effect("speed_delay", arm="left", joints=["joint5"], delay_s=delay_s)
    twin, robot = TwinConfig(), TwinConfig(effects=[late])
    for one in (twin, robot):  # soft gains leave room for a late speed
        set_numbers(one, SIGNAL, {"kp": 6.0, "kd": 0.6, "torque_ff": 0.0}, {})
    made = [
        recorded(robot, motion, k, effort=True) for k, motion in enumerate((CHIRP, CHIRP, VALIDATION[0], VALIDATION[1]))
    ]
    measurements = Measurements(tuple(made[:2]), validation=tuple(made[2:]))
    problem = JointProblem(twin, SIGNAL, measurements)
    assert problem.commanded
    found = diagnose(problem, problem.fit, problem.validation, start=problem.start)
    assert found.names == ()
    assert found.base["speed_delay_s"] == pytest.approx(delay_s, abs=2e-4)
    assert "speed_delay_s" not in found.at_bound  # absent is no end of a range that says anything


def test_a_payload_off_its_place_is_said_with_the_way_out_and_is_nothing_of_the_twin():
    case = draw_case((), 30038, design="pack")
    found = diagnose_joint(case.twin, case.signal, recordings(case, "pack"), gains="fitted")
    (remark,) = [r for r in found.diagnosis.remarks if "payload" in r]
    assert "5.2 mm" in remark
    assert "payload_position_m" in remark
    assert PiperTwin(case.twin).mended([found])[0].config.effects == case.twin.effects


def test_validation_rows_without_a_measurement_are_refused():
    whole = recorded(NOMINAL, CHIRP, 0)
    alone = dataclasses.replace(whole, measured=whole.measured.copy())
    alone.measured[len(alone.measured) // 2 :, alone.column(SIGNAL)] = np.nan
    with pytest.raises(TaccorlError, match="nothing was measured in the validation rows"):
        diagnose_joint(NOMINAL, SIGNAL, Measurements((alone,)))


@pytest.mark.slow
def test_dry_friction_and_a_late_command_are_found_together():
    """As in the pairs of docs/diagnosis.md."""
    case = draw_case(("coulomb_friction", "command_delay"), 51000, design="pack", sampled=True, coloured=True)
    problem = problem_of(case, effort=True, design="pack")
    found = diagnose(problem, problem.fit, problem.validation, problem.test, start=problem.start)
    assert {"coulomb_friction", "command_delay"} <= {*found.names}
    assert found.errors["after"]["validation"] < 1.3 < found.errors["fitted"]["validation"]
