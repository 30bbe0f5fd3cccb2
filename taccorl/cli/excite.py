"""``taccorl excite --twin=twin.yaml --joint=left_joint5 --effects=backlash,joint_compliance``: choose the motion to record next.
``taccorl excite elbow --twin=my_robot.yaml --measurements=sweeps``: the same for a joint of a robot file, or an axis.
``taccorl excite --twin=twin.yaml --pads=left --effects=touch_lag,touch_delay``: choose the press to record next.
``taccorl excite --twin=taxel.yaml --measurements=presses``: the same for a sensor of cells.

The score of a motion or press is the difference, in noise floors, that remains between the rival effects after each is refitted,
together with the recordings that exist already (--measurements). Motions beyond the joint's limits or the motor's torque are
refused, and so are presses beyond the gripper's range, its fingers' speed or the pads' travel. Where none separates any of the
rivals, nothing is written. Otherwise it writes a recording plan:
plan.yaml, and for each motion or press a table of targets, which a driver can send, at 200 Hz or, for a robot or axis file, at
the rate of its recordings; for presses also their entries of measurements.yaml; for a sensor of cells the load of each cell.
Collisions are checked only where other joints of a robot file move to another pose (--pose=), between shapes of its model.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import check_writable, is_free
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.diagnosis.experiment_design.excitation import Plan, PlannedMotion
    from taccorl.diagnosis.experiment_design.loads import PlannedLoad
    from taccorl.diagnosis.experiment_design.machine_motions import Ground
    from taccorl.diagnosis.experiment_design.presses import PlannedPress
    from taccorl.diagnosis.machines.cells import CellsMachine
    from taccorl.diagnosis.machines.machine import Machine
    from taccorl.report.planned import Entry
    from taccorl.sim.twin import TwinConfig

    Made = tuple[Plan, Section, Iterator[str]]

WAY = "0_to_the_pose.csv"
"""Table of the way to another pose, in the plan's folder."""
FLOOR_RAD = 2e-4
"""Noise floor of an angle where nothing states one [rad]. A choice."""
OF_JOINTS, OF_TOUCH = "backlash,joint_compliance", "touch_lag,touch_delay"
"""Examples of rival effects in messages: of joints, and of pads and cells."""


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
    pose: dict[str, float] = field(default_factory=dict)
    """Positions of other joints of the arm or robot during the motion [rad, m], such as {shoulder: 0.8}. If not given: those of
    the recordings, or, of a joint at which the diagnosis found an effect in one pose only, another pose that is chosen."""
    num: int = 3
    """Number of motions or presses to write, best first."""
    out: Path = Path("recording_plan")
    """Folder of the plan; it must not exist."""


def main(argv: list[str]) -> int:
    """Run ``taccorl excite`` with the words ``argv`` after it; returns the exit status, 0: a motion or press separates the
    effects, 1: none does."""
    config = parse(ExciteConfig, argv, positional="joint")
    if config.num < 1:
        raise TaccorlError(f"--num={config.num}: at least 1")
    if config.floor_rad is not None and not 0 < config.floor_rad < math.inf:
        raise TaccorlError(f"--floor_rad={config.floor_rad:g}: a number above 0")
    if not is_free(config.out):
        raise TaccorlError(f"{config.out}: already exists; give another --out, or remove it")
    check_writable(config.out)
    from taccorl.diagnosis.machines.cells import CellsMachine
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.diagnosis.machines.piper import PiperTwin
    from taccorl.report.terminal import show

    if config.twin is None:
        _part(config)  # wrong words are refused before anything is loaded
    machine = load_machine(config.twin)
    if isinstance(machine, PiperTwin):
        _refuse(config, ("span", "speed"), "applies to robot and axis files only (the limits of the PiPER are known)")
        found, section, write = (_presses if config.pads else _motions)(config, machine.config)
    elif config.pads:
        raise TaccorlError(f"--pads={config.pads}: {machine.name} has no pads; remove --pads")
    else:
        found, section, write = (
            _loads(config, machine) if isinstance(machine, CellsMachine) else _machine(config, machine)
        )
    show(section)
    none = f"wrote nothing: no recording that was tried separates {', '.join(found.rivals)}"
    show(Section(text=[none] if found.separates_nothing else [*write]))
    return int(bool(found.hopeless))


