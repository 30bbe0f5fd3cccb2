"""``taccorl ingest recordings/ --spec=piper_flexitac_mcap --out=outputs/my_dataset``

Turn recordings (MCAP, ROS 2 and ROS 1 bags, HDF5, LeRobot datasets) into one LeRobot v3 dataset with touch.
``taccorl ingest inspect FILE`` prints the contents of a recording and drafts its specs.
"""

import ctypes
import json
import os
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from taccorl.cli.card import add_card
from taccorl.cli.output_lock import check_apart
from taccorl.cli.parse import parse
from taccorl.cli.printed import give
from taccorl.data.origin import DOMAINS, Domain, Origin
from taccorl.errors import DatasetError, InTheWayError, TaccorlError, nearest, printable
from taccorl.lineage.destinations import check_writable, is_free, write_new
from taccorl.lineage.engines import Engine, LocalEngine

if TYPE_CHECKING:
    from taccorl.data.ingest import Job
    from taccorl.data.inspection import Inventory
    from taccorl.data.recording import Source


@dataclass(kw_only=True)
class IngestConfig:
    """Ingest recordings into one LeRobot dataset."""

    paths: list[Path]
    """Recordings: files, bag folders, datasets, or folders of those."""
    spec: str | None = None
    """Recording spec: a file, or the name of one in data_specs/recordings/; chosen by the topics if not given."""
    out: Path = Path("outputs/dataset")
    """The dataset's folder. It must be empty or not exist, unless it holds the same dataset."""
    store: Path = Path("outputs/store")
    """Folder that keeps finished recordings, so that a second run continues where the first ended."""
    dry_run: bool = False
    """Read, align and check, but write no dataset (two rows are written into a scratch folder as a test)."""
    domain: str | None = None
    """Who made the recordings that do not say so themselves: real (a robot), surrogate (a simulation in its place) or twin."""
    replace: bool = False
    """If `out` holds another dataset, move that one aside (out.old-1, …) and publish the new one."""
    engine: Engine = field(default_factory=LocalEngine)
    """Where recordings are ingested: --engine.type=local --engine.workers=2, or ray."""


@dataclass(kw_only=True)
class InspectConfig:
    """Print the contents of a recording, and draft its specs."""

    paths: list[Path]
    """Recordings: files, bag folders, datasets, or folders of those."""
    reader: str | None = None
    """mcap, db3, rosbag1, hdf5, lerobot or the name of a plug-in; chosen by the file's content if not given."""
    split_bag: bool = False
    """Treat files x_0, x_1, … of a folder as one recording."""
    draft: Path | None = None
    """Write the draft recording spec to this file, and beside it the draft dataset spec (…_dataset.yaml) and, for an unknown
    kind of pad, the draft sensor spec (…_sensor.yaml), instead of printing them. Existing files are not overwritten."""


def main(argv: list[str]) -> int:
    """Run ``taccorl ingest`` with the words ``argv`` after it; returns the exit status, 0: all recordings were written or split,
    1: some were quarantined or refused."""
    if argv and argv[0] == "inspect":
        return inspect(
            parse(
                InspectConfig,
                argv[1:],
                positional="paths",
                prog="taccorl ingest inspect",
            )
        )
    return run(parse(IngestConfig, argv, positional="paths"))


def _save_memory() -> None:
    """One heap for all threads, freed memory given back: 60 MB less beside the encoders. Only in a process of our own."""
    if os.environ.get("TACCORL_PROGRAM") != "1":
        return
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(-8, 2)  # M_ARENA_MAX
        libc.mallopt(-1, 1 << 17)  # M_TRIM_THRESHOLD [bytes]
    except (OSError, AttributeError):
        pass  # not glibc: it works without


def run(config: IngestConfig) -> int:
    """Ingest the recordings. Returns the exit status, 0: all recordings were written or split, 1: some were quarantined or
    refused."""
    _save_memory()
    from taccorl.report.ingested import ingested
    from taccorl.report.terminal import show

    moved: list[Path] = []
    report = ingested_as(config, print, moved.append)
    give(lambda: report)
    show(ingested(report))
    for aside in moved:
        print(f"what was at {config.out} is now at {aside}")
    _say_where(report, config)
    bad = (
        report["episodes_quarantined"]
        + report["outcomes"]["quarantined"]
        + report["outcomes"]["refused"]
    )
    return 1 if bad else 0


