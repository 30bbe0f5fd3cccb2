"""A pool of worker processes that names the item at which a worker died, and whose workers end with their parent. The standard
pool does not report which item broke it, and drops all others. Here each worker has its own pipe, so that the parent knows the
item of each: a worker that is killed, crashes or hangs costs that one item, and is replaced.
"""

import contextlib
import ctypes
import itertools
import math
import multiprocessing
import os
import pickle
import resource
import signal
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Literal

from taccorl.errors import DISK_FAULTS, TaccorlError
from taccorl.lineage.errors import EngineError

PR_SET_PDEATHSIG = 1  # linux/prctl.h
LOOK_S = (
    1.0  # how often to look for workers that died without closing their pipe, or hang
)
GRACE_S = 5.0  # how long a worker may tidy up before it is killed
_numbers = itertools.count()  # of workers
_FUNCTION, _ITEM = b"f", b"i"  # first byte of a message to a worker


@dataclass(frozen=True)
class Done:
    """Result of the function for one item."""

    result: Any


@dataclass(frozen=True)
class Failed:
    """Reason why one item has no result."""

    reason: str
    """Text for the message."""
    trace: str | None = None
    """Traceback, if the cause is a fault of the program rather than of the input; else None."""
    process: Literal["", "crashed", "hung"] = ""
    """End of the process that had the item, if it did not end by itself: it ``crashed``, or it ``hung`` and was killed."""
    disk: OSError | None = None
    """The error, if nothing can be written (``DISK_FAULTS``): other items would fail in the same way."""


@dataclass(frozen=True, kw_only=True)
class Care:
    """Retry policy for an item that kills its process or does not end. It needs worker processes: in the caller's own process
    nothing would survive such an item."""

    limit_s: float = math.inf
    """Wall time after which a worker is killed together with its item [s]."""
    tries: int = 1
    """Number of processes that may die of an item before it fails. After a death the item is tried again after all others, one
    at a time."""


NO_CARE = Care()
"""One try without a time limit."""


def attempt(fn: Callable[[Any], Any], item: Any) -> Done | Failed:
    """Call ``fn(item)``; an exception becomes a `Failed`."""
    try:
        return Done(fn(item))
    except Exception as error:
        disk = (
            error if isinstance(error, OSError) and error.errno in DISK_FAULTS else None
        )
        trace = (
            None if disk or isinstance(error, TaccorlError) else traceback.format_exc()
        )
        return Failed(f"{type(error).__name__}: {error}", trace, disk=disk)


