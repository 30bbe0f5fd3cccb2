"""Measurements from LeRobot datasets: rows at the dataset's rate, one measurement per episode.

Datasets of this project state their units. For those of other people a columns file (``tables``) states them; the name of a
column is that of the feature, a point, and the name of the element, or its number from 0 where elements have no names::

    time: {column: timestamp, unit: s}
    signals:
      elbow_flex:
        q:        {column: observation.state.elbow_flex.pos, unit: deg}
        q_target: {column: action.elbow_flex.pos, unit: deg}
      gripper:                             # 0 … 100 for -0.17 … 1.75 rad: 9.09 at 0 rad, 0.0192 rad each
        q:        {column: observation.state.gripper.pos, unit: rad, factor: 0.0192, zero: 9.09}
        q_target: {column: action.gripper.pos, unit: rad, factor: 0.0192, zero: 9.09}

LeRobot's record loop reads the positions of row k and then sends the action of row k, which is therefore in force from row k on.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np

from taccorl.alignment.measurements.measurement import Measurement, Touch
from taccorl.alignment.measurements.quantisation import find_quantum
from taccorl.alignment.measurements.recorded import (
    pad_features,
    pads_of,
    signal_names,
    signal_units,
)
from taccorl.alignment.measurements.tables import (
    TableSpec,
    measurement_of_columns,
    wanted_columns,
)
from taccorl.data.dataset import Dataset
from taccorl.data.episode import Episode
from taccorl.data.origin import UNSTATED, Origin
from taccorl.data.spec import ACTION, STATE
from taccorl.errors import RecordingError, TaccorlError, nearest

TIME = (
    "timestamp"  # Column of a LeRobot dataset with the time of a row in its episode [s]
)


def read_dataset(
    root: Path, columns: TableSpec | None = None, *, is_all: bool = False
) -> list[Measurement]:
    """One measurement per episode of a dataset, in their order, at the dataset's rate. ``columns``: names and units of the
    columns of a dataset that states none. A dataset that states its units is read by those. ``is_all``: nothing else is read, so
    that ``columns`` can be meant for this dataset only. Raises TaccorlError: it is not a dataset, its numbers have no units, it
    does not state its action_time, it lacks a column, or it states its units and ``columns`` would too."""
    dataset = Dataset(root)
    try:
        names, units = signal_names(dataset.spec), signal_units(dataset.spec)
    except RecordingError as error:
        if columns is not None:
            return [
                _from_columns(dataset, columns, k) for k in range(dataset.num_episodes)
            ]
        raise TaccorlError(
            f"{root}: {error}. Only datasets of taccorl state their units (meta/taccorl/). State those of others in a columns "
            "file (--columns, or `columns:` in measurements.yaml); `taccorl init-robot MODEL --dataset=DATASET` drafts one"
        ) from error
    if is_all and columns is not None:
        raise TaccorlError(
            f"{root}: this dataset states its units itself (meta/taccorl/), so its columns file would not be used: leave out "
            "--columns or `columns:` of measurements.yaml. If the stated units are wrong, correct the spec and ingest again"
        )
    return [
        from_episode(dataset.episode(k), names, units, Path(root), k)
        for k in range(dataset.num_episodes)
    ]


def dataset_columns(dataset: Dataset) -> dict[str, tuple[str, int]]:
    """Name of each column of numbers → (feature, index of its element), in the order of the dataset; without ``TIME``."""
    found = {}
    for key, feature in dataset.spec.features.items():
        if feature.dtype != "video":
            names = feature.names or tuple(map(str, range(feature.size)))
            found |= {f"{key}.{name}": (key, j) for j, name in enumerate(names)}
    return found


def _from_columns(dataset: Dataset, columns: TableSpec, k: int) -> Measurement:
    """One episode of a dataset without units as a measurement, read as a table."""
    if not columns.signals:
        raise TaccorlError(
            f"{dataset.root}: its columns file names no signals, and only tables have taccorl's own names; state them"
        )
    known, name = dataset_columns(dataset), f"{dataset.root.name}/episode_{k}"
    wanted = wanted_columns(columns, [TIME, *known])
    for column in wanted:
        if column != TIME and column not in known:
            raise RecordingError(
                f"{dataset.root}: no column {column!r}; {nearest(column, [TIME, *known])}"
            )
    stored = dataset.values(
        k, sorted({known[c][0] if c in known else TIME for c in wanted})
    )
    values = {
        c: stored[known[c][0]][:, known[c][1]] if c in known else stored[TIME].ravel()
        for c in wanted
    }
    for column, numbers in values.items():
        bad = np.flatnonzero(~np.isfinite(numbers))
        if len(bad):
            raise RecordingError(
                f"{name}: column {column!r}: row {bad[0]} is not finite; remove the episode"
            )
    stated, found = (
        Origin(columns.domain, columns.origin),
        dataset.episode_facts(k).get("origin", UNSTATED),
    )
    m = measurement_of_columns(
        dataset.data_file(k),
        {column: numbers.astype(float) for column, numbers in values.items()},
        columns,
        name=name,
        origin=stated
        if found == UNSTATED
        else found.agreed(stated.domain, "the columns file"),
    )
    tasks = dataset.tasks(k)
    return dataclasses.replace(
        m, instruction=columns.instruction or (tasks[0][1] if tasks else "")
    )


def from_episode(
    episode: Episode, names: tuple[str, ...], units: tuple[str, ...], root: Path, k: int
) -> Measurement:
    """Read one episode of a dataset as a measurement. Its target at a row is the command that the joint was following when the
    row was recorded; ``DatasetSpec.action_time`` states which row of ``action`` that is.

    ``next_row``: the action of row t is reached, in a straight line, at row t + 1, so that row k of the measurement is row k + 1
    of the episode with the action of row k (T rows → T − 1). ``this_row``: the action of row t is in force from row t (T rows).
    ``names``, ``units``: of the J signals, in the order of the columns of state and action. ``root``: folder of the dataset.
    ``k``: index of the episode. Raises TaccorlError: there are too few rows, or the dataset does not state its action_time."""
    episode.spec.require_action_time(episode.name)
    state, action = (
        episode.arrays[STATE].astype(float),
        episode.executed().astype(float),
    )
    first = 1 if episode.spec.action_time == "next_row" else 0
    target, measured = action[: len(action) - first], state[first:]
    if len(measured) < 2:
        raise TaccorlError(
            f"{episode.name}: {len(state)} rows, too few for a measurement; delete it with lerobot-edit-dataset"
        )
    time_s = np.arange(len(measured)) / episode.spec.fps
    touch = None
    features = [key for key in pad_features(episode.spec) if key in episode.arrays]
    if features:
        pads = tuple(pad for key in features for pad in pads_of(episode.spec, key))
        counts = [episode.arrays[key][first:].astype(np.int16) for key in features]
        resting = [
            np.asarray(episode.baselines.get(key, np.zeros(own.shape[1])))
            for key, own in zip(features, counts, strict=True)
        ]
        touch = Touch(
            time_s=np.repeat(time_s[:, None], len(pads), axis=1),
            counts=np.concatenate(counts, axis=1),
            baseline=np.concatenate(resting),
            pads=pads,
        )
    ages = [
        t.age_max_s
        for t in episode.timing
        if t.feature in (STATE, ACTION) and math.isfinite(t.age_max_s)
    ]
    return Measurement(
        name=f"{root.name}/episode_{k}",
        time_s=time_s,
        target=target,
        measured=measured,
        signals=names,
        units=units,
        quantum=np.array([find_quantum(column) for column in measured.T]),
        touch=touch,
        source=root,
        origin=episode.origin,
        instruction=episode.instruction,
        start_ns=episode.start_ns,
        time_error_s=max(ages, default=0.0),
        timing=tuple(t for t in episode.timing if t.feature in (STATE, ACTION)),
    )
