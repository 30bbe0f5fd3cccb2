"""Site of the documentation: ``make docs``. The pages are README.md, CHANGELOG.md, CONTRIBUTING.md, docs/ and the notebooks.

``sphinx-build -c docs . outputs/docs``: the clone is the source, so that links and pictures resolve as they do on GitHub.
"""

import json
import sys
from pathlib import Path
from typing import Any

project = "TacCoRL"
sys.path.insert(0, str(Path(__file__).parents[1]))  # docs/api.md imports taccorl.api
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
source_suffix = {".md": "markdown", ".ipynb": "markdown"}
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "docs/*.md",
    "notebooks/*.ipynb",
]
root_doc = "README"
myst_heading_anchors = 4  # anchors of headings as GitHub makes them
html_theme = "furo"
html_title = project
html_copy_source = False
html_static_path = ["site.css"]
html_css_files = ["site.css"]
suppress_warnings = [
    "myst.header",  # a section of a notebook may begin one level deeper
    "misc.highlighting_failure",  # a block that is not quite in its language, such as YAML with an ellipsis
]

NAVIGATION = {
    "Use": ["data", "training", "demonstrations", "twin", "effects", "robot"],
    "Diagnose": ["your_robot", "diagnosis", "api"],
    "Results": ["results", "learning", "benchmarks", "decisions", "limits"],
}
"""Caption → pages of docs/, in reading order; notebooks and the pages for developers follow."""


def table_of_contents(notebooks: list[str]) -> str:
    """Hidden tables of contents for the side bar, in MyST."""
    pages = {
        caption: [f"docs/{name}" for name in names]
        for caption, names in NAVIGATION.items()
    }
    pages |= {
        "Notebooks": sorted(notebooks),
        "Develop": ["docs/architecture", "CONTRIBUTING", "CHANGELOG"],
    }
    parts = (
        f"```{{toctree}}\n:hidden:\n:caption: {name}\n\n" + "\n".join(of) + "\n```"
        for name, of in pages.items()
    )
    return "\n\n".join(parts)


def notebook_page(text: str) -> str:
    """A notebook as Markdown: cells, and their stored outputs as text or PNG."""
    blocks = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] != "code":
            blocks.append(source)
            continue
        blocks.append(f"````python\n{source}\n````")
        for output in cell["outputs"]:
            data: dict[str, Any] = output.get("data", {})
            if "image/png" in data:
                blocks.append(
                    "![output](data:image/png;base64,"
                    + "".join(data["image/png"]).replace("\n", "")
                    + ")"
                )
            else:
                shown = "".join(output.get("text", data.get("text/plain", [])))
                blocks.append(f"````text\n{shown.rstrip()}\n````")
    return "\n\n".join(blocks) + "\n"


def read_source(app: Any, docname: str, content: list[str]) -> None:
    """Convert notebooks to Markdown, and add the tables of contents to the first page."""
    if app.env.doc2path(docname).suffix == ".ipynb":
        content[0] = notebook_page(content[0])
    if docname == root_doc:
        content[0] += "\n\n" + table_of_contents(
            [f"notebooks/{p.stem}" for p in Path(app.srcdir).glob("notebooks/*.ipynb")]
        )


def write_index(app: Any, error: Exception | None) -> None:
    """Let index.html, which servers and people open first, lead to the first page."""
    if error is None:
        page = f'<meta http-equiv="refresh" content="0; url={root_doc}.html"><a href="{root_doc}.html">{project}</a>\n'
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app: Any) -> None:
    app.connect("source-read", read_source)
    app.connect("build-finished", write_index)
