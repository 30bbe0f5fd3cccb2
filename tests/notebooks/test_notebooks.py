"""Notebooks hold small outputs; each runs from top to bottom, shows its plots, and prints what is stored."""

from pathlib import Path

import nbformat
import pytest
from stored_outputs import FOLDER, differences, executed, pictures

NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stored_and_small(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert any(cell.outputs for cell in cells) and all(cell.execution_count for cell in cells), "run make notebooks"
    shown = [picture for cell in cells for picture in pictures(cell)]
    assert shown and max(map(len, shown)) <= 100_000
    written = "".join(str(cell.outputs) for cell in cells)
    assert "/tmp/tmp" not in written and "Error" not in written and "stderr" not in written


def test_all_notebooks_together_are_small() -> None:
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{k}_" for k in range(1, len(NOTEBOOKS) + 1)]
    assert sum(path.stat().st_size for path in NOTEBOOKS) <= 1_500_000


@pytest.mark.slow
@pytest.mark.timeout(1800)  # on an idle machine each takes less than three minutes
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_prints_what_is_stored(path: Path) -> None:
    stored, now = nbformat.read(path, as_version=4), executed(path)
    plotting = [cell for cell in now.cells if "plt.show()" in cell.source or "display(" in cell.source]
    assert plotting
    for cell in plotting:
        assert pictures(cell), cell.source
    assert differences(stored, now) == [], "if that is right: make notebooks"
