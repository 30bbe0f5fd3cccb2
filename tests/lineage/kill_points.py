"""Script ``kill_points.py FOLDER``: kill a run before each of its file operations, in turn.

Prints how many such points there are, and after how many of them an artefact in the store did not match its manifest.
A script of its own because it forks: a fresh process has no threads that a fork could catch half-way.
"""

import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taccorl.lineage.explain import trace
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.stage import Stage
from taccorl.lineage.store import Store

FILE_EVENTS = {
    "open",
    "os.mkdir",
    "os.rename",
    "os.remove",
    "os.rmdir",
    "os.listdir",
    "os.scandir",
    "fcntl.flock",
}


def write_two(config: Any, inputs: list[Path], out_dir: Path) -> None:
    (out_dir / "sub").mkdir()
    (out_dir / "one").write_text("1")
    (out_dir / "sub" / "two").write_text("2")


def copy_one(config: Any, inputs: list[Path], out_dir: Path) -> None:
    shutil.copyfile(inputs[0] / "one", out_dir / "one")


TWO, PUBLISHED = Stage("two", write_two), Stage("published", copy_one)


def run(store: Store) -> None:
    """An artefact in the store, and one that is made from it beside the store."""
    made = store.run(TWO, None, [])
    store.run(
        PUBLISHED,
        None,
        [made],
        destination=store.root.with_name(f"{store.root.name}_out"),
    )


def wrong(store: Store) -> list[Path]:
    """Artefacts in the store, and published by it, that do not match their manifest."""
    made = [*store.artefacts(), *store.root.parent.glob(f"{store.root.name}_out")]
    return [
        path for path in made if not read_manifest(path) or trace(path, None).problems
    ]


def temporary(folder: Path) -> list[Path]:
    """Temporary folders anywhere below."""
    return [
        p
        for p in folder.rglob(".*")
        if p.is_dir() and p.name not in (".locks", ".digests", ".destinations")
    ]


def survives(kill_at: int, work: Callable[[], Any]) -> bool:
    """``work()`` in a forked process that kills itself before its ``kill_at``-th file operation; True if it ended."""
    if (pid := os.fork()) == 0:
        seen = 0

        def count(event: str, _arguments: tuple) -> None:
            nonlocal seen
            seen += event in FILE_EVENTS
            if event in FILE_EVENTS and seen == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(count)
        try:
            work()
            os._exit(0)
        except BaseException:
            os._exit(1)
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    assert status in (0, -signal.SIGKILL), status
    return status == 0


def main(folder: Path) -> None:
    num_wrong = 0
    for kill_at in range(1, 1000):
        root = folder / f"at_{kill_at}"
        if survives(kill_at, lambda root=root: run(Store(root))):
            print(kill_at - 1, num_wrong)
            return
        store = Store(root)
        num_wrong += len(wrong(store))
        if not wrong(store):
            run(store)
            left = [path for path in temporary(folder) if root.name in str(path)]
            assert (len(store.artefacts()), wrong(store), left) == (1, [], [])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
