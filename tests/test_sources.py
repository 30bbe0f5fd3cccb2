"""What sources name is there: documents that comments cite, packages that are imported."""

import ast
import re
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from hatchling.build import build_wheel

ROOT = Path(__file__).parents[1]
FOLDERS = ("taccorl", "pipelines", "tests", "data_specs", "configs", "docs")
UNLISTED = {
    "rerun": "rerun-sdk",
    "rerun_cli": "rerun-sdk",
    "ruamel": "ruamel-yaml",
}  # a .pth file puts them on the path


def test_every_document_of_the_project_that_is_cited_exists() -> None:
    missing = []
    for path in [
        ROOT / "README.md",
        *(p for folder in FOLDERS for p in (ROOT / folder).rglob("*")),
    ]:
        if path.suffix in (".py", ".md", ".yaml"):
            for cited in re.findall(
                r"\b(?:docs|research|notebooks)/[\w./-]+\.(?:md|ipynb)\b",
                path.read_text("utf-8"),
            ):
                if not (ROOT / cited).is_file():
                    missing.append(f"{path.relative_to(ROOT)}: {cited}")
    assert missing == []


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings as GitHub makes them: lower case, without signs, hyphens for spaces."""
    headings = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {
        re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")
        for heading in headings
    }


def test_every_link_of_a_page_leads_somewhere() -> None:
    broken = []
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
            path, _, anchor = target.partition("#")
            place = (page.parent / path).resolve() if path else page
            if not target.startswith("http") and not (
                place.exists()
                and (not anchor or (place.suffix == ".md" and anchor in anchors(place)))
            ):
                broken.append(f"{page.name}: {target}")
    assert broken == []


IMPORTS = re.compile(r"^ *(?:from ([\w.]+) import |import (\w[\w., ]*)$)", re.MULTILINE)


def test_every_package_that_is_imported_is_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    stated = [
        *project["dependencies"],
        *(d for group in project["optional-dependencies"].values() for d in group),
    ]
    declared = {re.split(r"[^A-Za-z0-9_-]", text)[0].lower() for text in stated}
    known, imported = packages_distributions(), set[str]()
    for path in (
        p for folder in ("taccorl", "pipelines") for p in (ROOT / folder).rglob("*.py")
    ):
        for module, modules in IMPORTS.findall(path.read_text("utf-8")):
            imported |= {
                name.split()[0].split(".")[0] for name in (module or modules).split(",")
            }
    assert {"numpy", "lerobot", "mujoco"} <= imported, "the search finds what there is"
    undeclared = set()
    for package in imported - {"taccorl", "pipelines"} - sys.stdlib_module_names:
        distributions = {
            UNLISTED.get(package, name).lower().replace("_", "-")
            for name in known.get(package, [package])
        }
        if not distributions & declared:
            undeclared.add(package)
    assert undeclared == set()


def test_the_wheel_holds_what_commands_read_besides_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    held = set(zipfile.ZipFile(tmp_path / build_wheel(str(tmp_path))).namelist())
    specs = {
        f"taccorl/_{path.relative_to(ROOT).as_posix()}"
        for path in (ROOT / "data_specs").rglob("*.yaml")
    }
    others = {
        path.relative_to(ROOT).as_posix()
        for kind in ("yaml", "j2", "txt")
        for path in (ROOT / "taccorl").rglob(f"*.{kind}")
    }
    assert len(specs) > 3 and len(others) > 3
    assert (
        specs | others | {"taccorl/sim/effects/effects.md", "lerobot_policy_taccorl.py"}
        <= held
    )


PICKLES = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
OWN_MESSAGES = {"lineage/processes.py"}
"""Between this run's processes, through pipes."""
UNSAFE = re.compile(
    r"torch\.(load|save)|.*\.(read_pickle|to_pickle|unsafe_load|full_load)|yaml\.load"
)
SUSPECT = re.compile(
    rf"{'|'.join(PICKLES)}|torch\s*\.\s*(load|save)|yaml\s*\.\s*load|(unsafe|full)_load|weights_only"
)
"""Text without which a source file holds none of these, and need not be parsed."""


def test_nothing_that_a_folder_holds_is_unpickled() -> None:
    found = set()
    for path in (
        p for folder in ("taccorl", "pipelines") for p in (ROOT / folder).rglob("*.py")
    ):
        if not SUSPECT.search(text := path.read_text("utf-8")):
            continue
        for node in ast.walk(ast.parse(text)):
            names = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import | ast.ImportFrom)
                else []
            )
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            unsafe = [name for name in names if name.split(".")[0] in PICKLES]
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                unsafe += [called] if UNSAFE.fullmatch(called) else []
                unsafe += [
                    k.arg
                    for k in node.keywords
                    if k.arg in ("allow_pickle", "weights_only")
                ]
            found |= {
                (
                    path.relative_to(ROOT / path.relative_to(ROOT).parts[0]).as_posix(),
                    name,
                )
                for name in unsafe
            }
    assert {entry for entry in found if entry[0] not in OWN_MESSAGES} == set()
    assert found == {(name, "pickle") for name in OWN_MESSAGES}, (
        "the search finds what there is"
    )
