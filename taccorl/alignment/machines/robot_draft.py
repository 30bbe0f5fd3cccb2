"""Draft a robot file from an MJCF or URDF file, and a columns file for a LeRobot dataset: facts of the model, and ``TODO`` for
facts that only the user knows, such as units, which a dataset does not state."""

import functools
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from taccorl.alignment.controller.drive_law import GAIN_UNITS, NEEDED, DriveLaw, Law
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
from taccorl.data.strict_yaml import load_yaml
from taccorl.errors import TaccorlError, nearest

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
_SERVO_EFFECTS = {
    "coulomb_friction": "torque_nm",
    "viscous_friction": "damping_nms_per_rad",
}
"""Effect of a servo of ``servos.yaml`` → the parameter that its number is."""
Servo = Mapping[str, tuple[Any, str]]
"""Key → (value, source) of the published numbers of a servo."""
_HEADER = """\
# A robot, drafted from {model}. Write a value for each TODO; loading the file names those that are left.
# taccorl compare sweeps/ --twin={name}      how far this model is from recordings, and where
# taccorl diagnose sweeps/ --twin={name}     which physical effect it lacks
"""
_OF_SERVO = """\
# Of the servo: numbers of Better Actuator Models (M. Duclusaud, G. Passault), github.com/Rhoban/bam, Apache-2.0. m1: fitted to
# swings of a pendulum (bam/params/SERVO/m1.json); code: bam/*/actuator.py. LeRobot: robots/so_follower of 0.6.1."""


@functools.cache
def servos() -> dict[str, Servo]:
    """Name → published numbers of each servo of ``servos.yaml``, with their sources."""
    content = load_yaml(Path(__file__).with_name("servos.yaml"))
    return {
        name: {key: (value, source) for key, (value, source) in numbers.items()}
        for name, numbers in content.items()
    }


def servo_of(name: str) -> Servo:
    """Published numbers of a servo. Raises TaccorlError: there is none of this name."""
    if name not in servos():
        raise TaccorlError(f"--servo={name}: not known; {nearest(name, servos())}")
    return servos()[name]


@dataclass(frozen=True, kw_only=True)
class StatedFacts:
    """Facts that the user states for all joints of a draft, beside those of the model."""

    law: Law | None = None  # Control law of the drives; None: that of the actuators
    gains: Literal["commanded", "fitted"] | None = None  # None: TODO
    gravity_compensation: float | None = None
    """Share of the weight that the controller compensates, 0 … 1; None: TODO."""
    servo: Servo = field(default_factory=dict)
    """Published numbers of the servo at every hinge; empty: of no servo."""

    def law_of(self, facts: JointFacts) -> Law:
        """Law of a joint. Raises TaccorlError: the servo has another law than ``law``."""
        own = self.servo_of(facts).get("law", (self.law, ""))[0]
        if self.law not in (None, own):
            raise TaccorlError(
                f"--law={self.law}: the servo has law {own}; leave --law or --servo out"
            )
        return own or facts.drive.law

    def servo_of(self, facts: JointFacts) -> Servo:
        """Numbers of the servo, which are of a turn; none for a slide."""
        return self.servo if facts.unit == "rad" else {}


def robot_draft(
    model: Path, out: Path, stated: StatedFacts | None = None
) -> tuple[str, RobotModel]:
    """YAML text of a draft robot file for the path ``out``, and the model that it names. ``model``: MJCF or URDF file. ``out``:
    path of the robot file, which is not written here; the text names the model relative to it. ``stated``: facts that the user
    states. Raises TaccorlError: the model cannot be used (``load_robot_model``), or two stated facts exclude each other."""
    stated = stated or StatedFacts()
    robot = load_robot_model(model)
    relative = Path(
        os.path.relpath(Path(model).resolve(), Path(out).resolve().parent)
    ).as_posix()
    share: float | str | None = stated.gravity_compensation
    if share is None:
        share = 0.0 if stated.servo else TODO
    lines = [_HEADER.format(model=Path(model).name, name=Path(out).name).rstrip()]
    lines += [f"# Of the model: {remark}." for remark in robot.remarks]
    if stated.servo:
        lines += [_OF_SERVO]
    lines += [
        "kind: robot",
        f"model: {relative}",
        f"gravity_compensation: {share}      # 1.0 if the controller adds the arm's weight to its torque, 0.0 if it does not",
        "# law: what the drive does with its target, and so the numbers that it needs (k_t and k_e at the joint, gear included):",
        *(f"#   {law + ':':<11}{words}" for law, words in _LAWS.items()),
        "joints:                        # remove those that no recording moves; they are held where the model has them",
    ]
    for facts in robot.joints.values():
        lines += _joint(facts, stated)
    return "\n".join(lines) + "\n", robot


