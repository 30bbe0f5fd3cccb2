"""Encoder bias: the reported angle is off by a constant, and the controller works on the reported angle."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("encoder_bias")
@dataclass(kw_only=True)
class EncoderBias(JointEffect):
    """y = q + b, and τ = K_p (q* − y) − K_d q̇ + T_ref: the joint settles at q* − b and reports q*.

    So the report alone tells nothing at rest; cameras, touch and the arm's weight do.
    """

    name: ClassVar = "encoder_bias"
    bias_rad: float = parameter(
        unit="rad",
        symbol="b",
        absent=0.0,
        low=-0.2,
        high=0.2,
        typical=0.01,
        source="a choice: half a degree from zeroing an arm by hand",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            actuator = spec.actuator(name)
            actuator.biasprm[0] -= actuator.gainprm[0] * self.bias_rad  # K_p (q* − q − b)

    def encoder(self, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:, self.columns] += self.bias_rad
        return values
