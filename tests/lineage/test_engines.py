"""Engines: results in order, failures named, crashes and hangs survived and tried again; no process outlives its parent."""

import errno
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
import types
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import draccus
import pytest

from taccorl.errors import TaccorlError
from taccorl.lineage import engines, processes
from taccorl.lineage.engines import Engine, LocalEngine, RayEngine
from taccorl.lineage.errors import EngineError
from taccorl.lineage.processes import Care, Done, Failed, _work
from tests.fresh_python import fresh_python

from . import toys

ONE_AND_TWO_WORKERS = pytest.mark.parametrize("workers", [1, 2])


@ONE_AND_TWO_WORKERS
def test_results_come_in_the_order_of_the_items(workers):
    done = []
    results = LocalEngine(workers=workers).map(
        toys.double, range(6), on_done=lambda *pair: done.append(pair)
    )
    assert results == [0, 2, 4, 6, 8, 10]
    assert sorted(done) == [(0, 0), (1, 2), (2, 4), (3, 6), (4, 8), (5, 10)]


@ONE_AND_TWO_WORKERS
def test_item_that_fails_is_named_and_the_others_are_done(workers):
    done = []
    with pytest.raises(EngineError) as caught:
        LocalEngine(workers=workers).map(
            toys.refuse_odd, range(5), on_done=lambda item, _: done.append(item)
        )
    assert str(caught.value).splitlines() == [
        "2 of 5 items failed; the others are done:",
        "  1: RecordingError: recording 1 is odd",
        "  3: RecordingError: recording 3 is odd",
    ]
    assert sorted(done) == [0, 2, 4]


@ONE_AND_TWO_WORKERS
def test_fault_of_the_program_shows_its_traceback(workers):
    with pytest.raises(EngineError, match=r"(?s)0: ZeroDivisionError.*return 1 / x"):
        LocalEngine(workers=workers).map(toys.divide_by, [1, 0])


@pytest.mark.parametrize("workers", [1, 2])
def test_a_full_disk_ends_the_run_at_once_with_the_systems_error(workers, tmp_path):
    with pytest.raises(OSError, match="No space left on device") as caught:
        LocalEngine(workers=workers).map(
            toys.fill_disk, [tmp_path / f"{k}" for k in range(40)]
        )
    assert caught.value.errno == errno.ENOSPC and str(caught.value.filename).startswith(
        str(tmp_path)
    )
    assert (
        len(list(tmp_path.iterdir())) < 10
    )  # those that ran at the same time, not all 40


def test_worker_that_crashes_is_named_with_its_item_and_the_others_are_done():
    done = []
    with pytest.raises(EngineError) as caught:
        LocalEngine(workers=2).map(
            toys.crash_on_seven,
            range(12),
            on_done=lambda item, _: done.append(item),
            name="demo_{}".format,
        )
    assert str(caught.value).splitlines() == [
        "2 of 12 items failed; the others are done:",
        "  demo_7: the worker process ended with exit code 3 while it had this item",
        "  demo_8: the worker process was killed by SIGSEGV while it had this item",
    ]
    assert sorted(done) == [0, 1, 2, 3, 4, 5, 6, 9, 10, 11]


def test_function_or_item_that_cannot_be_sent_is_said_before_anything_starts():
    with pytest.raises(EngineError, match=r"function .*lambda.* cannot be sent"):
        LocalEngine(workers=2).map(lambda x: x, [1, 2])
    with pytest.raises(EngineError, match="item <generator"):
        LocalEngine(workers=2).map(toys.double, [1, (x for x in "ab")])
    assert LocalEngine().map(lambda x: x, [1, 2]) == [
        1,
        2,
    ]  # nothing is sent within one process


def test_result_that_cannot_be_sent_back_is_named():
    with pytest.raises(EngineError, match="1: its result cannot be sent back"):
        LocalEngine(workers=2).map(make_generator, [1, 2])


def make_generator(x):
    return (i for i in range(x))


def test_function_that_a_worker_cannot_load_is_said_once(monkeypatch):
    only_here = types.ModuleType("only_here")
    exec("def double(x):\n    return 2 * x", only_here.__dict__)
    monkeypatch.setitem(sys.modules, "only_here", only_here)
    with pytest.raises(
        EngineError, match="cannot be loaded in a worker process: ModuleNotFoundError"
    ):
        LocalEngine(workers=2).map(only_here.double, [1, 2])


