"""Check that command and measurement are on one clock, to less than a row.

* No joint moves before it is commanded: a measurement that **leads** its command has wrong time stamps, whatever the physics.
* A measurement that comes **late** may have a late clock or a real delay. Positions alone do not distinguish them.
* A joint that an object stops while its command goes on follows the command up to there; the rest of the command is left out.
* Offsets below one row (5 ms) are found in the first movement after a step, or if the joint responds as a first-order lag
  (``first_order``), or in the onset of its steps beside a replay. Otherwise an offset of a row looks like a missing
  effect, and the finding states that it was not judged.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from taccorl.alignment.checks import first_order
from taccorl.alignment.checks.first_order import (
    REST_S,
    Shift,
    delay_between,
    fit_first_order,
)
from taccorl.alignment.checks.motion import BLOCKED_RAD, BLOCKED_S
from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.checks.trial import Trial, noise_of_rows, scale, write
from taccorl.alignment.checks.wiring import FOLLOWS_FROM
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.quantisation import find_quantum
from taccorl.alignment.measurements.tables import is_table
from taccorl.data.finding import Finding, not_judged
from taccorl.data.joint_checks import LAG_SURE, find_lag
from taccorl.data.timing import runs
from taccorl.errors import TaccorlError

CLOCK = "clock"  # Topic of findings that the clock of a joint could not be judged, or was judged by the onsets of steps
FAR = "late"  # Topic of late answers beyond ``DELAY_S``
SHIFTED = "shifted_from_twin"
"""Check whose findings state that a measurement leads the twin's replay, or comes after it."""
UNDECIDED = "clock_or_effect"
"""Check whose findings state that a measurement leads the twin's replay, which an effect of the drive explains as well."""
EXCHANGED_COLUMNS = "exchanged_target"
"""Check whose findings state that the columns of target and position are exchanged."""
SURE = 4.0  # Number of standard deviations above which an offset is significant
HALF_ROW_MOST = 0.75  # A lead below this [rows] can arise because the replay holds targets that the drive interpolated
LEAD_ROWS = (
    0.3  # Least lead that is reported [rows]; a smaller one can be an error of the fit
)
HIDDEN = 3.0
"""A shift is ignored if it alone would leave so many times what measurement and replay differ by: other numbers would have to
hide it. A choice."""
BETTER = 0.9
"""A lead is an offset of the clock if a shift leaves less than this share of what an effect of the drive leaves. Of simulated
joints with stated gains that led by one row it left 0.27 to 0.85 of what velocity_feedforward left, and 1.6 to 15 times as much
where that effect was hidden."""
SAME_FIT = 1.1
"""A shift alone explains a difference if it leaves at most so many times what a shift, another gain and another lag leave. A
choice."""
NOT_A_SHIFT = 2.0
"""A delay beside another gain and another lag is not reported if it is more than so many times the best shift alone (or a row):
slow motions do not tell delay and lag apart. A choice."""
LATE_ROWS = 1.2
"""Least delay that is reported [rows]. A second pole (inertia over K_d) counts as delay, up to 5.7 ms at the twin's joints 2 and
3, so that less is expected."""
FITTING = 3.0
"""A first-order lag describes a joint if it leaves an RMS error below this [noise floors]; else see ``FITTING_ROWS``."""
FITTING_ROWS = 0.05
"""A first-order lag also describes a joint if its residual is below this share of that of an offset of one row; the delay is
then wrong by a sixth of a row at most."""
STEP_FLOORS = (
    8.0  # Least motion in the first row after a step for judging it [noise floors]
)
EXCHANGED = 0.7
"""Columns of target and position are exchanged if the residual of a lag fitted from position to target is below this share of
that from target to position."""
ROUGHER = 3.0
"""Columns of target and position are also exchanged if neither fit decides, and the noise of the column given as the target is
this many times the other's."""
NOISELESS = 50.0
"""The column whose noise is so many times the other's, and the step of the other's values, is the measured one. A choice."""
USUAL_TAU_S = 0.12
"""Slowest time constant of a joint in the paper (Fig. "Per-joint controller SysID"): a step moves a joint in its first row by at
least step · period / τ."""


