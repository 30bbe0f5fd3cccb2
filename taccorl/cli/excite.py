"""``taccorl excite --twin=twin.yaml --joint=left_joint5 --effects=backlash,joint_compliance``: choose the motion to record next.
``taccorl excite elbow --twin=my_robot.yaml --measurements=sweeps``: the same for a joint of a robot file, or an axis.
``taccorl excite --twin=twin.yaml --pads=left --effects=touch_lag,touch_delay``: choose the press to record next.
``taccorl excite --twin=taxel.yaml --measurements=presses``: the same for a sensor of cells.

The score of a motion or press is the difference, in noise floors, that remains between the rival effects after each is refitted,
together with the recordings that exist already (--measurements). Motions beyond the joint's limits or the motor's torque are
refused, and so are presses beyond the gripper's range, its fingers' speed or the pads' travel. Where none separates two of the
rivals, they are tried with the motor's effort recorded, too. Where nothing separates any of the rivals, nothing is written.
Otherwise it writes a recording plan: plan.yaml, and for each motion or press a table of targets, which a driver can send, at
200 Hz or, for a robot or axis file, at the rate of its recordings; for presses also their entries of measurements.yaml; for a
sensor of cells the load of each cell. Other joints stand where the recordings have them. Collisions are not checked.
"""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from taccorl.cli.parse import parse, refuse
from taccorl.errors import TaccorlError, nearest
from taccorl.lineage.destinations import check_writable, is_free
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurement, Measurements
    from taccorl.diagnosis.experiment_design.plan import Part
    from taccorl.diagnosis.machines.cells import CellsMachine
    from taccorl.diagnosis.machines.machine import Machine
    from taccorl.sim.twin import TwinConfig

FLOOR_RAD = 2e-4
"""Noise floor of an angle where nothing states one [rad]. A choice."""
OF_JOINTS, OF_TOUCH = "backlash,joint_compliance", "touch_lag,touch_delay"
"""Examples of rival effects in messages: of joints, and of pads and cells."""
NO_POSE = (
    "--pose: motions are planned in the pose of the recordings; record one in the other "
    "pose, and give it as --measurements="
)


@dataclass(kw_only=True)
class ExciteConfig:
    """Choose the motion or press to record next, so that rival effects can be separated."""

    joint: str | None = None
    """The joint to move, such as left_joint5; may be left out for an axis."""
    pads: str | None = None
    """The pads to press, instead of a joint: left or right, those of this arm."""
    effects: list[str] = field(default_factory=list)
    """Rival effects, two or more; those of the diagnosis in --diagnosis if not given."""
    twin: Path | None = None
    """A twin.yaml of the PiPER, or the file of a robot, an axis or a sensor of cells; the PiPER's nominal twin if not given."""
    measurements: Path | None = None
    """Recordings that exist already. A sensor of cells needs them: they state its noise, gain and rate."""
    diagnosis: Path = Path("diagnosis")
    """Folder of a diagnosis, for its fitted values, and for its rival effects if --effects is not given."""
    gains: Literal["auto", "commanded", "fitted"] = "auto"
    """Gains of a joint. ``fitted``: they are unknown and are fitted with each effect, which makes effects harder to separate."""
    floor_rad: float | None = None
    """Noise floor of a joint's angle, of a slide [m], if there are no recordings to estimate it from; 2e-4 rad if not given. For
    pads without recordings it is the twin's own noise."""
    span: list[float] = field(default_factory=list)
    """Lowest and highest position of a joint of a robot file, or of an axis [rad, m]. If not given: the range of the recordings,
    or else the limits in its file. Of a sensor of cells: 0 and the highest load, in the unit of its file."""
    speed: float | None = None
    """Highest speed of targets of a robot or axis file [rad/s, m/s], or of the load of a sensor of cells, in the unit of its file
    per second; that of the recordings if not given."""
    num: int = 3
    """Number of motions or presses to write, best first."""
    out: Path = Path("recording_plan")
    """Folder of the plan; it must not exist."""


