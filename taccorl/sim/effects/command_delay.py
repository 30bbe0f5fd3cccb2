"""Command delay: targets reach the controller late."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter
from taccorl.sim.effects.history import delay

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("command_delay")
@dataclass(kw_only=True)
class CommandDelay(JointEffect):
    """Delay of the commands: the controller receives q*(t − d), because of bus, driver and interpolation in the drive. The phase
    lag grows in proportion to the frequency.

    The control loop itself is not delayed, because it runs in the drive.
    """

    name: ClassVar = "command_delay"
    needs: ClassVar = ("target",)
    equation: ClassVar = "τ = K_p (q*(t − d) − q) − K_d q̇ + T_ref"
    in_words: ClassVar = (
        "Commands reach the drive late: bus, driver, interpolation. The drive's own loop is not delayed."
    )
    at_a_policy: ClassVar = (
        "Everything happens d later than it was trained for; near contact that is d times the speed too deep."
    )
    to_record: ClassVar = "A chirp up to 3 Hz or more, and steps: the joint stands still for d after each."
    near_twins: ClassVar = {
        "torque_lag": "A small phase in either; the one within the loop grows with the gains: record at twice the gain.",
        "command_lag": (
            "Slow motion is late by the same time in both; steps tell: a delay stands still, a lag begins at once."
        ),
        "sensor_delay": (
            "A report that is late by d looks the same while nothing is touched; efforts, pads or a camera on the same"
            " clock tell which it is."
        ),
        "velocity_feedforward": "It takes K_d / K_p off the lag as a delay adds to it; steps and 2× gain tell.",
        "dropped_commands": (
            "On average commands are older by p / (1 − p) periods; a delay repeats, drops do not: record twice."
        ),
        "joint_compliance": "A small phase in either; a delay leaves no resonance: small, fast chirp.",
    }
    possible: ClassVar = (*ROBOT.joints, "gripper")
    delay_s: float = parameter(
        unit="s",
        symbol="d",
        absent=0.0,
        low=0.0,
        high=0.2,
        typical=0.02,
        source="a choice; 0.8–4 ms fitted to a Unitree Go2 (iit-DLSLab/sim2real-robot-identification)",
    )

    def drive(self) -> dict[str, float]:
        return {"command_delay": self.delay_s}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            delay(spec.actuator(name), self.delay_s, config.physics.timestep_s)
