"""``taccorl diagnose --twin=twin.yaml --measurements=sweeps/``: find the physical effect that the twin lacks, with the evidence.

Every joint that moves in the recordings is diagnosed separately, then the pads of every arm for which measurements.yaml states
the pressed object. First the effects are listed that the recordings can show and separate. Then all known effects are fitted
together with the controller's gains, and chosen by their error on validation recordings, to which nothing is fitted. Test
recordings, if there are any, have no influence on a choice and give the final error. Effects with equal errors are reported as
ties, with the recording that would separate them; a residual that no known effect explains is reported as "something else".
"""

import dataclasses
import itertools
import shlex
import signal
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.add_effect import compare_words
from taccorl.cli.measured import (
    OTHER_GAINS,
    PartsConfig,
    far_off,
    refuse_long,
    replayed,
)
from taccorl.cli.parse import command, verb
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.cli.measured import Replayed
    from taccorl.diagnosis.machines.machine import Finding, Machine
    from taccorl.report.fact import Fact
    from taccorl.report.report import Report


@dataclass(kw_only=True)
class DiagnoseConfig(PartsConfig):
    """Find the physical effect that a twin lacks, with the evidence."""

    until: Literal["one", "noise_floor"] = "one"
    """``one``: find the most likely missing effect of each joint. ``noise_floor``: add effects until the error is at the noise
    floor, and write the corrected twin."""
    gains: Literal["auto", "commanded", "fitted"] = "auto"
    """``auto``: gains are fixed to the commanded ones if every recording states them, since fitted gains can hide a missing
    effect. Not of an axis, whose file says so; with efforts they are fitted within a factor of 1.25 but for `known: [kp, kd]`."""
    without: list[str] = field(default_factory=list)
    """Effects that the search does not add. Where a joint's twin has one already, it stays with its present numbers."""
    out: Path = Path("diagnosis")
    """Folder of report.html, report.json, which ``taccorl add-effect`` reads, and the corrected twin.yaml. An earlier report is
    replaced; other files are not overwritten."""


@verb(DiagnoseConfig, positional="measurements")
def run(config: DiagnoseConfig) -> int:
    """Diagnose, and print and write the result. Returns the exit status, 0: nothing is
    missing, or at least half of the squared error is gone in each part; 1: little of it is,
    or the measurements have errors, or efforts of other gains than the file's; 143: SIGTERM
    ended the search, and what it had found was written."""
    from taccorl.report.report import check_folder

    before = check_folder(config.out, config.measurements)
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.report.account import is_explained
    from taccorl.report.compared import not_compared
    from taccorl.report.diagnosed import account_section, next_section
    from taccorl.report.report import write_report
    from taccorl.report.terminal import show
    from taccorl.sim.effects import effects

    machine = load_machine(config.twin)
    for name in config.without:
        effects.get(name)
    measurements = config.read(machine)
    if machine.of_joints:
        refuse_long(measurements)
    compare = partial(machine.compare, measurements)
    selected = machine.select(machine.parts(measurements), config.joints, config.pads)
    beside = replayed(
        machine,
        measurements,
        "not diagnosed",
        config.accept,
        compare,
        clocks=False,
        only=config.asked(machine, measurements),
    )
    if beside is None:
        return 1
    off = {
        f.feature: f.text
        for own in beside.findings.values()
        for f in own
        if f.check == OTHER_GAINS
    }
    parts = [
        part for part in selected if part not in off or OTHER_GAINS in config.accept
    ]  # else an effect stands in
    way = f"--accept={OTHER_GAINS} diagnoses it with the stated ones"
    refused = [
        f"{part}: not diagnosed: {off[part]}. {way}"
        for part in selected
        if part not in parts
    ]
    show(
        Section(
            text=[
                *far_off(beside.comparison, machine.fitted_gains, beside.findings),
                *refused,
            ]
        ),
        not_compared(beside.comparison),
    )
    if not parts:
        return 1
    found, stopped_by = _diagnosed(config, machine, parts, measurements)
    left = [part for part in parts if part not in {f.part for f in found}]
    refused += [f"{part}: stopped before an effect was found" for part in left]
    if not found and stopped_by == signal.SIGTERM:
        show(Section(text=[*refused, "no report was written"]))
        return 128 + stopped_by
    if not found:
        raise KeyboardInterrupt
    mended, disagree = machine.mended(found)
    report = _report(config, machine, found, beside, measurements, mended)
    if stopped_by:
        words = "This diagnosis is not finished: it was stopped."
        report = dataclasses.replace(report, stopped=" ".join([words, *refused]))
    step = _next(config, report, machine)
    report = dataclasses.replace(report, next=step)
    accounts = report.accounts()
    show(*map(account_section, accounts.values()))
    if step and len(accounts) > 1:
        show(next_section(step))
    clocks = [
        f"{f.part}: {beside.unjudged[f.part]}"
        for f in found
        if f.part in beside.unjudged and _of_time(f)
    ]
    written = write_report(report, config.out, before)
    lines = [disagree] if disagree else []
    if config.until == "noise_floor":
        mended.save(path := config.out / mended.file_name)
        lines = [f"wrote {path}: {mended.saved_words}", *lines]
    show(Section(text=[*refused, *clocks]), written, Section(text=lines))
    if stopped_by == signal.SIGTERM:
        return 128 + stopped_by
    explained = all(
        is_explained(f.diagnosis) and accounts[f.part].kind != "data_first"
        for f in found
    )
    return int(not explained or bool(disagree or refused))


