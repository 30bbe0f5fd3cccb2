"""``taccorl diagnose --twin=twin.yaml --measurements=sweeps/``: which physical effect the twin lacks, and with what evidence.

Every joint that the recordings sweep is looked at by itself. First what the recordings can show and tell apart at all; then all
known effects are tried, refitted together with the controller's numbers and judged on recordings that nothing was fitted to.
Effects that do as well as each other are shown as ties, with the recording that would tell them apart; structure that no known
effect explains is called "something else".

    --until=noise_floor    add effects until nothing is left above the noise floor, and write the mended twin
    --out=DIR              report.html, report.json, which `taccorl add-effect` reads, and the mended twin.yaml
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError, nearest

if TYPE_CHECKING:
    from taccorl.alignment.measurements import Measurements
    from taccorl.diagnosis.comparison import Comparison
    from taccorl.diagnosis.joints import JointFinding
    from taccorl.sim.twin import TwinConfig


FAR_GAIN = 3.0
"""Fitted gains that are so many times the twin's are doubted."""


@dataclass(kw_only=True)
class DiagnoseConfig:
    """Which physical effect the twin lacks, and with what evidence."""

    measurements: Path
    """A recording, table or dataset, or a folder of those."""
    twin: Path | None = None
    """twin.yaml; the nominal twin if not given."""
    joints: list[str] = field(default_factory=list)
    """Only these: left_joint5, or joint5 and J4 (the paper's name of it) for both arms; all that are swept if not given."""
    until: Literal["one", "noise_floor"] = "one"
    """``one``: the most likely missing effect of each joint. ``noise_floor``: effects are added until nothing is left."""
    gains: Literal["auto", "commanded", "fitted"] = "auto"
    """``auto``: commanded gains stay fixed where every recording states them; free ones hide missing physics."""
    without: list[str] = field(default_factory=list)
    """Effects that are not considered."""
    out: Path = Path("diagnosis")
    """Folder of the report. An earlier report is replaced, any other file left alone."""
    workers: int = 2
    """Joints that are diagnosed at the same time."""
    spec: str | None = None
    """Recording spec; needed where several shipped ones read the format."""
    columns: Path | None = None
    """Columns file of tables with other names or units than ours."""
    held_out_every: int | None = None
    """Every k-th motion is held out; else as measurements.yaml says."""


def main(argv: list[str]) -> int:
    """0: diagnosed, and what remains is at the noise floor; 1: something else remains, or the measurements have errors."""
    config = parse(DiagnoseConfig, argv, positional="measurements")
    from taccorl.diagnosis.report import check_folder

    check_folder(config.out)
    from taccorl.alignment.measurements import read_measurements
    from taccorl.cli.measured import checked, clock_is_off, name_of, print_findings, twin_of
    from taccorl.diagnosis.compare import compare
    from taccorl.diagnosis.joints import mended, swept_joints
    from taccorl.sim.effects import effects

    twin = twin_of(config.twin)
    for name in config.without:
        effects.get(name)
    measurements = read_measurements(
        config.measurements, spec=config.spec, columns=config.columns, held_out_every=config.held_out_every
    )
    findings = checked(measurements, "not diagnosed")
    if findings is None:
        return 1
    before = compare(twin, measurements, name=name_of(config.twin))
    late = {name: list(found) for name, found in before.clock.items() if found}
    print_findings({f"replay of {name}": found for name, found in late.items()})
    if clock_is_off(late, len(measurements.all)):
        print(
            "not diagnosed: time stamps of most recordings are off, see above; an offset of one row looks like missing physics"
        )
        return 1
    signals = joints_named(config.joints, swept_joints(measurements))
    found = _diagnosed(config, twin, signals, measurements)
    for finding in found:
        print_finding(finding)
    after = compare(mended(twin, found), measurements, name="mended twin")
    said = {name: [*findings.get(name, []), *late.get(name, [])] for name in (*findings, *late)}
    _write(config, argv, twin, found, before, after, said)
    return int(any(f.diagnosis.status not in ("nothing_missing", "at_floor") for f in found))


