"""Draft a columns file for a LeRobot dataset and a robot file: ``TODO`` for units, which the dataset does not state."""

import re
from pathlib import Path

import numpy as np

from taccorl.alignment.machines.robot_file import TODO
from taccorl.alignment.machines.robot_model import JointFacts, RobotModel
from taccorl.alignment.measurements.dataset_rows import TIME, dataset_columns
from taccorl.data.dataset import Dataset
from taccorl.data.spec import ACTION, STATE
from taccorl.errors import TaccorlError

_HEADER = """\
# Columns of the LeRobot dataset {dataset}. Write the unit of each joint for TODO: deg, rad, mm, m …
# quantity [unit] = (number in the dataset − zero) · factor, where zero is the number at 0 of the model's joint.
# Numbers of a range (-100 … 100 or 0 … 100) become rad or m by `factor:` and `zero:`. Those beside each joint are right where the
# motor was calibrated over exactly the limits of the model.
time: {{column: {time}, unit: s}}
signals:
"""


def columns_draft(root: Path, robot: RobotModel) -> tuple[str, list[str]]:
    """YAML text of a draft columns file for the dataset at ``root``, and those elements of its state that are no joint of
    ``robot``. Raises TaccorlError: it is no dataset, or no element of its state and action has the name of a joint."""
    dataset = Dataset(root)
    known = dataset_columns(dataset)
    rows = dataset.values(0, [key for key in (STATE, ACTION) if key in dataset.spec.features])
    lines, spare = [_HEADER.format(dataset=dataset.root.name, time=TIME).rstrip()], []
    for column, (key, j) in known.items():
        if key != STATE:
            continue
        element = column.removeprefix(f"{STATE}.")
        facts = robot.joints.get(element.removesuffix(".pos"))
        if facts is None or f"{ACTION}.{element}" not in known:
            spare.append(element)
            continue
        lines += _signal(facts, element, rows[STATE][:, j])
    if len(lines) == 1:
        raise TaccorlError(
            f"{root}: {STATE} and {ACTION} have {', '.join(spare) or 'no elements'}; none is called like a joint of "
            f"{robot.path.name}: {', '.join(robot.joints)}. Rename the joints in the model"
        )
    return "\n".join(lines) + "\n", spare


def _signal(facts: JointFacts, element: str, numbers: np.ndarray) -> list[str]:
    lines = [f"  {facts.name}:   # {np.nanmin(numbers):.4g} … {np.nanmax(numbers):.4g} in episode 0"]
    if facts.limits is not None:
        low, high = facts.limits
        lines[0] += f"; the model allows {low:.4g} … {high:.4g} {facts.unit}"
        for first, last in ((-100.0, 100.0), (0.0, 100.0)):
            factor = (high - low) / (last - first)
            numbers_of = f"factor: {factor:.6g}, zero: {round(first - low / factor, 4) + 0.0:g}"
            lines.append(f"    # of a range {first:g} … {last:g}: unit: {facts.unit}, {numbers_of}")
    name = element if re.fullmatch(r"[A-Za-z0-9_.]+", element) else None
    for key, feature in (("q:       ", STATE), ("q_target:", ACTION)):
        column = f"{feature}.{element}" if name else f'"{feature}.{element}"'
        lines.append(f"    {key} {{column: {column}, unit: {TODO}}}")
    return lines
