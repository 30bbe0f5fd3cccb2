"""Output of the verbs: tables and progress bars, readable in a narrow terminal and in a log file."""

import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text as RichText

from taccorl.data.inspection import Inventory
from taccorl.data.recording import without_place
from taccorl.errors import printable

WIDE = 150
"""Width of tables in a log file or pipe [characters]."""
LINE_EVERY_S = 5.0
"""Time between two lines of progress without a terminal [s]."""
LONG_TEXT = 400
"""Most characters of a metadata record that are shown: rosbag2 writes pages of settings into one."""
COLORS = {"written": "green", "split": "yellow", "quarantined": "red", "refused": "red"}
"""Outcome of a recording → colour."""
SEVERITY = {"error": "red", "warning": "yellow", "note": "dim"}
"""Severity of a finding → colour."""


def Text(text: str, style: str = "") -> RichText:
    """``text`` with control characters escaped, for names of topics and files that taccorl did not choose, in a style of rich."""
    return RichText(printable(text), style)


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """`taccorl … | head`: for ``cli.main`` to handle, not an exit code that means something else."""
        raise BrokenPipeError


def console() -> Console:
    """Console with the terminal's width; without a terminal, wide enough not to fold a topic's name."""
    found = _Console()
    return found if found.is_terminal else _Console(width=WIDE)


class Bars:
    """Progress over recordings on stderr: rows of the current recording, or the number of finished recordings if several are
    processed at the same time.

    A bar in a terminal; elsewhere a line every ``LINE_EVERY_S`` with rate and time left.
    """

    def __init__(self, num_recordings: int, begin: str = "") -> None:
        """
        Args:
            begin: text until the first update; that recordings are read, if not given.
        """
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self._progress = Progress(*columns, transient=True, console=Console(stderr=True))
        self._begin_text = begin or f"reading ({num_recordings} recordings)"
        self._task: Any = None
        self._line_s = time.monotonic()
        self._begin = (0, 0, self._line_s)
        """Total, number done and time [s] from which the rate is measured."""

    def __enter__(self) -> "Bars":
        if self._progress.console.is_terminal:
            self._progress.start()
        self._task = self._progress.add_task(self._begin_text, total=None)
        return self

    def __exit__(self, *_: object) -> None:
        if self._progress.console.is_terminal:
            self._progress.stop()

    def update(self, name: str, done: int, total: int) -> None:
        """Set the progress of the recording ``name``: ``done`` of ``total`` rows."""
        self._progress.update(self._task, description=printable(_shorten(name)), completed=done, total=total)
        if self._progress.console.is_terminal:
            return
        now_s = time.monotonic()
        if self._begin[0] != total or done < self._begin[1]:
            self._begin = (total, done, now_s)
        if now_s - self._line_s >= LINE_EVERY_S:
            self._line_s = now_s
            _, first, first_s = self._begin
            rate_hz = (done - first) / (now_s - first_s) if now_s > first_s else 0.0
            left = f", {rate_hz:.3g}/s, {(total - done) / rate_hz:.0f} s left" if rate_hz else ""
            print(f"{printable(name)}: {done} of {total}{left}", file=sys.stderr, flush=True)


@dataclass
class Steps:
    """Prints on stderr what a search or a check is doing, now and then; processes may have copies of it."""

    every_s: float = LINE_EVERY_S
    """Least time between two lines [s]."""
    begun_s: float = field(default_factory=lambda: time.monotonic())
    """Time of the beginning [s], which lines state."""
    line_s: float = field(default_factory=lambda: time.monotonic())
    """Time of the last line [s]."""

    def __call__(self, part: str, text: str) -> None:
        """Print the present step of ``part``, with the time since the beginning."""
        now_s = time.monotonic()
        if now_s - self.line_s >= self.every_s:
            self.line_s = now_s
            print(f"{printable(part)}: {text} ({now_s - self.begun_s:.0f} s)", file=sys.stderr, flush=True)


class Attempts:
    """Prints the lines of attempts, each with the rate of those that count and the time left."""

    def __init__(self, total: int | None = None, counts: Callable[[str], bool] = lambda line: True) -> None:
        """
        Args:
            total: number of lines that count at the end; None: unknown.
            counts: whether a line counts.
        """
        self._total, self._counts, self._done, self._begin_s = total, counts, 0, time.monotonic()

    def __call__(self, line: str) -> None:
        self._done += self._counts(line)
        rate_hz = self._done / max(time.monotonic() - self._begin_s, 1e-3)
        words = f"; {rate_hz:.3g}/s" if self._done else ""
        if words and self._total is not None and self._total > self._done:
            words += f", {(self._total - self._done) / rate_hz:.0f} s left"
        print(f"{printable(line)}{words}", flush=True)


def is_success(line: str) -> bool:
    """True if the line of an attempt states a success."""
    return ": success" in line


