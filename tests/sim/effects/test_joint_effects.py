"""Closed forms of effects on joint 5 of the right arm, and that they act only on the arms, joints and simulations chosen.

Laws that ``tests/surrogate`` computes apart from the one-joint model, which tests/alignment/controller/test_joint_model.py
compares with MuJoCo, are not repeated here. At rest at home targets stand T_ref / K_p below the angles, and weight is carried.
"""

import math
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from press_bench import RIGHT_HOME, PressBench, start

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.command import uniform
from taccorl.sim.effects.effect import Effect
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

COLUMN = ROBOT.action_names.index("right_joint5")
KP, KD, TORQUE_FF = (
    ROBOT.kp_nm_per_rad[4],
    ROBOT.kd_nms_per_rad[4],
    ROBOT.torque_ff_nm[4],
)
STEP_S = TwinConfig().physics.timestep_s
GRAVITY = 9.81


def on_joint5(name: str, **values: float) -> Effect:
    return make_effect(name, arm="right", joints=["joint5"], **values)


def drive(
    sim: Simulation, seconds: float, offset=lambda t: 0.0, column: int = COLUMN
) -> dict[str, np.ndarray]:
    """Let one joint's target be its target at rest + ``offset(t)`` [rad]; what the joint does after each physics step. Returns
    ``t`` [s], ``u`` target, ``q`` angle of the motor, ``v`` its velocity, ``reported``; each (T,)."""
    rest = sim.targets.copy()
    joint = sim.model.joint(ROBOT.action_names[column])
    rows = []
    for k in range(round(seconds / STEP_S)):
        targets = rest.copy()
        targets[:, column] += offset(k * STEP_S)
        sim.advance(targets[None], 1)
        q, v = (
            sim.arrays["qpos"][0, joint.qposadr[0]],
            sim.arrays["qvel"][0, joint.dofadr[0]],
        )
        rows.append(
            (
                (k + 1) * STEP_S,
                targets[0, column],
                q,
                v,
                sim.proprioception()[0, column],
            )
        )
    return dict(zip(("t", "u", "q", "v", "reported"), np.array(rows).T, strict=True))


def asked_nm(motion: dict[str, np.ndarray]) -> np.ndarray:
    """(T,) what a controller without effects would ask for: K_p (u − q) − K_d q̇ + T_ref."""
    return KP * (motion["u"] - motion["q"]) - KD * motion["v"] + TORQUE_FF


HOME = RIGHT_HOME[4]
STRIBECK = {
    "torque_nm": 0.5,
    "stiction_share": 1.0,
    "stribeck_rad_per_s": 0.1,
    "presliding_rad": 5e-4,
}
POWER = {"torque_nm": 0.5, "exponent": 0.5, "asymmetry": 0.3}
LEANING = {"torque_nm": 0.5, "asymmetry": 0.3}


# K_p (u − q) − K_d v + T_ref balances what acts besides it.
@pytest.mark.parametrize(
    ("name", "values", "speed", "seconds", "torque_nm", "rel"),
    [
        (
            "power_law_friction",
            POWER,
            0.1,
            0.8,
            0.5 * 1.3,
            0.01,
        ),  # four times the speed, twice the friction
        ("power_law_friction", POWER, 0.4, 0.8, 0.5 * 1.3 * 2, 0.01),
        (
            "power_law_friction",
            POWER | {"yield_nm": 0.2},
            -0.4,
            0.8,
            -0.2 - 0.5 * 0.7 * 2,
            0.01,
        ),
        ("asymmetric_friction", LEANING, 0.05, 1.0, 0.5 * 1.3, 0.01),
        ("asymmetric_friction", LEANING, -0.05, 1.0, -0.5 * 0.7, 0.01),
        ("stribeck_friction", STRIBECK, 0.02, 1.0, 0.5 + 0.5 * np.exp(-0.04), 0.02),
        ("stribeck_friction", STRIBECK, 0.1, 1.0, 0.5 + 0.5 * np.exp(-1.0), 0.02),
        ("stribeck_friction", STRIBECK, 0.4, 0.7, 0.5 + 0.5 * np.exp(-16.0), 0.02),
    ],
)
def test_a_steady_sweep_takes_the_torque_of_the_law(
    name, values, speed, seconds, torque_nm, rel
):
    motion = drive(start(on_joint5(name, **values)), seconds, lambda t: speed * t)
    assert motion["v"][-1] == pytest.approx(speed, rel=0.02)
    assert asked_nm(motion)[-1] == pytest.approx(torque_nm, rel=rel)


