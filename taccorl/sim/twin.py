"""The twin: two arms on a table, cameras, a task's parts, and the physical effects that have been added to it."""

from dataclasses import dataclass, field

import mujoco

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.cameras import CameraConfig, add_cameras, bench_cameras
from taccorl.sim.controller import ControllerConfig, add_actuators
from taccorl.sim.effects.added import edit_model
from taccorl.sim.effects.effect import Effect
from taccorl.sim.rendering import style
from taccorl.sim.robot import RobotConfig, add_arm
from taccorl.sim.sensors import SensorConfig
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.settings import check_numbers
from taccorl.sim.task import Task

CONTROL_HZ = 30  # the dataset's fps: one action a row
MOST_STEPS = 2000
"""Most physics steps within a control step: steps of 17 µs, in which a second takes a minute."""


@dataclass(kw_only=True)
class PhysicsConfig:
    """Contact and solver settings, chosen by measurement: docs/benchmarks.md, penetration and creep."""

    steps_per_control_step: int = 40
    """Number of physics steps within one control step of 1/30 s; a multiple of 20, so that samples at 200 Hz (joints) and 100 Hz
    (pads) fall on whole steps."""
    impratio: float = 10.0
    """Stiffness of friction relative to the normal force: at 1 a gripped part creeps, at 50 a step costs twice as much."""

    def __post_init__(self) -> None:
        if (
            not 20 <= self.steps_per_control_step <= MOST_STEPS
            or self.steps_per_control_step % 20
        ):
            raise TaccorlError(
                f"physics.steps_per_control_step: {self.steps_per_control_step:.10g} is not a multiple of 20 from 20 to "
                f"{MOST_STEPS}; 20 is a step of 1.67 ms, 40 of 0.83 ms"
            )
        check_numbers("physics", self, positive=("impratio",))

    @property
    def timestep_s(self) -> float:
        """Duration of a physics step [s]."""
        return 1.0 / (CONTROL_HZ * self.steps_per_control_step)


@dataclass(kw_only=True)
class TwinConfig:
    """Complete definition of a twin except its task; the content of a ``twin.yaml``."""

    robot: RobotConfig = field(default_factory=RobotConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    arm_controllers: dict[str, ControllerConfig] = field(default_factory=dict)
    """``left`` or ``right`` → gains of that arm, where they differ from ``controller``."""
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    cameras: list[CameraConfig] = field(default_factory=lambda: list(bench_cameras()))
    sensor: SensorConfig = field(default_factory=FlexiTacConfig)
    effects: list[Effect] = field(default_factory=list)
    """Physical effects of the twin, in any order."""

    def __post_init__(self) -> None:
        for arm in self.arm_controllers:
            if arm not in ROBOT.arms:
                raise TaccorlError(
                    f"arm_controllers: no arm {arm!r}; {nearest(arm, ROBOT.arms)}"
                )

    def controller_of(self, arm: str) -> ControllerConfig:
        """Controller gains of one arm."""
        return self.arm_controllers.get(arm, self.controller)


def empty_bench(config: TwinConfig) -> mujoco.MjSpec:
    """Model specification with table, arms and actuators, to which a task adds its parts."""
    spec = mujoco.MjSpec()
    spec.modelname = "taccorl"
    spec.compiler.degree = False
    option = spec.option
    option.timestep = config.physics.timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # MuJoCo 4.0.0's Newton solver gives wrong accelerations with sparse Jacobians, which
    # it takes by itself where a scene has 60 degrees of freedom or more; 4.0.1 does not.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.impratio = config.physics.impratio
    option.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_AUTORESET
    )  # a diverged simulation must stay one
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.5, 0.7, 0.02],
        pos=[0.35, 0, -0.02],
        rgba=[0.78, 0.74, 0.66, 1],
        friction=[0.6, 0.005, 0.0001],
        solref=[0.005, 1],
    )
    for arm in ROBOT.arms:
        add_arm(spec, arm, config.robot)
    for arm in ROBOT.arms:
        add_actuators(spec, arm, config.robot, config.controller_of(arm))
    return spec


def build_spec(config: TwinConfig, task: Task) -> mujoco.MjSpec:
    """Build the complete model specification of a task's scene: arms, parts, cameras, sensors and effects."""
    spec = empty_bench(config)
    task.add_parts(spec)
    add_cameras(spec, config.cameras)
    style(spec)
    _add_encoders(spec)
    _add_contact_sensors(spec, task)
    edit_model(spec, config)
    return spec


def _add_encoders(spec: mujoco.MjSpec) -> None:
    """``left_joint1_pos`` … ``right_gripper_pos``: read through MuJoCo's sensors, so that a delay is an attribute of theirs."""
    for arm in ROBOT.arms:
        for joint in ROBOT.joints:
            spec.add_sensor(
                name=f"{arm}_{joint}_pos",
                type=mujoco.mjtSensor.mjSENS_JOINTPOS,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=f"{arm}_{joint}",
            )
        spec.add_sensor(
            name=f"{arm}_gripper_pos",
            type=mujoco.mjtSensor.mjSENS_TENDONPOS,
            objtype=mujoco.mjtObj.mjOBJ_TENDON,
            objname=f"{arm}_opening",
        )


_FOUND, _DIST, _FORCE = (
    1 << int(field)
    for field in (
        mujoco.mjtConDataField.mjCONDATA_FOUND,
        mujoco.mjtConDataField.mjCONDATA_DIST,
        mujoco.mjtConDataField.mjCONDATA_FORCE,
    )
)
_MIN_DIST, _NET_FORCE = 1, 3  # reductions of MuJoCo's contact sensor


def _add_contact_sensors(spec: mujoco.MjSpec, task: Task) -> None:
    """``left_a_on_plug`` (number of contacts) for each pad and part; ``plug_on_socket`` (number, distance) and
    ``plug_on_socket_force`` for each mating pair."""
    body, geom = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_GEOM
    for part in task.parts:
        for pad in ROBOT.pads:
            _contact_sensor(
                spec, f"{pad}_on_{part}", (geom, pad), part, _FOUND, _MIN_DIST
            )
    for one, other in task.mating:
        _contact_sensor(
            spec, f"{one}_on_{other}", (body, one), other, _FOUND | _DIST, _MIN_DIST
        )
        _contact_sensor(
            spec, f"{one}_on_{other}_force", (body, one), other, _FORCE, _NET_FORCE
        )


def _contact_sensor(
    spec: mujoco.MjSpec,
    name: str,
    obj: tuple[mujoco.mjtObj, str],
    body: str,
    data: int,
    reduce: int,
) -> None:
    spec.add_sensor(
        name=name,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=obj[0],
        objname=obj[1],
        reftype=mujoco.mjtObj.mjOBJ_BODY,
        refname=body,
        intprm=[data, reduce, 1],
    )
