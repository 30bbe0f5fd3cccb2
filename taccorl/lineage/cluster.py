"""Run the same function on a Slurm or Ray cluster: datatrove's executors start the tasks; items and results are files.

A job is a folder that all nodes see: ``job.pkl`` (function, items, retry policy), ``results/<index>.pkl`` (renamed into place),
``logs/``. Task r of n works on the items r, r+n, r+2n, … in a process of its own, so that an item that kills it, or hangs,
costs no other. A result that is not there when the job has ended means that its task was killed: the item is named.
"""

import importlib
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from taccorl.lineage.errors import EngineError
from taccorl.lineage.processes import NO_CARE, Care, Done, Failed, pickled, run_in_processes

POLL_S = 5.0  # how often to look for new results of a Slurm job

Take = Callable[[int, Done | Failed], None]
"""Function that is called with (index of an item, its outcome)."""


@dataclass(frozen=True)
class Job:
    """A function, its items and the retry policy, stored in a folder for tasks on other machines."""

    folder: Path
    """Folder of the job, which all nodes can access."""
    num_items: int
    """Number of items."""

    @classmethod
    def create(
        cls,
        work_dir: Path,
        fn: Callable[[Any], Any],
        items: list[Any],
        name: Callable[[Any], str],
        care: Care = NO_CARE,
    ) -> "Job":
        """Write a job into a new folder below ``work_dir``. Raises EngineError: ``fn`` or an item cannot be pickled."""
        require_datatrove()
        inner = fn
        while hasattr(inner, "func"):  # functools.partial
            inner = inner.func  # type: ignore[attr-defined]
        if getattr(inner, "__module__", None) == "__main__":
            raise EngineError(
                f"function {getattr(inner, '__qualname__', inner)} is defined in the script that was started: other "
                f"machines cannot import it. Move it into a module and import it from there."
            )
        for item in items:
            pickled(item, f"item {name(item)}")
        content = pickled((fn, items, care), f"function {getattr(inner, '__qualname__', inner)}")
        started = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        folder = work_dir.absolute() / f"{started}-{os.getpid()}-{os.urandom(2).hex()}"
        (folder / "results").mkdir(parents=True)
        (folder / "job.pkl").write_bytes(content)
        return cls(folder, len(items))

    def collect(self, taken: set[int], take: Take) -> None:
        """Call ``take`` with every result that arrived since the last call. ``taken``: indices of the items whose results were
        taken; changed in place."""
        for path in sorted((self.folder / "results").glob("*.pkl")):
            index = int(path.stem)
            if index not in taken:
                taken.add(index)
                take(index, pickle.loads(path.read_bytes()))

    def name_the_lost(self, taken: set[int], take: Take) -> None:
        """After the end of the job, call ``take`` for the items without a result, which are reported as failed."""
        for index in range(self.num_items):
            if index not in taken:
                take(index, Failed(f"its task ended without a result; logs: {self.folder / 'logs'}"))


class RankTask:
    """Work of one task, as a datatrove pipeline step. Contains only a path, so that it is cheap to send."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, data: Any = None, rank: int = 0, world_size: int = 1) -> None:
        fn, items, care = pickle.loads((self.folder / "job.pkl").read_bytes())
        mine = range(rank, len(items), world_size)

        def write(place: int, outcome: Done | Failed) -> None:
            path = self.folder / "results" / f"{mine[place]:06d}.pkl"
            temp = path.with_suffix(".part")
            temp.write_bytes(pickle.dumps(outcome))
            temp.replace(path)

        run_in_processes(fn, [items[index] for index in mine], 1, str, write, care)


def require_datatrove() -> Any:
    """The module ``datatrove.executor``, imported. Raises EngineError: datatrove is not installed."""
    try:
        return importlib.import_module("datatrove.executor")
    except ImportError as error:
        raise EngineError(
            f"the slurm and ray engines need datatrove ({error}): pip install lerobot_policy_taccorl[cluster]"
        ) from error


def run_on_slurm(job: Job, take: Take, *, tasks: int, **slurm: Any) -> None:
    """Submit the job array, then wait for it, taking results as they come."""
    executor = require_datatrove().SlurmPipelineExecutor(
        [RankTask(job.folder)],
        tasks=tasks,
        venv_path=str(Path(sys.prefix) / "bin" / "activate"),
        logging_dir=str(job.folder / "logs"),
        job_name="taccorl",
        **slurm,
    )
    executor.run()
    taken: set[int] = set()
    while len(taken) < job.num_items and _in_queue(executor.job_id):
        job.collect(taken, take)
        time.sleep(POLL_S)
    job.collect(taken, take)
    job.name_the_lost(taken, take)


def _in_queue(job_id: str) -> bool:
    queue = subprocess.run(["squeue", "-h", "-j", str(job_id)], capture_output=True, text=True, check=False)
    if queue.returncode != 0 and "Invalid job id" not in queue.stderr:
        return True  # squeue itself is not well: the job may be, so ask again
    return bool(queue.stdout.strip())


def run_on_ray(job: Job, take: Take, *, tasks: int, **ray: Any) -> None:
    """Run the tasks on the running Ray cluster, then collect all results."""
    executor = require_datatrove().RayPipelineExecutor(
        [RankTask(job.folder)], tasks=tasks, logging_dir=str(job.folder / "logs"), **ray
    )
    executor.run()
    taken: set[int] = set()
    job.collect(taken, take)
    job.name_the_lost(taken, take)
