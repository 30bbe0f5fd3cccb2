"""Control laws of an axis against this test's own integration of their equations (10 µs steps), not the kernel's."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from axes import altered, axis_answer, axis_motion, axis_of, config_of, joint_of
from made_rows import of_signal

from taccorl.alignment.controller.joint_model import JointModel, JointResponse
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.measurements.measurement import Measurement, TargetKind
from taccorl.errors import TaccorlError

RATE_HZ, DT_S = 200, 1e-5
WINDING: dict[str, Any] = {
    "supply_v": 12.0,
    "resistance_ohm": 4.0,
    "torque_nm_per_a": 1.0,
    "emf_v_s_per_rad": 1.1,
}
SERVO = axis_of(
    name="servo", unit="rad", inertia=0.02, law="pwm", kp=6.0, lever_m=0.15, **WINDING
)


def recording(
    target: np.ndarray, kind: TargetKind = "position", payload_kg: float = 0.0
) -> Measurement:
    more = {"target_kinds": (kind,), "payload_kg": {"servo": payload_kg}}
    return of_signal("made", RATE_HZ, target, np.zeros(len(target)), "servo", **more)


def answer(axis: Robot, m: Measurement) -> JointResponse:
    return axis_answer(axis, axis_motion(axis, m))


def integrated(
    target: np.ndarray, torque, inertia: float, weight_nm: float = 0.0
) -> np.ndarray:
    """(T,) position of inertia · q̈ = torque(target, q, v) − weight sin q from rest at 0, targets held."""
    q = v = 0.0
    found = []
    for goal in target.tolist():
        found.append(q)
        for _ in range(round(1 / (RATE_HZ * DT_S))):
            v += DT_S * (torque(goal, q, v) - weight_nm * math.sin(q)) / inertia
            q += DT_S * v
    return np.array(found)


def test_a_pwm_servo_with_a_pendulum_clips_its_duty_and_loses_the_back_emf():
    """τ = k_t (V d − k_e q̇) / R, d = kp (q* − q) within ± 1: at a step of 0.8 rad d is clipped, and the speed is k_e's."""
    target = np.where(np.arange(400) < 10, 0.0, 0.8)

    def torque(goal: float, q: float, v: float) -> float:
        return (12.0 * min(max(6.0 * (goal - q), -1.0), 1.0) - 1.1 * v) / 4.0

    inertia, weight = 0.02 + 0.3 * 0.15**2, 0.3 * 9.81 * 0.15
    truth = integrated(target, torque, inertia, weight)
    m = recording(target, payload_kg=0.3)
    found = answer(SERVO, m)
    assert np.abs(found.reported - truth).max() < 2e-4  # the model's steps are 1 ms
    # At the end it stands: 12 V · kp · e / R holds the weight.
    assert 3.0 * 6.0 * (0.8 - found.reported[-1]) == pytest.approx(
        weight * math.sin(found.reported[-1]), rel=0.03
    )
    assert found.effort[-1] == pytest.approx(
        weight * math.sin(found.reported[-1]), rel=0.03
    )
    stiff = altered(SERVO, emf_v_s_per_rad=1e-6)
    assert np.abs(answer(stiff, m).reported - truth).max() > 0.05, (
        "without back-EMF it is much faster"
    )


def sampled(
    target: np.ndarray,
    axis: Robot,
    filter_s: float = 0.0,
    dead: float = 0.0,
    gain: float = 1.0,
) -> np.ndarray:
    """(T,) position of an axis of law impedance or pwm whose loop of ``loop_hz`` computes its speed from two readings, smooths it
    over ``filter_s`` and holds its output; ``dead``: half the dead band [rad], ``gain``: factor on negative torques."""
    config = config_of(axis)
    every, clips = round(1.0 / (config.loop_hz or 1.0) / DT_S), config.law == "pwm"
    most = config.stall_nm if clips else math.inf
    state = {"n": 0, "seen": 0.0, "speed": 0.0, "asked": 0.0}

    def torque(goal: float, q: float, v: float) -> float:
        if state["n"] % every == 0:
            fresh = (q - state["seen"]) * (config.loop_hz or 1.0)
            share = 1.0 - math.exp(-every * DT_S / filter_s) if filter_s else 1.0
            state["speed"] += share * (fresh - state["speed"])
            error = math.copysign(max(abs(goal - q) - dead, 0.0), goal - q)
            asked = config.loop_gains.kp * error - config.loop_gains.kd * state["speed"]
            state.update(seen=q, asked=min(max(asked, -most), most))
        state["n"] += 1
        drawn = state["asked"] - config.back_emf * v
        return drawn * (gain if drawn < 0.0 else 1.0)

    return integrated(target, torque, config.inertia)


