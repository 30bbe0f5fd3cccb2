"""``taccorl diagnose --twin=twin.yaml --measurements=sweeps/``: find the physical effect that the twin lacks, with the evidence.

Every joint that moves in the recordings is diagnosed separately, then the pads of every arm for which measurements.yaml states
the pressed object. First the effects are listed that the recordings can show and separate. Then all known effects are fitted
together with the controller's gains, and chosen by their error on validation recordings, to which nothing is fitted. Test
recordings, if there are any, have no influence on a choice and give the final error. Effects with equal errors are reported as
ties, with the recording that would separate them; a residual that no known effect explains is reported as "something else".

    --joints=[J3,left_joint5] --pads=[left]    only these
    --until=noise_floor    add effects until the error is at the noise floor, and write the corrected twin
    --out=DIR              report.html, report.json, which `taccorl add-effect` reads, and the corrected twin.yaml
"""

import dataclasses
import itertools
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.parse import command, parse
from taccorl.errors import TaccorlError

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.diagnosis.comparison.regimes import RegimeErrors
    from taccorl.diagnosis.comparison.result import Comparison
    from taccorl.diagnosis.machines.machine import Finding, Machine
    from taccorl.diagnosis.report.report import Report
    from taccorl.diagnosis.report.verdict import Verdict


COLORS = {"high": "green", "moderate": "yellow", "low": "red"}
"""Colour of a verdict by its confidence."""
MOST_NAMES = 6
"""Most names in a printed line; the report has the others."""


@dataclass(kw_only=True)
class DiagnoseConfig:
    """Find the physical effect that a twin lacks, with the evidence."""

    measurements: Path
    """A recording, table or dataset, or a folder of those."""
    twin: Path | None = None
    """File of the machine: a twin.yaml of the PiPER, or a file of kind axis, robot or cells. The nominal twin if not given."""
    joints: list[str] = field(default_factory=list)
    """Only these joints: left_joint5, or joint5 and J4 (the paper's name of it) for both arms. If neither joints nor pads are
    given, all joints that move and all pads with a stated object are diagnosed."""
    pads: list[str] = field(default_factory=list)
    """Only the pads of these arms: left, right."""
    until: Literal["one", "noise_floor"] = "one"
    """``one``: find the most likely missing effect of each joint. ``noise_floor``: add effects until the error is at the noise
    floor."""
    gains: Literal["auto", "commanded", "fitted"] = "auto"
    """``auto``: gains are fixed to the commanded ones if every recording states them, since fitted gains can hide a missing
    effect."""
    without: list[str] = field(default_factory=list)
    """Effects to leave out of the search."""
    out: Path = Path("diagnosis")
    """Folder of the report. An earlier report is replaced; other files are not overwritten."""
    workers: int = 2
    """Number of joints, or arms with pads, that are diagnosed at the same time."""
    spec: str | None = None
    """Recording spec; required where several shipped ones read the format."""
    columns: Path | None = None
    """Columns file: names and units of tables' columns that are not taccorl's own, and of other people's LeRobot datasets."""
    validation_every: int | None = None
    """Every k-th motion is for validation; as measurements.yaml states if not given."""
    accept: list[str] = field(default_factory=list)
    """Names of checks whose errors are known, such as frozen_channel: their errors become warnings, which stay in the report."""


def main(argv: list[str]) -> int:
    """Run ``taccorl diagnose`` with the words ``argv`` after it; returns the exit status of ``run``."""
    return run(parse(DiagnoseConfig, argv, positional="measurements"))


