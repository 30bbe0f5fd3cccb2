#!/usr/bin/env bash
# Surprise: mink's ConfigurationLimit treats a joint that starts outside its range by
# commanding it back within one step: 0.1 rad outside and 10 ms a step are 9.5 rad/s,
# even of a task that asks it to stay.
# Hurts: who drives an arm that hangs a little beyond a soft limit, or whose encoder
# zero is off: the first command is a jump. A VelocityLimit beside it does not slow
# the return, but leaves the problem without a solution.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    mink==1.3.0 mujoco==4.0.0 "qpsolvers[daqp]==4.13.0" numpy==2.2.6
"$folder/bin/python" - <<'PYTHON'
import sys
from importlib.metadata import version

import mink
import mujoco
import numpy as np

XML = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body>
      <joint name="elbow" type="hinge" range="-1 1"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""
MODEL = mujoco.MjModel.from_xml_string(XML)
STEP = 0.01  # s


def speed(position, *more):
    """Commanded speed, rad/s, of a joint that is asked to stay where it is."""
    configuration = mink.Configuration(MODEL, q=np.array([position]))
    task = mink.PostureTask(MODEL, cost=1.0)
    task.set_target(np.array([position]))
    limits = [mink.ConfigurationLimit(MODEL), *more]
    try:
        velocity = mink.solve_ik(configuration, [task], STEP, "daqp", limits=limits)
    except mink.NoSolutionFound:
        return None
    return round(float(velocity[0]), 6) + 0.0


inside, outside = speed(0.9), speed(1.1)
slowed = speed(1.1, mink.VelocityLimit(MODEL, {"elbow": 1.0}))

print(f"mink {version('mink')}: limits -1 and 1 rad, asked to stay, {STEP} s a step")
print("expected: 0 rad/s at 0.9; at 1.1 rad a slow return, or a refusal;")
print("          with a VelocityLimit of 1 rad/s at most that")
print(f"seen: {inside:g} rad/s at 0.9, {outside:g} rad/s at 1.1;", end=" ")
print("no solution" if slowed is None else f"{slowed:g} rad/s", "with a VelocityLimit")
if not (inside == 0 and outside == -9.5 and slowed is None):
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
