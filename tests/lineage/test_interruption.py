"""Kill -9 at any point, and two runs at once: an artefact is complete or absent, and the next run sets all right."""

import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

from taccorl.lineage.store import Store

from . import kill_points, toys
from .kill_points import TWO, temporary
from .toys import make_raw, run_pipeline


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


def kill_at_every_point(tmp_path: Path, kind: str) -> list[int]:
    words = [sys.executable, kill_points.__file__, str(tmp_path), kind]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    return [int(word) for word in done.stdout.split()]


def test_killed_before_each_of_its_file_operations_a_run_never_leaves_a_wrong_artefact(tmp_path):
    num_points, num_wrong = kill_at_every_point(tmp_path, "sound")
    assert num_points >= 30  # folders, files, flushing them, the manifest, the rename, the lock, …
    assert num_wrong == 0


def test_a_store_that_writes_the_manifest_first_is_caught_by_the_same_check(tmp_path):
    _, num_wrong = kill_at_every_point(tmp_path, "hasty")
    assert num_wrong > 0


def test_manifest_is_the_last_file_opened_for_writing_and_one_rename_follows(tmp_path):
    store, events = Store(tmp_path / "store"), []
    with store.lock("any"):
        pass  # the store's own files are there from now on
    watching = True

    def watch(event: str, arguments: tuple) -> None:
        if watching and event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR):
            events.append(("write", re.sub(r"\.\d+-[0-9a-f]{8}\.new$", ".new", Path(os.fsdecode(arguments[0])).name)))
        elif watching and event == "os.rename":
            events.append(("rename", Path(arguments[1]).name))

    sys.addaudithook(watch)  # stays for the life of the process: hence the switch
    artefact = store.run(TWO, None, [])
    watching = False
    key = artefact.manifest["key"]
    lock = [("write", f"{key}.lock"), ("write", f"{key}.holder")]
    assert [e for e in events if e not in lock] == [
        ("write", "one"),
        ("write", "two"),
        ("write", ".manifest.json.new"),
        ("rename", "manifest.json"),
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
