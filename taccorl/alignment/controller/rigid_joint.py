"""What the one-joint model knows of the body that a joint moves: inertia, weight, and what other joints' motion costs it.

Each kind of machine has its own ``RigidJoint``: the PiPER's twin (``arm_joint``), any robot of an MJCF or URDF file
(``robot_joint``), and an axis with nothing but an inertia (``AxisJoint``).

Letters in shapes: T rows, Q joints of the model, N numbers of a pose.
"""

import math
from abc import ABC
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple

import mujoco
import numpy as np
from scipy.signal import butter, sosfiltfilt

from taccorl.alignment.controller.joint_motion import AT_TCP, JointMotion, Position
from taccorl.alignment.measurements.measurement import Measurement, TargetKind
from taccorl.errors import TaccorlError
from taccorl.sim.effects.effect import Effect

NEED_ROTOR = ("backlash", "joint_compliance")
"""Effects in a gear, which need the inertia on the motor's side of it."""
_START_S = 0.1  # of a rest at the start is averaged
STILL = 0.01
"""rad, m: another joint that moves less counts as held."""
_SMOOTH_HZ = 20.0
"""Of the other joints' measured motion. Seven clean robots of ``docs/robot_study.jsonl`` ended at up to 1.45 noise floors with
10 Hz, which loses what steps do to other joints, at 1.16 with 20 Hz, and at 1.18 with 30 Hz, which lets in noise."""


class Gains(NamedTuple):
    """τ = K_p (q* − q) − K_d q̇ + T_ref. Of a sliding joint N/m, N·s/m, N."""

    kp: float
    """N·m/rad."""
    kd: float
    """N·m·s/rad."""
    torque_ff: float
    """N·m."""


class Rigid(NamedTuple):
    """Inertia and weight of one joint with the others held; names and signs as in ``joint_kernel.Drive``."""

    inertia: float
    rotor_inertia: float = 0.0
    gravity_sin: float = 0.0
    gravity_cos: float = 0.0
    compensation_sin: float = 0.0
    compensation_cos: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """What one recording says of the rest of the machine."""

    coupling_nm: np.ndarray
    """(T,) torque that the joint must hold against the measured motion of the others."""
    torque_ff_nm: np.ndarray | None = None
    """(T,) known torque that the controller adds to its law; None: none."""
    supply: np.ndarray | None = None
    """(T,) voltage of the motor over the one of its file; None: 1."""
    on: np.ndarray | None = None
    """(T,) 0 while the motor is off, else 1; None: 1."""
    moment_kgm: float = 0.0
    """Σ m l of what the recording mounts on an axis, with the arm that holds it;"""
    mounted_kgm2: float = 0.0
    """Σ m l²; on a slide Σ m in kg."""
    pose: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(N,) where the other joints are held, in the machine's own order."""
    payload_kg: float = 0.0
    payload_at_m: Position = AT_TCP
    payload_at_known: bool = False


