"""Sections as Markdown, for cards of datasets and pages in Rerun.

Rows are data and are escaped. Lines and notes may have Markdown of their own, in which
data are put by ``escaped`` and ``code``: a dataset's texts are those of strangers.
"""

import re

from taccorl.errors import printable
from taccorl.report.section import Section, Value, cell

_SPECIAL = re.compile(r"[\\`*<>&|]|\](?=[(\[:])")
_CODE = re.compile(r"(`+).*?(?<!`)\1(?!`)")
_TARGET = re.compile(r"\]\((?!https?://|\.card/)")


def markdown(*sections: Section, level: int = 2) -> str:
    """Headings from ``level`` on; lines as a list, in bold where the section has the style data; tables; commands as code."""
    blocks: list[str] = []
    for s in sections:
        blocks += [f"{'#' * level} {escaped(s.title)}"] * bool(s.title)
        if s.text:
            blocks.append(
                "\n".join(
                    f"**{_line(v)}**" if s.style == "data" else f"- {_line(v)}"
                    for v in s.text
                )
            )
        if s.rows and any(s.heads):
            rules = ("--:" if k in s.right else ":--" for k in range(len(s.heads)))
            rows = [f"| {' | '.join(map(_text, row))} |" for row in (s.heads, *s.rows)]
            blocks.append("\n".join([rows[0], f"|{'|'.join(rules)}|", *rows[1:]]))
        elif s.rows:
            blocks.append(
                "\n".join(f"- {_text(name)}: {_text(value)}" for name, value in s.rows)
            )
        blocks += [_line(v) for v in s.notes]
        blocks += [f"```\n{printable(s.command)}\n```"] * bool(s.command)
        blocks += [markdown(*s.parts, level=level + 1)] * bool(s.parts)
    return "\n\n".join(blocks)


def escaped(text: object) -> str:
    """``text`` as Markdown shows it in one line: no markup, link, picture or HTML."""
    return _SPECIAL.sub(lambda found: f"\\{found[0]}", printable(text))


def code(text: object) -> str:
    """``text`` as code in a line, whatever backticks it has."""
    shown = printable(text)
    longest = max(map(len, re.findall("`+", shown)), default=0)
    if not longest:
        return f"`{shown}`"
    fence = "`" * (longest + 1)
    return f"{fence} {shown} {fence}"


def _text(value: Value) -> str:
    own = cell(value)
    if own.style == "code":
        # A table's cells end at each bar, also within code.
        return code(own.text).replace("|", "\\|")
    mark = "**" if own.style == "bold" else ""
    return f"{mark}{escaped(own.text)}{mark}"


def _line(value: Value) -> str:
    """A line with Markdown of its own: links to http, https and the card's picture only,
    and no HTML outside of code."""
    own = cell(value)
    if own.style:
        return _text(own)
    text, parts, end = printable(own.text), list[str](), 0
    for found in _CODE.finditer(text):
        parts += [_plain(text[end : found.start()]), found[0]]
        end = found.end()
    return "".join([*parts, _plain(text[end:])])


def _plain(text: str) -> str:
    shown = re.sub(r"(?<!\\)<", "&lt;", text)
    return _TARGET.sub(r"]\\(", shown)