def run(config: DiagnoseConfig) -> int:
    """Diagnose, and print and write the result. Returns the exit status, 0: the remaining error is at the noise floor, 1:
    something else remains, or the measurements have errors."""
    if config.workers < 1:
        raise TaccorlError(f"--workers={config.workers}: at least 1")
    from taccorl.diagnosis.report.write import check_folder

    check_folder(config.out, config.measurements)
    from taccorl.alignment.checks.telemetry import check_names
    from taccorl.cli.measured import (
        checked,
        clock_is_off,
        far_off,
        of_replays,
        print_replays,
        refuse_long,
        unused_accepts,
        without_explained,
    )
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.diagnosis.problems.joints import of_joints
    from taccorl.sim.effects import effects

    check_names(config.accept)
    machine = load_machine(config.twin)
    for name in config.without:
        effects.get(name)
    measurements = machine.read(
        config.measurements, spec=config.spec, columns=config.columns, validation_every=config.validation_every
    )
    if config.joints and not config.pads:  # recordings of other joints, and what is wrong with them, hold nothing up
        measurements = of_joints(measurements, machine.select(machine.parts(measurements), config.joints, []))
    if machine.of_joints:
        refuse_long(measurements)
    findings = checked(machine, measurements, "not diagnosed", config.accept)
    if findings is None:
        return 1
    parts = machine.select(machine.parts(measurements), config.joints, config.pads)
    before = machine.compare(measurements)
    findings = without_explained(findings, before)
    late = of_replays(before, findings, config.accept)
    unused_accepts(config.accept, findings, late)
    print_replays(before, findings, late)
    if clock_is_off(late, len(measurements.all)):
        print(
            "not diagnosed: time stamps of most recordings are off, see above; an offset of one row looks like missing physics"
        )
        return 1
    for line in far_off(before, machine.fitted_gains):
        print(line)
    found = _diagnosed(config, machine, parts, measurements)
    mended, disagree = machine.mended(found)
    said = {name: [*findings.get(name, []), *late.get(name, [])] for name in (*findings, *late)}
    report = _report(config, machine, found, before, measurements, mended, said)
    verdicts, regimes = report.verdicts(), report.regimes()
    for finding in found:
        _print_finding(finding, verdicts[finding.part], regimes.get(finding.part))
    _write(config, report, found, machine, mended)
    if disagree:
        print(disagree)
    done = all(f.diagnosis.status in ("nothing_missing", "numbers_off", "at_floor") for f in found)
    return int(not done or bool(disagree))


def _diagnosed(
    config: DiagnoseConfig, machine: "Machine", parts: Sequence[str], measurements: "Measurements"
) -> "list[Finding]":
    from taccorl.cli.tables import Bars, Steps
    from taccorl.diagnosis.machines.machine import diagnose_parts
    from taccorl.diagnosis.search.result import SearchConfig

    search = SearchConfig() if config.until == "noise_floor" else SearchConfig(max_effects=1)
    with Bars(len(parts), f"diagnosing {len(parts)} parts") as bars:
        count = itertools.count(1)
        return diagnose_parts(
            machine,
            parts,
            measurements,
            gains=config.gains,
            search=search,
            without=config.without,
            workers=config.workers,
            done=lambda part: bars.update(part, next(count), len(parts)),
            progress=Steps(),
        )


def _print_finding(finding: "Finding", first: "Verdict", regimes: "RegimeErrors | None" = None) -> None:
    """Print the finding about one part of a machine: the verdict, the effects that can be separated, the evidence and the
    numbers."""
    from rich.table import Table
    from rich.text import Text

    from taccorl.cli.tables import console
    from taccorl.diagnosis.report.evidence_words import evidence_words, unit_words

    out, d = console(), finding.diagnosis
    out.print(Text(f"\n{finding.part}", "bold"))
    out.print(Text(f"  {first.finding}", COLORS[first.level]), soft_wrap=True)
    out.print(Text(f"  {first.confidence}"), soft_wrap=True)
    out.print(Text(f"  Record next: {first.record_next}"), soft_wrap=True)
    if first.command:
        out.print(Text(f"    {first.command}"), soft_wrap=True)
    for remark in first.remarks:
        out.print(Text(f"  Remark: {remark}"), soft_wrap=True)
    out.print(f"  noise floor {finding.noise}", highlight=False)
    judged = "the last rows of each" if finding.rows_split else ", ".join(finding.recordings["validation"])
    out.print(f"  {finding.numbers}; chosen by the error on {judged} (validation)", highlight=False, soft_wrap=True)
    if finding.remark:
        out.print(f"  {finding.remark}", highlight=False, soft_wrap=True)
    hardly = [_why_invisible(finding, name) for name in finding.can_tell.invisible if name not in d.names]
    if hardly:
        text = f"  these recordings would not show, at a typical strength: {_some(hardly)}"
        out.print(Text(text, "dim"), soft_wrap=True)
    pairs = [f"{a} and {b}" for a, b, _ in finding.can_tell.pairs]
    if pairs:
        out.print(Text(f"  look alike in these recordings: {_some(pairs)}", "dim"), soft_wrap=True)
    for number, found in enumerate(d.rounds, 1):
        table = Table(box=None, pad_edge=False)
        instead = f", in place of {found.in_place_of}" if found.in_place_of else ""
        for head in (
            "",
            f"round {number}: effect{instead}",
            "with",
            "validation error",
            "gain",
            "gain / s.e.",
            "evidence",
            "",
        ):
            left = head in ("", "with", "evidence") or "effect" in head
            table.add_column(head, justify="left" if left else "right", overflow="fold")
        for e in found.evidence[:6]:
            mark = "→" if e.name == found.added else "=" if e.name in found.ties else ""
            numbers = ", ".join(
                f"{k.split('.', 1)[1]} {v:.3g}{unit_words(e.units.get(k, '1'))}" for k, v in e.values.items()
            )
            trouble = "; ".join(
                w for w in (e.verdict, e.trouble, f"at bound: {', '.join(e.at_bound)}" * bool(e.at_bound)) if w
            )
            score = f"{e.score:.1f}"
            table.add_row(
                mark,
                e.name,
                numbers,
                f"{e.validation_error:.2f} ×",
                f"{round(e.gain, 2) + 0.0:.0%}",
                score,
                evidence_words(e),
                trouble,
            )
        out.print(table)
    if d.rounds:
        text = "  gain: share of the squared validation error above the floor that the effect removes; s.e.: its standard error"
        out.print(Text(text, "dim"), soft_wrap=True)
    for line in details(finding):
        out.print(line, highlight=False, soft_wrap=True)
    worst = regimes.worst if regimes is not None else None
    if worst is not None:
        place = f"{worst.recording} ({worst.use}), {worst.regime}"
        line = f"  worst after the fit: {place}: {worst.error:.2f} noise floors, n {worst.n}"
        out.print(line, highlight=False, soft_wrap=True)


