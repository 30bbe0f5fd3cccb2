#!/usr/bin/env bash
# Surprise: MuJoCo 4.0's actuator delay with interp="linear" lags by a fraction of a
# step above one step (2.5 ms of 2 ms: 1.25 steps), but any delay above 0 and below
# one step acts as one whole step: 0.5 ms lags by 2 ms, and so does 1 ns.
# Hurts: whoever fits or randomises short delays (CAN bus, servo loop): between 0 and
# one step the error has no slope, a fit stops where it began, and a delay that is
# stated as 0.5 ms costs the phase of 2 ms. A delay of exactly 0 has no lag.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    mujoco-core==4.0.0 numpy==2.2.6
"$folder/bin/python" - <<'PYTHON'
import sys

import mujoco

STEP_S = 0.002
XML = """
<mujoco>
  <option timestep="{step}"/>
  <worldbody>
    <body>
      <joint name="slide" type="slide"/>
      <geom size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="slide" delay="{delay}" nsample="8" interp="linear"/>
  </actuator>
</mujoco>
"""


def lag(delay_s):
    """Steps by which the force of a ramp of controls lags, after 20 steps."""
    xml = XML.format(step=STEP_S, delay=delay_s)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    for k in range(20):
        data.ctrl[0] = k
        mujoco.mj_step(model, data)
    return round(19 - float(data.actuator_force[0]), 6)


delays_s = (0.0, 1e-9, 0.0005, 0.001, 0.002, 0.0025, 0.003)
expected = [round(delay_s / STEP_S, 6) for delay_s in delays_s]
seen = [lag(delay_s) for delay_s in delays_s]
print(f"MuJoCo {mujoco.__version__}: lag in steps of a ramp, by delay")
print(f"delay [s]  {list(delays_s)}")
print(f"expected   {expected}")
print(f"seen       {seen}")
if seen != [0.0, 1.0, 1.0, 1.0, 1.0, 1.25, 1.5]:
    sys.exit("CHANGED")
PYTHON
