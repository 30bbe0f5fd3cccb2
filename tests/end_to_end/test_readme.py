"""The commands of README.md and of the pads in docs/twin.md, from top to bottom: every option exists, and every line works.

What is given here is made up: a surrogate robot, stand-in recordings, and an arm of one joint that this file simulates. Lines
that would take hours as they stand are made small (``SMALL``); blocks below a comment that says so are not run.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from taccorl.cli.completion import options_of
from taccorl.cli.main import VERBS

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PADS = (ROOT / "docs/twin.md").read_text(encoding="utf-8").partition("## Diagnose its pads")[2]
FENCE = re.compile(r"(?:<!--(?P<comment>.*?)-->\n)?```(?P<language>\w*)\n(?P<text>.*?)```", re.DOTALL)
PROGRAMS = re.compile(r"(taccorl|lerobot-\w+|make|python) ")
NOT_RUN = "no test runs these"
SMALL = {  # verb → options that take the place of the line's own, or are added
    "collect": ("--episodes=1",),
    "augment": ("--episodes=1",),
    "view": ("--save=episode.rrd",),  # there is no screen
    "lerobot-train": ("--steps=2", "--batch_size=2", "--num_workers=0", "--save_checkpoint=false"),
}
PAGES = ("README.md", *(f"docs/{p.name}" for p in sorted((ROOT / "docs").glob("*.md"))))


@dataclass(frozen=True)
class Command:
    """A line of a block."""

    words: list[str]
    is_run: bool

    @property
    def verb(self) -> str:
        return self.words[1] if self.words[0] == "taccorl" else self.words[0]


def commands(page: str) -> list[Command]:
    """Lines of blocks without a language that call a program of ours, without their comments; other blocks are diagrams."""
    found = []
    for block in FENCE.finditer(page):
        if not block["language"]:
            text = block["text"].replace("\\\n", " ")
            lines = (shlex.split(line, comments=True) for line in text.splitlines() if PROGRAMS.match(line))
            found += [Command(words, NOT_RUN not in (block["comment"] or "")) for words in lines if words]
    return found


def unknown_options(command: Command) -> list[str]:
    """Options of a ``taccorl`` line that its verb does not have."""
    if command.words[0] != "taccorl":
        return []
    if command.verb not in [verb for verbs in VERBS.values() for verb in verbs]:
        return [command.verb]
    given = [word.removeprefix("--").partition("=")[0] for word in command.words if word.startswith("--")]
    known = options_of(command.verb)
    return [name for name in given if name not in known and not any(k.startswith(f"{name}.") for k in known)]


@pytest.mark.parametrize("page", PAGES)
def test_every_option_that_is_shown_exists(page: str) -> None:
    wrong = {shlex.join(c.words): found for c in commands((ROOT / page).read_text()) if (found := unknown_options(c))}
    assert not wrong


def test_every_line_of_the_readme_calls_a_program_of_ours() -> None:
    blocks = [block["text"] for block in FENCE.finditer(README) if not block["language"]]
    assert len(commands(README)) == sum(bool(line.strip()) for text in blocks for line in text.splitlines())


def test_an_option_that_was_renamed_is_found() -> None:
    planted = [
        Command([w.replace("--", "--no_such_", 1) if w == option else w for w in c.words], c.is_run)
        for c in commands(README)
        for option in [w for w in c.words if w.startswith("--")]
        if c.words[0] == "taccorl"
    ]
    assert len(planted) > 30
    assert all(len(unknown_options(c)) == 1 for c in planted)


def smaller(command: Command) -> list[str]:
    """The words of a line, small enough for a test."""
    options = SMALL.get(command.verb, ())
    names = {option.partition("=")[0] for option in options}
    return [*(w for w in command.words if w.partition("=")[0] not in names), *options]


class Walk:
    """A folder in which the lines are run, with what the README says one has before each."""

    def __init__(self, folder: Path, recordings: Path) -> None:
        self.folder, self.recordings = folder, recordings
        self.given: dict[str, Callable[[], None]] = {  # begin of a line → what is made before it
            "taccorl ingest inspect recording.mcap": self.some_recordings,
            "taccorl init-robot my_arm.xml": self.tables_of_an_arm,
            "taccorl compare sweeps/ --twin=my_robot.yaml": self.fill_todos,
            "taccorl compare sweeps/ --twin=twin.yaml": self.sweeps_of_the_piper,
            "taccorl compare presses/": self.presses,
            "taccorl merge": lambda: shutil.copytree("outputs/my_dataset", "recorded") and None,
        }

    def run(self, *words: str) -> None:
        bin_folder = Path(sys.executable).parent
        env = os.environ | {"PATH": f"{bin_folder}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(words, cwd=self.folder, env=env, capture_output=True, text=True, check=False)
        print(f"$ {shlex.join(words)}\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
        assert done.returncode == 0, f"{shlex.join(words)} ended with {done.returncode}"
        assert "Traceback" not in done.stderr

    def some_recordings(self) -> None:
        shutil.copytree(self.recordings, "recordings")
        shutil.copy(next(Path("recordings").glob("*.mcap")), "recording.mcap")

    def tables_of_an_arm(self) -> None:
        Path("my_arm.xml").write_text(ARM)
        Path("sweeps").mkdir()
        for name, hz, seed in (("one", 0.6, 1), ("again", 0.6, 2), ("held", 0.8, 3)):
            write_table(Path("sweeps") / f"{name}.csv", hz, seed)
        Path("sweeps/measurements.yaml").write_text(
            "recordings:\n  again.csv: {repeat_of: one.csv}\n  held.csv: {use: validation}\n"
        )

    def fill_todos(self) -> None:
        path = Path("my_robot.yaml")
        text = path.read_text().replace("gravity_compensation: TODO", "gravity_compensation: 0.0")
        path.write_text(text.replace("gains: TODO", "gains: commanded"))
        assert "TODO" not in re.sub(r"#.*", "", path.read_text())

    def sweeps_of_the_piper(self) -> None:
        shutil.rmtree("sweeps")
        hidden = ("--secret=3", "--effects=[coulomb_friction]", "--signal=left_joint4", "--strength=12")
        self.run("taccorl", "surrogate", *hidden, "--design=chirp", "--gains_known=true", "--out=robot")
        Path("robot/sweeps").rename("sweeps")
        shutil.copy("robot/twin.yaml", "twin.yaml")

    def presses(self) -> None:
        words = ("--pads=left", "--effects=[taxel_saturation]", "--out=pads")
        self.run("taccorl", "surrogate", "--secret=4", *words)
        Path("pads/presses").rename("presses")
        shutil.copy("pads/twin.yaml", "twin.yaml")


INERTIA_KGM2, FRICTION_NM, KP, KD = 0.1, 0.6, 60.0, 4.0
RATE_HZ, PARTS = 250, 40
ARM = f"""
<mujoco><compiler angle="radian"/><worldbody>
<body name="lower"><joint name="elbow" axis="0 0 1" range="-2 2"/>
<inertial pos="0 0 0" mass="1" diaginertia="{INERTIA_KGM2} {INERTIA_KGM2} {INERTIA_KGM2}"/></body></worldbody>
<actuator><position name="servo" joint="elbow" kp="{KP}" kv="{KD}" forcerange="-30 30"/></actuator></mujoco>
"""


def write_table(path: Path, hz: float, seed: int) -> None:
    """The elbow, turning about the vertical, with dry friction that its model lacks, under PD control in steps of 0.1 ms."""
    time_s = np.arange(4 * RATE_HZ) / RATE_HZ
    fade = np.clip(np.minimum(time_s - 0.3, 3.7 - time_s) / 0.4, 0, 1)
    target = 0.3 * fade**2 * (3 - 2 * fade) * np.sin(2 * np.pi * hz * (time_s - 0.3))
    dt_s, at, speed, goal, rows = 1.0 / (RATE_HZ * PARTS), 0.0, 0.0, 0.0, []
    stops = dt_s * FRICTION_NM / INERTIA_KGM2
    for following in target.tolist():
        rows.append((at, KP * (goal - at) - KD * speed))
        goal = following
        for _ in range(PARTS):
            free = speed + dt_s * (KP * (goal - at) - KD * speed) / INERTIA_KGM2
            speed = 0.0 if abs(free) <= stops else free - np.sign(free) * stops
            at += dt_s * speed
    noise = np.random.default_rng(seed).standard_normal((len(rows), 2)) * [5e-5, 5e-3]
    lines = ["t,elbow.q,elbow.q_target,elbow.tau"]
    for t, goal, (q, tau) in zip(time_s, target, np.array(rows) + noise, strict=True):
        lines.append(f"{t:.4f},{q:.7f},{goal:.7f},{tau:.5f}")
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_every_line_works_from_top_to_bottom(recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    walk, made = Walk(tmp_path, recordings), []
    for command in (c for c in commands(README) + commands(PADS) if c.is_run):
        for line, make in walk.given.items():
            if shlex.join(command.words).startswith(line) and line not in made:
                make()
                made.append(line)
        walk.run(*smaller(command))
    assert set(made) == set(walk.given), "the pages no longer need what is made here"
    assert {"both", "many", "my_robot+coulomb_friction.yaml"} <= {p.name for p in tmp_path.iterdir()}
