"""Check that a recording and a robot file match: limits of position and effort, inertia, missing columns."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from scipy.signal import savgol_filter

from taccorl.alignment.checks.effort_time import SIGN_SURE, LawFit, law_fit
from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.checks.trial import write
from taccorl.alignment.checks.unsigned import unsigned_register
from taccorl.alignment.checks.wiring import all_in_degrees, speed_as_position
from taccorl.alignment.controller.drive_law import DriveLaw
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.measurements.measurement import UNITS, Measurement
from taccorl.alignment.measurements.registers import UnsignedColumn
from taccorl.data.finding import Finding, listed

BEYOND = (
    0.02  # Share of a joint's range by which a measured position may exceed its limits
)
DEGREES, NEAR_DEGREES = math.pi / 180, 0.3
"""Radians in a degree. Where the fitted inertia over the stated one is this number, within a factor of exp(0.3) (a choice), the
positions are in degrees."""
EFFORT_BEYOND = 1.5  # Multiple of the effort limit above which a reported effort is probably in another unit
INERTIA_OFF = 5.0  # Ratio of the model's inertia to that in the recording from which on they do not match
INERTIA_SURE = 0.6
"""Least correlation of acceleration and effort, without other torques, at which the inertia in the recording is known, and by
which a reversed effort must be explained better than the effort as it is."""
BY_LAW = 0.02
"""Efforts are those of a register if the constant torque beside their law is below this
share of half the register's range. A choice: a constant weight comes as near to a power
of two of its own steps by chance in one of 20 recordings."""
BY_ITSELF = 1e-12
"""Efforts of 54 bits and more, which no float64 tells apart, are if each lies within this
share of half the range from what means 0."""
REVERSED_LEFT = 0.2
"""Share that a reversed effort leaves at most of what the effort as it is leaves, where no law shows its sign: a centre of mass
on the other side of the axis leaves more. A choice."""
SMOOTH_S = (
    0.05  # Window of the quadratic whose second derivative is the acceleration [s]
)


def check_robot(
    robot: Robot,
    m: Measurement,
    whole: Measurement,
    moved: Sequence[str],
    fits: Mapping[str, LawFit | None] | None = None,
) -> list[Finding]:
    """Check one recording of a machine with a robot file; returns its findings. ``whole``: the measurement ``m`` extended to all
    signals of the robot. ``moved``: joints of the robot file that the recording moves. ``fits``: joint → law of its efforts in
    all recordings; by default in this one."""
    if fits is None:
        fits = {
            name: law_fit(robot.config.joints[name], [whole], name)
            for name in moved
            if name in m.signals
        }
    lacking = [name for name in robot.units if name not in m.signals]
    found = pose_unknown(
        lacking if robot.config.model else [], "at the model's zero pose"
    )
    limits = {n: robot.rigid.joints[n].limits for n in robot.config.joints}
    hinges = {n: own for n, own in limits.items() if own and robot.units[n] == "rad"}
    if degrees := all_in_degrees(m, hinges):
        return [*found, *degrees]
    factors: dict[str, float] = {}
    of_efforts: list[Finding] = []
    for name in robot.config.joints:
        if name in m.signals:
            wrong = beyond_limits(m, name, limits[name], robot.rigid.path.name)
            fit = fits[name] if name in moved else None
            known = None
            if robot.config.model:  # else gains are fitted, or suspected
                known = _factor(robot.config.joints[name], whole, name, fit)
            if (
                known is not None
                and not wrong
                and not 1 / INERTIA_OFF <= known <= INERTIA_OFF
            ):
                factors[name] = known
                continue
            wrong += beyond_effort(
                robot.config.joints[name], m, name, robot.path.name, fit
            )
            if name in moved and not wrong:
                model = JointModel(robot, name)
                words = partial(_inertia_words, robot, whole, model)
                wrong = wrong_inertia(model, whole, fit, words, known or 1.0)
            of_efforts += [
                f for f in wrong if f.check in ("beyond_effort", "wrong_inertia")
            ]
            found += [f for f in wrong if f not in of_efforts]
    if (
        len(factors) > 1
    ):  # one cause: what is left of these comes back once the unit is written
        of_efforts = []
    return [*found, *_effort_unit(m, factors), *of_efforts]


@check("error", "effort_unit")
def _effort_unit(m: Measurement, factors: Mapping[str, float]) -> list[Finding]:
    """One finding for all joints whose reported efforts are ``factors`` times those of their laws."""
    if not factors:
        return []
    low, high = min(factors.values()), max(factors.values())
    times = f"{low:.3g} times" if len(factors) == 1 else f"{low:.3g} … {high:.3g} times"
    unit = (
        "another unit: mA, or the torque before the gear?"
        if low > 1
        else "another unit, such as A?"
    )
    numbers = ", ".join(f"{name}: {1 / factor:.3g}" for name, factor in factors.items())
    scales = "as `effort_scale:` of the recording in measurements.yaml"
    where = write(m, "as `factor:` of their .tau in a columns file", scales)
    text = (
        f"efforts of {listed(list(factors))} are {times} what kp and kd of the file command: in {unit} With these gains one unit "
        f"is so many N·m (N) at the joint: {{{numbers}}}. Write these {where}, or the torque constants that you know; or correct "
        "kp and kd"
    )
    return [find("effort_unit", next(iter(factors)), text, topic="effort unit")]


def _beside(x: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(T,) ``x`` without what the columns ``others`` (T, N) explain."""
    return x - others @ np.linalg.lstsq(others, x, rcond=None)[0]


