"""Jobs in processes of their own, each with a time limit: one that fails, dies or takes too long costs its own result only."""

import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

_spawn = get_context("spawn")


@dataclass(frozen=True, kw_only=True)
class Done[JobT, ResultT]:
    """One finished job."""

    job: JobT
    result: ResultT | None
    why: str = ""
    """Why there is no result: the traceback, the exit code or the time limit."""


@dataclass
class _Worker[JobT]:
    process: BaseProcess
    pipe: Connection
    job: JobT
    ends_s: float


def finished[JobT, ResultT](
    work: Callable[[JobT], ResultT], jobs: Sequence[JobT], workers: int, limit_s: float
) -> Iterator[Done[JobT, ResultT]]:
    """``work`` of every job, as each is done; jobs begin in their order.

    Args:
        work: of a module, so that processes can import it.
        limit_s: wall time that one job may take, start of its process included.
    """
    waiting, busy = deque(jobs), list[_Worker[JobT]]()
    idle = list[tuple[BaseProcess, Connection]]()
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                process, pipe = idle.pop() if idle else _start(work)
                job = waiting.popleft()
                pipe.send(job)
                busy.append(_Worker(process, pipe, job, time.monotonic() + limit_s))
            ready = wait([w.pipe for w in busy], timeout=max(0.0, min(w.ends_s for w in busy) - time.monotonic()))
            for worker in list(busy):
                if worker.pipe not in ready and time.monotonic() < worker.ends_s:
                    continue
                busy.remove(worker)
                if worker.pipe in ready:
                    done, alive = _received(worker)
                    if alive:
                        idle.append((worker.process, worker.pipe))
                else:
                    worker.process.kill()
                    done = Done(job=worker.job, result=None, why=f"took longer than {limit_s:g} s and was stopped")
                yield done
    finally:
        for process, pipe in [*idle, *((w.process, w.pipe) for w in busy)]:
            pipe.close()
            process.kill()
            process.join()


def _start(work: Callable) -> tuple[BaseProcess, Connection]:
    ours, theirs = _spawn.Pipe()
    process = _spawn.Process(target=_serve, args=(work, theirs), daemon=True)
    process.start()
    theirs.close()
    return process, ours


def _received(worker: _Worker) -> tuple[Done, bool]:
    """What a worker sent, and whether it goes on living."""
    try:
        result, why = worker.pipe.recv()
        return Done(job=worker.job, result=result, why=why), True
    except EOFError:
        worker.process.join()
        return Done(
            job=worker.job, result=None, why=f"its process died with exit code {worker.process.exitcode}"
        ), False


def _serve(work: Callable, pipe: Connection) -> None:
    with suppress(EOFError, KeyboardInterrupt):
        while True:
            job = pipe.recv()
            try:
                answer = (work(job), "")
            except Exception:
                answer = (None, traceback.format_exc(limit=-6))
            pipe.send(answer)
