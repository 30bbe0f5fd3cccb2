"""A robot file: any robot as a kinematic tree of an MJCF or URDF file, with facts about each joint's drive that only its user
knows. Without a model, its joints are axes: a slide on a bench, a wheel, a servo with a pendulum.

``docs/your_robot.md`` has one with its keys. ``taccorl init-robot my_arm.xml`` writes one with the facts of the model, and
``TODO`` for the others.
"""

import dataclasses
import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import mujoco
import numpy as np
import yaml

from taccorl.alignment.controller.drive_law import WINDING, DriveLaw
from taccorl.alignment.controller.rigid_joint import NEED_ROTOR, PointMass
from taccorl.alignment.machines.model_drive import DriveFacts
from taccorl.alignment.machines.robot_joint import (
    PAYLOAD_AT,
    KeptMotions,
    RobotJoint,
    acts_on_joint,
)
from taccorl.alignment.machines.robot_model import (
    JointFacts,
    RobotModel,
    load_robot_model,
)
from taccorl.data.strict_yaml import Rules
from taccorl.errors import SpecError, TaccorlError, nearest, plain_name
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.load import Payload
from taccorl.sim.effects.scaled import OF_A_TURN, bounded
from taccorl.sim.settings import check_numbers
from taccorl.sim.twin_file import EffectsDocument, effect_entry, write_whole

TODO = "TODO"  # Placeholder for a value that only the user knows; a file that contains it is rejected
REMOVABLE = 0.95
"""Largest share of a body's mass that a ``payload`` below 0 may remove. A choice: what is left must be above 0."""
MOST_EARLY_S = 0.01
"""``position_age_s`` and ``target_late_s`` of a file must be above minus this value [s]. A
choice: longer than the period of any drive's loop."""
_ALONG = 0.9999  # least cosine between axes that count as parallel
_HEADER = (
    "# A robot: taccorl/alignment/machines/robot_file.py says what may stand here.\n"
)


