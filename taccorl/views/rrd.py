"""Write .rrd files with errors raised: Rerun's own writer continues when the disk is full, and only logs it."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from taccorl.data.episode import Episode
from taccorl.views.outputs import APPLICATION

Progress = Callable[[str, int, int], None]
"""Function that is called with the name of an episode, the number of its rows whose pictures are written, and of all rows."""


def no_progress(name: str, done: int, total: int) -> None:
    """Report nothing."""


@dataclass(frozen=True)
class EpisodeLog:
    """Writes the rows of one episode into a recording of Rerun.

    Time lines: ``time`` [s] and, where the recording holds no other episode, ``frame_index``."""

    rec: rr.RecordingStream
    episode: Episode
    root: str = ""
    """Prefix of all entities of the episode, such as ``a/``; empty if the recording holds no other episode."""
    begins_s: float = 0.0
    """Time of row 0 on the time line [s]."""
    progress: Progress = no_progress

    def static(self, path: str, data: rr.AsComponents) -> None:
        """Log values that do not change over time, as the entity ``path``."""
        self.rec.log(f"{self.root}{path}", data, static=True)

    def send(
        self,
        path: str,
        columns: rr.ComponentColumnList,
        rows: Sequence[int] | None = None,
    ) -> None:
        """Log values that change, for all T rows or the given ones; ``columns`` have one entry per row."""
        index = np.asarray(
            range(self.episode.num_rows) if rows is None else rows, dtype=np.int64
        )
        # Rerun itself would round down.
        time_ns = np.round(1e9 * (self.begins_s + self.episode.time_s[index])).astype(
            "timedelta64[ns]"
        )
        indexes = [rr.TimeColumn("time", duration=time_ns)]
        if not self.root:
            indexes.append(rr.TimeColumn("frame_index", sequence=index))
        rr.send_columns(f"{self.root}{path}", indexes, columns, recording=self.rec)


@contextlib.contextmanager
def recording_to(rrd: Path, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """Context manager: a recording that is collected in memory and written to ``rrd`` when the context ends without an error.
    Raises OSError: ``rrd`` cannot be written completely."""
    with rr.RecordingStream(APPLICATION) as rec:
        stream = rec.binary_stream()
        # active, too: as the default alone, the web viewer shows its own arrangement instead
        rec.send_blueprint(blueprint, make_active=True, make_default=True)
        yield rec
        content = (
            stream.read()
        )  # once: each reading ends with a footer that counts from its own beginning
    assert content is not None  # not even the blueprint came
    rrd.write_bytes(content)
