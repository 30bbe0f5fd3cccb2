"""Checks of values, efforts and motion of one measurement: what is no number, does not move, stops, or begins in motion."""

import math
from collections.abc import Iterator

import numpy as np
from scipy.ndimage import uniform_filter1d

from taccorl.alignment.checks.first_order import LEAST_ROWS, fit_first_order
from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.checks.trial import (
    Trial,
    least_motion,
    place,
    scale,
    without,
    write,
)
from taccorl.alignment.checks.wiring import FOLLOWS_FROM, in_other_unit
from taccorl.alignment.controller.joint_motion import steps_at_once
from taccorl.alignment.measurements.even_rows import LONGEST_GAP_S
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.finding import Finding, listed
from taccorl.data.timing import runs
from taccorl.errors import TaccorlError

WRAPPED = 0.5
"""Largest difference from a full turn of a jump between rows, in an angle that is wrapped [rad]. A choice."""
TOO_SHORT_S, SHORT_S = 1.0, 3.0
"""Duration of motion below which a recording is an error, and below which it is a warning [s]. The paper sweeps each joint for
10 s."""
DEAD_SHARE = 0.05  # A joint does not answer if its range is below this share of its command's range
FROZEN_S = 0.3  # Least time of bit-identical readings of a frozen channel [s]
LATE_S = 2.0
"""Latest answer to a target [s]: for as long a joint goes on after the last one of a recording that answers late. A choice."""
FROZEN_MOVE = 0.05  # Least motion of the command in that time [rad; a tenth of it in m]
FROZEN_EFFORT_S = 1.0
"""Least time of bit-identical efforts of a frozen effort channel [s]; the joint must move to and fro by ``FROZEN_MOVE`` in it,
which friction and inertia do not allow at one effort. A choice."""
ANSWER_S = 0.1
"""Delay between a change of the command and the first motion of the joint that is still normal [s] (a choice). A command that
changes only in the last ``ANSWER_S`` of a stretch of equal readings is no sign of a frozen channel."""
REST_SHARE = 0.1
"""Share of the command's range within a stretch of equal readings. If the command used less than this before the last
``ANSWER_S``, it counts as standing still until then."""
BLOCKED_S, BLOCKED_RAD = 0.3, 0.05
"""Time at the furthest reading [s], and distance of the command beyond it [rad; a tenth of it in m], for a blocked joint."""
START_S, START_ROWS = (
    0.15,
    (8, 30),
)  # Time and number of rows from which the speed at row 0 is estimated
JUMP_SHARE = 0.9  # Least share of the way of the targets that is a jump. A choice.
START_SPEED = {"rad": 0.03, "m": 0.003}
"""Largest speed at row 0 [rad/s]: a twin that starts at rest then errs by 0.1 s times it, 3 mrad."""
START_OFFSET_RAD = 0.1
"""Largest distance of a joint from its resting command at the start [rad]. The paper's feed-forward torque causes 11 mrad at
most."""
AT_LIMIT_SHARE = 0.01  # Share of the rows with exactly the largest effort from which on the effort counts as limited
PLATEAU_ROWS, PLATEAU_FROM = 10, 0.9
"""Least number of rows, and share of the effort in them below which rows show the law, for an effort at a limit with noise."""
STATED_LIMIT = 0.02  # A plateau of efforts is at the stated limit if it is within this share of it. A choice.
STICK_STEPS = 4.0
"""Most steps (usual ones between rows, or the encoder's) by which a sticking joint moves on; a driver that repeated old values
jumps to the joint's present position instead."""
STICK_GROWS = 0.25
"""Share of the command's range within a hold by which it may go on away from a joint that sticks where it is furthest out, which
comes to rest as its command turns. A choice."""
STICK_ERRORS = 1.5
"""Largest distance of a command from a joint that sticks until the recording ends, in multiples of the largest one of the other
rows: beyond it the friction would have given way. A choice."""


REPEATED = 10, 0.02
"""Least number of rows that repeat the one before, with more than ``STICK_STEPS`` steps of the encoder on both sides and a motion
of as many times the noise, which repeats numbers by chance, and least share of the rows in motion. Choices."""
FILLER, FILLER_LEAST = 5.0, 0.02
"""A position of one row is no measurement if the way to it is so many times the longest way between other rows, and so long [rad,
m], while the target stays. Choices: a joint that breaks free does not come back in the next row."""


