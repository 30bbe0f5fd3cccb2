#!/usr/bin/env bash
# Surprise: LeRobot's statistics of a feature with rows and columns keep the last axis
# only: a pad of (16, 16) taxels has 16 means, deviations and quantiles, each over a
# whole column of taxels, and normalization spreads them over the rows.
# Hurts: who stores taxels as the pad has them and normalizes by mean and std: a taxel
# that always rests at 40 counts is centred with its column, not at its rest. Flat,
# (256,), each taxel has its own.
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

REST = np.zeros((16, 16), np.float32)
REST[0] = 40.0  # the first row rests at 40 counts, all others at 0


def statistics(shape):
    """Mean and standard deviation, as stored, of a pad that nobody touches."""
    touch = {"dtype": "float32", "shape": shape, "names": None}
    root = Path(sys.argv[1]) / f"pad_{len(shape)}"
    dataset = LeRobotDataset.create(
        "local/pad", fps=50, features={"touch": touch}, root=root, use_videos=False
    )
    for _ in range(100):
        dataset.add_frame({"task": "rest", "touch": REST.reshape(shape)})
    dataset.save_episode()
    dataset.finalize()
    found = LeRobotDataset("local/pad", root=root).meta.stats["touch"]
    return np.asarray(found["mean"]), np.asarray(found["std"])


mean, std = statistics((16, 16))
flat_mean, flat_std = statistics((256,))

print(f"lerobot {version('lerobot')}: a pad of (16, 16), first row at 40, others at 0")
print("expected: 256 means, 40 of the first row and 0 elsewhere, deviations 0")
print(f"seen: shape {mean.shape}, each mean {mean[0]:g}, deviation {std[0]:.3g};")
print(f"      stored flat {flat_mean.shape}, means {flat_mean[0]:g} and", end=" ")
print(f"{flat_mean[16]:g}, deviations {flat_std[0]:.3g} and {flat_std[16]:.3g}")
same = (
    mean.shape == (16,)
    and np.allclose(mean, 2.5)
    and std.min() > 9
    and flat_mean.shape == (256,)
    and np.allclose(flat_mean, REST.ravel())
    and flat_std.max() < 1e-3
)
if not same:
    print((Path(sys.argv[1]) / "messages").read_text()[-2000:])
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
