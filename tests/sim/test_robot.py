"""The arm from its number table: joint frames, masses, and what gripping does."""

import re

import mujoco
import numpy as np
import pytest

from pipelines.benchmarks.grip_rig import gripped, in_hand_m, rest, shake
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.robots.bimanual_piper import INERTIAS
from taccorl.sim.bench import Bench
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.robot import RobotConfig, add_arm, link_poses
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig, empty_bench


def compiled(**robot) -> mujoco.MjModel:
    return empty_bench(TwinConfig(robot=RobotConfig(**robot))).compile()


def test_forward_kinematics_agrees_with_the_published_joint_frames():
    model = compiled()
    data = mujoco.MjData(model)
    limits = np.array([link.range_rad for link in ROBOT.links])
    for seed in range(20):
        for arm in ROBOT.arms:
            joints = np.random.default_rng(seed).uniform(*limits.T)
            data.qpos[[model.joint(f"{arm}_{j}").qposadr[0] for j in ROBOT.joints]] = (
                joints
            )
            mujoco.mj_kinematics(model, data)
            base = data.body(f"{arm}_base_link").xpos
            for i, link in enumerate(ROBOT.links):
                ours = link_poses(joints)[i]
                body = data.body(f"{arm}_{link.name}")
                np.testing.assert_allclose(body.xpos - base, ours[:3, 3], atol=1e-12)
                np.testing.assert_allclose(
                    body.xmat.reshape(3, 3), ours[:3, :3], atol=1e-12
                )


def test_both_mass_sets_are_physical_and_differ_by_a_third():
    moving = {
        name: sum(link.mass_kg for link in links) + 2 * 0.025
        for name, links in INERTIAS.items()
    }
    assert moving["manufacturer"] == pytest.approx(3.64, abs=0.005)
    assert moving["menagerie"] == pytest.approx(2.20, abs=0.01)
    for links in INERTIAS.values():
        for link in links:
            xx, yy, zz, xy, xz, yz = link.about_com_kgm2()
            a, b, c = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            assert a > 0
            assert a + b >= c * (
                1 - 1e-6
            )  # no mass distribution breaks the triangle inequality


@pytest.mark.parametrize("inertias", ["manufacturer", "menagerie"])
def test_compiled_model_has_the_table_s_masses_and_limits(inertias):
    model = compiled(inertias=inertias)
    for arm in ROBOT.arms:
        for link, inertia in zip(ROBOT.links, INERTIAS[inertias], strict=True):
            body = model.body(f"{arm}_{link.name}")
            assert body.mass[0] == pytest.approx(inertia.mass_kg)
            np.testing.assert_allclose(body.ipos, inertia.com_link_m, atol=1e-12)
            trace = sum(
                inertia.about_com_kgm2()[:3]
            )  # of the tensor: the same in any axes
            assert body.inertia.sum() == pytest.approx(trace)
            np.testing.assert_allclose(
                model.joint(f"{arm}_joint{link.name[-1]}").range, link.range_rad
            )


def test_arms_are_mirror_images_and_stand_where_they_were_told():
    model = compiled(mount_height_m=0.1, mount_spacing_m=0.5)
    np.testing.assert_allclose(model.body("left_base_link").pos, [0, 0.25, 0.1])
    np.testing.assert_allclose(model.body("right_base_link").pos, [0, -0.25, 0.1])


def test_taxel_frames_look_at_each_other_and_run_from_palm_to_tip():
    model = compiled()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for arm in ROBOT.arms:
        hand = data.body(f"{arm}_link6").xmat.reshape(3, 3)
        a, b = (data.site(f"{arm}_{f}").xmat.reshape(3, 3) for f in "ab")
        np.testing.assert_allclose(a[:, 2], -b[:, 2], atol=1e-12)
        for frame in (a, b):
            np.testing.assert_allclose(frame[:, 1], hand[:, 2], atol=1e-12)
        # closed fingers: both undeformed surfaces lie in the hand's middle plane
        np.testing.assert_allclose(
            data.site(f"{arm}_a").xpos, data.site(f"{arm}_tcp").xpos, atol=1e-12
        )
    for pad in ROBOT.pads:
        half = model.geom(pad).size
        assert half[[0, 2]] * 2 == pytest.approx(
            [ROBOT.pad.width_m, ROBOT.pad.length_m]
        )


