"""Poses of parts and hands in the state's token, forward kinematics in torch, a policy without pictures, and the pose head."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from tiny_policies import batch_of, chunk, features, losses, tiny_config, tiny_policy

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
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy
from taccorl.policies.tactile_pi05.part_poses import (
    PART_POSES,
    PartPosesStep,
    PoseHead,
    num_part_numbers,
    part_poses,
    relative_poses_m,
)
from taccorl.policies.tactile_pi05.processor_tactile_pi05 import (
    make_tactile_pi05_pre_post_processors,
)
from taccorl.robots import ROBOT
from taccorl.sim.part_poses import PARTS_KEY, part_pose_names
from taccorl.sim.robot import RobotConfig
from taccorl.sim.task import tasks
from taccorl.tasks.experts.kinematics import ArmKinematics

NAMES = list(part_pose_names(tasks.get("assembly_2")))
TOLD: dict[str, Any] = {
    "discrete_state_input": None,
    "action_feature_names": list(arm_names()),
    "part_names": NAMES,
}
STATISTICS = {
    key: {"q01": -torch.ones(14), "q99": torch.ones(14)}
    for key in ("observation.state", "action")
}


def turn(axis: int, angle_rad: float) -> np.ndarray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    planes = {
        0: [[1, 0, 0], [0, c, -s], [0, s, c]],
        1: [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        2: [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    return np.array(planes[axis], dtype=float)


def numbers(position_m: list[float] | np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return np.concatenate([position_m, rotation[:, 0], rotation[:, 1]])


def test_relative_poses_written_out():
    """The second body is turned by 90° about z: its x axis is the world's y, its y axis the world's −x. The first body lies
    10 mm further in x and 2 mm in y, not turned: in the second's frame (2, −10, 0) mm, its axes (0, −1, 0) and (1, 0, 0)."""
    poses = np.concatenate(
        [
            numbers([0.51, 0.102, 0.05], np.eye(3)),
            numbers([0.5, 0.1, 0.05], turn(2, math.pi / 2)),
        ]
    )
    tcp = np.eye(4)
    tcp[:3, 3] = [0.51, 0.102, 0.25]
    tcp[:3, :3] = turn(0, math.pi)  # approaches downwards
    found = part_poses(
        torch.tensor(poses[None]), [torch.tensor(tcp[None], dtype=torch.float32)] * 2
    )[0].numpy()
    assert len(found) == num_part_numbers(2) == 2 * 9 + 15 + 4 * 9
    np.testing.assert_allclose(
        found[:9], [2.04, 0.408, 0.2, 1, 0, 0, 0, 1, 0], atol=1e-6
    )
    np.testing.assert_allclose(
        found[9:18], [2.0, 0.4, 0.2, 0, 1, 0, -1, 0, 0], atol=1e-6
    )
    fine = [math.tanh(0.2), math.tanh(-1), 0, math.tanh(1), math.tanh(-5), 0]
    np.testing.assert_allclose(
        found[18:33], [0.02, -0.1, 0, *fine, 0, -1, 0, 1, 0, 0], atol=2e-5
    )
    # 200 mm below the TCP, whose z axis points downwards
    np.testing.assert_allclose(found[33:42], [0, 0, 2, 1, 0, 0, 0, -1, 0], atol=1e-6)
    assert np.array_equal(found[51:], found[33:51])
    mm = 1e3 * relative_poses_m(torch.tensor(found[None]), 2)[0].numpy()
    np.testing.assert_allclose(
        mm[:, :3], [[2, -10, 0], *[[0, 0, 200], [-10, 2, 200]] * 2], atol=1e-3
    )
    # rotations at a lever of 100 mm: the first body in the second's frame and in the hand's, the second in the hand's
    np.testing.assert_allclose(mm[0, 3:], [0, -100, 0, 100, 0, 0], atol=1e-3)
    np.testing.assert_allclose(
        mm[1:3, 3:], [[100, 0, 0, 0, -100, 0], [0, -100, 0, -100, 0, 0]], atol=1e-3
    )


def test_the_step_uses_the_state_as_it_is_and_comes_back_from_its_configuration():
    state = torch.linspace(-0.5, 0.5, 42).reshape(3, 14)
    poses = torch.tensor(
        np.tile(np.concatenate([numbers([0.4, 0, 0.1], np.eye(3))] * 2), (3, 1))
    )
    before, _ = make_tactile_pi05_pre_post_processors(
        tiny_config(**TOLD, part_poses=True), STATISTICS
    )
    given = {
        "observation.state": state,
        "observation.tactile": torch.zeros(3, 10, 1536),
        PARTS_KEY: poses,
        "task": ["a"] * 3,
    }
    expected = part_poses(poses, tcp_poses(state, torch.tensor(arm_chains())))
    assert torch.equal(before(given)[PART_POSES], expected)
    again = PartPosesStep(**PartPosesStep(names=NAMES).get_config())
    one = again.observation({"observation.state": state[1], PARTS_KEY: poses[1]})
    torch.testing.assert_close(one[PART_POSES], expected[1])


