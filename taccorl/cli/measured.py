"""Code shared by the verbs that read measurements: loading of the twin, and the checks before any conclusion."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from taccorl.errors import TaccorlError, no_such_path
from taccorl.report.findings import found_in_recordings
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
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
OF_EFFORTS = (
    *("wrong_inertia", "reversed_effort", "beyond_effort", "effort_time"),
    *("frozen_effort", "unsigned_effort"),
)
"""Checks of one joint's efforts and inertia, which do not hinder the diagnosis of others."""
OTHER_GAINS = "other_gains"
"""Check by which efforts have other gains than the file's: no part with it is diagnosed unless it is accepted."""
FEWEST_FLOORS = 10.0
"""A replay with an error below this many noise floors is never reported."""


Show = Callable[..., None]
"""Function that is called with the sections of what is to be said."""


def in_terminal(*sections: Section) -> None:
    """Print sections in the terminal."""
    from taccorl.report.terminal import show

    show(*sections)


@dataclass(kw_only=True)
class MeasuredConfig:
    """Options of the verbs that read measurements of joints, axes, pads and cells."""

    measurements: Path
    """A recording, table or dataset, or a folder of those."""
    twin: Path | None = None
    """File of the machine: a twin.yaml of the PiPER, or a file of kind robot or cells. The nominal twin if not given."""
    joints: list[str] = field(default_factory=list)
    """Only these joints: left_joint5, or joint5 and J4 (the paper's name of it) for both arms; all that move if not given."""
    spec: str | None = None
    """Recording spec; required where several shipped ones read the format."""
    columns: Path | None = None
    """Columns file: names and units of tables' columns that are not taccorl's own, and of other people's LeRobot datasets."""
    validation_every: int | None = None
    """Every k-th motion is for validation; as measurements.yaml states if not given."""
    accept: list[str] = field(default_factory=list)
    """Names of checks whose errors are known, such as frozen_channel: their errors become warnings, which stay in the report."""

    def check_paths(self) -> None:
        """Raises TaccorlError: a path at which there is nothing. Before anything is loaded, which takes seconds."""
        for path in (self.twin, self.columns):
            if path is not None and not path.exists():
                raise TaccorlError(no_such_path(path, "file"))
        if not self.measurements.exists():
            raise TaccorlError(no_such_path(self.measurements))

    def read(self, machine: "Machine", **how: bool) -> "Measurements":
        """The measurements, as ``machine`` reads them; ``how`` as of ``Machine.read``."""
        from taccorl.alignment.checks.telemetry import check_names

        check_names(self.accept)
        every = self.validation_every
        return machine.read(
            self.measurements,
            spec=self.spec,
            columns=self.columns,
            validation_every=every,
            **how,
        )


@dataclass(kw_only=True)
class PartsConfig(MeasuredConfig):
    """Options of the verbs that work on parts one by one."""

    pads: list[str] = field(default_factory=list)
    """Only the pads of these arms: left, right. If no part is named: all joints that move and all pads with a stated object."""
    workers: int = 2
    """Number of joints, or arms with pads, at the same time."""

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise TaccorlError(f"--workers={self.workers}: at least 1")

    def read(self, machine: "Machine", **how: bool) -> "Measurements":
        """The measurements of the named joints: recordings of others, and what is wrong with them, hold nothing up."""
        from taccorl.diagnosis.problems.joints import of_joints

        found = super().read(machine, **how)
        if self.joints and not self.pads:
            return of_joints(
                found, machine.select(machine.parts(found), self.joints, [])
            )
        return found


class Replayed(NamedTuple):
    """Measurements that passed the checks, beside the replays of a machine."""

    comparison: "Comparison"
    """The replays."""
    findings: dict[str, list["Finding"]]
    """Recording → findings of the checks and of its replay."""
    late: dict[str, list["Finding"]]
    """Recording → findings about its clock by its replay."""
    unjudged: dict[str, str]
    """Signal → text on its clock, which nothing judged."""


