"""Dataset card: ``README.md`` beside ``meta/``, in the form that the Hugging Face Hub shows, with a picture in ``.card/``.

It states facts from the dataset's own files: origin, features with units, size, checks. Missing facts, such as a
licence, are not filled in. The card belongs to no digest, and its owner may edit it.
"""

import itertools
import json
import os
import shlex
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from taccorl.data.dataset import BOOKKEEPING, PROVENANCE, Dataset
from taccorl.data.finding import listed
from taccorl.data.origin import Domain, Origin
from taccorl.data.spec import FeatureSpec
from taccorl.errors import printable
from taccorl.lineage.manifest import CARD
from taccorl.report.markdown import code, escaped, markdown
from taccorl.report.section import Cell, Section
from taccorl.views.contact_sheet import draw_sheet

PICTURE = ".card/episode_0.jpg"
SHEET_WIDTH_PX = 1200
"""Largest width of the card's picture [pixels]."""
DOMAIN_TAGS: dict[Domain | None, str] = {
    "real": "real",
    "surrogate": "surrogate",
    "twin": "simulated",
}
"""Domain → tag of the card."""
MOST_INSTRUCTIONS = 8
"""Most instructions that a card lists."""


def write_card(root: Path) -> Path | None:
    """Write the card of the dataset at ``root``; returns its path, or None if there is a README.md, which is not changed.
    Raises DatasetError: it is not a complete LeRobot dataset. Raises OSError: the folder cannot be written."""
    path, picture = root / CARD, root / PICTURE
    temp = picture.with_name(CARD)
    if os.path.lexists(path):
        temp.unlink(missing_ok=True)  # of a run that died
        return None
    dataset = Dataset(root)
    text, sheet = card_text(dataset), draw_sheet(dataset.episode(0))
    if sheet.width > SHEET_WIDTH_PX:
        size = SHEET_WIDTH_PX, round(sheet.height * SHEET_WIDTH_PX / sheet.width)
        sheet = sheet.resize(size, Image.Resampling.LANCZOS)
    picture.parent.mkdir(exist_ok=True)
    sheet.save(picture, optimize=True, quality=85)
    try:
        temp.write_text(text, encoding="utf-8")
        os.link(temp, path)  # unlike a rename, never over a file that came meanwhile
    except FileExistsError:
        return None
    finally:
        temp.unlink(missing_ok=True)
    return path


def card_text(dataset: Dataset) -> str:
    """Text of the dataset card: Markdown, below the YAML front matter that the Hugging Face Hub reads."""
    origins = Counter(
        dataset.episode_facts(i)["origin"] for i in range(dataset.num_episodes)
    )
    front = yaml.safe_dump(
        _front_matter(dataset, origins), sort_keys=False, allow_unicode=True
    )
    said = "; ".join(escaped(origin) for origin in origins)
    shown = f"![Episode 0: pictures and pads at six instants, grippers and touch over time]({PICTURE})"
    body = markdown(
        Section(text=[f"Data: {said}"], style="data"),
        Section(text=_summary(dataset), notes=[shown]),
        _features(dataset),
        _origin(dataset, origins),
        Section(title="Checks", text=_checks(dataset)),
    )
    return f"---\n{front}---\n\n# {escaped(dataset.root.resolve().name)}\n\n{body}\n\n## Use\n\n{_use(dataset)}\n"


def _front_matter(dataset: Dataset, origins: Counter[Origin]) -> dict[str, Any]:
    """As LeRobot's own card, without a licence: its owner adds that."""
    kinds = dict.fromkeys(
        DOMAIN_TAGS[origin.domain] for origin in origins if origin.domain
    )
    tags = [
        "LeRobot",
        "taccorl",
        *["tactile"] * bool(dataset.spec.keys("tactile")),
        *kinds,
        dataset.spec.robot_type,
    ]
    return {
        "task_categories": ["robotics"],
        "tags": [tag for tag in dict.fromkeys(tags) if tag],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }


