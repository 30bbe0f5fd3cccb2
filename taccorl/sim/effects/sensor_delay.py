"""Sensor delay: angles and openings are reported late."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter
from taccorl.sim.effects.history import delay
from taccorl.sim.robot import JOINTS

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("sensor_delay")
@dataclass(kw_only=True)
class SensorDelay(JointEffect):
    """y(t) = q(t − d): the arm moves as before, the report lags. Its controller sits in the drive and sees q at once."""

    name: ClassVar = "sensor_delay"
    possible: ClassVar = (*JOINTS, "gripper")
    delay_s: float = parameter(
        unit="s",
        symbol="d",
        absent=0.0,
        low=0.0,
        high=0.2,
        typical=0.02,
        source="a choice: some cycles of the 200 Hz report",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            delay(spec.sensor(f"{name}_pos"), self.delay_s, config.physics.timestep_s)
