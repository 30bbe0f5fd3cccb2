"""The dataset of co-training: real and simulated episodes in one, each row told apart, with exact statistics.

``lerobot-train --policy.type=tactile_pi05 --policy.sim_weight=…`` weighs its rows (``taccorl.policies.tactile_pi05.mixture``).
"""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from taccorl.data.dataset import BOOKKEEPING, PROVENANCE, Dataset
from taccorl.data.lerobot_format import exact_stats, merge, quiet_lerobot
from taccorl.errors import DatasetError, InTheWayError
from taccorl.policies.tactile_pi05.mixture import IS_SIM

IS_SIM_FEATURE = {"dtype": "float32", "shape": (1,), "names": None, "unit": "1", "range": [0, 1]}
RECORD = PROVENANCE / "cotrain.json"


@dataclass(frozen=True)
class Part:
    """A dataset that went in."""

    dataset: str
    is_sim: bool
    episodes: int
    rows: int
    origins: tuple[str, ...]
    """What its episodes say they are from, such as a surrogate robot; empty: they do not say."""


def merge_domains(real: Sequence[Path], sim: Sequence[Path], out: Path) -> list[Part]:
    """Datasets of both domains → one at ``out``, with ``observation.is_sim`` and what all of them hold.

    A simulator's own columns (``sim.*``) and optional features that not all of them hold are left out. Statistics are computed
    anew over all rows: LeRobot 0.6.1 takes the mean of the datasets' quantiles, which is no quantile of theirs together.

    Args:
        real: datasets of the robot, or of a surrogate that stands for it.
        sim: datasets of the twin.

    Raises:
        DatasetError: none given, or they differ in a feature, fps or robot.
        InTheWayError: something is at ``out``.
    """
    roots = [*real, *sim]
    if not roots:
        raise DatasetError("co-training: no dataset given")
    if out.exists():
        raise InTheWayError(f"{out} exists already; nothing was touched: give another folder")
    datasets = [Dataset(root) for root in roots]
    shared = _shared_features(datasets)
    with tempfile.TemporaryDirectory(prefix="cotrain_", dir=out.resolve().parent) as name:
        copies = [_with_domain(d, k >= len(real), shared, Path(name) / f"part_{k}") for k, d in enumerate(datasets)]
        merge(copies, out)
    write_exact_statistics(out)
    parts = [
        Part(str(d.root), k >= len(real), d.num_episodes, int(d.info["total_frames"]), _origins(d))
        for k, d in enumerate(datasets)
    ]
    record = out / RECORD
    record.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps([asdict(part) for part in parts], indent=1, ensure_ascii=False) + "\n")
    return parts


def write_exact_statistics(root: Path) -> None:
    """Replace what ``meta/stats.json`` says of features that are numbers: over all rows, quantiles too."""
    with quiet_lerobot():
        from lerobot.datasets.io_utils import load_stats, write_stats

        stats = dict(load_stats(root) or {})
        features = json.loads((root / "meta/info.json").read_text())["features"]
        for key, feature in features.items():
            if key in BOOKKEEPING or feature["dtype"] in ("video", "image", "string"):
                continue
            stats[key] = exact_stats(_values(root, key))
        write_stats(stats, root)


def _values(root: Path, key: str) -> np.ndarray:
    """(rows, size) of the whole dataset."""
    pieces = []
    for path in sorted((root / "data").glob("*/*.parquet")):
        for chunk in pq.read_table(path, columns=[key]).column(key).chunks:
            flat = chunk.flatten() if hasattr(chunk, "flatten") and chunk.type.num_fields else chunk
            pieces.append(flat.to_numpy(zero_copy_only=False).reshape(len(chunk), -1))
    return np.concatenate(pieces)


def _shared_features(datasets: Sequence[Dataset]) -> set[str]:
    """
    Raises:
        DatasetError: a feature that is not the same in all, and that is neither a simulator's own nor optional.
    """
    first = datasets[0]
    everything = {key for d in datasets for key in d.info["features"]}
    shared = {key for key in everything if all(key in d.info["features"] for d in datasets)}
    for key in sorted(everything - shared - {IS_SIM}):
        optional = all(key not in d.spec.features or d.spec.features[key].optional for d in datasets)
        if not key.startswith("sim.") and not optional:
            has, lacks = (
                [d.root.name for d in datasets if (key in d.info["features"]) is there] for there in (True, False)
            )
            raise DatasetError(
                f"co-training: {', '.join(has)} has {key}, {', '.join(lacks)} has not: ingest them with the same data spec"
            )
    for d in datasets[1:]:
        for what in ("fps", "robot_type"):
            if d.info[what] != first.info[what]:
                raise DatasetError(
                    f"co-training: {what} is {first.info[what]} in {first.root.name}, {d.info[what]} in {d.root.name}: "
                    "ingest them with the same data spec"
                )
    return {key for key in shared if not key.startswith("sim.")}


def _with_domain(dataset: Dataset, is_sim: bool, keep: set[str], copy: Path) -> Path:
    """A copy with only the features of ``keep`` and ``observation.is_sim``."""
    with quiet_lerobot():
        from lerobot.datasets.dataset_tools import modify_features
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        features: dict[str, Any] = dataset.info["features"]
        drop = [key for key in features if key not in keep or key == IS_SIM]
        flags = np.full(int(dataset.info["total_frames"]), is_sim, dtype=np.float32)
        modify_features(
            LeRobotDataset(f"local/{copy.name}", root=dataset.root),
            add_features={IS_SIM: (flags, dict(IS_SIM_FEATURE))},
            remove_features=drop or None,
            output_dir=copy,
            repo_id=f"local/{copy.name}",
        )
    return copy


def _origins(dataset: Dataset) -> tuple[str, ...]:
    told = {str(dataset.told(k).get("origin") or "") for k in range(dataset.num_episodes)}
    return tuple(sorted(told - {""}))
