"""Datasets, joined, beside what LeRobot's own ``aggregate_datasets`` makes of them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from taccorl.data.dataset import Dataset
from taccorl.data.dataset_checks import check_bookkeeping
from taccorl.data.episode import Episode
from taccorl.data.lerobot_format import _join, merge, write_episodes
from taccorl.data.origin import Origin
from taccorl.data.spec import DatasetSpec, load_dataset_spec

SPEC = """
spec_version: 1
name: numbers
fps: 30
robot_type: two joints
action_time: next_row
features:
  observation.images.top:
    {dtype: video, shape: [32, 48, 3], unit: rgb8, frame: camera, rate_hz: 30, range: [0, 255], optional: true}
  observation.state: {dtype: float32, shape: [2], names: [a, b], unit: rad, frame: joint, rate_hz: 30, range: [-4, 4]}
  action: {dtype: float32, shape: [2], names: [a, b], unit: rad, frame: joint, rate_hz: 30, range: [-4, 4]}
"""


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> DatasetSpec:
    path = tmp_path_factory.mktemp("spec") / "numbers.yaml"
    path.write_text(SPEC, encoding="utf-8")
    return load_dataset_spec(path)


TOP = "observation.images.top"


def episode(
    spec: DatasetSpec,
    seed: int,
    rows: int,
    instruction: str,
    cameras: tuple[str, ...] = (),
) -> Episode:
    """Numbers at random; row k of a picture is grey of brightness 4 k + 20 seed."""
    rng = np.random.default_rng(seed)
    arrays = {
        key: rng.normal(size=(rows, 2)).astype(np.float32)
        for key in spec.features
        if key != TOP
    }
    shown = [
        dict.fromkeys(
            cameras, np.full((32, 48, 3), (4 * k + 20 * seed) % 256, np.uint8)
        )
        for k in range(rows)
    ]
    return Episode(
        name=f"made up {seed}", spec=spec, start_ns=0, arrays=arrays, picture_keys=cameras, pictures=lambda: iter(shown),
        instruction=instruction, origin=Origin(text="made up"),
    )  # fmt: skip


def written(
    spec: DatasetSpec, folder: Path, cameras: tuple[str, ...] = ()
) -> list[Path]:
    """Tasks are numbered otherwise in each: push 0 and pull 1; pull 0; lift 0 and push 1."""
    told = {"x": ["push", "pull", "push"], "y": ["pull"], "z": ["lift", "push"]}
    for k, (name, instructions) in enumerate(told.items()):
        episodes = [
            episode(spec, 10 * k + i, 7 + 3 * i + k, text, cameras)
            for i, text in enumerate(instructions)
        ]
        write_episodes(episodes, folder / name)
    return [folder / name for name in told]


@pytest.fixture(scope="module")
def parts(spec: DatasetSpec, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return written(spec, tmp_path_factory.mktemp("parts"))


@pytest.fixture(scope="module")
def filmed(spec: DatasetSpec, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return written(spec, tmp_path_factory.mktemp("filmed"), (TOP,))


def table(root: Path, kind: str) -> pd.DataFrame:
    pieces = [
        pq.read_table(path)
        for path in sorted((root / kind).glob("chunk-*/file-*.parquet"))
    ]
    return pa.concat_tables(pieces).to_pandas()


@pytest.mark.parametrize("of", ["parts", "filmed"])
def test_it_is_what_lerobot_makes_of_them(of, tmp_path, request):
    parts = request.getfixturevalue(of)
    _join(parts, tmp_path / "ours")
    names = [f"local/{root.name}" for root in parts]
    aggregate_datasets(
        names, "local/theirs", parts, tmp_path / "theirs", concatenate_videos=False
    )
    for kind in ("data", "meta/episodes"):
        pd.testing.assert_frame_equal(
            table(tmp_path / "ours", kind), table(tmp_path / "theirs", kind)
        )
    ours, theirs = (
        pd.read_parquet(tmp_path / name / "meta/tasks.parquet")
        for name in ("ours", "theirs")
    )
    pd.testing.assert_frame_equal(ours, theirs)
    for name in ("info", "stats"):
        found, wanted = (
            json.loads((tmp_path / of / f"meta/{name}.json").read_text())
            for of in ("ours", "theirs")
        )
        if of == "parts":
            wanted.pop("video_path", None)  # LeRobot forgets where videos would be
        assert found.items() >= wanted.items()
    films = [
        {
            path.relative_to(tmp_path / of): path.read_bytes()
            for path in (tmp_path / of).rglob("*.mp4")
        }
        for of in ("ours", "theirs")
    ]
    assert films[0] == films[1] and len(films[0]) == (3 if of == "filmed" else 0)
    # LeRobot's writer converts through pandas, which drops the fixed length of list columns.
    schemas = [
        pq.read_schema(root / "data/chunk-000/file-000.parquet")
        for root in (tmp_path / "ours", parts[0])
    ]
    assert schemas[0].equals(schemas[1])


@pytest.mark.parametrize("per_chunk", [2, 1000])
def test_each_row_shows_its_own_picture_after_merging_twice(
    filmed, tmp_path, monkeypatch, per_chunk
):
    from taccorl.data import joining

    read = joining.read_info
    monkeypatch.setattr(
        joining, "read_info", lambda root: read(root) | {"chunks_size": per_chunk}
    )
    merge(filmed[:2], tmp_path / "two")
    merge([filmed[2], tmp_path / "two", filmed[1]], tmp_path / "all")
    assert len(list((tmp_path / "all/videos").rglob("*.mp4"))) == 4
    joined = LeRobotDataset("local/all", root=tmp_path / "all", video_backend="pyav")
    seeds = [20, 21, 0, 1, 2, 10, 10]
    row = 0
    for number, seed in enumerate(seeds):
        rows = int(joined.meta.episodes[number]["length"])
        for k in range(rows):
            item = joined[row + k]
            assert item["episode_index"] == number
            assert abs(float(item[TOP].mean()) * 255 - (4 * k + 20 * seed) % 256) < 2
        row += rows
    assert row == len(joined) and [*check_bookkeeping(Dataset(tmp_path / "all"))] == []


@pytest.mark.parametrize(
    ("limit_mb", "per_chunk", "files"), [(1, 2, 3), (100, 1000, 1)]
)
def test_rows_tasks_and_episodes_are_where_they_belong_however_it_is_divided(
    parts, tmp_path, monkeypatch, limit_mb, per_chunk, files
):
    from taccorl.data import joining

    read = joining.read_info
    small = {"data_files_size_in_mb": limit_mb, "chunks_size": per_chunk}
    monkeypatch.setattr(
        joining, "_MB", 1024 if limit_mb == 1 else 1024 * 1024
    )  # no file is smaller than 1 kB
    monkeypatch.setattr(joining, "read_info", lambda root: read(root) | small)
    _join(parts, tmp_path / "all")
    for kind in ("data", "meta/episodes"):
        assert (
            len(list((tmp_path / "all" / kind).glob("chunk-*/file-*.parquet"))) == files
        )
        assert len(list((tmp_path / "all" / kind).glob("chunk-*"))) == -(
            -files // per_chunk
        )
    assert [*check_bookkeeping(Dataset(tmp_path / "all"))] == []
    joined, numbers = (
        Dataset(tmp_path / "all"),
        [(part, k) for part in map(Dataset, parts) for k in range(part.num_episodes)],
    )
    for number, (part, k) in enumerate(numbers):
        one, other = joined.episode(number), part.episode(k)
        assert one.instruction == other.instruction
        np.testing.assert_array_equal(one.arrays["action"], other.arrays["action"])


def test_statistics_that_one_dataset_lacks_are_left_out_of_every_file(
    parts, tmp_path, monkeypatch
):
    shutil.copytree(parts[2], edited := tmp_path / "edited")
    path = edited / "meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["stats/action/min"]), path)
    monkeypatch.setattr("taccorl.data.joining.JOINED_TOGETHER", 2)
    _join([*parts[:2], edited], tmp_path / "joined")
    files = sorted((tmp_path / "joined/meta/episodes").glob("*/*.parquet"))
    assert len(files) == 2
    for file in files:
        names = pq.read_schema(file).names
        assert "stats/action/min" not in names and "stats/action/max" in names


def test_statistics_that_a_removed_feature_left_behind_do_not_matter(parts, tmp_path):
    """LeRobot's ``modify_features`` removes a column, but not its statistics from the table of episodes."""
    edited = tmp_path / "edited"
    shutil.copytree(parts[0], edited)
    path = edited / "meta/episodes/chunk-000/file-000.parquet"
    episodes = pq.read_table(path)
    pq.write_table(
        episodes.append_column("stats/sim.executed/min", episodes["stats/action/min"]),
        path,
    )
    merge([edited, *parts[1:]], tmp_path / "joined")
    merge(parts, tmp_path / "plain")
    joined, plain = (
        table(tmp_path / name, "meta/episodes") for name in ("joined", "plain")
    )
    assert list(joined.columns) == list(plain.columns) and len(joined) == len(plain)