@check(
    "error",
    "measured_before_command",
    explains=("effort_time", "other_gains", "reversed_effort", "wrong_inertia"),
)
@check("error", EXCHANGED_COLUMNS, explains=FOLLOWS_FROM)
@check("note", "late_answer", needs="clock")
def check_clock(t: Trial) -> Iterator[Finding]:
    """Leads, late answers, exchanged columns, and signals that could not be judged."""
    m, even = t.m, t.even
    stepped = _early_steps(t)
    for name, rows in stepped.items():
        where = (
            "before the row of its step"
            if t.early_rows(name)
            else "where its step is only commanded"
        )
        text = (
            f"{name} has moved at row {rows[0]} ({m.time_s[rows[0]]:.3f} s), {where} ({len(rows)} such "
            f"steps): one row or more too early. {_earlier_targets(m, m.period_s)}, or log both by one clock"
        )
        yield find("measured_before_command", name, text, (rows[0], rows[0] + 1))
    judged = bool(stepped)
    for j in t.moving:
        name, factor, row_s = even.signals[j], scale(even, j), m.period_s
        target, measured = _until_stopped(even, j), even.measured[:, j]
        try:
            fit = fit_first_order(target, measured, even.period_s)
        except TaccorlError:
            continue
        judged = True
        if name in stepped:
            continue
        lag = find_lag(
            target[:, None] * factor,
            measured[:, None] * factor,
            max(1, round(even.rate_hz)),
        )
        delay, early_s = (
            f"{fit.delay_s * 1e3:.2f} ± {fit.delay_sd_s * 1e3:.2f} ms",
            t.early_rows(name) * row_s,
        )
        if (
            lag.correlation >= LAG_SURE and lag.lag_s < -0.5 * row_s - early_s
        ):  # velocities of steps hardly correlate
            if _exchanged(
                target,
                measured,
                even.period_s,
                -lag.lag_s,
                find_quantum(m.target[:, j]),
                m.quantum[j],
            ):
                yield _exchange(name, -lag.lag_s, m)
            else:
                yield _lead(
                    name,
                    -lag.lag_s,
                    m,
                    "its movement correlates best with a later command",
                )
        elif far := first_order.far_delay(even.target[:, j], measured, even.period_s):
            text = (
                f"{name} answers its target {far.delay_s:.2f} s late ({far.delay_s / row_s:.0f} rows, then a lag of "
                f"{far.time_constant_s * 1e3:.0f} ms): positions are stamped or paired late, commands early, or a driver "
                "queues commands; positions cannot tell which. Gains, inertia and units come after it: compare the clocks, and "
                f"{_earlier_positions(m)}. Only if the clocks agree is it a delay (effects command_delay, sensor_delay)"
            )
            yield find("late_answer", name, text, severity="warning", topic=FAR)
        elif not fit.rms < max(FITTING * t.floor[name], FITTING_ROWS * fit.row_rms):
            why = f"it shows in steps; {_steps_wanted(m, name, t.floor[name])}"
            yield not_judged(
                name, f"an offset of one row ({row_s * 1e3:.1f} ms)", why, CLOCK
            )
        elif fit.delay_s + SURE * fit.delay_sd_s < -LEAD_ROWS * row_s - early_s:
            yield _lead(
                name,
                -fit.delay_s,
                m,
                f"lag {fit.time_constant_s * 1e3:.1f} ms, delay {delay}",
            )
        elif fit.delay_s - SURE * fit.delay_sd_s > LATE_ROWS * row_s:
            text = (
                f"{name} answers its target {fit.delay_s * 1e3:.1f} ms ({fit.delay_s / row_s:.1f} rows) later than a lag of "
                f"{fit.time_constant_s * 1e3:.0f} ms does: by its inertia and by a real delay or a clock offset, which "
                "positions cannot tell apart. If the clocks are known to agree, diagnose fits the delay (effects "
                "command_delay, sensor_delay) beside the inertia; else compare them or log both by one clock"
            )
            yield find("late_answer", name, text)
    if not judged:
        yield not_judged(
            "", "clock of command and measurement", "no joint moves enough to tell"
        )


@check("error", "late_recording")
def check_late_recordings(
    recordings: Sequence[Measurement], found: dict[str, list[Finding]]
) -> None:
    """Turn far delays of signals that answer at once in at least as many other recordings into errors: a robot's own delay is in
    all of them. Changes ``found``, name of a recording → its findings."""
    far = {
        (m.name, f.feature): f
        for m in recordings
        for f in found[m.name]
        if f.topic == FAR
    }
    for signal in {feature for _, feature in far}:
        late = [m for m in recordings if (m.name, signal) in far]
        sound = [
            m
            for m in recordings
            if signal in m.signals
            and m not in late
            and m.column(signal) in Trial(m).moving
        ]
        if len(late) > len(sound) or not sound:
            continue
        for m in late:
            old = far[m.name, signal]
            text = (
                f"{old.text.partition(': positions')[0]}, and not in {len(sound)} other recordings ({sound[0].name} …): the "
                f"clock of this one is off, or columns are shifted. {_earlier_positions(m).capitalize()}, or leave this one out"
            )
            found[m.name] = [
                find("late_recording", signal, text) if f is old else f
                for f in found[m.name]
            ]


