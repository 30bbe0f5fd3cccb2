"""Pages: what enters a section is text, wherever it stands; and pages are made in one place."""

import re
from pathlib import Path

import pytest

import taccorl
from taccorl.errors import SpecError, plain_name
from taccorl.report.ingested import ingested
from taccorl.report.page import html
from taccorl.report.section import Cell, Picture, Section
from taccorl.report.terminal import show

BAD = """<img src=x onerror="alert('1')">&amp;"""
SHOWN = "&lt;img src=x onerror=&#34;alert(&#39;1&#39;)&#34;&gt;&amp;amp;"
PNG = b"\x89PNG"


@pytest.mark.parametrize(
    "section",
    [
        Section(title=BAD),
        Section(title=BAD, folded=True),
        Section(text=[BAD]),
        Section(text=[BAD], style="low"),
        Section(heads=(BAD,), rows=[("1",)]),
        Section(rows=[(BAD,)]),
        Section(rows=[("1",)], marks=(BAD,)),
        Section(notes=[BAD]),
        Section(command=BAD),
        Section(figures=[Picture(lambda: PNG, BAD)]),
        Section(parts=[Section(text=[BAD])]),
        *(Section(rows=[(Cell(BAD, style),)]) for style in ("", "bad", "bold", "code", "link")),
        Section(rows=[(Cell("x", hint=BAD),)]),
        Section(rows=[(Cell("x", more=[BAD]),)]),
    ],
)
def test_text_is_escaped_wherever_it_enters(section: Section):
    page = html(BAD, [section], BAD)
    assert "<img src=x" not in page and page.count(SHOWN) >= 4, "title, heading, generator and the section"
    assert "default-src 'none'" in page and "<script" not in page


def test_a_section_of_one_place_is_in_that_place_only(capsys: pytest.CaptureFixture[str]):
    both = [Section(text=["p"], only="page"), Section(text=["b"])]
    show(*both, Section(title="outer", parts=both))
    assert capsys.readouterr().out.split() == ["b", "outer", "b"]
    page = html("x", [*both, Section(title="outer", parts=both)], "x")
    assert [page.count(f"<div>{word}</div>") for word in "pb"] == [2, 2]


def test_paths_and_reasons_are_shown_whole_in_a_narrow_terminal(monkeypatch, capsys):
    monkeypatch.setattr("taccorl.report.terminal.WIDE", 60)
    path = "/data/robots/left_lab/2026-11-22/very_long_session_name/demonstration_000123.mcap"
    reason = f"{path}: /front/camera/image_raw/compressed: a message at log time 1700000000000000000 ns does not fit"
    entry = {
        "recording": path,
        "part": None,
        "outcome": "refused",
        "reason": reason,
        "command": f"taccorl check {path}",
    }
    show(ingested({"recordings": [{**entry, "episodes": []}], "outcomes": {"refused": 1}}))
    shown = capsys.readouterr().out
    assert f"refused {reason}\n" in shown and f"taccorl check {path}\n" in shown
    assert "…" not in shown
    table = shown.split("refused /data")[0]
    assert path in "".join(line.split("  ")[0].strip() for line in table.splitlines()[1:])  # folded, not cut


def test_no_other_module_writes_html():
    """Every page goes through the template, and no f-string holds a tag."""
    root = Path(taccorl.__file__).parent
    for path in root.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"<!doctype|import html$|html\.escape|Markup", text, re.MULTILINE), path
        assert not re.search(r"f[\"']<(p|h1|h2|h3|td|tr|li|ul|div|b|span|code|details)[ >]", text), path


@pytest.mark.parametrize("name", ["a<b", "a>b", "a&b", "a\x1b[31m", "a\nb", "a\u202eb", "\x9b2J", "a\u2028b", "\x00"])
def test_names_that_steer_a_terminal_or_a_page_are_refused_with_their_place(name: str):
    with pytest.raises(SpecError, match=r"arm\.urdf:3: .*character"):
        plain_name(name, "arm.urdf:3: <joint>")
    assert plain_name("left/joint 1-µ:2'é", "x") == "left/joint 1-µ:2'é"