def ingested_as(
    config: IngestConfig, say: Callable[[str], None], moved: Callable[[Path], None]
) -> dict[str, Any]:
    """Ingest the recordings, and write the dataset and its report.

    Args:
        say: function that gets what was chosen, and what was not read.
        moved: function that gets the path to which an earlier dataset was moved.

    Returns: the content of ingest_report.json.

    Raises:
        TaccorlError: an option is wrong, or the output cannot be written.
    """
    from taccorl.cli.progress import Bars
    from taccorl.data.ingest import find_jobs, ingest
    from taccorl.data.spec import load_recording_spec
    from taccorl.lineage.store import Store

    if config.domain not in (None, *DOMAINS):
        raise TaccorlError(
            f"--domain={config.domain}: {nearest(config.domain, DOMAINS)}"
        )
    name = config.spec or chosen_spec(config.paths, say)
    spec = load_recording_spec(name)
    skipped: list[str] = []
    domain = cast("Domain | None", config.domain)
    jobs = find_jobs(
        config.paths, spec, name, config.store, config.dry_run, skipped, domain
    )
    for line in skipped:
        say(f"not read: {printable(line)}")
    _check_out(config, jobs)
    store = None if config.dry_run else Store(config.store)
    if store is not None:
        store.make()  # each recording's errors are its own: a store that cannot be written would be an error of all
    with Bars(len(jobs)) as bars:
        try:
            report = ingest(
                jobs,
                config.out,
                store,
                engine=config.engine,
                progress=bars.update,
                replace=moved if config.replace else None,
            )
        except InTheWayError as error:
            raise InTheWayError(f"{error} --replace=true moves it aside.") from error
    _write_report(report, config)
    return report


def chosen_spec(paths: Sequence[Path], say: Callable[[str], None] = print) -> str:
    """Name of the shipped spec that fits recordings for which the user gave none; ``say`` gets it. Raises TaccorlError: none
    fits, or several do."""
    from taccorl.data.inspection import choose_spec

    name = choose_spec(paths)
    say(f"spec:    {name}, whose topics these are (--spec={name})")
    return name


def _check_out(config: IngestConfig, jobs: "list[Job]") -> None:
    """Fail early if the output path is occupied, instead of after an hour of work."""
    from taccorl.data.lerobot_format import check_path

    out, whole, store = config.out, config.out.resolve(), config.store.resolve()
    if out.name in ("", ".."):
        raise DatasetError(f"--out={out} is not the name of a folder: give a name")
    if inside := [
        file
        for job in jobs
        for file in job.source.files
        if file.resolve().is_relative_to(whole)
    ]:
        raise DatasetError(
            f"{inside[0]} is an input, and lies in --out={out}: give another --out"
        )
    if within := [
        path
        for path in config.paths
        if path.is_dir() and whole.is_relative_to(path.resolve())
    ]:
        raise TaccorlError(
            f"--out={out} lies in {within[0]}, which is read: give another folder"
        )
    check_apart(out, [("--store", config.store)])
    check_path(store)
    if config.dry_run:
        return
    check_writable(whole.parent)
    check_writable(store, "--store")
    if jobs and not is_free(out) and not config.replace:
        _check_same(out, jobs)


def _check_same(out: Path, jobs: "list[Job]") -> None:
    """``out`` exists: it must be what these recordings and this spec gave before."""
    way_out = "give another --out, or --replace=true to move it aside"
    manifest = out / "meta/taccorl/manifest.json"
    try:
        made_by = json.loads(manifest.read_text())["config"]
        there = {(name, part) for name, part, _ in made_by["recordings"]}
        same_spec = (made_by["spec"], made_by.get("domain")) == (
            jobs[0].spec.digest,
            jobs[0].domain,
        )
    except (OSError, ValueError, KeyError, TypeError):
        raise DatasetError(
            f"{out} exists and is not a dataset of taccorl: {way_out}"
        ) from None
    wanted = {(job.source.path.name, job.source.part) for job in jobs}
    if there != wanted or not same_spec:
        new, gone = len(wanted - there), len(there - wanted)
        why = f"{new} recordings are new, {gone} are missing"
        why = why if new or gone else "it was made with another spec or domain"
        kept = "Finished recordings are then taken from --store, not ingested again"
        raise DatasetError(
            f"{out} exists and holds another dataset ({why}): {way_out}. {kept}"
        )


def _report_path(config: IngestConfig) -> Path:
    return config.out.with_name(f"{config.out.name}.ingest_report.json")


def _write_report(report: dict[str, Any], config: IngestConfig) -> None:
    """Beside the dataset, before anything is printed: a closed pipe must not cost it."""
    path = _report_path(config)
    if not config.dry_run:
        path.parent.mkdir(parents=True, exist_ok=True)
        temp = path.with_name(f".{path.name}.{os.getpid()}")
        temp.write_text(
            json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )
        temp.replace(path)


