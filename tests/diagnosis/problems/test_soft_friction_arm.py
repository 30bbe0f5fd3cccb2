"""Dry friction of an arm that plain MuJoCo simulates, with MuJoCo's own and with a stiff constraint; not by the kernel."""

from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from simulated_slide import robot_machine

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.origin import Origin
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.search.fit import Fit, best_fit

STEP_S, EVERY, NOISE_RAD = 5e-4, 8, 1e-4
LOSS_NM, DAMPING = 0.6, 0.9
STIFF = 'solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001 0.5 2"'
LINK = '<geom type="capsule" fromto="0 0 0 {0} 0 0" size="0.03" mass="{1}" {2}/>'
APART = 'contype="0" conaffinity="0"'
FILE = """kind: robot
model: arm.xml
gravity_compensation: 0.0
joints:
  shoulder: {kp: 120.0, kd: 6.0, gains: commanded, rotor_inertia: 0.02}
  elbow: {kp: 60.0, kd: 2.0, gains: commanded, rotor_inertia: 0.01}
"""


def model(friction: str) -> str:
    return f"""<mujoco><option timestep="{STEP_S}"/><compiler angle="radian"/>
<worldbody><body><joint name="shoulder" axis="0 1 0" armature="0.02" {friction}/>
{LINK.format(0.3, 1.0, APART)}<body pos="0.3 0 0">
<joint name="elbow" axis="0 1 0" armature="0.01" {friction}/>
{LINK.format(0.25, 0.5, APART)}</body></body></worldbody>
<actuator><position joint="shoulder" kp="120" kv="6"/>
<position joint="elbow" kp="60" kv="2"/></actuator></mujoco>"""


@cache
def recorded(friction: str) -> Measurement:
    """Waves that grow faster, and then steps with holds, of both joints at once."""
    time_s = STEP_S * EVERY * np.arange(2500)
    fade = np.clip(np.minimum(time_s - 0.3, 5.5 - time_s) / 0.3, 0, 1)[:, None]
    phase = 2 * np.pi * (0.2 * time_s + 0.15 * time_s**2)
    wave = fade * np.sin(np.stack([phase, 1.3 * phase], axis=1)) * [0.3, 0.25]
    level = np.floor(np.maximum(time_s - 6.0, 0.0) / 0.8).astype(int)
    steps = np.array([[0, 0], [0.2, -0.1], [-0.1, 0.2], [0.1, 0.05], [0, -0.2], [0, 0]])
    target = wave + steps[level]
    made = mujoco.MjModel.from_xml_string(model(friction))
    data, rows = mujoco.MjData(made), []
    for _ in range(4000):
        mujoco.mj_step(made, data)
    for row in target:
        rows.append(data.qpos.copy())
        data.ctrl[:] = row
        for _ in range(EVERY):
            mujoco.mj_step(made, data)
    noise = NOISE_RAD * np.random.default_rng(0).standard_normal(target.shape)
    return Measurement(
        name="both.csv",
        time_s=time_s,
        signals=("shoulder", "elbow"),
        units=("rad", "rad"),
        target=target,
        measured=np.array(rows) + noise,
        kp={"shoulder": 120.0, "elbow": 60.0},
        kd={"shoulder": 6.0, "elbow": 2.0},
        origin=Origin("twin", "simulated by the test in plain MuJoCo, not a machine"),
    )


def fitted(folder: Path, friction: str, joint: str, *names: str) -> Fit:
    machine = robot_machine(folder, model(""), FILE)
    problem = JointProblem(machine.robot, joint, Measurements((recorded(friction),)))
    start = problem.start | {f"{name}_friction.torque_nm": 0.3 for name in names}
    effects = [f"{name}_friction" for name in names]
    return best_fit(problem, problem.fit, effects, [start])


@pytest.mark.parametrize("joint", ["shoulder", "elbow"])
@pytest.mark.parametrize(
    ("friction", "right", "wrong"),
    [(f'frictionloss="{LOSS_NM}"', "soft", "coulomb"),
     (f'frictionloss="{LOSS_NM}" {STIFF}', "coulomb", "soft")],
    ids=["soft", "rigid"],
)  # fmt: skip
def test_soft_and_rigid_dry_friction_are_told_apart(
    friction: str, right: str, wrong: str, joint: str, tmp_path: Path
) -> None:
    found = fitted(tmp_path, friction, joint, right)
    assert found.error < 1.6
    low, high = found.intervals()[f"{right}_friction.torque_nm"]
    assert low < LOSS_NM < high
    assert high - low < 0.1 * LOSS_NM
    assert fitted(tmp_path, friction, joint, wrong).error > 5.0 * found.error


def test_the_usual_pair_is_found_beside_each_other(tmp_path: Path) -> None:
    friction = f'frictionloss="{LOSS_NM}" damping="{DAMPING}"'
    found = fitted(tmp_path, friction, "elbow", "soft", "viscous")
    assert found.error < 1.6
    values = found.values
    assert values["soft_friction.torque_nm"] == pytest.approx(LOSS_NM, rel=0.02)
    damping = values["viscous_friction.damping_nms_per_rad"]
    assert damping == pytest.approx(DAMPING, rel=0.05)
