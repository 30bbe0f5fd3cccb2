"""Check that a recording and a robot file match: limits of position and effort, inertia, missing columns."""

from collections.abc import Sequence

import numpy as np
from scipy.signal import savgol_filter

from taccorl.alignment.checks.effort_time import check_effort_time
from taccorl.alignment.controller.drive_law import DriveLaw
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.measurements.measurement import UNITS, Measurement
from taccorl.data.finding import Finding, listed

BEYOND = 0.02
"""Share of a joint's range by which a measured position may exceed its limits."""
EFFORT_BEYOND = 1.5
"""Multiple of the effort limit above which a reported effort is probably in another unit."""
INERTIA_OFF = 5.0
"""Ratio of the model's inertia to that in the recording from which on they do not match."""
INERTIA_SURE = 0.6
"""Least correlation of acceleration and effort, without other torques, at which the inertia in the recording is known."""
SMOOTH_S = 0.05
"""Window of the quadratic whose second derivative is the acceleration [s]."""


def check_robot(robot: Robot, m: Measurement, whole: Measurement, moved: Sequence[str]) -> list[Finding]:
    """Check one recording of a machine with a robot file; returns its findings.

    Args:
        whole: the measurement ``m`` extended to all signals of the robot.
        moved: joints of the robot file that the recording moves.
    """
    found = _missing(robot, m)
    for name in robot.config.joints:
        if name in m.signals:
            wrong = [
                *_beyond_limits(robot, m, name),
                *beyond_effort(robot.config.joints[name], m, name, robot.path.name),
            ]
            if name in moved and not wrong:
                wrong = _wrong_inertia(robot, whole, name) or _wrong_effort_time(robot, whole, name)
            found += wrong
    return found


def _missing(robot: Robot, m: Measurement) -> list[Finding]:
    lacking = [name for name in robot.units if name not in m.signals]
    if not lacking:
        return []
    text = (
        f"it lacks {listed(lacking)}: they are taken to stand at the model's zero pose, and inertia and weight of what moves "
        "follow from that; add their columns, constant ones will do"
    )
    return [Finding("pose_unknown", "warning", "", text)]


def _beyond_limits(robot: Robot, m: Measurement, name: str) -> list[Finding]:
    facts, j = robot.rigid.joints[name], m.column(name)
    if facts.limits is None:
        return []
    (low, high), q = facts.limits, m.measured[:, j]
    beyond = np.nan_to_num(np.maximum(q - high, low - q), nan=-1.0)
    row = int(np.argmax(beyond))
    if beyond[row] <= BEYOND * (high - low):
        return []
    if facts.unit == "rad" and abs(q[row]) > 2 * np.pi:
        way_out = f"Write `unit: deg` for {name}.q and {name}.q_target in a columns file; of ticks, rad of one as their `factor:`"
    else:
        way_out = f"Write the `unit:` of {name}.q and {name}.q_target in a columns file, `factor: -1` if their sign is reversed"
    text = (
        f"{name} is at {q[row]:.4g} {facts.unit} at {m.time_s[row]:.3f} s, its limits in the model are {low:.4g} … {high:.4g}. "
        f"{way_out}; or correct the range in {robot.rigid.path.name}"
    )
    return [Finding("beyond_limits", "error", name, text, (row, row + 1))]


def beyond_effort(law: DriveLaw, m: Measurement, name: str, file: str) -> list[Finding]:
    """Finding on reported efforts above ``EFFORT_BEYOND`` times the stated ``effort_limit``; empty if there are none.

    Args:
        law: the drive of signal ``name``.
        file: name of its file, for the message.
    """
    limit, j = law.effort_limit, m.column(name)
    if limit is None or not m.has_effort()[j]:
        return []
    row = int(np.nanargmax(np.abs(m.effort[:, j])))
    if abs(m.effort[row, j]) <= EFFORT_BEYOND * limit:
        return []
    text = (
        f"{name} reports {m.effort[row, j]:.4g} {UNITS[m.units[j]][1]} at {m.time_s[row]:.3f} s, its effort_limit is {limit:g}. "
        f"Is it a current (mA), or the torque before the gear? Write the torque of one such unit at the joint as `factor:` of "
        f"{name}.tau in a columns file, or correct `effort_limit:` in {file}"
    )
    return [Finding("beyond_effort", "error", name, text, (row, row + 1))]


def _wrong_effort_time(robot: Robot, m: Measurement, name: str) -> list[Finding]:
    """Of gains that are known."""
    law = robot.config.joints[name]
    if any(name not in getattr(m, gain) for gain in law.gain_names):
        return []
    return check_effort_time(law, m, name, robot.path.name)


def _wrong_inertia(robot: Robot, m: Measurement, name: str) -> list[Finding]:
    """Least squares: effort on acceleration, velocity, its sign, sine and cosine of the angle, a constant."""
    j = m.column(name)
    q, torque = m.measured[:, j], m.effort[:, j]
    rows = max(5, 2 * round(0.5 * SMOOTH_S * m.rate_hz) + 1)
    if not m.has_effort()[j] or not np.isfinite([q, torque]).all() or m.num_rows < 4 * rows:
        return []
    v, a = (savgol_filter(q, rows, 2, deriv=d, delta=m.period_s) for d in (1, 2))
    others = np.column_stack([v, np.sign(v), np.sin(q), np.cos(q), np.ones_like(q)])
    a, torque = (x - others @ np.linalg.lstsq(others, x, rcond=None)[0] for x in (a, savgol_filter(torque, rows, 2)))
    size = float(np.linalg.norm(a) * np.linalg.norm(torque))
    alike = float(a @ torque) / size if size > 0 else 0.0
    if abs(alike) < INERTIA_SURE:
        return []
    seen = float(a @ torque) / float(a @ a)
    if seen < 0:
        text = (
            f"effort of {name} pushes against its acceleration (correlation {alike:.2f}): its sign is reversed; write "
            f"`factor: -1` for {name}.tau in a columns file"
        )
        return [Finding("reversed_effort", "error", name, text)]
    model = JointModel(robot, name)
    known = model.inertia_kgm2(motion_of(m, name, model.joint))
    if 1 / INERTIA_OFF <= seen / known <= INERTIA_OFF:
        return []
    nearest = min(robot.rigid.joints.values(), key=lambda f: abs(np.log(max(f.inertia + f.armature, 1e-9) / seen))).name
    hint = f" That is the size of {nearest}: are columns exchanged?" if nearest != name else ""
    text = (
        f"effort and acceleration of {name} say {seen:.3g} {'kg·m²' if m.units[j] == 'rad' else 'kg'}, the model with its rotor "
        f"{known:.3g}: {seen / known:.2g} times.{hint} Else write the unit and `factor:` of {name}.tau in a columns file, or "
        f"rotor_inertia and gear of {name} in {robot.path.name}"
    )
    return [Finding("wrong_inertia", "error", name, text)]
