"""``kill -9`` at random moments of a real ingest, then the same command again: the same dataset, byte for byte."""

import hashlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

# One process imports LeRobot once and forks the ingests: what is killed is a real process in the middle of its work.
RUNNER = """
import os, sys, time, signal
import lerobot.datasets.lerobot_dataset, lerobot.datasets.aggregate, lerobot.configs
from taccorl.cli.main import main
print("ready", flush=True)
for line in sys.stdin:
    kill_after, *words = line.rstrip("\\n").split("\\t")
    pid = os.fork()
    if pid == 0:
        os.setpgid(0, 0)
        null = os.open(os.devnull, os.O_WRONLY); os.dup2(null, 1); os.dup2(null, 2)
        os._exit(main(words))
    end = time.monotonic() + float(kill_after)
    done = 0
    while time.monotonic() < end and not done:
        done, status = os.waitpid(pid, os.WNOHANG)
        time.sleep(0.005)
    if not done:
        os.killpg(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
    print(status, flush=True)
"""


class Ingests:
    """Ingests by real processes that can be killed."""

    def __init__(self, recordings: Path) -> None:
        self.recordings = recordings
        self.process = subprocess.Popen(
            [sys.executable, "-c", RUNNER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self._read("ready")

    def _read(self, wanted: str = "") -> str:
        assert self.process.stdout is not None
        while True:
            line = self.process.stdout.readline().strip()
            assert line or self.process.poll() is None, "the runner died"
            if line and (not wanted or line == wanted):
                return line

    def run(self, folder: Path, kill_after_s: float = 300.0) -> int:
        """Exit status as of waitpid; 9 if it was killed."""
        words = [
            "ingest",
            str(self.recordings),
            "--spec=piper_flexitac_mcap",
            f"--out={folder / 'out'}",
            f"--store={folder / 'store'}",
        ]
        assert self.process.stdin is not None
        self.process.stdin.write("\t".join([str(kill_after_s), *words]) + "\n")
        self.process.stdin.flush()
        return int(self._read())

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(30)


def content(folder: Path) -> dict[str, str]:
    """Digest of every parquet and JSON file of a dataset and of its report; the manifest says when it was made, so not that."""
    files = [p for p in sorted((folder / "out").rglob("*")) if p.suffix in (".parquet", ".json", ".mp4")]
    files = [p for p in files if p.name != "manifest.json"] + [folder / "out.ingest_report.json"]
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def leftovers(folder: Path) -> list[str]:
    return [
        str(p)
        for p in folder.rglob("*")
        if p.is_dir() and p.name.startswith(".") and p.name not in (".locks", ".digests", ".destinations")
    ]


def kill_and_resume(recordings: Path, tmp_path: Path, num_kills: int, seed: int) -> None:
    ingests = Ingests(recordings)
    try:
        start = time.monotonic()
        assert ingests.run(tmp_path / "undisturbed") == 0
        duration_s = time.monotonic() - start
        expected = content(tmp_path / "undisturbed")
        assert sum(name.endswith(".parquet") for name in expected) >= 3
        rng, killed = random.Random(seed), 0
        for trial in range(num_kills):
            folder = tmp_path / f"trial_{trial}"
            # evenly over the run, at a random place of each stretch
            moment_s = duration_s * (trial + rng.random()) / num_kills
            killed += ingests.run(folder, moment_s) == signal.SIGKILL
            assert ingests.run(folder) == 0
            assert content(folder) == expected, f"killed after {moment_s:.2f} of {duration_s:.2f} s"
            assert leftovers(folder) == []
        assert killed >= num_kills // 2, "most runs ended before they could be killed"
    finally:
        ingests.close()


@pytest.mark.slow
def test_eight_kills_then_the_same_dataset(recordings: Path, tmp_path: Path) -> None:
    kill_and_resume(recordings, tmp_path, num_kills=8, seed=1)
