"""Texts of strangers in Markdown, rendered by another program: no markup, link or HTML."""

from html.parser import HTMLParser

import pytest

from taccorl.report.markdown import code, escaped, markdown
from taccorl.report.section import Cell, Section

markdown_it = pytest.importorskip("markdown_it", reason="renders Markdown")

HOSTILE = {
    "html": "<img src=x onerror=alert(1)><script>alert(1)</script>",
    "link": "[the data](javascript:alert(1))",
    "picture": "![x](data:image/svg+xml;base64,AAAA)",
    "reference": "[a][b] [b]: javascript:alert(1)",
    "autolink": "<javascript:alert(1)>",
    "bold": "**no**, *no*",
    "code": "`` ` ``` end",
    "cell": "a | b | c",
    "lines": "one\n\n# two\n\n[a]: javascript:alert(1)\n```\n<b>",
    "backslash": "\\<b> \\[x](javascript:alert(1))",
    "entity": "&lt;b&gt; &#60;b&#62;",
}


class Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags, self.text = set[str](), ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.add(tag)
        self.tags |= {f"{name}={value}" for name, value in attrs if name != "style"}

    def handle_data(self, data: str) -> None:
        self.text += data


def rendered(*sections: Section) -> Tags:
    parser = markdown_it.MarkdownIt("commonmark", {"html": True}).enable(["table"])
    return Tags(parser.render(markdown(*sections)))


@pytest.mark.parametrize("name", HOSTILE)
def test_texts_of_strangers_are_shown_as_they_are_wherever_they_stand(name: str):
    text = HOSTILE[name]
    shown = " ".join(
        text.encode("unicode_escape").decode().replace("\\\\", "\\").split()
    )
    places = {
        "title": Section(title=text),
        "line": Section(text=[f"instruction: *{escaped(text)}*"]),
        "data": Section(text=[escaped(text)], style="data"),
        "note": Section(notes=[f"made of {code(text)}"]),
        "list": Section(rows=[[text, text]]),
        "table": Section(heads=("a", "b"), rows=[[Cell(text, "code"), text]]),
        "bold": Section(heads=("a",), rows=[[Cell(text, "bold")]]),
        "command": Section(command=text),
    }
    allowed = {
        *[
            "h2",
            "p",
            "ul",
            "li",
            "strong",
            "em",
            "table",
            "thead",
            "tbody",
            "tr",
            "th",
            "td",
            "code",
            "pre",
        ]
    }
    for place, section in places.items():
        found = rendered(section)
        assert found.tags <= allowed, place
        assert shown in " ".join(found.text.split()), place


def test_lines_keep_their_own_markup_and_links_to_the_web_only():
    lines = [
        "format: [LeRobot](https://github.com/huggingface/lerobot), `a < b`, 1 < 2",
        "[x](javascript:alert(1)) <b>",
        "![picture](.card/episode_0.jpg)",
    ]
    found = rendered(Section(text=lines))
    assert found.tags == {
        *("ul", "li", "code", "a", "img", "alt=picture"),
        "href=https://github.com/huggingface/lerobot",
        "src=.card/episode_0.jpg",
    }
    assert "a < b" in found.text and "1 < 2" in found.text
