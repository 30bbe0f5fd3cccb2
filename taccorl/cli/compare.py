"""``taccorl compare --twin=twin.yaml --measurements=sweeps/``: the difference between the twin and measurements.
``taccorl compare --twin=drive.yaml --measurements=bench/``: for another machine, whose file says ``kind: axis``.

MEASUREMENTS is a recording, a table (CSV, parquet), a dataset, or a folder of those; ``measurements.yaml`` in it may state which
are for validation, which repeat one another, and which object the pads pressed: then touch is compared, pad by pad. The commands
of every recording are simulated in the twin. Faults of the data are printed first; with errors nothing is compared.

    --against=other.yaml   a second twin beside it, such as the one before a change
    --out=DIR              report.html (one page, works anywhere) and report.json
    --rerun=x.rrd          measured, replayed, residual and noise floor over time, for the Rerun program
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.parse import command, parse
from taccorl.errors import TaccorlError, nearest

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.alignment.measurements.pressed import PressedObject
    from taccorl.data.finding import Finding
    from taccorl.diagnosis.comparison.result import Comparison, Score
    from taccorl.diagnosis.machines.machine import Machine


@dataclass(kw_only=True)
class PressedConfig:
    """Object between the fingers during the recordings: a ball or a rod."""

    shape: Literal["nothing", "sphere", "rod"] = "nothing"
    """Shape of the object. nothing: touch is not compared."""
    radius_m: float = 0.012
    """Radius of the object [m]."""
    length_m: float = 0.03
    """Length of a rod [m]."""
    arm: str = "left"
    """Arm whose fingers press it: left or right."""
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the object [m]: in the TCP's frame (origin in the middle between the pads, z = approach, fingers close along y),
    or in the world's, as ``frame`` says."""
    rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Orientation of the object [rad]: fixed-axis roll, pitch, yaw; [0, 1.5708, 0] lays a rod across the pads."""
    frame: Literal["tcp", "world"] = "tcp"
    """tcp: the object is fixed relative to the hand. world: it is fixed to the bench."""


@dataclass(kw_only=True)
class CompareConfig:
    """Measure the difference between a twin and measurements."""

    measurements: Path
    """A recording, table or dataset, or a folder of those."""
    twin: Path | None = None
    """File of the machine: a twin.yaml of the PiPER, or a file of kind axis, robot or cells. The nominal twin if not given."""
    against: Path | None = None
    """File of a second machine of the same kind, shown beside the first."""
    joints: list[str] = field(default_factory=list)
    """Only these joints, such as left_joint5; all that were commanded to move if not given."""
    spec: str | None = None
    """Recording spec; required where several shipped ones read the format."""
    columns: Path | None = None
    """Columns file: names and units of tables' columns that are not taccorl's own, and of other people's LeRobot datasets."""
    validation_every: int | None = None
    """Every k-th motion is for validation; as measurements.yaml states if not given."""
    accept: list[str] = field(default_factory=list)
    """Names of checks whose errors are known, such as frozen_channel: their errors become warnings, which stay in the report."""
    pressed: PressedConfig = field(default_factory=PressedConfig)
    """Object that the fingers pressed, for recordings with pads whose object measurements.yaml does not state."""
    out: Path | None = None
    """Folder for report.html and report.json. An earlier report is replaced; other files are not overwritten."""
    rerun: Path | None = None
    """Rerun file (.rrd) to write. An earlier one of taccorl is replaced; other files are not overwritten."""


def main(argv: list[str]) -> int:
    """Run ``taccorl compare`` with the words ``argv`` after it; returns the exit status of ``run``."""
    return run(parse(CompareConfig, argv, positional="measurements"))


