"""Dataset card: ``README.md`` beside ``meta/``, in the form that the Hugging Face Hub shows, with pictures in ``.card/``.

It states facts from the dataset's own files: origin, features with units, size, coverage, checks. Missing facts, such as a
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

import numpy as np
import yaml
from PIL import Image, ImageDraw

from taccorl.data.dataset import BOOKKEEPING, PROVENANCE, Dataset
from taccorl.data.finding import listed
from taccorl.data.origin import Domain, Origin
from taccorl.data.spec import DatasetSpec, FeatureSpec
from taccorl.errors import printable
from taccorl.lineage.manifest import CARD
from taccorl.report.markdown import markdown
from taccorl.report.section import Cell, Section
from taccorl.views.colors import ARM_COLORS, heat
from taccorl.views.contact_sheet import INK, PAPER, SOFT, draw_sheet, font
from taccorl.views.groups import element_names

PICTURES = ".card"
EPISODE_PICTURE, COVERAGE_PICTURE = f"{PICTURES}/episode_0.jpg", f"{PICTURES}/coverage.png"
SHEET_WIDTH_PX = 1200
"""Largest width of the card's pictures [pixels]."""
LABEL_PX, BARS_PX, MAP_PX, ROW_PX, GAP_PX = 150, 380, 104, 24, 20
LIGHT_BAR = (191, 205, 224)
DOMAIN_TAGS: dict[Domain | None, str] = {"real": "real", "surrogate": "surrogate", "twin": "simulated"}
"""Domain → tag of the card."""
MOST_INSTRUCTIONS = 8
"""Most instructions that a card lists."""


def write_card(root: Path) -> Path | None:
    """Write the card of the dataset at ``root``; returns its path, or None if there is a README.md, which is not changed.
    Raises DatasetError: it is not a complete LeRobot dataset. Raises OSError: the folder cannot be written."""
    path, temp = root / CARD, root / PICTURES / CARD
    if os.path.lexists(path):
        temp.unlink(missing_ok=True)  # of a run that died
        return None
    dataset = Dataset(root)
    pictures = dict(_pictures(dataset))
    text = card_text(dataset, list(pictures))
    (root / PICTURES).mkdir(exist_ok=True)
    for name, image in pictures.items():
        image.save(root / name, optimize=True, quality=85)
    try:
        temp.write_text(text, encoding="utf-8")
        os.link(temp, path)  # unlike a rename, never over a file that came meanwhile
    except FileExistsError:
        return None
    finally:
        temp.unlink(missing_ok=True)
    return path


def card_text(dataset: Dataset, pictures: list[str]) -> str:
    """Return the card as Markdown with YAML front matter; ``pictures`` are the paths of its pictures relative to the dataset."""
    origins = Counter(dataset.episode_facts(i)["origin"] for i in range(dataset.num_episodes))
    front = yaml.safe_dump(_front_matter(dataset, origins), sort_keys=False, allow_unicode=True)
    said = "; ".join(str(origin) for origin in origins)
    body = markdown(
        Section(text=[f"Data: {said}"], style="data"),
        Section(text=_summary(dataset), notes=[f"![{_ALT[name]}]({name})" for name in pictures]),
        _features(dataset),
        _origin(dataset, origins),
        Section(title="Checks", text=_checks(dataset)),
    )
    return f"---\n{front}---\n\n# {printable(dataset.root.resolve().name)}\n\n{body}\n\n## Use\n\n{_use(dataset)}\n"


_ALT = {
    EPISODE_PICTURE: "Episode 0: pictures and pads at six instants, grippers and touch over time",
    COVERAGE_PICTURE: "Coverage: ranges of the joints within their limits, counts of every taxel",
}


def _front_matter(dataset: Dataset, origins: Counter[Origin]) -> dict[str, Any]:
    """As LeRobot's own card, without a licence: its owner adds that."""
    kinds = dict.fromkeys(DOMAIN_TAGS[origin.domain] for origin in origins if origin.domain)
    tags = [
        "LeRobot",
        "taccorl",
        *(["tactile"] if dataset.spec.keys("tactile") else []),
        *kinds,
        dataset.spec.robot_type,
    ]
    return {
        "task_categories": ["robotics"],
        "tags": [tag for tag in dict.fromkeys(tags) if tag],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }


def _summary(dataset: Dataset) -> list[str]:
    spec, rows = dataset.spec, sum(dataset.num_rows(i) for i in range(dataset.num_episodes))
    outcomes = Counter(dataset.episode_facts(i).get("success") for i in range(dataset.num_episodes))
    words = {True: "success", False: "failure", None: "not stated"}
    said = ", ".join(f"{num} {words[outcome]}" for outcome, num in outcomes.most_common())
    texts, seconds = [f"*{text}*" for text in dataset.instructions], rows / spec.fps
    duration = f"{seconds / 3600:.2f} hours" if seconds >= 360 else f"{seconds / 60:.1f} minutes"
    size = f"{_count(dataset.num_episodes, 'episode')}, {rows} rows at {spec.fps} a second, {duration}"
    return [
        f"{size}; outcomes: {said}",
        f"robot: {spec.robot_type}; data spec {spec.name}",
        f"instruction{'s' if len(texts) > 1 else ''}: {listed(texts, MOST_INSTRUCTIONS)}",
        f"format: [LeRobot](https://github.com/huggingface/lerobot) {dataset.info['codebase_version']}, written by taccorl",
    ]