def test_what_is_missing_or_of_another_task_is_named():
    step, state = PartPosesStep(names=NAMES), torch.zeros(1, 14)
    with pytest.raises(
        TaccorlError,
        match=r"no observation.environment_state.*collect --part_poses=true",
    ):
        step.observation({"observation.state": state})
    with pytest.raises(TaccorlError, match=r"36 numbers.*the 18 of plug, cradle"):
        step.observation({"observation.state": state, PARTS_KEY: torch.zeros(1, 36)})
    with pytest.raises(TaccorlError, match="6 numbers"):
        step.observation(
            {"observation.state": torch.zeros(1, 6), PARTS_KEY: torch.zeros(1, 18)}
        )
    assert set(
        PartPosesStep(names=NAMES, required=False).observation(
            {"observation.state": state}
        )
    ) == {"observation.state"}
    with pytest.raises(TaccorlError, match="discrete_state_input"):
        TactilePI05Config(backbone="full", part_poses=True)
    with pytest.raises(TaccorlError, match=r"pose_loss.*pictures=false"):
        TactilePI05Config(
            backbone="small", pose_loss=1.0, pictures=False, tactile=False
        )
    with pytest.raises(TaccorlError, match=r"pose_loss.*discrete_state_input=false"):
        TactilePI05Config(backbone="full", pose_loss=1.0)
    with pytest.raises(TaccorlError, match="pose_loss=-1"):
        TactilePI05Config(backbone="small", pose_loss=-1.0)


def dataset_of(names: list[str] | None) -> Any:
    known: dict[str, Any] = {
        "observation.state": {},
        **({} if names is None else {PARTS_KEY: {"names": names}}),
    }
    return SimpleNamespace(
        stats=None,
        total_frames=9,
        repo_id="local/d",
        root="d",
        fps=30,
        features=known,
        episodes={"length": [20]},
    )


@pytest.mark.parametrize("option", [{"part_poses": True}, {"pose_loss": 1.0}])
def test_a_dataset_without_poses_or_of_other_parts_is_refused_with_the_way_out(option):
    config = TactilePI05Config(backbone="tiny", tactile=False, **option)
    with pytest.raises(
        TaccorlError,
        match=r"has no observation.environment_state: make it with taccorl collect --part_poses",
    ):
        config.match_dataset(dataset_of(None))
    config.match_dataset(dataset_of(NAMES))
    assert config.part_names == NAMES and config.num_bodies == 2
    with pytest.raises(
        TaccorlError,
        match=r"of tube, rack, stand, but that of the checkpoint is of plug, cradle",
    ):
        config.match_dataset(dataset_of(list(part_pose_names(tasks.get("test_tube")))))
    if config.pose_loss:
        config.match_dataset(dataset_of(None))  # goes on with the flow loss alone


def test_by_default_nothing_changes():
    """A dataset with poses, a policy that is not told them: the same inputs, steps and weights."""
    known = features()
    known["input_features"][PARTS_KEY] = PolicyFeature(FeatureType.ENV, (18,))
    plain, beside = (
        tiny_policy(discrete_state_input=None),
        tiny_policy(**known, discrete_state_input=None),
    )
    assert plain.config.input_features == beside.config.input_features
    ours, theirs = plain.state_dict(), beside.state_dict()
    assert list(ours) == list(theirs) and all(
        torch.equal(ours[key], theirs[key]) for key in ours
    )
    assert not any(key.startswith("pose_head") for key in ours)
    before, _ = make_tactile_pi05_pre_post_processors(plain.config, STATISTICS)
    assert not any(isinstance(step, PartPosesStep) for step in before.steps)
    rows = batch_of(True, False)
    told = {PARTS_KEY: torch.rand(2, 18), PART_POSES: torch.rand(2, 69)}
    assert torch.equal(chunk(plain, rows), chunk(beside, {**rows, **told}))
    assert torch.equal(losses(plain, rows), losses(beside, {**rows, **told}))


def told_batch(*touched: bool) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    rows = len(touched)
    told = {
        HAND_POSES: torch.rand(rows, 27, generator=generator),
        PART_POSES: torch.rand(rows, 69, generator=generator),
    }
    return {**batch_of(*touched), **told}