QUICK = altered(SERVO, kd=0.1, loop_hz=1000.0, lever_m=0.0)
ARM = axis_of(name="servo", unit="rad", inertia=0.002, kp=3.0, kd=0.08, loop_hz=1000.0)


@pytest.mark.parametrize(
    ("axis", "filter_s", "late_s", "effect", "most"),
    [
        (QUICK, 0.0, 0.0, {}, 3e-4),
        (
            QUICK,
            3e-3,
            2.53e-3,
            {},
            8e-4,
        ),  # the mean age of the filter's readings is 1 ms · e⁻⅓ / (1 − e⁻⅓)
        (QUICK, 0.0, 0.0, {"dead": 0.02}, 8e-4),
        (ARM, 0.0, 0.0, {"gain": 0.7}, 6e-4),
    ],
)
def test_a_sampled_loop_damps_late_only_what_its_duty_and_its_direction_leave(
    axis, filter_s, late_s, effect, most
):
    """Steps. At the end of the duty only the back-EMF damps, at once; a gain of one direction is that of the damping, too; a
    target that leaves a dead band acts at once."""
    target = np.select(
        [np.arange(400) < k for k in (20, 100, 180, 300)], [0.0, 0.8, -0.3, -0.25], 0.5
    )
    truth = sampled(target, axis, filter_s, **effect)
    own = [
        ("error_deadband", "width_rad", "dead"),
        ("direction_gain", "factor", "gain"),
    ]
    entries = tuple((name, {p: effect[k]}) for name, p, k in own if k in effect)
    found = answer(
        altered(axis, speed_late_s=late_s, effects=entries), recording(target)
    )
    assert np.abs(found.reported - truth).max() < most, np.abs(
        found.reported - truth
    ).max()


