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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from taccorl.cli.add_effect import compare_words
from taccorl.cli.measured import (
    OTHER_GAINS,
    PartsConfig,
    Show,
    far_off,
    refuse_long,
    replayed,
)
from taccorl.cli.parse import command, verb
from taccorl.cli.printed import give
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.cli.measured import Replayed
    from taccorl.diagnosis.comparison.result import Comparison
    from taccorl.diagnosis.machines.machine import Finding, GainsAre, Machine
    from taccorl.report.fact import Fact
    from taccorl.report.report import Report


Until = Literal["one", "noise_floor"]


@dataclass(kw_only=True)
class DiagnoseConfig(PartsConfig):
    """Find the physical effect that a twin lacks, with the evidence."""

    until: Until = "one"
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
    config.check_paths()
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.report.report import as_json, check_folder
    from taccorl.report.terminal import show

    replaced = check_folder(config.out, config.measurements)
    machine = load_machine(config.twin)
    ready = to_diagnose(
        machine,
        config.read(machine),
        joints=config.joints,
        pads=config.pads,
        without=config.without,
        accept=config.accept,
        show=show,
    )
    if ready is None or not ready.parts:
        return 1
    measurements, parts, refused = ready.measurements, ready.parts, ready.refused
    words = command("diagnose", config, "measurements")
    report = ready.report(
        _title(config.twin, config.measurements, machine.name),
        command=shlex.join(words),
        twin=str(config.twin) if config.twin else "nominal twin",
        options=_options(config.twin, config.out, config.measurements),
    )
    search = partial(
        ready.search,
        until=config.until,
        gains=config.gains,
        without=config.without,
        workers=config.workers,
    )
    found, stopped_by = _searched(search, report, parts, config.out)
    left = [part for part in parts if part not in {f.part for f in found}]
    refused += [f"{part}: stopped before an effect was found" for part in left]
    if not found and stopped_by == signal.SIGTERM:
        show(Section(text=[*refused, "no report was written"]))
        return 128 + stopped_by
    if not found:
        raise KeyboardInterrupt
    mended, disagree = machine.mended(found)
    report = with_results(report, machine, found, measurements, mended)
    if stopped_by:
        stopped = "This diagnosis is not finished: it was stopped."
        report = dataclasses.replace(report, stopped=" ".join([stopped, *refused]))
    file = config.out / machine.file_name if config.until == "noise_floor" else None
    step = _next(report, machine, words, config.twin, file)
    report = dataclasses.replace(report, next=step)
    give(partial(as_json, report))
    lines = _saved(report, config.out, replaced, mended, file)
    lines += [disagree] if disagree else []
    show(
        Section(text=[*refused, *_open_clocks(ready.beside, found)]),
        Section(text=lines),
    )
    if stopped_by == signal.SIGTERM:
        return 128 + stopped_by
    return int(not _is_explained(report) or bool(disagree or refused))


class Ready(NamedTuple):
    """Measurements that passed the checks, and the parts that can be diagnosed."""

    machine: "Machine"
    measurements: "Measurements"
    beside: "Replayed"
    """The replays of the machine, and findings."""
    parts: list[str]
    refused: list[str]
    """Lines: a part, and why it is not diagnosed."""

    def report(
        self, title: str, twin: str, command: str = "", options: Sequence[str] = ()
    ) -> "Report":
        """Report without a diagnosis.

        Args:
            twin: the machine's file, or its name.
            command: words of the verb; empty if none was typed.
            options: options of suggested commands.
        """
        from taccorl.report.report import Report

        return Report(
            title=title,
            comparison=self.beside.comparison,
            options=options,
            findings=self.beside.findings,
            provenance={
                "command": command,
                "twin": twin,
                "twin, SHA-256": self.machine.digest(),
            },
        )

    def search(
        self,
        *,
        until: Until,
        gains: "GainsAre",
        without: Sequence[str],
        workers: int,
        **progress: Any,
    ) -> "list[Finding]":
        """Findings of the parts. ``progress``: ``done`` and ``progress`` of
        ``diagnose_parts``; the other arguments are options of the verb."""
        from taccorl.diagnosis.machines.machine import diagnose_parts
        from taccorl.diagnosis.search.result import SearchConfig

        return diagnose_parts(
            self.machine,
            self.parts,
            self.measurements,
            gains=gains,
            search=SearchConfig(max_effects=1) if until == "one" else SearchConfig(),
            without=without,
            workers=workers,
            **progress,
        )