def balance(torque_nm: Callable[[float], float], goal: float) -> float:
    """q where K_p (goal − q) is the torque of the effect, found by Newton's steps."""
    q = goal
    for _ in range(50):
        slope = (torque_nm(q + 1e-6) - torque_nm(q - 1e-6)) / 2e-6
        q += (KP * (goal - q) - torque_nm(q)) / (KP + slope)
    return q


@pytest.mark.parametrize(
    ("effects", "offset", "torque_nm", "tolerance"),
    [
        (
            {"cable_spring": {"stiffness_nm_per_rad": 5.0, "rest_rad": -0.4}},
            0.0,
            lambda q: 5.0 * (q + 0.4),
            1e-6,
        ),
        (
            {"unbalance": {"torque_nm": 3.0, "hangs_at_rad": -0.8}},
            0.0,
            lambda q: 3.0 * np.sin(q + 0.8),
            1e-6,
        ),
        (
            {"end_stop": {"angle_rad": HOME - 0.03, "stiffness_nm_per_rad": 1000.0}},
            -0.1,
            lambda q: 1000.0 * (q - HOME + 0.03),
            1e-6,
        ),
        (
            {
                "end_stop": {"angle_rad": HOME + 0.03, "stiffness_nm_per_rad": 1000.0},
                "cable_spring": {"stiffness_nm_per_rad": 20.0, "rest_rad": 0.5},
            },
            0.1,
            lambda q: 1000.0 * (q - HOME - 0.03) + 20.0 * (q - 0.5),
            1e-6,
        ),
        (
            {"coulomb_friction": {"torque_nm": 0.5}},
            0.02,
            lambda q: 0.5,
            3e-5,
        ),  # it stops short by F / K_p, 3.31 mrad
        ({"coulomb_friction": {"torque_nm": 0.5}}, -0.02, lambda q: -0.5, 3e-5),
        (
            {"power_law_friction": {"torque_nm": 0.01, "yield_nm": 0.5}},
            -0.02,
            lambda q: -0.5,
            3e-5,
        ),
    ],
)
def test_a_joint_rests_where_the_drive_balances_the_law(
    effects, offset, torque_nm, tolerance
):
    motion = drive(
        start(*(on_joint5(name, **values) for name, values in effects.items())),
        2.0,
        lambda t: offset,
    )
    goal = motion["u"][-1] + TORQUE_FF / KP
    assert motion["q"][-1] == pytest.approx(balance(torque_nm, goal), abs=tolerance)
    assert abs(motion["q"][-1] - goal) > 3e-3, "it shows"


