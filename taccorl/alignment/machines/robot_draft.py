"""Draft a robot file from an MJCF or URDF file, and a columns file for a LeRobot dataset: facts of the model, and ``TODO`` for
facts that only the user knows, such as units, which a dataset does not state."""

import os
import re
from pathlib import Path

import numpy as np

from taccorl.alignment.controller.drive_law import GAIN_UNITS
from taccorl.alignment.machines.robot_file import TODO
from taccorl.alignment.machines.robot_model import (
    JointFacts,
    RobotModel,
    load_robot_model,
)
from taccorl.alignment.measurements.dataset_rows import TIME, dataset_columns
from taccorl.data.dataset import Dataset
from taccorl.data.finding import listed
from taccorl.data.spec import ACTION, STATE
from taccorl.errors import TaccorlError

_LAWS = {
    "impedance": "kp (q* − q) − kd q̇ + torque_ff. Columns NAME.q, NAME.q_target, NAME.tau; a PD on a torque interface, too",
    "cascade": "kd (kp (q* − q) − q̇) + torque_ff. Columns as for impedance; kp in 1/s",
    "velocity": "kd (q̇* − q̇) + torque_ff. Column NAME.qd_target; no kp",
    "torque": "τ* + torque_ff. Column NAME.tau_target (a current times k_t: `factor:` in a columns file); no kp, no kd",
    "effort": "the measured torque, for logs without targets. Columns NAME.q and NAME.tau; no kp, kd, gains, effort_limit",
    "pwm": "k_t (V d − k_e q̇) / R, duty d = kp (q* − q) − kd q̇ within ± 1: supply_v, resistance_ohm, torque_nm_per_a",
}
_MEANING = {
    "kp": "position gain of the drive; a guess where nobody knows it",
    "kd": "damping gain",
    "supply_v": "supply of the motor; the model states none",
}
_WINDING_UNITS = {"supply_v": "V", "resistance_ohm": "Ω", "torque_nm_per_a": "N·m/A"}
_HEADER = """\
# A robot, drafted from {model}. Write a value for each TODO; loading the file names those that are left.
# taccorl compare sweeps/ --twin={name}      how far this model is from recordings, and where
# taccorl diagnose sweeps/ --twin={name}     which physical effect it lacks
"""


def robot_draft(model: Path, out: Path) -> tuple[str, RobotModel]:
    """YAML text of a draft robot file for the path ``out``, and the model that it names. ``model``: MJCF or URDF file. ``out``:
    path of the robot file, which is not written here; the text names the model relative to it. Raises TaccorlError: the model
    cannot be used (``load_robot_model``)."""
    robot = load_robot_model(model)
    relative = Path(
        os.path.relpath(Path(model).resolve(), Path(out).resolve().parent)
    ).as_posix()
    lines = [_HEADER.format(model=Path(model).name, name=Path(out).name).rstrip()]
    lines += [f"# Of the model: {remark}." for remark in robot.remarks]
    lines += [
        "kind: robot",
        f"model: {relative}",
        f"gravity_compensation: {TODO}      # 1.0 if the controller adds the arm's weight to its torque, 0.0 if it does not",
        "# law: what the drive does with its target, and so the numbers that it needs (k_t and k_e at the joint, gear included):",
        *(f"#   {law + ':':<11}{words}" for law, words in _LAWS.items()),
        "joints:                        # remove those that no recording moves; they are held where the model has them",
    ]
    for facts in robot.joints.values():
        lines += _joint(facts)
    return "\n".join(lines) + "\n", robot


