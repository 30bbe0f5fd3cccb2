"""A robot file: any robot as a kinematic tree of an MJCF or URDF file, with facts about each joint's drive that only its user
knows.

::

    kind: robot
    model: my_arm.xml                 # MJCF or URDF, relative to this file; meshes are not needed
    gravity_compensation: 1.0         # share of the weight that the controller adds to its torque; 0 if it adds none
    gravity: [0.05, 0, -1]            # its direction in the model's frame, if the base is not mounted as the model has it
    joints:
      elbow:                          # as the model calls it, and as the tables' columns do: elbow.q, elbow.q_target
        law: impedance                # τ = kp (q* − q) − kd q̇ + torque_ff; others: drive_law
        kp: 40.0                      # N·m/rad; of a sliding joint N/m
        kd: 1.5                       # N·m·s/rad
        gains: commanded              # kp and kd are what the controller runs; fitted: nobody knows, these are a start
        rotor_inertia: 1.2e-5         # kg·m² of the motor, and …
        gear: 100.0                   # … turns of the motor for one of the joint: 0.12 kg·m² at the joint
        effort_limit: 30.0            # N·m; torques beyond are clipped
        loop_hz: 1000.0               # of the drive's own control loop, where it is known
        effects:                      # physics beyond rigid bodies and control; taccorl add-effect writes them
        - {effect: coulomb_friction, torque_nm: 0.41}
        known: [torque_ff]            # numbers and effects that diagnose leaves as they are here (DriveLaw.known)

``taccorl init-robot my_arm.xml`` writes such a file with the facts of the model, and ``TODO`` for the others.
"""

import dataclasses
import hashlib
import math
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import mujoco
import numpy as np
import yaml

from taccorl.alignment.controller.drive_law import DriveLaw
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.rigid_joint import (
    NEED_ROTOR,
    Gains,
    MassTorque,
    PointMass,
    Rigid,
    RigidJoint,
    Surroundings,
    mass_torque_along,
    moved_by_others,
    needed_nm,
    resting,
    rigid_terms,
    torque_along,
    with_masses,
)
from taccorl.alignment.machines.robot_model import JointFacts, RobotModel, load_robot_model
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.errors import SpecError, TaccorlError, nearest
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.load import Payload
from taccorl.sim.effects.scaled import OF_A_TURN, WAVE_SHARE, Scale, bounded, scaled
from taccorl.sim.settings import check_numbers
from taccorl.sim.twin_file import EffectsDocument, effect_entry

TODO = "TODO"
"""Placeholder for a value that only the user knows; a file that contains it is rejected."""
_GIVES = ("target", "position", "velocity", "acceleration", "effort", "load", "dry_friction")
"""What the model of one joint knows (``Effect.needs``)."""
_STILL = 1e-3  # rad, m: soft joints near the base give way to a wrist that swings, and less than this costs it nothing
_LEAST_REACH_M = 0.05
_ALONG = 0.9999  # least cosine between axes that count as parallel
PAYLOAD_AT = ("x_link6_m", "y_link6_m", "z_link6_m")
"""Parameters of ``payload`` for its place along the axes of its body."""
_SLIDE_WAVES = Scale(unit="m", length=1.0 / WAVE_SHARE)  # bounds of wave numbers are those of a file, in rad/m
_HEADER = "# A robot: taccorl/alignment/machines/robot_file.py says what may stand here.\n"


