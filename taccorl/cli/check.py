"""``taccorl check PATH [--spec=piper_flexitac_mcap]``: find faults of a recording or a dataset.

A recording is read by its spec, if none is given by the shipped one that fits its topics. A dataset is checked against the spec
that is stored in it; with --spec=SPEC of the reader lerobot, its episodes are checked as recordings, before they are ingested by
that spec.
"""

import dataclasses
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taccorl.cli.ingest import chosen_spec
from taccorl.cli.parse import verb
from taccorl.cli.printed import give
from taccorl.data.file_kinds import no_recording
from taccorl.data.finding import LEAVE_OUT, Finding, leave_out, listed, not_judged
from taccorl.errors import TaccorlError, no_such_path
from taccorl.extras import missing
from taccorl.report.findings import found_in
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.data.cutting import Cutter
    from taccorl.data.dataset import Dataset

MOST_PROBED = 12
"""Most episodes of which LeRobot reads the first and last row."""


@dataclass(kw_only=True)
class CheckConfig:
    """Find faults of a recording or a dataset."""

    path: Path
    """A LeRobot dataset's folder, or a recording (file, bag folder, folder of recordings)."""
    spec: str | None = None
    """Recording spec; chosen by the topics if not given. With a spec of the reader lerobot, episodes of a dataset are checked as
    recordings."""
    pictures: bool = True
    """Also decode every picture, to find frozen cameras; takes a few seconds per episode."""
    quick: bool = False
    """Of a dataset, neither read all files to compare them with the digests in its manifest nor load it with LeRobot."""
    repair: Path | None = None
    """Write a copy of a dataset to this new folder, with the time stamps, indices, totals and statistics that its rows must
    have. The dataset itself is not changed."""


@verb(CheckConfig, positional="path")
def run(config: CheckConfig) -> int:
    """Check a dataset or recordings, and print the findings. Returns the exit status, 0: notes at most, 1: warnings or errors."""
    if config.repair is not None:
        return _repair(config)
    if (config.path / "meta" / "info.json").is_file() and config.spec is None:
        return _check_dataset(config)
    if not config.path.exists():
        raise TaccorlError(no_such_path(config.path))
    if config.spec is None:
        if what := no_recording(config.path):
            raise TaccorlError(f"{config.path}: {what}")
        config = dataclasses.replace(config, spec=chosen_spec([config.path]))
    return _check_recordings(config)


def _repair(config: CheckConfig) -> int:
    """Write the copy and check it."""
    from taccorl.data.dataset import Dataset
    from taccorl.data.dataset_checks import repair

    assert config.repair is not None
    repair(Dataset(config.path), config.repair)
    print(f"dataset: {config.repair}")
    return _check_dataset(dataclasses.replace(config, path=config.repair, repair=None))


def _why(error: TaccorlError | MemoryError) -> str:
    return (
        f"reading it takes more memory than there is ({error})"
        if isinstance(error, MemoryError)
        else str(error)
    )


def _probes(dataset: "Dataset") -> list[int]:
    """First and last row of the first, the last and some episodes between them."""
    number = dataset.num_episodes
    some = (
        sorted(
            {round(k * (number - 1) / (MOST_PROBED - 1)) for k in range(MOST_PROBED)}
        )
        if number
        else []
    )
    first = list(
        itertools.accumulate((dataset.num_rows(i) for i in range(number)), initial=0)
    )
    return sorted(
        {
            row
            for i in some
            if dataset.num_rows(i)
            for row in (first[i], first[i + 1] - 1)
        }
    )


def _bookkeeping(dataset: "Dataset", quick: bool) -> list[Finding]:
    """On what LeRobot reads beside the features, and whether it can."""
    from taccorl.data.dataset_checks import check_bookkeeping, check_statistics
    from taccorl.data.lerobot_format import read_as_lerobot

    findings = []
    for check in (check_bookkeeping, check_statistics):
        try:
            findings += check(dataset)
        except (TaccorlError, MemoryError) as error:  # LeRobot reads all rows, too
            return [*findings, Finding("unreadable", "error", "rows", _why(error))]
    why = (
        "--quick=true"
        if quick
        else "its pictures are only in the cache of training" * bool(dataset.unstored)
    )
    if why := why or missing("lerobot"):
        return [*findings, not_judged("dataset", "whether LeRobot loads it", why)]
    problems = read_as_lerobot(dataset.root, _probes(dataset))
    text = "; ".join(problems[:1]) + (
        f" ({len(problems)} such rows)" if len(problems) > 1 else ""
    )
    return [
        *findings,
        *([Finding("lerobot", "error", "dataset", text)] if problems else []),
    ]


def _check_dataset(config: CheckConfig) -> int:
    from taccorl.cli.progress import Bars
    from taccorl.data.checks import check_episode, check_recording_episodes
    from taccorl.data.dataset import Dataset
    from taccorl.data.episode import Episode
    from taccorl.report.terminal import show

    if not missing("av"):
        import av.logging

        av.logging.set_libav_level(
            av.logging.FATAL
        )  # what is wrong with a video is said below, in our words
    stored = [] if config.quick else _stored_findings(config.path)
    worst = _worst(stored)
    if worst:  # said before a changed file may prevent the rest
        show(found_in(f"{config.path}: files", stored))
    dataset = Dataset(config.path)
    findings = [] if worst else stored
    findings += _bookkeeping(dataset, config.quick)
    findings += [
        Finding("video_count", "error", "video", text)
        for text in dataset.video_problems()
    ]
    findings += [
        Finding("skipped_feature", "note", key, f"{key}: {why}")
        for key, why in dataset.skipped.items()
    ]
    episodes: dict[int, Episode] = {}
    for index in range(dataset.num_episodes):
        try:
            episodes[index] = dataset.episode(index)
        except (TaccorlError, MemoryError) as error:
            findings.append(Finding("unreadable", "error", "rows", _why(error)))
    findings += check_recording_episodes([*episodes.values()])
    show(found_in(str(config.path), findings))
    worst = max(worst, _worst(findings))
    checked = []
    with Bars(len(episodes), f"checking {len(episodes)} episodes") as bars:
        for done, (number, episode) in enumerate(episodes.items()):
            bars.update(f"episode {number}", done, len(episodes))
            try:
                found = check_episode(episode, pictures=config.pictures)
            except (
                TaccorlError,
                MemoryError,
            ) as error:  # a video without its rows: the other episodes may be sound
                found = [Finding("unreadable", "error", "video", _why(error))]
            for k, f in enumerate(found):
                if LEAVE_OUT in f.text:
                    text = f.text.replace(
                        LEAVE_OUT, leave_out(config.path.resolve(), number)
                    )
                    found[k] = dataclasses.replace(f, text=text)
            checked.append((f"  episode {number}: {episode.num_rows} rows", found))
    show(*(found_in(label, found) for label, found in checked))
    every = dict.fromkeys([*stored, *findings])
    _give([(str(config.path), [*every]), *checked])
    return max(worst, *(_worst(found) for _, found in checked), 0)


def _stored_findings(folder: Path) -> list[Finding]:
    """On files that are not what was stored."""
    from taccorl.lineage.errors import LineageError
    from taccorl.lineage.manifest import verify

    try:
        found = verify(folder)
    except LineageError as error:
        return [Finding("damaged_manifest", "error", "files", str(error))]
    if found is None:
        text = "no manifest of taccorl lies in meta/taccorl"
        if (
            folder / "meta" / "taccorl" / "episodes.json"
        ).is_file():  # a spec alone may be the user's
            text += ", although taccorl wrote this dataset: copy it again"
            return [Finding("no_manifest", "warning", "files", text)]
        return [not_judged("files", "whether files are as they were written", text)]
    if (
        found.changed == ("meta/stats.json",)
        and not found.missing + found.unreadable
        and _same_pictures(folder)
    ):
        text = "meta/stats.json was computed anew since (lerobot-edit-dataset recompute_stats); it is compared with the rows"
        return [Finding("changed_statistics", "note", "files", text)]
    advice = "copy the dataset again, or make it again from its sources"
    findings = []
    for check, names, what in (
        ("changed_file", found.changed, "are not what was written (SHA-256)"),
        ("missing_file", found.missing, "are missing"),
        ("unreadable_file", found.unreadable, "cannot be read"),
    ):
        if names:
            text = f"{len(names)} of {found.num_files} files {what}: {listed([*names])}; {advice}"
            findings.append(Finding(check, "error", "files", text))
    return findings or [
        Finding(
            "verified",
            "note",
            "files",
            f"all {found.num_files} files are as they were written",
        )
    ]