def _filled(values: np.ndarray, target: np.ndarray) -> int | None:
    """Row of (T,) ``values`` that lies apart from its neighbours, or from its neighbour if it is the first or last one."""
    way, last = np.abs(np.diff(values)), len(values) - 1
    if last < 3 or not np.isfinite(way).all():
        return None
    k = int(way.argmax())
    inner = k + 1 if k == 0 or way[min(k + 1, last - 1)] > way[k - 1] else k
    row = 0 if k == 0 and way[1] < 0.5 * way[0] else inner
    row = last if k == last - 1 and way[k - 1] < 0.5 * way[k] else row
    around = slice(max(row - 1, 0), row + 1)
    others = float(np.delete(way, range(*around.indices(last))).max())
    moved = float(np.ptp(target[max(row - 3, 0) : row + 2]))
    apart = float(way[around].min())
    return row if apart > max(FILLER * others, FILLER_LEAST, 2.0 * moved) else None


def _unwrap(name: str) -> str:
    """Text: the lines of a columns file that unwrap an angle."""
    lines = ", ".join(f"{name}.{key}: {{unwrap: true}}" for key in ("q", "q_target"))
    return f"Write `changes: {{{lines}}}` into a columns file; in one with signals: `unwrap: true` there"


@check("error", "wrapped", explains=(*FOLLOWS_FROM, "unit", "reversed"))
@check("error", "not_finite", "lost_samples", needs="rows")
def check_values(t: Trial) -> Iterator[Finding]:
    """Find targets that are no numbers, angles that jump by a full turn, values that fill a row (a logger's zeros), and rows
    without a measurement."""
    m = t.m
    for name, values in zip(m.signals, m.target.T, strict=True):
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            text = (
                f"{name}: its target is no number in {len(bad)} rows, first at row {bad[0]} ({m.time_s[bad[0]]:.3f} "
                f"s); {without(m, int(bad[0]))}"
            )
            yield find("not_finite", name, text, (int(bad[0]), int(bad[-1]) + 1))
    for name, unit, values in zip(m.signals, m.units, m.measured.T, strict=True):
        turns = (
            np.flatnonzero(np.abs(np.abs(np.diff(values)) - 2 * np.pi) < WRAPPED)
            if unit == "rad"
            else []
        )
        if len(turns):
            text = (
                f"{name} jumps by a full turn in {len(turns)} rows, first after row {turns[0]} ({m.time_s[turns[0]]:.3f} s): its "
                f"angle is wrapped. {write(m, _unwrap(name), 'Unwrap it (numpy.unwrap) before it is logged')}"
            )
            yield find("wrapped", name, text, (int(turns[0]), int(turns[0]) + 2))
        elif (row := _filled(values, m.target[:, m.column(name)])) is not None:
            text = (
                f"{name} is at {values[row]:.4g} {unit} in row {row} ({m.time_s[row]:.3f} s) alone, {FILLER:g} times as far from "
                f"its neighbours as any other: a value that a logger fills in; {without(m, row)}"
            )
            yield find("not_finite", name, text, (row, row + 1))
    known = np.asarray(np.isfinite(m.measured))
    compared = np.asarray(
        known.any(axis=0)
    )  # a signal that was never measured is not compared
    holes = runs(np.asarray(~known[:, compared].all(axis=1)))
    if not holes:
        return
    first, end = max(holes, key=lambda r: r[1] - r[0])
    # Short gaps of a table were judged where it was brought to an even grid.
    if (
        any(f.check == "resampled" for f in m.findings)
        and (end - first) * m.period_s <= LONGEST_GAP_S
    ):
        return
    names = [
        m.signals[j] for j in np.flatnonzero(compared & ~known[first:end].all(axis=0))
    ]
    damaged = any(f.check == "damaged" for f in m.findings)
    again = (
        "The file is damaged: copy it again"
        if damaged
        else "Record again with less load on the logger"
    )
    text = (
        f"{listed(names)}: nothing was measured in {place(m, first, end)}, {len(holes)} such holes: no row "
        f"there can be compared. {again}, or {without(m, first)}"
    )
    yield find("lost_samples", names[0], text, (first, end))