@dataclass(kw_only=True)
class JointConfig(DriveLaw):
    """Settings of the drive of one joint. Units are for a hinge; for a sliding joint read N for N·m, m for rad, kg for kg·m²."""

    gains: Literal["commanded", "fitted"] = "commanded"
    """commanded: kp and kd are those of the controller. fitted: they are only the start of a fit. With law pwm they are always
    the servo's own, and stall torque and back-EMF are fitted."""
    rotor_inertia: float = 0.0
    """Inertia of the motor's rotor on the motor's side of the gear [kg·m²]."""
    gear: float = 1.0
    """Turns of the motor per turn of the joint; for a sliding joint [rad/m]."""
    loop_hz: float | None = None
    """Rate of the drive's control loop [Hz]."""
    command_hz: float | None = None
    """Rate at which the drive receives targets [Hz], if they are logged at a lower rate: a replay then interpolates the rows
    linearly at this rate. If not given, a target is held until the next row."""
    position_age_s: float = 0.0
    """Age of the measured position when the torque acts, beyond the age that follows from the loop's timing [s]; ``diagnose``
    fits it."""
    effects: list[Effect] = field(default_factory=list)
    """Effects beyond rigid bodies and control law; empty if there are none."""
    FITTED: ClassVar[tuple[str, ...]] = (*DriveLaw.FITTED, "effort_scale", "speed_delay_s", "position_age_s")

    def __post_init__(self) -> None:
        check_numbers("joint", self, positive=("gear",), not_negative=("rotor_inertia",))
        optional = ("loop_hz", "command_hz")
        check_numbers("joint", self, positive=[name for name in optional if getattr(self, name) is not None])
        self.check_law("joint")
        self.check_known("joint", {e.name: [p.name for p in e.parameters()] for e in self.effects})
        if self.law == "pwm" and self.gains == "fitted":
            raise TaccorlError(
                "joint.gains: with law pwm, stall torque and back-EMF are fitted instead of kp and kd; write the servo's own "
                "kp and kd, and `gains: commanded`"
            )

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

    kind: Literal["robot"]
    model: str
    """Path of the MJCF or URDF file, relative to this file."""
    gravity_compensation: float = 0.0
    """Share of the weight that the controller compensates, 0 … 1."""
    gravity: list[float] = field(default_factory=list)
    """Direction of gravity (x, y, z) in the model's frame, of any length, where the base is not mounted as the model has it. The
    controller compensates the weight as the model has it. Empty: as the model has it."""
    joints: dict[str, JointConfig]
    """Name of the joint in the model → its drive."""

    def __post_init__(self) -> None:
        check_numbers("robot", self, not_negative=("gravity_compensation",))
        if self.gravity and (len(self.gravity) != 3 or not math.isfinite(sum(self.gravity)) or not any(self.gravity)):
            raise TaccorlError(f"robot.gravity: is {self.gravity}; give the three numbers x, y, z of a direction")