@dataclass(kw_only=True)
class JointConfig(DriveLaw):
    """Settings of the drive of one joint. Units are for a hinge; for a sliding joint read N for N·m, m for rad, kg for kg·m²."""

    gains: Literal["commanded", "fitted"] = "commanded"
    """commanded: kp and kd are those of the controller. fitted: they are only the start of a fit. With law pwm they are always
    the servo's own, and stall torque and back-EMF are fitted."""
    rotor_inertia: float = (
        0.0  # Inertia of the motor's rotor on the motor's side of the gear [kg·m²]
    )
    gear: float = (
        1.0  # Turns of the motor per turn of the joint; for a sliding joint [rad/m]
    )
    loop_hz: float | None = None  # Rate of the drive's control loop [Hz]
    command_hz: float | None = None
    """Rate at which the drive receives targets [Hz], if only some of them are logged: a replay interpolates rows linearly at this
    rate. Without it, a target holds until the next row."""
    position_age_s: float = 0.0
    """Age of the measured position when the torque acts, beyond that of the loop's timing [s]; ``diagnose`` fits it."""
    unit: Literal["rad", "m"] | None = None
    """Unit of the position of a joint without a model: rad of a hinge, m of a slide."""
    inertia: float | None = None
    """Inertia of a joint without a model [kg·m²], its rotor included; a fit starts there."""
    limits: tuple[float, float] | None = None
    """Lowest and highest position of a joint without a model [rad]."""
    weight_sin: float = 0.0
    """S [N·m] in S sin q + C cos q, which holds the weight of a hinge without a model."""
    weight_cos: float = 0.0
    """C [N·m] in it; of a slide without a model its weight [N]."""
    payload_kg: float = 0.0
    """Mass that a joint without a model carries [kg], unless a recording states another;
    not part of ``inertia``."""
    lever_m: float = 0.0
    """Distance of the payload from the axis, unless a recording states another [m]."""
    arm_kg: float = 0.0
    """Mass of the arm that holds the payload, a uniform rod as long as the lever [kg]."""
    hangs_at_rad: float = 0.0
    """Position at which payload and arm hang straight down [rad]."""
    target_late_s: float = 0.0
    """Delay from a target's row until it acts in the drive [s]. Below 0: the position of a
    row is read after the row's target was sent, or half a step later, as MuJoCo's
    semi-implicit steps give it. ``diagnose`` fits −2 ms to 0, of a joint without a model −2
    to 3 ms; a longer delay is an effect."""
    speed_late_s: float = 0.0
    """Delay of the speed in the loop of a joint without a model beyond that of a difference
    of two samples [s]; minus half a period if the drive measures the speed."""
    force_unit_n: float | None = None
    """Effort [N·m] of this joint that corresponds to 1 N·m at a joint of a small arm;
    bounds of effects are multiplied by it (``RobotJoint.scale`` has the default)."""
    length_unit_m: float | None = None
    """Range of positions [rad] that corresponds to 1 rad at a joint of a small arm."""
    effects: list[Effect] = field(default_factory=list)
    """Effects beyond rigid bodies and control law; empty if there are none."""
    FITTED: ClassVar[tuple[str, ...]] = (
        *DriveLaw.FITTED,
        "effort_scale",
        "speed_delay_s",
        "position_age_s",
        *WINDING,
        *("inertia", "weight_sin", "weight_cos", "target_late_s", "speed_late_s"),
    )
    WITHOUT_MODEL: ClassVar[tuple[str, ...]] = (
        *("unit", "inertia", "limits", "weight_sin", "weight_cos", "payload_kg"),
        *("lever_m", "arm_kg", "hangs_at_rad", "speed_late_s"),
    )
    """Keys of a joint without a model, which has them for the others."""
    OF_HINGES: ClassVar[tuple[str, ...]] = (
        *("weight_sin", "lever_m", "arm_kg", "hangs_at_rad"),
    )
    OPTIONAL: ClassVar[tuple[str, ...]] = (
        *("loop_hz", "command_hz", "force_unit_n", "length_unit_m", "inertia"),
    )

    def check(self, has_model: bool) -> None:
        """Check the numbers of a file. Raises TaccorlError, which begins with the key:
        one is out of range, missing, or not used by its law or by a joint with a model."""
        positive = [name for name in self.OPTIONAL if getattr(self, name) is not None]
        check_numbers(
            "joint",
            self,
            positive=("gear", *positive),
            not_negative=("rotor_inertia", "payload_kg", "lever_m", "arm_kg"),
            finite=(
                *("position_age_s", "target_late_s", "weight_sin", "weight_cos"),
                "hangs_at_rad",
            ),
        )
        if has_model:
            self._check_beside_model()
        else:
            self._check_alone()
        for name in ("position_age_s", "target_late_s"):
            if not (value := getattr(self, name)) > -MOST_EARLY_S:
                raise TaccorlError(
                    f"joint.{name}: is {value:g} s; write a value above −{MOST_EARLY_S:g} s"
                )
        self.check_law("joint")
        self.check_known(
            "joint", {e.name: [p.name for p in e.parameters()] for e in self.effects}
        )
        if self.law == "pwm" and self.gains == "fitted":
            raise TaccorlError(
                "joint.gains: with law pwm, stall torque and back-EMF are fitted instead of kp and kd; write the servo's own "
                "kp and kd, and `gains: commanded`"
            )

    def _check_beside_model(self) -> None:
        for field_ in dataclasses.fields(self):
            name = field_.name
            if name in self.WITHOUT_MODEL and getattr(self, name) != field_.default:
                raise TaccorlError(f"joint.{name}: the model states it; remove it")

    def _check_alone(self) -> None:
        for name in ("unit", "inertia"):
            if getattr(self, name) is None:
                raise TaccorlError(
                    f"joint.{name}: key {name!r} is missing; a joint states it where the "
                    "file has no `model:`"
                )
        if self.armature > (self.inertia or 0.0):
            raise TaccorlError(
                f"joint.rotor_inertia: {self.armature:g} is greater than inertia, {self.inertia:g}, of which it is a part; "
                "correct one of them"
            )
        newest = -0.5 / self.loop_hz if self.loop_hz else 0.0
        if not self.speed_late_s >= newest:
            raise TaccorlError(
                f"joint.speed_late_s: is {self.speed_late_s:g} s; write at least {newest:g} s, minus half a period of "
                "loop_hz: the value of a measured speed"
            )
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise TaccorlError(
                f"joint.limits: {list(self.limits)} must be ascending; write the lowest position first"
            )
        if self.gains == "fitted" and not self.gain_names:
            raise TaccorlError(
                f"joint.gains: law {self.law} has no gains to fit; remove this key"
            )
        of_hinge = [name for name in self.OF_HINGES if getattr(self, name)]
        if self.unit == "m" and of_hinge:
            raise TaccorlError(
                f"joint.{of_hinge[0]}: does not apply to a slide, whose weight [N] is weight_cos; remove this key"
            )

    def with_numbers(self, base: Mapping[str, float]) -> "JointConfig":
        """Copy with fitted numbers: name of a number → value as it was fitted."""
        own = ("weight_sin", "weight_cos", "target_late_s", "speed_late_s")
        new = {key: base[key] for key in (*own, "position_age_s") if key in base}
        new |= self.law_numbers(base)
        if base.get("loop_s", 0.0) > 0.0:
            new["loop_hz"] = 1.0 / base["loop_s"]
        if self.inertia is not None and "inertia" in base:
            share = min(self.rotor_inertia / self.inertia, 1.0)
            new |= {
                "inertia": base["inertia"],
                "rotor_inertia": share * base["inertia"],
            }
        return dataclasses.replace(self, **{key: float(v) for key, v in new.items()})

    @property
    def is_uncertain(self) -> bool:
        """Whether ``diagnose`` fits numbers of the control law, because they are not known."""
        return self.law == "pwm" or self.gains == "fitted"

    @property
    def armature(self) -> float:
        """Inertia of the rotor as it acts at the joint [kg·m²]."""
        return self.rotor_inertia * self.gear**2


