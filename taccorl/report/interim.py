"""Report of a diagnosis that is not finished: what the search has accepted so far, so that nothing that ends it loses that.

It has the names and, in report.json, the keys of a finished report, which ``taccorl add-effect`` reads; ``finished`` is false.
"""

import json
import urllib.parse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import taccorl
from taccorl.diagnosis.search.problem import Found
from taccorl.report import page
from taccorl.report.report import GENERATOR, NUMBERS, PAGE, effects_as_json, plain
from taccorl.report.section import Section

NOT_FINISHED = "not finished: the diagnosis ended, or goes on; what is beside or in place of this was not tried"
"""Status of a part in a report that is not finished."""


@dataclass(frozen=True, kw_only=True)
class Interim:
    """Writer of such a report. Processes have copies of it, each for its part; the newest report is of all of them."""

    folder: Path
    """Folder of the report."""
    kept: Path
    """Folder for what is found in each part."""
    title: str
    provenance: Mapping[str, str]
    """As in ``Report``."""

    @property
    def parts(self) -> list[str]:
        """Names of the parts in which something was found."""
        return [urllib.parse.unquote(p.stem) for p in sorted(self.kept.glob("*.json"))]

    def add(self, part: str, found: Found) -> None:
        """Write the report with what was found in ``part``. Raises TaccorlError: it cannot be written."""
        d = {
            "status": "at_floor" if found.finished else "too_many",
            "words": str(found) if found.finished else NOT_FINISHED,
            "present": list(found.present),
            "effects": effects_as_json(found.effects),
            "base": found.base,
            "intervals": found.intervals,
            "errors": found.errors,
            "at_bound": [],
            "offers": [],
            "rounds": [],
            "finished": found.finished,
        }
        path = self.kept / f"{urllib.parse.quote(part, safe='')}.json"
        page.write({path: json.dumps(plain(d))})
        self.write()

    def write(self) -> None:
        """Write the report of all parts. Raises TaccorlError: it cannot be written."""
        diagnoses = {
            part: json.loads(
                (self.kept / f"{urllib.parse.quote(part, safe='')}.json").read_text()
            )
            for part in self.parts
        }
        findings = {part: _words(part, d) for part, d in diagnoses.items()}
        numbers = {
            "generator": f"{GENERATOR}, taccorl {taccorl.__version__}",
            "title": self.title,
            "finished": False,
            "provenance": dict(self.provenance),
            "verdicts": {part: {"finding": text} for part, text in findings.items()},
            "diagnoses": diagnoses,
        }
        text = Section(text=["This diagnosis is not finished.", *findings.values()])
        page.write(
            {
                self.folder / NUMBERS: json.dumps(
                    numbers, indent=1, ensure_ascii=False
                ),
                self.folder / PAGE: page.html(self.title, [text], GENERATOR),
            }
        )


def _words(part: str, d: Mapping[str, Any]) -> str:
    """Sentence on what was found in one part."""
    names = [e["effect"] for e in d["effects"] if e["effect"] not in d["present"]]
    error = d["errors"]["after"]["validation"]
    state = "" if d["finished"] else f"; {NOT_FINISHED}"
    return f"{part}: {' and '.join(names) or 'no effect'}, validation error {error:.2f} noise floors{state}."