def _until_stopped(m: Measurement, j: int) -> np.ndarray:
    """(T,) target of an even measurement, of which the part beyond an object that stops the joint is replaced by where it stands.

    A joint is stopped where it stands within ``BLOCKED_RAD`` / 5 for ``BLOCKED_S`` while its target is ``BLOCKED_RAD`` (a tenth
    of it in m) or more beyond; friction and lag leave less of a joint that stands."""
    target, measured = (
        m.target[:, j].copy(),
        np.nan_to_num(m.measured[:, j], nan=np.inf),
    )
    beyond, rows = BLOCKED_RAD / scale(m, j), max(2, round(BLOCKED_S / m.period_s))
    with np.errstate(invalid="ignore"):
        still = (
            maximum_filter1d(measured, rows) - minimum_filter1d(measured, rows)
            < 0.2 * beyond
        )
    for side in (1.0, -1.0):
        for first, end in runs(still & (side * (target - measured) > beyond)):
            at = float(np.median(measured[first:end]))
            for start, stop in runs(side * (m.target[:, j] - at) > 0.0):
                if start < end and first < stop:
                    target[start:stop] = at
    return target


def _early_steps(t: Trial) -> dict[str, list[int]]:
    """Signal → rows of its steps from rest at which it has moved already, where that is at least half of its steps; the rows
    before those where targets are sent between rows."""
    m, before, settle = t.m, round(REST_S / t.m.period_s), 5
    changes = np.diff(m.target, axis=0)
    still = np.all(np.abs(changes) < 1e-6, axis=1)
    found: dict[str, list[int]] = {}
    for j in t.moving:
        floor, first = t.floor[m.signals[j]], t.early_rows(m.signals[j])
        large = np.flatnonzero(np.abs(changes[:, j]) > _least_step(m, floor)) + 1
        steps = [
            int(k) for k in large if k > before and still[k - 1 - before : k - 1].all()
        ]
        seen = [
            (
                k - first,
                m.measured[k - 1 - before : k + 1 - first, j],
                changes[k - 1, j],
            )
            for k in steps
        ]
        early = [k for k, values, step in seen if _moved(values, settle, step, floor)]
        if early and len(early) >= len(steps) / 2:
            found[m.signals[j]] = early
    return found


def _least_step(m: Measurement, floor: float) -> float:
    """Least size of a step from rest [rad, m] at which its first row of movement can be told from noise."""
    return STEP_FLOORS * floor * USUAL_TAU_S / m.period_s


def _moved(values: np.ndarray, settle: int, step: float, floor: float) -> bool:
    """Whether the last of ``values`` has gone in the step's direction, from the line through those well before it."""
    past = np.arange(len(values) - 1 - settle)
    rest = values[: len(past)]
    if not np.isfinite(values).all() or len(past) < 5:
        return False
    line = np.polynomial.polynomial.polyfit(past, rest, 1)
    noise = max(
        floor, float(np.std(rest - np.polynomial.polynomial.polyval(past, line)))
    )
    gone = (
        values[-1] - np.polynomial.polynomial.polyval(len(values) - 1, line)
    ) * np.sign(step)
    return bool(gone > (SURE + 1) * 1.5 * noise)


def _steps_wanted(m: Measurement, signal: str, floor: float) -> str:
    """Text: the motion that shows an offset of one row."""
    return f"record two of {_least_step(m, floor):.2g} {m.units[m.column(signal)]} from {2 * REST_S:g} s of rest"


def _lead(signal: str, lead_s: float, m: Measurement, how: str) -> Finding:
    text = (
        f"{signal} answers {lead_s * 1e3:.1f} ms ({lead_s / m.period_s:.1f} rows) before its command ({how}), all "
        f"through {m.time_s[-1] - m.time_s[0]:.1f} s: stamps of commands are late or those of positions early. "
        f"{_earlier_targets(m, lead_s)}, or log both by one clock"
    )
    return find("measured_before_command", signal, text)


