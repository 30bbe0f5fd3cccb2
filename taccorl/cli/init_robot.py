"""``taccorl init-robot my_arm.xml --out=my_robot.yaml``: a robot file for compare, diagnose and add-effect.

MODEL is an MJCF or URDF file of any kinematic tree; its meshes may be missing. The written file lists its joints with limits,
inertias, actuators, damping and friction from the model, and TODO for facts that no model states: gains of the drives, and
whether they compensate gravity. ``--dataset=DATASET`` also drafts a columns file for a LeRobot dataset, which states no units.
"""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import write_new


@dataclass(kw_only=True)
class InitRobotConfig:
    """Write a robot file from an MJCF or URDF file."""

    model: Path
    """MJCF or URDF file of the robot."""
    out: Path | None = None
    """File to write; beside the model, with _robot.yaml in its name, if not given. An existing file is not overwritten."""
    dataset: Path | None = None
    """LeRobot dataset of the robot: its columns file is drafted as columns.yaml beside --out."""
    servo: str = ""
    """so101, sts3215, mx64, mx106, xl320, xl330, erob80_50 or erob80_100: write the published numbers of this servo (law, supply,
    winding, inertia, friction) at every hinge, each with its source."""
    law: Literal["", "impedance", "cascade", "velocity", "torque", "effort", "pwm"] = ""
    """Control law of every drive; that of the model's actuators if not given."""
    gains: Literal["", "commanded", "fitted"] = ""
    """commanded: the drives run kp and kd. fitted: nobody knows them. TODO in the file if not given."""
    gravity_compensation: float | None = None
    """Share of the weight that the controller adds to its torque, 0 … 1. TODO in the file if not given; 0 of a servo."""


def main(argv: list[str]) -> int:
    """Run ``taccorl init-robot`` with the words ``argv`` after it; returns the exit status, 0: written."""
    config = parse(InitRobotConfig, argv, positional="model", prog="taccorl init-robot")
    out = config.out or config.model.with_name(f"{config.model.stem}_robot.yaml")
    beside = out.with_name("columns.yaml")
    for path in (out, beside) if config.dataset else (out,):
        if path.exists():
            raise TaccorlError(
                f"{path}: already exists; give another --out, or remove it"
            )
    from taccorl.alignment.machines.robot_draft import (
        StatedFacts,
        columns_draft,
        robot_draft,
        servo_of,
    )
    from taccorl.alignment.machines.robot_file import TODO

    share = config.gravity_compensation
    if share is not None and not 0.0 <= share <= 1.0:
        raise TaccorlError(
            f"--gravity_compensation={share:g}: give the share of the weight, 0 … 1"
        )
    stated = StatedFacts(
        law=config.law or None,
        gains=config.gains or None,
        gravity_compensation=share,
        servo=servo_of(config.servo) if config.servo else {},
    )
    text, robot = robot_draft(config.model, out, stated)
    if config.gains and f"    gains: {config.gains}" not in text:
        print(
            f"note: --gains={config.gains} is not written: no joint's law fits kp and kd; "
            "law pwm fits stall torque and back-EMF instead"
        )
    texts, spare = {out: text}, []
    if config.dataset is not None:
        texts[beside], spare = columns_draft(config.dataset, robot, stated.servo)
    for path, written in texts.items():
        try:
            write_new(path, written)
        except OSError as error:
            raise TaccorlError(
                f"{path}: cannot be written: {error.strerror or error}"
            ) from error
    for remark in robot.remarks:
        print(f"note: {remark}")
    print(f"wrote {out}: {len(robot.joints)} joints ({', '.join(robot.joints)})")
    _print_todo(text, TODO)
    name = next(iter(robot.joints))
    if config.dataset is not None:
        print(f"wrote {beside}: names and units of the columns of {config.dataset}")
        if spare:
            print(
                f"note: no joint of the model is called {', '.join(spare)}; not in {beside}"
            )
        _print_todo(texts[beside], TODO)
        options = shlex.join([f"--twin={out}", f"--columns={beside}"])
        print(f"next: taccorl compare {shlex.quote(str(config.dataset))} {options}")
        return 0
    print(
        f"record each joint: tables with columns t, {name}.q, {name}.q_target, and where you have them .qd and .tau"
    )
    print(f"next: taccorl compare YOUR_RECORDINGS {shlex.quote(f'--twin={out}')}")
    return 0


def _print_todo(text: str, todo: str) -> None:
    left = [
        number
        for number, line in enumerate(text.splitlines(), 1)
        if f": {todo}" in line
    ]
    if not left:
        return
    print(
        f"write {len(left)} values where it says {todo}: lines {', '.join(map(str, left))}"
    )
