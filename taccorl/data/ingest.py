"""Turn recordings into one LeRobot dataset: each recording is a stage of its own in the store; the results are then merged and
published together.

Every input ends as exactly one of: ``written``; ``split`` (written in part: something was silent, damaged, cut off, or some
of its episodes were quarantined, and what is missing is listed; ``rows_lost`` counts it); ``quarantined`` (readable, but its
data is wrong: none of it is in the dataset); ``refused`` (cannot be read or does not fit the spec). Originals are only ever read.
"""

import contextlib
import dataclasses
import itertools
import json
import os
import shlex
import shutil
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from taccorl.data.checks import check_episode, check_recording_episodes
from taccorl.data.cutting import BrokenPicture, Cut, Cutter, Loss, Unfit
from taccorl.data.dataset import (
    PROVENANCE,
    dataset_spec_to_json,
    episode_record,
    write_records,
)
from taccorl.data.episode import Episode, Pictures
from taccorl.data.finding import Finding
from taccorl.data.origin import Domain
from taccorl.data.picture_checks import PictureWatch
from taccorl.data.recording import Damage, Source, find_sources, opened
from taccorl.data.spec import RecordingSpec
from taccorl.errors import DISK_FAULTS, InTheWayError, RecordingError, TaccorlError
from taccorl.lineage.digest import digest_file
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.manifest import DATASET_MANIFEST
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store

Outcome = Literal["written", "split", "quarantined", "refused"]
Progress = Callable[[str, int, int], None]
"""Function that is called with (recording, number of rows done, number of rows in all)."""
RECORDING_STAGE_VERSION = 6
DATASET_STAGE_VERSION = 5


@dataclass(frozen=True)
class Job:
    """One recording to ingest; plain data, so that it can go to another process or machine."""

    source: Source
    spec: RecordingSpec
    spec_name: str
    """Name or path of the recording spec, as the user gave it."""
    store: Path
    dry_run: bool = False
    domain: Domain | None = None
    """Domain of a recording that states none itself."""

    @property
    def stated(self) -> dict[str, str]:
        """Part of a stage's configuration; empty where nobody states a domain."""
        return {} if self.domain is None else {"domain": self.domain}


class NothingToWrite(RecordingError):
    """Error: no episode of the recording may go into a dataset. Holds the recording's report entry."""

    def __init__(self, entry: dict[str, Any]) -> None:
        super().__init__(entry["reason"])
        self.entry = entry


def find_jobs(
    paths: Sequence[Path],
    spec: RecordingSpec,
    spec_name: str,
    store: Path,
    dry_run: bool,
    skipped: list[str] | None = None,
    domain: Domain | None = None,
) -> list[Job]:
    """One job per recording under ``paths``, in the order given, folders in natural order; a file that is named twice is one
    input. ``skipped``: as in ``find_sources``; the other arguments: as in ``Job``. Raises RecordingError: a path holds none."""
    jobs: dict[tuple[Path, str | None], Job] = {}
    for path in paths:
        for _, source in find_sources(
            path, reader=spec.reader, split_bag=spec.split_bag, skipped=skipped
        ):
            jobs.setdefault(
                (source.path.resolve(), source.part),
                Job(source, spec, spec_name, store, dry_run, domain),
            )
    return list(jobs.values())


