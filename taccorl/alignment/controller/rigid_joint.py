"""Rigid-body properties of one joint for the one-joint model: inertia, weight, and torque from the motion of other joints. Each
kind of machine has its own ``RigidJoint``: the PiPER's twin (``arm_joint``), and any robot or axis
(``robot_joint``).

Letters in shapes: T rows, Q joints of the model, N numbers of a pose.
"""

import math
from abc import ABC
from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import Any, ClassVar, Literal, NamedTuple

import mujoco
import numpy as np

from taccorl.alignment.controller.joint_motion import JointMotion, Surroundings
from taccorl.alignment.measurements.measurement import Measurement, TargetKind
from taccorl.sim.effects.effect import Effect

NEED_ROTOR = (
    "backlash",
    "joint_compliance",
)  # Effects in a gear, which need the inertia on the motor's side


class Gains(NamedTuple):
    """Gains of τ = K_p (q* − q) − K_d q̇ + T_ref. For a sliding joint N/m, N·s/m, N."""

    kp: float  # K_p [N·m/rad]
    kd: float  # K_d [N·m·s/rad]
    torque_ff: float  # T_ref [N·m]


class Rigid(NamedTuple):
    """Inertia and weight of one joint with the others held, in N·m and rad (for a sliding joint N and m)."""

    inertia: float  # Inertia about the joint, with the rotor [kg·m²]
    rotor_inertia: float = (
        0.0  # Part of ``inertia`` that is on the motor's side of the gear [kg·m²]
    )
    gravity_sin: float = 0.0  # S [N·m] in S sin q + C cos q, the torque that holds the weight at position q
    gravity_cos: float = 0.0  # C [N·m] in the same torque
    compensation_sin: float = 0.0  # S [N·m] in S sin q + C cos q, the torque that the motor adds to compensate gravity
    compensation_cos: float = 0.0  # C [N·m] in the same torque
    free_inertia: float = 0.0
    """1 / (M⁻¹)ⱼⱼ with the rotors of all joints, at the model's zero pose [kg·m²]: the inertia with the other joints free; 0: as
    ``inertia``."""
    weight_n: float = 0.0
    """Force that holds the weight of masses besides the model's at a slide [N], which does not change as it slides."""


class PointMass(NamedTuple):
    """A mass that is fixed to a body, and that the controller's gravity compensation does not carry."""

    mass_kg: float
    body: int  # Id of the body
    place_m: tuple[float, float, float]  # Place of its centre in the body's frame [m]
    spread_m2: np.ndarray = np.zeros(
        (3, 3)
    )  # (3, 3) mean of r rᵀ [m²], r from its centre, body frame; 0: a point


class MassTorque(NamedTuple):
    """Torque at one joint that a given motion requires because a point mass is fixed to a body, per kilogram of it, at each
    row: k + l·c + cᵀ M c, where c (3,) is the place of the mass in the body's frame [m]. From Newton's law and the joint's
    Jacobian (``mass_torque_along``)."""

    constant: np.ndarray  # (T,) k [N·m/kg]
    linear: np.ndarray  # (T, 3) l [N/kg]
    square: np.ndarray  # (T, 3, 3) M [1/s²]

    def of(self, one: PointMass) -> np.ndarray:
        """(T,) torque [N·m] for one mass in that body."""
        at = np.array(one.place_m)
        squares = (np.outer(at, at) + one.spread_m2).ravel()
        square = self.square.reshape(-1, 9) @ squares
        return one.mass_kg * (self.constant + self.linear @ at + square)


class RigidJoint(ABC):
    """One joint of a machine with all bodies that it moves. The base class describes a joint that no other joint, load or file
    influences; subclasses override its methods."""

    signal: str
    unit: Literal["rad", "m"] = (
        "rad"  # Unit of its position: a hinge has rad, a slide m
    )
    gains: Gains  # Gains for recordings that state none
    command_hz: float = 150.0
    """Rate at which its drive receives targets [Hz]. Rows at a lower rate are interpolated linearly at this rate; at a higher
    rate a target is held until the next row."""
    effort_holds_weight: ClassVar[bool] = False
    """Whether the reported effort includes the torque of the gravity compensation."""

    target_kind: TargetKind = "position"  # Quantity that its controller takes as target
    facts: Mapping[str, float] = {}
    """Known fields of ``drive_numbers.Drive``. Fields that effects set are added, or replace them."""
    position_age_s: float = 0.0
    """Mean age of the measured position when the drive's torque acts [s]; ``speed_delay_s`` is that of the velocity."""
    loop_s: float = 0.0
    """Period of the drive's loop that the machine's file states [s]; 0: none."""
    stated_age_s: float = 0.0  # Part of ``position_age_s`` that the machine's file states beyond half a loop period [s]
    speed_delay_s: float = 0.0  # Delay of the measured velocity in the controller [s]
    exact_timing: ClassVar[bool] = False
    """Whether the age of the position is fitted if gains are commanded: at 3.7 rad/s half a millisecond makes 18 noise floors of
    0.1 mrad."""

    keeps_times: ClassVar[bool] = False
    """True: a recording may begin in motion, targets of rows with jitter act at their own
    arrival times, and between two rows on the line. False: it begins at rest, and a target
    is held from the time of its row, as in a replay."""
    target_late_s: float = 0.0
    """Delay from a target's arrival (see ``keeps_times``) until it acts in the controller [s]."""

    gain_names: tuple[str, ...] = (
        "kp",
        "kd",
    )  # Gains that a recording can state and a fit can determine
    wave: float = 1.0
    """Position that counts as 1 rad in periodic forces: of a slide ``Scale.wave`` [m]."""
    known_names: tuple[
        str, ...
    ] = ()  # Numbers and effects that the file marks as known (``DriveLaw.known``)

    @property
    def winding(self) -> Mapping[str, float]:
        """Stall torque [N·m] and back-EMF [N·m·s/rad] of a motor with law pwm, fitted in place of gains; empty for others."""
        return {}

    def numbers(self, values: Mapping[str, float]) -> tuple[Gains, dict[str, float]]:
        """Convert fitted values, by parameter name. Returns gains, with those of ``gains`` where ``values`` has none; and field →
        value of ``drive_numbers.Drive`` that replace ``facts``."""
        return self.gains._replace(
            **{name: values[name] for name in Gains._fields if name in values}
        ), {}

    def with_values(self, values: Mapping[str, float]) -> "RigidJoint":
        """The joint with fitted numbers, by name, that ``numbers`` does not convert."""
        return self

    def gain_scales(self, m: Measurement) -> tuple[float, float]:
        """Ratios of a recording's gains to ``gains``: (for the position error, for the velocity); 1 if the recording states
        none."""
        factor, both = (
            m.gain_scale.get(self.signal, 1.0),
            ((m.kp, self.gains.kp), (m.kd, max(self.gains.kd, 1e-9))),
        )
        kp, kd = (
            stated[self.signal] / own if self.signal in stated else factor
            for stated, own in both
        )
        return kp, kd

    def timestep_s(self, motion: JointMotion) -> float:
        """Physics step [s] for a recording."""
        raise NotImplementedError

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        """Inertia of the joint, and its weight as a function of its position, with the other joints held where they were.
        ``motion``: recording, of which the pose of the other joints and the mounted masses are used. ``bodies``: effects that act
        on the joint; those that change masses, such as ``payload``, are included, others ignored."""
        raise NotImplementedError

    def moving_masses_nm(
        self, motion: JointMotion, bodies: Sequence[Effect]
    ) -> np.ndarray | float:
        """(T,) torque [N·m] because other joints move the masses that ``bodies`` add, beyond ``rigid``.
        ``bodies``: as for ``rigid``."""
        return 0.0

    def surroundings(self, m: Measurement) -> Surroundings:
        """Pose and motion of the rest of the machine in the recording ``m``, mounted masses, and the motor's supply."""
        return Surroundings(coupling_nm=np.zeros(m.num_rows))

    def whole(self, m: Measurement) -> Measurement:
        """The recording extended to all signals of the machine; missing signals are at rest and count as not measured."""
        return m

    def effects(self, more: Sequence[Effect]) -> list[Effect]:
        """The joint's own effects and ``more``, which replace own effects of the same name; absent effects are left out."""
        return [effect for effect in more if not effect.is_absent]

    def freed(self, held: Collection[str] = ()) -> tuple[list[Effect], "RigidJoint"]:
        """The joint's own effects that a search fits, all but ``held``, and the joint without them."""
        return [], self

    def in_units(self, cls: type[Effect]) -> type[Effect]:
        """The class of an effect whose parameters are in the units of the joint: N for N·m where it slides."""
        return cls

    def selectors(self, cls: type[Effect]) -> Mapping[str, Any] | None:
        """Arguments with which an effect acts on this joint alone; None for effects that it cannot have."""
        return None


