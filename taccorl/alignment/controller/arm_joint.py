"""One joint of the PiPER's twin for the one-joint model: its arm compiled with the other joints held.

Letters in shapes: T rows.
"""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import Any, Protocol

import mujoco
import numpy as np

from taccorl.alignment.controller import arm_bench
from taccorl.alignment.controller.arm_bench import of_joint, split_signal
from taccorl.alignment.controller.joint_motion import AT_TCP, JointMotion, Surroundings, moved_by_others, resting
from taccorl.alignment.controller.rigid_joint import Gains, Rigid, RigidJoint, torque_along
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.effects.effect import ArmEffect, Effect, JointEffect
from taccorl.sim.twin import TwinConfig

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
    return ArmJoint(machine, signal) if isinstance(machine, TwinConfig) else machine.joint(signal)


class ArmJoint(RigidJoint):
    """A joint of the twin ``config``; its own effects are those of the config that act on it. Raises TaccorlError: there is no
    such joint, or it is a gripper."""

    def __init__(self, config: TwinConfig, signal: str) -> None:
        arm, joint = split_signal(signal)
        k = ROBOT.joints.index(joint)
        control = config.controller_of(arm)
        self.signal, self._config = signal, config
        self.gains = Gains(control.kp_nm_per_rad[k], control.kd_nms_per_rad[k], control.torque_ff_nm[k])
        self._own = of_joint(config.effects, signal)
        # Cached: building a MuJoCo MjSpec takes about 10 ms, compiling it about 0.1 ms.
        self._specified = lru_cache(lambda pose, *held: arm_bench.arm_spec(config, arm, np.array(pose), [joint], *held))

    def timestep_s(self, motion: JointMotion) -> float:
        return self._config.physics.timestep_s

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        spec = self._specified(tuple(motion.pose), motion.payload_kg, motion.payload_at_m).copy()
        return arm_bench.rigid_of(spec, self._config, self.signal, bodies)

    def surroundings(self, m: Measurement) -> Surroundings:
        arm, _ = split_signal(self.signal)
        names = ROBOT.action_names[ROBOT.arm_slice(arm)]
        pose = np.array([resting(m, m.column(name)) if name in m.signals else 0.0 for name in names])
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
        return of_joint([*(e for e in self._own if e.name not in names), *more], self.signal)

    def freed(self, held: Collection[str] = ()) -> "tuple[list[Effect], ArmJoint]":
        effects = self._config.effects
        on = {self.signal, split_signal(self.signal)[0]}
        mine = [e for e in effects if isinstance(e, ArmEffect) and on & {*e.acts_on()}]
        own: list[Effect] = [e for e in mine if e.fitted and e.name not in held]
        others = [e for e in effects if not any(e is mine for mine in own)]
        return own, ArmJoint(dataclasses.replace(self._config, effects=others), self.signal)

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
        for free in ([name for name in ROBOT.joints if f"{arm}_{name}" in angles], [joint]):
            model = arm_bench.arm_spec(
                self._config, arm, known.pose, free, known.payload_kg, known.payload_at_m
            ).compile()
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
            q = np.column_stack([angles[f"{arm}_{name}"] for name in free])
            needed, carried, _ = torque_along(model, q, m.period_s)
            both.append((needed - carried)[:, model.joint(self.signal).dofadr[0]])
        return both[0] - both[1]


def selectors(cls: type[Effect], signal: str) -> dict[str, Any] | None:
    """Arguments (``arm``, ``joints``) with which an effect acts on one joint of the PiPER alone; None if it cannot act on it."""
    arm, joint = signal.split("_", 1)
    if issubclass(cls, JointEffect):
        return {"arm": arm, "joints": [joint]} if joint in cls.possible else None
    return {"arm": arm} if issubclass(cls, ArmEffect) else None