@check("error", "too_short")
@check("warning", "short", needs="rows")
def check_length(t: Trial) -> Iterator[Finding]:
    """Motion, from the first change of a command to the last, that is too short for a fit."""
    if t.m.num_rows < 2 or not (np.diff(t.m.time_s) > 0).all():
        return  # check_time reports it
    changed = np.flatnonzero(np.any(np.diff(t.m.target, axis=0) != 0, axis=1))
    seconds = (
        float(t.m.time_s[changed[-1] + 1] - t.m.time_s[changed[0]])
        if len(changed)
        else 0.0
    )
    if seconds < SHORT_S and t.moves.any():
        text = (
            f"{seconds:.2f} s of motion in {t.m.num_rows} rows: three parameters of a joint want 10 s that sweep it "
            "from slow to fast"
        )
        yield find(
            "too_short"
            if seconds < TOO_SHORT_S and not _comes_to_rest(t.m)
            else "short",
            "",
            text,
        )


def _comes_to_rest(m: Measurement) -> bool:
    """Whether targets and measurements rest in the last ``ANSWER_S``, so that even a short recording has the whole response."""
    rows = max(3, round(ANSWER_S / m.period_s))
    known = np.isfinite(m.measured).all(axis=0)
    last = [np.ptp(values[-rows:, known], axis=0) for values in (m.target, m.measured)]
    span = np.ptp(m.measured[:, known], axis=0)
    return bool(
        known.any()
        and (last[0] == 0.0).all()
        and (last[1] <= np.maximum(DEAD_SHARE * span, 1e-9)).all()
    )


@check("error", "no_motion", "dead_channel", needs="position")
def check_motion(t: Trial) -> Iterator[Finding]:
    """Joints that do not move, do not answer, or stop answering."""
    m = t.m
    if not t.moves.any():
        few, more = (
            list(zip(m.signals, m.units, strict=True))[:2],
            " …" * (len(m.signals) > 2),
        )
        way_out = ""
        for name, own, target in zip(m.signals, m.measured.T, m.target.T, strict=True):
            known = own[np.isfinite(own)]
            went = np.ptp(known) if len(known) else 0.0
            if went > least_motion(m, name) and went > 10.0 * np.ptp(target) > 0.0:
                way_out = f"{name} moves further: are its targets in another unit (`unit:` of a columns file)? Else "
        text = (
            f"no command moves ({', '.join(f'{n} by less than {least_motion(m, n):.2g} {u}' for n, u in few)}{more}) in "
            f"{m.time_s[-1]:.1f} s: {way_out}record a sweep"
        )
        yield find("no_motion", "", text)
        return
    for j in np.flatnonzero(t.moves):
        name, measured, target = m.signals[j], m.measured[:, j], m.target[:, j]
        known = measured[np.isfinite(measured)]
        if len(known) and np.ptp(known) < DEAD_SHARE * np.ptp(target):
            if in_other_unit(t, int(j)):
                continue  # check_wiring says so
            still = (
                "the same number all the time"
                if np.ptp(known) == 0
                else f"within {np.ptp(known):.2g} {m.units[j]}"
            )
            text = (
                f"{name} stays {still} while its command moves by {np.ptp(target):.3g} {m.units[j]} over "
                f"{m.time_s[-1]:.1f} s: motor off, brake on, its driver repeats one value, or its columns of target and position "
                "are exchanged; look at `taccorl view` of the recording and record again"
            )
            yield find("dead_channel", name, text)
        elif not name.endswith("gripper"):  # it stands still on what it holds
            yield from _stuck(m, int(j))


