"""``import taccorl``: the verbs as functions, for notebooks and programs.

    robot = taccorl.load_robot("my_arm.yaml")
    measurements = taccorl.read_measurements("sweeps/", robot)
    report = taccorl.diagnose(robot, measurements)
    mended = taccorl.add_effect(robot, "coulomb_friction", report)
    mended.save("my_arm+friction.yaml")

Each function calls the one that its verb calls, so both have the same results, and the
same texts of errors: a message may name an option of the verb (``--joints``), which is
the argument of that name here. Nothing is printed but progress, on stderr. Packages are
imported by the first call that needs them; none of these functions needs torch.
"""

import dataclasses
import warnings
import weakref
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from taccorl.errors import TaccorlError, nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from taccorl.alignment.measurements.folder import Measurements
    from taccorl.alignment.measurements.pressed import PressedObject
    from taccorl.cli.add_effect import Change
    from taccorl.data.episode import Episode
    from taccorl.data.origin import Domain
    from taccorl.diagnosis.machines.machine import Machine
    from taccorl.report.report import Report
    from taccorl.report.section import Section

__all__ = [
    "add_effect",
    "compare",
    "diagnose",
    "ingest",
    "load_episode",
    "load_robot",
    "plot",
    "read_measurements",
]


def load_robot(path: Path | str | None = None) -> "Machine":
    """Load the robot, axis or sensor that a file describes.

    Args:
        path: a robot file (``taccorl init-robot`` drafts one), or a twin.yaml of the
            PiPER; its nominal twin if not given.

    Returns: the machine. ``save(path)`` writes it, ``numbers(part)`` has name → (value,
        unit), ``effects`` the names of its effects.

    Raises:
        TaccorlError: the file cannot be read; the message names file, line and key.
    """
    from taccorl.diagnosis.machines.load import load_machine

    return load_machine(None if path is None else Path(path))


def read_measurements(
    folder: Path | str,
    robot: "Machine",
    *,
    joints: Sequence[str] = (),
    spec: str | None = None,
    columns: Path | str | None = None,
    validation_every: int | None = None,
    fit_needed: bool = True,
) -> "Measurements":
    """Read recordings of a robot, divided into fit, validation and test.

    Args:
        folder: a recording, a table (CSV, parquet), a dataset, or a folder of those,
            with a ``measurements.yaml`` or without.
        robot: the machine that was recorded; its file has the units of tables.
        joints: only recordings that move one of these; all if not given.
        spec: recording spec; needed where several shipped ones read the format.
        columns: columns file with names and units of the tables' columns.
        validation_every: every k-th motion is for validation; as ``measurements.yaml``
            says if not given.
        fit_needed: False for ``compare``, which fits nothing: no recording need be for
            the fit.

    Returns: ``fit``, ``validation`` and ``test``, tuples of recordings with T rows each:
        ``time_s`` (T,) [s], ``measured`` and ``target`` (T, signals) [rad; m if a joint
        slides], ``effort`` likewise [N·m, N] where it was recorded.

    Raises:
        TaccorlError: there is nothing to read, or a file, a column or a joint is wrong.
    """
    from taccorl.diagnosis.problems.joints import of_joints

    found = robot.read(
        Path(folder),
        spec=spec,
        columns=None if columns is None else Path(columns),
        validation_every=validation_every,
        fit_needed=fit_needed,
    )
    if not joints:
        return found
    return of_joints(found, robot.select(robot.parts(found), joints, []))


def compare(
    robot: "Machine",
    measurements: "Measurements",
    *,
    against: "Machine | None" = None,
    joints: Sequence[str] = (),
    pressed: "PressedObject | None" = None,
    accept: Sequence[str] = (),
) -> "Report":
    """Simulate the commands of every recording, and measure the differences.

    Args:
        robot: the machine that is simulated.
        measurements: what ``read_measurements`` returned.
        against: a second machine of the same kind, shown beside the first.
        joints: only these; all that move if not given.
        pressed: object between the fingers in recordings that do not state one.
        accept: names of checks whose errors are known; they become warnings.

    Returns: the report, which a notebook shows as HTML. ``comparison.scores()`` has RMSE
        in units, and ``ratio`` to the noise floor; ``comparison.traces`` has (T,) arrays
        of every signal; ``save(folder)`` writes report.html and report.json.

    Raises:
        TaccorlError: the measurements have errors, a joint is in no recording, or
            ``against`` is of another machine.
    """
    from taccorl.cli.compare import compared

    names = [robot.name]
    if against is not None:
        same = against.name == robot.name
        names.append(f"{against.name}, the second" if same else against.name)
    shown = _Shown()
    report = compared(
        [robot] if against is None else [robot, against],
        measurements,
        names=names,
        joints=joints,
        accept=accept,
        pressed=pressed,
        second="against",
        title=f"{len(measurements.all)} recordings",
        show=shown,
    )
    if report is None:
        raise shown.error()
    return report


