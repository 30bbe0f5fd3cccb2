"""The commands of README.md and of sections of docs/, from top to bottom: every option exists, every line works, and prints
what README shows of it.

What is given here is made up: stand-in recordings, and surrogates of a PiPER and of an arm with one joint. Lines that would take
hours as they stand are made small (``SMALL``); blocks below a comment that says so are not run.
"""

import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import get_type_hints

import pytest
from simulated_sweeps import write_folder

from pipelines.studies.slides import draw_slide, recordings
from taccorl.cli.main import VERBS
from taccorl.cli.parse import _inner_names
from taccorl.diagnosis.experiment_design.motions import ground_of
from taccorl.diagnosis.machines.load import load_machine

SEED = 5
"""Seed of the simulated arm."""
ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SECTIONS = (  # run after README.md, in this order
    ("training.md", "## Train, with LeRobot's own commands"),
    ("training.md", "## Both domains"),
    ("your_robot.md", "## A robot of an MJCF or URDF file"),
    ("your_robot.md", "## Plan recordings"),
    ("twin.md", "## Diagnose its joints"),
    ("twin.md", "## Diagnose its pads"),
    ("data.md", "## Look at it"),
)
FENCE = re.compile(
    r"(?:<!--(?P<comment>.*?)-->\n)?```(?P<language>\w*)\n(?P<text>.*?)```", re.DOTALL
)
CELL = re.compile(
    r"^\|.*?`((?:taccorl|lerobot-\w+) [^`]+)`", re.MULTILINE
)  # First command in a row of a table
PROGRAMS = re.compile(r"(taccorl|lerobot-\w+|make|python) ")
NOT_RUN = "no test runs these"
SMALL = {  # verb → options that take the place of the line's own, or are added
    "collect": ("--episodes=1",),
    "augment": ("--episodes=1",),
    "view": ("--save=episode.rrd",),  # there is no screen
    "lerobot-train": (
        "--steps=2",
        "--batch_size=2",
        "--num_workers=0",
        "--save_checkpoint=false",
    ),
}
ELSEWHERE = {"serve-surrogate": "taccorl.robot_plugin.surrogate_server"}
"""Verb → module that defines its options, if not the verb's own."""
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
    """Lines of blocks without a language that call a program of ours, without their comments; other blocks are diagrams. Then
    the commands in tables, which assume what the blocks make."""
    found = []
    for block in FENCE.finditer(page):
        if not block["language"]:
            text = block["text"].replace("\\\n", " ")
            lines = (
                shlex.split(line, comments=True)
                for line in text.splitlines()
                if PROGRAMS.match(line)
            )
            found += [
                Command(words, NOT_RUN not in (block["comment"] or ""))
                for words in lines
                if words
            ]
    return found + [
        Command(shlex.split(line), True) for line in CELL.findall(FENCE.sub("", page))
    ]


def sections() -> list[Command]:
    """Commands of ``SECTIONS``; a section ends at the next heading."""
    found = []
    for name, title in SECTIONS:
        _, there, rest = (
            (ROOT / "docs" / name).read_text(encoding="utf-8").partition(f"\n{title}\n")
        )
        assert there, f"docs/{name}: no {title}"
        found += commands(re.split(r"\n#+ ", rest)[0])
    return found


def masked(text: str) -> str:
    """``text`` without its numbers and the widths of its columns, which another processor may change."""
    return re.sub(r"\s+", " ", re.sub(r"-?\d[\d.,]*", "0", text))


def options_of(verb: str) -> set[str]:
    """Names of the options of a verb and of its second words, nested ones with a dot: ``engine.workers``."""
    module = importlib.import_module(
        ELSEWHERE.get(verb, f"taccorl.cli.{verb.replace('-', '_')}")
    )
    configs = [
        kind
        for name, kind in vars(module).items()
        if name.endswith("Config") and is_dataclass(kind)
    ]
    hints = [
        (name.rstrip("_"), hint)
        for config in configs
        for name, hint in get_type_hints(config).items()
    ]
    return {"config_path"}.union(
        *(
            {name, *(f"{name}.{inner}" for inner in _inner_names(hint))}
            for name, hint in hints
        )
    )


def unknown_options(command: Command) -> list[str]:
    """Options of a ``taccorl`` line that its verb does not have."""
    if command.words[0] != "taccorl":
        return []
    if command.verb not in [verb for verbs in VERBS.values() for verb in verbs]:
        return [command.verb]
    given = [
        word.removeprefix("--").partition("=")[0]
        for word in command.words
        if word.startswith("--")
    ]
    known = options_of(command.verb)
    return [
        name
        for name in given
        if name not in known and not any(k.startswith(f"{name}.") for k in known)
    ]


@pytest.mark.parametrize("page", PAGES)
def test_every_option_that_is_shown_exists(page: str) -> None:
    wrong = {
        shlex.join(c.words): found
        for c in commands((ROOT / page).read_text())
        if (found := unknown_options(c))
    }
    assert not wrong


