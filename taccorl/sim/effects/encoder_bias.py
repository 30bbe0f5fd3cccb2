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
    """Constant error of an encoder: y = q + b, and τ = K_p (q* − y) − K_d q̇ + T_ref. The joint settles at q* − b and reports
    q*.

    So the reported angle alone does not show the effect at rest; cameras, touch and the arm's weight do.
    """

    name: ClassVar = "encoder_bias"
    needs: ClassVar = ("position",)
    equation: ClassVar = "y = q + b; τ = K_p (q* − y) − K_d q̇ + T_ref"
    in_words: ClassVar = (
        "The joint's zero is off: the arm reports an angle that is wrong by a constant, and goes to wrong places on "
        "purpose."
    )
    at_a_policy: ClassVar = (
        "The hand is off by b times its reach while proprioception says that all is well; pictures disagree with it."
    )
    to_record: ClassVar = (
        "A camera on the hand, or touching a known point from both sides: joint data alone hardly show it."
    )
    near_twins: ClassVar = {
        "torque_ff": (
            "A constant torque moves the angle by T_ref / K_p, a bias moves what it is called; twice the gain halves "
            "the first."
        ),
        "encoder_scale": "A wrong scale is a bias that grows with the angle; go to both ends of the range.",
        "encoder_eccentricity": "Over a part of a turn a wave is a bias; go over the whole range.",
    }
    bias_rad: float = parameter(
        unit="rad",
        symbol="b",
        absent=0.0,
        low=-0.2,
        high=0.2,
        typical=0.01,
        source="a choice: half a degree from zeroing an arm by hand",
    )

    def drive(self) -> dict[str, float]:
        return {"encoder_bias": self.bias_rad}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            actuator = spec.actuator(name)
            actuator.biasprm[0] -= actuator.gainprm[0] * self.bias_rad  # K_p (q* − q − b)

    def encoder(self, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:, self.columns] += self.bias_rad
        return values