def _diagnosed(
    config: DiagnoseConfig,
    machine: "Machine",
    parts: Sequence[str],
    measurements: "Measurements",
) -> "tuple[list[Finding], int]":
    """Findings, and the signal that stopped the search, or 0. What was found before anything ended it is in ``config.out``."""
    from taccorl.cli.progress import Bars, Steps
    from taccorl.diagnosis.machines.machine import diagnose_parts
    from taccorl.diagnosis.search.result import SearchConfig
    from taccorl.report.interim import Interim

    search = (
        SearchConfig() if config.until == "noise_floor" else SearchConfig(max_effects=1)
    )
    with (
        Bars(len(parts), f"diagnosing {len(parts)} parts") as bars,
        tempfile.TemporaryDirectory() as kept,
    ):
        count, steps = itertools.count(1), Steps()
        steps.interim = Interim(
            folder=config.out,
            kept=Path(kept),
            title=_title(config, machine),
            provenance=_provenance(config, machine),
        )
        try:
            with steps.until_interrupted():
                found = diagnose_parts(
                    machine,
                    parts,
                    measurements,
                    gains=config.gains,
                    search=search,
                    without=config.without,
                    workers=config.workers,
                    done=lambda part: bars.update(part, next(count), len(parts)),
                    progress=steps,
                )
                return found, steps.stopped_by
        except BaseException:
            if some := steps.interim.parts:
                steps.interim.write()
                print(
                    f"\nnot finished; {config.out}/report.json has what was found at {', '.join(some)}",
                    file=sys.stderr,
                    flush=True,
                )
            raise


def _title(config: DiagnoseConfig, machine: "Machine") -> str:
    """The machine and the folder, with as much of their paths as tells them apart."""
    twin = Path(*config.twin.parts[-2:]) if config.twin else machine.name
    return f"{twin}: what it lacks, by {Path(*config.measurements.parts[-2:])}"


def _provenance(config: DiagnoseConfig, machine: "Machine") -> dict[str, str]:
    return {
        "command": shlex.join(command("diagnose", config, "measurements")),
        "twin": str(config.twin) if config.twin else "nominal twin",
        "twin, SHA-256": machine.digest(),
    }


def _report(
    config: DiagnoseConfig,
    machine: "Machine",
    found: "Sequence[Finding]",
    beside: "Replayed",
    measurements: "Measurements",
    mended: "Machine",
) -> "Report":
    """With the comparisons that show what refitted numbers removed, and what effects did."""
    from taccorl.report.evidence import added
    from taccorl.report.report import Report

    some = any(
        added(f.diagnosis) for f in found
    )  # else the twin as it was is the reference
    return Report(
        title=_title(config, machine),
        comparison=beside.comparison,
        refitted=machine.refitted(found).compare(measurements, name="refitted twin")
        if some
        else None,
        after=mended.compare(measurements, name="corrected twin"),
        found=found,
        options=[
            shlex.quote(word)
            for word in (f"--measurements={config.measurements}", *_given(config))
        ],
        findings=beside.findings,
        provenance=_provenance(config, machine),
    )


def _of_time(found: "Finding") -> bool:
    """Whether an offset of the clock may have a part in the result: an effect in time was added or ties, or none explains all."""
    from taccorl.sim.effects import effects

    names = {*(d := found.diagnosis).names, *itertools.chain(*d.rivals.values())}
    return d.status == "something_else" or any(
        p.unit == "s" for n in names for p in effects.get(n).parameters()
    )


def _given(config: DiagnoseConfig) -> list[str]:
    """Options that lead further commands to the twin and the report."""
    out = [f"--diagnosis={config.out}"] * (config.out != Path("diagnosis"))
    return [f"--twin={config.twin}"] * (config.twin is not None) + out


def _next(config: DiagnoseConfig, report: "Report", machine: "Machine") -> "list[Fact]":
    """The next command, with all parts together; nothing that this run has done."""
    from taccorl.diagnosis.search.problem import EFFORT_SCALE
    from taccorl.report.account import moved
    from taccorl.report.evidence import added
    from taccorl.report.fact import fact

    accounts, found = report.accounts(), report.found
    own = command("diagnose", config, "measurements")
    if any(a.kind == "data_first" for a in accounts.values()):
        return [fact("next_data")]
    if config.until == "noise_floor":
        path = config.out / machine.file_name
        parts = [f.part for f in found]
        return [fact("next", command=compare_words(own, parts, config.twin, path))]
    whole = dataclasses.replace(config, until="noise_floor")
    if any(f.diagnosis.status == "too_many" for f in found):
        words = command("diagnose", whole, "measurements")
        return [fact("next", command=shlex.join(words))]
    names: dict[str, list[str]] = {}
    largest_first = sorted(
        found, key=lambda f: -f.diagnosis.errors["fitted"]["validation"]
    )
    for f in largest_first:
        changed = [c for c in f.diagnosis.changed if c.name != EFFORT_SCALE]
        of_file = [*moved(f.diagnosis), *(c.effect or c.name for c in changed)]
        for name in added(f.diagnosis) or of_file:
            names.setdefault(name, machine.option_of(f.part))
    if not names:
        return []
    first = next(iter(names.values()))
    together = [name for name, options in names.items() if options == first]
    words = ["taccorl", "add-effect", ",".join(together), *first, *_given(config)]
    return [fact("next", command=shlex.join(words))]
