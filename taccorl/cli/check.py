"""``taccorl check PATH [--spec=piper_flexitac_mcap]``: find faults of a recording or a dataset.

A recording is read by its spec, if none is given by the shipped one that fits its topics. A dataset is checked against the spec
that is stored in it; with --spec=SPEC of the reader lerobot, its episodes are checked as recordings, before they are ingested by
that spec.
"""

import dataclasses
import json
import shlex
from collections.abc import Iterator, Sequence
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
    from taccorl.data.episode import Episode

MOST_PROBED = 12
"""Most episodes of which the first and last row are read as in training."""


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
    """Of a dataset, do not read all files to compare them with the digests in its manifest."""
    lerobot: bool = False
    """Of a dataset, also load it with LeRobot, as training does: at least 10 CPU-s and 1 GB. Without, its tables and some of its
    pictures are compared with what LeRobot requires."""
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
        raise TaccorlError(no_such_path(config.path) + _of_hub(config.path))
    if config.spec is None:
        if what := no_recording(config.path):
            raise TaccorlError(f"{config.path}: {what}")
        config = dataclasses.replace(config, spec=chosen_spec([config.path]))
    return _check_recordings(config)


def _of_hub(path: Path) -> str:
    """Words on a path that may be the name of a dataset on Hugging Face's Hub, OWNER/NAME; empty for any other."""
    if path.is_absolute() or len(path.parts) != 2 or path.parts[0] in (".", ".."):
        return ""
    got = f"hf download {shlex.quote(str(path))} --repo-type=dataset --local-dir={shlex.quote(path.name)}"
    return f". Names on the Hub are not fetched: `{got}`, then `taccorl check {shlex.quote(path.name)}`"


def _repair(config: CheckConfig) -> int:
    """Write the copy and check it."""
    from taccorl.data.dataset import Dataset
    from taccorl.data.dataset_checks import repair

    assert config.repair is not None
    dataset = Dataset(config.path, partial=True)
    repair(dataset, config.repair)
    kept, told = dataset.num_episodes, dataset.info["total_episodes"]
    if kept < told:
        lost = [str(k) for k in range(kept, told)]
        print(
            f"lost:    episodes {', '.join(lost)}, of which meta/episodes says nothing"
        )
    print(f"dataset: {config.repair}")
    return _check_dataset(dataclasses.replace(config, path=config.repair, repair=None))


def _why(error: TaccorlError | MemoryError) -> str:
    return (
        f"reading it takes more memory than there is ({error})"
        if isinstance(error, MemoryError)
        else str(error)
    )


def _probed(dataset: "Dataset") -> list[int]:
    """The first, the last and some episodes between them, of those that have rows."""
    last, steps = max(dataset.num_episodes - 1, 0), MOST_PROBED - 1
    some = sorted({round(k * last / steps) for k in range(MOST_PROBED)})
    return [i for i in some if i < dataset.num_episodes and dataset.num_rows(i)]


def _bookkeeping(dataset: "Dataset", config: CheckConfig) -> list[Finding]:
    """On what LeRobot reads beside the features, and whether it can."""
    from taccorl.data.dataset_checks import check_bookkeeping, check_statistics

    findings = []
    for check in (check_bookkeeping, check_statistics):
        try:
            findings += check(dataset)
        except (TaccorlError, MemoryError) as error:  # LeRobot reads all rows, too
            return [*findings, Finding("unreadable", "error", "rows", _why(error))]
    return findings + _loading(dataset, config)


def _loading(dataset: "Dataset", config: CheckConfig) -> list[Finding]:
    """On whether LeRobot can load a dataset: by LeRobot itself where that is asked for."""
    from taccorl.data.lerobot_format import loading_problems, read_as_lerobot

    probed, findings = _probed(dataset), list[Finding]()
    if config.lerobot and dataset.unstored:
        why = "its pictures are only in the cache of training"
        findings = [not_judged("dataset", "whether LeRobot loads it", why)]
    elif config.lerobot and (why := missing("lerobot")):
        findings = [not_judged("dataset", "whether LeRobot loads it", why)]
    elif config.lerobot:
        ends = [(dataset.first_row(i), dataset.num_rows(i)) for i in probed]
        rows = {row for first, n in ends for row in (first, first + n - 1)}
        problems = read_as_lerobot(dataset.root, sorted(rows))
        return _of_loading(problems, "such rows")
    problems = loading_problems(dataset, () if config.pictures else probed)
    return findings + _of_loading(problems, "such problems")


def _of_loading(problems: list[str], kind: str) -> list[Finding]:
    if not problems:
        return []
    more = f" ({len(problems)} {kind})" if len(problems) > 1 else ""
    return [Finding("lerobot", "error", "dataset", problems[0] + more)]


def _check_dataset(config: CheckConfig) -> int:
    from taccorl.cli.progress import Bars
    from taccorl.data.checks import check_recording_episodes
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
    findings += _bookkeeping(dataset, config)
    findings += [
        Finding("video_count", "error", "video", text)
        for text in dataset.video_problems()
    ]
    findings += [
        Finding("skipped_feature", "note", key, f"{key}: {why}")
        for key, why in dataset.skipped.items()
    ]
    checked: list[tuple[str, list[Finding]]] = []

    def one_by_one() -> Iterator[Episode]:
        """Check each episode, and hold it no longer than until the next one is read."""
        with Bars(dataset.num_episodes, f"checking {dataset.num_episodes}") as bars:
            for index in range(dataset.num_episodes):
                bars.update(f"episode {index}", index, dataset.num_episodes)
                try:
                    episode = dataset.episode(index)
                except (TaccorlError, MemoryError) as error:
                    unread = Finding("unreadable", "error", "rows", _why(error))
                    findings.append(unread)
                    continue
                label = f"  episode {index}: {episode.num_rows} rows"
                checked.append((label, _of_episode(episode, index, config)))
                yield episode

    across = check_recording_episodes(one_by_one())
    show(found_in(str(config.path), findings + across))
    show(*(found_in(label, found) for label, found in checked))
    every = dict.fromkeys([*stored, *findings, *across])
    _give([(str(config.path), [*every]), *checked])
    severe = [_worst(found) for _, found in checked]
    return max(worst, _worst(findings + across), *severe)


def _of_episode(episode: "Episode", index: int, config: CheckConfig) -> list[Finding]:
    """Findings on one episode of a dataset; those whose remedy is to leave it out name the command that does."""
    from taccorl.data.checks import check_episode

    try:
        found = check_episode(episode, pictures=config.pictures)
    except (TaccorlError, MemoryError) as error:
        # a video without its rows: the other episodes may be sound
        return [Finding("unreadable", "error", "video", _why(error))]
    command = leave_out(config.path.resolve(), index)
    return [
        dataclasses.replace(f, text=f.text.replace(LEAVE_OUT, command)) for f in found
    ]


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