def _joint(facts: JointFacts, stated: StatedFacts) -> list[str]:
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
    drive, law, servo = facts.drive, stated.law_of(facts), stated.servo_of(facts)
    if servo:
        source = servo["law"][1]
    else:
        source = "as stated" if stated.law else "or another one of those above"
    lines = [
        f"  {facts.name}:   # {limits}; inertia {facts.inertia:.3g} {inertia} at the model's zero pose",
        f"    law: {law:<9}             # {source}",
    ]
    units = _units(law, torque, turn, is_chosen=stated.law is not None)
    lines += _numbers(facts, units, servo)
    has_gains = law != "pwm" and (NEEDED[law] or stated.law is None)
    if has_gains:
        lines += [
            f"    gains: {stated.gains or TODO}                # commanded: the drive runs kp and kd; fitted: nobody knows them"
        ]
    if "torque_ff" in drive.numbers:
        lines += [
            f"    torque_ff: {drive.numbers['torque_ff']:.6g}   # {torque}: constant of the actuators"
        ]
    if "rotor_inertia" in servo:
        number, source = servo["rotor_inertia"]
        beside = f"; the model has {facts.armature:.4g}" if facts.armature > 0 else ""
        lines += [
            f"    rotor_inertia: {number}   # {inertia}, at the joint, so gear is 1: {source}{beside}"
        ]
    elif facts.armature > 0:
        lines += [
            f"    rotor_inertia: {facts.armature:.6g}   # {inertia}: the model's armature, already at the joint, so gear is 1"
        ]
    else:
        lines += [
            "    # Of a geared drive: gear² × rotor_inertia adds to the joint's inertia, often more than the links have.",
            "    # rotor_inertia: 1.0e-5    # an example. kg·m² of the motor; without it no effect in the gear is looked for",
            f"    # gear: 100.0              # an example. {per_gear}",
        ]
    most = drive.numbers.get("effort_limit")
    if "effort_limit" in servo:
        number, source = servo["effort_limit"]
        beside = "" if most is None else f"; the model has {most:.6g}"
        lines += [f"    effort_limit: {number}   # {torque}: {source}{beside}"]
    elif most is not None and law != "effort":
        lines += [
            f"    effort_limit: {most:.6g}   # {torque}; torques beyond are clipped"
        ]
    elif law != "effort":
        lines += [
            f"    # effort_limit: 10.0       # an example. {torque}; the model names none"
        ]
    lines += [
        "    # loop_hz: 1000.0          # an example. Of the drive's control loop, where it is known",
        "    # command_hz: 1000.0       # an example. Where the drive receives targets faster than they are logged",
        "    # effort_after_target: true   # where the effort of a row is the answer to the target of the same row",
        "    # known: [armature]        # an example. What you know for certain: no diagnosis moves or adds it",
    ]
    return lines + _effects(facts, law, servo)


def _units(law: Law, torque: str, turn: str, *, is_chosen: bool) -> dict[str, str]:
    """Number of a drive that the draft states → its unit. Before a law is chosen, laws
    without gains have TODO for them, too."""
    gains = {"kp": f"{torque}/{turn}", "kd": f"{torque}·s/{turn}"}
    if law in GAIN_UNITS:
        gains = dict(zip(gains, GAIN_UNITS[law], strict=True))
    if law == "pwm":
        return gains | _WINDING_UNITS
    if law == "velocity" or is_chosen:
        return {key: unit for key, unit in gains.items() if key in NEEDED[law]}
    return gains


def _numbers(facts: JointFacts, units: Mapping[str, str], servo: Servo) -> list[str]:
    """Lines of the numbers of the drive: those of the servo, else those of actuators whose
    law gives them the same unit, else TODO."""
    torque, turn = ("N·m", "rad") if facts.unit == "rad" else ("N", "m")
    theirs = _units(facts.drive.law, torque, turn, is_chosen=False)
    source = (
        f", of actuator {listed(facts.drive.actuators)}; is it what the drive runs?"
    )
    lines = []
    for key, unit in units.items():
        factor = servo.get(f"{key}_factor")
        unit = "steps of the servo's own gain" if factor else unit
        if key in servo:
            value, words = servo[key]
            lines += [f"    {key}: {value}   # {unit}: {words}"]
        elif not servo and key in facts.drive.numbers and theirs.get(key) == unit:
            lines += [f"    {key}: {facts.drive.numbers[key]:.6g}   # {unit}{source}"]
            source = ""
        elif key == "kd" and servo and "kd" not in NEEDED[servo["law"][0]]:
            lines += ["    # kd: 1.0   # an example. s/rad; nobody published it"]
        else:
            what = _MEANING.get(key, "no model states it")
            lines += [f"    {key}: {TODO}                   # {unit}: {what}"]
        if factor:
            lines += [f"    {key}_factor: {factor[0]}   # {factor[1]}"]
    return lines


