"""Check that every joint follows its own command, with the right sign and unit.

    follows[i, j]   correlation of the velocity of measured i with that of command j behind a lag of 0.1 s
    gain[j]         how far measured j goes for each radian (metre) that command j goes, behind the same lag

Letters in shapes: T rows, J signals.
"""

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import fftconvolve, lfilter

from taccorl.alignment.checks.first_order import FAR_S
from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.checks.trial import MOVED, Trial, place, scale, without, write
from taccorl.alignment.measurements.measurement import Measurement, other_arm, unit_of
from taccorl.data.finding import Finding, listed
from taccorl.data.timing import runs
from taccorl.robots import ROBOT

USUAL_LAG_S = 0.1  # Lag of a joint behind its command that is assumed here [s]
FOLLOWS, FOLLOWS_NOT = (
    0.8,
    0.5,
)  # Correlation above which a joint follows a command, and below which it does not
REVERSED = -0.6  # Correlation below which a joint moves against its command
ALIKE = 0.02  # Least difference of correlations for choosing between two joints
GAIN = (
    0.2,
    5.0,
)  # Gain above which neither controller nor physics can explain the motion
TURN_S, TURNED = 1.5, (3, 0.9)
"""Window of the correlation by which a sign that turns within a recording is found [s]; least number of windows, a quarter of
``TURN_S`` apart, and least correlation. Choices."""
AT_TARGET = 0.3
"""A column lies at the target if their difference (RMS) is below this share of the target's range, and of the other column's
difference. A choice."""
SAME_FACTOR = 1.5
"""A joint that hardly moves is in another unit if it follows its command and its gain is a known factor, within so many times of
it either way: a lag other than ``USUAL_LAG_S`` changes gains. A choice."""
BEYOND = {
    "rad": 0.5,
    "m": 0.05,
}  # Distance beyond the robot's limits above which a position is impossible
SMOOTH_S = 0.03  # Window over which velocities are averaged [s]
KNOWN_FACTORS = {
    57.2958: "in degrees where it should be in rad",
    1 / 57.2958: "in rad where the command is in degrees",
    1000.0: "in mm or mrad where it should be in m or rad",
    0.001: "in m or rad where the command is in mm or mrad",
}
"""Gain of position over command → text that names the wrong unit."""
VELOCITY_FACTORS = {
    57.2958: "deg/s",
    9.5493: "rpm",
    1000.0: "mm/s or mrad/s",
    0.159155: "revolutions/s",
    -1.0: "the other sign",
}
"""Ratio of reported velocity to the slope of the position → unit in which the velocity probably is."""
VELOCITY_GAIN = (0.8, 1.25)  # Range of that ratio that is accepted


FOLLOWS_FROM = (
    *(
        "measured_before_command",
        "reversed_effort",
        "wrong_inertia",
        "effort_time",
        "other_gains",
        "other_scale",
        "sticking_joint",
        "blocked",
    ),
    *(
        "dropped_commands",
        "does_not_repeat",
        "late_answer",
        "not_judged",
        "start_offset",
        "beyond_limits",
        "velocity_unit",
    ),
    "wrong_sign",
)
"""Checks whose findings about a signal may follow from a column that is wrong; ``wrong_sign`` at any signal."""
OF_ANOTHER_JOINT = (
    *(
        "dead_channel",
        "frozen_channel",
        "saturated_channel",
        "not_at_rest",
        "unit",
        "velocity_unit",
        "effort_unit",
    ),
    *("beyond_effort", "exchanged_target", "reversed"),
)
"""Checks whose findings about a signal may also follow from a column that is another joint's."""


