"""MuJoCo model of one joint of the twin: its arm with the other joints held, without contacts and with a fixed gripper.

``alignment.controller.joint_model`` reads inertia and weight from it, and simulates it for effects that only MuJoCo can compute.
"""

import copy
import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from taccorl.alignment.controller.joint_motion import AT_TCP, Position
from taccorl.alignment.controller.rigid_joint import Rigid, rigid_terms
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.controller import MotorEffort
from taccorl.sim.effects.added import AddedEffects, present
from taccorl.sim.effects.effect import ArmEffect, Effect, JointEffect
from taccorl.sim.effects.history import fill_histories
from taccorl.sim.effects.load import Payload
from taccorl.sim.twin import TwinConfig, empty_bench

_INPUTS = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)


def split_signal(signal: str) -> tuple[str, str]:
    """Split the name of an arm's joint: ``left_joint5`` → ("left", "joint5"). Raises TaccorlError: ``signal`` is not a joint of
    an arm; grippers have no one-joint model."""
    arm, _, joint = signal.partition("_")
    if arm in ROBOT.arms and joint == "gripper":
        raise TaccorlError(f"{signal}: there is no one-joint model of a gripper; choose a joint")
    if arm not in ROBOT.arms or joint not in ROBOT.joints:
        first, last = (ROBOT.action_names[k] for k in (ROBOT.joint_indices[0], ROBOT.joint_indices[-1]))
        raise TaccorlError(f"{signal!r} is not a joint of the arms; their joints are {first} … {last}")
    return arm, joint


def of_joint(effects: Sequence[Effect], signal: str) -> list[Effect]:
    """Those of ``effects`` that are not absent and act on joint ``signal``, for it alone, in the order in which they act."""
    arm, joint = split_signal(signal)
    own: list[Effect] = []
    for effect in present(effects):
        if isinstance(effect, JointEffect) and signal in effect.acts_on():
            is_alone = effect.arm == arm and effect.joints == [joint]  # as in every hypothesis of a search
            own.append(effect if is_alone else dataclasses.replace(effect, arm=arm, joints=[joint]))
        elif isinstance(effect, ArmEffect) and not isinstance(effect, JointEffect) and arm in effect.acts_on():
            own.append(dataclasses.replace(effect, arm=arm))
        elif not isinstance(effect, ArmEffect) and effect.slot == "robot" and {arm, signal} & {*effect.acts_on()}:
            own.append(effect)
    return own


def arm_spec(
    config: TwinConfig,
    arm: str,
    pose: np.ndarray,
    free: Sequence[str],
    payload_kg: float = 0.0,
    payload_at_m: Position = AT_TCP,
) -> mujoco.MjSpec:
    """One arm whose joints ``free`` have motors and encoders, and whose other joints and gripper are held at ``pose``.

    Args:
        pose: (7,) angles of the arm's six joints [rad] and its opening [m].
        free: names of joints without the arm, such as ``joint5``.
        payload_at_m: centre of mass of the known payload, in link 6's frame.
    """
    spec = empty_bench(config)
    for other in ROBOT.arms:
        if other != arm:
            spec.delete(spec.body(f"{other}_base_link"))
    for things in (spec.geoms, spec.equalities, spec.tendons):
        for thing in list(things):
            spec.delete(thing)
    names = [f"{arm}_{joint}" for joint in free]
    for actuator in list(spec.actuators):
        if actuator.name not in names:
            spec.delete(actuator)
    for joint, link, angle in zip(ROBOT.joints, ROBOT.links, pose, strict=False):
        if joint not in free:
            body = spec.body(f"{arm}_{link.name}")
            turn = np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
            quat = np.empty(4)
            mujoco.mju_mulQuat(quat, np.asarray(body.quat), turn)
            body.quat = quat
    for finger, side in zip(ROBOT.fingers, (1.0, -1.0), strict=True):
        body = spec.body(f"{arm}_finger_{finger}")
        body.pos[1] += side * pose[ROBOT.num_joints] / 2
    for joint in list(spec.joints):
        if joint.name not in names:
            spec.delete(joint)
    for joint in spec.joints:
        joint.limited = False
    for name in names:
        spec.add_sensor(
            name=f"{name}_pos", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name
        )
    if payload_kg > 0:
        held_payload(arm, payload_kg, payload_at_m).edit(spec, config)
        spec.body(f"{arm}_payload").name = f"{arm}_held"  # so that the arm may have another, hidden one
    return spec


