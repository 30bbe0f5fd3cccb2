"""Check that a measurement is good enough to judge a twin. This is done before any effect is considered.

The checks of joints are in ``time_stamps``, ``motion`` (values, efforts, motion, start), ``wiring`` (which joint follows which
command, units), ``clock`` (offsets in time), ``unrepeated`` (recordings of one motion), ``robot`` and ``effort_time`` (a robot's
file); those of cells in ``cells``. ``registry.CHECKS`` lists their names and severities.

An error that a user has examined can be accepted by its name; it stays in the report as a warning. Every finding names joint,
value and place, and what to record or change.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from taccorl.alignment.checks import (
    cells,
    clock,
    effort_time,
    robot,
    time_stamps,
    unsigned,
    wiring,
)
from taccorl.alignment.checks.registry import (
    CHECKS,
    accepted,
    check,
    check_names,
    find,
    is_cause,
    run,
    without_explained,
)
from taccorl.alignment.checks.trial import MOVED, Trial, least_motion
from taccorl.alignment.checks.unrepeated import check_clock_rates, check_repeatability
from taccorl.alignment.measurements.folder import copies
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.repeats import Overlay, overlay
from taccorl.data.finding import Finding
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT

__all__ = [
    "MOVED",
    "accepted",
    "check_copies",
    "check_measurement",
    "check_measurements",
    "check_names",
    "least_motion",
    "one_cause",
]
LISTED = cells, clock, effort_time, robot, time_stamps, unsigned, wiring
"""Modules whose checks the list has once they are imported."""
DIFFERENT = 3.0
"""Two recordings of the same commands that differ by more than so many noise floors were made in different conditions."""
ORDER = ("error", "warning", "note")
NO_MORE = (
    "time_backwards",
    "time_unit",
    "not_finite",
    "too_short",
)  # With these nothing else can be judged


def check_measurement(
    m: Measurement,
    accept: Sequence[str] = (),
    limits: Mapping[str, float] | None = None,
    rates: Mapping[str, float] | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Finding]:
    """All findings on one measurement, worst first.

    Args:
        accept: names of checks whose errors are known and become warnings.
        limits: signal → largest effort that its machine states [N·m, N]; a plateau there is no finding.
        rates: as in ``Trial``.
        progress: function that is called with a text about the present check.
    """
    progress("checking times and values")
    whole = Trial(m, limits or {}, rates or {})
    findings = accepted([*m.findings, *run("rows", whole)], accept)
    if not any(f.check in NO_MORE for f in findings):
        progress("checking efforts, motion and wiring")
        findings += accepted(run("effort", whole), accept)
        followed = [
            s for s in m.signals if m.target_kind(s) == "position"
        ]  # a velocity or a torque is not followed
        if followed:
            trial = Trial(m.only(followed), limits or {}, rates or {})
            findings += accepted(run("position", trial), accept)
            if not any(
                f.severity == "error"
                and f.check not in ("lost_samples", "dead_channel")
                for f in findings
            ):
                progress("checking its clock")
                findings += accepted(run("clock", trial), accept)
                findings = [_held_and_exchanged(m, f, findings) for f in findings]
    return sorted(findings, key=lambda f: ORDER.index(f.severity))


def check_measurements(
    measurements: Sequence[Measurement],
    accept: Sequence[str] = (),
    limits: Mapping[str, float] | None = None,
    rates: Mapping[str, float] | None = None,
    progress: Callable[[str, str], None] = lambda name, text: None,
) -> dict[str, list[Finding]]:
    """Check several measurements. Also finds measurements that repeat another without stating it, and copies. Returns name of the
    measurement → its findings, worst first. ``accept``, ``limits``, ``rates``: as in ``check_measurement``; ``progress`` is
    called with (name of a measurement, text about the present check)."""
    found = {}
    for k, m in enumerate(measurements, 1):
        place = f"recording {k} of {len(measurements)}, "
        trial = partial(check_measurement, m, accept=accept, limits=limits, rates=rates)
        found[m.name] = trial(
            progress=lambda text, m=m, place=place: progress(m.name, place + text)
        )
    clock.check_late_recordings(measurements, found)
    found = {m.name: accepted(found[m.name], accept) for m in measurements}
    sound = [
        m for m in measurements if not any(f.severity == "error" for f in found[m.name])
    ]
    for name, finding in check_clock_rates(sound):
        found[name].append(finding)
    sound = [m for m in sound if not any(f.severity == "error" for f in found[m.name])]
    moves = {m.name: {*np.flatnonzero(np.ptp(m.target, axis=0))} for m in sound}
    for name, finding in _slower_rows(sound, rates or {}):
        found[name].append(finding)
    copied = check_copies(sound)
    found = {name: [*own, *copied.get(name, [])] for name, own in found.items()}
    for a, b in itertools.combinations([m for m in sound if m.name not in copied], 2):
        if not moves[a.name] & moves[b.name]:
            continue  # other joints: of a hundred recordings most pairs
        told = (
            b.name in (a.name, a.repeat_of)
            or a.name == b.repeat_of
            or (a.repeat_of and a.repeat_of == b.repeat_of)
        )
        if not told:
            try:
                found[b.name].append(_same_commands(a, b, overlay(a, b)))
            except TaccorlError:
                continue  # other commands
    for m in sound[:1]:
        progress(m.name, f"checking what {len(sound)} recordings do not repeat")
    for name, finding in check_repeatability(sound):
        found[name].append(finding)
    late = {
        m.name: {f.feature for f in found[m.name] if f.check == "late_answer"}
        for m in measurements
    }
    for m in (
        measurements
    ):  # one motion has one delay: what a repeat does not show is chance
        first = m.repeat_of or m.name
        always = set.intersection(
            *(late[x.name] for x in measurements if (x.repeat_of or x.name) == first)
        )
        found[m.name] = [
            f
            for f in found[m.name]
            if f.check != "late_answer" or f.topic or f.feature in always
        ]
    return found


def _held_and_exchanged(
    m: Measurement, f: Finding, findings: Sequence[Finding]
) -> Finding:
    """A dead channel beside exchanged columns: of a joint that is held, the target stands still and the position is shaken."""
    exchanged = [other for other in findings if other.check == clock.EXCHANGED_COLUMNS]
    if (
        f.check != "dead_channel"
        or not exchanged
        or np.ptp(m.measured[:, m.column(f.feature)]) > 0.0
    ):
        return f
    text = f"{f.feature}: its position is one number and its target moves; as with {exchanged[0].feature}, the two are exchanged"
    return find(clock.EXCHANGED_COLUMNS, f.feature, text)


@check("warning", "slower_rows")
def _slower_rows(
    sound: Sequence[Measurement], rates: Mapping[str, float]
) -> Iterator[tuple[str, Finding]]:
    """Find recordings with fewer rows a second than targets changed in another one; ``rates``: joint → stated command_hz or 0."""
    trials = [Trial(m) for m in sound]
    for signal in (signal for signal, hz in rates.items() if hz == 0.0):
        moved = [t.m for t in trials if signal in {t.m.signals[j] for j in t.moving}]
        rows = [
            (m, np.diff(np.flatnonzero(np.diff(m.target[:, m.column(signal)]))))
            for m in moved
        ]
        many = [
            (m.rate_hz / float(np.median(own)), m.name)
            for m, own in rows
            if len(own) > 20
        ]  # a choice, as is 1.5
        hz, fastest = max(many, default=(0.0, ""))
        for m in (m for m in moved if 1.5 * m.rate_hz < hz):
            text = (
                f"{signal}: {m.rate_hz:g} rows a second here, {hz:g} targets a second in {fastest}: each target is held for its "
                f"row. If as many were sent here, write `command_hz: {hz:g}` of {signal} into the file of your robot or axis; if "
                "one a row was sent, nothing"
            )
            yield m.name, find("slower_rows", signal, text, topic="rows")


@check("warning", "copied_recording")
def check_copies(measurements: Sequence[Measurement]) -> dict[str, list[Finding]]:
    """Find recordings that hold the same numbers as another. Returns: name of the copy → one warning."""
    why = "number for number: nothing new, and no repeat for the noise floor. Remove it, and its entry in measurements.yaml if it"
    end = "has one (a simulation without noise repeats so as well)"
    of = copies(measurements)
    return {
        name: [find("copied_recording", "", f"{name} is {first}, {why} {end}")]
        for name, first in of.items()
    }


@check("note", "same_motion")
@check("warning", "same_commands")
def _same_commands(a: Measurement, b: Measurement, laid: Overlay) -> Finding:
    """What to write into the index of two recordings that were given the same commands."""
    floors = [Trial(a).floor, Trial(b).floor]
    ratios = {}
    for j, name in enumerate(a.signals):
        difference = laid.difference["position"][:, j]
        noise = math.sqrt(sum(floor[name] ** 2 for floor in floors))
        if np.isfinite(difference).any() and math.isfinite(noise):
            ratios[name] = (float(np.sqrt(np.nanmean(difference**2))), noise)
    worst = max(ratios, key=lambda name: ratios[name][0] / ratios[name][1], default="")
    if not worst or ratios[worst][0] <= DIFFERENT * ratios[worst][1]:
        text = f"{b.name} was given the same commands as {a.name}: say `repeat_of: {a.name}`, and the noise floor comes from both"
        return find("same_motion", "", text)
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
        f"hold something? Write {held}. Only if nothing was changed and the robot does not repeat, write `repeat_of: {a.name}`"
    )
    return find("same_commands", worst, text)


def _turned(m: Measurement, f: Finding) -> Measurement:
    return dataclasses.replace(
        m, measured=np.where(np.array(m.signals) == f.feature, -1.0, 1.0) * m.measured
    )


def _exchanged(m: Measurement, f: Finding) -> Measurement:
    own, q, target = np.array(m.signals) == f.feature, m.measured, m.target
    return dataclasses.replace(
        m, measured=np.where(own, target, q), target=np.where(own, q, target)
    )


def _of_other(m: Measurement, f: Finding) -> Measurement:
    (other,) = set(f.topic.split(" ↔ ")) - {f.feature}
    measured, pair = m.measured.copy(), [m.column(f.feature), m.column(other)]
    measured[:, pair] = measured[:, pair[::-1]]
    return dataclasses.replace(m, measured=measured)


CORRECTED: Mapping[str, Callable[[Measurement, Finding], Measurement]] = {
    "reversed": _turned,
    clock.EXCHANGED_COLUMNS: _exchanged,
    "swapped_joints": _of_other,
}
"""Check of a column that is wrong in every recording of a set → function that returns a recording with what the finding says
corrected."""


def one_cause(
    found: Mapping[str, Sequence[Finding]],
    recordings: Sequence[Measurement],
    rates: Mapping[str, float] | None = None,
) -> dict[str, list[Finding]]:
    """Findings of a set with one cause for each signal whose column is wrong in every recording: it looks reversed in one and
    late in another.

    If a signal is reversed, or exchanged with its target, in most of the recordings that have an error of it, the others are
    checked again with that corrected. Those that pass have the same cause; findings that it explains are removed, as are those
    that any other error of the signal explains.
    ``found``: name of a recording → its findings. ``rates``: as in ``Trial``."""
    every = [f for own in found.values() for f in own if f.severity == "error"]
    causes = [f for own in found.values() for f in own if is_cause(f)]
    result = without_explained(found, [f for f in causes if f.check not in CORRECTED])
    wrong = {
        f.feature
        for own in result.values()
        for f in own
        if f.check in CORRECTED and f.severity == "error"
    }
    for signal in sorted(wrong):
        of_signal = {
            n: [f for f in own if f.feature == signal and f.severity == "error"]
            for n, own in result.items()
        }
        errors = {n: {f.check: f for f in own} for n, own in of_signal.items()}
        of = {
            cause: [name for name, own in errors.items() if cause in own]
            for cause in CORRECTED
        }
        cause = max(of, key=lambda c: len(of[c]))
        follow = {*CORRECTED, *CHECKS[cause].explains}
        others = [
            name
            for name, own in errors.items()
            if own.keys() & follow and name not in of[cause]
        ]
        if len(of[cause]) <= len(others):
            continue
        first = errors[of[cause][0]][cause]
        corrected = (
            CORRECTED[cause](m, first).only([signal])
            for m in recordings
            if m.name in others
        )
        again = [
            (m.name, f) for m in corrected for f in check_measurement(m, rates=rates)
        ]
        fails = {
            name for name, f in again if f.severity == "error" and f.check in follow
        }
        if cause == "reversed" and any(
            (f.check, f.feature) == ("reversed_effort", signal) for f in every
        ):
            more = f". Its effort pushes against its acceleration as well: it is {signal}.q"
            errors[of[cause][0]][cause] = dataclasses.replace(
                first, text=first.text + more
            )
        text = f"{first.text}. So in {of[cause][0]}; with that corrected this recording passes"
        for name in result.keys() - fails:  # these have a cause of their own
            kept = [
                f for f in result[name] if f.feature != signal or f.check not in follow
            ]
            if name in others:
                kept.append(find(cause, signal, text, topic=first.topic))
            elif cause in errors[name]:
                kept.append(errors[name][cause])
            result[name] = kept
    columns = [f for f in every if f.check in CORRECTED]
    of_all = {name for name, listed in CHECKS.items() if listed.of_all}
    explained = {e for f in columns for e in CHECKS[f.check].explains} & of_all
    return {
        name: [f for f in own if f.check not in explained]
        for name, own in result.items()
    }
