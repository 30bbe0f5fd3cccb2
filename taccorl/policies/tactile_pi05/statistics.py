"""Statistics by which the policy normalises: exact ones of the dataset's rows, whatever its ``meta/stats.json`` holds.

LeRobot averages the quantiles of episodes and takes deviations in float32; datasets converted from v2.1 have no quantiles. Its
normaliser maps low … high to −1 … 1, (q01, q99) or (min, max) by ``normalization_mapping``, and divides by 1e-8 where they are
equal. So low and high get a finite distance. With c their middle, h half of it, and n elements:

    an element that moves          h ← max(h, (max − min) / 20), so that normalised values are at most 20 in size
    a state that never moves       h ← 0.01 · √(mean of h² of those that move), 1 without any: in use it may be elsewhere
    an action that never moves     h = 0: it is −1 for LeRobot, and every output of the policy means this one value
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import NormalizationMode
from lerobot.utils.constants import ACTION, OBS_STATE

from taccorl.data.dataset import data_files, feature_rows
from taccorl.data.exact_statistics import known_rows, statistics_of_rows
from taccorl.data.lerobot_format import STATED
from taccorl.errors import TaccorlError

LIMITS = {
    NormalizationMode.QUANTILES: ("q01", "q99"),
    NormalizationMode.QUANTILE10: ("q10", "q90"),
    NormalizationMode.MIN_MAX: ("min", "max"),
}
"""Mode of normalisation → the statistics that it maps to −1 and 1."""
MOST_SIZE = 20.0  # Largest normalised value of a dataset's row. A choice
STILL_SHARE = 0.01  # Half range of a state that never moves, relative to those that move. A choice
ROUNDING = 1e-6  # Range of float32 numbers, relative to the largest, that is no motion
TOLERANCE = 1e-3  # Difference of stored statistics, relative to the range, that is not worth a line
Statistics = dict[str, dict[str, np.ndarray]]  # Feature → statistic → (size,)
_log = logging.getLogger(__name__)


def use_exact_statistics(config: Any, meta: Any) -> None:
    """Replace, in LeRobot's metadata ``meta`` of a training dataset, the statistics by which a policy of this ``config``
    normalises by exact ones of the rows on disk; one line says so where they differ. Relative actions keep theirs, which the
    reader computes. Raises TaccorlError: the dataset has no rows here (it is streamed), and its statistics lack what the policy
    needs."""
    stats, root = meta.stats, Path(meta.root)
    if stats is None:
        return  # LeRobot ends before it has a policy
    names = _normalised_by(config, meta)
    differences: list[str] = []
    num_rows = 0
    for key, needed in names.items():
        exact = (
            _exact(root, key, meta.features[key]["shape"]) if _has_rows(root) else {}
        )
        if not exact:
            _require(stats, key, needed, meta)
            continue
        num_rows = int(exact["count"][0])
        differences += _differences(stats.get(key, {}), exact, key, needed)
        stats[key] = exact
    for key, kind in ((OBS_STATE, "STATE"), (ACTION, "ACTION")):
        if key in stats and key in meta.features:
            mode = config.normalization_mapping.get(kind, NormalizationMode.IDENTITY)
            stats[key] = with_finite_range(stats[key], mode, is_state=key == OBS_STATE)
    if differences and not config.resumed:
        more = f" (and {len(differences) - 1} more)" if len(differences) > 1 else ""
        _log.warning(
            "dataset %s (%s): normalised by exact statistics of its %d rows, not by its meta/stats.json: %s%s",
            *(meta.repo_id, root, num_rows, differences[0], more),
        )


def _normalised_by(config: Any, meta: Any) -> dict[str, tuple[str, ...]]:
    """Feature of the dataset that the policy normalises by its statistics → the statistics that it needs."""
    needed: dict[str, tuple[str, ...]] = {}
    for key, kind in ((OBS_STATE, "STATE"), (ACTION, "ACTION")):
        mode = config.normalization_mapping.get(kind, NormalizationMode.IDENTITY)
        if mode is not NormalizationMode.IDENTITY:
            needed[key] = LIMITS.get(mode, ("mean", "std"))
    if config.use_relative_actions:
        needed.pop(ACTION, None)
    if config.tactile:
        needed |= dict.fromkeys(config.tactile_layouts or {}, ("mean", "std"))
    return {
        key: names
        for key, names in needed.items()
        if meta.features.get(key, {}).get("dtype") in STATED
    }


def _has_rows(root: Path) -> bool:
    return (root / "data").is_dir() and bool(data_files(root))


def _exact(root: Path, key: str, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    known = known_rows(feature_rows(root, key))
    return statistics_of_rows(known, shape) if len(known) else {}


def _require(stats: Statistics, key: str, needed: tuple[str, ...], meta: Any) -> None:
    absent = [name for name in needed if name not in stats.get(key, {})]
    if absent:
        raise TaccorlError(
            f"dataset {meta.repo_id} ({meta.root}): its meta/stats.json has no {' and '.join(absent)} of {key}, and its rows are "
            "not on this disk (--dataset.streaming=true): train without streaming, which computes them, or from the copy that "
            "taccorl check --repair=COPY writes"
        )


def _differences(
    stored: Mapping[str, Any],
    exact: Mapping[str, np.ndarray],
    key: str,
    names: tuple[str, ...],
) -> list[str]:
    """Text on each statistic of ``names`` that is absent from ``stored`` or not the exact one."""
    found = []
    tolerance = TOLERANCE * (exact["max"] - exact["min"]) + 1e-5 * np.abs(exact["mean"])
    for name in names:
        own = np.asarray(stored.get(name, np.nan), dtype=float).ravel()
        if name not in stored or own.shape != exact[name].shape:
            found.append(f"{name} of {key} is not there")
            continue
        off = np.nan_to_num(np.abs(own - exact[name]), nan=np.inf) - tolerance - 1e-7
        if (off > 0.0).any():
            i = int(np.argmax(off))
            found.append(
                f"{name} of {key}, element {i}, is {own[i]:.6g} there, of the rows {exact[name][i]:.6g}"
            )
    return found


def with_finite_range(
    stats: Mapping[str, Any], mode: NormalizationMode, *, is_state: bool
) -> dict[str, Any]:
    """Copy of one feature's ``stats`` (name → (size,)), with low and high, or the deviation, of ``mode`` moved apart where an
    element hardly moves. ``is_state``: an element may be elsewhere in use than it ever was in the dataset."""
    found = dict(stats)
    if mode is NormalizationMode.IDENTITY or any(
        name not in found for name in ("min", "max", *LIMITS.get(mode, ("std",)))
    ):
        return found
    low, high = (np.asarray(found[name], dtype=float) for name in ("min", "max"))
    span = high - low
    still = is_state & (span <= ROUNDING * np.maximum(np.abs(low), np.abs(high)))
    if mode in LIMITS:
        ends = [np.asarray(found[name], dtype=float) for name in LIMITS[mode]]
        half = (ends[1] - ends[0]) / 2
    else:
        half = np.asarray(found["std"], dtype=float)
    least = span / MOST_SIZE
    moving = np.maximum(half, least)[~still]
    of_others = float(np.sqrt(np.mean(moving**2))) if len(moving) else 0.0
    least = np.where(still, STILL_SHARE * of_others or 1.0, least)
    if mode not in LIMITS:
        return found | {"std": np.maximum(half, least)}
    middle, wider = (ends[0] + ends[1]) / 2, half < least
    for name, end, side in zip(LIMITS[mode], ends, (-1.0, 1.0), strict=True):
        found[name] = np.where(wider, middle + side * least, end)
    return found