def test_an_arm_touches_table_parts_and_the_other_arm_but_not_itself():
    model = compiled()
    bits = {
        arm: {
            (int(model.geom_contype[g]), int(model.geom_conaffinity[g]))
            for g in _geoms(model, arm)
        }
        for arm in ROBOT.arms
    }
    (left,), (right,) = (bits[arm] - {(1, 1)} for arm in ROBOT.arms)

    def collide(one: tuple[int, int], other: tuple[int, int]) -> bool:
        return bool(one[0] & other[1] or other[0] & one[1])

    assert collide(left, right)
    assert not collide(left, left)
    assert not collide(right, right)
    assert collide(left, (1, 1))
    assert collide(right, (1, 1))


def _geoms(model: mujoco.MjModel, arm: str) -> list[int]:
    return [
        g
        for g in range(model.ngeom)
        if model.body(model.geom_bodyid[g]).name.startswith(arm)
    ]


# gripping -----------------------------------------------------------------------------------------------------------------


def test_gripped_part_creeps_less_than_the_issue_allows():
    model, data = gripped(0.04, 10.0)
    before = in_hand_m(data)
    rest(model, data, 2.0)
    assert np.linalg.norm(in_hand_m(data) - before) / 2.0 < 0.02e-3  # m/s


def test_gripped_part_stays_in_the_hand_when_it_is_shaken():
    model, data = gripped(0.04, 10.0)
    assert shake(model, data) < 1e-3


def test_gripper_closes_to_where_the_force_is_asked_for():
    _, data = gripped(0.04, 20.0)
    force_n = data.actuator("right_gripper").force[0]
    assert force_n == pytest.approx(-20.0, rel=0.03)


def test_fingers_stay_mirror_images_under_a_one_sided_push():
    model, data = gripped(0.04, 10.0)
    finger = data.body("right_finger_a").id
    data.xfrc_applied[finger, :3] = 5.0 * data.site("right_a").xmat.reshape(3, 3)[:, 2]
    mujoco.mj_step(model, data, nstep=600)
    a, b = (data.joint(f"right_finger_{f}").qpos[0] for f in "ab")
    assert abs(a - b) < 1e-4
    assert 0 <= a <= ROBOT.finger_stroke_m


def test_an_arm_can_be_built_alone():
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_arm(spec, "left", RobotConfig(pads="rigid"))
    model = spec.compile()
    assert model.nv == 8  # six joints, two fingers, no springs


@pytest.mark.parametrize(
    ("name", "wrong", "wanted"),
    [
        *(
            (name, wrong, "finite number > 0")
            for name in (
                "mount_spacing_m",
                "pad_stiffness_n_per_m",
                "grip_stiffness_n_per_m",
                "grip_force_max_n",
            )
            for wrong in (0.0, -1.0, float("inf"))
        ),
        *(
            (name, wrong, "finite number ≥ 0")
            for name in (
                "armature_kgm2",
                "pad_damping_ns_per_m",
                "grip_damping_ns_per_m",
            )
            for wrong in (-1e-9, float("nan"))
        ),
        *(
            (name, float("nan"), "finite number")
            for name in ("mount_height_m", "gravity_compensation")
        ),
        ("pad_tilt_stiffness_nm_per_rad", (40.0, 0.0), "finite number > 0"),
        ("pad_tilt_stiffness_nm_per_rad", (40.0,), "not two numbers"),
        ("armature_kgm2", "0.01", "finite number ≥ 0"),
    ],
)
def test_numbers_that_no_robot_has_are_refused_by_name(name, wrong, wanted):
    with pytest.raises(
        TaccorlError, match=rf"robot\.{name}: {re.escape(str(wrong))} .*{wanted}"
    ):
        RobotConfig(**{name: wrong})