@pytest.mark.parametrize(
    ("name", "values", "torque_nm", "least", "most"),
    [
        # Applied torque below the breakaway torque: the joint stays. Breakaway is 0.5 N·m (Coulomb), 0.5 (1 ± a) N·m (asymmetric)
        # and 1 N·m (Stribeck); the last has bristles, which yield by up to 0.1 mrad.
        ("coulomb_friction", {"torque_nm": 0.5}, -0.45, -2e-5, 2e-5),
        ("coulomb_friction", {"torque_nm": 0.5}, 0.25, -2e-5, 2e-5),
        ("coulomb_friction", {"torque_nm": 0.5}, 0.495, -2e-5, 2e-5),
        ("asymmetric_friction", LEANING, 0.6, -2e-5, 2e-5),
        ("asymmetric_friction", LEANING, -0.3, -2e-5, 2e-5),
        (
            "stribeck_friction",
            STRIBECK | {"presliding_rad": 1e-4, "stribeck_rad_per_s": 0.05},
            0.7,
            0.0,
            3e-4,
        ),
        # Applied torque beyond the breakaway torque, 0.65 and −0.35 N·m: the joint moves, driven by the excess of 0.05 N·m.
        ("asymmetric_friction", LEANING, 0.7, 0.9 * 0.05 / KP, 1.1 * 0.05 / KP),
        ("asymmetric_friction", LEANING, -0.4, -1.1 * 0.05 / KP, -0.9 * 0.05 / KP),
    ],
)
def test_friction_at_rest_holds_up_to_its_break_away(
    name, values, torque_nm, least, most
):
    motion = drive(start(on_joint5(name, **values)), 1.0, lambda t: torque_nm / KP)
    assert least < motion["q"][-1] - HOME < most
    if least < 0 < most:
        assert abs(motion["v"][-1]) < 1e-5


@pytest.mark.parametrize(
    ("name", "values", "reads"),
    [
        ("encoder_bias", {"bias_rad": 0.01}, lambda q: q + 0.01),
        ("encoder_scale", {"factor": 1.05}, lambda q: 1.05 * q),
        (
            "encoder_eccentricity",
            {"amplitude_rad": 0.05, "phase_rad": 0.6},
            lambda q: q + 0.05 * np.sin(q + 0.6),
        ),
    ],
)
def test_an_encoder_settles_the_arm_where_it_reads_the_target_and_reports_that_it_is_there(
    name, values, reads
):
    sim = start(on_joint5(name, **values))
    assert sim.proprioception()[0, COLUMN] == pytest.approx(HOME, abs=1e-12)
    motion = drive(sim, 1.5, lambda t: 0.05)
    at_target = motion["u"][-1] + TORQUE_FF / KP
    assert motion["reported"][-1] == pytest.approx(at_target, abs=1e-6)
    assert reads(motion["q"][-1]) == pytest.approx(at_target, abs=1e-6)
    assert abs(motion["q"][-1] - at_target) > 0.009


def test_both_limits_of_one_drive_hold() -> None:
    sim = start(
        on_joint5("torque_speed_limit", stall_nm=4.0, no_load_rad_per_s=50.0),
        on_joint5("torque_saturation", torque_max_nm=2.0),
    )
    alone = start(on_joint5("torque_saturation", torque_max_nm=2.0))
    np.testing.assert_allclose(
        drive(sim, 0.01, lambda t: 0.5)["v"],
        drive(alone, 0.01, lambda t: 0.5)["v"],
        rtol=1e-9,
    )


def dropping(probability: float = 0.3, seed: int = 5, num_sims: int = 1) -> Simulation:
    config = TwinConfig(
        effects=[
            make_effect(
                "dropped_commands", probability=probability, seed=seed, arm="right"
            )
        ]
    )
    return Simulation(PressBench(), config, num_sims=num_sims)


def arrived(sim: Simulation, num: int = 60) -> np.ndarray:
    """(num, N) what is in force of a ramp of 1 mrad a command, in mrad."""
    rest = sim.targets.copy()
    rows = []
    for k in range(1, num + 1):
        sim.advance(rest[None] + 1e-3 * k, 1)
        rows.append(
            sim.arrays["ctrl"][:, sim.action_actuators[COLUMN]] - rest[:, COLUMN]
        )
    return np.round(1e3 * np.array(rows)).astype(int)


