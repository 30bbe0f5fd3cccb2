"""The compiled one-joint model against MuJoCo, joint by joint and effect by effect, and against the whole twin."""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import mujoco
import numpy as np
import pytest
from made_rows import of_joint, of_signal
from one_joint import HOME, TWIN, AxisJoint, at_rest, chirp
from scipy.linalg import expm

from pipelines.benchmarks.one_joint import in_mujoco
from taccorl.alignment.controller import arm_joint, joint_model
from taccorl.alignment.controller.drive_numbers import TORQUE, VELOCITY, Drive
from taccorl.alignment.controller.joint_kernel import simulate
from taccorl.alignment.controller.joint_model import JointModel, Numbers
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.joint_recording import joint_motion, motion_of
from taccorl.alignment.controller.rigid_joint import Gains, Rigid, rigid_terms
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import ArmEffect, Effect, JointEffect, number
from taccorl.sim.replay import replay
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

STEP_S = TWIN.physics.timestep_s


def _on_joints(name: str) -> bool:
    """An effect of arms or joints, and not of grippers only, that needs no other one."""
    cls = effects.get(name)
    of_arms = issubclass(cls, ArmEffect) and (
        not issubclass(cls, JointEffect) or "joint2" in cls.possible
    )
    return of_arms and "dry_friction" not in cls.needs


KNOWN = [
    name
    for name in effects
    if _on_joints(name) and effects.get(name)().drive() is not None
]
START_MRAD = {
    "torque_scale": 0.1
}  # the twin's first physics step after it is built still carries the whole weight
OTHER_EFFORT = {
    "command_delay",
    "direction_gain",
    "speed_delay",
}  # of the command before, or not MuJoCo's own
NEAR_EFFORT = {
    "torque_speed_limit",
    "encoder_eccentricity",
}  # MuJoCo has speed or angle of the physics step before
IN_REACH = {  # of the motion below: limits of torque and speed, and a place in the range
    "left_joint2": {
        "torque_max_nm": 8.0,
        "stall_nm": 8.0,
        "no_load_rad_per_s": 2.0,
        "angle_rad": 1.85,
    },
    "left_joint5": {
        "torque_max_nm": 0.6,
        "stall_nm": 0.6,
        "no_load_rad_per_s": 2.0,
        "angle_rad": 0.1,
    },
}


def typical(name: str, signal: str) -> Effect:
    """At three times its typical strength, where that is within its bounds: nonlinear terms must show."""
    cls = effects.get(name)
    values = {}
    for p in cls.parameters():
        value = p.typical
        if p.absent is not None and np.isfinite(p.absent):
            value = min(max(p.absent + 3 * (p.typical - p.absent), p.low), p.high)
        values[p.name] = IN_REACH[signal].get(p.name, value)
    arm, joint = signal.split("_")
    where = (
        {"arm": arm, "joints": [joint]}
        if issubclass(cls, JointEffect)
        else {"arm": arm}
    )
    return make_effect(name, **where, **values)


def from_rest(
    signal: str, seconds: float = 3.0, **options: float
) -> tuple[JointModel, JointMotion]:
    """Model of one joint of the nominal twin, and a chirp of ``seconds`` that begins with the joint at rest."""
    model = JointModel(TWIN, signal)
    return model, at_rest(
        joint_motion(chirp(signal, seconds, **options), TWIN, signal), model.gains
    )


@pytest.mark.parametrize("joint", ROBOT.joints)
def test_a_plain_joint_moves_as_in_mujoco(joint: str) -> None:
    signal = f"right_{joint}"
    model, motion = from_rest(signal, 4.0)
    quick, exact = (
        model.simulate(motion, model.gains),
        in_mujoco(motion, signal, model.gains),
    )
    np.testing.assert_allclose(quick.reported, exact.reported, atol=1e-12)
    np.testing.assert_allclose(quick.effort, exact.effort, atol=1e-9)
    assert np.ptp(exact.reported) > 0.3


@pytest.mark.parametrize("name", KNOWN)
@pytest.mark.parametrize(
    "signal", ["left_joint2", pytest.param("left_joint5", marks=pytest.mark.slow)]
)
def test_an_effect_does_in_the_model_what_it_does_in_mujoco(
    name: str, signal: str
) -> None:
    model, effect = JointModel(TWIN, signal), typical(name, signal)
    gains = model.gains._replace(
        torque_ff=0.0
    )  # so that a motion from rest is in balance
    motion = at_rest(joint_motion(chirp(signal, 3.0, high_hz=3.0), TWIN, signal), gains)
    quick, plain = model.simulate_all(
        [motion], [Numbers(gains, [effect]), Numbers(gains)]
    )[0]
    np.testing.assert_array_equal(
        plain.reported, JointModel(TWIN, signal).simulate(motion, gains).reported
    )
    exact = in_mujoco(motion, signal, gains, [effect])
    away = np.abs(quick.reported - exact.reported)
    assert away[:100].max() < 1e-3 * START_MRAD.get(name, 1e-3)
    assert away[100:].max() < (
        2e-5 if name == "speed_delay" else 1e-6
    )  # MuJoCo's is exact to the first order
    # the effort is what the motor gives, not what was asked of it
    if name not in OTHER_EFFORT:
        away_nm = np.abs(quick.effort - exact.effort)[100:].max()
        assert away_nm < (1e-2 if name in NEAR_EFFORT else 1e-4) * np.ptp(exact.effort)
    if name in ("torque_saturation", "torque_speed_limit"):
        most_nm, reached = (
            IN_REACH[signal]["torque_max_nm"],
            np.abs(model.motor_nm(motion, quick)).max(),
        )
        assert reached == pytest.approx(most_nm, rel=0.1 * (name in NEAR_EFFORT))
    shown = np.abs(exact.reported - plain.reported).max()
    assert shown > 1e-5 or name == "encoder_bias", (
        "it shows, or this means nothing; a bias does not, by its nature"
    )


def test_every_effect_of_joints_is_known_to_the_model() -> None:
    unknown = [name for name in effects if _on_joints(name) and name not in KNOWN]
    assert unknown == [], "no recording of a joint can be simulated with these"
    assert len(KNOWN) >= 18


def test_effects_act_together_as_in_mujoco() -> None:
    signal = "left_joint5"
    model, motion = from_rest(signal)
    at = {"arm": "left", "joints": ["joint5"]}
    together = [
        make_effect("coulomb_friction", torque_nm=0.3, **at),
        make_effect("asymmetric_friction", torque_nm=0.2, asymmetry=0.5, **at),
        make_effect("command_delay", delay_s=0.0123, **at),
        make_effect("velocity_feedforward", share=0.5, **at),
        make_effect("joint_compliance", **at, compliance_rad_per_nm=0.01),
    ]
    quick, exact = (
        model.simulate(motion, model.gains, together),
        in_mujoco(motion, signal, model.gains, together),
    )
    np.testing.assert_allclose(quick.reported, exact.reported, atol=1e-5)
    # In the twin's own config they do the same.
    own = JointModel(TwinConfig(effects=together), signal).simulate(motion, model.gains)
    np.testing.assert_array_equal(own.reported, quick.reported)


def test_a_command_that_comes_at_a_row_s_time_is_not_yet_in_its_effort() -> None:
    signal = "left_joint4"
    model, motion = from_rest(signal)
    late = make_effect("command_delay", arm="left", joints=["joint4"], delay_s=0.03)
    plain, answer = (
        model.simulate(motion, model.gains).effort,
        model.simulate(motion, model.gains, [late]).effort,
    )
    np.testing.assert_allclose(answer[6:], plain[:-6], atol=1e-3 * np.ptp(plain))


def test_effects_called_the_same_beside_a_torque_ff_give_the_same_positions() -> None:
    """Friction F (1 + a) forwards and F (1 − a) backwards is F both ways and a constant −F a; a torque_ff of F a cancels that."""
    signal, at = "left_joint5", {"arm": "left", "joints": ["joint5"]}
    pairs = {
        tuple(sorted((a, b)))
        for a in effects
        for b in effects.get(a).same_with_torque_ff
    }
    assert pairs == {("asymmetric_friction", "coulomb_friction")}, (
        "a further pair needs its own numbers below"
    )
    assert all(
        a in effects.get(b).same_with_torque_ff
        for a, b in pairs | {(b, a) for a, b in pairs}
    )
    model, motion = from_rest(signal)
    both_ways = make_effect("coulomb_friction", torque_nm=0.3, **at)
    one_way = make_effect("asymmetric_friction", torque_nm=0.3, asymmetry=0.4, **at)
    shifted = model.gains._replace(torque_ff=model.gains.torque_ff + 0.3 * 0.4)
    plain = model.simulate(motion, model.gains, [both_ways]).reported
    np.testing.assert_allclose(
        model.simulate(motion, shifted, [one_way]).reported, plain, atol=1e-9
    )
    apart = np.abs(
        model.simulate(motion, model.gains, [one_way]).reported - plain
    ).max()
    assert apart == pytest.approx(
        0.3 * 0.4 / model.gains.kp, rel=0.01
    )  # the spring K_p holds what nothing cancels


def test_bristles_of_coulomb_friction_bend_as_in_mujoco() -> None:
    signal, at = "left_joint5", {"arm": "left", "joints": ["joint5"]}
    model, motion = from_rest(signal)
    dry = make_effect("coulomb_friction", torque_nm=0.3, **at)
    bristles = make_effect("presliding", presliding_rad=1e-3, **at)
    quick = model.simulate(motion, model.gains, [dry, bristles]).reported
    exact = in_mujoco(motion, signal, model.gains, [dry, bristles]).reported
    np.testing.assert_allclose(quick, exact, atol=1e-5)
    assert (
        np.abs(quick - model.simulate(motion, model.gains, [dry]).reported).max() > 1e-4
    )
    alone, plain = (
        model.simulate(motion, model.gains, some).reported for some in ([bristles], [])
    )
    np.testing.assert_array_equal(alone, plain)
    own = make_effect("coulomb_friction", torque_nm=0.3, presliding_rad=1e-3, **at)
    np.testing.assert_array_equal(
        model.simulate(motion, model.gains, [own]).reported, quick
    )
    np.testing.assert_array_equal(
        in_mujoco(motion, signal, model.gains, [own]).reported, exact
    )
    refused = {
        "left_joint5: coulomb_friction comes after": [bristles, dry],
        "bristles of its own": [own, bristles],
    }
    for said, twin in refused.items():
        with pytest.raises(TaccorlError, match=said):
            Simulation(Bench(), TwinConfig(effects=twin))


def test_bristles_of_coulomb_friction_give_way_by_dahl_s_law() -> None:
    """dz/dx = 1 − z / x_p forwards and 1 + z / x_p backwards: half of the friction bends them by x_p ln 2 from rest, and back to
    no torque they return x_p ln 1.5."""
    bend_rad, friction_nm = 1e-4, 3.0
    rubs = {
        "coulomb_friction__torque_nm": friction_nm,
        "presliding__presliding_rad": bend_rad,
    }
    drive = Drive(
        0.0,
        0.0,
        0.0,
        0.01,
        viscous_friction__damping_nms_per_rad=5.0,
        command=TORQUE,
        midpoint=1.0,
        **rubs,
    )
    torque = (
        0.5
        * friction_nm
        * np.interp(np.arange(8000), [0, 3000, 4000, 7000], [0.0, 1.0, 1.0, 0.0])
    )
    still, ones = np.zeros(8000), np.ones(8000)
    angle, _ = simulate(
        drive, torque, still, still, ones, ones, still, 0.0, 1, 1, 1e-3, 0.0
    )
    assert angle[3999] == pytest.approx(bend_rad * np.log(2.0), rel=1e-2)
    assert angle[-1] == pytest.approx(bend_rad * (np.log(2.0) - np.log(1.5)), rel=1e-2)


def test_the_effort_of_a_late_speed_is_inertia_times_acceleration() -> None:
    """−K_d (q̇ − τ q̈) on a free mass: what the motor gives is J q̈, not (J − K_d τ) q̈, which is 5 % less here."""
    joint = JointModel(
        AxisJoint("mass", 0.05, gains=Gains(20.0, 1.7, 0.0), step_s=1e-3)
    )
    time_s = np.arange(2000) * 1e-3
    target = 0.3 * np.sin(2 * np.pi * 2.0 * time_s) * np.clip(time_s, 0.0, 1.0)
    m = of_signal("made", 1000.0, target, np.zeros(2000), "mass")
    late = make_effect("speed_delay", delay_s=1.5e-3)
    answer = joint.simulate(motion_of(m, "mass", joint.joint), joint.gains, [late])
    q = answer.reported
    acceleration = (
        q[2:] - 2 * q[1:-1] + q[:-2]
    ) / 1e-3**2  # of the physics step that ends at q[2:]
    np.testing.assert_allclose(
        answer.effort[2:],
        0.05 * acceleration,
        rtol=0,
        atol=1e-9 * np.abs(answer.effort).max(),
    )


def test_at_its_limit_a_motor_with_a_late_speed_moves_the_whole_inertia_and_reports_the_limit() -> (
    None
):
    """K_p asks for 20 N·m of a motor of 1 N·m: q = ½ (1 / 0.05) t² until the brake, not 5 % more; the effort is 1 N·m."""
    joint = JointModel(
        AxisJoint("mass", 0.05, gains=Gains(20.0, 1.7, 0.0), step_s=1e-4)
    )
    time_s = np.arange(200) * 1e-3
    m = of_signal(
        "made", 1000.0, np.where(time_s > 0.0095, 1.0, 0.0), np.zeros(200), "mass"
    )
    effects = [
        make_effect("speed_delay", delay_s=1.5e-3),
        make_effect("torque_saturation", torque_max_nm=1.0),
    ]
    answer = joint.simulate(motion_of(m, "mass", joint.joint), joint.gains, effects)
    since = np.clip(time_s - 0.010, 0.0, None)[:150]
    np.testing.assert_allclose(
        answer.reported[:150],
        0.5 * 20.0 * since**2,
        rtol=0,
        atol=20.0 * 1e-4 * since[-1],
    )
    np.testing.assert_allclose(answer.effort[11:150], 1.0, rtol=0, atol=1e-12)
    assert answer.effort[:11] == pytest.approx(0.0, abs=1e-12)


def test_an_effect_takes_the_place_of_the_config_s_own() -> None:
    model, motion = from_rest("left_joint4", 2.0)
    weak, strong = (make_effect("coulomb_friction", torque_nm=f) for f in (0.1, 2.0))
    refitted = JointModel(TwinConfig(effects=[weak]), model.signal).simulate(
        motion, model.gains, [strong]
    )
    np.testing.assert_array_equal(
        refitted.reported, model.simulate(motion, model.gains, [strong]).reported
    )


def test_of_an_effect_of_all_joints_the_model_takes_what_acts_on_its_own() -> None:
    model, motion = from_rest("left_joint6", 2.0)
    on_right = TwinConfig(
        effects=[make_effect("coulomb_friction", torque_nm=1.0, arm="right")]
    )
    other, plain = (
        JointModel(on_right, model.signal),
        model.simulate(motion, model.gains),
    )
    np.testing.assert_array_equal(
        other.simulate(motion, model.gains).reported, plain.reported
    )


@dataclasses.dataclass(kw_only=True)
class _Hooks(JointEffect):
    """Effect of a plug-in that states no numbers of the one-joint model (``drive``)."""

    name = "test_hooks"
    late: float = number("n", "1", 0.0, 1.0, (0.0, 1.0), "a test")


def test_an_effect_that_only_has_hooks_is_not_searched_and_refused_by_name() -> None:
    model, motion = from_rest("left_joint5")
    assert (
        model.joint.selectors(_Hooks) is None
        and model.joint.selectors(effects.get("coulomb_friction")) is not None
    )
    with pytest.raises(
        TaccorlError, match="left_joint5: the one-joint model does not have test_hooks"
    ):
        model.simulate(
            motion, model.gains, [_Hooks(late=1.0, arm="left", joints=["joint5"])]
        )


def test_rows_below_150_hz_are_sent_in_straight_lines_as_in_a_replay() -> None:
    model, slow = from_rest("left_joint5", rate_hz=30.0)
    assert len(model.simulate(slow, model.gains).reported) == len(slow.target) == 90
    # By hand: 30 Hz are five commands a row, on the line to the next row.
    line = np.interp(np.arange(90 * 5) + 1.0, 5 * np.arange(90), slow.target)
    fine = dataclasses.replace(
        slow, target=line, rate_hz=150.0, coupling_nm=np.zeros(450)
    )
    of_rows, of_commands = (
        model.simulate(one, model.gains).reported for one in (slow, fine)
    )
    np.testing.assert_allclose(of_rows, of_commands[::5], atol=1e-12)


def test_row_k_is_before_command_k_acts() -> None:
    signal = "left_joint4"
    model, m = JointModel(TWIN, signal), chirp(signal, 2.0, amplitude=0.0)
    m.target[10:, 3] += 0.02
    answer = model.simulate(
        at_rest(joint_motion(m, TWIN, signal), model.gains), model.gains
    ).reported
    np.testing.assert_allclose(answer[:11], answer[0], atol=1e-12)
    lag_s = model.gains.kd / model.gains.kp
    assert answer[15] - answer[0] == pytest.approx(
        0.02 * (1 - np.exp(-5 * 0.005 / lag_s)), rel=0.02
    )


def test_the_whole_twin_agrees_with_its_joints_one_by_one() -> None:
    # All joints of an arm move at once; each alone, with the others' measured motion as a known torque, does the same.
    m, rng = chirp("left_joint1", 4.0, amplitude=0.0), np.random.default_rng(0)
    fade = np.clip((m.time_s - 0.5) / 0.5, 0, 1)
    for j in range(6):
        m.target[:, j] += (
            0.25
            * fade
            * np.sin(2 * np.pi * (0.3 + 0.25 * j) * m.time_s + rng.uniform(0, 6))
        )
    sim = Simulation(Bench())
    sim.reset([0])
    offset = np.array([*(np.array(ROBOT.torque_ff_nm) / ROBOT.kp_nm_per_rad), 0.0] * 2)
    done = replay(sim, m.target, 200.0, HOME + offset)
    effort = np.concatenate(
        [done.effort[:1], done.effort[:-1]]
    )  # of the row before: the time of this one
    measured = dataclasses.replace(m, measured=done.reported, effort=effort)
    for j in range(6):
        signal = ROBOT.action_names[j]
        model, motion = JointModel(TWIN, signal), joint_motion(measured, TWIN, signal)
        answer = model.simulate(motion, model.gains)
        away = answer.reported - done.reported[:, j]
        assert np.sqrt(np.mean(away**2)) < 2e-5, signal
        without = dataclasses.replace(motion, coupling_nm=np.zeros(m.num_rows))
        apart = model.simulate(without, model.gains).reported - done.reported[:, j]
        assert np.sqrt(np.mean(apart**2)) > 10 * np.sqrt(np.mean(away**2)), (
            "the others' motion matters"
        )
        # Torques agree less: a row's is what is left, 5 ms on, of the command's jump, and that hangs on how the others give way.
        assert np.corrcoef(answer.effort[10:], effort[10:, j])[0, 1] > 0.7


def test_a_known_payload_is_carried_and_weighs() -> None:
    # 0.5 kg at the TCP, 0.168 m along the hand's z: its weight turns the joint by torque / K_p.
    signal = "left_joint5"
    model, m = JointModel(TWIN, signal), chirp(signal, 4.0, amplitude=0.0)
    m.target[3:, 4] += 1e-3  # so that it does not only rest
    bare, loaded = (
        joint_motion(dataclasses.replace(m, payload_kg=kg), TWIN, signal)
        for kg in ({}, {"left": 0.5})
    )
    sag = (
        model.simulate(loaded, model.gains).reported[-1]
        - model.simulate(bare, model.gains).reported[-1]
    )
    hidden = model.simulate(
        bare, model.gains, [make_effect("payload", mass_kg=0.5, z_m=0.168)]
    ).reported
    np.testing.assert_allclose(
        model.simulate(loaded, model.gains).reported, hidden, atol=1e-12
    )
    torque_nm = 0.5 * 9.81 * 0.168
    assert 0.3 * torque_nm / model.gains.kp < abs(sag) <= 3 * torque_nm / model.gains.kp
    both = model.simulate(
        loaded, model.gains, [make_effect("payload", mass_kg=0.5, z_m=0.168)]
    ).reported
    assert both[-1] - hidden[-1] == pytest.approx(sag, rel=0.05), (
        "a hidden one adds to a known one"
    )


def test_a_payload_s_position_sets_its_lever_arm() -> None:
    # The same weight further out: joint 5's axis is 0.091 m behind the flange.
    signal = "left_joint5"
    pose = np.array([0.0, 1.2, -1.4, 0.0, 0.0, 0.0, 0.02])
    masses = {
        at: arm_joint.rigid(TWIN, signal, pose, 0.5, [], (0.0, 0.0, at))
        for at in (0.0, 0.1, 0.168)
    }
    bare = arm_joint.rigid(TWIN, signal, pose, 0.0, [])
    assert arm_joint.rigid(TWIN, signal, pose, 0.5, []) == masses[0.168]
    for at, body in masses.items():
        weight_nm = np.hypot(
            body.gravity_sin - bare.gravity_sin, body.gravity_cos - bare.gravity_cos
        )
        assert weight_nm == pytest.approx(0.5 * 9.81 * (0.091 + at), rel=0.01)


def test_commanded_gains_scale_what_the_model_is_given() -> None:
    signal = "left_joint5"
    m = dataclasses.replace(chirp(signal, 2.0), kp={signal: 302.2}, kd={signal: 17.1})
    motion = joint_motion(m, TWIN, signal)
    assert (motion.kp_scale, motion.kd_scale) == pytest.approx((2.0, 1.0))
    assert motion.kp_known and motion.kd_known
    model, plain = JointModel(TWIN, signal), dataclasses.replace(motion, kp_scale=1.0)
    scaled, stated = (
        model.simulate(motion, model.gains),
        model.simulate(plain, Gains(302.2, 17.1, 1.73)),
    )
    np.testing.assert_array_equal(scaled.reported, stated.reported)


def test_a_sliding_axis_follows_its_closed_form() -> None:
    # 95 kg, K_p 1e4 N/m, K_d 4e3 N s/m: overdamped, poles at −2.7 and −39.4 1/s.
    model = JointModel(
        AxisJoint("slide", 95.0, gains=Gains(1e4, 4e3, 0.0), unit="m", step_s=1e-4)
    )
    time_s = np.arange(5000) / 1000
    m = of_signal("made", 1000.0, np.full(5000, 0.02), np.zeros(5000), "slide", "m")
    motion = motion_of(m, "slide", model.joint)
    answer = model.simulate(motion, model.gains).reported
    fast, slow = np.sort(np.roots([95.0, 4e3, 1e4]))
    expected = 0.02 * (
        1
        - (slow * np.exp(fast * time_s) - fast * np.exp(slow * time_s)) / (slow - fast)
    )
    np.testing.assert_allclose(answer, expected, atol=2e-5)
    with_friction = model.simulate(
        motion, model.gains, [make_effect("coulomb_friction", torque_nm=20)]
    )
    assert 0.02 - with_friction.reported[-1] == pytest.approx(
        20 / 1e4, rel=0.02
    )  # F / K_p before its target
    with pytest.raises(
        TaccorlError, match="slide: the one-joint model does not have touch_lag"
    ):
        model.simulate(
            motion, model.gains, [make_effect("touch_lag", time_constant_s=0.02)]
        )


class _Geared(AxisJoint):
    """A rotor of 0.6 kg·m² of 3.3 kg·m² in all, in a machine without a twin in MuJoCo."""

    facts: ClassVar = {"midpoint": 1.0}
    command_hz: ClassVar = 200.0

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        return Rigid(3.3, 0.6)


@pytest.mark.parametrize("kd", [110.0, 2640.0])
def test_a_late_speed_is_behind_a_low_pass(kd: float) -> None:
    """J q̈ = K_p (q* − q) − K_d w, τ ẇ = q̇ − w after a step of the target; also where K_d τ is 1.2 J, as of a light wrist."""
    inertia, kp, late_s = 3.3, 1320.0, 1.5e-3
    model = JointModel(_Geared("pan", inertia, Gains(kp, kd, 0.0), "rad", 1e-4))
    motion = of_joint(
        "step", 200.0, np.where(np.arange(60) > 0, 1.0, 0.0), np.full(60, np.nan)
    )
    found = model.simulate(
        motion, model.gains, [make_effect("speed_delay", delay_s=late_s)]
    )
    law = np.array(
        [
            [0.0, 1.0, 0.0],
            [-kp / inertia, 0.0, -kd / inertia],
            [0.0, 1.0 / late_s, -1.0 / late_s],
        ]
    )
    off = np.array([expm(law * 5e-3 * k) @ [-1.0, 0.0, 0.0] for k in range(59)])
    np.testing.assert_allclose(found.reported[1:], 1.0 + off[:, 0], rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        found.effort[2:], -kp * off[1:, 0] - kd * off[1:, 2], rtol=0, atol=1e-3 * kp
    )


def test_a_rotor_on_a_stiff_gear_swings_as_its_two_masses_do() -> None:
    """0.6 q̈ = K_p (q* − q) − K_d q̇ − t, 2.7 p̈ = t, t = k (q − p) + d (q̇ − ṗ): 71 Hz and a damping ratio of 0.33 in the gear."""
    kp, kd, k, d = 6000.0, 190.0, 1e5, 150.0
    model = JointModel(_Geared("pan", 3.3, Gains(kp, kd, 0.0), "rad", 1e-3))
    target = np.where(np.arange(60) > 0, 0.01, 0.0)
    motion = of_joint("step", 200.0, target, np.full(60, np.nan))
    gear = make_effect("joint_compliance", compliance_rad_per_nm=1 / k, damping_s=d / k)
    found = model.simulate(motion, model.gains, [gear]).reported
    rotor, link = (
        np.array([-kp - k, -kd - d, k, d]) / 0.6,
        np.array([k, d, -k, -d]) / 2.7,
    )
    turn = expm(np.array([[0, 1, 0, 0], rotor, [0, 0, 0, 1], link]) / 200.0)
    state, rest, exact = np.zeros(4), np.array([0.01, 0.0, 0.01, 0.0]), [0.0]
    for goal in target[1:]:
        exact.append(state[0])
        state = rest * (goal / 0.01) + turn @ (state - rest * (goal / 0.01))
    assert np.ptp(exact) > 0.01 and np.abs(found - exact).max() < 5e-5


def test_an_integral_in_a_velocity_loop_follows_its_closed_form_and_holds_a_constant_load() -> (
    None
):
    """J v̇ = K_d (v* − v + r ∫ (v* − v) dt) − d: a step of v* answers as (K_d s + K_d r) / (J s² + K_d s + K_d r), whatever d."""
    inertia, kd, rate, load_nm, step_s = 0.1, 2.0, 10.0, 0.7, 1e-3
    law = {
        "integral_action__rate_per_s": rate,
        "command": VELOCITY,
        "effort_after": 1.0,
        "midpoint": 1.0,
    }
    drive = Drive(0.0, kd, 0.0, inertia, **law)
    goal, still, ones = np.append(0.0, np.ones(1499)), np.zeros(1500), np.ones(1500)
    angle, effort = simulate(
        drive, goal, still + load_nm, still, ones, ones, still, 0.0, 1, 1, step_s, 0.0
    )
    time_s = step_s * np.arange(-1, 1499)
    lag, wave = (
        0.5 * kd / inertia,
        np.sqrt(kd * rate / inertia - (0.5 * kd / inertia) ** 2),
    )
    assert (lag, wave) == pytest.approx(
        (10.0, 10.0)
    )  # so v = 1 − e^(−10 t) (cos 10 t − sin 10 t), and its integral:
    exact = time_s - 0.1 * np.exp(-lag * time_s) * np.sin(wave * time_s)
    assert np.abs(angle - np.where(time_s > 0, exact, 0.0)).max() < 5e-6
    assert effort[-1] == pytest.approx(load_nm, abs=1e-4)


def test_a_lag_of_the_torque_and_an_integral_follow_their_closed_form() -> None:
    """J q̈ = τ, T τ̇ = K_p (e + r ∫ e dt) − K_d q̇ − τ with e = q* − q, of targets that are held for a step of 1 ms."""
    inertia, kp, kd, lag_s, rate = 0.1, 400.0, 10.0, 4e-3, 3.0
    speeds = np.array([-kp, -kd, -1.0, kp * rate, kp]) / lag_s
    still, ones = np.zeros(5), np.ones(2000)
    turn = expm(
        1e-3
        * np.array(
            [
                np.eye(5)[1],
                np.eye(5)[2] / inertia,
                speeds,
                [-1.0, 0.0, 0.0, 0.0, 1.0],
                still,
            ]
        )
    )
    goals, state, exact = (
        0.3 * np.sin(4e-3 * np.arange(2000)),
        np.zeros(5),
        list[float](),
    )
    for goal in goals:
        exact.append(state[0])
        state = turn @ np.append(state[:4], goal)
    late = {
        "torque_lag__time_constant_s": lag_s,
        "integral_action__rate_per_s": rate,
        "midpoint": 1.0,
    }
    more = (0.0 * ones, 0.0 * ones, ones, ones, 0.0 * ones, 0.0, 1, 1, 1e-3, 0.0)
    assert (
        np.abs(
            simulate(Drive(kp, kd, 0.0, inertia, **late), goals, *more)[0] - exact
        ).max()
        < 1e-5
    )


def test_a_joint_starts_in_balance() -> None:
    # Rest for ever with friction, bristles, integrator, gear and encoder at once: nothing moves until the command does.
    drive = Drive(150.0, 17.0, 1.0, 0.03, 0.01, gravity_sin=2.0, gravity_cos=0.5)
    target, sticks = (
        np.full(400, 0.3),
        {"stribeck_friction__torque_nm": 4.0, "stribeck_friction__stiction_share": 0.5},
    )
    for change in (
        {
            "integral_action__rate_per_s": 1.0,
            "joint_compliance__compliance_rad_per_nm": 0.01,
        },
        {"integral_action__rate_per_s": 1.0, "backlash__play_rad": 0.01},
        {"coulomb_friction__torque_nm": 5.0},
        sticks
        | {"encoder_scale__factor": 1.05, "encoder_eccentricity__amplitude_rad": 0.01},
    ):
        # an integral has had for ever to take the error away
        start = 0.3 if "integral_action__rate_per_s" in change else 0.29
        none, ones = np.zeros(400), np.ones(400)
        more = (none, none, ones, ones, none, start, 6, 1, STEP_S, 0.0)
        reported, _ = simulate(drive._replace(**change), target, *more)
        assert reported[0] == pytest.approx(start, abs=1e-12)
        assert np.ptp(reported) < 2e-5, change  # dry friction creeps at 6 µrad/s


