"""``taccorl check PATH [--spec=piper_flexitac_mcap]``: what is wrong with a recording or a dataset.

A recording needs its spec; a dataset is checked against the spec it carries.
"""

from dataclasses import dataclass
from pathlib import Path

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError


@dataclass(kw_only=True)
class CheckConfig:
    """What is wrong with a recording or a dataset."""

    path: Path
    """A LeRobot dataset's folder, or a recording (file, bag folder, folder of recordings)."""
    spec: str | None = None
    """Recording spec; needed for recordings."""
    pictures: bool = True
    """Look at every picture, too: finds frozen ones, takes a few seconds an episode."""


def main(argv: list[str]) -> int:
    """0: nothing worse than a note; 1: warnings or errors."""
    config = parse(CheckConfig, argv, positional="path")
    if (config.path / "meta" / "info.json").is_file() and config.spec is None:
        return _check_dataset(config)
    if config.spec is None:
        raise TaccorlError(
            f"{config.path} is no LeRobot dataset; for a recording give --spec=… (`taccorl ingest inspect` helps)"
        )
    return _check_recordings(config)


def _check_dataset(config: CheckConfig) -> int:
    from taccorl.cli.tables import findings_table
    from taccorl.data.checks import Finding, check_episode, check_recording_episodes
    from taccorl.data.dataset import Dataset

    dataset = Dataset(config.path)
    findings = [Finding("video_count", "error", "video", text) for text in dataset.video_problems()]
    findings += [Finding("skipped_feature", "note", key, f"{key}: {why}") for key, why in dataset.skipped.items()]
    episodes = [dataset.episode(i) for i in range(dataset.num_episodes)]
    findings += check_recording_episodes(episodes) if len(episodes) > 1 else []
    findings_table(str(config.path), findings)
    worst = _worst(findings)
    for episode in episodes:
        found = check_episode(episode, pictures=config.pictures)
        findings_table(f"  episode {episodes.index(episode)}: {episode.num_rows} rows", found)
        worst = max(worst, _worst(found))
    return worst


def _check_recordings(config: CheckConfig) -> int:
    from taccorl.cli.tables import findings_table
    from taccorl.data.checks import Finding, check_episode, check_recording_episodes
    from taccorl.data.cutting import Cutter
    from taccorl.data.recording import find_sources, opened
    from taccorl.data.spec import load_recording_spec

    assert config.spec is not None
    spec = load_recording_spec(config.spec)
    worst = 0
    for _, source in find_sources(config.path, reader=spec.reader, split_bag=spec.split_bag):
        try:
            with opened(source, spec) as recording:
                cut = Cutter(recording).cut()
                findings = [Finding("damage", "warning", "file", str(d)) for d in recording.damage]
                for loss in cut.losses:
                    severity = "warning" if loss.wanted else "note"
                    findings.append(
                        Finding("lost", severity, "rows", f"{loss.start_s:.2f} to {loss.end_s:.2f} s: {loss.reason}")
                    )
                findings += check_recording_episodes(cut.episodes) if len(cut.episodes) > 1 else []
                findings_table(source.name, findings)
                worst = max(worst, _worst(findings))
                for episode in cut.episodes:
                    found = check_episode(episode, pictures=config.pictures)
                    label = episode.name.removeprefix(source.name).strip() or "episode"
                    findings_table(f"  {label}: {episode.num_rows} rows, {episode.instruction!r}", found)
                    worst = max(worst, _worst(found))
        except TaccorlError as error:
            findings_table(source.name, [Finding("unreadable", "error", "file", str(error))])
            worst = 1
    return worst


def _worst(findings: list) -> int:
    return int(any(f.severity in ("error", "warning") for f in findings))
