"""Settings of generation for a task: the YAML file that ``Task.mimicgen`` names, with IsaacLab Mimic's field names.

Every distance is in metres, every angle in radians; a step is a control step, 1/30 s.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from taccorl.data.strict_yaml import Document, Rules, check_version
from taccorl.episodes.sources.mimicgen.schedule import ConstraintSpec, rehearse
from taccorl.errors import DeadlockError, SpecError, TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.task import Task, tasks
from taccorl.tasks.experts import expert_of

UNTIL_THE_END = "until the end"
"""Name of a last subtask without a signal."""
Retarget = Literal["held_object", "eef", "eef_command"]
ContactMode = Literal["replay", "closed_loop_expert"]
Strategy = Literal["random", "nearest_neighbor_object"]


@dataclass(frozen=True, kw_only=True)
class SubtaskSpec:
    """One subtask of one arm: its end, the object that its motion refers to, the object held, and the choice of a source."""

    subtask_term_signal: str | None
    """Name of the task's subtask (``Task.subtasks``) whose ``done`` ends this one. Null, for the last subtask of an arm only: it
    lasts until the source ends (a retreat, for example), and the other arm does not wait for it."""
    object_ref: str | None = None
    """Reference body for the transfer of the motion: T' = O_new · O_src⁻¹ · T_src. Null: the motion is repeated in joint space,
    blended from the arm's present angles to those at which the held object reaches its target."""
    held_object: str | None = None
    """Body held by this hand: its path is transferred instead of the hand's (``retarget: held_object``)."""
    subtask_term_offset_range: tuple[int, int] = (0, 0)
    """Range of steps after the signal, both ends included, from which an offset is drawn for each attempt. (0, 0) for an arm's
    last subtask."""
    selection_strategy: Strategy = "random"
    """How an attempt's source demonstration is chosen: at random, or from those whose object lies nearest to that of the new
    scene (``carry.NEAREST``). The subtask that begins first decides for the whole attempt."""

    @property
    def name(self) -> str:
        """Name of the subtask for schedules and messages."""
        return (
            UNTIL_THE_END
            if self.subtask_term_signal is None
            else self.subtask_term_signal
        )


@dataclass(frozen=True, kw_only=True)
class NoiseSpec:
    """Standard deviation of white noise on the hand's goal in free motion and while gripping, up to ``contact_lead_steps`` before
    the held object first touches its mate; per axis, each step. MimicGen's default is 2.5 mm and 1.4°."""

    position_m: float = 0.0
    rotation_rad: float = 0.0


@dataclass(frozen=True, kw_only=True)
class DisturbanceSpec:
    """Disturbance of the arms in transport in new episodes, so that these contain recoveries (``disturbance.py``): ``action`` is
    the intended target, ``sim.executed`` the target that was sent."""

    joint_rad: float = 0.0
    """Standard deviation of each joint's drift; 0: none. 0.02 moves a hand by about 10 mm."""
    time_s: float = 0.7
    """Time constant of the drift [s]: after it a drift has decayed to 1/e."""


@dataclass(frozen=True, kw_only=True)
class GenerationSpec:
    """Settings for all subtasks: transfer of the motion, motion in contact, waiting, noise."""

    retarget: Retarget = "held_object"
    """Object whose path is kept. held_object: T' = Δ · T_src · G_src · G_new⁻¹ with the object's pose G in the hand; eef: T' = Δ
    · T_src. Both transfer the target poses of the hand, and correct the steady-state offset that the arm has in this twin.
    eef_command: the method of MimicGen and IsaacLab Mimic, Δ · T_src of the commanded poses, sent unchanged."""
    contact_mode: ContactMode = "replay"
    """Controller of the hands from shortly before a held object touches its mate to the end of that subtask. replay: the
    source's motion, without feedback. closed_loop_expert: the task's scripted expert, which detects a block, backs off and aims
    again, with a human-like aiming error and tremor. These are in ``sim.executed``, the target that was sent; ``action`` is the
    target without them. The mode is stored in the provenance, with the expert's corrections."""
    num_settle_steps_before_gripper: int = 12
    """Largest number of steps, without noise, for which an arm waits until it is at rest before its gripper opens or closes; the
    other arm of a coordinated subtask waits, too."""
    num_settle_steps_before_contact: int = 30
    """Largest number of steps for which an arm waits until its hand has reached its goal before contact begins
    (``contact_lead_steps``). In this time the steady-state offset of the arm in this twin is estimated, and the noise of the
    transport decays."""
    contact_lead_steps: int = 15
    """Number of control steps before the held object touches its mate from which the motion counts as contact."""
    noise: NoiseSpec = field(default_factory=NoiseSpec)
    disturbance: DisturbanceSpec = field(default_factory=DisturbanceSpec)

    @property
    def has_intended(self) -> bool:
        """Whether ``action`` may differ from the target that was sent to the twin (``sim.executed``), because arms are disturbed
        or an expert has an aiming error."""
        return (
            self.contact_mode == "closed_loop_expert" or self.disturbance.joint_rad > 0
        )


