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

import csv
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

if TYPE_CHECKING:
    import numpy as np

    from taccorl.alignment.machines.cells_file import CellsConfig
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.diagnosis.experiment_design.excitation import Plan, PlannedMotion
    from taccorl.diagnosis.experiment_design.loads import PlannedLoad
    from taccorl.diagnosis.experiment_design.machine_motions import Ground
    from taccorl.diagnosis.experiment_design.other_pose import OtherPose
    from taccorl.diagnosis.experiment_design.presses import PlannedPress
    from taccorl.diagnosis.machines.cells import CellsMachine
    from taccorl.diagnosis.machines.machine import Machine
    from taccorl.sim.twin import TwinConfig

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
    from taccorl.alignment.measurements.folder import read_measurements
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.diagnosis.machines.piper import PiperTwin

    if config.twin is None:
        _part(config)  # wrong words are refused before anything is loaded
    machine = load_machine(config.twin)
    if not isinstance(machine, PiperTwin):
        return _of_machine(config, machine)
    for name in ("span", "speed"):
        if getattr(config, name) != getattr(ExciteConfig(), name):
            raise TaccorlError(
                f"--{name} applies to robot and axis files only (the limits of the PiPER are known); remove it"
            )
    part, twin = _part(config), machine.config
    rivals, fitted = _rivals(config, part, OF_TOUCH if config.pads else OF_JOINTS)
    measurements = None if config.measurements is None else read_measurements(config.measurements)
    if config.pads:
        pressed = _presses(config.pads, twin, rivals, fitted, measurements)
        _press_table(pressed)
        return _ended(pressed, lambda: _write_presses(pressed, config))
    found = _motions(config, part, twin, rivals, fitted, measurements)
    _table(found)
    return _ended(found, lambda: _write(found, config))


def _ended(found: "Plan", write: Callable[[], None]) -> int:
    """Write the plan if it separates any of the rivals; returns the exit status."""
    if found.separates_nothing:
        print(f"wrote nothing: no recording that was tried separates {', '.join(found.rivals)}")
    else:
        write()
    return int(bool(found.hopeless))


def _of_machine(config: ExciteConfig, machine: "Machine") -> int:
    """Plan a motion of a joint of a robot file, or of an axis."""
    from taccorl.diagnosis.experiment_design.machine_motions import MOTIONS, ground_of, plan_machine
    from taccorl.diagnosis.machines.cells import CellsMachine

    if config.pads:
        raise TaccorlError(f"--pads={config.pads}: {machine.name} has no pads; remove --pads")
    if isinstance(machine, CellsMachine):
        return _of_cells(config, machine)
    from taccorl.diagnosis.experiment_design.other_pose import chosen_pose, stated_pose

    names = [*machine.units]
    if config.joint is None and len(names) > 1:
        raise TaccorlError(f"missing the {machine.part_word} to move: {', '.join(names)}")
    if not names:
        machine.drive("")  # says why
    part = config.joint or names[0]
    rivals, fitted = _rivals(config, part)
    measurements = None if config.measurements is None else machine.read(config.measurements)
    ground = ground_of(machine, part, measurements, span=config.span, speed=config.speed)
    others = _in_one_pose(config, part)
    if config.pose:
        pose = stated_pose(machine, part, ground.like, ground.span, config.pose)
        ground = dataclasses.replace(ground, pose=pose)
    elif others and measurements is not None:
        print(
            f"{part}: found while {', '.join(others)} stood in one pose; the motions are planned in another one (--pose=)"
        )
        ground = dataclasses.replace(ground, pose=chosen_pose(machine, part, ground.like, ground.span, others))
    unit = machine.drive(part).unit
    with _counted(len(MOTIONS)) as done:
        found = plan_machine(
            ground,
            rivals,
            measurements=measurements,
            floor=_floor(config, part, unit, measurements),
            fitted=fitted,
            gains=config.gains,
            done=done,
        )
    _table(found, unit)
    for line in _short_of(found, config, ground):
        print(line)
    return _ended(found, lambda: _write_motions(found, config, ground))


