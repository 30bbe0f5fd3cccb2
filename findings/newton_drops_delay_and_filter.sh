#!/usr/bin/env bash
# Surprise: Newton's add_mjcf leaves out the filter (`timeconst`) and the delay of an
# actuator, without an error or a warning, while gains, force ranges, armature,
# damping and friction of the same element arrive.
# Hurts: who trains in Newton on a robot whose drive was identified in MuJoCo: the
# latency, which was fitted with the rest, is gone, and the arm is faster than it was.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    "newton[sim]==1.8.0" mujoco==3.17.0 mujoco-warp==3.17.0 warp-lang==1.19.0
"$folder/bin/python" - <<'PYTHON'
import contextlib
import io
import sys
import warnings

import mujoco
import newton
import warp

XML = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="elbow" type="hinge" frictionloss="1.5"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="elbow" kp="100" kv="7" forcerange="-3 3" timeconst="0.1"
              delay="0.01" nsample="6"/>
  </actuator>
</mujoco>
"""


def facts(model):
    """Gains, friction, and time constant and delay [s] of the only actuator."""
    filtered = model.actuator_dyntype[0] != mujoco.mjtDyn.mjDYN_NONE
    return {
        "kp": round(float(model.actuator_gainprm[0, 0]), 6),
        "kv": round(-float(model.actuator_biasprm[0, 2]), 6),
        "force": float(model.actuator_forcerange[0, 1]),
        "friction": float(model.dof_frictionloss[0]),
        "timeconst": round(float(model.actuator_dynprm[0, 0]), 6) if filtered else 0.0,
        "delay": round(float(model.actuator_delay[0]), 6),
    }


warp.config.quiet = True
builder = newton.ModelBuilder()
newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
said = io.StringIO()
with warnings.catch_warnings(record=True) as warned, contextlib.redirect_stderr(said):
    warnings.simplefilter("always")
    builder.add_mjcf(XML)
    solver = newton.solvers.SolverMuJoCo(
        builder.finalize(device="cpu"), use_mujoco_cpu=True
    )
text = said.getvalue() + " ".join(str(one.message) for one in warned)
mentions = [word for word in ("timeconst", "delay", "dyntype") if word in text]
own = facts(mujoco.MjModel.from_xml_string(XML))
seen = facts(solver.mj_model)

print(f"newton {newton.__version__} with mujoco {mujoco.__version__}: one <position>")
print("expected:", own)
print("seen:    ", seen, "and no warning" if not mentions else mentions)
kept = all(seen[key] == own[key] for key in ("kp", "kv", "force", "friction"))
lost = (own["timeconst"], own["delay"]) == (0.1, 0.01)
lost = lost and (seen["timeconst"], seen["delay"]) == (0.0, 0.0)
if not (kept and lost and not mentions):
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON
