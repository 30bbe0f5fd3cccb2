"""One joint of the PiPER's twin for the one-joint model: its arm compiled with the other joints held, without contacts and with a
fixed gripper.

Letters in shapes: T rows.
"""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import Any, Protocol

import mujoco
import numpy as np

from taccorl.alignment.controller.joint_motion import (
    AT_TCP,
    JointMotion,
    Position,
    Surroundings,
    moved_by_others,
    resting,
)
from taccorl.alignment.controller.rigid_joint import (
    Gains,
    Rigid,
    RigidJoint,
    rigid_terms,
    torque_along,
)
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.effects.added import present
from taccorl.sim.effects.effect import ArmEffect, Effect, JointEffect
from taccorl.sim.effects.load import Payload
from taccorl.sim.twin import TwinConfig, empty_bench


def split_signal(signal: str) -> tuple[str, str]:
    """Split the name of an arm's joint: ``left_joint5`` → ("left", "joint5"). Raises TaccorlError: ``signal`` is not a joint of
    an arm; grippers have no one-joint model."""
    arm, _, joint = signal.partition("_")
    if arm in ROBOT.arms and joint == "gripper":
        raise TaccorlError(
            f"{signal}: there is no one-joint model of a gripper; choose a joint"
        )
    if arm not in ROBOT.arms or joint not in ROBOT.joints:
        first, last = (
            ROBOT.action_names[k]
            for k in (ROBOT.joint_indices[0], ROBOT.joint_indices[-1])
        )
        raise TaccorlError(
            f"{signal!r} is not a joint of the arms; their joints are {first} … {last}"
        )
    return arm, joint


def of_joint(effects: Sequence[Effect], signal: str) -> list[Effect]:
    """Those of ``effects`` that are not absent and act on joint ``signal``, for it alone, in the order in which they act."""
    arm, joint = split_signal(signal)
    own: list[Effect] = []
    for effect in present(effects):
        if isinstance(effect, JointEffect) and signal in effect.acts_on():
            is_alone = effect.arm == arm and effect.joints == [
                joint
            ]  # as in every hypothesis of a search
            own.append(
                effect
                if is_alone
                else dataclasses.replace(effect, arm=arm, joints=[joint])
            )
        elif (
            isinstance(effect, ArmEffect)
            and not isinstance(effect, JointEffect)
            and arm in effect.acts_on()
        ):
            own.append(dataclasses.replace(effect, arm=arm))
        elif (
            not isinstance(effect, ArmEffect)
            and effect.slot == "robot"
            and {arm, signal} & {*effect.acts_on()}
        ):
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
    """One arm whose joints ``free`` have motors and encoders, and whose other joints and gripper are held at ``pose``. ``pose``:
    (7,) angles of the arm's six joints [rad] and its opening [m]. ``free``: names of joints without the arm, such as ``joint5``.
    ``payload_at_m``: centre of mass of the known payload, in link 6's frame."""
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
    position, of_joint = mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtObj.mjOBJ_JOINT
    for name in names:
        spec.add_sensor(
            name=f"{name}_pos", type=position, objtype=of_joint, objname=name
        )
    if payload_kg > 0:
        held_payload(arm, payload_kg, payload_at_m).edit(spec, config)
        spec.body(
            f"{arm}_payload"
        ).name = f"{arm}_held"  # so that the arm may have another, hidden one
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
    return rigid_of(
        arm_spec(config, arm, pose, [joint], payload_kg, payload_at_m),
        config,
        signal,
        effects,
    )


def rigid_of(
    spec: mujoco.MjSpec, config: TwinConfig, signal: str, effects: Sequence[Effect]
) -> Rigid:
    """``rigid`` of the arm ``spec``, which is changed."""
    for effect in effects:
        effect.edit(spec, config)
    return rigid_terms(spec.compile(), signal)


BENCH_REST = np.concatenate([[*Bench.home_rad[arm], 0.0] for arm in ROBOT.arms])
"""(14,) positions [rad, m] of joints and grippers that a table does not contain."""


class HasJoints(Protocol):
    """Interface of a machine with joints for the one-joint model."""

    def joint(self, signal: str) -> RigidJoint:
        """The joint of that name. Raises TaccorlError: the machine has no such joint."""
        ...


def joint_of(machine: TwinConfig | HasJoints, signal: str) -> RigidJoint:
    """The joint ``signal`` of the PiPER's twin ``machine``, or of another machine, for the one-joint model. Raises TaccorlError:
    there is no such joint, or it is a gripper of the PiPER."""
    return (
        ArmJoint(machine, signal)
        if isinstance(machine, TwinConfig)
        else machine.joint(signal)
    )


