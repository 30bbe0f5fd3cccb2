#!/usr/bin/env bash
# Surprise: mujoco.sysid scales the residual of each sensor by what its description
# calls the standard deviation of the measured data; it is the root of their summed
# squares, zero offset included. The same motion read by an encoder whose zero lies
# elsewhere weighs less.
# Hurts: who fits several joints at once: a joint that works around 1.5 rad, a torque
# beside a large weight, or an encoder in absolute turns counts for little, and a
# change of units is harmless while a change of zero is not.
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

swing = 0.1 * np.sin(np.linspace(0.0, 20.0, 2000))[:, None]
error = 0.01 * np.cos(np.linspace(0.0, 90.0, 2000))[:, None]


def cost(scale, zero):
    """Summed squares of the residual of one sensor with this unit and zero."""
    measured = scale * (swing + zero)
    residual = sysid.normalize_residual(scale * error, measured)
    return float(np.sum(residual**2))


plain = cost(1.0, 0.0)
unit = cost(180 / np.pi, 0.0) / plain
moved = {zero: cost(1.0, zero) / plain for zero in (0.5, 1.5)}

print(f"mujoco {mujoco.__version__}: share in the cost of a swing of 0.1 rad")
print("expected: the same, in rad or degrees, wherever the encoder has its zero")
print(f"seen: in degrees {unit:.3g} of that in rad; with the zero 0.5 rad away")
print(f"      {moved[0.5]:.2g}, 1.5 rad away {moved[1.5]:.2g}")
if not (abs(unit - 1) < 1e-9 and moved[0.5] < 0.03 and moved[1.5] < 0.003):
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