def _short_of(found: "Plan[PlannedMotion]", config: ExciteConfig, ground: "Ground") -> list[str]:
    """Lines that name the suspected limits that no motion reaches, by how much, and what holds the motions back."""
    from taccorl.diagnosis.experiment_design.machine_motions import EFFORT_SHARE

    drive, room = ground.machine.drive(found.part), ground.room
    limit = "" if drive.effort_limit is None else f", {EFFORT_SHARE:.0%} of effort_limit {drive.effort_limit:g}"
    low, high = room.middle_rad - room.wide_rad, room.middle_rad + room.wide_rad
    held = (
        f"Motions stay within {low:.4g} … {high:.4g} {drive.unit} (--span=), {room.speed_rad_per_s:.3g} {drive.unit}/s "
        f"(--speed=){limit}; allow more if the machine may, or the effect stays undecided"
    )
    return [
        f"{name}: no motion reaches the suspected limit, the nearest goes to {far:.0%} of it. {held}"
        for name, far in found.reaches.items()
        if far < 1.0
    ]


def _of_cells(config: ExciteConfig, machine: "CellsMachine") -> int:
    """Plan a press of a sensor of cells."""
    from taccorl.diagnosis.experiment_design.loads import LIBRARY, load_range, plan_loads

    sensor = machine.config
    for name in ("joint", "gains", "floor_rad", "pose"):
        if getattr(config, name) != getattr(ExciteConfig(), name):
            raise TaccorlError(f"--{name}: {machine.name} is a sensor of cells and has no joints; remove --{name}")
    if config.measurements is None:
        raise TaccorlError(
            f"missing --measurements=: recordings of {machine.name} state its noise, gain and rate; record a press first"
        )
    rivals, fitted = _rivals(config, sensor.name, OF_TOUCH)
    measurements = machine.read(config.measurements)
    allowed = load_range(sensor, measurements, span=config.span, speed=config.speed)
    with _counted(len(LIBRARY)) as done:
        found = plan_loads(sensor, rivals, measurements, allowed, fitted=fitted, done=done)
    rows = [
        (p.profile.name, f"{float(p.load.max()):.3g} {sensor.load.unit}", f"{p.duration_s:.0f} s")
        for p in found.planned
    ]
    same = "from readings under these loads they are the same thing, pick either"
    floor = f"{found.floor:.3g} {sensor.reading.unit}, the median cell"
    _show(found, floor, ("press", "highest load", "lasts"), rows, same)
    if (at := found.planned[0].place_mm) is not None:
        print(f"all presses at x {at[0]:.4g} mm, y {at[1]:.4g} mm, a place of the recordings")
    return _ended(found, lambda: _write_loads(found, config, sensor))


def _floor(config: ExciteConfig, part: str, unit: str, measurements: "Measurements | None") -> float:
    """Noise floor of a position [rad, m]: that of recordings, else as given."""
    if measurements is not None:
        from taccorl.alignment.measurements.noise_floor import noise_floor

        return noise_floor(measurements.all)[part].value
    if config.floor_rad is None and unit == "m":
        raise TaccorlError(f"--floor_rad: the noise of {part} is not known without recordings; give it in m")
    return FLOOR_RAD if config.floor_rad is None else config.floor_rad


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
    for name in ("gains", "floor_rad", "pose"):
        if getattr(config, name) != getattr(ExciteConfig(), name):
            raise TaccorlError(f"--{name} applies to joints only; remove it with --pads={config.pads}")
    return f"{config.pads} pads"