def _effects(facts: JointFacts, law: Law, servo: Servo) -> list[str]:
    """Lines of the effects of a joint: the servo's friction in place of the model's."""
    lines = []
    for effect in facts.effects:
        numbers = ", ".join(
            f"{p.name}: {getattr(effect, p.name):.6g}"
            for p in effect.parameters()
            if getattr(effect, p.name) != p.absent
        )
        entry = f"    - {{effect: {effect.name}, {numbers}}}"
        if effect.name in servo:
            lines += [
                f"    # of the model, in place of which the servo's stands: {entry[6:]}"
            ]
        elif not DriveLaw(law=law).allows_effect(effect.name):
            lines += [f"    # of the model, but law {law} cannot have it: {entry[6:]}"]
        else:
            lines += [entry]
    for name, parameter in _SERVO_EFFECTS.items():
        if name in servo:
            number, source = servo[name]
            lines += [f"    - {{effect: {name}, {parameter}: {number}}}   # {source}"]
    if any(line.startswith("    - ") for line in lines):
        lines.insert(0, "    effects:   # friction, springs and drive as in the model")
    return lines


_HEADER_OF_COLUMNS = """\
# Columns of the LeRobot dataset {dataset}. Write the unit of each joint for TODO: deg, rad, mm, m …
# quantity [unit] = (number in the dataset − zero) · factor, where zero is the number at 0 of the model's joint.
# Numbers of a range (-100 … 100 or 0 … 100) become rad or m by `factor:` and `zero:`. Those beside each joint are right where the
# motor was calibrated over exactly the limits of the model.
time: {{column: {time}, unit: s}}
signals:
"""


def columns_draft(
    root: Path, robot: RobotModel, servo: Servo | None = None
) -> tuple[str, list[str]]:
    """YAML text of a draft columns file for the dataset at ``root``, and those elements of
    its state that are no joint of ``robot``. ``servo``: published numbers, which may state
    how LeRobot records the joints. Raises TaccorlError: it is no dataset, or no element of
    its state and action has the name of a joint."""
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
        lines += _signal(facts, element, rows[STATE][:, j], servo or {})
    if len(lines) == 1:
        raise TaccorlError(
            f"{root}: {STATE} and {ACTION} have {', '.join(spare) or 'no elements'}; none is called like a joint of "
            f"{robot.path.name}: {', '.join(robot.joints)}. Rename the joints in the model"
        )
    return "\n".join(lines) + "\n", spare


def _signal(
    facts: JointFacts, element: str, numbers: np.ndarray, servo: Servo
) -> list[str]:
    unit, source = servo.get("recorded", (TODO, ""))
    is_share = bool(source) and facts.name == "gripper" and facts.limits is not None
    lines = [
        f"  {facts.name}:   # {np.nanmin(numbers):.4g} … {np.nanmax(numbers):.4g} in episode 0"
    ]
    if facts.limits is not None:
        low, high = facts.limits
        lines[0] += f"; the model allows {low:.4g} … {high:.4g} {facts.unit}"
        for first, last in ((-100.0, 100.0), (0.0, 100.0)):
            factor = (high - low) / (last - first)
            zero = round(first - low / factor, 4) + 0.0
            numbers_of = f"unit: {facts.unit}, factor: {factor:.6g}, zero: {zero:g}"
            lines.append(f"    # of a range {first:g} … {last:g}: {numbers_of}")
            unit = numbers_of.removeprefix("unit: ") if is_share else unit
    name = element if re.fullmatch(r"[A-Za-z0-9_.]+", element) else None
    guess = f"   # a guess: {source}" if source else ""
    for key, feature in (("q:       ", STATE), ("q_target:", ACTION)):
        column = f"{feature}.{element}" if name else f'"{feature}.{element}"'
        lines.append(f"    {key} {{column: {column}, unit: {unit}}}{guess}")
    return lines