def test_a_target_that_acts_between_two_rows_has_the_effort_of_its_own_period_of_the_loop():
    """The drive's loop runs at 2 kHz, a row is logged every 1 ms, and its target acts 1.5 ms later. Its effort is that of the
    loop period before it. The model's effort is off by 0.006 N·m with steps of one loop period (0.5 ms), and by 0.29 N·m with
    steps of 1 ms, in which old and new target are averaged. A fitted loop rate must not change the step."""
    axis = axis_of(
        name="servo",
        unit="rad",
        inertia=0.04,
        kp=40.0,
        kd=2.0,
        loop_hz=2000.0,
        target_late_s=1.5e-3,
    )
    target = 0.3 * np.sin(
        2 * np.pi * (2.0 + 8.0 * np.arange(800) / 800) * np.arange(800) / 1000
    )
    q = v = seen = asked = 0.0
    efforts = []
    for n in range(1600):
        efforts += [asked] * (n % 2 == 0)
        goal = float(target[(n - 3) // 2]) if n >= 3 else 0.0
        seen, asked = q, 40.0 * (goal - q) - 2.0 * (q - seen) * 2000.0
        for _ in range(50):
            v += DT_S * asked / 0.04
            q += DT_S * v
    m = of_signal("made", 1000, target, np.zeros(800), "servo")
    joint, fitted = (
        joint_of(axis),
        joint_of(altered(axis, loop_hz=None)).with_values({"loop_s": 1 / 2000}),
    )
    motion = motion_of(m, "servo", joint)
    assert joint.timestep_s(motion) == pytest.approx(5e-4) and fitted.timestep_s(
        motion
    ) == pytest.approx(1e-3)
    off = [
        np.std(JointModel(j).simulate(motion, j.gains).effort - efforts)
        for j in (joint, fitted)
    ]
    assert off[0] < 0.02 and off[1] > 0.1


def test_a_velocity_loop_reaches_its_velocity_as_a_lag_of_inertia_over_gain():
    """J q̈ = kd (v* − q̇): q = v* (t − T (1 − e^(−t/T))), T = J / kd = 0.1 s."""
    axis = axis_of(name="servo", unit="rad", inertia=0.02, law="velocity", kd=0.2)
    time_s = np.arange(200) / RATE_HZ
    found = answer(axis, recording(np.full(200, 1.5), "velocity"))
    np.testing.assert_allclose(
        found.reported, 1.5 * (time_s - 0.1 * (1 - np.exp(-time_s / 0.1))), atol=3e-3
    )


def test_an_integral_of_a_cascade_adds_up_the_error_of_its_speed():
    """τ = kd (u + r ∫ u dt), u = kp (q* − q) − q̇. At rest it balances a spring of 2 N·m/rad at the target."""
    numbers = {
        "integral_action": {"rate_per_s": 15.0},
        "cable_spring": {"stiffness_nm_per_rad": 2.0, "rest_rad": 0.0},
    }
    axis = axis_of(
        name="servo", unit="rad", inertia=0.08, law="cascade", kp=25.0, kd=4.0
    )
    axis = altered(axis, effects=tuple(numbers.items()))
    target, total = np.where(np.arange(400) < 10, 0.0, 0.3), np.zeros(1)

    def torque(goal: float, q: float, v: float) -> float:
        total[0] += DT_S * (25.0 * (goal - q) - v)
        return 4.0 * (25.0 * (goal - q) - v + 15.0 * total[0]) - 2.0 * q

    found = answer(axis, recording(target))
    assert np.abs(found.reported - integrated(target, torque, 0.08)).max() < 1e-4
    assert found.reported[-1] == pytest.approx(0.3, abs=1e-3) and found.effort[
        -1
    ] == pytest.approx(0.6, rel=0.01)
    dry = ("coulomb_friction", {"torque_nm": 0.5})
    axis = altered(axis, effects=(*numbers.items(), dry))
    # within the dry friction it begins with any effort
    for seen, given in ((0.3, 0.3), (0.9, 0.5), (np.nan, 0.0)):
        held = answer(
            axis,
            dataclasses.replace(recording(np.zeros(50)), effort=np.full((50, 1), seen)),
        )
        assert held.effort == pytest.approx(np.full(50, given), abs=2e-3)


@pytest.mark.parametrize("speed_rate", [0.0, 15.0])
def test_an_integral_of_the_position_of_a_cascade_is_before_its_speed_loop(
    speed_rate: float,
):
    """τ = kd (u + r_s ∫ u dt), u = kp (e + 3 ∫ e dt) − q̇, alone and beside an integral of u: both hold a spring at the target."""
    axis = axis_of(
        name="servo", unit="rad", inertia=0.08, law="cascade", kp=25.0, kd=4.0
    )
    numbers = {
        "position_integral": {"rate_per_s": 3.0},
        "integral_action": {"rate_per_s": speed_rate},
        "cable_spring": {"stiffness_nm_per_rad": 2.0, "rest_rad": 0.0},
    }
    axis = altered(axis, effects=tuple(numbers.items()))
    target, total = np.where(np.arange(400) < 10, 0.0, 0.3), np.zeros(2)

    def torque(goal: float, q: float, v: float) -> float:
        total[0] += DT_S * (goal - q)
        u = 25.0 * (goal - q + 3.0 * total[0]) - v
        total[1] += DT_S * u
        return 4.0 * (u + speed_rate * total[1]) - 2.0 * q

    found = answer(axis, recording(target))
    assert np.abs(found.reported - integrated(target, torque, 0.08)).max() < 1e-4
    plain = altered(axis, effects=[*numbers.items()][1:])
    assert np.abs(answer(plain, recording(target)).reported - found.reported).max() > (
        1e-3
    )
    others = (SERVO, altered(axis, law="impedance", effects=()))
    assert not any(config_of(law).allows_effect("position_integral") for law in others)


def test_an_integral_of_the_position_adds_up_what_a_sampled_cascade_knows():
    """A loop of 1 kHz: half a period of the newest error is 10 1/s · 0.5 ms = 0.5 % of the target, 1.5 mrad of 0.3 rad."""
    time_s, hz, rate = np.arange(600) / RATE_HZ, 1000, 10.0
    target = 0.3 * np.sin(2 * np.pi * (0.3 + 0.3 * time_s) * time_s)
    q = v = total = torque = before = 0.0
    truth = np.empty(len(target))
    for step in range(len(target) * round(1 / (RATE_HZ * DT_S))):
        row, within = divmod(step, round(1 / (RATE_HZ * DT_S)))
        truth[row] = q if within == 0 else truth[row]
        if step % round(1 / (hz * DT_S)) == 0:
            speed, before = (q - before) * hz, q
            total += (target[row] - q) / hz
            torque = 8.0 * (20.0 * (target[row] - q + rate * total) - speed)
        v += DT_S * torque / 0.08
        q += DT_S * v
    numbers = {"inertia": 0.08, "kp": 20.0, "kd": 8.0, "loop_hz": float(hz)}
    axis = axis_of(name="servo", unit="rad", law="cascade", **numbers)
    axis = altered(axis, effects=[("position_integral", {"rate_per_s": rate})])
    assert np.abs(answer(axis, recording(target)).reported - truth).max() < 1e-4


@pytest.mark.parametrize("law", ["cascade", "velocity"])
def test_an_integral_adds_up_what_the_loop_knows_and_a_row_shows_it_as_old_as_the_rest(
    law,
):
    """A loop of 1 kHz smooths the speed of two readings by a quarter in each period: 1 ms · (1 − ¼) / ¼ = 3 ms late. The sum of
    that speed lacks 20 · 4 N·m/rad · 3 ms = 0.24 N·m·s/rad of damping, 8 … 20 mrad; half a period of the newest error 1 … 2 mrad,
    and 0.04 … 0.07 N·m of a row's effort."""
    time_s, hz, rate = np.arange(600) / RATE_HZ, 1000, 20.0
    wave = 0.3 * np.sin(2 * np.pi * (0.3 + 0.4 * time_s) * time_s)
    target = wave if law == "cascade" else np.gradient(wave, time_s)
    q = v = late = total = torque = before = 0.0
    truth, effort = np.empty((2, len(target)))
    for step in range(len(target) * round(1 / (RATE_HZ * DT_S))):
        row, within = divmod(step, round(1 / (RATE_HZ * DT_S)))
        truth[row], effort[row] = (
            (q, torque) if within == 0 else (truth[row], effort[row])
        )
        if step % round(1 / (hz * DT_S)) == 0:
            late, before = late + 0.25 * ((q - before) * hz - late), q
            error = (
                8.0 * (target[row] - q) if law == "cascade" else target[row]
            ) - late
            total += error / hz
            torque = 4.0 * (error + rate * total)
        v += DT_S * torque / 0.08
        q += DT_S * v
    gains, kind = (
        ({"kp": 8.0, "kd": 4.0}, "position") if law == "cascade" else ({"kd": 4.0}, law)
    )
    effect = ("integral_action", {"rate_per_s": rate})
    axis = axis_of(
        name="servo",
        unit="rad",
        inertia=0.08,
        law=law,
        **gains,
        loop_hz=hz,
        speed_late_s=3e-3,
    )
    found = answer(altered(axis, effects=(effect,)), recording(target, kind))
    assert np.abs(found.reported - truth).max() < 2e-4, np.abs(
        found.reported - truth
    ).max()
    assert np.median(np.abs(found.effort - effort)) < 5e-3, np.median(
        np.abs(found.effort - effort)
    )


def test_a_torque_accelerates_and_none_lets_the_axis_coast():
    """0.01 N·m on 0.02 kg·m² for 0.5 s: 0.0625 rad and 0.25 rad/s, kept with the motor off."""
    axis = axis_of(name="servo", unit="rad", inertia=0.02, law="torque")
    target = np.where(np.arange(200) < 100, 0.01, 0.0)
    found = answer(axis, recording(target, "torque")).reported
    assert found[100] == pytest.approx(0.0625, rel=0.01)
    assert found[-1] == pytest.approx(0.0625 + 0.25 * 99 / RATE_HZ, rel=0.01)


def test_torques_of_an_outer_loop_are_replayed_near_the_measured_position_and_friction_shows():
    """Commands of kp 2, kd 0.2 beside 0.005 N·m that the model lacks: alone they are 0.06 mrad with K = (20 π)² · 0.02, and drift
    else. Friction of 0.05 N·m is ten times as much. The spring is no effort of the motor."""
    axis, goals = (
        axis_of(name="servo", unit="rad", inertia=0.02, law="torque"),
        0.4 * np.sin(np.arange(800) / 60),
    )
    for friction_nm, least, most in ((0.0, 0.0, 2e-4), (0.05, 4e-4, 1.5e-3)):
        q = v = 0.0
        rows = list[tuple[float, float]]()
        for goal in goals.tolist():
            rows.append((q, asked := 2.0 * (goal - q) - 0.2 * v))
            for _ in range(500):
                v += DT_S * (asked - 0.005 - friction_nm * ((v > 0) - (v < 0))) / 0.02
                q += DT_S * v
        measured, torques = np.array(rows).T
        made = {"target_kinds": ("torque",), "effort": torques}
        free, held = (
            of_signal("m", RATE_HZ, torques, measured, "servo", held=x, **made)
            for x in (False, True)
        )
        assert np.abs(answer(axis, free).reported - measured).max() > 0.1
        found = answer(axis, held)
        assert least < np.sqrt(np.mean((found.reported - measured) ** 2)) < most
        assert found.effort[1:] == pytest.approx(torques[:-1])


def test_a_servo_falls_freely_while_it_is_off_and_gets_the_voltage_that_was_recorded():
    """Off from 0.5 to 0.9 s: no duty, no back-EMF. Else the supply falls from 12 to 8 V: duty · 8 / 12, back-EMF as before.
    A row reads what its motor got until then."""
    rows = np.arange(400)
    target, off = np.where(rows < 10, 0.0, 0.8), (rows >= 100) & (rows < 180)
    volts = np.where(rows < 50, 12.0, 8.0)
    inertia, weight = 0.02 + 0.3 * 0.15**2, 0.3 * 9.81 * 0.15

    def torque(k: int, q: float, v: float) -> float:
        duty = min(max(6.0 * (target[k] - q), -1.0), 1.0)
        return 0.0 if off[k] else (volts[k] * duty - 1.1 * v) / 4.0

    truth = integrated(rows, torque, inertia, weight)
    m = dataclasses.replace(
        recording(target, payload_kg=0.3),
        supply_v=np.append(12.0, volts[:-1])[:, None],
        enabled=np.where(off, 0.0, 1.0)[:, None],
    )
    assert np.abs(answer(SERVO, m).reported - truth).max() < 5e-4
    assert answer(SERVO, m).effort[off] == pytest.approx(np.zeros(80))
    with pytest.raises(
        TaccorlError, match=r"made:.*supply voltage.*servo.*stated,.*law torque.*use"
    ):
        torque_axis = axis_of(name="servo", unit="rad", inertia=0.02, law="torque")
        answer(
            torque_axis, dataclasses.replace(m, target_kinds=("torque",), payload_kg={})
        )


def test_targets_act_at_their_own_times_and_late_by_what_the_file_states():
    """J q̈ = τ from rest: 0.01 N·m from 0.1037 s on give τ t² / 2 J. The row is at 0.1 s; its target came
    2.2 ms later, and the file states 1.5 ms."""
    axis = axis_of(
        name="servo", unit="rad", inertia=0.02, law="torque", target_late_s=1.5e-3
    )
    time_s = np.arange(200) / RATE_HZ
    target = np.where(time_s < 0.0999, 0.0, 0.01)
    m = dataclasses.replace(recording(target, "torque"), command_s=time_s + 2.2e-3)
    truth = 0.5 * 0.5 * np.clip(time_s - 0.1037, 0.0, None) ** 2
    np.testing.assert_allclose(answer(axis, m).reported, truth, atol=2e-7)


def test_a_torque_that_the_controller_adds_moves_the_axis_and_is_in_its_effort():
    """J = 0.02: 0.01 N·m from 0.5 s on beside a velocity loop whose target is 0: q̇ → 0.01 / 0.2 rad/s, and no effort is left."""
    axis = axis_of(name="servo", unit="rad", inertia=0.02, law="velocity", kd=0.2)
    m = recording(np.zeros(200), "velocity")
    added = np.where(np.arange(200) < 100, 0.0, 0.01)[:, None]
    found = answer(axis, dataclasses.replace(m, torque_ff=added))
    assert np.diff(found.reported)[-1] * RATE_HZ == pytest.approx(0.05, rel=0.02)
    assert (
        found.effort[101] == pytest.approx(0.01, rel=0.06)
        and abs(found.effort[-1]) < 2e-4
    )


def test_the_effort_of_a_row_is_before_its_target_or_after_it_as_the_file_says():
    """At rest 18 N·m/rad times a step of 0.01 rad: 0.18 N·m in the step's row, or in the next."""
    m = recording(np.where(np.arange(50) < 20, 0.0, 0.01))
    before, after = (
        answer(altered(SERVO, effort_after_target=own), m).effort[19:21]
        for own in (False, True)
    )
    assert before == pytest.approx([0.0, 0.0]) and after == pytest.approx([0.0, 0.18])


def test_a_recording_s_own_lever_and_arm_are_those_of_its_pendulum():
    """0.3 kg at 0.2 m on a rod of 0.06 kg: J + 0.3 · 0.04 + 0.06 · 0.04 / 3 kg·m², and 9.81 (0.06 + 0.006) N·m at 90°."""
    m = dataclasses.replace(
        recording(np.zeros(50), payload_kg=0.3),
        lever_m={"servo": 0.2},
        arm_kg={"servo": 0.06},
    )
    axis = joint_of(SERVO)
    rigid = axis.rigid(motion_of(m, "servo", axis), [])
    assert rigid.inertia == pytest.approx(0.02 + 0.012 + 0.0008)
    assert (rigid.gravity_sin, rigid.gravity_cos) == pytest.approx((9.81 * 0.066, 0.0))
    stated = joint_of(altered(SERVO, payload_kg=0.3, lever_m=0.2, arm_kg=0.06))
    always = dataclasses.replace(recording(np.zeros(50)), payload_kg={})
    assert stated.rigid(motion_of(always, "servo", stated), []) == rigid
    nowhere = joint_of(altered(SERVO, lever_m=0.0))
    with pytest.raises(
        TaccorlError,
        match=r"made: payload_kg or arm_kg of servo is stated.*write `lever_m",
    ):
        motion_of(recording(np.zeros(50), payload_kg=0.3), "servo", nowhere)


def test_a_gain_s_register_is_worth_its_factor():
    """800 steps of 0.0075 / rad are 6 / rad: 18 N·m/rad at 12 V, 4 Ω and 1 N·m/A."""
    register = config_of(altered(SERVO, kp=800.0, kp_factor=0.0075))
    assert register.loop_gains == pytest.approx(config_of(SERVO).loop_gains)
    assert config_of(SERVO).loop_gains.kp == pytest.approx(18.0)
    fitted = axis_of(
        name="servo",
        unit="rad",
        inertia=0.02,
        kp=400.0,
        kp_factor=0.02,
        kd=10.0,
        kd_factor=0.1,
    )
    again = config_of(fitted).with_numbers({"kp": 9.0, "kd": 1.1})
    assert (again.kp, again.kd) == pytest.approx((450.0, 11.0)), (
        "the file keeps its register's steps"
    )


def test_a_target_that_the_law_does_not_take_is_refused():
    with pytest.raises(
        TaccorlError, match=r"servo.*commanded by velocity,.*law.*position;.*q_target"
    ):
        answer(SERVO, recording(np.zeros(50), "velocity"))


def test_targets_of_the_rate_of_the_rows_are_held_although_stamps_are_rounded():
    """60 Hz with stamps of 0.1 ms: 239 steps in 3.9834 s are 59.999 Hz, and command_hz 60 is no faster than that."""
    target = 0.2 * np.sin(2 * np.pi * np.arange(240) / 60)
    m = dataclasses.replace(recording(target), time_s=np.linspace(0.0, 3.9834, 240))
    assert 59.9 < m.rate_hz < 60.0
    held, stated, faster = (
        answer(altered(SERVO, command_hz=hz), m).reported for hz in (None, 60.0, 120.0)
    )
    np.testing.assert_array_equal(held, stated)
    assert np.abs(faster - held).max() > 1e-3
