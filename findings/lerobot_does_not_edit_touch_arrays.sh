#!/usr/bin/env bash
# Surprise: LeRobot's own tools that merge data sets and delete episodes end with an
# exception of pyarrow or pandas where one feature has rows and columns; it writes,
# reads and serves these data sets otherwise.
# Hurts: who recorded taxels as (rows, columns): bad episodes cannot be taken out, and
# recordings of two days not put together. Flat features work.
# Needs Python 3.12 or later (PYTHON=... names another one).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.12}" -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    "lerobot[dataset]==0.6.1" datasets==4.8.5 pandas==2.3.3 pyarrow==26.0.1 \
    numpy==2.2.6
HF_HUB_OFFLINE=1 HF_HOME="$folder/cache" \
    "$folder/bin/python" - "$folder" 2> "$folder/messages" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

FOLDER = Path(sys.argv[1])


def written(name, shape):
    """A data set of two episodes of ten rows, read back."""
    touch = {"dtype": "float32", "shape": shape, "names": None}
    root = FOLDER / name
    dataset = LeRobotDataset.create(
        "local/" + name, fps=50, features={"touch": touch}, root=root, use_videos=False
    )
    for _ in range(2):
        for row in range(10):
            dataset.add_frame({"task": "t", "touch": np.full(shape, row, np.float32)})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/" + name, root=root)


def outcome(function, *arguments, **places):
    """Rows of the new data set, or the name of the exception."""
    try:
        return len(function(*arguments, **places))
    except Exception as error:
        return type(error).__name__


def outcomes(name, shape):
    """Rows as written, after a merge of two data sets, and after a deletion."""
    first, second = written(name + "_a", shape), written(name + "_b", shape)
    merged = outcome(
        merge_datasets,
        [first, second],
        output_repo_id="local/merged",
        output_dir=FOLDER / (name + "_merged"),
    )
    rest = outcome(
        delete_episodes,
        first,
        [0],
        output_dir=FOLDER / (name + "_rest"),
        repo_id="local/rest",
    )
    return len(first), merged, rest


array, flat = outcomes("array", (4, 4)), outcomes("flat", (16,))

print(f"lerobot {version('lerobot')}: rows written, after a merge, after a deletion")
print("expected: (20, 40, 10)")
print(f"seen: touch of (16,) {flat}")
print(f"      touch of (4, 4) {array}")
same = flat == (20, 40, 10) and array[0] == 20
if not (same and {type(one) for one in array[1:]} == {str}):
    print((FOLDER / "messages").read_text()[-2000:])
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