def _exchange(signal: str, lead_s: float, m: Measurement) -> Finding:
    where = write(
        m,
        f"give {signal}.q the column that {signal}.q_target has now, and the other way round, in a columns file",
        f"exchange the channels of state and command of {signal} in the recording spec",
    )
    text = (
        f"{signal}: the target follows the measured position by {lead_s * 1e3:.1f} ms, as a joint follows its target, over "
        f"{m.time_s[-1] - m.time_s[0]:.1f} s: the two are exchanged; {where}"
    )
    return find(EXCHANGED_COLUMNS, signal, text)


def _exchanged(
    target: np.ndarray,
    measured: np.ndarray,
    period_s: float,
    lead_s: float,
    *steps: float,
) -> bool:
    """Whether the target follows the position as a joint follows its target, and the position does not follow the target so.

    Noise of one beside none of the other decides (``steps``: of both encoders). Else a lag is fitted both ways, without the lead.
    Where neither leaves less than an offset of one row would and much less than the other, the rougher is the measured one."""
    lead = math.ceil(lead_s / period_s)
    if not np.isfinite(measured).all():
        return False
    noise = noise_of_rows(target), noise_of_rows(measured)
    for k in (0, 1):
        if noise[k] > NOISELESS * max(noise[1 - k], steps[1 - k]):
            return k == 0
    turned = fit_first_order(measured, target, period_s)
    forward = fit_first_order(target[lead:], measured[:-lead], period_s)
    if turned.rms < min(turned.row_rms, EXCHANGED * forward.rms):
        return turned.delay_s > -LEAD_ROWS * period_s
    if forward.rms < min(forward.row_rms, EXCHANGED * turned.rms):
        return False
    return noise[0] > ROUGHER * noise[1]


def _earlier_positions(m: Measurement) -> str:
    """Text: the correction for positions that are late."""
    otherwise = "correct `latency_s` of the state's channel in the recording spec"
    return write(
        m,
        "shift the position columns against time, or log both by one clock",
        otherwise,
    )


def _earlier_targets(m: Measurement, lead_s: float, *, whole: bool = False) -> str:
    """Text: the correction for positions that are ``lead_s`` [s] ahead of their targets.
    ``whole``: the joint's own lag is not in ``lead_s``. Otherwise it hides a part of the offset, and rows are rounded up."""
    rows = (
        max(1, round(lead_s / m.period_s)) if whole else math.ceil(lead_s / m.period_s)
    )
    if is_table(m):
        return f"Write `target_rows_late: {rows}`{'' if whole else ' (or more)'} into the columns file"
    if (m.source / "meta" / "info.json").is_file():
        return (
            "If each row holds a command that was sent right after its observation, write `action_time: this_row` into the "
            "dataset spec and ingest again"
        )
    return "Set `latency_s` of the state's channel in the recording spec"