@check("error", "copied_target", "reversed", explains=FOLLOWS_FROM)
@check(
    "error",
    "swapped_joints",
    needs="position",
    explains=(*FOLLOWS_FROM, *OF_ANOTHER_JOINT),
)
def check_wiring(t: Trial) -> Iterator[Finding]:
    """Swapped joints and arms, reversed signs, and wrong units."""
    m, even = t.m, t.even
    usual = zip(ROBOT.action_low, ROBOT.action_high, strict=True)
    limits = dict(zip(ROBOT.action_names, usual, strict=True))
    if found := all_in_degrees(
        m, {n: own for n, own in limits.items() if unit_of(n) == "rad"}
    ):
        yield from found
        return
    yield from (beyond := list(_beyond_range(m)))
    commanded = [
        j
        for j in range(len(m.signals))
        if np.ptp(even.target[:, j]) * scale(m, j) > MOVED["rad"]
    ]
    if not commanded:
        return
    lagged = _lagged(even.target, even.period_s)
    follows, gains = _follows(even, lagged, commanded)
    follows[gains < 0.05] = np.nan
    answers = _lagged(np.nan_to_num(even.measured), even.period_s)
    backwards = np.diag(
        _follows(dataclasses.replace(even, measured=even.target), answers, commanded)[0]
    )
    swapped: dict[str, str] = {}
    for j in commanded:
        own, name = follows[j, j], m.signals[j]
        if own >= FOLLOWS_NOT and gains[j, j] >= GAIN[0]:
            continue
        # Also of one that does not move (NaN), or only as others shake it; other checks say that where no other joint follows.
        other = _follower(m, np.where(gains >= GAIN[0], follows, np.nan), j)
        if (
            other is not None and not backwards[j] > follows[other, j]
        ):  # else target and position are exchanged
            swapped[name] = m.signals[other]
        elif (of := _copied(m, follows, j)) is not None:
            text = (
                f"{name}: its command is that of {m.signals[of]}, number for number, which {m.signals[of]} follows and {name} "
                f"does not (correlation {own:.2f} over {m.time_s[-1]:.1f} s): one was logged for both. "
                f"{write(m, f'Give {name}.q_target its own column', 'Correct the channel of its command')}, or leave {name} out"
            )
            yield find("copied_target", name, text)
        elif own < REVERSED:
            way_out = write(
                m,
                f"write `factor: -1` for {name}.q or {name}.q_target in a columns file",
                "put a minus into `scale` of its channel in the recording spec",
            )
            text = (
                f"{name} moves against its command (correlation {own:.2f} over {m.time_s[-1]:.1f} s): the sign of "
                f"one of the two is turned; {way_out}, or correct the logger"
            )
            yield find("reversed", name, text)
    yield from _swaps(m, swapped)
    for j in t.moving:
        is_named = m.signals[j] in {*(f.feature for f in beyond), *swapped}
        if not is_named and (follows[j, j] > FOLLOWS_NOT or in_other_unit(t, j)):
            yield from _gain(m, even, lagged, j)
            yield from _velocity_unit(m, even, j)


def _copied(m: Measurement, follows: np.ndarray, j: int) -> int | None:
    """Another joint with the command of ``j``, which it follows; None if there is none, or if joint ``j`` rests."""
    alike = (
        i
        for i in range(len(m.signals))
        if i != j and follows[i, i] > FOLLOWS and np.isfinite(follows[j, j])
    )
    return next((i for i in alike if (m.target[:, i] == m.target[:, j]).all()), None)


