"""Effects of what an encoder reports: late, off by a constant, by a factor or by a wave. The controller works on the report,
except that it comes late to others only."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import JointEffect, Memory, effect, number
from taccorl.sim.effects.history import delay
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effect("encoder_bias", slot="encoder", needs="position")
class EncoderBias(JointEffect):
    """Constant error of an encoder: y = q + b, and τ = K_p (q* − y) − K_d q̇ + T_ref. The joint settles at q* − b and reports
    q*. So the reported angle alone does not show the effect at rest; cameras, touch and the arm's weight do."""

    bias_rad: float = number(
        "b",
        "rad",
        0,
        0.01,
        (-0.2, 0.2),
        "a choice: half a degree from zeroing an arm by hand",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            actuator = spec.actuator(name)
            actuator.biasprm[0] -= (
                actuator.gainprm[0] * self.bias_rad
            )  # K_p (q* − q − b)

    def encoder(self, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:, self.columns] += self.bias_rad
        return values


@effect("encoder_eccentricity", slot="encoder", needs="position")
class EncoderEccentricity(JointEffect):
    """Sinusoidal error of an encoder: y = q + A sin(q + φ), and τ = K_p (q* − y) − K_d ẏ + T_ref with ẏ = q̇ (1 + A cos(q + φ)).
    At rest the joint reports q*.

    A is the eccentricity of the encoder's disc divided by its radius. Gravity compensation uses the true pose. A physics step
    uses the error at its beginning."""

    rewrites: ClassVar = ("actuator_biasprm",)
    kept: ClassVar = ("angle_rad",)
    amplitude_rad: float = number(
        "A", "rad", 0, 0.01, (0, 0.1), "a choice: 0.1 mm on a disc of 10 mm"
    )
    phase_rad: float = number("φ", "rad", None, 0, (-math.tau, math.tau))

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: sine and cosine, of both signs."""
        return [
            {"phase_rad": phase} for phase in (0.0, math.pi / 2, math.pi, -math.pi / 2)
        ]

    def encoder(self, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:, self.columns] += self.amplitude_rad * np.sin(
            values[:, self.columns] + self.phase_rad
        )
        return values

    def look(self, live: LiveModel) -> Sequence[np.ndarray]:
        return (live.seen("qpos")[:, live.angles(self.acts_on())],)

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        turned = memory["angle_rad"] + self.phase_rad
        bias, actuators = live.own("actuator_biasprm"), live.actuators(self.acts_on())
        bias[:, actuators, 0] += (
            bias[:, actuators, 1] * self.amplitude_rad * np.sin(turned)
        )
        bias[:, actuators, 2] *= 1.0 + self.amplitude_rad * np.cos(turned)


@effect("encoder_scale", slot="encoder", needs="position")
class EncoderScale(JointEffect):
    """Scale error of an encoder: y = s q, and τ = K_p (q* − y) − K_d ẏ + T_ref. The joint settles at q* / s and reports q*.
    Angles are measured from the joint's zero. Gravity compensation uses the true pose."""

    factor: float = number("s", "1", 1, 1.02, (0.9, 1.1))

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            spec.actuator(name).biasprm[1:3] *= self.factor

    def encoder(self, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:, self.columns] *= self.factor
        return values


@effect("sensor_delay", slot="encoder", needs="position")
class SensorDelay(JointEffect):
    """Delay of the reported angle: y(t) = q(t − d). The motion does not change: the controller is in the drive and uses q
    without delay."""

    possible: ClassVar = (*ROBOT.joints, "gripper")
    delay_s: float = number(
        "d", "s", 0, 0.02, (0, 0.2), "a choice: some cycles of the 200 Hz report"
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            delay(spec.sensor(f"{name}_pos"), self.delay_s, config.physics.timestep_s)