class ArmJoint(RigidJoint):
    """A joint of the twin ``config``; its own effects are those of the config that act on it. Raises TaccorlError: there is no
    such joint, or it is a gripper."""

    def __init__(self, config: TwinConfig, signal: str) -> None:
        arm, joint = split_signal(signal)
        k = ROBOT.joints.index(joint)
        control = config.controller_of(arm)
        self.signal, self._config = signal, config
        self.gains = Gains(
            control.kp_nm_per_rad[k], control.kd_nms_per_rad[k], control.torque_ff_nm[k]
        )
        self._own = of_joint(config.effects, signal)
        # Cached: building a MuJoCo MjSpec takes about 10 ms, compiling it about 0.1 ms.
        self._specified = lru_cache(
            lambda pose, *held: arm_spec(config, arm, np.array(pose), [joint], *held)
        )

    def timestep_s(self, motion: JointMotion) -> float:
        return self._config.physics.timestep_s

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        spec = self._specified(
            tuple(motion.pose), motion.payload_kg, motion.payload_at_m
        ).copy()
        return rigid_of(spec, self._config, self.signal, bodies)

    def surroundings(self, m: Measurement) -> Surroundings:
        arm, _ = split_signal(self.signal)
        names = ROBOT.action_names[ROBOT.arm_slice(arm)]
        pose = np.array(
            [resting(m, m.column(name)) if name in m.signals else 0.0 for name in names]
        )
        known = Surroundings(
            coupling_nm=np.zeros(m.num_rows),
            pose=pose,
            payload_kg=m.payload_kg.get(arm, 0.0),
            payload_at_m=m.payload_position_m.get(arm, AT_TCP),
            payload_at_known=arm in m.payload_position_m,
        )
        return dataclasses.replace(known, coupling_nm=self._coupling(m, known))

    def whole(self, m: Measurement) -> Measurement:
        return m if m.signals == ROBOT.action_names else m.on_robot(BENCH_REST)

    def effects(self, more: Sequence[Effect]) -> list[Effect]:
        names = {effect.name for effect in more}
        return of_joint(
            [*(e for e in self._own if e.name not in names), *more], self.signal
        )

    def freed(self, held: Collection[str] = ()) -> "tuple[list[Effect], ArmJoint]":
        effects = self._config.effects
        on = {self.signal, split_signal(self.signal)[0]}
        mine = [e for e in effects if isinstance(e, ArmEffect) and on & {*e.acts_on()}]
        own: list[Effect] = [e for e in mine if e.fitted and e.name not in held]
        others = [e for e in effects if not any(e is mine for mine in own)]
        return own, ArmJoint(
            dataclasses.replace(self._config, effects=others), self.signal
        )

    def selectors(self, cls: type[Effect]) -> Mapping[str, Any] | None:
        return selectors(cls, self.signal)

    def _coupling(self, m: Measurement, known: Surroundings) -> np.ndarray:
        """(T,) torque beyond the joint's own inertia and weight, because other joints of its arm move."""
        arm, joint = split_signal(self.signal)
        angles = moved_by_others(m, [f"{arm}_{other}" for other in ROBOT.joints])
        if angles.keys() <= {self.signal}:
            return np.zeros(m.num_rows)
        angles |= moved_by_others(m, [self.signal], still=-1.0)
        both = []
        for free in (
            [name for name in ROBOT.joints if f"{arm}_{name}" in angles],
            [joint],
        ):
            model = arm_spec(
                self._config,
                arm,
                known.pose,
                free,
                known.payload_kg,
                known.payload_at_m,
            ).compile()
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
            q = np.column_stack([angles[f"{arm}_{name}"] for name in free])
            needed, carried = torque_along(model, q, m.period_s)
            both.append((needed - carried)[:, model.joint(self.signal).dofadr[0]])
        return both[0] - both[1]


def selectors(cls: type[Effect], signal: str) -> dict[str, Any] | None:
    """Arguments (``arm``, ``joints``) with which an effect acts on one joint of the PiPER alone; None if it cannot act on it, or
    if the one-joint model lacks it: an outside effect with hooks alone."""
    arm, joint = signal.split("_", 1)
    if cls().drive() is None:
        return None
    if issubclass(cls, JointEffect):
        return {"arm": arm, "joints": [joint]} if joint in cls.possible else None
    return {"arm": arm} if issubclass(cls, ArmEffect) else None
