"""Every notebook runs from top to bottom and shows its plots."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"


@pytest.mark.slow
@pytest.mark.timeout(600)  # each cell has 240 s
@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebook_runs_and_every_plot_appears(path):
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "stored outputs go stale: clear them"
    NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(FOLDER.parent)}}).execute()
    plotting = [cell for cell in notebook.cells if "plt.show()" in cell.source or "display(" in cell.source]
    assert plotting
    for cell in plotting:
        assert any("image/png" in output.get("data", {}) for output in cell.outputs)
