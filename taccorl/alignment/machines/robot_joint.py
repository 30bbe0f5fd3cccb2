"""One joint of a robot file for the one-joint model: its drive, weight, payloads, and what the motion of other joints adds."""

import copy
import dataclasses
import hashlib
import math
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from taccorl.alignment.controller.drive_law import with_gains
from taccorl.alignment.controller.joint_model import GRAVITY_M_PER_S2, JointModel
from taccorl.alignment.controller.joint_motion import (
    JointMotion,
    Surroundings,
    beside_model,
    moved_by_others,
    resting,
)
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.controller.rigid_joint import (
    NEED_ROTOR,
    Gains,
    MassTorque,
    PointMass,
    Rigid,
    RigidJoint,
    mass_torque_along,
    masses_along,
    rates,
    rigid_terms,
    torque_along,
    with_masses,
)
from taccorl.alignment.machines.robot_model import JointFacts
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import Effect, number
from taccorl.sim.effects.load import Payload
from taccorl.sim.effects.scaled import OF_A_TURN, Scale, bounded, scaled

if TYPE_CHECKING:  # which makes the joints
    from taccorl.alignment.machines.robot_file import JointConfig, Robot

_GIVES = (
    "target",
    "position",
    "velocity",
    "acceleration",
    "effort",
    "load",
    "dry_friction",
)
"""Words of ``Effect.needs`` for what the one-joint model can compute: an effect that needs another one cannot act in it."""
MOST_KEPT, MOST_NUMBERS = 1_000_000, 50_000_000
"""Largest number of positions in ``KeptMotions``, and of entries of mass matrices."""
FORCE_OF_MASS = 0.1
"""Force unit of a slide without ``effort_limit`` over its mass [N/kg]. A choice: dry
friction is searched up to 20 times this, a friction coefficient of 0.2."""
PAYLOAD_AT = (
    "x_m",
    "y_m",
    "z_m",
)  # Parameters of ``payload`` for its place along the axes of its body


MOST_TILT = (-0.2, 0.2)
"""Change of the direction of gravity that a fit tries along each axis [rad], 11° (a choice)."""


@dataclass(kw_only=True)
class TiltedBase(Effect):
    """Change of the unit vector along gravity in the frame of a robot's model: number
    ``gravity`` of its file, which every hinge shares. No file has it as an effect."""

    name: ClassVar = "gravity"
    slot: ClassVar = "body"
    x: float = number("g_x", "1", 0, 0.01, MOST_TILT)
    y: float = number("g_y", "1", 0, 0.01, MOST_TILT)
    z: float = number("g_z", "1", 0, 0.01, MOST_TILT)

    def tilted(self, gravity: np.ndarray) -> np.ndarray:
        """(3,) gravity of the same size in the changed direction."""
        size = np.linalg.norm(gravity)
        direction = gravity / size + (self.x, self.y, self.z)
        return size * direction / np.linalg.norm(direction)


def under_gravity(model: mujoco.MjModel, gravity_mps2: np.ndarray) -> mujoco.MjModel:
    """Copy of ``model`` with gravity ``gravity_mps2`` (3,) [m/s²] in the world frame."""
    return _copy_under_gravity(model, np.asarray(gravity_mps2, float).tobytes())


@lru_cache(maxsize=64)  # a search asks for the same few thousands of times
def _copy_under_gravity(model: mujoco.MjModel, gravity_mps2: bytes) -> mujoco.MjModel:
    copied = copy.copy(model)
    copied.opt.gravity[:] = np.frombuffer(gravity_mps2)
    return copied


@cache
def acts_on_joint(
    cls: type[Effect], *, weight: bool, rotor: bool, payload: bool
) -> bool:
    """True if an effect can act on one joint of a robot file, whose ``weight`` is compensated, of whose ``rotor`` the inertia is
    known, and in whose body no other joint's ``payload`` is, so that the one-joint model can compute it."""
    if cls is Payload:
        return payload
    if "joint" not in cls.kinds() or not cls.works_with(
        (*_GIVES, *["weight"] * weight)
    ):
        return False
    if cls.name in NEED_ROTOR and not rotor:
        return False
    return bool(
        make_effect(cls.name, **{p.name: p.typical for p in cls.parameters()}).drive()
    )


