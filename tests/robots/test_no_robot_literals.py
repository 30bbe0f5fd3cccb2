"""Numbers and names of one robot stand in ``taccorl/robots`` and ``data_specs`` only; everything else asks ``ROBOT``."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import taccorl
from taccorl.robots import ROBOT

ROOT = Path(taccorl.__file__).parents[1]
FOLDERS = ("taccorl", "pipelines")
ROBOTS = "taccorl/robots/"
ALLOWED = {
    ("taccorl/surrogate/twin_recording.py", "7 *"),  # a stride through noise
    ("taccorl/diagnosis/comparison/along.py", "14"),  # bins
    ("taccorl/sim/part_poses.py", "* 6"),  # numbers of a rotation
    # data lies below robots: it takes arms from the prefixes of a data spec's names.
    ("taccorl/data/episode.py", "('left', 'right')"),
    ("taccorl/data/draft.py", "('left', 'right')"),
}
"""(File, literal) that mean something else, or that cannot ask ``ROBOT``."""

_NAMES = [
    set(names)
    for names in (
        ROBOT.arms,
        ROBOT.cameras,
        ROBOT.pads,
        ROBOT.joints,
        ROBOT.action_names,
    )
]
_SIZES = {ROBOT.num_actions, ROBOT.num_taxels, ROBOT.pad.num_taxels}
_ARRAYS = {
    "empty",
    "zeros",
    "ones",
    "full",
    "reshape",
    "range",
    "arange",
    "rand",
    "randn",
    "normal",
    "uniform",
    "eye",
}
_SIGNALS = re.compile(
    r"joints|actions?\b|state|targets?\b|commands?\b|proprioception|reported|measured"
)


def robot_literals(code: str) -> Iterator[tuple[int, str]]:
    """(Line, literal) of what looks like a number or a list of names of this robot."""
    nodes = [*ast.walk(ast.parse(code))]
    types = {id(n) for node in nodes if _is_literal_type(node) for n in ast.walk(node)}
    for node in nodes:
        if id(node) in types:
            continue
        match node:
            case ast.Tuple(elts=parts) | ast.List(elts=parts) | ast.Set(elts=parts):
                values = [_value(part) for part in parts]
                texts = {v for v in values if isinstance(v, str)}
                if (
                    len(texts) > 1
                    and len(texts) == len(values)
                    and any(texts <= names for names in _NAMES)
                ):
                    yield node.lineno, str(tuple(values))
                if (
                    values == ROBOT.gripper_indices
                    or tuple(values[-2:]) == ROBOT.pad.shape
                ):
                    yield node.lineno, str(tuple(values))
                yield from ((node.lineno, str(v)) for v in values if _is_size(v))
            case ast.BinOp(left=left, op=ast.Mult(), right=right):
                for one, other in ((left, right), (right, left)):
                    if _value(one) == ROBOT.num_per_arm and not isinstance(
                        other, ast.Constant | ast.List | ast.Tuple
                    ):
                        yield node.lineno, f"{ROBOT.num_per_arm} *"
                    if _value(one) in (
                        ROBOT.num_joints,
                        ROBOT.num_per_arm,
                    ) and isinstance(other, ast.List | ast.Tuple):
                        yield node.lineno, f"* {_value(one)}"
            case ast.Call(
                func=ast.Name(id=name) | ast.Attribute(attr=name), args=args
            ) if name in _ARRAYS:
                values = [_value(arg) for arg in args]
                if name == "range" and values in (
                    [ROBOT.num_joints],
                    [1, ROBOT.num_per_arm],
                ):
                    yield node.lineno, f"range({', '.join(map(str, values))})"
                some = _SIZES | (
                    {ROBOT.num_per_arm}
                    if name in ("empty", "zeros", "ones", "full", "reshape")
                    else set()
                )
                yield from (
                    (node.lineno, str(v))
                    for v in values
                    if type(v) is int and v in some
                )
            case ast.Assign(value=value) if _is_size(_value(value)):
                yield node.lineno, str(_value(value))
            case ast.Compare(left=left, comparators=others):
                yield from (
                    (node.lineno, str(_value(n)))
                    for n in (left, *others)
                    if _is_size(_value(n))
                )
            case ast.Subscript(value=value, slice=index) if _SIGNALS.search(
                ast.unparse(value)
            ):
                numbers = {_value(n) for n in ast.walk(index)}
                places = {*ROBOT.gripper_indices, ROBOT.num_per_arm} & {
                    n for n in numbers if type(n) is int
                }
                if places:
                    yield node.lineno, ast.unparse(node)


def _value(node: ast.AST) -> object:
    return node.value if isinstance(node, ast.Constant) else None


def _is_size(value: object) -> bool:
    return type(value) is int and value in _SIZES


def _is_literal_type(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and node.value.id == "Literal"
    )


def test_no_module_states_numbers_or_names_of_the_robot_itself() -> None:
    found, used = [], set()
    for path in sorted(
        path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")
    ):
        name = path.relative_to(ROOT).as_posix()
        if name.startswith(ROBOTS):
            continue
        for line, literal in robot_literals(path.read_text(encoding="utf-8")):
            if (name, literal) in ALLOWED:
                used.add((name, literal))
            else:
                found.append(f"{name}:{line}: {literal}")
    assert not found, "take them from taccorl.robots.ROBOT:\n" + "\n".join(found)
    assert used == ALLOWED, "no longer there: take them off ALLOWED"