def held_payload(arm: str, mass_kg: float, at_m: Position = AT_TCP) -> Payload:
    """The effect ``payload`` of a known mass in the gripper of ``arm``, at ``at_m`` in link 6's frame."""
    x_m, y_m, z_m = at_m
    return Payload(arm=arm, mass_kg=mass_kg, x_m=x_m, y_m=y_m, z_m=z_m)


def rigid(
    config: TwinConfig,
    signal: str,
    pose: np.ndarray,
    payload_kg: float,
    effects: Sequence[Effect],
    payload_at_m: Position = AT_TCP,
) -> Rigid:
    """Inertia and weight of joint ``signal`` with the others held at ``pose`` (7,) [rad, m], which is that of ``arm_spec``; of
    ``effects`` only those that change bodies are used."""
    arm, joint = split_signal(signal)
    return rigid_of(arm_spec(config, arm, pose, [joint], payload_kg, payload_at_m), config, signal, effects)


def rigid_of(spec: mujoco.MjSpec, config: TwinConfig, signal: str, effects: Sequence[Effect]) -> Rigid:
    """``rigid`` of the arm ``spec``, which is changed."""
    for effect in effects:
        effect.edit(spec, config)
    return rigid_terms(spec.compile(), signal)


def run(
    config: TwinConfig,
    signal: str,
    sent: np.ndarray,
    hold: int,
    coupling_nm: np.ndarray,
    *,
    gains: tuple[float, float, float],
    start: float,
    pose: np.ndarray,
    payload_kg: float,
    effects: Sequence[Effect],
    payload_at_m: Position = AT_TCP,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate the joint in MuJoCo, with its effects as in the twin, from rest; a link that hangs in a gear's play or spring
    starts in equilibrium.

    Args:
        sent: (S,) targets [rad], each held for ``hold`` physics steps.
        coupling_nm: (S hold,) torque that must be held against the other joints' motion.
        gains: K_p [N·m/rad], K_d [N·m·s/rad], T_ref [N·m].
        start: position that the encoder reports at rest [rad].
        pose: (7,) as in ``arm_spec``.
        effects: effects of this joint alone (``of_joint``).

    Returns:
        (S,) reported [rad] and (S,) motor torque [N·m] when each target is sent, before it acts.
    """
    arm, joint = split_signal(signal)
    spec = arm_spec(config, arm, pose, [joint], payload_kg, payload_at_m)
    kp, kd, torque_ff = gains
    motor = spec.actuator(signal)
    motor.gainprm[0], motor.biasprm[:3] = kp, [torque_ff, -kp, -kd]
    for effect in effects:
        effect.edit(spec, config)
    model = spec.compile()
    column, motor_id, encoder = (
        ROBOT.action_names.index(signal),
        model.actuator(signal).id,
        model.sensor(f"{signal}_pos").adr[0],
    )
    batch = Batch(model, 1, 1)
    batch.bind("sensordata")  # from now on each forward pass fills it
    given = MotorEffort(batch, np.array([motor_id]))
    hooks = AddedEffects(effects, batch.bind("time"), batch)

    def reports(angles: np.ndarray) -> np.ndarray:
        rows = np.zeros((len(angles), len(ROBOT.action_names)))
        rows[:, column] = angles
        return hooks.encoder(rows)[:, column]

    angle = np.array([start])
    for _ in range(20):
        angle += start - reports(angle)
    batch.bind("qpos")[0] = _hanging(model, signal, angle[0])
    batch.bind("ctrl")[0, motor_id] = sent[0]
    targets = np.zeros((1, len(ROBOT.action_names)))
    targets[0, column] = sent[0]
    only = np.array([0])
    hooks.reset(only, targets)
    fill_histories(batch, only)
    batch.forward()
    hooks.feel(only, 0.0)

    held_s = np.array([hold * model.opt.timestep])
    inputs = np.zeros((len(sent) * hold, model.nu + 6 * model.nbody))
    for k, target in enumerate(sent):
        targets[0, column] = target
        inputs[k * hold : (k + 1) * hold, motor_id] = hooks.command(targets, held_s)[0, column]
    # The coupling is a torque on the link about the joint's axis, which does not move.
    link = model.body(f"{arm}_link{joint[-1]}").id
    axis = batch.get_data(0).xaxis[model.joint(signal).id]
    inputs[:, model.nu + 6 * link + 3 : model.nu + 6 * link + 6] = -coupling_nm[:, None] * axis
    ask = _step_by_step if hooks.rewrites else _at_once
    reported, effort = ask(batch, hooks, given, inputs, hold, motor_id, encoder)
    return reports(reported), effort


def _at_once(
    batch: Batch, hooks: AddedEffects, given: MotorEffort, inputs: np.ndarray, hold: int, motor: int, encoder: int
) -> tuple[np.ndarray, np.ndarray]:
    """Readings and the motor's torques when each command is sent, before it acts."""
    whole = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    first = given()[0, 0]
    done = batch.rollout(len(inputs), inputs[None], _INPUTS, ("sensordata", whole))
    # After a step sensors still say what was before it: exactly the time at which the step's command was sent.
    reported = done["sensordata"][0, ::hold, encoder]
    # Forces hold the new command already; those before it come from the state at the end of the last one's stretch.
    rows = Batch(batch.model, len(reported), 1)
    rows.state[0] = done[whole][0, 0]
    rows.state[1:] = done[whole][0, hold - 1 : -1 : hold]
    after = MotorEffort(rows, np.array([motor]))
    rows.forward()
    effort = after()[:, 0]
    effort[0] = first
    return reported, effort


def _step_by_step(
    batch: Batch, hooks: AddedEffects, given: MotorEffort, inputs: np.ndarray, hold: int, motor: int, encoder: int
) -> tuple[np.ndarray, np.ndarray]:
    """The same with effects that rewrite the model before every physics step."""
    ctrl, xfrc = batch.bind("ctrl"), batch.bind("xfrc_applied").reshape(1, -1)
    sensed = batch.bind("sensordata")
    num, only = batch.model.nu, np.array([0])
    reported, effort = np.empty(len(inputs) // hold), np.empty(len(inputs) // hold)
    for n, values in enumerate(inputs):
        if n % hold == 0:
            reported[n // hold], effort[n // hold] = sensed[0, encoder], given()[0, 0]
        ctrl[0], xfrc[0] = values[:num], values[num:]
        batch.step(stage=mujoco.mjtStage.mjSTAGE_ACC)
        hooks.feel(only, batch.model.opt.timestep)
    return reported, effort


def _hanging(model: mujoco.MjModel, signal: str, angle: float) -> np.ndarray:
    """(nq,) the motor held at ``angle``; what there is between it and the link where the weight has pulled it."""
    held = copy.copy(model)
    motor = held.joint(signal)
    held.dof_armature[motor.dofadr[0]], held.opt.tolerance = (
        1e8,
        0.0,
    )  # so heavy a joint would make the solver content too soon
    data = mujoco.MjData(held)
    data.qpos[motor.qposadr[0]] = angle
    for step_s in (0.02, model.opt.timestep) if model.nv > 1 else ():  # far, and then exactly
        held.opt.timestep = step_s
        for _ in range(300):
            mujoco.mj_step(held, data)
            data.qpos[motor.qposadr[0]] = angle
            data.qvel[:] *= 0.5
    return data.qpos.copy()
