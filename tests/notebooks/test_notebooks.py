"""Notebooks hold small outputs; each runs from top to bottom, shows its plots, and prints what is stored."""

import ast
from pathlib import Path

import nbformat
import pytest
from stored_outputs import FOLDER, ROOT, differences, executed, pictures

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


def names_of(module: str) -> set[str]:
    """Names that a module of taccorl defines or imports at its top level, and its submodules, from its source."""
    path = ROOT / module.replace(".", "/")
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    names = {child.stem for child in path.iterdir()} if path.is_dir() else set()
    for node in ast.parse(source.read_text("utf-8")).body:
        match node:
            case ast.ClassDef(name=name) | ast.FunctionDef(name=name):
                names.add(name)
            case ast.Import(names=imported) | ast.ImportFrom(names=imported):
                names |= {alias.asname or alias.name for alias in imported}
            case ast.Assign(targets=targets):
                names |= {target.id for target in targets if isinstance(target, ast.Name)}
            case ast.AnnAssign(target=ast.Name(id=name)):
                names.add(name)
    return names


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_a_notebook_imports_is_there(path: Path) -> None:
    cells = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    for cell in cells:
        for node in ast.walk(ast.parse(cell.source.removeprefix("%matplotlib inline"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("taccorl."):
                assert {alias.name for alias in node.names} <= names_of(node.module or ""), ast.unparse(node)


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
