"""Datasets whose metadata or columns are of another type, by the command: a line for the user, no traceback."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from taccorl.cli.main import main
from taccorl.data.dataset import BOOKKEEPING

ROWS = 6
STATE = "observation.state"
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def write(root: Path, features: dict[str, Any], **columns: Any) -> Path:
    """A dataset of one episode of ROWS rows, without videos."""
    count = list(range(ROWS))
    known = {"timestamp": np.arange(ROWS, dtype=np.float32) / 30, "frame_index": count}
    known |= {"episode_index": [0] * ROWS, "index": count, "task_index": [0] * ROWS}
    episode = {"episode_index": [0], "tasks": [["put"]], "length": [ROWS]}
    episode |= {"data/chunk_index": [0], "data/file_index": [0]}
    episode |= {"dataset_from_index": [0], "dataset_to_index": [ROWS]}
    files = {
        DATA: {**known, **columns},
        EPISODES: episode,
        "meta/tasks.parquet": {"task_index": [0], "task": ["put"]},
    }
    for name, table in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(table), root / name)
    own = {key: {"dtype": "int64", "shape": [1], "names": None} for key in BOOKKEEPING}
    own["timestamp"]["dtype"] = "float32"
    info = {"codebase_version": "v3.0", "fps": 30, "features": {**own, **features}}
    info |= {"total_episodes": 1, "total_frames": ROWS, "total_tasks": 1}
    info |= {"data_path": DATA, "video_path": None, "robot_type": "arm"}
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


@pytest.fixture
def root(tmp_path: Path) -> Path:
    feature = {"dtype": "float32", "shape": [2], "names": ["a", "b"]}
    values = [[0.1 * k, 0.2] for k in range(ROWS)]
    return write(tmp_path / "ds", {STATE: feature}, **{STATE: values})


def checked(root: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    code = main(["check", str(root), "--quick=true", "--pictures=false"])
    said = capsys.readouterr()
    return code, said.out + said.err


@pytest.mark.parametrize("key", ["dtype", "shape", "info"])
@pytest.mark.parametrize("value", ["x", ["x"], [1.5], [-1], [[1]], 7, {"a": 1}, True])
def test_a_feature_described_by_another_type_is_named(
    key: str, value: Any, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"][STATE][key] = value
    path.write_text(json.dumps(info))
    code, text = checked(root, capsys)
    if (key, value) in (("dtype", "x"), ("info", {"a": 1})):
        assert code in (0, 1)  # a kind of data that is not read, and facts beside
    else:
        assert code == 2 and f"{path}: feature {STATE}" in text and key in text


@pytest.mark.parametrize("value", ["x", [], 7, None])
def test_a_feature_that_is_no_description_is_named(
    value: Any, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    path.write_text(json.dumps({**info, "features": {STATE: value}}))
    code, text = checked(root, capsys)
    assert code == 2 and f"{path}: feature {STATE}" in text


OTHER: dict[str, Callable[[], pa.Array]] = {
    "string": lambda: pa.array(["x"] * ROWS),
    "binary": lambda: pa.array([b"x"] * ROWS),
    "struct": lambda: pa.array([{"a": 1.0}] * ROWS),
    "bool": lambda: pa.array([[True, False]] * ROWS),
    "timestamp": lambda: pa.array([[0, 1]] * ROWS, pa.list_(pa.timestamp("s"))),
    "null": lambda: pa.nulls(ROWS),
    "texts": lambda: pa.array([["x", "y"]] * ROWS),
}


@pytest.mark.parametrize(
    ("column", "kind", "codes", "words"),
    [(STATE, kind, {1}, f"{DATA}, episode 0, {STATE}: a column of") for kind in OTHER]
    + [
        (column, kind, {1, 2}, column)
        for column in ("timestamp", "frame_index", "index", "task_index")
        for kind in ("string", "struct", "null")
    ],
)
def test_a_column_of_another_type_is_named(
    column: str,
    kind: str,
    codes: set[int],
    words: str,
    root: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    table = pq.read_table(root / DATA)
    at = table.column_names.index(column)
    pq.write_table(table.set_column(at, column, OTHER[kind]()), root / DATA)
    code, text = checked(root, capsys)
    assert code in codes
    assert words in text


def test_a_dataset_without_numbers_is_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = {"dtype": "image", "shape": [8, 8, 3], "names": None}
    columns = {"observation.images.top": [{"bytes": b"x", "path": None}] * ROWS}
    root = write(tmp_path / "ds", {"observation.images.top": picture}, **columns)
    _, text = checked(root, capsys)
    assert f"episode 0: {ROWS} rows" in text
