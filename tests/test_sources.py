"""What sources name is there: documents that comments cite, packages that are imported."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("taccorl", "pipelines", "tests", "data_specs", "configs", "docs")
OPTIONAL = {"playwright"}  # of the developers' group; looked for before it is imported
UNLISTED = {"rerun": "rerun-sdk", "rerun_cli": "rerun-sdk"}  # a .pth file puts them on the path


def test_every_document_of_the_project_that_is_cited_exists() -> None:
    missing = []
    for path in [ROOT / "README.md", *(p for folder in FOLDERS for p in (ROOT / folder).rglob("*"))]:
        if path.suffix in (".py", ".md", ".yaml"):
            for cited in re.findall(r"\b(?:docs|research|notebooks)/[\w./-]+\.(?:md|ipynb)\b", path.read_text("utf-8")):
                if not (ROOT / cited).is_file():
                    missing.append(f"{path.relative_to(ROOT)}: {cited}")
    assert missing == []


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings as GitHub makes them: lower case, without signs, hyphens for spaces."""
    headings = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_link_of_a_page_leads_somewhere() -> None:
    broken = []
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
            path, _, anchor = target.partition("#")
            place = (page.parent / path).resolve() if path else page
            if not target.startswith("http") and not (
                place.exists() and (not anchor or (place.suffix == ".md" and anchor in anchors(place)))
            ):
                broken.append(f"{page.name}: {target}")
    assert broken == []


def test_every_package_that_is_imported_is_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    stated = [*project["dependencies"], *(d for group in project["optional-dependencies"].values() for d in group)]
    declared = {re.split(r"[^A-Za-z0-9_-]", text)[0].lower() for text in stated}
    known, undeclared = packages_distributions(), set()
    for path in (p for folder in ("taccorl", "pipelines") for p in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            for package in {name.split(".")[0] for name in names} - {"taccorl", "pipelines"} - sys.stdlib_module_names:
                distributions = {
                    UNLISTED.get(package, name).lower().replace("_", "-") for name in known.get(package, [package])
                }
                if not distributions & declared and package not in OPTIONAL:
                    undeclared.add(package)
    assert undeclared == set()
