"""The surrogate's rigid bodies against MuJoCo, and against what mechanics says of any arm."""

import mujoco
import numpy as np
import pytest

from taccorl.sim.robot import RobotConfig
from taccorl.sim.twin import TwinConfig, empty_bench
from taccorl.surrogate.arm import GRAVITY, bodies, mass_matrix, torques

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