def diagnose(
    robot: "Machine",
    measurements: "Measurements",
    *,
    joints: Sequence[str] = (),
    pads: Sequence[str] = (),
    until: Literal["one", "noise_floor"] = "one",
    gains: Literal["auto", "commanded", "fitted"] = "auto",
    without: Sequence[str] = (),
    accept: Sequence[str] = (),
    workers: int = 1,
) -> "Report":
    """Find the physical effect that a machine lacks, with the evidence.

    Args:
        robot: the machine that is simulated.
        measurements: what ``read_measurements`` returned.
        joints, pads: only these parts; all that move if not given.
        until: ``one`` finds the most likely effect of each part; ``noise_floor`` adds
            effects until the error is at the noise floor.
        gains: ``auto`` fixes gains that every recording states, and fits others.
        without: effects that are not tried.
        accept: names of checks whose errors are known; they become warnings.
        workers: number of parts at the same time. Above 1, a program needs the guard
            ``if __name__ == "__main__":``, since Python starts processes.

    Returns: the report, which a notebook shows as HTML. ``accounts()`` has part → facts
        of its verdict, ``found`` the findings with all evidence; ``save(folder)`` writes
        report.html and the report.json that ``taccorl add-effect`` reads.

    Raises:
        TaccorlError: the measurements have errors, or no part can be diagnosed.
    """
    from taccorl.cli.diagnose import to_diagnose, with_results
    from taccorl.cli.progress import Steps

    if workers < 1:
        raise TaccorlError(f"workers={workers}: at least 1")
    _check_choice("until", until, ("one", "noise_floor"))
    _check_choice("gains", gains, ("auto", "commanded", "fitted"))
    shown = _Shown()
    ready = to_diagnose(
        robot,
        measurements,
        joints=joints,
        pads=pads,
        without=without,
        accept=accept,
        show=shown,
    )
    if ready is None or not ready.parts:
        raise shown.error()
    for line in ready.refused:
        warnings.warn(line, stacklevel=2)
    found = ready.search(
        until=until, gains=gains, without=without, workers=workers, progress=Steps()
    )
    title = f"{robot.name}: what it lacks, by {len(measurements.all)} recordings"
    corrected, disagreement = robot.mended(found)
    if disagreement:
        warnings.warn(disagreement, stacklevel=2)
    report = ready.report(title, twin=robot.name)
    return with_results(report, robot, found, measurements, corrected)


def add_effect(
    robot: "Machine",
    effect: str,
    diagnosis: "Report | Path | str | None" = None,
    *,
    values: Mapping[str, float] | None = None,
    joints: Sequence[str] = (),
    pads: Sequence[str] = (),
) -> "Machine":
    """A copy of the robot with an effect, or with corrected numbers.

    Args:
        robot: the machine that was diagnosed; it is not changed.
        effect: name of an effect (``taccorl effects`` lists them) or of a number that
            the diagnosis says is off, such as ``kd``; several with commas between.
        diagnosis: what ``diagnose`` returned, or the folder of a saved report.
        values: parameter → value by hand, in the units of docs/effects.md, in place of
            a diagnosis.
        joints, pads: only at these parts; if not given, where the diagnosis found it.

    Returns: the copy; ``save(path)`` writes its file.

    Raises:
        TaccorlError: the effect is unknown, cannot act there, or was not fitted.
    """
    from taccorl.cli import add_effect as verb
    from taccorl.report.report import Report, as_json, numbers_of

    if (diagnosis is None) == (not values):
        raise TaccorlError(
            f"{effect}: give its numbers, either diagnosis=… or values={{…}}"
        )
    request = verb.Request(list(dict.fromkeys(effect.split(","))), joints, pads)
    if values:
        change = verb.by_hand(robot, request, values, "values=")
        return _named(robot, effect, change)
    if isinstance(diagnosis, Report):
        path, stored = Path("the diagnosis"), as_json(diagnosis)
    else:
        path = numbers_of(Path(diagnosis or ""))
        stored = verb.stored(path, robot, request.names)
    change = verb.diagnosed(robot, request, stored, path, _warn)
    return _named(robot, effect, change)


def _named(robot: "Machine", effect: str, change: "Change") -> "Machine":
    """The changed copy, with a name of its own for tables and pictures."""
    mended = robot.with_additions(change.additions)
    if not dataclasses.is_dataclass(mended):
        return mended
    own: Any = mended
    return dataclasses.replace(own, name=f"{robot.name}+{effect}")