@dataclass(kw_only=True)
class RobotConfig:
    """Content of a robot file."""

    kind: Literal["robot"] = "robot"
    model: str = ""
    """Path of the MJCF or URDF file, relative to this file. Without one each joint states
    its ``unit`` and ``inertia``, and moves without loading the others."""
    gravity_compensation: float = (
        0.0  # Share of the weight that the controller compensates, 0 … 1
    )
    gravity: list[float] = field(default_factory=list)
    """Direction of gravity (x, y, z) in the model's frame, of any length, where the base is not mounted as in the model, which
    the controller does not know. Empty: as the model has it."""
    joints: dict[str, JointConfig]  # Name of the joint in the model → its drive

    def __post_init__(self) -> None:
        if not 0.0 <= self.gravity_compensation <= 1.0:
            share = f"robot.gravity_compensation: is {self.gravity_compensation:g}; give the share of the weight, 0 … 1"
            raise TaccorlError(
                f"{share}. A controller that is wrong about the weight is the effect gravity_mismatch"
            )
        if self.gravity and (
            len(self.gravity) != 3
            or not math.isfinite(sum(self.gravity))
            or not any(self.gravity)
        ):
            raise TaccorlError(
                f"robot.gravity: is {self.gravity}; give the three numbers x, y, z of a direction"
            )


