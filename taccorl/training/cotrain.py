"""Merge real and simulated datasets for co-training: each row is marked with its domain, statistics are exact.

``taccorl merge`` makes it, ``lerobot-train --policy.type=tactile_pi05 --policy.sim_weight=…`` weights its rows
(``taccorl.policies.tactile_pi05.mixture``).
"""

import dataclasses
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.dataset import (
    PROVENANCE,
    Dataset,
    dataset_spec_from_json,
    dataset_spec_to_json,
    episode_record,
    state_domains,
    write_records,
)
from taccorl.data.joining import require_videos
from taccorl.data.lerobot_format import (
    change_features,
    copy_pictures,
    merge,
    write_exact_statistics,
)
from taccorl.data.origin import Origin
from taccorl.data.spec import DatasetSpec, FeatureSpec
from taccorl.errors import DatasetError, InTheWayError
from taccorl.lineage.destinations import is_free
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.policies.tactile_pi05.mixture import IS_SIM
from taccorl.sim.part_poses import PARTS_KEY

IS_SIM_FEATURE = {
    "dtype": "float32",
    "shape": (1,),
    "names": None,
    "unit": "1",
    "range": [0, 1],
}
"""Entry of the feature ``observation.is_sim`` in LeRobot's features: 1 for a simulated row, 0 for a real one."""
RECORD = PROVENANCE / "cotrain.json"
"""File in the merged dataset that lists its parts."""
VERSION = 3  # of the stage


@dataclass(frozen=True)
class Part:
    """One input dataset of the merge, with its domain and origins."""

    dataset: str
    """Path of the dataset's folder."""
    is_sim: bool
    episodes: int
    rows: int
    """Number of its rows."""
    origins: tuple[Origin, ...]
    """Origins of its episodes, each once."""


Progress = Callable[[str, int, int], None]
"""Function that is called with a text, the number of steps done and of all steps."""


def publish(
    real: Sequence[Path],
    sim: Sequence[Path],
    out: Path,
    store: Store,
    progress: Progress = lambda text, done, total: None,
    *,
    videos: bool = True,
) -> list[Part]:
    """Run ``merge_domains`` as a stage: the dataset is published at ``out``, outside of the store, which remembers its key; if
    the same merge is there already, it stays as it is. ``taccorl lineage explain`` shows its inputs.

    Returns the parts, first those of ``real``, then those of ``sim``.

    Raises:
        DatasetError: as ``merge_domains``; two datasets have the same content; with ``videos`` also a dataset whose frames are
            only in the frame cache.
        LineageError: numbers or pictures of a dataset were changed after it was written.
        InTheWayError: ``out`` holds something else.
    """
    check_domains(real, sim)
    for root in (*real, *sim):
        if videos:
            require_videos(root)

    def build(_: Any, inputs: list[Path], folder: Path) -> None:
        folder.rmdir()  # LeRobot wants to make it
        merge_domains(
            inputs[: len(real)], inputs[len(real) :], folder, progress, videos=videos
        )

    stage = Stage("cotraining", build, VERSION, manifest=f"{PROVENANCE}/manifest.json")
    config: dict[str, Any] = {
        "real": len(real),
        "sim": len(sim),
    }  # which they are, their content says
    config |= {} if videos else {"pictures": "cache"}
    datasets: dict[str, Artefact] = {}
    for root in (*real, *sim):
        dataset = store.dataset(root)
        if same := datasets.get(dataset.digest):
            raise DatasetError(
                f"{root} has the same content as {same.path}: give each dataset once"
            )
        datasets[dataset.digest] = dataset
    store.run(stage, config, [*datasets.values()], destination=out)
    told = json.loads((out / RECORD).read_text(encoding="utf-8"))
    return [
        Part(**{**part, "origins": tuple(map(Origin.read, part["origins"]))})
        for part in told
    ]


