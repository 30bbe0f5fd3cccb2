#!/usr/bin/env bash
# Surprise: Rerun's own reader of LeRobot v3 data sets leaves out the whole episode, not
# the feature, where one feature is an array with rows and columns; and the whole data
# set where one is of uint8 or int32. LeRobot writes and reads all of these.
# Hurts: who keeps taxels as pads have them, (rows, columns) or bytes: neither joints
# nor cameras of the recording can be looked at. Flat features of float32, int16 or
# int64 load.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    rerun-sdk==0.33.1 pyarrow==22.0.0 numpy==2.2.6
"$folder/bin/python" - "$folder" 2> "$folder/messages" <<'PYTHON'
import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import rerun as rr

FOLDER = Path(sys.argv[1])
ROWS = 20
INDEX = ("frame_index", "episode_index", "index", "task_index")
TOUCH = {
    "(16,) float32": ("float32", [16], pa.list_(pa.float32(), 16), [0.5] * 16),
    "(16,) int16": ("int16", [16], pa.list_(pa.int16(), 16), [5] * 16),
    "(16,) uint8": ("uint8", [16], pa.list_(pa.uint8(), 16), [5] * 16),
    "(4, 4) float32": (
        "float32",
        [4, 4],
        pa.list_(pa.list_(pa.float32())),
        [[0.5] * 4] * 4,
    ),
}


def write(root, touch):
    """A LeRobot v3 data set of one episode: joints, and one feature of touch."""
    dtype, shape, arrow, value = touch
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": ["a", "b"]},
        "observation.touch": {"dtype": dtype, "shape": shape, "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    features |= {n: {"dtype": "int64", "shape": [1], "names": None} for n in INDEX}
    count = {"total_episodes": 1, "total_frames": ROWS, "total_tasks": 1, "fps": 50}
    info = {"codebase_version": "v3.0", "robot_type": "arm", "features": features}
    info |= count | {"chunks_size": 1000, "splits": {"train": "0:1"}}
    info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    info["video_path"] = None
    data = {
        "observation.state": pa.array([[0.1, 0.2]] * ROWS, pa.list_(pa.float32(), 2)),
        "observation.touch": pa.array([value] * ROWS, arrow),
        "timestamp": pa.array([k / 50 for k in range(ROWS)], pa.float32()),
        "frame_index": pa.array(range(ROWS), pa.int64()),
        "index": pa.array(range(ROWS), pa.int64()),
    }
    data |= {n: pa.array([0] * ROWS, pa.int64()) for n in INDEX if n not in data}
    episode = {"episode_index": [0], "tasks": [["press"]], "length": [ROWS]}
    episode |= {"data/chunk_index": [0], "data/file_index": [0]}
    episode |= {"dataset_from_index": [0], "dataset_to_index": [ROWS]}
    for name, table in {
        "data/chunk-000/file-000.parquet": data,
        "meta/episodes/chunk-000/file-000.parquet": episode,
        "meta/tasks.parquet": {"task_index": [0], "task": ["press"]},
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(table), root / name)
    (root / "meta/info.json").write_text(json.dumps(info))


def joints_shown(root):
    """Whether Rerun's recording of the data set has the joints."""
    saved = root.with_suffix(".rrd")
    code = "import rerun as rr, sys, time; r = rr.RecordingStream('look');"
    code += "r.save(sys.argv[2]); r.log_file_from_path(sys.argv[1]); time.sleep(5);"
    code += "r.flush(); r.disconnect()"
    subprocess.run([sys.executable, "-c", code, str(root), str(saved)], check=True)
    command = Path(sys.executable).with_name("rerun")
    listed = subprocess.run(
        [command, "rrd", "print", saved], check=True, capture_output=True, text=True
    )
    return "observation.state" in listed.stdout


seen = {}
for number, (name, touch) in enumerate(TOUCH.items()):
    root = FOLDER / f"dataset_{number}"
    write(root, touch)
    seen[name] = joints_shown(root)

print(f"rerun-sdk {version('rerun-sdk')}: are joints shown beside a touch feature?")
print("expected: always; a feature that cannot be drawn is left out")
print("seen:", ", ".join(f"{name}: {'yes' if s else 'no'}" for name, s in seen.items()))
if [*seen.values()] != [True, True, False, False]:
    print(*(FOLDER / "messages").read_text().splitlines()[-5:], sep="\n")
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