@dataclass(frozen=True)
class Robot:
    """Machine described by a robot file and its model. ``joint`` returns the data for the one-joint model."""

    config: RobotConfig
    """Content of the file."""
    rigid: RobotModel
    """The model that the file names."""
    path: Path
    """Path of the robot file."""
    assumed: Mapping[int, PointMass] = field(default_factory=dict)
    """Id of a body → payload of which a search assumes the place and fits the mass."""

    @property
    def units(self) -> dict[str, str]:
        """Joint of the model → unit of its position, rad or m. Joints that the file does not name may also be recorded; their
        motion is then known."""
        return {name: facts.unit for name, facts in self.rigid.joints.items()}

    def joint(self, signal: str) -> "RobotJoint":
        """The joint for the one-joint model.

        Raises:
            TaccorlError: the file names no such joint.
        """
        if signal not in self.config.joints:
            raise TaccorlError(f"{self.path}: no joint {signal!r}; {nearest(signal, self.config.joints)}")
        return RobotJoint(self, signal)

    def last_body(self, signal: str) -> int:
        """Id of the body in which the joint's ``payload`` is."""
        return _last_body(self.rigid.model, signal)

    def body_name(self, body: int) -> str:
        """Name of a body in the model; ``body 3`` of one without a name."""
        return self.rigid.model.body(body).name or f"body {body}"

    def moves_body(self, signal: str, body: int) -> bool:
        """True if the joint moves the body with this id."""
        model = self.rigid.model
        own = int(model.joint(signal).bodyid[0])
        while body > own:
            body = int(model.body_parentid[body])
        return body == own

    def along_chain(self, signal: str) -> tuple[str, ...]:
        """Joints whose positions change which weight the joint carries: those behind it, from it to the tip, then those before
        it, from it to the base."""
        bodies = {name: int(self.rigid.model.joint(name).bodyid[0]) for name in self.rigid.joints if name != signal}
        behind = [name for name, body in bodies.items() if self.moves_body(signal, body)]
        own = int(self.rigid.model.joint(signal).bodyid[0])
        before = [name for name in bodies if name not in behind and self.moves_body(name, own)]
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
        return {
            name: self.mass(name, effect)
            for name, joint in self.config.joints.items()
            for effect in joint.effects
            if isinstance(effect, Payload) and not effect.is_absent
        }

    def mass(self, signal: str, payload: Payload) -> PointMass:
        """The mass of a ``payload`` at one joint: its place is in a frame with the axes of the joint's last body, in that body's
        centre of mass."""
        body = self.last_body(signal)
        offset = [getattr(payload, name) for name in PAYLOAD_AT]
        x, y, z = (float(a + b) for a, b in zip(self.rigid.model.body_ipos[body], offset, strict=True))
        return PointMass(payload.mass_kg, body, (x, y, z))

    def mass_twice(self) -> tuple[str, str]:
        """A joint whose payload is in the same body as another one's, and text that says so; ("", "") if there is none."""
        bodies: dict[int, str] = {}
        for name, mass in self.masses().items():
            other = bodies.setdefault(mass.body, name)
            if other != name:
                text = (
                    f"payload of {name}: {other} has one, too, and both are in body {self.body_name(mass.body)}; every joint "
                    "that moves the body feels its mass, so write one payload, at one of these joints"
                )
                return name, text
        return "", ""

    def reach_m(self, signal: str) -> float:
        """Largest distance of a payload from the centre of mass of its body along each axis, for a search [m]: half the length of
        the chain of links from the base, or twice the distance of that centre from its joint, if this is more. A choice."""
        model, body = self.rigid.model, self.last_body(signal)
        from_joint = np.linalg.norm(model.body_ipos[body] - model.jnt_pos[model.body_jntadr[body]])
        chain = float(np.linalg.norm(model.body_ipos[body]))
        while model.body_parentid[body] != 0:
            chain += float(np.linalg.norm(model.body_pos[body]))
            body = int(model.body_parentid[body])
        return max(0.5 * chain, 2.0 * float(from_joint), _LEAST_REACH_M)

    def idle_axes(self, signal: str) -> tuple[int, ...]:
        """Axes 0, 1, 2 of the joint's last body along which the joint does not feel the payload's place: all for a slide; for a
        hinge the one that is parallel to its own, if joints between it and the body are slides or turn about the same axis."""
        model, last, own = self.rigid.model, self.last_body(signal), self.rigid.model.joint(signal).id
        if model.jnt_type[own] == mujoco.mjtJoint.mjJNT_SLIDE:
            return (0, 1, 2)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        body = last
        while body != model.jnt_bodyid[own]:
            for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
                hinge = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
                if hinge and abs(data.xaxis[j] @ data.xaxis[own]) < _ALONG:
                    return ()
            body = int(model.body_parentid[body])
        along = np.abs(data.xmat[last].reshape(3, 3).T @ data.xaxis[own])
        return (int(np.argmax(along)),) if along.max() > _ALONG else ()

    def with_joint(self, signal: str, config: JointConfig) -> "Robot":
        """The robot with another drive at one joint."""
        joints = {name: config if name == signal else own for name, own in self.config.joints.items()}
        return dataclasses.replace(self, config=dataclasses.replace(self.config, joints=joints))

    def text(self, path: Path) -> str:
        """YAML text of the robot file for ``path``, to which the model's path is relative; keys with default values are left
        out."""
        model = self.rigid.path.resolve()
        folder = Path(path).resolve().parent
        content: dict[str, Any] = {"kind": "robot", "model": Path(os.path.relpath(model, folder)).as_posix()}
        content |= _set(self.config, ("gravity_compensation",))
        content |= {"gravity": self.config.gravity} if self.config.gravity else {}
        content["joints"] = {}
        for name, joint in self.config.joints.items():
            names = [f.name for f in dataclasses.fields(JointConfig) if f.name != "effects"]
            content["joints"][name] = _set(joint, names)
            if joint.effects:
                content["joints"][name]["effects"] = [
                    {k: v for k, v in effect_entry(e).items() if k not in ("arm", "joints")} for e in joint.effects
                ]
        return _HEADER + yaml.safe_dump(
            content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120
        )

    def digest(self) -> str:
        """Digest of a robot, 16 hexadecimal digits; equal only if file and model are equal."""
        model = self.rigid.path.read_bytes()
        return hashlib.sha256(self.text(self.path).encode() + model).hexdigest()[:16]


@contextmanager
def under_gravity(model: mujoco.MjModel, gravity_mps2: np.ndarray) -> Iterator[mujoco.MjModel]:
    """Context manager: ``model`` with another gravity ``gravity_mps2`` (3,) [m/s²], in the frame of the world, for a while."""
    own = model.opt.gravity.copy()
    model.opt.gravity[:] = gravity_mps2
    try:
        yield model
    finally:
        model.opt.gravity[:] = own


