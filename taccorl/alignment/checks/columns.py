"""Columns of a joint against the model of a robot file: another joint's columns, and a sign
that is turned in all of them. Target and position agree there, so that only the model shows
it; no effect is needed once the columns are right.

Three torques of a joint must agree: the recorded effort, that of its stated drive at target
and position, and that which links and rotor ask. Columns of two joints are exchanged if two
of the three agree far better with the columns of both exchanged; a joint is turned if its
effort is that of the links with its sign reversed.

Letters in shapes: T rows, R of every few rows, J signals.
"""

import copy
import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.checks.trial import write
from taccorl.alignment.checks.wiring import velocity_gain
from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.measurements.measurement import UNITS, Measurement
from taccorl.data.finding import Finding

OFF = 0.05
"""Torques of a joint disagree above this share of their RMS. A choice."""
BETTER = 1 / 3
"""Columns are exchanged if the exchange leaves less than this share of the disagreement, by
the geometric mean of both joints, and less at each. A choice."""
TURNED = 0.5
"""What a turned sign leaves of the effort is at most this share of what the sign as it is
leaves. A choice."""
SURELY = 0.2
"""A reversed sign is an error if reversing it leaves less than this share of the residual,
else a warning: another centre of mass can look like it. A choice."""
AS_GOOD = 1.2
"""Turning a sign fits no number: it may leave this many times what a fit with a free weight
and spring leaves. A choice."""
SMOOTH_S = 0.1
"""Window of the quadratics whose slopes are velocity and acceleration [s]."""
MOST_ROWS = 200
"""Rows of one recording at which the model is evaluated."""
NO_WEIGHT, SURELY_NONE = 0.2, 0.05
"""Efforts lack the carried weight if what they lack is a multiple of it that is within the first of 1, with a correlation above
1 less the first, and in one comparison above 1 less the second: with another centre of mass it was 0.93. Choices."""
COLUMNS = ("measured", "target", "velocity", "effort")
"""Arrays (T, J) of a measurement that hold a joint's columns."""
EXCHANGES = (
    COLUMNS,
    COLUMNS[:-1],
    tuple(name for name in COLUMNS if name != "target"),
    ("effort",),
)
"""Columns that may be exchanged together."""
PAIRS = (("effort", "drive"), ("effort", "links"), ("drive", "links"))
"""Torques that are compared."""
_Moved = Mapping[str, Sequence[Measurement]]
"""Joint → recordings that move it, with all signals."""


class _Torques(NamedTuple):
    """Torques [N·m, N] and motion of all signals in one recording, (R, J) each; NaN where a
    torque is not known."""

    effort: np.ndarray
    drive: np.ndarray
    links: np.ndarray
    carried: np.ndarray
    """Weight that the controller carries, a part of ``drive``."""
    position: np.ndarray
    speed: np.ndarray


class _Exchange(NamedTuple):
    """Two joints whose torques agree far better with columns exchanged."""

    pair: tuple[str, str]
    recordings: Sequence[Measurement]
    columns: Sequence[str]
    torques: tuple[str, str]
    """Those that agree."""
    ratio: float
    """Their disagreement with columns exchanged over that without; mean of both joints."""


@check(
    "error",
    "effort_without_weight",
    explains=("effort_time", "other_gains", "other_scale", "wrong_inertia"),
)
def check_columns(
    robot: Robot, recordings: _Moved, found: dict[str, list[Finding]]
) -> None:
    """Add errors to ``found`` (recording → findings)."""
    every = list({m.name: m for own in recordings.values() for m in own}.values())
    as_is = {
        m.name: torques for m in every if (torques := _torques(robot, m)) is not None
    }
    known = [m for m in every if m.name in as_is]
    off = [
        name
        for name in recordings
        if (_disagreements(known, list(as_is.values()), name) > OFF).any()
    ]
    pairs = [
        one
        for pair in itertools.combinations(off, 2)
        if robot.units[pair[0]] == robot.units[pair[1]]
        and (one := _exchanged(robot, pair, recordings, known, as_is, found))
    ]
    named: set[str] = set()
    for one in sorted(pairs, key=lambda one: one.ratio):
        if not named & {*one.pair}:
            named |= {*one.pair}
            _tell(one, found)
    bare = [
        name
        for name in recordings
        if name not in named and _without_weight(list(as_is.values()), known, name)
    ]
    if bare:
        text = (
            f"efforts of {', '.join(bare)} lack the weight that the controller carries (`gravity_compensation` of "
            f"{robot.path.name}): without it they are those of kp and kd. Log the torque with it, or leave the efforts out"
        )
        for m in recordings[bare[0]]:
            found[m.name].append(find("effort_without_weight", bare[0], text))
    elif off:
        _turned(robot, recordings, known, as_is, found)