def joints_named(names: Sequence[str], swept: Sequence[str]) -> tuple[str, ...]:
    """Joints that are meant: ``left_joint5``; ``joint5`` and the paper's ``J4`` are that joint of every arm that is swept.

    Raises:
        TaccorlError: nothing is swept, an unknown name, or a joint that no recording sweeps.
    """
    if not swept:
        raise TaccorlError(
            "no fit recording sweeps a joint (2 mrad at least); record sweeps: taccorl excite plans them"
        )
    if not names:
        return tuple(swept)
    chosen: list[str] = []
    for name in names:
        joint = f"joint{int(name[1:]) + 1}" if name[:1] in "Jj" and name[1:].isdigit() else name
        joint = f"joint{joint}" if joint.isdigit() else joint
        meant = [s for s in swept if joint in (s, s.split("_", 1)[1])]
        if not meant:
            raise TaccorlError(f"{name}: no such joint is swept in these recordings; {nearest(joint, swept)}")
        chosen += [s for s in meant if s not in chosen]
    return tuple(chosen)


def _diagnosed(
    config: DiagnoseConfig, twin: "TwinConfig", signals: Sequence[str], measurements: "Measurements"
) -> "list[JointFinding]":
    from taccorl.cli.tables import Bars
    from taccorl.diagnosis.joints import diagnose_joints
    from taccorl.diagnosis.search import SearchConfig

    search = SearchConfig() if config.until == "noise_floor" else SearchConfig(max_effects=1)

    with Bars(len(signals)) as bars:
        count = 0

        def done(signal: str) -> None:
            nonlocal count
            count += 1
            bars.update(signal, count, len(signals))

        return diagnose_joints(
            twin,
            signals,
            measurements,
            gains=config.gains,
            search=search,
            without=config.without,
            workers=config.workers,
            done=done,
        )


def print_finding(finding: "JointFinding") -> None:
    """What was found at one joint: what can be told, the evidence, the verdict."""
    from rich.table import Table
    from rich.text import Text

    from taccorl.cli.tables import console

    out, d = console(), finding.diagnosis
    out.print(Text(f"\n{finding.signal}", "bold"))
    out.print(f"  noise floor {'; effort '.join(f.words() for f in finding.floors)}", highlight=False)
    gains = "commanded gains" if finding.commanded else "gains fitted (not stated by the recordings)"
    judged = "the last rows of each" if finding.rows_split else ", ".join(finding.recordings["held_out"])
    out.print(f"  {gains}; judged on {judged}", highlight=False, soft_wrap=True)
    hardly = [name for name in finding.can_tell.invisible if name not in d.names]
    if hardly:
        words = ", ".join(_why_invisible(finding, name) for name in hardly)
        out.print(Text(f"  of a typical strength these recordings would not show: {words}", "dim"), soft_wrap=True)
    pairs = [f"{a} from {b}" for a, b, _ in finding.can_tell.pairs[:6]]
    if pairs:
        out.print(Text(f"  nor tell at once: {', '.join(pairs)}", "dim"), soft_wrap=True)
    for number, found in enumerate(d.rounds, 1):
        table = Table(box=None, pad_edge=False)
        for head in ("", f"round {number}: effect", "with", "held-out error", "gain", "÷ s.e.", "ΔBIC", ""):
            left = head in ("", "with") or "effect" in head
            table.add_column(head, justify="left" if left else "right", overflow="fold")
        for e in found.evidence[:6]:
            mark = "→" if e.name == found.added else "=" if e.name in found.ties else ""
            numbers = ", ".join(f"{k.split('.', 1)[1]} {v:.3g}" for k, v in e.values.items())
            trouble = "; ".join(
                w for w in (e.verdict, e.trouble, f"at bound: {', '.join(e.at_bound)}" * bool(e.at_bound)) if w
            )
            score = f"{e.score:.1f}"
            table.add_row(
                mark, e.name, numbers, f"{e.held_out_error:.2f} ×", f"{e.gain:.0%}", score, f"{e.bic:.0f}", trouble
            )
        out.print(table)
    for line in verdict(finding):
        out.print(line, highlight=False, soft_wrap=True)


def _why_invisible(finding: "JointFinding", name: str) -> str:
    from taccorl.sim.effects import effects

    twins = [t for t in effects.get(name).near_twins if t in finding.diagnosis.start]
    return f"{name} (taken up by {' and '.join(twins)})" if twins else name


