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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.add_effect import compare_words
from taccorl.cli.measured import PartsConfig, far_off, refuse_long, replayed
from taccorl.cli.parse import command, verb
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.cli.measured import Replayed
    from taccorl.diagnosis.machines.machine import Finding, Machine
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
    """Diagnose, and print and write the result. Returns the exit status, 0: the remaining error is at the noise floor, 1:
    something else remains, or the measurements have errors, or efforts of other gains than the file's; 143: SIGTERM ended the
    search, and what it had found was written."""
    from taccorl.report.report import check_folder

    check_folder(config.out, config.measurements)
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.report.compared import not_compared
    from taccorl.report.diagnosed import brief
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
        joints=selected if config.joints else (),
    )
    if beside is None:
        return 1
    off = {
        f.feature: f.text
        for own in beside.findings.values()
        for f in own
        if f.check == "other_gains"
    }
    parts = [
        part for part in selected if part not in off or "other_gains" in config.accept
    ]  # else an effect stands in
    way = "--accept=other_gains diagnoses it with the stated ones"
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
    verdicts = report.verdicts()
    show(*(brief(f, verdicts[f.part], report.options) for f in found))
    clocks = [
        f"{f.part}: {beside.unjudged[f.part]}"
        for f in found
        if f.part in beside.unjudged and _of_time(f)
    ]
    held = [part for part, v in verdicts.items() if v.kind == "data_first"]
    written = write_report(
        report, config.out
    )  # makes the folder of the corrected twin, too
    text = [
        *_next(config, held, found, machine, mended),
        *([disagree] if disagree else []),
    ]
    show(Section(text=[*refused, *clocks]), written, Section(text=text))
    done = all(
        f.diagnosis.status in ("nothing_missing", "numbers_off", "at_floor")
        for f in found
    )
    if stopped_by == signal.SIGTERM:
        return 128 + stopped_by
    return int(not done or bool(disagree or refused))


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
            title=f"What {machine.name} lacks, from {config.measurements.name}",
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
    from taccorl.report.report import Report
    from taccorl.report.verdict import added

    some = any(
        added(f.diagnosis) for f in found
    )  # else the twin as it was is the reference
    return Report(
        title=f"What {beside.comparison.twin} lacks, from {config.measurements.name}",
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


def _next(
    config: DiagnoseConfig,
    held: Sequence[str],
    found: "Sequence[Finding]",
    machine: "Machine",
    mended: "Machine",
) -> Iterator[str]:
    """Write the corrected machine if it was asked for; what was written, or what to do next. ``held``: parts whose recordings
    are to be corrected first."""
    from taccorl.diagnosis.search.problem import EFFORT_SCALE
    from taccorl.report.evidence_words import may_stand_in, unit_words, untested_words
    from taccorl.report.verdict import added

    found = sorted(
        found, key=lambda f: -f.diagnosis.errors[f.diagnosis.baseline]["validation"]
    )  # the largest first
    names = list(dict.fromkeys(name for f in found for name in added(f.diagnosis)))
    off = [
        (f.part, c)
        for f in found
        for c in f.diagnosis.changed
        if c.name != EFFORT_SCALE
    ]  # which no file has
    refitted = [
        c
        for f in found
        if f.diagnosis.status == "numbers_off" or not names
        for c in f.diagnosis.changed
    ]
    of_file = [c.effect or c.name for c in refitted if c.name != EFFORT_SCALE]
    undecided = any(c.instead for c in refitted)
    whole = machine.changes_as_a_whole(found)
    further = shlex.join(
        command(
            "diagnose", dataclasses.replace(config, until="noise_floor"), "measurements"
        )
    )
    if config.until == "noise_floor":
        mended.save(path := config.out / mended.file_name)
        done = [name for name in names if name in mended.effects]
        done += [
            f"{c.name} of {part} {c.was} → {c.after:.4g}{unit_words(c.unit)}"
            for part, c in off
        ]
        yield f"wrote {path}: {', '.join([*done, *whole]) or 'refitted numbers, no effect'}; {mended.saved_words}"
        yield f"next: {compare_words(command('diagnose', config, 'measurements'), [f.part for f in found], config.twin, path)}"
        for f in found:
            yield from (
                f"{f.part}: {doubt}"
                for doubt in (may_stand_in(f.diagnosis), untested_words(f.diagnosis))
                if doubt
            )
    elif held:
        yield f"next: correct the recordings of {', '.join(held)} as said above, and diagnose again; add nothing before that"
    elif any(f.diagnosis.status == "too_many" for f in found) or whole:
        yield f"next: {further}"
    elif names := list(dict.fromkeys([*names, *of_file])):
        alone = [
            n
            for n in names
            if not any(
                machine.option_of(f.part) for f in found if n in f.diagnosis.names
            )
        ]
        words = [
            "taccorl",
            "add-effect",
            ",".join(alone) if names[0] in alone else names[0],
        ]
        words += [
            w
            for f in found
            if names[0] in f.diagnosis.names
            for w in machine.option_of(f.part)
        ]
        tied = [n for f in found for n in f.diagnosis.rivals.get(names[0], ())]
        tied += [
            f"payload in {body}"
            for f in found
            for body in f.diagnosis.or_in
            if names[0] == "payload"
        ]
        yield from ["next: record what decides, see Record next"] * undecided
        yield f"{'to write what was refitted' if undecided else 'next'}: {shlex.join([*words, *_given(config)])}"
        yield from [
            f"{' or '.join(tied)} does as well as {names[0]}: see Record next"
        ] * bool(tied)
    elif any(
        f.part in machine.fitted_gains or machine.option_of(f.part) for f in found
    ):
        yield f"a twin with the refitted numbers: {further}"
