#!/usr/bin/env bash
# Surprise: mujoco.sysid's apply_delay returns a new TimeSeries that shares its numbers
# with the one it was given, and has delayed both; apply_gain and apply_bias leave
# their input alone.
# Hurts: who delays measured data inside a residual, once for each evaluation: the
# recording moves on at every call, and the fitted delay depends on how often the
# optimizer looked. Pass a copy.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    mujoco-core==4.0.0 numpy==2.2.6 scipy==1.16.3 absl-py==2.3.1 colorama==0.4.6 \
    tabulate==0.9.0 typing_extensions==4.15.0 pyyaml==6.0.3
"$folder/bin/python" - <<'PYTHON'
import sys

import mujoco
import numpy as np
from mujoco import sysid

TIMES = np.arange(11) / 10


def ramp():
    """A reading that equals its time, 0 to 1 s."""
    mapping = {"encoder": (sysid.SignalType.CustomObs, np.array([0]))}
    return sysid.TimeSeries(TIMES.copy(), TIMES.copy()[:, None], mapping)


def last_after(function, value, calls):
    """Last number of the input, and of the result, after some calls with the input."""
    series = ramp()
    parameter = sysid.Parameter("value", value, 0.0, 5.0)
    for _ in range(calls):
        result = function(series, "encoder", parameter)
    return round(float(series.data[-1, 0]), 9), round(float(result.data[-1, 0]), 9)


delay = [last_after(sysid.apply_delay, 0.1, calls) for calls in (1, 3)]
gain = [last_after(sysid.apply_gain, 2.0, calls) for calls in (1, 3)]
bias = [last_after(sysid.apply_bias, 2.0, calls) for calls in (1, 3)]

print(f"mujoco {mujoco.__version__}: last number of a ramp to 1, (input, result)")
print("expected: a delay of 0.1 s leaves (1, 0.9), called once or three times")
print(f"seen: delay, once {delay[0]}, three times {delay[1]}")
print(f"      gain 2, {gain[0]} and {gain[1]}; bias 2, {bias[0]} and {bias[1]}")
same = (
    delay == [(0.9, 0.9), (0.7, 0.7)]
    and gain == [(1.0, 2.0)] * 2
    and bias == [(1.0, 3.0)] * 2
)
if not same:
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
