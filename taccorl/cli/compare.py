"""``taccorl compare --twin=twin.yaml --measurements=sweeps/``: the difference between the twin and measurements.
``taccorl compare --twin=drive.yaml --measurements=bench/``: for another machine, whose file says ``kind: robot``.

MEASUREMENTS is a recording, a table (CSV, parquet), a dataset, or a folder of those; ``measurements.yaml`` in it may state which
are for validation, which repeat one another, and which object the pads pressed: then touch is compared, pad by pad. The commands
of every recording are simulated in the twin. Faults of the data are printed first; with errors nothing is compared.
"""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.measured import MeasuredConfig, far_off, replayed
from taccorl.cli.parse import command, verb
from taccorl.errors import TaccorlError, nearest
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.data.finding import Finding
    from taccorl.diagnosis.comparison.result import Comparison
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
class CompareConfig(MeasuredConfig):
    """Measure the difference between a twin and measurements."""

    against: Path | None = None
    """File of a second machine of the same kind, shown beside the first, such as the twin before a change."""
    pressed: PressedConfig = field(default_factory=PressedConfig)
    """Object that the fingers pressed, for recordings with pads whose object measurements.yaml does not state."""
    out: Path | None = None
    """Folder for report.html (one page, works anywhere) and report.json. An earlier report is replaced; other files are not
    overwritten."""
    rerun: Path | None = None
    """Rerun file (.rrd) to write: measured, replayed, residual and noise floor over time. An earlier one of taccorl is replaced;
    other files are not overwritten."""


@verb(CompareConfig, positional="measurements")
def run(config: CompareConfig) -> int:
    """Compare, and print and write the result. Returns the exit status, 0: compared, 1: the measurements have errors, nothing was
    compared."""
    _check_outputs(config)
    from taccorl.diagnosis.comparison.result import origin_words
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.diagnosis.problems.joints import of_joints
    from taccorl.report.compared import (
        cell_numbers,
        how_far,
        not_compared,
        pad_matches,
        where,
    )
    from taccorl.report.terminal import show

    twins = [
        load_machine(path)
        for path in (config.twin, config.against)[: 1 + (config.against is not None)]
    ]
    measurements = config.read(twins[0], fit_needed=False)
    signals = sorted({signal for m in measurements.all for signal in m.signals})
    for name in config.joints:  # before the replays, which take minutes
        if name not in signals:
            raise TaccorlError(
                f"--joints: {name!r} is in no recording; {nearest(name, signals)}"
            )
    kin = twins[0].of_joints == twins[-1].of_joints
    for name in (
        s
        for s in signals
        if not kin or (s in twins[0].units and s not in twins[-1].units)
    ):
        own = f"is of another machine: it has no {name!r}, which {config.twin or 'the nominal twin'} has and recordings move"
        raise TaccorlError(
            f"--against={config.against}: {own}; give a file of the same machine"
        )
    moved = of_joints(
        measurements, config.joints
    )  # what is wrong with recordings of others holds nothing up
    measurements = moved if moved.all else measurements
    comparisons: list[Comparison] = []

    def replay() -> "Comparison":
        comparisons.extend(_compared(config, twins, measurements))
        return comparisons[0]

    beside = replayed(
        twins[0],
        measurements,
        "not compared",
        config.accept,
        replay,
        joints=config.joints,
    )
    if beside is None:
        return 1
    first, last = comparisons[0], comparisons[-1]
    show(
        how_far(*comparisons),
        *pad_matches(*comparisons),
        where(first, ()),
        cell_numbers(last),
        not_compared(first),
    )
    off = far_off(last, twins[-1].fitted_gains, beside.findings)
    show(
        Section(text=[origin_words(first.origins), *off]),
        *_write(config, comparisons, beside.findings, twins),
    )
    return 0


def _check_outputs(config: CompareConfig) -> None:
    """Before any work is done: is there a place for what was asked for?"""
    if config.out is not None:
        from taccorl.report.report import check_folder

        check_folder(config.out, config.measurements)
    if config.rerun is not None:
        from taccorl.extras import require
        from taccorl.views.outputs import check_free

        require("lerobot")
        if config.rerun.suffix != ".rrd":
            raise TaccorlError(f"--rerun={config.rerun}: must end in .rrd")
        check_free(config.rerun)


def _compared(
    config: CompareConfig, twins: "Sequence[Machine]", measurements: "Measurements"
) -> list["Comparison"]:
    from taccorl.alignment.measurements.pressed import indenter
    from taccorl.cli.progress import Bars
    from taccorl.diagnosis.comparison.result import only

    pressed = (
        None if config.pressed.shape == "nothing" else indenter(**vars(config.pressed))
    )
    found = []
    for twin, label in zip(twins, _labels(config, twins), strict=True):
        with Bars(len(measurements.all)) as bars:
            found.append(
                twin.compare(
                    measurements,
                    name=label,
                    pressed=pressed,
                    progress=lambda recording, *at, name=label: bars.update(
                        f"{name}: {recording}", *at
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
    depth = next(
        (
            k
            for k in range(1, max(map(len, parts)) + 1)
            if parts[0][-k:] != parts[1][-k:]
        ),
        1,
    )
    return ["/".join(own[-depth:]) for own in parts]


def _write(
    config: CompareConfig,
    comparisons: "Sequence[Comparison]",
    findings: dict[str, list["Finding"]],
    twins: "Sequence[Machine]",
) -> Iterator[Section]:
    first, after = comparisons[0], comparisons[1] if len(comparisons) > 1 else None
    if config.out is not None:
        from taccorl.report.report import Report, write_report

        provenance = {"command": shlex.join(command("compare", config, "measurements"))}
        for twin, label in zip(twins, _labels(config, twins), strict=True):
            provenance[f"{label}, SHA-256"] = twin.digest()
        title = f"{first.twin} beside {config.measurements.name}" + (
            f", and {after.twin}" if after else ""
        )
        report = Report(
            title=title,
            comparison=first,
            after=after,
            findings=findings,
            provenance=provenance,
        )
        yield write_report(report, config.out)
    if config.rerun is not None:
        from taccorl.views.compare_view import save_comparison

        save_comparison(first, config.rerun, after)
        yield Section(
            text=[
                f"wrote {config.rerun}: look at it with rerun {shlex.quote(str(config.rerun))}"
            ]
        )