def _count(num: int, what: str) -> str:
    return f"{num} {what}{'s' * (num != 1)}"


def _features(dataset: Dataset) -> Section:
    rows = []
    for key, told in dataset.info["features"].items():
        if key not in BOOKKEEPING:
            feature = dataset.spec.features.get(key)
            content = _unit_and_content(dataset, key, feature) if feature else ("", dataset.skipped.get(key, ""))
            rows.append([Cell(key, "code"), f"{told['dtype']} [{' × '.join(map(str, told['shape']))}]", *content])
    return Section(title="Features", heads=("feature", "type", "unit", "what"), rows=rows)


def _unit_and_content(dataset: Dataset, key: str, feature: FeatureSpec) -> tuple[str, str]:
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
    if any(origin.derived for origin in origins):
        notes.append("Derived: written before taccorl stored domains; the text or the simulator's columns tell it.")
    if any(origin.domain is None for origin in origins):
        notes.append("Where the domain is not stated, nothing here says whether a robot or a simulator made the data.")
    if manifest := dataset.provenance:
        software = ", ".join(f"{name} {v}" for name, v in manifest["software"].items() if name in _SHAPED_BY)
        sources = len(manifest.get("sources", []))
        made_of = _count(sources, "file") if sources else f"{_count(len(manifest['inputs']), 'result')} of other stages"
        notes.append(
            f"Made by stage `{manifest['stage']}` from {made_of}, with {software}. "
            f"`taccorl lineage explain {_quoted(dataset)}` shows what it was made from, down to the raw files."
        )
    return Section(title="Origin", heads=("domain: origin", "episodes"), rows=rows, right=(1,), notes=notes)


_SHAPED_BY = ("taccorl", "lerobot", "mujoco")


def _checks(dataset: Dataset) -> list[str]:
    lines = []
    if report := _read(dataset, "ingest_report.json", None):
        outcomes = ", ".join(f"{num} {outcome}" for outcome, num in report["outcomes"].items())
        lines.append(f"recordings: {outcomes}; {report['episodes_quarantined']} episodes quarantined")
        found = Counter((f["severity"], f["check"]) for f in _findings(report))
        named = [f"{severity} `{check}` ({num})" for (severity, check), num in sorted(found.items())]
        lines.append(f"findings in its episodes: {', '.join(named) or 'none'}")
    if report := _read(dataset, "collect_report.json", None):
        if "attempts" in report and "outcomes" in report:
            outcomes = ", ".join(f"{num} {outcome}" for outcome, num in report["outcomes"].items())
            lines.append(f"{_count(report['attempts'], 'attempt')}: {outcomes}")
        if report.get("dropped"):
            dropped = ", ".join(f"{num} {outcome}" for outcome, num in report["dropped"].items())
            lines.append(f"left out, because they did not succeed when they were executed: {dropped}")
    if dataset.spec.keys("video"):
        lines.append("every row had a video frame of its own when it was written")
    command = f"`taccorl check {_quoted(dataset)}`"
    return [*lines, f"{command} compares all files with their digests and looks at timing, joints, pictures and touch"]


