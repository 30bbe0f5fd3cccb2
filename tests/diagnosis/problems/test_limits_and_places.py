"""Limits and places that a joint may have, hidden in motion that this file integrates itself, and found by the search.

A joint of 0.05 kg m² with a drive of 40 N·m/rad and 1.5 N·m·s/rad, in steps of 0.1 ms; the twin's model takes steps of 0.42 ms.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
from axes import axis_of, problem_of
from simulated_slide import logged, one_round

from taccorl.alignment.controller.drive_numbers import Drive
from taccorl.alignment.controller.joint_kernel import simulate
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.search.result import Diagnosis
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.command import uniform
from taccorl.sim.twin import TwinConfig

INERTIA, KP, KD = 0.05, 40.0, 1.5
RATE_HZ, PARTS, NOISE_RAD = 200, 50, 1e-3
AXIS = axis_of(name="joint", unit="rad", inertia=INERTIA, kp=KP, kd=KD)
NEW = ("torque_speed_limit", "position_dependent_friction", "end_stop")


def free(torque: float, q: float, v: float) -> float:
    """(motor's torque, angle, speed) → what acts on the joint."""
    return torque


def frictionless(q: float) -> float:
    return 0.0


def recorded(
    name: str,
    target: np.ndarray,
    seed: int,
    acting: Callable[[float, float, float], float] = free,
    friction: Callable[[float], float] = frictionless,
    repeat_of: str | None = None,
) -> Measurement:
    """Semi-implicit Euler; dry friction takes away at most the speed that there is."""
    dt_s, q, v, goal = 1.0 / (RATE_HZ * PARTS), float(target[0]), 0.0, float(target[0])
    measured = np.empty(len(target))
    for k, following in enumerate(target.tolist()):
        measured[k] = q
        goal = following
        for _ in range(PARTS):
            wish = v + dt_s * acting(KP * (goal - q) - KD * v, q, v) / INERTIA
            stops = dt_s * friction(q) / INERTIA
            v = 0.0 if abs(wish) <= stops else wish - math.copysign(stops, wish)
            q += dt_s * v
    measured += NOISE_RAD * np.random.default_rng(seed).standard_normal(len(target))
    time_s = np.arange(len(target)) / RATE_HZ
    return logged(
        name,
        ("joint",),
        ("rad",),
        repeat_of,
        time_s=time_s,
        target=target,
        measured=measured,
    )


def steps(*levels: float) -> np.ndarray:
    """Half a second each, from rest at the first."""
    return np.repeat(levels, RATE_HZ // 2)


def sweep(amplitude: float, hz: float, seconds: float = 3.0) -> np.ndarray:
    """After a rest of a quarter of a second."""
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ - 0.25
    return (
        amplitude
        * np.clip(time_s, 0.0, 0.5)
        * 2.0
        * np.sin(2 * np.pi * hz * np.maximum(time_s, 0.0))
    )


def found_in(
    fit: tuple[np.ndarray, np.ndarray],
    validation: np.ndarray,
    *,
    acting: Callable[[float, float, float], float] = free,
    friction: Callable[[float], float] = frictionless,
) -> Diagnosis:
    """What the search finds in two motions, the second one recorded twice, judged on a third."""
    first, second = fit
    made = Measurements(
        (
            recorded("one", first, 1, acting, friction),
            recorded("two", second, 2, acting, friction),
            recorded("again", second, 3, acting, friction, repeat_of="two"),
        ),
        (recorded("validation", validation, 4, acting, friction),),
    )
    return one_round(
        AXIS, made, {*effects} - {"cogging"}
    )  # a hundred probes that no test here is about


def test_without_anything_hidden_nothing_is_missing() -> None:
    said = found_in((sweep(0.5, 0.6), steps(0.0, 0.4, -0.4, 0.0)), sweep(0.4, 0.9))
    assert said.status == "nothing_missing", said.errors


LIMITED = (
    (steps(0.0, 0.9, -0.6, 1.2, 0.0), sweep(0.8, 1.2)),
    steps(0.0, -0.9, 0.5, 1.1, 0.2),
)


def torque_speed_line(torque: float, q: float, v: float) -> float:
    """5 N·m at a stand, none at 6 rad/s; braking 5 N·m. The steps ask for 60 N·m and would reach 20 rad/s."""
    most = 5.0 * max(1.0 - abs(v) / 6.0, 0.0) if torque * v > 0 else 5.0
    return math.copysign(min(abs(torque), most), torque)


@pytest.mark.slow
def test_a_torque_that_falls_with_the_speed_is_found_with_its_two_numbers() -> None:
    said = found_in(*LIMITED, acting=torque_speed_line)
    assert said.names == ("torque_speed_limit",) and said.status == "at_floor", (
        said.errors
    )
    assert said.after.values["torque_speed_limit.stall_nm"] == pytest.approx(
        5.0, rel=0.03
    )
    assert said.after.values["torque_speed_limit.no_load_rad_per_s"] == pytest.approx(
        6.0, rel=0.03
    )


WIDE = ((sweep(1.0, 0.4, 4.0), sweep(0.8, 0.9)), sweep(0.9, 0.55, 4.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("angle_rad", "width_rad"),
    [(0.45, 0.06), pytest.param(-0.3, 0.25, marks=pytest.mark.slow)],
)
def test_a_tight_spot_is_found_where_it_is_and_as_wide_as_it_is(
    angle_rad: float, width_rad: float
) -> None:
    said = found_in(
        *WIDE, friction=lambda q: 1.5 * math.exp(-(((q - angle_rad) / width_rad) ** 2))
    )
    assert (
        said.names == ("position_dependent_friction",) and said.status == "at_floor"
    ), said.errors
    values = {
        k.split(".")[1]: v
        for k, v in said.after.values.items()
        if k.startswith("position")
    }
    assert values["angle_rad"] == pytest.approx(angle_rad, abs=0.1 * width_rad)
    assert values["width_rad"] == pytest.approx(width_rad, rel=0.15)
    assert values["torque_nm"] == pytest.approx(1.5, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("share", "phase_rad"),
    [(0.6, -0.8), pytest.param(0.9, 0.4, marks=pytest.mark.slow)],
)
def test_friction_that_swells_twice_a_turn_is_a_wide_spot(
    share: float, phase_rad: float
) -> None:
    # F (1 + a cos(2q + φ)): the surrogate's kind "angle_friction", which is no Gaussian. cos² x ≈ exp(−x²).
    said = found_in(
        *WIDE, friction=lambda q: 0.6 * (1.0 + share * math.cos(2.0 * q + phase_rad))
    )
    assert said.names == ("position_dependent_friction",)
    assert said.status == "at_floor", said.errors
    assert said.after.values["position_dependent_friction.angle_rad"] == pytest.approx(
        -0.5 * phase_rad, abs=0.15
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("angle_rad", "stiffness"),
    [(-0.5, 60.0), pytest.param(0.6, 400.0, marks=pytest.mark.slow)],
)
def test_an_end_stop_is_found_on_either_side(
    angle_rad: float, stiffness: float
) -> None:
    side = math.copysign(1.0, angle_rad)

    def stopped(torque: float, q: float, v: float) -> float:
        deep, rate = side * (q - angle_rad), side * v
        return torque - side * max(stiffness * (deep + 0.005 * rate), 0.0) * (deep > 0)

    said = found_in(*WIDE, acting=stopped)
    assert said.names == ("end_stop",)
    assert said.status == "at_floor", said.errors
    assert said.after.values["end_stop.angle_rad"] == pytest.approx(
        angle_rad, abs=0.005
    )
    assert said.after.values["end_stop.stiffness_nm_per_rad"] == pytest.approx(
        stiffness, rel=0.05
    )


def test_lost_commands_are_no_candidate_of_a_search_and_stay_in_a_twin_that_has_them() -> (
    None
):
    axis = problem_of(AXIS, Measurements((recorded("one", sweep(0.5, 0.6), 1),)))
    assert "dropped_commands" not in axis.candidates
    assert set(NEW) <= axis.candidates.keys()
    dropping = make_effect(
        "dropped_commands", probability=0.2, arm="left", joints=["joint5"]
    )
    home = np.zeros((600, 14))
    home[:, [1, 8]], home[:, [2, 9]] = 1.5, -1.0
    home[:, 4] = sweep(0.3, 0.8)
    seen = home + 1e-4 * np.random.default_rng(0).standard_normal(home.shape)
    m = Measurement(
        name="one", time_s=np.arange(600) / RATE_HZ, target=home, measured=seen
    )
    plain, with_drops = (
        JointProblem(TwinConfig(effects=have), "left_joint5", Measurements((m,)))
        for have in ([], [dropping])
    )
    assert with_drops.present == ()
    assert "dropped_commands" not in with_drops.candidates
    assert set(NEW) <= with_drops.candidates.keys()
    apart = [p.simulate(p.start, [], p.fit[0])[:, 0] for p in (plain, with_drops)]
    assert np.abs(apart[0] - apart[1]).max() > 1e-4


def test_the_compiled_model_loses_the_commands_that_the_twin_loses() -> None:
    sent = np.arange(300) * 0.01
    drive = Drive(
        100.0,
        10.0,
        0.0,
        0.01,
        dropped_commands__probability=0.3,
        dropped_commands__seed=7.0,
    )
    arrives = uniform(7, np.zeros(300), np.arange(300)) >= 0.3
    held, now = np.empty(300), 0.0
    for k in range(300):
        now = sent[k] if arrives[k] else now
        held[k] = now
    assert 0.25 < 1.0 - arrives.mean() < 0.35
    none, ones = np.zeros(300), np.ones(300)
    more = (none, none, ones, ones, none, 0.0, 6, 1, 1 / 1200, 0.0)
    without = drive._replace(dropped_commands__probability=0.0)
    np.testing.assert_array_equal(
        simulate(drive, sent, *more)[0], simulate(without, held, *more)[0]
    )


def test_effects_that_are_no_candidates_are_few_and_known() -> None:
    assert [name for name in effects if not effects.get(name).fitted] == [
        "dropped_commands",
        "speed_delay",
    ]