def _summary(dataset: Dataset) -> list[str]:
    spec, rows = (
        dataset.spec,
        sum(dataset.num_rows(i) for i in range(dataset.num_episodes)),
    )
    outcomes = Counter(
        dataset.episode_facts(i).get("success") for i in range(dataset.num_episodes)
    )
    words = {True: "success", False: "failure", None: "not stated"}
    said = ", ".join(
        f"{num} {words[outcome]}" for outcome, num in outcomes.most_common()
    )
    texts, seconds = [f"*{escaped(x)}*" for x in dataset.instructions], rows / spec.fps
    duration = (
        f"{seconds / 3600:.2f} hours"
        if seconds >= 360
        else f"{seconds / 60:.1f} minutes"
    )
    size = f"{_count(dataset.num_episodes, 'episode')}, {rows} rows at {spec.fps} a second, {duration}"
    return [
        f"{size}; outcomes: {said}",
        f"robot: {escaped(spec.robot_type)}; data spec {escaped(spec.name)}",
        f"instruction{'s' if len(texts) > 1 else ''}: {listed(texts, MOST_INSTRUCTIONS)}",
        "format: [LeRobot](https://github.com/huggingface/lerobot) "
        f"{escaped(dataset.info['codebase_version'])}, written by taccorl",
    ]


def _count(num: int, what: str) -> str:
    return f"{num} {what}{'s' * (num != 1)}"


def _features(dataset: Dataset) -> Section:
    rows = []
    for key, told in dataset.info["features"].items():
        if key not in BOOKKEEPING:
            feature = dataset.spec.features.get(key)
            content = (
                _unit_and_content(dataset, key, feature)
                if feature
                else ("", dataset.skipped.get(key, ""))
            )
            rows.append(
                [
                    Cell(key, "code"),
                    f"{told['dtype']} [{' × '.join(map(str, told['shape']))}]",
                    *content,
                ]
            )
    return Section(
        title="Features", heads=("feature", "type", "unit", "what"), rows=rows
    )


def _unit_and_content(
    dataset: Dataset, key: str, feature: FeatureSpec
) -> tuple[str, str]:
    if feature.dtype == "video":
        codec = (dataset.info["features"][key].get("info") or {}).get("video.codec", "")
        return "", f"RGB {codec}".rstrip()
    if sensor := dataset.spec.sensors.get(key):
        history = f", last {feature.history} readings" if feature.history > 1 else ""
        return feature.unit if isinstance(feature.unit, str) else "", (
            f"{sensor.name}: {len(feature.pads)} pads ({', '.join(feature.pads)}) of {sensor.rows} × {sensor.columns} "
            f"taxels{history}; counts above baseline, reading = counts × {sensor.gain_per_count:.4g} ({sensor.scheme})"
        )
    runs = [(unit, len(list(run))) for unit, run in itertools.groupby(feature.units)]
    units = ", ".join(f"{num} {unit}" if len(runs) > 1 else unit for unit, num in runs)
    names = list(feature.names)
    shown = ", ".join(names) if len(names) <= 3 else f"{names[0]} … {names[-1]}"
    return units, shown


def _origin(dataset: Dataset, origins: Counter[Origin]) -> Section:
    rows, notes = [[str(origin), str(num)] for origin, num in origins.most_common()], []
    for part in _read(dataset, "cotrain.json", []):
        kind = "simulated" if part["is_sim"] else "given as real"
        rows.append([f"{kind}: {Path(part['dataset']).name}", str(part["episodes"])])
    if any(origin.domain is None for origin in origins):
        notes.append(
            "Where the domain is not stated, nothing here says whether a robot or a simulator made the data."
        )
    if manifest := dataset.provenance:
        software = ", ".join(
            f"{name} {v}"
            for name, v in manifest["software"].items()
            if name in _SHAPED_BY
        )
        sources = len(manifest.get("sources", []))
        made_of = (
            _count(sources, "file")
            if sources
            else f"{_count(len(manifest['inputs']), 'result')} of other stages"
        )
        notes.append(
            f"Made by stage {code(manifest['stage'])} from {made_of}, with {escaped(software)}. "
            f"{code(f'taccorl lineage explain {_quoted(dataset)}')} shows what it was made from, down to the raw files."
        )
    return Section(
        title="Origin",
        heads=("domain: origin", "episodes"),
        rows=rows,
        right=(1,),
        notes=notes,
    )


