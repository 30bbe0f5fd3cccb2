"""A recording as one joint of a machine sees it: its targets, what was measured, and what the other joints' motion costs it.

Letters in shapes: T rows, N numbers of a pose.
"""

from dataclasses import dataclass

import numpy as np

from taccorl.alignment.arm_joint import HasJoints, joint_of
from taccorl.alignment.measurement import Measurement
from taccorl.alignment.rigid_joint import AT_TCP, Position, RigidJoint, Surroundings, resting
from taccorl.errors import TaccorlError
from taccorl.sim.twin import TwinConfig

_TARGET_COLUMNS = {"position": "q_target", "velocity": "qd_target", "torque": "tau_target"}


@dataclass(frozen=True, kw_only=True)
class JointMotion:
    """One recording seen from one joint. Row k is the joint at the time of command k, before it acts."""

    name: str
    time_s: np.ndarray
    """(T,)."""
    rate_hz: float
    target: np.ndarray
    """(T,) rad."""
    measured: np.ndarray
    """(T,) rad; NaN where nothing was measured."""
    effort: np.ndarray
    """(T,) N·m; NaN where it was not recorded."""
    coupling_nm: np.ndarray
    """(T,) torque that the joint must hold against the measured motion of the others; 0 where they stand still."""
    start: float
    """rad: reported at rest before the first command."""
    pose: np.ndarray
    """(N,) where the other joints are held [rad, m] (of the PiPER its arm's joints and gripper); the number of the free joint is
    not used."""
    kp_scale: float = 1.0
    """Gains of this recording over those that are asked for: commanded ones, where known, over the twin's; else over those of
    the other recordings (``Measurement.gain_scale``)."""
    kd_scale: float = 1.0
    kp_known: bool = False
    """The recording says which gain was commanded."""
    kd_known: bool = False
    payload_kg: float = 0.0
    """Known mass in the gripper."""
    torque_ff_nm: np.ndarray | None = None
    """(T,) known torque that the controller adds to its law; None: none."""
    supply: np.ndarray | None = None
    """(T,) voltage of the motor over the one of its file; None: 1."""
    command_s: np.ndarray | None = None
    """(T,) when each target came, on the clock of ``time_s``; None: with its row."""
    on: np.ndarray | None = None
    """(T,) 0 while the motor is off, else 1; None: 1."""
    moment_kgm: float = 0.0
    """Σ m l of what the recording mounts on an axis,"""
    mounted_kgm2: float = 0.0
    """and Σ m l²; on a slide Σ m in kg."""
    payload_at_m: Position = AT_TCP
    """Its centre of mass in link 6's frame."""
    payload_at_known: bool = False
    """The recording states that place."""


def joint_motion(measurement: Measurement, machine: TwinConfig | HasJoints | None, signal: str) -> JointMotion:
    """A recording as one of its joints sees it.

    Args:
        machine: whose other joints couple with this one; None for an axis by itself.

    Raises:
        TaccorlError: no such signal, gaps in its targets, nothing measured at the start, too short, uneven time.
    """
    return motion_of(measurement, signal, None if machine is None else joint_of(machine, signal))


def motion_of(measurement: Measurement, signal: str, joint: RigidJoint | None) -> JointMotion:
    """``joint_motion`` of a joint that is known already."""
    m, j = measurement, measurement.column(signal)
    target, measured = m.target[:, j].astype(float), m.measured[:, j].astype(float)
    if m.num_rows < 10:
        raise TaccorlError(f"{m.name}: {m.num_rows} rows are too short for a motion of {signal}; record some seconds")
    wanted = "position" if joint is None else joint.target_kind
    if m.target_kind(signal) != wanted:
        raise TaccorlError(
            f"{m.name}: {signal} is commanded by {m.target_kind(signal)}, its law takes a {wanted}; mend the law in its file, or "
            f"give the column {_TARGET_COLUMNS[wanted]}"
        )
    if not np.isfinite(target).all():
        row = int(np.flatnonzero(~np.isfinite(target))[0])
        raise TaccorlError(f"{m.name}: {signal} has no target at {m.time_s[row]:.3f} s; cut the recording there")
    gaps = np.diff(m.time_s)
    if not (np.abs(gaps - m.period_s) < 0.1 * m.period_s).all():
        row = int(np.argmax(np.abs(gaps - m.period_s)))
        raise TaccorlError(
            f"{m.name}: time is not even, {gaps[row] * 1e3:.1f} ms at {m.time_s[row]:.3f} s where {m.period_s * 1e3:.1f} ms "
            "are usual. Tables with less jitter than half a row and gaps below 0.25 s are brought to an even rate when they are "
            "read; this has more: log the driver's or the bus's own stamps, or cut the recording at the gap"
        )
    rest = Surroundings(coupling_nm=np.zeros(m.num_rows)) if joint is None else joint.surroundings(m)
    factor = m.gain_scale.get(signal, 1.0)
    kp_scale, kd_scale = (factor, factor) if joint is None else joint.gain_scales(m)
    return JointMotion(
        name=m.name,
        time_s=m.time_s,
        rate_hz=m.rate_hz,
        target=target,
        measured=measured,
        effort=m.effort[:, j].astype(float) if m.has_effort()[j] else np.full(m.num_rows, np.nan),
        coupling_nm=rest.coupling_nm,
        torque_ff_nm=rest.torque_ff_nm,
        supply=rest.supply,
        on=rest.on,
        command_s=m.command_s if m.command_s.size and joint is not None and joint.keeps_times else None,
        start=resting(m, j),
        pose=rest.pose,
        kp_scale=kp_scale,
        kd_scale=kd_scale,
        kp_known=joint is not None and signal in m.kp,
        kd_known=joint is not None and signal in m.kd,
        payload_kg=rest.payload_kg,
        moment_kgm=rest.moment_kgm,
        mounted_kgm2=rest.mounted_kgm2,
        payload_at_m=rest.payload_at_m,
        payload_at_known=rest.payload_at_known,
    )