def _some(words: Sequence[str]) -> str:
    """Few enough to be read."""
    more = len(words) - MOST_NAMES
    return ", ".join(words[:MOST_NAMES]) + (f" and {more} more: see the report" if more > 0 else "")


def _why_invisible(finding: "Finding", name: str) -> str:
    from taccorl.sim.effects import effects

    twins = [t for t in effects.get(name).near_twins if t in finding.diagnosis.start]
    return f"{name} (looks like {' and '.join(twins)}, always fitted)" if twins else name


def _ends(intervals: Mapping[str, Sequence[float]], name: str) -> str:
    """Text of a number's interval, such as `` (0.1 … 0.2)``; `` (not fitted)`` if it has none."""
    low, high = intervals.get(name, (math.nan, math.nan))
    return f" ({low:.4g} … {high:.4g})" if math.isfinite(low) and math.isfinite(high) else " (not fitted)"


def details(finding: "Finding") -> list[str]:
    """Lines of text that are printed below a verdict: errors, identified and absolute numbers, near-twins, tied effects."""
    from taccorl.diagnosis.comparison.cell_numbers import summarised
    from taccorl.diagnosis.report.evidence_words import last_refit_words, to_record, unit_words
    from taccorl.diagnosis.report.verdict import NEAR

    d = finding.diagnosis
    errors = d.errors["fitted"]["validation"], d.errors["after"]["validation"]
    added = [e.name for e in d.effects if e.name not in d.present]
    told = [f"{d.errors['before']['validation']:.2f} as it was", f"{errors[0]:.2f} with its numbers refitted"]
    told += [f"{errors[1]:.2f} with {', '.join(added)}"] * bool(added)
    lines = [f"  {d.words}", f"  validation error in noise floors ({finding.measured}): {', '.join(told)}"]
    if text := last_refit_words(d):
        lines.append(f"    {text}")
    for name in ("k_n", "k_d"):
        if name in d.base:
            lines.append(f"    {name} {d.base[name]:.4g}{_ends(d.intervals, name)}, the twin had {d.start[name]:.4g}")
    lines += [f"    {name}: {words}" for name, words in summarised(d.base)[1].items()]
    known = finding.known
    if known is not None:
        own = [n.words() for n in known.identifiable if "." not in n.name]
        pinned = f"; scale of torques fixed by {' and '.join(known.pinned_by)}" if known.pinned_by else ""
        lines.append(f"    identified: {', '.join(own) or 'no number but those of the effects'}{pinned}")
    for effect in d.effects:
        if effect.name in d.present:
            continue
        numbers = []
        for p in effect.parameters():
            value = f"{getattr(effect, p.name):.4g}{unit_words(p.unit)}"
            numbers.append(f"{p.name} {value}{_ends(effect.interval, p.name)}")
        own = [n for n in known.identifiable if n.name.startswith(f"{effect.name}.")] if known is not None else []
        primary = [n.words().removeprefix(f"{effect.name}.") for n in own]
        plain = [f"{p.name}" for p in effect.parameters()]
        if known is None or known.pinned_by or all(n.name.split(".", 1)[1] in plain for n in own):
            lines.append(f"  → {effect.name}: {', '.join(numbers)}")
        else:
            lines.append(f"  → {effect.name}: {', '.join(primary)}")
            lines.append(f"    in the twin, with kp {d.base['kp']:.4g}: {', '.join(numbers)}")
        if effect.in_words:
            lines.append(f"    {effect.in_words}")
        rivals = d.rivals.get(effect.name, ())
        if rivals:
            lines.append(
                f"    cannot be told from {', '.join(rivals)} by these recordings, so it may as well be that; what to record:"
            )
            lines += [f"      {line}" for line in to_record(finding.part, d, effect.name, rivals)]
        for twin, why in d.twins.get(effect.name, {}).items():
            lines.append(f"    near-twin {twin}: {why}")
    if d.status == "something_else" and d.rounds:
        best = [e for e in d.rounds[-1].evidence[:1] if e.gain >= NEAR]
        near = f"; nearest: {best[0].name}, {best[0].verdict}" if best else "; no effect comes near to it"
        lines.append(f"    see in the report where the residual is{near}")
    if d.trouble:
        lines.append(f"    {d.trouble}")
    if d.undetermined:
        lines.append(
            f"    not determined by these recordings, its value is one of many that fit: {', '.join(d.undetermined)}"
        )
    if d.at_bound:
        lines.append(
            f"    at the end of its range: {', '.join(d.at_bound)}; a symptom of missing physics or wrong units"
        )
    return lines


