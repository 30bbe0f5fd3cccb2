"""Shards in Ray actors: what they give is what shards in this process give."""

import importlib.util
import sys
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from taccorl.errors import TaccorlError
from taccorl.rl.ray_shards import RayShard, start_ray
from taccorl.rl.start_states import StartStates
from taccorl.rl.twin_shard import ShardSeen, TwinShard
from taccorl.sim.twin import TwinConfig
from taccorl.sim.vector_env import TaccorlVectorEnv

ENVS: dict[str, Any] = {
    "task": "assembly_2",
    "num_envs": 2,
    "twin": TwinConfig(),
    "images": "never",
    "num_threads": 1,
    "autoreset": AutoresetMode.DISABLED,
    "max_episode_steps": 8,
    "part_poses": True,
}
SHARD: dict[str, Any] = {"history": 3, "images": False, "privileged": True, "first": 4}


def test_without_ray_the_way_to_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(TaccorlError, match=r"taccorl\[ray\]"):
        start_ray()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="extra ray is not installed")
def test_an_actor_gives_the_numbers_of_this_process() -> None:
    ray = start_ray()
    here = TwinShard(TaccorlVectorEnv(**ENVS), **SHARD, starts=StartStates(0.5, 4))
    there = RayShard(ray, ENVS, SHARD, (0.5, 4))
    names = ("num_envs", "task", "instruction", "part_names", "limit_steps")
    assert [getattr(there, name) for name in names] == [getattr(here, name) for name in names]

    def check(one: ShardSeen, other: ShardSeen) -> None:
        assert one.observation.keys() == other.observation.keys()
        for key, value in one.observation.items():
            np.testing.assert_array_equal(value, other.observation[key], err_msg=key)
        np.testing.assert_array_equal(one.window_NLK, other.window_NLK)
        np.testing.assert_array_equal(one.privileged_NP, other.privileged_NP)

    for shard in (here, there):
        shard.restart(3)
    for step in range(3):
        seen = here.observe()
        check(seen, there.observe())
        actions = np.repeat(seen.observation["observation.state"][:, None].astype(np.float32), 5, axis=1) + 0.02
        one, other = here.act(actions), there.act(actions)
        for name in ("reward_N", "terminated_N", "truncated_N", "num_steps_N", "seed_N", "partial_N"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
        assert (one.outcomes, one.later_outcomes) == (other.outcomes, other.later_outcomes)
        assert (one.last is None) == (other.last is None) == (step != 1)
        if one.last is not None and other.last is not None:
            check(one.last, other.last)
    state = there.state_dict()
    here.load_state_dict(state)
    check(here.observe(), there.observe())
    there.close()
    here.close()
    ray.shutdown()
