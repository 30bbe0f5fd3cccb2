"""Progress of the verbs: bars in a terminal, lines now and then in a log file."""

import multiprocessing
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from taccorl.errors import printable

if TYPE_CHECKING:
    from taccorl.report.interim import Interim

LINE_EVERY_S = 5.0
"""Time between two lines of progress without a terminal [s]."""


class Bars:
    """Progress over recordings on stderr: rows of the current recording, or the number of finished recordings if several are
    processed at the same time.

    A bar in a terminal; elsewhere a line every ``LINE_EVERY_S`` with rate and time left.
    """

    def __init__(self, num_recordings: int, begin: str = "") -> None:
        """``begin``: text until the first update; that recordings are read, if not given."""
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self._progress = Progress(
            *columns, transient=True, console=Console(stderr=True)
        )
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
        short = name if len(name) <= 48 else f"…{name[-47:]}"
        self._progress.update(
            self._task, description=printable(short), completed=done, total=total
        )
        if self._progress.console.is_terminal:
            return
        now_s = time.monotonic()
        if self._begin[0] != total or done < self._begin[1]:
            self._begin = (total, done, now_s)
        if now_s - self._line_s >= LINE_EVERY_S:
            self._line_s = now_s
            _, first, first_s = self._begin
            rate_hz = (done - first) / (now_s - first_s) if now_s > first_s else 0.0
            left = (
                f", {rate_hz:.3g}/s, {(total - done) / rate_hz:.0f} s left"
                if rate_hz
                else ""
            )
            print(
                f"{printable(name)}: {done} of {total}{left}",
                file=sys.stderr,
                flush=True,
            )


@dataclass
class Steps:
    """Prints on stderr what a search, a check or a policy is doing, now and then; processes may have copies of it."""

    every_s: float = LINE_EVERY_S
    """Least time between two lines [s]."""
    begun_s: float = field(default_factory=lambda: time.monotonic())
    """Time of the beginning [s], which lines state."""
    line_s: float = field(default_factory=lambda: time.monotonic())
    """Time of the last line [s]."""
    asked: Path | None = None
    """File that is there once the user has typed Ctrl-C, or SIGTERM came; all processes see it."""
    interim: "Interim | None" = None
    """Writer of what a search has found so far; None: it is not written."""

    @property
    def stopped_by(self) -> int:
        """Number of the signal that asked the command to stop; 0: none did."""
        if self.asked is None or not self.asked.exists():
            return 0
        return int(self.asked.read_text() or signal.SIGINT)

    @contextmanager
    def until_interrupted(self) -> Iterator["Steps"]:
        """Context manager. After the first Ctrl-C or SIGTERM, calls of this object raise ``Stopped``, in worker processes, too; a
        second one ends the command."""
        if (
            threading.current_thread() is not threading.main_thread()
        ):  # in which alone signals can be handled
            yield self
            return
        with tempfile.TemporaryDirectory() as folder:
            asked = self.asked = Path(folder) / "stop"

            def ask(number: int, *_: object) -> None:
                asked.write_text(str(int(number)))
                as_before()
                print(
                    "\nstopping with what was found; Ctrl-C again ends without it",
                    file=sys.stderr,
                    flush=True,
                )

            def as_before() -> None:
                for number, handler in before.items():
                    signal.signal(number, handler)

            both = (signal.SIGINT, signal.SIGTERM)
            before = {number: signal.signal(number, ask) for number in both}
            try:
                yield self
            finally:
                as_before()

    def __call__(self, part: str, text: str = "") -> None:
        """Print the present step ``text`` of ``part``, with the time since the beginning. What a search has found so far is
        written at once (``interim``)."""
        if self.asked is not None:
            from taccorl.diagnosis.search.problem import Found, Stopped

            if self.interim is not None and isinstance(text, Found):
                self.interim.add(part, text)

            if (
                multiprocessing.parent_process() is not None
            ):  # a worker, which its parent stops
                signal.signal(signal.SIGINT, signal.SIG_IGN)
            if self.stopped_by:
                raise Stopped
        now_s = time.monotonic()
        if now_s - self.line_s >= self.every_s:
            self.line_s = now_s
            step = f"{printable(part)}: {text}" if text else printable(part)
            print(f"{step} ({now_s - self.begun_s:.0f} s)", file=sys.stderr, flush=True)


class Attempts:
    """Prints the lines of attempts, each with the rate of those that count and the time left."""

    def __init__(
        self,
        total: int | None = None,
        counts: Callable[[str], bool] = lambda line: True,
    ) -> None:
        """``total``: number of lines that count at the end; None: unknown. ``counts``: whether a line counts."""
        self._total, self._counts, self._done, self._begin_s = (
            total,
            counts,
            0,
            time.monotonic(),
        )

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