def _without_weight(
    torques: Sequence[_Torques], known: Sequence[Measurement], name: str
) -> bool:
    """Whether the recorded efforts of joint ``name`` lack the weight that the controller compensates.

    They do if the weight is missing in two comparisons, each with friction removed: efforts beside the torque of the drive's
    law (kp, kd, targets), and efforts beside the inverse dynamics of the links and rotors."""
    lacks = np.zeros(
        (2, 3)
    )  # of drive and links: products of the difference and the weight
    for own, m in zip(torques, known, strict=True):
        j = m.column(name)
        speed = own.speed[:, j]
        others = np.column_stack([_friction(own, j)[:, :2], np.gradient(speed)])
        weight = _beside(own.carried[:, j], others)
        for k, whole in enumerate((own.drive, own.links)):
            rest = _beside(whole[:, j] - own.effort[:, j], others)
            lacks[k] += [rest @ weight, rest @ rest, weight @ weight]
    cross, rest, weight = lacks.T
    with np.errstate(divide="ignore", invalid="ignore"):
        share, likeness = cross / weight, cross / np.sqrt(rest * weight)
    near = (np.abs(share - 1.0) < NO_WEIGHT) & (likeness > 1.0 - NO_WEIGHT)
    return bool(near.all() and likeness.max() > 1.0 - SURELY_NONE)


def _exchanged(
    robot: Robot,
    pair: tuple[str, str],
    recordings: _Moved,
    known: Sequence[Measurement],
    as_is: Mapping[str, _Torques],
    found: Mapping[str, Sequence[Finding]],
) -> _Exchange | None:
    """None: their columns are not exchanged, or these recordings do not show it."""
    names = {m.name for joint in pair for m in recordings[joint]}
    if any(  # it is their unit that is wrong
        f.check == "beyond_limits" and f.feature in pair
        for name in names
        for f in found[name]
    ):
        return None
    own = [m for m in known if m.name in names]
    old = np.array([_disagreements(own, [as_is[m.name] for m in own], n) for n in pair])
    best, least_of_all = None, np.inf
    for columns in EXCHANGES:
        swapped = [_swapped(m, *pair, columns) for m in own]
        torques = [_torques(robot, m) for m in swapped]
        new = np.array([_disagreements(swapped, torques, n) for n in pair])
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = new / old
            means = np.sqrt(ratios.prod(axis=0))  # NaN: a torque is not known
        shown = [
            _Exchange(pair, own, columns, compared, mean)
            for compared, mean, largest in zip(
                PAIRS, means.tolist(), ratios.max(axis=0).tolist(), strict=True
            )
            if mean < BETTER and largest < 1.0
        ]
        # Several may explain one pair of torques; all pairs together tell which it is.
        of_all = float(np.nanprod(means))
        if shown and of_all < least_of_all:
            best, least_of_all = min(shown, key=lambda one: one.ratio), of_all
    return best


def _tell(one: _Exchange, found: dict[str, list[Finding]]) -> None:
    """Add an error to ``found`` of each recording."""
    which = "efforts" if len(one.columns) == 1 else "columns"
    text = (
        f"{' and '.join(one.pair)}: their {which} are exchanged: the torques of "
        f"{' and '.join(one.torques)} agree {1 / max(one.ratio, 1e-3):.2g} times as well with "
        f"the {which} of the two exchanged. {_exchange(one.recordings, one.pair, one.columns)}"
        ", or exchange their names in the model"
    )
    topic = " ↔ ".join(sorted(one.pair))
    names = sorted(m.name for m in one.recordings)
    for name, feature in itertools.product(names, one.pair):
        found[name].append(
            find("swapped_joints", feature, text, severity="error", topic=topic)
        )


def _exchange(
    moved: Sequence[Measurement], pair: tuple[str, str], columns: Sequence[str]
) -> str:
    """Text: the columns file that exchanges the ``columns`` of the two, velocities if they
    follow their own positions."""
    j, k = at = [moved[0].column(name) for name in pair]
    own = sum(velocity_gain(m, i, i) is not None for m in moved for i in (j, k))
    other = sum(
        velocity_gain(m, *p) is not None for m in moved for p in ((j, k), (k, j))
    )
    keys = {"measured": "q", "target": "q_target", "velocity": "qd", "effort": "tau"}
    if own < other:
        del keys["velocity"]
    used = [
        key
        for column, key in keys.items()
        if column in columns
        and all(np.isfinite(getattr(m, column)[:, at]).all() for m in moved)
    ]
    sides = [(a, b, key) for key in used for a, b in (pair, pair[::-1])]
    changes = ", ".join(f"{a}.{key}: {{column: {b}.{key}}}" for a, b, key in sides)
    file = (
        f"Write `changes: {{{changes}}}` into a columns file; in one with signals: exchange "
        "the same columns there"
    )
    spec = "Exchange the channels of the two in the recording spec"
    return write(moved[0], file, spec)