class RobotJoint(RigidJoint):
    """One joint of a robot file. A pose holds the model's ``qpos``."""

    effort_holds_weight: ClassVar[bool] = True
    exact_timing: ClassVar[bool] = True
    keeps_times: ClassVar[bool] = True

    def __init__(
        self,
        robot: "Robot",
        signal: str,
        masses: Mapping[str, PointMass] | None = None,
        stated: "Robot | None" = None,
        along: "Along | None" = None,
    ) -> None:
        self._robot, self.signal = robot, signal
        self._use(law := robot.config.joints[signal])
        self._stated_loop_hz = law.loop_hz
        self._stated, self._along = robot if stated is None else stated, along
        self._masses = robot.masses() if masses is None else masses
        own = self._masses.get(signal)
        self._payload_in = robot.last_body(signal) if own is None else own.body
        self.scale = self._scale()
        self.wave = self.scale.wave
        self._mass_torques: dict[tuple[JointMotion, int], MassTorque] = {}
        self._weight_levers: dict[JointMotion, np.ndarray] = {}
        self._unloaded: dict[bytes, Rigid] = {}

    def _use(self, config: "JointConfig") -> None:
        """Take the numbers of the drive from ``config``."""
        self._config = config
        self.unit = self._robot.rigid.joints[self.signal].unit
        self.gains, self.gain_names = config.following, config.gain_names
        self.target_kind, self.known_names = config.target_kind, config.known
        is_effort = config.law == "effort"
        self.command_hz = math.inf if is_effort else config.command_hz or 0.0
        # Of a sampled loop the output is held, on average half a period; a difference of
        # two samples is as old again, and so is the output that a row shows before its own
        # target acts. After it acts, the output is new.
        loop_s = self.loop_s = 1.0 / config.loop_hz if config.loop_hz else 0.0
        age_s = (-0.5 if config.effort_after_target else 0.5) * loop_s
        self.facts = config.facts | {"effort_age": age_s}
        self.stated_age_s = config.position_age_s
        self.position_age_s = 0.5 * loop_s + config.position_age_s
        self.speed_delay_s = loop_s
        self.target_late_s = config.target_late_s
        if not self.has_model:
            late_s = config.speed_late_s if config.loop_hz and config.kd else 0.0
            late = {"speed_age": loop_s, "speed_delay__delay_s": late_s}
            self.facts = {**self.facts, **late}
            self.speed_delay_s = loop_s + late_s if config.kd else 0.0

    @property
    def config(self) -> "JointConfig":
        """Numbers of the drive: those of the file, or of ``with_values``."""
        return self._config

    @property
    def has_model(self) -> bool:
        """Whether a model has inertia and weight; else the file has, and fits them."""
        return bool(self._robot.config.model)

    def with_values(self, values: Mapping[str, float]) -> "RobotJoint":
        if self.has_model:
            return self
        fitted = copy.copy(self)
        fitted._use(self._config.with_numbers(values))
        return fitted

    @property
    def known(self) -> JointFacts:
        """Limits, inertia, damping, friction and actuators of the joint as stated in the MJCF or URDF file."""
        return self._robot.rigid.joints[self.signal]

    @property
    def winding(self) -> dict[str, float]:
        """Stall torque ``stall_nm`` [N·m] and ``back_emf`` [N·m·s/rad] of law pwm; empty for other laws."""
        c = self._config
        return (
            {"stall_nm": c.stall_nm, "back_emf": c.back_emf} if c.law == "pwm" else {}
        )

    def numbers(self, values: Mapping[str, float]) -> tuple[Gains, dict[str, float]]:
        if not self.has_model:  # ``with_values`` has them all
            return self.gains, {}
        gains, facts = super().numbers(values)
        if "stall_nm" not in values:
            return gains, facts
        factor = values["stall_nm"] / self._config.stall_nm
        gains = gains._replace(kp=self.gains.kp * factor, kd=self.gains.kd * factor)
        return gains, {
            "duty_torque": values["stall_nm"],
            "back_emf": values["back_emf"],
        }

    def gain_scales(self, m: Measurement) -> tuple[float, float]:
        return self._config.gain_scales(self.signal, m)

    def timestep_s(self, motion: JointMotion) -> float:
        c = self._config
        inertia = c.inertia or self.known.inertia + c.armature
        loop_hz = self._stated_loop_hz
        return c.timestep_s(motion.rate_hz, inertia, motion.kp_scale, loop_hz)

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        if self._config.inertia is not None:
            return self._stated_rigid(motion, self._config.inertia)
        masses, more = self._every_mass(bodies), self._more_gravity(bodies)
        terms = self._terms(motion.pose, masses, more)
        # A mass below 0 that a search tries far from its body's centre would leave the
        # joint no inertia: a hundredth stays, a choice.
        least = 0.01 * self.known.inertia
        inertia = max(terms.inertia, least) + self._config.armature
        return terms._replace(
            inertia=inertia,
            rotor_inertia=self._config.armature,
            free_inertia=max(self._free_inertia(masses), least),
        )

    @cached_property
    def _at_zero(self) -> tuple[mujoco.MjData, np.ndarray]:
        """The model at its zero pose, and its mass matrix (nv, nv) there with rotors."""
        model = self._robot.rigid.model
        data, mass = mujoco.MjData(model), np.empty((model.nv, model.nv))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        for name, joint in self._robot.config.joints.items():
            dof = model.joint(name).dofadr[0]
            mass[dof, dof] += joint.armature
        return data, mass

    def _free_inertia(self, masses: Sequence[PointMass]) -> float:
        """``Rigid.free_inertia`` with point masses."""
        model, (data, empty) = self._robot.rigid.model, self._at_zero
        mass = empty.copy()

        def lever(one: PointMass, by: np.ndarray) -> np.ndarray:
            """(3, nv) Jacobian of a point beside the mass, by so much in its body's frame."""
            jac = np.empty((3, model.nv))
            turn = data.xmat[one.body].reshape(3, 3)
            at = data.xpos[one.body] + turn @ (one.place_m + by)
            mujoco.mj_jac(model, data, jac, None, at, one.body)
            return jac

        for one in masses:
            there = lever(one, np.zeros(3))
            beside = np.array([lever(one, axis) - there for axis in np.eye(3)])
            spread = np.einsum("kl,kxi,lxj->ij", one.spread_m2, beside, beside)
            mass += one.mass_kg * (there.T @ there + spread)
        own = model.joint(self.signal).dofadr[0]
        return float(1.0 / np.linalg.inv(mass)[own, own])

    def _stated_rigid(self, motion: JointMotion, inertia: float) -> Rigid:
        c = self._config
        inertia += motion.mounted_kgm2
        if self.unit == "m":
            return Rigid(inertia, c.armature, weight_n=c.weight_cos)
        weight = motion.moment_kgm * GRAVITY_M_PER_S2  # m l g sin(q − q₀)
        sine = c.weight_sin + weight * math.cos(c.hangs_at_rad)
        cosine = c.weight_cos - weight * math.sin(c.hangs_at_rad)
        return Rigid(inertia, c.armature, sine, cosine)

    def inertia_kgm2(self, m: Measurement) -> float:
        """Inertia [kg·m²] of the joint in the pose in which a recording begins, with the payloads and the rotor of the file."""
        if self._config.inertia is not None:
            return self._config.inertia + self.surroundings(m).mounted_kgm2
        return (
            self._terms(self.pose(m), self._every_mass(self.effects(()))).inertia
            + self._config.armature
        )

    def _more_gravity(self, bodies: Sequence[Effect]) -> np.ndarray:
        """(3,) gravity of the file and of a ``TiltedBase`` less the model's [m/s²]."""
        more = self._robot.more_gravity
        for effect in bodies:
            if isinstance(effect, TiltedBase):
                gravity = self._robot.rigid.model.opt.gravity
                more = effect.tilted(gravity + more) - gravity
        return more

    def _terms(
        self,
        pose: np.ndarray,
        masses: Sequence[PointMass] = (),
        more: np.ndarray | None = None,
    ) -> Rigid:
        """``Rigid`` at ``pose`` (nq,), with point masses and without a rotor. ``more``: (3,)
        gravity less the model's [m/s²]; by default that of the file."""
        model = self._robot.rigid.model
        more = self._robot.more_gravity if more is None else more
        if (key := pose.tobytes()) not in self._unloaded:
            self._unloaded[key] = rigid_terms(model, self.signal, pose)
        terms = with_masses(self._unloaded[key], model, self.signal, pose, masses)
        if not more.any():
            return terms
        leaned = under_gravity(model, more)  # the weight is linear in gravity
        extra = with_masses(
            rigid_terms(leaned, self.signal, pose), leaned, self.signal, pose, masses
        )
        names = ("gravity_sin", "gravity_cos", "weight_n")
        return terms._replace(
            **{name: getattr(terms, name) + getattr(extra, name) for name in names}
        )

    def _every_mass(self, bodies: Sequence[Effect]) -> list[PointMass]:
        """Point masses that the model file lacks: payloads of the robot file at other joints, and those of ``bodies``."""
        masses = [mass for name, mass in self._masses.items() if name != self.signal]
        return masses + [
            self._robot.mass(self.signal, effect)
            for effect in bodies
            if isinstance(effect, Payload)
        ]

    def moving_masses_nm(
        self, motion: JointMotion, bodies: Sequence[Effect]
    ) -> np.ndarray | float:
        if motion.positions is None:
            return 0.0
        torque = sum(
            self._mass_torque(motion, one.body).of(one)
            for one in self._every_mass(bodies)
        )
        by = self._more_gravity(bodies) - self._robot.more_gravity
        return torque + self._moving_weight(motion) @ by if by.any() else torque

    def _moving_weight(self, motion: JointMotion) -> np.ndarray:
        """(T, 3) torque that holds the weight of a hinge because other joints move, for
        each component of gravity [N·m·s²/m]; kept, since a search changes gravity only."""
        if motion not in self._weight_levers:
            model, q = self._robot.rigid.model, motion.positions
            assert q is not None
            data, joint = mujoco.MjData(model), model.joint(self.signal)
            body, levers = joint.bodyid[0], np.empty((len(q), 3))
            for row, positions in enumerate(q):
                data.qpos[:] = positions
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                off_axis = data.subtree_com[body] - data.xanchor[joint.id]
                levers[row] = -np.cross(data.xaxis[joint.id], off_axis)
            own = q[:, joint.qposadr[0]]
            for k, axis in enumerate(np.eye(3)):
                alone = rigid_terms(
                    under_gravity(model, axis), self.signal, motion.pose
                )
                levers[:, k] *= model.body_subtreemass[body]
                levers[:, k] -= alone.gravity_sin * np.sin(own)
                levers[:, k] -= alone.gravity_cos * np.cos(own)
            self._weight_levers[motion] = levers
        return self._weight_levers[motion]

    def _mass_torque(self, motion: JointMotion, body: int) -> MassTorque:
        """Torque for masses in one body because other joints move; kept, since a search changes masses only."""
        if (motion, body) not in self._mass_torques:
            model, q = self._robot.rigid.model, motion.positions
            assert q is not None
            gravity = model.opt.gravity + self._robot.more_gravity
            period_s, alone = (
                len(motion.target) / len(q) / motion.rate_hz,
                np.tile(motion.pose, (len(q), 1)),
            )
            own = model.joint(self.signal).qposadr[0]
            alone[:, own] = q[:, own]
            whole, alone = (
                mass_torque_along(model, self.signal, body, at, period_s, gravity)
                for at in (q, alone)
            )
            self._mass_torques[motion, body] = MassTorque(
                *(a - b for a, b in zip(whole, alone, strict=True))
            )
        return self._mass_torques[motion, body]

    def pose(self, m: Measurement) -> np.ndarray:
        """(nq,) positions of all joints at the beginning of a recording [rad, m]; where it has none, those of the model."""
        model = self._robot.rigid.model
        pose = model.qpos0.copy()
        for name in self._robot.rigid.joints:
            if name in m.signals:
                pose[model.joint(name).qposadr[0]] = resting(m, m.column(name))
        return pose

    def surroundings(self, m: Measurement) -> Surroundings:
        """Raises TaccorlError: a payload is stated at a joint of a model, or without its
        lever at one without."""
        if not self.has_model:
            return self._mounted(m)
        if any(kg > 0 for kg in m.payload_kg.values()):
            raise TaccorlError(
                f"{m.name}: payload_kg applies to the PiPER's hands only; write a second model file with the mass fixed to its "
                "link, and a robot file for it"
            )
        pose, along = self.pose(m), self._along or moved_together(self._stated, m)
        coupling, carrying = self._coupling(m, pose, along)
        rows = np.arange(len(coupling)) * m.num_rows / len(coupling)
        drive = self._drive(m)
        coupling = coupling + np.interp(rows, np.arange(m.num_rows), drive.coupling_nm)
        positions = None if along is None else along.positions
        return dataclasses.replace(
            drive,
            coupling_nm=coupling,
            carrying_nm=carrying,
            pose=pose,
            positions=positions,
        )

    def _drive(self, m: Measurement) -> Surroundings:
        """What the recording states of the drive: known load, added torque, the motor's
        supply, and whether it is on. Raises TaccorlError: there is a supply voltage that
        the law does not use."""
        j = m.column(self.signal)
        return Surroundings(
            coupling_nm=-m.known_load(self.signal),
            supply=self._config.supply(self.signal, m),
            on=m.enabled[:, j] if m.enabled.size else None,
            torque_ff_nm=m.torque_ff[:, j] if m.torque_ff.size else None,
        )

    def _mounted(self, m: Measurement) -> Surroundings:
        """With the masses that the file or the recording mounts on a joint without model:
        the inertia m l² and the weight m g l sin(q − q₀), and those of the arm."""
        c, name = self._config, self.signal
        payload, lever, arm = (
            getattr(m, key).get(name, getattr(c, key))
            for key in ("payload_kg", "lever_m", "arm_kg")
        )
        if self.unit == "m" and (lever or arm):
            raise TaccorlError(
                f"{m.name}: lever_m or arm_kg of {name} is stated, but a slide has no lever; remove it"
            )
        if self.unit == "rad" and payload + arm > 0.0 and lever == 0.0:
            raise TaccorlError(
                f"{m.name}: payload_kg or arm_kg of {name} is stated, but the length of its lever is not; write `lever_m: …` "
                f"in its file, or `lever_m: {{{name}: …}}` in measurements.yaml"
            )
        mounted = payload
        if self.unit == "rad":
            mounted = payload * lever**2 + arm * lever**2 / 3.0
        return dataclasses.replace(
            self._drive(m),
            payload_kg=payload,
            payload_at_known=True,
            moment_kgm=payload * lever + 0.5 * arm * lever,
            mounted_kgm2=mounted,
        )

    def whole(self, m: Measurement) -> Measurement:
        """The recording extended to all joints of the model, with the file's gains if they are commanded and the recording states
        none. Raises TaccorlError: the model lacks a signal, or has it in another unit."""
        names = tuple(self._robot.units)
        if not self.has_model:
            own = [name for name in names if name in m.signals]
            if not own:
                raise TaccorlError(
                    f"{m.name} has no signal {names[0]!r}, which its file names; {nearest(names[0], m.signals)}"
                )
            m = m.only(own)
        for name, unit in zip(m.signals, m.units, strict=True):
            if name not in names:
                model = self._robot.rigid.path.name
                raise TaccorlError(
                    f"{m.name}: {model} has no joint {name!r} ({nearest(name, names)}). Rename the columns of the recording"
                )
            if unit != self._robot.units[name]:
                raise TaccorlError(
                    f"{m.name}: {name} is in {unit}, its file states {self._robot.units[name]}"
                )
            for key in ("lever_m", "arm_kg"):
                if self.has_model and name in getattr(m, key):
                    raise TaccorlError(
                        f"{m.name}: {key} of {name} is stated, which is for joints without a model; remove it from "
                        "measurements.yaml, and fix the mass to its link in the model"
                    )
            if (
                m.enabled.size
                and not m.enabled[:, m.column(name)].all()
                and self._robot.config.gravity_compensation
            ):
                row = int(np.argmin(m.enabled[:, m.column(name)]))
                raise TaccorlError(
                    f"{m.name}: the motor of {name} is off at {m.time_s[row]:.3f} s, but according to the robot file the "
                    "controller compensates the weight; cut the recording there"
                )
        m = with_gains(
            m,
            {
                n: joint
                for n, joint in self._robot.config.joints.items()
                if joint.gains == "commanded"
            },
        )
        if m.signals == names:
            return m
        model = self._robot.rigid.model
        return m.extended(
            self._robot.units,
            [model.qpos0[model.joint(name).qposadr[0]] for name in names],
        )

    def effects(self, more: Sequence[Effect]) -> list[Effect]:
        names = {effect.name for effect in more}
        every = [*(e for e in self._config.effects if e.name not in names), *more]
        return [effect for effect in every if not effect.is_absent]

    def freed(self, held: Collection[str] = ()) -> "tuple[list[Effect], RobotJoint]":
        own = [e for e in self._config.effects if e.fitted and e.name not in held]
        bare = dataclasses.replace(
            self._config,
            effects=[e for e in self._config.effects if e not in own],
            known=(),
        )
        return own, RobotJoint(
            self._robot.with_joint(self.signal, bare),
            self.signal,
            self._masses,
            self._stated,
        )

    def in_units(self, cls: type[Effect]) -> type[Effect]:
        if cls is Payload:  # bounds for this robot's size
            far, most = (
                self._robot.reach_m(self.signal),
                next(p.high for p in cls.parameters() if p.name == "mass_kg"),
            )
            mass = (
                "mass_kg",
                -min(self._robot.removable_kg(self._payload_in), most),
                most,
            )
            return bounded(
                "payload", (mass, *((name, -far, far) for name in PAYLOAD_AT))
            )
        return scaled(cls.name, self.scale)

    def made(self, name: str, /, **values: Any) -> Effect:
        """The effect of that name as a file may state it, in the units of the joint.
        Raises TaccorlError: an effect or parameter is unknown, or out of bounds."""
        cls = effects.get(name)
        for key in values:
            if key not in (known := cls.settings()):
                raise TaccorlError(
                    f"effect {name}: no parameter {key!r}; {nearest(key, known)}"
                )
        return self.in_units(cls)(**values)

    def _scale(self) -> Scale:
        """Size of the joint's forces and motions relative to a joint of a small arm, by
        which bounds of effects are multiplied: the file's ``force_unit_n`` and
        ``length_unit_m``. Defaults: 1 of a hinge of a model; else a tenth of
        ``effort_limit``, or of a slide ``FORCE_OF_MASS`` times its mass, and its stroke.
        The stroke of a slide of a model counts up to 1 m: its damping and drag are those
        of the model, and bounds fall with the length."""
        c, known = self._config, self.known
        force, length, drive = 1.0, 1.0, 0.0
        if self.unit == "m":
            force = max(1.0, FORCE_OF_MASS * known.inertia)
            if known.limits is not None:
                length = known.limits[1] - known.limits[0]
            if self.has_model:
                length = min(length, 1.0)
        if self.unit == "m" or not self.has_model:
            if c.effort_limit is not None:
                force = 0.1 * c.effort_limit
            if c.law != "effort" and c.loop_gains.kp > 0.0:
                drive = 1.0 / c.loop_gains.kp
        return Scale(
            unit=self.unit,
            force=c.force_unit_n or force,
            length=c.length_unit_m or length,
            drive=drive,
        )

    def selectors(self, cls: type[Effect]) -> Mapping[str, Any] | None:
        if self.unit == "m" and cls.name in OF_A_TURN:
            return None
        if cls is Payload and not self.has_model:
            return None
        facts = {
            "weight": self._robot.config.gravity_compensation > 0,
            "rotor": self._config.armature > 0,
            "payload": self._payload_in
            not in [m.body for name, m in self._masses.items() if name != self.signal],
        }
        if not (acts_on_joint(cls, **facts) and self._config.allows_effect(cls.name)):
            return None
        return self._idle_place() if cls is Payload else {}

    def _idle_place(self) -> dict[str, Any]:
        """Payload's link, and its place along the axes along which the joint does not feel it: as the file has it, else in the
        centre of mass of its body."""
        robot, last = self._robot, self._payload_in
        known = self._masses.get(self.signal)
        at = (
            np.zeros(3)
            if known is None
            else np.subtract(known.place_m, robot.rigid.model.body_ipos[last])
        )
        spread = known is not None and known.spread_m2.any()
        axes = (0, 1, 2) if spread else robot.idle_axes(self.signal, last)
        link = (
            {"link": robot.body_name(last)}
            if spread or last != robot.last_body(self.signal)
            else {}
        )
        return (
            link
            | ({"like_link": True} if spread else {})
            | {PAYLOAD_AT[axis]: float(at[axis]) for axis in axes}
        )

    def _coupling(
        self, m: Measurement, pose: np.ndarray, along: "Along | None"
    ) -> tuple[np.ndarray, np.ndarray]:
        """(T · F,) torque because other joints move, without payloads (``moving_masses_nm``); of a sliding joint the model's
        weight as well, which does not change as it slides. And (T · F,) the part of it that the gravity compensation supplies."""
        model, joint = (
            self._robot.rigid.model,
            self._robot.rigid.model.joint(self.signal),
        )
        slide, dof = (
            model.jnt_type[joint.id] == mujoco.mjtJoint.mjJNT_SLIDE,
            joint.dofadr[0],
        )
        if along is None or along.moving <= {self.signal}:
            rest = needed_along(self._robot, np.tile(pose, (2, 1)), 1.0)
            needed, carried = (
                np.full(m.num_rows, values[0, dof] if slide else 0.0) for values in rest
            )
            return needed, carried
        terms, q = self._terms(pose), along.positions[:, joint.qposadr[0]]
        acceleration = rates(q, m.period_s * m.num_rows / len(q))[1]
        needed, carried = (
            along.needed[:, dof] - terms.inertia * acceleration,
            along.carried[:, dof],
        )
        if not slide:
            needed = (
                needed - terms.gravity_sin * np.sin(q) - terms.gravity_cos * np.cos(q)
            )
            carried = (
                carried
                - terms.compensation_sin * np.sin(q)
                - terms.compensation_cos * np.cos(q)
            )
        return needed, carried


