"""Check that a measurement is good enough to judge a twin. This is done before any effect is considered.

    error    time_backwards, time_unit, not_finite, lost_samples, too_short, no_motion, dead_channel, frozen_channel,
             frozen_effort, saturated_channel, unit, reversed, swapped_joints, swapped_arms, exchanged_target,
             measured_before_command
    warning  dropped_rows, jitter, low_rate, row_times, out_of_order, not_at_rest, start_offset, blocked, short, dead_effort,
             velocity_unit, no_baseline, dropped_commands, does_not_repeat, same_commands, sticking_joint, resampled
             (beside a twin's replay: clock_or_effect, shifted_from_twin, which is an error where positions lead)
    note     late_answer, effort_limit, not_judged, same_motion

An error that a user has examined can be accepted by its name; it stays in the report as a warning. Every finding names joint,
value and place, and what to record or change. The checks are here (values, motion, start), in ``time_stamps``, ``wiring`` (which
joint follows which command, units), ``clock`` (offsets in time) and ``unrepeated`` (recordings of one motion).
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from taccorl.alignment.checks.cells import ERRORS as CELL_ERRORS
from taccorl.alignment.checks.clock import check_clock
from taccorl.alignment.checks.range_end import stood_at_stop
from taccorl.alignment.checks.time_stamps import check_time
from taccorl.alignment.checks.unrepeated import check_repeatability
from taccorl.alignment.checks.wiring import check_wiring
from taccorl.alignment.controller.rigid_joint import steps_at_once
from taccorl.alignment.measurements.even_rows import LONGEST_GAP_S
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import noise_floor
from taccorl.alignment.measurements.repeats import Overlay, overlay
from taccorl.alignment.measurements.tables import is_table
from taccorl.data.finding import Finding, listed
from taccorl.data.timing import runs
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT

MOVED = {"rad": 0.02, "m": 0.002}
"""Least range of a command that counts as motion [rad; a tenth of it in m]."""
MOVED_STEPS = 100.0
"""A command of a machine other than the PiPER also counts as motion if its range is so many encoder steps (± 1 mm on a stage)."""
TOO_SHORT_S, SHORT_S = 1.0, 3.0
"""Duration of motion below which a recording is an error, and below which it is a warning [s]. The paper sweeps each joint for
10 s."""
DEAD_SHARE = 0.05
"""A joint does not answer if its range is below this share of its command's range."""
FROZEN_S = 0.3
"""Least time of bit-identical readings of a frozen channel [s]."""
FROZEN_MOVE = 0.05
"""Least motion of the command in that time [rad]."""
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
"""Time at the furthest reading [s], and distance by which the command is beyond it [rad], for a blocked joint."""
START_S, START_ROWS = 0.15, (8, 30)
"""Time and number of rows from which the speed at row 0 is estimated."""
START_SPEED = {"rad": 0.03, "m": 0.003}
"""Largest speed at row 0 [rad/s]: a twin that starts at rest then errs by 0.1 s times it, 3 mrad."""
START_OFFSET_RAD = 0.1
"""Largest distance of a joint from its resting command at the start [rad]. The paper's feed-forward torque causes 11 mrad at
most."""
AT_LIMIT_SHARE = 0.01
"""Share of the rows with exactly the largest effort from which on the effort counts as limited."""
PLATEAU_ROWS, PLATEAU_FROM = 10, 0.9
"""Least number of rows, and share of the effort in them below which rows show the law, for an effort at a limit with noise."""
STATED_LIMIT = 0.02
"""A plateau of efforts is at the stated limit if it is within this share of it. A choice."""
_ORDER = ("error", "warning", "note")
STICK_STEPS = 4.0
"""Most steps (usual ones between rows, or the encoder's) by which a sticking joint moves on; a driver that repeated old values
jumps to the joint's present position instead."""
STICK_GROWS = 0.25
"""Share of the command's range within a hold by which it may go on away from a joint that sticks where it is furthest out, which
comes to rest as its command turns. A choice."""
STICK_ERRORS = 1.5
"""Largest distance of a command from a joint that sticks until the recording ends, in multiples of the largest one of the other
rows: beyond it the friction would have given way. A choice."""
DIFFERENT = 3.0
"""Two recordings of the same commands that differ by more than so many noise floors were made in different conditions."""
ERRORS = (
    "time_backwards", "time_unit", "not_finite", "lost_samples", "too_short", "no_motion", "dead_channel", "frozen_channel",
    "saturated_channel", "unit", "reversed", "swapped_joints", "swapped_arms", "exchanged_target",
    "measured_before_command", "shifted_from_twin", "beyond_limits", "beyond_effort", "wrong_inertia", "reversed_effort",
    "effort_time", "frozen_effort", "effort_unit",
    *CELL_ERRORS,
)  # fmt: skip
"""Checks that can end in an error, and so can be accepted with ``--accept``."""
_NO_MORE = ("time_backwards", "time_unit", "not_finite", "too_short")
"""With these nothing else can be judged."""