@dataclass(frozen=True, kw_only=True)
class GatesSpec:
    """Limits that a success must meet to be kept: forces, penetration, joint limits and speeds."""

    max_force_n: float = 80.0
    """Net force between mating parts [N]."""
    max_penetration_m: float = 0.0003
    """Overlap of mating parts [m]; it must be less than the clearance on a side."""
    max_joint_speed_radps: float = 3.1
    """Measured speed of any joint [rad/s]; PiPER's slowest joints reach 180°/s."""


@dataclass(frozen=True, kw_only=True)
class MimicSpec:
    """Complete settings of generation for one task, except the twin and the sources."""

    spec_version: int
    task: str
    subtask_configs: dict[str, tuple[SubtaskSpec, ...]]
    """Arm → its subtasks in order."""
    task_constraint_configs: tuple[ConstraintSpec, ...] = ()
    symmetry: dict[str, int] = field(default_factory=dict)
    """Body → number of rotations about its own z axis, in equal steps, that look the same; 0: any angle."""
    datagen_config: GenerationSpec = field(default_factory=GenerationSpec)
    gates: GatesSpec = field(default_factory=GatesSpec)

    @property
    def digest(self) -> str:
        """SHA-256 of everything in the spec that affects the result; layout and comments of the file do not."""
        return hashlib.sha256(
            json.dumps(dataclasses.asdict(self), sort_keys=True).encode()
        ).hexdigest()

    @property
    def signals(self) -> dict[str, tuple[str, ...]]:
        """Arm → names of its subtasks."""
        return {
            arm: tuple(s.name for s in subtasks)
            for arm, subtasks in self.subtask_configs.items()
        }

    def coordination(self, arm: str, k: int) -> ConstraintSpec | None:
        """Constraint that ties subtask ``k`` of ``arm`` to a simultaneous subtask of the other arm; None without one."""
        return next((c for c in self._of(arm, k) if c.coordinated), None)

    def formers(self, arm: str, k: int) -> list[tuple[str, int]]:
        """Return the subtasks (arm, index) that must have ended before subtask ``k`` of ``arm`` begins."""
        return [
            c.former
            for c in self._of(arm, k)
            if not c.coordinated and c.latter == (arm, k)
        ]

    def _of(self, arm: str, k: int) -> Iterator[ConstraintSpec]:
        return (
            c
            for c in self.task_constraint_configs
            if (arm, k) in c.eef_subtask_constraint_tuple
        )


def load_mimic_spec(name: str | Path) -> MimicSpec:
    """Load a spec by path, or a task's own by the task's name. Raises SpecError: the file is invalid; the message names file,
    line and key."""
    document = Document(MimicSpec, mimic_spec_path(name))
    spec = document.value
    check_version(document, spec.spec_version)
    document.refuse(_rules(spec))
    return spec