def _same_pictures(folder: Path) -> bool:
    """Whether the statistics of pictures, which nothing else compares, are those that LeRobot's recompute_stats leaves."""
    import numpy as np

    from taccorl.data.dataset import Dataset
    from taccorl.data.lerobot_format import picture_statistics

    try:
        stated = json.loads(
            (folder / "meta" / "stats.json").read_text(encoding="utf-8")
        )
        due = picture_statistics(folder, Dataset(folder).spec.keys("video"))
        return all(
            np.allclose(stated[k][n], v, 1e-3, 1e-6)
            for k, of in due.items()
            for n, v in of.items()
        )
    except (TaccorlError, ValueError, KeyError, TypeError):
        return False


def _check_recordings(config: CheckConfig) -> int:
    from taccorl.cli.progress import Bars
    from taccorl.data.cutting import BrokenPicture, Cutter
    from taccorl.data.recording import find_sources, opened
    from taccorl.data.spec import load_recording_spec
    from taccorl.report.terminal import show

    assert config.spec is not None
    spec = load_recording_spec(config.spec)
    if (config.path / "meta" / "info.json").is_file() and spec.reader != "lerobot":
        raise TaccorlError(
            f"{config.path}: is a LeRobot dataset; --spec={config.spec} is of {spec.reader} recordings. Leave --spec out: a "
            "dataset is checked against the spec that is stored in it"
        )
    skipped: list[str] = []
    sources = find_sources(
        config.path, reader=spec.reader, split_bag=spec.split_bag, skipped=skipped
    )
    show(Section(text=[f"not read: {line}" for line in skipped]))
    checked: list[tuple[str, list[Finding]]] = []
    with Bars(len(sources)) as bars:
        for k, (_, source) in enumerate(sources):
            bars.update(source.name, k, len(sources))
            try:
                with opened(source, spec) as recording:
                    cutter = Cutter(recording)
                    try:
                        checked += _recording_findings(cutter, config.pictures)
                    except (
                        BrokenPicture
                    ):  # as ingest does: leave it out, look at the rest
                        cutter.drop_broken_pictures()
                        checked += _recording_findings(cutter, config.pictures)
            except (TaccorlError, MemoryError) as error:
                checked.append(
                    (source.name, [Finding("unreadable", "error", "file", _why(error))])
                )
    show(*(found_in(label, findings) for label, findings in checked))
    _give(checked)
    return max((_worst(findings) for _, findings in checked), default=0)


def _recording_findings(
    cutter: "Cutter", pictures: bool
) -> list[tuple[str, list[Finding]]]:
    """(what, findings): the recording first, then each of its episodes."""
    from taccorl.data.checks import check_episode, check_recording_episodes

    recording, cut = cutter.recording, cutter.cut()
    findings = [
        Finding("damage", "warning" if d.lost else "note", "file", str(d))
        for d in recording.damage
    ]
    for channel, times_s in cutter.broken_pictures_s.items():
        text = f"{channel}: {len(times_s)} pictures do not decode, first at {times_s[0]:.2f} s"
        findings.append(Finding("broken_picture", "warning", channel, text))
    for loss in cut.losses:
        text = f"{loss.start_s:.2f} to {loss.end_s:.2f} s: {loss.reason}"
        findings.append(
            Finding(
                "lost",
                "warning" if loss.wanted and not loss.within_slack else "note",
                "rows",
                text,
            )
        )
    findings += check_recording_episodes(cut.episodes) if len(cut.episodes) > 1 else []
    found = [(recording.source.name, findings)]
    for episode in cut.episodes:
        label = episode.name.removeprefix(recording.source.name).strip() or "episode"
        label = f"  {label}: {episode.num_rows} rows, {episode.instruction!r}"
        found.append((label, check_episode(episode, pictures=pictures)))
    findings += cutter.size_findings()
    return found


def _give(checked: Sequence[tuple[str, list[Finding]]]) -> None:
    """Findings as the report of ``--json``."""

    def as_json() -> list[dict[str, Any]]:
        return [
            {"name": label.strip(), "findings": [*map(dataclasses.asdict, found)]}
            for label, found in checked
        ]

    give(as_json)


def _worst(findings: list) -> int:
    return int(any(f.severity in ("error", "warning") for f in findings))
