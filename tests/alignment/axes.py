"""Axes for tests: robots of one joint without a model."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from taccorl.alignment.controller.joint_model import JointModel, JointResponse
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.machines.robot_file import JointConfig, Robot, robot_of
from taccorl.alignment.machines.robot_joint import RobotJoint
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import Effect

type Entries = Sequence[tuple[str, Mapping[str, Any]]]
"""Name and parameters of each effect."""


def axis_of(*, name: str, effects: Entries = (), **numbers: Any) -> Robot:
    """The axis of that name with the numbers of an axis file."""
    config = JointConfig(**numbers)
    robot = robot_of({name: config}, Path("bench.yaml"))
    made = [robot.joint(name).made(effect, **values) for effect, values in effects]
    config = dataclasses.replace(config, effects=made)
    config.check(has_model=False)
    return robot.with_joint(name, config)


def name_of(robot: Robot) -> str:
    return next(iter(robot.config.joints))


def config_of(robot: Robot) -> JointConfig:
    return robot.config.joints[name_of(robot)]


def altered(robot: Robot, **numbers: Any) -> Robot:
    """The axis with other numbers; ``effects`` replace its own, ``name`` its name."""
    old = config_of(robot)
    given: Entries = [
        (e.name, {key: getattr(e, key) for key in e.settings()}) for e in old.effects
    ]
    name, effects = numbers.pop("name", name_of(robot)), numbers.pop("effects", given)
    fields = [f.name for f in dataclasses.fields(old) if f.name != "effects"]
    own = {key: getattr(old, key) for key in fields}
    return axis_of(name=name, effects=effects, **(own | numbers))


def joint_of(robot: Robot) -> RobotJoint:
    return robot.joint(name_of(robot))


def effect_class(robot: Robot, effect: str) -> type[Effect] | None:
    joint, cls = joint_of(robot), registry.get(effect)
    return None if joint.selectors(cls) is None else joint.in_units(cls)


def problem_of(robot: Robot, measurements: Measurements) -> JointProblem:
    return JointProblem(robot, name_of(robot), measurements)


def axis_motion(robot: Robot, m: Measurement) -> JointMotion:
    joint = joint_of(robot)
    return motion_of(joint.whole(m), joint.signal, joint)


def axis_answer(
    robot: Robot, motion: JointMotion, effects: Sequence[Effect] = ()
) -> JointResponse:
    model = JointModel(joint_of(robot))
    return model.simulate(motion, model.gains, effects)