def _swapped(m: Measurement, a: str, b: str, columns: Sequence[str]) -> Measurement:
    order = list(range(len(m.signals)))
    j, k = m.column(a), m.column(b)
    order[j], order[k] = k, j
    return dataclasses.replace(
        m, **{name: getattr(m, name)[:, order] for name in columns}
    )


def _disagreements(
    recordings: Sequence[Measurement], torques: Sequence[_Torques | None], name: str
) -> np.ndarray:
    """(3,) RMS of the difference of each of ``PAIRS`` of joint ``name``, beside friction, a
    constant and, for links, a spring, over the RMS of the torques; NaN where a torque is not
    known."""
    squares = np.zeros((len(PAIRS), 2))
    for m, own in zip(recordings, torques, strict=True):
        if own is None:
            return np.full(len(PAIRS), np.nan)
        j = m.column(name)
        others = _friction(own, j)
        for k, (one, other) in enumerate(PAIRS):
            first, second = getattr(own, one)[:, j], getattr(own, other)[:, j]
            if not np.isfinite([first, second]).all():
                squares[k] += np.nan
                continue
            spring = own.position[:, [j]] if "links" in (one, other) else others[:, :0]
            left = _beside(first - second, np.hstack([others, spring]))
            size = _beside(first, others[:, 2:])
            squares[k] += [left @ left, size @ size]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(squares[:, 0] / squares[:, 1])


def _friction(own: _Torques, j: int) -> np.ndarray:
    """(R, 3) speed of signal ``j``, its sign, and 1."""
    speed = own.speed[:, j]
    return np.column_stack([speed, np.sign(speed), np.ones_like(speed)])


def _beside(x: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(R,) ``x`` without what the columns ``others`` (R, N) explain."""
    return x - others @ np.linalg.lstsq(others, x, rcond=None)[0]


def _torques(robot: Robot, m: Measurement) -> _Torques | None:
    """None if positions were not measured throughout."""
    window = max(5, 2 * round(0.5 * SMOOTH_S * m.rate_hz) + 1)
    known = [bool(np.isfinite(column).any()) for column in m.measured.T]
    q = np.where(known, m.measured, m.target)
    if m.num_rows < 4 * window or not np.isfinite(q).all():
        return None
    rows = slice(window, -window, max(1, m.num_rows // MOST_ROWS))

    def smooth(values: np.ndarray, slope: int = 0) -> np.ndarray:
        own = {"deriv": slope, "delta": m.period_s, "axis": 0, "mode": "nearest"}
        return savgol_filter(values, window, 2, **own)[rows]

    state = np.array([smooth(q, slope) for slope in range(3)])
    links, weight = _links(robot, m, state)
    drive, target = np.full_like(links, np.nan), smooth(m.target)
    for name, law in robot.config.joints.items():
        j = m.column(name)
        usual = law.law in ("impedance", "cascade") and law.target_kind == "position"
        if not usual or m.target_kind(name) != "position" or not known[j]:
            continue
        kp, kd, torque_ff = law.loop_gains
        kp_scale, kd_scale = law.gain_scales(name, m)
        error = target[:, j] - state[0, :, j]
        drive[:, j] = kp * kp_scale * error - kd * kd_scale * state[1, :, j]
        drive[:, j] += torque_ff + robot.config.gravity_compensation * weight[:, j]
        if law.effort_limit is not None:
            drive[:, j] = np.clip(drive[:, j], -law.effort_limit, law.effort_limit)
    carried = robot.config.gravity_compensation * weight
    return _Torques(smooth(m.effort), drive, links, carried, state[0], state[1])


def _links(
    robot: Robot, m: Measurement, state: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Two (R, J) torques [N·m, N]: that which positions, speeds and accelerations, ``state``
    (3, R, J), ask of links and rotors, and the weight that a controller knows."""
    rotors = [
        robot.config.joints[n].armature if n in robot.config.joints else 0.0
        for n in m.signals
    ]
    asked, weight = np.array(rotors) * state[2], np.zeros(state.shape[1:])
    model = copy.copy(robot.rigid.model)
    known = model.opt.gravity.copy()
    data = mujoco.MjData(model)
    joints = [model.joint(signal) for signal in m.signals]
    q_at = [int(joint.qposadr[0]) for joint in joints]
    v_at = [int(joint.dofadr[0]) for joint in joints]
    for t in range(len(asked)):
        data.qpos[q_at] = state[0, t]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for torques, gravity, motion in (
            (weight, known, np.zeros_like(state[1:, t])),
            (asked, known + robot.more_gravity, state[1:, t]),
        ):
            model.opt.gravity[:] = gravity
            data.qvel[v_at], data.qacc[v_at] = motion
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 1, data.qfrc_inverse)
            torques[t] += data.qfrc_inverse[v_at]
    return asked, weight


