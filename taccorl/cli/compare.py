"""``taccorl compare --twin=twin.yaml --measurements=sweeps/``: the difference between the twin and measurements.
``taccorl compare --twin=drive.yaml --measurements=bench/``: for another machine, whose file says ``kind: robot``.

MEASUREMENTS is a recording, a table (CSV, parquet), a dataset, or a folder of those; ``measurements.yaml`` in it may state which
are for validation, which repeat one another, and which object the pads pressed: then touch is compared, pad by pad. The commands
of every recording are simulated in the twin. Faults of the data are printed first; with errors nothing is compared.
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.measured import MeasuredConfig, far_off, replayed
from taccorl.cli.parse import command, verb
from taccorl.errors import TaccorlError, nearest
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.alignment.measurements.pressed import PressedObject
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
    from taccorl.diagnosis.comparison.result import only, origin_words
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.report import compared
    from taccorl.report.report import Report, check_folder, write_report
    from taccorl.report.terminal import show

    if config.out is not None:  # before any work is done
        check_folder(config.out, config.measurements)
    if config.rerun is not None:
        _check_rerun(config.rerun)
    paths = [config.twin, *([] if config.against is None else [config.against])]
    twins = [load_machine(path) for path in paths]
    measurements = config.read(twins[0], fit_needed=False)
    measurements = _of_joints(measurements, config.joints)
    _check_same_machine(twins, paths, measurements)
    words, labels = command("compare", config, "measurements"), _labels(twins, paths)
    solid = config.pressed.made()
    comparisons: list[Comparison] = []

    def replay() -> "Comparison":
        for twin, label in zip(twins, labels, strict=True):
            comparisons.append(_replayed(twin, label, measurements, solid))
        if config.joints:
            comparisons[:] = [only(c, config.joints) for c in comparisons]
        return comparisons[0]

    beside = replayed(
        twins[0],
        measurements,
        "not compared",
        config.accept,
        replay,
        only=config.joints,
    )
    if beside is None:
        return 1
    first, *rest = comparisons
    show(
        compared.how_far(*comparisons),
        *compared.pad_matches(*comparisons),
        compared.where(first, ()),
        compared.cell_numbers(comparisons[-1]),
        compared.not_compared(first),
    )
    off = far_off(comparisons[-1], twins[-1].fitted_gains, beside.findings)
    show(Section(text=[origin_words(first.origins), *off]))
    after = rest[0] if rest else None
    if config.out is not None:
        digests = {
            f"{name}, SHA-256": t.digest()
            for name, t in zip(labels, twins, strict=True)
        }
        report = Report(
            title=", and ".join(
                [f"{labels[0]} beside {config.measurements.name}", *labels[1:]]
            ),
            comparison=first,
            after=after,
            findings=beside.findings,
            provenance={"command": shlex.join(words), **digests},
        )
        show(write_report(report, config.out))
    if config.rerun is not None:
        from taccorl.views.compare_view import save_comparison

        save_comparison(first, config.rerun, after)
        look = f"look at it with rerun {shlex.quote(str(config.rerun))}"
        show(Section(text=[f"wrote {config.rerun}: {look}"]))
    return 0


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
    twins: "Sequence[Machine]",
    paths: Sequence[Path | None],
    measurements: "Measurements",
) -> None:
    """Raises TaccorlError: the second machine lacks a signal that the first one has."""
    first, last = twins[0], twins[-1]
    kin = first.of_joints == last.of_joints
    for name in sorted({signal for m in measurements.all for signal in m.signals}):
        if not kin or (name in first.units and name not in last.units):
            raise TaccorlError(
                f"--against={paths[-1]}: is of another machine: it has no {name!r}, which "
                f"{paths[0] or 'the nominal twin'} has and recordings move; give a file of "
                "the same machine"
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