@dataclass(frozen=True)
class Robot:
    """Machine described by a robot file and its model. ``joint`` returns the data for the one-joint model."""

    config: RobotConfig  # Content of the file
    rigid: RobotModel  # The model that the file names
    path: Path  # Path of the robot file
    motions: KeptMotions = field(default_factory=KeptMotions, repr=False, compare=False)

    @property
    def units(self) -> dict[str, str]:
        """Joint of the model → unit of its position, rad or m. Joints that the file does not name may also be recorded."""
        return {name: facts.unit for name, facts in self.rigid.joints.items()}

    def joint(self, signal: str) -> RobotJoint:
        """The joint for the one-joint model. Raises TaccorlError: the file names no such joint."""
        if signal not in self.config.joints:
            raise TaccorlError(
                f"{self.path}: no joint {signal!r}; {nearest(signal, self.config.joints)}"
            )
        return RobotJoint(self, signal)

    def last_body(self, signal: str) -> int:
        """Id of the body in which the joint's ``payload`` is that states no ``link``: the one with the most bodies between it and
        the joint; of several the one with the lowest id."""
        chains = map(self.chain, range(self.rigid.model.nbody))
        own = self.rigid.model.joint(signal).bodyid[0]
        return max((c for c in chains if own in c), key=lambda c: (len(c), -c[0]))[0]

    def chain(self, body: int) -> list[int]:
        """Ids of the bodies from ``body`` to the world."""
        parents, found = self.rigid.model.body_parentid, [body]
        while found[-1] != 0:
            found.append(int(parents[found[-1]]))
        return found

    def body_of(self, signal: str, payload: Payload) -> int:
        """Id of the body in which a payload of the joint is."""
        return (
            self.rigid.model.body(payload.link).id
            if payload.link
            else self.last_body(signal)
        )

    def body_name(self, body: int) -> str:
        """Name of a body in the model; ``body 3`` of one without a name."""
        return self.rigid.model.body(body).name or f"body {body}"

    def links_before(self, body: int) -> dict[str, int]:
        """Name → id of the bodies with joints between the base and a body."""
        model = self.rigid.model
        before = [one for one in self.chain(body)[1:-1] if model.body_jntnum[one]]
        names = {model.body(one).name: one for one in before}
        return {name: one for name, one in names.items() if name}

    def moves_body(self, signal: str, body: int) -> bool:
        """True if the joint moves the body with this id."""
        return self.rigid.model.joint(signal).bodyid[0] in self.chain(body)

    def along_chain(self, signal: str) -> tuple[str, ...]:
        """Joints whose positions change what weight the joint carries: those behind it, to the tip, then those before it."""
        bodies = {
            name: int(self.rigid.model.joint(name).bodyid[0])
            for name in self.rigid.joints
            if name != signal
        }
        behind = [
            name for name, body in bodies.items() if self.moves_body(signal, body)
        ]
        own = int(self.rigid.model.joint(signal).bodyid[0])
        before = [
            name for name in bodies if name not in behind and self.moves_body(name, own)
        ]
        return (*behind, *reversed(before))

    @property
    def more_gravity(self) -> np.ndarray:
        """(3,) gravity less that of the model [m/s²]: what no controller compensates."""
        own = self.rigid.model.opt.gravity
        if not self.config.gravity:
            return np.zeros(3)
        direction = np.array(self.config.gravity, float)
        return np.linalg.norm(own) * direction / np.linalg.norm(direction) - own

    def masses(self) -> dict[str, PointMass]:
        """Joint → the mass of its effect ``payload``, which all joints move that move its body."""
        every = [
            (name, effect)
            for name, joint in self.config.joints.items()
            for effect in joint.effects
        ]
        return {
            name: self.mass(name, e)
            for name, e in every
            if isinstance(e, Payload) and not e.is_absent
        }

    def mass(self, signal: str, payload: Payload) -> PointMass:
        """The mass of a ``payload`` at one joint: its place is along the axes of its body, from that body's centre of mass."""
        model, body = self.rigid.model, self.body_of(signal, payload)
        x, y, z = (
            float(a + getattr(payload, n))
            for a, n in zip(model.body_ipos[body], PAYLOAD_AT, strict=True)
        )
        mujoco.mju_quat2Mat(turn := np.empty(9), model.body_iquat[body])
        inertia = (
            payload.like_link
            * model.body_inertia[body]
            / max(model.body_mass[body], 1e-9)
        )
        own = 0.5 * inertia.sum() - inertia
        axes = turn.reshape(3, 3)
        return PointMass(payload.mass_kg, body, (x, y, z), axes * own @ axes.T)

    def removable_kg(self, body: int) -> float:
        """Most mass that a payload below 0 may remove from a body [kg]: a share of that of all bodies fixed to one another."""
        model = self.rigid.model
        return REMOVABLE * float(
            model.body_mass[model.body_weldid == model.body_weldid[body]].sum()
        )

    def wrong_mass(self) -> tuple[str, str]:
        """Joint and error message of the first ``payload`` that removes more mass than its body has, or that is in the same body
        as another joint's; ("", "") if all are valid."""
        bodies: dict[int, str] = {}
        for name, mass in self.masses().items():
            if mass.mass_kg < -(most := self.removable_kg(mass.body)):
                text = (
                    f"payload of {name}: mass_kg is {mass.mass_kg:g} kg, and body {self.body_name(mass.body)} must keep a mass: "
                    f"give {-most:.4g} kg or more, {REMOVABLE:.0%} of what {self.rigid.path.name} states"
                )
                return name, text
            other = bodies.setdefault(mass.body, name)
            if other != name:
                text = (
                    f"payload of {name}: {other} has one, too, and both are in body {self.body_name(mass.body)}; every joint "
                    "that moves the body feels its mass, so write one payload, at one of these joints"
                )
                return name, text
        return "", ""

    def reach_m(self, signal: str) -> float:
        """Largest distance of a payload from its body's centre of mass along each axis, for a search [m]: half the length of the
        chain from the base, or twice the distance of that centre from its joint. A choice."""
        model, body = self.rigid.model, self.last_body(signal)
        from_joint = np.linalg.norm(
            model.body_ipos[body] - model.jnt_pos[model.body_jntadr[body]]
        )
        lengths = np.linalg.norm(model.body_pos[self.chain(body)[:-2]], axis=1)
        chain = float(np.linalg.norm(model.body_ipos[body]) + lengths.sum())
        return max(0.5 * chain, 2.0 * float(from_joint), 0.05)

    def idle_axes(self, signal: str, last: int | None = None) -> tuple[int, ...]:
        """Axes 0, 1, 2 of the body ``last`` (default: the joint's last body) along which the joint does not feel the payload's
        place: all for a slide; for a hinge the one parallel to its own, if all joints in between are slides or turn about it."""
        model, own = self.rigid.model, self.rigid.model.joint(signal).id
        last = self.last_body(signal) if last is None else last
        if model.jnt_type[own] == mujoco.mjtJoint.mjJNT_SLIDE:
            return (0, 1, 2)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        chain = self.chain(last)
        between = chain[: chain.index(model.jnt_bodyid[own])]
        turning = np.isin(model.jnt_bodyid, between)
        turning &= model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
        if (np.abs(data.xaxis[turning] @ data.xaxis[own]) < _ALONG).any():
            return ()
        along = np.abs(data.xmat[last].reshape(3, 3).T @ data.xaxis[own])
        return (int(np.argmax(along)),) if along.max() > _ALONG else ()

    def with_joint(self, signal: str, config: JointConfig) -> "Robot":
        """The robot with another drive at one joint."""
        joints = {
            name: config if name == signal else own
            for name, own in self.config.joints.items()
        }
        return dataclasses.replace(
            self, config=dataclasses.replace(self.config, joints=joints)
        )

    def text(self, path: Path) -> str:
        """YAML text of the robot file for ``path``, to which the model's path is relative, without default values."""
        model = self.rigid.path.resolve()
        folder = Path(path).resolve().parent
        content: dict[str, Any] = {"kind": "robot"}
        if self.config.model:
            content["model"] = Path(os.path.relpath(model, folder)).as_posix()
        content |= _set(self.config, ("gravity_compensation",))
        content |= {"gravity": self.config.gravity} if self.config.gravity else {}
        content["joints"] = {}
        for name, joint in self.config.joints.items():
            names = [
                f.name for f in dataclasses.fields(JointConfig) if f.name != "effects"
            ]
            content["joints"][name] = _plain(_set(joint, names))
            if joint.effects:
                # z_m of a payload is always written: its default is a place in the PiPER's hand, and robot files must state one.
                placed = [
                    {"z_m": e.z_m} if isinstance(e, Payload) else {}
                    for e in joint.effects
                ]
                entries = [
                    effect_entry(e) | more
                    for e, more in zip(joint.effects, placed, strict=True)
                ]
                content["joints"][name]["effects"] = [
                    {k: v for k, v in entry.items() if k not in ("arm", "joints")}
                    for entry in entries
                ]
        return _HEADER + yaml.safe_dump(
            content,
            sort_keys=False,
            allow_unicode=True,
            default_flow_style=None,
            width=120,
        )

    def save(self, path: Path) -> None:
        """Write the robot file, as a whole or not at all: the text of the file that was loaded with what changed, so that its
        comments stay; ``text`` where that would not say the same. Raises TaccorlError: the folder cannot be written to."""
        from taccorl.alignment.machines.kept_text import with_changes

        path, after = Path(path), self.text(path)
        try:
            loaded = self.path.read_bytes().decode()
            kept = with_changes(loaded, load_robot(self.path).text(self.path), after)
        except (OSError, UnicodeDecodeError, TaccorlError):
            kept = None
        if kept is not None:
            beside = path.with_name(f".{path.name}.kept.yaml")
            try:
                write_whole(beside, kept)
                if load_robot(beside).text(path) == after:
                    write_whole(path, kept)
                    return
            except TaccorlError:
                pass
            finally:
                beside.unlink(missing_ok=True)
        write_whole(path, after)

    def digest(self) -> str:
        """Digest of a robot, 16 hexadecimal digits; equal only if file and model are equal."""
        model = self.rigid.path.read_bytes() if self.config.model else b""
        return hashlib.sha256(self.text(self.path).encode() + model).hexdigest()[:16]


