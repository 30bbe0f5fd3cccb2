"""MIT impedance control: the gains of the paper are in the model, and joints answer as the arithmetic says."""

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig, empty_bench


def test_actuators_hold_the_paper_s_numbers():
    model = empty_bench(TwinConfig()).compile()
    for arm in ROBOT.arms:
        for joint, kp, kd, bias in zip(
            ROBOT.joints, ROBOT.kp_nm_per_rad, ROBOT.kd_nms_per_rad, ROBOT.torque_ff_nm, strict=True
        ):
            actuator = model.actuator(f"{arm}_{joint}")
            assert actuator.gainprm[0] == kp
            np.testing.assert_array_equal(actuator.biasprm[:3], [bias, -kp, -kd])


@pytest.mark.parametrize("joint", [0, 3, 4, 5])
def test_step_response_is_a_first_order_lag_with_kd_over_kp(joint):
    # τ = K_d / K_p; after one τ a step is 1 − 1/e = 63.2 % done (inertia is small against K_d² / K_p).
    sim = Simulation(Bench())
    sim.reset([0])
    before = sim.proprioception()[0].copy()
    target = sim.targets[0].copy()
    target[7 + joint] += 0.05
    tau_s = ROBOT.kd_nms_per_rad[joint] / ROBOT.kp_nm_per_rad[joint]
    steps = round(tau_s / sim.config.physics.timestep_s)
    sim.advance(target[None, None], steps)
    done = (sim.proprioception()[0, 7 + joint] - before[7 + joint]) / 0.05
    assert done == pytest.approx(1 - np.exp(-1), abs=0.03)


def test_arm_rests_torque_over_stiffness_away_from_its_target():
    sim = Simulation(Bench())
    sim.reset([0])
    np.testing.assert_allclose(sim.proprioception()[0, 7:13], Bench.home_rad["right"], atol=1e-9)
    offset = sim.proprioception()[0, 7:13] - sim.targets[0, 7:13]
    np.testing.assert_allclose(offset, np.array(ROBOT.torque_ff_nm) / ROBOT.kp_nm_per_rad, atol=1e-9)
    for _ in range(30):
        sim.step(sim.targets.copy())
    np.testing.assert_allclose(sim.proprioception()[0, 7:13], Bench.home_rad["right"], atol=2e-5)  # it stays there


def test_an_arm_may_have_gains_of_its_own():
    own = ControllerConfig(kp_nm_per_rad=[100.0] * 6, torque_ff_nm=[0.5] * 6)
    sim = Simulation(Bench(), TwinConfig(arm_controllers={"right": own}))
    sim.reset([0])
    offset = sim.proprioception()[0] - sim.targets[0]
    np.testing.assert_allclose(offset[7:13], 0.5 / 100.0, atol=1e-9)
    np.testing.assert_allclose(offset[:6], np.array(ROBOT.torque_ff_nm) / ROBOT.kp_nm_per_rad, atol=1e-9)
    with pytest.raises(TaccorlError, match=r"arm_controllers: no arm 'rigth'; did you mean 'right'"):
        TwinConfig(arm_controllers={"rigth": own})


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"kp_nm_per_rad": [1.0] * 5}, "kp_nm_per_rad: 5 values"),
        ({"kp_nm_per_rad": [1.0] * 5 + [0.0]}, r"controller\.kp_nm_per_rad: .*0\.0\].* finite number > 0"),
        ({"kd_nms_per_rad": [1, 1, 1, 1, 1, -1]}, r"controller\.kd_nms_per_rad: .*-1\].* finite number ≥ 0"),
        ({"torque_ff_nm": [0.0] * 5 + [float("nan")]}, r"controller\.torque_ff_nm: .*nan\].* finite number"),
        ({"kp_nm_per_rad": [1.0] * 5 + ["2"]}, r"controller\.kp_nm_per_rad: .*'2'\].* finite number"),
    ],
)
def test_wrong_gains_are_refused_by_name(settings, said):
    with pytest.raises(TaccorlError, match=said):
        ControllerConfig(**settings)