def test_a_lost_command_leaves_the_one_before_in_force_and_each_episode_loses_its_own() -> (
    None
):
    sim = dropping(num_sims=3)
    sim.reset([0, 2**40 + 3, 0])
    got = arrived(sim)
    for i, episode in ((0, 0), (1, 3 ^ 2**8)):  # 2⁴⁰ + 3 folded into 32 bits
        arrives = uniform(5, np.full(60, episode), np.arange(60)) >= 0.3
        newest = np.maximum.accumulate(np.where(arrives, np.arange(1, 61), 0))
        np.testing.assert_array_equal(got[:, i], newest)
    np.testing.assert_array_equal(got[:, 2], got[:, 0])
    assert (got[:, 1] != got[:, 0]).any()
    sim.reset([0, 0, 0])
    np.testing.assert_array_equal(arrived(sim)[:, 1], got[:, 0])


def test_a_greater_probability_loses_more_commands_besides_the_same_ones() -> None:
    draws = uniform(1, np.zeros(20000), np.arange(20000))
    assert draws.mean() == pytest.approx(0.5, abs=3 / math.sqrt(12 * 20000))
    for p in (0.02, 0.3):
        assert (draws < p).mean() == pytest.approx(
            p, abs=3 * math.sqrt(p * (1 - p) / 20000)
        )
    assert abs(np.corrcoef(draws[1:], draws[:-1])[0, 1]) < 3 / math.sqrt(20000)
    assert abs(
        np.corrcoef(draws, uniform(2, np.zeros(20000), np.arange(20000)))[0, 1]
    ) < 3 / math.sqrt(20000)


def test_other_joints_hear_every_command() -> None:
    sim = Simulation(
        PressBench(),
        TwinConfig(effects=[on_joint5("dropped_commands", probability=0.95)]),
    )
    sim.reset([0])
    rest = sim.targets.copy()
    sim.advance(rest[None] + 1e-3 * np.arange(1, 4)[:, None, None], 1)
    others = np.delete(np.arange(14), COLUMN)
    np.testing.assert_allclose(
        (sim.arrays["ctrl"][:, sim.action_actuators] - rest)[0, others],
        3e-3,
        atol=1e-12,
    )


@pytest.mark.parametrize("seed", [-1, 1.5, True, 2**32])
def test_a_seed_that_is_no_whole_number_of_32_bits_is_refused(seed: float) -> None:
    with pytest.raises(
        TaccorlError,
        match=r"dropped_commands: seed is .*give a whole number in 0 … 4294967295",
    ):
        make_effect("dropped_commands", seed=seed)


def test_delays_reach_grippers_too() -> None:
    sim = start(
        make_effect("command_delay", delay_s=0.1, arm="right", joints=["gripper"])
    )
    targets = sim.targets.copy()
    targets[0, 13] -= 0.03
    openings = []
    for _ in range(48):  # 0.2 s
        sim.advance(targets[None], 5)
        openings.append(sim.proprioception()[0, 13])
    assert np.ptp(openings[:24]) < 1e-6 and openings[-1] < openings[0] - 0.005


def test_a_gravity_mismatch_of_one_arm_leaves_the_other_where_it_was() -> None:
    sim = start(make_effect("gravity_mismatch", share=0.8, arm="right"))
    drive(sim, 0.5)
    np.testing.assert_allclose(
        sim.proprioception()[0, :6], start().proprioception()[0, :6], atol=1e-9
    )


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.1), (0.08, -0.05, 0.15)])
def test_a_payload_sags_every_joint_by_its_moment_over_the_stiffness(
    centre: tuple[float, float, float],
) -> None:
    sim = start()
    model, data = sim.model, sim.batch.get_data(0)
    mujoco.mj_forward(model, data)
    hand = data.body("right_link6")
    point = hand.xpos + hand.xmat.reshape(3, 3) @ centre
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, point, model.body("right_link6").id)
    dofs = [model.joint(f"right_joint{k}").dofadr[0] for k in range(1, 7)]
    expected = -0.3 * GRAVITY * jacobian[2, dofs] / np.array(ROBOT.kp_nm_per_rad)
    keys = ("x_m", "y_m", "z_m")
    loaded = start(
        make_effect(
            "payload", mass_kg=0.3, arm="right", **dict(zip(keys, centre, strict=True))
        )
    )
    drive(loaded, 1.5)
    sag = loaded.proprioception()[0, 7:13] - RIGHT_HOME
    assert np.abs(expected).max() > 3e-4
    np.testing.assert_allclose(sag, expected, atol=0.02 * np.abs(expected).max())
    with pytest.raises(
        TaccorlError,
        match=r"payload: mass_kg is -0\.3 kg, below 0, which only robot files",
    ):
        start(make_effect("payload", mass_kg=-0.3))