def to_diagnose(
    machine: "Machine",
    measurements: "Measurements",
    *,
    joints: Sequence[str],
    pads: Sequence[str],
    without: Sequence[str],
    accept: Sequence[str],
    show: Show,
) -> Ready | None:
    """Check measurements, and choose the parts that can be diagnosed; None if there are
    errors, which were shown. Arguments are options of the verb.

    Raises:
        TaccorlError: a joint, a pad or an effect is unknown, or a recording is too long.
    """
    from taccorl.report.compared import not_compared
    from taccorl.sim.effects import effects

    for name in without:
        effects.get(name)
    if machine.of_joints:
        refuse_long(measurements)
    selected = machine.select(machine.parts(measurements), joints, pads)
    beside = replayed(
        machine,
        measurements,
        "not diagnosed",
        accept,
        partial(machine.compare, measurements),
        clocks=False,
        only=selected if joints and not pads else (),
        show=show,
    )
    if beside is None:
        return None
    off = {} if OTHER_GAINS in accept else _other_gains(beside)
    refused = [f"{part}: {off[part]}" for part in selected if part in off]
    far = far_off(beside.comparison, machine.fitted_gains, beside.findings)
    show(Section(text=[*far, *refused]), not_compared(beside.comparison))
    parts = [part for part in selected if part not in off]
    return Ready(machine, measurements, beside, parts, refused)


def _other_gains(beside: "Replayed") -> dict[str, str]:
    """Part whose efforts have other gains than the file's → why it is not diagnosed: an
    effect would stand in for them."""
    way = f"--accept={OTHER_GAINS} diagnoses it with the stated ones"
    every = itertools.chain(*beside.findings.values())
    own = {f.feature: f.text for f in every if f.check == OTHER_GAINS}
    return {part: f"not diagnosed: {text}. {way}" for part, text in own.items()}


def _searched(
    search: "Callable[..., list[Finding]]",
    report: "Report",
    parts: Sequence[str],
    folder: Path,
) -> "tuple[list[Finding], int]":
    """Findings, and the signal that stopped the search, or 0. What was found before anything
    ended it is in ``folder``."""
    from taccorl.cli.progress import Bars, Steps
    from taccorl.report.interim import Interim

    with (
        Bars(len(parts), f"diagnosing {len(parts)} parts") as bars,
        tempfile.TemporaryDirectory() as kept,
    ):
        count, steps = itertools.count(1), Steps()
        steps.interim = Interim(
            folder=folder,
            kept=Path(kept),
            title=report.title,
            provenance=report.provenance,
        )

        def done(part: str) -> None:
            bars.update(part, next(count), len(parts))

        try:
            with steps.until_interrupted():
                return search(done=done, progress=steps), steps.stopped_by
        except BaseException:
            if some := steps.interim.parts:
                steps.interim.write()
                print(
                    f"\nnot finished; {folder}/report.json has what was found at "
                    f"{', '.join(some)}",
                    file=sys.stderr,
                    flush=True,
                )
            raise


def _title(twin: Path | None, measurements: Path, name: str) -> str:
    """The machine and the folder, with as much of their paths as tells them apart."""
    shown = Path(*twin.parts[-2:]) if twin else name
    return f"{shown}: what it lacks, by {Path(*measurements.parts[-2:])}"