def _report(
    config: DiagnoseConfig,
    machine: "Machine",
    found: "Sequence[Finding]",
    before: "Comparison",
    measurements: "Measurements",
    mended: "Machine",
    findings: dict,
) -> "Report":
    """With the comparisons that show what refitted numbers removed, and what effects did."""
    from taccorl.diagnosis.report.report import Report

    refitted = machine.refitted(found)
    options = [f"--measurements={config.measurements}"]
    options += [f"--twin={config.twin}"] * (config.twin is not None)
    options += [f"--diagnosis={config.out}"] * (config.out != Path("diagnosis"))
    return Report(
        title=f"What {before.twin} lacks, from {config.measurements.name}",
        comparison=before,
        refitted=refitted.compare(measurements, name="refitted twin"),
        after=mended.compare(measurements, name="corrected twin"),
        diagnoses={f.part: f.diagnosis for f in found},
        can_tell={f.part: f.can_tell for f in found},
        known={f.part: f.known for f in found if f.known is not None},
        options=[shlex.quote(word) for word in options],
        findings=findings,
        provenance={
            "command": shlex.join(command("diagnose", config, "measurements")),
            "twin": str(config.twin) if config.twin else "nominal twin",
            "twin, SHA-256": machine.digest(),
        },
    )


def _write(
    config: DiagnoseConfig, report: "Report", found: "Sequence[Finding]", machine: "Machine", mended: "Machine"
) -> None:
    from taccorl.diagnosis.report.evidence_words import may_stand_in, unit_words, untested_words
    from taccorl.diagnosis.report.write import write_report

    written = write_report(report, config.out)
    again = f" (replaced the report of {written.replaced})" if written.replaced else ""
    print(f"\nwrote {written.page} and {written.numbers.name}{again}")
    held = [part for part, v in report.verdicts().items() if v.kind == "data_first"]
    names = list(dict.fromkeys(e.name for f in found for e in f.diagnosis.effects if e.name not in f.diagnosis.present))
    off = [(f.part, c) for f in found for c in f.diagnosis.changed]
    alone = {f.part for f in found if {*f.diagnosis.names} <= {*f.diagnosis.present}}
    of_file = [c.effect for part, c in off if c.effect and part in alone]
    if config.until == "noise_floor":
        path = config.out / mended.file_name
        mended.save(path)
        names = [name for name in names if name in mended.effects]
        numbers = [f"{c.name} of {part} {c.before:.4g} → {c.after:.4g}{unit_words(c.unit)}" for part, c in off]
        numbers += machine.changes_as_a_whole(found)
        print(f"wrote {path}: {', '.join([*names, *numbers]) or 'refitted numbers, no effect'}; {mended.saved_words}")
        for f in found:
            for doubt in filter(None, (may_stand_in(f.diagnosis), untested_words(f.diagnosis))):
                print(f"{f.part}: {doubt}")
    elif held:
        print(
            f"next: correct the recordings of {', '.join(held)} as said above, and diagnose again; add nothing before that"
        )
    elif any(f.diagnosis.status == "too_many" for f in found) or machine.changes_as_a_whole(found):
        further = dataclasses.replace(config, until="noise_floor")
        print(f"next: {shlex.join(command('diagnose', further, 'measurements'))}")
    elif names := list(dict.fromkeys([*names, *of_file])):
        alone = [n for n in names if not any(machine.option_of(f.part) for f in found if n in f.diagnosis.names)]
        words = ["taccorl", "add-effect", ",".join(alone) if names[0] in alone else names[0]]
        words += [w for f in found if names[0] in f.diagnosis.names for w in machine.option_of(f.part)]
        words += [f"--twin={config.twin}"] * (config.twin is not None)
        words += [f"--diagnosis={config.out}"] * (config.out != Path("diagnosis"))
        print(f"next: {shlex.join(words)}")
    elif off or any(machine.option_of(f.part) for f in found):
        print("next: the same with --until=noise_floor writes a twin with the refitted numbers")