@check("error", SHIFTED)
@check("warning", UNDECIDED)
def check_against_twin(
    m: Measurement,
    reported: np.ndarray,
    floor: dict[str, float],
    uncertain: Collection[str] = (),
    changed: Callable[[str], Sequence[np.ndarray]] = lambda signal: (),
    rivals: Callable[[str], Mapping[str, np.ndarray]] = lambda signal: {},
) -> list[Finding]:
    """Findings about time shifts between the measurement and the twin's replay of its commands. A shift is reported only if it
    can be distinguished from other gains (both are fitted together) and from a missing effect (the residual must be small).

    Args:
        reported: (T, J) positions of the twin, in the rows of ``m.target`` [rad, m].
        floor: signal → noise floor of positions [rad, m].
        uncertain: signals of drives with unknown numbers (gains, k_t, back-EMF), which diagnose fits. Wrong numbers also shift
            the replay, so that a lead of these signals is only a warning.
        changed: function that returns the twin's positions (T,) of a signal with another inertia, stiffness and damping. A shift
            that these explain, or that they leave uncertain, is not reported.
        rivals: function that returns, by the names of effects, the twin's positions (T,) of a signal with a little of an effect
            that takes lag off. A lead that one of them explains as well as a shift is only a warning.
    """
    findings, period_s = [], m.period_s
    late: dict[str, tuple[float, float]] = {}
    for j in Trial(m).moving:
        name = m.signals[j]
        rows = m.target[:, j], m.measured[:, j], reported[:, j]
        try:
            shift = delay_between(*rows, period_s)
            if _leads(shift, period_s):
                shift = delay_between(*rows, period_s, changed(name))
            plain = first_order.pure_shift(*rows[1:], period_s)
        except TaccorlError as error:
            findings.append(
                not_judged(name, "its offset in time from the twin", str(error), CLOCK)
            )
            continue
        is_plain = (
            plain.rms <= SAME_FIT * shift.rms
        )  # nothing else is needed beside a shift
        if is_plain and plain.delay_s > 0:
            shift = plain
        elif _is_late(shift, period_s) and not _is_late(
            delay_between(*rows, period_s, changed(name)), period_s
        ):
            shift = dataclasses.replace(
                plain, row_rms=0.0
            )  # other numbers explain it without a delay
        hidden = HIDDEN * np.nanstd(rows[1] - rows[2])
        contrary = _leads(shift, period_s) and _is_late(
            plain, period_s
        )  # so friction looks beside a longer lag
        if contrary or shift.rms > max(
            FITTING * floor[name], FITTING_ROWS * shift.row_rms
        ):
            why = f"look for the missing effect first, which leaves {plain.rms / floor[name]:.0f} noise floors"
            unjudged = not_judged(name, "its offset in time from the twin", why, CLOCK)
            findings.append(_by_steps(m, name, reported[:, j], floor[name]) or unjudged)
        elif (
            name not in uncertain
            and abs(shift.delay_s) / period_s * shift.row_rms > hidden
        ):
            continue
        elif _leads(shift, period_s):
            effects = {} if name in uncertain else rivals(name)
            rival = _rival(*rows[1:], plain, effects)
            findings.append(
                _led(
                    m,
                    name,
                    plain if is_plain and plain.delay_s < 0 else shift,
                    rival,
                    name in uncertain,
                )
            )
        elif _is_late(shift, period_s):
            if shift.delay_s > NOT_A_SHIFT * max(plain.delay_s, period_s):
                why = f"more lag explains its {plain.delay_s * 1e3:.0f} ms; of steps, {_steps_wanted(m, name, floor[name])}"
                findings.append(
                    not_judged(name, "its offset in time from the twin", why, CLOCK)
                )
                continue
            late[name] = shift.delay_s, shift.delay_sd_s
            text = (
                f"{name}: the measurement comes {_size(shift, period_s)} after the twin's replay: a real delay (effects "
                "command_delay, sensor_delay), or a clock offset; positions cannot tell which. Compare the "
                f"clocks{'' if m.has_effort()[j] else ', or record effort too'}"
            )
            findings.append(find(SHIFTED, name, text, severity="warning"))
    return _with_common_delay(findings, late, period_s)


def beside_onsets(
    clock: Mapping[str, Sequence[Finding]],
) -> dict[str, tuple[Finding, ...]]:
    """Findings of ``check_against_twin``, recording → findings. If a joint leads its replay in two or more recordings, but starts
    its steps on time in another (``same_onset``), clocks agree: errors become warnings that name gains; ``UNDECIDED`` goes."""
    all_of = [f for own in clock.values() for f in own]
    leads = Counter(
        f.feature
        for f in all_of
        if f.check == UNDECIDED or (f.check == SHIFTED and f.severity == "error")
    )
    same = {
        f.feature for f in all_of if f.check == "same_onset" and leads[f.feature] > 1
    }
    why = (
        "though its steps begin on one clock: gains that are not the stated ones (`gains: fitted` fits them) or a missing effect "
        "look like this"
    )

    def said(f: Finding) -> Finding:
        if f.check != SHIFTED or f.severity != "error" or f.feature not in same:
            return f
        return dataclasses.replace(
            f, severity="warning", text=f"{f.text.partition('): ')[0]}), {why}"
        )

    return {
        n: tuple(said(f) for f in own if f.check != UNDECIDED or f.feature not in same)
        for n, own in clock.items()
    }


def _size(shift: Shift, period_s: float) -> str:
    rows = abs(shift.delay_s) / period_s
    return f"{abs(shift.delay_s) * 1e3:.1f} ± {shift.delay_sd_s * 1e3:.1f} ms ({rows:.1f} rows)"


