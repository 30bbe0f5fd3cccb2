"""The arm from its number table: joint frames, masses, and what gripping does."""

import re

import mujoco
import numpy as np
import pytest

from pipelines.benchmarks.grip_rig import gripped, in_hand_m, rest, shake
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.robots.bimanual_piper import INERTIAS
from taccorl.sim.robot import RobotConfig, add_arm, link_poses
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
            data.qpos[[model.joint(f"{arm}_{j}").qposadr[0] for j in ROBOT.joints]] = joints
            mujoco.mj_kinematics(model, data)
            base = data.body(f"{arm}_base_link").xpos
            for i, link in enumerate(ROBOT.links):
                ours = link_poses(joints)[i]
                body = data.body(f"{arm}_{link.name}")
                np.testing.assert_allclose(body.xpos - base, ours[:3, 3], atol=1e-12)
                np.testing.assert_allclose(body.xmat.reshape(3, 3), ours[:3, :3], atol=1e-12)


def test_both_mass_sets_are_physical_and_differ_by_a_third():
    moving = {name: sum(link.mass_kg for link in links) + 2 * 0.025 for name, links in INERTIAS.items()}
    assert moving["manufacturer"] == pytest.approx(3.64, abs=0.005)
    assert moving["menagerie"] == pytest.approx(2.20, abs=0.01)
    for links in INERTIAS.values():
        for link in links:
            xx, yy, zz, xy, xz, yz = link.about_com_kgm2()
            a, b, c = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            assert a > 0
            assert a + b >= c * (1 - 1e-6)  # no mass distribution breaks the triangle inequality


@pytest.mark.parametrize("inertias", ["manufacturer", "menagerie"])
def test_compiled_model_has_the_table_s_masses_and_limits(inertias):
    model = compiled(inertias=inertias)
    for arm in ROBOT.arms:
        for link, inertia in zip(ROBOT.links, INERTIAS[inertias], strict=True):
            body = model.body(f"{arm}_{link.name}")
            assert body.mass[0] == pytest.approx(inertia.mass_kg)
            np.testing.assert_allclose(body.ipos, inertia.com_link_m, atol=1e-12)
            trace = sum(inertia.about_com_kgm2()[:3])  # of the tensor: the same in any axes
            assert body.inertia.sum() == pytest.approx(trace)
            np.testing.assert_allclose(model.joint(f"{arm}_joint{link.name[-1]}").range, link.range_rad)


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
        np.testing.assert_allclose(data.site(f"{arm}_a").xpos, data.site(f"{arm}_tcp").xpos, atol=1e-12)
    for pad in ROBOT.pads:
        half = model.geom(pad).size
        assert half[[0, 2]] * 2 == pytest.approx([ROBOT.pad.width_m, ROBOT.pad.length_m])


def test_an_arm_touches_table_parts_and_the_other_arm_but_not_itself():
    model = compiled()
    bits = {
        arm: {(int(model.geom_contype[g]), int(model.geom_conaffinity[g])) for g in _geoms(model, arm)}
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
    return [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name.startswith(arm)]


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
            for name in ("mount_spacing_m", "pad_stiffness_n_per_m", "grip_stiffness_n_per_m", "grip_force_max_n")
            for wrong in (0.0, -1.0, float("inf"))
        ),
        *(
            (name, wrong, "finite number ≥ 0")
            for name in ("armature_kgm2", "pad_damping_ns_per_m", "grip_damping_ns_per_m")
            for wrong in (-1e-9, float("nan"))
        ),
        *((name, float("nan"), "finite number") for name in ("mount_height_m", "gravity_compensation")),
        ("pad_tilt_stiffness_nm_per_rad", (40.0, 0.0), "finite number > 0"),
        ("pad_tilt_stiffness_nm_per_rad", (40.0,), "not two numbers"),
        ("armature_kgm2", "0.01", "finite number ≥ 0"),
    ],
)
def test_numbers_that_no_robot_has_are_refused_by_name(name, wrong, wanted):
    with pytest.raises(TaccorlError, match=rf"robot\.{name}: {re.escape(str(wrong))} .*{wanted}"):
        RobotConfig(**{name: wrong})


def test_an_arm_may_have_no_rotor_inertia_no_damping_and_carry_more_than_its_weight():
    RobotConfig(
        armature_kgm2=0.0,
        pad_damping_ns_per_m=0.0,
        grip_damping_ns_per_m=0,
        gravity_compensation=1.2,
        mount_height_m=-0.1,
    )
