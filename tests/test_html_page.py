"""Pages of HTML: what is no markup of this package is text, wherever it stands; and pages are made in one place."""

import re
from pathlib import Path

import pytest

import taccorl
from taccorl.errors import SpecError, plain_name
from taccorl.html_page import Html, bullets, document, element, figure, inline, lines, note, table

BAD = """<img src=x onerror="alert('1')">&amp;"""
SHOWN = "&lt;img src=x onerror=&quot;alert(&#x27;1&#x27;)&quot;&gt;&amp;amp;"


@pytest.mark.parametrize(
    "made",
    [
        element("p", BAD),
        element("p", "x", title=BAD),
        inline(BAD),
        lines([BAD]),
        bullets([BAD]),
        note(BAD),
        figure("data:image/png;base64,", BAD),
        table((BAD,), [("1",)]),
        table((), [(BAD,)]),
        table((), [("1",)], classes=(BAD,)),
        inline(f"{element('b', BAD)}"),
    ],
)
def test_text_is_escaped_wherever_it_enters(made: Html):
    assert "<img src=x" not in made and "&lt;img src=x" in made.replace("&amp;", "&")
    assert inline(made) is not made and inline(made) == made, "what is HTML stays so"


def test_a_page_forbids_scripts_and_escapes_its_title_and_plain_parts():
    page = document(BAD, "p{}", "test", [BAD, element("p", "x")])
    assert page.count(SHOWN) == 2 and "<p>x</p>" in page and "default-src 'none'" in page


def test_no_other_module_writes_html():
    """Every page goes through ``document``, and no f-string holds a tag."""
    root = Path(taccorl.__file__).parent
    for path in root.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if path.name != "html_page.py":
            assert not re.search(r"<!doctype|import html$|html\.escape", text, re.MULTILINE), path
            assert not re.search(r"f[\"']<(p|h1|h2|h3|td|tr|li|ul|div|b|span|code|details)[ >]", text), path


@pytest.mark.parametrize("name", ["a<b", "a>b", "a&b", "a\x1b[31m", "a\nb", "a\u202eb", "\x9b2J", "a\u2028b", "\x00"])
def test_names_that_steer_a_terminal_or_a_page_are_refused_with_their_place(name: str):
    with pytest.raises(SpecError, match=r"arm\.urdf:3: .*character"):
        plain_name(name, "arm.urdf:3: <joint>")
    assert plain_name("left/joint 1-µ:2'é", "x") == "left/joint 1-µ:2'é"
