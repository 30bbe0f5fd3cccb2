"""Shards of environments as Ray actors, on this machine or on others of a Ray cluster (extra ``ray``).

An actor makes its own environments and gives and takes arrays; the policy stays here, so no weights travel.
"""

import importlib
import logging
from typing import Any

import numpy as np

from taccorl.errors import TaccorlError
from taccorl.rl.start_states import StartStates
from taccorl.rl.twin_shard import ShardActed, ShardSeen, TwinShard
from taccorl.sim.vector_env import TaccorlVectorEnv


def start_ray() -> Any:
    """The module, connected: to the cluster that RAY_ADDRESS names, else to one on this machine.

    Raises:
        TaccorlError: it is not installed.
    """
    try:
        ray: Any = importlib.import_module("ray")
    except ModuleNotFoundError as error:
        raise TaccorlError("--env.ray=true: Ray is not installed: pip install 'taccorl[ray]'") from error
    if not ray.is_initialized():
        ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.WARNING)
    return ray


class _Actor:
    """A ``TwinShard`` in a process of its own, which Ray starts."""

    def __init__(self, envs: dict[str, Any], shard: dict[str, Any], starts: tuple[float, int]) -> None:
        self._shard = TwinShard(TaccorlVectorEnv(**envs), **shard, starts=StartStates(*starts))

    def facts(self) -> dict[str, Any]:
        shard = self._shard
        names = ("num_envs", "task", "instruction", "part_names", "limit_steps")
        return {name: getattr(shard, name) for name in names}

    def call(self, method: str, *args: Any) -> Any:
        return getattr(self._shard, method)(*args)


class RayShard:
    """A ``TwinShard`` in an actor; each call waits for its result."""

    def __init__(self, ray: Any, envs: dict[str, Any], shard: dict[str, Any], starts: tuple[float, int]) -> None:
        """
        Args:
            ray: of ``start_ray``.
            envs: arguments of ``TaccorlVectorEnv``; the actor takes as many CPUs as its ``num_threads``.
            shard: arguments of ``TwinShard`` but ``envs`` and ``starts``.
            starts: arguments of ``StartStates``.
        """
        self._ray = ray
        self._actor = ray.remote(_Actor).options(num_cpus=envs["num_threads"]).remote(envs, shard, starts)
        facts = ray.get(self._actor.facts.remote())
        self.num_envs: int = facts["num_envs"]
        self.task: str = facts["task"]
        self.instruction: str = facts["instruction"]
        self.part_names: tuple[str, ...] = facts["part_names"]
        self.limit_steps: int = facts["limit_steps"]

    def _call(self, method: str, *args: Any) -> Any:
        return self._ray.get(self._actor.call.remote(method, *args))

    def restart(self, seed: int) -> None:
        self._call("restart", seed)

    def observe(self) -> ShardSeen:
        return self._call("observe")

    def act(self, actions_NHA: np.ndarray) -> ShardActed:
        return self._call("act", actions_NHA)

    def reset(self, rows_N: np.ndarray) -> None:
        self._call("reset", rows_N)

    def state_dict(self) -> dict[str, Any]:
        return self._call("state_dict")

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._call("load_state_dict", state)

    def close(self) -> None:
        self._call("close")
        self._ray.kill(self._actor)
