"""Section and files of a plan of recordings: scores of motions or presses, tables of their targets, ``plan.yaml``."""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from taccorl.diagnosis.experiment_design.excitation import SAME, TELLS, Plan, Planned
from taccorl.report.section import Section


def planned(found: Plan, floor: str, heads: Sequence[str], rows: Sequence[Sequence[str]], same: str) -> Section:
    """Motions or presses with their scores, best first, what was refused, and what nothing tells apart.

    Args:
        floor: text of the noise floor.
        heads, rows: facts about each; the first is its name.
        same: what it means if two rivals cannot be told apart by anything.
    """
    pairs = list(found.planned[0].discrimination) if found.planned else []
    scored = [
        [*row, *(f"{p.discrimination[pair]:.2f} ×" for pair in pairs)]
        for p, row in zip(found.planned, rows, strict=True)
    ]
    lines = []
    if found.pose:
        stand = ", ".join(f"{name} {value:g}" for name, value in found.pose.items())
        lines.append(f"meanwhile other joints stand at (rad, m): {stand}")
    lines += [f"not {name}: {why}" for name, why in found.refused.items()]
    for pair in found.hopeless:
        best, one_way = found.best(pair), _one_way(found, pair, rows)
        none = f"no single {heads[0]} tells them apart whichever of them is true"
        why = same if best < SAME and not one_way else none
        lines.append(f"{pair}: {best:.2f} floors at best, less than {TELLS:g}: {why}{one_way}")
    return Section(
        text=[f"{found.part}: noise floors ({floor}) that stay between rivals after a refit"],
        heads=(*heads, *pairs),
        rows=scored,
        right=range(1, len(heads) + len(pairs)),
        parts=[Section(text=lines)],
    )


def _one_way(found: Plan, pair: str, rows: Sequence[Sequence[str]]) -> str:
    """What tells the two apart if one of them is true: where one effect contains the other (friction that depends on the
    direction contains friction that does not), only its own motions do."""
    words = ""
    for k, truth in enumerate(pair.split(" | ")):
        scores = ((p.ways[pair][k], row[0]) for p, row in zip(found.planned, rows, strict=True))
        apart, name = max(scores, default=(0.0, ""))
        if apart >= TELLS:
            words += f"; if it is {truth}, {name} shows it ({apart:.2f} floors)"
    return words


Entry = tuple[str, Mapping[str, np.ndarray], dict[str, Any]]
"""Name, columns of the table, each (T,), and facts of a planned motion or press."""


def write_plan[P: Planned](
    folder: Path,
    found: Plan[P],
    num: int,
    entry: Callable[[P, dict[str, float]], Entry],
    at_hz: float,
    kind: tuple[str, str],
    **facts: object,
) -> Iterator[str]:
    """Write ``plan.yaml``, and a table of targets of each of the first ``num``; the line that says so.

    Args:
        entry: of one of them and its scores.
        at_hz: rate of the targets [Hz].
        kind: words of ``plan.yaml`` for the part and for the list: joint and motions, pads and presses.
        facts: other entries of ``plan.yaml``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for number, p in enumerate(found.planned[:num], 1):
        apart = {pair: round(score, 2) for pair, score in p.discrimination.items()}
        name, columns, own = entry(p, apart)
        write_table(folder / f"{number}_{name}.csv", columns, at_hz)
        entries.append({"table": f"{number}_{name}.csv", **own})
    reaches = {"reaches": {name: round(far, 3) for name, far in found.reaches.items()}} if found.reaches else {}
    words = {
        **reaches,
        kind[0]: found.part,
        "tells_apart": list(found.rivals),
        "rate_hz": at_hz,
        **facts,
        kind[1]: entries,
    }
    (folder / "plan.yaml").write_text(yaml.safe_dump(words, sort_keys=False, allow_unicode=True), encoding="utf-8")
    yield f"wrote {folder / 'plan.yaml'} and {len(entries)} tables of targets"


def write_table(path: Path, columns: Mapping[str, np.ndarray], rate_hz: float) -> None:
    """``t`` [s] and the columns, (T,) each, with seven digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["t", *columns])
        for k, values in enumerate(zip(*columns.values(), strict=True)):
            rows.writerow([f"{k / rate_hz:.6g}", *(f"{v:.7g}" for v in values)])
