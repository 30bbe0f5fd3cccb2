"""Encoder scale: the reported angle is the true one times a factor, and the controller works on the reported angle."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("encoder_scale")
@dataclass(kw_only=True)
class EncoderScale(JointEffect):
    """Scale error of an encoder: y = s q, and τ = K_p (q* − y) − K_d ẏ + T_ref. The joint settles at q* / s and reports q*.

    Angles are measured from the joint's zero. Gravity compensation uses the true pose.
    """

    name: ClassVar = "encoder_scale"
    needs: ClassVar = ("position",)
    equation: ClassVar = "y = s q; τ = K_p (q* − y) − K_d ẏ + T_ref"
    in_words: ClassVar = (
        "The gear ratio or the counts a turn are a little off in the driver: every angle is wrong by a percentage."
    )
    at_a_policy: ClassVar = (
        "The hand is off by more the further a joint is from its zero, while proprioception says that all is well."
    )
    to_record: ClassVar = "A camera on the hand at both ends of the range; joint data alone hardly show it."
    near_twins: ClassVar = {
        "encoder_bias": "A wrong scale is a bias that grows with the angle; go to both ends of the range.",
        "torque_scale": (
            "Seen through a scaled encoder weight and inertia look smaller; a camera or a known angle tells."
        ),
    }
    factor: float = parameter(
        unit="1",
        symbol="s",
        absent=1.0,
        low=0.9,
        high=1.1,
        typical=1.02,
        source="a choice",
    )

    def drive(self) -> dict[str, float]:
        return {"encoder_scale": self.factor}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            spec.actuator(name).biasprm[1:3] *= self.factor

    def encoder(self, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:, self.columns] *= self.factor
        return values
