#!/usr/bin/env bash
# Surprise: LeRobot's relative actions take the names of joints that stay absolute as
# parts of names: "joint_1" keeps joint_10, joint_11 and joint_12 absolute, too.
# Hurts: who trains two arms, or an arm with a hand, on relative actions and leaves one
# joint out by its name: with ten joints or more others go with it, in training and in
# the rollout alike, so that nothing shows it but the quality of the policy.
# Needs Python 3.12 or later (PYTHON=... names another one).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3.12}" -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    lerobot==0.6.1 numpy==2.2.6
HF_HUB_OFFLINE=1 HF_HOME="$folder/cache" \
    "$folder/bin/python" - "$folder" 2> "$folder/messages" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

import torch
from lerobot.processor import RelativeActionsProcessorStep, create_transition

NAMES = [f"joint_{number}" for number in range(1, 13)]


def absolute(excluded):
    """Joints whose action is not made relative, of an arm at 2 that is sent to 5."""
    step = RelativeActionsProcessorStep(
        enabled=True, exclude_joints=[excluded], action_names=NAMES
    )
    state = {"observation.state": torch.full((1, len(NAMES)), 2.0)}
    action = torch.full((1, len(NAMES)), 5.0)
    given = step(create_transition(action=action, observation=state))["action"][0]
    return [name for name, value in zip(NAMES, given.tolist()) if value == 5.0]


first, last = absolute("joint_1"), absolute("joint_12")

print(f"lerobot {version('lerobot')}: joints that stay absolute, of joint_1 to joint_12")
print('expected: of exclude_joints=["joint_1"] joint_1, of ["joint_12"] joint_12')
print("seen:", ", ".join(first), "and", ", ".join(last))
if first != ["joint_1", "joint_10", "joint_11", "joint_12"] or last != ["joint_12"]:
    print((Path(sys.argv[1]) / "messages").read_text()[-2000:])
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