class Along(NamedTuple):
    """Motion of all joints in one recording."""

    moving: frozenset[str]  # Joints that move
    positions: np.ndarray  # (T · F, nq) positions [rad, m]
    needed: (
        np.ndarray
    )  # (T · F, nv) torques that they need, without payloads and armature [N·m, N]
    carried: (
        np.ndarray
    )  # (T · F, nv) the part of them that the gravity compensation supplies [N·m, N]


def needed_along(
    robot: "Robot", positions: np.ndarray, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """``torque_along`` of ``positions`` (T, nq) with the robot's own gravity: twice (T, nv)."""
    needed, carried = torque_along(robot.rigid.model, positions, period_s)
    if (more := robot.more_gravity).any():
        leaned = under_gravity(robot.rigid.model, more)
        needed += torque_along(leaned, positions, period_s, still=True)[0]
    return needed, carried


def moved_together(robot: "Robot", m: Measurement) -> Along | None:
    """Motion of all joints in a recording; None if none moves.

    Measured positions say nothing of accelerations that jump with a target between two rows, and their noise is a load on other
    joints. So a position is what the file's drive makes of the targets, and the low-pass filtered rest (``beside_model``). As the
    joints load each other, the accelerations are found by Gauss–Seidel sweeps, which converge for every mass matrix.
    """
    said = repr(
        (robot.rigid.path, robot.config, m.rate_hz, m.kp, m.kd, m.gain_scale)
    ).encode()
    arrays = [
        getattr(m, name).tobytes() for name in ("target", "measured", *m.extra_columns)
    ]
    key = hashlib.sha1(b"".join([said, *arrays])).digest()
    return robot.motions.of(key, lambda: _moved_together(robot, m))


class KeptMotions:
    """Motions of a robot's joints, which serve all joints of a recording. A copy that
    another process gets is empty."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: dict[bytes, Along | None] = {}

    def __reduce__(self) -> "tuple[type[KeptMotions], tuple[()]]":
        return KeptMotions, ()

    def of(self, key: bytes, make: Callable[[], Along | None]) -> Along | None:
        """The motion of ``key``; ``make`` computes it if it is not there."""
        with self._lock:
            if key in self._found:
                return self._found[key]
        made = make()
        with self._lock:
            while sum(len(a.positions) for a in self._found.values() if a) > MOST_KEPT:
                del self._found[next(iter(self._found))]
            return self._found.setdefault(key, made)


def at_times(times: np.ndarray, answer: np.ndarray, rows: int) -> np.ndarray:
    """(F,) positions at ``times`` [rows] of an ``answer`` (N,) at even times of ``rows``
    rows. Between its steps a spline: lines would have no acceleration but at their ends."""
    every, left = divmod(len(answer), len(times))
    if not left:
        return answer[::every]
    return CubicSpline(np.arange(len(answer)) * rows / len(answer), answer)(times)


def _moved_together(robot: "Robot", m: Measurement) -> Along | None:
    model, laws = robot.rigid.model, robot.config.joints
    # Soft joints near the base give way to a wrist that swings; less than 1 mrad or 1 mm
    # costs it nothing.
    angles = moved_by_others(m, list(robot.rigid.joints), 1e-3)
    driven = [
        n
        for n in angles
        if n in laws and laws[n].target_kind == "position" == m.target_kind(n)
    ]
    driven = [
        n
        for n in driven
        if len(angles) > 1 and np.isfinite(m.target[:, m.column(n)]).all()
    ]
    most = MOST_NUMBERS // (m.num_rows * model.nv**2)
    # Of a simulated arm of four joints, whose targets change every 10 ms, steps of 1 ms
    # leave an error of 1.06 noise floors of the efforts; 2 ms leave 1.24.
    fine = max(1, min(math.ceil(m.period_s / 1e-3 - 1e-6), most)) if driven else 1
    rows, times = np.arange(m.num_rows), np.arange(m.num_rows * fine) / fine
    q = np.tile(RobotJoint(robot, next(iter(laws))).pose(m), (len(times), 1))
    for name, values in angles.items():
        q[:, model.joint(name).qposadr[0]] = (
            CubicSpline(rows, values)(times) if fine > 1 else values
        )
    needed, carried = needed_along(robot, q, m.period_s / fine)
    # They hardly change between two rows, and only guide the sweeps.
    masses = np.repeat(masses_along(model, q[::fine] if driven else q[:0]), fine, 0)
    found = Along(frozenset(angles), q, needed, carried)
    joints = {name: RobotJoint(robot, name, along=found) for name in driven}
    models = {name: JointModel(joint) for name, joint in joints.items()}
    motions = {name: motion_of(m, name, joint) for name, joint in joints.items()}
    # Four Gauss–Seidel sweeps, a choice: each removes two thirds of the error.
    for name in driven * 4:
        one, moved, joint = models[name], motions[name], model.joint(name)
        coupling, carrying = joints[name]._coupling(m, moved.pose, found)
        coupling = coupling + one.joint.moving_masses_nm(moved, one.joint.effects(()))
        moved = dataclasses.replace(
            moved, coupling_nm=coupling, carrying_nm=carrying, positions=None
        )
        answer = one.simulate(moved, one.gains, each_step=True).reported
        answer = at_times(times, answer, m.num_rows)
        before = q[:, joint.qposadr[0]].copy()
        q[:, joint.qposadr[0]] = beside_model(m, name, answer)
        more = rates(q[:, joint.qposadr[0]] - before, m.period_s / fine)[1]
        needed += masses[:, :, joint.dofadr[0]] * more[:, None]
    needed, carried = (
        needed_along(robot, q, m.period_s / fine) if driven else (needed, carried)
    )
    return Along(frozenset(angles), q, needed, carried) if angles else None
