"""Trials of ``taccorl evaluate --robot.type=…`` through the real server process, and the README's section On the robot."""

import json
import os
import re
import resource
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from simulated_robot import SimulatedRobot

from taccorl.data.dataset import Dataset
from taccorl.errors import TaccorlError
from taccorl.evaluation.episodes import read_rows
from taccorl.robot_plugin import lerobot_hooks

ROOT = Path(__file__).resolve().parents[2]
ENV = {
    **os.environ,
    "PYTHONPATH": str(ROOT),
    "HF_HUB_OFFLINE": "1",
    "OMP_NUM_THREADS": "1",
}
Start = Callable[..., tuple[subprocess.Popen, int]]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Start]:
    """Function that starts ``taccorl serve-surrogate`` and returns its process, stopped after the test, and its port."""
    started = []

    def start(*words: str, port: int = 0) -> tuple[subprocess.Popen, int]:
        command = [
            sys.executable,
            "-m",
            "taccorl.cli.main",
            "serve-surrogate",
            f"--port={port}",
            *words,
        ]
        log = tmp_path / f"server_{len(started)}.log"
        with log.open("w") as out:
            started.append(
                subprocess.Popen(command, env=ENV, stdout=out, stderr=subprocess.STDOUT)
            )
        while "listening" not in log.read_text():
            assert started[-1].poll() is None, log.read_text()
            time.sleep(0.1)
        return started[-1], int(log.read_text().partition("on port ")[2].split()[0])

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def evaluate(
    tmp_path: Path, checkpoint: Path, capfd: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Runs ``taccorl evaluate`` on a surrogate in this process; (exit status, what was printed)."""
    from taccorl.cli.main import main

    def run(port: int, *words: str) -> tuple[int, str]:
        patient = [
            "--robot.lost_after_s=5",
            "--robot.safety.max_age_s={state: 3, camera: 3, pad: 3}",
        ]
        patient += [
            "--robot.safety.stop_after_s=9",
            "--robot.safety.effort={pos: 90}",
        ]  # the policy has learnt nothing
        patient += ["--robot.type=taccorl_surrogate", f"--robot.port={port}"]
        places = [
            f"--robot.calibration_dir={tmp_path}",
            "--robot.id=trials",
            f"--out={tmp_path / 'trials'}",
        ]
        own = [
            f"--policy.path={checkpoint}",
            "--policy.device=cpu",
            "--episode_length=150",
        ]
        own += (
            []
            if any(word.startswith("--task=") for word in words)
            else ["--task=assembly_1"]
        )
        code = main(["evaluate", *own, *patient, *places, *words])
        shown = capfd.readouterr()
        lerobot_hooks._policy = None  # forgotten after the test
        return code, " ".join((shown.out + shown.err).split())

    return run


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_trials_on_a_surrogate_are_kept_and_gone_on_with(
    served: Start, evaluate: Any, tmp_path: Path
) -> None:
    _, port = served()
    code, shown = evaluate(port, "--episodes=2")
    assert (
        code == 0
        and "on a surrogate, assembly_1: 0 of 2 episodes succeeded: 0.0 % (95 %: 0.0 … 65.8)"
        in shown
    )
    rows = read_rows(tmp_path / "trials/episodes.jsonl")
    assert [(row.seed, row.outcome) for row in rows] == [
        (1000, "timeout"),
        (1001, "timeout"),
    ]
    assert all(row.time_s >= 5.0 for row in rows) and any(
        "period_p99_ms" in row.measures for row in rows
    )
    summary = json.loads((tmp_path / "trials/evaluation.json").read_text())
    assert (
        summary["robot"]["void"] == [] and "not a robot" in summary["robot"]["origin"]
    )
    page = (tmp_path / "trials/report.html").read_text()
    assert (
        "Run on a surrogate, not a robot" in page
        and "Simulated in the MuJoCo twin" not in page
    )
    assert page.count("data:image/jpeg;base64,") >= 2
    assert (tmp_path / "trials/trials/assembly_1_seed_1000.mcap").is_file()

    # As after a stop: the first trial is kept, the second is run.
    lines = (tmp_path / "trials/episodes.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "trials/episodes.jsonl").write_text(lines[0])
    code, shown = evaluate(port, "--episodes=2")
    assert (
        code == 0 and "trial 2 of 2, seed 1001" in shown and "trial 1 of 2" not in shown
    )
    assert read_rows(tmp_path / "trials/episodes.jsonl")[0] == rows[0]
    code, shown = evaluate(port, "--episodes=2", "--seed=7")
    assert code == 2 and "holds other scenes" in shown
    code, shown = evaluate(
        port, "--episodes=2", "--task=puzzle", f"--out={tmp_path / 'other'}"
    )
    assert (
        code == 2
        and "--task=puzzle: the surrogate on that port runs assembly_1" in shown
    )


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_trial_whose_server_dies_is_void(
    served: Start, evaluate: Any, tmp_path: Path
) -> None:
    server, port = served()
    rows = tmp_path / "trials/episodes.jsonl"

    def kill() -> None:
        while not rows.is_file():
            time.sleep(0.01)
        time.sleep(1.0)  # the second trial, or its connection
        server.kill()

    threading.Thread(target=kill, daemon=True).start()
    code, shown = evaluate(
        port, "--episodes=3", "--robot.lost_after_s=0.3", "--episode_length=300"
    )
    assert (
        code == 2 and "void, not counted" in shown and "3 void trials in a row" in shown
    )
    assert "1 trials are kept: the same command goes on" in shown
    assert [row.seed for row in read_rows(rows)] == [1000]
    assert (
        len(
            json.loads((tmp_path / "trials/evaluation.json").read_text())["robot"][
                "void"
            ]
        )
        == 3
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--twin=none.yaml",), "--twin has no effect with --robot.type: remove it"),
        (("--before_mate=2",), "--before_mate has no effect"),
        (("--against=expert",), "--against=FOLDER of an earlier evaluation at most"),
        (("--robot.prt=1",), "prt"),
        (("--robot.type=taccorl_surogate",), "did you mean 'taccorl_surrogate'"),
        (("--robot.type=",), "--robot.type: give it"),
        (("--robot.dry_run=true",), "--robot.dry_run, --robot.record: a trial moves"),
        ((), "no surrogate answers on port 9"),
    ],
)
def test_wrong_options_are_refused(
    words: tuple[str, ...], said: str, evaluate: Any, tmp_path: Path
) -> None:
    code, shown = evaluate(9, *words)
    assert (
        code == 2
        and said in shown
        and not (tmp_path / "trials/episodes.jsonl").exists()
    )


def test_a_person_judges_by_keys_and_corrects_a_wrong_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from taccorl.robot_plugin.trials import Quit, Trials
    from taccorl.sim.task import tasks

    with pytest.raises(TaccorlError, match="so101_follower: has no limits and stops"):
        Trials(
            {"type": "so101_follower", "port": "/dev/ttyACM0"},
            None,
            tasks.get("assembly_1"),
        )
    reader, writer = os.pipe()
    with os.fdopen(reader) as stdin, os.fdopen(writer, "w") as person:
        monkeypatch.setattr(sys, "stdin", stdin)
        trials = Trials.__new__(Trials)
        trials.link, trials.task, trials._ended, trials._found = (
            None,
            tasks.get("assembly_1"),
            threading.Event(),
            [],
        )
        assert trials._verdict() is None  # nobody has typed
        for line, outcome in (
            ("x", None),
            ("y", "success"),
            ("n", "failed"),
            ("n dropped", "dropped"),
            ("v", "void"),
        ):
            print(line, file=person, flush=True)
            verdict = trials._verdict()
            assert (verdict and verdict.outcome) == outcome
        print("y", file=person, flush=True)
        trials._judge()
        assert (
            trials._ended.is_set()
            and trials._found[0].partial == trials.task.max_partial
        )
        person.close()
        with pytest.raises(Quit, match="standard input is closed"):
            trials._verdict()


def test_a_full_disk_ends_the_recording_and_not_the_loop(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    robot = SimulatedRobot(
        tmp_path, camera_px=64, paced=True, record=tmp_path / "run.mcap"
    )
    robot.connect()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(
        resource.RLIMIT_FSIZE, (4096, limits[1])
    )  # writing fails as on a full disk
    try:
        for _ in range(100):
            seen = robot.get_observation()
            robot.send_action({name: seen[name] for name in robot.body.names})
        assert [
            r.message
            for r in caplog.records
            if "the recording ends here, unfinished" in r.message
        ]
        assert robot.commands == 100 and not robot.guard.stopped
        robot.disconnect()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


SECTION = re.split(
    r"\n## ",
    (ROOT / "README.md").read_text("utf-8").partition("\n## On the robot\n")[2],
)[0]
LINES = [
    line
    for block in re.findall(r"```\n(.*?)```", SECTION, re.DOTALL)
    for line in block.splitlines()
]
PATIENT = "{state: 3.0, camera: 3.0, pad: 3.0}"
"""Ages that are accepted, because tests run side by side on a loaded machine; safety has tests of its own."""
STOP = re.compile(
    r"STOPPED: (the (left|right) hand would be at .* outside of safety|effort of .*, at most (15|45))"
)
"""Reasons for which safety, with its default limits, stops arms that move at random."""


def added(port: int) -> dict[str, list[str]]:
    """Command → options that a test adds to it: the server's port, small pictures, few steps, long time limits."""
    safety = [f"safety.max_age_s={PATIENT}", "safety.stop_after_s=9"]
    options = [
        f"port={port}",
        "camera_px=64",
        "lost_after_s=5",
        "id=two_terminals",
        "calibration_dir=calibration",
    ]
    robot = [f"--robot.{option}" for option in (*options, *safety)]
    train = [
        "--steps=2",
        "--batch_size=2",
        "--num_workers=0",
        "--save_freq=2",
        "--policy.device=cpu",
    ]
    return {
        "serve-surrogate": [f"--port={port}", "--camera_px=64"],
        "lerobot-record": [
            *robot,
            f"--teleop.port={port}",
            "--dataset.episode_time_s=4",
            "--robot.record=run.mcap",
        ],
        "lerobot-train": train,
        "lerobot-rollout": [
            *robot,
            "--duration=4",
            "--device=cpu",
            "--return_to_initial_position=false",
        ],
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
    run = subprocess.run(
        words(LINES[1], port),
        cwd=tmp_path,
        env=ENV,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (
        run.returncode
        and f"start one with taccorl serve-surrogate --port={port}," in run.stderr
    )
    assert (
        list(tmp_path.rglob("*recorded*")) == []
    )  # a folder would make the next try fail
    with (tmp_path / "first.log").open("w") as log:
        first = subprocess.Popen(
            words(LINES[0], port),
            cwd=tmp_path,
            env=ENV,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    try:
        while "listening" not in (tmp_path / "first.log").read_text():
            assert first.poll() is None, (tmp_path / "first.log").read_text()
            time.sleep(0.2)
        for line in LINES[1:]:
            run = subprocess.run(
                words(line, port),
                cwd=tmp_path,
                env=ENV,
                capture_output=True,
                text=True,
                check=False,
            )
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
    assert re.search(
        r"\nended after \d+ commands.*\n$", (tmp_path / "first.log").read_text()
    )
    episode = Dataset(tmp_path / "outputs/recorded").episode(0)
    assert episode.origin.domain == "surrogate" and episode.num_rows > 10
    assert (tmp_path / "run.mcap").stat().st_size > 100_000
