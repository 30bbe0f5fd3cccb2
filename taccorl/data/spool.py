"""Arrays of a recording in a temporary file on disk, so that memory use does not grow with the recording's length."""

import mmap
from pathlib import Path

import numpy as np

from taccorl.errors import RecordingError


class Spool:
    """Rows that are appended to a file on disk and read back as one memory-mapped array, so that memory does not grow."""

    def __init__(self, folder: Path, name: str) -> None:
        self._path = folder / f"{name}.spool"
        self._file = self._path.open("wb")
        self._first: np.ndarray | None = None
        self._rows = 0

    def append(self, row: np.ndarray) -> None:
        """Append one row (1-D array); all rows of a channel have the same size and dtype."""
        if self._first is None:
            self._first = row
        elif row.size != self._first.size:
            raise RecordingError(
                f"{row.size} values after messages with {self._first.size}"
            )
        self._file.write(row.astype(self._first.dtype, copy=False).tobytes())
        self._rows += 1

    def finish(self) -> np.ndarray:
        """All rows as a memory-mapped array (rows, size)."""
        self._file.close()
        if self._first is None:
            return np.empty((0, 0))
        return np.memmap(
            self._path,
            dtype=self._first.dtype,
            mode="r",
            shape=(self._rows, self._first.size),
        )


def release(values: np.ndarray) -> None:
    """Release the memory of ``values``, a memory-mapped array (rows, size). It is read from disk again at its next use."""
    mapped = getattr(values, "_mmap", None)
    if mapped is not None and hasattr(mapped, "madvise"):
        mapped.madvise(mmap.MADV_DONTNEED)