def ingest_table(report: dict[str, Any]) -> None:
    """Print one line per recording, and below the table their faults, in lines that are never cut or folded, so that they can be
    copied.
    """
    table = Table(box=None, pad_edge=False)
    for column in ("recording", "outcome", "episodes", "rows"):
        table.add_column(column, overflow="fold", no_wrap=column != "recording")
    for r in report["recordings"]:
        written = [e for e in r["episodes"] if e["outcome"] == "written"]
        rows = str(sum(e["rows"] for e in written))
        table.add_row(Text(_name(r)), Text(_outcome(r), COLORS[r["outcome"]]), str(len(written)), rows)
    out = console()
    out.print(table)
    for r in report["recordings"]:
        if r["reason"]:
            reason = without_place(r["reason"], r["recording"])
            out.print(Text(r["outcome"], COLORS[r["outcome"]]) + Text(f" {_name(r)}: {reason}"), soft_wrap=True)
        if r["outcome"] != "written":
            out.print(Text("  look: ") + Text(r["command"], "bold"), soft_wrap=True)
        for e in r["episodes"]:
            for f in e["findings"]:
                if f["severity"] != "note":
                    label = Text(f"  {f['severity']}: ", SEVERITY[f["severity"]])
                    where = " ".join(w for w in (_name(r), e["name"]) if w)
                    out.print(label + Text(f"{where}: {f['feature']}: {f['text']}"), soft_wrap=True)
    unprotected = Counter(r["unprotected"] for r in report["recordings"] if r.get("unprotected"))
    for text, number in unprotected.items():
        out.print(
            Text("  note: ", SEVERITY["note"]) + Text(f"{number} of {len(report['recordings'])} recordings: {text}"),
            soft_wrap=True,
        )
    counts = ", ".join(f"{n} {o}" for o, n in report["outcomes"].items())
    out.print(f"recordings: {counts}", highlight=False)


def _outcome(r: dict[str, Any]) -> str:
    """Outcome of a recording, and whether all of it became rows."""
    if r["outcome"] not in ("written", "split"):
        return r["outcome"]
    lost = r["rows_lost"]
    whole = "whole" if r["outcome"] == "written" else "no row lost"
    return f"{r['outcome']}, {f'{lost} row{"s" * (lost > 1)} lost' if lost else whole}"


def _name(r: dict[str, Any]) -> str:
    return r["recording"] + (f"#{r['part']}" if r["part"] else "")


def findings_table(name: str, findings: list[Any]) -> None:
    """Print the findings of ``taccorl check`` about one episode or dataset as a table."""
    out = console()
    worst = "error" if any(f.severity == "error" for f in findings) else "warning"
    if not any(f.severity in ("error", "warning") for f in findings):
        unjudged = sum(f.check == "not_judged" for f in findings)
        out.print(Text("ok       ", "green") + Text(name + (f" ({unjudged} checks not judged)" if unjudged else "")))
    else:
        out.print(Text(f"{worst:9s}", SEVERITY[worst]) + Text(name))
    for f in findings:
        out.print(Text(f"  {f.severity:8s}", SEVERITY[f.severity]) + Text(f"{f.check}: {f.text}"), soft_wrap=True)


def inventory_table(inventory: Inventory) -> None:
    """Print channels, rates, gaps, clock skew and damage of one recording as a table."""
    out = console()
    files = f" ({len(inventory.source.files)} files)" if len(inventory.source.files) > 1 else ""
    duration = f"{inventory.duration_s:.2f}" if inventory.times_known else "–"
    about = f"{files}  {inventory.reader}, {duration} s"
    out.print(Text(inventory.source.name, "bold") + Text(about), soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    for column in ("topic", "type", "messages", "rate [Hz]", "gaps", "longest gap [s]", "clock"):
        table.add_column(column, justify="left" if column in ("topic", "type", "clock") else "right", overflow="fold")
    for t in inventory.topics:
        timed = bool(t.rate_hz) and inventory.times_known
        rate, gaps, gap = (f"{t.rate_hz:.1f}", str(t.num_gaps), f"{t.longest_gap_s:.3f}") if timed else ("–",) * 3
        clock = _clock(t) if inventory.times_known else "–"
        table.add_row(Text(t.topic), Text(t.type.name), str(t.num_messages), rate, gaps, gap, clock)
    out.print(table)
    for t in inventory.topics:
        if t.names:
            out.print(Text(f"  names of {t.topic}: {', '.join(t.names)}"), soft_wrap=True)
    for topic, unusable in {t.topic: t.unusable for t in inventory.topics if t.unusable}.items():
        out.print(Text(f"  without names or values {topic}: {unusable} messages, which give no sample"), soft_wrap=True)
    for t in inventory.topics:
        if t.problem:
            out.print(Text("  not decodable ", "yellow") + Text(t.problem), soft_wrap=True)
    for name, record in inventory.metadata.items():
        text = str(record)
        shown = text if len(text) <= LONG_TEXT else f"{text[:LONG_TEXT]} … ({len(text):,} characters)"
        out.print(Text(f"  metadata {name}: {shown}"), soft_wrap=True)
    for d in inventory.damage:
        out.print(Text("  damage ", "red") + Text(str(d)), soft_wrap=True)


def _clock(t: Any) -> str:
    if not t.num_messages:
        return "–"
    if not t.stamped:
        return "log (no header)"
    if t.sim_time:
        return f"header is {t.skew_s:.6g} s behind log: simulation time?"
    return f"log − header {1e3 * t.skew_s:.1f} ms ± {1e3 * t.skew_p99_s:.1f}" + (
        f", {t.repeated} repeated" if t.repeated else ""
    )


def _shorten(name: str, width: int = 48) -> str:
    return name if len(name) <= width else "…" + name[1 - width :]
