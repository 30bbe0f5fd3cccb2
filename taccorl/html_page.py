"""HTML pages of reports. Text is escaped where it enters a page; only what these functions return is taken for HTML.

A page holds its style and pictures, loads no other file, and its Content-Security-Policy forbids scripts.
"""

import html
from collections.abc import Container, Iterable, Sequence

import taccorl

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
"""Content-Security-Policy of every page: no scripts, frames, forms or requests."""
_EMPTY = ("img", "meta")


class Html(str):
    """Text that is HTML. Strings made from it by formatting or joining are plain text again, and escaped."""


def inline(*parts: str) -> Html:
    """``parts`` one after another; those that are no ``Html`` are escaped."""
    return Html("".join(part if isinstance(part, Html) else html.escape(part) for part in parts))


def element(tag: str, /, *parts: str, **attributes: str) -> Html:
    """HTML element with these parts and attributes, all escaped. ``class_`` is the attribute class; attributes of an empty text
    are left out."""
    own = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(value)}"' for key, value in attributes.items() if value
    )
    return Html(f"<{tag}{own}>" + ("" if tag in _EMPTY else f"{inline(*parts)}</{tag}>"))


def lines(parts: Iterable[str]) -> Html:
    """``parts`` with line breaks between them."""
    return Html("<br>".join(inline(part) for part in parts))


def bullets(parts: Iterable[str]) -> Html:
    """HTML list with one item for each of ``parts``."""
    return element("ul", *(element("li", part) for part in parts))


def table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Container[int] = (), classes: Sequence[str] = ()
) -> Html:
    """HTML table.

    Args:
        heads: texts of the heading; none if all are empty.
        rows: rows of cells.
        numbers: indices of the columns that are right-aligned.
        classes: CSS class of each row; empty: none.
    """
    top = element("tr", *(element("th", head) for head in heads)) if any(heads) else Html()
    body = [
        element(
            "tr",
            *(element("td", cell, class_="n" * (i in numbers)) for i, cell in enumerate(row)),
            class_=classes[k] if classes else "",
        )
        for k, row in enumerate(rows)
    ]
    return element("div", element("table", top, *body), class_="scroll")


def note(text: str) -> Html:
    """HTML paragraph of a remark."""
    return element("p", text, class_="note")


def figure(uri: str, caption: str) -> Html:
    """HTML of a picture with its caption; ``uri`` holds the picture, ``data:image/png;base64,…``."""
    return element("figure", element("img", src=uri, alt=caption), element("figcaption", caption))


def document(title: str, style: str, generator: str, parts: Iterable[str]) -> str:
    """HTML text of a whole page.

    Args:
        style: style sheet, which is of this program and not escaped.
        generator: text by which the file is recognised.
    """
    head = [
        Html('<meta charset="utf-8">'),
        Html(f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'),
        element("meta", name="generator", content=f"{generator}, taccorl {taccorl.__version__}"),
        Html('<meta name="viewport" content="width=device-width">'),
        element("title", title),
        Html(f"<style>{style}</style>"),
    ]
    body = element("main", Html("\n".join(inline(part) for part in parts)))
    return f'<!doctype html><html lang="en">{element("head", *head)}{element("body", body)}</html>\n'