def replayed(
    machine: "Machine",
    measurements: "Measurements",
    verdict: str,
    accept: Sequence[str],
    replay: "Callable[[], Comparison]",
    why: str = "looks like missing physics",
    clocks: bool = True,
    only: Collection[str] = (),
    show: Show = in_terminal,
) -> Replayed | None:
    """Check measurements before and after their replay, and show the findings. ``verdict``: text with which the message begins
    if there are errors: ``not compared``. ``accept``: checks whose errors become warnings. ``replay``: compares the machine
    with the measurements. ``why``: what an offset of one row does.
    ``clocks``: whether to show which clocks nothing judged. ``only``: parts that are asked for; errors of others are
    warnings. ``show``: function that gets what is to be said. Returns None if there are errors, or most clocks are off."""
    findings = checked(machine, measurements, accept, only, show)
    if wrong := recordings_with_errors(findings):
        with contextlib.suppress(TaccorlError):  # what a replay would refuse as well
            late = of_replays(replay(), findings, accept, only)
            findings |= {name: [*findings[name], *late[name]] for name in late}
        show(Section(text=[refusal(verdict, wrong, findings)]))
        return None
    comparison = replay()
    findings = without_explained(findings, comparison)
    late = of_replays(comparison, findings, accept, only)
    checks = {
        f.check for found in (findings, late) for own in found.values() for f in own
    }
    unused = [
        f"--accept={n}: no recording has that finding; leave it out"
        for n in dict.fromkeys(accept)
        if n not in checks
    ]
    shown = of_recordings(comparison, findings, late)
    unjudged = [f for own in shown.values() for f in own if f.check == "not_judged"]
    shown = {
        name: [f for f in own if clocks or f not in unjudged]
        for name, own in shown.items()
    }
    show(Section(text=unused), *found_in_recordings(shown))
    if clock_is_off(late, len(measurements.all)):
        text = f"{verdict}: time stamps of most recordings are off, see above; an offset of one row {why}"
        show(Section(text=[text, refusal(verdict, recordings_with_errors(late), late)]))
        return None
    every = {
        name: [*findings.get(name, []), *late.get(name, [])]
        for name in (*findings, *late)
    }
    return Replayed(
        comparison, every, late, {f.feature: f.text for f in reversed(unjudged)}
    )


def recordings_with_errors(findings: Mapping[str, Sequence["Finding"]]) -> list[str]:
    """Names of the recordings in which a check found an error."""
    every = findings.items()
    return sorted(n for n, own in every if any(f.severity == "error" for f in own))


def refusal(
    verdict: str, wrong: Sequence[str], findings: Mapping[str, Sequence["Finding"]]
) -> str:
    """Line on recordings with errors, with the one option that accepts all that stops the verb."""
    every = [f for own in findings.values() for f in own]
    stops = [f.check for f in every if f.severity == "error" or f.check == OTHER_GAINS]
    option = f"--accept={','.join(dict.fromkeys(stops))}"
    return (
        f"{verdict}: errors in {', '.join(wrong)}, each with what to record or correct instead, see above; if none of "
        f"them is an error here: {option}"
    )


def of_asked(
    findings: Sequence["Finding"], only: Collection[str], machine_parts: Collection[str]
) -> list["Finding"]:
    """``findings`` with errors as warnings where they are of the efforts of parts that are not asked for. Positions of other
    joints move those that are."""
    others = {*machine_parts} - {*only} if only else set[str]()
    return [
        dataclasses.replace(f, severity="warning")
        if f.severity == "error" and f.check in OF_EFFORTS and f.feature in others
        else f
        for f in findings
    ]


def checked(
    machine: "Machine",
    measurements: "Measurements",
    accept: Sequence[str] = (),
    only: Collection[str] = (),
    show: Show = in_terminal,
) -> dict[str, list["Finding"]]:
    """Run the checks of telemetry and of the machine, and show their findings. ``accept``: checks whose errors become
    warnings. ``only``, ``show``: as of ``replayed``. Returns: name of a recording → its findings."""
    from taccorl.alignment.checks.telemetry import (
        accepted,
        check_copies,
        check_measurements,
        one_cause,
    )
    from taccorl.alignment.checks.unsigned import without_unsigned
    from taccorl.cli.progress import LINE_EVERY_S, Steps

    rows, seconds = (
        sum(each)
        for each in zip(
            *((m.num_rows, m.time_s[-1]) for m in measurements.all), strict=True
        )
    )
    if rows > MANY_ROWS:
        text = (
            f"{rows} rows, {seconds:.0f} s in all: checks and replays of so many take "
            "minutes; 10 s of each motion are enough"
        )
        show(Section(text=[text]))
    steps = Steps(every_s=0.0 if rows > MANY_ROWS else LINE_EVERY_S)
    found = check_copies(measurements.all)
    if machine.of_joints:
        limits, rates = machine.effort_limits, machine.command_rates
        found = check_measurements(
            measurements.all, accept=accept, limits=limits, rates=rates, progress=steps
        )
    uneven = [
        f
        for own in found.values()
        for f in own
        if f.feature == "time" and f.severity == "error"
    ]
    timed = not uneven and all(
        m.period_s > 0 for m in measurements.all
    )  # else the checks above name the rows
    signed = {
        use: tuple(
            without_unsigned(m, measurements.all) for m in getattr(measurements, use)
        )
        for use in ("fit", "validation", "test")
    }
    own = machine.check(dataclasses.replace(measurements, **signed)) if timed else {}
    of_sweeps = (
        "no_motion",
        "short",
        "too_short",
    )  # a press need not move a joint as far or as long
    found = {
        m.name: [
            f
            for f in found.get(m.name, [])
            if m.pressed is None or f.check not in of_sweeps
        ]
        + accepted(own.get(m.name, []), accept)
        for m in measurements.all
    }
    found = one_cause(found, measurements.all, machine.command_rates)
    found = {name: of_asked(own, only, machine.units) for name, own in found.items()}
    show(
        *found_in_recordings(
            {name: [f for f in own if not _waits(f)] for name, own in found.items()}
        )
    )
    lines = [f"not read: {line}" for line in measurements.skipped]
    if measurements.unlisted:
        lines.append(
            f"not listed in measurements.yaml, taken as use: fit: {', '.join(measurements.unlisted)}"
        )
    show(Section(text=lines))
    return found