@pytest.mark.parametrize("tactile", [True, False])
def test_without_pictures_a_policy_is_told_the_poses(tactile):
    policy = tiny_policy(**TOLD, part_poses=True, pictures=False, tactile=tactile)
    assert set(policy.config.input_features or {}) == {
        "observation.state",
        PARTS_KEY,
        *["observation.tactile"] * tactile,
    }
    assert policy.config.state_dim == 14 + 27 + 69
    rows = {k: x for k, x in told_batch(True, False).items() if "images" not in k}
    assert chunk(policy, rows).shape == (2, 10, 14)
    moved = {**rows, PART_POSES: rows[PART_POSES] + torch.tensor([[0.1], [0.0]])}
    differs = (chunk(policy, rows) != chunk(policy, moved)).any(dim=(1, 2))
    assert differs.tolist() == [True, False]
    policy.train()
    loss, said = policy.forward(rows)
    loss.backward()
    assert torch.isfinite(loss) and "pose_loss" not in said


def test_rows_without_known_poses_have_no_pose_loss_and_change_nothing():
    policy = tiny_policy(
        **TOLD, pose_loss=0.5, image_randomization=False, image_noise_std=0.0
    ).train()
    head = policy.pose_head
    assert head is not None
    torch.manual_seed(0)
    fused, poses = (
        torch.randn(4, head.hidden.in_features),
        torch.randn(4, num_part_numbers(head.num_bodies)),
    )
    known, error_mm = head.errors(fused[:2], poses[:2])
    poses[2:] = torch.nan
    some, same_mm = head.errors(fused, poses)
    # two of four: their mean is that of the two
    torch.testing.assert_close(some, torch.cat([2 * known, torch.zeros(2)]))
    assert same_mm == pytest.approx(error_mm.item())
    some.mean().backward()
    assert all(
        p.grad is not None and p.grad.isfinite().all() for p in head.parameters()
    )
    none, zero_mm = head.errors(fused, torch.full_like(poses, torch.nan))
    assert none.tolist() == [0.0] * 4 and zero_mm == 0


def test_the_pose_loss_falls_and_acting_does_not_depend_on_its_head(tmp_path):
    policy = tiny_policy(
        **TOLD, pose_loss=0.5, image_randomization=False, image_noise_std=0.0
    )
    plain = tiny_policy(**TOLD, image_randomization=False, image_noise_std=0.0)
    rows = told_batch(False, True, False, True)
    assert {k for k in policy.state_dict() if k not in plain.state_dict()} == {
        f"pose_head.{name}.{kind}"
        for name in ("hidden", "out")
        for kind in ("weight", "bias")
    }
    assert (
        PARTS_KEY not in (policy.config.input_features or {})
        and policy.config.state_dim == 14 + 27
    )
    policy.train()
    torch.manual_seed(0)
    loss, said = policy.forward(rows)
    assert said["loss"] == pytest.approx(said["flow_loss"] + 0.5 * said["pose_loss"])
    plain.load_state_dict(policy.state_dict(), strict=False)
    assert said["flow_loss"] == pytest.approx(
        losses(plain.train(), rows, seed=0).mean().item()
    )
    torch.manual_seed(0)
    each, _ = policy.forward(rows, "none")
    torch.testing.assert_close(each.mean(), loss)
    optimizer, errors = torch.optim.Adam(policy.parameters(), 1e-3), []
    for _ in range(30):
        loss, said = policy.forward(rows)
        errors.append((said["pose_loss"], said["pose_error_mm"]))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert errors[-1][0] < 0.3 * errors[0][0] and errors[-1][1] < 0.5 * errors[0][1]
    camera: Any = policy.model.paligemma_with_expert.paligemma.model.vision_tower
    assert camera.cameras[0].hidden.weight.grad is not None
    policy.eval()
    assert "pose_loss" not in policy.forward(rows)[1] and policy.pose_head is not None

    policy.save_pretrained(tmp_path / "with")
    without = {k: x for k, x in rows.items() if k != PART_POSES}
    again = TactilePI05Policy.from_pretrained(tmp_path / "with")
    assert torch.equal(chunk(again, without), chunk(policy, without))
    again.config.pose_loss = 0.0
    lighter = TactilePI05Policy.from_pretrained(tmp_path / "with", config=again.config)
    assert lighter.pose_head is None and torch.equal(
        chunk(lighter, without), chunk(policy, without)
    )
    lighter.save_pretrained(tmp_path / "without")
    lighter.config.pose_loss = 1.0
    assert (
        TactilePI05Policy.from_pretrained(
            tmp_path / "without", config=lighter.config
        ).pose_head
        is not None
    )


def test_the_pose_loss_sees_the_touch_of_rows_that_use_it_beside_pictures():
    known: dict[str, Any] = {
        **TOLD,
        "image_randomization": False,
        "image_noise_std": 0.0,
    }
    policy, rows = (
        tiny_policy(**known, pose_loss=0.5).train(),
        told_batch(True, False, True),
    )

    def pose_loss(batch: dict[str, torch.Tensor]) -> float:
        torch.manual_seed(0)
        return policy.forward(batch)[1]["pose_loss"]

    def gradients(weight: float) -> dict[str, torch.Tensor]:
        policy.config.pose_loss = weight
        policy.zero_grad()
        torch.manual_seed(0)
        policy.forward(rows)[0].backward()
        return {
            k: torch.zeros_like(p) if p.grad is None else p.grad.clone()
            for k, p in policy.named_parameters()
        }

    with_poses, flow_only = gradients(0.5), gradients(0.0)
    changed = {
        k for k in with_poses if (with_poses[k] - flow_only[k]).abs().max() > 1e-7
    }
    vision = "model.paligemma_with_expert.paligemma.model.vision_tower."
    for seen in ("model.tactile.encoder.pad.", vision):
        assert any(k.startswith(seen) for k in changed), seen
    fused = ("model.tactile.to_fusion.", "model.fusion.inputs.", "model.fusion.layers.")
    inputs = (
        "model.tactile.encoder.",
        "model.state_token.",
        *fused,
        vision,
        "pose_head.",
    )
    assert all(k.startswith(inputs) for k in changed)

    for row, matters in (
        (0, True),
        (1, False),
    ):  # row 1 has no contact before and after
        felt = rows["observation.tactile"].clone()
        felt[row] *= 0.9
        assert (
            pose_loss({**rows, "observation.tactile": felt}) != pose_loss(rows)
        ) == matters
    assert math.isfinite(pose_loss(told_batch(False, False)))
    felt = policy._losses_and_fused(rows)[2]
    assert felt is not None and felt.shape == (3, 2 * 64)
    hidden = tiny_policy(**known, pose_loss=0.5, touch_dropout=0.999999).train()
    hidden.load_state_dict(policy.state_dict())
    without = hidden._losses_and_fused(rows)[2]
    assert without is not None and (felt - without).abs().amax(1).gt(1e-3).tolist() == [
        True,
        False,
        True,
    ]


def test_without_pictures_poses_are_predicted_from_touch():
    policy = tiny_policy(**TOLD, pose_loss=0.5, pictures=False).train()
    fusion: Any = policy.model.fusion
    assert fusion.inputs.in_features == 64  # the state's token
    rows = {k: x for k, x in told_batch(True, False).items() if "images" not in k}
    assert math.isfinite(policy.forward(rows)[1]["pose_loss"])


def test_the_pose_loss_is_quadratic_below_three_quarters_of_a_millimetre():
    """Distance 0: the unit is 2.5 mm, an error of 0.5 mm is 0.2, 0.2² / (2 · 0.3) = 0.0667; one of 5 mm is 2, 2 − 0.3 / 2 = 1.85.
    Distance 50 mm: the unit is 5 mm, an error of 5 mm is 1, 1 − 0.3 / 2 = 0.85, and is not in the mean of near positions."""
    head = PoseHead(1, 2)
    cases = [(0.0, 0.0005, 0.2**2 / 0.6), (0.0, 0.005, 1.85), (0.05, 0.005, 0.85)]
    for distance_m, error_m, loss in cases:
        torch.nn.init.zeros_(head.out.weight)
        torch.nn.init.zeros_(head.out.bias)
        with torch.no_grad():
            head.out.bias[0] = (
                distance_m + error_m
            ) / 0.1  # x of the first body in the frame of the second
        poses = torch.zeros(1, num_part_numbers(2))
        poses[0, 18] = distance_m / 0.1
        found, error_mm = head.errors(torch.zeros(1, 1), poses)
        assert found.item() == pytest.approx(
            loss / 45, rel=1e-4
        )  # of 5 poses with 9 numbers
        assert error_mm.item() == pytest.approx(
            0.0 if distance_m else 1e3 * error_m / math.sqrt(5), abs=1e-4
        )


@pytest.fixture(scope="module")
def states() -> np.ndarray:
    return (
        np.random.default_rng(0)
        .uniform(ROBOT.action_low, ROBOT.action_high, (20, 14))
        .astype(np.float32)
    )


@pytest.mark.parametrize(
    "robot", [RobotConfig(), RobotConfig(mount_height_m=0.1, mount_spacing_m=0.8)]
)
def test_hands_are_where_mujoco_has_them(states, robot):
    """MuJoCo computes in double precision: float32 leaves some 1e-7 of a metre a link."""
    told = tcp_poses(torch.tensor(states), torch.tensor(arm_chains(robot)))
    for a, arm in enumerate(("left", "right")):
        kinematics = ArmKinematics(arm, robot)
        wanted = np.stack(
            [
                kinematics.pose(state[7 * a : 7 * a + 6])
                for state in states.astype(float)
            ]
        )
        np.testing.assert_allclose(told[a].numpy(), wanted, atol=2e-6)


def test_one_hand_in_the_others_frame_does_not_change_when_the_gripper_or_the_unit_of_another_does(
    states,
):
    chains = torch.tensor(arm_chains())
    told = hand_poses(torch.tensor(states), chains)
    left, right = (
        pose.double().numpy() for pose in tcp_poses(torch.tensor(states), chains)
    )
    between = np.linalg.inv(left) @ right
    np.testing.assert_allclose(
        told[:, 18:21].numpy() * HAND_TO_HAND_M, between[:, :3, 3], atol=1e-5
    )
    np.testing.assert_allclose(told[:, 21:24].numpy(), between[:, :3, 0], atol=1e-5)
    np.testing.assert_allclose(told[:, 24:27].numpy(), between[:, :3, 1], atol=1e-5)
    np.testing.assert_allclose(told[:, :3].numpy() * WORLD_M, left[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(
        told[:, 9:12].numpy() * WORLD_M, right[:, :3, 3], atol=1e-6
    )
    opened = states.copy()
    opened[:, [6, 13]] += 0.01
    assert torch.equal(hand_poses(torch.tensor(opened), chains), told)


def test_the_step_takes_any_leading_shape_keeps_the_rest_and_comes_back_from_its_configuration(
    states,
):
    step = HandPosesStep()
    observation = {
        "observation.state": torch.tensor(states),
        "observation.other": torch.zeros(1),
    }
    found = step.observation(observation)
    assert (
        found["observation.other"] is observation["observation.other"]
        and HAND_POSES not in observation
    )
    again = HandPosesStep(**step.get_config()).observation(
        {"observation.state": torch.tensor(states[3])}
    )
    torch.testing.assert_close(again[HAND_POSES], found[HAND_POSES][3])


def test_another_robot_is_refused_with_the_way_out():
    with pytest.raises(
        TaccorlError, match=r"6 numbers.*left_joint_1.*--policy.hand_poses=false"
    ):
        HandPosesStep().observation({"observation.state": torch.zeros(2, 6)})


def test_a_policy_is_told_of_hands_that_it_knows():
    names = list(arm_names())
    assert (
        names[0] == "left_joint_1.pos" and names[13] == "right_gripper.pos"
    )  # as datasets have them
    assert TactilePI05Config(backbone="small", action_feature_names=names).knows_hands
    assert not TactilePI05Config(
        backbone="small", action_feature_names=["elbow"]
    ).knows_hands
    assert not TactilePI05Config(
        backbone="full", action_feature_names=names
    ).knows_hands
    assert not TactilePI05Config(
        backbone="small", action_feature_names=names, hand_poses=False
    ).knows_hands
    with pytest.raises(TaccorlError, match="hand_poses=true"):
        TactilePI05Config(backbone="full", hand_poses=True)


def test_poses_are_of_the_state_before_it_is_normalised(states):
    settings = {
        "discrete_state_input": False,
        "action_feature_names": list(arm_names()),
    }
    config = tiny_config(**settings, use_relative_actions=True)
    half = torch.ones(14)
    statistics = {
        key: {"q01": -half, "q99": half} for key in ("observation.state", "action")
    }
    statistics["observation.state"] = {"q01": torch.zeros(14), "q99": half}
    before, _ = make_tactile_pi05_pre_post_processors(config, statistics)
    state = torch.tensor(states[:2])
    given = {
        "observation.state": state,
        "observation.tactile": torch.zeros(2, 10, 1536),
        "task": ["a", "b"],
    }
    found = before(given)
    torch.testing.assert_close(found["observation.state"], 2 * state - 1)
    torch.testing.assert_close(
        found[HAND_POSES], hand_poses(state, torch.tensor(arm_chains()))
    )
    assert config.state_dim == 14 + 27