def _factor(
    law: DriveLaw, m: Measurement, name: str, fit: LawFit | None
) -> float | None:
    """Reported effort over the torque of the law; None without commanded gains, or if the recordings do not show it."""
    stated = law.law in ("impedance", "cascade") and all(
        name in getattr(m, gain) for gain in law.gain_names
    )
    return fit.kp if fit is not None and stated and fit.sign > 0 else None


@check("warning", "pose_unknown")
def pose_unknown(lacking: Sequence[str], pose: str, feature: str = "") -> list[Finding]:
    """Finding on joints that a recording lacks. ``pose``: text that says where they are taken to stand."""
    text = (
        f"it lacks {listed(lacking, 6)}: they are taken to stand {pose}, and inertia and weight of what moves follow from that; "
        "add their columns, constant ones will do"
    )
    return [find("pose_unknown", feature, text)] if lacking else []


@check("error", "beyond_limits")
def beyond_limits(
    m: Measurement, name: str, limits: tuple[float, float] | None, file: str
) -> list[Finding]:
    """Finding on positions beyond ``limits`` of signal ``name``, which ``file`` states [rad, m]; empty if there are none."""
    j = m.column(name)
    (low, high), q, unit = limits or (-math.inf, math.inf), m.measured[:, j], m.units[j]
    beyond = np.nan_to_num(np.maximum(q - high, low - q), nan=-1.0)
    row = int(np.argmax(beyond))
    if limits is None or beyond[row] <= BEYOND * (high - low):
        return []
    turns = float(np.round(np.nanmean(q - 0.5 * (low + high)) / (2 * np.pi)))
    within = np.nanmax(np.abs(q - 2 * np.pi * turns - 0.5 * (low + high)))
    if unit == "rad" and turns and within < (0.5 + BEYOND) * (high - low):
        way_out = (
            f"All of it lies {turns:g} full turns off: write `zero: {2 * np.pi * turns:.6g}` (in rad) for {name}.q, and for "
            f"{name}.q_target if it is as far off, in a columns file"
        )
    elif unit == "rad" and abs(q[row]) > 2 * np.pi:
        qd = f" (`deg/s` for {name}.qd)" if speed_as_position(m, name) else ""
        way_out = f"Write `unit: deg` for {name}.q and {name}.q_target{qd} in a columns file; of ticks, rad of one as `factor:`"
    else:
        way_out = f"Write the `unit:` of {name}.q and {name}.q_target in a columns file, `factor: -1` if their sign is reversed"
    text = (
        f"{name} is at {q[row]:.4g} {unit} at {m.time_s[row]:.3f} s, its limits in {file} are [{low:.4g}, {high:.4g}]. "
        f"{way_out}; or correct these, [{min(low, float(np.nanmin(q))):.4g}, {max(high, float(np.nanmax(q))):.4g}] hold all of it"
    )
    return [find("beyond_limits", name, text, (row, row + 1))]


