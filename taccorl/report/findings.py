"""Sections of what checks found: one episode, recording or dataset; findings that several recordings share are listed once."""

import dataclasses
from collections.abc import Mapping, Sequence

from taccorl.data.finding import Finding, listed
from taccorl.report.section import Cell, Section

SEVERITIES = ("error", "warning", "note")


def found_in(name: str, findings: Sequence[Finding]) -> Section:
    """The worst severity, and each finding, of one episode, recording or dataset."""
    worst = next(
        (s for s in ("error", "warning") if any(f.severity == s for f in findings)),
        "ok",
    )
    unjudged = sum(f.check == "not_judged" for f in findings) if worst == "ok" else 0
    head = (
        f"{worst:9s}{name}"
        + f" ({unjudged} check{'s' * (unjudged > 1)} could not be made)"
        * bool(unjudged)
    )
    lines = [
        Cell(f"  {f.severity:8s}{f.check}: {f.text}", f.severity) for f in findings
    ]
    return Section(text=[Cell(head, "good" if worst == "ok" else worst), *lines])


def found_in_recordings(found: Mapping[str, Sequence[Finding]]) -> list[Section]:
    """Findings of each recording, equal ones in one line. What several recordings share is said once, with the first of them
    and their number. ``found``: name of a recording → its findings."""
    shared: dict[tuple[str, str, str], list[tuple[str, Finding]]] = {}
    for name, findings in found.items():
        for f in findings:
            shared.setdefault(_key(f), []).append((name, f))
    several = {
        key: of
        for key, of in shared.items()
        if key[0] == "note" or len({name for name, _ in of}) > 1
    }
    sections = []
    for name, findings in found.items():
        own: dict[str, list[Finding]] = {}
        for f in findings:
            if _key(f) not in several:
                own.setdefault(f.check, []).append(f)
        if own:
            same = [
                dataclasses.replace(f, text=f.text + _also(more))
                for f, *more in own.values()
            ]
            sections.append(found_in(name, same))
    sound = [
        name
        for name, findings in found.items()
        if all(f.severity == "note" for f in findings)
    ]
    if sound:
        sections.append(found_in(f"{len(sound)} recordings: {listed(sound)}", []))
    lines = []
    for same in (
        of
        for severity in SEVERITIES
        for key, of in several.items()
        if key[0] == severity
    ):
        name, f = same[0]
        more = f" (and {further} more)" if (further := len(dict(same)) - 1) else ""
        others = [other for _, other in same if other.feature != f.feature]
        lines.append(
            Cell(
                f"  {f.severity:8s}{name}{more}: {f.check}: {f.text}{_also(others)}",
                f.severity,
            )
        )
    return [*sections, Section(text=lines)]


def _key(f: Finding) -> tuple[str, str, str]:
    """What findings in one line have in common: their topic, or the feature if they have none."""
    return f.severity, f.check, f.topic or f.feature


def _also(others: Sequence[Finding]) -> str:
    return (
        f". Also: {', '.join(dict.fromkeys(f.feature for f in others))}"
        if others
        else ""
    )
