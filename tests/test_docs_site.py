"""``make docs``: the site builds without a warning, and every link, picture and style sheet of it is in its folder."""

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

pytest.importorskip(
    "sphinx",
    reason="the site needs the packages of the group dev: make docs sets them up",
)
from tests.fresh_python import fresh_python

ROOT = Path(__file__).parents[1]


class Page(HTMLParser):
    """Targets of a page's links, resources that it loads, and its anchors."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.resources: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        of = {name: value or "" for name, value in attrs}
        self.anchors |= {of[name] for name in ("id", "name") if name in of}
        if tag == "a" and "href" in of:
            self.links.append(of["href"])
        self.resources += [
            of[name]
            for name in ("src", "href")
            if name in of and tag in ("img", "script", "link")
        ]


@pytest.mark.slow
def test_every_link_and_picture_of_the_site_is_in_it(tmp_path: Path) -> None:
    site = tmp_path / "site"
    words = f"-m sphinx -q -W --keep-going -c docs . {site} -d {tmp_path / 'd'}".split()
    built = fresh_python(*words)
    assert (built.returncode, built.stderr) == (0, "")
    pages = {path: Page(path) for path in site.rglob("*.html")}
    sources = [
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/*.md"),
        *ROOT.glob("notebooks/*.ipynb"),
    ]
    for source in sources:
        assert site / source.relative_to(ROOT).with_suffix(".html") in pages
    assert site / "index.html" in pages
    wrong = []
    for path, page in pages.items():
        for target in page.resources + page.links:
            place, _, anchor = target.partition("#")
            if target.startswith(("data:", "mailto:")) or (
                target.startswith("http") and target not in page.resources
            ):
                continue
            there = (
                (path.parent / unquote(place.partition("?")[0])).resolve()
                if place
                else path
            )
            if not there.is_file() or (
                anchor and unquote(anchor) not in pages[there].anchors
            ):
                wrong.append(f"{path.relative_to(site)}: {target}")
    assert wrong == []
    notebook = (site / "notebooks" / "3_find_the_missing_effect.html").read_text(
        encoding="utf-8"
    )
    assert notebook.count("<img") >= 3, "stored pictures of a notebook are shown"