def test_an_arm_may_have_no_rotor_inertia_no_damping_and_carry_more_than_its_weight():
    RobotConfig(
        armature_kgm2=0.0,
        pad_damping_ns_per_m=0.0,
        grip_damping_ns_per_m=0,
        gravity_compensation=1.2,
        mount_height_m=-0.1,
    )


# MIT impedance control -----------------------------------------------------------------------------------------------------


def test_actuators_hold_the_paper_s_numbers():
    model = empty_bench(TwinConfig()).compile()
    for arm in ROBOT.arms:
        for joint, kp, kd, bias in zip(
            ROBOT.joints,
            ROBOT.kp_nm_per_rad,
            ROBOT.kd_nms_per_rad,
            ROBOT.torque_ff_nm,
            strict=True,
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
    np.testing.assert_allclose(
        sim.proprioception()[0, 7:13], Bench.home_rad["right"], atol=1e-9
    )
    offset = sim.proprioception()[0, 7:13] - sim.targets[0, 7:13]
    np.testing.assert_allclose(
        offset, np.array(ROBOT.torque_ff_nm) / ROBOT.kp_nm_per_rad, atol=1e-9
    )
    for _ in range(30):
        sim.step(sim.targets.copy())
    np.testing.assert_allclose(
        sim.proprioception()[0, 7:13], Bench.home_rad["right"], atol=2e-5
    )  # it stays there


def test_an_arm_may_have_gains_of_its_own():
    own = ControllerConfig(kp_nm_per_rad=[100.0] * 6, torque_ff_nm=[0.5] * 6)
    sim = Simulation(Bench(), TwinConfig(arm_controllers={"right": own}))
    sim.reset([0])
    offset = sim.proprioception()[0] - sim.targets[0]
    np.testing.assert_allclose(offset[7:13], 0.5 / 100.0, atol=1e-9)
    np.testing.assert_allclose(
        offset[:6], np.array(ROBOT.torque_ff_nm) / ROBOT.kp_nm_per_rad, atol=1e-9
    )
    with pytest.raises(
        TaccorlError, match=r"arm_controllers: no arm 'rigth'; did you mean 'right'"
    ):
        TwinConfig(arm_controllers={"rigth": own})


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"kp_nm_per_rad": [1.0] * 5}, "kp_nm_per_rad: 5 values"),
        (
            {"kp_nm_per_rad": [1.0] * 5 + [0.0]},
            r"controller\.kp_nm_per_rad: .*0\.0\].* finite number > 0",
        ),
        (
            {"kd_nms_per_rad": [1, 1, 1, 1, 1, -1]},
            r"controller\.kd_nms_per_rad: .*-1\].* finite number ≥ 0",
        ),
        (
            {"torque_ff_nm": [0.0] * 5 + [float("nan")]},
            r"controller\.torque_ff_nm: .*nan\].* finite number",
        ),
        (
            {"kp_nm_per_rad": [1.0] * 5 + ["2"]},
            r"controller\.kp_nm_per_rad: .*'2'\].* finite number",
        ),
    ],
)
def test_wrong_gains_are_refused_by_name(settings, said):
    with pytest.raises(TaccorlError, match=said):
        ControllerConfig(**settings)


def test_a_twin_with_many_parts_keeps_dense_jacobians():
    """MuJoCo takes sparse ones by itself from 60 degrees of freedom on."""
    spec = empty_bench(TwinConfig())
    for k in range(10):  # 6 degrees of freedom each, beside those of the arms
        body = spec.worldbody.add_body(name=f"part {k}", pos=[0.0, 0.0, 1.0 + k])
        body.add_freejoint()
        body.add_geom(size=[0.01, 0.0, 0.0])
    model = spec.compile()
    assert model.nv >= 60
    assert not mujoco.mj_isSparse(model)