def unsigned_efforts(
    m: Measurement, name: str, slope: int = 0, nearer: float = 0.5
) -> list[UnsignedColumn]:
    """Registers by which the efforts of signal ``name`` are ``nearer`` to 0 than the
    column's numbers, on average; nearest first. ``slope``: sign of the recorded efforts
    against their law; 0: not known. Above 0 they rise with the law, which sign and
    magnitude below 0 do not."""
    effort = m.effort[:, m.column(name)]
    size = float(np.nanmean(np.abs(effort))) if np.isfinite(effort).any() else 0.0
    means = [
        (float(np.nanmean(np.abs(own.decoded(effort)))), own)
        for own in m.registers
        if own.signal == name and own.quantity == "tau" and not own.changes
    ]
    falls = {-1: True, 0: None, 1: False}[slope]
    near = [
        pair
        for pair in means
        if pair[0] < nearer * size
        and falls in (None, pair[1].register.key == "sign_bit")
    ]
    return [own for _, own in sorted(near, key=lambda pair: pair[0])]


def _against_law(
    law: DriveLaw, m: Measurement, name: str, effort: np.ndarray
) -> tuple[float, float, float] | None:
    """(slope, constant, RMS of the rest) of ``effort`` (T,) of signal ``name`` over the
    torque of the file's law at the rows' own targets, positions and speeds [N·m, N]; None
    if the recording does not determine them."""
    torque = law_torque(law, m, name)
    rows = np.isfinite(effort) if torque is None else np.isfinite(effort + torque)
    if torque is None or not rows.any() or np.ptp(torque[rows]) == 0.0:
        return None
    columns = np.column_stack([torque[rows], np.ones(rows.sum())])
    solved, *_ = np.linalg.lstsq(columns, effort[rows], rcond=None)
    rest = effort[rows] - columns @ solved
    return float(solved[0]), float(solved[1]), float(np.sqrt(np.mean(rest**2)))


def law_torque(law: DriveLaw, m: Measurement, name: str) -> np.ndarray | None:
    """(T,) torque of the file's ``law`` at the rows' own targets and positions, NaN in the
    first row [N·m, N]; None for a law without a gain of the position or speed."""
    if law.law in ("pwm", "effort", "torque"):
        return None
    j, late = m.column(name), 0 if law.effort_after_target else 1
    kp, kd, torque_ff = law.loop_gains
    kp_scale, kd_scale = law.gain_scales(name, m)
    q, target = m.measured[:, j], np.roll(m.target[:, j], late)
    speed = kd * kd_scale * np.gradient(q, m.period_s)
    wanted = kd * kd_scale * target
    if law.target_kind == "position":
        wanted = kp * kp_scale * (target - q)
    torque = wanted - speed + torque_ff
    if m.torque_ff.size:
        torque = torque + np.roll(m.torque_ff[:, j], late)
    torque[0] = np.nan
    return torque


def unsigned_by_law(law: DriveLaw, m: Measurement, name: str) -> list[Finding]:
    """Finding on efforts that follow the file's law, without a constant torque, only if
    they are read as a register that a driver logged without its sign; empty if none
    does."""
    effort = m.effort[:, m.column(name)]
    best: tuple[float, UnsignedColumn] | None = None
    for own in unsigned_efforts(m, name, nearer=math.inf):
        signed = own.decoded(effort)
        found = _against_law(law, m, name, signed)
        if found is None:
            continue
        slope, constant, rest = found
        off = abs(constant) / own.half
        alike = 1 / INERTIA_OFF <= slope <= INERTIA_OFF
        if alike and off < BY_LAW and rest < SIGN_SURE * float(np.nanstd(signed)):
            best = min((off, own), best or (math.inf, own), key=lambda pair: pair[0])
    if best is not None:
        off, own = best
        why = (
            "read so, it is the effort of the drive's law and a constant of "
            f"{off:.1%} of half the register's range; as it is, that constant is far larger"
        )
        return [unsigned_register(own, why)]
    for own in unsigned_efforts(m, name):
        if float(np.nanmax(np.abs(own.decoded(effort)))) < BY_ITSELF * own.half:
            why = f"all its numbers lie within {BY_ITSELF:.0e} of one that is no effort"
            return [unsigned_register(own, why)]
    return []