def robot_of(joints: Mapping[str, JointConfig], path: Path) -> Robot:
    """A robot without a model: each of ``joints`` states its own unit and inertia.
    ``path``: of its file, which its messages name."""
    spec = mujoco.MjSpec()
    spec.option.gravity = np.zeros(3)
    facts: dict[str, JointFacts] = {}
    for name, config in joints.items():
        unit, inertia = config.unit or "rad", config.inertia or 1.0
        body = spec.worldbody.add_body(mass=inertia, inertia=[inertia] * 3)
        body.explicitinertial = True
        kinds = {"m": mujoco.mjtJoint.mjJNT_SLIDE, "rad": mujoco.mjtJoint.mjJNT_HINGE}
        body.add_joint(name=name, type=kinds[unit], axis=[0.0, 0.0, 1.0])
        facts[name] = JointFacts(
            name=name,
            unit=unit,
            limits=config.limits,
            inertia=inertia,
            armature=config.armature,
            drive=DriveFacts(),
            effects=(),
        )
    rigid = RobotModel(path, spec.compile(), facts, ())
    return Robot(RobotConfig(joints=dict(joints)), rigid, path)


def _plain(content: dict[str, Any]) -> dict[str, Any]:
    return {k: list(v) if isinstance(v, tuple) else v for k, v in content.items()}


