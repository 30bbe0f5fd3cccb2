"""Most lines of Python in each folder. Numbers only fall: a change that needs more lines gives them back in the same folder."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MOST_LINES = {
    "taccorl/alignment": 15_300,
    "taccorl/cli": 5_850,
    "taccorl/data": 8_910,
    "taccorl/demos": 7_650,
    "taccorl/diagnosis": 13_450,
    "taccorl/evaluation": 1_900,
    "taccorl/lerobot_plugin": 350,
    "taccorl/lineage": 2_350,
    "taccorl/policies": 3_630,
    "taccorl/rl": 2_550,
    "taccorl/robots": 400,
    "taccorl/sim": 12_144,
    "taccorl/surrogate": 3_850,
    "taccorl/tasks": 1_500,
    "taccorl/training": 1_650,
    "taccorl/views": 3_200,
    "tests": 62_550,
    "pipelines": 6_150,
}


def lines(folder: Path) -> int:
    return sum(len(path.read_text("utf-8").splitlines()) for path in folder.rglob("*.py"))


@pytest.mark.parametrize("folder", MOST_LINES)
def test_no_folder_grows(folder: str) -> None:
    assert lines(ROOT / folder) <= MOST_LINES[folder]


def test_every_folder_has_a_budget() -> None:
    packages = {path.parent for path in (ROOT / "taccorl").glob("*/*.py")}
    assert {path.relative_to(ROOT).as_posix() for path in packages} == set(MOST_LINES) - {"tests", "pipelines"}
