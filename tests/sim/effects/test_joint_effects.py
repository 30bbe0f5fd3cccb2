"""Each effect of the arm against its closed form, on joint 5 of the right arm unless said otherwise.

At rest at home everything is in balance: the controller's targets stand T_ref / K_p below the angles, and weight is carried.
K_d damps so heavily that inertia does not show: a joint approaches its target by exp(−t K_p / K_d).
"""

import mujoco
import numpy as np
import pytest
from joint_bench import COLUMN, GRAVITY, KP, STEP_S, TORQUE_FF, drive, on_joint5, static_torque_nm
from press_bench import RIGHT_HOME, PressBench, start

from taccorl.robots import ROBOT
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.effects import make_effect
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig


@pytest.mark.parametrize("delay_s", [0.02, 0.0204])
def test_a_delayed_command_shifts_the_step_response_by_the_delay(delay_s: float) -> None:
    plain = drive(start(), 0.25, lambda t: 0.1)
    late = drive(start(on_joint5("command_delay", delay_s=delay_s)), 0.25, lambda t: 0.1)
    expected = np.interp(late["t"] - delay_s, np.r_[0.0, plain["t"]], np.r_[RIGHT_HOME[4], plain["q"]])
    np.testing.assert_allclose(late["q"], expected, atol=plain["v"].max() * STEP_S)
    assert np.ptp(late["q"][late["t"] < delay_s]) < 1e-9, "at rest until the command arrives"
    if delay_s == 0.02:  # 24 physics steps
        np.testing.assert_allclose(late["q"][24:], plain["q"][:-24], atol=1e-9)


def test_a_delayed_sensor_reports_what_was_and_leaves_the_arm_alone() -> None:
    plain, late = (drive(start(*e), 0.2, lambda t: 0.1) for e in ([], [on_joint5("sensor_delay", delay_s=0.03)]))
    np.testing.assert_array_equal(late["q"], plain["q"])
    np.testing.assert_allclose(late["reported"][36:], plain["q"][:-36], atol=1e-12)  # 30 ms are 36 physics steps
    np.testing.assert_array_equal(late["reported"][:36], RIGHT_HOME[4])


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


def test_armature_lengthens_the_period_of_an_undamped_joint() -> None:
    """ω² = K_p / (J + ΔJ): between two ΔJ, K_p (1/ω₂² − 1/ω₁²) is their difference, whatever J is."""
    inertia = []
    for added in (0.1, 0.3):
        config = TwinConfig(effects=[on_joint5("armature", added_kgm2=added)])
        config.controller = ControllerConfig(kd_nms_per_rad=[*ROBOT.kd_nms_per_rad[:4], 0.0, ROBOT.kd_nms_per_rad[5]])
        sim = Simulation(PressBench(), config)
        sim.reset([0])
        motion = drive(sim, 2.0, lambda t: 0.02)
        q = motion["q"] - motion["q"].mean()
        up = np.flatnonzero((q[:-1] < 0) & (q[1:] >= 0))
        crossings = motion["t"][up] - STEP_S * q[up + 1] / (q[up + 1] - q[up]) + STEP_S
        period = np.diff(crossings).mean()
        inertia.append(KP * (period / (2 * np.pi)) ** 2)
    assert inertia[1] - inertia[0] == pytest.approx(0.2, rel=0.01)


def test_a_saturated_drive_accelerates_in_proportion_to_its_torque() -> None:
    speeds = []
    for torque in (1.0, 2.0):
        motion = drive(start(on_joint5("torque_saturation", torque_max_nm=torque)), 0.005, lambda t: 0.5)
        load = static_torque_nm(start())
        speeds.append(motion["v"][-1] / (torque - load))
        assert motion["v"][-1] < 1.0
    assert speeds[0] == pytest.approx(speeds[1], rel=0.02)
    free = drive(start(), 0.005, lambda t: 0.5)  # K_p · 0.5 rad = 76 N·m
    assert free["v"][-1] > 1.5


def test_a_gravity_mismatch_sags_by_the_missing_torque_over_the_stiffness() -> None:
    sim = start(make_effect("gravity_mismatch", share=0.8, arm="right"))
    load = static_torque_nm(sim)
    motion = drive(sim, 1.5)
    assert abs(load) > 0.1
    assert motion["q"][-1] - RIGHT_HOME[4] == pytest.approx(-0.2 * load / KP, rel=0.02)
    left = sim.proprioception()[0, :6]
    np.testing.assert_allclose(left, start().proprioception()[0, :6], atol=1e-9)


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


@pytest.mark.parametrize("angle_rad", [0.9, -0.9])
def test_weight_lays_a_link_against_one_end_of_its_play_while_the_encoder_sees_none(angle_rad: float) -> None:
    sim = start(on_joint5("backlash", play_rad=0.01))
    joints = sim.proprioception()[0].copy()
    joints[COLUMN] = angle_rad
    sim.place_arms(joints, joints - np.eye(14)[COLUMN] * TORQUE_FF / KP)
    load = static_torque_nm(sim)
    assert abs(load) > 0.05
    drive(sim, 0.4)
    play = sim.batch.joint("right_joint5_backlash").qpos[0, 0]
    assert play == pytest.approx(-np.sign(load) * 0.005, abs=5e-5)
    assert sim.proprioception()[0, COLUMN] == pytest.approx(angle_rad, abs=1e-4)


def test_a_compliant_joint_bends_by_the_torque_that_its_gear_carries() -> None:
    sim = start(on_joint5("joint_compliance", compliance_rad_per_nm=0.01))
    drive(sim, 0.5)
    load = static_torque_nm(sim)
    bend = sim.batch.joint("right_joint5_compliance").qpos[0, 0]
    assert abs(load) > 0.1
    assert bend == pytest.approx(-0.01 * load, rel=0.01)
    assert sim.proprioception()[0, COLUMN] == pytest.approx(RIGHT_HOME[4], abs=1e-5)


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