_SHAPED_BY = ("taccorl", "lerobot", "mujoco")


def _checks(dataset: Dataset) -> list[str]:
    lines = []
    if report := _read(dataset, "ingest_report.json", None):
        outcomes = ", ".join(
            f"{num} {escaped(outcome)}" for outcome, num in report["outcomes"].items()
        )
        lines.append(
            f"recordings: {outcomes}; {report['episodes_quarantined']} episodes quarantined"
        )
        found = Counter((f["severity"], f["check"]) for f in _findings(report))
        named = [
            f"{escaped(severity)} {code(check)} ({num})"
            for (severity, check), num in sorted(found.items())
        ]
        lines.append(f"findings in its episodes: {', '.join(named) or 'none'}")
    if report := _read(dataset, "collect_report.json", None):
        if "attempts" in report and "outcomes" in report:
            outcomes = ", ".join(
                f"{num} {escaped(outcome)}"
                for outcome, num in report["outcomes"].items()
            )
            lines.append(f"{_count(report['attempts'], 'attempt')}: {outcomes}")
        if report.get("dropped"):
            dropped = ", ".join(
                f"{num} {escaped(outcome)}"
                for outcome, num in report["dropped"].items()
            )
            lines.append(
                f"left out, because they did not succeed when they were executed: {dropped}"
            )
    if dataset.spec.keys("video"):
        lines.append("every row had a video frame of its own when it was written")
    command = code(f"taccorl check {_quoted(dataset)}")
    return [
        *lines,
        f"{command} compares all files with their digests and looks at timing, joints, pictures and touch",
    ]


def _findings(report: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for recording in report["recordings"]:
        yield from recording["findings"]
        for episode in recording["episodes"]:
            if episode["outcome"] == "written":
                yield from episode["findings"]


def _use(dataset: Dataset) -> str:
    name, quoted = printable(dataset.root.resolve().name), _quoted(dataset)
    own = f"--policy.push_to_hub=false --dataset.repo_id={shlex.quote(f'local/{name}')} --dataset.root={quoted}"
    train = f"lerobot-train --policy.type=act {own}"  # a policy that refuses data without pictures
    lines = [
        "```python",
        "from lerobot.datasets import LeRobotDataset",
        "",
        f"dataset = LeRobotDataset({f'local/{name}'!r}, root={name!r})",
        "```",
        "```",
        *([train] if dataset.spec.keys("video") else []),
        f"taccorl view {quoted} --episode=0",
        "```",
    ]
    if dataset.unstored:
        lines = [
            "```",
            f"lerobot-train --policy.type=tactile_pi05 --policy.backbone=small {own} --dataset.cache=gpu "
            "--dataset.cache_store=STORE --policy.image_resolution=[ROWS,COLUMNS]",
            f"taccorl view {quoted} --episode=0",
            "```",
            "",
            "It has no videos: its pictures are in the frame cache (STORE) of the machine that made it, at ROWS × COLUMNS.",
        ]
    repository, version = f"USER/{name}", dataset.info["codebase_version"]
    upload = f"hf upload {repository} {quoted} --repo-type=dataset"
    tag = f"hf repos tag create {repository} {version} --repo-type=dataset"
    publish = (
        f"{code(upload)}, then {code(tag)}, publish it with this card (LeRobot's `push_to_hub` "
        "writes its own card). Its licence is not stated here: add `license:` at the top."
    )
    return "\n".join([*lines, "", publish])


def _quoted(dataset: Dataset) -> str:
    return shlex.quote(printable(dataset.root.resolve().name))


def _read(dataset: Dataset, name: str, default: Any) -> Any:
    path = dataset.root / PROVENANCE / name
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else default
