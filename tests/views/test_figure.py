"""The figure's kinematics against arithmetic, symmetry and the twin's."""

import dataclasses

import numpy as np
import pytest

from taccorl.robots import ROBOT
from taccorl.views.colors import heat
from taccorl.views.figure import arms_of, link_poses, pad_colors, pad_poses
from taccorl.views.touch import pads_of

from .made_episode import made_episode

RNG = np.random.default_rng(3)
JOINTS_RAD = RNG.uniform(-1.2, 1.2, (50, 6))


def test_mirrored_joints_give_a_mirrored_arm():
    right = link_poses(JOINTS_RAD)[:, :, :3, 3]
    left = link_poses(JOINTS_RAD * [-1, 1, 1, -1, 1, -1])[:, :, :3, 3]
    assert np.allclose(left, right * [1, -1, 1], atol=1e-4)  # J6's origin is 0.09 mm off the arm's middle


def test_at_zero_the_flange_is_where_agilexs_own_example_returns_to():
    assert link_poses(np.zeros((1, 6)))[0, 6, :3, 3] == pytest.approx([0.057, 0.0, 0.215], abs=0.002)


@pytest.mark.parametrize("opening_m", [0.0, 0.02, 0.07])
def test_gripper_opening_is_the_distance_between_the_pads(opening_m: float):
    link6 = link_poses(JOINTS_RAD)[:, 6]
    pads = pad_poses(link6, np.full(50, opening_m))
    gap = pads[:, 0, :3, 3] - pads[:, 1, :3, 3]
    assert np.allclose(np.linalg.norm(gap, axis=1), opening_m)
    assert np.allclose(gap, opening_m * link6[:, :3, 1]), "along y of link 6, finger a on the positive side"
    middle_in_link6 = np.einsum("tji,tj->ti", link6[:, :3, :3], pads[:, :, :3, 3].mean(axis=1) - link6[:, :3, 3])
    assert np.allclose(middle_in_link6[:, :2], 0, atol=1e-12)
    assert (middle_in_link6[:, 2] > ROBOT.finger_from_hand_m).all()


def test_arms_are_found_by_name_whatever_their_order():
    episode = made_episode(10, picture_size=32)
    feature = episode.spec.features["observation.state"]
    order = RNG.permutation(14)
    shuffled = dataclasses.replace(
        episode,
        spec=dataclasses.replace(
            episode.spec,
            features={
                **episode.spec.features,
                "observation.state": dataclasses.replace(feature, names=tuple(feature.names[i] for i in order)),
            },
        ),
        arrays={**episode.arrays, "observation.state": episode.arrays["observation.state"][:, order]},
    )
    for side in ("left", "right"):
        assert np.array_equal(arms_of(shuffled)[side], arms_of(episode)[side])


def test_other_robots_have_no_piper_figure():
    episode = made_episode(10, picture_size=32)
    other = dataclasses.replace(episode, spec=dataclasses.replace(episode.spec, robot_type="aloha"))
    assert arms_of(other) == {}


def test_pads_wear_the_heatmaps_colours_by_their_sum():
    pads = pads_of(made_episode(101, picture_size=32))
    colors = pad_colors(pads[2])
    assert colors.dtype == np.uint32
    red, green, blue = (int(c) for c in heat(np.array(0.0)))
    assert colors[0] == (red << 24 | green << 16 | blue << 8 | 255), "nothing touches: the scale's zero"
    share = pads[2].sum_count[60] / pads[2].full_sum_count
    assert 0.1 < share < 1
    red, green, blue = (int(c) for c in heat(np.array(share)))
    assert colors[60] == (red << 24 | green << 16 | blue << 8 | 255)