def plot(
    report: "Report", signal: str | None = None, recording: str | None = None
) -> "Figure":
    """Plot one signal of one recording: target, measurement, replay, and the residual
    with its noise floor below.

    Args:
        report: what ``compare`` or ``diagnose`` returned; a second or corrected machine
            is drawn beside the first.
        signal: such as ``joint5``; that with the largest error over its noise floor if
            not given.
        recording: its name; that with the signal's largest error if not given.

    Returns: the figure; axes are in s, and rad, m, N·m or N with a prefix.

    Raises:
        TaccorlError: the report has no such signal or recording.
    """
    import numpy as np

    from taccorl.report.figures import joint_response

    traces = list(report.comparison.traces)
    for name, value in (("signal", signal), ("recording", recording)):
        known = {getattr(t, name) for t in traces}
        if value is not None and value not in known:
            raise TaccorlError(
                f"{name}={value!r}: not compared; {nearest(value, known)}"
            )
        traces = [t for t in traces if value in (None, getattr(t, name))]
    if not traces:
        raise TaccorlError(
            f"signal={signal!r}: recording={recording!r} does not move it; the report has "
            "no curve of it"
        )

    def error(t: Any) -> float:
        square = np.square(t.residual)
        own = 0.0 if np.all(np.isnan(square)) else float(np.sqrt(np.nanmean(square)))
        return own / t.floor.value

    first = max(traces, key=error)
    key = (first.signal, first.kind, first.recording)
    others = () if report.after is None else report.after.traces
    same = [t for t in others if (t.signal, t.kind, t.recording) == key]
    names = (report.comparison.twin, report.last.twin)
    return joint_response(first, same[0] if same else None, names)


def load_episode(
    path: Path | str, number: int = 0, *, spec: str | None = None
) -> "Episode":
    """Load one episode of a dataset, a recording, or an attempt in the twin.

    Args:
        path: a LeRobot v3 dataset, or a recording (MCAP, ROS bag, HDF5).
        number: which episode, counted from 0.
        spec: recording spec; needed where several shipped ones fit a recording.

    Returns: the episode of T rows. ``arrays`` has key → (T, size), in the units of its
        ``spec``; ``pictures()`` streams the rows' pictures, (H, W, 3) uint8 in RGB by
        camera; ``instruction``, ``success`` and ``origin`` say what it is. Its files
        stay open while it is in use.

    Raises:
        TaccorlError: there is no such file or episode, or the spec is missing.
    """
    from taccorl.cli.view import opened_episode

    files = ExitStack()
    episode = files.enter_context(
        opened_episode(Path(path), number, spec, "--spec", _warn)
    )
    weakref.finalize(episode, files.close)
    return episode


def ingest(
    paths: Path | str | Sequence[Path | str],
    out: Path | str,
    *,
    spec: str | None = None,
    store: Path | str = "outputs/store",
    dry_run: bool = False,
    domain: "Domain | None" = None,
    replace: bool = False,
    workers: int = 1,
) -> dict[str, Any]:
    """Turn recordings into one LeRobot v3 dataset with touch.

    Args:
        paths: recordings: files, bag folders, datasets, or folders of those.
        out: the dataset's folder; it must be empty, or hold the same dataset.
        spec: recording spec, a file or the name of a shipped one; chosen by the topics
            if not given.
        store: folder that keeps finished recordings, for a second run.
        dry_run: read, align and check, but write no dataset.
        domain: who made recordings that do not say so: real, surrogate or twin.
        replace: move another dataset at ``out`` aside.
        workers: number of recordings at the same time.

    Returns: the content of ``OUT.ingest_report.json``, which is written, too: numbers of
        ``episodes`` and ``rows``, ``outcomes``, and each of ``recordings`` with reasons
        why rows or the whole were quarantined.

    Raises:
        TaccorlError: a path or spec is wrong, or the output is occupied.
    """
    from taccorl.cli.ingest import IngestConfig, ingested_as
    from taccorl.cli.output_lock import hold, released_at_the_end
    from taccorl.lineage.engines import LocalEngine

    some = [paths] if isinstance(paths, Path | str) else paths
    config = IngestConfig(
        paths=[Path(path) for path in some],
        spec=spec,
        out=Path(out),
        store=Path(store),
        dry_run=dry_run,
        domain=domain,
        replace=replace,
        engine=LocalEngine(workers=workers),
    )
    with released_at_the_end():
        hold(config.out)
        return ingested_as(config, _warn, lambda aside: _warn(f"moved to {aside}"))


class _Shown:
    """Sections that a verb would print, kept for the text of an error."""

    def __init__(self) -> None:
        self.sections: list[Section] = []

    def __call__(self, *sections: "Section") -> None:
        self.sections += sections

    def error(self) -> TaccorlError:
        """The error that stops the call, with the findings above it."""
        from taccorl.report.terminal import as_text

        return TaccorlError(as_text(*self.sections))


def _warn(text: str) -> None:
    warnings.warn(text.removeprefix("warning: "), stacklevel=4)


def _check_choice(name: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise TaccorlError(f"{name}={value!r}: {nearest(value, known)}")
