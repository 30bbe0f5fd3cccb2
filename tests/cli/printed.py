"""What a run of a command left behind: facts of its report, and the commands that it printed."""

import html
import json
import re
from pathlib import Path
from typing import Any


def facts(folder: Path, part: str) -> dict[str, list[dict[str, Any]]]:
    """Id → values of the facts about one part in the report of a diagnosis."""
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    found: dict[str, list[dict[str, Any]]] = {}
    for fact in report["verdicts"][part]["facts"]:
        found.setdefault(fact["id"], []).append(fact["values"])
    return found


def commands(text: str) -> list[str]:
    """The commands of taccorl in a text, each from its name to the end of its line."""
    return [found.strip() for found in re.findall(r"(taccorl [a-z].*)", text)]


def of_page(path: Path) -> list[str]:
    """The commands that a page shows as code."""
    code = re.findall(r"<code>(taccorl .*?)</code>", path.read_text(encoding="utf-8"))
    return [html.unescape(found) for found in code]
