"""Sections as Markdown, for cards of datasets and pages in Rerun."""

from taccorl.errors import printable
from taccorl.report.section import Section, Value, cell

_MARKS = {"code": "`", "bold": "**"}


def markdown(*sections: Section, level: int = 2) -> str:
    """Headings from ``level`` on; lines as a list, in bold where the section has the style data; tables; commands as code."""
    blocks: list[str] = []
    for s in sections:
        blocks += [f"{'#' * level} {printable(s.title)}"] * bool(s.title)
        if s.text:
            blocks.append(
                "\n".join(
                    f"**{_text(v)}**" if s.style == "data" else f"- {_text(v)}"
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
        blocks += [_text(v) for v in s.notes]
        blocks += [f"```\n{s.command}\n```"] * bool(s.command)
        blocks += [markdown(*s.parts, level=level + 1)] * bool(s.parts)
    return "\n\n".join(blocks)


def _text(value: Value) -> str:
    own = cell(value)
    mark = _MARKS.get(own.style, "")
    return f"{mark}{printable(own.text)}{mark}"
