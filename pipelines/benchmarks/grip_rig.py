"""Test rig: a part held by the right hand in the air, to measure creep, slip and the pads' readings."""

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.robots import ROBOT
from taccorl.sim.part import PART_CONTACT
from taccorl.sim.twin import CONTROL_HZ, TwinConfig, empty_bench

HOME_RAD = np.array([0.0, 1.45, -1.35, 0.0, 0.9, 0.0])
_PART_HALF_M = (0.01, 0.01, 0.03)


def gripped(
    mass_kg: float,
    force_n: float,
    config: TwinConfig | None = None,
    *,
    friction: float = 0.4,
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Simulation in which each pad of the right hand presses a 20 × 20 × 60 mm part with ``force_n`` [N], after one second of
    rest."""
    config = config or TwinConfig()
    spec = empty_bench(config)
    peg = spec.worldbody.add_body(name="peg")
    peg.add_freejoint(name="peg")
    contact = dict(PART_CONTACT, friction=[friction, 0.002, 0.0001])
    peg.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=_PART_HALF_M, mass=mass_kg, **contact
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    squeeze_m = force_n / config.robot.grip_stiffness_n_per_m
    if config.robot.pads == "sprung":
        squeeze_m += 2 * force_n / config.robot.pad_stiffness_n_per_m
    for arm in ROBOT.arms:
        data.qpos[[model.joint(f"{arm}_{j}").qposadr[0] for j in ROBOT.joints]] = (
            HOME_RAD
        )
        data.ctrl[[model.actuator(f"{arm}_{j}").id for j in ROBOT.joints]] = HOME_RAD
        for finger in ROBOT.fingers:
            data.qpos[model.joint(f"{arm}_finger_{finger}").qposadr[0]] = (
                _PART_HALF_M[1] + 0.0001
            )
        data.ctrl[model.actuator(f"{arm}_gripper").id] = 2 * _PART_HALF_M[1] - squeeze_m
    mujoco.mj_kinematics(model, data)
    tcp, free = data.site("right_tcp"), data.joint("peg")
    free.qpos[:3] = tcp.xpos
    free.qpos[3:] = Rotation.from_matrix(tcp.xmat.reshape(3, 3)).as_quat(
        scalar_first=True
    )
    rest(model, data, 1.0)
    return model, data


def rest(model: mujoco.MjModel, data: mujoco.MjData, duration_s: float) -> None:
    """Simulate ``duration_s`` with constant controls."""
    mujoco.mj_step(model, data, nstep=round(duration_s / model.opt.timestep))
    mujoco.mj_forward(model, data)


def in_hand_m(data: mujoco.MjData) -> np.ndarray:
    """(3,) position of the part in the TCP's frame [m]."""
    tcp, peg = data.site("right_tcp"), data.body("peg")
    return tcp.xmat.reshape(3, 3).T @ (peg.xpos - tcp.xpos)


def shake(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    duration_s: float = 3.0,
    swing_rad: float = 0.06,
) -> float:
    """Swing the right arm about its joints 1 and 2 (1.5 and 1.2 Hz) and turn joint 6. Return how far the part slips in the hand
    [m].

    Amplitudes, a choice: ``swing_rad`` (0.06) and two thirds of it (0.04), joint 6 by 0.2 rad at 1 Hz.
    """
    actuators = [model.actuator(f"right_{joint}").id for joint in ROBOT.joints]
    before, now = in_hand_m(data), data.ctrl[actuators].copy()
    start = now.copy()
    for k in range(1, round(duration_s * CONTROL_HZ) + 1):
        t = k / CONTROL_HZ
        fade = min(1.0, 4 * t, 4 * (duration_s - t))
        waves = np.sin(2 * np.pi * np.array([1.5, 1.2, 0.0, 0.0, 0.0, 1.0]) * t)
        goal = start + fade * waves * np.array(
            [swing_rad, swing_rad * 2 / 3, 0, 0, 0, 0.2]
        )
        for share in np.arange(1, 6) / 5:  # as Simulation.step does
            data.ctrl[actuators] = now + share * (goal - now)
            mujoco.mj_step(
                model, data, nstep=round(1 / (5 * CONTROL_HZ * model.opt.timestep))
            )
        now = goal
    mujoco.mj_forward(model, data)
    return float(np.linalg.norm(in_hand_m(data) - before))
