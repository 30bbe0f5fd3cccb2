"""Command delay: targets reach the controller late."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter
from taccorl.sim.effects.history import delay
from taccorl.sim.robot import JOINTS

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("command_delay")
@dataclass(kw_only=True)
class CommandDelay(JointEffect):
    """The controller works on q*(t − d): bus, driver, interpolation in the drive. The phase lags in proportion to the frequency.

    The control loop itself is not delayed: it runs in the drive.
    """

    name: ClassVar = "command_delay"
    possible: ClassVar = (*JOINTS, "gripper")
    delay_s: float = parameter(
        unit="s",
        symbol="d",
        absent=0.0,
        low=0.0,
        high=0.2,
        typical=0.02,
        source="a choice; 0.8–4 ms on a Unitree Go2, research/discrepancy.md §4.6",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            delay(spec.actuator(name), self.delay_s, config.physics.timestep_s)