def _motions(
    config: ExciteConfig,
    signal: str,
    twin: "TwinConfig",
    rivals: list[str],
    fitted: dict[str, dict[str, float]],
    measurements: "Measurements | None",
) -> "Plan[PlannedMotion]":
    from taccorl.alignment.measurements.motions import LIBRARY
    from taccorl.alignment.measurements.noise_floor import noise_floor
    from taccorl.diagnosis.comparison.replays import BENCH_REST
    from taccorl.diagnosis.experiment_design.excitation import plan, posed, rest_pose

    floor_rad = FLOOR_RAD if config.floor_rad is None else config.floor_rad
    if measurements is not None:
        swept = [m for m in measurements.all if signal in m.signals]
        if not swept:
            raise TaccorlError(f"{config.measurements}: no recording has {signal}")
        floor_rad = noise_floor([m.on_robot(BENCH_REST) for m in swept])[signal].value
    with _counted(len(LIBRARY)) as done:
        return plan(
            twin,
            signal,
            rivals,
            pose=posed(signal, rest_pose(signal, measurements), config.pose),
            floor_rad=floor_rad,
            measurements=measurements,
            gains=config.gains,
            fitted=fitted,
            done=done,
        )


def _presses(
    arm: str,
    twin: "TwinConfig",
    rivals: list[str],
    fitted: dict[str, dict[str, float]],
    measurements: "Measurements | None",
) -> "Plan[PlannedPress]":
    from taccorl.diagnosis.experiment_design.presses import LIBRARY, plan_presses

    with _counted(len(LIBRARY)) as done:
        return plan_presses(twin, arm, rivals, measurements=measurements, fitted=fitted, done=done)


@contextmanager
def _counted(num: int) -> Iterator[Callable[[str], None]]:
    """A bar over ``num`` motions or presses, to be told each one's name when it has been scored."""
    from taccorl.cli.tables import Bars

    with Bars(num, "scoring") as bars:
        count = itertools.count(1)
        yield lambda name: bars.update(name, next(count), num)


def _diagnosed(config: ExciteConfig, part: str) -> dict[str, Any]:
    """The diagnosis of a part in the report in --diagnosis; empty if there is none."""
    import json

    from taccorl.diagnosis.report.report import NUMBERS

    path = config.diagnosis / NUMBERS
    if not path.is_file():
        return {}
    return json.loads(path.read_text(encoding="utf-8")).get("diagnoses", {}).get(part, {})


def _in_one_pose(config: ExciteConfig, part: str) -> list[str]:
    """Other joints, if the diagnosis found an effect while all of them stood in one pose."""
    found = _diagnosed(config, part).get("one_pose") or {}
    return [*next(iter(found.values()), [])]


def _rivals(config: ExciteConfig, part: str, example: str = OF_JOINTS) -> tuple[list[str], dict[str, dict[str, float]]]:
    """Effects to tell apart, and the numbers that a diagnosis fitted with each; ``example`` stands in the message where none are
    given."""
    from taccorl.diagnosis.report.report import NUMBERS
    from taccorl.sim.effects import effects

    path, d = config.diagnosis / NUMBERS, _diagnosed(config, part)
    rows = [e for r in d.get("rounds", [])[:1] for e in r["evidence"]]
    fitted = {e["name"]: e["base"] | e["values"] for e in rows}
    names = config.effects
    if not names:
        names = [n for name, others in d.get("rivals", {}).items() for n in (name, *others)]
        if len(names) < 2:
            raise TaccorlError(
                f"no effects to separate: {path} names no rival effects of {part}; give --effects={example}"
            )
    names = [part for name in names for part in name.split(",")]
    for name in names:
        effects.get(name)
    return names, fitted


def _table(found: "Plan[PlannedMotion]", unit: str = "rad") -> None:
    effort, small, factor = ("N", "µm", 1e6) if unit == "m" else ("N·m", "mrad", 1e3)
    rows = [
        (
            p.motion.name,
            f"× {p.motion.gain:g}",
            f"{p.motion.payload_kg:g} kg" if p.motion.payload_kg else "",
            f"{p.peak_torque_nm:.3g} {effort}",
        )
        for p in found.planned
    ]
    floor = f"{found.floor * factor:.3g} {small}"
    same = "from angles they are the same thing, pick either, or record efforts"
    _show(
        found,
        floor,
        ("motion", "gains", "payload", f"peak {'force' if unit == 'm' else 'torque'} with weight"),
        rows,
        same,
    )


