"""Most lines of Python in each folder and file. Their sums only fall: what one folder needs more, others give back."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MOST_LINES = {
    "taccorl/alignment": 14_654,
    "taccorl/cli": 4_873,
    "taccorl/data": 8_739,
    "taccorl/diagnosis": 11_108,
    "taccorl/episodes": 4_043,
    "taccorl/evaluation": 1_911,
    "taccorl/lerobot_plugin": 343,
    "taccorl/lineage": 2_067,
    "taccorl/policies": 3_461,
    "taccorl/report": 2_569,
    "taccorl/rl": 2_472,
    "taccorl/robot_plugin": 2_679,
    "taccorl/robots": 338,
    "taccorl/sim": 9_266,
    "taccorl/surrogate": 3_255,
    "taccorl/tasks": 2_511,
    "taccorl/training": 1_557,
    "taccorl/views": 2_334,
    "tests": 55_548,
    "pipelines": 6_123,
}
MOST_LINES_OF_A_FILE = 500


def lines(folder: Path) -> int:
    return sum(len(path.read_text("utf-8").splitlines()) for path in folder.rglob("*.py"))


@pytest.mark.parametrize("folder", MOST_LINES)
def test_no_folder_grows(folder: str) -> None:
    assert lines(ROOT / folder) <= MOST_LINES[folder]


@pytest.mark.parametrize("folder", [folder for folder in MOST_LINES if folder != "tests"])
def test_no_file_is_too_long(folder: str) -> None:
    files = {path.name: len(path.read_text("utf-8").splitlines()) for path in (ROOT / folder).rglob("*.py")}
    assert {name for name, n in files.items() if n > MOST_LINES_OF_A_FILE} == set()


def test_every_folder_has_a_budget() -> None:
    packages = {path.parent for path in (ROOT / "taccorl").glob("*/*.py")}
    assert {path.relative_to(ROOT).as_posix() for path in packages} == set(MOST_LINES) - {"tests", "pipelines"}