def _refuse(config: ExciteConfig, names: Sequence[str], why: str, end: str = "remove it") -> None:
    """
    Raises:
        TaccorlError: one of these options is given.
    """
    for name in names:
        if getattr(config, name) != getattr(ExciteConfig(), name):
            raise TaccorlError(f"--{name} {why}; {end}".replace(" :", ":"))


def _motions(config: ExciteConfig, twin: "TwinConfig") -> "Made":
    """Of a joint of the PiPER."""
    from taccorl.alignment.measurements.folder import read_measurements
    from taccorl.alignment.measurements.motions import LIBRARY, RATE_HZ
    from taccorl.alignment.measurements.noise_floor import noise_floor
    from taccorl.diagnosis.comparison.replays import BENCH_REST
    from taccorl.diagnosis.experiment_design.excitation import plan, posed, rest_pose
    from taccorl.report.planned import write_plan

    joint = _part(config)
    rivals, fitted = _rivals(config, joint)
    measurements = None if config.measurements is None else read_measurements(config.measurements)
    floor_rad = FLOOR_RAD if config.floor_rad is None else config.floor_rad
    if measurements is not None:
        swept = [m for m in measurements.all if joint in m.signals]
        if not swept:
            raise TaccorlError(f"{config.measurements}: no recording has {joint}")
        floor_rad = noise_floor([m.on_robot(BENCH_REST) for m in swept])[joint].value
    with _counted(len(LIBRARY)) as done:
        found = plan(
            twin,
            joint,
            rivals,
            pose=posed(joint, rest_pose(joint, measurements), config.pose),
            floor_rad=floor_rad,
            measurements=measurements,
            gains=config.gains,
            fitted=fitted,
            done=done,
        )

    def entry(p: "PlannedMotion", apart: dict[str, float]) -> "Entry":
        facts = {
            "gains": f"{p.motion.gain:g} times the usual",
            "payload_kg": p.motion.payload_kg,
            "seconds": round(len(p.target) / RATE_HZ, 1),
            "range_rad": [round(float(p.target.min()), 4), round(float(p.target.max()), 4)],
            "peak_torque_nm": round(p.peak_torque_nm, 3),
            "floors_apart": apart,
        }
        return p.motion.name, {f"{found.part}.q_target": p.target}, facts

    write = write_plan(
        *(config.out, found, config.num, entry, RATE_HZ, ("joint", "motions")),
        units="t in s, q_target in rad",
        pose=found.pose,
        how="begin and end at rest; hold the other joints where `pose` says (rad, gripper m); record one motion twice; "
        "payload_kg is held at the TCP, peak_torque_nm includes the carried weight",
    )
    return found, _of_motions(found), write


def _of_motions(found: "Plan[PlannedMotion]", unit: str = "rad") -> Section:
    from taccorl.report.planned import planned

    effort, small, factor = ("N", "µm", 1e6) if unit == "m" else ("N·m", "mrad", 1e3)
    rows = []
    for p in found.planned:
        payload = f"{p.motion.payload_kg:g} kg" if p.motion.payload_kg else ""
        rows.append((p.motion.name, f"× {p.motion.gain:g}", payload, f"{p.peak_torque_nm:.3g} {effort}"))
    heads = ("motion", "gains", "payload", f"peak {'force' if unit == 'm' else 'torque'} with weight")
    same = "from angles they are the same thing, pick either, or record efforts"
    return planned(found, f"{found.floor * factor:.3g} {small}", heads, rows, same)