@ONE_AND_TWO_WORKERS
def test_items_that_others_gave_rise_to_are_run_and_their_results_follow(workers):
    """0 … 3 are followed by their tens and these by nothing: 8 items, in whatever order they end."""
    more = []

    def tens(item, result):
        more.append(10 * item)
        return [10 * item] if 0 < item < 10 else None

    found = LocalEngine(workers=workers).map(toys.double, [1, 2, 3], on_done=tens)
    assert found[:3] == [2, 4, 6] and sorted(found[3:]) == [20, 40, 60]
    assert sorted(more) == [10, 20, 30, 100, 200, 300]


def test_items_that_others_gave_rise_to_are_run_before_those_that_wait():
    order = []

    def urgent(item, result):
        order.append(item)
        return [1000] if item == 0 else None

    LocalEngine(workers=2).map(toys.double, range(400), on_done=urgent)
    assert order.index(1000) < 300  # at the end it would be the last but for one


def test_an_item_that_another_gave_rise_to_follows_one_whose_process_died():
    done = []
    with pytest.raises(
        EngineError, match="demo_7: the worker process ended with exit code 3"
    ):
        LocalEngine(workers=2).map(
            toys.crash_on_seven,
            [7, 1],
            on_done=lambda item, _: done.append(item) or [item + 1] * (item < 4),
            name="demo_{}".format,
            care=Care(tries=2),
        )
    assert done == [1, 2, 3, 4]


def test_kept_workers_are_used_again_for_another_function_and_end_after_it(tmp_path):
    engine = LocalEngine(workers=2)
    with processes.workers_kept():
        first = set(engine.map(pid_after, [0.3] * 6))
        assert engine.map(toys.double, [1, 2, 3]) == [2, 4, 6]
        assert set(engine.map(pid_after, [0.3] * 6)) == first and len(first) == 2
        with pytest.raises(EngineError, match="recording 1 is odd"):
            engine.map(toys.refuse_odd, range(3))
        assert set(engine.map(pid_after, [0.3] * 6)) == first
    assert not any(is_running(pid) for pid in first)
    assert not set(engine.map(pid_after, [0.3] * 6)) & first


def test_a_worker_that_was_not_ready_before_all_work_was_done_loads_the_next_function():
    """One worker has done both items before the other has started: it then answers for two functions."""
    with processes.workers_kept():
        for _ in range(5):
            assert LocalEngine(workers=3).map(toys.double, [1, 2, 3]) == [2, 4, 6]
            assert LocalEngine(workers=3).map(abs, [-1, -2, -3]) == [1, 2, 3]


def pid_after(seconds):
    time.sleep(seconds)
    return os.getpid()


def test_no_items_give_no_results():
    assert LocalEngine(workers=4).map(toys.double, []) == []


def test_script_without_a_main_guard_is_told_so_instead_of_hanging(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from lineage.toys import double\nfrom taccorl.lineage.engines import LocalEngine\n"
        "LocalEngine(workers=2).map(double, [1, 2])\n"
    )
    done = fresh_python(script, path=Path(toys.__file__).parents[1])
    assert (
        done.returncode == 1
        and "if __name__ == '__main__':" in done.stderr.splitlines()[-1]
    )


# Processes that outlive nobody.

PARENT = """
import sys
from pathlib import Path
from lineage import toys
from taccorl.lineage.engines import LocalEngine
if __name__ == "__main__":
    LocalEngine(workers=2).map(toys.sleep_and_leave_pid, [Path(sys.argv[1]) / "a", Path(sys.argv[1]) / "b"])
"""

PATIENT_PARENT = PARENT.replace(
    "if __name__",
    # A shell that starts pytest in the background makes it ignore SIGINT, and what it starts.
    "import signal\nfrom taccorl.lineage import processes\nprocesses.GRACE_S = 10 * toys.PATIENCE_S\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\nif __name__",
)

PARENT_WITHOUT_KERNEL_HELP = """
import multiprocessing, sys, threading
from pathlib import Path
from lineage import toys
from taccorl.lineage.processes import _end_after_parent
def child(path):
    threading.Thread(target=_end_after_parent, daemon=True).start()
    toys.sleep_and_leave_pid(path)
if __name__ == "__main__":
    spawn = multiprocessing.get_context("spawn")
    for name in "ab":
        spawn.Process(target=child, args=(Path(sys.argv[1]) / name,)).start()
"""