@check(
    "error",
    "frozen_channel",
    "saturated_channel",
    explains=(*FOLLOWS_FROM, "velocity_unit", "wrong_sign"),
)
@check("warning", "sticking_joint", "blocked")
def _stuck(m: Measurement, j: int) -> Iterator[Finding]:
    """A joint that stands still while its command moves: a driver that repeats old values, the end of its range, or a joint that
    sticks or is stopped. One finding."""
    name, measured, target = m.signals[j], m.measured[:, j], m.target[:, j]
    least, beyond = FROZEN_MOVE / scale(m, j), BLOCKED_RAD / scale(m, j)
    same = np.concatenate([[False], np.diff(measured) == 0])
    stands: list[Finding] = []
    for first, end in sorted(runs(same), key=lambda r: r[0] - r[1]):
        rows = (first - 1, end)
        held_s = m.time_s[end - 1] - m.time_s[first - 1]
        moved = np.ptp(target[rows[0] : end])
        before_answer = np.ptp(
            target[rows[0] : max(end - max(round(ANSWER_S / m.period_s), 1), first)]
        )
        if held_s < FROZEN_S or moved < least or before_answer < REST_SHARE * moved:
            continue
        if (sign := _stop_side(m, j, rows)) is not None:
            stands = stands or [_blocked(m, j, sign, rows)]
            continue
        if goes_on := _sticks(m, j, rows):
            text = (
                f"{name} stands at {measured[first]:.4f} {m.units[j]} for {held_s:.2f} s while its command moves by "
                f"{moved:.3g} {m.units[j]}, {place(m, *rows)}, and {goes_on}: it "
                "sticks, as dry friction does (effects coulomb_friction, stribeck_friction), or something held it. If "
                f"its driver repeated old values, {without(m, rows[0])}"
            )
            stands = stands or [find("sticking_joint", name, text, rows)]
            continue
        edge = measured[first] in (np.nanmax(measured), np.nanmin(measured))
        why = (
            "its furthest reading: the end of the encoder's or the message's range"
            if edge
            else "its driver repeats old values, or the bus was silent"
        )
        text = (
            f"{name} reads {measured[first]:.4f} {m.units[j]} without change for {held_s:.2f} s while its command goes "
            f"{moved:.3g} {m.units[j]}, {place(m, *rows)}: {why}. Record again within its range, or {without(m, rows[0])}"
        )
        yield find("saturated_channel" if edge else "frozen_channel", name, text, rows)
        return
    if stands:
        yield stands[0]
        return
    for sign in (1.0, -1.0):
        furthest = np.nanmax(sign * measured)
        at_stop = (sign * measured > furthest - 0.1 * beyond) & (
            sign * target > furthest + beyond
        )
        for first, end in runs(at_stop):
            if m.time_s[end - 1] - m.time_s[first] >= BLOCKED_S:
                yield _blocked(m, j, sign, (first, end))
                return


def _blocked(m: Measurement, j: int, sign: float, rows: tuple[int, int]) -> Finding:
    """A joint stays at the upper (``sign`` 1) or lower (− 1) end of its measured range although its command lies beyond it."""
    first, end = rows
    furthest = float(np.nanmax(sign * m.measured[:, j]))
    text = (
        f"{m.signals[j]} stands at {sign * furthest:.3f} {m.units[j]} for {m.time_s[end - 1] - m.time_s[first]:.2f} s although "
        f"it is commanded {np.max(sign * m.target[first:end, j]) - furthest:.3f} further, {place(m, first, end)}: a stop or "
        "something in its way (effect end_stop), the motor's limit (effect torque_saturation), or a weight that its controller "
        "does not carry, which the model knows; sweep within its range if that is not what you measure"
    )
    return find("blocked", m.signals[j], text, rows)


def _stop_side(m: Measurement, j: int, rows: tuple[int, int]) -> float | None:
    """+1 or −1 if the joint stood at a stop at that end of its range; None if it did not, or that is not known."""
    first, end = rows
    measured, target = m.measured[:, j], m.target[:, j]
    least = BLOCKED_RAD / scale(m, j)
    near = 0.1 * least
    for sign in (1.0, -1.0):
        at_end = sign * measured[first] > np.nanmax(sign * measured) - near
        beyond = np.max(sign * (target[first:end] - measured[first])) > least
        if (
            at_end
            and beyond
            and stood_at_stop(target, measured, m.period_s, rows, sign, near)
        ):
            return sign
    return None


