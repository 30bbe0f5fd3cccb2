"""Sensor delay: angles and openings are reported late."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter
from taccorl.sim.effects.history import delay

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("sensor_delay")
@dataclass(kw_only=True)
class SensorDelay(JointEffect):
    """Delay of the reported angle: y(t) = q(t − d). The motion does not change: the controller is in the drive and uses q
    without delay."""

    name: ClassVar = "sensor_delay"
    needs: ClassVar = ("position",)
    equation: ClassVar = "y(t) = q(t − d)"
    in_words: ClassVar = (
        "Angles are reported late: a slow bus or a driver that buffers. The motion itself is as before."
    )
    at_a_policy: ClassVar = (
        "It sees the arm where it was; together with pictures, which have another delay, the state contradicts itself."
    )
    to_record: ClassVar = "Fast motion with a camera, pads or efforts on the same clock."
    near_twins: ClassVar = {
        "torque_lag": "A small phase in either; the one within the loop grows with the gains: record at twice the gain.",
        "command_lag": "Slow motion is late by the same time in both; steps tell: a delay stands still, a lag begins at once.",
        "command_delay": (
            "A command that is late by d looks the same while nothing is touched; efforts, pads or a camera on the "
            "same clock tell which it is."
        ),
    }
    possible: ClassVar = (*ROBOT.joints, "gripper")
    delay_s: float = parameter(
        unit="s",
        symbol="d",
        absent=0.0,
        low=0.0,
        high=0.2,
        typical=0.02,
        source="a choice: some cycles of the 200 Hz report",
    )

    def drive(self) -> dict[str, float]:
        return {"encoder_delay": self.delay_s}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            delay(spec.sensor(f"{name}_pos"), self.delay_s, config.physics.timestep_s)
