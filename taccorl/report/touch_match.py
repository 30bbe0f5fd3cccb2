"""Table of the paper's five numbers of a touch match (App. B.2), before and after."""

from collections.abc import Sequence

from taccorl.alignment.touch.match import MATCH_NUMBERS, TouchMatch
from taccorl.diagnosis.comparison.result import shown_unit
from taccorl.report.section import Section, Value


def touch_match_section(
    names: Sequence[str], matches: Sequence[TouchMatch], title: str = "touch match"
) -> Section:
    """A row for each number, a column for each of ``matches``, headed by ``names``. A number
    that the readings do not determine is "undefined", with the reason below."""
    rows, notes = [], []
    for number in MATCH_NUMBERS:
        factor, unit = shown_unit(number.unit)
        values = [getattr(one, number.name) for one in matches]
        cells: list[Value] = [
            "undefined" if value is None else f"{factor * value:.3g}"
            for value in values
        ]
        rows.append([number.label, *cells, unit])
        if None in values:
            notes.append(f"{number.label}: undefined, because {number.needs}")
    frames = " → ".join(f"{one.frames:,}" for one in matches)
    centroids = " → ".join(f"{one.centroid_frames:,}" for one in matches)
    notes.append(
        f"n: {frames} frames of single pads with an active taxel; centroids {centroids}"
    )
    return Section(
        title=title,
        heads=("number", *names, "unit"),
        rows=rows,
        right=range(1, len(names) + 1),
        notes=notes,
    )