def _sticks(m: Measurement, j: int, rows: tuple[int, int]) -> str:
    """How the joint went on after a hold, if it itself can have stood still; empty if its driver repeated an old value.

    Old values show in three ways: the joint jumps to where it is meanwhile, readings that flicker at rest do not in the hold, or
    the command leaves further and further without an answer, which a joint that sticks follows once its friction gives way.
    Readings may have been interpolated to another rate, so that no step of an encoder is left in them.
    """
    first, end = rows
    measured, target, quantum = m.measured[:, j], m.target[:, j], float(m.quantum[j])
    steps, still = np.abs(np.diff(measured)), np.diff(target) == 0
    moving = steps[np.isfinite(steps) & (steps > 0.5 * quantum)]
    # Of a joint that is at rest; one that still follows its command is not.
    flickers = still & (
        np.abs(np.diff(measured, n=2, append=measured[-1])) > 1.5 * quantum
    )
    if quantum == 0.0:
        flickers &= steps > 0.0
    most = 0.05 if quantum > 0.0 else 0.9
    if len(moving) == 0 or (still.any() and flickers.sum() > most * still.sum()):
        return ""
    far = np.abs(target - measured)
    outside = np.delete(far, np.s_[first:end])
    usual = float(np.nanmax(outside)) if np.isfinite(outside).any() else 0.0
    ends = end >= m.num_rows or not np.isfinite(measured[end])
    side = math.copysign(1.0, float(target[first] - measured[first]))
    grows = float(np.max(side * (target[first:end] - target[first])))
    # Not for a hold from row 0 on: a joint may begin at any angle, and dry friction keeps it there until the torque exceeds it.
    extreme = first > 0 and side * measured[first] == np.nanmax(side * measured)
    goes_away = grows > max(
        2.0 * quantum, STICK_GROWS * float(np.ptp(target[first:end]))
    )
    # Further out than the joint came: its readings end there, unless it stood as far off elsewhere.
    if (
        (extreme or ends)
        and goes_away
        and (not ends or float(np.max(far[first:end])) > STICK_ERRORS * usual)
    ):
        return ""
    if ends:
        return "the recording ends there"
    jump = abs(float(measured[end] - measured[end - 1]))
    if jump > STICK_STEPS * max(quantum, float(np.median(moving))):
        return ""
    return f"goes on from there ({jump:.2g} {m.units[j]} to the next row)"


@check("error", "frozen_target", needs="position", explains=FOLLOWS_FROM)
def check_frozen_targets(t: Trial) -> Iterator[Finding]:
    """Targets that stand for far longer than elsewhere while the joint goes on to and fro."""
    m = t.m
    answer, late = (round(s / m.period_s) for s in (SETTLED_S, LATE_S))
    for j in t.moving:
        name, least = m.signals[j], FROZEN_MOVE / scale(m, j)
        least = max(least, REST_SHARE * float(np.ptp(m.target[:, j])))
        holds = runs(np.diff(m.target[:, j]) == 0)
        later = sorted(
            (r for r in holds if r[0] > 0), key=lambda r: r[0] - r[1]
        )  # the longest first; the last one may reach the end
        if not later:
            continue
        first, end = later[0]
        others = max((stop - start for start, stop in later[1:]), default=0)
        if (end - first) * m.period_s < FROZEN_S or 3 * others > end - first:
            continue
        moving_from = first + (late if end >= m.num_rows - 1 else answer)
        if _to_and_fro(m.measured[moving_from:end, j]) > least:
            text = (
                f"{name}: its target stands at {m.target[first, j]:.4g} {m.units[j]} in {place(m, first, end + 1)}, while the "
                f"joint goes on to and fro: its logger repeated an old target; {without(m, first)}"
            )
            yield find("frozen_target", name, text, (first, end + 1))


def _to_and_fro(values: np.ndarray) -> float:
    """The smaller one of the longest ways up and down in (T,) ``values``; NaN are left out."""
    known = values[np.isfinite(values)]
    up = (known - np.minimum.accumulate(known)).max(initial=0.0)
    down = (np.maximum.accumulate(known) - known).max(initial=0.0)
    return float(min(up, down))


