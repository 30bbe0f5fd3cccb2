#!/usr/bin/env bash
# Surprise: MuJoCo 4.0's `armature` and `damping` of an MJCF actuator act on the
# joint, but stand in actuator_armature and actuator_damping only; the joint's
# dof_armature and dof_damping say 0, and clearing those changes nothing.
# Hurts: whoever randomises, identifies or exports a drive's inertia and damping
# by dof_armature and dof_damping, where they stood so far: they read 0, fit the
# rest on top, or believe that they removed what is still there.
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
  <option gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="elbow" type="hinge"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="elbow" armature="0.5" damping="2"/>
  </actuator>
</mujoco>
"""


def inertia(model, data):
    """Inertia at the only joint, kg m^2."""
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return float(full[0, 0])


model = mujoco.MjModel.from_xml_string(XML)
data = mujoco.MjData(model)
data.qvel[0] = 1.0
mujoco.mj_forward(model, data)
dof = (float(model.dof_armature[0]), float(model.dof_damping[0]))
model.dof_armature[:] = 0
model.dof_damping[:] = 0
mujoco.mj_setConst(model, data)
data.qvel[0] = 1.0
mujoco.mj_forward(model, data)
after = (inertia(model, data), float(data.qfrc_damper[0]))
ball = 0.4 * 1.0 * 0.1**2

print(f"mujoco {mujoco.__version__}: <motor armature=0.5 damping=2> at a ball")
print("expected: dof_armature 0.5, dof_damping 2; with both cleared, the joint")
print(f"          has the ball's {ball:.4f} kg m^2 and no damping")
print(f"seen: dof_armature {dof[0]:g}, dof_damping {dof[1]:g}; with both cleared,")
print(f"      {after[0]:.4f} kg m^2 and {after[1]:g} N m at 1 rad/s")
same = dof == (0.0, 0.0) and np.allclose(after, (ball + 0.5, -2.0), atol=1e-6)
if not same:
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
