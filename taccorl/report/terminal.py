"""Sections in a terminal, readable in a narrow one and in a log file."""

import io

from rich.console import Console
from rich.table import Table
from rich.text import Text as RichText

from taccorl.errors import printable
from taccorl.report.section import Section, Value, cell

WIDE = 150
"""Width of tables in a log file or pipe [characters]."""
STYLES = {
    **dict.fromkeys(("good", "high"), "green"),
    **dict.fromkeys(("bad", "moderate", "warning"), "yellow"),
    **dict.fromkeys(("low", "error"), "red"),
    "note": "dim",
    "bold": "bold",
    "code": "bold",
}
"""Style of a cell or section → style of rich; others have none."""


def Text(text: str, style: str = "") -> RichText:
    """``text`` with control characters escaped, for names of topics and files that taccorl did not choose, in a style of rich."""
    return RichText(printable(text), style)


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """`taccorl … | head`: for ``cli.main`` to handle, not an exit code that means something else."""
        raise BrokenPipeError


def console() -> Console:
    """Console with the terminal's width; without a terminal, wide enough not to fold a topic's name."""
    found = _Console()
    return found if found.is_terminal else _Console(width=WIDE)


def as_text(*sections: Section) -> str:
    """What ``show`` prints into a log file."""
    file = io.StringIO()
    show(*sections, out=_Console(file=file, width=WIDE, color_system=None))
    return file.getvalue().strip("\n")


def show(*sections: Section, indent: str = "", out: Console | None = None) -> None:
    """Print sections: lines whole, never cut or folded, so that they can be copied; cells of tables folded. ``out``: where;
    stdout if not given."""
    out = out or console()
    for s in sections:
        if s.only == "page":
            continue
        if s.title:
            out.print(
                "" if indent else "\n",
                Text(f"{indent}{s.title}", "bold"),
                sep="",
                soft_wrap=True,
            )
        for number, value in enumerate(s.text):
            out.print(
                _line(value, indent, s.style if number == 0 else ""), soft_wrap=True
            )
        if s.rows and (any(s.heads) or len(s.rows[0]) != 2):
            out.print(_table(s, indent))
        elif s.rows:  # names and values
            within = indent if not s.style else f"{indent}  "
            width = max(len(cell(name).text) for name, _ in s.rows)
            for name, value in s.rows:
                label = _line(name, within)
                label.append(" " * (width + 2 - len(cell(name).text)))
                out.print(label + _line(value, ""), soft_wrap=True)
        for value in s.notes:
            out.print(_line(value, indent, "note"), soft_wrap=True)
        if s.command:
            out.print(Text(f"{indent}{s.command}"), soft_wrap=True)
        show(*s.parts, indent=f"{indent}  " if s.title else indent, out=out)


def _line(value: Value, indent: str, style: str = "") -> RichText:
    own = cell(value)
    return Text(f"{indent}{own.text}", STYLES.get(own.style or style, ""))


def _table(s: Section, indent: str) -> Table:
    table = Table(
        box=None, pad_edge=False, show_header=any(s.heads), padding=(0, 2, 0, 0)
    )
    for k in range(max(map(len, s.rows))):
        head = s.heads[k] if k < len(s.heads) else ""
        table.add_column(
            Text(f"{indent if k == 0 else ''}{head}"),
            justify="right" if k in s.right else "left",
            overflow="fold",
        )
    for row in s.rows:
        table.add_row(
            *(_line(value, indent if k == 0 else "") for k, value in enumerate(row))
        )
    return table
