"""Kill -9 at any point, and two runs at once: an artefact is complete or absent, and the next run sets all right."""

import subprocess
import sys
import threading
import time
from pathlib import Path

from taccorl.lineage.store import Store

from . import kill_points, toys
from .kill_points import temporary
from .toys import make_raw, run_pipeline


def start(tmp_path: Path, destination: Path) -> subprocess.Popen:
    """The toy pipeline in a process of its own, its imports done, waiting for a line on its input."""
    words = [tmp_path / "store", tmp_path / "raw", tmp_path / "log", destination]
    process = subprocess.Popen(
        [sys.executable, toys.__file__, *map(str, words)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def go(process: subprocess.Popen) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def test_killed_before_each_of_its_file_operations_a_run_never_leaves_a_wrong_artefact(
    tmp_path,
):
    words = [sys.executable, kill_points.__file__, str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    num_points, num_wrong = map(int, done.stdout.split())
    assert (
        num_points >= 30
    )  # folders, files, flushing them, the manifest, the rename, the lock, …
    assert num_wrong == 0


def test_two_processes_at_once_do_the_work_once_and_agree(tmp_path):
    make_raw(tmp_path / "raw")
    processes = [start(tmp_path, tmp_path / "dataset") for _ in range(2)]
    for process in processes:
        go(process)
    digests = [process.communicate(timeout=30)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    assert digests[0] == digests[1] != ""
    assert sorted((tmp_path / "log").read_text().splitlines()) == [
        "ingest demo_0.raw",
        "ingest demo_1.raw",
        "merge",
    ]


def test_two_threads_at_once_do_the_work_once(tmp_path):
    store, raw, log, digests = (
        Store(tmp_path / "store"),
        make_raw(tmp_path / "raw"),
        tmp_path / "log",
        [],
    )
    threads = [
        threading.Thread(
            target=lambda: digests.append(run_pipeline(store, raw, log=log).digest)
        )
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(digests) == 3 and len(set(digests)) == 1
    assert len(log.read_text().splitlines()) == 3


def test_waiting_run_takes_over_when_the_first_is_killed(tmp_path):
    make_raw(tmp_path / "raw")
    first, second = (
        start(tmp_path, tmp_path / "dataset"),
        start(tmp_path, tmp_path / "dataset"),
    )
    go(first)
    time.sleep(0.01)
    go(second)
    time.sleep(0.01)
    first.kill()
    first.communicate()
    digest = second.communicate(timeout=30)[0].strip()
    assert (
        digest == run_pipeline(Store(tmp_path / "reference"), tmp_path / "raw").digest
    )
    assert temporary(tmp_path) == []
