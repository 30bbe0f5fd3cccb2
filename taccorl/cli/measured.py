"""Code shared by the verbs that read measurements: loading of the twin, and the checks before any conclusion."""

import dataclasses
import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from taccorl.errors import TaccorlError

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.alignment.measurements.measurement import Measurement
    from taccorl.data.finding import Finding
    from taccorl.diagnosis.comparison.result import Comparison, Trace
    from taccorl.diagnosis.machines.machine import Machine

FAR_OFF = 0.3
"""A replay explains hardly anything if its RMS error is more than this share of the motion's RMS about its mean."""
AS_FAR_AS_TARGET = 0.8
"""A replay explains hardly anything if its RMS error is more than this share of the tracking error (measured − target). For a
simulated servo the share was 0.9 to 6 with 1000 times the supply voltage, or with kp 57 times too large or small; 0.34 with the
right values and a hidden friction."""
MOSTLY_CONSTANT = 0.5
"""Share of the squared error from which its mean is named: two columns whose zeros differ. A choice."""
MANY_ROWS = 1_000_000
"""Rows of all recordings from which on their number is printed first. A choice."""
MOST_ROWS = 500_000
"""Rows of one recording beyond which a joint is not diagnosed. A choice: at 0.2 µs a row and replay (three physics steps a row),
3400 replays for one effect of EMPS take six minutes then, and 70 000 replays to the noise floor two hours."""
FEWEST_FLOORS = 10.0
"""A replay with an error below this many noise floors is never reported."""


def checked(
    machine: "Machine", measurements: "Measurements", verdict: str, accept: Sequence[str] = ()
) -> dict[str, list["Finding"]] | None:
    """Run the checks of telemetry and of the machine, and print their findings.

    Args:
        verdict: text with which the message begins if there are errors.
        accept: checks whose errors become warnings.

    Returns:
        Name of a recording → its findings; None if there are errors.
    """
    from taccorl.alignment.checks.one_cause import one_cause
    from taccorl.alignment.checks.telemetry import accepted, check_measurements
    from taccorl.cli.tables import LINE_EVERY_S, Steps

    rows, seconds = (
        sum(values) for values in zip(*((m.num_rows, m.time_s[-1]) for m in measurements.all), strict=True)
    )
    if rows > MANY_ROWS:
        print(
            f"{rows} rows, {seconds:.0f} s in all: checks and replays of so many take minutes; 10 s of each motion are enough",
            flush=True,
        )
    steps = Steps(every_s=0.0 if rows > MANY_ROWS else LINE_EVERY_S)
    found: dict[str, list[Finding]] = {}
    if machine.of_joints:
        limits = machine.effort_limits
        found = check_measurements(measurements.all, accept=accept, limits=limits, progress=steps)
    timed = all(m.period_s > 0 for m in measurements.all)  # else the checks above name the rows
    own = machine.check(measurements) if timed else {}
    found = {
        m.name: [*_judged(m, found.get(m.name, [])), *accepted(own.get(m.name, []), accept)] for m in measurements.all
    }
    found = one_cause(found, measurements.all)
    wrong = sorted({name for name, own in found.items() if any(f.severity == "error" for f in own)})
    print_findings(found if wrong else {name: [f for f in own if not _waits(f)] for name, own in found.items()})
    for line in measurements.skipped:
        print(f"not read: {line}")
    if wrong:
        print(
            f"{verdict}: errors in {', '.join(wrong)}, each with what to record or correct instead, see above; an error "
            "that is none here is accepted by --accept=CHECK"
        )
        return None
    return found


def refuse_long(measurements: "Measurements") -> None:
    """Raise if a recording has more rows than a diagnosis of joints can replay some thousand times.

    Raises:
        TaccorlError: one has more than ``MOST_ROWS``.
    """
    longest = max(measurements.all, key=lambda m: m.num_rows)
    if longest.num_rows > MOST_ROWS:
        raise TaccorlError(
            f"{longest.name}: {longest.num_rows} rows, {longest.time_s[-1]:.0f} s; a diagnosis replays each row thousands of "
            f"times and takes up to {MOST_ROWS} rows of one recording. Cut it into the motions that differ; 10 s of each are "
            "enough. taccorl compare takes the whole recording, which it replays once"
        )


