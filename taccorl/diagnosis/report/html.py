"""HTML elements of a report."""

import html
from collections.abc import Container, Sequence


def table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Container[int] = (), classes: Sequence[str] = ()
) -> str:
    """HTML table from rows of HTML cells. ``numbers``: columns that are right-aligned; ``classes``: one for each row."""
    top = "<tr>" + "".join(f"<th>{html.escape(h)}</th>" for h in heads) + "</tr>" if heads else ""
    lines = []
    for k, row in enumerate(rows):
        kind = f' class="{classes[k]}"' if classes and classes[k] else ""
        cells = "".join(f"<td{' class=n' if i in numbers else ''}>{cell}</td>" for i, cell in enumerate(row))
        lines.append(f"<tr{kind}>{cells}</tr>")
    return f'<div class="scroll"><table>{top}{"".join(lines)}</table></div>'


def note(text: str) -> str:
    return f'<p class="note">{html.escape(text)}</p>'


def figure(uri: str, caption: str) -> str:
    words = html.escape(caption)
    return f'<figure><img src="{uri}" alt="{words}"><figcaption>{words}</figcaption></figure>'
