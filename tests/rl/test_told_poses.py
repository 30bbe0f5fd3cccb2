"""A policy that is told the poses of the parts and sees no pictures: rollouts, evaluation, and the task it belongs to."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tiny_checkpoint import write_checkpoint

from taccorl.errors import TaccorlError
from taccorl.evaluation.evaluate import Scenes, score
from taccorl.evaluation.policy_actor import needs_images, open_checkpoint, policy_batch
from taccorl.evaluation.preflight import preflight, refuse_differences
from taccorl.policies.tactile_pi05.part_poses import PART_POSES
from taccorl.rl.flow_policy import TactileFlowPolicy
from taccorl.rl.rollout import Clock
from taccorl.rl.settings import PolicySettings
from taccorl.rl.shards import LocalShard
from taccorl.rl.start_states import StartStates
from taccorl.rl.twin_shard import make_shard
from taccorl.rl.twin_world import TwinWorld
from taccorl.sim.part_poses import PARTS_KEY, part_pose_names
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig

TOUCH = "observation.tactile"


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Any:
    names = list(part_pose_names(tasks.get("assembly_2")))
    told = {"part_poses": True, "pictures": False, "part_names": names}
    return open_checkpoint(
        write_checkpoint(tmp_path_factory.mktemp("checkpoint"), **told), "cpu"
    )


def world_of(opened: Any, task: str = "assembly_2") -> TwinWorld:
    envs = {
        "task": task,
        "num_envs": 2,
        "max_episode_steps": 7,
        "num_threads": 1,
        "part_poses": True,
    }
    shard = LocalShard(
        partial(
            make_shard,
            envs,
            history=opened.config.tactile_history,
            starts=StartStates(),
        )
    )
    return TwinWorld([shard], opened, Clock())


def test_rollouts_keep_what_the_policy_is_told_and_render_nothing(opened: Any) -> None:
    world = world_of(opened)
    assert not needs_images(opened.config)
    world.restart(5)
    seen = world.observe().batch
    assert {PART_POSES, PARTS_KEY, "observation.state", TOUCH} <= set(seen) and not any(
        "images" in key for key in seen
    )
    (shard,) = world.shards
    assert isinstance(shard, LocalShard)
    observation = shard.twins.envs.observe()
    observation[TOUCH] = np.repeat(observation[TOUCH][:, None], 10, axis=1)
    expected = policy_batch(
        opened.preprocessor, observation, [shard.twins.facts().instruction] * 2
    )
    assert torch.equal(seen[PART_POSES], expected[PART_POSES])  # pyright: ignore
    for _ in range(2):
        acted = world.act(seen["observation.state"][:, None].expand(-1, 5, -1))
    assert (
        acted.truncated_N.all()
        and acted.last is not None
        and PART_POSES in acted.last.batch
    )
    actor = TactileFlowPolicy(opened.load(0).policy, PolicySettings(), num_steps=4)
    features = actor.features(world.observe().batch)
    width = 96 + 14 + 69  # mean token of the prefix, state, poses of the parts
    assert features.shape == (2, width) and actor.num_features == width
    world.close()


def test_evaluation_switches_the_poses_on(opened: Any) -> None:
    checks = preflight(opened.facts(), TwinConfig())
    refuse_differences(checks, "policy")
    assert [c.policy for c in checks if c.what == "poses of the parts"] == ["18"]
    actor = opened.load(0)
    assert actor.needs_part_poses and not actor.needs_images
    scenes = Scenes(tasks=("assembly_2",), episodes=2, seed=7, episode_length=6)
    assert [rollout.row.outcome for rollout in score(scenes, actor)] == ["timeout"] * 2


def test_another_task_is_refused(opened: Any) -> None:
    with pytest.raises(
        TaccorlError,
        match=r"assembly_1: its part poses are plug.x, socket.x .* plug.x, cradle.x",
    ):
        world_of(opened, "assembly_1")
    with pytest.raises(TaccorlError, match="another task"):
        score(
            Scenes(tasks=("assembly_1",), episodes=1, seed=7, episode_length=6),
            opened.load(0),
        )