def _set(config: Any, names: Sequence[str]) -> dict[str, Any]:
    fields = {f.name: f for f in dataclasses.fields(config)}
    return {
        name: getattr(config, name)
        for name in names
        if getattr(config, name) != fields[name].default
    }


def load_robot(path: Path) -> Robot:
    """Load a robot file with the MJCF or URDF model that it names. A file without a model,
    such as a ``kind: axis`` file, states the inertia of each joint itself.

    Raises SpecError: the file holds ``TODO``, a wrong key or value, or a joint that the
    model lacks; the message names file and line; TaccorlError: the model cannot be used
    (``load_robot_model``)."""
    path = Path(path)
    _refuse_todo(path)
    document = _RobotDocument(RobotConfig, path)
    config = document.value
    document.check()
    if config.model:
        model = path.parent / config.model
        if not model.is_file():
            raise document.error(
                "model",
                f"no file {config.model!r} beside it; write the path of the MJCF or URDF file",
            )
        rigid = load_robot_model(model, config.gravity_compensation)
        if not config.joints:
            raise document.error(
                "joints",
                f"the file names no joint; the model has {', '.join(rigid.joints)}",
            )
        robot = Robot(config, rigid, path)
    else:
        robot = robot_of(config.joints, path)
    document.refuse(_rules(robot, document))
    return document.in_units(robot)


class _RobotDocument(EffectsDocument[RobotConfig]):
    """A robot file, or an axis file, whose keys are those of its one joint. Bounds of
    effects follow from joints, which the model has: ``in_units`` checks them."""

    is_axis = False

    def _dataclass(self, cls: Any, node: yaml.Node, key: str) -> Any:
        if cls is not RobotConfig:
            return super()._dataclass(cls, node, key)
        items = dict(self._items(node, key))
        kind = self._scalar(str, items["kind"], "kind") if "kind" in items else ""
        self.is_axis = kind == "axis"
        if not self.is_axis:
            return super()._dataclass(cls, node, key)
        if "name" not in items:
            raise self.error("", "key 'name' is missing")
        name = self._scalar(str, items.pop("name"), "name")
        try:
            plain_name(name, "name")
        except TaccorlError as error:
            raise self.error("name", str(error).removeprefix("name: ")) from error
        del items["kind"]
        values = self._values(JointConfig, [*items.items()], key)
        return RobotConfig(joints={name: JointConfig(**values)})

    def place(self, joint: str) -> str:
        """Path of a joint's keys in the file."""
        return "" if self.is_axis else f"joints/{joint}/"

    def check(self) -> None:
        """Check the numbers of all joints. Raises SpecError, with the line."""
        for name, config in self.value.joints.items():
            try:
                config.check(has_model=bool(self.value.model))
            except TaccorlError as error:
                key, _, text = str(error).removeprefix("joint.").partition(": ")
                raise self.error(f"{self.place(name)}{key}", text) from error

    def _made(self, make: Any, values: dict[str, Any], key: str) -> Any:
        is_effect = isinstance(make, type) and issubclass(make, Effect)
        if is_effect and make is not Payload:
            wide = [(p.name, -math.inf, math.inf) for p in make.parameters()]
            make = bounded(make.name, tuple(wide))
        return super()._made(make, values, key)

    def in_units(self, robot: Robot) -> Robot:
        """``robot`` with the effects of the file in the units of their joints."""
        for name, config in robot.config.joints.items():
            joint, made = robot.joint(name), []
            document_key = f"{self.place(name)}effects"
            for k, effect in enumerate(config.effects):
                key = f"{document_key}/{k}"
                stated = {
                    field: getattr(effect, field)
                    for field in effect.settings()
                    if self.has(f"{key}/{field}")
                }
                made.append(self._made(partial(joint.made, effect.name), stated, key))
            robot = robot.with_joint(name, dataclasses.replace(config, effects=made))
        return robot


