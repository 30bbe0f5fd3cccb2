"""Extract one joint's data from a recording: ``JointMotion``.

Letters in shapes: T rows.
"""

import dataclasses
import math

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from taccorl.alignment.controller.arm_joint import HasJoints, joint_of
from taccorl.alignment.controller.drive_law import FOLLOW_HZ
from taccorl.alignment.controller.joint_motion import (
    JointMotion,
    resting,
    steps_at_once,
)
from taccorl.alignment.controller.rigid_joint import RigidJoint
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import NUMBER, noise_floor
from taccorl.errors import TaccorlError
from taccorl.sim.twin import TwinConfig

_TARGET_COLUMNS = {
    "position": "q_target",
    "velocity": "qd_target",
    "torque": "tau_target",
    "effort": "tau, and no target",
}
START_ROWS = 8  # Rows from which speed and effort at the start are computed. A choice.
SMOOTH_S = 0.05
"""Window of the quadratic that is the measured position at which a model of law effort is held [s]: half of 1 / ``FOLLOW_HZ``."""
MOST_YIELD = 0.05
"""Largest share of a recording's span by which the standard deviation of its effort may move a model of law effort (a choice)."""


def joint_motion(
    measurement: Measurement, machine: TwinConfig | HasJoints, signal: str
) -> JointMotion:
    """``motion_of`` a joint of ``machine``."""
    return motion_of(measurement, signal, joint_of(machine, signal))


def motion_of(measurement: Measurement, signal: str, joint: RigidJoint) -> JointMotion:
    """Data of one joint from a recording. Raises TaccorlError: there is no such signal, its targets have gaps or are not those of
    its law, nothing was measured at the start, the recording is too short, or its time is uneven."""
    m, j = measurement, measurement.column(signal)
    target, measured = m.target[:, j].astype(float), m.measured[:, j].astype(float)
    if m.num_rows < 10:
        raise TaccorlError(
            f"{m.name}: {m.num_rows} rows are too few for a motion of {signal}; record some seconds"
        )
    kind, wanted = m.target_kind(signal), joint.target_kind
    if kind != wanted:
        what, way_out = f"is commanded by {kind}", "correct the law in its file"
        if kind == "effort":
            what = "has no target"
            way_out = "write `law: effort` into its file: the measured effort is then the input"
        text = f"{what}, but its law requires a {wanted}; give the column {_TARGET_COLUMNS[wanted]}, or {way_out}"
        raise TaccorlError(f"{m.name}: {signal} {text}")
    if not np.isfinite(target).all():
        row = int(np.flatnonzero(~np.isfinite(target))[0])
        raise TaccorlError(
            f"{m.name}: {signal} has no target at {m.time_s[row]:.3f} s; cut the recording there"
        )
    gaps = np.diff(m.time_s)
    if not (np.abs(gaps - m.period_s) < 0.1 * m.period_s).all():
        row = int(np.argmax(np.abs(gaps - m.period_s)))
        raise TaccorlError(
            f"{m.name}: rows are not evenly spaced: {gaps[row] * 1e3:.1f} ms at {m.time_s[row]:.3f} s instead of the usual "
            f"{m.period_s * 1e3:.1f} ms. Tables with jitter below half a row, gaps below 0.25 s and at most a tenth of the "
            "rows lost are made even when they are read; this table exceeds these limits: log the driver's or the bus's own "
            "stamps, or cut the recording at the gap"
        )
    rest = joint.surroundings(m)
    effort = (
        m.effort[:, j].astype(float)
        if m.has_effort()[j]
        else np.full(m.num_rows, np.nan)
    )
    added = rest.torque_ff_nm
    kp_scale, kd_scale = joint.gain_scales(m)
    if wanted == "effort":
        target, added = _followed(m, signal, joint, effort)
        kp_scale = kd_scale = holding_stiffness(m, signal)
    held = 0.0
    if wanted == "torque":
        target, added = target + (0.0 if added is None else added), None
        if m.held:
            held = holding_stiffness(dataclasses.replace(m, effort=m.target), signal)
            added = _held(m, j, held)
    start, start_speed = resting(m, j), 0.0
    if joint.keeps_times and not steps_at_once(m, j):
        start, start_speed = starting(measured, m.rate_hz) or (start, 0.0)
    return JointMotion(
        name=m.name,
        time_s=m.time_s,
        rate_hz=m.rate_hz,
        target=target,
        measured=measured,
        effort=effort,
        **vars(dataclasses.replace(rest, torque_ff_nm=added)),
        command_s=m.command_s
        if m.command_s.size and joint.keeps_times and joint.target_kind != "effort"
        else None,
        start=start,
        start_speed=start_speed,
        start_nm=float(np.nan_to_num(np.mean(effort[:START_ROWS]), nan=np.inf)),
        kp_scale=kp_scale,
        kd_scale=kd_scale,
        held_nm_per_rad=held,
        kp_known=signal in m.kp,
        kd_known=signal in m.kd,
    )


