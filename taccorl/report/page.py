"""Sections as a page: one HTML file with its pictures inside, which loads no other file and runs no script. All text is escaped.

Files of a report are replaced by the next one; other files of their names are not overwritten.
"""

import base64
import io
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import taccorl
from taccorl.errors import TaccorlError
from taccorl.report.section import Section, cell

HEAD_BYTES = 2048
"""Bytes at the start of a file in which its generator is looked for."""


def html(title: str, sections: Iterable[Section], generator: str) -> str:
    """Text of the page; ``generator`` is the text by which the file is recognised."""
    made_by = f"{generator}, taccorl {taccorl.__version__}"
    return _rendered(sections, whole=True, title=title, generator=made_by)


def fragment(sections: Iterable[Section]) -> str:
    """Sections as one HTML element with its own style, for a cell of a notebook."""
    return _rendered(sections, whole=False)


def _rendered(sections: Iterable[Section], **values: object) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("taccorl.report", ""),
        autoescape=True,
        undefined=StrictUndefined,
    )
    made.filters |= {"cell": cell, "uri": _uri}
    template = made.get_template("page.html.j2")
    return template.render(sections=list(sections), **values)


def _uri(draw: Callable[[], Any]) -> str:
    """The picture inside an address."""
    made = draw()
    if not isinstance(made, bytes):
        stream = io.BytesIO()
        made.savefig(stream, format="png", facecolor="white")
        made = stream.getvalue()
    kind = "jpeg" if made[:2] == b"\xff\xd8" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(made).decode('ascii')}"


def check_free(paths: Iterable[Path], generator: str, option: str) -> None:
    """Raises TaccorlError: something that is no such report is at one of ``paths``; give another ``option``."""
    for path in paths:
        head = b""
        if path.is_file():
            with path.open("rb") as file:
                head = file.read(HEAD_BYTES)
        if path.exists() and generator.encode() not in head:
            raise TaccorlError(
                f"{path}: already exists and is not a report of taccorl; give {option}, or remove it"
            )


def write(texts: dict[Path, str]) -> None:
    """Write each file as a whole or not at all; folders are created. Raises TaccorlError: the disk is full, or a folder cannot
    be written to."""
    for path, text in texts.items():
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_text(text, encoding="utf-8")
            part.replace(path)
        except OSError as error:
            raise TaccorlError(
                f"{path.parent}: the report cannot be written: {error}"
            ) from error