def refuse_long(measurements: "Measurements") -> None:
    """Raise if a recording has more rows than a diagnosis of joints can replay some thousand times. Raises TaccorlError: one
    has more than ``MOST_ROWS``."""
    longest = max(measurements.all, key=lambda m: m.num_rows)
    if longest.num_rows > MOST_ROWS:
        raise TaccorlError(
            f"{longest.name}: {longest.num_rows} rows, {longest.time_s[-1]:.0f} s; a diagnosis replays each row thousands of "
            f"times and takes up to {MOST_ROWS} rows of one recording. Cut it into the motions that differ; 10 s of each are "
            "enough. taccorl compare takes the whole recording, which it replays once"
        )


def of_replays(
    comparison: "Comparison",
    findings: dict[str, list["Finding"]],
    accept: Sequence[str],
    only: Collection[str] = (),
) -> dict[str, list["Finding"]]:
    """Findings about clocks that comparing each recording with its replay gave: name of a recording → findings. A time shift
    is only a warning for an arm whose pose is unknown, and for a joint with other gains. ``findings``: of earlier checks; the
    feature of ``pose_unknown`` is the arm, or empty for all joints. ``accept``: checks whose errors become warnings."""
    from taccorl.alignment.checks.clock import SHIFTED
    from taccorl.alignment.checks.telemetry import accepted

    late = {}
    for name, clock in comparison.clock.items():
        found = [
            f
            for f in findings.get(name, [])
            if f.check in ("pose_unknown", "other_gains", "other_scale")
        ]
        if clock:
            every = {f.feature for f in clock}
            late[name] = [
                _beside(f, found) if f.check == SHIFTED else f
                for f in of_asked(accepted(clock, accept), only, every)
            ]
    return late


def _beside(shift: "Finding", found: Sequence["Finding"]) -> "Finding":
    """A warning, without its way out, if one of ``found`` explains it."""
    for f in found:
        if f.feature in ("", shift.feature, f"{shift.feature.partition('_')[0]} arm"):
            text = f"{shift.text.partition(': positions stamped')[0]}. {f.check} shifts the replay, too: correct that first"
            return dataclasses.replace(shift, severity="warning", text=text)
    return shift


def without_explained(
    findings: dict[str, list["Finding"]], comparison: "Comparison"
) -> dict[str, list["Finding"]]:
    """``findings`` without late answers that the replay shows as well: the file's own friction or inertia holds a joint back."""

    def explained(f: "Finding", name: str) -> bool:
        traces = comparison.of(f.feature) if f.check == "late_answer" else ()
        return any(_as_late(t) for t in traces if t.recording == name)

    return {
        name: [f for f in own if not explained(f, name)]
        for name, own in findings.items()
    }


def _as_late(t: "Trace") -> bool:
    """Whether the replay comes as late after the target as the measurement, within half a row."""
    from taccorl.alignment.checks.first_order import far_delay, fit_first_order

    period_s = (t.time_s[-1] - t.time_s[0]) / (len(t.time_s) - 1)
    rows = [(t.target, q, period_s) for q in (t.measured, t.replayed)]
    measured, replayed = (
        (far_delay(*of) or fit_first_order(*of)).delay_s for of in rows
    )
    return measured - replayed < 0.5 * period_s


