"""``taccorl compare --twin=twin.yaml --measurements=sweeps/``: the difference between the twin and measurements.
``taccorl compare --twin=drive.yaml --measurements=bench/``: for another machine, whose file says ``kind: robot``.

MEASUREMENTS is a recording, a table (CSV, parquet), a dataset, or a folder of those; ``measurements.yaml`` in it may state which
are for validation, which repeat one another, and which object the pads pressed: then touch is compared, pad by pad. The commands
of every recording are simulated in the twin. Faults of the data are printed first; with errors nothing is compared.
"""

import dataclasses
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.measured import MeasuredConfig, Show, far_off, replayed
from taccorl.cli.parse import command, verb
from taccorl.cli.printed import give
from taccorl.errors import TaccorlError, nearest
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.alignment.measurements.pressed import PressedObject
    from taccorl.diagnosis.comparison.result import Comparison
    from taccorl.diagnosis.machines.machine import Machine
    from taccorl.report.report import Report


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

    def made(self) -> "PressedObject | None":
        """The object; None if there is nothing."""
        from taccorl.alignment.measurements.pressed import indenter

        return None if self.shape == "nothing" else indenter(**vars(self))


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
    config.check_paths()
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.report.report import as_json, check_folder, write_report
    from taccorl.report.terminal import show

    if config.out is not None:  # before any work is done
        check_folder(config.out, config.measurements)
    if config.rerun is not None:
        _check_rerun(config.rerun)
    paths = [config.twin, *([] if config.against is None else [config.against])]
    twins = [load_machine(path) for path in paths]
    measurements = config.read(twins[0], fit_needed=False)
    report = compared(
        twins,
        measurements,
        names=_labels(twins, paths),
        joints=config.joints,
        accept=config.accept,
        pressed=config.pressed.made(),
        second=f"--against={config.against}",
        title=config.measurements.name,
        show=show,
    )
    if report is None:
        return 1
    give(partial(as_json, report))
    if config.out is not None:
        words = shlex.join(command("compare", config, "measurements"))
        provenance = {"command": words, **report.provenance}
        report = dataclasses.replace(report, provenance=provenance)
        show(write_report(report, config.out))
    if config.rerun is not None:
        from taccorl.views.compare_view import save_comparison

        save_comparison(report.comparison, config.rerun, report.after)
        look = f"look at it with rerun {shlex.quote(str(config.rerun))}"
        show(Section(text=[f"wrote {config.rerun}: {look}"]))
    return 0


def compared(
    twins: "Sequence[Machine]",
    measurements: "Measurements",
    *,
    names: Sequence[str],
    joints: Sequence[str],
    accept: Sequence[str],
    pressed: "PressedObject | None",
    second: str,
    title: str,
    show: Show,
) -> "Report | None":
    """Compare one machine with measurements, or two beside each other.

    Args:
        names: name of each machine in tables and titles.
        joints: only these; all that move if there are none.
        accept: checks whose errors become warnings.
        pressed: object between the fingers in recordings that do not state one.
        second: the second machine, for messages.
        title: name of the measurements.
        show: function that gets the findings and the result.

    Returns: the content of the report; None if the measurements have errors, which were
        shown.

    Raises:
        TaccorlError: no recording has one of the joints, or the second machine lacks a
            signal that the first one has.
    """
    from taccorl.diagnosis.comparison.result import only, origin_words
    from taccorl.report import compared as sections
    from taccorl.report.report import Report

    measurements = _of_joints(measurements, joints)
    _check_same_machine(twins, names[0], second, measurements)
    comparisons: list[Comparison] = []

    def replay() -> "Comparison":
        for twin, name in zip(twins, names, strict=True):
            comparisons.append(_replayed(twin, name, measurements, pressed))
        if joints:
            comparisons[:] = [only(c, joints) for c in comparisons]
        return comparisons[0]

    beside = replayed(
        twins[0], measurements, "not compared", accept, replay, only=joints, show=show
    )
    if beside is None:
        return None
    first, *rest = comparisons
    off = far_off(comparisons[-1], twins[-1].fitted_gains, beside.findings)
    show(
        sections.how_far(*comparisons),
        *sections.pad_matches(*comparisons),
        sections.where(first, ()),
        sections.cell_numbers(comparisons[-1]),
        sections.not_compared(first),
        Section(text=[origin_words(first.origins), *off]),
    )
    return Report(
        title=", and ".join([f"{names[0]} beside {title}", *names[1:]]),
        comparison=first,
        after=rest[0] if rest else None,
        findings=beside.findings,
        provenance={
            f"{name}, SHA-256": t.digest() for name, t in zip(names, twins, strict=True)
        },
    )


def _check_rerun(path: Path) -> None:
    """Raises TaccorlError: no Rerun file can be written there."""
    from taccorl.extras import require
    from taccorl.views.outputs import check_free

    require("lerobot")
    if path.suffix != ".rrd":
        raise TaccorlError(f"--rerun={path}: must end in .rrd")
    check_free(path)


def _of_joints(measurements: "Measurements", joints: Sequence[str]) -> "Measurements":
    """Recordings that move ``joints``; all, if none does. What is wrong with those of others
    holds nothing up. Raises TaccorlError: a joint is in no recording."""
    from taccorl.diagnosis.problems.joints import of_joints

    signals = sorted({signal for m in measurements.all for signal in m.signals})
    for name in joints:  # before the replays, which take minutes
        if name not in signals:
            raise TaccorlError(
                f"--joints: {name!r} is in no recording; {nearest(name, signals)}"
            )
    moved = of_joints(measurements, joints)
    return moved if moved.all else measurements


def _check_same_machine(
    twins: "Sequence[Machine]", name: str, second: str, measurements: "Measurements"
) -> None:
    """Raises TaccorlError: the second machine lacks a signal that the first one has."""
    first, last = twins[0], twins[-1]
    kin = first.of_joints == last.of_joints
    for signal in sorted({signal for m in measurements.all for signal in m.signals}):
        if not kin or (signal in first.units and signal not in last.units):
            raise TaccorlError(
                f"{second}: is of another machine: it has no {signal!r}, which {name} has "
                "and recordings move; give a file of the same machine"
            )


def _replayed(
    twin: "Machine",
    label: str,
    measurements: "Measurements",
    pressed: "PressedObject | None",
) -> "Comparison":
    """The comparison with one machine, with a bar that shows how far it is."""
    from taccorl.cli.progress import Bars

    with Bars(len(measurements.all)) as bars:

        def update(recording: str, done: int, total: int) -> None:
            bars.update(f"{label}: {recording}", done, total)

        return twin.compare(measurements, name=label, pressed=pressed, progress=update)


def _labels(twins: "Sequence[Machine]", paths: Sequence[Path | None]) -> list[str]:
    """Name of each twin in tables and reports: that of its file, with as many folders as distinguish two files of one name."""
    names = [twin.name for twin in twins]
    if None in paths or len(set(names)) == len(names):
        return names
    parts = [path.with_suffix("").parts for path in paths if path is not None]
    most = max(map(len, parts))
    tails = ([own[-k:] for own in parts] for k in range(1, most + 1))
    different = (tail for tail in tails if tail[0] != tail[1])
    return ["/".join(tail) for tail in next(different, [own[-1:] for own in parts])]