def check_domains(real: Sequence[Path], sim: Sequence[Path]) -> set[str]:
    """Check that the datasets at ``real`` and ``sim`` can be merged; returns the names of the features that all of them have.
    Raises DatasetError: as ``merge_domains``."""
    datasets = [Dataset(root) for root in (*real, *sim)]
    if not datasets:
        raise DatasetError(
            "no dataset given: --real=FOLDER, --sim=FOLDER; repeat them for several"
        )
    for d in datasets:
        if IS_SIM in d.info["features"]:
            raise DatasetError(
                f"{d.root} has {IS_SIM}, so that it is a merged dataset: give the datasets from which it was made"
            )
        d.spec.require_action_time(str(d.root))
    for d in datasets[: len(real)]:
        if twin := [origin for origin in origins_of(d) if origin.domain == "twin"]:
            raise DatasetError(
                f"--real={d.root}: its episodes are {twin[0]}: give --sim={d.root}. Where the twin stands in for the robot, "
                "collect with --domain=surrogate"
            )
    for d in datasets[len(real) :]:
        if other := [
            origin for origin in origins_of(d) if origin.domain in ("real", "surrogate")
        ]:
            raise DatasetError(
                f"--sim={d.root}: its episodes are {other[0]}: give --real={d.root}"
            )
    _check_pictures(datasets)
    return _shared_features(datasets, datasets[len(real) :])


def merge_domains(
    real: Sequence[Path],
    sim: Sequence[Path],
    out: Path,
    progress: Progress = lambda text, done, total: None,
    *,
    videos: bool = True,
) -> list[Part]:
    """Merge datasets of both domains into one at ``out``, with their common features and ``observation.is_sim``.

    A simulator's own columns (``sim.*``) and optional features that not all of them hold are left out, except for the poses of
    the parts: where all datasets of the twin have them, the other rows have NaN, which the pose loss of training leaves out.
    Statistics are computed anew over all rows: LeRobot 0.6.1 averages the datasets' quantiles, which is not the quantile of all
    rows.

    Args:
        real: datasets of the robot, or of a surrogate that stands for it.
        sim: datasets of the twin.
        videos: False: the result states its cameras and has no videos, as of ``taccorl collect --pictures=cache``;
            ``frame_cache.join_frames`` stores its frames.

    Raises:
        DatasetError: no dataset is given; they differ in a feature, fps or robot; one is merged already; one does not state its
            action_time, so that its actions may be shifted by a row; or episodes that state the twin as their origin are given
            as real.
        InTheWayError: something is at ``out``.
    """
    if not is_free(out):
        raise InTheWayError(
            f"{out} exists already; nothing was changed: give another folder"
        )
    shared = check_domains(real, sim)
    datasets = [Dataset(root) for root in (*real, *sim)]
    poses = next(
        (
            d.info["features"][PARTS_KEY]
            for d in datasets[len(real) :]
            if PARTS_KEY in shared
        ),
        None,
    )
    cameras = {
        key
        for d in datasets
        for key, f in d.info["features"].items()
        if f["dtype"] == "video"
    }
    num_steps = len(datasets) + 2
    with tempfile.TemporaryDirectory(
        prefix=f"{out.name}.parts_", dir=out.resolve().parent
    ) as name:
        copies = []
        for k, d in enumerate(datasets):
            progress(f"copying {d.root.name}", k, num_steps)
            added = {IS_SIM: (float(k >= len(real)), IS_SIM_FEATURE)}
            if poses is not None and PARTS_KEY not in d.info["features"]:
                added[PARTS_KEY] = (np.nan, poses)
            copies.append(Path(name) / f"part_{k}")
            change_features(
                d.root, copies[-1], shared if videos else shared - cameras, added
            )
            state_domains(
                copies[-1], []
            )  # LeRobot merges only what has the same metadata
        progress("joining", len(datasets), num_steps)
        merge(copies, out)
    progress("statistics", len(datasets) + 1, num_steps)
    write_exact_statistics(out)
    if not videos:
        copy_pictures(datasets[0].root, out)
    parts = [
        Part(
            str(d.root),
            k >= len(real),
            d.num_episodes,
            int(d.info["total_frames"]),
            origins_of(d),
        )
        for k, d in enumerate(datasets)
    ]
    _dump(
        out / RECORD,
        [
            asdict(part) | {"origins": [o.record() for o in part.origins]}
            for part in parts
        ],
    )
    write_records(out, [record for d in datasets for record in _records(d, shared)])
    described = [
        d for d in datasets if (d.root / PROVENANCE / "dataset_spec.json").is_file()
    ]
    if described:
        _dump(
            out / PROVENANCE / "dataset_spec.json",
            dataset_spec_to_json(_spec(described[0], described[1:], shared)),
        )
    return parts