def verdict(finding: "JointFinding") -> list[str]:
    """In words: what is missing, what does as well, what remains, what to record."""
    d = finding.diagnosis
    errors = d.errors["fitted"]["held_out"], d.errors["after"]["held_out"]
    added = [e.name for e in d.effects if e.name not in d.present]
    told = [f"{d.errors['before']['held_out']:.2f} as it was", f"{errors[0]:.2f} with its numbers refitted"]
    told += [f"{errors[1]:.2f} with {', '.join(added)}"] * bool(added)
    what = "angles and efforts together" if len(finding.floors) > 1 else "angles"
    lines = [f"  {d.words}", f"  held-out error in noise floors ({what}): {', '.join(told)}"]
    for name in ("kp", "kd"):
        ratio = d.base.get(name, 1.0) / d.start.get(name, 1.0) if name in d.base else 1.0
        if not 1 / FAR_GAIN < ratio < FAR_GAIN:
            lines.append(f"    {name} became {ratio:.3g} times the twin's: state the commanded gains, or doubt this")
    for effect in d.effects:
        if effect.name in d.present:
            continue
        numbers = []
        for p in effect.parameters():
            low, high = effect.interval.get(p.name, (float("nan"), float("nan")))
            numbers.append(f"{p.name} {getattr(effect, p.name):.4g} {p.unit} ({low:.4g} … {high:.4g})")
        lines.append(f"  → {effect.name}: {', '.join(numbers)}")
        if effect.in_words:
            lines.append(f"    {effect.in_words}")
        rivals = d.rivals.get(effect.name, ())
        if rivals:
            lines.append(
                f"    cannot be told from {', '.join(rivals)} by these recordings, so it may as well be that; what to record:"
            )
            lines.append(f"      taccorl excite {finding.signal} --effects={','.join((effect.name, *rivals))} …")
        for twin, why in d.twins.get(effect.name, {}).items():
            lines.append(f"    near-twin {twin}: {why}")
    if d.status == "something_else" and d.rounds:
        best = d.rounds[-1].evidence[:1]
        near = f"; nearest: {best[0].name}, {best[0].verdict}" if best else ""
        lines.append(f"    see in the report where the residual is{near}")
    if d.trouble:
        lines.append(f"    {d.trouble}")
    if d.at_bound:
        lines.append(
            f"    at the end of its range: {', '.join(d.at_bound)}; a symptom of missing physics or wrong units"
        )
    return lines


def _write(
    config: DiagnoseConfig,
    argv: Sequence[str],
    twin: "TwinConfig",
    found: "Sequence[JointFinding]",
    before: "Comparison",
    after: "Comparison",
    findings: dict,
) -> None:
    from taccorl.diagnosis.joints import mended
    from taccorl.diagnosis.report import Report, write_report
    from taccorl.sim.twin_file import save_twin, twin_digest

    report = Report(
        title=f"What {before.twin} lacks, from {config.measurements.name}",
        comparison=before,
        after=after,
        diagnoses={f.signal: f.diagnosis for f in found},
        can_tell={f.signal: f.can_tell for f in found},
        findings=findings,
        provenance={
            "command": shlex.join(["taccorl", "diagnose", *argv]),
            "twin": str(config.twin) if config.twin else "nominal twin",
            "twin, SHA-256": twin_digest(twin),
        },
    )
    written = write_report(report, config.out)
    again = f" (replaced the report of {written.replaced})" if written.replaced else ""
    print(f"\nwrote {written.page} and {written.numbers.name}{again}")
    names = list(dict.fromkeys(e.name for f in found for e in f.diagnosis.effects if e.name not in f.diagnosis.present))
    if config.until == "noise_floor":
        path = config.out / "twin.yaml"
        save_twin(mended(twin, found), path)
        print(
            f"wrote {path}: {', '.join(names) or 'the refitted gains, no effect'}; it is what collect and training load"
        )
    elif names:
        words = ["taccorl", "add-effect", names[0]]
        words += [f"--twin={config.twin}"] * (config.twin is not None)
        words += [f"--diagnosis={config.out}"] * (config.out != Path("diagnosis"))
        print(f"next: {shlex.join(words)}")
