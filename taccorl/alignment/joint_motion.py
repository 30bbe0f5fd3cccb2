"""A recording as one joint of the arm sees it: its targets, what was measured, and what the other joints' motion costs it.

Letters in shapes: T rows.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.signal import butter, sosfiltfilt

from taccorl.alignment import arm_bench
from taccorl.alignment.arm_bench import split_signal
from taccorl.alignment.measurement import Measurement
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig

_START_S = 0.1  # of a rest at the start is averaged
_STILL_RAD = 0.01  # another joint that moves less counts as held
_SMOOTH_HZ = 10.0  # of the other joints' measured motion


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
    """Pose at which the arm's other joints [rad] and its gripper [m] are held; the number of the free joint is not used."""
    kp_scale: float = 1.0
    """Gains of this recording over those that are asked for: commanded ones, where known, over the twin's; else over those of
    the other recordings (``Measurement.gain_scale``)."""
    kd_scale: float = 1.0
    kp_known: bool = False
    """The recording says which gain was commanded."""
    kd_known: bool = False
    payload_kg: float = 0.0
    """Known mass in the gripper."""
    payload_at_m: arm_bench.Position = arm_bench.AT_TCP
    """Its centre of mass in link 6's frame."""
    payload_at_known: bool = False
    """The recording states that place."""


def joint_motion(measurement: Measurement, config: TwinConfig | None, signal: str) -> JointMotion:
    """A recording as one of its joints sees it.

    Args:
        config: the twin whose arm couples the joints; None for an axis that is not the arm's.

    Raises:
        TaccorlError: no such signal, gaps in its targets, nothing measured at the start, too short, uneven time.
    """
    m, j = measurement, measurement.column(signal)
    target, measured = m.target[:, j].astype(float), m.measured[:, j].astype(float)
    if m.num_rows < 10:
        raise TaccorlError(f"{m.name}: {m.num_rows} rows are too short for a motion of {signal}; record some seconds")
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
    start = _start(m, j)
    if config is None:
        pose, coupling, payload, commanded = np.zeros(ROBOT.num_per_arm), np.zeros(m.num_rows), 0.0, {}
        payload_at_m, known_place = arm_bench.AT_TCP, False
    else:
        arm, joint = split_signal(signal)
        names = ROBOT.action_names[ROBOT.arm_slice(arm)]
        pose = np.array([_start(m, m.column(name)) if name in m.signals else 0.0 for name in names])
        payload = m.payload_kg.get(arm, 0.0)
        payload_at_m, known_place = m.payload_position_m.get(arm, arm_bench.AT_TCP), arm in m.payload_position_m
        coupling = _coupling(m, config, signal, pose, payload, payload_at_m)
        k, control = ROBOT.joints.index(joint), config.controller_of(arm)
        commanded = {
            "kp": m.kp.get(signal, math.nan) / control.kp_nm_per_rad[k],
            "kd": m.kd.get(signal, math.nan) / max(control.kd_nms_per_rad[k], 1e-9),
        }
    known = {name: scale for name, scale in commanded.items() if math.isfinite(scale)}
    return JointMotion(
        name=m.name,
        time_s=m.time_s,
        rate_hz=m.rate_hz,
        target=target,
        measured=measured,
        effort=m.effort[:, j].astype(float) if m.has_effort()[j] else np.full(m.num_rows, np.nan),
        coupling_nm=coupling,
        start=start,
        pose=pose,
        kp_scale=known.get("kp", m.gain_scale.get(signal, 1.0)),
        kd_scale=known.get("kd", m.gain_scale.get(signal, 1.0)),
        kp_known="kp" in known,
        kd_known="kd" in known,
        payload_kg=payload,
        payload_at_m=payload_at_m,
        payload_at_known=known_place,
    )


def _start(m: Measurement, j: int) -> float:
    """Mean of what was measured before the targets change, of a tenth of a second at most; one reading is noisy."""
    changed = np.flatnonzero(m.target[:, j] != m.target[0, j])
    rest = min(changed[0] + 1 if len(changed) else m.num_rows, max(1, round(_START_S * m.rate_hz)))
    rows = m.measured[:rest, j]
    if np.isfinite(rows).any():
        return float(np.nanmean(rows))
    if np.isfinite(m.measured[:, j]).any():
        raise TaccorlError(
            f"{m.name}: {m.signals[j]} was not measured in its first {rest} rows; cut the recording there"
        )
    return float(m.target[0, j])


def _coupling(
    m: Measurement,
    config: TwinConfig,
    signal: str,
    pose: np.ndarray,
    payload_kg: float,
    payload_at_m: arm_bench.Position,
) -> np.ndarray:
    """(T,) what the joint must hold beyond its own inertia and weight, because other joints of its arm move."""
    arm, joint = split_signal(signal)
    moving = [joint]
    angles = {joint: _smooth(m.measured[:, m.column(signal)], m.rate_hz)}
    for other in ROBOT.joints:
        name = f"{arm}_{other}"
        if other == joint or name not in m.signals:
            continue
        seen = m.measured[:, m.column(name)]
        smooth = _smooth(seen if np.isfinite(seen).any() else m.target[:, m.column(name)], m.rate_hz)
        if np.ptp(smooth) > _STILL_RAD:
            moving.append(other)
            angles[other] = smooth
    if len(moving) == 1:
        return np.zeros(m.num_rows)
    both = []
    for free in (moving, [joint]):
        model = arm_bench.arm_spec(config, arm, pose, free, payload_kg, payload_at_m).compile()
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        data, dof = mujoco.MjData(model), model.joint(f"{arm}_{joint}").dofadr[0]
        q = np.column_stack([angles[name] for name in ROBOT.joints if name in free])
        v = np.gradient(q, m.period_s, axis=0)
        a = np.gradient(v, m.period_s, axis=0)
        torque, needed = np.empty(m.num_rows), np.empty(model.nv)
        for row in range(m.num_rows):
            data.qpos[:], data.qvel[:] = q[row], v[row]
            mujoco.mj_forward(model, data)
            data.qacc[:] = a[row]
            mujoco.mj_rne(model, data, 1, needed)
            torque[row] = needed[dof] - data.qfrc_gravcomp[dof]  # what the weight's compensation carries is not felt
        both.append(torque)
    return both[0] - both[1]


def _smooth(angles: np.ndarray, rate_hz: float) -> np.ndarray:
    """(T,) without what is faster than the arm."""
    seen = np.isfinite(angles)
    rows = np.arange(len(angles))
    whole = np.interp(rows, rows[seen], angles[seen]) if seen.any() else np.zeros(len(angles))
    low_pass = butter(2, min(_SMOOTH_HZ / (rate_hz / 2), 0.8), output="sos")
    return np.asarray(sosfiltfilt(low_pass, whole, padlen=min(9, len(whole) - 1)))