class RigidJoint(ABC):
    """One joint of a machine, with all that it moves. The methods here are those of a joint with nothing around it."""

    signal: str
    unit: Literal["rad", "m"] = "rad"
    gains: Gains
    """Of a recording that states none."""
    command_hz: float = 150.0
    """Rate at which its drive receives targets: rows that are logged more slowly are joined by straight lines of such steps, at a
    higher rate a target is held until the next row."""
    effort_holds_weight: ClassVar[bool] = False
    """Whether the reported effort holds the torque by which the controller carries the weight."""

    target_kind: TargetKind = "position"
    """What its controller takes as a target."""
    facts: Mapping[str, float] = {}
    """Numbers of ``joint_kernel.Drive`` that are known of the drive; those of effects are added or take their place."""
    position_age_s: float = 0.0
    """How old the measured position is, on average, when the drive's torque acts; with ``speed_delay_s`` of a velocity."""
    speed_delay_s: float = 0.0
    exact_timing: ClassVar[bool] = False
    """Whether the age of the position is fitted where gains are commanded: half a millisecond is 18 noise floors of 0.1 mrad at
    3.7 rad/s."""

    follows_line: ClassVar[bool] = False
    """Whether targets between the rows are those of the line at their own time; else those of the next time, as in a replay."""
    keeps_times: ClassVar[bool] = False
    """Whether targets of rows that jittered act when they came; else with their rows."""
    target_late_s: float = 0.0
    """After that."""

    gain_names: tuple[str, ...] = ("kp", "kd")
    """Gains that a recording can state and a fit can find."""

    @property
    def winding(self) -> Mapping[str, float]:
        """Stall torque [N·m] and back-EMF [N·m·s/rad] of a motor on a voltage, which a fit finds in place of gains."""
        return {}

    def numbers(self, values: Mapping[str, float]) -> tuple[Gains, dict[str, float]]:
        """Gains, and numbers in place of ``facts``, from fitted values of those names."""
        return self.gains._replace(**{name: values[name] for name in Gains._fields if name in values}), {}

    def gain_scales(self, m: Measurement) -> tuple[float, float]:
        """Gains of a recording over ``gains``: of the position error, of the velocity."""
        own = (self.gains.kp, max(self.gains.kd, 1e-9))
        factor = m.gain_scale.get(self.signal, 1.0)
        kp, kd = (
            stated[self.signal] / one if self.signal in stated else factor
            for stated, one in zip((m.kp, m.kd), own, strict=True)
        )
        return kp, kd

    def timestep_s(self, rate_hz: float) -> float:
        """Physics step for rows at ``rate_hz``."""
        raise NotImplementedError

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        """Inertia and weight in the pose of a recording; of ``bodies`` those effects that only change bodies."""
        raise NotImplementedError

    def surroundings(self, m: Measurement) -> Surroundings:
        """What a recording says of the rest of the machine."""
        return Surroundings(coupling_nm=np.zeros(m.num_rows))

    def whole(self, m: Measurement) -> Measurement:
        """With all the machine's signals; those that the recording lacks rest and were not measured."""
        return m

    def effects(self, more: Sequence[Effect]) -> list[Effect]:
        """The joint's own effects and ``more``, which take the place of own ones of the same name; absent ones left out."""
        return [effect for effect in more if not effect.is_absent]

    def freed(self) -> tuple[list[Effect], "RigidJoint"]:
        """Its own effects that a search fits, and the joint without them."""
        return [], self

    def selectors(self, cls: type[Effect]) -> Mapping[str, Any] | None:
        """Arguments with which an effect acts on this joint alone; None for effects that it cannot have."""
        return None

    def in_mujoco(
        self, motion: JointMotion, gains: Gains, effects: Sequence[Effect], sent: np.ndarray, parts: int, hold: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Answer of the joint where ``joint_kernel`` lacks one of ``effects``: reported (T,) and effort (T,).

        Raises:
            TaccorlError: the machine has no such simulation.
        """
        unknown = [effect.name for effect in effects if effect.drive() is None]
        raise TaccorlError(
            f"{self.signal}: an axis without an arm knows effects by their numbers in the one-joint model, and "
            f"{' and '.join(unknown or sorted(e.name for e in effects))} cannot be had there; leave it out"
        )


@dataclass(frozen=True)
class AxisJoint(RigidJoint):
    """An inertia [kg m²], or a mass [kg] on a slide with ``unit`` m, without weight."""

    signal: str
    inertia: float
    gains: Gains
    unit: Literal["rad", "m"] = "rad"
    step_s: float = 1.0 / 1200.0

    def timestep_s(self, rate_hz: float) -> float:
        return self.step_s

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        return Rigid(self.inertia)


# from recordings -------------------------------------------------------------------------------------------------------


def resting(m: Measurement, j: int) -> float:
    """Mean of what was measured before the targets change, of a tenth of a second at most; one reading is noisy.

    Raises:
        TaccorlError: measured later only.
    """
    changed = np.flatnonzero(m.target[:, j] != m.target[0, j])
    rest = min(changed[0] + 1 if len(changed) else m.num_rows, max(1, round(_START_S * m.rate_hz)))
    rows = m.measured[:rest, j]
    if np.isfinite(rows).any():
        return float(np.nanmean(rows))
    if np.isfinite(m.measured[:, j]).any():
        raise TaccorlError(
            f"{m.name}: {m.signals[j]} was not measured in its first {rest} rows; cut the recording there"
        )
    return float(_planned(m, j)[0])


def smooth_motion(m: Measurement, signal: str) -> np.ndarray:
    """(T,) measured positions, or targets where none were measured, without what is faster than the other joints."""
    j = m.column(signal)
    seen = m.measured[:, j]
    return _smooth(seen if np.isfinite(seen).any() else _planned(m, j), m.rate_hz)


def _planned(m: Measurement, j: int) -> np.ndarray:
    """(T,) targets of a signal that was not measured.

    Raises:
        TaccorlError: they are no positions.
    """
    kind = m.target_kind(m.signals[j])
    if kind != "position":
        raise TaccorlError(
            f"{m.name}: {m.signals[j]} is commanded by {kind} and its position was not measured; log it, or leave the signal out"
        )
    return m.target[:, j]


def moved_by_others(m: Measurement, signal: str, others: Sequence[str], still: float = STILL) -> dict[str, np.ndarray]:
    """Smooth motion of ``signal`` and of those ``others`` that the recording has and that move by more than ``still``.

    Only ``signal``'s own is in it where all the others stand still.
    """
    found = {signal: _smooth(m.measured[:, m.column(signal)], m.rate_hz)}
    for other in others:
        if other != signal and other in m.signals:
            motion = smooth_motion(m, other)
            if np.ptp(motion) > still:
                found[other] = motion
    return found


def _smooth(angles: np.ndarray, rate_hz: float) -> np.ndarray:
    seen = np.isfinite(angles)
    rows = np.arange(len(angles))
    whole = np.interp(rows, rows[seen], angles[seen]) if seen.any() else np.zeros(len(angles))
    low_pass = butter(2, min(_SMOOTH_HZ / (rate_hz / 2), 0.8), output="sos")
    return np.asarray(sosfiltfilt(low_pass, whole, padlen=min(9, len(whole) - 1)))


# from MuJoCo -----------------------------------------------------------------------------------------------------------


def rigid_terms(model: mujoco.MjModel, joint: str, pose: np.ndarray | None = None) -> Rigid:
    """Inertia and weight of a hinge with the other joints held at ``pose`` (nq,), qpos0 if not given.

    The weight's torque of a hinge is S sin q + C cos q: two angles determine it. A slide's is constant and not in here
    (``constant_weight``).
    """
    data = mujoco.MjData(model)
    if pose is not None:
        data.qpos[:] = pose
    dof, address = model.joint(joint).dofadr[0], model.joint(joint).qposadr[0]
    mujoco.mj_forward(model, data)
    mass = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    inertia, rotor = float(mass[dof, dof]), float(model.dof_armature[dof])
    if model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_SLIDE:
        return Rigid(inertia, rotor)
    weight, carried = [], []
    for angle in (0.5 * np.pi, 0.0):
        data.qpos[address] = angle
        mujoco.mj_forward(model, data)
        weight.append(float(data.qfrc_bias[dof]))
        carried.append(float(data.qfrc_gravcomp[dof]))
    return Rigid(inertia, rotor, *weight, *carried)


def needed_nm(
    model: mujoco.MjModel, joint: str, positions: np.ndarray, velocities: np.ndarray, accelerations: np.ndarray
) -> np.ndarray:
    """(T,) torque that a motion (T, nq) needs at one joint by inverse dynamics, without armature and without what
    gravity compensation carries."""
    data, dof = mujoco.MjData(model), model.joint(joint).dofadr[0]
    torque, needed = np.empty(len(positions)), np.empty(model.nv)
    for row, (q, v, a) in enumerate(zip(positions, velocities, accelerations, strict=True)):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        data.qacc[:] = a
        mujoco.mj_rne(model, data, 1, needed)
        torque[row] = needed[dof] - data.qfrc_gravcomp[dof]
    return torque


def torque_along(model: mujoco.MjModel, joint: str, positions: np.ndarray, period_s: float) -> np.ndarray:
    """(T,) ``needed_nm`` of smooth positions (T, nq) at rest at both ends, ``period_s`` apart."""
    accelerations = np.zeros_like(positions)
    accelerations[1:-1] = np.diff(positions, 2, axis=0) / period_s**2
    return needed_nm(model, joint, positions, np.gradient(positions, period_s, axis=0), accelerations)


def weighs(rigid: Rigid) -> bool:
    """Whether weight acts about the joint: not about one whose axis is vertical."""
    return math.hypot(rigid.gravity_sin, rigid.gravity_cos) > 1e-6