def unused_accepts(accept: Sequence[str], *found: dict[str, list["Finding"]]) -> None:
    """Warn about checks in ``--accept`` that no recording violates: they have no effect."""
    checks = {f.check for findings in found for own in findings.values() for f in own}
    for name in dict.fromkeys(accept):
        if name not in checks:
            print(f"--accept={name}: no recording has that finding; leave it out")


def of_replays(
    comparison: "Comparison", findings: dict[str, list["Finding"]], accept: Sequence[str]
) -> dict[str, list["Finding"]]:
    """Findings about clocks that comparing each recording with its replay gave: name of a recording → findings. A time shift is
    only a warning for an arm whose pose is unknown.

    Args:
        findings: findings of earlier checks; the feature of a ``pose_unknown`` finding is the arm, or empty for all joints.
        accept: checks whose errors become warnings.
    """
    from taccorl.alignment.checks.telemetry import accepted

    late = {}
    for name, clock in comparison.clock.items():
        unknown = [f.feature.removesuffix(" arm") for f in findings.get(name, []) if f.check == "pose_unknown"]
        if clock:
            late[name] = [
                dataclasses.replace(
                    f,
                    severity="warning",
                    text=f"{f.text}. A wrong pose shifts the replay, too: correct pose_unknown first",
                )
                if f.severity == "error" and any(f.feature.startswith(arm) for arm in unknown)
                else f
                for f in accepted(clock, accept)
            ]
    return late


def without_explained(findings: dict[str, list["Finding"]], comparison: "Comparison") -> dict[str, list["Finding"]]:
    """``findings`` without late answers that the replay shows as well: the file's own friction or inertia holds a joint back."""

    def explained(f: "Finding", name: str) -> bool:
        traces = comparison.of(f.feature) if f.check == "late_answer" else ()
        return any(_as_late(t) for t in traces if t.recording == name)

    return {name: [f for f in own if not explained(f, name)] for name, own in findings.items()}


def _as_late(t: "Trace") -> bool:
    """Whether the replay comes as late after the target as the measurement, within half a row."""
    from taccorl.alignment.checks.first_order import fit_first_order

    period_s = (t.time_s[-1] - t.time_s[0]) / (len(t.time_s) - 1)
    measured, replayed = (fit_first_order(t.target, q, period_s).delay_s for q in (t.measured, t.replayed))
    return measured - replayed < 0.5 * period_s


def print_replays(
    comparison: "Comparison", findings: dict[str, list["Finding"]], late: dict[str, list["Finding"]]
) -> None:
    """Print the findings of replays, and in one line the joints whose clock neither they nor the checks before could judge."""
    judged = {f.feature for own in late.values() for f in own if f.check in ("same_onset", "shifted_from_twin")}
    shown: dict[str, list[Finding]] = {}
    for name in dict.fromkeys([*findings, *late]):
        open_ = [f for f in late.get(name, []) if not (_waits(f) and f.feature in judged)]
        unjudged = {f.feature for f in open_ if _waits(f)}
        before = [f for f in findings.get(name, []) if _waits(f) and f.feature not in judged]
        stays = [f for f in before if f.check == "late_answer" or f.feature in unjudged or name not in comparison.clock]
        open_ = [*stays, *open_]
        if open_ or name in late:
            shown[f"replay of {name}"] = open_
    print_findings(shown)


def _waits(f: "Finding") -> bool:
    """Whether a replay may still judge what the checks before it could not."""
    from taccorl.alignment.checks.clock import CLOCK

    return f.check == "late_answer" or (f.check == "not_judged" and f.topic == CLOCK)


