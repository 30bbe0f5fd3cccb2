"""Measurements from datasets of this project: rows at the dataset's rate, one measurement per episode."""

import math
from pathlib import Path

import numpy as np

from taccorl.alignment.measurements.measurement import Measurement, Touch
from taccorl.alignment.measurements.quantisation import find_quantum
from taccorl.alignment.measurements.recorded import TACTILE, signal_names, signal_units
from taccorl.data.arms import ACTION, STATE
from taccorl.data.dataset import Dataset
from taccorl.data.episode import Episode
from taccorl.errors import RecordingError, TaccorlError
from taccorl.robots import ROBOT


def read_dataset(root: Path) -> list[Measurement]:
    """One measurement per episode of a dataset, in their order, at the dataset's rate.

    Raises:
        TaccorlError: it is not a dataset, its numbers have no units, or it does not state its action_time.
    """
    dataset = Dataset(root)
    try:
        names, units = signal_names(dataset.spec), signal_units(dataset.spec)
    except RecordingError as error:
        raise TaccorlError(
            f"{root}: {error}. Units are stated in meta/taccorl/, which only taccorl's commands write; convert other datasets "
            "by `taccorl ingest` with a spec"
        ) from error
    return [from_episode(dataset.episode(k), names, units, Path(root), k) for k in range(dataset.num_episodes)]


def from_episode(episode: Episode, names: tuple[str, ...], units: tuple[str, ...], root: Path, k: int) -> Measurement:
    """One episode of a dataset as a measurement. Row k of the measurement is row k + 1 of the episode (T rows → T − 1).

    The action of row t is reached, in a straight line, at row t + 1 (``DatasetSpec.action_time``): the command in force at
    row t is the action of row t − 1. Row 0 has none.

    Args:
        names, units: of the J signals, in the order of the columns of state and action.
        root: folder of the dataset.
        k: index of the episode.

    Raises:
        TaccorlError: there are too few rows, or the dataset does not state its action_time.
    """
    episode.spec.require_action_time(episode.name)
    state, action = episode.arrays[STATE].astype(float), episode.executed().astype(float)
    target, measured = action[:-1], state[1:]
    if len(measured) < 2:
        raise TaccorlError(f"{episode.name}: {len(state)} rows are too few for a measurement")
    time_s = np.arange(len(measured)) / episode.spec.fps
    touch = None
    if TACTILE in episode.arrays:
        counts = episode.arrays[TACTILE][1:].astype(np.int16)
        baseline = np.asarray(episode.baselines.get(TACTILE, np.zeros(counts.shape[1])))
        touch = Touch(time_s=np.repeat(time_s[:, None], len(ROBOT.pads), axis=1), counts=counts, baseline=baseline)
    ages = [t.age_max_s for t in episode.timing if t.feature in (STATE, ACTION) and math.isfinite(t.age_max_s)]
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
