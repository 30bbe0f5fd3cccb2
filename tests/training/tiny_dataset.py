"""Small LeRobot datasets by LeRobot's own writer: random numbers, pictures that tell their row, touch in its real layout."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import factory, lerobot_dataset, video_utils
from lerobot.processor import DataProcessorPipeline

from taccorl.data.dataset import PROVENANCE, dataset_spec_to_json
from taccorl.data.episode import Episode, Pictures
from taccorl.data.lerobot_format import write_episodes
from taccorl.data.origin import Origin
from taccorl.data.spec import (
    DatasetSpec,
    FeatureSpec,
    data_specs_folder,
    load_dataset_spec,
)
from taccorl.lineage.store import Store
from taccorl.training.frame_cache import FRAMES, FramesConfig, empty_frames

TOUCH, IS_SIM = "observation.tactile", "observation.is_sim"
WINDOWS = {TOUCH: [k / 30 for k in range(-9, 1)], "action": [k / 30 for k in range(10)]}
PICTURE_PX = 56
CHANGED: dict[Any, tuple[str, ...]] = {
    lerobot_dataset: ("DatasetReader", "get_safe_default_video_backend"),
    factory: ("resolve_delta_timestamps", "StreamingLeRobotDataset", "make_dataset"),
    video_utils: ("get_safe_default_video_backend",),
    DataProcessorPipeline: ("_save_pretrained",),
}
"""What ``reading.install`` changes in LeRobot."""


def assert_same(ours: dict, theirs: dict, but: tuple[str, ...] = ()) -> None:
    assert set(ours) == set(theirs)
    for key, value in theirs.items():
        if key in but:
            continue
        if isinstance(value, torch.Tensor):
            assert ours[key].dtype == value.dtype and torch.equal(ours[key], value), key
        else:
            assert ours[key] == value


def tiny_spec(
    *, cameras: int = 1, picture_px: int = PICTURE_PX, is_sim: bool = False
) -> DatasetSpec:
    """The shipped spec without its optional window, with fewer and smaller pictures."""
    spec = load_dataset_spec(data_specs_folder() / "taccorl_bimanual.yaml")
    features = {key: f for key, f in spec.features.items() if not f.optional}
    for key in spec.keys("video")[cameras:]:
        del features[key]
    for key, feature in features.items():
        if feature.dtype == "video":
            features[key] = dataclasses.replace(
                feature, shape=(picture_px, picture_px, 3)
            )
    if is_sim:
        told = {
            "dtype": "float32",
            "shape": (1,),
            "unit": "1",
            "frame": "none",
            "rate_hz": 30,
            "range": (0, 1),
        }
        features[IS_SIM] = FeatureSpec(**told)
    return dataclasses.replace(
        spec, features=features, sensors={TOUCH: spec.sensors[TOUCH]}
    )


def tiny_episode(
    spec: DatasetSpec, num_rows: int, seed: int, is_sim: float = 0.0
) -> Episode:
    """Touched in its second half."""
    rng = np.random.default_rng(seed)
    touch = rng.integers(-10, 10, (num_rows, 1536)).astype(np.int16)
    touch[num_rows // 2 :, 40:60] += 120
    low, high = spec.features["action"].limits.T
    state, action = rng.uniform(
        0.5 * low + 0.5 * high, 0.4 * low + 0.6 * high, (2, num_rows, 14)
    ).astype(np.float32)
    arrays = {"observation.state": state, "action": action, TOUCH: touch}
    if IS_SIM in spec.features:
        arrays[IS_SIM] = np.full((num_rows, 1), is_sim, dtype=np.float32)
    cameras = tuple(spec.keys("video"))

    def pictures() -> Iterator[Pictures]:
        for row in range(num_rows):
            shape = spec.features[cameras[0]].shape
            yield {
                key: np.full(shape, (20 + 5 * row + 40 * k) % 256, dtype=np.uint8)
                for k, key in enumerate(cameras)
            }

    return Episode(
        name=f"tiny {seed}",
        spec=spec,
        start_ns=0,
        arrays=arrays,
        pictures=pictures if cameras else lambda: iter([{}] * num_rows),
        picture_keys=cameras,
        instruction="insert the plug",
        origin=Origin("surrogate", "random numbers, not a robot"),
    )


def write_tiny(
    root: Path,
    *,
    rows: tuple[int, ...] = (24, 18),
    sim_episodes: int = 0,
    with_spec: bool = True,
    **spec_changes: int,
) -> Path:
    """Episodes of so many rows, the first ``sim_episodes`` of them simulated.

    Without ``with_spec`` as another program would write them."""
    spec = tiny_spec(is_sim=sim_episodes > 0, **spec_changes)
    write_episodes(
        [tiny_episode(spec, n, k, float(k < sim_episodes)) for k, n in enumerate(rows)],
        root,
    )
    if with_spec:
        write_spec(root, spec)
    return root


def put_frames(store: Store, root: Path, key: str, frames: np.ndarray) -> Path:
    """Frames (F, 3, rows, columns) of the camera ``key`` of a dataset in the store's cache; returns the artefact's folder."""

    def put(config: FramesConfig, inputs: list[Path], out_dir: Path) -> None:
        empty_frames(out_dir, key, len(frames), frames.shape[2:])[:] = frames

    return store.run(
        FRAMES.bound(put), FramesConfig(frames.shape[2:]), [store.dataset(root)]
    ).path


def write_spec(root: Path, spec: DatasetSpec) -> None:
    """``meta/taccorl/dataset_spec.json`` of a dataset."""
    (root / PROVENANCE).mkdir(exist_ok=True)
    (root / PROVENANCE / "dataset_spec.json").write_text(
        json.dumps(dataset_spec_to_json(spec))
    )