def _turned(
    robot: Robot,
    recordings: _Moved,
    known: Sequence[Measurement],
    as_is: Mapping[str, _Torques],
    found: dict[str, list[Finding]],
) -> None:
    """Report a joint whose efforts are explained far better if its sign is reversed. Efforts
    are fitted by the torque of the links times a factor, damping, dry friction and a constant:
    as recorded, with one joint reversed, with a free weight and spring."""
    judged = {}  # joint → recordings that move it, with its effort
    for name, own in recordings.items():
        names = {m.name for m in own}
        used = [m for m in known if m.name in names]
        used = [m for m in used if m.has_effort()[m.column(name)]]
        if used:
            judged[name] = used
    if not judged:
        return
    plain = {n: _left(judged[n], as_is, n) for n in judged}
    free = {n: _left(judged[n], as_is, n, free=True) for n in judged}
    errors: dict[str, dict[str, float]] = {}  # turned joint → joint → what it leaves
    for k in robot.config.joints:
        measured = [m for m in known if np.isfinite(m.measured[:, m.column(k)]).any()]
        sign = {m.name: np.where(np.array(m.signals) == k, -1.0, 1.0) for m in measured}
        torques = {
            m.name: turned
            for m in measured
            if (turned := _torques(robot, _with_sign(m, sign[m.name]))) is not None
        }
        left = {
            n: _left(own, torques, n)
            for n, own in judged.items()
            if all(m.name in torques for m in own)
        }
        clear = any(
            e < TURNED * plain[n] and e < AS_GOOD * free[n] for n, e in left.items()
        )
        if clear and all(e < AS_GOOD * plain[n] for n, e in left.items()):
            errors[k] = left
    total = {
        k: sum(e / max(plain[n], 1e-300) for n, e in left.items())
        for k, left in errors.items()
    }
    k = min(total, key=lambda k: total[k], default="")
    if not k:
        return
    alike = [o for o in total if o != k and total[o] < AS_GOOD * total[k]]
    turned = [k, *alike]
    name = min(errors[k], key=lambda n: errors[k][n] / max(plain[n], 1e-300))
    unit = UNITS[robot.units[name]][1]
    sure = errors[k][name] < SURELY * plain[name]
    text = (
        f"the sign of {' or of '.join(turned)} is turned in all columns: the rigid model "
        f"leaves {plain[name]:.3g} {unit} (RMS) of the effort of {name}, "
        f"{errors[k][name]:.3g} with it turned, and {free[name]:.3g} with any weight or spring "
        f"that {name} lacks. Write `factor: -1` for {k}.q, {k}.q_target and {k}.tau (and "
        f"{k}.qd) in a columns file; if the robot hangs or leans, state its `gravity` first"
    )
    if not sure:
        text += (
            ". Another centre of mass of a link or another payload may look like this"
        )
    if alike:
        text += "; these recordings do not tell which of the joints it is"
    severity = "error" if sure else "warning"
    for m in recordings[name]:
        found[m.name].append(
            find("wrong_sign", name, text, severity=severity, topic=f"sign of {k}")
        )


def _with_sign(m: Measurement, sign: np.ndarray) -> Measurement:
    return dataclasses.replace(m, **{name: getattr(m, name) * sign for name in COLUMNS})


def _left(
    recordings: Sequence[Measurement],
    torques: Mapping[str, _Torques],
    name: str,
    *,
    free: bool = False,
) -> float:
    """RMS of the effort of joint ``name`` without a positive multiple of the torque of its
    links, friction and a constant; ``free``: without any weight and spring, too."""
    effort, links, others = [], [], []
    for m in recordings:
        own, j = torques[m.name], m.column(name)
        effort.append(own.effort[:, j])
        links.append(own.links[:, j])
        q = own.position[:, j]
        more = [q, np.sin(q), np.cos(q)] if free else []
        others.append(np.column_stack([_friction(own, j), *more]))
    y, beside = np.concatenate(effort), np.concatenate(others)
    columns = np.column_stack([np.concatenate(links), beside])
    solution = np.linalg.lstsq(columns, y, rcond=None)[0]
    if solution[0] <= 0.0:
        return float(np.sqrt(np.mean(_beside(y, beside) ** 2)))
    return float(np.sqrt(np.mean((y - columns @ solution) ** 2)))