def check_names(accept: Sequence[str]) -> None:
    """Check that ``accept`` holds names of checks in ``ERRORS``.

    Raises:
        TaccorlError: there is no check of such a name.
    """
    for name in accept:
        if name not in ERRORS:
            raise TaccorlError(f"--accept={name}: no check with this name reports errors; {nearest(name, ERRORS)}")


def accepted(findings: Sequence[Finding], accept: Sequence[str]) -> list[Finding]:
    """Copy of ``findings`` in which errors of the checks named in ``accept`` are warnings that state the acceptance."""
    return [
        dataclasses.replace(f, severity="warning", text=f"{f.text}. An error, accepted by --accept={f.check}")
        if f.severity == "error" and f.check in accept
        else f
        for f in findings
    ]


def check_measurement(
    m: Measurement,
    joints: Sequence[str] = (),
    floor: dict[str, float] | None = None,
    accept: Sequence[str] = (),
    limits: Mapping[str, float] | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Finding]:
    """All findings on one measurement, worst first.

    Args:
        joints: signals to be fitted; each must move.
        floor: signal → noise floor of positions (rad, m); estimated from this measurement alone by default.
        accept: names of checks whose errors are known and become warnings.
        limits: signal → largest effort that its machine states [N·m, N]; a plateau there is no finding.
        progress: function that is called with a text about the present check.
    """
    progress("checking times and values")
    for name in joints:
        if name not in m.signals:
            raise TaccorlError(f"{m.name}: no signal {name!r} to check; {nearest(name, m.signals)}")
    findings = accepted([*m.findings, *check_time(m), *check_values(m)], accept)
    if not any(f.check in _NO_MORE for f in findings):
        progress("checking efforts, motion and wiring")
        findings += accepted(_check_effort(m, limits or {}), accept)
        followed = [s for s in m.signals if m.target_kind(s) == "position"]  # a velocity or a torque is not followed
        if followed:
            m = m.only(followed)
            findings += accepted(_check_motion(m, joints) + _check_start(m) + check_wiring(m), accept)
            if not any(f.severity == "error" and f.check != "lost_samples" for f in findings):
                progress("checking its clock")
                findings += accepted(check_clock(m, floor or _own_floor(m)), accept)
    return sorted(findings, key=lambda f: _ORDER.index(f.severity))


def check_measurements(
    measurements: Sequence[Measurement],
    joints: Sequence[str] = (),
    accept: Sequence[str] = (),
    limits: Mapping[str, float] | None = None,
    progress: Callable[[str, str], None] = lambda name, text: None,
) -> dict[str, list[Finding]]:
    """Check several measurements; each joint must move in one of them. Also finds measurements that repeat another without
    stating it.

    Args:
        joints: signals to be fitted.
        accept: names of checks whose errors are known and become warnings.
        limits: signal → largest effort that its machine states [N·m, N]; a plateau there is no finding.
        progress: function that is called with (name of a measurement, text about the present check).

    Returns:
        Name of the measurement → its findings, worst first.
    """
    found = {}
    for k, m in enumerate(measurements, 1):
        place = f"recording {k} of {len(measurements)}, "
        found[m.name] = check_measurement(
            m, accept=accept, limits=limits, progress=lambda text, m=m, place=place: progress(m.name, place + text)
        )
    moved = {name for m in measurements for name, far in zip(m.signals, _moves(m), strict=True) if far}
    for m in measurements[:1]:
        found[m.name] += [_no_motion(m, name) for name in joints if name not in moved]
    for a, b in itertools.combinations([m for m in measurements if not _broken(found[m.name])], 2):
        told = b.name in (a.name, a.repeat_of) or a.name == b.repeat_of or (a.repeat_of and a.repeat_of == b.repeat_of)
        if not told:
            try:
                found[b.name].append(_same_commands(a, b, overlay(a, b)))
            except TaccorlError:
                continue  # other commands
    sound = [m for m in measurements if not _broken(found[m.name])]
    for m in sound[:1]:
        progress(m.name, f"checking what {len(sound)} recordings do not repeat")
    for name, finding in check_repeatability(sound):
        found[name].append(finding)
    return found


