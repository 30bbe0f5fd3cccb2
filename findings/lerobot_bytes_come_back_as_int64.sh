#!/usr/bin/env bash
# Surprise: LeRobot stores a feature of uint8 or int16 as stated, and gives it back as
# int64, and one of float64 as float32: the stated dtype is that of the file, not of
# what a policy sees.
# Hurts: who keeps taxels as bytes to save memory: a batch takes eight times as much;
# and who keeps times or positions as float64: an epoch in seconds comes back to a
# multiple of 128 s.
# Needs Python 3.12 or later (PYTHON=... names another one).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.12}" -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    "lerobot[dataset]==0.6.1" numpy==2.2.6
HF_HUB_OFFLINE=1 HF_HOME="$folder/cache" \
    "$folder/bin/python" - "$folder" 2> "$folder/messages" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

EPOCH = 1760000000.25  # s, of October 2025
VALUES = {
    "bytes": np.full((16, 16), 200, np.uint8),
    "counts": np.full(16, -300, np.int16),
    "epoch": np.array([EPOCH, EPOCH]),
}
root = Path(sys.argv[1]) / "dataset"
features = {
    name: {"dtype": str(value.dtype), "shape": value.shape, "names": None}
    for name, value in VALUES.items()
}
dataset = LeRobotDataset.create(
    "local/pad", fps=50, features=features, root=root, use_videos=False
)
for _ in range(10):
    dataset.add_frame({"task": "rest"} | VALUES)
dataset.save_episode()
dataset.finalize()
item = LeRobotDataset("local/pad", root=root)[3]
seen = {name: str(item[name].dtype).removeprefix("torch.") for name in VALUES}
size = item["bytes"].numpy().nbytes / VALUES["bytes"].nbytes
error = abs(float(item["epoch"][0]) - EPOCH)

print(f"lerobot {version('lerobot')}: dtype of an item of a data set")
print("expected:", {name: str(value.dtype) for name, value in VALUES.items()})
print("seen:    ", seen)
print(f"          the bytes take {size:g} times as much; the epoch is off by {error:g} s")
same = seen == {"bytes": "int64", "counts": "int64", "epoch": "float32"}
if not (same and size == 8 and error > 0):
    print((Path(sys.argv[1]) / "messages").read_text()[-2000:])
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