def _last_body(model: mujoco.MjModel, joint: str) -> int:
    """Id of the most distal body that ``joint`` moves: the one with the most bodies between it and the joint; of several the one
    with the lowest id."""
    far = model.joint(joint).bodyid[0]
    depth = {int(far): 0}
    for body in range(int(far) + 1, model.nbody):
        parent = int(model.body_parentid[body])
        if parent in depth:
            depth[body] = depth[parent] + 1
    return max(depth, key=lambda body: (depth[body], -body))


def _set(config: Any, names: Sequence[str]) -> dict[str, Any]:
    fields = {f.name: f for f in dataclasses.fields(config)}
    return {name: getattr(config, name) for name in names if getattr(config, name) != fields[name].default}


def load_robot(path: Path) -> Robot:
    """Load a robot file and its model.

    Raises:
        SpecError: the file holds ``TODO``, a wrong key or value, or a joint that the model lacks; the message names file and
            line.
        TaccorlError: the model cannot be used (``load_robot_model``).
    """
    path = Path(path)
    _refuse_todo(path)
    document = EffectsDocument(RobotConfig, path)
    config = document.value
    model = path.parent / config.model
    if not model.is_file():
        raise document.error("model", f"no file {config.model!r} beside it; write the path of the MJCF or URDF file")
    rigid = load_robot_model(model, config.gravity_compensation)
    if not config.joints:
        raise document.error("joints", f"the file names no joint; the model has {', '.join(rigid.joints)}")
    for name, joint in config.joints.items():
        if name not in rigid.joints:
            raise document.error(
                f"joints/{name}", f"{config.model} has no joint {name!r}; {nearest(name, rigid.joints)}"
            )
        for k, effect in enumerate(joint.effects):
            key = f"joints/{name}/effects/{k}"
            if not _acts_on_joint(type(effect), weight=True, rotor=True, payload=True):
                raise document.error(key, f"{effect.name} cannot act on one joint of a robot file; remove it")
            if effect.name in OF_A_TURN and rigid.joints[name].unit == "m":
                raise document.error(key, f"{effect.name} repeats with each turn, and {name} is a slide; remove it")
            if not joint.allows_effect(effect.name):
                raise document.error(
                    key, f"{effect.name} acts in a control loop that law {joint.law} does not have; remove it"
                )
            if effect.name in NEED_ROTOR and joint.armature == 0.0:
                raise document.error(
                    key,
                    f"{effect.name} needs the inertia of the motor's rotor: write rotor_inertia (kg·m²) and gear of "
                    f"{name}",
                )
    robot = Robot(config, rigid, path)
    name, why = robot.mass_twice()
    if name:
        raise document.error(f"joints/{name}/effects", why)
    return robot


def _refuse_todo(path: Path) -> None:
    """
    Raises:
        SpecError: names each line that still says ``TODO``, with its comment, which says what to write.
    """
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
            left.append((number, f"{owner}{key.strip()} ({comment.strip() or 'write its value'})"))
    if left:
        words = "; ".join(f"line {number} {what}" for number, what in left)
        raise SpecError(f"{path}:{left[0][0]}: {TODO} must be replaced by a value: {words}")


@cache
def _acts_on_joint(cls: type[Effect], *, weight: bool, rotor: bool, payload: bool) -> bool:
    """True if an effect can act on one joint of a robot file, so that the one-joint model can compute it.

    Args:
        weight: the controller compensates gravity.
        rotor: the rotor's inertia is known.
        payload: no other joint's payload is in the body.
    """
    if cls is Payload:
        return payload
    if "joint" not in cls.kinds() or not cls.works_with((*_GIVES, *["weight"] * weight)):
        return False
    if cls.name in NEED_ROTOR and not rotor:
        return False
    typical = {p.name: p.typical for p in cls.parameters()}
    return bool(make_effect(cls.name, **typical).drive())


