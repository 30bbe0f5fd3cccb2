"""The README's section "On the robot": two terminals, five commands, typed as they stand, made small for a test."""

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from taccorl.data.dataset import Dataset

ROOT = Path(__file__).resolve().parents[2]
SECTION = re.split(r"\n## ", (ROOT / "README.md").read_text("utf-8").partition("\n## On the robot\n")[2])[0]
LINES = [line for block in re.findall(r"```\n(.*?)```", SECTION, re.DOTALL) for line in block.splitlines()]
PATIENT = "{state: 3.0, camera: 3.0, pad: 3.0}"
"""Ages that are accepted, because tests run side by side on a loaded machine; safety has tests of its own."""
ENV = {**os.environ, "PYTHONPATH": str(ROOT), "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
STOP = re.compile(r"STOPPED: (the (left|right) hand would be at .* outside of safety|effort of .*, at most (15|45))")
"""Reasons for which safety, with its default limits, stops arms that move at random."""


def added(port: int) -> dict[str, list[str]]:
    """Verb → options that a test adds: a port of its own, small pictures, few steps, patience."""
    safety = [f"safety.max_age_s={PATIENT}", "safety.stop_after_s=9"]
    options = [f"port={port}", "camera_px=64", "lost_after_s=5", "id=two_terminals", "calibration_dir=calibration"]
    robot = [f"--robot.{option}" for option in (*options, *safety)]
    train = ["--steps=2", "--batch_size=2", "--num_workers=0", "--save_freq=2", "--policy.device=cpu"]
    return {
        "serve-surrogate": [f"--port={port}", "--camera_px=64"],
        "lerobot-record": [*robot, f"--teleop.port={port}", "--dataset.episode_time_s=4", "--robot.record=run.mcap"],
        "lerobot-train": train,
        "lerobot-rollout": [*robot, "--duration=4", "--device=cpu", "--return_to_initial_position=false"],
    }


def words(line: str, port: int) -> list[str]:
    """A line as this interpreter runs it. An option that is given twice counts by its last value."""
    program, *rest = shlex.split(line)
    verb = rest[0] if program == "taccorl" else program
    more = added(port).get(verb, [])
    names = {word.partition("=")[0] for word in more}
    rest = [word for word in rest if word.partition("=")[0] not in names] + more
    if program == "taccorl":
        return [sys.executable, "-m", "taccorl.cli.main", *rest]
    return [sys.executable, "-m", f"lerobot.scripts.{program.replace('-', '_')}", *rest]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_two_terminals_record_train_and_run(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    run = subprocess.run(words(LINES[1], port), cwd=tmp_path, env=ENV, capture_output=True, text=True, check=False)
    assert run.returncode and f"start one with taccorl serve-surrogate --port={port}," in run.stderr
    assert list(tmp_path.rglob("*recorded*")) == []  # a folder would make the next try fail
    with (tmp_path / "first.log").open("w") as log:
        first = subprocess.Popen(words(LINES[0], port), cwd=tmp_path, env=ENV, stdout=log, stderr=subprocess.STDOUT)
    try:
        while "listening" not in (tmp_path / "first.log").read_text():
            assert first.poll() is None, (tmp_path / "first.log").read_text()
            time.sleep(0.2)
        for line in LINES[1:]:
            run = subprocess.run(words(line, port), cwd=tmp_path, env=ENV, capture_output=True, text=True, check=False)
            told = f"{line}\n{run.stdout[-2000:]}\n{run.stderr[-3000:]}"
            # `check` may note that a loaded machine was slow; it finds no error.
            # A policy of two steps acts at random: safety, with its default limits, may stop it, and nothing else.
            if "lerobot-rollout" in line and run.returncode:
                assert STOP.search(run.stderr), told
                continue
            assert run.returncode in ((0, 1) if "taccorl check" in line else (0,)), told
            assert "error  " not in run.stdout and "STOPPED" not in run.stderr, told
    finally:
        first.send_signal(signal.SIGTERM)
        first.wait(30)
    assert first.returncode == 143
    assert re.search(r"\nended after \d+ commands.*\n$", (tmp_path / "first.log").read_text())
    episode = Dataset(tmp_path / "outputs/recorded").episode(0)
    assert episode.origin.domain == "surrogate" and episode.num_rows > 10
    assert (tmp_path / "run.mcap").stat().st_size > 100_000