def start_parent(folder: Path, source: str) -> tuple[subprocess.Popen, list[int]]:
    """A script with two busy children, and the children's process ids."""
    (folder / "parent.py").write_text(source)
    words = [sys.executable, str(folder / "parent.py"), str(folder)]
    parent = subprocess.Popen(words, env=toys.ENVIRONMENT, stderr=subprocess.DEVNULL)
    notes = [folder / "a", folder / "b"]
    assert in_time(lambda: all(note.exists() and note.read_text() for note in notes))
    return parent, [int(note.read_text()) for note in notes]


@pytest.mark.parametrize(
    "source",
    [
        PARENT,
        pytest.param(
            PARENT.replace("sleep_and", "spin_and"),
            marks=pytest.mark.skipif(sys.platform != "linux", reason="prctl"),
        ),
        PARENT_WITHOUT_KERNEL_HELP,
    ],
    ids=["asleep", "deep in C code", "without the kernel's help"],
)
def test_workers_die_with_a_sigkilled_parent(tmp_path, source):
    parent, pids = start_parent(tmp_path, source)
    assert all(is_running(pid) for pid in pids)
    parent.kill()
    parent.wait()
    try:
        assert in_time(lambda: not any(is_running(pid) for pid in pids))
    finally:
        end(pids)


def test_interrupted_engine_ends_its_workers_after_they_tidied_up(tmp_path):
    parent, pids = start_parent(tmp_path, PATIENT_PARENT)
    parent.send_signal(signal.SIGINT)
    parent.wait(
        timeout=toys.PATIENCE_S
    )  # sooner than GRACE_S: they were asked to end, and did
    try:
        assert not any(is_running(pid) for pid in pids)
        assert (tmp_path / "a.tidy").exists()
        assert (tmp_path / "b.tidy").exists()
    finally:
        end(pids)


def end(pids: list[int]) -> None:
    for pid in pids:
        if is_running(pid):
            os.kill(pid, signal.SIGKILL)


def in_time(condition) -> bool:
    end_s = time.monotonic() + toys.PATIENCE_S
    while time.monotonic() < end_s:
        if condition():
            return True
        time.sleep(0.02)
    return False


def is_running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in (
        "Z",
        "X",
    )  # a zombie has ended; only its entry waits for whoever adopted it


@dataclass
class AnyConfig:
    engine: Engine = field(default_factory=LocalEngine)


def test_engine_is_chosen_on_the_command_line():
    assert draccus.parse(AnyConfig, args=[]).engine == LocalEngine(workers=1)
    assert draccus.parse(
        AnyConfig, args=["--engine.type=local", "--engine.workers=3"]
    ).engine == LocalEngine(workers=3)
    assert draccus.parse(
        AnyConfig, args=["--engine.type=ray", "--engine.tasks=2"]
    ).engine == RayEngine(tasks=2)


def test_without_ray_the_way_to_it_is_said(monkeypatch):
    monkeypatch.setitem(
        sys.modules, "ray", None
    )  # as if not installed, wherever this runs
    with pytest.raises(
        TaccorlError, match=r"pip install \"lerobot_policy_taccorl\[ray\]\""
    ):
        RayEngine().map(toys.double, [1, 2])


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


def test_an_item_whose_process_died_is_tried_once_more_and_then_has_a_result_that_says_so(
    tmp_path,
):
    items, done = [tmp_path / name for name in ("a", "once", "always", "b")], []
    found = LocalEngine(workers=2).map(
        fate,
        items,
        on_done=lambda item, result: done.append((item.name, result)),
        care=TWICE,
        instead=spoken,
    )
    assert found == [
        "a 1",
        "once 2",
        "always: crashed: the worker process ended with exit code 7 while it had this item",
        "b 1",
    ]
    assert (tmp_path / "always").read_text() == "xx"
    assert sorted(done) == sorted(zip(("a", "once", "always", "b"), found, strict=True))
    assert [name for name, _ in done][-2:] == [
        "once",
        "always",
    ]  # alone, after all others