def _machine(config: ExciteConfig, machine: "Machine") -> "Made":
    """Of a joint of a robot file, or of an axis."""
    from taccorl.diagnosis.experiment_design.machine_motions import EFFORT_SHARE, MOTIONS, ground_of, plan_machine
    from taccorl.diagnosis.experiment_design.other_pose import chosen_pose, stated_pose
    from taccorl.report.terminal import show

    names = [*machine.units]
    if config.joint is None and len(names) > 1:
        raise TaccorlError(f"missing the {machine.part_word} to move: {', '.join(names)}")
    if not names:
        machine.drive("")  # says why
    part = config.joint or names[0]
    rivals, fitted = _rivals(config, part)
    measurements = None if config.measurements is None else machine.read(config.measurements)
    ground = ground_of(machine, part, measurements, span=config.span, speed=config.speed)
    others = [*next(iter((_diagnosed(config, part).get("one_pose") or {}).values()), [])]
    if config.pose:
        pose = stated_pose(machine, part, ground.like, ground.span, config.pose)
        ground = dataclasses.replace(ground, pose=pose)
    elif others and measurements is not None:
        stood = f"{part}: found while {', '.join(others)} stood in one pose; the motions are planned in another one (--pose=)"
        show(Section(text=[stood]))
        ground = dataclasses.replace(ground, pose=chosen_pose(machine, part, ground.like, ground.span, others))
    drive, room = machine.drive(part), ground.room
    with _counted(len(MOTIONS)) as done:
        found = plan_machine(
            ground,
            rivals,
            measurements=measurements,
            floor=_floor(config, part, drive.unit, measurements),
            fitted=fitted,
            gains=config.gains,
            done=done,
        )
    limit = "" if drive.effort_limit is None else f", {EFFORT_SHARE:.0%} of effort_limit {drive.effort_limit:g}"
    low, high = room.middle_rad - room.wide_rad, room.middle_rad + room.wide_rad
    held = (
        f"Motions stay within {low:.4g} … {high:.4g} {drive.unit} (--span=), {room.speed_rad_per_s:.3g} {drive.unit}/s "
        f"(--speed=){limit}; allow more if the machine may, or the effect stays undecided"
    )
    short = [
        f"{name}: no motion reaches the suspected limit, the nearest goes to {far:.0%} of it. {held}"
        for name, far in found.reaches.items()
        if far < 1.0
    ]
    section = _of_motions(found, drive.unit)
    return (
        found,
        dataclasses.replace(section, parts=[*section.parts, Section(text=short)]),
        _write(found, config, ground),
    )


def _floor(config: ExciteConfig, part: str, unit: str, measurements: "Measurements | None") -> float:
    """Noise floor of a position [rad, m]: that of recordings, else as given."""
    if measurements is not None:
        from taccorl.alignment.measurements.noise_floor import noise_floor

        return noise_floor(measurements.all)[part].value
    if config.floor_rad is None and unit == "m":
        raise TaccorlError(f"--floor_rad: the noise of {part} is not known without recordings; give it in m")
    return FLOOR_RAD if config.floor_rad is None else config.floor_rad


def _write(found: "Plan[PlannedMotion]", config: ExciteConfig, ground: "Ground") -> Iterator[str]:
    """Tables and plan of motions of a joint of a robot file, or of an axis."""
    import numpy as np

    from taccorl.report.planned import write_plan, write_table

    drive, pose = ground.machine.drive(found.part), ground.pose
    is_speed = drive.target_kind == "velocity"
    column, unit = f"{found.part}.{'qd_target' if is_speed else 'q_target'}", drive.unit + "/s" * is_speed
    held, where = {}, {}
    if pose is not None and pose.driven and found.planned:
        config.out.mkdir(parents=True, exist_ok=True)
        held = {f"{name}.q_target": pose.positions[name] for name in pose.driven}
        way = {f"{name}.q_target": path for name, path in pose.way(ground.rate_hz).items()}
        write_table(config.out / WAY, way, ground.rate_hz)
        where = {"pose": found.pose, "way_to_the_pose": WAY}
    checked = "Collisions are not checked: look where the motion goes. "
    if pose is not None:
        hidden = f"; {pose.unchecked} moving links have no shape in it and are not checked" * bool(pose.unchecked)
        checked = (
            f"On the way to the pose and during the motions no shapes of the model touch that did not touch before{hidden}. What "
            "stands around the robot is not checked: look where the motion goes. "
        )
    there = "there, too" if pose is None else "as `pose` says"
    stand = "Gains as in the file; other joints stand where the model's zero pose has them"

    def entry(p: "PlannedMotion", apart: dict[str, float]) -> "Entry":
        still = {key: np.full(len(p.target), position) for key, position in held.items()}
        own = {
            "seconds": round(len(p.target) / ground.rate_hz, 1),
            "range": [float(f"{x:.6g}") for x in (p.target.min(), p.target.max())],
            "peak_effort": float(f"{p.peak_torque_nm:.4g}"),
            "floors_apart": apart,
        }
        return p.motion.name, {column: p.target, **still}, own

    yield from write_plan(
        *(config.out, found, config.num, entry, ground.rate_hz, ("part", "motions")),
        units=f"t in s, {column} and range in {unit}, peak_effort in {'N' if drive.unit == 'm' else 'N·m'}",
        **where,
        how=f"{checked}Begin and end at rest; record one motion twice. "
        + (f"Masses and gains as in {ground.like.name}, other joints {there}" if ground.like else stand),
    )