def run(config: CompareConfig) -> int:
    """Compare, and print and write the result. Returns the exit status, 0: compared, 1: the measurements have errors, nothing was
    compared."""
    _check_outputs(config)
    from taccorl.alignment.checks.telemetry import check_names
    from taccorl.cli.measured import (
        checked,
        clock_is_off,
        far_off,
        of_replays,
        print_replays,
        unused_accepts,
        without_explained,
    )
    from taccorl.diagnosis.machines.load import load_machine

    check_names(config.accept)

    twins = [load_machine(path) for path in (config.twin, config.against)[: 1 + (config.against is not None)]]
    measurements = twins[0].read(
        config.measurements,
        spec=config.spec,
        columns=config.columns,
        validation_every=config.validation_every,
        fit_needed=False,
    )
    signals = sorted({signal for m in measurements.all for signal in m.signals})
    for name in config.joints:  # before the replays, which take minutes
        if name not in signals:
            raise TaccorlError(f"--joints: {name!r} is in no recording; {nearest(name, signals)}")
    findings = checked(twins[0], measurements, "not compared", config.accept)
    if findings is None:
        return 1
    comparisons = _compared(config, twins, measurements)
    findings = without_explained(findings, comparisons[0])
    late = of_replays(comparisons[0], findings, config.accept)
    unused_accepts(config.accept, findings, late)
    print_replays(comparisons[0], findings, late)
    if clock_is_off(late, len(measurements.all)):
        print(
            "not compared: time stamps of most recordings are off, see above; an offset of one row looks like missing physics"
        )
        return 1
    _score_table(comparisons[0], comparisons[1] if len(comparisons) > 1 else None)
    for line in far_off(comparisons[-1], twins[-1].fitted_gains):
        print(line)
    _write(config, comparisons, findings, late, twins)
    return 0


def _check_outputs(config: CompareConfig) -> None:
    """Before any work is done: is there a place for what was asked for?"""
    if config.out is not None:
        from taccorl.diagnosis.report.write import check_folder

        check_folder(config.out, config.measurements)
    if config.rerun is not None:
        from taccorl.views.outputs import check_free

        if config.rerun.suffix != ".rrd":
            raise TaccorlError(f"--rerun={config.rerun}: must end in .rrd")
        check_free(config.rerun)


def _compared(config: CompareConfig, twins: "Sequence[Machine]", measurements: "Measurements") -> list["Comparison"]:
    from taccorl.cli.tables import Bars
    from taccorl.diagnosis.comparison.result import only

    pressed = _pressed(config.pressed)
    found = []
    for twin, label in zip(twins, _labels(config, twins), strict=True):
        with Bars(len(measurements.all)) as bars:
            found.append(
                twin.compare(
                    measurements,
                    name=label,
                    pressed=pressed,
                    progress=lambda recording, done, total, name=label: bars.update(
                        f"{name}: {recording}", done, total
                    ),
                )
            )
    return [only(c, config.joints) for c in found] if config.joints else found


def _labels(config: CompareConfig, twins: "Sequence[Machine]") -> list[str]:
    """Name of each twin in tables and reports: that of its file, with as many folders as distinguish two files of one name."""
    names = [twin.name for twin in twins]
    if config.twin is None or config.against is None or len(set(names)) == len(names):
        return names
    parts = [path.with_suffix("").parts for path in (config.twin, config.against)]
    depth = next((k for k in range(1, max(map(len, parts)) + 1) if parts[0][-k:] != parts[1][-k:]), 1)
    return ["/".join(own[-depth:]) for own in parts]


def _pressed(config: PressedConfig) -> "PressedObject | None":
    from taccorl.alignment.measurements.pressed import indenter

    if config.shape == "nothing":
        return None
    return indenter(
        config.shape,
        config.radius_m,
        config.arm,
        length_m=config.length_m,
        position_m=config.position_m,
        rpy_rad=config.rpy_rad,
        frame=config.frame,
    )