def main(argv: list[str]) -> int:
    """Run ``taccorl excite`` with the words ``argv`` after it; returns the exit status, 0: a plan was written, 1: no recording
    separates any of the effects, whichever of them is true."""
    if any(word.partition("=")[0] == "--pose" for word in argv):
        raise TaccorlError(NO_POSE)
    config = parse(ExciteConfig, argv, positional="joint")
    if config.num < 1:
        raise TaccorlError(f"--num={config.num}: at least 1")
    if config.floor_rad is not None and not 0 < config.floor_rad < math.inf:
        raise TaccorlError(f"--floor_rad={config.floor_rad:g}: a number above 0")
    if config.twin is None:
        _part_of_piper(config)  # wrong words are refused before anything is loaded
    from taccorl.diagnosis.experiment_design.presses import PadsPart
    from taccorl.diagnosis.machines.cells import CellsMachine
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.diagnosis.machines.piper import PiperTwin

    machine = load_machine(config.twin)
    name = (
        _part_of_piper(config)
        if isinstance(machine, PiperTwin)
        else _part(config, machine)
    )
    rivals, diagnosis = _rivals(config, machine, name)
    if not is_free(config.out):
        raise TaccorlError(
            f"{config.out}: already exists; give another --out, or remove it"
        )
    check_writable(config.out)
    recorded = (
        None if config.measurements is None else machine.read(config.measurements)
    )
    if isinstance(machine, CellsMachine):
        made = _cells(config, machine, recorded)
    elif not isinstance(machine, PiperTwin):
        made = _joint(config, machine, name, recorded)
    elif config.pads:
        made = PadsPart(machine.config, config.pads, recorded)
    else:
        made = _arm_joint(config, machine.config, name, recorded)
    return _search(config, made, rivals, diagnosis)


def _search(
    config: ExciteConfig,
    part: "Part",
    rivals: Sequence[str],
    diagnosis: Mapping[str, Any],
) -> int:
    from taccorl.cli.plan_words import words
    from taccorl.cli.progress import Bars
    from taccorl.diagnosis.experiment_design.plan import plan
    from taccorl.report.planned import planned, write_plan
    from taccorl.report.terminal import show

    rows = [e for r in diagnosis.get("rounds", [])[:1] for e in r["evidence"]]
    with Bars(1, "scoring") as bars:
        found = plan(
            part,
            rivals,
            {e["name"]: e["base"] | e["values"] for e in rows},
            bars.update,
        )
    show(planned(found, part, words))
    if found.separates_nothing:
        show(
            Section(
                text=[
                    f"wrote nothing: no recording that was tried separates {', '.join(found.rivals)}"
                ]
            )
        )
        return 1
    show(Section(text=[write_plan(config.out, found, part, words, config.num)]))
    return 0


def _part_of_piper(config: ExciteConfig) -> str:
    """``left_joint5`` or ``left pads``."""
    from taccorl.alignment.measurements.motions import joint_number
    from taccorl.robots import ROBOT

    why = "applies to robot and axis files only (the limits of the PiPER are known); remove it"
    refuse(config, ("span", "speed"), why)
    if config.joint is not None and config.pads is not None:
        raise TaccorlError(
            f"--joint={config.joint} and --pads={config.pads}: give one of them"
        )
    if config.joint is not None:
        joint_number(config.joint)
        return config.joint
    if config.pads is None:
        raise TaccorlError(
            "missing --joint=left_joint5, or --pads=left for the pads of that arm"
        )
    if config.pads not in ROBOT.arms:
        raise TaccorlError(
            f"--pads={config.pads}: no such arm; {nearest(config.pads, ROBOT.arms)}"
        )
    refuse(
        config,
        ("gains", "floor_rad"),
        f"applies to joints only; remove it with --pads={config.pads}",
    )
    return f"{config.pads} pads"


def _part(config: ExciteConfig, machine: "Machine") -> str:
    """Name of the joint, axis or sensor of a file."""
    from taccorl.diagnosis.machines.cells import CellsMachine

    names = [*machine.units]
    if config.pads:
        raise TaccorlError(
            f"--pads={config.pads}: {machine.name} has no pads; remove --pads"
        )
    if isinstance(machine, CellsMachine):
        for name in ("joint", "gains", "floor_rad"):
            refuse(
                config,
                (name,),
                f": {machine.name} is a sensor of cells and has no joints; remove --{name}",
            )
        return machine.config.name
    if not names:
        machine.drive("")  # says why
    if config.joint is None and len(names) > 1:
        raise TaccorlError(
            f"missing the {machine.part_word} to move: {', '.join(names)}"
        )
    if config.joint is not None and config.joint not in names:
        raise TaccorlError(
            f"{machine.name}: no {machine.part_word} {config.joint!r}; it has {', '.join(names)}"
        )
    return config.joint or names[0]


