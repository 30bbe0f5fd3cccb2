"""Shards in other processes: what they give is what a shard in this process gives."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from taccorl.errors import TaccorlError
from taccorl.rl import remote_shards
from taccorl.rl.remote_shards import ProcessShard, RayShard, RemoteShard, start_ray
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


def agree(there: RemoteShard) -> None:
    """Three chunks over a time limit, and a state that goes from there to here."""
    here = TwinShard(TaccorlVectorEnv(**ENVS), **SHARD, starts=StartStates(0.5, 4))
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


def test_a_process_gives_the_numbers_of_this_one() -> None:
    agree(ProcessShard(ENVS, SHARD, (0.5, 4)))


def test_an_error_in_a_process_says_where_it_arose() -> None:
    with pytest.raises(TypeError, match="foo") as caught:
        ProcessShard(ENVS | {"foo": 1}, SHARD, (0.0, 1))
    assert any("_Worker" in note or "__init__" in note for note in caught.value.__notes__)


def test_a_process_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_shards, "_PATIENCE_S", 0.5)
    shard = ProcessShard(ENVS, SHARD, (0.0, 1))
    assert shard._process.pid is not None
    os.kill(shard._process.pid, signal.SIGSTOP)
    shard.close()
    assert not shard._process.is_alive()


def test_what_environments_refuse_in_a_process_is_said_here() -> None:
    with pytest.raises(TaccorlError, match="assembly_22"):
        ProcessShard(ENVS | {"task": "assembly_22"}, SHARD, (0.0, 1))


def test_a_process_that_was_killed_is_named() -> None:
    shard = ProcessShard(ENVS, SHARD, (0.0, 1))
    shard.restart(0)
    shard._process.kill()
    with pytest.raises(TaccorlError, match=r"--env\.shards.*--resume=true"):
        shard.observe()
    shard.close()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="extra ray is not installed")
def test_an_actor_gives_the_numbers_of_this_process() -> None:
    ray = start_ray()
    agree(RayShard(ray, ENVS, SHARD, (0.5, 4)))
    ray.shutdown()


@pytest.mark.slow
def test_environments_end_with_the_process_that_was_killed(tmp_path: Path) -> None:
    script = tmp_path / "make.py"
    script.write_text(
        "import time\n"
        "from gymnasium.vector import AutoresetMode\n"
        "from taccorl.rl.remote_shards import ProcessShard\n"
        "if __name__ == '__main__':\n"
        "    envs = {'task': 'assembly_2', 'autoreset': AutoresetMode.DISABLED}\n"
        "    shard = ProcessShard(envs, {'history': 3, 'images': False, 'privileged': False}, (0.0, 1))\n"
        "    print(shard._process.pid, flush=True)\n"
        "    time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    status = Path(f"/proc/{child}/status")
    for _ in range(100):
        if not status.exists() or "State:\tZ" in status.read_text():
            return
        time.sleep(0.1)
    pytest.fail(f"process {child} goes on without its parent")