def rigid_terms(
    model: mujoco.MjModel, joint: str, pose: np.ndarray | None = None
) -> Rigid:
    """Inertia and weight of a hinge with the other joints held at ``pose`` (nq,), qpos0 if not given.

    The weight's torque of a hinge is S sin q + C cos q: two angles determine it. The weight of a slide is constant and not
    included: ``Surroundings.coupling_nm`` has it."""
    data = mujoco.MjData(model)
    if pose is not None:
        data.qpos[:] = pose
    dof, address = model.joint(joint).dofadr[0], model.joint(joint).qposadr[0]
    mujoco.mj_forward(model, data)
    mass = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    inertia, rotor = float(mass[dof, dof]), _rotor_inertia(model, joint)
    if model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_SLIDE:
        return Rigid(inertia, rotor)
    weight, carried = [], []
    for angle in (0.5 * np.pi, 0.0):
        data.qpos[address] = angle
        mujoco.mj_forward(model, data)
        weight.append(float(data.qfrc_bias[dof]))
        carried.append(float(data.qfrc_gravcomp[dof]))
    return Rigid(inertia, rotor, *weight, *carried)


def _rotor_inertia(model: mujoco.MjModel, joint: str) -> float:
    """Inertia [kg·m², kg] of the rotors at a joint: its own armature, and that of each of its
    actuators times the square of the gear."""
    one = model.joint(joint)
    kinds = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    own = np.isin(model.actuator_trntype, kinds)
    own &= model.actuator_trnid[:, 0] == one.id
    gear = model.actuator_gear[own, 0]
    rotors = float(gear**2 @ model.actuator_armature[own])
    return float(model.dof_armature[one.dofadr[0]]) + rotors


def with_masses(
    terms: Rigid,
    model: mujoco.MjModel,
    joint: str,
    pose: np.ndarray,
    masses: Sequence[PointMass],
) -> Rigid:
    """``terms`` of one joint with the inertia m r² and the weight of ``masses``, the other joints held at ``pose`` (nq,)."""
    hinge = model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_HINGE
    for one in masses:
        there, turning = _levers(model, joint, pose.tobytes(), one.body)
        lever = there + turning @ one.place_m
        own = np.sum(turning[1] @ one.spread_m2 * turning[1])
        inertia = terms.inertia + one.mass_kg * float(lever[1] @ lever[1] + own)
        first, last = map(float, -one.mass_kg * lever @ model.opt.gravity)
        sine, cosine = (
            (terms.gravity_sin + first, terms.gravity_cos + last)
            if hinge
            else terms[2:4]
        )
        weight = terms.weight_n + last * (not hinge)
        terms = terms._replace(
            inertia=inertia, gravity_sin=sine, gravity_cos=cosine, weight_n=weight
        )
    return terms


@lru_cache(maxsize=1024)
def _levers(
    model: mujoco.MjModel, joint: str, pose: bytes, body: int
) -> tuple[np.ndarray, np.ndarray]:
    """(2, 3) j and (2, 3, 3) L of the lever j + L c of a point at c (3,) in a body, with the joint at π / 2 and at 0."""
    data, jac, levers = (
        mujoco.MjData(model),
        np.zeros((2, 3, model.nv)),
        np.zeros((2, 4, 3)),
    )
    data.qpos[:] = np.frombuffer(pose)
    for k, angle in enumerate((0.5 * np.pi, 0.0)):
        data.qpos[model.joint(joint).qposadr[0]] = angle
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jac(model, data, *jac, data.xpos[body], body)
        along, about = jac[:, :, model.joint(joint).dofadr[0]]
        levers[k] = along, *np.cross(about, data.xmat[body].reshape(3, 3).T)
    return levers[:, 0], levers[:, 1:].swapaxes(1, 2)