def _press_table(found: "Plan[PlannedPress]") -> None:
    from taccorl.diagnosis.problems.touch_problem import FRAMES_A_ROW

    rows = [
        (
            p.press.name,
            f"{p.press.shape} of {1e3 * p.press.pressed('left').radius_m:g} mm",
            f"{1e3 * p.press.penetration_m().max():.2f} mm",
            f"{p.peak_force_n:.0f} N",
        )
        for p in found.planned
    ]
    floor = f"{found.floor:.2g} counts, a taxel's mean over {FRAMES_A_ROW} frames"
    same = "from what pads read in a known object they are the same thing, pick either"
    _show(found, floor, ("press", "radius", "depth", "peak force"), rows, same)


def _show(found: "Plan", floor: str, heads: Sequence[str], rows: Sequence[Sequence[str]], same: str) -> None:
    """The table, best first, what was refused, and what nothing tells apart.

    Args:
        same: what it means if two rivals cannot be told apart by anything.
    """
    from rich.table import Table

    from taccorl.cli.tables import console
    from taccorl.diagnosis.experiment_design.excitation import SAME, TELLS

    pairs = list(found.planned[0].discrimination) if found.planned else []
    table = Table(box=None, pad_edge=False)
    for head in (*heads, *pairs):
        table.add_column(head, justify="left" if head == heads[0] else "right", overflow="fold")
    for p, row in zip(found.planned, rows, strict=True):
        table.add_row(*row, *(f"{p.discrimination[pair]:.2f} ×" for pair in pairs))
    out = console()
    out.print(f"{found.part}: noise floors ({floor}) that stay between rivals after a refit")
    out.print(table)
    if found.pose:
        stand = ", ".join(f"{name} {value:g}" for name, value in found.pose.items())
        out.print(f"meanwhile other joints stand at (rad, m): {stand}", soft_wrap=True, highlight=False)
    for name, why in found.refused.items():
        out.print(f"not {name}: {why}")
    for pair in found.hopeless:
        best = found.best(pair)
        one_way = _one_way(found, pair, rows)
        why = (
            same if best < SAME and not one_way else f"no single {heads[0]} tells them apart whichever of them is true"
        )
        out.print(f"{pair}: {best:.2f} floors at best, less than {TELLS:g}: {why}{one_way}")


def _one_way(found: "Plan", pair: str, rows: Sequence[Sequence[str]]) -> str:
    """What tells the two apart if one of them is true: where one effect contains the other (friction that depends on the
    direction contains friction that does not), only its own motions do."""
    from taccorl.diagnosis.experiment_design.excitation import TELLS

    words = ""
    for k, truth in enumerate(pair.split(" | ")):
        apart, name = max(
            ((p.ways[pair][k], row[0]) for p, row in zip(found.planned, rows, strict=True)), default=(0.0, "")
        )
        if apart >= TELLS:
            words += f"; if it is {truth}, {name} shows it ({apart:.2f} floors)"
    return words