@check(
    "warning",
    "repeated_rows",
    needs="position",
    explains=("late_answer", "dropped_commands", "does_not_repeat"),
)
def check_repeated_rows(t: Trial) -> Iterator[Finding]:
    """Single rows in which a joint in motion reads the number of the row before: a driver that was polled too early."""
    m = t.m
    for j in t.moving:
        step = np.diff(m.measured[:, j])
        # of a normal distribution; a quarter of the rows may be repeated
        bends = np.nanquantile(np.abs(np.diff(step)), 0.2) / 0.253
        noise = float(bends) / math.sqrt(6.0)
        least = STICK_STEPS * max(float(m.quantum[j]), noise, 1e-12)
        fast = np.abs(step) > STICK_STEPS * max(float(m.quantum[j]), 1e-12)
        fast &= np.abs(uniform_filter1d(step, 5)) > least
        around = fast[:-2] & fast[2:] & (np.sign(step[:-2]) == np.sign(step[2:]))
        count = int((around & (step[1:-1] == 0.0)).sum())
        share = count / max(int(around.sum()), 1)
        if count >= REPEATED[0] and share > REPEATED[1]:
            text = (
                f"{m.signals[j]}: rows repeat the reading of the row before while the joint moves ({share:.0%} of its rows in "
                "motion): they were polled faster than the driver measures. Log only new readings with the driver's stamps, or "
                "leave repeated rows out: gaps of a table are bridged"
            )
            yield find("repeated_rows", m.signals[j], text)


@check("warning", "not_at_rest", "start_offset", needs="position")
def check_start(t: Trial) -> Iterator[Finding]:
    """Signals that were not at rest near their command at the start, as the twin is."""
    m = t.m
    rows = min(max(START_ROWS[0], round(START_S / m.period_s)), START_ROWS[1])
    if m.num_rows <= rows:
        return
    past = m.time_s[:rows] - m.time_s[0]
    for j, (name, unit) in enumerate(zip(m.signals, m.units, strict=True)):
        measured, target = m.measured[:rows, j], m.target[:rows, j]
        if not (
            np.isfinite(measured).all() and np.isfinite(target).all()
        ) or steps_at_once(m, j):
            continue
        speed, sd = _speed_at_start(past, measured)
        # The second part: what the answer to a command that begins at once looks like in a parabola.
        allowed = START_SPEED[unit] + 0.25 * float(np.ptp(target)) / past[-1]
        if speed > allowed + 5 * sd and not _answers_a_jump(target, measured):
            text = (
                f"{name} moves at {speed:.3f} ± {sd:.3f} {unit}/s at row 0 (0.000 s), the twin starts at rest: "
                "begin the recording a second before the motion"
            )
            yield find("not_at_rest", name, text, (0, rows))
        off = float(measured[0] - target[0])
        if (
            unit == "rad"
            and abs(off) > START_OFFSET_RAD
            and np.ptp(target) < 1e-3
            and speed <= allowed
        ):
            text = (
                f"{name} stands {off:+.3f} rad from its command at row 0 (0.000 s) and stays there: switched off, "
                "blocked, or a zero point that differs between the two (`zero:` of a column in a columns file is its number "
                "at 0 rad); record with the motor on"
            )
            yield find("start_offset", name, text, (0, rows))


def _answers_a_jump(target: np.ndarray, measured: np.ndarray) -> bool:
    """Whether one jump, to the first target or to one of the next, makes up most of the way
    of the targets and at least half of the motion: a polynomial through its answer has a
    speed at row 0, also of a joint that starts at rest. Both (T,), of the first rows."""
    way = np.abs(np.diff(target, prepend=measured[0]))
    largest = float(way.max())
    return largest > JUMP_SHARE * way.sum() and largest > 0.5 * np.ptp(measured)


def _speed_at_start(past_s: np.ndarray, measured: np.ndarray) -> tuple[float, float]:
    """(speed at row 0, its standard deviation), from a parabola; from a cubic where the parabola does not do."""
    for order in (3, 2):
        design = np.vander(past_s, order + 1, increasing=True)
        solution = np.linalg.lstsq(design, measured, rcond=None)[0]
        left = measured - design @ solution
        covariance = (
            float(left @ left)
            / max(len(left) - order - 1, 1)
            * np.linalg.inv(design.T @ design)
        )
        sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        if abs(solution[-1]) > 5 * sd[-1]:
            break
    return abs(float(solution[1])), float(sd[1])