def _same_commands(a: Measurement, b: Measurement, laid: Overlay) -> Finding:
    """What to write into the index of two recordings that were given the same commands."""
    floors = [_own_floor(a), _own_floor(b)]
    ratios = {}
    for j, name in enumerate(a.signals):
        difference = laid.difference["position"][:, j]
        noise = math.sqrt(sum(floor[name] ** 2 for floor in floors))
        if np.isfinite(difference).any() and math.isfinite(noise):
            ratios[name] = (float(np.sqrt(np.nanmean(difference**2))), noise)
    worst = max(ratios, key=lambda name: ratios[name][0] / ratios[name][1], default="")
    if not worst or ratios[worst][0] <= DIFFERENT * ratios[worst][1]:
        text = (
            f"{b.name} was given the same commands as {a.name}: say `repeat_of: {a.name}`, and the noise floor comes "
            "from both"
        )
        return Finding("same_motion", "note", "", text)
    rms, noise = ratios[worst]
    if worst in ROBOT.action_names:
        arm = next(arm for arm in ROBOT.arms if worst.startswith(arm))
        held = f"`payload_kg: {{{arm}: 0.5}}`"
    else:
        held = f"`payload_kg: {{{worst}: 0.5}}` with its `lever_m` for an axis file; a robot file needs a model with that mass"
    text = (
        f"{b.name} was given the same commands as {a.name}, but {worst} moved differently: by {rms:.2g} "
        f"{a.units[a.column(worst)]} (RMS), {rms / noise:.0f} times what noise allows. Had it other gains? Write `{b.name}: "
        f"{{gain_scale: {{{worst}: 2.0}}}}` with their factor, or kp and kd, under `recordings:` in measurements.yaml. Did it "
        f"hold something? Write {held}. Only if nothing was changed and the robot does not repeat, write "
        f"`repeat_of: {a.name}`"
    )
    return Finding("same_commands", "warning", worst, text)


def _own_floor(m: Measurement) -> dict[str, float]:
    """Signal → noise floor from this measurement alone; nothing is known of one that was not measured."""
    known = noise_floor([dataclasses.replace(m, repeat_of=None)])
    return {name: known[name].value if name in known else math.inf for name in m.signals}


def _broken(findings: list[Finding]) -> bool:
    return any(f.severity == "error" for f in findings)


def _place(m: Measurement, first: int, end: int) -> str:
    last = min(end, m.num_rows - 1)
    return f"rows {first} to {end - 1} ({m.time_s[first]:.3f} to {m.time_s[last]:.3f} s)"


# values and motion -----------------------------------------------------------------------------------------------------


def check_values(m: Measurement) -> list[Finding]:
    """Findings about the values: targets that are not finite, gaps of the measurement, too little motion; empty if there are
    none."""
    findings = []
    for name, values in zip(m.signals, m.target.T, strict=True):
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            text = (
                f"{name}: its target is no number in {len(bad)} rows, first at row {bad[0]} ({m.time_s[bad[0]]:.3f} "
                "s); cut them out"
            )
            findings.append(Finding("not_finite", "error", name, text, (int(bad[0]), int(bad[-1]) + 1)))
    known = np.asarray(np.isfinite(m.measured))
    compared = np.asarray(known.any(axis=0))  # a signal that was never measured is not compared
    holes = runs(np.asarray(~known[:, compared].all(axis=1)))
    if holes:
        first, end = max(holes, key=lambda r: r[1] - r[0])
        some = [n for n, c in zip(m.signals, compared, strict=True) if c]
        names = [n for n, c in zip(m.signals, known[first:end].T, strict=True) if not c.all() and n in some]
        text = (
            f"{listed(names)}: nothing was measured in {_place(m, first, end)}, {len(holes)} such holes: no row "
            "there can be compared. Record again with less load on the logger, or cut the recording there"
        )
        # Short gaps of a table were judged where it was brought to an even grid.
        even = any(f.check == "resampled" for f in m.findings)
        if not even or (end - first) * m.period_s > LONGEST_GAP_S:
            findings.append(Finding("lost_samples", "error", names[0], text, (first, end)))
    seconds = _motion_s(m)
    if seconds < SHORT_S and any(_moves(m)):
        too_short = seconds < TOO_SHORT_S and not _comes_to_rest(m)
        check, severity = ("too_short", "error") if too_short else ("short", "warning")
        text = (
            f"{seconds:.2f} s of motion in {m.num_rows} rows: three parameters of a joint want 10 s that sweep it "
            "from slow to fast"
        )
        findings.append(Finding(check, severity, "", text))
    return findings