def starting(measured: np.ndarray, rate_hz: float) -> tuple[float, float] | None:
    """Position [rad] and speed [rad/s] at the first of ``measured`` (T,) positions [rad]; None where the joint seems to start at
    rest.

    A quadratic through the first rows gives both. The joint was moving if the quadratic's speed is at least half of the mean
    speed over these rows (from rest, at constant or growing acceleration, it is 0 or negative), and the motion ten times what
    the quadratic leaves of it.
    """
    first = measured[:START_ROWS]
    if len(first) < START_ROWS or not np.isfinite(first).all():
        return None
    row = np.arange(START_ROWS)
    fit = np.polynomial.Polynomial.fit(row, first, 2, domain=[0, 1], window=[0, 1])
    speed, moved = float(fit.coef[1]), float(first[-1] - first[0])
    least = max(0.5 * abs(moved), 10.0 * float(np.abs(first - fit(row)).max()))
    if moved == 0.0 or speed * np.sign(moved) * (START_ROWS - 1) < least:
        return None
    return float(fit.coef[0]), speed * rate_hz


def _followed(
    m: Measurement, signal: str, joint: RigidJoint, effort: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(T,) targets q + K_d / K_p q̇ of law effort, with which K_p (q* − q) − K_d q̇ holds the model at the measured position and
    speed, and (T,) efforts that drive it, each the mean of its row and the next. Raises TaccorlError: position or effort were not
    measured throughout."""
    q = m.measured[:, m.column(signal)].astype(float)
    for values, what in ((q, "position"), (effort, "effort")):
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise TaccorlError(
                f"{m.name}: {signal} has no {what} at {m.time_s[row]:.3f} s, and law effort needs it; cut the recording there"
            )
    at = _smooth(m, signal)
    target = at + joint.gains.kd / joint.gains.kp * np.gradient(at, m.period_s)
    return target, 0.5 * (effort + np.append(effort[1:], effort[-1]))


def _held(m: Measurement, j: int, stiffness: float) -> np.ndarray:
    """(T,) K q + D q̇ [N·m] of a spring and damper that draw a model of law torque to the measured position q: from each row to
    the next, the mean of both and their difference."""
    seen = np.isfinite(m.measured[:, j])
    q = np.interp(m.time_s, m.time_s[seen], m.measured[seen, j])
    later = np.append(q[1:], q[-1])
    return stiffness * (
        0.5 * (q + later) + (later - q) * m.rate_hz / (math.pi * FOLLOW_HZ)
    )


def _smooth(m: Measurement, signal: str, deriv: int = 0) -> np.ndarray:
    """(T,) measured position, or a time derivative of it, of the quadratic over ``SMOOTH_S``; its first derivative would lack a
    share of the speed, ω² ``SMOOTH_S``² / 40 of a sine."""
    return savgol_filter(
        m.measured[:, m.column(signal)].astype(float),
        _window(m),
        2,
        deriv=deriv,
        delta=m.period_s,
    )


def _window(m: Measurement) -> int:
    return max(5, 2 * round(0.5 * SMOOTH_S * m.rate_hz) + 1)


def holding_stiffness(m: Measurement, signal: str) -> float:
    """Stiffness K of what holds a model of law effort at the measured position [N·m/rad], from the recording alone.

    K = ω² J, with ω of ``FOLLOW_HZ`` and the largest inertia that the effort allows, J = rms(τ − mean) / rms(q̈), but at most so
    that noise of the smoothed position and speed makes no more effort than that of the effort itself. A stiffness that followed
    the model's inertia would vanish with it, and with it the error of the effort. The recorded effort moves the model by
    ``MOST_YIELD`` of its span at most.
    """
    one = m.only([signal])
    effort, span = one.effort[:, 0].astype(float), float(np.ptp(one.measured))
    size = float(np.std(effort))
    if size == 0.0 or span == 0.0:  # a joint that rests, or is pushed evenly
        size, span = max(float(np.abs(effort).max()), NUMBER), span or 1.0
    omega, window = 2.0 * math.pi * FOLLOW_HZ, _window(m)
    found = (
        omega**2
        * size
        / max(float(np.sqrt(np.mean(_smooth(m, signal, 2) ** 2))), NUMBER)
    )
    noise = [noise_floor([one], kind)[signal] for kind in ("effort", "position")]
    if all(f.used.method != "number" for f in noise):
        weights = np.pad(savgol_coeffs(window, 2), 1)
        weights = weights + 2.0 / omega * np.gradient(weights, m.period_s)
        found = min(
            found, noise[0].value / (noise[1].value * float(np.linalg.norm(weights)))
        )
    return max(found, size / (MOST_YIELD * span))
