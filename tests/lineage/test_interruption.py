"""Kill -9 at any point, and two runs at once: an artefact is complete or absent, and the next run sets all right."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from taccorl.lineage.explain import trace
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.stage import Stage
from taccorl.lineage.store import Store

from . import toys
from .toys import PIPELINE_MIN_S, make_raw, run_pipeline

NUM_KILLS = 25
FILE_EVENTS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.listdir", "os.scandir", "fcntl.flock"}


def start(tmp_path: Path, destination: Path) -> subprocess.Popen:
    """The toy pipeline in a process of its own, its imports done, waiting for a line on its input."""
    words = [tmp_path / "store", tmp_path / "raw", tmp_path / "log", destination]
    process = subprocess.Popen(
        [sys.executable, toys.__file__, *map(str, words)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def go(process: subprocess.Popen) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def temporary(folder: Path) -> list[Path]:
    return [p for p in folder.rglob(".*") if p.is_dir() and p.name not in (".locks", ".digests")]


def wrong(store: Store) -> list[Path]:
    """Artefacts in the store that do not match their manifest."""
    return [path for path in store.artefacts() if not read_manifest(path) or trace(path, None).problems]


def test_sigkill_at_25_random_moments_never_leaves_a_half_artefact_and_a_rerun_gives_the_same_digest(tmp_path):
    rng = random.Random(0)
    expected = run_pipeline(Store(tmp_path / "reference"), make_raw(tmp_path / "raw"))
    seen_temporary = seen_finished = 0
    for i in range(NUM_KILLS):
        here = tmp_path / f"kill_{i}"
        make_raw(here / "raw")
        process = start(here, here / "dataset")
        go(process)
        time.sleep(rng.uniform(0, PIPELINE_MIN_S))  # the pauses alone last longer: it cannot have finished
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL

        store = Store(here / "store")
        seen_temporary += bool(temporary(here))
        seen_finished += bool(store.artefacts())
        assert wrong(store) == []
        assert not (here / "dataset").exists()

        again = run_pipeline(store, here / "raw", here / "dataset")
        assert again.digest == expected.digest
        assert temporary(here) == []
        assert wrong(store) == []
        assert len(store.artefacts()) == 2
    assert seen_temporary >= NUM_KILLS // 3  # else the kills came too early or too late to mean anything
    assert seen_finished >= 1


def run_until_event(kill_at: int, work) -> bool:
    """``work()`` in a forked process that kills itself at its ``kill_at``-th file operation; True if it got through."""
    pid = os.fork()
    if pid == 0:
        seen = 0

        def count(event: str, _arguments: tuple) -> None:
            nonlocal seen
            if event in FILE_EVENTS:
                seen += 1
                if seen == kill_at:
                    os.kill(os.getpid(), signal.SIGKILL)

        try:
            sys.addaudithook(count)
            work()
            os._exit(0)
        except BaseException:
            os._exit(1)
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    assert status in (0, -signal.SIGKILL), status
    return status == 0


def write_two(config, inputs, out_dir):
    (out_dir / "sub").mkdir()
    (out_dir / "one").write_text("1")
    (out_dir / "sub" / "two").write_text("2")


TWO = Stage("two", write_two)


def half_artefacts_over_all_kill_points(tmp_path: Path, store_class: type[Store]) -> tuple[int, int]:
    """Kill before every single file operation of a run, in turn: number of kill points, and of wrong artefacts seen."""
    num_wrong = 0
    for kill_at in range(1, 500):
        root = tmp_path / f"at_{kill_at}"
        if run_until_event(kill_at, lambda root=root: store_class(root).run(TWO, None, [])):
            return kill_at - 1, num_wrong
        store = Store(root)
        num_wrong += len(wrong(store))
        if not wrong(store):
            store.run(TWO, None, [])
            assert wrong(store) == []
            assert temporary(root) == []
            assert len(store.artefacts()) == 1
    raise AssertionError("the run never got through")


def test_killed_before_each_of_its_file_operations_a_run_never_leaves_a_wrong_artefact(tmp_path):
    num_points, num_wrong = half_artefacts_over_all_kill_points(tmp_path, Store)
    assert num_points >= 15  # mkdir, two files, their flushing, the manifest, the rename, the lock, …
    assert num_wrong == 0


class HastyStore(Store):
    """The planted bug: builds in the final place, manifest first."""

    def _make(self, job):
        from taccorl.lineage.store import _seal

        job.final.mkdir(parents=True)
        (job.final / "one").write_text("early")
        _seal(job.final, job, seconds=0.0)
        job.stage.fn(job.config, [], job.final)
        return super()._existing(job)


def test_a_store_that_writes_the_manifest_first_is_caught_by_the_same_check(tmp_path):
    _, num_wrong = half_artefacts_over_all_kill_points(tmp_path, HastyStore)
    assert num_wrong > 0


def test_manifest_is_the_last_file_opened_for_writing_and_one_rename_follows(tmp_path):
    store, events, watching = Store(tmp_path / "store"), [], True

    def watch(event: str, arguments: tuple) -> None:
        if watching and event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR):
            events.append(("write", Path(os.fsdecode(arguments[0])).name))
        elif watching and event == "os.rename":
            events.append(("rename", Path(arguments[1]).name))

    sys.addaudithook(watch)  # stays for the life of the process: hence the switch
    artefact = store.run(TWO, None, [])
    watching = False
    key = artefact.manifest["key"]
    lock = ("write", f"{key}.lock")
    assert [e for e in events if e != lock] == [
        ("write", "one"),
        ("write", "two"),
        ("write", "manifest.json"),
        ("rename", key),
    ]


def test_two_processes_at_once_do_the_work_once_and_agree(tmp_path):
    make_raw(tmp_path / "raw")
    processes = [start(tmp_path, tmp_path / "dataset") for _ in range(2)]
    for process in processes:
        go(process)
    digests = [process.communicate(timeout=30)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    assert digests[0] == digests[1] != ""
    assert sorted((tmp_path / "log").read_text().splitlines()) == ["ingest demo_0.raw", "ingest demo_1.raw", "merge"]


def test_two_threads_at_once_do_the_work_once(tmp_path):
    store, raw, log, digests = Store(tmp_path / "store"), make_raw(tmp_path / "raw"), tmp_path / "log", []
    threads = [
        threading.Thread(target=lambda: digests.append(run_pipeline(store, raw, log=log).digest)) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(digests) == 3
    assert len(set(digests)) == 1
    assert len(log.read_text().splitlines()) == 3


def test_waiting_run_takes_over_when_the_first_is_killed(tmp_path):
    make_raw(tmp_path / "raw")
    first, second = start(tmp_path, tmp_path / "dataset"), start(tmp_path, tmp_path / "dataset")
    go(first)
    time.sleep(0.01)
    go(second)
    time.sleep(0.01)
    first.kill()
    first.communicate()
    digest = second.communicate(timeout=30)[0].strip()
    assert digest == run_pipeline(Store(tmp_path / "reference"), tmp_path / "raw").digest
    assert temporary(tmp_path) == []