def _moves(m: Measurement) -> list[bool]:
    """Whether each signal is commanded to move. A command that stands still moves a joint that starts away from it and comes."""
    found = []
    for j, (name, target) in enumerate(zip(m.signals, m.target.T, strict=True)):
        known, least = target[np.isfinite(target)], least_motion(m, name)
        found.append(bool(len(known) and (np.ptp(known) > least or _comes(m, j, least))))
    return found


def _comes(m: Measurement, j: int, least: float) -> bool:
    """Whether the joint is more than ``least`` [rad, m] from its target at the start, and at the end less than half as far."""
    if m.target_kind(m.signals[j]) != "position":
        return False
    off = m.target[:, j] - m.measured[:, j]
    off = np.abs(off[np.isfinite(off)])
    return bool(len(off) and off[0] > least and off[-1] < 0.5 * off[0])


def _comes_to_rest(m: Measurement) -> bool:
    """Whether all signals stand still in the last tenth of a second: the answer to a step is whole, however short."""
    rows = max(3, round(ANSWER_S / m.period_s))
    known = np.isfinite(m.measured).all(axis=0)
    last = [np.ptp(values[-rows:, known], axis=0) for values in (m.target, m.measured)]
    span = np.ptp(m.measured[:, known], axis=0)
    return bool(known.any() and (last[0] == 0.0).all() and (last[1] <= np.maximum(DEAD_SHARE * span, 1e-9)).all())


def least_motion(m: Measurement, name: str) -> float:
    """Least range of the command of signal ``name`` that counts as motion [rad, m]."""
    j = m.column(name)
    usual = MOVED[m.units[j]]
    if name in ROBOT.action_names:
        return usual
    # Noise of the readings from their fourth differences, in which slow motion is nothing.
    q = m.measured[np.isfinite(m.measured[:, j]), j]
    noise = 1.4826 * float(np.median(np.abs(np.diff(q, 4)))) / np.sqrt(70.0) if len(q) > 20 else 0.0
    resolved = max(float(m.quantum[j]), noise)
    return min(usual, MOVED_STEPS * resolved) if resolved > 0.0 else usual


def _motion_s(m: Measurement) -> float:
    """From the first change of a command to the last."""
    changed = np.flatnonzero(np.any(np.diff(m.target, axis=0) != 0, axis=1))
    return float(m.time_s[changed[-1] + 1] - m.time_s[changed[0]]) if len(changed) else 0.0


def _no_motion(m: Measurement, name: str) -> Finding:
    j = m.column(name)
    unit = m.units[j]
    text = (
        f"{name} is never commanded to move (by {np.ptp(m.target[:, j]):.2g} {unit}, it takes {least_motion(m, name):.2g}): "
        "nothing about it can be learnt here; record a sweep of it"
    )
    return Finding("no_motion", "error", name, text)


