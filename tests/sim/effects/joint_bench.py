"""One joint of the press bench's free arm, driven about its rest: joint 5 of the right arm unless said otherwise.

At rest at home everything is in balance: the controller's targets stand T_ref / K_p below the angles, and weight is carried.
"""

import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

COLUMN = ROBOT.action_names.index("right_joint5")
KP, KD, TORQUE_FF = ROBOT.kp_nm_per_rad[4], ROBOT.kd_nms_per_rad[4], ROBOT.torque_ff_nm[4]
STEP_S = TwinConfig().physics.timestep_s
GRAVITY = 9.81


def on_joint5(name: str, **values: float) -> Effect:
    return make_effect(name, arm="right", joints=["joint5"], **values)


def drive(sim: Simulation, seconds: float, offset=lambda t: 0.0, column: int = COLUMN) -> dict[str, np.ndarray]:
    """Let one joint's target be its target at rest + ``offset(t)`` [rad]; what the joint does after each physics step. Returns
    ``t`` [s], ``u`` target, ``q`` angle of the motor, ``v`` its velocity, ``reported``; each (T,)."""
    rest = sim.targets.copy()
    joint = sim.model.joint(ROBOT.action_names[column])
    rows = []
    for k in range(round(seconds / STEP_S)):
        targets = rest.copy()
        targets[:, column] += offset(k * STEP_S)
        sim.advance(targets[None], 1)
        q, v = sim.arrays["qpos"][0, joint.qposadr[0]], sim.arrays["qvel"][0, joint.dofadr[0]]
        rows.append(((k + 1) * STEP_S, targets[0, column], q, v, sim.proprioception()[0, column]))
    return dict(zip(("t", "u", "q", "v", "reported"), np.array(rows).T, strict=True))


def asked_nm(motion: dict[str, np.ndarray]) -> np.ndarray:
    """(T,) what a controller without effects would ask for: K_p (u − q) − K_d q̇ + T_ref."""
    return KP * (motion["u"] - motion["q"]) - KD * motion["v"] + TORQUE_FF
