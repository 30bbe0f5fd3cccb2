"""Items that kill their process or never end: tried again, given up with the reason, at no cost to others; on clusters too."""

import multiprocessing
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from taccorl.lineage import cluster
from taccorl.lineage.engines import LocalEngine, RayEngine
from taccorl.lineage.errors import EngineError
from taccorl.lineage.processes import Care, Failed, _work

from . import toys

TWICE = Care(tries=2)


def fate(note: Path) -> str:
    """What its name says becomes of the process; every time it is given out, the note grows by a byte."""
    with note.open("a") as file:
        file.write("x")
    times = len(note.read_text())
    if note.name.startswith("once") and times == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    if note.name.startswith("always"):
        os._exit(7)
    if note.name.startswith("hangs"):
        time.sleep(60)
    return f"{note.name} {times}"


def spoken(item: Path, end: Failed) -> str:
    return f"{item.name}: {end.process}: {end.reason}"


def test_an_item_whose_process_died_is_tried_once_more_and_then_has_a_result_that_says_so(tmp_path):
    items, done = [tmp_path / name for name in ("a", "once", "always", "b")], []
    found = LocalEngine(workers=2).map(
        fate, items, on_done=lambda item, result: done.append((item.name, result)), care=TWICE, instead=spoken
    )
    assert found == [
        "a 1",
        "once 2",
        "always: crashed: the worker process ended with exit code 7 while it had this item",
        "b 1",
    ]
    assert (tmp_path / "always").read_text() == "xx"
    assert sorted(done) == sorted(zip(("a", "once", "always", "b"), found, strict=True))
    assert [name for name, _ in done][-2:] == ["once", "always"]  # alone, after all others


@pytest.mark.slow
def test_an_item_that_never_ends_is_killed_at_the_limit_and_not_tried_again(tmp_path):
    began_s = time.monotonic()
    items, care = [tmp_path / name for name in ("hangs", "a", "b")], Care(limit_s=1.0, tries=2)
    found = LocalEngine(workers=2).map(fate, items, care=care, instead=spoken)
    assert found == ["hangs: hung: no end after 1 s; the worker process was killed", "a 1", "b 1"]
    assert (tmp_path / "hangs").read_text() == "x"
    assert time.monotonic() - began_s < 20


@pytest.mark.slow
def test_one_item_of_two_workers_does_not_take_the_command_with_it(tmp_path):
    found = LocalEngine(workers=2).map(fate, [tmp_path / "always"], care=TWICE, instead=spoken)
    assert found[0].startswith("always: crashed: ")


@pytest.mark.slow
def test_where_every_one_of_several_dies_the_machine_is_at_fault_and_nothing_is_taken_for_a_result(tmp_path):
    items = [tmp_path / "always 1", tmp_path / "always 2"]
    with pytest.raises(EngineError, match=r"(?s)2 of 2 items failed.*always 1.*exit code 7.*always 2.*exit code 7"):
        LocalEngine(workers=2).map(fate, items, care=TWICE, instead=lambda *_: pytest.fail("taken for a result"))


def test_an_exception_is_no_end_of_a_process(tmp_path):
    with pytest.raises(EngineError, match="recording 1 is odd"):
        LocalEngine(workers=2).map(toys.refuse_odd, [0, 1], care=TWICE, instead=lambda *_: 5)


class OneAfterAnother:
    """datatrove's Ray executor as far as it is used, in this process: it stands in where Ray is not installed."""

    def __init__(self, pipeline: list[Callable[..., Any]], *, tasks: int, **_: Any) -> None:
        self.pipeline, self.tasks = pipeline, tasks

    def run(self) -> None:
        for rank in range(self.tasks):
            self.pipeline[0](None, rank, self.tasks)


NAMES = ("a", "always", "once", "b", "hangs", "c")
ON_A_CLUSTER = [
    "a 1",
    "always: crashed: the worker process ended with exit code 7 while it had this item",
    "once 2",
    "b 1",
    "hangs: hung: no end after 2 s; the worker process was killed",
    "c 1",
]


def on_ray(folder: Path) -> list[Any]:
    care = Care(limit_s=2.0, tries=2)
    engine = RayEngine(work_dir=folder / "work", tasks=2, mem_per_cpu_gb=1)
    return engine.map(fate, [folder / name for name in NAMES], care=care, instead=spoken)


@pytest.mark.slow
def test_a_task_of_a_cluster_outlives_its_items(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "require_datatrove", lambda: SimpleNamespace(RayPipelineExecutor=OneAfterAnother))
    assert on_ray(tmp_path) == ON_A_CLUSTER


@pytest.mark.slow
def test_the_same_on_ray_itself(tmp_path, monkeypatch):
    ray = pytest.importorskip("ray", reason="extra cluster: ray")
    pytest.importorskip("datatrove.executor", reason="extra cluster: datatrove")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(toys.__file__).parents[1]), *sys.path]))
    ray.init(address="local", num_cpus=2, include_dashboard=False)
    try:
        assert on_ray(tmp_path) == ON_A_CLUSTER
    finally:
        ray.shutdown()


def test_a_worker_that_is_ready_after_all_work_is_done_ends_without_a_word(capfd: pytest.CaptureFixture[str]) -> None:
    context = multiprocessing.get_context("spawn")
    near, far = context.Pipe()
    near.close()
    worker = context.Process(target=_work, args=(far, pickle.dumps(fate), os.getpid()))
    worker.start()
    far.close()
    worker.join(timeout=60)
    assert worker.exitcode == 0
    assert "Traceback" not in capfd.readouterr().err
