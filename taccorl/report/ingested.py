"""Sections of an ingest, and of the contents of one recording."""

from collections import Counter
from typing import Any

from taccorl.data.inspection import Inventory
from taccorl.data.recording import without_place
from taccorl.report.section import Cell, Section, Value

LONG_TEXT = 400
"""Most characters of a metadata record that are shown: rosbag2 writes pages of settings into one."""
GRADES = {
    "written": "good",
    "split": "warning",
    "quarantined": "error",
    "refused": "error",
}
"""Outcome of a recording → style."""


def ingested(report: dict[str, Any]) -> Section:
    """One row for each recording, and below their faults; ``report`` is that of ``ingest``."""
    rows, lines = [], []
    for r in report["recordings"]:
        name = r["recording"] + (f"#{r['part']}" if r["part"] else "")
        written = [e for e in r["episodes"] if e["outcome"] == "written"]
        grade = GRADES[r["outcome"]]
        rows.append(
            [
                name,
                Cell(_outcome(r), grade),
                str(len(written)),
                str(sum(e["rows"] for e in written)),
            ]
        )
        if r["reason"]:
            lines.append(
                Cell(
                    f"{r['outcome']} {name}: {without_place(r['reason'], r['recording'])}",
                    grade,
                )
            )
        if r["outcome"] != "written":
            lines.append(Cell(f"  look: {r['command']}", "bold"))
        for e in r["episodes"]:
            where = " ".join(w for w in (name, e["name"]) if w)
            found = (f for f in e["findings"] if f["severity"] != "note")
            lines += [
                Cell(
                    f"  {f['severity']}: {where}: {f['feature']}: {f['text']}",
                    f["severity"],
                )
                for f in found
            ]
    unprotected = Counter(
        r["unprotected"] for r in report["recordings"] if r.get("unprotected")
    )
    lines += [
        f"  note: {n} of {len(rows)} recordings: {text}"
        for text, n in unprotected.items()
    ]
    counts = ", ".join(f"{n} {outcome}" for outcome, n in report["outcomes"].items())
    heads = ("recording", "outcome", "episodes", "rows")
    return Section(
        heads=heads, rows=rows, parts=[Section(text=[*lines, f"recordings: {counts}"])]
    )


def _outcome(r: dict[str, Any]) -> str:
    """Outcome of a recording, and whether all of it became rows."""
    if r["outcome"] not in ("written", "split"):
        return r["outcome"]
    lost = r["rows_lost"]
    whole = "whole" if r["outcome"] == "written" else "no row lost"
    return f"{r['outcome']}, {f'{lost} row{"s" * (lost > 1)} lost' if lost else whole}"


def contents(inventory: Inventory) -> Section:
    """Channels, rates, gaps, clock skew and damage of one recording."""
    files = (
        f" ({len(inventory.source.files)} files)"
        if len(inventory.source.files) > 1
        else ""
    )
    if beside := [path.name for path in inventory.source.beside]:
        files += f" with {', '.join(beside)}"
    known = inventory.times_known
    duration = f"{inventory.duration_s:.2f}" if known else "–"
    rows, lines = [], []
    for t in inventory.topics:
        timed = bool(t.rate_hz) and known
        rate, gaps, gap = (
            (f"{t.rate_hz:.1f}", str(t.num_gaps), f"{t.longest_gap_s:.3f}")
            if timed
            else ("–",) * 3
        )
        rows.append(
            [
                t.topic,
                t.type.name,
                str(t.num_messages),
                rate,
                gaps,
                gap,
                _clock(t) if known else "–",
            ]
        )
    lines: list[Value] = [
        f"names of {t.topic}: {', '.join(t.names)}" for t in inventory.topics if t.names
    ]
    lines += [
        f"before its first key frame {t.topic}: {t.unusable} messages, which give no picture"
        if t.is_picture
        else f"without names or values {t.topic}: {t.unusable} messages, which give no sample"
        for t in {t.topic: t for t in inventory.topics if t.unusable}.values()
    ]
    lines += [
        Cell(f"not decodable {t.problem}", "warning")
        for t in inventory.topics
        if t.problem
    ]
    for name, record in inventory.metadata.items():
        text = str(record)
        more = f" … ({len(text):,} characters)" if len(text) > LONG_TEXT else ""
        lines.append(f"metadata {name}: {text[:LONG_TEXT]}{more}")
    lines += [Cell(f"damage {d}", "error") for d in inventory.damage]
    return Section(
        title=f"{inventory.source.name}{files}  {inventory.reader}, {duration} s",
        heads=(
            "topic",
            "type",
            "messages",
            "rate [Hz]",
            "gaps",
            "longest gap [s]",
            "clock",
        ),
        rows=rows,
        right=range(2, 6),
        parts=[Section(text=lines)],
    )


def _clock(t: Any) -> str:
    if not t.num_messages:
        return "–"
    if not t.stamped:
        return "log (no header)"
    if t.sim_time:
        return f"header is {t.skew_s:.6g} s behind log: simulation time?"
    repeated = f", {t.repeated} repeated" if t.repeated else ""
    return f"log − header {1e3 * t.skew_s:.1f} ms ± {1e3 * t.skew_p99_s:.1f}{repeated}"