def _rules(robot: Robot, document: _RobotDocument) -> Rules:
    config, rigid = robot.config, robot.rigid
    bodies = {rigid.model.body(k).name: k for k in range(1, rigid.model.nbody)}
    for joint, drive in config.joints.items():
        unknown = (
            f"{config.model} has no joint {joint!r}; {nearest(joint, rigid.joints)}"
        )
        place = document.place(joint)
        yield joint not in rigid.joints, f"joints/{joint}", unknown
        for k, effect in enumerate(drive.effects):
            key, name = f"{place}effects/{k}", effect.name
            twice = name in [other.name for other in drive.effects[:k]]
            yield (
                twice,
                key,
                f"{name} stands twice at {joint}, which has one of each effect; remove one",
            )
            gives = {"weight": bool(config.model), "payload": bool(config.model)}
            can_act = acts_on_joint(type(effect), rotor=True, **gives)
            yield (
                not can_act,
                key,
                f"{name} cannot act on one joint of a robot file; remove it",
            )
            of_slide = name in OF_A_TURN and rigid.joints[joint].unit == "m"
            yield (
                of_slide,
                key,
                f"{name} repeats with each turn, and {joint} is a slide; remove it",
            )
            no_loop = f"{name} acts in a control loop that law {drive.law} does not have; remove it"
            yield not drive.allows_effect(name), key, no_loop
            rotor = f"{name} needs the inertia of the motor's rotor: write rotor_inertia (kg·m²) and gear of {joint}"
            yield name in NEED_ROTOR and drive.armature == 0.0, key, rotor
            unplaced = name == "payload" and not document.has(f"{key}/z_m")
            way_out = "payload: write z_m [m], along z of its body, from that body's centre of mass (x_m, y_m: else 0)"
            yield unplaced, key, way_out
            link = getattr(effect, "link", "")
            is_moved = not link or (
                link in bodies and robot.moves_body(joint, bodies[link])
            )
            yield (
                not is_moved,
                key,
                f"link: {joint} moves no body {link!r}; {nearest(link, bodies)}",
            )
    joint, why = robot.wrong_mass()
    yield joint, f"{document.place(joint)}effects", why


def _refuse_todo(path: Path) -> None:
    """Raises SpecError: lines of the file still say ``TODO``. The message quotes each with its comment: what to write."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return  # what reads it says so
    left: list[tuple[int, str]] = []
    joint = ""
    for number, line in enumerate(lines, 1):
        content, _, comment = line.partition("#")
        key, _, value = content.partition(":")
        if not value.strip() and key.startswith("  ") and not key.startswith("   "):
            joint = key.strip()
        if value.strip() == TODO:
            owner = f"{joint}/" if key.startswith("    ") else ""
            left.append(
                (
                    number,
                    f"{owner}{key.strip()} ({comment.strip() or 'write its value'})",
                )
            )
    if left:
        words = "; ".join(f"line {number} {what}" for number, what in left)
        raise SpecError(
            f"{path}:{left[0][0]}: {TODO} must be replaced by a value: {words}"
        )
