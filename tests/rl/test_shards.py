"""Shards in other processes: what they give is what a shard in this process gives."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.lineage.engines import start_ray
from taccorl.rl import shards
from taccorl.rl.shards import LocalShard, ProcessShard, RayShard, Shard
from taccorl.rl.start_states import StartStates
from taccorl.rl.twin_shard import PRIVILEGED, make_shard
from taccorl.sim.twin import TwinConfig

ENVS: dict[str, Any] = {
    "task": "assembly_2",
    "num_envs": 2,
    "twin": TwinConfig(),
    "num_threads": 1,
    "max_episode_steps": 8,
    "part_poses": True,
}
OPTIONS: dict[str, Any] = {
    "history": 3,
    "starts": StartStates(0.5, 4),
    "privileged": True,
    "first": 4,
}


def maker(**changes: Any) -> Any:
    return partial(make_shard, ENVS | changes, **OPTIONS)


def call(shard: Shard, method: str, *args: Any) -> Any:
    shard.start(method, *args)
    return shard.result()


def agree(there: Shard) -> None:
    """Three chunks over a time limit, and a state that goes from there to here."""
    here = LocalShard(maker())
    assert (
        call(there, "facts") == call(here, "facts")
        and call(here, "facts").num_envs == 2
    )

    def check(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
        assert one.keys() == other.keys() >= {PRIVILEGED, "observation.tactile"}
        for key, value in one.items():
            np.testing.assert_array_equal(value, other[key], err_msg=key)

    for shard in (here, there):
        call(shard, "restart", 3)
    for step in range(3):
        seen = call(here, "observe")
        check(seen, call(there, "observe"))
        actions = (
            np.repeat(seen["observation.state"][:, None].astype(np.float32), 5, axis=1)
            + 0.02
        )
        one, other = call(here, "act", actions), call(there, "act", actions)
        for name, value in one._asdict().items():
            if name != "last":
                np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)
        assert (one.last is None) == (other.last is None) == (step != 1)
        if one.last is not None:
            check(one.last, other.last)
    call(here, "load_state_dict", call(there, "state_dict"))
    check(call(here, "observe"), call(there, "observe"))
    there.close()
    here.close()


def test_a_process_gives_the_numbers_of_this_one() -> None:
    agree(ProcessShard(maker()))


def test_an_error_in_a_process_says_where_it_arose() -> None:
    with pytest.raises(TypeError, match="foo") as caught:
        ProcessShard(maker(foo=1)).result()
    assert any("make_shard" in note for note in caught.value.__notes__)


def test_a_process_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "_PATIENCE_S", 0.5)
    shard = ProcessShard(maker())
    assert shard.process.pid is not None
    os.kill(shard.process.pid, signal.SIGSTOP)
    shard.close()
    assert not shard.process.is_alive()


def test_a_process_that_was_killed_is_named() -> None:
    shard = ProcessShard(maker())
    call(shard, "restart", 0)
    shard.process.kill()
    with pytest.raises(TaccorlError, match=r"--env\.shards.*--resume=true"):
        call(shard, "observe")
    shard.close()


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="extra ray is not installed"
)
def test_an_actor_gives_the_numbers_of_this_process() -> None:
    ray = start_ray()
    agree(RayShard(ray, maker(), 1))
    ray.shutdown()


@pytest.mark.slow
def test_environments_end_with_the_process_that_was_killed(tmp_path: Path) -> None:
    script = tmp_path / "make.py"
    script.write_text(
        "import time\n"
        "from functools import partial\n"
        "from taccorl.rl.shards import ProcessShard\n"
        "from taccorl.rl.start_states import StartStates\n"
        "from taccorl.rl.twin_shard import make_shard\n"
        "if __name__ == '__main__':\n"
        "    shard = ProcessShard(partial(make_shard, {'task': 'assembly_2'}, history=3, starts=StartStates()))\n"
        "    print(shard.process.pid, flush=True)\n"
        "    time.sleep(60)\n"
    )
    parent = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True
    )
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
