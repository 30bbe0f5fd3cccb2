"""Engines run one function on many items: in this process, in several, or on a Ray cluster.

``--engine.type=local --engine.workers=8``, ``--engine.type=ray --engine.tasks=100``

Results come in the order of the items. An item that fails does not stop the others; at the end one `EngineError` names
every item that failed. Finished work is in the store, so the next run does only the rest.
"""

import abc
import importlib
import itertools
import logging
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import draccus

from taccorl.errors import TaccorlError
from taccorl.lineage.errors import EngineError
from taccorl.lineage.processes import (
    NO_CARE,
    Care,
    Done,
    Failed,
    attempt,
    run_in_processes,
)

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
            ended = {
                i: o for i, o in outcomes.items() if isinstance(o, Failed) and o.process
            }
            if instead is not None and not len(ended) == len(items) > 1:
                for index, outcome in sorted(ended.items()):
                    take(index, Done(instead(items[index], outcome)))
        failures = [
            (short_name(items[i]), o)
            for i, o in sorted(outcomes.items())
            if isinstance(o, Failed)
        ]
        if failures:
            raise EngineError(_failure_text(failures, len(items)))
        return [
            outcome.result
            for _, outcome in sorted(outcomes.items())
            if isinstance(outcome, Done)
        ]

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
            raise EngineError(
                f"--engine.workers={self.workers}: give at least one process"
            )

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


@Engine.register_subclass("ray")
@dataclass(frozen=True, kw_only=True)
class RayEngine(Engine):
    """The Ray cluster of RAY_ADDRESS, else one on this machine (extra ``ray``). All nodes must see the folder of the store."""

    tasks: int = 100
    """Most tasks at the same time; each runs every tasks-th item, in a process of its own, so that an item that kills it, or
    hangs, costs no other. ``on_done`` is called when a task has ended."""
    cpus_per_task: int = 1
    """Number of CPU cores that Ray reserves for a task."""

    def __post_init__(self) -> None:
        for name in ("tasks", "cpus_per_task"):
            if getattr(self, name) < 1:
                raise EngineError(f"--engine.{name}={getattr(self, name)}: at least 1")

    @property
    def at_once(self) -> int:
        return self.tasks

    def _run(self, fn, items, first, name, take, care) -> None:
        ray = start_ray()
        task = ray.remote(_outcomes).options(num_cpus=self.cpus_per_task)
        shares = [
            range(start, len(items), self.tasks)
            for start in range(first, min(first + self.tasks, len(items)))
        ]
        running = {
            task.remote(fn, [items[i] for i in share], care): share for share in shares
        }
        while running:
            (ended,), _ = ray.wait(list(running))
            share = running.pop(ended)
            try:
                outcomes = ray.get(ended)
            except ray.exceptions.RayError as error:
                outcomes = [Failed(f"its task ended without a result: {error}")] * len(
                    share
                )
            for index, outcome in zip(share, outcomes, strict=True):
                take(index, outcome)


def _outcomes(
    fn: Callable[[Any], Any], items: list[Any], care: Care
) -> list[Done | Failed]:
    """Outcomes of all items, in their order, from another process of this machine."""
    outcomes: dict[int, Done | Failed] = {}
    run_in_processes(fn, items, 1, str, outcomes.__setitem__, care)
    return [outcomes[index] for index in range(len(items))]


def start_ray() -> Any:
    """Start Ray and return its module: connected to the cluster of RAY_ADDRESS, else to one on this machine. Raises
    TaccorlError: Ray is not installed, or cannot be reached."""
    try:
        ray: Any = importlib.import_module("ray")
    except ModuleNotFoundError as error:
        raise TaccorlError(
            'Ray is not installed: pip install "lerobot_policy_taccorl[ray]"'
        ) from error
    address = os.environ.get("RAY_ADDRESS", "local")
    silent: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.WARNING}
    if address == "local":
        silent["include_dashboard"] = False
    else:
        print(f"Ray: connecting to RAY_ADDRESS={address}", flush=True)
    try:
        ray.init(address, ignore_reinit_error=True, **silent)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise TaccorlError(
            f"RAY_ADDRESS={address}: no Ray there ({error}); start it, or unset RAY_ADDRESS"
        ) from error
    return ray


def _failure_text(failures: list[tuple[str, Failed]], num_items: int) -> str:
    lines = [f"{len(failures)} of {num_items} items failed; the others are done:"]
    lines += [
        f"  {name}: {failed.reason}" for name, failed in failures[:NAMED_FAILURES]
    ]
    if len(failures) > NAMED_FAILURES:
        lines.append(f"  and {len(failures) - NAMED_FAILURES} more")
    if trace := next((failed.trace for _, failed in failures if failed.trace), None):
        lines.append(f"The first traceback:\n{trace}")
    return "\n".join(lines)
