"""``kill -9`` at 30 moments each of ingest, merge and augment, then the same command again: the same result, byte for byte."""

import hashlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

# One process imports LeRobot once and forks the commands: what is killed is a real process in the middle of its work.
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
NUM_KILLS = 30
OWN_FOLDERS = (".locks", ".digests", ".destinations", ".card")


class Commands:
    """Commands by real processes that can be killed."""

    def __init__(self) -> None:
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

    def run(self, words: list[str], folder: Path, kill_after_s: float = 300.0) -> int:
        """Exit status as of waitpid; 9 if it was killed."""
        words = [*words, f"--out={folder / 'out'}", f"--store={folder / 'store'}"]
        assert self.process.stdin is not None
        self.process.stdin.write("\t".join([str(kill_after_s), *words]) + "\n")
        self.process.stdin.flush()
        return int(self._read())

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(30)


def content(folder: Path) -> dict[str, str]:
    """Digest of every file of a dataset, and of ingest's report; the manifest says when it was made, so not that."""
    files = [p for p in sorted((folder / "out").rglob("*")) if p.is_file() and p.name != "manifest.json"]
    files += folder.glob("out.ingest_report.json")
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def leftovers(folder: Path) -> list[str]:
    """Folders of work that was not finished, and files of cards."""
    found = [p for p in folder.rglob(".*") if p.is_dir() and p.name not in OWN_FOLDERS]
    return [str(p) for p in (*found, *folder.glob("out/.card/*.md"))]


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("verb", ["ingest", "merge", "augment"])
def test_thirty_kills_then_the_same_dataset(
    verb: str, recordings: Path, dataset: Path, collected: Path, tmp_path: Path
) -> None:
    words = {
        "ingest": ["ingest", str(recordings), "--spec=piper_flexitac_mcap"],
        "merge": ["merge", f"--real={dataset}"],
        "augment": ["augment", "--task=assembly_2", f"--source={collected}", "--episodes=1", "--images=false"],
    }[verb]
    commands = Commands()
    try:
        start = time.monotonic()
        assert commands.run(words, tmp_path / "undisturbed") == 0
        duration_s = time.monotonic() - start
        expected = content(tmp_path / "undisturbed")
        assert {"out/README.md", "out/meta/info.json", "out/data/chunk-000/file-000.parquet"} <= set(expected)
        rng, killed = random.Random(1), 0
        for trial in range(NUM_KILLS):
            folder = tmp_path / f"trial_{trial}"
            # evenly over the run, at a random place of each stretch
            moment_s = duration_s * (trial + rng.random()) / NUM_KILLS
            killed += commands.run(words, folder, moment_s) == signal.SIGKILL
            assert commands.run(words, folder) == 0
            assert content(folder) == expected, f"killed after {moment_s:.2f} of {duration_s:.2f} s"
            assert leftovers(folder) == []
        assert killed >= NUM_KILLS // 2, "most runs ended before they could be killed"
        print(f"{verb}: {killed} of {NUM_KILLS} runs of {duration_s:.1f} s were killed")
    finally:
        commands.close()