def mimic_spec_path(name: str | Path) -> Path:
    """Path of a spec: ``name`` itself if it is a file, else the file that the task of that name states (``Task.mimicgen``).
    Raises SpecError: ``name`` is neither a file nor a task, or the task has no spec."""
    if Path(name).is_file():
        return Path(name)
    if str(name) not in tasks:
        raise SpecError(
            f"no MimicGen spec {str(name)!r}: neither a file nor a task; {nearest(Path(name).stem, tasks)}"
        )
    path = tasks.get(str(name)).mimicgen
    if path is None:
        raise SpecError(
            f"task {name} has no MimicGen spec: name one by its attribute mimicgen, or give --spec=FILE"
        )
    return path


def _rules(spec: MimicSpec) -> Rules:
    counts = ", ".join(
        f"{arm} has 0 … {len(subtasks) - 1}"
        for arm, subtasks in spec.subtask_configs.items()
    )
    for arm, subtasks in spec.subtask_configs.items():
        yield (
            arm not in ROBOT.arms,
            f"subtask_configs/{arm}",
            f"no arm {arm!r}; {nearest(arm, ROBOT.arms)}",
        )
        for k, subtask in enumerate(subtasks):
            yield from _subtask_rules(
                f"subtask_configs/{arm}/{k}", subtask, last=k == len(subtasks) - 1
            )
    for arm in ROBOT.arms:
        yield (
            not spec.subtask_configs.get(arm),
            "subtask_configs",
            f"the {arm} arm has no subtasks",
        )
    for body, turns in spec.symmetry.items():
        yield (
            turns < 0,
            f"symmetry/{body}",
            f"{turns}: how many turns look the same; 0 for any",
        )
    yield from _number_rules(spec)
    bound: dict[tuple[str, int], int] = {}
    for i, constraint in enumerate(spec.task_constraint_configs):
        key = f"task_constraint_configs/{i}/eef_subtask_constraint_tuple"
        pair = constraint.eef_subtask_constraint_tuple
        for arm, k in pair:
            is_there = 0 <= k < len(spec.subtask_configs.get(arm, ()))
            yield not is_there, key, f"there is no subtask {k} of {arm!r}; {counts}"
        same = f"both are of the {pair[0][0]} arm; an arm's own subtasks run in order anyway"
        yield pair[0][0] == pair[1][0], key, same
        for end in pair if constraint.coordinated else pair[1:]:
            text = f"{end[0]} subtask {end[1]} waits in constraint {bound.get(end)} already; one for each subtask"
            yield end in bound, key, text
            bound[end] = i
    try:
        rehearse(spec.signals, spec.task_constraint_configs)
    except DeadlockError as error:
        yield True, "task_constraint_configs", str(error)


def _subtask_rules(key: str, subtask: SubtaskSpec, *, last: bool) -> Rules:
    (low, high), ends = (
        subtask.subtask_term_offset_range,
        f"{key}/subtask_term_offset_range",
    )
    yield low > high, ends, f"[{low}, {high}]: the lower bound comes first"
    unnamed = subtask.subtask_term_signal is None and not last
    yield (
        unnamed,
        f"{key}/subtask_term_signal",
        "null: only an arm's last subtask needs no signal",
    )
    text = f"[{low}, {high}]: an arm's last subtask ends where the source ends"
    yield last and (low, high) != (0, 0), ends, text
    needs = subtask.selection_strategy != "random" and subtask.object_ref is None
    yield (
        needs,
        f"{key}/selection_strategy",
        f"{subtask.selection_strategy} needs an object_ref",
    )


def _numbers(config: object, place: str = "") -> Iterator[tuple[str, float]]:
    """(name with its place, value) of the numbers in a dataclass."""
    for f in dataclasses.fields(config):  # pyright: ignore[reportArgumentType]
        value = getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, f"{place}{f.name}/")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{place}{f.name}", value


def _number_rules(spec: MimicSpec) -> Rules:
    generation = spec.datagen_config
    for name, value in _numbers(spec.gates, "gates/"):
        yield not value > 0, name, f"{value:g}: nothing would pass; give a number > 0"
    for name, value in _numbers(generation):
        positive = name.endswith("time_s")
        text = (
            f"{value:g} is out of range; give a number {'> 0' if positive else '≥ 0'}"
        )
        yield (
            not value >= 0 or (positive and value == 0),
            f"datagen_config/{name}",
            text,
        )
    disturbance = generation.disturbance
    alone = disturbance.joint_rad == 0 and disturbance != DisturbanceSpec()
    yield (
        alone,
        "datagen_config/disturbance/time_s",
        "has no effect without joint_rad; give joint_rad: 0.02",
    )
    yield from _closed_loop_rules(generation)