def cpu_s(*, children: bool = False) -> float:
    """CPU time (user + system) of this process [s] and, with ``children``, of its child processes that ended."""
    usages = [resource.getrusage(resource.RUSAGE_SELF)]
    if children:
        usages.append(resource.getrusage(resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in usages)


def pickled(thing: Any, what: str) -> bytes:
    """``thing`` as bytes for another process. Raises EngineError: it cannot be pickled."""
    try:
        return pickle.dumps(thing)
    except Exception as error:
        raise EngineError(
            f"{what} cannot be sent to another process: {error}. A function must be defined at the top level of a "
            f"module (no lambda, no function in a function); items must be plain data, such as paths."
        ) from error


def run_in_processes(
    fn: Callable[[Any], Any],
    items: Sequence[Any],
    workers: int,
    name: Callable[[Any], str],
    on_outcome: Callable[[int, Done | Failed], None],
    care: Care = NO_CARE,
    first: int = 0,
) -> None:
    """Run ``fn`` on every item from ``first`` on in ``workers`` processes; ``on_outcome(index, outcome)`` is called when an
    item has ended. ``items``: ``on_outcome`` may append further ones, which are run before those that wait. Raises
    EngineError: ``fn`` or an item cannot be pickled, or workers cannot start."""
    fn_bytes = pickled(fn, f"function {getattr(fn, '__qualname__', fn)}")
    todo = deque[tuple[int, bytes]]()
    known = first
    """Number of items that need not be pickled any more."""
    again = deque[tuple[int, bytes]]()
    """Numbers of the items whose worker process died. They are run again after all others, one at a time."""
    deaths = Counter[int]()
    with _pool(fn_bytes) as pool:
        while True:
            new = [
                (i, pickled(items[i], f"item {name(items[i])}"))
                for i in range(known, len(items))
            ]
            todo.extendleft(reversed(new))
            known = len(items)
            if not todo and not any(worker.index is not None for worker in pool):
                if not again:
                    return
                todo.append(again.popleft())
            while len(pool) < workers and sum(
                not worker.ready for worker in pool
            ) < len(todo):
                pool.append(_Worker(fn_bytes))
            for worker, index, outcome in _looked_at(pool, care.limit_s):
                if isinstance(outcome, Failed) and outcome.process == "crashed":
                    deaths[index] += 1
                    if deaths[index] < care.tries:
                        again.append((index, worker.item_bytes))
                        continue
                on_outcome(index, outcome)
            for worker in pool:
                if worker.ready and worker.index is None and todo:
                    worker.give(*todo.popleft())


def _looked_at(
    pool: list["_Worker"], limit_s: float
) -> Iterator[tuple["_Worker", int, "Done | Failed"]]:
    """Wait until workers send results or end, at most ``LOOK_S``. Yields (worker, number of the item, outcome) for each item that
    ended; removes workers that ended from ``pool``."""
    looked_s = time.monotonic()
    spoke = set(wait([worker.pipe for worker in pool], timeout=LOOK_S))
    passed_s = min(
        time.monotonic() - looked_s, 2 * LOOK_S
    )  # not what all of us were stopped for
    for worker in list(pool):
        worker.busy_s += passed_s
        worker.unseen_s += passed_s
        if (
            worker.pipe in spoke or worker.unseen_s >= LOOK_S
        ):  # a system call for each: not for each message of another
            worker.unseen_s = 0.0
            news = worker.news(limit_s)
            if worker.is_dead:
                pool.remove(worker)
            yield from ((worker, *item) for item in news)


_number: int | None = None  # of this process, if it is a worker
_idle: list["_Worker"] | None = None  # while workers are kept


def worker_number() -> int | None:
    """0, 1, … of this worker process among those that its parent started; None in another process."""
    return _number


@contextlib.contextmanager
def workers_kept() -> Iterator[None]:
    """While open, worker processes remain after ``run_in_processes`` and are used by its next call; they end when this closes.
    Starting a worker costs some seconds of CPU time for imports, and what it has made once."""
    global _idle
    if _idle is not None:
        yield
        return
    _idle = []
    try:
        yield
    finally:
        kept, _idle = _idle, None
        _end(kept)


@contextlib.contextmanager
def _pool(fn_bytes: bytes) -> Iterator[list["_Worker"]]:
    """Workers for one function: those that were kept, and what the caller appends. They end, or are kept again."""
    pool = list[_Worker]()
    try:
        while _idle:
            worker = _idle.pop()
            if worker.process.is_alive():
                worker.load(fn_bytes)
                pool.append(worker)
            else:  # of something else than an item
                _end([worker])
        yield pool
    except BaseException:
        for worker in pool:
            worker.process.terminate()
        _end(pool)
        raise
    if _idle is None:
        _end(pool)
    else:
        _idle.extend(pool)


def _end(pool: Sequence["_Worker"]) -> None:
    for worker in pool:
        worker.pipe.close()  # an idle worker ends when its pipe does
    for worker in pool:
        worker.process.join(GRACE_S)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()


class _Worker:
    """One process as its parent sees it."""

    def __init__(self, fn_bytes: bytes) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, far_end = context.Pipe()
        # Not a daemon: a stage may have processes of its own. That it dies with us is seen to in the worker.
        args = far_end, fn_bytes, os.getpid(), next(_numbers)
        self.process: BaseProcess = context.Process(target=_work, args=args)
        self.process.start()
        far_end.close()
        self.index, self.is_dead, self.busy_s, self.unseen_s = None, False, 0.0, 0.0
        self.item_bytes = b""
        self.loading = 1
        """Number of functions that were sent to this worker and that it has not confirmed to have loaded."""

    @property
    def ready(self) -> bool:
        return not self.loading

    def load(self, fn_bytes: bytes) -> None:
        """Make a worker without an item load another function, even before it has loaded the first."""
        self.loading += 1
        self._send(_FUNCTION + fn_bytes)

    def give(self, index: int, item_bytes: bytes) -> None:
        self.index, self.item_bytes, self.busy_s = index, item_bytes, 0.0
        self._send(_ITEM + item_bytes)

    def _send(self, message: bytes) -> None:
        with contextlib.suppress(OSError):  # it died just now: news() will tell
            self.pipe.send_bytes(message)

    def news(self, limit_s: float) -> list[tuple[int, Done | Failed]]:
        """What became of the item, if anything did; one that has taken longer than ``limit_s`` ends here."""
        ended = (
            self.process.exitcode is not None
        )  # asked first: what it sent before it ended is still in the pipe
        try:
            message = pickle.loads(self.pipe.recv_bytes()) if self.pipe.poll() else None
        except (EOFError, OSError):
            message, ended = None, True
        if message is None:
            if ended:
                return self._died()
            return (
                self._end_hung(limit_s)
                if self.index is not None and self.busy_s > limit_s
                else []
            )
        if not self.ready:
            if isinstance(message, Failed):
                raise EngineError(
                    f"the function cannot be loaded in a worker process: {message.reason}\n{message.trace}"
                )
            self.loading -= 1
            return []
        index, self.index = self.index, None
        return [] if index is None else [(index, message)]

    def _died(self) -> list[tuple[int, Done | Failed]]:
        self.is_dead = True
        self.pipe.close()
        self.process.join(GRACE_S)
        if self.process.is_alive():  # it closed its pipe but goes on: no use to us
            self.process.kill()
            self.process.join()
        how = _exit_in_words(self.process.exitcode)
        if not self.ready:
            why = "Is there enough memory? Fewer workers need less; run it again, it goes on where it was."
            if (self.process.exitcode or 0) >= 0:
                why = "What it printed above says why. "
                why += "A script that uses workers needs its start under `if __name__ == '__main__':`."
            raise EngineError(f"a worker process {how} before it could start. {why}")
        reason = f"the worker process {how} while it had this item"
        return (
            []
            if self.index is None
            else [(self.index, Failed(reason, process="crashed"))]
        )

    def _end_hung(self, limit_s: float) -> list[tuple[int, Done | Failed]]:
        self.is_dead = True
        self.process.kill()
        self.process.join()
        self.pipe.close()
        assert self.index is not None
        reason = f"no end after {limit_s:g} s; the worker process was killed"
        return [(self.index, Failed(reason, process="hung"))]


def _exit_in_words(exitcode: int | None) -> str:
    if exitcode is None or exitcode >= 0:
        return f"ended with exit code {exitcode}"
    try:
        return f"was killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"was killed by signal {-exitcode}"


def _work(pipe: Connection, fn_bytes: bytes, parent_pid: int, number: int = 0) -> None:
    """The worker's life: load the function, then one item after another until the pipe closes."""
    global _number
    _number = number
    _die_with_parent(parent_pid)
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches the parent too, which then ends us in order
    signal.signal(
        signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM)
    )  # so that a stage can tidy up
    loaded = attempt(pickle.loads, fn_bytes)
    with contextlib.suppress(
        EOFError, ConnectionError
    ):  # all work was done, perhaps before this was ready
        pipe.send_bytes(
            pickle.dumps(loaded if isinstance(loaded, Failed) else Done(None))
        )
        while isinstance(loaded, Done):
            message = pipe.recv_bytes()
            kind, content = message[:1], message[1:]
            if kind == _ITEM:
                pipe.send_bytes(_outcome_bytes(loaded.result, content))
            else:
                loaded = attempt(pickle.loads, content)
                pipe.send_bytes(
                    pickle.dumps(loaded if isinstance(loaded, Failed) else Done(None))
                )


def _outcome_bytes(fn: Callable[[Any], Any], item_bytes: bytes) -> bytes:
    outcome = attempt(lambda data: fn(pickle.loads(data)), item_bytes)
    try:
        return pickle.dumps(outcome)
    except Exception as error:
        return pickle.dumps(
            Failed(f"its result cannot be sent back to the parent process: {error}")
        )


def _die_with_parent(parent_pid: int) -> None:
    """End this process as soon as its parent, the process ``parent_pid``, is gone, however the parent ended."""
    threading.Thread(
        target=_end_after_parent, daemon=True
    ).start()  # works everywhere, between two bytecodes
    if (
        sys.platform == "linux"
    ):  # the kernel does it at once, whatever this process is doing
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:  # it was gone before the lines above took effect
        os._exit(1)


def _end_after_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
