#!/usr/bin/env bash
# Surprise: with MuJoCo 4.0's RK4 integrator the stages within a step look a delayed
# command up at times of their own, so it acts before its delay is over: a delay of
# 5 steps moves the joint in the fifth step.
# Hurts: who fits or states a latency with one integrator and simulates with another,
# or checks that nothing moves before the delay is over. Without a delay both
# integrators hold the command for the whole step, and agree.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    mujoco-core==4.0.0 numpy==2.2.6
"$folder/bin/python" - <<'PYTHON'
import sys

import mujoco
import numpy as np

XML = """
<mujoco>
  <option gravity="0 0 0" timestep="0.01" integrator="{integrator}"/>
  <worldbody>
    <body>
      <joint name="elbow" type="hinge" armature="0.996"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="elbow" {delay}/>
  </actuator>
</mujoco>
"""
DELAY = 'delay="0.05" nsample="8"'


def speeds(integrator, delay):
    """Speed, rad/s, after each of 8 steps with 1 N m at 1 kg m^2."""
    model = mujoco.MjModel.from_xml_string(
        XML.format(integrator=integrator, delay=delay)
    )
    data = mujoco.MjData(model)
    data.ctrl[0] = 1.0
    found = []
    for _ in range(8):
        mujoco.mj_step(model, data)
        found.append(float(data.qvel[0]))
    return np.round(found, 6)


plain = np.abs(speeds("RK4", "") - speeds("Euler", "")).max()
euler, rk4 = speeds("Euler", DELAY), speeds("RK4", DELAY)

print(f"mujoco {mujoco.__version__}: a command of 1 N m from time 0 on, 10 ms a step")
print("expected: with a delay of 50 ms no motion in 5 steps, whatever the integrator")
print(f"seen: after 5 steps Euler {euler[4]:g} rad/s, RK4 {rk4[4]:g} rad/s;")
print(f"      after 8, {euler[7]:g} and {rk4[7]:g}; without a delay", end=" ")
print(f"they differ by {plain:g}")
same = (
    plain < 1e-5
    and euler[4] == 0
    and np.allclose(rk4[4:] - euler[4:], 0.01 / 6, atol=1e-5)
)
if not same:
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
