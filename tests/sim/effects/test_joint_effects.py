"""Effects act on the arms, grippers, joints and simulations that are chosen, only. test_joint_laws.py tests their equations."""

import mujoco
import numpy as np
import pytest
from joint_bench import COLUMN, GRAVITY, drive, on_joint5
from press_bench import RIGHT_HOME, start

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect


def test_delays_reach_grippers_too() -> None:
    sim = start(make_effect("command_delay", delay_s=0.1, arm="right", joints=["gripper"]))
    targets = sim.targets.copy()
    targets[0, 13] -= 0.03
    openings = []
    for _ in range(48):  # 0.2 s
        sim.advance(targets[None], 5)
        openings.append(sim.proprioception()[0, 13])
    assert np.ptp(openings[:24]) < 1e-6
    assert openings[-1] < openings[0] - 0.005


def test_a_gravity_mismatch_of_one_arm_leaves_the_other_where_it_was() -> None:
    sim = start(make_effect("gravity_mismatch", share=0.8, arm="right"))
    drive(sim, 0.5)
    np.testing.assert_allclose(sim.proprioception()[0, :6], start().proprioception()[0, :6], atol=1e-9)


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.1), (0.08, -0.05, 0.15)])
def test_a_payload_sags_every_joint_by_its_moment_over_the_stiffness(centre: tuple[float, float, float]) -> None:
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
    loaded = start(make_effect("payload", mass_kg=0.3, arm="right", **dict(zip(keys, centre, strict=True))))
    drive(loaded, 1.5)
    sag = loaded.proprioception()[0, 7:13] - RIGHT_HOME
    assert np.abs(expected).max() > 3e-4
    np.testing.assert_allclose(sag, expected, atol=0.02 * np.abs(expected).max())
    with pytest.raises(TaccorlError, match=r"payload: mass_kg is -0\.3 kg, below 0, which only robot files"):
        start(make_effect("payload", mass_kg=-0.3))


def test_a_lagging_command_of_one_simulation_waits_while_only_another_advances() -> None:
    sim = start(on_joint5("command_lag", time_constant_s=0.04), num_sims=2)
    rest = sim.targets.copy()
    for ids in ([0], [0], [1]):
        sim.advance(rest[None] + 0.1, 6, np.array(ids))
    moved = sim.arrays["ctrl"][:, sim.action_actuators[COLUMN]] - rest[:, COLUMN]
    np.testing.assert_allclose(moved, 0.1 * -np.expm1([-0.01 / 0.04, -0.005 / 0.04]), rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "values", "field"),
    [
        ("coulomb_friction", {"torque_nm": 0.3}, "dof_frictionloss"),
        ("viscous_friction", {"damping_nms_per_rad": 2.0}, "dof_damping"),
        ("armature", {"added_kgm2": 0.2}, "dof_armature"),
    ],
)
def test_only_the_chosen_joints_change(name: str, values: dict[str, float], field: str) -> None:
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
                make_effect("speed_delay", arm=a, joints=[f"joint{k}" for k in range(1, 7)], delay_s=3e-3)
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
            "3 ms would reduce the inertia by" in t and f"MuJoCo applies {1e3 * applied_s:.3g} ms" in t for t in mine
        )
    assert (lost[[late.model.joint(f"left_joint{k}").dofadr[0] for k in range(1, 7)]] > 0).all()
    for _ in range(50):
        late.advance(late.targets[None] + 0.02, 6)
    assert np.isfinite(late.arrays["qpos"]).all()