@check("error", "beyond_effort")
def beyond_effort(
    law: DriveLaw, m: Measurement, name: str, file: str, fit: LawFit | None = None
) -> list[Finding]:
    """Finding on reported efforts above ``EFFORT_BEYOND`` times the stated ``effort_limit``, or of a register without its sign;
    empty if there are none. ``law``: the drive of signal ``name``. ``file``: name of its file, for the message. ``fit``: law
    that the recorded efforts follow."""
    limit, j = law.effort_limit, m.column(name)
    if not m.has_effort()[j]:
        return []
    if limit is None:
        return unsigned_by_law(law, m, name)
    row = int(np.nanargmax(np.abs(m.effort[:, j])))
    if abs(m.effort[row, j]) <= EFFORT_BEYOND * limit:
        return unsigned_by_law(law, m, name)
    if found := unsigned_by_law(law, m, name):
        return found
    slope = 0 if fit is None else fit.sign
    for own in unsigned_efforts(m, name, slope):
        largest = float(np.nanmax(np.abs(own.decoded(m.effort[:, j]))))
        if largest <= EFFORT_BEYOND * limit:
            why = f"{m.effort[row, j]:.4g} {UNITS[m.units[j]][1]} are beyond its effort_limit of {limit:g}"
            return [unsigned_register(own, why)]
    text = (
        f"{name} reports {m.effort[row, j]:.4g} {UNITS[m.units[j]][1]} at {m.time_s[row]:.3f} s, its effort_limit is {limit:g}. "
        f"Is it a current (mA), or the torque before the gear? Write the torque of one such unit at the joint as "
        f"{_line(m, name)}, or correct `effort_limit:` in {file}"
    )
    return [find("beyond_effort", name, text, (row, row + 1))]


def _line(m: Measurement, name: str, factor: str = "…") -> str:
    """Place at which a user writes the factor that converts recorded efforts to N·m or N: a columns file for tables,
    measurements.yaml for recordings."""
    scale = (
        f"`effort_scale: {{{name}: {factor}}}` of the recording in measurements.yaml"
    )
    return write(m, f"`factor: {factor}` for {name}.tau in a columns file", scale)


@check("error", "reversed_effort", explains=("effort_time",))
def reversed_effort(
    m: Measurement, name: str, left: float, fit: LawFit | None
) -> list[Finding]:
    """Finding on an effort with the wrong sign: by its law, which no mass changes, or where no law shows the sign by inertia.
    ``left``: share that the effort with the opposite sign leaves of what it leaves as it is."""
    sign = 0 if fit is None else fit.sign
    if sign > 0 or (sign == 0 and left >= math.sqrt(1.0 - INERTIA_SURE**2)):
        return []
    for own in unsigned_efforts(m, name, slope=-1):
        if np.nanmax(own.decoded(m.effort[:, m.column(name)])) <= 0.0:
            return [unsigned_register(own, "it falls where its law asks for more")]
    if fit is not None and sign < 0:
        why = f"is {fit.kp:.2f} ± {fit.sd[0]:.2f} times what its law makes of target and position"
    else:
        why = f"pushes against its acceleration: of it the opposite sign leaves {left:.0%} of what it leaves as it is"
    sure, line = sign < 0 or left < REVERSED_LEFT, _line(m, name, "-1")
    way = f"Its sign is reversed; write {line}"
    if not sure:
        way = f"Weight or centre of mass of what moves are not the model's, or its sign is reversed, which {line} mends"
    return [
        find(
            "reversed_effort",
            name,
            f"effort of {name} {why}. {way}",
            severity="error" if sure else "warning",
        )
    ]


def in_degrees(ratio: float, signal: str, unit: str) -> str:
    """Text: the line to write if positions in degrees explain an inertia of ``ratio`` times the stated one; else empty."""
    if unit != "rad" or abs(math.log(ratio / DEGREES)) > NEAR_DEGREES:
        return ""
    line = f"`unit: deg` for {signal}.q and {signal}.q_target in a columns file"
    return f" Positions in degrees make it 0.0175 times: then write {line}."


