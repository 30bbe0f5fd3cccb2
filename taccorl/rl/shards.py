"""Where environments run: in this process, in worker processes of this machine, or in Ray actors of a cluster (extra ``ray``).

Python runs in one thread of a process at a time, so that one process feeds about ten cores with environments. Each shard makes
its own environments, and receives and returns arrays; the policy stays in the main process, so that no weights are transferred.
Results do not depend on the place.
"""

import contextlib
import multiprocessing
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from taccorl.errors import TaccorlError
from taccorl.rl.twin_shard import TwinShard

_PATIENCE_S = 5.0
"""How long ``close`` waits after SIGTERM before it sends SIGKILL [s]."""


class Shard(ABC):
    """A ``TwinShard`` and the place where it runs. ``start`` calls one of its methods, ``result`` waits for what it returns."""

    @abstractmethod
    def start(self, method: str, *args: Any) -> None:
        """Begin to compute ``TwinShard.<method>(*args)``, and return at once (``LocalShard``: when it is done)."""

    @abstractmethod
    def result(self) -> Any:
        """Wait for the last ``start``, and return what its method returned. Raises TaccorlError: the process of the
        environments ended, or the method raised it."""

    def close(self) -> None:
        """Close the environments and end their process."""
        self.start("close")
        self.result()


class LocalShard(Shard):
    """Shard that runs in this process."""

    def __init__(self, make: Callable[[], TwinShard]) -> None:
        self.twins = make()

    def start(self, method: str, *args: Any) -> None:
        self._result = getattr(self.twins, method)(*args)

    def result(self) -> Any:
        return self._result


class ProcessShard(Shard):
    """Shard that runs in another process of this machine.

    The environments are created while ``__init__`` returns; the first ``result`` raises what they raise. A script that makes one
    must do so below ``if __name__ == "__main__":``, because multiprocessing imports the script again."""

    def __init__(self, make: Callable[[], TwinShard]) -> None:
        """``make``: function that makes the ``TwinShard``; it is pickled, and called in the other process."""
        context = multiprocessing.get_context(
            "forkserver"
        )  # imports once, and forks before there are threads
        context.set_forkserver_preload([__name__])
        self._pipe, there = context.Pipe()
        self.process = context.Process(target=_serve, args=(there, make), daemon=True)
        self.process.start()
        there.close()  # so that the end of either process ends the other's waiting

    def start(self, method: str, *args: Any) -> None:
        with contextlib.suppress(BrokenPipeError):  # what it sent last says why
            self._pipe.send((method, args))

    def result(self) -> Any:
        try:
            result, error = self._pipe.recv()
        except (EOFError, OSError) as end:
            raise TaccorlError(
                "--env.shards: a process of environments ended unexpectedly: see its error above, or the memory was exhausted. "
                '--resume=true continues. (In a script, create environments only under if __name__ == "__main__":)'
            ) from end
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        self.process.terminate()  # it holds nothing that must be saved
        self.process.join(_PATIENCE_S)
        self.process.kill()
        self.process.join()
        self._pipe.close()


def _serve(pipe: Connection, make: Callable[[], TwinShard]) -> None:
    """Body of the other process: answer calls from the pipe until its other end is closed."""
    try:
        twins = make()
        while True:
            method, args = pipe.recv()
            pipe.send((getattr(twins, method)(*args), None))
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        return
    except Exception as error:
        error.add_note(f"In a process of environments:\n{traceback.format_exc()}")
        pipe.send((None, error))


class RayShard(Shard):
    """Shard that runs in a Ray actor."""

    def __init__(self, ray: Any, make: Callable[[], TwinShard], num_cpus: int) -> None:
        """
        Args:
            make: function that makes the ``TwinShard``; it is pickled, and called in the actor.
            num_cpus: number of CPUs that the actor reserves.
        """
        self._ray = ray
        self._actor = ray.remote(LocalShard).options(num_cpus=num_cpus).remote(make)

    def start(self, method: str, *args: Any) -> None:
        self._actor.start.remote(method, *args)
        self._waiting = self._actor.result.remote()

    def result(self) -> Any:
        return self._ray.get(self._waiting)

    def close(self) -> None:
        self._ray.kill(self._actor)  # it holds nothing that must be saved
