"""Cheap stages and functions for the tests of lineage, and a script that runs them: ``toys.py STORE RAW LOG [DEST]``.

The pipeline: two raw files → ``ingest`` each → ``merge``. Every run of a stage appends one line to the log.
"""

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from taccorl.errors import RecordingError
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store

PAUSE_S = 0.004
NUM_PARTS = 5
PATIENCE_S = 240.0  # Time after which a test gives up waiting: long, so that no test depends on how busy the machine is
ENVIRONMENT = os.environ | {
    "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
}


@dataclass(frozen=True, kw_only=True)
class IngestConfig:
    rate_hz: float = 30.0
    log: Path | None = field(default=None, compare=False)


def ingest(config: Any, inputs: list[Path], out_dir: Path) -> None:
    _log(config.log, f"ingest {inputs[0].name}")
    content = inputs[0].read_bytes()
    (out_dir / "data").mkdir()
    for i in range(NUM_PARTS):
        time.sleep(PAUSE_S)
        (out_dir / "data" / f"{i}.bin").write_bytes(
            content[i:] + str(config.rate_hz).encode()
        )


def merge(config: Any, inputs: list[Path], out_dir: Path) -> None:
    _log(config.log, "merge")
    for i in range(NUM_PARTS):
        time.sleep(PAUSE_S)
        (out_dir / f"{i}.bin").write_bytes(
            b"".join((path / "data" / f"{i}.bin").read_bytes() for path in inputs)
        )


def _log(path: Path | None, line: str) -> None:
    if path is not None:
        with path.open("a") as file:
            file.write(f"{line}\n")


INGEST = Stage("ingest", ingest)
MERGE = Stage("merge", merge)
MERGE_DATASET = Stage("merge", merge, manifest="meta/taccorl/manifest.json")


def make_raw(folder: Path, num: int = 2) -> Path:
    folder.mkdir(parents=True)
    for i in range(num):
        (folder / f"demo_{i}.raw").write_bytes(bytes([i]) * 200)
    return folder


def run_pipeline(
    store: Store, raw: Path, destination: Path | None = None, *, log: Path | None = None
) -> Artefact:
    config = IngestConfig(log=log)
    episodes = [
        store.run(INGEST, config, [store.source(path)])
        for path in sorted(raw.iterdir())
    ]
    return store.run(
        MERGE if destination is None else MERGE_DATASET,
        config,
        episodes,
        destination=destination,
    )


def run_and_die(store_root: Path, destination: Path | None = None) -> None:
    """A run in another process that is killed while its stage works: leaves a temporary folder with 1000 bytes."""
    script = (
        "import sys; from lineage.toys import start_dying; start_dying(*sys.argv[1:])"
    )
    words = [
        sys.executable,
        "-c",
        script,
        str(store_root),
        *([str(destination)] if destination else []),
    ]
    assert (
        subprocess.run(words, env=ENVIRONMENT, check=False).returncode
        == -signal.SIGKILL
    )


def start_dying(store_root: str, destination: str | None = None) -> None:
    Store(Path(store_root)).run(
        Stage("one", _die),
        "x",
        [],
        destination=Path(destination) if destination else None,
    )


def _die(config: Any, inputs: list[Path], out_dir: Path) -> None:
    (out_dir / "half").write_text("x" * 1000)
    os.kill(os.getpid(), signal.SIGKILL)


def double(x: int) -> int:
    return 2 * x


def refuse_odd(x: int) -> int:
    if x % 2:
        raise RecordingError(f"recording {x} is odd")
    return x


def divide_by(x: int) -> float:
    return 1 / x


def crash_on_seven(x: int) -> int:
    if x == 7:
        os._exit(3)
    if x == 8:
        os.kill(os.getpid(), signal.SIGSEGV)
    return x


def sleep_and_leave_pid(path: Path) -> None:
    path.write_text(str(os.getpid()))
    try:
        time.sleep(10 * PATIENCE_S)
    finally:
        path.with_suffix(".tidy").touch()


def spin_and_leave_pid(path: Path) -> None:
    path.write_text(str(os.getpid()))
    sum(
        range(10**11)
    )  # a minute or more of C code that lets no other Python thread run


def fill_disk(path: Path) -> None:
    """Leave a mark, then write to a device that is always full, as if it were ``path``."""
    path.touch()
    time.sleep(0.05)
    try:
        with Path("/dev/full").open("w") as full:
            full.write("x")
    except OSError as error:
        error.filename = str(path)
        raise


if __name__ == "__main__":
    store_root, raw_folder, log_file, *dest = [Path(word) for word in sys.argv[1:]]
    print("ready", flush=True)
    sys.stdin.readline()
    print(run_pipeline(Store(store_root), raw_folder, *dest, log=log_file).digest)