@check("error", "wrong_inertia")
def wrong_inertia(
    model: JointModel,
    m: Measurement,
    fit: LawFit | None,
    words: Callable[[JointMotion, float, float], str],
    factor: float = 1.0,
) -> list[Finding]:
    """Finding that the efforts show another inertia than the file states; empty if they agree to ``INERTIA_OFF``. The inertia is
    the factor of the acceleration in a least-squares fit of effort / ``factor`` by acceleration, velocity, its sign, sine and
    cosine of the angle, and a constant.

    Args:
        fit: law that the recorded efforts follow.
        words: function of (motion, fitted inertia, stated inertia [kg·m², kg]) that returns the text of the finding.
    """
    name = model.signal
    j = m.column(name)
    q, torque, is_off = (
        m.measured[:, j],
        m.effort[:, j] / factor,
        m.enabled.size and not m.enabled[:, j].all(),
    )
    rows = max(5, 2 * round(0.5 * SMOOTH_S * m.rate_hz) + 1)
    known = (
        m.has_effort()[j]
        and np.isfinite([q, torque, m.target[:, j]]).all()
        and not is_off
    )
    if not known or m.num_rows < 4 * rows:
        return []
    motion = motion_of(m, name, model.joint)
    v, a = (savgol_filter(q, rows, 2, deriv=d, delta=m.period_s) for d in (1, 2))
    others = np.column_stack([v, np.sign(v), np.sin(q), np.cos(q), np.ones_like(q)])
    # What the other joints' motion asks of this one is no inertia of its own; reversed efforts hold the opposite of it.
    a = _beside(a, others)
    coupling = motion.coupling_nm[:: len(motion.coupling_nm) // m.num_rows]
    asked = {sign: savgol_filter(sign * torque - coupling, rows, 2) for sign in (1, -1)}
    left = {sign: _beside(own, others) for sign, own in asked.items()}
    seen = {
        sign: float(a @ own) / max(float(a @ a), 1e-300) for sign, own in left.items()
    }
    remains = {
        sign: float(np.linalg.norm(own - max(seen[sign], 0.0) * a))
        for sign, own in left.items()
    }
    against = remains[-1] / max(remains[1], 1e-300) if seen[-1] > 0.0 else 1.0
    if reversed_ := reversed_effort(m, name, against, fit):
        return reversed_
    size = float(np.linalg.norm(a) * np.linalg.norm(left[1]))
    if size == 0.0 or float(a @ left[1]) / size < INERTIA_SURE:
        return []
    stated = model.inertia_kgm2(motion)
    if 1 / INERTIA_OFF <= seen[1] / stated <= INERTIA_OFF:
        return []
    return [find("wrong_inertia", name, words(motion, seen[1], stated))]


def _inertia_words(
    robot: Robot,
    m: Measurement,
    model: JointModel,
    motion: JointMotion,
    seen: float,
    known: float,
) -> str:
    name = model.signal
    if not robot.config.model:
        return _stated_inertia_words(robot, name, motion, seen, known)
    nearest = min(
        robot.rigid.joints.values(),
        key=lambda f: abs(np.log(max(f.inertia + f.armature, 1e-9) / seen)),
    ).name
    hint = (
        f" That is the size of {nearest}: are columns exchanged?"
        if nearest != name
        else ""
    )
    unit, rotor = (
        "kg·m²" if model.unit == "rad" else "kg",
        model.joint.rigid(motion, []).rotor_inertia,
    )
    if seen > known and rotor == 0.0:  # a small joint is mostly rotor
        hint = f" It has no rotor: a motor behind a gear adds its own, here `rotor_inertia: {seen - known:.3g}`.{hint}"
    return (
        f"effort and acceleration of {name} say {seen:.3g} {unit}, the model with its rotor {known:.3g}: {seen / known:.2g} "
        f"times.{hint}{in_degrees(seen / known, name, model.unit)} Else its effort is in another unit: write "
        f"{_line(m, name)}, or rotor_inertia and gear of {name} in {robot.path.name}"
    )


def _stated_inertia_words(
    robot: Robot, name: str, motion: JointMotion, seen: float, known: float
) -> str:
    degrees = in_degrees(seen / known, name, robot.units[name])
    stated = max(seen - motion.mounted_kgm2, 1e-3 * seen)
    line = f"`inertia: {stated:.3g}`"
    otherwise = f"Else write {line}" if degrees else f"Write {line}"
    return (
        f"effort and acceleration of {name} say {seen:.3g} "
        f"{robot.joint(name).scale.unit_of('kg·m²')}, its file {known:.3g}: "
        f"{seen / known:.2g} times.{degrees} {otherwise}, or the right unit or factor of "
        f"q and tau in a columns file"
    )