def _score_table(comparison: "Comparison", after: "Comparison | None" = None) -> None:
    """Print a table of errors with one line per signal and use (fit, validation, test).

    Args:
        after: comparison of a second twin, whose errors are shown beside the first; None: none.
    """
    from rich.table import Table
    from rich.text import Text

    from taccorl.cli.tables import console
    from taccorl.diagnosis.comparison.cell_numbers import cell_lines
    from taccorl.diagnosis.comparison.localise import heat_map, worst_regime
    from taccorl.diagnosis.comparison.localise_touch import touch_heat_map
    from taccorl.diagnosis.comparison.result import origin_words, shown

    cells = [*heat_map(comparison, "position"), *heat_map(comparison, "effort"), *touch_heat_map(comparison.touches)]
    scores = [*comparison.scores(), *comparison.pad_scores()]
    others = [*after.scores(), *after.pad_scores()] if after is not None else []
    later = {(s.signal, s.kind, s.use): s for s in others}
    table = Table(box=None, pad_edge=False)
    heads = [f"RMSE {comparison.twin}", "× floor"]
    heads += [f"RMSE {after.twin}", "× floor", "change"] if after is not None else []
    for head in ("signal", "use", *heads, "NRMSE", "floor", "worst regime (where, not why)"):
        table.add_column(
            head, justify="left" if head in ("signal", "use") or "regime" in head else "right", overflow="fold"
        )
    for s in scores:
        row = [Text(f"{s.signal} {s.kind}" if s.signal != "touch" else s.signal), s.use.replace("_", "-")]
        row += _error_cells(s)
        other = later.get((s.signal, s.kind, s.use))
        if after is not None:
            row += [*_error_cells(other), f"{other.rmse / s.rmse - 1:+.0%}"] if other is not None else [""] * 3
        worst = worst_regime(cells, s.signal, s.kind)
        floor = shown(s.floor, s.unit) + (" or more" if s.lower_bound else "")
        table.add_row(*row, f"{s.nrmse:.2%}", floor, f"{worst.regime} ({worst.ratio:.3g} × floor)" if worst else "")
    out = console()
    out.print(table)
    if any(s.lower_bound and s.kind == "touch" for s in scores):
        out.print(Text("or more, of touch: the noise of each taxel; what presses do not repeat is not in it", "dim"))
    if any(s.lower_bound and s.kind != "touch" for s in scores):
        out.print(
            Text(
                "or more: no recording is declared to repeat another (repeat_of), so this floor is a lower bound", "dim"
            )
        )
    for line in cell_lines(comparison.touches if after is None else after.touches):
        out.print(Text(line), soft_wrap=True, highlight=False)
    for line in comparison.left_out:
        out.print(Text(f"not compared: {line}", "dim"), soft_wrap=True)
    out.print(Text(origin_words(comparison.origins)), soft_wrap=True)


def _error_cells(s: "Score") -> list:
    from rich.text import Text

    from taccorl.diagnosis.comparison.result import shown
    from taccorl.diagnosis.search.result import SearchConfig

    return [shown(s.rmse, s.unit), Text(f"{s.ratio:.3g}", "green" if s.ratio <= SearchConfig().stop_at else "yellow")]


def _write(
    config: CompareConfig,
    comparisons: "Sequence[Comparison]",
    findings: dict[str, list["Finding"]],
    late: dict[str, list["Finding"]],
    twins: "Sequence[Machine]",
) -> None:
    first, after = comparisons[0], comparisons[1] if len(comparisons) > 1 else None
    if config.out is not None:
        from taccorl.diagnosis.report.report import Report
        from taccorl.diagnosis.report.write import write_report

        provenance = {"command": shlex.join(command("compare", config, "measurements"))}
        for twin, label in zip(twins, _labels(config, twins), strict=True):
            provenance[f"{label}, SHA-256"] = twin.digest()
        clock = {name: [*findings.get(name, []), *late.get(name, [])] for name in (*findings, *late)}
        title = f"{first.twin} beside {config.measurements.name}" + (f", and {after.twin}" if after else "")
        report = Report(title=title, comparison=first, after=after, findings=clock, provenance=provenance)
        written = write_report(report, config.out)
        again = f" (replaced the report of {written.replaced})" if written.replaced else ""
        print(f"wrote {written.page} and {written.numbers.name}{again}")
    if config.rerun is not None:
        from taccorl.views.compare_view import save_comparison

        save_comparison(first, config.rerun, after)
        print(f"wrote {config.rerun}: look at it with rerun {shlex.quote(str(config.rerun))}")