def ingest(
    jobs: Sequence[Job],
    out: Path,
    store: Store | None,
    *,
    engine: Engine | None = None,
    progress: Progress | None = None,
    replace: Callable[[Path], None] | None = None,
) -> dict[str, Any]:
    """Ingest all jobs and publish the dataset at ``out``; returns the report. A dry run needs no store. ``replace``: if given,
    whatever else is at ``out`` is moved aside; called with the path it is moved to. Raises InTheWayError: ``out`` holds
    something else; TaccorlError: the machine failed (disk full); finished recordings are kept, a later run does not repeat them.
    """
    entries = ingest_each(jobs, engine, progress)
    _leave_out_twins(jobs, entries)
    report = _report(jobs, entries)
    made = [
        (job, entry)
        for job, entry in zip(jobs, entries, strict=True)
        if entry.get("artefact")
    ]
    shards = [Path(entry["artefact"]) for _, entry in made]
    files = (
        file
        for job, entry in made
        for file in zip(job.source.inputs, entry["source_digests"], strict=True)
    )
    sources = [Artefact(path, digest) for path, digest in files]
    for entry in entries:
        entry.pop("artefact", None)
    if not shards or store is None or any(job.dry_run for job in jobs):
        return report
    spec = jobs[0].spec

    stage = Stage("dataset", version=DATASET_STAGE_VERSION, manifest=DATASET_MANIFEST)
    stage = stage.bound(
        lambda config, inputs, folder: _assemble(spec, report, entries, inputs, folder)
    )
    # Names without folders: the same files reached by another path are the same dataset.
    named = [[Path(e["recording"]).name, e["part"], e["outcome"]] for e in entries]
    config = {"spec": spec.digest, "recordings": named} | jobs[0].stated
    inputs = [
        Artefact(path, json.loads((path / "manifest.json").read_text())["digest"])
        for path in shards
    ]
    try:
        try:
            store.run(stage, config, inputs, destination=out, sources=sources)
        except InTheWayError:
            if replace is None:
                raise
            with moved_aside(out) as aside:
                store.run(stage, config, inputs, destination=out, sources=sources)
            replace(aside)
    except Exception as error:
        if (fault := _machine_fault(error)) is not None:
            raise _stopped(fault, out, store.root) from error
        raise
    return report