def test_a_lagging_command_of_one_simulation_waits_while_only_another_advances() -> (
    None
):
    sim = start(on_joint5("command_lag", time_constant_s=0.04), num_sims=2)
    rest = sim.targets.copy()
    for ids in ([0], [0], [1]):
        sim.advance(rest[None] + 0.1, 6, np.array(ids))
    moved = sim.arrays["ctrl"][:, sim.action_actuators[COLUMN]] - rest[:, COLUMN]
    np.testing.assert_allclose(
        moved, 0.1 * -np.expm1([-0.01 / 0.04, -0.005 / 0.04]), rtol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "values", "field"),
    [
        ("coulomb_friction", {"torque_nm": 0.3}, "dof_frictionloss"),
        ("viscous_friction", {"damping_nms_per_rad": 2.0}, "dof_damping"),
        ("armature", {"added_kgm2": 0.2}, "dof_armature"),
    ],
)
def test_only_the_chosen_joints_change(
    name: str, values: dict[str, float], field: str
) -> None:
    effect = make_effect(name, arm="left", joints=["joint2", "joint6"], **values)
    changed, plain = (start(*effects).model for effects in ([effect], []))
    difference = getattr(changed, field) - getattr(plain, field)
    dofs = [plain.joint(f"left_joint{k}").dofadr[0] for k in (2, 6)]
    expected = np.zeros(plain.nv)
    expected[dofs] = next(iter(values.values()))
    np.testing.assert_allclose(difference, expected, atol=1e-15)


def test_a_delay_never_makes_an_inertia_of_the_twin_negative_and_says_where_less_is_applied():
    with pytest.warns(UserWarning, match="effect speed_delay") as said:
        late = start(
            *(
                make_effect(
                    "speed_delay",
                    arm=a,
                    joints=[f"joint{k}" for k in range(1, 7)],
                    delay_s=3e-3,
                )
                for a in ("left", "right")
            )
        )
    lost = start().model.dof_armature - late.model.dof_armature
    texts = {str(w.message) for w in said}
    for joint in (f"{a}_joint{k}" for a in ("left", "right") for k in range(1, 7)):
        kd = late.config.controller.kd_nms_per_rad[int(joint[-1]) - 1]
        applied_s = lost[late.model.joint(joint).dofadr[0]] / kd
        mine = [text for text in texts if f": {joint}: " in text]
        assert len(mine) == (applied_s < 3e-3 * (1 - 1e-9)), (joint, applied_s)
        assert all(
            "3 ms would reduce the inertia by" in t
            and f"MuJoCo applies {1e3 * applied_s:.3g} ms" in t
            for t in mine
        )
    assert (
        lost[[late.model.joint(f"left_joint{k}").dofadr[0] for k in range(1, 7)]] > 0
    ).all()
    for _ in range(50):
        late.advance(late.targets[None] + 0.02, 6)
    assert np.isfinite(late.arrays["qpos"]).all()


def test_the_constant_part_of_asymmetric_friction_is_not_the_motors() -> None:
    sim = start(on_joint5("asymmetric_friction", torque_nm=0.5, asymmetry=0.3))
    motion = drive(sim, 1.0, lambda t: 0.05 * t)
    assert sim.effort()[0, COLUMN] == pytest.approx(asked_nm(motion)[-1], abs=1e-9)


