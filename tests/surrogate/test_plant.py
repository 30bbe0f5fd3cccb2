"""The surrogate's joint under test: what can be said of it beforehand."""

import math

import mujoco
import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from taccorl.alignment.measurements.motions import (
    CHIRP,
    LOADED_CHIRP,
    POSES,
    RATE_HZ,
    Motion,
    Room,
)
from taccorl.sim.robot import RobotConfig, link_poses
from taccorl.sim.twin import TwinConfig, empty_bench
from taccorl.surrogate.arm import GRAVITY, bodies, mass_matrix, torques
from taccorl.surrogate.hidden import KINDS, Change, Scale
from taccorl.surrogate.plant import Arm, Drive, Run, simulate
from taccorl.surrogate.robot import Robot, inertia_and_weight

NONE = np.zeros(6)
JOINT = 5
POSE = POSES[JOINT - 1]
INERTIA, WEIGHT = inertia_and_weight(np.array(POSE), JOINT)
OMEGA, ZETA = 15.0, 1.0
KP, KD = INERTIA * OMEGA**2, 2 * ZETA * OMEGA * INERTIA
ROOM = Room.of(JOINT, POSE[JOINT - 1], INERTIA, WEIGHT)


def robot(torque_ff: float = 0.0, **drive: float) -> Robot:
    return Robot(
        f"left_joint{JOINT}",
        (KP, KD, torque_ff),
        [Change(drive=drive)] if drive else [],
        POSE,
    )


def of_targets(target: np.ndarray) -> Motion:
    return Motion(name="made", target=lambda room: POSE[JOINT - 1] + target)


def joint(run: Run) -> np.ndarray:
    """(T,) rad from the middle, at the rows."""
    return run.angle[::5, JOINT - 1] - POSE[JOINT - 1]


REST = of_targets(np.zeros(400))
SLOW = of_targets(
    0.3 * np.interp(np.arange(2400) / 2400, [0, 0.25, 0.75, 1.0], [0, 1, -1, 0])
)  # 0.1 rad/s


def test_without_effects_a_joint_is_the_linear_one_of_its_inertia_and_gains():
    discrete = cont2discrete(
        ([KP / INERTIA], [1.0, KD / INERTIA, KP / INERTIA]), 1 / RATE_HZ
    )
    target = CHIRP.target(ROOM) - POSE[JOINT - 1]
    linear = lfilter(np.ravel(discrete[0]), discrete[1], target)
    swing = np.sqrt(np.mean(linear**2))
    # Half a step of the twin (0.42 ms) more of damping than the continuous joint, see LATE_S: 3e-3 of the swing.
    assert (
        np.sqrt(np.mean((joint(robot().run(CHIRP, ROOM)) - linear) ** 2)) < 5e-3 * swing
    )


def test_it_rests_where_its_constant_torque_turns_it():
    run = robot(torque_ff=0.01 * KP).run(REST, ROOM)
    np.testing.assert_allclose(joint(run), 0.01, atol=1e-6)
    np.testing.assert_allclose(
        run.effort[:, JOINT - 1], 0.0, atol=1e-6
    )  # the weight is carried


def test_energy_stays_when_nothing_drives_or_brakes():
    arm = bodies(RobotConfig(), 0.02)
    free = Arm(arm, arm, 0.0, np.full(6, 0.01), NONE, NONE, NONE)
    start = np.array([0.0, 1.0, -1.0, 0.3, 0.2, 0.1])
    target = np.tile(start, (100, 1))
    drive = Drive(kp=0.0, kd=0.0, torque_ff=0.0)
    run = simulate(
        free, 4, drive, target, start, np.zeros((500, 6)), np.zeros(500, np.int64), 0
    )

    def energy(q: np.ndarray, v: np.ndarray) -> float:
        moving = 0.5 * v @ (mass_matrix(arm, q) + 0.01 * np.eye(6)) @ v
        poses = link_poses(q)
        return moving + GRAVITY * sum(
            float(p[2, :3] @ h + m * p[2, 3])
            for p, h, m in zip(poses, arm.moment, arm.mass, strict=True)
        )

    total = np.array(
        [energy(q, v) for q, v in zip(run.angle[::10], run.velocity[::10], strict=True)]
    )
    fallen = 0.5 * run.velocity[-1] @ run.velocity[-1]
    assert fallen > 1.0  # it did move
    assert np.ptp(total) < 2e-3 * (
        energy(run.angle[-1], run.velocity[-1]) - energy(run.angle[-1], NONE)
    )


def test_stiction_is_greater_in_slow_motion_than_in_fast():
    sticky = robot(coulomb=0.02, stribeck=0.06, stribeck_speed=0.05)
    for speed in (0.007, 0.3):
        run = sticky.run(of_targets(speed * np.arange(800) / 200), ROOM)
        friction = 0.02 + 0.06 * math.exp(-((speed / 0.05) ** 2))
        assert run.effort[-200:, JOINT - 1].mean() == pytest.approx(friction, rel=0.02)


