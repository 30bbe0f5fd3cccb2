"""One joint of the twin by MuJoCo's own steps, its arm's other joints held: what the one-joint model is compared with."""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from taccorl.alignment.controller.arm_joint import arm_spec, of_joint, split_signal
from taccorl.alignment.controller.joint_model import JointResponse
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.rigid_joint import Gains
from taccorl.robots import ROBOT
from taccorl.sim.controller import MotorEffort
from taccorl.sim.effects.added import AddedEffects
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.history import fill_histories
from taccorl.sim.twin import TwinConfig


def in_mujoco(
    motion: JointMotion,
    signal: str,
    gains: Gains,
    effects: Sequence[Effect] = (),
    config: TwinConfig | None = None,
) -> JointResponse:
    """Response of joint ``signal`` to the T targets of ``motion`` from rest, with ``effects`` as in the twin ``config``; a link
    that hangs in a gear's play or spring starts in equilibrium."""
    config, (arm, joint), effects = (
        config or TwinConfig(),
        split_signal(signal),
        of_joint(effects, signal),
    )
    spec = arm_spec(
        config, arm, motion.pose, [joint], motion.payload_kg, motion.payload_at_m
    )
    kp, kd, torque_ff = gains
    motor = spec.actuator(signal)
    motor.gainprm[0], motor.biasprm[:3] = kp, [torque_ff, -kp, -kd]
    for effect in effects:
        effect.edit(spec, config)
    model = spec.compile()
    column, motor_id = ROBOT.action_names.index(signal), model.actuator(signal).id
    batch = Batch(model, 1, 1)
    sensed = batch.bind("sensordata")  # from now on each forward pass fills it
    effort = MotorEffort(batch, np.array([motor_id]))
    hooks = AddedEffects(effects, batch.bind("time"), batch)

    def reported(angles: np.ndarray) -> np.ndarray:
        rows = np.zeros((len(angles), len(ROBOT.action_names)))
        rows[:, column] = angles
        return hooks.encoder(rows)[:, column]

    angle = np.array([motion.start])
    for _ in range(20):
        angle += motion.start - reported(angle)
    batch.bind("qpos")[0] = _hanging(model, signal, angle[0])
    targets, only = np.zeros((1, len(ROBOT.action_names))), np.array([0])
    ctrl, xfrc = batch.bind("ctrl"), batch.bind("xfrc_applied")
    ctrl[0, motor_id] = targets[0, column] = motion.target[0]
    hooks.reset(only, targets)
    fill_histories(batch, only)
    batch.forward()
    hooks.feel(only, 0.0)

    hold = round(1 / (motion.rate_hz * model.opt.timestep))
    steps = np.arange(len(motion.target) * hold) / hold
    coupling_nm = np.interp(steps, np.arange(len(motion.target)), motion.coupling_nm)
    # The coupling is a torque on the link about the joint's axis, which does not move.
    link, axis = (
        model.body(f"{arm}_link{joint[-1]}").id,
        batch.get_data(0).xaxis[model.joint(signal).id].copy(),
    )
    encoder, seen = model.sensor(f"{signal}_pos").adr[0], []
    for n, load_nm in enumerate(coupling_nm):
        if n % hold == 0:
            seen.append((sensed[0, encoder], effort()[0, 0]))
            targets[0, column] = motion.target[n // hold]
            ctrl[0, motor_id] = hooks.command(
                targets, np.array([hold * model.opt.timestep])
            )[0, column]
        xfrc[0, link, 3:] = -load_nm * axis
        batch.step(stage=mujoco.mjtStage.mjSTAGE_ACC)
        hooks.feel(only, model.opt.timestep)
    angles, efforts = np.array(seen).T
    return JointResponse(reported(angles), efforts)


def _hanging(model: mujoco.MjModel, signal: str, angle: float) -> np.ndarray:
    """(nq,) the motor held at ``angle``; what there is between it and the link where the weight has pulled it."""
    held = copy.copy(model)
    motor = held.joint(signal)
    held.dof_armature[motor.dofadr[0]] = 1e8
    held.opt.tolerance = 0.0  # so heavy a joint would make the solver content too soon
    data = mujoco.MjData(held)
    data.qpos[motor.qposadr[0]] = angle
    for step_s in (
        (0.02, model.opt.timestep) if model.nv > 1 else ()
    ):  # far, and then exactly
        held.opt.timestep = step_s
        for _ in range(300):
            mujoco.mj_step(held, data)
            data.qpos[motor.qposadr[0]] = angle
            data.qvel[:] *= 0.5
    return data.qpos.copy()