def _led(
    m: Measurement, name: str, shift: Shift, rival: str, uncertain: bool
) -> Finding:
    """Finding that a measurement leads the twin's replay, which the effect ``rival`` explains as well if there is one."""
    text = (
        f"{name}: the measurement leads the twin's replay by {_size(shift, m.period_s)}"
    )
    if rival:
        text += (
            f", which the effect {rival} explains as well as a shift: the search decides. Recordings of steps and of fast motion "
            "tell them apart; if the search does not add it, compare the clocks"
        )
        return find(UNDECIDED, name, text)
    numbers = (
        "the drive's numbers in the file are off (diagnose fits them), or " * uncertain
    )
    text += f": {numbers}positions stamped too early or commands too late, or paired one row off. "
    text += _earlier_targets(m, -shift.delay_s, whole=True)
    if uncertain:
        text += " only if the lead remains with the numbers that were fitted"
    elif -shift.delay_s < HALF_ROW_MOST * m.period_s:
        text += (
            ". Half a row is also what a drive shows that receives targets faster than they are logged: state that "
            "rate as `command_hz` in the file of your robot or axis"
        )
    return find(SHIFTED, name, text, severity="warning" if uncertain else "error")


def _with_common_delay(
    findings: list[Finding], late: Mapping[str, tuple[float, float]], period_s: float
) -> list[Finding]:
    """``findings``, of which those that say that a joint comes late have one topic and name the common delay if all late joints
    agree within half a row or ``SURE`` standard deviations. ``late``: late joint → delay and its standard deviation [s]."""
    delays_s = np.array([delay_s for delay_s, _ in late.values()])
    allowed = np.array([max(0.5 * period_s, SURE * sd_s) for _, sd_s in late.values()])
    if len(late) < 2 or (np.abs(delays_s - np.median(delays_s)) > allowed).any():
        return findings
    common = (
        f" {len(late)} joints are late alike, by {delays_s.min() * 1e3:.1f} … {delays_s.max() * 1e3:.1f} ms: one cause for all, "
        "such as the way of commands or of readings, or a clock"
    )
    return [
        dataclasses.replace(f, text=f"{f.text}.{common}", topic="late")
        if f.check == SHIFTED and f.feature in late
        else f
        for f in findings
    ]


@check("note", "same_onset")
def _by_steps(
    m: Measurement, signal: str, reported: np.ndarray, floor: float
) -> Finding | None:
    """Finding on the onsets after steps, where effects are missing; None if the recording has no steps that show them."""
    onset = first_order.onset_delay(m, signal, reported, floor)
    if onset is None:
        return None
    rows = abs(onset.delay_s) / m.period_s
    where = f"{onset.delay_s * 1e3:+.1f} ± {onset.sd_s * 1e3:.1f} ms ({onset.num_steps} steps)"
    if rows < 0.5 and SURE * onset.sd_s < m.period_s:
        text = f"{signal} begins its steps {where} after the twin's replay: on one clock, though effects are missing"
        return find("same_onset", signal, text, topic=CLOCK)
    if rows < 0.5 or abs(onset.delay_s) < SURE * onset.sd_s:
        return None
    way = (
        "a real delay (effects command_delay, sensor_delay), or targets that are stamped too early or paired with later rows; "
        "positions cannot tell which. Compare the clocks"
        if onset.delay_s > 0.0
        else "positions stamped too early, commands too late or paired one row off, or a drive that is sent speeds, too (effect "
        f"velocity_feedforward). If the search does not add that: {_earlier_targets(m, -onset.delay_s, whole=True)}"
    )
    text = f"{signal} begins its steps {where}, {rows:.1f} rows, after the twin's replay, though effects are missing: {way}"
    return find(SHIFTED, signal, text, severity="warning")


def _rival(
    measured: np.ndarray,
    replay: np.ndarray,
    plain: Shift,
    rivals: Mapping[str, np.ndarray],
) -> str:
    """Name of the effect with which the replay comes as near to the measurement as by a shift alone; empty if none does. No other
    number is adjusted: with another K_d and inertia, too, velocity feedforward and a lead are alike.
    ``rivals``: name of an effect → the replay (T,) with a little of it."""
    left = {
        name: first_order.left_by_change(measured, replay, changed)
        for name, changed in rivals.items()
    }
    best = min(left, key=lambda name: left[name], default="")
    return best if best and plain.rms >= BETTER * left[best] else ""


def _leads(shift: Shift, period_s: float) -> bool:
    return -shift.delay_s > max(SURE * shift.delay_sd_s, LEAD_ROWS * period_s)


def _is_late(shift: Shift, period_s: float) -> bool:
    return shift.delay_s > max(SURE * shift.delay_sd_s, 0.5 * period_s)
