"""Engines run one function on many items: in this process, in several, or on a cluster.

``--engine.type=local --engine.workers=8``, ``--engine.type=slurm --engine.partition=cpu``, ``--engine.type=ray``

Results come in the order of the items. An item that fails does not stop the others; at the end one `EngineError` names
every item that failed. Finished work is in the store, so the next run does only the rest.
"""

import abc
import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus

from taccorl.lineage import cluster
from taccorl.lineage.errors import EngineError
from taccorl.lineage.processes import NO_CARE, Care, Done, Failed, attempt, run_in_processes

NAMED_FAILURES = 20  # in one message; the rest is counted
NAME_LENGTH = 160
"""Most characters of an item's name in a message."""


@dataclass(frozen=True, kw_only=True)
class Engine(draccus.ChoiceRegistry, abc.ABC):
    """Base class of engines, which run a function on many items."""

    def map(
        self,
        fn: Callable[[Any], Any],
        items: Sequence[Any],
        *,
        on_done: Callable[[Any, Any], Iterable[Any] | None] | None = None,
        name: Callable[[Any], str] = str,
        care: Care = NO_CARE,
        instead: Callable[[Any, Failed], Any] | None = None,
    ) -> list[Any]:
        """Results of ``fn`` for all items, in the order of the items: ``[fn(item) for item in items]``.

        Args:
            fn: a function at the top level of a module; with more than one process it and the items are pickled.
            items: plain data such as paths.
            on_done: function that is called in this process with (item, result) when an item is done, in any order. It may
                return further items, which are run before those that wait; their results follow.
            care: retry policy for items that kill their process or do not end; without effect with a single process.
            instead: function that is called in this process with (item, way its process ended) after the last try, and returns
                the result to use. It is not called if all of several items failed so, because then the machine is at fault.

        Raises:
            EngineError: an item failed; the message names each one and the reason. All other items were done.
            OSError: the disk is full or read-only (``DISK_FAULTS``); the items that wait are not run.
        """
        items = list(items)
        outcomes: dict[int, Done | Failed] = {}

        def take(index: int, outcome: Done | Failed) -> None:
            if isinstance(outcome, Failed) and outcome.disk:
                raise outcome.disk
            outcomes[index] = outcome
            if on_done is not None and isinstance(outcome, Done):
                items.extend(on_done(items[index], outcome.result) or ())

        def short_name(item: Any) -> str:
            return name(item)[:NAME_LENGTH]

        while len(outcomes) < len(items):
            self._run(fn, items, len(outcomes), short_name, take, care)
            ended = {i: o for i, o in outcomes.items() if isinstance(o, Failed) and o.process}
            if instead is not None and not len(ended) == len(items) > 1:
                for index, outcome in sorted(ended.items()):
                    take(index, Done(instead(items[index], outcome)))
        failures = [(short_name(items[i]), o) for i, o in sorted(outcomes.items()) if isinstance(o, Failed)]
        if failures:
            raise EngineError(_failure_text(failures, len(items)))
        return [outcome.result for _, outcome in sorted(outcomes.items()) if isinstance(outcome, Done)]

    @abc.abstractmethod
    def _run(
        self,
        fn: Callable[[Any], Any],
        items: list[Any],
        first: int,
        name: Callable[[Any], str],
        take: Callable[[int, Done | Failed], None],
        care: Care,
    ) -> None:
        """Hand the index and outcome of every item from ``first`` on to ``take``, which may append items. Those may be left to
        the next call."""

    @property
    @abc.abstractmethod
    def at_once(self) -> int:
        """Most items that run at the same time."""


@Engine.register_subclass("local")
@dataclass(frozen=True, kw_only=True)
class LocalEngine(Engine):
    """Engine that runs items in processes of this machine."""

    workers: int = 1
    """Number of processes; with 1 the items run in this process, one after another, which suits a debugger. An item that kills
    its process, or hangs, then ends the run."""

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise EngineError(f"--engine.workers={self.workers}: give at least one process")

    @property
    def at_once(self) -> int:
        return self.workers

    def _run(self, fn, items, first, name, take, care) -> None:
        if self.workers > 1 and (len(items) - first > 1 or care != NO_CARE):
            run_in_processes(fn, items, self.workers, name, take, care, first)
            return
        for index in itertools.count(first):
            if index == len(items):
                return
            take(index, attempt(fn, items[index]))


@dataclass(frozen=True, kw_only=True)
class _ClusterEngine(Engine):
    """One job on a cluster, through datatrove (extra ``cluster``); ``on_done`` is called at its end."""

    work_dir: Path = Path("outputs/cluster")
    """Folder for items, results and logs that all nodes can access. The store must also be in such a folder."""
    tasks: int = 100
    """Most tasks of a job (elements of Slurm's job array, below the cluster's MaxArraySize); each runs every tasks-th item."""
    cpus_per_task: int = 1
    """Number of CPU cores of one task."""
    mem_per_cpu_gb: int = 4
    """Memory that a task gets for each of its CPU cores [GB]."""

    @property
    def at_once(self) -> int:
        return self.tasks

    def _submit(self, run, fn, items, first, name, take, care) -> None:
        """``Engine._run`` by ``run``, a function of ``cluster``, as one job of the items from ``first`` on."""
        run(
            cluster.Job.create(self.work_dir, fn, items[first:], name, care),
            lambda index, outcome: take(first + index, outcome),
            tasks=min(self.tasks, len(items) - first),
            cpus_per_task=self.cpus_per_task,
            mem_per_cpu_gb=self.mem_per_cpu_gb,
        )


@Engine.register_subclass("slurm")
@dataclass(frozen=True, kw_only=True)
class SlurmEngine(_ClusterEngine):
    """A Slurm cluster. Waits until the job has ended."""

    partition: str
    """Name of the Slurm partition."""
    time: str = "24:00:00"
    """Time limit of one task, in Slurm's format."""

    def _run(self, fn, items, first, name, take, care) -> None:
        run = functools.partial(cluster.run_on_slurm, partition=self.partition, time=self.time)
        self._submit(run, fn, items, first, name, take, care)


@Engine.register_subclass("ray")
@dataclass(frozen=True, kw_only=True)
class RayEngine(_ClusterEngine):
    """A running Ray cluster."""

    def _run(self, fn, items, first, name, take, care) -> None:
        self._submit(cluster.run_on_ray, fn, items, first, name, take, care)


def _failure_text(failures: list[tuple[str, Failed]], num_items: int) -> str:
    lines = [f"{len(failures)} of {num_items} items failed; the others are done:"]
    lines += [f"  {name}: {failed.reason}" for name, failed in failures[:NAMED_FAILURES]]
    if len(failures) > NAMED_FAILURES:
        lines.append(f"  and {len(failures) - NAMED_FAILURES} more")
    if trace := next((failed.trace for _, failed in failures if failed.trace), None):
        lines.append(f"The first traceback:\n{trace}")
    return "\n".join(lines)