def _options(
    twin: Path | None, out: Path, measurements: Path | None = None
) -> list[str]:
    """Options that lead further commands to the recordings, the twin and the report."""
    given = {"measurements": measurements, "twin": twin}
    given["diagnosis"] = out if out != Path("diagnosis") else None
    words = [f"--{name}={path}" for name, path in given.items() if path is not None]
    return [shlex.quote(word) for word in words]


def with_results(
    report: "Report",
    machine: "Machine",
    found: "Sequence[Finding]",
    measurements: "Measurements",
    mended: "Machine",
) -> "Report":
    """With the comparisons that show what refitted numbers removed, and what effects did,
    and the errors of these files in the findings."""
    from taccorl.diagnosis.machines.machine import as_written
    from taccorl.report.evidence import added

    later: dict[str, Comparison | None] = {"fitted": None}
    if any(added(f.diagnosis) for f in found):  # else as it was is the reference
        refitted = machine.refitted(found)
        later["fitted"] = refitted.compare(measurements, name="refitted twin")
    later["after"] = mended.compare(measurements, name="corrected twin")
    return dataclasses.replace(
        report,
        refitted=later["fitted"],
        after=later["after"],
        found=as_written(found, report.comparison, later),
    )


def _saved(
    report: "Report", folder: Path, replaced: str, mended: "Machine", file: Path | None
) -> list[str]:
    """Print and write the report, and the corrected machine as ``file`` if that is given;
    the lines that say so."""
    from taccorl.report.diagnosed import account_section, next_section
    from taccorl.report.report import write_report
    from taccorl.report.terminal import show

    accounts = report.accounts()
    show(*map(account_section, accounts.values()))
    if report.next and len(accounts) > 1:
        show(next_section(report.next))
    lines = [*map(str, write_report(report, folder, replaced).text)]
    if file is not None:
        mended.save(file)
        lines.append(f"wrote {file}: {mended.saved_words}")
    return lines


def _is_explained(report: "Report") -> bool:
    """Whether nothing is missing, or most of the error is gone, in each part."""
    from taccorl.report.account import is_explained

    accounts = report.accounts()
    return all(
        is_explained(f.diagnosis) and accounts[f.part].kind != "data_first"
        for f in report.found
    )


def _open_clocks(beside: "Replayed", found: "Sequence[Finding]") -> list[str]:
    """What nothing judged of clocks that may have a part in the result."""
    own = [f.part for f in found if f.part in beside.unjudged and _of_time(f)]
    return [f"{part}: {beside.unjudged[part]}" for part in own]


def _of_time(found: "Finding") -> bool:
    """Whether an offset of the clock may have a part in the result: an effect in time was added or ties, or none explains all."""
    from taccorl.sim.effects import effects

    names = {*(d := found.diagnosis).names, *itertools.chain(*d.rivals.values())}
    return d.status == "something_else" or any(
        p.unit == "s" for n in names for p in effects.get(n).parameters()
    )


def _next(
    report: "Report",
    machine: "Machine",
    words: list[str],
    twin: Path | None,
    file: Path | None,
) -> "list[Fact]":
    """The next command, with all parts together; nothing that this run has done.
    ``words``: its own command. ``file``: where it writes the corrected machine, if it does."""
    from taccorl.diagnosis.search.problem import EFFORT_SCALE
    from taccorl.report.account import moved
    from taccorl.report.evidence import added
    from taccorl.report.fact import fact

    accounts = report.accounts()
    found = [f for f in report.found if accounts[f.part].kind != "drifting"]
    if any(a.kind == "data_first" for a in accounts.values()):
        return [fact("next_data")]
    if not found:
        return []
    if file is not None:
        parts = [f.part for f in found]
        return [fact("next", command=compare_words(words, parts, twin, file))]
    if any(f.diagnosis.status == "too_many" for f in found):
        return [fact("next", command=shlex.join([*words, "--until=noise_floor"]))]
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
    own = shlex.join(["taccorl", "add-effect", ",".join(together), *first])
    where = report.options[1:]  # without the recordings
    return [fact("next", command=" ".join([own, *where]))]