@check("error", "turned_midway", needs="position", explains=(*FOLLOWS_FROM, "reversed"))
def check_turns(t: Trial) -> Iterator[Finding]:
    """Find targets or positions whose sign is reversed in a part of the recording only. In windows of ``TURN_S`` seconds the
    velocity of the position is correlated with that of the target: about +1 where signs agree, about −1 where one is reversed.
    The lag is that of the speeds without their signs, so that a late or a fast motion is not taken for a turned one."""
    m, even = t.m, t.even
    rows, about = (round(seconds / even.period_s) for seconds in (TURN_S, SMOOTH_S))
    for j in t.moving:
        way, own = (
            _velocity(values[:, [j]], even.period_s)[:, 0]
            for values in (even.target, even.measured)
        )
        most = min(round(FAR_S / even.period_s), even.num_rows // 4)
        after, before = (abs(x) - abs(x).mean() for x in (own, way))
        same = fftconvolve(after, before[::-1])
        same = same[even.num_rows - 1 - most : even.num_rows + most]
        lags = int(np.argmax(same)) - most + np.array([-about, 0, about])
        first, last = max(lags[-1], 0), even.num_rows - rows + min(lags[0], 0)
        starts = np.arange(first, last, max(rows // 4, 1))
        likeness = np.array(
            [[_alike(way, own, at, rows, lag) for lag in lags] for at in starts]
        ).reshape(len(starts), len(lags))
        follows = likeness.max(axis=1) > TURNED[1]
        against = (likeness.max(axis=1) < 0) & (likeness.min(axis=1) < -TURNED[1])
        for first, end in runs(against):
            if end - first >= TURNED[0] and follows.any():
                begin, until = int(starts[first]), int(starts[end - 1]) + rows
                text = (
                    f"{m.signals[j]} moves against its command in {place(m, begin, until)} and with it elsewhere: the sign of "
                    f"one of the two turns within the recording; {without(m, begin)}"
                )
                yield find("turned_midway", m.signals[j], text, (begin, until))
                break


def _alike(way: np.ndarray, own: np.ndarray, at: int, rows: int, lag: int) -> float:
    """Correlation of two (T,) velocities in ``rows`` from row ``at`` on, ``way`` that of ``lag`` rows before; 0 of one that
    rests."""
    pair = way[at - lag : at - lag + rows], own[at : at + rows]
    return float(np.corrcoef(*pair)[0, 1]) if all(np.ptp(x) > 0 for x in pair) else 0.0


@check(
    "error",
    "exchanged_effort",
    needs="position",
    explains=(*FOLLOWS_FROM, *OF_ANOTHER_JOINT),
)
def check_exchanged_effort(t: Trial) -> Iterator[Finding]:
    """A column of efforts that lies at the target, where the column of positions does not."""
    m = t.m
    for j, name in enumerate(m.signals):
        target, effort = m.target[:, j], m.effort[:, j]
        span = float(np.ptp(target)) if np.isfinite(target).all() else 0.0
        if span * scale(m, j) < MOVED["rad"] or not np.isfinite(effort).all():
            continue
        near = float(np.sqrt(np.mean((effort - target) ** 2)))
        far = float(np.sqrt(np.nanmean((m.measured[:, j] - target) ** 2)))
        if near < min(AT_TARGET * span, AT_TARGET * far):
            changes = (
                f"{name}.q: {{column: {name}.tau}}, {name}.tau: {{column: {name}.q}}"
            )
            file = f"Write `changes: {{{changes}}}` into a columns file; in one with signals: exchange the two there"
            where = write(m, file, "Exchange the two in the recording spec")
            text = (
                f"{name}: its effort lies within {near:.2g} of the target (RMS), its position {far:.2g} from it: the columns of "
                f"position and effort are exchanged. {where}"
            )
            yield find("exchanged_effort", name, text)


def in_other_unit(t: Trial, j: int) -> bool:
    """Whether joint ``j`` follows its command with a gain near a known ratio of two units, as of rad to degrees: 1 / 57.3."""
    one = t.even.only([t.m.signals[j]])
    follows, gain = (
        float(found[0, 0])
        for found in _follows(one, _lagged(one.target, one.period_s), [0])
    )
    near = (1 / SAME_FACTOR < gain / f < SAME_FACTOR for f in KNOWN_FACTORS)
    return j in t.moving and follows > FOLLOWS and any(near)


def _lagged(target: np.ndarray, period_s: float) -> np.ndarray:
    keep = np.exp(-period_s / USUAL_LAG_S)
    return target[0] + lfilter([1 - keep], [1, -keep], target - target[0], axis=0)


def _velocity(values: np.ndarray, period_s: float) -> np.ndarray:
    filled = np.where(
        np.isfinite(values),
        values,
        np.nanmean(values, axis=0) if np.isfinite(values).any() else 0.0,
    )
    return uniform_filter1d(
        np.gradient(filled, period_s, axis=0),
        max(3, round(SMOOTH_S / period_s)),
        axis=0,
    )


def _follows(
    m: Measurement, lagged: np.ndarray, commanded: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """(J, J) correlation of measured i with command j, NaN where one of them rests; and the (J, J) gain by their ranges."""
    v_measured, v_command = (
        _velocity(m.measured, m.period_s),
        _velocity(lagged, m.period_s),
    )
    found, gains = np.full((2, len(m.signals), len(m.signals)), np.nan)
    span = np.ptp(np.nan_to_num(m.measured), axis=0)
    for i in range(len(m.signals)):
        for j in commanded:
            gains[i, j] = span[i] / max(np.ptp(lagged[:, j]), 1e-12)
            if v_measured[:, i].std() == 0 or v_command[:, j].std() == 0:
                continue
            found[i, j] = np.corrcoef(v_measured[:, i], v_command[:, j])[0, 1]
    return found, gains


def _follower(m: Measurement, follows: np.ndarray, j: int) -> int | None:
    """Another joint that follows command j and not its own; of several alike the other arm's same joint."""
    free = [
        i
        for i in range(len(m.signals))
        if i != j and follows[i, j] > FOLLOWS and not follows[i, i] > FOLLOWS
    ]
    if not free:
        return None
    best = max(follows[i, j] for i in free)
    alike = [i for i in free if follows[i, j] > best - ALIKE]
    return ([i for i in alike if m.signals[i] == other_arm(m.signals[j])] or alike)[0]


@check("error", "swapped_arms")
def _swaps(m: Measurement, swapped: dict[str, str]) -> Iterator[Finding]:
    across = [name for name, other in swapped.items() if other == other_arm(name)]
    if len(across) == len(swapped) and len(across) > 1:
        text = (
            f"{listed(across)} follow the other arm's commands over {m.time_s[-1]:.1f} s: left and right are "
            "exchanged in either positions or commands (CAN adapters or topics swapped); correct "
            f"{write(m, 'the columns file', '`channels` in the recording spec')}"
        )
        yield find("swapped_arms", across[0], text)
        return
    for name, other in swapped.items():
        changes = ", ".join(
            f"{a}.q: {{column: {b}.q}}" for a, b in ((name, other), (other, name))
        )
        file = f"Write `changes: {{{changes}}}` into a columns file, .qd and .tau (or .q_target) likewise where they are"
        text = f"{name} does not follow its command, {other} does (over {m.time_s[-1]:.1f} s): their columns are exchanged"
        text = (
            f"{text}. {write(m, file, 'Pick elements by name in the recording spec')}"
        )
        for one in (name, *({other} - swapped.keys())):
            yield find(
                "swapped_joints", one, text, topic=" ↔ ".join(sorted((name, other)))
            )


def _unit_way_out(m: Measurement, *columns: str) -> str:
    """Line to write where a number is in another unit."""
    file = f"Write the `unit:` of {' and '.join(columns)} in a columns file"
    where = write(m, file, "State `scale` of the channel in the recording spec")
    return f"{where}; if other recordings are right, convert this one"


def all_in_degrees(
    m: Measurement, limits: Mapping[str, tuple[float, float]]
) -> list[Finding]:
    """One finding if the positions of all joints with ``limits`` [rad] are in degrees: as degrees they are within the limits,
    and at least half of them, and two, are more than a turn beyond these as they are."""
    known = {n: m.measured[:, m.column(n)] for n in limits if n in m.signals}
    known = {n: q[np.isfinite(q)] for n, q in known.items() if np.isfinite(q).any()}
    far = [n for n, q in known.items() if np.abs(q).max() > 2 * np.pi]
    far = [
        n for n in far if known[n].max() > limits[n][1] or known[n].min() < limits[n][0]
    ]
    fits = all(
        limits[n][0] - BEYOND["rad"] < np.radians(q.min())
        and np.radians(q.max()) < limits[n][1] + BEYOND["rad"]
        for n, q in known.items()
    )
    if len(far) < 2 or 2 * len(far) < len(known) or not fits:
        return []
    lines = [f"{n}.{key}: {{unit: deg}}" for n in known for key in ("q", "q_target")]
    lines += [f"{n}.qd: {{unit: deg/s}}" for n in known if speed_as_position(m, n)]
    file = f"Write `changes: {{{', '.join(lines)}}}` into a columns file, in one with signals `unit: deg` at each"
    each = ", ".join(f"{n} at {known[n][np.abs(known[n]).argmax()]:.4g}" for n in far)
    text = (
        f"all positions look like degrees, read as rad: {each} is beyond its limits, in degrees all are within them. "
        f"{write(m, file, 'State `scale: 0.0174533` of the channels in the recording spec')}"
    )
    return [find("degrees", "", text)]


@check("error", "degrees", explains=(*FOLLOWS_FROM, *OF_ANOTHER_JOINT))
@check(
    "error",
    "unit",
    explains=(
        "start_offset",
        "beyond_limits",
        "effort_unit",
        "velocity_unit",
        "wrong_inertia",
        "wrong_sign",
    ),
)
def _beyond_range(m: Measurement) -> Iterator[Finding]:
    """Positions where the robot cannot be: another unit."""
    for j, (name, unit) in enumerate(zip(m.signals, m.units, strict=True)):
        if name not in ROBOT.action_names:
            continue
        k = ROBOT.action_names.index(name)
        for what, values in (
            ("measured", m.measured[:, j]),
            ("commanded", m.target[:, j]),
        ):
            beyond = np.nan_to_num(
                np.maximum(values - ROBOT.action_high[k], ROBOT.action_low[k] - values)
            )
            row = int(np.argmax(beyond))
            if beyond[row] > BEYOND[unit]:
                text = (
                    f"{name} is {what} at {values[row]:.4g} {unit} at row {row} ({m.time_s[row]:.2f} s), its limits "
                    f"are [{ROBOT.action_low[k]:.3g}, {ROBOT.action_high[k]:.3g}]: in {'degrees' if unit == 'rad' else 'mm'}? "
                    f"{_unit_way_out(m, f'{name}.q', f'{name}.q_target')}"
                )
                yield find("unit", name, text, (row, row + 1))
                break


def _gain(
    m: Measurement, even: Measurement, lagged: np.ndarray, j: int
) -> Iterator[Finding]:
    name, rows = m.signals[j], np.isfinite(even.measured[:, j])
    x, y = (
        lagged[rows, j] - lagged[rows, j].mean(),
        even.measured[rows, j] - even.measured[rows, j].mean(),
    )
    gain = float(x @ y / (x @ x))
    if GAIN[0] < gain < GAIN[1]:
        return
    factor = min(KNOWN_FACTORS, key=lambda f: abs(np.log(max(gain, 1e-9) / f)))
    near = abs(np.log(max(gain, 1e-9) / factor)) < 1.0
    text = (
        f"{name} goes {gain:.3g} times as far as its command over {m.time_s[-1]:.1f} s: "
        f"{KNOWN_FACTORS[factor] if near else 'in another unit'}? {_unit_way_out(m, f'{name}.q', f'{name}.q_target')}"
    )
    yield find("unit", name, text)


@check("warning", "velocity_unit")
def _velocity_unit(m: Measurement, even: Measurement, j: int) -> Iterator[Finding]:
    """The reported velocity against the slope of the position."""
    gain = velocity_gain(even, j, j)
    if gain is None or VELOCITY_GAIN[0] < gain < VELOCITY_GAIN[1]:
        return
    near = [text for f, text in VELOCITY_FACTORS.items() if abs(gain / f - 1) < 0.2]
    text = (
        f"{m.signals[j]}: its reported velocity is {gain:.3g} times the slope of its position"
        f"{f' ({near[0]}?)' if near else ''}. {_unit_way_out(m, f'{m.signals[j]}.qd')}, or leave it out"
    )
    yield find("velocity_unit", m.signals[j], text)


def speed_as_position(m: Measurement, name: str) -> bool:
    """Whether the velocity of a joint whose positions are in degrees was recorded, in degrees a second as far as it shows."""
    j = m.column(name)
    gain = velocity_gain(m, j, j)  # 1 in degrees a second, π / 180 in rad/s
    in_rad = gain is not None and gain < np.sqrt(np.pi / 180)
    return bool(np.isfinite(m.velocity[:, j]).any()) and not in_rad


def velocity_gain(even: Measurement, j: int, k: int) -> float | None:
    """Reported velocity of signal ``j`` over the slope of the position of ``k``; None if they hardly correlate: it was smoothed
    by the driver, or is too noisy."""
    reported = even.velocity[:, j]
    rows = np.isfinite(reported) & np.isfinite(even.measured[:, k])
    if not rows.any() or np.ptp(reported[rows]) == 0:
        return None
    slope = _velocity(even.measured[:, [k]], even.period_s)[rows, 0]
    seen = uniform_filter1d(reported[rows], max(3, round(SMOOTH_S / even.period_s)))
    return (
        float(slope @ seen / (slope @ slope))
        if abs(np.corrcoef(slope, seen)[0, 1]) >= FOLLOWS
        else None
    )