@check("warning", "dead_effort")
@check("note", "effort_limit", needs="effort")
def check_effort(t: Trial) -> Iterator[Finding]:
    """Efforts that are constant while the joint moves, or stop at a limit that is not the one stated in ``limits``."""
    m = t.m
    recorded = (
        m.has_effort() if m.pressed is not None else np.isfinite(m.effort).any(axis=0)
    )  # presses need none
    for j in np.flatnonzero(t.moves & recorded):
        name, effort = m.signals[j], m.effort[:, j]
        known = effort[np.isfinite(effort)]
        largest = float(np.abs(known).max())
        if np.ptp(known) == 0:
            use = (
                f"so no diagnosis uses efforts of {name}"
                if known[0] == 0.0
                else "of no use for a fit"
            )
            text = f"{name}: its effort reads {known[0]:.3g} all the time while it moves: not measured, {use}"
            yield find("dead_effort", name, f"{text}; {_without_effort(m, name)}")
            continue
        yield from _frozen_effort(m, int(j))
        at = np.flatnonzero(np.abs(effort) == largest)
        value, level, least = (
            largest,
            f"exactly ±{largest:.3g}",
            max(3, int(AT_LIMIT_SHARE * len(known))) + 1,
        )
        if len(at) < least:
            at, value, sd = plateau(m, int(j))
            level, least = f"±{value:.3g} (within {sd:.2g}, its noise)", PLATEAU_ROWS
        if (
            len(at) >= least
            and abs(value - t.limits.get(name, math.inf)) > STATED_LIMIT * value
        ):
            text = (
                f"{name}: its effort is {level} in {len(at)} rows, first at row {at[0]} ({m.time_s[at[0]]:.2f} s): the drive's "
                "limit (effect torque_saturation) or the end of the report's range"
            )
            yield find("effort_limit", name, text, (int(at[0]), int(at[-1]) + 1))


@check("error", "frozen_effort")
def _frozen_effort(m: Measurement, j: int) -> Iterator[Finding]:
    """An effort that stays the same to the last bit for ``FROZEN_EFFORT_S`` while the joint goes to and fro, though it changes
    from row to row elsewhere; efforts at their largest value are left to the limit of the drive."""
    effort, name = m.effort[:, j], m.signals[j]
    same = np.diff(effort) == 0
    first, end = max(runs(same), key=lambda run: run[1] - run[0], default=(0, 0))
    inside = m.measured[first : end + 1, j]
    inside = inside[np.isfinite(inside)]
    at_limit = abs(effort[first]) == np.nanmax(np.abs(effort))
    outside = np.delete(same, np.s_[first:end])
    short = end - first < FROZEN_EFFORT_S / m.period_s
    move = FROZEN_MOVE / scale(m, j)
    coarse = outside.size and outside.mean() > 0.5
    if at_limit or short or coarse or _to_and_fro(inside) < move:
        return
    text = (
        f"{name}: its effort reads {effort[first]:.4g} in all of {place(m, first, end + 1)}, while the joint goes to and fro by "
        f"{np.ptp(inside):.2g} {m.units[j]}: the driver repeated an old value. Cut this out, or {_without_effort(m, name)}"
    )
    yield find("frozen_effort", name, text, (first, end + 1))


def _without_effort(m: Measurement, name: str) -> str:
    """The way to leave out the effort of a signal."""
    file = f"leave the column {name}.tau out of {m.source.name}, or its line out of the columns file"
    return write(m, file, f"write `effort_scale: {{{name}: 0}}` in measurements.yaml")