def _presses(config: ExciteConfig, twin: "TwinConfig") -> "Made":
    """Of the pads of one arm."""
    from taccorl.alignment.measurements.folder import read_measurements
    from taccorl.alignment.measurements.motions import RATE_HZ
    from taccorl.diagnosis.experiment_design.presses import LIBRARY, plan_presses
    from taccorl.diagnosis.problems.touch_problem import FRAMES_A_ROW
    from taccorl.report.planned import planned, write_plan

    part, arm = _part(config), str(config.pads)
    rivals, fitted = _rivals(config, part, OF_TOUCH)
    measurements = None if config.measurements is None else read_measurements(config.measurements)
    with _counted(len(LIBRARY)) as done:
        found = plan_presses(twin, arm, rivals, measurements=measurements, fitted=fitted, done=done)
    rows = []
    for p in found.planned:
        size = f"{p.press.shape} of {1e3 * p.press.pressed('left').radius_m:g} mm"
        rows.append((p.press.name, size, f"{1e3 * p.press.penetration_m().max():.2f} mm", f"{p.peak_force_n:.0f} N"))
    floor = f"{found.floor:.2g} counts, a taxel's mean over {FRAMES_A_ROW} frames"
    same = "from what pads read in a known object they are the same thing, pick either"
    section = planned(found, floor, ("press", "radius", "depth", "peak force"), rows, same)

    def entry(p: "PlannedPress", apart: dict[str, float]) -> "Entry":
        note = dataclasses.asdict(p.press.pressed(arm))
        own = {
            "seconds": round(len(p.target_m) / RATE_HZ, 1),
            "depth_m": round(float(p.press.penetration_m().max()), 6),
            "range_m": [round(float(p.target_m.min()), 6), round(float(p.target_m.max()), 6)],
            "peak_force_n": round(p.peak_force_n, 1),
            "floors_apart": apart,
            "pressed": {k: list(v) if isinstance(v, tuple) else v for k, v in note.items() if v is not None},
        }
        return p.press.name, {f"{arm}_gripper.q_target": p.target_m, f"{arm}_gripper.opening": p.opening_m}, own

    write = write_plan(
        *(config.out, found, config.num, entry, RATE_HZ, ("pads", "presses")),
        units="t in s, q_target and opening in m",
        how="hold the object where `pressed` says, in the hand's own frame, and the arm still; record pads and measured "
        "opening, one press twice; put `pressed` under the recording's name in measurements.yaml",
        targets="q_target is what to command a gripper that yields as the twin's does, opening is where its fingers shall "
        "then be; a gripper that goes where it is told is sent the opening",
    )
    return found, section, write


