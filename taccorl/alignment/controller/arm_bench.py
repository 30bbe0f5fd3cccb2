"""MuJoCo model of one joint of the twin: its arm with the other joints held, without contacts and with a fixed gripper.

``alignment.controller.joint_model`` reads inertia and weight from it.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from taccorl.alignment.controller.joint_motion import AT_TCP, Position
from taccorl.alignment.controller.rigid_joint import Rigid, rigid_terms
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.added import present
from taccorl.sim.effects.effect import ArmEffect, Effect, JointEffect
from taccorl.sim.effects.load import Payload
from taccorl.sim.twin import TwinConfig, empty_bench


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