def plateau(m: Measurement, j: int) -> tuple[np.ndarray, float, float]:
    """Rows in which a linear law of target, position and speed, fitted to the rows of less effort, asks for more than the largest
    effort, while the effort stays at it but for its noise; that effort [N·m, N], and its standard deviation in these rows. No
    rows if there is no such law."""
    nothing = np.zeros(0, dtype=int), 0.0, 0.0
    target, q, effort = m.target[:, j], m.measured[:, j], m.effort[:, j]
    if not np.isfinite([target, q, effort]).all():
        return nothing
    before = np.concatenate([target[:1], target[:-1]])
    columns = np.column_stack(
        [target, before, q, np.gradient(q, m.period_s), np.ones_like(q)]
    )
    columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    size = np.abs(effort)
    below = size < PLATEAU_FROM * np.quantile(size, 1.0 - PLATEAU_ROWS / len(size))
    if below.sum() < 0.2 * len(size):
        return nothing
    law = columns @ np.linalg.lstsq(columns[below], effort[below], rcond=None)[0]
    sd_law = float(np.std((effort - law)[below]))
    rows = np.flatnonzero(~below & (np.sign(effort) * law - size > 5.0 * sd_law))
    if len(rows) < PLATEAU_ROWS:
        return nothing
    level = float(np.median(size[rows]))
    sd = 1.4826 * float(np.median(np.abs(size[rows] - level)))
    if np.std(
        law[rows] * np.sign(effort[rows])
    ) < 5.0 * sd or size.max() > level + 6.0 * max(sd, 1e-12):
        return nothing
    return rows, level, sd


# Distinguish a joint at a mechanical stop from one whose encoder's range ended, by the time at which the reading changes again.
#
# In both cases the reading is constant while the command is beyond it. If the *reading* ended, the joint moved on: the reading
# changes when the joint's free response comes back, about a lag τ (0.1 s on a PiPER) after the command. A joint that stood at a
# *stop* was held there: it moves as soon as the command is back. With u = g q*(t − d) + b, everything mirrored for a lower end,
# and τ, d, g from ``first_order``, fitted to the rows of free motion:
#
#     free      f ← u + (f − u) e^(−h/τ)                   comes back below the reading q_held
#     stopped   q ← min(q_held, u + (q − u) e^(−h/τ))      leaves q_held
#
# The hypothesis whose time is nearer to the measured one is chosen.

SETTLED_S = 0.3
"""Time after a hold in which a stop still influences the motion [s] (three time constants τ of 0.1 s): its rows are not
fitted."""


def stood_at_stop(
    target: np.ndarray,
    measured: np.ndarray,
    period_s: float,
    rows: tuple[int, int],
    sign: float,
    near: float,
) -> bool:
    """True if the end of the hold shows a joint at a stop; False if it does not, or is unclear.

    Args:
        target: (T,) commands [rad].
        measured: (T,) readings [rad]; NaN where not measured.
        period_s: time between two rows.
        rows: first row and last row + 1 of the constant readings.
        sign: +1 for an upper end of the range, −1 for a lower end.
        near: readings within this distance [rad] of the held one may also be at the end, and are not used as free motion.
    """
    first, end = rows
    if end >= len(target):
        return False
    up, seen, held = sign * target, sign * measured, sign * float(measured[first])
    free = np.isfinite(seen)
    for start, stop in runs(np.asarray(seen >= held - near)):
        free[start : stop + round(SETTLED_S / period_s)] = False
    if free.sum() < LEAST_ROWS:
        return False
    try:
        fit = fit_first_order(up, np.where(free, seen, np.nan), period_s)
    except TaccorlError:
        return False
    keep = math.exp(-period_s / fit.time_constant_s)
    at = np.arange(len(up))
    answer = fit.response(up, period_s)
    offset = float(np.mean((seen - answer)[free]))
    command, answer = (
        fit.gain * np.interp(at - fit.delay_s / period_s, at, up - up[0]) + offset,
        answer + offset,
    )
    steps = np.abs(np.diff(seen[np.isfinite(seen)]))
    below = held - 0.5 * float(
        np.min(steps[steps > 0])
    )  # a reading changes half a step from the held one
    stopped = np.full(len(up), held)
    for k in range(first, len(up) - 1):
        stopped[k + 1] = min(held, command[k] + (stopped[k] - command[k]) * keep)
    beyond = first + int(np.argmax(command[first:end]))  # both come back after this row
    back = [
        np.append(np.flatnonzero(own[beyond:] < below) + beyond, len(up))[0]
        for own in (answer, stopped)
    ]
    return bool(abs(back[1] - end) < abs(back[0] - end))
