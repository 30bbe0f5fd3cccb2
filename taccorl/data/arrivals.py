"""Recordings that arrive in a folder while it is watched: which of them are complete, and which are new.

A recording counts as complete when the size and time of change of its files have been the same for ``SETTLED_S``. One that
changes later, because a recorder paused, is new again.
"""

from collections.abc import Callable, Sequence

from taccorl.data.ingest import Job

SETTLED_S = 5.0
"""Longer than the pauses between writes of common recorders (rosbag2 writes when its cache is full, or every second). A choice.
"""

_Key = tuple[str, str | None]
_Signature = tuple[tuple[int, int], ...] | None


class Arrivals:
    """Follows the recordings that ``find`` returns, to tell those that are complete from those that are still written."""

    def __init__(self, find: Callable[[], Sequence[Job]], settled_s: float = SETTLED_S) -> None:
        """``find``: all recordings that are there now, in order. ``settled_s``: time without change [s] after which a
        recording is complete."""
        self._find, self._settled_s = find, settled_s
        self._since: dict[_Key, tuple[_Signature, float]] = {}
        self._told: dict[_Key, _Signature] = {}
        self.complete: list[Job] = []
        """All complete recordings, as of the last call of ``look``."""
        self.growing: list[Job] = []
        """All recordings that are not complete yet, as of the last call of ``look``."""

    def look(self, now_s: float) -> list[Job]:
        """Return the complete recordings that no earlier call has returned in their present state. ``now_s``: time of a
        monotonic clock [s]."""
        self.complete, self.growing, new = [], [], []
        for job in self._find():
            key, signature = (str(job.source.path), job.source.part), _signature(job)
            if key not in self._since or self._since[key][0] != signature:
                self._since[key] = signature, now_s
            if signature is None or now_s - self._since[key][1] < self._settled_s:
                self.growing.append(job)
                continue
            self.complete.append(job)
            if self._told.get(key) != signature:
                self._told[key] = signature
                new.append(job)
        return new


def _signature(job: Job) -> _Signature:
    """Size and time of change of each file; None if one has just gone."""
    try:
        stats = [path.stat() for path in job.source.files]
    except OSError:
        return None
    return tuple((s.st_size, s.st_mtime_ns) for s in stats)