def _check_motion(m: Measurement, joints: Sequence[str] = ()) -> list[Finding]:
    """Findings about joints that do not move, do not answer, or stop answering; empty if there are none.

    Args:
        joints: signals that must move; of the others only those that move are checked.
    """
    moves = _moves(m)
    if not any(moves):
        few, more = list(zip(m.signals, m.units, strict=True))[:2], " …" * (len(m.signals) > 2)
        text = (
            f"no command moves ({', '.join(f'{n} by less than {least_motion(m, n):.2g} {u}' for n, u in few)}{more}) in "
            f"{m.time_s[-1]:.1f} s: record a sweep"
        )
        return [Finding("no_motion", "error", "", text)]
    findings = [_no_motion(m, name) for name in joints if not moves[m.column(name)]]
    for j in np.flatnonzero(moves):
        name, measured, target = m.signals[j], m.measured[:, j], m.target[:, j]
        known = measured[np.isfinite(measured)]
        if len(known) and np.ptp(known) < DEAD_SHARE * np.ptp(target):
            still = "the same number all the time" if np.ptp(known) == 0 else f"within {np.ptp(known):.2g} {m.units[j]}"
            text = (
                f"{name} stays {still} while its command moves by {np.ptp(target):.3g} {m.units[j]} over "
                f"{m.time_s[-1]:.1f} s: motor off, brake on, or its driver repeats one value; look at `taccorl "
                "view` of the recording and record again"
            )
            findings.append(Finding("dead_channel", "error", name, text))
        elif m.units[j] == "rad":  # a gripper stands still on what it holds
            findings += _check_stuck(m, int(j))
    return findings


def _check_stuck(m: Measurement, j: int) -> list[Finding]:
    name, measured, target = m.signals[j], m.measured[:, j], m.target[:, j]
    same = np.concatenate([[False], np.diff(measured) == 0])
    stands: list[Finding] = []
    for first, end in sorted(runs(same), key=lambda r: r[0] - r[1]):
        rows = (first - 1, end)
        held_s = m.time_s[end - 1] - m.time_s[first - 1]
        moved = np.ptp(target[rows[0] : end])
        before_answer = np.ptp(target[rows[0] : max(end - max(round(ANSWER_S / m.period_s), 1), first)])
        if held_s < FROZEN_S or moved < FROZEN_MOVE or before_answer < REST_SHARE * moved:
            continue
        if (sign := _stop_side(m, j, rows)) is not None:
            stands = stands or [_blocked(m, j, sign, rows)]
            continue
        if goes_on := _sticks(m, j, rows):
            text = (
                f"{name} stands at {measured[first]:.4f} {m.units[j]} for {held_s:.2f} s while its command moves by "
                f"{moved:.3g} {m.units[j]}, {_place(m, *rows)}, and {goes_on}: it "
                "sticks, as dry friction does (effects coulomb_friction, stribeck_friction), or something held it. If "
                "its driver repeated old values, cut this out"
            )
            stands = stands or [Finding("sticking_joint", "warning", name, text, rows)]
            continue
        edge = measured[first] in (np.nanmax(measured), np.nanmin(measured))
        check = "saturated_channel" if edge else "frozen_channel"
        why = (
            "its furthest reading: the end of the encoder's or the message's range"
            if edge
            else "its driver repeats old values, or the bus was silent"
        )
        text = (
            f"{name} reads {measured[first]:.4f} {m.units[j]} without change for {held_s:.2f} s while its command "
            f"goes {moved:.3f}, {_place(m, *rows)}: {why}. Record again within its "
            "range, or cut this out"
        )
        return [Finding(check, "error", name, text, rows)]
    if stands:
        return stands
    for sign in (1.0, -1.0):
        furthest = np.nanmax(sign * measured)
        at_stop = (sign * measured > furthest - 0.1 * BLOCKED_RAD) & (sign * target > furthest + BLOCKED_RAD)
        for first, end in runs(at_stop):
            if m.time_s[end - 1] - m.time_s[first] >= BLOCKED_S:
                return [_blocked(m, j, sign, (first, end))]
    return []


def _blocked(m: Measurement, j: int, sign: float, rows: tuple[int, int]) -> Finding:
    """Warning that a joint stays at the end of its measured range although its command lies beyond that end.

    Args:
        sign: +1 for the upper end, −1 for the lower end.
        rows: first row, and last row + 1, in which it does.
    """
    first, end = rows
    furthest = float(np.nanmax(sign * m.measured[:, j]))
    text = (
        f"{m.signals[j]} stands at {sign * furthest:.3f} {m.units[j]} for {m.time_s[end - 1] - m.time_s[first]:.2f} s although "
        f"it is commanded {np.max(sign * m.target[first:end, j]) - furthest:.3f} further, {_place(m, first, end)}: a stop or "
        "something in its way (effect end_stop), the motor's limit (effect torque_saturation), or a weight that its controller "
        "does not carry, which the model knows; sweep within its range if that is not what you measure"
    )
    return Finding("blocked", "warning", m.signals[j], text, rows)


def _stop_side(m: Measurement, j: int, rows: tuple[int, int]) -> float | None:
    """+1 or −1 if the joint stood at a stop at that end of its range; None if it did not, or that is not known."""
    first, end = rows
    measured, target = m.measured[:, j], m.target[:, j]
    near = 0.1 * BLOCKED_RAD
    for sign in (1.0, -1.0):
        at_end = sign * measured[first] > np.nanmax(sign * measured) - near
        beyond = np.max(sign * (target[first:end] - measured[first])) > BLOCKED_RAD
        if at_end and beyond and stood_at_stop(target, measured, m.period_s, rows, sign, near):
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
    flickers = still & (np.abs(np.diff(measured, n=2, append=measured[-1])) > 1.5 * quantum)
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
    # At the start it stands wherever it stood before, until its friction gives way.
    furthest = np.nanmax(side * measured)
    extreme = first > 0 and side * measured[first] == furthest
    goes_away = grows > max(2.0 * quantum, STICK_GROWS * float(np.ptp(target[first:end])))
    # Further out than the joint came: its readings end there, unless it stood as far off elsewhere.
    if (extreme or ends) and goes_away and (not ends or float(np.max(far[first:end])) > STICK_ERRORS * usual):
        return ""
    if ends:
        return "the recording ends there"
    jump = abs(float(measured[end] - measured[end - 1]))
    if jump > STICK_STEPS * max(quantum, float(np.median(moving))):
        return ""
    return f"goes on from there ({jump:.2g} {m.units[j]} to the next row)"


def _check_start(m: Measurement) -> list[Finding]:
    """Warnings about signals that were not at rest near their command at the start, as the twin is; empty if all were."""
    rows = min(max(START_ROWS[0], round(START_S / m.period_s)), START_ROWS[1])
    findings = []
    if m.num_rows <= rows:
        return findings
    past = m.time_s[:rows] - m.time_s[0]
    for j, (name, unit) in enumerate(zip(m.signals, m.units, strict=True)):
        measured, target = m.measured[:rows, j], m.target[:rows, j]
        if not (np.isfinite(measured).all() and np.isfinite(target).all()) or steps_at_once(m, j):
            continue
        speed, sd = _speed_at_start(past, measured)
        # The second part: what the answer to a command that begins at once looks like in a parabola.
        allowed = START_SPEED[unit] + 0.25 * float(np.ptp(target)) / past[-1]
        if speed > allowed + 5 * sd:
            text = (
                f"{name} moves at {speed:.3f} ± {sd:.3f} {unit}/s at row 0 (0.000 s), the twin starts at rest: "
                "begin the recording a second before the motion"
            )
            findings.append(Finding("not_at_rest", "warning", name, text, (0, rows)))
        off = float(measured[0] - target[0])
        if unit == "rad" and abs(off) > START_OFFSET_RAD and np.ptp(target) < 1e-3 and speed <= allowed:
            text = (
                f"{name} stands {off:+.3f} rad from its command at row 0 (0.000 s) and stays there: switched off, "
                "blocked, or a zero point that differs between the two (`zero:` of a column in a columns file is its number "
                "at 0 rad); record with the motor on"
            )
            findings.append(Finding("start_offset", "warning", name, text, (0, rows)))
    return findings


def _speed_at_start(past_s: np.ndarray, measured: np.ndarray) -> tuple[float, float]:
    """(speed at row 0, its standard deviation), from a parabola; from a cubic where the parabola does not do."""
    for order in (3, 2):
        design = np.vander(past_s, order + 1, increasing=True)
        solution = np.linalg.lstsq(design, measured, rcond=None)[0]
        left = measured - design @ solution
        covariance = float(left @ left) / max(len(left) - order - 1, 1) * np.linalg.inv(design.T @ design)
        sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        if abs(solution[-1]) > 5 * sd[-1]:
            break
    return abs(float(solution[1])), float(sd[1])


def _check_effort(m: Measurement, limits: Mapping[str, float]) -> list[Finding]:
    """Findings about efforts that are constant while the joint moves (warning), or stop at a limit that is not the one stated in
    ``limits`` (note); empty if there are none."""
    findings = []
    recorded = m.has_effort()
    for j in np.flatnonzero(np.array(_moves(m)) & recorded):
        name, effort = m.signals[j], m.effort[:, j]
        known = effort[np.isfinite(effort)]
        largest = float(np.abs(known).max())
        if np.ptp(known) == 0:
            text = (
                f"{name}: its effort reads {known[0]:.3g} all the time while it moves: not measured; it is of no "
                "use for a fit"
            )
            findings.append(Finding("dead_effort", "warning", name, text))
            continue
        findings += _frozen_effort(m, int(j))
        at = np.flatnonzero(np.abs(effort) == largest)
        value, level, least = largest, f"exactly ±{largest:.3g}", max(3, int(AT_LIMIT_SHARE * len(known))) + 1
        if len(at) < least:
            at, value, sd = _plateau(m, j)
            level, least = f"±{value:.3g} (within {sd:.2g}, its noise)", PLATEAU_ROWS
        if len(at) >= least and abs(value - limits.get(name, math.inf)) > STATED_LIMIT * value:
            text = (
                f"{name}: its effort is {level} in {len(at)} rows, first at row {at[0]} "
                f"({m.time_s[at[0]]:.2f} s): the drive's limit (effect torque_saturation) or the end of the "
                "report's range"
            )
            findings.append(Finding("effort_limit", "note", name, text, (int(at[0]), int(at[-1]) + 1)))
    return findings


def _frozen_effort(m: Measurement, j: int) -> list[Finding]:
    """Error if the effort stays the same to the last bit for ``FROZEN_EFFORT_S`` while the joint goes to and fro, though it
    changes from row to row elsewhere; efforts at their largest value are left to the limit of the drive."""
    effort, name = m.effort[:, j], m.signals[j]
    same = np.diff(effort) == 0
    first, end = max(runs(same), key=lambda run: run[1] - run[0], default=(0, 0))
    inside = m.measured[first : end + 1, j]
    inside = inside[np.isfinite(inside)]
    at_limit = abs(effort[first]) == np.nanmax(np.abs(effort))
    outside = np.delete(same, np.s_[first:end])
    if at_limit or end - first < FROZEN_EFFORT_S / m.period_s or (outside.size and outside.mean() > 0.5):
        return []
    move = FROZEN_MOVE * (0.1 if m.units[j] == "m" else 1.0)
    rises, falls = inside - np.minimum.accumulate(inside), np.maximum.accumulate(inside) - inside
    if min(rises.max(initial=0.0), falls.max(initial=0.0)) < move:
        return []
    way_out = (
        f"leave {name}.tau out of the columns"
        if is_table(m)
        else f"write `effort_scale: {{{name}: 0}}` in measurements.yaml"
    )
    text = (
        f"{name}: its effort reads {effort[first]:.4g} in all of {_place(m, first, end + 1)}, while the joint goes to and fro by "
        f"{np.ptp(inside):.2g} {m.units[j]}: the driver repeated an old value. Cut this out, or {way_out}"
    )
    return [Finding("frozen_effort", "error", name, text, (first, end + 1))]


def _plateau(m: Measurement, j: int) -> tuple[np.ndarray, float, float]:
    """Rows in which a linear law of target, position and speed, fitted to the rows of less effort, asks for more than the largest
    effort, while the effort stays at it but for its noise; that effort [N·m, N], and its standard deviation in these rows. No
    rows if there is no such law."""
    nothing = np.zeros(0, dtype=int), 0.0, 0.0
    target, q, effort = m.target[:, j], m.measured[:, j], m.effort[:, j]
    if not np.isfinite([target, q, effort]).all():
        return nothing
    before = np.concatenate([target[:1], target[:-1]])
    columns = np.column_stack([target, before, q, np.gradient(q, m.period_s), np.ones_like(q)])
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
    if np.std(law[rows] * np.sign(effort[rows])) < 5.0 * sd or size.max() > level + 6.0 * max(sd, 1e-12):
        return nothing
    return rows, level, sd