def ingest_each(
    jobs: Sequence[Job], engine: Engine | None = None, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """Ingest the jobs on the engine; returns the report entry of each job (``ingest_one``), in the order of the jobs."""
    if engine is None or (isinstance(engine, LocalEngine) and engine.workers <= 1):
        return [ingest_one(job, progress) for job in jobs]
    done = iter(range(1, len(jobs) + 1))

    def tell(job: Job, _: Any) -> None:
        if progress:
            progress(job.source.name, next(done), len(jobs))

    return engine.map(ingest_one, jobs, name=lambda job: job.source.name, on_done=tell)


def _leave_out_twins(jobs: Sequence[Job], entries: list[dict[str, Any]]) -> None:
    """The same content twice would put the same episodes into training and test: the second is refused."""
    sizes = [
        (
            tuple(p.stat().st_size for p in job.source.files if p.is_file()),
            job.source.part,
        )
        for job in jobs
    ]
    alike, first = Counter(sizes), dict[tuple[Any, ...], str]()
    for job, entry, size in zip(jobs, entries, sizes, strict=True):
        if entry["outcome"] not in ("written", "split") or alike[size] == 1:
            continue
        if job.dry_run:
            entry["source_digests"] = [digest_file(path) for path in job.source.inputs]
        content, digest = (
            (tuple(entry["source_digests"][: len(job.source.files)]), entry["part"]),
            entry["source_digests"][0][:12],
        )
        if first.setdefault(content, entry["recording"]) is not entry["recording"]:
            reason = f"the same content as {first[content]} (sha256 {digest}…): its episodes are in already"
            entry |= _entry("refused", reason)
            entry.pop("artefact", None)


@contextlib.contextmanager
def moved_aside(out: Path) -> Iterator[Path]:
    """What is at ``out`` lies under another name; it comes back if the work fails."""
    names = (out.with_name(f"{out.name}.old-{number}") for number in itertools.count(1))
    aside = next(name for name in names if not os.path.lexists(name))
    out.rename(aside)
    try:
        yield aside
    except BaseException:
        if not os.path.lexists(out):
            aside.rename(out)
        raise


# ---- one recording ----


def ingest_one(job: Job, progress: Progress | None = None) -> dict[str, Any]:
    """Ingest one recording into a shard in the store; returns its entry of the report: ``outcome``, ``reason``,
    ``source_digests`` … A fault of the recording is never raised: the entry states the outcome."""
    digests: list[str] = []
    try:
        entry = _dry(job, progress) if job.dry_run else _stored(job, progress, digests)
    except NothingToWrite as nothing:
        entry = nothing.entry
    except TaccorlError as error:
        entry = _entry(
            "quarantined" if isinstance(error, Unfit) else "refused", str(error)
        )
    except (
        MemoryError
    ) as error:  # one recording may ask for more than there is; the others need not
        entry = _entry(
            "refused", f"reading it takes more memory than there is ({error})"
        )
    except Exception as error:
        if (fault := _machine_fault(error)) is not None:
            raise _stopped(fault, job.store) from error
        if isinstance(error, OSError):
            entry = _entry(
                "refused",
                f"{error.strerror or error} ({error.filename or job.source.name})",
            )
        else:  # our fault, not the user's: no traceback on the screen, but the whole of it in the report
            entry = _entry(
                "refused",
                f"a fault in taccorl, please report it: {type(error).__name__}: {error}",
            )
            entry["traceback"] = traceback.format_exc()
    # What depends on where the recording lies is kept out of the store, which knows contents only.
    command = f"taccorl check {shlex.quote(str(job.source.path))} --spec={shlex.quote(job.spec_name)}"
    head = {
        "recording": str(job.source.path),
        "part": job.source.part,
        "spec": job.spec_name,
    }
    head |= {
        "spec_digest": job.spec.digest,
        "outcome": entry["outcome"],
        "reason": entry["reason"],
        "command": command,
    }
    return (
        head
        | {k: v for k, v in entry.items() if k not in head}
        | {"source_digests": digests}
    )


def _machine_fault(error: Exception) -> str | None:
    """The fault of the machine behind an error; None if it was none. LeRobot's encoder threads and shutil pass an OSError on as
    text only."""
    told = (
        text
        for number, text in DISK_FAULTS.items()
        if f"[Errno {number}]" in str(error)
    )
    return DISK_FAULTS.get(getattr(error, "errno", None) or 0) or next(told, None)


def _stopped(fault: str, *places: Path) -> TaccorlError:
    text = f"{fault} at {' or '.join(map(str, places))} or in {tempfile.gettempdir()} (scratch files); what was "
    return TaccorlError(
        f"{text}finished is kept: make room, then run the same command again"
    )


def _stored(job: Job, progress: Progress | None, digests: list[str]) -> dict[str, Any]:
    store = Store(job.store)
    stage = Stage(
        "recording",
        lambda config, inputs, folder: _build(job, folder, progress),
        RECORDING_STAGE_VERSION,
    )
    inputs = [store.source(path) for path in job.source.inputs]
    digests += [artefact.digest for artefact in inputs]
    artefact = store.run(
        stage, {"spec": job.spec.digest, "part": job.source.part} | job.stated, inputs
    )
    return {
        **json.loads((artefact.path / "entry.json").read_text()),
        "artefact": str(artefact.path),
    }


def _build(job: Job, folder: Path, progress: Progress | None) -> None:
    """Stage ``recording``: dataset/, entry.json and episodes.json of one recording."""
    from taccorl.data.lerobot_format import write_episodes

    def write(episodes: list[Episode]) -> None:
        rows, tell = (
            sum(e.num_rows for e in episodes),
            progress or (lambda name, done, total: None),
        )
        shutil.rmtree(folder / "dataset", ignore_errors=True)
        write_episodes(
            episodes,
            folder / "dataset",
            progress=lambda done: tell(job.source.name, done, rows),
        )

    with opened(job.source, job.spec) as recording:
        good, entry = _settle(Cutter(recording, job.domain), write)
        records = [episode_record(e, "") for e in good]
    _dump(folder / "entry.json", entry)
    _dump(folder / "episodes.json", records)


def _dry(job: Job, progress: Progress | None) -> dict[str, Any]:
    """Same result as ``_build`` without writing a dataset: everything is read, pictures too, and LeRobot writes two rows into a
    scratch folder."""
    from taccorl.data.lerobot_format import write_episodes

    def look(episodes: list[Episode]) -> None:
        shortest = min(episodes, key=lambda e: e.num_rows)
        arrays = {key: values[:2] for key, values in shortest.arrays.items()}
        first = dataclasses.replace(
            shortest,
            arrays=arrays,
            pictures=lambda: itertools.islice(shortest.pictures(), 2),
        )
        with tempfile.TemporaryDirectory(prefix="taccorl_") as scratch:
            write_episodes([first], Path(scratch) / "dataset")
        shown = (None for episode in episodes for _ in episode.pictures())
        for done, _ in enumerate(shown, 1):
            if progress is not None:
                progress(job.source.name, done, sum(e.num_rows for e in episodes))

    with opened(job.source, job.spec) as recording:
        return _settle(Cutter(recording, job.domain), look)[1]


def _settle(
    cutter: Cutter, consume: Callable[[list[Episode]], None]
) -> tuple[list[Episode], dict[str, Any]]:
    """The good episodes, consumed, and the report entry. What only the pictures show may take a second try. Raises
    NothingToWrite: no good episode."""
    try:
        return _consume(cutter, {}, consume)
    except BrokenPicture:
        cutter.drop_broken_pictures()
    good, entry = _consume(cutter, {}, consume)
    entry["broken_pictures_s"] = cutter.broken_pictures_s
    if entry["outcome"] == "written":
        broken = ", ".join(
            f"{len(times)} of {channel}"
            for channel, times in cutter.broken_pictures_s.items()
        )
        reason = (
            f"pictures that do not decode: {broken}; their rows show the one before"
        )
        entry |= {"outcome": "split", "reason": reason}
    return good, entry


def _consume(
    cutter: Cutter,
    seen: dict[str, list[Finding]],
    consume: Callable[[list[Episode]], None],
) -> tuple[list[Episode], dict[str, Any]]:
    """Judge and consume, watching the pictures go by. ``seen``: episode name → findings from its pictures, of an earlier
    try."""
    good, entry = _judge(cutter, seen)
    if not good:
        raise NothingToWrite(entry)
    watches = [PictureWatch(e) for e in good]
    consume(
        [
            dataclasses.replace(e, pictures=_watched(e, w))
            for e, w in zip(good, watches, strict=True)
        ]
    )
    sizes = cutter.size_findings()
    found = {e.name: w.findings() + sizes for e, w in zip(good, watches, strict=True)}
    severities = {f.severity for findings in found.values() for f in findings}
    if not seen and "error" in severities:
        return _consume(cutter, found, consume)
    return good, entry if seen or not severities - {"note"} else _judge(cutter, found)[
        1
    ]


def _watched(episode: Episode, watch: PictureWatch) -> Callable[[], Iterator[Pictures]]:
    def pictures() -> Iterator[Pictures]:
        watch.restart()
        for shown in episode.pictures():
            watch.see(shown)
            yield shown

    return pictures


def _judge(
    cutter: Cutter, seen: dict[str, list[Finding]]
) -> tuple[list[Episode], dict[str, Any]]:
    """Which episodes are fit for the dataset, and the recording's report entry. ``seen``: findings from pictures."""
    recording, cut = cutter.recording, cutter.cut()
    findings = [
        check_episode(e, pictures=False) + seen.get(e.name, []) for e in cut.episodes
    ]
    wrong = [
        next((f for f in found if f.severity == "error"), None) for found in findings
    ]
    good = [e for e, error in zip(cut.episodes, wrong, strict=True) if error is None]
    across = check_recording_episodes(good) if len(good) > 1 else []
    episodes = []
    for e, found, error in zip(cut.episodes, findings, wrong, strict=True):
        start_s, name = (
            (e.start_ns - cut.origin_ns) / 1e9,
            e.name.removeprefix(recording.source.name).strip(),
        )
        what = {
            "name": name,
            "outcome": "written" if error is None else "quarantined",
            "start_s": round(start_s, 3),
        }
        what |= {
            "end_s": round(start_s + (e.num_rows - 1) / e.spec.fps, 3),
            "rows": e.num_rows,
        }
        what |= {
            "instruction": e.instruction,
            "success": e.success,
            **e.origin.record(),
        }
        what |= {"findings": [dataclasses.asdict(f) for f in found]}
        episodes.append(what | {"timing": [dataclasses.asdict(t) for t in e.timing]})
    entry = _entry(*_outcome(cut, wrong, recording.damage))
    bad_rows = sum(e["rows"] for e in episodes if e["outcome"] == "quarantined")
    entry["rows_lost"] = sum(loss.rows for loss in cut.losses if loss.wanted) + bad_rows
    entry |= {
        "samples": cutter.samples,
        "episodes": episodes,
        "findings": [dataclasses.asdict(f) for f in across],
    }
    entry["losses"] = [dataclasses.asdict(loss) for loss in cut.losses]
    entry["damage"] = [
        {**dataclasses.asdict(d), "file": Path(d.file).name} for d in recording.damage
    ]
    entry |= {
        "unprotected": recording.reader.unprotected,
        "messages": dict(sorted(recording.counts.items())),
    }
    return good, entry


def _outcome(
    cut: Cut, errors: Sequence[Finding | None], damage: Sequence[Damage]
) -> tuple[Outcome, str]:
    """Outcome of a recording and its reasons, the most important one first."""
    wrong = [f"{f.feature}: {f.text}" for f in errors if f is not None]
    gone = [str(d) for d in damage if d.lost]
    lost = [
        _describe(loss) for loss in cut.losses if loss.wanted and not loss.within_slack
    ]
    trimmed = [_describe(loss) for loss in cut.losses if loss.within_slack]
    left_out = [_describe(loss) for loss in cut.losses if not loss.wanted]
    if wrong and len(errors) > 1:
        wrong[0] = f"{len(wrong)} of {len(errors)} episodes quarantined: {wrong[0]}"
    if len(wrong) == len(errors):
        return "quarantined", _first_of([wrong[:1], gone, lost, left_out]) or "no rows"
    if wrong or lost or gone:
        return "split", _first_of([wrong[:1], gone, lost])
    failures = sum(e.success is False for e in cut.episodes)
    notes = [f"{len(left_out)} discarded by the operator"] if left_out else []
    notes += [f"{failures} marked as failure (success: false)"] if failures else []
    notes += [_first_of([trimmed])] if trimmed else []
    return "written", "; ".join([*notes, *(f"nothing lost; {d}" for d in damage[:1])])


def _first_of(kinds: list[list[str]]) -> str:
    """The first reason of each kind, and how many there are besides."""
    told = [reasons[0] for reasons in kinds if reasons][:2]
    more = sum(map(len, kinds)) - len(told)
    return "; ".join(told) + (f"; {more} more in the report" if more > 0 else "")


def _describe(loss: Loss) -> str:
    end = f" to {loss.end_s:.2f}" if loss.start_s != loss.end_s else ""
    return f"{loss.start_s:.2f}{end} s: {loss.reason}"


def _entry(outcome: Outcome, reason: str) -> dict[str, Any]:
    lists = {key: [] for key in ("episodes", "findings", "losses")}
    return {
        "outcome": outcome,
        "reason": reason,
        "rows_lost": 0,
        **lists,
        "samples": {},
        "damage": [],
    }


# ---- the dataset ----


def _report(jobs: Sequence[Job], entries: list[dict[str, Any]]) -> dict[str, Any]:
    episodes = [e for entry in entries for e in entry["episodes"]]
    written = [e for e in episodes if e["outcome"] == "written"]
    for index, episode in enumerate(written):
        episode["index_in_dataset"] = index
    return {
        "report_version": 1,
        "dry_run": any(job.dry_run for job in jobs),
        "dataset_spec": jobs[0].spec.target.name,
        "outcomes": {
            o: sum(e["outcome"] == o for e in entries)
            for o in ("written", "split", "quarantined", "refused")
        },
        "episodes": len(written),
        "episodes_quarantined": sum(e["outcome"] == "quarantined" for e in episodes),
        "rows": sum(e["rows"] for e in written),
        "recordings": entries,
    }


def _assemble(
    spec: RecordingSpec,
    report: dict[str, Any],
    entries: list[dict[str, Any]],
    shards: list[Path],
    folder: Path,
) -> None:
    """Stage ``dataset``: the shards merged, with their provenance in meta/taccorl/."""
    from taccorl.data.lerobot_format import merge

    merge([shard / "dataset" for shard in shards], folder)
    meta, records = folder / PROVENANCE, []
    with_rows = [
        e for e in entries if any(x["outcome"] == "written" for x in e["episodes"])
    ]
    for entry, shard in zip(with_rows, shards, strict=True):
        named = {
            "recording": entry["recording"],
            "part": entry["part"],
            "source_digest": entry["source_digests"][0],
        }
        records += [
            {**record, **named}
            for record in json.loads((shard / "episodes.json").read_text())
        ]
    write_records(folder, records)
    _dump(meta / "ingest_report.json", report)
    _dump(meta / "dataset_spec.json", dataset_spec_to_json(spec.target))
    _dump(
        meta / "recording_spec.json",
        dataclasses.asdict(dataclasses.replace(spec, contract=None)),
    )


def _dump(path: Path, value: Any) -> None:
    path.write_text(
        json.dumps(value, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )
