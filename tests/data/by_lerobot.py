"""Datasets of given rows, written by LeRobot itself."""

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.dataset import PROVENANCE, dataset_spec_to_json, episode_record
from taccorl.data.episode import Episode
from taccorl.data.lerobot_format import quiet_lerobot, write_episodes

Row = Mapping[
    str, Any
]  # Feature → array, picture (rows, columns, 3) or text; and ``task``


def write_with_lerobot(
    root: Path,
    episodes: Iterable[Sequence[Row]],
    *,
    names: Mapping[str, list[str]] | None = None,
    images: Collection[str] = (),
    encoder: Mapping[str, Any] | None = None,
    **options: Any,
) -> Path:
    """Types and shapes are those of the first row. Pictures become videos, those of ``images`` remain pictures."""

    def feature(key: str, value: Any) -> dict[str, Any]:
        if isinstance(value, str):
            return {"dtype": "string", "shape": (1,), "names": None}
        if ".images." in key:
            dtype = "image" if key in images else "video"
            return {
                "dtype": dtype,
                "shape": value.shape,
                "names": ["height", "width", "channels"],
            }
        return {
            "dtype": str(value.dtype),
            "shape": np.shape(value),
            "names": (names or {}).get(key),
        }

    episodes = [list(rows) for rows in episodes]
    with quiet_lerobot():
        from lerobot.configs import RGBEncoderConfig
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        features = {
            key: feature(key, value)
            for key, value in episodes[0][0].items()
            if key != "task"
        }
        options = {
            "fps": 30,
            "rgb_encoder": RGBEncoderConfig(**encoder) if encoder else None,
            **options,
        }
        dataset = LeRobotDataset.create(
            f"local/{root.name}", root=root, features=features, **options
        )
        for rows in episodes:
            for row in rows:
                dataset.add_frame(dict(row))
            dataset.save_episode()
        dataset.finalize()
    return root


def write_described(root: Path, episodes: Sequence[Episode]) -> Path:
    """Episodes of one spec by taccorl's writer, with the records and the spec that ``taccorl ingest`` writes beside them."""
    write_episodes(episodes, root)
    (root / PROVENANCE).mkdir()
    (root / PROVENANCE / "episodes.json").write_text(
        json.dumps([episode_record(e, "") for e in episodes])
    )
    (root / PROVENANCE / "dataset_spec.json").write_text(
        json.dumps(dataset_spec_to_json(episodes[0].spec))
    )
    return root
