"""Joints that move together, in recordings of an arm that MuJoCo itself simulates."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from simulated_slide import robot_machine

from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.controller.rigid_joint import masses_along, rates, torque_along
from taccorl.alignment.machines.robot_joint import at_times
from taccorl.alignment.measurements.measurement import Measurement

ARM = """<mujoco><option timestep="0.0001" integrator="implicitfast"/><worldbody>
<body><inertial pos="0.14 0 0" mass="1.8" diaginertia="0.003 0.016 0.016"/><joint name="upper" axis="0 1 0" armature="0.06"/>
<body pos="0.3 0 0"><inertial pos="0.11 0 0" mass="1.1" diaginertia="0.001 0.007 0.007"/>
<joint name="fore" axis="0 1 0" armature="0.03"/></body></body></worldbody>
<actuator><position joint="upper" kp="260" kv="16"/><position joint="fore" kp="150" kv="8"/></actuator></mujoco>"""
FILE = """kind: robot
model: arm.xml
joints: {upper: {kp: 260, kd: 16, rotor_inertia: 0.06}, fore: {kp: 150, kd: 8, rotor_inertia: 0.03}}"""
NAMES, NOISE_RAD = ("upper", "fore"), 1.5e-4


def steps(late_rows: int = 0) -> Measurement:
    """6 s of steps at 100 rows per second, each joint's 0.2 s after the other's: a target acts from its row to the next, and on
    ``upper`` so many rows later than it is logged."""
    rng, target = np.random.default_rng(5), np.tile([-0.3, 0.5], (600, 1))
    for k in range(12):
        target[50 * k + 30 + 20 * (k % 2) :, k % 2] = [-0.3, 0.5][k % 2] + rng.uniform(
            -0.25, 0.25
        )
    model = mujoco.MjModel.from_xml_string(ARM)
    data, seen = mujoco.MjData(model), np.empty((600, 2))
    data.qpos[:] = target[0]
    for row in range(-200, 600):
        if row >= 0:
            seen[row] = data.qpos
        acting = target[[max(row - late_rows, 0), max(row, 0)], [0, 1]]
        data.ctrl[:] = acting
        mujoco.mj_step(model, data, 100)
    noisy = seen + rng.normal(0.0, NOISE_RAD, seen.shape)
    time_s = np.arange(600) / 100
    return Measurement(
        name="steps",
        time_s=time_s,
        target=target,
        measured=noisy,
        signals=NAMES,
        units=("rad", "rad"),
    )


def left(folder: Path, m: Measurement, name: str) -> np.ndarray:
    """(T,) error of the file's model of a joint [noise]."""
    model = JointModel(robot_machine(folder, ARM, FILE).robot, name)
    seen = model.simulate(motion_of(m, name, model.joint), model.gains).reported
    return (seen - m.measured[:, NAMES.index(name)]) / NOISE_RAD


@pytest.mark.parametrize("name", NAMES)
def test_a_right_model_leaves_the_noise_while_all_joints_make_steps(
    tmp_path: Path, name: str
) -> None:
    """With loads by the positions of rows 1.13 and 1.42, and up to 9 and 12."""
    off = left(tmp_path, steps(), name)
    assert np.sqrt(np.mean(off**2)) < 1.06 and np.abs(off).max() < 4.5


def test_a_joint_that_is_later_than_its_file_says_is_a_better_known_load_than_by_its_rows(
    tmp_path: Path,
) -> None:
    """1.45 with loads by the positions of rows."""
    off = left(tmp_path, steps(late_rows=4), "fore")
    assert np.sqrt(np.mean(off**2)) < 1.25


def test_steps_of_a_drive_that_do_not_divide_those_of_the_loads_add_no_acceleration():
    """2 rad/row² at seven steps a row, seen at five: the second difference is 2 / 5². By
    lines between the steps it was between 0 and 1.8 times that."""
    seven, five = np.arange(140) / 7, np.arange(100) / 5
    seen = at_times(five, seven**2, 20)
    np.testing.assert_allclose(np.diff(seen, 2), 2.0 / 25, rtol=1e-6)
    every = at_times(five, (np.arange(200) / 10) ** 2, 20)
    np.testing.assert_array_equal(every, five**2)


def test_torques_and_masses_along_a_motion_are_those_of_mujoco_s_inverse_dynamics():
    """M q̈ + c(q, q̇) − compensation row by row, with the rotors in the mass matrix alone."""
    lifted = ARM.replace('<body pos="0.3 0 0">', '<body pos="0.3 0 0" gravcomp="0.4">')
    model = mujoco.MjModel.from_xml_string(lifted)
    time_s = np.linspace(0.0, 1.0, 201)
    positions = np.column_stack([0.4 * np.sin(5 * time_s), 0.7 * np.cos(3 * time_s)])
    needed, carried = torque_along(model, positions, 0.005)
    masses = masses_along(model, positions)
    velocities, accelerations = rates(positions, 0.005)
    data = mujoco.MjData(model)
    for row in (1, 50, 137):
        data.qpos[:], data.qvel[:] = positions[row], velocities[row]
        data.qacc[:] = accelerations[row]
        mujoco.mj_inverse(model, data)
        rotors = model.dof_armature * accelerations[row]
        torque = data.qfrc_inverse + data.qfrc_passive - rotors
        np.testing.assert_allclose(needed[row], torque, atol=1e-9)
        np.testing.assert_allclose(carried[row], data.qfrc_gravcomp, atol=1e-9)
        moved = masses[row] @ accelerations[row] + data.qfrc_bias - rotors
        np.testing.assert_allclose(moved, needed[row], atol=1e-4)
