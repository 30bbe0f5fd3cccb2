#!/usr/bin/env bash
# Surprise: MuJoCo 4.0 takes polynomials for a joint's `damping` and `stiffness`. The
# second number of damping multiplies v |v| and brakes both ways; that of stiffness
# multiplies x^2, so below the rest position it pushes the joint further away.
# Hurts: who writes a progressive spring (a cable, a rubber stop) as "k0 k1", the way
# quadratic drag is written: it is right on one side and unstable on the other.
# Powers that are odd ("k0 0 k2") pull back on both sides.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    mujoco-core==4.0.0 numpy==2.2.6
"$folder/bin/python" - <<'PYTHON'
import sys

import mujoco

XML = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="elbow" type="hinge" {law}/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""


def torque(law, position=0.0, velocity=0.0):
    """Passive torque at the joint, N m."""
    model = mujoco.MjModel.from_xml_string(XML.format(law=law))
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = position, velocity
    mujoco.mj_forward(model, data)
    return round(float(data.qfrc_passive[0]), 9)


damper = [torque('damping="1 2"', velocity=v) for v in (2.0, -2.0)]
spring = [torque('stiffness="1 2"', position=q) for q in (2.0, -2.0)]
odd = [torque('stiffness="1 0 2"', position=q) for q in (2.0, -2.0)]

print(f"mujoco {mujoco.__version__}: torque at +2 and at -2 rad/s or rad")
print('expected: damping="1 2" -10 and 10, stiffness="1 2" -10 and 10')
print(f"seen: damping {damper[0]:g} and {damper[1]:g},", end=" ")
print(f"stiffness {spring[0]:g} and {spring[1]:g}: away from rest;")
print(f'      stiffness="1 0 2" {odd[0]:g} and {odd[1]:g}')
if not (damper == [-10, 10] and spring == [-10, -6] and odd == [-18, 18]):
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