@pytest.mark.parametrize(
    ("drive", "up_nm", "down_nm"),
    [
        ({"coulomb": 0.05}, 0.05, -0.05),
        ({"coulomb": 0.05, "asymmetry": 0.4}, 0.07, -0.03),
        ({"viscous": 0.3}, 0.3 * 0.1, -0.3 * 0.1),
        ({"quadratic": 2.0}, 2.0 * 0.1**2, -2.0 * 0.1**2),
    ],
)
def test_in_slow_motion_friction_costs_what_its_law_says(drive, up_nm, down_nm):
    effort = robot(**drive).run(SLOW, ROOM).effort[:, JOINT - 1]
    assert effort[1500:2500].mean() == pytest.approx(up_nm, rel=0.02)
    assert effort[5500:6500].mean() == pytest.approx(down_nm, rel=0.04)


def test_an_encoders_bias_is_taken_for_the_angle():
    biased = robot(encoder_bias=0.05)
    run = biased.run(REST, ROOM)
    np.testing.assert_allclose(joint(run), -0.05, atol=1e-5)
    np.testing.assert_allclose(
        biased.reported(run)[:, JOINT - 1], POSE[JOINT - 1], atol=1e-5
    )


# Joint 1 turns about a vertical axis: no weight, so that in its play the motor is alone.
INERTIA_1, _ = inertia_and_weight(np.array(POSES[0]), 1)
KP_1, KD_1 = INERTIA_1 * OMEGA**2, 2 * ZETA * OMEGA * INERTIA_1


def geared(target: np.ndarray, **drive: float) -> np.ndarray:
    """(T,) rad of joint 1's motor."""
    made = Robot("right_joint1", (KP_1, KD_1, 0.0), [Change(drive=drive)], POSES[0])
    room = Room.of(1, 0.0, INERTIA_1, 0.0)
    return made.run(Motion(name="made", target=lambda room: target), room).angle[::5, 0]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[pytest.mark.slow] * (k % 4 > 0))
        for k, n in enumerate(KINDS)
    ],
)
def test_every_hidden_effect_changes_what_is_reported(name):
    k = KINDS[name]
    number = 5 if 5 in k.joints else k.joints[-1]  # a joint with weight
    pose = np.array(POSES[number - 1])
    inertia, weight = inertia_and_weight(pose, number)
    kp, kd = inertia * OMEGA**2, 2 * OMEGA * inertia
    room = Room.of(number, pose[number - 1], inertia, weight)
    plain = Robot(f"left_joint{number}", (kp, kd, 0.01 * kp), [], tuple(pose))
    run = plain.run(LOADED_CHIRP, room)
    scale = Scale(
        kp=kp,
        kd=kd,
        inertia=inertia,
        torque=float(np.abs(run.effort[:, number - 1] + plain.carried_nm(run)).max()),
        speed=3.0,
        centre=pose[number - 1],
    )
    low, high = k.severity(scale)
    shape = k.shape(np.random.default_rng(0), scale)
    moved = []
    for severity in (math.sqrt(low * high), high):
        change = k.plant(k.values(severity, scale, shape))
        changed = Robot(
            f"left_joint{number}", (kp, kd, 0.01 * kp), [change], tuple(pose)
        )
        other = changed.reported(changed.run(LOADED_CHIRP, room))
        assert np.isfinite(other).all()
        moved.append(np.abs(other - plain.reported(run)).max())
    assert moved[0] > 1e-5 and moved[1] > moved[0]


# ---- rigid bodies against MuJoCo, and against what mechanics says of any arm ----

ARMATURE = 0.01


@pytest.fixture(params=["manufacturer", "menagerie"])
def config(request) -> RobotConfig:
    return RobotConfig(inertias=request.param)


@pytest.mark.parametrize("arm", ["left", "right"])
def test_torques_are_those_of_mujocos_inverse_dynamics(config, arm):
    twin = TwinConfig(robot=config)
    twin.robot.gravity_compensation = 0.0
    model = empty_bench(twin).compile()
    model.opt.integrator = (
        mujoco.mjtIntegrator.mjINT_EULER
    )  # the discrete one changes what "inverse" means
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    )
    data = mujoco.MjData(model)
    joints = [model.joint(f"{arm}_joint{k}") for k in range(1, 7)]
    at, dof = [j.qposadr[0] for j in joints], [j.dofadr[0] for j in joints]
    for finger in "ab":
        data.qpos[model.joint(f"{arm}_finger_{finger}").qposadr] = 0.01
    own = bodies(config, opening_m=0.02)
    rng = np.random.default_rng(0)
    for _ in range(50):
        q, v, a = rng.uniform(-1.5, 1.5, 6), rng.normal(0, 2, 6), rng.normal(0, 10, 6)
        data.qpos[at], data.qvel[dof] = q, v
        data.qacc[:] = 0.0
        data.qacc[dof] = a
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(
            torques(own, q, v, a, GRAVITY) + ARMATURE * a,
            data.qfrc_inverse[dof],
            rtol=0,
            atol=1e-9,
        )


def test_mass_matrix_is_what_accelerations_cost(config):
    arm = bodies(config, 0.02, ((0.5, 0.0, 0.0, 0.1),))
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, a = rng.uniform(-2, 2, 6), rng.normal(size=6)
        mass = mass_matrix(arm, q)
        np.testing.assert_allclose(
            mass @ a, torques(arm, q, NONE, a, 0.0), rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(mass, mass.T, atol=1e-14)
        assert np.linalg.eigvalsh(mass).min() > 0
