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
from taccorl.report.diagnosed import account_section
from taccorl.report.fact import Account, fact
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
        diagnoses, accounts = {}, {}
        for part in self.parts:
            path = self.kept / f"{urllib.parse.quote(part, safe='')}.json"
            d = diagnoses[part] = json.loads(path.read_text())
            accounts[part] = _account(part, d)
        numbers = {
            "generator": f"{GENERATOR}, taccorl {taccorl.__version__}",
            "title": self.title,
            "finished": False,
            "provenance": dict(self.provenance),
            "verdicts": {part: a.as_json() for part, a in accounts.items()},
            "diagnoses": diagnoses,
        }
        sections = [
            Section(text=["This diagnosis is not finished."]),
            *map(account_section, accounts.values()),
        ]
        text = json.dumps(plain(numbers), indent=1, ensure_ascii=False)
        html = page.html(self.title, sections, GENERATOR)
        page.write({self.folder / NUMBERS: text, self.folder / PAGE: html})


def _account(part: str, d: Mapping[str, Any]) -> Account:
    """What was found in one part so far."""
    names = [e["effect"] for e in d["effects"] if e["effect"] not in d["present"]]
    kind = (
        ("effects" if names else "nothing_missing") if d["finished"] else "unfinished"
    )
    found = [fact(kind, part=part, missing=names)]
    found.append(fact("error_so_far", error=d["errors"]["after"]["validation"]))
    return Account.of_facts(part, found)