def _shared_features(datasets: Sequence[Dataset], sims: Sequence[Dataset]) -> set[str]:
    """Features of the merged dataset. Raises DatasetError: a feature that is not the same in all, and that is neither a
    simulator's own nor optional."""
    first = datasets[0]
    everything = {key for d in datasets for key in d.info["features"]}
    shared = {
        key for key in everything if all(key in d.info["features"] for d in datasets)
    }
    for key in sorted(everything - shared):
        optional = all(
            key not in d.unstored
            and (key not in d.spec.features or d.spec.features[key].optional)
            for d in datasets
        )
        if not key.startswith("sim.") and not optional:
            has, lacks = (
                [d.root.name for d in datasets if (key in d.info["features"]) is there]
                for there in (True, False)
            )
            raise DatasetError(
                f"co-training: {', '.join(has)} has {key}, but {', '.join(lacks)} does not: ingest or collect them with the "
                "same features"
            )
    for d in datasets[1:]:
        for what in ("fps", "robot_type"):
            if d.info[what] != first.info[what]:
                raise DatasetError(
                    f"co-training: {what} is {first.info[what]} in {first.root.name}, but {d.info[what]} in {d.root.name}: "
                    "ingest them with the same data spec"
                )
    if sims and all(PARTS_KEY in d.info["features"] for d in sims):
        shared.add(PARTS_KEY)
    return {key for key in shared if not key.startswith("sim.")}


def _check_pictures(datasets: Sequence[Dataset]) -> None:
    """Raises DatasetError: a camera has pictures of another size."""
    first = datasets[0]
    for d in datasets[1:]:
        for key, f in d.info["features"].items():
            there, here = (
                list(f["shape"]),
                list(first.info["features"].get(key, f)["shape"]),
            )
            if f["dtype"] == "video" and there != here:
                raise DatasetError(
                    f"co-training: {key} is {there} in {d.root.name}, {here} in {first.root.name}: ingest them with the same "
                    "data spec"
                )


def _records(dataset: Dataset, shared: set[str]) -> list[dict[str, Any]]:
    """What ingest or the twin wrote down of each episode, its origin above all; of other people's datasets what there is."""
    path = dataset.root / PROVENANCE / "episodes.json"
    if not path.is_file():
        return [
            episode_record(dataset.episode(k), "") for k in range(dataset.num_episodes)
        ]
    records = json.loads(path.read_text(encoding="utf-8"))
    return [
        {
            **r,
            **dataset.episode_facts(k)["origin"].record(),
            "baselines": {key: v for key, v in r["baselines"].items() if key in shared},
        }
        for k, r in enumerate(records)
    ]


def _spec(dataset: Dataset, others: Sequence[Dataset], shared: set[str]) -> DatasetSpec:
    """Data spec of the merged dataset: that of ``dataset``, with the parts' poses of another one if it has none."""
    read = [
        dataset_spec_from_json(d.root / PROVENANCE / "dataset_spec.json")
        for d in (dataset, *others)
    ]
    spec, told = read[0], IS_SIM_FEATURE
    features = {key: f for key, f in spec.features.items() if key in shared}
    posed = [one.features[PARTS_KEY] for one in read if PARTS_KEY in one.features]
    if PARTS_KEY in shared and posed:
        features[PARTS_KEY] = dataclasses.replace(posed[0], optional=True)
    features[IS_SIM] = FeatureSpec(
        dtype=told["dtype"],
        shape=told["shape"],
        unit=told["unit"],
        frame="none",
        rate_hz=float(spec.fps),
        range=tuple(told["range"]),
    )
    sensors = {key: sensor for key, sensor in spec.sensors.items() if key in shared}
    return dataclasses.replace(spec, features=features, sensors=sensors)


def _dump(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        json.dumps(value, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )


def origins_of(dataset: Dataset) -> tuple[Origin, ...]:
    """Origins of the episodes, each once, in the order of their labels."""
    return tuple(
        sorted(
            {dataset.episode_facts(k)["origin"] for k in range(dataset.num_episodes)},
            key=str,
        )
    )
