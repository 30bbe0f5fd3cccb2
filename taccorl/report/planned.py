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


def apart(p: Planned) -> dict[str, float]:
    """Scores of a motion or press for ``plan.yaml``."""
    return {pair: round(score, 2) for pair, score in p.discrimination.items()}


def write_plan[P: Planned](
    folder: Path,
    some: Sequence[P],
    of: Callable[[P], tuple[str, Mapping[str, np.ndarray], dict[str, Any]]],
    rate_hz: float,
    facts: Mapping[str, object],
    kind: str,
) -> Iterator[str]:
    """Write ``plan.yaml``, and a table of targets of each of ``some``; the line that says so.

    Args:
        of: name, columns of the table, each (T,), and facts of one of them.
        facts: other entries of ``plan.yaml``.
        kind: name of the list in ``plan.yaml``: motions or presses.
    """
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for number, p in enumerate(some, 1):
        name, columns, own = of(p)
        write_table(folder / f"{number}_{name}.csv", columns, rate_hz)
        entries.append({"table": f"{number}_{name}.csv", **own})
    text = yaml.safe_dump({**facts, kind: entries}, sort_keys=False, allow_unicode=True)
    (folder / "plan.yaml").write_text(text, encoding="utf-8")
    yield f"wrote {folder / 'plan.yaml'} and {len(entries)} tables of targets"


def write_table(path: Path, columns: Mapping[str, np.ndarray], rate_hz: float) -> None:
    """``t`` [s] and the columns, with seven digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["t", *columns])
        for k, values in enumerate(zip(*columns.values(), strict=True)):
            rows.writerow([f"{k / rate_hz:.6g}", *(f"{v:.7g}" for v in values)])