@pytest.mark.slow
def test_an_item_that_never_ends_is_killed_at_the_limit_and_not_tried_again(tmp_path):
    began_s = time.monotonic()
    items, care = (
        [tmp_path / name for name in ("hangs", "a", "b")],
        Care(limit_s=1.0, tries=2),
    )
    found = LocalEngine(workers=2).map(fate, items, care=care, instead=spoken)
    assert found == [
        "hangs: hung: no end after 1 s; the worker process was killed",
        "a 1",
        "b 1",
    ]
    assert (tmp_path / "hangs").read_text() == "x"
    assert time.monotonic() - began_s < 20


@pytest.mark.slow
def test_one_item_of_two_workers_does_not_take_the_command_with_it(tmp_path):
    found = LocalEngine(workers=2).map(
        fate, [tmp_path / "always"], care=TWICE, instead=spoken
    )
    assert found[0].startswith("always: crashed: ")


@pytest.mark.slow
def test_where_every_one_of_several_dies_the_machine_is_at_fault_and_nothing_is_taken_for_a_result(
    tmp_path,
):
    items = [tmp_path / "always 1", tmp_path / "always 2"]
    with pytest.raises(
        EngineError,
        match=r"(?s)2 of 2 items failed.*always 1.*exit code 7.*always 2.*exit code 7",
    ):
        LocalEngine(workers=2).map(
            fate,
            items,
            care=TWICE,
            instead=lambda *_: pytest.fail("taken for a result"),
        )


def test_an_exception_is_no_end_of_a_process(tmp_path):
    with pytest.raises(EngineError, match="recording 1 is odd"):
        LocalEngine(workers=2).map(
            toys.refuse_odd, [0, 1], care=TWICE, instead=lambda *_: 5
        )


class RayHere:
    """Ray as far as it is used, in this process: it stands in where Ray is not installed. Results are their references."""

    exceptions = SimpleNamespace(RayError=ConnectionError)

    def remote(self, function: Callable[..., list[Any]]) -> Any:
        return SimpleNamespace(
            options=lambda **_: SimpleNamespace(
                remote=lambda *args: tuple(function(*args))
            )
        )

    def wait(self, references: list[Any]) -> tuple[list[Any], list[Any]]:
        return references[-1:], references[:-1]

    def get(self, reference: tuple[Any, ...]) -> tuple[Any, ...]:
        return reference


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
    return RayEngine(tasks=2).map(
        fate, [folder / name for name in NAMES], care=care, instead=spoken
    )


@pytest.mark.slow
def test_a_task_of_a_cluster_outlives_its_items(tmp_path, monkeypatch):
    monkeypatch.setattr(engines, "start_ray", RayHere)
    assert on_ray(tmp_path) == ON_A_CLUSTER


def test_items_of_a_task_that_a_cluster_lost_are_named(monkeypatch):
    class Lossy(RayHere):
        def get(self, reference: tuple[Any, ...]) -> tuple[Any, ...]:
            if Done(2) in reference:
                raise ConnectionError("a node died")
            return reference

    monkeypatch.setattr(engines, "start_ray", Lossy)
    with pytest.raises(
        EngineError,
        match=r"(?s)2 of 5 items failed.*  1: its task ended .*: a node died\n  4: its task",
    ):
        RayEngine(tasks=3).map(toys.double, range(5))


@pytest.mark.slow
def test_the_same_on_ray_itself(tmp_path, monkeypatch):
    ray = pytest.importorskip("ray", reason="extra ray")
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(Path(toys.__file__).parents[1]), *sys.path])
    )
    ray.init(address="local", num_cpus=2, include_dashboard=False)
    try:
        assert on_ray(tmp_path) == ON_A_CLUSTER
    finally:
        ray.shutdown()


@pytest.mark.parametrize("when_ready", [False, True])
def test_a_worker_for_whom_no_work_is_left_ends_without_a_word(
    when_ready, capfd
) -> None:
    context = multiprocessing.get_context("spawn")
    near, far = context.Pipe()
    worker = context.Process(target=_work, args=(far, pickle.dumps(fate), os.getpid()))
    worker.start()
    far.close()
    if when_ready:
        assert near.poll(
            60
        )  # and never read: the worker's next read is reset, not at its end
    near.close()
    worker.join(timeout=60)
    assert worker.exitcode == 0
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("option", ["tasks", "cpus_per_task"])
def test_ray_needs_at_least_one_task_and_one_core(option: str) -> None:
    with pytest.raises(EngineError, match=f"--engine.{option}=0: at least 1"):
        RayEngine(**{option: 0})
