"""Numbers of the cells of an array in few words: median, spread, and the cells that are farthest from the median.

Letters in shapes: K cells, R × C the grid.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from taccorl.diagnosis.comparison.result import CellNumbers, TouchTrace

FEW = 6
"""Numbers of so many cells are listed one by one; those of more are summarised."""
FARTHEST = 4
"""Number of cells that a summary names."""
FAMILIES = {"gain_": "gain", "offset_": "offset"}
"""Beginning of the names of one number of all cells (``gain_r0c0``, …) → its name."""


def spread_words(
    names: Sequence[str], values: np.ndarray, unit: str = "", *, largest: bool = False
) -> str:
    """Text such as ``median 30 count, middle half 25 … 35 count, farthest r1c2 62, r0c9 12``.

    Args:
        names: names of the K cells.
        values: (K,) their numbers in ``unit``.
        largest: name the largest ones, as of errors; else those that differ most from the median.
    """
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75))
    order = np.argsort(
        -(values if largest else np.abs(values - median)), kind="stable"
    )[:FARTHEST]
    some = ", ".join(f"{names[k]} {values[k]:.3g}" for k in order)
    of = f" {unit}" if unit else ""
    word = "largest" if largest else "farthest"
    return f"median {median:.3g}{of}, middle half {low:.3g} … {high:.3g}{of}, {word} {some}"


def summarised(numbers: Mapping[str, float]) -> tuple[dict[str, float], dict[str, str]]:
    """Numbers of a fit, divided into those to list and texts about those of more than ``FEW`` cells, such as ``gain of 80
    cells`` → ``median …``."""
    rest, words = dict(numbers), {}
    for begin, word in FAMILIES.items():
        own = {name: value for name, value in numbers.items() if name.startswith(begin)}
        if len(own) > FEW:
            rest = {name: value for name, value in rest.items() if name not in own}
            cells = [name.removeprefix(begin) for name in own]
            words[f"{word} of {len(own)} cells"] = spread_words(
                cells, np.array(list(own.values()))
            )
    return rest, words


def cell_errors(traces: Sequence[TouchTrace]) -> np.ndarray:
    """(R, C) RMS residual of each cell of a sensor over all recordings, in noise floors."""
    return (
        np.sqrt(
            np.concatenate([np.square(t.residual[:, 0]) for t in traces]).mean(axis=0)
        )
        / traces[0].floor[0]
    )


def best_of(cells: CellNumbers) -> str:
    """Text for gains of which each is that of one of several places; empty for one place."""
    return f", each at the best of {cells.places} places" if cells.places > 1 else ""


def cell_lines(traces: Sequence[TouchTrace]) -> list[str]:
    """Lines of text on gain, offset and error of an array of more than ``FEW`` cells; empty for fewer, and for pads."""
    first = traces[0] if traces else None
    if first is None or first.cells is None or len(first.cells.names) <= FEW:
        return []
    names, cells = first.cells.names, first.cells
    gain_unit = f"{first.unit}/{first.load_unit}"
    return [
        f"gain of {len(names)} cells{best_of(cells)}: {spread_words(names, cells.gain.ravel(), gain_unit)}",
        f"offset: {spread_words(names, cells.offset.ravel(), first.unit)}",
        f"error over noise floor: {spread_words(names, cell_errors(traces).ravel(), largest=True)}",
    ]