def of_recordings(
    comparison: "Comparison",
    findings: dict[str, list["Finding"]],
    late: dict[str, list["Finding"]],
) -> dict[str, list["Finding"]]:
    """Findings of replays to be shown, with the joints whose clock neither they nor the checks before could judge."""
    judged = {
        f.feature
        for own in late.values()
        for f in own
        if f.check in ("same_onset", "shifted_from_twin")
    }
    shown: dict[str, list[Finding]] = {}
    for name in dict.fromkeys([*findings, *late]):
        open_ = [
            f for f in late.get(name, []) if not (_waits(f) and f.feature in judged)
        ]
        unjudged = {f.feature for f in open_ if _waits(f)}
        before = [
            f
            for f in findings.get(name, [])
            if _waits(f) and (f.feature not in judged or f.severity != "note")
        ]
        stays = [
            f
            for f in before
            if f.check == "late_answer"
            or f.feature in unjudged
            or name not in comparison.clock
        ]
        open_ = [*stays, *open_]
        if open_ or name in late:
            shown[f"replay of {name}"] = open_
    return shown


def _waits(f: "Finding") -> bool:
    """Whether a replay may still judge what the checks before it could not."""
    from taccorl.alignment.checks.clock import CLOCK

    return f.check == "late_answer" or (f.check == "not_judged" and f.topic == CLOCK)


def far_off(
    comparison: "Comparison",
    fitted: Collection[str],
    findings: Mapping[str, list["Finding"]],
) -> list[str]:
    """Lines to print, one for each signal whose replay explains hardly anything: its error is above ``FAR_OFF`` times the
    measured motion, or above ``AS_FAR_AS_TARGET`` times the tracking error, in the recordings of one use (fit, validation,
    test). ``fitted``: signals whose gains are only the start of a fit. ``findings``: name of a recording → its findings."""
    import numpy as np

    lines: dict[str, str] = {}
    late = {
        f.feature
        for own in findings.values()
        for f in own
        if f.check == "late_answer" and f.topic
    }
    for s in comparison.scores():
        if s.kind != "position" or s.ratio < FEWEST_FLOORS:
            continue
        traces = comparison.of(s.signal, "position", s.use)
        of_target = math.sqrt(
            np.nansum([np.nansum(np.square(t.measured - t.target)) for t in traces])
            / max(s.n, 1)
        )
        # A drive that takes no position has the replay in place of a target.
        has_target = not any(
            np.array_equal(t.target, t.replayed, equal_nan=True) for t in traces
        )
        if s.nrmse > FAR_OFF or (
            has_target and s.rmse > AS_FAR_AS_TARGET * of_target > 0
        ):
            share = s.rmse / of_target if has_target and of_target > 0 else 0.0
            of = f", {share:.0%} of what the target by itself is off" * bool(share)
            off = np.concatenate([t.measured - t.replayed for t in traces])
            mean = float(np.nanmean(off))
            is_constant = mean * mean > MOSTLY_CONSTANT * s.rmse**2
            why = "which answers late (late_answer above): correct its times, or state the delay, before anything else"
            if s.signal not in late:
                why = "with the gains of the file, which are only a start (gains: fitted); diagnose --until=noise_floor writes "
                why += "those that the recordings determine"
            if s.signal in late or (s.signal in fitted and not is_constant):
                lines[s.signal] = (
                    f"{s.signal}: the replay is off by {s.nrmse:.0%} of the measured motion, {why}"
                )
                continue
            constant = (
                f"Most of it is a constant: measured positions stand {mean:+.3g} {traces[0].unit} from the replay. Give the "
                "number that a column has at 0 as its `zero:` in a columns file. Else check"
                if is_constant
                else "A wrong number is more likely than a missing effect: check"
            )
            per = (
                "per rad, not per degree"
                if traces[0].unit == "rad"
                else "per m, not per mm"
            )
            lines[s.signal] = (
                f"{s.signal}: the replay is off by {s.nrmse:.0%} of the measured motion (RMS about its mean; {s.use}){of}. "
                f"{constant} unit or factor of its columns, kp and kd ({per}), inertia, loop_hz "
                "(too slow a loop is not stable), and of law pwm supply_v, resistance_ohm and torque_nm_per_a"
            )
    return list(lines.values())


def clock_is_off(late: dict[str, list["Finding"]], num_recordings: int) -> bool:
    """True if more than half of the recordings show that their time stamps are shifted; those that leave it open whether it is
    the clock or an effect do not count. A single one may instead lack physics or have other gains. ``late``: name of a
    recording → findings of ``of_replays``."""
    from taccorl.alignment.checks.clock import UNDECIDED

    shifted = {
        name
        for name, found in late.items()
        if any(f.severity == "error" for f in found)
    }
    undecided = {
        name for name, found in late.items() if any(f.check == UNDECIDED for f in found)
    } - shifted
    return 2 * len(shifted) > num_recordings - len(undecided)
