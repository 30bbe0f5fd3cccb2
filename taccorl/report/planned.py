"""Section and files of a plan of recordings: scores of motions or presses, tables of their targets, ``plan.yaml``."""

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from taccorl.diagnosis.experiment_design.plan import SAME, TELLS, Part, Plan, Planned
from taccorl.report.section import Section


@dataclass(frozen=True, kw_only=True)
class Words:
    """Words of a plan for one part in one condition."""

    kind: tuple[str, str]
    """Of plan.yaml for the part and for the list: joint and motions, pads and presses."""
    heads: Sequence[str]
    """Headings of facts about each recording; the first is its name."""
    floor: str
    """Text of the noise floor."""
    same: str
    """What it means if two rivals cannot be told apart by anything."""
    facts: Mapping[str, Any]
    """Further entries of plan.yaml: units, and how to record."""
    entry: Callable[[Planned], dict[str, Any]]
    """Facts of a recording for plan.yaml,"""
    row: Callable[[Planned], Sequence[str]]
    """and for the table, below ``heads`` without the first."""
    remarks: Callable[[Plan], Iterable[str]] = lambda found: ()
    """Lines below the scores."""


def planned(found: Plan, part: Part, words: Callable[[Part], Words]) -> Section:
    """Motions or presses with their scores, best first, what was refused, and what nothing tells apart."""
    pairs, own = (
        list(found.planned[0].discrimination) if found.planned else [],
        words(part),
    )
    rows = []
    for p in found.planned:  # of several pairs, whose columns would be too wide to read, how many are separated
        few = [*p.discrimination.values()]
        apart = (
            f"{few[0]:.2f} ×"
            if len(few) == 1
            else f"{sum(s >= TELLS for s in few)} of {len(few)}"
        )
        rows.append([p.name, *words(p.part).row(p), apart])
    told = [pair for pair in pairs if len(pairs) > 1 and pair not in found.hopeless]
    best = {
        pair: max(found.planned, key=lambda p, pair=pair: p.discrimination[pair])
        for pair in told
    }
    lines = [
        f"{pair}: {p.discrimination[pair]:.2f} floors at best, with {p.name}"
        for pair, p in best.items()
    ]
    if part.pose:
        stand = ", ".join(f"{name} {value:g}" for name, value in part.pose.items())
        lines.append(f"meanwhile other joints stand at (rad, m): {stand}")
    lines += [f"not {name}: {why}" for name, why in found.refused.items()]
    for pair in dict.fromkeys(
        [*found.hopeless, *(pair for scores in found.tried.values() for pair in scores)]
    ):
        one_way = "".join(
            f"; if it is {truth}, {p.name} shows it ({apart:.2f} floors)"
            for of, truth, p, apart in found.one_way()
            if of == pair
        )
        best, nothing = (
            found.at_first(pair),
            f"no single {own.heads[0]} tells them apart whichever of them is true",
        )
        why = own.same if best < SAME and not one_way else nothing
        elsewhere = "".join(
            f"; {more[pair]:.2f} {where}"
            for where, more in found.tried.items()
            if pair in more
        )
        why = (
            f", as it is{elsewhere}"
            if found.best(pair) >= TELLS
            else f": {why}{one_way}{elsewhere}"
        )
        lines.append(f"{pair}: {best:.2f} floors at best, less than {TELLS:g}{why}")
    return Section(
        text=[
            f"{found.part}: noise floors ({own.floor}) that stay between rivals after a refit"
        ],
        heads=(*own.heads, pairs[0] if len(pairs) == 1 else "pairs apart"),
        rows=rows,
        right=range(1, len(own.heads) + 1),
        parts=[Section(text=[*lines, *own.remarks(found)])],
    )


def write_plan(
    folder: Path, found: Plan, part: Part, words: Callable[[Part], Words], num: int
) -> str:
    """Write ``plan.yaml`` and a table of targets of each of ``found.written(num)``; the line that says so."""
    folder.mkdir(parents=True, exist_ok=True)
    entries, whole = [], words(part)
    for number, p in enumerate(found.written(num), 1):
        own, table = words(p.part), f"{number}_{p.name}.csv"
        apart = {pair: round(score, 2) for pair, score in p.discrimination.items()}
        condition = {"condition": p.part.where, **own.facts} if p.part.label else {}
        entries.append(
            {"table": table, **own.entry(p), **condition, "floors_apart": apart}
        )
        write_table(folder / table, p.columns, part.rate_hz)
    rate_hz = (
        part.rate_hz if isinstance(part.rate_hz, int) else float(f"{part.rate_hz:.6g}")
    )
    content = (
        {"reaches": {name: round(far, 3) for name, far in found.reaches.items()}}
        if found.reaches
        else {}
    )
    content |= {
        whole.kind[0]: found.part,
        "tells_apart": list(found.rivals),
        "rate_hz": rate_hz,
        **whole.facts,
    }
    content[whole.kind[1]] = entries
    (folder / "plan.yaml").write_text(
        yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8"
    )
    return f"wrote {folder / 'plan.yaml'} and {len(entries)} tables of targets"


def write_table(path: Path, columns: Mapping[str, np.ndarray], rate_hz: float) -> None:
    """``t`` [s] and the columns, (T,) each, with seven digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["t", *columns])
        for k, values in enumerate(zip(*columns.values(), strict=True)):
            rows.writerow([f"{k / rate_hz:.6g}", *(f"{v:.7g}" for v in values)])