def _loads(config: ExciteConfig, machine: "CellsMachine") -> "Made":
    """Of a sensor of cells; loads have the names and units of its recordings."""
    from taccorl.alignment.machines.cells_file import LOADS
    from taccorl.diagnosis.experiment_design.loads import LIBRARY, load_range, plan_loads
    from taccorl.report.planned import planned, write_plan

    sensor, gone = machine.config, ("joint", "gains", "floor_rad", "pose")
    for name in gone:
        _refuse(config, (name,), f": {machine.name} is a sensor of cells and has no joints", f"remove --{name}")
    if config.measurements is None:
        why = f"recordings of {machine.name} state its noise, gain and rate; record a press first"
        raise TaccorlError(f"missing --measurements=: {why}")
    rivals, fitted = _rivals(config, sensor.name, OF_TOUCH)
    measurements = machine.read(config.measurements)
    allowed = load_range(sensor, measurements, span=config.span, speed=config.speed)
    with _counted(len(LIBRARY)) as done:
        found = plan_loads(sensor, rivals, measurements, allowed, fitted=fitted, done=done)
    unit = sensor.load.unit
    rows = [(p.profile.name, f"{float(p.load.max()):.3g} {unit}", f"{p.duration_s:.0f} s") for p in found.planned]
    same = "from readings under these loads they are the same thing, pick either"
    floor = f"{found.floor:.3g} {sensor.reading.unit}, the median cell"
    section = planned(found, floor, ("press", "highest load", "lasts"), rows, same)
    if (at := found.planned[0].place_mm) is not None:
        place = f"all presses at x {at[0]:.4g} mm, y {at[1]:.4g} mm, a place of the recordings"
        section = dataclasses.replace(section, parts=[*section.parts, Section(text=[place])])
    (column, factor), rate_hz = LOADS[unit], found.planned[0].rate_hz

    def entry(p: "PlannedLoad", apart: dict[str, float]) -> "Entry":
        loads = {column: p.load[:, 0]} if sensor.load.shared else {}
        if not sensor.load.shared:
            loads = {f"{cell}.{column}": p.load[:, k] for k, cell in enumerate(sensor.names)}
        columns = {key: factor * load for key, load in loads.items()}
        if p.place_mm is not None:
            columns |= {key: 0.0 * p.load[:, 0] + mm for key, mm in zip(("x_mm", "y_mm"), p.place_mm, strict=True)}
        own = {
            "seconds": round(p.duration_s, 1),
            "highest_load": float(f"{p.load.max():.4g}"),
            "floors_apart": apart,
        }
        return p.profile.name, columns, own

    write = write_plan(
        *(config.out, found, config.num, entry, rate_hz, ("sensor", "presses")),
        rate_hz=float(f"{rate_hz:.6g}"),
        units=f"t in s, {column}, highest_load in {unit}",
        how="apply the load over time as well as your press can, record the load that acts and the readings, one press twice; "
        "the recording need not follow the table exactly",
    )
    return found, section, write


def _part(config: ExciteConfig) -> str:
    """``left_joint5`` or ``left pads``."""
    from taccorl.alignment.measurements.motions import joint_number
    from taccorl.errors import nearest
    from taccorl.robots import ROBOT

    if config.joint is not None and config.pads is not None:
        raise TaccorlError(f"--joint={config.joint} and --pads={config.pads}: give one of them")
    if config.joint is not None:
        joint_number(config.joint)
        return config.joint
    if config.pads is None:
        raise TaccorlError("missing --joint=left_joint5, or --pads=left for the pads of that arm")
    if config.pads not in ROBOT.arms:
        raise TaccorlError(f"--pads={config.pads}: no such arm; {nearest(config.pads, ROBOT.arms)}")
    _refuse(config, ("gains", "floor_rad", "pose"), "applies to joints only", f"remove it with --pads={config.pads}")
    return f"{config.pads} pads"


@contextmanager
def _counted(num: int) -> Iterator[Callable[[str], None]]:
    """A bar over ``num`` motions or presses, to be told each one's name when it has been scored."""
    from taccorl.cli.progress import Bars

    with Bars(num, "scoring") as bars:
        count = itertools.count(1)
        yield lambda name: bars.update(name, next(count), num)


def _diagnosed(config: ExciteConfig, part: str) -> dict[str, Any]:
    """The diagnosis of a part in the report in --diagnosis; empty if there is none."""
    import json

    from taccorl.report.report import NUMBERS

    path = config.diagnosis / NUMBERS
    if not path.is_file():
        return {}
    return json.loads(path.read_text(encoding="utf-8")).get("diagnoses", {}).get(part, {})


def _rivals(config: ExciteConfig, part: str, example: str = OF_JOINTS) -> tuple[list[str], dict[str, dict[str, float]]]:
    """Effects to tell apart, and the numbers that a diagnosis fitted with each; ``example`` stands in the message where none are
    given."""
    from taccorl.report.report import NUMBERS
    from taccorl.sim.effects import effects

    path, d = config.diagnosis / NUMBERS, _diagnosed(config, part)
    rows = [e for r in d.get("rounds", [])[:1] for e in r["evidence"]]
    fitted = {e["name"]: e["base"] | e["values"] for e in rows}
    names = config.effects
    if not names:
        names = [n for name, others in d.get("rivals", {}).items() for n in (name, *others)]
        if len(names) < 2:
            text = f"no effects to separate: {path} names no rival effects of {part}; give --effects={example}"
            raise TaccorlError(text)
    names = [part for name in names for part in name.split(",")]
    for name in names:
        effects.get(name)
    return names, fitted
