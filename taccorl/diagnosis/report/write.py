"""Write a report: ``report.html`` to read, and ``report.json`` with all its numbers. An earlier report is replaced, and the
result states it; another file of that name is not overwritten.
"""

import datetime
import json
from dataclasses import dataclass
from pathlib import Path

from taccorl.diagnosis.report.report import GENERATOR, NUMBERS, PAGE, Report, as_json
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import check_writable

HEAD_BYTES = 2048
"""Bytes at the start of a file in which ``GENERATOR`` is looked for."""


@dataclass(frozen=True)
class Written:
    """Paths of the files of a report."""

    page: Path
    """Path of ``report.html``."""
    numbers: Path
    """Path of ``report.json``."""
    replaced: str
    """Date of the earlier report that was replaced; empty if there was none."""


def check_folder(folder: Path, measurements: Path | None = None) -> str:
    """Check that a report may be written there; returns the date of the report that it will replace, empty if there is none.

    Args:
        measurements: folder of recordings, which must not contain the report, because all its files are read.

    Raises:
        TaccorlError: another file has the report's name, the folder cannot be written, or it is the folder of the recordings.
    """
    if measurements is not None and measurements.is_dir() and folder.resolve() == measurements.resolve():
        raise TaccorlError(f"{folder}: contains the recordings; give another folder for the report")
    if folder.exists() and not folder.is_dir():
        raise TaccorlError(f"{folder}: is a file; give a folder for the report")
    check_writable(folder)
    for name in (PAGE, NUMBERS):
        path = folder / name
        if path.exists() and GENERATOR not in _head(path):
            raise TaccorlError(
                f"{path}: already exists and is not a report of taccorl; give another folder, or remove it"
            )
    page = folder / PAGE
    if not page.exists():
        return ""
    when = datetime.datetime.fromtimestamp(page.stat().st_mtime).astimezone()
    return when.strftime("%Y-%m-%d %H:%M")


def _head(path: Path) -> str:
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return file.read(HEAD_BYTES).decode("utf-8", "replace")


def write_report(report: Report, folder: Path) -> Written:
    """Write ``report.html`` and ``report.json`` into ``folder``, which is created if necessary.

    Raises:
        TaccorlError: as ``check_folder``, or the folder cannot be written to.
    """
    from taccorl.diagnosis.report.page import page  # matplotlib only where something is drawn

    replaced = check_folder(folder)
    texts = {NUMBERS: json.dumps(as_json(report), indent=1, ensure_ascii=False) + "\n", PAGE: page(report)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            part = folder / f".{name}.part"
            part.write_text(text, encoding="utf-8")
            part.replace(folder / name)
    except OSError as error:
        raise TaccorlError(f"{folder}: the report cannot be written: {error}") from error
    return Written(folder / PAGE, folder / NUMBERS, replaced)