def _write(found: "Plan[PlannedMotion]", config: ExciteConfig) -> None:
    from taccorl.alignment.measurements.motions import RATE_HZ

    config.out.mkdir(parents=True, exist_ok=True)
    entries = []
    for number, p in enumerate(found.planned[: config.num], 1):
        name = f"{number}_{p.motion.name}.csv"
        _write_table(config.out / name, {f"{found.part}.q_target": p.target}, RATE_HZ)
        entries.append(
            {
                "table": name,
                "gains": f"{p.motion.gain:g} times the usual",
                "payload_kg": p.motion.payload_kg,
                "seconds": round(len(p.target) / RATE_HZ, 1),
                "range_rad": [round(float(p.target.min()), 4), round(float(p.target.max()), 4)],
                "peak_torque_nm": round(p.peak_torque_nm, 3),
                "floors_apart": {pair: round(apart, 2) for pair, apart in p.discrimination.items()},
            }
        )
    words = {
        "joint": found.part,
        "tells_apart": list(found.rivals),
        "rate_hz": RATE_HZ,
        "units": "t in s, q_target in rad",
        "pose": found.pose,
        "how": "begin and end at rest; hold the other joints where `pose` says (rad, gripper m); record one motion twice; "
        "payload_kg is held at the TCP, peak_torque_nm includes the carried weight",
        "motions": entries,
    }
    _write_plan(config.out, words, len(entries))


def _write_motions(found: "Plan[PlannedMotion]", config: ExciteConfig, ground: "Ground") -> None:
    """Tables and plan of motions of a joint of a robot file, or of an axis."""
    import numpy as np

    drive = ground.machine.drive(found.part)
    column = f"{found.part}.{'qd_target' if drive.target_kind == 'velocity' else 'q_target'}"
    unit = drive.unit + ("/s" if drive.target_kind == "velocity" else "")
    pose, held, where = ground.pose, {}, {}
    config.out.mkdir(parents=True, exist_ok=True)
    if pose is not None and pose.driven and found.planned:
        held = {f"{name}.q_target": pose.positions[name] for name in pose.driven}
        way = pose.way(ground.rate_hz)
        _write_table(config.out / WAY, {f"{name}.q_target": path for name, path in way.items()}, ground.rate_hz)
        where = {"pose": found.pose, "way_to_the_pose": WAY}
    entries = []
    for number, p in enumerate(found.planned[: config.num], 1):
        name = f"{number}_{p.motion.name}.csv"
        still = {key: np.full(len(p.target), position) for key, position in held.items()}
        _write_table(config.out / name, {column: p.target, **still}, ground.rate_hz)
        entries.append(
            {
                "table": name,
                "seconds": round(len(p.target) / ground.rate_hz, 1),
                "range": [float(f"{x:.6g}") for x in (p.target.min(), p.target.max())],
                "peak_effort": float(f"{p.peak_torque_nm:.4g}"),
                "floors_apart": {pair: round(apart, 2) for pair, apart in p.discrimination.items()},
            }
        )
    words = {
        **({"reaches": {name: round(far, 3) for name, far in found.reaches.items()}} if found.reaches else {}),
        "part": found.part,
        "tells_apart": list(found.rivals),
        "rate_hz": ground.rate_hz,
        "units": f"t in s, {column} and range in {unit}, peak_effort in {'N' if drive.unit == 'm' else 'N·m'}",
        **where,
        "how": _checked(pose)
        + "Begin and end at rest; record one motion twice. "
        + (
            f"Masses and gains as in {ground.like.name}, other joints "
            + ("there, too" if pose is None else "as `pose` says")
            if ground.like
            else "Gains as in the file; other joints stand where the model's zero pose has them"
        ),
        "motions": entries,
    }
    _write_plan(config.out, words, len(entries))


def _checked(pose: "OtherPose | None") -> str:
    """Sentence on the collisions that were checked."""
    if pose is None:
        return "Collisions are not checked: look where the motion goes. "
    words = "On the way to the pose and during the motions no shapes of the model touch that did not touch before"
    unchecked = f"; {pose.unchecked} moving links have no shape in it and are not checked" * bool(pose.unchecked)
    return f"{words}{unchecked}. What stands around the robot is not checked: look where the motion goes. "


