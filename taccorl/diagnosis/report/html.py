"""HTML elements of a report."""

import html
from collections.abc import Container, Sequence


def table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Container[int] = (), classes: Sequence[str] = ()
) -> str:
    """HTML table.

    Args:
        heads: texts of the heading, which are escaped; none if empty.
        rows: rows of HTML cells.
        numbers: indices of the columns that are right-aligned.
        classes: CSS class of each row; empty: none.
    """
    top = "<tr>" + "".join(f"<th>{html.escape(h)}</th>" for h in heads) + "</tr>" if heads else ""
    lines = []
    for k, row in enumerate(rows):
        kind = f' class="{classes[k]}"' if classes and classes[k] else ""
        cells = "".join(f"<td{' class=n' if i in numbers else ''}>{cell}</td>" for i, cell in enumerate(row))
        lines.append(f"<tr{kind}>{cells}</tr>")
    return f'<div class="scroll"><table>{top}{"".join(lines)}</table></div>'


def note(text: str) -> str:
    """HTML paragraph of a remark; ``text`` is escaped."""
    return f'<p class="note">{html.escape(text)}</p>'


def figure(uri: str, caption: str) -> str:
    """HTML of a picture with its caption, which is escaped; ``uri`` is as from ``data_uri``."""
    words = html.escape(caption)
    return f'<figure><img src="{uri}" alt="{words}"><figcaption>{words}</figcaption></figure>'