def test_what_cannot_be_replayed_is_refused_by_name() -> None:
    m = chirp("left_joint5", 2.0)
    with pytest.raises(TaccorlError, match=r"left_gripper:.*gripper"):
        JointModel(TWIN, "left_gripper")
    with pytest.raises(TaccorlError, match="is not a joint of the arms"):
        JointModel(TWIN, "left_joint7")
    model = JointModel(TWIN, "left_joint5")
    with pytest.raises(
        TaccorlError, match=r"125 Hz means 9\.600 physics steps.*resampled"
    ):
        model.simulate(
            joint_motion(chirp("left_joint5", 2.0, rate_hz=125.0), TWIN, "left_joint5"),
            model.gains,
        )
    jumpy = dataclasses.replace(
        m, time_s=np.where(np.arange(400) > 200, m.time_s + 0.1, m.time_s)
    )
    with pytest.raises(TaccorlError, match=r"not evenly spaced: 105\.0 ms at 1\.000 s"):
        joint_motion(jumpy, TWIN, "left_joint5")
    hole = dataclasses.replace(
        m, target=np.where(np.arange(400)[:, None] == 100, np.nan, m.target)
    )
    with pytest.raises(TaccorlError, match=r"no target at 0\.500 s"):
        joint_motion(hole, TWIN, "left_joint5")
    late = dataclasses.replace(
        m, measured=np.where(np.arange(400)[:, None] < 40, np.nan, m.measured)
    )
    with pytest.raises(TaccorlError, match="not measured in its first 20 rows"):
        joint_motion(late, TWIN, "left_joint5")


def test_a_response_that_was_computed_is_kept_and_is_that_of_a_new_model(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """13 gains are one more than a recording keeps: the first is computed again, the last is not."""
    motion, asked = joint_motion(chirp("left_joint5", 3.0), TWIN, "left_joint5"), []
    model, plain = JointModel(TWIN, "left_joint5"), joint_model.simulate_all
    monkeypatch.setattr(
        joint_model,
        "simulate_all",
        lambda d, *rest: (asked.append(d[0]), plain(d, *rest))[1],
    )
    gains = [
        model.gains._replace(kp=model.gains.kp * (1 + 0.01 * k))
        for k in range(joint_model.KEPT + 1)
    ]
    found = [model.simulate(motion, g) for g in gains]
    again = [
        model.simulate(motion, g).reported for g in (gains[-1], gains[-1], gains[0])
    ]
    assert len(asked) == len(gains) + 1 and asked[-1] == asked[0]
    assert np.array_equal(again[0], found[-1].reported) and np.array_equal(
        again[2], found[0].reported
    )
    fresh = JointModel(TWIN, "left_joint5").simulate(motion, gains[-1])
    assert np.array_equal(again[1], fresh.reported)
    with pytest.raises(ValueError, match="read-only"):
        again[0][:] = 0.0


@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_the_rotor_is_that_of_the_joint_and_of_its_actuators(kind: str):
    """0.02 of the joint, 0.01 · 10² of one actuator and 0.003 · 2² of another: 1.032.
    A hinge moves 1 kg at 0.1 m with 0.006 kg·m² of its own, a slide 1 kg."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>
      <body><joint name="j" type="{kind}" axis="0 1 0" armature="0.02"/>
      <inertial pos="0.1 0 0" mass="1" diaginertia="0.004 0.006 0.006"/>
      <body><joint name="k" axis="0 1 0" armature="0.5"/>
      <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-9 1e-9 1e-9"/></body></body>
      </worldbody><actuator><motor joint="j" gear="10" armature="0.01"/>
      <motor joint="k" gear="7" armature="3"/>
      <position joint="j" kp="1" gear="2" armature="0.003"/></actuator></mujoco>""")
    found = rigid_terms(model, "j")
    assert found.rotor_inertia == pytest.approx(1.032)
    moved = 0.016 if kind == "hinge" else 1.0
    assert found.inertia - found.rotor_inertia == pytest.approx(moved, abs=1e-6)
