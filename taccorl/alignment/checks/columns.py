"""Columns of a joint against the model of a robot file: another joint's columns, and a sign that is turned in all of them. Target
and position agree there, so that only the model shows it; no effect is needed once the columns are right.

Letters in shapes: T rows, J signals.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from taccorl.alignment.checks.effort_time import law_left
from taccorl.alignment.checks.registry import find
from taccorl.alignment.checks.robot import beyond_limits
from taccorl.alignment.checks.trial import noise_of_rows, write
from taccorl.alignment.checks.wiring import velocity_gain
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.machines.robot_joint import under_gravity
from taccorl.alignment.measurements.measurement import UNITS, Measurement
from taccorl.data.finding import Finding

FAR, NEAR = 10.0, 3.0
"""A replay is far off above the first multiple of the noise, and right below the second one. Choices."""
INEXACT = 0.01  # Share of the tracking error that counts as noise: equations and times are no better. A choice.
BETTER = 1 / 3
"""Columns are exchanged, beside another fault that ``NEAR`` would not forgive, if the exchange leaves less than this share of the
error, by the geometric mean of both joints. A choice."""
LAW_OFF, LAW_NEAR = 0.1, 0.45
"""Shares of the RMS effort. If the law of its own joint leaves more of an effort than the first, laws of other joints are fitted
to it; one of them is accepted if it leaves at most the second. Choices."""
TURNED = 0.5
"""What a turned sign leaves of the effort is at most this share of what the sign as it is leaves. A choice."""
SURELY = 0.2
"""A reversed sign is an error if reversing it leaves less than this share of the residual, else a warning: another centre of mass
can look like it. A choice."""
AS_GOOD = 1.2
"""Turning a sign fits no number: it may leave this many times what a fit with a free weight and spring leaves. A choice."""
SMOOTH_S = (
    0.1  # Window of the quadratics whose slopes are velocity and acceleration [s]
)
MOST_ROWS = 400  # Rows of one recording at which the model is evaluated
FREE = (
    "a weight or spring"  # key of what is left beside the free numbers of such effects
)
COLUMNS = ("measured", "target", "velocity", "effort")  # Arrays (T, J) of a measurement
_Moved = Mapping[
    str, Sequence[Measurement]
]  # Joint → recordings that move it, with all signals


def check_columns(
    robot: Robot, recordings: _Moved, found: dict[str, list[Finding]]
) -> None:
    """Add errors to ``found`` (recording → findings)."""
    for pair in itertools.combinations(recordings, 2):
        if robot.units[pair[0]] == robot.units[pair[1]]:
            _exchanged(robot, pair, recordings, found)
    _turned(robot, recordings, found)


def _exchanged(
    robot: Robot,
    pair: tuple[str, str],
    recordings: _Moved,
    found: dict[str, list[Finding]],
) -> None:
    """With the columns of the two exchanged the replay, far off as it is, is right in all that decide it, or far better at both
    joints; or the efforts of both follow the law of the other. Of one joint that moved alone both must hold."""
    other, rows = dict(zip(pair, reversed(pair), strict=True)), []
    for name in pair:
        for m in recordings[name]:
            laws = {
                kind
                for n in pair
                for kind in (m.target_kind(n), robot.config.joints[n].target_kind)
            }
            if (
                laws != {"position"}
                or not np.isfinite(m.measured[:, [m.column(n) for n in pair]])
                .any(axis=0)
                .all()
            ):
                return
            swapped = _swapped(m, *pair)
            limits = {n: robot.rigid.joints[n].limits for n in pair}
            if any(
                beyond_limits(swapped, n, limits[n], "") for n in pair
            ):  # it is their unit that is wrong
                return
            old, new = (
                _replay_error(robot, m, name),
                _replay_error(robot, swapped, other[name]),
            )
            rows.append((name, m.name, _noise(m, name), old, new))
    deciding = [
        row for row in rows if row[3] >= FAR * row[2]
    ]  # a slow motion may not: any joint follows its target
    near = [
        max(0.0 if old >= FAR * noise else old, NEAR * noise) >= new
        for _, _, noise, old, new in rows
    ]
    right = bool(deciding) and all(
        any(row[0] == n for row in deciding) or not recordings[n] for n in pair
    )
    right = right and all(near)
    # Also a motion that only the exchange leaves far off decides: against it.
    far = [
        (row[0], *np.maximum(row[3:], row[2]))
        for row in rows
        if max(row[3:]) >= FAR * row[2]
    ]
    logs = [[math.log(new / old) for name, old, new in far if name == n] for n in pair]
    replay = np.array(
        [math.exp(sum(own) / len(own)) if own else math.nan for own in logs]
    )
    by_law, law, has_effort = _law_ratios(robot, pair, recordings)
    sides = [k for k, n in enumerate(pair) if recordings[n]]
    both = (
        (replay, by_law)
        if len(sides) == 2
        else [np.array([replay[k], by_law[k]]) for k in sides]
    )
    if not (right or any(map(_far_better, both))):
        return
    told = deciding if right or _far_better(replay) else rows
    old, new = np.sqrt(np.mean([np.square(row[3:]) for row in told], axis=0))
    text = (
        f"{' and '.join(pair)} move as the model's {' and '.join(reversed(pair))}: their replay is off by {old:.2g} "
        f"{robot.units[pair[0]]} (RMS), with the columns of the two exchanged by {new:.2g}"
        f"{', as no effect leaves it' if right else ''}{law}. "
        f"{_exchange([m for n in pair for m in recordings[n]], pair, has_effort)}, or exchange their names in the model"
        f"{', or kp and kd where those are' if law else ''}{'' if right else '; another cause is there besides'}"
    )
    topic = " ↔ ".join(sorted(pair))
    for name, feature in itertools.product(sorted({row[1] for row in told}), pair):
        found[name].append(
            find("swapped_joints", feature, text, severity="error", topic=topic)
        )


def _exchange(
    moved: Sequence[Measurement], pair: tuple[str, str], has_effort: bool
) -> str:
    """Text: the columns file that exchanges the two, with velocities if they follow their own positions, and efforts if asked."""
    j, k = at = [moved[0].column(name) for name in pair]
    own, other = (
        sum(velocity_gain(m, *p) is not None for m in moved for p in ps)
        for ps in (((j, j), (k, k)), ((j, k), (k, j)))
    )
    extra = {"qd": ("velocity", own >= other), "tau": ("effort", has_effort)}
    keys = [
        n
        for n, (of, use) in extra.items()
        if use and all(np.isfinite(getattr(m, of)[:, at]).all() for m in moved)
    ]
    sides = [
        (a, b, key) for key in ("q", "q_target", *keys) for a, b in (pair, pair[::-1])
    ]
    changes = ", ".join(f"{a}.{key}: {{column: {b}.{key}}}" for a, b, key in sides)
    file = f"Write `changes: {{{changes}}}` into a columns file; in one with signals: exchange the same columns there"
    return write(
        moved[0], file, "Exchange the channels of the two in the recording spec"
    )


def _far_better(ratios: np.ndarray) -> bool:
    """Whether errors with the columns exchanged over those as they are leave no doubt: (2,) of both joints, or of replay and law
    of the only one that moved. False where one is unknown, NaN."""
    return bool(np.sqrt(np.prod(ratios)) < BETTER and ratios.max() < 1.0)


def _law_ratios(
    robot: Robot, pair: tuple[str, str], recordings: _Moved
) -> tuple[np.ndarray, str, bool]:
    """(2,) what the law of the other joint leaves of each one's efforts over what its own leaves, whatever friction or load there
    is; NaN where they are not known, or near their own law. A text on both, and whether efforts are exchanged, too."""
    joints = robot.config.joints
    gains = [(k, p) for p in pair for k in joints[p].gain_names]
    used = [
        [m for m in recordings[n] if all(p in getattr(m, k) for k, p in gains)]
        for n in pair
    ]

    def shares(names: tuple[str, ...], columns: Sequence[str]) -> np.ndarray:
        """(2,) shares of the efforts that the laws of ``names`` leave; NaN if they are not known."""
        found = []
        for name, own in zip(names, used, strict=True):
            left = [
                law_left(joints[name], _swapped(m, *pair, columns), name) for m in own
            ]
            error, effort = np.square([x for x in left if x] or [(math.nan, 1.0)]).sum(
                axis=0
            )
            found.append(math.sqrt(error / max(effort, 1e-300)))
        return np.array(found)

    as_is = shares(pair, ())
    as_is[as_is <= LAW_OFF] = math.nan
    if np.isnan(as_is).all():
        return as_is, "", True
    both = [shares(pair[::-1], columns) for columns in (COLUMNS, COLUMNS[:-1])]
    has_effort = bool(np.nanmax(both[0]) <= np.nanmax(both[1]))
    new = both[not has_effort]
    new[new > LAW_NEAR] = math.nan
    if np.isnan(new / as_is).all():
        return as_is * math.nan, "", has_effort
    words = f"; their laws leave {np.nanmean(as_is):.0%} of their efforts, those of each other {np.nanmean(new):.0%}"
    return new / as_is, words, has_effort


def _swapped(
    m: Measurement, a: str, b: str, columns: Sequence[str] = COLUMNS
) -> Measurement:
    order = list(range(len(m.signals)))
    j, k = m.column(a), m.column(b)
    order[j], order[k] = k, j
    return dataclasses.replace(
        m, **{name: getattr(m, name)[:, order] for name in columns}
    )


def _replay_error(robot: Robot, m: Measurement, name: str) -> float:
    """RMS [rad, m]."""
    model = JointModel(robot, name)
    left = (
        m.measured[:, m.column(name)]
        - model.simulate(motion_of(m, name, model.joint), model.gains).reported
    )
    return float(np.sqrt(np.nanmean(left**2)))


def _noise(m: Measurement, name: str) -> float:
    j = m.column(name)
    q = m.measured[np.isfinite(m.measured[:, j]), j]
    return max(
        noise_of_rows(q),
        float(m.quantum[j]),
        INEXACT * float(np.nanstd(m.measured[:, j] - m.target[:, j])),
    )


def _turned(robot: Robot, recordings: _Moved, found: dict[str, list[Finding]]) -> None:
    """Report a joint whose efforts are explained far better if its sign is reversed. Efforts are fitted by the rigid-body torque
    times a factor, damping, dry friction and a constant: as recorded, with one joint reversed, with a free weight and spring."""
    parts: dict[str, list[_Torques]] = {name: [] for name in recordings}
    for m in {m.name: m for own in recordings.values() for m in own}.values():
        for name, part in _torques(robot, m).items():
            if any(m.name == one.name for one in recordings[name]):
                parts[name].append(part)
    left: dict[str, dict[str, float]] = {}
    for name, own in parts.items():
        if own:
            keys = [k for k in own[0].asked if all(k in p.asked for p in own)]
            effort, others = (
                np.concatenate([p.effort for p in own]),
                np.concatenate([p.others for p in own]),
            )
            asked = {k: np.concatenate([p.asked[k] for p in own]) for k in keys}
            left[name] = {
                k: _left(effort, torque, others) for k, torque in asked.items()
            }
            free = np.column_stack([others, np.concatenate([p.place for p in own])])
            left[name][FREE] = _left(effort, asked[""], free)

    def explains(k: str) -> bool:
        with_it = [
            (errors[k], errors[""], errors[FREE])
            for errors in left.values()
            if k in errors
        ]
        clear = any(
            other < TURNED * as_it_is and other < AS_GOOD * free
            for other, as_it_is, free in with_it
        )
        return clear and all(
            other < AS_GOOD * as_it_is for other, as_it_is, _ in with_it
        )

    better = [k for k in robot.config.joints if explains(k)]
    total = {
        k: sum(e[k] / max(e[""], 1e-300) for e in left.values() if k in e)
        for k in better
    }
    k = min(total, key=lambda k: total[k], default="")
    if k:
        turned = [
            k,
            *(
                other
                for other in total
                if other != k and total[other] < AS_GOOD * total[k]
            ),
        ]
        name = min(
            (n for n in left if k in left[n]),
            key=lambda n: left[n][k] / max(left[n][""], 1e-300),
        )
        errors, unit = left[name], UNITS[robot.units[name]][1]
        sure = errors[k] < SURELY * errors[""]
        text = (
            f"the sign of {' or of '.join(turned)} is turned in all columns: the rigid model leaves {errors['']:.3g} {unit} "
            f"(RMS) of the effort of {name}, {errors[k]:.3g} with it turned, and {errors[FREE]:.3g} with any weight or spring "
            f"that {name} lacks. Write `factor: -1` for {k}.q, {k}.q_target and {k}.tau (and {k}.qd) in a columns file; if the "
            "robot hangs or leans, state its `gravity` first"
            f"{'' if sure else '. Another centre of mass of a link or another payload may look like this'}"
            f"{'; these recordings do not tell which of the joints it is' * (len(turned) > 1)}"
        )
        severity = "error" if sure else "warning"
        for m in recordings[name]:
            found[m.name].append(
                find("wrong_sign", name, text, severity=severity, topic=f"sign of {k}")
            )


def _left(effort: np.ndarray, torque: np.ndarray, others: np.ndarray) -> float:
    """RMS of ``effort`` (T,) without a positive multiple of ``torque`` (T,) and the columns of ``others`` (T, N)."""
    columns = np.column_stack([torque, others])
    solution = np.linalg.lstsq(columns, effort, rcond=None)[0]
    if solution[0] <= 0.0:
        columns = others
        solution = np.linalg.lstsq(columns, effort, rcond=None)[0]
    return float(np.sqrt(np.mean((effort - columns @ solution) ** 2)))


class _Torques(NamedTuple):
    """One joint in one recording, at every few rows."""

    effort: np.ndarray  # (T,)
    asked: dict[
        str, np.ndarray
    ]  # Turned joint, "" for none → (T,) torque that the rigid model asks of this one
    others: np.ndarray  # (T, 3) speed, its sign, 1
    place: np.ndarray  # (T, 3) position, its sine and cosine


def _torques(robot: Robot, m: Measurement) -> dict[str, _Torques]:
    """Joint with measured effort → its torques; empty if positions were not measured throughout."""
    window = max(5, 2 * round(0.5 * SMOOTH_S * m.rate_hz) + 1)
    known = [bool(np.isfinite(column).any()) for column in m.measured.T]
    q = np.where(known, m.measured, m.target)
    names = [
        n for n in robot.config.joints if np.isfinite(m.effort[:, m.column(n)]).all()
    ]
    if m.num_rows < 4 * window or not np.isfinite(q).all() or not names:
        return {}
    rows = slice(window, -window, max(1, m.num_rows // MOST_ROWS))
    state = np.array(
        [
            savgol_filter(q, window, 2, deriv=d, delta=m.period_s, axis=0)[rows]
            for d in range(3)
        ]
    )
    turned = [k for k in robot.config.joints if known[m.column(k)]]
    signs = {
        k: np.array([1.0 - 2.0 * (signal == k) for signal in m.signals])
        for k in ("", *turned)
    }
    asked = {k: sign * _rigid(robot, m, state * sign) for k, sign in signs.items()}
    found = {}
    for name in names:
        j = m.column(name)
        at, speed = state[0, :, j], state[1, :, j]
        others = np.column_stack([speed, np.sign(speed), np.ones_like(speed)])
        effort = savgol_filter(m.effort[:, j], window, 2)[rows]
        place = np.column_stack([at, np.sin(at), np.cos(at)])
        found[name] = _Torques(
            effort, {k: torques[:, j] for k, torques in asked.items()}, others, place
        )
    return found


def _rigid(robot: Robot, m: Measurement, state: np.ndarray) -> np.ndarray:
    """(T, J) torques [N·m, N] that positions, speeds and accelerations, ``state`` (3, T, J), ask: links and rotors."""
    rotors = [
        robot.config.joints[n].armature if n in robot.config.joints else 0.0
        for n in m.signals
    ]
    asked = np.array(rotors) * state[2]
    model = under_gravity(
        robot.rigid.model, robot.rigid.model.opt.gravity + robot.more_gravity
    )
    data, joints = mujoco.MjData(model), [model.joint(signal) for signal in m.signals]
    q_at, v_at = (
        [int(getattr(joint, key)[0]) for joint in joints]
        for key in ("qposadr", "dofadr")
    )
    for t in range(len(asked)):
        data.qpos[q_at], data.qvel[v_at], data.qacc[v_at] = state[:, t]
        for step in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            step(model, data)
        mujoco.mj_rne(model, data, 1, data.qfrc_inverse)
        asked[t] += data.qfrc_inverse[v_at]
    return asked
