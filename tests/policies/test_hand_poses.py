"""Forward kinematics in torch against MuJoCo's own, and what a policy is told of it."""

import numpy as np
import pytest
import torch
from tiny_policies import tiny_config

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.policies.tactile_pi05.hand_poses import (
    HAND_POSES,
    HAND_TO_HAND_M,
    WORLD_M,
    HandPosesStep,
    arm_chains,
    arm_names,
    hand_poses,
    tcp_poses,
)
from taccorl.policies.tactile_pi05.processor_tactile_pi05 import make_tactile_pi05_pre_post_processors
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig
from taccorl.tasks.experts.kinematics import ArmKinematics


@pytest.fixture(scope="module")
def states() -> np.ndarray:
    return np.random.default_rng(0).uniform(ROBOT.action_low, ROBOT.action_high, (20, 14)).astype(np.float32)


@pytest.mark.parametrize("robot", [RobotConfig(), RobotConfig(mount_height_m=0.1, mount_spacing_m=0.8)])
def test_hands_are_where_mujoco_has_them(states, robot):
    """MuJoCo computes in double precision: float32 leaves some 1e-7 of a metre a link."""
    told = tcp_poses(torch.tensor(states), torch.tensor(arm_chains(robot)))
    for a, arm in enumerate(("left", "right")):
        kinematics = ArmKinematics(arm, robot)
        wanted = np.stack([kinematics.pose(state[7 * a : 7 * a + 6]) for state in states.astype(float)])
        np.testing.assert_allclose(told[a].numpy(), wanted, atol=2e-6)


def test_one_hand_in_the_others_frame_does_not_change_when_the_gripper_or_the_unit_of_another_does(states):
    chains = torch.tensor(arm_chains())
    told = hand_poses(torch.tensor(states), chains)
    left, right = (pose.double().numpy() for pose in tcp_poses(torch.tensor(states), chains))
    between = np.linalg.inv(left) @ right
    np.testing.assert_allclose(told[:, 18:21].numpy() * HAND_TO_HAND_M, between[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(told[:, 21:24].numpy(), between[:, :3, 0], atol=1e-5)
    np.testing.assert_allclose(told[:, 24:27].numpy(), between[:, :3, 1], atol=1e-5)
    np.testing.assert_allclose(told[:, :3].numpy() * WORLD_M, left[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(told[:, 9:12].numpy() * WORLD_M, right[:, :3, 3], atol=1e-6)
    opened = states.copy()
    opened[:, [6, 13]] += 0.01
    assert torch.equal(hand_poses(torch.tensor(opened), chains), told)


def test_the_step_takes_any_leading_shape_keeps_the_rest_and_comes_back_from_its_configuration(states):
    step = HandPosesStep()
    observation = {"observation.state": torch.tensor(states), "observation.other": torch.zeros(1)}
    found = step.observation(observation)
    assert found["observation.other"] is observation["observation.other"] and HAND_POSES not in observation
    again = HandPosesStep(**step.get_config()).observation({"observation.state": torch.tensor(states[3])})
    torch.testing.assert_close(again[HAND_POSES], found[HAND_POSES][3])


def test_another_robot_is_refused_with_the_way_out():
    with pytest.raises(TaccorlError, match=r"6 numbers.*left_joint_1.*--policy.hand_poses=false"):
        HandPosesStep().observation({"observation.state": torch.zeros(2, 6)})


def test_a_policy_is_told_of_hands_that_it_knows():
    names = list(arm_names())
    assert names[0] == "left_joint_1.pos" and names[13] == "right_gripper.pos"  # as datasets have them
    assert TactilePI05Config(backbone="small", action_feature_names=names).knows_hands
    assert not TactilePI05Config(backbone="small", action_feature_names=["elbow"]).knows_hands
    assert not TactilePI05Config(backbone="full", action_feature_names=names).knows_hands
    assert not TactilePI05Config(backbone="small", action_feature_names=names, hand_poses=False).knows_hands
    with pytest.raises(TaccorlError, match="hand_poses=true"):
        TactilePI05Config(backbone="full", hand_poses=True)


def test_poses_are_of_the_state_before_it_is_normalised(states):
    settings = {"discrete_state_input": False, "action_feature_names": list(arm_names())}
    config = tiny_config(**settings, use_relative_actions=True)
    half = torch.ones(14)
    statistics = {key: {"q01": -half, "q99": half} for key in ("observation.state", "action")}
    statistics["observation.state"] = {"q01": torch.zeros(14), "q99": half}
    before, _ = make_tactile_pi05_pre_post_processors(config, statistics)
    state = torch.tensor(states[:2])
    given = {"observation.state": state, "observation.tactile": torch.zeros(2, 10, 1536), "task": ["a", "b"]}
    found = before(given)
    torch.testing.assert_close(found["observation.state"], 2 * state - 1)
    torch.testing.assert_close(found[HAND_POSES], hand_poses(state, torch.tensor(arm_chains())))
    assert config.state_dim == 14 + 27