def torque_along(
    model: mujoco.MjModel, positions: np.ndarray, period_s: float, still: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse dynamics without armature for smooth ``positions`` (T, nq) [rad, m] that are ``period_s`` apart, at rest at both
    ends (``still``: everywhere). Returns (T, nv) torques [N·m] at all joints, and (T, nv) the part of them that the gravity
    compensation supplies."""
    data, (velocities, accelerations) = (
        mujoco.MjData(model),
        rates(positions, np.inf if still else period_s),
    )
    torque, carried = np.zeros((2, len(positions), model.nv))
    compensates = bool(model.body_gravcomp.any())
    q, v, a = data.qpos, data.qvel, data.qacc
    for row in range(len(positions)):
        q[:], v[:], a[:] = positions[row], velocities[row], accelerations[row]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 1, torque[row])
        if compensates:
            mujoco.mj_passive(model, data)
            carried[row] = data.qfrc_gravcomp
    return torque, carried


def masses_along(model: mujoco.MjModel, positions: np.ndarray) -> np.ndarray:
    """(T, nv, nv) mass matrices [kg·m², kg] at ``positions`` (T, nq)."""
    data = mujoco.MjData(model)
    masses = np.empty((len(positions), model.nv, model.nv), np.float32)
    mass = np.empty((model.nv, model.nv))
    for row, position in enumerate(positions):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_fullM(model, data, mass)
        masses[row] = mass
    return masses


def mass_torque_along(
    model: mujoco.MjModel,
    joint: str,
    body: int,
    positions: np.ndarray,
    period_s: float,
    gravity_mps2: np.ndarray,
) -> MassTorque:
    """Torque at one joint for a mass in one body, along a motion as that of ``torque_along``.

    A mass at c requires J_c · (a_c − g), its lever J_c = j + w × R c and acceleration a_c = a₀ + A R c with A = [ω̇]× + [ω]×²,
    for the Jacobian's columns j and w of the joint at the body's origin, the origin's acceleration a₀ and the body's rotation R.
    ``body``: id of the body. ``gravity_mps2``: (3,) gravity in the model's frame [m/s²]."""
    data, dof = mujoco.MjData(model), model.joint(joint).dofadr[0]
    jac, dot = np.zeros((2, len(positions), 2, 3, model.nv))
    rotation = np.empty((len(positions), 3, 3))
    velocities, accelerations = rates(positions, period_s)
    qpos, qvel = data.qpos, data.qvel
    place, turn = data.xpos[body], data.xmat[body].reshape(3, 3)
    for row in range(len(positions)):
        qpos[:], qvel[:] = positions[row], velocities[row]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_jac(model, data, jac[row, 0], jac[row, 1], place, body)
        mujoco.mj_jacDot(model, data, dot[row, 0], dot[row, 1], place, body)
        rotation[row] = turn
    v, a = velocities[:, None, :, None], accelerations[:, None, :, None]
    origin, turn = np.moveaxis((jac @ a + dot @ v)[..., 0], 1, 0)
    origin = origin - gravity_mps2
    about = _cross((jac[:, 1] @ v[:, 0])[..., 0])
    along, across = jac[:, 0, :, dof], _cross(jac[:, 1, :, dof])
    moved = (_cross(turn) + about @ about) @ rotation
    return MassTorque(
        np.sum(along * origin, axis=1),
        (along[:, None] @ moved + origin[:, None] @ across @ rotation)[:, 0],
        np.swapaxes(rotation, 1, 2) @ np.swapaxes(across, 1, 2) @ moved,
    )


def _cross(v: np.ndarray) -> np.ndarray:
    """(T, 3, 3) matrices [v]× of ``v`` (T, 3), with [v]× u = v × u."""
    return np.cross(v[:, None, :], np.eye(3)[None]).swapaxes(1, 2)


def rates(positions: np.ndarray, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """(T, nv) velocities and accelerations along ``positions`` (T, nq), at rest at both ends."""
    accelerations = np.zeros_like(positions)
    accelerations[1:-1] = np.diff(positions, 2, axis=0) / period_s**2
    return np.gradient(positions, period_s, axis=0), accelerations


def weighs(rigid: Rigid) -> bool:
    """True if weight has a torque about the joint; it has none about a vertical axis."""
    return math.hypot(rigid.gravity_sin, rigid.gravity_cos) > 1e-6
