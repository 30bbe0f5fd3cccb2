"""Shards of environments in processes of their own, on this machine or, by Ray, on those of a cluster (extra ``ray``).

Python runs in one thread of a process at a time, so that one process feeds about ten cores with environments. A remote shard
makes its own environments, and receives and returns arrays; the policy stays in the main process, so that no weights are
transferred.
"""

import contextlib
import importlib
import logging
import multiprocessing
import pickle
import traceback
from abc import ABC, abstractmethod
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from taccorl.errors import TaccorlError
from taccorl.rl.start_states import StartStates
from taccorl.rl.twin_shard import ShardActed, ShardSeen, TwinShard
from taccorl.sim.vector_env import TaccorlVectorEnv

_PATIENCE_S = 5.0
"""How long ``close`` waits after SIGTERM before it sends SIGKILL [s]."""


class _Worker:
    """Holds a ``TwinShard`` in the other process and calls its methods."""

    def __init__(self, envs: dict[str, Any], shard: dict[str, Any], starts: tuple[float, int]) -> None:
        self._shard = TwinShard(TaccorlVectorEnv(**envs), **shard, starts=StartStates(*starts))

    def facts(self) -> dict[str, Any]:
        shard = self._shard
        names = ("num_envs", "task", "instruction", "part_names", "limit_steps")
        return {name: getattr(shard, name) for name in names}

    def call(self, method: str, *args: Any) -> Any:
        return getattr(self._shard, method)(*args)


class RemoteShard(ABC):
    """A ``TwinShard`` in another process; each call waits for its result."""

    def __init__(self, facts: dict[str, Any]) -> None:
        self.num_envs: int = facts["num_envs"]
        self.task: str = facts["task"]
        self.instruction: str = facts["instruction"]
        self.part_names: tuple[str, ...] = facts["part_names"]
        self.limit_steps: int = facts["limit_steps"]

    @abstractmethod
    def _call(self, method: str, *args: Any) -> Any:
        """Result of a method of the ``TwinShard``."""

    @abstractmethod
    def close(self) -> None:
        """End the process."""

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


class ProcessShard(RemoteShard):
    """A ``TwinShard`` in another process of this machine.

    A script that makes one must do so below ``if __name__ == "__main__":``, because multiprocessing imports the script again.
    """

    def __init__(self, envs: dict[str, Any], shard: dict[str, Any], starts: tuple[float, int]) -> None:
        """
        Args:
            envs: arguments of ``TaccorlVectorEnv``.
            shard: arguments of ``TwinShard`` except ``envs`` and ``starts``.
            starts: arguments of ``StartStates``.

        Raises:
            TaccorlError: as the environments raise.
        """
        context = multiprocessing.get_context("forkserver")  # imports once, and forks before there are threads
        context.set_forkserver_preload([__name__])
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there, envs, shard, starts), daemon=True)
        self._process.start()
        there.close()  # so that the end of either process ends the other's waiting
        super().__init__(self._received())

    def _call(self, method: str, *args: Any) -> Any:
        with contextlib.suppress(BrokenPipeError):  # what it sent last says why
            self._pipe.send((method, args))
        return self._received()

    def _received(self) -> Any:
        try:
            result, error = self._pipe.recv()
        except (EOFError, OSError) as end:
            raise TaccorlError(
                "--env.shards: a process of environments ended by itself. If it said nothing above, the machine may be out of "
                "memory: --resume=true goes on from the last checkpoint with the same numbers; with lower --env.num_envs or "
                "--env.shards begin in another --out from --policy.path=…/checkpoints/last/pretrained_model. (In a script of "
                'your own, environments are made below if __name__ == "__main__":)'
            ) from end
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        self._process.terminate()  # it holds nothing that must be saved
        self._process.join(_PATIENCE_S)
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _serve(pipe: Connection, envs: dict[str, Any], shard: dict[str, Any], starts: tuple[float, int]) -> None:
    """Body of the other process: make a ``_Worker`` and answer calls from the pipe until the pipe's other end is closed."""
    try:
        worker = _Worker(envs, shard, starts)
        pipe.send((worker.facts(), None))
        while True:
            method, args = pipe.recv()
            pipe.send((worker.call(method, *args), None))
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        return
    except Exception as error:
        error.add_note(f"In a process of environments:\n{traceback.format_exc()}")
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # it cannot travel
            error = RuntimeError(traceback.format_exc())
        pipe.send((None, error))


def start_ray() -> Any:
    """Start Ray and return its module: connected to the cluster of RAY_ADDRESS, else to one on this machine.

    Raises:
        TaccorlError: Ray is not installed.
    """
    try:
        ray: Any = importlib.import_module("ray")
    except ModuleNotFoundError as error:
        raise TaccorlError("--env.ray=true: Ray is not installed: pip install 'taccorl[ray]'") from error
    if not ray.is_initialized():
        ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.WARNING)
    return ray


class RayShard(RemoteShard):
    """A ``TwinShard`` in a Ray actor."""

    def __init__(self, ray: Any, envs: dict[str, Any], shard: dict[str, Any], starts: tuple[float, int]) -> None:
        """
        Args:
            ray: module from ``start_ray``.
            envs: as of ``ProcessShard``; the actor takes as many CPUs as its ``num_threads``.
            shard: as of ``ProcessShard``.
            starts: as of ``ProcessShard``.
        """
        self._ray = ray
        self._actor = ray.remote(_Worker).options(num_cpus=envs["num_threads"]).remote(envs, shard, starts)
        super().__init__(ray.get(self._actor.facts.remote()))

    def _call(self, method: str, *args: Any) -> Any:
        return self._ray.get(self._actor.call.remote(method, *args))

    def close(self) -> None:
        self._call("close")
        self._ray.kill(self._actor)