def _closed_loop_rules(generation: GenerationSpec) -> Rules:
    closed = generation.contact_mode == "closed_loop_expert"
    text = "eef_command sends poses as commanded, closed_loop_expert says where the hands are to be; take "
    yield (
        closed and generation.retarget == "eef_command",
        "datagen_config/retarget",
        f"{text}held_object or eef",
    )


def check_task(spec: MimicSpec, task: Task) -> None:
    """Check that the spec is of this task: the same subtasks in the same order, and only objects that it has. Raises SpecError:
    the spec names something that the task does not have; the message gives the nearest name."""
    where = f"mimicgen spec of {spec.task}"
    if spec.task != task.name:
        raise SpecError(f"{where}: the task is {task.name}")
    bodies = (*task.parts, *task.clamped)
    for arm, subtasks in task.subtasks().items():
        known = [s.name for s in subtasks]
        named = [
            s.subtask_term_signal
            for s in spec.subtask_configs[arm]
            if s.subtask_term_signal is not None
        ]
        for k, name in enumerate(named):
            if name not in known:
                raise SpecError(
                    f"{where}: subtask_configs → {arm} → {k}: no subtask {name!r}; {nearest(name, known)}"
                )
        if named != known:
            raise SpecError(
                f"{where}: subtask_configs → {arm}: {', '.join(named)}; the task has {', '.join(known)}"
            )
        for k, subtask in enumerate(spec.subtask_configs[arm]):
            for key in ("object_ref", "held_object"):
                body = getattr(subtask, key)
                if body is not None and body not in bodies:
                    raise SpecError(
                        f"{where}: {arm} → {k} → {key}: no {body!r}; {nearest(body, bodies)}"
                    )
    for body in spec.symmetry:
        if body not in bodies:
            raise SpecError(f"{where}: symmetry: no {body!r}; {nearest(body, bodies)}")
    check_closed_loop(spec)


def check_closed_loop(spec: MimicSpec) -> None:
    """Check that the task's expert can move the hands in contact, if the spec requires it (``closed_loop_expert``). Raises
    SpecError: the task's expert cannot start in the middle of a task, or other options contradict it."""
    where = f"mimicgen spec of {spec.task}"
    for wrong, key, text in _closed_loop_rules(spec.datagen_config):
        if wrong:
            raise SpecError(f"{where}: {key.replace('/', ' → ')}: {text}")
    if (
        spec.datagen_config.contact_mode == "closed_loop_expert"
        and not expert_of(tasks.get(spec.task)).can_finish()
    ):
        raise SpecError(
            f"{where}: datagen_config → contact_mode: closed_loop_expert, but the expert of {spec.task} cannot start in the "
            "middle of a subtask: implement its finish(), or set contact_mode: replay"
        )


def with_options(spec: MimicSpec, **changes: object) -> MimicSpec:
    """A copy of the spec in which fields of ``datagen_config`` have the values ``changes``. Raises TaccorlError: there is no such
    field, or the value is not allowed."""
    known = [f.name for f in dataclasses.fields(GenerationSpec)]
    words = {"retarget": get_args(Retarget), "contact_mode": get_args(ContactMode)}
    for name, value in changes.items():
        if name not in known:
            raise TaccorlError(f"datagen_config: no {name!r}; {nearest(name, known)}")
        if name in words and value not in words[name]:
            raise TaccorlError(
                f"datagen_config: {name}: {value!r} is not one of {', '.join(words[name])}; {nearest(str(value), words[name])}"
            )
    return dataclasses.replace(
        spec, datagen_config=dataclasses.replace(spec.datagen_config, **changes)
    )  # pyright: ignore[reportArgumentType]
