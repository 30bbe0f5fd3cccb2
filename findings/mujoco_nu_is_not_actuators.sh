#!/usr/bin/env bash
# Surprise: since MuJoCo 4.0, model.nu counts controls, not actuators (nactuator).
# A `pid` has two controls, a `dcmotor` with input="none" has none, so the id of an
# actuator is no index of data.ctrl.
# Hurts: controllers, exporters and RL environments that write
# data.ctrl[model.actuator(name).id] or loop over range(model.nu): with a pid before
# it, the wrong drive is moved, without any error.
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
      <joint name="arm" type="hinge"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
    <body pos="1 0 0">
      <joint name="grip" type="hinge"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    {first}
    <motor name="grip" joint="grip"/>
  </actuator>
</mujoco>
"""
PID = '<pid name="arm" joint="arm" kp="1"/>'
PASSIVE = (
    '<dcmotor name="arm" joint="arm" motorconst="1" resistance="1" input="none"/>'
)


def compiled(first):
    return mujoco.MjModel.from_xml_string(XML.format(first=first))


def force_of_motor(model, index):
    """Force of the motor `grip` when data.ctrl[index] is 1."""
    data = mujoco.MjData(model)
    data.ctrl[index] = 1.0
    mujoco.mj_forward(model, data)
    return float(data.actuator("grip").force[0])


pid = compiled(PID)
motor = pid.actuator("grip").id
by_id = force_of_motor(pid, motor)
by_address = force_of_motor(pid, pid.actuator_ctrladr[motor])
passive = compiled(PASSIVE)

print(f"mujoco {mujoco.__version__}: two actuators, the second one a motor")
print("expected: nu 2; a control of 1 at the motor's id gives a force of 1")
print(f"seen: after a pid, nu {pid.nu}, of {pid.nactuator} actuators; force {by_id:g}")
print(f"      by the id, {by_address:g} by actuator_ctrladr;")
print(f"      after a dcmotor without input, nu {passive.nu}, of", end=" ")
print(f"{passive.nactuator} actuators; the motor's id is {passive.actuator('grip').id}")
same = (
    (pid.nu, pid.nactuator, passive.nu, passive.nactuator) == (3, 2, 1, 2)
    and (by_id, by_address) == (0.0, 1.0)
)
if not same:
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