def _say_where(report: dict[str, Any], config: IngestConfig) -> None:
    if config.dry_run:
        print("dry run: nothing was written")
        return
    print(f"report:  {_report_path(config)}")
    if report["episodes"]:
        print(
            f"dataset: {config.out}  ({report['episodes']} episodes, {report['rows']} rows)"
        )
        origins = Counter(
            str(Origin.read(e))
            for r in report["recordings"]
            for e in r["episodes"]
            if e["outcome"] == "written"
        )
        print(
            f"origin:  {printable('; '.join(f'{label} ({num} episodes)' for label, num in origins.most_common()))}"
        )
        if any(
            e["domain"] is None for r in report["recordings"] for e in r["episodes"]
        ):
            print(
                "         --domain=real states that a robot made the recordings that do not say so"
            )
        add_card(config.out)
        print(f"look:    taccorl view {shlex.quote(str(config.out))} --episode=0")


def inspect(config: InspectConfig) -> int:
    """Print the contents of recordings. Returns the exit status, 0: all were inspected and are whole, else 1."""
    from taccorl.data.draft import draft_paths
    from taccorl.data.inspection import inspect_source
    from taccorl.data.recording import without_place
    from taccorl.report.ingested import contents
    from taccorl.report.terminal import show

    draft = config.draft
    for path in draft_paths(draft) if draft is not None else ():
        if os.path.lexists(path):
            raise TaccorlError(
                f"{path} exists; give another --draft, it would be overwritten"
            )
    found, failed = _find_all(config)
    printed: dict[tuple[str, ...], str] = {}
    shown: dict[tuple[Any, ...], str] = {}
    for path, name, source in found:
        try:
            inventory = inspect_source(name, source)
        except TaccorlError as error:
            print(printable(f"{source.name}: {without_place(str(error), source.name)}"))
            failed += 1
            continue
        alike = (
            source.path,
            *((t.topic, t.type, t.names) for t in inventory.topics),
            *inventory.damage,
        )
        if source.part is not None and alike in shown:  # an episode of many in one file
            print(
                printable(
                    f"{source.name}: {inventory.duration_s:.2f} s, the same topics as {shown[alike]}"
                )
            )
            continue
        shown[alike] = source.name
        failed += (is_damaged := any(damage.lost for damage in inventory.damage))
        show(contents(inventory))
        _say_fit(inventory, path)
        if draft is not None:
            _write_drafts(inventory, draft)
            draft = None
        elif config.draft is None and not inventory.fits and inventory.topics:
            if is_damaged:
                print(
                    "no shipped spec fits, and it is damaged (above): --draft=draft.yaml drafts one from what is left\n"
                )
            else:
                _print_drafts(inventory, printed)
    return 1 if failed else 0


def _find_all(config: InspectConfig) -> tuple[list[tuple[Path, str, "Source"]], int]:
    """(path as given, reader, recording) of all that is there, and how many entries were not read."""
    from taccorl.data.recording import find_sources

    found, failed = [], 0
    for path in config.paths:
        skipped: list[str] = []
        try:
            sources = find_sources(
                path, reader=config.reader, split_bag=config.split_bag, skipped=skipped
            )
        except TaccorlError as error:
            if len(config.paths) == 1:
                raise
            print(printable(error))
            failed += 1
            continue
        for entry in skipped:
            print(printable(f"{path}: not read: {entry}"))
        failed += len(skipped)
        found += [(path, name, source) for name, source in sources]
    return found, failed


def _say_fit(inventory: "Inventory", path: Path) -> None:
    for fit in inventory.fits[:1]:
        if inventory.faults:
            print(
                f"has the topics of the shipped spec {fit}, but {'; '.join(inventory.faults)}\n"
            )
        else:
            print(
                f"fits the shipped spec: taccorl ingest {shlex.quote(str(path))} --spec={fit}\n"
            )


def _write_drafts(inventory: "Inventory", path: Path) -> None:
    from taccorl.data.draft import draft_specs

    files = draft_specs(inventory, path).files(path)
    for place, text in files.items():
        write_new(place, text)
    named = zip(
        ("draft spec", "and of its dataset", "and of its pads"), files, strict=False
    )
    print(
        "\n".join(f"{what}: {place}" for what, place in named)
        + "\nreplace the TODOs in all of them\n"
    )


def _print_drafts(inventory: "Inventory", printed: dict[tuple[str, ...], str]) -> None:
    """Print the drafts for a recording, unless equal ones were printed for another. ``printed``: texts of drafts without their
    first line, which names the recording → that recording; is added to."""
    from taccorl.data.draft import draft_specs

    path = Path("draft.yaml")
    files = draft_specs(inventory, path).files(path)
    first = printed.setdefault(
        tuple(text.split("\n", 1)[1] for text in files.values()), inventory.source.name
    )
    if first != inventory.source.name:
        print(
            f"no shipped spec fits; the drafts for {printable(first)} above are right for it, too\n"
        )
        return
    print(
        f"no shipped spec fits; drafts of {len(files)} specs (--draft={path} writes them):\n"
    )
    for what, (place, text) in zip(
        ("how it is read", "what its dataset holds", "its pads"),
        files.items(),
        strict=False,
    ):
        print(f"# ---- {place}: {what} ----\n{text}")
