#!/usr/bin/env bash
# Surprise: MuJoCo 4.0 takes polynomials for the damping of an actuator, and multiplies
# all of their coefficients by gear^2. Quadratic drag of a rotor behind a gear of 10 is
# 1000 times as much at the joint, cubic drag 10 000 times: it gives 100 times. The
# coefficient of a fixed tendon enters with the power that belongs to each term.
# Hurts: who writes a motor's measured drag at the rotor and lets `gear` do the rest:
# a tenth of it, or a hundredth, is simulated. Linear damping is right.
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
      <joint name="elbow" type="hinge"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  {part}
</mujoco>
"""
MOTOR = '<actuator><motor joint="elbow" gear="{}" damping="{}"/></actuator>'
TENDON = (
    '<tendon><fixed damping="{1}"><joint joint="elbow" coef="{0}"/></fixed></tendon>'
)
TERMS = {"linear": "1", "quadratic": "0 1", "cubic": "0 0 1"}


def torque(part):
    """Passive torque, N m, of the joint at 1 rad/s."""
    model = mujoco.MjModel.from_xml_string(XML.format(part=part))
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    mujoco.mj_forward(model, data)
    return float(data.qfrc_passive[0])


def ratios(part):
    """Torque with a ratio of 10 over that with 1, for each term."""
    return {
        name: round(torque(part.format(10, term)) / torque(part.format(1, term)))
        for name, term in TERMS.items()
    }


motor, tendon = ratios(MOTOR), ratios(TENDON)

print(f"mujoco {mujoco.__version__}: drag at the joint, ratio 10 over ratio 1")
print("expected: linear 100, quadratic 1000, cubic 10000, of gear and of tendon")
print("seen: gear of an actuator", motor)
print("      coefficient of a tendon", tendon)
same = [*motor.values()] == [100, 100, 100] and [*tendon.values()] == [100, 1000, 10000]
if not same:
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