def _joint(facts: JointFacts) -> list[str]:
    turn, torque = ("rad", "N·m") if facts.unit == "rad" else ("m", "N")
    inertia = "kg·m²" if facts.unit == "rad" else "kg"
    per_gear = (
        "turns of the motor for one of the joint"
        if facts.unit == "rad"
        else "rad of the motor for one m"
    )
    limits = (
        "no limits"
        if facts.limits is None
        else f"{facts.limits[0]:.4g} … {facts.limits[1]:.4g} {turn}"
    )
    drive = facts.drive
    lines = [
        f"  {facts.name}:   # {limits}; inertia {facts.inertia:.3g} {inertia} at the model's zero pose",
        f"    law: {drive.law:<9}             # or another one of those above",
    ]
    units = {"kp": f"{torque}/{turn}", "kd": f"{torque}·s/{turn}"}
    if drive.law == "pwm":
        units = dict(zip(units, GAIN_UNITS["pwm"], strict=True)) | _WINDING_UNITS
    if drive.law == "velocity":
        del units["kp"]
    source = f", of actuator {listed(drive.actuators)}; is it what the drive runs?"
    for key, unit in units.items():
        if key in drive.numbers:
            lines += [f"    {key}: {drive.numbers[key]:.6g}   # {unit}{source}"]
            source = ""
        else:
            lines += [f"    {key}: {TODO}                   # {unit}: {_MEANING[key]}"]
    if drive.law != "pwm":
        lines += [
            f"    gains: {TODO}                # commanded: the drive runs kp and kd; fitted: nobody knows them"
        ]
    if "torque_ff" in drive.numbers:
        lines += [
            f"    torque_ff: {drive.numbers['torque_ff']:.6g}   # {torque}: constant of the actuators"
        ]
    if facts.armature > 0:
        lines += [
            f"    rotor_inertia: {facts.armature:.6g}   # {inertia}: the model's armature, already at the joint, so gear is 1"
        ]
    else:
        lines += [
            "    # Of a geared drive: gear² × rotor_inertia adds to the joint's inertia, often more than the links have.",
            "    # rotor_inertia: 1.0e-5    # kg·m² of the motor; without it no effect in the gear is looked for",
            f"    # gear: 100.0              # {per_gear}",
        ]
    if "effort_limit" in drive.numbers:
        lines += [
            f"    effort_limit: {drive.numbers['effort_limit']:.6g}   # {torque}; torques beyond are clipped"
        ]
    else:
        lines += [f"    # effort_limit: 10.0       # {torque}; the model names none"]
    lines += [
        "    # loop_hz: 1000.0          # of the drive's control loop, where it is known",
        "    # command_hz: 1000.0       # where the drive receives targets faster than they are logged",
        "    # effort_after_target: true   # where the effort of a row is the answer to the target of the same row",
        "    # known: [armature]        # numbers and effects that you know for certain: no diagnosis moves or adds them",
    ]
    if facts.effects:
        lines += ["    effects:   # friction, springs and drive as in the model"]
    for effect in facts.effects:
        numbers = [
            f"{p.name}: {getattr(effect, p.name):.6g}"
            for p in effect.parameters()
            if getattr(effect, p.name) != p.absent
        ]
        lines += [f"    - {{effect: {effect.name}, {', '.join(numbers)}}}"]
    return lines


_HEADER_OF_COLUMNS = """\
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
    rows = dataset.values(
        0, [key for key in (STATE, ACTION) if key in dataset.spec.features]
    )
    lines, spare = (
        [_HEADER_OF_COLUMNS.format(dataset=dataset.root.name, time=TIME).rstrip()],
        [],
    )
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
    lines = [
        f"  {facts.name}:   # {np.nanmin(numbers):.4g} … {np.nanmax(numbers):.4g} in episode 0"
    ]
    if facts.limits is not None:
        low, high = facts.limits
        lines[0] += f"; the model allows {low:.4g} … {high:.4g} {facts.unit}"
        for first, last in ((-100.0, 100.0), (0.0, 100.0)):
            factor = (high - low) / (last - first)
            numbers_of = (
                f"factor: {factor:.6g}, zero: {round(first - low / factor, 4) + 0.0:g}"
            )
            lines.append(
                f"    # of a range {first:g} … {last:g}: unit: {facts.unit}, {numbers_of}"
            )
    name = element if re.fullmatch(r"[A-Za-z0-9_.]+", element) else None
    for key, feature in (("q:       ", STATE), ("q_target:", ACTION)):
        column = f"{feature}.{element}" if name else f'"{feature}.{element}"'
        lines.append(f"    {key} {{column: {column}, unit: {TODO}}}")
    return lines
