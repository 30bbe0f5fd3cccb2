"""What an .rrd file holds, read with Rerun's own reader."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rerun.experimental import RrdReader


@dataclass(frozen=True)
class Column:
    """One component of one entity."""

    values: list[Any]  # One list of instances per row
    frame_index: list[int]  # Empty for static data
    time_s: np.ndarray


def read_rrd(path: Path) -> dict[str, dict[str, Column]]:
    """Entity path → component, e.g. ``Scalars:scalars`` → what was logged, in the order of rows."""
    rows: dict[tuple[str, str], list[tuple[int, float, Any]]] = defaultdict(list)
    static: set[tuple[str, str]] = set()
    for chunk in RrdReader(path).store().stream():
        batch = chunk.to_record_batch()
        names = [n for n in batch.schema.names if ":" in n]
        for name in names:
            key = (chunk.entity_path, name)
            values = batch.column(name).to_pylist()
            if chunk.is_static:
                static.add(key)
                rows[key] += [(-1, np.nan, v) for v in values]
                continue
            has_frames = (
                "frame_index" in batch.schema.names
            )  # not where two episodes share the time line
            frames = (
                batch.column("frame_index").to_pylist()
                if has_frames
                else [0] * len(values)
            )
            times_s = batch.column("time").cast("int64").to_numpy() / 1e9
            rows[key] += zip(frames, times_s, values, strict=True)
    found: dict[str, dict[str, Column]] = defaultdict(dict)
    for (path_, name), entries in rows.items():
        entries.sort(key=lambda e: e[:2])
        is_static = (path_, name) in static
        found[path_][name] = Column(
            values=[v for _, _, v in entries],
            frame_index=[] if is_static else [f for f, _, _ in entries],
            time_s=np.array([] if is_static else [t for _, t, _ in entries]),
        )
    return dict(found)