def _rivals(
    config: ExciteConfig, machine: "Machine", part: str
) -> tuple[list[str], dict[str, Any]]:
    """Effects to tell apart, and the diagnosis of the part in --diagnosis, empty if there is none. Raises TaccorlError: none
    are given, an effect is unknown, or it is in the machine's file."""
    import json

    from taccorl.diagnosis.experiment_design.plan import check_rivals, in_file
    from taccorl.report.report import numbers_of
    from taccorl.sim.effects import effects

    path, found = numbers_of(config.diagnosis), {}
    if path.is_file():
        found = (
            json.loads(path.read_text(encoding="utf-8"))
            .get("diagnoses", {})
            .get(part, {})
        )
    names = config.effects or [
        n for name, others in found.get("rivals", {}).items() for n in (name, *others)
    ]
    names = names or [n for c in found.get("changed", ()) for n in c.get("instead", ())]
    if not config.effects and len(names) < 2:
        example = OF_TOUCH if config.pads or not machine.of_joints else OF_JOINTS
        raise TaccorlError(
            f"no effects to separate: {path} names no rival effects of {part}; give --effects={example}"
        )
    for name in names:
        effects.get(name)
    there = next((name for name in in_file(machine, part) if name in names), None)
    try:
        check_rivals(machine, part, names)
    except TaccorlError as error:
        raise TaccorlError(
            str(error) + (_ways_out(config, machine, part, there) if there else "")
        ) from error
    return names, found


def _ways_out(config: ExciteConfig, machine: "Machine", part: str, name: str) -> str:
    """The commands that refit an effect of the file, and take it out of it."""
    from taccorl.sim.effects import effects

    source = config.twin or Path(machine.file_name)
    bare = source.with_name(f"{source.stem}_without_{name}.yaml")
    where = machine.option_of(part) or [f"--joints={part}"] * machine.of_joints
    absent = {
        p.name: p.absent for p in effects.get(name).parameters() if p.absent is not None
    }
    given = f"--values={{{', '.join(f'{key}: {str(float(x)).replace("inf", ".inf")}' for key, x in absent.items())}}}"
    refit = [
        "taccorl",
        "diagnose",
        str(config.measurements or "YOUR_RECORDINGS"),
        f"--twin={source}",
    ]
    remove = [
        "taccorl",
        "add-effect",
        name,
        f"--twin={source}",
        *where,
        given,
        f"--out={bare}",
    ]
    return (
        f". `{shlex.join(refit)}` refits it. To ask for another effect in its place, `{shlex.join(remove)}` takes it out, and "
        f"--twin={bare} plans without it"
    )


def _arm_joint(
    config: ExciteConfig,
    twin: "TwinConfig",
    joint: str,
    measurements: "Measurements | None",
) -> "Part":
    """A joint of the PiPER."""
    from taccorl.diagnosis.comparison.replays import BENCH_REST
    from taccorl.diagnosis.experiment_design.motions import (
        JointPart,
        arm_ground,
        rest_pose,
    )

    swept = (
        [m.on_robot(BENCH_REST) for m in measurements.all if joint in m.signals]
        if measurements
        else None
    )
    if measurements is not None and not swept:
        raise TaccorlError(f"{config.measurements}: no recording has {joint}")
    floor_rad = _floor(config, joint, "rad", swept)
    ground = arm_ground(twin, joint, rest_pose(joint, measurements))
    return JointPart(ground, floor_rad, measurements, gains=config.gains)


def _joint(
    config: ExciteConfig, machine: "Machine", part: str, recorded: "Measurements | None"
) -> "Part":
    """A joint of a robot file, or an axis."""
    from taccorl.diagnosis.experiment_design.motions import JointPart, ground_of

    ground = ground_of(machine, part, recorded, span=config.span, speed=config.speed)
    floor = _floor(config, part, machine.drive(part).unit, recorded and recorded.all)
    return JointPart(ground, floor, recorded, gains=config.gains)


def _floor(
    config: ExciteConfig,
    part: str,
    unit: str,
    recordings: "Sequence[Measurement] | None",
) -> float:
    """Noise floor of a position [rad, m]: that of recordings, else as given."""
    if recordings is not None:
        from taccorl.alignment.measurements.noise_floor import noise_floor

        return noise_floor(recordings)[part].value
    if config.floor_rad is None and unit == "m":
        raise TaccorlError(
            f"--floor_rad: the noise of {part} is not known without recordings; give it in m"
        )
    return FLOOR_RAD if config.floor_rad is None else config.floor_rad


def _cells(
    config: ExciteConfig, machine: "CellsMachine", measurements: "Measurements | None"
) -> "Part":
    """A sensor of cells; loads have the names and units of its recordings."""
    from taccorl.diagnosis.experiment_design.loads import CellsPart, load_range

    if measurements is None:
        why = f"recordings of {machine.name} state its noise, gain and rate; record a press first"
        raise TaccorlError(f"missing --measurements=: {why}")
    allowed = load_range(
        machine.config, measurements, span=config.span, speed=config.speed
    )
    return CellsPart(machine.config, measurements, allowed)