@pytest.mark.parametrize("balanced", [True, False])
def test_integral_action_has_balanced_what_acts_on_a_joint_at_its_target(
    balanced: bool,
) -> None:
    half = make_effect("gravity_mismatch", share=0.5, arm="right")
    sim = start(half, *[on_joint5("integral_action", rate_per_s=2.0)] * balanced)
    joints = sim.proprioception()[0].copy()
    sim.place_arms(joints, joints)
    moved = np.abs(drive(sim, 0.5)["q"] - RIGHT_HOME[4]).max()
    assert (
        moved < 1e-4 if balanced else moved > 1e-3
    )  # the other joints sag a little, and change its load


SEEN = {
    "peak_torque_nm": 4.0,
    "peak_speed_rad_per_s": 0.8,
    "span_rad": 1.5,
    "duration_s": 10.0,
}


@pytest.mark.parametrize(
    ("name", "parameter", "expected"),
    [
        ("torque_saturation", "torque_max_nm", [2.2, 3.0, 3.52, 3.88]),
        ("slew_limit", "speed_rad_per_s", [0.28, 0.48, 0.64, 0.736, 0.784]),
        ("coulomb_friction", "torque_nm", [0.12, 0.4, 1.2]),
        ("viscous_friction", "damping_nms_per_rad", [1 / 3, 1.0, 3.0]),
        ("torque_scale", "factor", [1.2, 0.8]),
    ],
)
def test_a_search_starts_where_the_recordings_say(
    name: str, parameter: str, expected: list[float]
) -> None:
    assert [
        values[parameter] for values in effects.get(name).starts(SEEN)
    ] == pytest.approx(expected)


@pytest.mark.parametrize("periods", [6.1, 7.3, 24.0, 57.4])
def test_a_search_for_cogging_starts_near_enough_to_see_any_number_of_periods(
    periods: float,
) -> None:
    """Over the span one of the starts explains most of the wave: it does not run out of step."""
    q = np.linspace(0.0, SEEN["span_rad"], 400)
    wave = np.sin(periods * q + 0.9)
    starts = effects.get("cogging").starts(SEEN)
    explained = []
    for n in {values["periods"] for values in starts}:
        basis = np.column_stack([np.sin(n * q), np.cos(n * q)])
        left = wave - basis @ np.linalg.lstsq(basis, wave, rcond=None)[0]
        explained.append(1 - np.sum(left**2) / np.sum(wave**2))
    assert max(explained) > 0.7
    assert {values["phase_rad"] for values in starts} == {
        0.0,
        np.pi / 2,
        np.pi,
        -np.pi / 2,
    }


def test_commands_may_be_sent_one_by_one_or_together() -> None:
    names = {
        "load_friction": {"share": 0.1},
        "torque_lag": {"time_constant_s": 0.005},
        "command_delay": {"delay_s": 0.01},
    }
    together, apart = (
        start(*(make_effect(name, **values) for name, values in names.items()))
        for _ in range(2)
    )
    commands = together.targets + 0.05 * np.sin(np.arange(1, 9))[:, None, None]
    together.advance(commands, 6)
    for command in commands:
        apart.advance(command[None], 6)
    np.testing.assert_array_equal(together.arrays["qpos"], apart.arrays["qpos"])


@pytest.mark.parametrize(
    "name", ["torque_scale", "torque_lag", "load_friction", "gear_friction"]
)
def test_the_first_reset_of_a_simulation_is_like_every_other(name: str) -> None:
    """What an effect feels at a reset must not depend on whether the simulation has been reset before."""
    effect = make_effect(name, joints=["joint2"])
    strength = next(p for p in effect.parameters() if p.absent is not None)
    setattr(effect, strength.name, strength.typical)
    config = TwinConfig(effects=[effect])
    sim = Simulation(Bench(), config)
    seen = []
    for _ in range(2):
        sim.reset([0])
        sim.step(sim.targets + 0.05)
        seen.append(sim.proprioception()[0].copy())
    np.testing.assert_array_equal(*seen)