def _findings(report: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for recording in report["recordings"]:
        yield from recording["findings"]
        for episode in recording["episodes"]:
            if episode["outcome"] == "written":
                yield from episode["findings"]


def _use(dataset: Dataset) -> str:
    name, quoted = dataset.root.resolve().name, _quoted(dataset)
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
    publish = (
        f"`hf upload USER/{name} {quoted} --repo-type=dataset`, then `hf repos tag create USER/{name} "
        f"{dataset.info['codebase_version']} --repo-type=dataset`, publish it with this card (LeRobot's `push_to_hub` "
        "writes its own card). Its licence is not stated here: add `license:` at the top."
    )
    return "\n".join([*lines, "", publish])


def _quoted(dataset: Dataset) -> str:
    return shlex.quote(dataset.root.resolve().name)


def _read(dataset: Dataset, name: str, default: Any) -> Any:
    path = dataset.root / PROVENANCE / name
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else default


def _pictures(dataset: Dataset) -> Iterator[tuple[str, Image.Image]]:
    """Path relative to the dataset's folder → picture."""
    sheet, _ = draw_sheet(dataset.episode(0))
    if sheet.width > SHEET_WIDTH_PX:
        sheet = sheet.resize(
            (SHEET_WIDTH_PX, round(sheet.height * SHEET_WIDTH_PX / sheet.width)), Image.Resampling.LANCZOS
        )
    yield EPISODE_PICTURE, sheet
    path = dataset.root / "meta" / "stats.json"
    if path.is_file() and (image := draw_coverage(dataset.spec, json.loads(path.read_text(encoding="utf-8")))):
        yield COVERAGE_PICTURE, image


def draw_coverage(spec: DatasetSpec, stats: dict[str, dict[str, list[float]]]) -> Image.Image | None:
    """Draw the ranges of the state within its limits, and the 99 % quantile of every taxel's counts; None if the dataset has
    neither. ``stats``: content of LeRobot's ``meta/stats.json``, over all rows."""
    ranges, maps = state_ranges(spec, stats), pad_maps(spec, stats)
    if not ranges and not maps:
        return None
    bars_width, map_width = (LABEL_PX + BARS_PX + GAP_PX) * bool(ranges), len(maps) * (MAP_PX + GAP_PX)
    height = 2 * GAP_PX + 2 * ROW_PX + max(len(ranges) * ROW_PX, 3 * MAP_PX * bool(maps))
    image = Image.new("RGB", (GAP_PX + bars_width + map_width, height), PAPER)
    draw = ImageDraw.Draw(image)
    if ranges:
        _draw_ranges(draw, ranges)
    if maps:
        _draw_maps(image, draw, maps, GAP_PX + bars_width)
    return image


def _draw_ranges(draw: ImageDraw.ImageDraw, ranges: dict[str, tuple[float, ...]]) -> None:
    """A bar for every element: its limits, minimum to maximum, and 98 % of all rows."""
    left, top = GAP_PX + LABEL_PX, GAP_PX + ROW_PX
    draw.text((left, GAP_PX), "state within its limits: min to max; 98 % of rows (blue)", INK, font(14))
    for row, (title, (low, q01, q99, high)) in enumerate(ranges.items()):
        y = top + row * ROW_PX
        draw.text((left - 8, y + ROW_PX / 2), title, INK, font(14), anchor="rm")
        draw.rectangle((left, y + 5, left + BARS_PX, y + ROW_PX - 5), outline=SOFT)
        for begin, end, color in ((low, high, LIGHT_BAR), (q01, q99, ARM_COLORS["left"])):
            x0, x1 = (left + BARS_PX * float(np.clip(share, 0, 100)) / 100 for share in (begin, end))
            draw.rectangle((x0, y + 5, max(x1, x0 + 1), y + ROW_PX - 5), fill=color)
    for share in (0, 50, 100):
        y = top + len(ranges) * ROW_PX
        draw.text((left + BARS_PX * share / 100, y + 2), f"{share} %", SOFT, font(13), anchor="mt")


def _draw_maps(image: Image.Image, draw: ImageDraw.ImageDraw, maps: dict[str, np.ndarray], left: int) -> None:
    """Every pad, in one scale of colours."""
    top_count = max(1.0, *(float(values.max()) for values in maps.values()))
    text = f"touch: counts that 99 % of rows do not exceed, 0 to {top_count:.0f}"
    draw.text((left, GAP_PX), text, INK, font(14))
    for k, (name, values) in enumerate(maps.items()):
        x = left + k * (MAP_PX + GAP_PX)
        size = (MAP_PX, round(MAP_PX * values.shape[0] / values.shape[1]))
        if size[1] > 3 * MAP_PX:
            size = (round(3 * MAP_PX * values.shape[1] / values.shape[0]), 3 * MAP_PX)
        picture = Image.fromarray(heat(np.clip(values, 0, None) / top_count)).resize(size, Image.Resampling.NEAREST)
        image.paste(picture, (x, GAP_PX + 2 * ROW_PX))
        draw.text((x + size[0] / 2, GAP_PX + 2 * ROW_PX - 5), name, SOFT, font(13), anchor="ms")


def state_ranges(spec: DatasetSpec, stats: dict[str, dict[str, list[float]]]) -> dict[str, tuple[float, ...]]:
    """Element of the state with finite limits → minimum, 1 % and 99 % quantile, maximum, in % of the range between its limits."""
    key = "observation.state"
    feature, found = spec.features.get(key), stats.get(key, {})
    if feature is None or not {"min", "q01", "q99", "max"} <= set(found):
        return {}
    titles = [f"{name} [{unit}]" for name, unit in zip(element_names(feature), feature.units, strict=True)]
    ranges = {}
    for i, (title, (low, high)) in enumerate(zip(titles, feature.limits, strict=True)):
        if np.isfinite([low, high]).all() and high > low:
            ranges[title] = tuple(100 * (found[name][i] - low) / (high - low) for name in ("min", "q01", "q99", "max"))
    return ranges


def pad_maps(spec: DatasetSpec, stats: dict[str, dict[str, list[float]]]) -> dict[str, np.ndarray]:
    """Pad → (rows, columns) 99 % quantile of its counts, from the newest reading of each row."""
    maps: dict[str, np.ndarray] = {}
    for key in sorted(spec.keys("tactile"), key=lambda k: spec.features[k].history):
        feature, sensor = spec.features[key], spec.sensors[key]
        if "q99" not in stats.get(key, {}):
            continue
        counts = np.array(stats[key]["q99"], dtype=float)
        counts = counts.reshape(feature.history, len(feature.pads), sensor.rows, sensor.columns)[-1]
        for pad, values in zip(feature.pads, counts, strict=True):
            maps.setdefault(pad, values)
    return maps