def far_off(comparison: "Comparison", fitted: Collection[str] = ()) -> list[str]:
    """Lines to print, one for each signal whose replay explains hardly anything: its error is above ``FAR_OFF`` times the
    measured motion, or above ``AS_FAR_AS_TARGET`` times the tracking error, in the recordings of one use (fit, validation, test).

    Args:
        fitted: signals whose gains are only the start of a fit.
    """
    import numpy as np

    lines: dict[str, str] = {}
    for s in comparison.scores():
        if s.kind != "position" or s.ratio < FEWEST_FLOORS:
            continue
        traces = comparison.of(s.signal, "position", s.use)
        of_target = math.sqrt(np.nansum([np.nansum(np.square(t.measured - t.target)) for t in traces]) / max(s.n, 1))
        # A drive that takes no position has the replay in place of a target.
        has_target = not any(np.array_equal(t.target, t.replayed, equal_nan=True) for t in traces)
        if s.nrmse > FAR_OFF or (has_target and s.rmse > AS_FAR_AS_TARGET * of_target > 0):
            of = (
                f", {s.rmse / of_target:.0%} of what the target by itself is off"
                if has_target and of_target > 0
                else ""
            )
            off = np.concatenate([t.measured - t.replayed for t in traces])
            mean = float(np.nanmean(off))
            is_constant = mean * mean > MOSTLY_CONSTANT * s.rmse**2
            if s.signal in fitted and not is_constant:
                lines[s.signal] = (
                    f"{s.signal}: the replay is off by {s.nrmse:.0%} of the measured motion, with the gains of the file, which "
                    "are only a start (gains: fitted); diagnose --until=noise_floor writes those that the recordings determine"
                )
                continue
            constant = (
                f"Most of it is a constant: measured positions stand {mean:+.3g} {traces[0].unit} from the replay. Give the "
                "number that a column has at 0 as its `zero:` in a columns file. Else check"
                if is_constant
                else "A wrong number is more likely than a missing effect: check"
            )
            per = "per rad, not per degree" if traces[0].unit == "rad" else "per m, not per mm"
            lines[s.signal] = (
                f"{s.signal}: the replay is off by {s.nrmse:.0%} of the measured motion (RMS about its mean; {s.use}){of}. "
                f"{constant} unit or factor of its columns, kp and kd ({per}), inertia, and of law pwm "
                "supply_v, resistance_ohm and torque_nm_per_a"
            )
    return list(lines.values())


def clock_is_off(late: dict[str, list["Finding"]], num_recordings: int) -> bool:
    """True if more than half of the recordings show that their time stamps are shifted; those that leave it open whether it is
    the clock or an effect do not count. A single one may instead lack physics or have other gains.

    Args:
        late: name of a recording → findings of ``of_replays``.
    """
    from taccorl.alignment.checks.clock import UNDECIDED

    shifted = {name for name, found in late.items() if any(f.severity == "error" for f in found)}
    undecided = {name for name, found in late.items() if any(f.check == UNDECIDED for f in found)} - shifted
    return 2 * len(shifted) > num_recordings - len(undecided)


def _judged(m: "Measurement", findings: list["Finding"]) -> list["Finding"]:
    """A press need not move a joint as far or as long as a sweep does."""
    return [f for f in findings if m.pressed is None or f.check not in ("no_motion", "short", "too_short")]


def print_findings(found: dict[str, list["Finding"]]) -> None:
    """Print the findings of each recording, with equal ones in one line. What several recordings share is printed once, with the
    first of them and their number.

    Args:
        found: name of a recording → its findings.
    """
    from rich.text import Text

    from taccorl.cli.tables import SEVERITY, console, findings_table

    shared: dict[tuple[str, str, str], list[tuple[str, Finding]]] = {}
    for name, findings in found.items():
        for f in findings:
            shared.setdefault(_key(f), []).append((name, f))
    several = {key: of for key, of in shared.items() if key[0] == "note" or len({name for name, _ in of}) > 1}
    for name, findings in found.items():
        own: dict[str, list[Finding]] = {}
        for f in findings:
            if _key(f) not in several:
                own.setdefault(f.check, []).append(f)
        if own:
            findings_table(name, [_together(same) for same in own.values()])
    sound = [name for name, findings in found.items() if all(f.severity == "note" for f in findings)]
    if sound:
        findings_table(f"{len(sound)} recordings: {', '.join(sound)}", [])
    for severity in SEVERITY:
        for same in (of for key, of in several.items() if key[0] == severity):
            name, f = same[0]
            more = f" (and {len(same) - 1} more)" if len(same) > 1 else ""
            features = list(dict.fromkeys(other.feature for _, other in same if other.feature != f.feature))
            also = f". Also: {', '.join(features)}" if features else ""
            line = Text(f"  {severity:8s}", SEVERITY[severity]) + Text(f"{name}{more}: {f.check}: {f.text}{also}")
            console().print(line, soft_wrap=True)


def _key(f: "Finding") -> tuple[str, str, str]:
    """What findings in one line have in common: their topic, or the feature if they have none."""
    return f.severity, f.check, f.topic or f.feature


def _together(same: list["Finding"]) -> "Finding":
    """The first of several alike, and where else it is so."""
    others = [f.feature for f in same[1:]]
    return dataclasses.replace(same[0], text=f"{same[0].text}. Also: {', '.join(others)}") if others else same[0]
