"""Concepts a reader must know: statements, classes and named constants of each folder.

Lines are not counted: whoever budgets lines gets wide lines. What one folder needs
more, others give back.
"""

import ast
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]


class Concepts(NamedTuple):
    statements: int
    classes: int
    constants: int


MOST = {
    "taccorl/alignment": Concepts(11699, 117, 482),
    "taccorl/cli": Concepts(3801, 41, 44),
    "taccorl/data": Concepts(7579, 84, 256),
    "taccorl/diagnosis": Concepts(6896, 78, 192),
    "taccorl/episodes": Concepts(2722, 65, 53),
    "taccorl/evaluation": Concepts(1227, 18, 25),
    "taccorl/lerobot_plugin": Concepts(255, 2, 11),
    "taccorl/lineage": Concepts(1394, 20, 29),
    "taccorl/policies": Concepts(2280, 45, 78),
    "taccorl/report": Concepts(2141, 19, 50),
    "taccorl/rl": Concepts(1843, 35, 31),
    "taccorl/robot_plugin": Concepts(2719, 45, 61),
    "taccorl/robots": Concepts(158, 5, 12),
    "taccorl/sim": Concepts(6185, 158, 146),
    "taccorl/surrogate": Concepts(2098, 26, 125),
    "taccorl/tasks": Concepts(1629, 18, 135),
    "taccorl/training": Concepts(1045, 15, 13),
    "taccorl/views": Concepts(1535, 8, 73),
    "tests": Concepts(42790, 138, 1207),
    "pipelines": Concepts(5172, 26, 239),
}
MOST_LINES_OF_A_FILE = 850  # at 88 columns


def is_constant(name: str) -> bool:
    return name.strip("_").isupper()


def concepts(folder: Path) -> Concepts:
    """Statements and classes at any depth, constants of modules: names in capitals."""
    counts = Counter[str]()
    for path in folder.rglob("*.py"):
        module = ast.parse(path.read_text("utf-8"))
        for node in ast.walk(module):
            counts["statements"] += isinstance(node, ast.stmt)
            counts["classes"] += isinstance(node, ast.ClassDef)
        for node in module.body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            if isinstance(node, ast.AnnAssign):
                targets = [node.target]
            names = [n for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
            counts["constants"] += sum(is_constant(name.id) for name in names)
    return Concepts(counts["statements"], counts["classes"], counts["constants"])


@pytest.mark.parametrize("folder", MOST)
def test_no_folder_gains_concepts(folder: str) -> None:
    counted = concepts(ROOT / folder)
    assert counted.statements <= MOST[folder].statements
    assert counted.classes <= MOST[folder].classes
    assert counted.constants <= MOST[folder].constants


def test_statements_classes_and_constants_are_counted(tmp_path: Path) -> None:
    text = "LIMIT = 1\n_LOW, _HIGH = 2, 3\nname = 4\nclass A:\n    B = 5\n"
    (tmp_path / "module.py").write_text(text)
    # LIMIT, _LOW … _HIGH, name, class, B are 5 statements; B belongs to the class.
    assert concepts(tmp_path) == Concepts(statements=5, classes=1, constants=3)


@pytest.mark.parametrize("folder", [name for name in MOST if name != "tests"])
def test_no_file_is_too_long(folder: str) -> None:
    long = {}
    for path in (ROOT / folder).rglob("*.py"):
        lines = len(path.read_text("utf-8").splitlines())
        if lines > MOST_LINES_OF_A_FILE:
            long[path.name] = lines
    assert long == {}


def test_every_folder_has_a_budget() -> None:
    packages = {path.parent for path in (ROOT / "taccorl").glob("*/*.py")}
    named = {path.relative_to(ROOT).as_posix() for path in packages}
    assert named == set(MOST) - {"tests", "pipelines"}