class RobotJoint(RigidJoint):
    """One joint of a robot file. A pose holds the model's ``qpos``."""

    effort_holds_weight: ClassVar[bool] = True
    exact_timing: ClassVar[bool] = True
    follows_line: ClassVar[bool] = True

    def __init__(self, robot: Robot, signal: str, masses: Mapping[str, PointMass] | None = None) -> None:
        self._robot, self._config = robot, robot.config.joints[signal]
        self.signal, self.unit = signal, robot.rigid.joints[signal].unit
        self._masses = robot.masses() if masses is None else masses
        self.gains = self._config.following
        self.gain_names, self.target_kind = self._config.gain_names, self._config.target_kind
        self.known_names = self._config.known
        self.command_hz = math.inf if self._config.law == "effort" else self._config.command_hz or 0.0
        # Of a sampled loop the output is held, on average half a period; a difference of two samples is as old again, and so is
        # the output that a row shows before its own target acts. After it acts, the output is new.
        loop_s = 0.0 if self._config.loop_hz is None else 1.0 / self._config.loop_hz
        newer = -1.0 if self._config.effort_after_target else 1.0
        self.facts = self._config.facts | {"effort_age": 0.5 * newer * loop_s}
        # At a slide the weight of an unknown mass is a constant force, too.
        self.holds_torque_ff = self.unit == "m" and robot.last_body(signal) in robot.assumed
        self.position_age_s, self.speed_delay_s = 0.5 * loop_s + self._config.position_age_s, loop_s
        self._mass_torques: dict[tuple[JointMotion, int], MassTorque] = {}

    @property
    def known(self) -> JointFacts:
        """Limits, inertia, damping, friction and actuators of the joint as stated in the MJCF or URDF file."""
        return self._robot.rigid.joints[self.signal]

    def gain_scales(self, m: Measurement) -> tuple[float, float]:
        return self._config.gain_scales(self.signal, m)

    @property
    def winding(self) -> dict[str, float]:
        """Stall torque ``stall_nm`` [N·m] and ``back_emf`` [N·m·s/rad] of law pwm; empty for other laws."""
        c = self._config
        return {"stall_nm": c.stall_nm, "back_emf": c.back_emf} if c.law == "pwm" else {}

    def numbers(self, values: Mapping[str, float]) -> tuple[Gains, dict[str, float]]:
        gains, facts = super().numbers(values)
        if "stall_nm" not in values:
            return gains, facts
        factor = values["stall_nm"] / self._config.stall_nm
        gains = gains._replace(kp=self.gains.kp * factor, kd=self.gains.kd * factor)
        return gains, {"duty_torque": values["stall_nm"], "back_emf": values["back_emf"]}

    def timestep_s(self, motion: JointMotion) -> float:
        inertia = self.known.inertia + self._config.armature
        return self._config.timestep_s(motion.rate_hz, inertia, motion.kp_scale)

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        terms = rigid_terms(self._robot.rigid.model, self.signal, motion.pose)
        terms = terms._replace(inertia=terms.inertia + self._config.armature, rotor_inertia=self._config.armature)
        masses = self._every_mass(bodies)
        terms = with_masses(terms, self._robot.rigid.model, self.signal, motion.pose, masses)
        more = self._robot.more_gravity
        if not more.any():
            return terms
        with under_gravity(self._robot.rigid.model, more) as model:  # the weight is linear in gravity
            extra = with_masses(rigid_terms(model, self.signal, motion.pose), model, self.signal, motion.pose, masses)
        return terms._replace(
            gravity_sin=terms.gravity_sin + extra.gravity_sin,
            gravity_cos=terms.gravity_cos + extra.gravity_cos,
            weight_n=terms.weight_n + extra.weight_n,
        )

    def _every_mass(self, bodies: Sequence[Effect]) -> list[PointMass]:
        """Point masses that the model file lacks: payloads that the robot file states at other joints, and the payloads among
        ``bodies``."""
        masses = [mass for name, mass in self._masses.items() if name != self.signal]
        return masses + [self._robot.mass(self.signal, effect) for effect in bodies if isinstance(effect, Payload)]

    def moving_masses_nm(self, motion: JointMotion, bodies: Sequence[Effect]) -> np.ndarray | float:
        if motion.positions is None:
            return 0.0
        return sum(self._mass_torque(motion, one.body).of(one) for one in self._every_mass(bodies))

    def _mass_torque(self, motion: JointMotion, body: int) -> MassTorque:
        """Torque for masses in one body because other joints move; kept, since a search changes masses only."""
        if (motion, body) not in self._mass_torques:
            assert motion.positions is not None
            gravity = self._robot.rigid.model.opt.gravity + self._robot.more_gravity
            whole, alone = (
                mass_torque_along(self._robot.rigid.model, self.signal, body, q, 1.0 / motion.rate_hz, gravity)
                for q in (motion.positions, self._alone(motion.positions, motion.pose))
            )
            self._mass_torques[motion, body] = MassTorque(*(a - b for a, b in zip(whole, alone, strict=True)))
        return self._mass_torques[motion, body]

    def _alone(self, positions: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(T, nq) ``positions`` of this joint, with the others at ``pose`` (nq,)."""
        address = self._robot.rigid.model.joint(self.signal).qposadr[0]
        own = np.tile(pose, (len(positions), 1))
        own[:, address] = positions[:, address]
        return own

    def _positions(self, m: Measurement) -> np.ndarray | None:
        """(T, nq) low-pass filtered positions of all joints [rad, m]; None if no other joint moves."""
        angles = moved_by_others(m, self.signal, list(self._robot.rigid.joints), _STILL)
        if len(angles) == 1:
            return None
        q = np.tile(self.pose(m), (m.num_rows, 1))
        for name, values in angles.items():
            q[:, self._robot.rigid.model.joint(name).qposadr[0]] = values
        return q

    def pose(self, m: Measurement) -> np.ndarray:
        """(nq,) positions of all joints of the model at the beginning of a recording [rad, m]; as the model has them where the
        recording does not."""
        model = self._robot.rigid.model
        pose = model.qpos0.copy()
        for name in self._robot.rigid.joints:
            if name in m.signals:
                pose[model.joint(name).qposadr[0]] = resting(m, m.column(name))
        return pose

    def surroundings(self, m: Measurement) -> Surroundings:
        if any(kg > 0 for kg in m.payload_kg.values()):
            raise TaccorlError(
                f"{m.name}: payload_kg applies to the PiPER's hands only; write a second model file with the mass fixed to its "
                "link, and a robot file for it"
            )
        pose, positions = self.pose(m), self._positions(m)
        coupling, carrying = self._coupling(m, pose, positions)
        coupling = coupling - m.known_load(self.signal)
        j = m.column(self.signal)
        on, added = (values[:, j] if values.size else None for values in (m.enabled, m.torque_ff))
        return Surroundings(
            coupling_nm=coupling,
            carrying_nm=carrying,
            pose=pose,
            positions=positions,
            supply=self._config.supply(self.signal, m),
            on=on,
            torque_ff_nm=added,
        )

    def whole(self, m: Measurement) -> Measurement:
        """The recording extended to all joints of the model, with the file's gains if they are commanded and the recording
        states none.

        Raises:
            TaccorlError: the model lacks a signal, or has it in another unit.
        """
        names, units = tuple(self._robot.units), tuple(self._robot.units.values())
        for name, unit in zip(m.signals, m.units, strict=True):
            if name not in names:
                model = self._robot.rigid.path.name
                raise TaccorlError(
                    f"{m.name}: {model} has no joint {name!r} ({nearest(name, names)}). Rename the columns of the recording"
                )
            if unit != self._robot.units[name]:
                raise TaccorlError(f"{m.name}: {name} is in {unit}, the model's is in {self._robot.units[name]}")
            for key in ("lever_m", "arm_kg"):
                if name in getattr(m, key):
                    raise TaccorlError(
                        f"{m.name}: {key} of {name} is stated, which is supported for axis files only; remove it from "
                        "measurements.yaml, and fix the mass to its link in the model"
                    )
            if m.enabled.size and not m.enabled[:, m.column(name)].all() and self._robot.config.gravity_compensation:
                row = int(np.argmin(m.enabled[:, m.column(name)]))
                raise TaccorlError(
                    f"{m.name}: the motor of {name} is off at {m.time_s[row]:.3f} s, but according to the robot file the "
                    "controller compensates the weight; cut the recording there"
                )
        stated: dict[str, dict[str, float]] = {"kp": dict(m.kp), "kd": dict(m.kd)}
        for name, joint in self._robot.config.joints.items():
            if joint.gains == "commanded":
                for key in joint.gain_names:
                    stated[key].setdefault(name, m.gain_scale.get(name, 1.0) * getattr(joint, key))
        m = dataclasses.replace(m, kp=stated["kp"], kd=stated["kd"])
        if m.signals == names:
            return m
        kinds = tuple(m.target_kind(name) if name in m.signals else "position" for name in names)
        absent = {"load": 0.0, "torque_ff": 0.0, "supply_v": np.nan, "enabled": 1.0}
        arrays: dict[str, np.ndarray] = {
            name: np.full((m.num_rows, len(names)), absent.get(name, np.nan))
            for name in ("measured", "velocity", "effort", *m.extra_columns)
        }
        model = self._robot.rigid.model
        rest = [model.qpos0[model.joint(name).qposadr[0]] for name in names]
        arrays["target"] = np.tile(rest, (m.num_rows, 1))
        quantum = np.zeros(len(names))
        for j, name in enumerate(names):
            if name in m.signals:
                quantum[j] = m.quantum[m.column(name)]
                for key, values in arrays.items():
                    values[:, j] = getattr(m, key)[:, m.column(name)]
        return dataclasses.replace(m, **arrays, quantum=quantum, signals=names, units=units, target_kinds=kinds)

    def effects(self, more: Sequence[Effect]) -> list[Effect]:
        names = {effect.name for effect in more}
        every = [*(e for e in self._config.effects if e.name not in names), *more]
        return [effect for effect in every if not effect.is_absent]

    def freed(self, held: Collection[str] = ()) -> "tuple[list[Effect], RobotJoint]":
        own = [e for e in self._config.effects if e.fitted and e.name not in held]
        bare = dataclasses.replace(self._config, effects=[e for e in self._config.effects if e not in own], known=())
        return own, RobotJoint(self._robot.with_joint(self.signal, bare), self.signal, self._masses)

    def in_units(self, cls: type[Effect]) -> type[Effect]:
        if cls is Payload:
            return self._payload()
        if self.unit == "rad":
            return cls
        return scaled(cls.name, _SLIDE_WAVES if cls.name == "cogging" else Scale(unit="m"))

    def _payload(self) -> type[Effect]:
        """``payload`` with bounds for this robot's size."""
        far = self._robot.reach_m(self.signal)
        return bounded("payload", tuple((name, -far, far) for name in PAYLOAD_AT))

    def selectors(self, cls: type[Effect]) -> Mapping[str, Any] | None:
        if self.unit == "m" and cls.name in OF_A_TURN:
            return None
        last = self._robot.last_body(self.signal)
        facts = {
            "weight": self._robot.config.gravity_compensation > 0,
            "rotor": self._config.armature > 0,
            "payload": last not in [mass.body for name, mass in self._masses.items() if name != self.signal],
        }
        if not (_acts_on_joint(cls, **facts) and self._config.allows_effect(cls.name)):
            return None
        return self._idle_place() if cls is Payload else {}

    def _idle_place(self) -> dict[str, float]:
        """Payload's place along the axes along which the joint does not feel it, or at all where it is assumed: as the file
        has it, else in the centre of mass of its body."""
        robot, last = self._robot, self._robot.last_body(self.signal)
        known = robot.assumed.get(last, self._masses.get(self.signal))
        at = np.zeros(3) if known is None else np.subtract(known.place_m, robot.rigid.model.body_ipos[last])
        axes = (0, 1, 2) if last in robot.assumed else robot.idle_axes(self.signal)
        return {PAYLOAD_AT[axis]: float(at[axis]) for axis in axes}

    def _more_weight(self, positions: np.ndarray) -> np.ndarray:
        """(T,) torque [N·m, N] that holds the weight by which gravity differs from the model's, at ``positions`` (T, nq)."""
        more, still = self._robot.more_gravity, np.zeros((len(positions), self._robot.rigid.model.nv))
        if not more.any():
            return np.zeros(len(positions))
        with under_gravity(self._robot.rigid.model, more) as model:
            return needed_nm(model, self.signal, positions, still, still)[0]

    def _coupling(
        self, m: Measurement, pose: np.ndarray, positions: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """(T,) torque because other joints move, without payloads (``moving_masses_nm``); of a sliding joint the model's weight
        as well, which does not change as it slides. And (T,) the part of it that the gravity compensation supplies."""
        model, joint = self._robot.rigid.model, self._robot.rigid.model.joint(self.signal)
        slide = model.jnt_type[joint.id] == mujoco.mjtJoint.mjJNT_SLIDE
        needed, carried = np.zeros(m.num_rows), np.zeros(m.num_rows)
        if slide:
            still = np.zeros((1, model.nv))
            at_rest = needed_nm(model, self.signal, pose[None], still, still)
            needed, carried = needed + at_rest[0] + self._more_weight(pose[None]), carried + at_rest[1]
        if positions is None:
            return needed, carried
        for sign, q in ((1.0, positions), (-1.0, self._alone(positions, pose))):
            along = torque_along(model, self.signal, q, m.period_s)
            needed, carried = needed + sign * (along[0] + self._more_weight(q)), carried + sign * along[1]
        return needed, carried
