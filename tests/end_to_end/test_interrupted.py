"""``kill -9`` at 30 moments each of ingest, merge, augment, correct and post-train, then the same command again (post-train: with
``--resume=true``): the same result, byte for byte."""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_checkpoint import write_checkpoint

# One process imports LeRobot once and forks the commands: what is killed is a real process in the middle of its work.
RUNNER = """
import os, sys, time, signal
import lerobot.datasets.lerobot_dataset, lerobot.datasets.aggregate, lerobot.configs
import taccorl.evaluation.policy_episodes, taccorl.rl.post_train
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
NUM_KILLS, MOST_TRIES = 30, 5
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
        words = [*words, f"--out={folder / 'out'}"]
        if words[0] != "post-train":
            words.append(f"--store={folder / 'store'}")
        elif (
            folder / "out" / "settings.json"
        ).is_file():  # otherwise it was killed before it had begun
            words.append("--resume=true")
        assert self.process.stdin is not None
        self.process.stdin.write("\t".join([str(kill_after_s), *words]) + "\n")
        self.process.stdin.flush()
        return int(self._read())

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(30)


def content(folder: Path) -> dict[str, str]:
    """Digest of every file of a result and of ingest's report, without what states time: manifest.json, seconds in
    post-training's progress.jsonl, and the content of Rerun's files."""
    found = {}
    for path in (
        *sorted((folder / "out").rglob("*")),
        *folder.glob("out.ingest_report.json"),
    ):
        if path.is_file() and path.name not in ("manifest.json", ".verified.json"):
            data = path.read_bytes() if path.suffix != ".rrd" else b""
            if path.name == "progress.jsonl":
                rows = [json.loads(line) for line in data.splitlines()]
                data = json.dumps(
                    [{key: row[key] for key in row if key != "seconds"} for row in rows]
                ).encode()
            found[str(path.relative_to(folder))] = hashlib.sha256(data).hexdigest()
    return found


def leftovers(folder: Path) -> list[str]:
    """Folders of work that was not finished, and files of cards."""
    found = [p for p in folder.rglob(".*") if p.is_dir() and p.name not in OWN_FOLDERS]
    return [str(p) for p in (*found, *folder.glob("out/.card/*.md"))]


DATASET = ("out/README.md", "out/meta/info.json", "out/data/chunk-000/file-000.parquet")
CHECKPOINT = "out/checkpoints/000002"


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "verb", ["ingest", "merge", "augment", "correct", "post-train"]
)
def test_thirty_kills_then_the_same_result(
    verb: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    words, expected_files = command(verb, tmp_path / "inputs", request)
    commands = Commands()
    try:
        start = time.monotonic()
        assert commands.run(words, tmp_path / "undisturbed") == 0
        duration_s = time.monotonic() - start
        expected = content(tmp_path / "undisturbed")
        assert set(expected_files) <= set(expected)
        rng = random.Random(1)
        for trial in range(NUM_KILLS):
            folder = tmp_path / f"trial_{trial}"
            for _ in range(MOST_TRIES):
                # evenly over the run, at a random place of each stretch
                moment_s = duration_s * (trial + rng.random()) / NUM_KILLS
                start = time.monotonic()
                if commands.run(words, folder, moment_s) == signal.SIGKILL:
                    break
                duration_s = min(
                    duration_s, time.monotonic() - start
                )  # a shared machine: faster now
                shutil.rmtree(folder)
            else:
                pytest.fail(
                    f"ended {MOST_TRIES} times before it could be killed after {moment_s:.2f} s"
                )
            assert commands.run(words, folder) == 0, (
                f"killed after {moment_s:.2f} of {duration_s:.2f} s"
            )
            assert content(folder) == expected, (
                f"killed after {moment_s:.2f} of {duration_s:.2f} s"
            )
            assert leftovers(folder) == []
            shutil.rmtree(folder)
        print(
            f"{verb}: {NUM_KILLS} runs were killed, the last after {moment_s:.1f} of {duration_s:.1f} s"
        )
    finally:
        commands.close()


def command(
    verb: str, inputs: Path, request: pytest.FixtureRequest
) -> tuple[list[str], tuple[str, ...]]:
    """The words of a command, without --out and --store, and files that it must write."""

    def made(name: str) -> str:
        return str(request.getfixturevalue(name))

    if verb == "ingest":
        return ["ingest", made("recordings"), "--spec=piper_flexitac_mcap"], DATASET
    if verb == "merge":
        return ["merge", f"--real={made('dataset')}"], DATASET
    if verb == "augment":
        source = f"--source={made('collected')}"
        return [
            "augment",
            "--task=assembly_2",
            source,
            "--episodes=1",
            "--images=false",
        ], DATASET
    policy = [f"--policy.path={write_checkpoint(inputs)}", "--policy.device=cpu"]
    if verb == "correct":
        small = ["--episodes=2", "--num_envs=2", "--episode_length=3", "--images=false"]
        return ["correct", *policy, "--task=assembly_2", *small], DATASET
    small = [
        "--env.num_envs=2",
        "--env.decisions=2",
        "--env.episode_length=12",
        "--iterations=2",
        "--save_freq=1",
    ]
    small += [
        "--anchor.weight=0",
        "--noise_check=false",
        "--ppo.adapt_lr=true",
        "--ppo.privileged_critic=true",
    ]
    words = ["post-train", *policy, "--env.task=assembly_2", *small]
    return words, (
        f"{CHECKPOINT}/pretrained_model/model.safetensors",
        f"{CHECKPOINT}/training_state/state.safetensors",
    )