def test_every_line_of_the_readme_calls_a_program_of_ours() -> None:
    blocks = [
        block["text"] for block in FENCE.finditer(README) if not block["language"]
    ]
    lines = sum(bool(line.strip()) for text in blocks for line in text.splitlines())
    assert len(commands(README)) == lines + len(CELL.findall(README))


def smaller(command: Command) -> list[str]:
    """The words of a line, small enough for a test."""
    options = SMALL.get(command.verb, ())
    names = {option.partition("=")[0] for option in options}
    return [*(w for w in command.words if w.partition("=")[0] not in names), *options]


class Walk:
    """A folder in which the lines are run, with what the README says one has before each."""

    def __init__(self, folder: Path, recordings: Path) -> None:
        self.folder, self.recordings = folder, recordings
        self.printed = ""
        self.given: dict[
            str, Callable[[], None]
        ] = {  # begin of a line → what is made before it
            "taccorl ingest recordings/": self.some_recordings,
            "taccorl init-robot my_arm.xml": self.model_of_an_arm,
            "taccorl compare sweeps/ --twin=my_robot.yaml": self.tables_of_an_arm,
            "taccorl align sweeps/ --twin=twin.yaml": self.sweeps_of_the_piper,
            "taccorl compare presses/": self.presses,
            "taccorl merge": self.two_domains,
        }

    def run(self, *words: str) -> None:
        bin_folder = Path(sys.executable).parent
        env = os.environ | {
            "PATH": f"{bin_folder}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
        }
        done = subprocess.run(
            words, cwd=self.folder, env=env, capture_output=True, text=True, check=False
        )
        self.printed += done.stdout
        print(f"$ {shlex.join(words)}\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
        assert done.returncode == 0, f"{shlex.join(words)} ended with {done.returncode}"
        assert "Traceback" not in done.stderr

    def two_domains(self) -> None:
        shutil.copytree("outputs/my_dataset", "recorded")
        self.run(
            "taccorl",
            "augment",
            "--source=sources",
            "--task=assembly_2",
            "--episodes=1",
            "--out=many",
        )

    def some_recordings(self) -> None:
        shutil.copytree(self.recordings, "recordings")
        shutil.copy(next(Path("recordings").glob("*.mcap")), "recording.mcap")

    def model_of_an_arm(self) -> None:
        Path("my_arm.xml").write_text(ARM)

    def tables_of_an_arm(self) -> None:
        """The TODOs of the arm's file, filled in, and simulated recordings with dry friction
        that it lacks."""
        path = Path("my_robot.yaml")
        text = path.read_text().replace(
            "gravity_compensation: TODO", "gravity_compensation: 0.0"
        )
        path.write_text(text.replace("gains: TODO", "gains: commanded"))
        assert "TODO" not in re.sub(r"#.*", "", path.read_text())
        ground = ground_of(load_machine(path), "elbow", speed=1.5)
        case = draw_slide(ground, SEED, ["coulomb_friction"])
        write_folder(Path("sweeps"), recordings(case), ("elbow",))

    def sweeps_of_the_piper(self) -> None:
        shutil.rmtree("sweeps")
        Path("robot/sweeps").rename("sweeps")  # of the surrogate in README.md
        shutil.copy("robot/twin.yaml", "twin.yaml")

    def presses(self) -> None:
        words = ("--pads=left", "--effects=[taxel_saturation]", "--out=pads")
        self.run("taccorl", "surrogate", "--secret=4", *words)
        Path("pads/presses").rename("presses")
        shutil.copy("pads/twin.yaml", "twin.yaml")


ARM = """
<mujoco><compiler angle="radian"/><worldbody>
<body name="lower"><joint name="elbow" axis="0 0 1" range="-2 2"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/></body></worldbody>
<actuator><position name="servo" joint="elbow" kp="60" kv="4" forcerange="-30 30"/></actuator></mujoco>
"""


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_every_line_works_from_top_to_bottom(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    walk, made = Walk(tmp_path, recordings), []
    typed = {
        tuple(smaller(c)): c for c in commands(README) + sections() if c.is_run
    }  # each line once
    for command in typed.values():
        for line, make in walk.given.items():
            if shlex.join(command.words).startswith(line) and line not in made:
                make()
                made.append(line)
        walk.run(*smaller(command))
    assert set(made) == set(walk.given), "the pages no longer need what is made here"
    shown = "\n".join(
        block["text"] for block in FENCE.finditer(README) if block["language"] == "text"
    )
    for line in (line.rstrip(" …,") for line in shown.splitlines()):
        assert masked(line).strip() in masked(walk.printed), line
    assert {"both", "many", "my_robot+coulomb_friction.yaml"} <= {
        p.name for p in tmp_path.iterdir()
    }
