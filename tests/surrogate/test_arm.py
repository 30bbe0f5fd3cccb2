"""The surrogate's rigid bodies against MuJoCo, and against what mechanics says of any arm."""

import mujoco
import numpy as np
import pytest

from taccorl.sim.robot import RobotConfig, link_poses
from taccorl.sim.twin import TwinConfig, empty_bench
from taccorl.surrogate.arm import GRAVITY, bodies, factor, mass_matrix, solve, torques

ARMATURE = 0.01
NONE = np.zeros(6)


@pytest.fixture(params=["manufacturer", "menagerie"])
def config(request) -> RobotConfig:
    return RobotConfig(inertias=request.param)


@pytest.mark.parametrize("arm", ["left", "right"])
def test_torques_are_those_of_mujocos_inverse_dynamics(config, arm):
    twin = TwinConfig(robot=config)
    twin.robot.gravity_compensation = 0.0
    model = empty_bench(twin).compile()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # the discrete one changes what "inverse" means
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
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
            torques(own, q, v, a, GRAVITY) + ARMATURE * a, data.qfrc_inverse[dof], rtol=0, atol=1e-9
        )


def test_mass_matrix_is_what_accelerations_cost(config):
    arm = bodies(config, 0.02, ((0.5, 0.0, 0.0, 0.1),))
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, a = rng.uniform(-2, 2, 6), rng.normal(size=6)
        mass = mass_matrix(arm, q)
        np.testing.assert_allclose(mass @ a, torques(arm, q, NONE, a, 0.0), rtol=0, atol=1e-12)
        np.testing.assert_allclose(mass, mass.T, atol=1e-14)
        assert np.linalg.eigvalsh(mass).min() > 0


def test_a_payload_weighs_its_mass_times_its_lever_arm():
    # Joint 2 turns about the horizontal y axis of the base through (0, 0, 0.123); the ball sits on link 6.
    config = RobotConfig()
    q = np.array([0.0, 1.2, -1.5, 0.0, 0.3, 0.0])
    link6 = link_poses(q)[5]
    ball = link6 @ [0.02, -0.01, 0.1, 1.0]
    more = torques(bodies(config, 0.02, ((0.5, 0.02, -0.01, 0.1),)), q, NONE, NONE, GRAVITY) - torques(
        bodies(config, 0.02), q, NONE, NONE, GRAVITY
    )
    axis = link_poses(q)[1][:3, 2]
    lever = ball[:3] - link_poses(q)[1][:3, 3]
    assert more[1] == pytest.approx(axis @ np.cross(lever, [0, 0, 0.5 * GRAVITY]), abs=1e-12)
    assert more[0] == pytest.approx(0.0, abs=1e-12)  # gravity does not turn a vertical axis


def test_factor_and_solve_undo_a_matrix():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6))
    matrix, x = root @ root.T + np.eye(6), rng.normal(size=6)
    b = matrix @ x
    lower = matrix.copy()
    factor(lower)
    solve(lower, b)
    np.testing.assert_allclose(b, x, atol=1e-12)


def test_gravity_is_the_slope_of_potential_energy():
    arm, config = bodies(RobotConfig(), 0.02), RobotConfig()
    assert config.inertias == "manufacturer"
    q = np.array([0.3, 1.2, -1.1, 0.4, 0.5, -0.2])

    def energy(angles: np.ndarray) -> float:
        poses = link_poses(angles)
        return GRAVITY * sum(
            float((pose[2, :3] @ h) + m * pose[2, 3]) for pose, h, m in zip(poses, arm.moment, arm.mass, strict=True)
        )

    slope = [(energy(q + d) - energy(q - d)) / 2e-6 for d in np.eye(6) * 1e-6]
    np.testing.assert_allclose(torques(arm, q, NONE, NONE, GRAVITY), slope, atol=1e-7)