def _write_presses(found: "Plan[PlannedPress]", config: ExciteConfig) -> None:
    from taccorl.alignment.measurements.motions import RATE_HZ

    config.out.mkdir(parents=True, exist_ok=True)
    gripper = f"{config.pads}_gripper"
    entries = []
    for number, p in enumerate(found.planned[: config.num], 1):
        name = f"{number}_{p.press.name}.csv"
        _write_table(config.out / name, {f"{gripper}.q_target": p.target_m, f"{gripper}.opening": p.opening_m}, RATE_HZ)
        note = dataclasses.asdict(p.press.pressed(str(config.pads)))
        entries.append(
            {
                "table": name,
                "seconds": round(len(p.target_m) / RATE_HZ, 1),
                "depth_m": round(float(p.press.penetration_m().max()), 6),
                "range_m": [round(float(p.target_m.min()), 6), round(float(p.target_m.max()), 6)],
                "peak_force_n": round(p.peak_force_n, 1),
                "floors_apart": {pair: round(apart, 2) for pair, apart in p.discrimination.items()},
                "pressed": {k: list(v) if isinstance(v, tuple) else v for k, v in note.items() if v is not None},
            }
        )
    words = {
        "pads": found.part,
        "tells_apart": list(found.rivals),
        "rate_hz": RATE_HZ,
        "units": "t in s, q_target and opening in m",
        "how": "hold the object where `pressed` says, in the hand's own frame, and the arm still; record pads and measured "
        "opening, one press twice; put `pressed` under the recording's name in measurements.yaml",
        "targets": "q_target is what to command a gripper that yields as the twin's does, opening is where its fingers shall "
        "then be; a gripper that goes where it is told is sent the opening",
        "presses": entries,
    }
    _write_plan(config.out, words, len(entries))


def _write_loads(found: "Plan[PlannedLoad]", config: ExciteConfig, sensor: "CellsConfig") -> None:
    """Tables and plan of presses of a sensor of cells; loads have the names and units of its recordings."""
    from taccorl.alignment.machines.cells_file import LOADS

    config.out.mkdir(parents=True, exist_ok=True)
    column, factor = LOADS[sensor.load.unit]
    rate_hz = found.planned[0].rate_hz
    entries = []
    for number, p in enumerate(found.planned[: config.num], 1):
        name = f"{number}_{p.profile.name}.csv"
        loads = {column: p.load[:, 0]} if sensor.load.shared else {}
        if not sensor.load.shared:
            loads = {f"{cell}.{column}": p.load[:, k] for k, cell in enumerate(sensor.names)}
        columns = {key: factor * load for key, load in loads.items()}
        if p.place_mm is not None:
            columns |= {key: 0.0 * p.load[:, 0] + mm for key, mm in zip(("x_mm", "y_mm"), p.place_mm, strict=True)}
        _write_table(config.out / name, columns, rate_hz)
        entries.append(
            {
                "table": name,
                "seconds": round(p.duration_s, 1),
                "highest_load": float(f"{p.load.max():.4g}"),
                "floors_apart": {pair: round(apart, 2) for pair, apart in p.discrimination.items()},
            }
        )
    words = {
        "sensor": found.part,
        "tells_apart": list(found.rivals),
        "rate_hz": float(f"{rate_hz:.6g}"),
        "units": f"t in s, {column}, highest_load in {sensor.load.unit}",
        "how": "apply the load over time as well as your press can, record the load that acts and the readings, one press twice; "
        "the recording need not follow the table exactly",
        "presses": entries,
    }
    _write_plan(config.out, words, len(entries))


def _write_table(path: Path, columns: "dict[str, np.ndarray]", rate_hz: float) -> None:
    """``t`` [s] and the columns, with seven digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["t", *columns])
        for k, values in enumerate(zip(*columns.values(), strict=True)):
            rows.writerow([f"{k / rate_hz:.6g}", *(f"{v:.7g}" for v in values)])


def _write_plan(folder: Path, words: dict[str, object], num: int) -> None:
    import yaml

    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump(words, sort_keys=False, allow_unicode=True), encoding="utf-8")
    print(f"wrote {path} and {num} tables of targets")
